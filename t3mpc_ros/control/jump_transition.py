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
    """What is done about the jumps of a reference."""

    preview: bool = parameter(
        True,
        'whether a jump that is known beforehand is met half-way; otherwise the reference is only '
        'known up to now, and carried on by its slope',
        dynamic=True,
    )
    crossing: str = parameter(
        'ramp',
        'ramp: the law follows a ramp across the jump; program: the law follows the jump itself, '
        'which enters Psi_free as a known disturbance, and v_p does what its bound allows',
        choices=('ramp', 'program'),
    )
    acceleration: float = parameter(
        30.0,
        'acceleration with which a jump is crossed: what the limits allow one wheel; for the '
        'torque drive, which is not limited so, the lab uses more',
        unit='rad/s²',
        low=0.1,
        high=1e4,
        dynamic=True,
    )


JUMP, SLOPE_AFTER, COVERED = range(3)
"""Rows of a crossing: the jump (rad/s), r' after it (rad/s²), how far each wheel has come."""
FOLLOWED, PASSED, OFFSET, OFFSET_NEXT = range(4)
"""Rows of the sums over all crossings (rad/s): what the servo has made of the way, the jumps that
r has made, and h now and a period later."""


@kernel
def step_transition(
    crossings: Array,
    instants: Stamps,
    passed: Flags,
    count: int,
    sums: Array,
    now_ns: int,
    wanted: Array,
    wanted_next: Array,
    period: float,
    lag: float,
    most: float,
    followed: Array,
    rate: Array,
) -> int:
    """Renew h for the period that begins at ``now_ns``; return how many crossings are left.

    crossings    : shape (n, 3, 2), rows JUMP, SLOPE_AFTER, DONE; the first ``count`` count
    instants     : shape (n,), when r jumps, ns
    passed       : shape (n,), whether it has
    sums         : shape (4, 2), rows FOLLOWED, PASSED, OFFSET, OFFSET_NEXT
    wanted, wanted_next : r now and a period later, with its jumps, rad/s, shape (2,)
    period, lag  : of control and of the servo, s
    most         : acceleration with which a jump is crossed, rad/s²
    followed     : shape (2,), overwritten, rbar now, rad/s
    rate         : shape (2,), overwritten, its derivative until the next step, rad/s²
    """
    if count > 0:
        keep = math.exp(-period / lag) if lag > 0.0 else 0.0
        until_ns = now_ns + round(period * NANOSECONDS)
        # The command acts before the servo follows; and r, which is sampled, jumps somewhere in
        # the period before the instant: in its middle, as far as the squared error goes.
        early = period * (keep / (1.0 - keep) + 0.5)
        for k in range(count):
            mark_passed(crossings, instants, passed, k, sums, now_ns)
        for i in range(2):
            sums[OFFSET, i] = sums[FOLLOWED, i] - sums[PASSED, i]
            rise = wanted_next[i] - wanted[i]
            for k in range(count):
                if not passed[k] and until_ns >= instants[k]:
                    rise -= crossings[k, JUMP, i]
            told = 0.0
            for k in range(count):
                left = (instants[k] - now_ns) / NANOSECONDS - early
                advance_crossing(crossings[k], i, passed[k], left, rise / period, period, most)
                told += crossings[k, COVERED, i]
            sums[FOLLOWED, i] += (1.0 - keep) * (told - sums[FOLLOWED, i])
        for k in range(count):
            mark_passed(crossings, instants, passed, k, sums, until_ns)
        for i in range(2):
            sums[OFFSET_NEXT, i] = sums[FOLLOWED, i] - sums[PASSED, i]
        # What is left of an old crossing is less than rounding.
        over_ns = now_ns - round(30.0 * lag * NANOSECONDS)
        count = remove_finished(crossings, instants, passed, count, sums, over_ns)
    else:
        sums[OFFSET] = 0.0
        sums[OFFSET_NEXT] = 0.0
    for i in range(2):
        followed[i] = wanted[i] + sums[OFFSET, i]
        rate[i] = (wanted_next[i] + sums[OFFSET_NEXT, i] - followed[i]) / period
    return count


