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
"""Messages of bags that are made up, without a ROS installation."""

from functools import cache
import math
import struct

import numpy as np
from rosbags.typesys import Stores, get_typestore

from t3mpc_ros.geometry.types import ORIGIN

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
START = 1_700_000_000_000_000_000
ODOMETRY, TWIST = 'nav_msgs/msg/Odometry', 'geometry_msgs/msg/Twist'
CDR, NO_COVARIANCE = b'\0\1\0\0', bytes(8 * 36)


class Serialised:
    """A message in CDR, made once where many are written."""

    def __init__(self, kind, data):
        self.__msgtype__, self.data = kind, data


def serialised(message):
    """Return a message in CDR."""
    if isinstance(message, Serialised):
        return message.data
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def serialised_twist(twist):
    """Return :func:`twist_message` in CDR, twenty times as fast."""
    linear, angular = map(float, twist)
    return Serialised(TWIST, CDR + struct.pack('<6d', linear, 0.0, 0.0, 0.0, 0.0, angular))


@cache
def _odometry_frame():
    """Return the bytes of a message between its stamp and its pose: the names of both frames."""
    data = serialised(odometry_message(0, (1.0, 2.0), (3.0, 4.0, 0.0)))
    return data[12 : data.index(struct.pack('<d', 3.0))]


def serialised_odometry(stamp_ns, twist, pose=ORIGIN):
    """Return :func:`odometry_message` in CDR, twenty times as fast."""
    (x, y, yaw), (linear, angular) = map(float, pose), map(float, twist)
    stamp = struct.pack('<iI', *divmod(stamp_ns, 10**9))
    place = struct.pack('<7d', x, y, 0.0, 0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw))
    moves = struct.pack('<6d', linear, 0.0, 0.0, 0.0, 0.0, angular)
    data = CDR + stamp + _odometry_frame() + place + NO_COVARIANCE + moves + NO_COVARIANCE
    return Serialised(ODOMETRY, data)


def header(stamp_ns, frame='odom'):
    stamp = TYPES['builtin_interfaces/msg/Time'](stamp_ns // 10**9, stamp_ns % 10**9)
    return TYPES['std_msgs/msg/Header'](stamp, frame)


def twist_message(twist):
    """Return the message of a (linear, angular) twist."""
    vector, (linear, angular) = TYPES['geometry_msgs/msg/Vector3'], map(float, twist)
    return TYPES['geometry_msgs/msg/Twist'](vector(linear, 0.0, 0.0), vector(0.0, 0.0, angular))


def odometry_message(stamp_ns, twist, pose=ORIGIN, child='base_link'):
    """Return the message of a (linear, angular) twist at an (x, y, yaw) pose."""
    x, y, yaw = map(float, pose)
    place = TYPES['geometry_msgs/msg/Pose'](
        TYPES['geometry_msgs/msg/Point'](x, y, 0.0),
        TYPES['geometry_msgs/msg/Quaternion'](0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)),
    )
    return TYPES['nav_msgs/msg/Odometry'](
        header(stamp_ns),
        child,
        TYPES['geometry_msgs/msg/PoseWithCovariance'](place, np.zeros(36)),
        TYPES['geometry_msgs/msg/TwistWithCovariance'](twist_message(twist), np.zeros(36)),
    )


def number(value):
    return TYPES['std_msgs/msg/Float64'](float(value))


def diagnostics(stamp_ns, name, level=0, text='', **values):
    """Return the diagnostics of one component."""
    entry = TYPES['diagnostic_msgs/msg/KeyValue']
    status = TYPES['diagnostic_msgs/msg/DiagnosticStatus'](
        level=level,
        name=name,
        message=text,
        hardware_id='',
        values=[entry(key=key, value=str(value)) for key, value in values.items()],
    )
    return TYPES['diagnostic_msgs/msg/DiagnosticArray'](header(stamp_ns), [status])
