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
"""ROS messages: conversion to the types of the package, classes by name, frames, and age."""

from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import importlib
import math
import struct
import time
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose as PoseMessage
from geometry_msgs.msg import (
    PoseStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    TwistStamped,
)
from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from t3mpc_ros.geometry.obstacles import OccupancyGrid
from t3mpc_ros.geometry.types import NANOSECONDS, Array, BodyTwist, Pose, State
from t3mpc_ros.parameters.table import Parameters, parameter

MAX_CLOCK_LEAD_NS = NANOSECONDS // 20
"""Lead of the publisher's clock beyond which the age of a message is unknown."""
UNKNOWN_VARIANCE = 1e6
"""Variance of a quantity that is not measured, in any unit."""
MIN_VARIANCE = 1e-6
"""Least published variance of a pose or twist: 1 mm and 1 mrad, 1 mm/s and 1 mrad/s. After a
reset the pose is exact by definition, as a reference and the ground truth are, but filters invert
its covariance."""


@dataclass(frozen=True)
class FrameParameters(Parameters):
    """Prefix of frames, with the parameters of diff_drive_controller.

    Topics are separated by the namespace, transforms are not: two robots need two names for each
    frame.
    """

    tf_frame_prefix_enable: bool = parameter(True, 'whether frames get a prefix')
    tf_frame_prefix: str = parameter('', 'prefix of the frames; empty: the namespace of the node')

    def prefixed(self, frame: str, namespace: str) -> str:
        """Return a frame with the prefix that a node in this namespace uses."""
        prefix = (self.tf_frame_prefix or namespace).strip('/')
        if not (self.tf_frame_prefix_enable and prefix) or frame.startswith(f'{prefix}/'):
            return frame
        return f'{prefix}/{frame}'


def time_from_ns(stamp_ns: int) -> Time:
    """Return a stamp in nanoseconds as a message."""
    seconds, rest = divmod(stamp_ns, NANOSECONDS)
    return Time(sec=seconds, nanosec=rest)


