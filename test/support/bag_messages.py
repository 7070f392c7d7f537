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

import math

import numpy as np
from rosbags.typesys import Stores, get_typestore

from t3mpc_ros.geometry.types import ORIGIN

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
START = 1_700_000_000_000_000_000


def serialised(message):
    """Return a message in CDR."""
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


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
