# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What another method of the lab would have commanded, step by step, in a recorded run.

The robot does not answer to it. So that its estimates are those of the run all the same, the
drive in front of it is told after each step what was sent in fact: each answer is the one that
the method would have given had it taken over just then.
"""

from collections.abc import Mapping
from dataclasses import replace
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.controller import JUMP_FACTOR, ControllerSettings
from t3mpc_ros.control.drive import Drive
from t3mpc_ros.control.freshness import Reason
from t3mpc_ros.lab.contestants import methods
from t3mpc_ros.lab.rerun.inputs import SPEEDS, Inputs, Life, RerunError, motions
from t3mpc_ros.lab.rerun.rerun import Rerun, rerun
from t3mpc_ros.lab.rivals.rival import Knowledge, Rival, View
from t3mpc_ros.lab.trial.loop import MethodSpec
from t3mpc_ros.motion import BodyTwist, Motion
from t3mpc_ros.motion.kinematics import wheels_from_body
from t3mpc_ros.motion.sequence import Motions
from t3mpc_ros.motion.track import Track
from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.robot.simulated import SimulatedRobotSettings

Array = NDArray[np.float64]

PREVIEW = 0.4
"""How far ahead a method with preview may see at most, s; as in a trial of the lab."""


def rerun_rival(inputs: Inputs, name: str, changes: Mapping[str, object] | None = None) -> Rerun:
    """Return what a rival would have commanded where the controller let the robot move.

    When that is so our controller decides, on the same inputs: all methods stop alike. There
    are no fields but the commands.

    Raises
    ------
    RerunError
        There is no rival of that name.
    """
    known = methods('velocity')
    if name not in known:
        raise RerunError(f'there is no method {name!r}; there are: {", ".join(known)}')
    ours = rerun(inputs, changes)
    answers = {speed: ours.fields[speed].copy() for speed in SPEEDS}
    odometry, references = motions(inputs.odometry), motions(inputs.references)
    for life in inputs.lives:
        _live(inputs, life, known[name], ours, odometry, references, answers)
    return replace(ours, fields=answers)


def _live(
    inputs: Inputs,
    life: Life,
    method: MethodSpec,
    ours: Rerun,
    odometry: Motions,
    references: Motions,
    answers: Mapping[str, Array],
) -> None:
    """Write the answers of one life."""
    settings = life.settings[life.start]
    seat = _Seat(settings, method)
    taken = life.taken
    for k in range(len(life.events)):
        row = life.first + k
        for i in range(int(taken.begin[k]), int(taken.end[k])):
            seat.track.add(references[i])
        heard = int(taken.odometry[k])
        if heard < 0 or ours.reasons[row] is not Reason.TRACKING:
            seat.stop()
            continue
        answer = seat.answer(odometry[heard])
        for speed, value in zip(SPEEDS, answer or (math.nan, math.nan), strict=True):
            answers[speed][row] = value
        if answer is None:
            continue
        sent = BodyTwist(*(float(inputs.recorded[speed][row]) for speed in SPEEDS))
        if all(map(math.isfinite, sent)):
            seat.tell(sent)


class _Seat:
    """Where a rival sits: behind the estimator and in front of the drive of the controller."""

    def __init__(self, settings: ControllerSettings, method: MethodSpec) -> None:
        self._settings, self._method = settings, method
        self._period = 1.0 / settings.rate
        limits = settings.limits
        self._drive = Drive(settings.estimate, limits, settings.geometry, 'velocity', self._period)
        self.track = Track(
            BodyTwist(
                JUMP_FACTOR * limits.linear_acceleration, JUMP_FACTOR * limits.angular_acceleration
            )
        )
        self._rival: Rival | None = None
        self._learnt: Mapping[str, Array] = {}
        self._last_ns = 0

    def stop(self) -> None:
        """Let the rival rest; what it has learnt is kept."""
        if self._rival is not None:
            self._learnt = self._rival.learnt()
            self._rival = None

    def answer(self, measured: Motion) -> BodyTwist | None:
        """Return what the rival commands; None where the reference is not known far enough."""
        drive, stamp = self._drive, measured.stamp_ns
        speeds = np.array(wheels_from_body(measured.twist, self._settings.geometry))
        gap = (stamp - self._last_ns) / NANOSECONDS
        fresh = self._rival is None or not 0.0 < gap <= self._settings.freshness.odometry_timeout
        self._last_ns = stamp
        if fresh:
            drive.reset(speeds)
        drive.observe(speeds, self._period if fresh else gap)
        if fresh:
            self._rival = self._method(self._knowledge())
            if self._learnt:
                self._rival.restore(self._learnt)
        rival = self._rival
        if rival is None or (rows := self._rows(stamp, rival.preview)) is None:
            return None
        view = View(
            drive.ahead,
            drive.unexplained,
            rows[0],
            rows[1],
            drive.command,
            rows if rival.preview else None,
        )
        applied = drive.send(rival.step(view)).copy()
        rival.applied(applied, limited=drive.limited)
        return drive.twist

    def tell(self, sent: BodyTwist) -> None:
        """Take note of what was sent in the rival's place."""
        self._drive.tell(np.array(wheels_from_body(sent, self._settings.geometry)))

    def _rows(self, stamp_ns: int, preview: bool) -> Array | None:
        """Return r when the command begins to act and each period after it, shape (n, 2)."""
        geometry, track = self._settings.geometry, self.track
        late = self._drive.dead_time
        if not preview:
            newest = track.newest_ns
            point = track.at(stamp_ns if newest is None else min(stamp_ns, newest))
            if point is None:
                return None
            now = np.array(wheels_from_body(point.twist, geometry))
            slope = np.array(wheels_from_body(point.rate, geometry))
            return np.array([now + late * slope, now + (late + self._period) * slope])
        found = []
        for j in range(max(2, round(PREVIEW / self._period))):
            ahead = round((late + j * self._period) * NANOSECONDS)
            point = track.at(stamp_ns + ahead)
            if point is None:
                break
            found.append(wheels_from_body(point.twist, geometry))
        if not found:
            return None
        # What is not known yet is taken as it is known last.
        found += [found[-1]] * (max(2, round(PREVIEW / self._period)) - len(found))
        return np.array(found)

    def _knowledge(self) -> Knowledge:
        settings = self._settings
        robot = SimulatedRobotSettings.from_flat(
            {
                'drive.kind': 'velocity',
                'rate': settings.rate,
                'drive.lag': settings.estimate.lag,
                'drive.dead_time': settings.estimate.dead_time,
                **{f'geometry.{key}': value for key, value in settings.geometry.flat().items()},
            }
        )
        limits, geometry = settings.limits, settings.geometry
        radius = geometry.wheel_radius
        reach = min(
            limits.linear_acceleration / radius,
            limits.angular_acceleration * geometry.half_separation / radius,
            limits.wheel_acceleration,
        )
        return Knowledge('velocity', self._period, settings.estimate.lag, reach, robot)
