# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Reachable reference across the jumps of the reference."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters, parameter

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]
Flags = NDArray[np.bool_]

NANOSECONDS = 1e9


@dataclass(frozen=True)
class JumpTransitionParameters(Parameters):
    """Treatment of the jumps of the reference."""

    preview: bool = parameter(
        True,
        'whether the transition of a jump that is known in advance starts before the jump; false: '
        'the reference is known up to the present only and is extrapolated by its slope',
        dynamic=True,
    )
    method: str = parameter(
        'ramp',
        'ramp: the law follows a ramp across the jump; predictive: the law follows the jump '
        'itself, which enters Psi_free as a known disturbance, and v_p acts within its bound',
        choices=('ramp', 'predictive'),
    )
    acceleration: float = parameter(
        30.0,
        'acceleration of the ramp: at most the acceleration limit of a wheel; the evaluation uses '
        'a larger value for the torque drive, which has no such limit',
        unit='rad/s²',
        low=0.1,
        high=1e4,
        dynamic=True,
    )


class JumpTransition:
    r"""Computes rbar = r + h, a reference that the wheels can reach, around the jumps of r.

    Assumption 3 of the paper, a reachable reference, does not hold at a jump of r. The law
    follows rbar instead: all of (66)-(84) then holds for chi - rbar, and the adaptation does not
    learn the jump as an estimation error.

    A wheel with bounded acceleration a crosses a jump J with the least squared error if it
    departs from the old reference before the jump. With the relative accelerations
    a_1 = a - s r' before and a_2 after the jump (s the sign of J), the integral of the squared
    error is x³/(3 a_1) + (|J| - x)³/(3 a_2), where x is the distance covered before the jump. Its
    minimum is at

    .. math:: x = |J| \sqrt{a_1} / (\sqrt{a_1} + \sqrt{a_2}),

    half of J if the slopes are equal; the squared error is then a quarter of the one of a
    transition that starts at the jump. The transition of a jump that becomes known later starts
    at once. The *command* crosses with a, one servo lag in advance, and rbar is the response of
    the servo to it.

    Parameters
    ----------
    parameters
        Acceleration of the ramp.
    lag
        Time constant of the servo, s; 0 for a torque drive.
    period
        Control period, s.
    """

    def __init__(self, parameters: JumpTransitionParameters, lag: float, period: float) -> None:
        self._parameters = parameters
        self._lag = lag
        self._period = period
        self.count = 0
        """Number of unfinished transitions."""
        self._transitions: Array = np.zeros((8, 3, 2))
        self._instants: Stamps = np.zeros(8, dtype=np.int64)
        self._passed: Flags = np.zeros(8, dtype=np.bool_)
        self._sums: Array = np.zeros((4, 2))
        self.reachable: Array = np.zeros(2)
        """rbar at the last step, rad/s, shape (2,)."""
        self.rate: Array = np.zeros(2)
        """Derivative of rbar until the next step, rad/s², shape (2,)."""

    def configure(self, parameters: JumpTransitionParameters) -> None:
        """Use new values of the dynamic parameters from the next step on."""
        self._parameters = parameters

    def reset(self) -> None:
        """Discard all jumps: rbar is r."""
        self.count = 0
        self._sums[:] = 0.0

    @property
    def offset(self) -> Array:
        """Offset h at the last step, rad/s, shape (2,)."""
        row: Array = self._sums[OFFSET]
        return row

    @property
    def offset_next(self) -> Array:
        """Offset h one period later, rad/s, shape (2,)."""
        row: Array = self._sums[OFFSET_NEXT]
        return row

    @property
    def active(self) -> bool:
        """Whether rbar may differ from r."""
        return self.count > 0

    def future_jumps(self, now_ns: int, span: float, rows: int) -> Array:
        """Return the future jumps of delta = chi - r, shape (rows, 2), rad/s.

        Row j holds the jumps between ``now_ns`` + j span and + (j + 1) span (s), for Psi_free
        (56) in :meth:`t3mpc_ros.mpc.predictive_controller.PredictiveController.step`.
        """
        change = np.zeros((rows, 2))
        for k in range(self.count):
            ahead = (int(self._instants[k]) - now_ns) / NANOSECONDS
            row = math.ceil(ahead / span - 1e-9) - 1
            if 0 <= row < rows:
                change[row] -= self._transitions[k, JUMP]
        return change

    def pop_passed(self, now_ns: int) -> Array:
        """Remove the jumps up to ``now_ns`` and return their sum, rad/s, shape (2,)."""
        total = np.zeros(2)
        for k in reversed(range(self.count)):
            if self._instants[k] <= now_ns:
                total += self._transitions[k, JUMP]
                for rows in (self._transitions, self._instants, self._passed):
                    rows[k : self.count - 1] = rows[k + 1 : self.count].copy()
                self.count -= 1
        return total

    def announce(self, instant_ns: int, jump: Array, slope_after: Array) -> None:
        """Add a jump of r, past or future.

        Parameters
        ----------
        instant_ns
            First instant with the new value, ns.
        jump
            Change in addition to the previous slope, rad/s, shape (2,).
        slope_after
            r' after the jump, rad/s², shape (2,).
        """
        k = self.count
        if k == len(self._instants):
            self._transitions = np.concatenate(
                (self._transitions, np.zeros_like(self._transitions))
            )
            self._instants = np.concatenate((self._instants, np.zeros_like(self._instants)))
            self._passed = np.concatenate((self._passed, np.zeros_like(self._passed)))
        self._transitions[k] = (jump, slope_after, (0.0, 0.0))
        self._instants[k] = instant_ns
        self._passed[k] = False
        self.count += 1

    def withdraw(self, instant_ns: int) -> None:
        """Cancel the jumps announced for ``instant_ns`` or later."""
        for k in range(self.count):
            if not self._passed[k] and self._instants[k] >= instant_ns:
                self._transitions[k, JUMP] = 0.0
                self._instants[k] = instant_ns
                self._passed[k] = True

    def step(self, now_ns: int, reference: Array, reference_next: Array) -> None:
        """Update ``reachable``, ``rate`` and the offsets for the period that starts at ``now_ns``.

        Parameters
        ----------
        now_ns
            Instant at which the next command takes effect, ns.
        reference, reference_next
            r at that instant and one period later, including its jumps, rad/s, shape (2,).
        """
        self.count = step_transitions(
            self._transitions,
            self._instants,
            self._passed,
            self.count,
            self._sums,
            now_ns,
            reference,
            reference_next,
            self._period,
            self._lag,
            self._parameters.acceleration,
            self.reachable,
            self.rate,
        )


