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
"""Bags of robots, as any recorder writes them."""

import math

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from support.bag_messages import START, STORE, odometry_message, serialised, twist_message
from t3mpc_ros.bag.writer import BagWriter


def write(folder, rows, plugin=StoragePlugin.MCAP):
    """Write rows of (receipt in s, topic, message) in their order."""
    writer = Writer(folder, version=8, storage_plugin=plugin)
    writer.open()
    connections = {}
    for received, topic, message in rows:
        kind = message.__msgtype__
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
        writer.write(connections[topic], START + round(received * 1e9), serialised(message))
    writer.close()
    return folder


def write_with_records(folder, rows, records, empty=()):
    """Write rows beside metadata records, with the topics ``empty`` (name, type) besides."""
    with BagWriter(folder, metadata_records=records) as bag:
        kinds = {topic: message.__msgtype__ for _, topic, message in rows}
        for topic, kind in {**dict(empty), **kinds}.items():
            bag.add_topic(topic, kind)
        for received, topic, message in sorted(rows, key=lambda row: row[0]):
            stamp = START + round(received * 1e9)
            bag.write(topic, stamp, stamp, serialised(message))
    return folder


def following_rows(duration=16.0, rate=50.0, offset=0.02, pose=(0.0, 0.0, 0.0), frame='base_link'):
    """Return the rows of a robot whose speed is that of its reference but for ``offset``, m/s.

    The offset is a number, or a function of time.
    """
    rows, (x, y, yaw) = [], pose
    for t in np.arange(1, round(duration * rate)) / rate:
        v, w = 0.2 + 0.05 * math.sin(1.3 * t), 0.5 * math.sin(0.7 * t)
        x, y = x + v * math.cos(yaw) / rate, y + v * math.sin(yaw) / rate
        yaw += w / rate
        stamp = START + round(t * 1e9)
        error = offset(t) if callable(offset) else offset
        rows += [
            (t - 0.001, '/reference', odometry_message(stamp, (v, w))),
            (t + 0.001, '/odom', odometry_message(stamp, (v + error, w), (x, y, yaw), frame)),
            (t + 0.002, '/cmd_vel', twist_message((v, w))),
        ]
    return rows
