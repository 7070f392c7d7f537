# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Raw subscriptions polled by a timer, topic discovery and QoS adaptation of the recorder."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import (
    QoSSubscriptionEventType,
    SubscriptionEventCallbacks,
    UnsupportedEventTypeError,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from t3mpc_ros.bag.qos import QosProfile
from t3mpc_ros.bag.topic_filter import TopicFilter
from t3mpc_ros.bag.writer import SerializedMessage, TopicMetadata
from t3mpc_ros.nodes.common import introspection, qos

_RECEIVE_TIME = attrgetter('received_ns')


class PolledCallbackGroup(CallbackGroup):
    """A callback group whose entities the executor leaves alone."""

    def can_execute(self, entity: object) -> bool:
        """Return False: the executor does not even wait for the entity."""
        return False

    def beginning_execution(self, entity: object) -> bool:
        """Return False: the executor may not run the entity."""
        return False

    def ending_execution(self, entity: object) -> None:
        """Nothing has been executed."""


@dataclass
class RawSubscription:
    """How one topic is listened to."""

    kind: str
    quality: QoSProfile
    subscription: Subscription
    lost_event: Any
    """Handle of the message-lost event, None where the middleware has none."""
    sequence: int | None = None
    """Number that the publisher gave the last message."""


class RawSubscriptions:
    """The subscriptions of a recorder.

    Parameters
    ----------
    node
        Whose they are.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = PolledCallbackGroup()
        self._ears: dict[str, RawSubscription] = {}
        self._lost: dict[str, int] = {}

    @property
    def lost(self) -> dict[str, int]:
        """Messages of each topic that the middleware has lost, as of :meth:`count_lost`."""
        return dict(self._lost)

    def ear(self, topic: str) -> RawSubscription | None:
        """Return how ``topic`` is listened to, None when it is not."""
        return self._ears.get(topic)

    def kind(self, topic: str) -> str:
        """Return the type in which ``topic`` is listened to."""
        return self._ears[topic].kind

    def listen(self, topic: str, kind: str, profile: QoSProfile) -> None:
        """Listen to ``topic``, in a new way if it was listened to before.

        Raises
        ------
        ImportError
            The type is not installed.
        RCLError
            This process knows the topic with another type.
        """
        message = introspection.message_class(kind)
        self.stop(topic)
        subscription = self._node.create_subscription(
            message,
            topic,
            _unused_callback,
            profile,
            callback_group=self._group,
            # Offers that do not fit are looked for in the graph, and the profile is changed.
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            raw=True,
        )
        self._ears[topic] = RawSubscription(kind, profile, subscription, _lost_event(subscription))

    def stop(self, topic: str) -> None:
        """Listen to ``topic`` no longer; what has come and was not taken is lost."""
        if ear := self._ears.pop(topic, None):
            self._count_lost(topic, ear)
            if ear.lost_event is not None:
                ear.lost_event.destroy_when_not_in_use()
            self._node.destroy_subscription(ear.subscription)

    def close(self) -> None:
        """Listen to nothing any longer."""
        for topic in list(self._ears):
            self.stop(topic)

    def take(self) -> list[SerializedMessage]:
        """Return all that has come since the last time, in order of receipt."""
        found: list[SerializedMessage] = []
        for topic, ear in self._ears.items():
            subscription = ear.subscription
            handle, kind = subscription.handle, subscription.msg_type
            before = len(found)
            with handle:
                while (item := handle.take_message(kind, True)) is not None:
                    data, info = item
                    sequence = info['publication_sequence_number']
                    if len(found) == before:
                        first = sequence
                    found.append(
                        SerializedMessage(
                            topic,
                            info['received_timestamp'],
                            max(0, info['source_timestamp']),  # a stranger may say anything
                            data,
                        )
                    )
            if (count := len(found) - before) == 0:
                continue
            if count >= ear.quality.depth:
                self._lose(topic, self._fallen_out(ear, first))
            ear.sequence = sequence
        found.sort(key=_RECEIVE_TIME)
        return found

    def count_lost(self) -> None:
        """Ask the middleware what it has lost since the last time."""
        for topic, ear in self._ears.items():
            self._count_lost(topic, ear)

    def _count_lost(self, topic: str, ear: RawSubscription) -> None:
        if ear.lost_event is not None:
            with ear.lost_event:
                self._lose(topic, ear.lost_event.take_event().total_count_change)

    def _lose(self, topic: str, count: int) -> None:
        if count > 0:
            self._lost[topic] = self._lost.get(topic, 0) + count

    @staticmethod
    def _fallen_out(ear: RawSubscription, first: int | None) -> int:
        """Return how many messages a full queue has lost; 1 where nobody can tell."""
        if ear.sequence is None or first is None or ear.subscription.get_publisher_count() != 1:
            return 1  # each publisher counts for itself, and does not say which one it is
        return max(0, first - ear.sequence - 1)


def _lost_event(subscription: Subscription) -> Any:
    try:
        with subscription.handle:
            return rclpy_implementation.EventHandle(
                subscription.handle, QoSSubscriptionEventType.RCL_SUBSCRIPTION_MESSAGE_LOST
            )
    except UnsupportedEventTypeError:
        return None


def _unused_callback(data: bytes) -> None:
    """Stand where rclpy wants a callback."""


def offered_qos(
    topic: str, kind: str, publishers: Sequence[TopicEndpointInfo]
) -> tuple[TopicMetadata, int]:
    """Return what a bag has to know of a topic, and how many of its publishers are latched."""
    profiles = tuple(_qos_profile(info.qos_profile) for info in publishers)
    type_hash = str(publishers[-1].topic_type_hash) if publishers else None
    latched = sum(qos.is_transient_local(info.qos_profile) for info in publishers)
    return TopicMetadata(topic, kind, profiles, type_hash), latched


def _qos_profile(offered: QoSProfile) -> QosProfile:
    return QosProfile(
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


EXPECTED_TOPICS = {
    'reference': 'nav_msgs/msg/Odometry',
    'odom': 'nav_msgs/msg/Odometry',
    'ground_truth/odom': 'nav_msgs/msg/Odometry',
    'cmd_vel': 'geometry_msgs/msg/Twist',
    'controller/journal': 'std_msgs/msg/Int64MultiArray',
}
"""Topics subscribed to before anybody publishes them, so that their first message is kept."""
LATCHED_TOPICS = ('reference', 'odom', 'controller/journal')
"""Those of them whose publishers, ours, keep what they have said. A recorder that finds them a
moment after the controller did would otherwise lose what the run cannot be computed again from."""


class TopicDiscovery:
    """Decides which topics the ears are at, and with what quality of service.

    Parameters
    ----------
    node
        Who looks around in the graph.
    selection
        What is wanted.
    ears
        Those that listen.
    take
        Takes in what has been heard so far, before a topic is listened to in another way.
    recorded
        Whether something of a topic has been recorded already.
    """

    def __init__(
        self,
        node: Node,
        selection: TopicFilter,
        ears: RawSubscriptions,
        take: Callable[[], None],
        recorded: Callable[[str], bool],
    ) -> None:
        self._node = node
        self._selection = selection
        self._ears = ears
        self._take = take
        self._recorded = recorded
        self.left_out: set[str] = set()
        """Topics that are wanted and cannot be recorded."""

    def expect(self) -> None:
        """Listen to what will be there sooner or later."""
        for name, kind in EXPECTED_TOPICS.items():
            topic = self._node.resolve_topic_name(name)
            if not self._selection.matches(topic, [kind]):
                continue
            try:
                latched = name in LATCHED_TOPICS
                self._ears.listen(topic, kind, qos.RECORDER_LATCHED if latched else qos.RECORDER)
            except introspection.RCLError:
                # A node of this process has it with another type: the publisher will tell.
                continue

    def discover(self) -> None:
        """Listen to what is published and wanted."""
        for topic, kinds in self._node.get_topic_names_and_types():
            if topic in self.left_out or not self._selection.matches(topic, kinds):
                continue
            if publishers := self._node.get_publishers_info_by_topic(topic):
                self._attend(topic, publishers)

    def leave_out(self, topic: str, why: str) -> None:
        """Listen to a topic no longer, and say so."""
        self._ears.stop(topic)
        self.left_out.add(topic)
        self._node.get_logger().warning(f'{topic} is not recorded: {why}')

    def _attend(self, topic: str, publishers: Sequence[TopicEndpointInfo]) -> None:
        kinds = [info.topic_type for info in publishers]
        profiles = [info.qos_profile for info in publishers]
        held = self._ears.ear(topic)
        wanted = qos.adapt_request_to_offers(profiles)
        if held and held.kind in kinds:
            # What was latched before this recorder came is heard only by those who ask for it;
            # once something was recorded, asking would bring it twice.
            missed = qos.is_transient_local(wanted) and not qos.is_transient_local(held.quality)
            if qos.compatible_with_all(held.quality, profiles) and (
                not missed or self._recorded(topic)
            ):
                return
        kind = held.kind if held and held.kind in kinds else kinds[0]
        self._take()  # what was heard the old way is kept
        try:
            self._ears.listen(topic, kind, wanted)
        except (ImportError, introspection.RCLError) as error:
            self.leave_out(topic, str(error))
