# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Reachable reference across the jumps of the reference."""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import TypedKernel, contiguous, kernel
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
        'acceleration of the ramp: at most the acceleration limit of a wheel; a torque drive '
        'crosses with what its motors have for the direction of the jump instead',
        'rad/s²',
        (0.1, 1e4),
        dynamic=True,
    )


class MotorLimit(NamedTuple):
    """What the motors of a torque drive have for a jump."""

    inertia: Array
    """theta_bar of (11), kg m², shape (2, 2)."""
    torque: float
    """Largest torque of a wheel, N m."""

    def accelerations(self, jump: Array) -> Array:
        r"""Return the largest accelerations for a jump (rad/s), rad/s², shape (2,), positive.

        Both wheels cross in the same time t, so that the body keeps one direction:

        .. math:: t = \max_i |(\bar\theta J)_i| / \tau, \qquad a_i = |J_i| / t

        Two wheels that turn the body need more torque for the same acceleration than two that
        push it. A wheel that hardly jumps may be a little faster than that, since it is soon
        across.
        """
        needed = float(np.max(np.abs(self.inertia @ jump))) / self.torque
        if needed == 0.0:
            return np.full(2, math.nan)
        alike = np.abs(jump) / needed
        found: Array = np.maximum(alike, 0.25 * alike.max())
        return found


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
    motor_limit
        Of a torque drive, whose ramps it determines; None: the parameters do.
    """

    def __init__(
        self,
        parameters: JumpTransitionParameters,
        lag: float,
        period: float,
        motor_limit: MotorLimit | None = None,
    ) -> None:
        self._parameters = parameters
        self._motor_limit = motor_limit
        self._lag = lag
        self._period = period
        self.count = 0
        """Number of unfinished transitions."""
        self._transitions = Transitions(
            np.zeros((8, 4, 2)), np.zeros(8, dtype=np.int64), np.zeros(8, dtype=np.bool_)
        )
        self._plan = Plan(np.zeros(2), np.zeros(2), np.zeros((4, 2)))
        self._step_transitions = TypedKernel(step_transitions)

    @property
    def reachable(self) -> Array:
        """Return rbar at the last step, rad/s, shape (2,)."""
        return self._plan.reachable

    @property
    def rate(self) -> Array:
        """Derivative of rbar until the next step, rad/s², shape (2,)."""
        return self._plan.rate

    def configure(self, parameters: JumpTransitionParameters) -> None:
        """Use new values of the dynamic parameters from the next step on."""
        self._parameters = parameters

    def reset(self) -> None:
        """Discard all jumps: rbar is r."""
        self.count = 0
        self._plan.sums[:] = 0.0

    @property
    def offset(self) -> Array:
        """Offset h at the last step, rad/s, shape (2,)."""
        row: Array = self._plan.sums[OFFSET]
        return row

    @property
    def offset_next(self) -> Array:
        """Offset h one period later, rad/s, shape (2,)."""
        row: Array = self._plan.sums[OFFSET_NEXT]
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
            ahead = (int(self._transitions.instants[k]) - now_ns) / NANOSECONDS
            row = math.ceil(ahead / span - 1e-9) - 1
            if 0 <= row < rows:
                change[row] -= self._transitions.ramps[k, JUMP]
        return change

    def pop_passed(self, now_ns: int) -> Array:
        """Remove the jumps up to ``now_ns`` and return their sum, rad/s, shape (2,)."""
        total = np.zeros(2)
        for k in reversed(range(self.count)):
            if self._transitions.instants[k] <= now_ns:
                total += self._transitions.ramps[k, JUMP]
                for rows in self._transitions:
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
        if k == len(self._transitions.instants):
            longer = (np.concatenate((rows, np.zeros_like(rows))) for rows in self._transitions)
            self._transitions = Transitions._make(longer)
        ramps, instants, passed = self._transitions
        limit = self._motor_limit
        known = (math.nan, math.nan) if limit is None else limit.accelerations(jump)
        ramps[k] = (jump, slope_after, (0.0, 0.0), known)
        instants[k] = instant_ns
        passed[k] = False
        self.count += 1

    def withdraw(self, instant_ns: int) -> None:
        """Cancel the jumps announced for ``instant_ns`` or later."""
        ramps, instants, passed = self._transitions
        for k in range(self.count):
            if not passed[k] and instants[k] >= instant_ns:
                ramps[k, JUMP] = 0.0
                instants[k] = instant_ns
                passed[k] = True

    def step(self, now_ns: int, reference: Array, reference_next: Array) -> None:
        """Update ``reachable``, ``rate`` and the offsets for the period that starts at ``now_ns``.

        Parameters
        ----------
        now_ns
            Instant at which the next command takes effect, ns.
        reference, reference_next
            r at that instant and one period later, including its jumps, rad/s, shape (2,).
        """
        self.count = self._step_transitions(
            self._transitions,
            self.count,
            now_ns,
            contiguous(reference),
            contiguous(reference_next),
            self._period,
            self._lag,
            self._parameters.acceleration,
            self._plan,
        )


JUMP, SLOPE_AFTER, COVERED, ACCELERATION = range(4)
"""Rows of a transition: jump (rad/s), r' after it (rad/s²), commanded part of the jump (rad/s),
acceleration of a torque drive, or NaN (rad/s²)."""
RESPONSE, PASSED, OFFSET, OFFSET_NEXT = range(4)
"""Rows of the sums over all transitions (rad/s): servo response to the commanded parts, jumps
that r has made, and h now and one period later."""


class Transitions(NamedTuple):
    """Jumps that are known, for kernels; the first ``count`` rows are valid."""

    ramps: Array
    """Rows JUMP to ACCELERATION of each, shape (n, 4, 2)."""
    instants: Stamps
    """When r jumps, ns, shape (n,)."""
    passed: Flags
    """Whether it has, shape (n,)."""


class Plan(NamedTuple):
    """Results of :func:`step_transitions`."""

    reachable: Array
    """rbar now, rad/s, shape (2,)."""
    rate: Array
    """Its derivative until the next step, rad/s², shape (2,)."""
    sums: Array
    """Rows RESPONSE, PASSED, OFFSET and OFFSET_NEXT, shape (4, 2)."""


@kernel
def step_transitions(
    transitions: Transitions,
    count: int,
    now_ns: int,
    reference: Array,
    reference_next: Array,
    period: float,
    lag: float,
    acceleration: float,
    plan: Plan,
) -> int:
    """Update h for the period that starts at ``now_ns``; return the number of transitions left.

    count        : number of transitions
    reference, reference_next : r now and one period later, with its jumps, rad/s, shape (2,)
    period, lag  : of control and of the servo, s
    acceleration : of the ramp, rad/s²
    plan         : updated
    """
    sums = plan.sums
    ramps, instants, passed = transitions.ramps, transitions.instants, transitions.passed
    if count > 0:
        keep = math.exp(-period / lag) if lag > 0.0 else 0.0
        until_ns = now_ns + round(period * NANOSECONDS)
        # The command precedes the response of the servo; and the sampled r jumps within the
        # period before the instant, on average in its middle.
        lead = period * (keep / (1.0 - keep) + 0.5)
        for k in range(count):
            mark_passed(transitions, k, sums, now_ns)
        for i in range(2):
            sums[OFFSET, i] = sums[RESPONSE, i] - sums[PASSED, i]
            rise = reference_next[i] - reference[i]
            for k in range(count):
                if not passed[k] and until_ns >= instants[k]:
                    rise -= ramps[k, JUMP, i]
            commanded = 0.0
            for k in range(count):
                left = (instants[k] - now_ns) / NANOSECONDS - lead
                advance(ramps[k], i, passed[k], left, rise / period, period, acceleration)
                commanded += ramps[k, COVERED, i]
            sums[RESPONSE, i] += (1.0 - keep) * (commanded - sums[RESPONSE, i])
        for k in range(count):
            mark_passed(transitions, k, sums, until_ns)
        for i in range(2):
            sums[OFFSET_NEXT, i] = sums[RESPONSE, i] - sums[PASSED, i]
        # After 30 lags the remaining response is below rounding.
        over_ns = now_ns - round(30.0 * lag * NANOSECONDS)
        count = remove_finished(transitions, count, sums, over_ns)
    else:
        sums[OFFSET] = 0.0
        sums[OFFSET_NEXT] = 0.0
    for i in range(2):
        plan.reachable[i] = reference[i] + sums[OFFSET, i]
        after = reference_next[i] + sums[OFFSET_NEXT, i]
        plan.rate[i] = (after - plan.reachable[i]) / period
    return count


@kernel
def mark_passed(transitions: Transitions, k: int, sums: Array, now_ns: int) -> None:
    """Add jump ``k`` to the passed ones once its instant is reached."""
    if not transitions.passed[k] and now_ns >= transitions.instants[k]:
        transitions.passed[k] = True
        for i in range(2):
            sums[PASSED, i] += transitions.ramps[k, JUMP, i]


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

    transition   : shape (4, 2), rows JUMP to ACCELERATION
    passed       : whether r has jumped
    left         : time until the jump, less the lead of the command, s
    slope        : r' without the jump, rad/s²
    acceleration : of the ramp, unless the transition has its own, rad/s²
    """
    size = abs(transition[JUMP, i])
    rest = transition[JUMP, i] - transition[COVERED, i]
    if rest == 0.0:
        return
    sign = math.copysign(1.0, rest)
    if not math.isnan(transition[ACCELERATION, i]):
        acceleration = transition[ACCELERATION, i]
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
def remove_finished(transitions: Transitions, count: int, sums: Array, over_ns: int) -> int:
    """Remove the transitions finished since ``over_ns``; return the number of the others."""
    ramps, instants, passed = transitions.ramps, transitions.instants, transitions.passed
    kept = 0
    for k in range(count):
        done = passed[k] and instants[k] <= over_ns
        for i in range(2):
            done = done and ramps[k, COVERED, i] == ramps[k, JUMP, i]
        if done:
            for i in range(2):
                sums[RESPONSE, i] -= ramps[k, JUMP, i]
                sums[PASSED, i] -= ramps[k, JUMP, i]
        else:
            for row in range(4):
                for i in range(2):
                    ramps[kept, row, i] = ramps[k, row, i]
            instants[kept] = instants[k]
            passed[kept] = passed[k]
            kept += 1
    return kept