@kernel
def mark_passed(
    crossings: Array, instants: Stamps, passed: Flags, k: int, sums: Array, now_ns: int
) -> None:
    """Note that r has jumped when it has, see :func:`step_plan`."""
    if not passed[k] and now_ns >= instants[k]:
        passed[k] = True
        for i in range(2):
            sums[PASSED, i] += crossings[k, JUMP, i]


@kernel
def advance_crossing(
    crossing: Array, i: int, passed: bool, left: float, slope: float, period: float, most: float
) -> None:
    """Move wheel ``i`` on by one period, at its closing speed, once its time has come.

    crossing : shape (3, 2), rows JUMP, SLOPE_AFTER, DONE
    passed   : whether r has jumped
    left     : time until the jump, less that by which a command must come before, s
    slope    : r' without the jump, rad/s²
    """
    size = abs(crossing[JUMP, i])
    rest = crossing[JUMP, i] - crossing[COVERED, i]
    if rest == 0.0:
        return
    sign = math.copysign(1.0, rest)
    after = max(most - sign * crossing[SLOPE_AFTER, i], 0.2 * most)
    before = after
    if not passed:
        before = max(most - sign * slope, 0.2 * most)
    share = math.sqrt(before) / (math.sqrt(before) + math.sqrt(after))
    # The first step is a part of a period, so that the crossing is not early or late.
    time = min(share * size / before - left + period, period)
    if time > 0.0:
        crossing[COVERED, i] += sign * min(before * time, abs(rest))


@kernel
def remove_finished(
    crossings: Array, instants: Stamps, passed: Flags, count: int, sums: Array, over_ns: int
) -> int:
    """Drop the crossings that are over since ``over_ns``; return how many are left."""
    kept = 0
    for k in range(count):
        done = passed[k] and instants[k] <= over_ns
        for i in range(2):
            done = done and crossings[k, COVERED, i] == crossings[k, JUMP, i]
        if done:
            for i in range(2):
                sums[FOLLOWED, i] -= crossings[k, JUMP, i]
                sums[PASSED, i] -= crossings[k, JUMP, i]
        else:
            crossings[kept] = crossings[k]
            instants[kept] = instants[k]
            passed[kept] = passed[k]
            kept += 1
    return kept


