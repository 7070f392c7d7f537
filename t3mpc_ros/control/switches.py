# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How a jump of the reference is crossed: the reachable reference that the law follows."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.settings import Settings, setting

Array = NDArray[np.float64]

NANOSECONDS = 1e9


@dataclass(frozen=True)
class SwitchSettings(Settings):
    """What is done about the jumps of a reference."""

    preview: bool = setting(
        True,
        'whether a jump that is known beforehand is met half-way; otherwise the reference is only '
        'known up to now, and carried on by its slope',
        live=True,
    )
    crossing: str = setting(
        'ramp',
        'ramp: the law follows a ramp across the jump; program: the law follows the jump itself, '
        'which enters Psi_free as a known disturbance, and v_p does what its bound allows',
        choices=('ramp', 'program'),
    )
    acceleration: float = setting(
        30.0,
        'acceleration with which a jump is crossed: what the limits allow one wheel; for the '
        'torque drive, which is not limited so, the lab uses more',
        unit='rad/s²',
        low=0.1,
        high=1e4,
        live=True,
    )


class _Crossing:
    """One jump on its way: how far each wheel has come."""

    def __init__(self, instant_ns: int, jump: Array, slope_after: Array) -> None:
        self.instant_ns = instant_ns
        self.jump = jump
        self.slope_after = slope_after
        self.done: Array = np.zeros_like(jump)
        self.passed = False


class SwitchPlan:
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

    def __init__(self, settings: SwitchSettings, lag: float, period: float) -> None:
        self._settings = settings
        self._lag = lag
        self._period = period
        self._keep = math.exp(-period / lag) if lag > 0.0 else 0.0
        self.reset()

    def configure(self, settings: SwitchSettings) -> None:
        """Use other live settings from the next step on."""
        self._settings = settings

    def reset(self) -> None:
        """Forget every jump: rbar is r."""
        self._crossings: list[_Crossing] = []
        self._followed: Array = np.zeros(2)
        self._passed: Array = np.zeros(2)
        self.offset: Array = np.zeros(2)
        """h now, rad/s, shape (2,)."""
        self.offset_next: Array = np.zeros(2)
        """h one period later, rad/s, shape (2,)."""

    @property
    def crossing(self) -> bool:
        """Whether rbar differs from r."""
        return bool(self._crossings)

    def known_change(self, now_ns: int, span: float, rows: int) -> Array:
        """Return the jumps of delta = chi - r still to come, shape (rows, 2), rad/s.

        Row j holds those between ``now_ns`` + j span and + (j + 1) span (s), as
        :meth:`t3mpc_ros.mpc.predictive.PredictiveTerm.step` takes them into Psi_free (56).
        """
        change = np.zeros((rows, 2))
        for crossing in self._crossings:
            ahead = (crossing.instant_ns - now_ns) / NANOSECONDS
            row = math.ceil(ahead / span - 1e-9) - 1
            if 0 <= row < rows:
                change[row] -= crossing.jump
        return change

    def take_passed(self, now_ns: int) -> Array:
        """Return the sum of the jumps up to ``now_ns`` (rad/s), shape (2,), and forget them."""
        total = np.zeros(2)
        for crossing in self._crossings:
            if crossing.instant_ns <= now_ns:
                total += crossing.jump
        self._crossings = [one for one in self._crossings if one.instant_ns > now_ns]
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
        self._crossings.append(_Crossing(instant_ns, jump.copy(), slope_after.copy()))

    def withdraw(self, instant_ns: int) -> None:
        """Take back the jumps announced for ``instant_ns`` or later: r will not jump after all."""
        for crossing in self._crossings:
            if not crossing.passed and crossing.instant_ns >= instant_ns:
                crossing.jump = np.zeros(2)
                crossing.instant_ns = instant_ns
                crossing.passed = True

    def step(self, now_ns: int, wanted: Array, wanted_next: Array) -> None:
        """Renew ``offset`` and ``offset_next`` for the period that begins at ``now_ns``.

        Parameters
        ----------
        now_ns
            The instant at which the next command begins to act, ns.
        wanted, wanted_next
            r at that instant and a period later, with its jumps, rad/s, shape (2,).
        """
        if not self._crossings:
            self.offset[:] = 0.0
            self.offset_next[:] = 0.0
            return
        for crossing in self._crossings:
            self._pass(crossing, now_ns)
        self.offset[:] = self._followed - self._passed
        until_ns = now_ns + round(self._period * NANOSECONDS)
        rise = wanted_next - wanted
        for crossing in self._crossings:
            if not crossing.passed and until_ns >= crossing.instant_ns:
                rise = rise - crossing.jump
        slope = rise / self._period
        told = np.zeros(2)
        for crossing in self._crossings:
            self._cross(crossing, now_ns, slope)
            told += crossing.done
            self._pass(crossing, until_ns)
        self._followed += (1.0 - self._keep) * (told - self._followed)
        self.offset_next[:] = self._followed - self._passed
        self._forget(now_ns)

    def _pass(self, crossing: _Crossing, now_ns: int) -> None:
        if not crossing.passed and now_ns >= crossing.instant_ns:
            crossing.passed = True
            self._passed += crossing.jump

    def _cross(self, crossing: _Crossing, now_ns: int, slope: Array) -> None:
        """Move on by one period: each wheel at its closing speed once its time has come."""
        most = self._settings.acceleration
        # The command acts before the servo follows; and r, which is sampled, jumps somewhere in
        # the period before the instant: in its middle, as far as the squared error goes.
        ahead = self._period * (self._keep / (1.0 - self._keep) + 0.5)
        left = (crossing.instant_ns - now_ns) / NANOSECONDS - ahead
        for i in range(2):
            size = abs(crossing.jump[i])
            rest = crossing.jump[i] - crossing.done[i]
            if rest == 0.0:
                continue
            sign = math.copysign(1.0, rest)
            after = max(most - sign * crossing.slope_after[i], 0.2 * most)
            before = after
            if not crossing.passed:
                before = max(most - sign * slope[i], 0.2 * most)
            share = math.sqrt(before) / (math.sqrt(before) + math.sqrt(after))
            # The first step is a part of a period, so that the crossing is not early or late.
            time = min(share * size / before - left + self._period, self._period)
            if time > 0.0:
                crossing.done[i] += sign * min(before * time, abs(rest))

    def _forget(self, now_ns: int) -> None:
        """Drop crossings that are over, and what is left of them is less than rounding."""
        over = now_ns - round(30.0 * self._lag * NANOSECONDS)
        kept = []
        for crossing in self._crossings:
            finished = crossing.passed and np.array_equal(crossing.done, crossing.jump)
            if finished and crossing.instant_ns <= over:
                self._followed -= crossing.jump
                self._passed -= crossing.jump
            else:
                kept.append(crossing)
        self._crossings = kept
