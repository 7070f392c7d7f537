# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recomputes recorded inputs with another method of the evaluation."""

from collections.abc import Mapping
from dataclasses import replace
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.actuation import VelocityActuation
from t3mpc_ros.control.controller import JUMP_DETECTION_FACTOR, ControllerParameters
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.baselines.baseline_controller import (
    BaselineController,
    NominalModel,
    Observation,
)
from t3mpc_ros.evaluation.closed_loop import MethodSpec
from t3mpc_ros.evaluation.methods import methods
from t3mpc_ros.evaluation.process_replay.controller_inputs import (
    SPEEDS,
    ControllerInputs,
    ControllerSession,
    ReplayError,
    motions,
)
from t3mpc_ros.evaluation.process_replay.controller_replay import ReplayResult, replay_controller
from t3mpc_ros.evaluation.tuning.search_space import find_names
from t3mpc_ros.geometry.kinematics import wheels_from_twist
from t3mpc_ros.geometry.trajectory import ReferenceTrajectory
from t3mpc_ros.geometry.types import NANOSECONDS, BodyTwist, State, StateArray
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

Array = NDArray[np.float64]

PREVIEW = 0.4
"""Largest preview, s, as in the closed-loop evaluation."""


def replay_method(
    inputs: ControllerInputs, name: str, changes: Mapping[str, object] | None = None
) -> ReplayResult:
    """Return what another method would have commanded where the controller allowed motion.

    The controller decides when that is, on the same inputs: all methods stop alike. The result
    holds the commands only.
    """
    known = methods('velocity')
    try:
        (name,) = find_names('method', [name], known)
    except ValueError as error:
        raise ReplayError(str(error)) from error
    ours = replay_controller(inputs, changes)
    answers = {speed: ours.fields[speed].copy() for speed in SPEEDS}
    odometry, references = motions(inputs.odometry), motions(inputs.references)
    for life in inputs.lives:
        _replay_session(inputs, life, known[name], ours, odometry, references, answers)
    return replace(ours, fields=answers)


def _replay_session(
    inputs: ControllerInputs,
    life: ControllerSession,
    method: MethodSpec,
    ours: ReplayResult,
    odometry: StateArray,
    references: StateArray,
    answers: Mapping[str, Array],
) -> None:
    """Write the outputs of one life."""
    parameters = life.parameters[life.start]
    seat = _MethodAdapter(parameters, method)
    taken = life.taken
    for k in range(len(life.events)):
        row = life.first + k
        for i in range(int(taken.begin[k]), int(taken.end[k])):
            seat.track.add(references[i])
        message = int(taken.odometry[k])
        if message < 0 or ours.reasons[row] is not Reason.TRACKING:
            seat.stop()
            continue
        answer = seat.answer(odometry[message])
        for speed, value in zip(SPEEDS, answer or (math.nan, math.nan), strict=True):
            answers[speed][row] = value
        if answer is None:
            continue
        sent = BodyTwist(*(float(inputs.recorded[speed][row]) for speed in SPEEDS))
        if all(map(math.isfinite, sent)):
            seat.report_sent(sent)


class _MethodAdapter:
    """Adapter of a method between the estimator and the drive of the controller."""

    def __init__(self, parameters: ControllerParameters, method: MethodSpec) -> None:
        self._parameters, self._method = parameters, method
        self._period = 1.0 / parameters.rate
        limits = parameters.limits
        self._drive = VelocityActuation(
            parameters.speed_filter, limits, parameters.geometry, 'velocity', self._period
        )
        self.track = ReferenceTrajectory(
            BodyTwist(
                JUMP_DETECTION_FACTOR * limits.linear_acceleration,
                JUMP_DETECTION_FACTOR * limits.angular_acceleration,
            )
        )
        self._baseline: BaselineController | None = None
        self._learnt: Mapping[str, Array] = {}
        self._last_ns = 0

    def stop(self) -> None:
        """Reset the method; what it has learned is kept."""
        if self._baseline is not None:
            self._learnt = self._baseline.get_weights()
            self._baseline = None

    def answer(self, measured: State) -> BodyTwist | None:
        """Return the command of the method; None where the reference is too short."""
        drive, stamp = self._drive, measured.stamp_ns
        speeds = np.array(wheels_from_twist(measured.twist, self._parameters.geometry))
        gap = (stamp - self._last_ns) / NANOSECONDS
        fresh = (
            self._baseline is None or not 0.0 < gap <= self._parameters.watchdog.odometry_timeout
        )
        self._last_ns = stamp
        if fresh:
            drive.reset(speeds)
        drive.observe(speeds, self._period if fresh else gap)
        if fresh:
            self._baseline = self._method(self._knowledge())
            if self._learnt:
                self._baseline.set_weights(self._learnt)
        baseline = self._baseline
        if baseline is None or (rows := self._rows(stamp, baseline.preview)) is None:
            return None
        observation = Observation(
            drive.predicted,
            drive.disturbance,
            rows[0],
            rows[1],
            drive.command,
            rows if baseline.preview else None,
        )
        applied = drive.send_acceleration(baseline.step(observation)).copy()
        baseline.applied(applied, limited=drive.limited)
        return drive.twist

    def report_sent(self, sent: BodyTwist) -> None:
        """Report the acceleration that was sent."""
        self._drive.set_command(np.array(wheels_from_twist(sent, self._parameters.geometry)))

    def _rows(self, stamp_ns: int, preview: bool) -> Array | None:
        """Return r when the command takes effect and each period after it, shape (n, 2)."""
        geometry, track = self._parameters.geometry, self.track
        late = self._drive.dead_time
        if not preview:
            newest = track.newest_ns
            point = track.at(stamp_ns if newest is None else min(stamp_ns, newest))
            if point is None:
                return None
            now = np.array(wheels_from_twist(point.twist, geometry))
            slope = np.array(wheels_from_twist(point.rate, geometry))
            return np.array([now + late * slope, now + (late + self._period) * slope])
        found = []
        for j in range(max(2, round(PREVIEW / self._period))):
            ahead = round((late + j * self._period) * NANOSECONDS)
            point = track.at(stamp_ns + ahead)
            if point is None:
                break
            found.append(wheels_from_twist(point.twist, geometry))
        if not found:
            return None
        # Unknown future values repeat the last known one.
        found += [found[-1]] * (max(2, round(PREVIEW / self._period)) - len(found))
        return np.array(found)

    def _knowledge(self) -> NominalModel:
        parameters = self._parameters
        robot = PaperRobotParameters.from_dict(
            {
                'drive.kind': 'velocity',
                'rate': parameters.rate,
                'drive.lag': parameters.speed_filter.lag,
                'drive.dead_time': parameters.speed_filter.dead_time,
                **parameters.geometry.to_dict(),
            }
        )
        limits, geometry = parameters.limits, parameters.geometry
        radius = geometry.wheel_radius
        reach = min(
            limits.linear_acceleration / radius,
            limits.angular_acceleration * geometry.half_separation / radius,
            limits.wheel_acceleration,
        )
        return NominalModel('velocity', self._period, parameters.speed_filter.lag, reach, robot)
