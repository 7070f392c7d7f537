# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Localizer: the pose on the map, and the frame of the odometry, from odometry and ranges.

The filter is updated when the robot has moved, as in nav2_amcl: readings of a robot at rest
repeat their errors. Each reading counts once, along the beam on which it was taken: in the frame
of the odometry at that instant. The particles go their way, by the last reading of each sensor;
while the place is known, the pose that is tracked beside them, by all readings, is the result.
"""

from collections import deque
from dataclasses import dataclass
import enum
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.kinematics import frame_between, points_from_frame
from t3mpc_ros.geometry.types import (
    NANOSECONDS,
    ORIGIN,
    Array,
    Pose,
    has_moved,
    is_out_of_order,
    wrap_angle,
)
from t3mpc_ros.localization.change_detection import ChangeDetector, ChangeParameters
from t3mpc_ros.localization.distance_field import LocalizationMap, map_of_grid
from t3mpc_ros.localization.particle_filter import (
    KNOWN_SHARE,
    ParticleFilter,
    ParticleFilterParameters,
)
from t3mpc_ros.localization.pose_tracking import PoseTracker
from t3mpc_ros.localization.range_model import (
    NAMES,
    Beams,
    RangeModel,
    RangeModelParameters,
    explain_readings,
    joined,
)
from t3mpc_ros.parameters.table import Parameters, group, parameter

DISORDER = 0.2
"""Age up to which odometry was overtaken, and readings belong to it, s: the time-outs of the
controller."""
LONGEST_SILENCE = 2.5
"""Time without a reading from which on the pose is by odometry alone, s: a scanner of 1 Hz may
lose one scan."""
LARGEST_VARIANCES = 25.0, 25.0, 10.0
"""Largest variances of x, y (m²), yaw (rad²) of a pose that is given: it says nothing beyond."""
TRACKED_READINGS = 12
"""Number of the last readings of a sensor by which the pose is tracked: of half a second."""
SCAN = -1
"""Number of a scan among the sensors."""
LONGEST_UPDATE = 60.0
"""Longest time between two updates for which the yaw drifts, s: a robot at rest measures the bias
of its gyro."""
LARGEST_STEP = 1.0
"""Distance between two messages of the odometry from which on it has restarted, m."""
JUMP_STEP, JUMP_SPEED = (0.1, 0.3), (3.0, 12.0)
"""Motion between two messages (m, rad), and speeds (m/s, rad/s) of robots that are faster than any
of this kind, beyond both of which the odometry has jumped, and the robot has not."""
SYSTEMATIC = 0.01, 0.01, 0.007
"""Standard deviations (m, m, rad) of what particles do not know, because it repeats: offsets of
the sensors and the age of their readings; the errors measured on the twin."""
FOUND_AGREEMENT = 0.9
"""Share of fitting readings from which on a search ends: about 30 in a row from a half."""
CORRECTION_TIME = 0.5
"""Time constant with which the used pose approaches that of the localizer, s."""
CORRECTION_SPEED, CORRECTION_RATE = 0.05, 0.2
"""Largest speed of that (m/s, rad/s)."""
CORRECTION_SHARE, CORRECTION_ARM, CORRECTION_STANDING = 0.2, 0.05, 0.01
"""Largest share of the way of the odometry, with that of a point so far from the centre (m), by
which it moves the pose of a robot that is faster than that (m/s): a controller takes a way that is
too short, or leads aside, for a contact (0.3 and 0.4 of :mod:`t3mpc_ros.control.watchdog`)."""
JUMP_DISTANCE, JUMP_ANGLE = 0.25, 0.5
"""Distance (m) and angle (rad) from which on the pose is taken at once."""
STEADY_TIME, STEADY_DISTANCE, STEADY_ANGLE = 3.0, 0.08, 0.08
"""Largest corrections of the odometry (m, rad) in a time (s) with which readings may contradict
the map: the filter is not in doubt."""
DRIFT_TIME = 30.0
"""Time constant with which the drift of the odometry's yaw is measured, s."""
LARGEST_DRIFT, LARGEST_CHANGE = 0.02, 0.03
"""Largest drift, and largest that counts from one update to the next, rad/s: the bias of a warm
gyro stays below; a slip turns the odometry faster."""
AGREEMENT_DECAY = 0.05
"""Decay of the share of readings that fit, per telling reading."""
DOUBT_TIME = 60.0
"""Time after which a place that a search has found is not in doubt any more, s."""
ONE_THING, MOST_WITNESSES = 0.3, 6.0
"""Distance (m) within which readings contradict the map at one place, and number of the last 20 or
so that count of it: a robot that is not where it takes itself to be contradicts it at several."""
FADED = 0.1
"""Number of readings below which a place is forgotten: one reading, 45 ago."""
DOUBTFUL_AGREEMENT, OTHERS_AGREEMENT = 0.3, 0.8
"""Share of the readings of a sensor that fit below which they are not used, and share of the
median sensor from which on it is the sensor, not the place, that is wrong."""


