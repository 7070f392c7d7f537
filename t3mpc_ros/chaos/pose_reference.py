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
"""Sources of a reference with a pose: the chaotic path, a given path, and commanded twists."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Protocol

import numpy as np

from t3mpc_ros.chaos.portrait import PortraitParameters, PortraitPath
from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.geometry.kinematics import WheelGeometry, advance_pose
from t3mpc_ros.geometry.path_timing import MotionLimits, PathTiming
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, Array, BodyTwist, Pose
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter

APPROACH = 0.02
"""Distance from which on a robot has come nearer or set off, m: above the noise of a pose."""
MAX_REFERENCES = 4096
"""Samples of the reference that are kept until the robot has reported where it was."""


@dataclass(frozen=True)
class ReseedParameters(Parameters):
    """Times at which a chaotic path gets another seed."""

    shortest: float = parameter(
        0.0, 'shortest time between two seeds, drawn evenly; 0: the seed is kept', 's', (0.0, 1e6)
    )
    longest: float = parameter(0.0, 'longest time between two seeds', 's', (0.0, 1e6))

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` unless the times ascend."""
        if self.longest < self.shortest:
            raise ParameterError(
                f'reseed.longest must be at least reseed.shortest, {self.shortest:g} s: '
                f'got {self.longest:g}'
            )


@dataclass(frozen=True)
class WaitParameters(Parameters):
    """Where and how long a path waits for the robot."""

    distance: float = parameter(
        0.05,
        'distance of the robot from its reference from which on the path goes more slowly; it '
        'waits from twice the distance on. A chaotic path does so only until the robot sets off. '
        '0: it never waits',
        'm',
        (0.0, 10.0),
    )
    patience: float = parameter(
        3.0,
        'time for which the path waits for a robot on its way that comes no nearer; it then goes '
        'on for as long, so that it leaves an obstacle that it leads through',
        's',
        (0.1, 1e6),
    )


