# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A baseline as the controller of the digital twin."""

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.actuation import VelocityActuation
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.baselines.baseline_controller import BaselineController, NominalModel
from t3mpc_ros.evaluation.closed_loop import MethodLoop, observed_reference
from t3mpc_ros.evaluation.method_comparison.twin_scenario import TwinScenario
from t3mpc_ros.evaluation.scenario import RATE
from t3mpc_ros.evaluation.twin_closed_loop import LEAD
from t3mpc_ros.geometry.kinematics import wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, BodyTwist, State, wrap_angle

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BaselineStatus:
    """Status of one step."""

    stamp_ns: int
    reason: Reason


class TwinBaseline:
    """Drives the twin with a baseline, behind the state estimate and limits of the controller.

    It has no watchdog. A lost report is bridged by the estimator, as in the controller.

    Parameters
    ----------
    method
        Makes the baseline from the nominal model.
    scenario
        Reference, nominal model, estimator and measurement.
    """

    def __init__(
        self, method: Callable[[NominalModel], BaselineController], scenario: TwinScenario
    ) -> None:
        self._method = method
        self._model = scenario.nominal_model()
        self._geometry = self._model.robot.geometry
        self._uses_gyro = scenario.uses_gyro
        self._actuation = VelocityActuation(
            scenario.estimate(),
            scenario.limits,
            self._geometry,
            'velocity',
            self._model.period,
        )
        self._scenario = scenario
        self._enabled = True
        self._loop: MethodLoop | None = None
        self._last: tuple[int, float] = (0, 0.0)
        """Period and yaw of the last report."""

    def enable(self, on: bool) -> None:
        """Enable the robot's motion, or stop the robot."""
        self._enabled = on

    def add_reference(self, reference: State) -> bool:
        """Ignore the sample: the scenario has the reference."""
        return True

    def step(self, odometry: State) -> tuple[BodyTwist, BaselineStatus]:
        """Return the command that follows from a report of the robot."""
        stamp_ns = odometry.stamp_ns
        if not self._enabled:
            self._loop = None
            return STANDSTILL, BaselineStatus(stamp_ns, Reason.DISABLED)
        k = round(stamp_ns * RATE / NANOSECONDS)
        if self._loop is None:
            measured = self._measured(odometry, math.nan)
            self._actuation.reset(measured)
            self._loop = self._new_loop()
        else:
            measured = self._measured(odometry, (k - self._last[0]) * self._model.period)
        self._last = k, odometry.pose.yaw
        self._loop.send(self._loop.step(k, measured))
        return self._actuation.twist, BaselineStatus(stamp_ns, Reason.TRACKING)

    def _new_loop(self) -> MethodLoop:
        controller, dead_time = self._method(self._model), self._actuation.dead_time
        # What a reference with this lead has made known at the stamp of the report.
        rows = round((LEAD - dead_time) * RATE) + 1
        steps = round(self._scenario.duration * RATE)
        reference = observed_reference(
            self._scenario.reference(), steps, rows, dead_time, preview=controller.preview
        )
        return MethodLoop(controller, self._actuation, self._model.period, reference)

    def _measured(self, odometry: State, dt: float) -> Array:
        """Return the measured wheel speeds, rad/s, shape (2,).

        With the gyro, their difference is that of the yaw rate of the odometry's pose.
        """
        twist = odometry.twist
        if self._uses_gyro and not math.isnan(dt):
            turned = wrap_angle(odometry.pose.yaw - self._last[1])
            twist = BodyTwist(twist.linear, turned / dt)
        return np.array(wheels_from_twist(twist, self._geometry))