def ns_from_time(stamp: Time) -> int:
    """Return the stamp of a message in nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def header(stamp_ns: int, frame: str = '') -> Header:
    """Return the header of a message."""
    return Header(stamp=time_from_ns(stamp_ns), frame_id=frame)


def quaternion_from_yaw(yaw: float) -> Quaternion:
    """Return the rotation by ``yaw`` (rad) about z."""
    return Quaternion(z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))


def yaw_from_quaternion(x: float, y: float, z: float, w: float) -> float:
    """Return the yaw (rad) of a rotation with any roll and pitch; NaN if not finite, or of zeros.

    Zeros are no rotation: a driver that leaves them knows no yaw.
    """
    if not (x or y or z or w):
        return math.nan
    # Products, not powers, which raise OverflowError.
    sine = 2.0 * (w * z + x * y)
    cosine = 1.0 - 2.0 * (y * y + z * z)
    # atan2 of an infinite vector is finite.
    if not (math.isfinite(sine) and math.isfinite(cosine)):
        return math.nan
    return math.atan2(sine, cosine)


def state_from_odometry(data: bytes) -> State:
    """Return the planar state in a serialized odometry message.

    To construct the message, with its 72 covariances, would take ten times as long. The layout
    is that of CDR: four bytes of header, then each value at a multiple of its size. struct.error
    if the data ends before the message does.
    """
    order, start = _layout(data)
    seconds, nanoseconds = struct.unpack_from(f'{order}iI', data, 4)
    # 7 numbers of the pose, 36 of its covariance, 6 of the twist.
    x, y, _, *rotation, linear, _, _, _, _, angular = struct.unpack_from(
        f'{order}7d288x6d', data, start
    )
    return State(
        seconds * NANOSECONDS + nanoseconds,
        Pose(x, y, yaw_from_quaternion(*rotation)),
        BodyTwist(linear, angular),
    )


def frame_from_serialized(data: bytes) -> str:
    """Return the frame of a serialized message that begins with its header."""
    (length,) = struct.unpack_from('<I' if data[1] & 1 else '>I', data, 12)
    return data[16 : 15 + length].decode(errors='replace')


def points_from_path(data: bytes) -> Array:
    """Return the positions in a serialized path, m, shape (n, 2); struct.error if it is truncated.

    To construct the message takes seconds for a long path, in which the node does nothing else.
    """
    order = '<' if data[1] & 1 else '>'
    (length,) = struct.unpack_from(f'{order}I', data, 12)
    start = 16 + length + -length % 4
    (count,) = struct.unpack_from(f'{order}I', data, start)
    start += 4
    points: list[tuple[float, float]] = []
    while len(points) < count:
        (length,) = struct.unpack_from(f'{order}I', data, start + 8)
        place = start + 12 + length
        place += (4 - place) % 8
        points.append(struct.unpack_from(f'{order}2d40x', data, place))
        start, rest = place + 56, count - len(points)
        if len(points) == 1 and rest:
            # From the second pose on, poses are equally long if the names of their frames are.
            size = 12 + length + (4 - length) % 8 + 56
            if len(data) >= start + rest * size:
                lengths = np.ndarray(rest, f'{order}u4', data, start + 8, size)
                if (lengths == length).all():
                    places = np.ndarray(
                        (rest, 2), f'{order}f8', data, start + size - 56, (size, 8)
                    )
                    return np.vstack([points, places]).astype(np.float64)
    return np.array(points, dtype=np.float64).reshape(-1, 2)


def twist_from_serialized(data: bytes) -> BodyTwist:
    """Return :func:`body_twist` of a serialized Twist; struct.error if it is truncated."""
    order = '<' if data[1] & 1 else '>'
    linear, y, z, roll, pitch, angular = struct.unpack_from(f'{order}6d', data, 4)
    if not all(map(math.isfinite, (y, z, roll, pitch))):
        return BodyTwist(math.nan, math.nan)
    return BodyTwist(linear, angular)


def float_from_serialized(data: bytes) -> float:
    """Return the number in a serialized Float64; struct.error if it is truncated."""
    (value,) = struct.unpack_from('<d' if data[1] & 1 else '>d', data, 4)
    return float(value)


def range_from_serialized(data: bytes) -> tuple[float, float]:
    """Return ``range`` and ``max_range`` of a serialized Range; struct.error if truncated."""
    order = '<' if data[1] & 1 else '>'
    (length,) = struct.unpack_from(f'{order}I', data, 12)
    end = 16 + length
    # After the byte of the kind of radiation: field of view, least and largest range, range.
    largest, distance = struct.unpack_from(f'{order}8x2f', data, end + 4 - end % 4)
    return distance, largest


def _layout(data: bytes | bytearray) -> tuple[str, int]:
    """Return the byte order of a serialized odometry message and the offset of its pose."""
    order = '<' if data[1] & 1 else '>'
    (length,) = struct.unpack_from(f'{order}I', data, 12)
    child = 16 + length + -length % 4
    (length,) = struct.unpack_from(f'{order}I', data, child)
    end = child + 4 + length
    return order, end + (4 - end) % 8


class SerializedOdometry:
    """Serialized odometry messages of two frames that differ in state and covariances only.

    Construction and serialization of a message would take most of the time of a robot's step.
    Until covariances are set, pose and twist are exact, but for the lateral speed, which is
    unknown.
    """

    def __init__(self, frame: str, child: str) -> None:
        self.frame, self.child = frame, child
        message = Odometry(header=header(0, frame), child_frame_id=child)
        self._data = bytearray(serialize_message(message))
        order, start = _layout(self._data)
        self._stamp = struct.Struct(f'{order}iI')
        self._pose = struct.Struct(f'{order}7d')
        self._twist = struct.Struct(f'{order}6d')
        self._covariance = struct.Struct(f'{order}36d')
        self._pose_start = start
        self._pose_covariance = start + self._pose.size
        self._twist_start = self._pose_covariance + self._covariance.size
        self._twist_covariance = self._twist_start + self._twist.size
        none = (0.0, 0.0, 0.0)
        self.set_pose_covariance(planar_covariance((none, none, none), MIN_VARIANCE))
        lateral = (0.0, UNKNOWN_VARIANCE, 0.0)
        self.set_twist_covariance(planar_covariance((none, lateral, none), MIN_VARIANCE))

    def set_pose_covariance(self, values: Sequence[float]) -> None:
        """Set the 36 numbers of the covariance of the pose."""
        self._covariance.pack_into(self._data, self._pose_covariance, *values)

    def set_twist_covariance(self, values: Sequence[float]) -> None:
        """Set the 36 numbers of the covariance of the twist."""
        self._covariance.pack_into(self._data, self._twist_covariance, *values)

    def with_state(self, state: State) -> bytes:
        """Return the message with the stamp, the pose and the twist of ``state``."""
        pose, twist, half = state.pose, state.twist, 0.5 * state.pose.yaw
        rotation = 0.0, 0.0, math.sin(half), math.cos(half)
        self._stamp.pack_into(self._data, 4, *divmod(state.stamp_ns, NANOSECONDS))
        self._pose.pack_into(self._data, self._pose_start, pose.x, pose.y, 0.0, *rotation)
        self._twist.pack_into(
            self._data, self._twist_start, twist.linear, 0.0, 0.0, 0.0, 0.0, twist.angular
        )
        return bytes(self._data)


def planar_covariance(pose: Sequence[Sequence[float]], least: float = 0.0) -> list[float]:
    """Return the 36 numbers of a message for a covariance (3, 3) of x, y, yaw.

    z, roll and pitch of a planar robot get :data:`UNKNOWN_VARIANCE`, the others at least
    ``least``.
    """
    full = [0.0] * 36
    planar = (0, 1, 5)
    for row, i in enumerate(planar):
        for column, j in enumerate(planar):
            full[6 * i + j] = float(pose[row][column])
        full[7 * i] = max(full[7 * i], least)
    for i in (2, 3, 4):
        full[7 * i] = UNKNOWN_VARIANCE
    return full


def body_twist(message: Twist) -> BodyTwist:
    """Return linear x and angular z of a command; NaN if any of its six numbers is not finite.

    The other four have no effect on a differential drive.
    """
    others = (message.linear.y, message.linear.z, message.angular.x, message.angular.y)
    if not all(map(math.isfinite, others)):
        return BodyTwist(math.nan, math.nan)
    return BodyTwist(message.linear.x, message.angular.z)


def twist_and_stamp(message: Twist | TwistStamped, now_ns: int) -> tuple[BodyTwist, int]:
    """Return a command and its stamp (ns): that of the header, otherwise ``now_ns``.

    A stamp of zero counts as not set, which is usual for teleoperation.
    """
    if isinstance(message, TwistStamped):
        return body_twist(message.twist), ns_from_time(message.header.stamp) or now_ns
    return body_twist(message), now_ns


def twist_from_body(twist: BodyTwist) -> Twist:
    """Return a command as a message."""
    message = Twist()
    message.linear.x = float(twist.linear)
    message.angular.z = float(twist.angular)
    return message


def stamped_twist(twist: BodyTwist, stamp_ns: int, frame: str) -> TwistStamped:
    """Return a command as a message with a header."""
    return TwistStamped(header=header(stamp_ns, frame), twist=twist_from_body(twist))


def points_from_poses(poses: Iterable[PoseMessage]) -> Array:
    """Return the positions of poses, m, shape (n, 2)."""
    places = [each.position for each in poses]
    return np.array([(each.x, each.y) for each in places], dtype=np.float64).reshape(-1, 2)


def occupancy_message(grid: OccupancyGrid, stamp_ns: int, frame: str) -> OccupancyGridMessage:
    """Return a grid as a message."""
    message = OccupancyGridMessage(header=header(stamp_ns, frame))
    message.info.map_load_time = message.header.stamp
    message.info.resolution = grid.resolution
    message.info.height, message.info.width = grid.cells.shape
    message.info.origin.position.x, message.info.origin.position.y = grid.x, grid.y
    message.data = array('b', grid.cells.tobytes())
    return message


def grid_from_occupancy(message: OccupancyGridMessage) -> OccupancyGrid:
    """Return the grid of a message; ValueError: its size is wrong, or it is turned."""
    info, origin = message.info, message.info.origin
    cells = np.array(message.data, dtype=np.int8)
    if cells.size != info.width * info.height or not cells.size:
        raise ValueError(
            f'map must have width x height cells, {info.width} x {info.height}: got {cells.size}'
        )
    turn = origin.orientation
    yaw = yaw_from_quaternion(turn.x, turn.y, turn.z, turn.w)
    place = origin.position.x, origin.position.y
    if not all(map(math.isfinite, (*place, yaw))) or abs(yaw) > 1e-6:
        raise ValueError(f'origin of map must be finite, with a yaw of 0: got {(*place, yaw)}')
    if not 1e-3 <= info.resolution <= 10.0:
        raise ValueError(f'resolution of map must be from 0.001 to 10 m: got {info.resolution:g}')
    return OccupancyGrid(cells.reshape(info.height, info.width), info.resolution, *place)


def pose_from_transform(transform: Transform) -> Pose:
    """Return the pose in the plane of a frame in its parent."""
    place, turn = transform.translation, transform.rotation
    return Pose(place.x, place.y, yaw_from_quaternion(turn.x, turn.y, turn.z, turn.w))


def pose_stamped(state: State, frame: str) -> PoseStamped:
    """Return the pose of a state as a message."""
    message = PoseStamped(header=header(state.stamp_ns, frame))
    message.pose.position.x = state.pose.x
    message.pose.position.y = state.pose.y
    message.pose.orientation = quaternion_from_yaw(state.pose.yaw)
    return message


def transform(
    stamp_ns: int, pose: Pose, frame: str, child: str, z: float = 0.0
) -> TransformStamped:
    """Return a pose at height ``z`` (m) as a transform from ``frame`` to ``child``."""
    message = TransformStamped(header=header(stamp_ns, frame), child_frame_id=child)
    message.transform.translation.x = pose.x
    message.transform.translation.y = pose.y
    message.transform.translation.z = z
    message.transform.rotation = quaternion_from_yaw(pose.yaw)
    return message


def joint_state(
    names: Sequence[str], angles: Sequence[float], speeds: Sequence[float], stamp_ns: int
) -> JointState:
    """Return wheel angles (rad) and speeds (rad/s) as a message."""
    return JointState(
        header=header(stamp_ns),
        name=list(names),
        position=list(map(float, angles)),
        velocity=list(map(float, speeds)),
    )


def message_age_ns(info: dict[str, Any]) -> int:
    """Return the time since the publication of a message, ns; 0 if the middleware has no stamp.

    An executor that was suspended takes messages that have waited: counted from the moment at
    which it takes them, an unstamped command would be new, however long ago its publisher ended.
    Both times are of the system clock, also with ``use_sim_time``. The age is negative if the
    clock of the publisher leads.
    """
    published_ns = int(info['source_timestamp'])
    return time.time_ns() - published_ns if published_ns > 0 else 0


def age_problem(age_ns: int, timeout: float) -> str:
    """Return why a message must not move a robot for which it is valid ``timeout`` s; or ''."""
    age = age_ns / NANOSECONDS
    if age_ns < -MAX_CLOCK_LEAD_NS:
        return f'is from the future: {-age:.3f} s, the clocks of the computers differ'
    if age >= timeout:
        return f'is too old: {age:.3f} s, it has waited or the clocks of the computers differ'
    return ''


def type_name(message: type) -> str:
    """Return ``package/msg/Type`` of a message class."""
    package = message.__module__.split('.', maxsplit=1)[0]
    return f'{package}/msg/{message.__name__}'


def message_class(name: str) -> type:
    """Return the class of ``package/msg/Type`` or ``package/srv/Type``, or raise ImportError."""
    package, folder, word = name.split('/')
    try:
        found: type = getattr(importlib.import_module(f'{package}.{folder}'), word)
    except AttributeError as error:
        raise ImportError(f'{package} has no {name}') from error
    return found
