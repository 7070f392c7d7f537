# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What publishers offer, as data."""

from collections.abc import Sequence

from rclpy.qos import QoSProfile
from rclpy.topic_endpoint_info import TopicEndpointInfo

from t3mpc_ros.nodes.plumbing import quality
from t3mpc_ros.record.quality import QualityProfile
from t3mpc_ros.record.writing.message import Announcement


def announcement(
    topic: str, kind: str, publishers: Sequence[TopicEndpointInfo]
) -> tuple[Announcement, int]:
    """Return what a bag has to know of a topic, and how many of its publishers are latched."""
    profiles = tuple(_profile(info.qos_profile) for info in publishers)
    type_hash = str(publishers[-1].topic_type_hash) if publishers else None
    latched = sum(quality.is_latched(info.qos_profile) for info in publishers)
    return Announcement(topic, kind, profiles, type_hash), latched


def _profile(offered: QoSProfile) -> QualityProfile:
    return QualityProfile(
        history=offered.history.name.lower(),
        depth=offered.depth,
        reliability=offered.reliability.name.lower(),
        durability=offered.durability.name.lower(),
        deadline_ns=offered.deadline.nanoseconds,
        lifespan_ns=offered.lifespan.nanoseconds,
        liveliness=offered.liveliness.name.lower(),
        liveliness_lease_ns=offered.liveliness_lease_duration.nanoseconds,
        avoid_ros_namespace_conventions=offered.avoid_ros_namespace_conventions,
    )