class JumpTransition:
    r"""Plans rbar = r + h, which the wheels can follow, around the jumps of r.

    Assumption 3 of the paper, a reference that can be reached, fails where r jumps. The law
    follows rbar instead: everything of (66)-(84) then holds for chi - rbar, and nothing takes the
    jump for an estimation error and learns from it.

    A wheel that may change its speed by a at most crosses a jump J with the least squared error
    when it leaves the old reference early enough to be part of the way across at the jump. With
    closing speeds a_1 = a - s r' before and a_2 after it (s the sign of J), the error's square
    integrates to x³/(3 a_1) + (|J| - x)³/(3 a_2) for a share x covered before; the least is at

    .. math:: x = |J| \sqrt{a_1} / (\sqrt{a_1} + \sqrt{a_2}),

    half of J when the slopes are equal: a quarter of the squared error of starting at the jump. A
    jump that is known too late is crossed from when it is known. Since a servo lags, the
    *command* crosses with a, a lag earlier, and rbar is what the servo makes of it.

    Parameters
    ----------
    settings
        Acceleration.
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
        """Crossings that are not over."""
        self._crossings: Array = np.zeros((8, 3, 2))
        self._instants: Stamps = np.zeros(8, dtype=np.int64)
        self._has_passed: Flags = np.zeros(8, dtype=np.bool_)
        self._sums: Array = np.zeros((4, 2))
        self.followed: Array = np.zeros(2)
        """rbar now, rad/s, shape (2,)."""
        self.rate: Array = np.zeros(2)
        """Its derivative until the next step, rad/s², shape (2,)."""

    def configure(self, parameters: JumpTransitionParameters) -> None:
        """Use other live settings from the next step on."""
        self._parameters = parameters

    def reset(self) -> None:
        """Forget every jump: rbar is r."""
        self.count = 0
        self._sums[:] = 0.0

    @property
    def tables(self) -> tuple[Array, Stamps, Flags, Array, float, float, float, Array, Array]:
        """What :func:`step_plan` reads and writes but its inputs and the count, in its order."""
        return (
            self._crossings,
            self._instants,
            self._has_passed,
            self._sums,
            self._period,
            self._lag,
            self._parameters.acceleration,
            self.followed,
            self.rate,
        )

    @property
    def offset(self) -> Array:
        """H now, rad/s, shape (2,)."""
        row: Array = self._sums[OFFSET]
        return row

    @property
    def offset_next(self) -> Array:
        """H one period later, rad/s, shape (2,)."""
        row: Array = self._sums[OFFSET_NEXT]
        return row

    @property
    def crossing(self) -> bool:
        """Whether rbar differs from r."""
        return self.count > 0

    def known_change(self, now_ns: int, span: float, rows: int) -> Array:
        """Return the jumps of delta = chi - r still to come, shape (rows, 2), rad/s.

        Row j holds those between ``now_ns`` + j span and + (j + 1) span (s), as
        :meth:`t3mpc_ros.mpc.predictive.PredictiveController.step` takes them into Psi_free (56).
        """
        change = np.zeros((rows, 2))
        for k in range(self.count):
            ahead = (int(self._instants[k]) - now_ns) / NANOSECONDS
            row = math.ceil(ahead / span - 1e-9) - 1
            if 0 <= row < rows:
                change[row] -= self._crossings[k, JUMP]
        return change

    def take_passed(self, now_ns: int) -> Array:
        """Return the sum of the jumps up to ``now_ns`` (rad/s), shape (2,), and forget them."""
        total = np.zeros(2)
        for k in reversed(range(self.count)):
            if self._instants[k] <= now_ns:
                total += self._crossings[k, JUMP]
                for table in (self._crossings, self._instants, self._has_passed):
                    table[k : self.count - 1] = table[k + 1 : self.count].copy()
                self.count -= 1
        return total

    def announce(self, instant_ns: int, jump: Array, slope_after: Array) -> None:
        """Tell that r jumps by ``jump`` (rad/s) at an instant, past or to come.

        Parameters
        ----------
        instant_ns
            First instant at which the new value holds, ns.
        jump
            Change beyond the slope of before, rad/s, shape (2,).
        slope_after
            r' after it, rad/s², shape (2,).
        """
        k = self.count
        if k == len(self._instants):
            self._crossings = np.concatenate((self._crossings, np.zeros_like(self._crossings)))
            self._instants = np.concatenate((self._instants, np.zeros_like(self._instants)))
            self._has_passed = np.concatenate((self._has_passed, np.zeros_like(self._has_passed)))
        self._crossings[k] = (jump, slope_after, (0.0, 0.0))
        self._instants[k] = instant_ns
        self._has_passed[k] = False
        self.count += 1

    def withdraw(self, instant_ns: int) -> None:
        """Take back the jumps announced for ``instant_ns`` or later: r will not jump after all."""
        for k in range(self.count):
            if not self._has_passed[k] and self._instants[k] >= instant_ns:
                self._crossings[k, JUMP] = 0.0
                self._instants[k] = instant_ns
                self._has_passed[k] = True

    def step(self, now_ns: int, wanted: Array, wanted_next: Array) -> None:
        """Renew ``followed``, ``rate`` and the offsets h for the period from ``now_ns`` on.

        Parameters
        ----------
        now_ns
            The instant at which the next command begins to act, ns.
        wanted, wanted_next
            r at that instant and a period later, with its jumps, rad/s, shape (2,).
        """
        self.count = step_transition(
            self._crossings,
            self._instants,
            self._has_passed,
            self.count,
            self._sums,
            now_ns,
            wanted,
            wanted_next,
            self._period,
            self._lag,
            self._parameters.acceleration,
            self.followed,
            self.rate,
        )