@dataclass(frozen=True)
class StartPoseParameters(Parameters):
    """Pose at the start, with its variances."""

    x: float = parameter(0.0, 'x at the start', 'm', (-1e4, 1e4), source=NAMES)
    y: float = parameter(0.0, 'y at the start', 'm', (-1e4, 1e4), source=NAMES)
    yaw: float = parameter(0.0, 'yaw at the start', 'rad', (-7.0, 7.0), source=NAMES)
    covariance_x: float = parameter(
        0.0025, 'variance of x at the start', 'm²', (0.0, 1e4), source='beluga_amcl'
    )
    covariance_y: float = parameter(
        0.0025, 'variance of y at the start', 'm²', (0.0, 1e4), source='beluga_amcl'
    )
    covariance_yaw: float = parameter(
        0.0025, 'variance of the yaw at the start', 'rad²', (0.0, 10.0), source='beluga_amcl'
    )


@dataclass(frozen=True)
class LocalizerParameters(ParticleFilterParameters):
    """When the filter is updated, where it begins, and when the robot is lost."""

    update_min_d: float = parameter(
        0.05, 'travel after which the filter is updated', 'm', (1e-3, 10.0), source=NAMES
    )
    update_min_a: float = parameter(
        0.1, 'turn after which the filter is updated', 'rad', (1e-3, 3.2), source=NAMES
    )
    set_initial_pose: bool = parameter(
        False,
        'begin at initial_pose; false: anywhere on the map, until initialpose is received',
        source=NAMES,
    )
    initial_pose: StartPoseParameters = group(StartPoseParameters)
    robot_radius: float = parameter(
        0.1, 'smallest distance of the centre from an obstacle', 'm', (0.0, 5.0)
    )
    localized_deviation: float = parameter(
        0.15,
        'standard deviation of x and y up to which the pose counts; that of the yaw in rad is '
        'the same',
        bounds=(1e-3, 10.0),
    )
    lost_agreement: float = parameter(
        0.4, 'share of fitting readings below which the robot is lost', bounds=(0.0, 1.0)
    )
    ranges: RangeModelParameters = group(RangeModelParameters, inline=True)
    changes: ChangeParameters = group(ChangeParameters)


class Localization(enum.Enum):
    """What is known of the place, in words for the diagnostics."""

    NO_ODOMETRY = 'no odometry yet'
    SEARCHING = 'searching: the readings fit to several places, or not for long enough'
    LOCALIZED = 'the place is known'
    LOST = 'lost: the readings do not fit to the map'
    OFF_MAP = (
        'lost: the pose is off the map; give another one by initialpose, or call '
        'reinitialize_global_localization'
    )