JUMP, SLOPE_AFTER, COVERED = range(3)
"""Rows of a transition: jump (rad/s), r' after it (rad/s²), commanded part of the jump (rad/s)."""
RESPONSE, PASSED, OFFSET, OFFSET_NEXT = range(4)
"""Rows of the sums over all transitions (rad/s): servo response to the commanded parts, jumps
that r has made, and h now and one period later."""


@kernel
def step_transitions(
    transitions: Array,
    instants: Stamps,
    passed: Flags,
    count: int,
    sums: Array,
    now_ns: int,
    reference: Array,
    reference_next: Array,
    period: float,
    lag: float,
    acceleration: float,
    reachable: Array,
    rate: Array,
) -> int:
    """Update h for the period that starts at ``now_ns``; return the number of transitions left.

    transitions  : shape (n, 3, 2), rows JUMP, SLOPE_AFTER, COVERED; the first ``count`` are valid
    instants     : shape (n,), when r jumps, ns
    passed       : shape (n,), whether it has
    sums         : shape (4, 2), rows RESPONSE, PASSED, OFFSET, OFFSET_NEXT
    reference, reference_next : r now and one period later, with its jumps, rad/s, shape (2,)
    period, lag  : of control and of the servo, s
    acceleration : of the ramp, rad/s²
    reachable    : shape (2,), overwritten, rbar now, rad/s
    rate         : shape (2,), overwritten, its derivative until the next step, rad/s²
    """
    if count > 0:
        keep = math.exp(-period / lag) if lag > 0.0 else 0.0
        until_ns = now_ns + round(period * NANOSECONDS)
        # The command precedes the response of the servo; and the sampled r jumps within the
        # period before the instant, on average in its middle.
        lead = period * (keep / (1.0 - keep) + 0.5)
        for k in range(count):
            mark_passed(transitions, instants, passed, k, sums, now_ns)
        for i in range(2):
            sums[OFFSET, i] = sums[RESPONSE, i] - sums[PASSED, i]
            rise = reference_next[i] - reference[i]
            for k in range(count):
                if not passed[k] and until_ns >= instants[k]:
                    rise -= transitions[k, JUMP, i]
            commanded = 0.0
            for k in range(count):
                left = (instants[k] - now_ns) / NANOSECONDS - lead
                advance(transitions[k], i, passed[k], left, rise / period, period, acceleration)
                commanded += transitions[k, COVERED, i]
            sums[RESPONSE, i] += (1.0 - keep) * (commanded - sums[RESPONSE, i])
        for k in range(count):
            mark_passed(transitions, instants, passed, k, sums, until_ns)
        for i in range(2):
            sums[OFFSET_NEXT, i] = sums[RESPONSE, i] - sums[PASSED, i]
        # After 30 lags the remaining response is below rounding.
        over_ns = now_ns - round(30.0 * lag * NANOSECONDS)
        count = remove_finished(transitions, instants, passed, count, sums, over_ns)
    else:
        sums[OFFSET] = 0.0
        sums[OFFSET_NEXT] = 0.0
    for i in range(2):
        reachable[i] = reference[i] + sums[OFFSET, i]
        rate[i] = (reference_next[i] + sums[OFFSET_NEXT, i] - reachable[i]) / period
    return count


