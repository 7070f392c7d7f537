# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Quality of service of every topic, in one place."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def _profile(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


STREAM = _profile(100)
"""Odometry and reference: every sample counts, and one second of them may pile up."""

COMMAND = _profile(50)
"""Published commands: kept long enough for a recorder to get each one."""

NEWEST = _profile(1)
"""Commands as the robot takes them: the newest wins, nothing is queued."""

SCALARS = _profile(20)
"""Plain numbers for plot tools."""

LATCHED = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""What a late subscriber should still see."""

DIAGNOSTICS = _profile(10)
"""Health of the nodes."""
