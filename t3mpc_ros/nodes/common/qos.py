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
"""Odometry and reference: every sample counts, and one second of them may pile up."""

CONTROLLER_INPUT = _profile(1000, DurabilityPolicy.TRANSIENT_LOCAL)
"""Reference and odometry as they are published: a recorder that finds them later than the
controller did must miss nothing that the controller knew, or the run cannot be computed again. On
a busy machine discovery has taken more than two seconds."""

COMMAND = _profile(50)
"""Published commands: kept long enough for a recorder to get each one."""

LATEST = _profile(1)
"""Commands as the robot takes them: the newest wins, nothing is queued."""

SCALARS = _profile(20)
"""Plain numbers for plot tools."""

LATCHED = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""What a late subscriber should still see."""

JOURNAL = _profile(1000, DurabilityPolicy.TRANSIENT_LOCAL)
"""The journal of the controller: a recorder that is slow to find it misses nothing of 10 s."""

PARAMETER_REVISIONS = _profile(20, DurabilityPolicy.TRANSIENT_LOCAL)
"""Settings of the controller as they change: the journal speaks of each of them."""

DIAGNOSTICS = _profile(10)
"""Health of the nodes."""

RECORDER = _profile(1000)
"""A topic as the recorder takes it: so much may wait while the disk is busy."""

RECORDER_LATCHED = _profile(RECORDER.depth, DurabilityPolicy.TRANSIENT_LOCAL)
"""The same of a topic whose publishers keep what was said before they were found."""


def is_transient_local(profile: QoSProfile) -> bool:
    """Whether it is about messages that late subscribers still get."""
    return bool(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)


def compatible_with_all(subscription: QoSProfile, publishers: Sequence[QoSProfile]) -> bool:
    """Whether a subscription hears every publisher: none of them offers less than it asks for."""
    return all(
        qos_check_compatible(offered, subscription)[0] != QoSCompatibility.ERROR
        for offered in publishers
    )


def adapt_request_to_offers(publishers: Sequence[QoSProfile]) -> QoSProfile:
    """Return the best profile for the recorder's subscription that hears every publisher."""
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
    return QoSProfile(
        depth=RECORDER.depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