@dataclass(frozen=True)
class PathReferenceParameters(ReferenceParameters):
    """Source of the reference, and the limits of a motion along a path."""

    source: str = parameter(
        'signals',
        'signals: two chaotic signals are the speeds of the wheels, as in the paper; portrait: a '
        'chaotic path in an arena; file: the path of path_file; topic: each nav_msgs/Path on '
        'path, appended to the one before; twist: the twists on target_twist. All but signals '
        'begin at the pose of the first odom message and need pose.enabled of the controller',
        choices=('signals', 'portrait', 'file', 'topic', 'twist'),
    )
    path_file: str = parameter('', 'path of source file: .csv or .yaml, m')
    repeat: bool = parameter(False, 'source file: drive the path again and again')
    twist_timeout: float = parameter(
        0.5,
        'source twist: age at which a twist expires, and the reference stops',
        's',
        (0.05, 10.0),
    )
    portrait: PortraitParameters = group(PortraitParameters)
    reseed: ReseedParameters = group(ReseedParameters)
    wait: WaitParameters = group(WaitParameters)
    motion: MotionLimits = group(MotionLimits)

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` if source and file contradict."""
        super().check_consistency()
        if (self.source == 'file') != bool(self.path_file):
            raise ParameterError(
                'path_file must name a file with source file, and only then: '
                f'got source {self.source} with path_file {self.path_file!r}'
            )


class PathClock:
    """Rate at which the time of a path passes: less than 1 while the robot is away from it.

    A path waits for a robot that has not set off, whose controller starts later, say, or that
    looks around or makes a detour. It does not know what holds the robot up, and so does not
    wait forever: where it leads through an obstacle, no robot can follow. ``on_the_way``: it
    also waits for a robot that has set off.
    """

    def __init__(self, parameters: WaitParameters, *, on_the_way: bool = True) -> None:
        self._parameters, self._on_the_way = parameters, on_the_way
        self._references: deque[tuple[int, Pose]] = deque(maxlen=MAX_REFERENCES)
        self._start: Pose | None = None
        """First pose of the robot."""
        self._set_off = False
        self._stamp_ns = 0
        """Stamp of the last pose of the robot."""
        self._nearest = math.inf
        self._held = 0.0
        """Time without approach, s; negative while the path goes on regardless."""
        self.rate = 1.0
        """Rate, from 0 (wait) to 1, for :meth:`PathSource.advance`."""

    def add_reference(self, stamp_ns: int, pose: Pose) -> None:
        """Store a sample of the reference; samples with later stamps are removed."""
        references = self._references
        while references and references[-1][0] >= stamp_ns:
            references.pop()
        references.append((stamp_ns, pose))

    def observe(self, stamp_ns: int, pose: Pose) -> None:
        """Update :attr:`rate` with the pose of the robot at a stamp."""
        references = self._references
        while len(references) > 1 and references[1][0] <= stamp_ns:
            references.popleft()
        if not references:
            return
        if self._start is None:
            self._start, self._stamp_ns = pose, stamp_ns
        self._set_off = self._set_off or _distance(self._start, pose) > APPROACH
        elapsed, self._stamp_ns = (stamp_ns - self._stamp_ns) / NANOSECONDS, stamp_ns
        self.rate = self._rate(_distance(references[0][1], pose), max(elapsed, 0.0))

    def _rate(self, distance: float, elapsed: float) -> float:
        begin = self._parameters.distance
        if distance <= begin or begin == 0.0 or (self._set_off and not self._on_the_way):
            self._nearest, self._held = math.inf, 0.0
            return 1.0
        if self._set_off:
            self._held += elapsed
        if self._held < 0.0:
            self._nearest = distance
            return 1.0
        if distance < self._nearest - APPROACH:
            self._nearest, self._held = distance, 0.0
        if self._held >= self._parameters.patience:
            self._held = -self._parameters.patience
        return max(2.0 - distance / begin, 0.0)


def _distance(one: Pose, other: Pose) -> float:
    return math.hypot(one.x - other.x, one.y - other.y)


class PathSource(Protocol):
    """Source of one sample of the reference in each period."""

    def advance(self, rate: float = 1.0) -> tuple[Pose, BodyTwist]:
        """Return pose and twist of the next period, for a rate of :class:`PathClock`."""


class PortraitSource:
    """The chaotic path of a seed, and of others after random times.

    The first seed also determines the times of the next ones, which ``next_seed`` returns.
    """

    def __init__(
        self,
        parameters: PathReferenceParameters,
        geometry: WheelGeometry,
        start: Pose,
        seed: int,
        next_seed: Callable[[], int],
    ) -> None:
        self._reseed, self._next_seed = parameters.reseed, next_seed
        self._path = PortraitPath(parameters, parameters.portrait, parameters.motion.linear, seed)
        self._timing = PathTiming(parameters.motion, geometry, 1.0 / parameters.rate, start)
        self._period = 1.0 / parameters.rate
        self._times = np.random.default_rng((seed, 3))
        self._left = self._draw_time()

    def advance(self, rate: float = 1.0) -> tuple[Pose, BodyTwist]:
        """Return pose and twist of the next period, for a rate of :class:`PathClock`."""
        # In the time of the path: where a seed ends does not depend on the robot.
        self._left -= self._timing.rate * self._period
        if self._left <= 0.0:
            self.reseed(self._next_seed())
        while self._timing.needs_points:
            self._timing.add_points(self._path.advance(1.0))
        return self._timing.advance(rate)

    def reseed(self, seed: int) -> None:
        """Continue with another seed, from where the path planned so far ends."""
        self._path.reseed(seed)
        self._times = np.random.default_rng((seed, 3))
        self._left = self._draw_time()

    def _draw_time(self) -> float:
        """Return the time until the next seed, s."""
        reseed = self._reseed
        if reseed.longest <= 0.0:
            return math.inf
        return float(self._times.uniform(reseed.shortest, reseed.longest))


class GivenPathSource:
    """A path of which points arrive now and then; the robot rests where no more are known.

    First points: m, shape (n, 2); with ``repeat`` they are driven again and again.
    """

    def __init__(
        self,
        parameters: PathReferenceParameters,
        geometry: WheelGeometry,
        start: Pose,
        points: Array | None = None,
        repeat: bool = False,
    ) -> None:
        self._timing = PathTiming(parameters.motion, geometry, 1.0 / parameters.rate, start)
        self._again = points if repeat else None
        if points is not None:
            self.add_points(points)

    def add_points(self, points: Array) -> None:
        """Append points (m), shape (n, 2)."""
        self._timing.add_points(points)
        self._timing.drive_to_last_point()

    def advance(self, rate: float = 1.0) -> tuple[Pose, BodyTwist]:
        """Return pose and twist of the next period, for a rate of :class:`PathClock`."""
        if self._again is not None:
            while self._timing.needs_points:
                self._timing.add_points(self._again)
        return self._timing.advance(rate)


class TwistSource:
    """Commanded twists as a reference within the limits, with the pose that they lead to."""

    def __init__(self, parameters: PathReferenceParameters, start: Pose) -> None:
        self._limits = parameters.motion
        self._period = 1.0 / parameters.rate
        self._timeout = parameters.twist_timeout
        self._pose, self._twist = start, STANDSTILL
        self._target, self._age = STANDSTILL, math.inf

    def set_target(self, twist: BodyTwist) -> bool:
        """Follow a twist from now on; return False, and stop, when it is not finite."""
        finite = all(map(math.isfinite, twist))
        self._target, self._age = (twist, 0.0) if finite else (STANDSTILL, math.inf)
        return finite

    def advance(self, rate: float = 1.0) -> tuple[Pose, BodyTwist]:
        """Return pose and twist of the next period, for a rate of :class:`PathClock`."""
        limits, period = self._limits, self._period
        self._age += period
        target = self._target if self._age <= self._timeout else STANDSTILL
        scale = rate * min(
            1.0,
            limits.linear / max(abs(target.linear), 1e-12),
            limits.angular / max(abs(target.angular), 1e-12),
        )
        gaps = (
            scale * target.linear - self._twist.linear,
            scale * target.angular - self._twist.angular,
        )
        # One factor for both: the robot keeps to the curve while it speeds up or slows down.
        part = min(
            1.0,
            limits.linear_acceleration * period / max(abs(gaps[0]), 1e-12),
            limits.angular_acceleration * period / max(abs(gaps[1]), 1e-12),
        )
        result = self._pose, self._twist
        self._twist = BodyTwist(
            self._twist.linear + part * gaps[0], self._twist.angular + part * gaps[1]
        )
        self._pose = advance_pose(self._pose, self._twist, period)
        return result
