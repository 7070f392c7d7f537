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
"""Pose, twist, wheel speeds, stamped states and range sensors of the robot, in SI units."""

from collections.abc import Iterator
from itertools import repeat
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Of any shape; docstrings give shape and units."""


def read_only(values: Array) -> Array:
    """Return a view of an array through which nobody can change it."""
    view = values.view()
    view.flags.writeable = False
    return view


NANOSECONDS = 1_000_000_000
"""Nanoseconds per second: stamps are ``int`` nanoseconds, durations ``float`` seconds."""

RANGE_SENSORS = (
    'front_left',
    'front_right',
    'left_front',
    'left_back',
    'rear_left',
    'rear_right',
    'right_front',
    'right_back',
)
"""The eight range sensors, two on each side, in the order of every list of them."""


class Pose(NamedTuple):
    """Position and yaw of the middle of the wheel axle in the world frame."""

    x: float
    """m"""
    y: float
    """m"""
    yaw: float
    """rad, counter-clockwise from the x axis; the paper's P"""


class BodyTwist(NamedTuple):
    """Velocity in the robot's own frame."""

    linear: float
    """m/s, forward; the paper's v"""
    angular: float
    """rad/s, counter-clockwise; the paper's omega"""


class WheelSpeeds(NamedTuple):
    """Wheel speeds, the paper's chi: right first, forward positive."""

    right: float
    """rad/s"""
    left: float
    """rad/s"""


LARGEST = 1e9
"""Sum of the magnitudes of a state from which it is no measurement: of 1e308 m, differences and
squares are infinite."""


class State(NamedTuple):
    """Pose and twist at one instant: measured, true or reference."""

    stamp_ns: int
    pose: Pose
    twist: BodyTwist

    def is_finite(self) -> bool:
        """Return whether every number is finite, and none beyond :data:`LARGEST`."""
        (x, y, yaw), (linear, angular) = self.pose, self.twist
        return abs(x) + abs(y) + abs(yaw) + abs(linear) + abs(angular) < LARGEST


ORIGIN = Pose(0.0, 0.0, 0.0)
STANDSTILL = BodyTwist(0.0, 0.0)


def check_pose(pose: Pose) -> None:
    """Raise ValueError when a pose is not finite."""
    if not all(map(math.isfinite, pose)):
        raise ValueError(f'pose must be finite: got {pose}')


def difference(one: Pose, other: Pose) -> tuple[float, float]:
    """Return the distance (m) and the angle (rad) between two poses."""
    return math.dist(one[:2], other[:2]), abs(wrap_angle(other.yaw - one.yaw))


def motion_between(last: Pose, new: Pose) -> tuple[float, float, float]:
    """Return the way ahead and to the left (m) between two poses, and the turn (rad)."""
    turn = wrap_angle(new.yaw - last.yaw)
    middle = last.yaw + 0.5 * turn
    x, y, cosine, sine = new.x - last.x, new.y - last.y, math.cos(middle), math.sin(middle)
    return cosine * x + sine * y, cosine * y - sine * x, turn


def has_moved(start: Pose | None, pose: Pose, distance: float, angle: float) -> bool:
    """Return whether a pose is farther than a distance (m) or an angle (rad) from the start."""
    return start is None or (
        math.hypot(pose.x - start.x, pose.y - start.y) > distance
        or abs(wrap_angle(pose.yaw - start.yaw)) > angle
    )


JUMP = 0.1, 0.3
"""Change of a pose beyond the motion that is a jump, m and rad."""


UNKNOWN_TWIST, UNKNOWN_TIME = BodyTwist(0.5, 4.5), 0.25
"""Speeds that a robot may have, and the time (s) for which it may, whose twist is zero: some
odometry has none."""


def has_jumped(last: State, new: State) -> bool:
    """Return whether the pose has changed by more than twice the motion between two messages."""
    elapsed = max(new.stamp_ns - last.stamp_ns, 0) / NANOSECONDS
    twists = last.twist, new.twist
    if twists == (STANDSTILL, STANDSTILL):
        twists, elapsed = (UNKNOWN_TWIST, UNKNOWN_TWIST), min(elapsed, UNKNOWN_TIME)
    linear, angular = (max(abs(twists[0][i]), abs(twists[1][i])) for i in (0, 1))
    distance, angle = JUMP[0] + 2.0 * elapsed * linear, JUMP[1] + 2.0 * elapsed * angular
    return has_moved(last.pose, new.pose, distance, angle)


def wrap_angle(angle: float) -> float:
    """Return ``angle`` (rad) wrapped into (-pi, pi]."""
    wrapped = math.remainder(angle, math.tau)
    return math.pi if wrapped == -math.pi else wrapped


class StateArray:
    """A sequence of :class:`State`, stored as arrays.

    Stamps (ns) have the shape (n,), poses (x, y in m, yaw in rad) (n, 3), twists (m/s, rad/s)
    (n, 2).
    """

    def __init__(self, stamps_ns: NDArray[np.int64], poses: Array, twists: Array) -> None:
        count = len(stamps_ns)
        if np.shape(poses) != (count, 3) or np.shape(twists) != (count, 2):
            raise ValueError(
                f'poses must be ({count}, 3) and twists ({count}, 2): got {np.shape(poses)} and '
                f'{np.shape(twists)}'
            )
        self.stamps_ns = np.ascontiguousarray(stamps_ns, dtype=np.int64)
        self.poses: Array = np.ascontiguousarray(poses, dtype=np.float64)
        self.twists: Array = np.ascontiguousarray(twists, dtype=np.float64)
        numbers = np.concatenate([self.poses, self.twists], axis=1)
        self.finite: NDArray[np.bool_] = np.all(np.isfinite(numbers), axis=1)
        """``State.is_finite`` of each state, shape (n,)."""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, k: int) -> State:
        return State(
            int(self.stamps_ns[k]),
            Pose(*self.poses[k].tolist()),
            BodyTwist(*self.twists[k].tolist()),
        )

    def __iter__(self) -> Iterator[State]:
        # As the named tuples make themselves, without a Python call for each.
        make = tuple.__new__
        poses = map(make, repeat(Pose), self.poses.tolist())
        twists = map(make, repeat(BodyTwist), self.twists.tolist())
        table = zip(self.stamps_ns.tolist(), poses, twists, strict=True)
        return map(make, repeat(State), table)


def is_out_of_order(stamp_ns: int, last_ns: int, timeout: float) -> bool:
    """Return whether a message is the last one again, or was overtaken by it on the way.

    A stamp that is older by more than ``timeout`` s is one of a clock that was set back.
    """
    return 0 <= last_ns - stamp_ns <= timeout * NANOSECONDS