class LocalizedPose(NamedTuple):
    """Pose on the map at the stamp of the odometry."""

    stamp_ns: int
    pose: Pose
    covariance: Array
    """Of x, y (m), yaw (rad), shape (3, 3); of all particles unless readings tell the place."""
    odometry_frame: Pose
    """Origin of the odometry on the map."""


class Localizer:
    """Pose on a map from odometry and range readings; equal calls give equal poses.

    mounts : x, y (m), direction (rad) of each range sensor in the frame of the robot, shape (s, 3)
    limits : smallest and largest distance of these sensors, m
    """

    def __init__(
        self,
        parameters: LocalizerParameters,
        known: LocalizationMap,
        mounts: Array,
        limits: tuple[float, float],
    ) -> None:
        self.parameters = parameters
        self._mounts, self._limits = mounts, limits
        self._model = RangeModel.of(parameters.ranges, parameters.robot_radius)
        self._field = known.field
        self._places = known.free_places(parameters.robot_radius)
        self.filter = ParticleFilter(parameters, known.field, self._places, self._model)
        """The particles."""
        self._tracker = PoseTracker(known.field, self._model, len(mounts))
        self.changes = ChangeDetector(parameters.changes, known.field, self._model)
        """What contradicts the map."""
        self._estimate: LocalizedPose | None = None
        """By the particles, at the last update; None before the first."""
        self.agreement = 1.0 if parameters.set_initial_pose else parameters.lost_agreement
        """Share of the telling readings that fit to the map, of the last 20 or so."""
        self._fits = np.ones(len(mounts))
        """That share for each range sensor."""
        self._searching = not parameters.set_initial_pose
        """Whether random particles are added until the readings fit for some time."""
        self._found_ns = math.inf
        """When the place was found by a search; inf: not yet, -inf: it was known at the start."""
        self._sure_ns = 0
        """When the readings last fitted at a place that was not in doubt."""
        self._witnesses = np.empty((0, 3))
        """Places that contradict the map, x, y (m), and the number of readings that do."""
        self._frames: deque[tuple[int, Pose]] = deque()
        """Stamps and origins of the odometry of the last :data:`STEADY_TIME`."""
        self.share = 0.0
        """Share of the weight in the heaviest cluster."""
        self._stamp_ns = 0
        self._odometry: Pose | None = None
        """Of the last message."""
        self._updated: Pose | None = None
        """Odometry at the last update."""
        self._updated_ns = 0
        self._drift = 0.0
        """Of the odometry's yaw, rad/s: a gyro measures its bias only at rest."""
        self._turned = 0.0
        """Turn by it since the last update, rad."""
        self.silence = 0.0
        """Time by the odometry since the last reading that was used, s."""
        self._pending: dict[int, tuple[Pose, Beams]] = {}
        """Beams since the last update by sensor, each with the odometry at its instant."""
        self._readings: dict[int, deque[Beams]] = {}
        """Those for the tracking, in the frame of the odometry."""
        if parameters.set_initial_pose:
            initial = parameters.initial_pose
            variances = initial.covariance_x, initial.covariance_y, initial.covariance_yaw
            self.set_pose(Pose(initial.x, initial.y, initial.yaw), np.diag(variances))

    def pose_problem(self, pose: Pose, covariance: Array) -> str:
        """Return why the robot cannot be at a pose as for :meth:`set_pose`, '' if it can."""
        if not (all(map(math.isfinite, pose)) and np.isfinite(covariance).all()):
            return 'it is not finite'
        variances = np.diag(covariance)
        if (variances > LARGEST_VARIANCES).any():
            most, got = LARGEST_VARIANCES, variances
            return (
                f'its variances must be at most {most[0]:g} m² and {most[2]:g} rad²: got '
                f'{got[0]:g}, {got[1]:g} and {got[2]:g}; reinitialize_global_localization searches'
            )
        if np.linalg.eigvalsh(covariance).min() < -1e-9:
            return 'its covariance is not positive semi-definite'
        deviation = math.sqrt(max(np.linalg.eigvalsh(covariance[:2, :2]).max(), 0.0))
        x, y = self._places.T
        away = float(np.hypot(x - pose.x, y - pose.y).min())
        if away <= max(3.0 * deviation, self.parameters.robot_radius, self._field.step):
            return ''
        return (
            f'it is {away:.3g} m from the free floor of the map, more than 3 standard deviations; '
            f'that is within x {x.min():.2f} to {x.max():.2f} m, y {y.min():.2f} to '
            f'{y.max():.2f} m: got x {pose.x:g} m, y {pose.y:g} m, deviation {deviation:g} m'
        )

    def set_pose(self, pose: Pose, covariance: Array) -> None:
        """Begin at a pose with a covariance of x, y (m), yaw (rad), shape (3, 3).

        Its variances are at least those of :data:`SYSTEMATIC`: particles that are all at one place
        leave readings nothing to choose from, so a pose given as exact was not corrected.
        """
        spread = np.array(covariance, dtype=np.float64)
        np.fill_diagonal(spread, np.maximum(np.diag(spread), np.square(SYSTEMATIC)))
        self.filter.place(pose, spread)
        self._restart(searching=False)

    def scatter(self) -> None:
        """Begin anywhere on the map."""
        self.filter.scatter()
        self._restart(searching=True)

    def _restart(self, *, searching: bool) -> None:
        self._searching, self.share = searching, 0.0
        self._found_ns = math.inf if searching else -math.inf
        self.agreement = self.parameters.lost_agreement if searching else 1.0
        self._fits[:] = 1.0
        self._witnesses = self._witnesses[:0]
        self._tracker.active = False
        self._pending.clear()
        self._readings.clear()
        self._updated = None  # the next odometry is an update without a motion

    @property
    def result(self) -> LocalizedPose | None:
        """Pose that is tracked, or else of the particles at the last update; None before that."""
        found, odometry = self._estimate, self._odometry
        tracked = self._tracker.active and self.state is Localization.LOCALIZED
        if found is None or odometry is None or not tracked:
            return found
        pose, covariance = self._tracker.pose, found.covariance
        if not self.silent:
            covariance = self._tracker.covariance + np.diag(np.square(SYSTEMATIC))
        return LocalizedPose(self._stamp_ns, pose, covariance, frame_between(pose, odometry))

    @property
    def state(self) -> Localization:
        """What is known of the place."""
        if self._estimate is None:
            return Localization.NO_ODOMETRY
        if self.agreement < self.parameters.lost_agreement:
            return Localization.LOST
        if self._searching:
            return Localization.SEARCHING
        largest = float(np.diag(self._estimate.covariance).max())
        if math.sqrt(largest) > self.parameters.localized_deviation:
            return Localization.SEARCHING
        on_map = self._field.contains(self._estimate.pose.x, self._estimate.pose.y)
        return Localization.LOCALIZED if on_map else Localization.OFF_MAP

    @property
    def doubtful(self) -> tuple[int, ...]:
        """Sensors whose readings contradict the map while those of the others fit."""
        if self._fits.size == 0 or np.median(self._fits) < OTHERS_AGREEMENT:
            return ()  # a scan alone has no sensors to compare
        return tuple(np.flatnonzero(self._fits < DOUBTFUL_AGREEMENT).tolist())

    @property
    def silent(self) -> bool:
        """Whether the pose is by odometry alone: no reading was used for some time."""
        return self.silence > LONGEST_SILENCE

    def add_range(self, sensor: int, reading: float, stamp_ns: int | None = None) -> str:
        """Add a reading (m, REP 117) taken where the last odometry was; return why not, or ''.

        NaN and a finite distance below zero change nothing, nor does a stamp of another time.
        """
        if not (reading >= 0.0 or reading == -math.inf):
            return f'it is no distance: {reading:g}'
        mount = self._mounts[sensor : sensor + 1]
        return self._add(
            sensor, Beams(mount, np.array([reading]), np.array([self._limits])), stamp_ns
        )

    def add_scan(self, beams: Beams, stamp_ns: int | None = None) -> str:
        """Add a scan taken where the last odometry was; return why not, or ''.

        It replaces one that was not used yet.
        """
        return self._add(SCAN, beams, stamp_ns) if beams.reading.size else 'it has no reading'

    def _add(self, sensor: int, beams: Beams, stamp_ns: int | None) -> str:
        if self._odometry is None:
            return ''  # not rejected: the first ones come before any odometry
        lead = 0.0 if stamp_ns is None else (stamp_ns - self._stamp_ns) / NANOSECONDS
        if abs(lead) > DISORDER:  # taken elsewhere than where the last odometry was
            return f'it is stamped {abs(lead):.1f} s {"after" if lead > 0.0 else "before"} odom'
        self._pending[sensor] = self._odometry, beams
        readings = self._readings.setdefault(sensor, deque(maxlen=TRACKED_READINGS))
        # One that comes again was taken where the robot was before.
        if not readings or not np.array_equal(readings[-1].reading, beams.reading):
            readings.append(beams._replace(origin=transformed(self._odometry, beams.origin)))
        self.silence = 0.0
        return ''

    def add_odometry(self, stamp_ns: int, pose: Pose) -> bool:
        """Add a pose of the odometry; return whether there is a new :attr:`result`.

        A pose that is not finite is ignored, as one that comes again or was overtaken on its way.
        After a restart of the odometry, seen by a stamp or a pose that jumps, the robot is where
        it was.
        """
        last, last_ns = self._odometry, self._stamp_ns
        if not all(map(math.isfinite, pose)):
            return False
        if last is not None and is_out_of_order(stamp_ns, last_ns, DISORDER):
            return False
        self._odometry, self._stamp_ns = pose, stamp_ns
        if last is not None and has_jumped(last, pose, stamp_ns - last_ns):
            return self._follow_jump(last, pose)
        since = 0.0 if last is None else min((stamp_ns - last_ns) / NANOSECONDS, DISORDER)
        self.silence += since
        if self._tracker.active:
            self._tracker.predict(last or pose, pose, since)
        if self._updated is None:
            self._publish(pose)
            return True
        parameters = self.parameters
        self._turn(pose, since)
        turned = pose._replace(yaw=pose.yaw + self._turned)
        if not has_moved(self._updated, turned, parameters.update_min_d, parameters.update_min_a):
            return False
        elapsed = min((stamp_ns - self._updated_ns) / NANOSECONDS, LONGEST_UPDATE)
        self.filter.predict(self._updated, turned, elapsed)
        self._correct(pose, elapsed)
        return True

    def _follow_jump(self, last: Pose, pose: Pose) -> bool:
        """Take a jump of the odometry for one of its frame; return whether there is a pose."""
        self._pending.clear()
        self._readings.clear()
        self._updated, self._updated_ns = pose, self._stamp_ns
        if self._estimate is None:
            return False
        frame = frame_kept(self._estimate.odometry_frame, last, pose)
        self._estimate = self._estimate._replace(
            stamp_ns=self._stamp_ns, pose=pose_in(frame, pose), odometry_frame=frame
        )
        return True

    def _correct(self, pose: Pose, elapsed: float) -> None:
        """Correct the particles and the tracked pose by the readings since the last update."""
        taken, doubtful = self._take_beams(pose), self.doubtful
        of_the_map = {sensor: self._of_the_map(each, pose) for sensor, each in taken.items()}
        known = joined([each for name, each in of_the_map.items() if name not in doubtful])
        # Averages of the likelihood get used to a wrong place; the share that fits does not.
        self.filter.correct(known, 1.0 - self.agreement if self._searching else 0.0)
        self._publish(pose)
        self._compare(known)
        self._track(pose, known, elapsed)
        for sensor, each in of_the_map.items():
            if sensor != SCAN:
                self._fits[sensor] = followed(self._fits[sensor], self._explain(each)[:, 0])
        if self.parameters.changes.enabled:
            self._detect(joined([each for name, each in taken.items() if name not in doubtful]))

    def _track(self, odometry: Pose, known: Beams, elapsed: float) -> None:
        """Correct the pose that is tracked; where the place is known it begins anew."""
        assert self._estimate is not None
        if self._tracker.active:
            back = frame_between(ORIGIN, odometry)
            for sensor in sorted(self._readings.keys() - {*self.doubtful}):
                beams = joined(self._readings[sensor])
                here = beams._replace(origin=transformed(back, beams.origin))
                self._tracker.correct(self._of_the_map(here, odometry), sensor)
            self._tracker.compare(self._estimate.pose, known, elapsed)
        self._readings.clear()
        if not self._tracker.active and self.state is Localization.LOCALIZED:
            self._tracker.begin(self._estimate.pose, self._estimate.covariance)

    def _turn(self, odometry: Pose, elapsed: float) -> None:
        """Turn the origin of the odometry about the robot as its yaw drifts."""
        if self._drift == 0.0 or self._estimate is None:
            return
        turn = self._drift * elapsed
        self._turned += turn
        expected = pose_in(self._estimate.odometry_frame, odometry)
        frame = frame_between(expected._replace(yaw=expected.yaw + turn), odometry)
        self._estimate = self._estimate._replace(odometry_frame=frame)

    def _learn_drift(self, correction: float) -> None:
        """Follow the drift by a correction (rad) of the yaw since the last update."""
        elapsed = (self._stamp_ns - self._updated_ns) / NANOSECONDS
        if elapsed > 0.0:
            change = min(max(correction / elapsed, -LARGEST_CHANGE), LARGEST_CHANGE)
            drift = self._drift + elapsed / (DRIFT_TIME + elapsed) * change
            self._drift = min(max(drift, -LARGEST_DRIFT), LARGEST_DRIFT)

    def _of_the_map(self, beams: Beams, odometry: Pose) -> Beams:
        """Return the beams without those of what has changed, by the pose before these beams."""
        if self._estimate is None or not self.parameters.changes.enabled:
            return beams
        expected = pose_in(self._estimate.odometry_frame, odometry)
        before_ns = self._found_ns if self._in_doubt else math.inf
        known = ~self.changes.explained(expected, self._estimate.covariance, beams, before_ns)
        return Beams(*(part[known] for part in beams))

    def _detect(self, beams: Beams) -> None:
        """Look for changes of the surroundings where the place is known.

        After a slip all readings contradict the map until the filter has corrected the pose.
        """
        assert self._estimate is not None
        assert self._odometry is not None
        stamp_ns, pose, _, frame = self._estimate
        self._frames.append((stamp_ns, frame))
        while not 0 <= stamp_ns - self._frames[0][0] <= STEADY_TIME * NANOSECONDS:
            self._frames.popleft()
        expected = pose_in(self._frames[0][1], self._odometry)
        steady = not has_moved(expected, pose, STEADY_DISTANCE, STEADY_ANGLE)
        if steady and self.state is Localization.LOCALIZED:
            self.changes.add(*self._estimate[:3], beams)
        else:
            self.changes.forget()

    def _take_beams(self, pose: Pose) -> dict[int, Beams]:
        """Return the beams since the last update by sensor, in the frame of the robot."""
        back = frame_between(ORIGIN, pose)
        found = {
            sensor: beams._replace(origin=transformed(back, transformed(there, beams.origin)))
            for sensor, (there, beams) in sorted(self._pending.items())
        }
        self._pending.clear()
        return found

    def _publish(self, odometry: Pose) -> None:
        estimate = self.filter.estimate()
        if self._updated is not None and self._estimate is not None:
            expected = pose_in(self._estimate.odometry_frame, odometry)
            if has_moved(expected, estimate.pose, JUMP_DISTANCE, JUMP_ANGLE):
                self._searching = True  # until the readings have fitted there for some time
            elif self.state is Localization.LOCALIZED:
                self._learn_drift(wrap_angle(estimate.pose.yaw - expected.yaw))
        self._turned = 0.0
        self._updated, self._updated_ns = odometry, self._stamp_ns
        self.share = estimate.share
        covariance = estimate.covariance + np.diag(np.square(SYSTEMATIC))
        if estimate.share < KNOWN_SHARE or self.silent:
            covariance = self.filter.spread(estimate.pose)
        frame = frame_between(estimate.pose, odometry)
        self._estimate = LocalizedPose(self._stamp_ns, estimate.pose, covariance, frame)

    def _compare(self, beams: Beams) -> None:
        """Update the share of readings that fit to the map at the estimate."""
        fits = [each[0] for each in self._explain(beams).tolist() if self._counts(*each)]
        self.agreement = followed(self.agreement, np.array(fits))
        if self.agreement < self.parameters.lost_agreement:
            self._searching, self._found_ns = True, math.inf
            self.changes.withdraw(self._sure_ns)
        elif self.agreement >= FOUND_AGREEMENT and self.share >= KNOWN_SHARE:
            self._searching, self._found_ns = False, min(self._found_ns, self._stamp_ns)
            if not self._in_doubt:
                self._sure_ns = self._stamp_ns

    @property
    def _in_doubt(self) -> bool:
        """Whether the place is not known, or was found a short time ago: it may be a wrong one.

        Then nothing that contradicts the map excuses a reading, nor several readings each other.
        """
        return self._stamp_ns - self._found_ns < DOUBT_TIME * NANOSECONDS

    def _counts(self, fits: float, x: float, y: float) -> bool:
        """Note a reading; return whether it tells the pose: of each place only so many do."""
        self._witnesses[:, 2] *= 1.0 - AGREEMENT_DECAY
        if fits > 0.0 or self._in_doubt:
            return True
        away = np.hypot(self._witnesses[:, 0] - x, self._witnesses[:, 1] - y)
        if not away.size or away.min() > ONE_THING:
            lately = self._witnesses[self._witnesses[:, 2] > FADED]
            self._witnesses = np.concatenate([lately, [[x, y, 1.0]]])
            return True
        near = int(away.argmin())
        counts = bool(self._witnesses[near, 2] < MOST_WITNESSES - 1.0)
        self._witnesses[near, 2] += 1.0 if counts else 0.0
        return counts

    def _explain(self, beams: Beams) -> Array:
        """Return which beams fit to the map at the estimate, and where, of those that tell."""
        assert self._estimate is not None
        found = np.empty((beams.reading.size, 3))
        explain_readings(np.array(self._estimate.pose), self._field, beams, self._model, found)
        fitting: Array = found[found[:, 0] != 0.0]
        return fitting