@kernel
def mark_passed(
    transitions: Array, instants: Stamps, passed: Flags, k: int, sums: Array, now_ns: int
) -> None:
    """Add jump ``k`` to the passed ones once its instant is reached."""
    if not passed[k] and now_ns >= instants[k]:
        passed[k] = True
        for i in range(2):
            sums[PASSED, i] += transitions[k, JUMP, i]


@kernel
def advance(
    transition: Array,
    i: int,
    passed: bool,
    left: float,
    slope: float,
    period: float,
    acceleration: float,
) -> None:
    """Advance the ramp of wheel ``i`` by one period after its start.

    transition   : shape (3, 2), rows JUMP, SLOPE_AFTER, COVERED
    passed       : whether r has jumped
    left         : time until the jump, less the lead of the command, s
    slope        : r' without the jump, rad/s²
    acceleration : of the ramp, rad/s²
    """
    size = abs(transition[JUMP, i])
    rest = transition[JUMP, i] - transition[COVERED, i]
    if rest == 0.0:
        return
    sign = math.copysign(1.0, rest)
    after = max(acceleration - sign * transition[SLOPE_AFTER, i], 0.2 * acceleration)
    before = after
    if not passed:
        before = max(acceleration - sign * slope, 0.2 * acceleration)
    fraction = math.sqrt(before) / (math.sqrt(before) + math.sqrt(after))
    # The first step is a fraction of a period: the ramp starts at its instant, not at a sample.
    time = min(fraction * size / before - left + period, period)
    if time > 0.0:
        transition[COVERED, i] += sign * min(before * time, abs(rest))


@kernel
def remove_finished(
    transitions: Array, instants: Stamps, passed: Flags, count: int, sums: Array, over_ns: int
) -> int:
    """Remove the transitions finished since ``over_ns``; return the number of the others."""
    kept = 0
    for k in range(count):
        done = passed[k] and instants[k] <= over_ns
        for i in range(2):
            done = done and transitions[k, COVERED, i] == transitions[k, JUMP, i]
        if done:
            for i in range(2):
                sums[RESPONSE, i] -= transitions[k, JUMP, i]
                sums[PASSED, i] -= transitions[k, JUMP, i]
        else:
            transitions[kept] = transitions[k]
            instants[kept] = instants[k]
            passed[kept] = passed[k]
            kept += 1
    return kept
