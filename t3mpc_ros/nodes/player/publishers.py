# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One publisher per played topic, with its QoS and the rule against moving a robot."""

from collections.abc import Mapping
from dataclasses import dataclass
import time

from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.topic_endpoint_info import TopicEndpointInfo

from t3mpc_ros.bag.merged_reader import MergedReader, require_cdr
from t3mpc_ros.bag.player import VELOCITY_TYPES, velocity_command_risk
from t3mpc_ros.bag.qos import UNLIMITED, QosProfile, adapt_offer_to_recorded_offers
from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.common import introspection

CLOCK = '/clock'
ROBOT_NODES = ('radio_bridge', 'sim_robot')
"""Nodes of this package that move when a velocity comes."""
SHARED_TOPICS = ('/diagnostics', '/rosout', '/parameter_events', '/tf', '/tf_static')
"""Topics on which everybody publishes."""


@dataclass(frozen=True)
class PublishingRules:
    """What may be published, and how."""

    allow_commands: bool
    own_clock: bool
    """Whether the replayer tells the time itself."""
    overrides: Mapping[str, QosProfile]
    """Profiles by topic, recorded or new name."""


class TopicPublishers:
    """The publishers of a tape; topics that cannot or must not be published leave the tape.

    Parameters
    ----------
    node
        Whose publishers they are. Its own remapping counts: a topic is judged by the name under
        which it really comes.
    """

    def __init__(self, node: Node, tape: MergedReader, rules: PublishingRules) -> None:
        self._node = node
        self._allow_commands = rules.allow_commands
        self.by_topic: dict[str, Publisher] = {}
        self.left_out: dict[str, str] = {}
        """Why, by topic."""
        self.refused: dict[str, str] = {}
        """Those that would move a robot: why, by topic."""
        for topic in list(tape.tracks):
            try:
                if problem := self._danger(tape, topic):
                    self.refused[topic] = problem
                else:
                    self.by_topic[topic] = self._create(tape, topic, rules)
                    continue
            except (
                BagError,
                ImportError,
                NameValidationException,
                introspection.RCLError,
            ) as error:
                self.left_out[topic] = str(error)
            except ValueError as error:
                self.left_out[topic] = f'its type cannot be used: {error}'
            tape.exclude_topic(topic)

    def _danger(self, tape: MergedReader, topic: str) -> str:
        if self._allow_commands:
            return ''
        name = self._node.resolve_topic_name(topic)
        type_name = tape.tracks[topic].type_name
        problems = (velocity_command_risk(old, name, type_name) for old in tape.recorded[topic])
        return next(filter(None, problems), '')

    def _create(self, tape: MergedReader, topic: str, rules: PublishingRules) -> Publisher:
        track = tape.tracks[topic]
        require_cdr(track)
        if rules.own_clock and self._node.resolve_topic_name(topic) == CLOCK:
            raise BagError('the replayer tells the time itself (clock_rate)')
        names = [topic, *tape.recorded[topic]]
        override = next((rules.overrides[n] for n in names if n in rules.overrides), None)
        offer = override or adapt_offer_to_recorded_offers(track.profiles)
        message = introspection.message_class(track.type_name)
        return self._node.create_publisher(message, topic, qos_profile(offer))

    def heard(self) -> bool:
        """Return whether every topic has somebody who listens."""
        return all(each.get_subscription_count() for each in self.by_topic.values())

    def driven(self) -> dict[str, str]:
        """Return which robot listens to a velocity that must not move one, by topic."""
        found = {}
        for topic, publisher in self.by_topic.items():
            if (
                self._allow_commands
                or introspection.type_name(publisher.msg_type) not in VELOCITY_TYPES
            ):
                continue
            for info in self._node.get_subscriptions_info_by_topic(publisher.topic_name):
                if info.node_name in ROBOT_NODES:
                    found[topic] = _full_name(info)
        return found

    def rivals(self) -> dict[str, str]:
        """Return who else publishes on a topic of ours, by topic."""
        found = {}
        own = self._node.get_fully_qualified_name()
        for topic, publisher in self.by_topic.items():
            if publisher.topic_name in SHARED_TOPICS:
                continue
            for info in self._node.get_publishers_info_by_topic(publisher.topic_name):
                if _full_name(info) != own:
                    found[topic] = _full_name(info)
        return found

    def flush(self, seconds: float) -> None:
        """Wait, at most so long, until listeners have what was published reliably."""
        end = time.monotonic() + seconds  # not the node's time, which may stand still
        for publisher in self.by_topic.values():
            left = end - time.monotonic()
            if left <= 0.0:
                return
            publisher.wait_for_all_acked(Duration(nanoseconds=round(left * NANOSECONDS)))


def qos_profile(profile: QosProfile) -> QoSProfile:
    """Return a profile of the bag as rclpy takes it."""
    return QoSProfile(
        history=HistoryPolicy[profile.history.upper()],
        depth=profile.depth,
        reliability=ReliabilityPolicy[profile.reliability.upper()],
        durability=DurabilityPolicy[profile.durability.upper()],
        deadline=_duration(profile.deadline_ns),
        lifespan=_duration(profile.lifespan_ns),
        liveliness=LivelinessPolicy[profile.liveliness.upper()],
        liveliness_lease_duration=_duration(profile.liveliness_lease_ns),
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )


def _duration(nanoseconds: int) -> Duration:
    return Duration(nanoseconds=0 if nanoseconds == UNLIMITED else nanoseconds)  # 0: no limit


def _full_name(info: TopicEndpointInfo) -> str:
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'