def followed(share: float, fits: Array) -> float:
    """Return a share of fitting readings after further ones: 1 of one that fits, else -1."""
    decay = 1.0 - (1.0 - AGREEMENT_DECAY) ** fits.size
    return share + decay * (float(np.mean(fits > 0.0)) - share) if fits.size else share


class PoseCorrection:
    """Pose on the map at every message of the odometry, without jumps a robot must not follow.

    It approaches the localizer's as a first-order lag of bounded speed, and takes it at once where
    they are far apart: after the robot was carried. Until the place is known there is none, and
    while the robot is lost it goes on by the odometry.
    """

    def __init__(self) -> None:
        self._frame: Pose | None = None
        """Origin of the odometry on the map, as used."""
        self._target: Pose | None = None
        """As last known."""
        self._stamp_ns = 0
        self._odometry: Pose | None = None

    def step(self, stamp_ns: int, odometry: Pose, localizer: Localizer) -> Pose | None:
        """Return the pose on the map of a pose of the odometry; None: the place is not known."""
        elapsed_ns = stamp_ns - self._stamp_ns
        elapsed = min(max(elapsed_ns / NANOSECONDS, 0.0), CORRECTION_TIME)
        self._stamp_ns = stamp_ns
        last, self._odometry = self._odometry or odometry, odometry
        jumped = has_jumped(last, odometry, elapsed_ns)
        if jumped and self._frame is not None and self._target is not None:
            self._frame = frame_kept(self._frame, last, odometry)
            self._target = frame_kept(self._target, last, odometry)
            return pose_in(self._frame, odometry)
        way = math.hypot(odometry.x - last.x, odometry.y - last.y)
        way += CORRECTION_ARM * abs(wrap_angle(odometry.yaw - last.yaw))
        most = CORRECTION_SPEED * elapsed
        if way > CORRECTION_STANDING * elapsed:
            most = min(most, CORRECTION_SHARE * way)
        result = localizer.result
        if result is not None and localizer.state is Localization.LOCALIZED:
            self._target = result.odometry_frame
        if self._target is None:
            return None
        wanted = pose_in(self._target, odometry)
        if self._frame is None:
            self._frame = self._target
            return wanted
        pose = pose_in(self._frame, odometry)
        x, y, turn = wanted.x - pose.x, wanted.y - pose.y, wrap_angle(wanted.yaw - pose.yaw)
        away = math.hypot(x, y)
        if away > JUMP_DISTANCE or abs(turn) > JUMP_ANGLE:
            self._frame = self._target
            return wanted
        share = elapsed / CORRECTION_TIME
        move = min(share, most / max(away, 1e-9))
        rotate = min(share, CORRECTION_RATE * elapsed / max(abs(turn), 1e-9))
        pose = Pose(pose.x + move * x, pose.y + move * y, wrap_angle(pose.yaw + rotate * turn))
        self._frame = frame_between(pose, odometry)
        return pose


