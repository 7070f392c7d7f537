# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""QoS profiles of all topics, and QoS compatibility of subscriptions with offers."""

from collections.abc import Sequence

from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)


def _profile(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


STREAM = _profile(100)
"""Odometry, reference and sensors: every sample counts; one second of them is queued."""

INITIAL_INPUTS = _profile(1000, DurabilityPolicy.TRANSIENT_LOCAL)
"""First inputs of the controller, 10 s at 100 Hz, for a recorder that discovers it late."""

COMMAND = _profile(50)
"""Published commands, queued until a recorder has received each of them."""

LATEST = _profile(1)
"""Commands received by a robot, and /clock: only the latest message counts."""

SCALARS = _profile(20)
"""Scalars for plot tools, joint states and slow sensors."""

LATCHED = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""Topics whose last message late subscribers receive."""

JOURNAL = _profile(1000, DurabilityPolicy.TRANSIENT_LOCAL)
"""Journal of the controller, with the last 10 s for a recorder that discovers it late."""

PARAMETER_REVISIONS = _profile(20, DurabilityPolicy.TRANSIENT_LOCAL)
"""Revisions of the controller's parameters, to which the journal refers."""

DIAGNOSTICS = _profile(10)
"""Diagnostics."""

RECORDER = _profile(1000)
"""Subscriptions of the recorder, with a queue for times when the disk is busy."""

RECORDER_LATCHED = _profile(RECORDER.depth, DurabilityPolicy.TRANSIENT_LOCAL)
"""Subscriptions of the recorder to topics with transient-local publishers."""


def is_transient_local(profile: QoSProfile) -> bool:
    """Return whether late subscribers receive earlier messages."""
    return bool(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)


def compatible_with_all(subscription: QoSProfile, publishers: Sequence[QoSProfile]) -> bool:
    """Return whether the offers of all publishers satisfy the request of a subscription."""
    return all(
        qos_check_compatible(offered, subscription)[0] != QoSCompatibility.ERROR
        for offered in publishers
    )


def adapt_request_to_offers(publishers: Sequence[QoSProfile]) -> QoSProfile:
    """Return the strictest request for the recorder that all offers satisfy."""
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
    return QoSProfile(
        depth=RECORDER.depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
