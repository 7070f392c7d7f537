# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The law on a reference that jumps: plan across the switches, then (66)-(67)."""

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.composition import ComposedLaw, CompositionSettings
from t3mpc_ros.control.switches import SwitchPlan

Array = NDArray[np.float64]


class Pursuit:
    """Chooses the accelerations that follow a reference across its jumps.

    Everything is told for the instant at which the answer begins to act.

    Parameters
    ----------
    settings
        The law, its parts, and what is done about jumps.
    kind
        ``'velocity'`` or ``'torque'``: with the former the servo's lag is planned for.
    """

    def __init__(self, settings: CompositionSettings, kind: str) -> None:
        self._settings = settings
        self._period = 1.0 / settings.rate
        self.law = ComposedLaw(settings)
        lag = settings.estimate.lag if kind == 'velocity' else 0.0
        self.plan = SwitchPlan(settings.switches, lag, self._period)

    def configure(self, settings: CompositionSettings) -> None:
        """Use other live settings from the next step on."""
        self._settings = settings
        self.law.configure(settings)
        self.plan.configure(settings.switches)

    def reset(self) -> None:
        """Start a new run; what was learnt is kept."""
        self.law.reset()
        self.plan.reset()

    def begin(self, now_ns: int, speeds: Array, wanted: Array) -> None:
        """Start from where the robot is: the way to the reference is crossed as a jump is."""
        self.reset()
        self.plan.announce(now_ns, wanted - speeds, np.zeros(2))

    def step(
        self, now_ns: int, speeds: Array, wanted: Array, wanted_next: Array, dt: float
    ) -> Array:
        """Return u (rad/s²), shape (2,).

        Parameters
        ----------
        now_ns
            The instant at which u begins to act, ns.
        speeds
            Estimated wheel speeds at that instant, rad/s, shape (2,).
        wanted, wanted_next
            The reference at that instant and one period later, with its jumps, rad/s, (2,).
        dt
            Seconds since the last step.
        """
        plan = self.plan
        if self._settings.switches.crossing == 'program':
            return self._step_program(now_ns, speeds, wanted, wanted_next, dt)
        plan.step(now_ns, wanted, wanted_next)
        return self.law.step(speeds, plan.followed, plan.rate, dt)

    def _step_program(
        self, now_ns: int, speeds: Array, wanted: Array, wanted_next: Array, dt: float
    ) -> Array:
        """Return u with the jumps left to the predictive term, by Psi_free (56)."""
        predictive, plan = self.law.predictive, self.plan
        until_ns = now_ns + round(self._period * 1e9)
        predictive.shift(-plan.take_passed(now_ns))
        change = None
        if predictive.due:
            change = plan.known_change(now_ns, predictive.span, predictive.settings.horizon)
        soon = -plan.known_change(now_ns, (until_ns - now_ns) / 1e9, 1)[0]
        rate = (wanted_next - soon - wanted) / self._period
        return self.law.step(speeds, wanted, rate, dt, change)

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Take note of what the drive made of the last command, see :class:`ComposedLaw`."""
        self.law.applied(acceleration, limited=limited)