def has_jumped(last: Pose, new: Pose, elapsed_ns: int) -> bool:
    """Return whether the odometry has restarted or was set, seen by its time or its motion."""
    elapsed = elapsed_ns / NANOSECONDS
    far = min(JUMP_STEP[0] + JUMP_SPEED[0] * elapsed, LARGEST_STEP)
    return elapsed_ns < 0 or has_moved(last, new, far, JUMP_STEP[1] + JUMP_SPEED[1] * elapsed)


def frame_kept(frame: Pose, last: Pose, new: Pose) -> Pose:
    """Return the origin of an odometry that has jumped while the robot was where it was."""
    return frame_between(pose_in(frame, last), new)


def pose_in(frame: Pose, pose: Pose) -> Pose:
    """Return a pose of a frame outside of it."""
    x, y, yaw = transformed(frame, np.array([pose]))[0].tolist()
    return Pose(x, y, wrap_angle(yaw))


def warm_up(parameters: LocalizerParameters) -> None:
    """Compile every kernel of an update, on a small map."""
    cells = np.zeros((8, 8), dtype=np.int8)
    cells[0] = 100
    small = map_of_grid(cells, max(0.1, parameters.robot_radius), (0.0, 0.0, 0.0))
    made = Localizer(parameters, small, np.zeros((1, 3)), (0.1, 0.8))
    made.scatter()
    made._tracker.begin(ORIGIN, np.eye(3))
    for k in range(3):
        made.add_odometry(k, Pose(k * 2.0 * parameters.update_min_d, 0.0, 0.0))
        made.add_range(0, 0.5)
    made.filter.resample(0.5, Beams(np.zeros((1, 3)), np.full(1, 0.5), np.array([[0.1, 0.8]])))


def transformed(frame: Pose, beams: Array) -> Array:
    """Return beams (x, y in m, direction in rad), shape (n, 3), of a frame outside of it."""
    return np.column_stack([points_from_frame(frame, beams[:, :2]), frame.yaw + beams[:, 2]])
