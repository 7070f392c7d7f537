# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The closed loop without ROS and without a clock: reference, law and simulated robot."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceSample, ReferenceSettings
from t3mpc_ros.control.composition import ComposedLaw, CompositionSettings
from t3mpc_ros.control.controller import Controller, ControllerSettings
from t3mpc_ros.control.law import TERMS
from t3mpc_ros.motion import Motion
from t3mpc_ros.motion.kinematics import wheels_from_body
from t3mpc_ros.motion.words import NANOSECONDS, ORIGIN
from t3mpc_ros.robot.dynamics import wheel_inertia
from t3mpc_ros.robot.simulated import SimulatedRobot, SimulatedRobotSettings

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LoopRecord:
    """What happened in one run, one row a control period, right wheel first."""

    time: Array
    """s, shape (n,)"""
    wanted: Array
    """r, rad/s, shape (n, 2)"""
    measured: Array
    """chi with its noise, rad/s, shape (n, 2)"""
    speeds: Array
    """True chi, rad/s, shape (n, 2)"""
    command: Array
    """u, rad/s², shape (n, 2)"""
    terms: Array
    """Terms of u, rows as in ``law.TERMS``, rad/s², shape (n, 5, 2)"""
    modes: Array
    """Active switching mode, shape (n,)"""
    margin: Array
    """Margin of the run-time certificate of E14, shape (n,)"""

    @property
    def error(self) -> Array:
        """True tracking error chi - r, rad/s, shape (n, 2)."""
        return self.speeds - self.wanted

    def rmse(self, after: float = 3.0, *, cut: float = 0.0) -> float:
        """Return the tracking RMSE over both wheels, rad/s.

        Parameters
        ----------
        after
            Seconds left out at the start, while the reference grows.
        cut
            Seconds left out after each switch.
        """
        counted = self.time >= after
        for switch in self.time[1:][np.diff(self.modes) != 0]:
            counted &= (self.time < switch) | (self.time >= switch + cut)
        return float(np.sqrt(np.mean(self.error[counted] ** 2)))

    def chatter(self) -> float:
        """Return the total variation of u per second and wheel, rad/s³."""
        span = self.time[-1] - self.time[0]
        return float(np.abs(np.diff(self.command, axis=0)).sum() / (2.0 * span))


def run_torque(
    law_settings: CompositionSettings,
    reference_settings: ReferenceSettings,
    robot_settings: SimulatedRobotSettings,
    duration: float,
    prepare: Callable[[ComposedLaw], None] | None = None,
) -> LoopRecord:
    """Return a run of the paper's setting: u applied as the torque theta_bar u.

    The law never sees the true speeds, masses or friction; theta_bar is the nominal one.

    Parameters
    ----------
    law_settings, reference_settings, robot_settings
        The robot's drive must be ``'torque'`` and all three rates equal.
    duration
        s
    prepare
        Called with the law before the run, for example to give it a trained predictor.

    Raises
    ------
    ValueError
        The rates differ.
    """
    rates = {law_settings.rate, reference_settings.rate, robot_settings.rate}
    if len(rates) != 1:
        raise ValueError(f'rates of law, reference and robot must be equal: got {sorted(rates)}')
    law = ComposedLaw(law_settings, 'torque')
    law.warm_up()
    if prepare is not None:
        prepare(law)
    robot = SimulatedRobot(robot_settings)
    reference = ChaoticReference(reference_settings, robot_settings.geometry)
    inertia = wheel_inertia(robot_settings.body, robot_settings.geometry)
    period = 1.0 / law_settings.rate
    steps = round(duration * law_settings.rate)
    record = _empty(steps)
    state = robot.state
    law.reset(np.array(state.wheels))
    for k in range(steps):
        sample = reference.advance()
        measured = np.array(state.wheels)
        command = law.step(measured, np.array(sample.wheels), np.array(sample.rate), period)
        law.applied(command.copy(), np.zeros(2), limited=False)
        assert state.true_wheels is not None
        record.time[k] = k * period
        record.wanted[k] = sample.wheels
        record.measured[k] = measured
        record.speeds[k] = state.true_wheels
        record.command[k] = command
        record.terms[k] = law.terms
        record.modes[k] = sample.mode
        record.margin[k] = law.reading.margin
        torque = inertia @ command
        state = robot.step_torque(float(torque[0]), float(torque[1]))
    return record


def run_velocity(
    controller_settings: ControllerSettings,
    reference_settings: ReferenceSettings,
    robot_settings: SimulatedRobotSettings,
    duration: float,
    lead: float = 0.2,
) -> LoopRecord:
    """Return a run of the loop as the nodes close it: stamped motions in, limited twists out.

    The robot's drive must be ``'velocity'``; ``command`` holds the applied accelerations.

    Parameters
    ----------
    controller_settings, reference_settings, robot_settings
        The rates of all three must be equal.
    duration
        s
    lead
        How far ahead the reference is stamped, s.

    Raises
    ------
    ValueError
        The rates differ.
    """
    rates = {controller_settings.rate, reference_settings.rate, robot_settings.rate}
    if len(rates) != 1:
        raise ValueError(f'rates of law, reference and robot must be equal: got {sorted(rates)}')
    controller = Controller(controller_settings)
    controller.warm_up()
    robot = SimulatedRobot(robot_settings)
    reference = ChaoticReference(reference_settings, robot_settings.geometry)
    steps = round(duration * controller_settings.rate)
    ahead = round(lead * controller_settings.rate)
    samples = [reference.advance() for _ in range(steps + ahead + 1)]
    period_ns = round(NANOSECONDS / controller_settings.rate)
    record = _empty(steps)
    for k in range(ahead):
        _add(controller, samples[k], k * period_ns)
    state = robot.advance(0)
    for k in range(steps):
        _add(controller, samples[k + ahead], (k + ahead) * period_ns)
        twist, status = controller.step(state.odometry)
        assert state.true_wheels is not None
        record.time[k] = k * period_ns / NANOSECONDS
        record.wanted[k] = samples[k].wheels
        record.measured[k] = state.wheels
        record.speeds[k] = state.true_wheels
        record.command[k] = status.applied
        record.terms[k] = status.terms
        record.modes[k] = samples[k].mode
        record.margin[k] = status.certificate.margin
        state = robot.step(wheels_from_body(twist, robot_settings.geometry))
    return record


def _add(controller: Controller, sample: ReferenceSample, stamp_ns: int) -> None:
    controller.add_reference(Motion(stamp_ns, ORIGIN, sample.twist))


def _empty(steps: int) -> LoopRecord:
    return LoopRecord(
        time=np.empty(steps),
        wanted=np.empty((steps, 2)),
        measured=np.empty((steps, 2)),
        speeds=np.empty((steps, 2)),
        command=np.empty((steps, 2)),
        terms=np.empty((steps, len(TERMS), 2)),
        modes=np.empty(steps),
        margin=np.empty(steps),
    )
