# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Control law on a reference with jumps: sampling, jump transition, law (66)-(67)."""

import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.control_law import Nt3fsMpcController, Nt3fsMpcParameters
from t3mpc_ros.control.jump_transition import JumpTransition
from t3mpc_ros.geometry import kinematics
from t3mpc_ros.geometry.trajectory import Stamps, interpolate
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.kernels import kernel

Array = NDArray[np.float64]

wheel_speeds = kernel(kinematics.wheel_speeds)


@kernel
def sample_reference(
    stamps: Stamps,
    samples: Array,
    first: int,
    end: int,
    jump: Array,
    stamp_ns: int,
    acts_ns: int,
    period: float,
    hold_ns: float,
    preview: bool,
    radius: float,
    half: float,
    linear: float,
    angular: float,
    speeds: Array,
    wanted: Array,
    begin: Array,
    finish: Array,
) -> tuple[bool, float, float]:
    """Write measured and wanted wheel speeds (rad/s); return whether the latter are known.

    Also returned: the largest magnitude of the speeds and of the tracking error.

    stamps ... jump   : a track, as in :func:`t3mpc_ros.geometry.trajectory.interpolate`
    stamp_ns          : of the odometry, whose twist is ``linear``, ``angular``
    acts_ns           : when the next command begins to act
    period            : control period, s
    hold_ns           : how long the newest sample is held
    preview           : whether the reference is known ahead; else its slope carries it on
    radius, half      : wheel radius and half of the wheel separation, m
    speeds, wanted    : shape (2,), overwritten, at ``stamp_ns``
    begin, finish     : shape (2,), overwritten, wanted at ``acts_ns`` and a period later
    """
    speeds[0], speeds[1] = wheel_speeds(linear, angular, radius, half)
    speed = max(abs(speeds[0]), abs(speeds[1]))
    newest = stamps[end - 1] if end > first else 0
    track = (stamps, samples, first, end, jump)
    known, v, w, v_rate, w_rate = interpolate(*track, hold_newest(stamp_ns, newest, hold_ns))
    if not known:
        wanted[:] = math.nan
        return False, speed, 0.0
    wanted[0], wanted[1] = wheel_speeds(v, w, radius, half)
    error = max(abs(speeds[0] - wanted[0]), abs(speeds[1] - wanted[1]))
    if preview:
        until_ns = acts_ns + round(period * NANOSECONDS)
        soon, v_soon, w_soon, _, _ = interpolate(*track, hold_newest(acts_ns, newest, hold_ns))
        later, v_later, w_later, _, _ = interpolate(*track, hold_newest(until_ns, newest, hold_ns))
        if soon and later:
            begin[0], begin[1] = wheel_speeds(v_soon, w_soon, radius, half)
            finish[0], finish[1] = wheel_speeds(v_later, w_later, radius, half)
            return True, speed, error
    slopes = wheel_speeds(v_rate, w_rate, radius, half)
    ahead = (acts_ns - stamp_ns) / NANOSECONDS
    for i in range(2):
        begin[i] = wanted[i] + ahead * slopes[i]
        finish[i] = wanted[i] + (ahead + period) * slopes[i]
    return True, speed, error


@kernel
def hold_newest(stamp_ns: int, newest_ns: int, hold_ns: float) -> int:
    """Return the instant whose reference holds at a stamp: the newest one for the time-out."""
    return newest_ns if 0 < stamp_ns - newest_ns <= hold_ns else stamp_ns


class SwitchingTracker:
    """Chooses the accelerations that follow a reference across its jumps.

    Everything is told for the instant at which the answer begins to act.

    Parameters
    ----------
    settings
        The law, its parts, and what is done about jumps.
    kind
        ``'velocity'`` or ``'torque'``: with the former the servo's lag is planned for.
    """

    def __init__(self, parameters: Nt3fsMpcParameters, kind: str) -> None:
        self._parameters = parameters
        self._period = 1.0 / parameters.rate
        self.law = Nt3fsMpcController(parameters)
        lag = parameters.estimate.lag if kind == 'velocity' else 0.0
        self.plan = JumpTransition(parameters.switches, lag, self._period)

    def configure(self, parameters: Nt3fsMpcParameters) -> None:
        """Use other live settings from the next step on."""
        self._parameters = parameters
        self.law.configure(parameters)
        self.plan.configure(parameters.switches)

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
        if self._parameters.switches.crossing == 'program':
            return self._step_program(now_ns, speeds, wanted, wanted_next, dt)
        plan.step(now_ns, wanted, wanted_next)
        return self.law.step(speeds, plan.followed, plan.rate, dt)

    def _step_program(
        self, now_ns: int, speeds: Array, wanted: Array, wanted_next: Array, dt: float
    ) -> Array:
        """Return u with the jumps left to the predictive term, by Psi_free (56)."""
        predictive, plan = self.law.predictive, self.plan
        until_ns = now_ns + round(self._period * 1e9)
        predictive.notify_jump(-plan.take_passed(now_ns))
        change = None
        if predictive.due:
            change = plan.known_change(now_ns, predictive.span, predictive.parameters.horizon)
        soon = -plan.known_change(now_ns, (until_ns - now_ns) / 1e9, 1)[0]
        rate = (wanted_next - soon - wanted) / self._period
        return self.law.step(speeds, wanted, rate, dt, change)

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Take note of what the drive made of the last command, see :class:`Nt3fsMpcController`."""
        self.law.applied(acceleration, limited=limited)
