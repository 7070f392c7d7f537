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
"""Subscriptions of the recorder: topic discovery, adapted QoS, polled raw messages, and lost ones.

The executor of rclpy builds a wait set with all entities of the node for each message that it
delivers; at 2000 messages per second this alone takes more than one core. The callback group of
the raw subscriptions therefore never becomes ready, and a timer takes all queued messages with the
call that the executor uses: ``subscription.handle.take_message(type, raw)`` (rclpy 7.1,
``Executor._take_subscription``). Polling does not affect the stamps: the middleware stores the
times of reception and publication with each message.

A reader with KEEP_LAST replaces its oldest samples when its queue is full, which DDS does not
report as lost. The sequence numbers of the publisher reveal these losses. Losses in transport are
reported by the message-lost event, which is polled, too. A volatile publisher keeps nothing for
the time until it and the recorder have discovered each other, which takes up to seconds on a busy
machine: the sequence number of the first message received is one more than their number.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from rclpy.event_handler import QoSSubscriptionEventType, UnsupportedEventTypeError
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from t3mpc_ros.bag.mcap_file import RECEIVE_TIME, SerializedMessage
from t3mpc_ros.bag.metadata_yaml import TopicInformation
from t3mpc_ros.bag.qos import QosProfile
from t3mpc_ros.bag.topic_filter import TopicFilter
from t3mpc_ros.nodes import ros_messages, topic_endpoints
from t3mpc_ros.nodes.topic_endpoints import PolledCallbackGroup, unused_callback

_ODOMETRY = 'nav_msgs/msg/Odometry'

EXPECTED_TOPICS = {
    'reference': (_ODOMETRY, topic_endpoints.RECORDER),
    'odom': (_ODOMETRY, topic_endpoints.RECORDER),
    'ground_truth/odom': (_ODOMETRY, topic_endpoints.RECORDER),
    'cmd_vel': ('geometry_msgs/msg/Twist', topic_endpoints.RECORDER),
    'controller/journal': ('std_msgs/msg/Int64MultiArray', topic_endpoints.RECORDER_LATCHED),
    'controller/initial_inputs/reference': (_ODOMETRY, topic_endpoints.RECORDER_LATCHED),
    'controller/initial_inputs/odom': (_ODOMETRY, topic_endpoints.RECORDER_LATCHED),
}
"""Types and requests of topics subscribed to before they are published, to record the first
message. Of transient-local publishers the messages from before discovery, without which a run
cannot be replayed, are received, too."""

FULL_DISCOVERY = 10
"""Calls of :meth:`TopicSubscriptions.discover` after which all publishers are queried again."""


@dataclass
class RawSubscription:
    """A subscription to serialized messages, with what is known about its losses."""

    type_name: str
    qos: QoSProfile
    subscription: Subscription
    lost_event: Any
    """Handle of the message-lost event; None if the middleware has none."""
    sequence: int | None = None
    """Publication sequence number of the last message."""
    received: bool = False
    """Whether there was a message of the topic."""


class TopicSubscriptions:
    """Raw subscriptions to the selected topics of the graph, with a QoS that fits all publishers.

    ``record`` is called before a subscription is replaced, so that no received message is lost.
    """

    def __init__(self, node: Node, topic_filter: TopicFilter, record: Callable[[], None]) -> None:
        self.lost: Counter[str] = Counter()
        """Lost messages by topic, up to the last :meth:`count_lost`."""
        self.undiscovered: Counter[str] = Counter()
        """Messages by topic that were published before their publisher was discovered."""
        self.excluded: set[str] = set()
        """Selected topics that cannot be recorded."""
        self._node = node
        self._topic_filter = topic_filter
        self._record = record
        self._group = PolledCallbackGroup()
        self._subscriptions: dict[str, RawSubscription] = {}
        self._calls = 0
        self._publisher_counts: dict[str, int] = {}

    # -- discovery --------------------------------------------------------------------------------

    def subscribe_expected(self) -> None:
        """Subscribe to the expected topics before they are published."""
        for name, (type_name, profile) in EXPECTED_TOPICS.items():
            topic = self._node.resolve_topic_name(name)
            if self._topic_filter.matches(topic, [type_name]):
                # A node of this process may use another type; discovery finds its publisher.
                with suppress(topic_endpoints.RCLError):
                    self._subscribe(topic, type_name, profile)

    def discover(self) -> None:
        """Subscribe to the selected topics that have publishers.

        The publishers of a topic are queried when their number changes, and at each
        :data:`FULL_DISCOVERY`-th call: for all topics the query takes most of the processor time
        of the recorder.
        """
        self._calls += 1
        if self._calls % FULL_DISCOVERY == 0:
            self._publisher_counts.clear()
        for topic, type_names in self._node.get_topic_names_and_types():
            if topic in self.excluded:
                continue
            count = self._node.count_publishers(topic)
            if self._publisher_counts.get(topic) == count:
                continue
            self._publisher_counts[topic] = count
            if not count or not self._topic_filter.matches(topic, type_names):
                continue
            if publishers := self._node.get_publishers_info_by_topic(topic):
                self._adapt(topic, publishers)

    def exclude(self, topic: str, reason: str) -> None:
        """Stop recording a topic, with a warning."""
        self._unsubscribe(topic)
        self.excluded.add(topic)
        self._node.get_logger().warning(f'{topic} is not recorded: {reason}')

    def _adapt(self, topic: str, publishers: Sequence[TopicEndpointInfo]) -> None:
        """Subscribe again if type or QoS of the subscription do not fit the publishers."""
        type_names = [info.topic_type for info in publishers]
        profiles = [info.qos_profile for info in publishers]
        held = self._subscriptions.get(topic)
        request = topic_endpoints.adapt_request_to_offers(profiles)
        type_name = type_names[0]
        if held and held.type_name in type_names:
            type_name = held.type_name
            # Only a transient-local subscription receives messages from before discovery; after
            # the first recorded message a new one would receive them twice.
            lacks_history = topic_endpoints.is_transient_local(
                request
            ) and not topic_endpoints.is_transient_local(held.qos)
            if topic_endpoints.compatible_with_all(held.qos, profiles) and (
                not lacks_history or held.received
            ):
                return
        self._record()
        try:
            self._subscribe(topic, type_name, request)
        except (ImportError, topic_endpoints.RCLError) as error:
            self.exclude(topic, str(error))

    def _subscribe(self, topic: str, type_name: str, profile: QoSProfile) -> None:
        """Subscribe to a topic, in place of the former subscription to it.

        Raises ImportError without the message type, RCLError if this process uses another one.
        """
        message = ros_messages.message_class(type_name)
        replaced = self._subscriptions.get(topic)
        self._unsubscribe(topic)
        subscription = self._node.create_subscription(
            message, topic, unused_callback, profile, callback_group=self._group, raw=True
        )
        made = RawSubscription(type_name, profile, subscription, _lost_event(subscription))
        if replaced:
            made.sequence, made.received = replaced.sequence, replaced.received
        self._subscriptions[topic] = made

    def _unsubscribe(self, topic: str) -> None:
        """Destroy the subscription to a topic with the messages still in its queue."""
        if held := self._subscriptions.pop(topic, None):
            self._count_lost(topic, held)
            if held.lost_event is not None:
                held.lost_event.destroy_when_not_in_use()
            self._node.destroy_subscription(held.subscription)

    def close(self) -> None:
        """Destroy all subscriptions."""
        for topic in list(self._subscriptions):
            self._unsubscribe(topic)

    # -- messages ---------------------------------------------------------------------------------

    def type_name(self, topic: str) -> str:
        """Return the message type of the subscription to a topic."""
        return self._subscriptions[topic].type_name

    def take_messages(self) -> list[SerializedMessage]:
        """Return the messages received since the last call, in order of reception."""
        found: list[SerializedMessage] = []
        for topic, held in self._subscriptions.items():
            handle, message_type = held.subscription.handle, held.subscription.msg_type
            before = len(found)
            with handle:
                while (item := handle.take_message(message_type, True)) is not None:
                    data, info = item
                    sequence = info['publication_sequence_number']
                    if len(found) == before:
                        first = sequence
                    found.append(
                        SerializedMessage(
                            topic,
                            info['received_timestamp'],
                            max(0, info['source_timestamp']),  # a foreign publisher sets it
                            data,
                        )
                    )
            if (count := len(found) - before) == 0:
                continue
            if count >= held.qos.depth:
                self._add_lost(topic, _replaced(held, first))
            self._count_undiscovered(topic, held, first)
            held.sequence, held.received = sequence, True
        found.sort(key=RECEIVE_TIME)
        return found

    def count_lost(self) -> None:
        """Update the counters from the message-lost events."""
        for topic, held in self._subscriptions.items():
            self._count_lost(topic, held)

    def _count_lost(self, topic: str, held: RawSubscription) -> None:
        if held.lost_event is not None:
            with held.lost_event:
                self._add_lost(topic, held.lost_event.take_event().total_count_change)

    def _add_lost(self, topic: str, count: int) -> None:
        if count > 0:
            self.lost[topic] += count

    def _count_undiscovered(self, topic: str, held: RawSubscription, first: int | None) -> None:
        """Count what was published before the first message of a new publisher.

        Only one publisher at a time can be counted: each has its own sequence, and a message does
        not identify it.
        """
        is_new = held.sequence is None or (first is not None and first <= held.sequence)
        if is_new and first and first > 1 and held.subscription.get_publisher_count() <= 1:
            self.undiscovered[topic] += first - 1


def _replaced(held: RawSubscription, first: int | None) -> int:
    """Return the number of messages replaced in a full queue; 1 if it cannot be determined."""
    if held.sequence is None or first is None or held.subscription.get_publisher_count() != 1:
        return 1  # each publisher has its own sequence, and a message does not identify it
    return max(0, first - held.sequence - 1)


def topic_information(
    topic: str, type_name: str, publishers: Sequence[TopicEndpointInfo]
) -> TopicInformation:
    """Return the metadata of a topic for the bag."""
    profiles = tuple(
        QosProfile.from_object(info.qos_profile, attrgetter('nanoseconds')) for info in publishers
    )
    type_hash = str(publishers[-1].topic_type_hash) if publishers else ''
    return TopicInformation(topic, type_name, profiles, type_hash)


def _lost_event(subscription: Subscription) -> Any:
    try:
        with subscription.handle:
            return rclpy_implementation.EventHandle(
                subscription.handle, QoSSubscriptionEventType.RCL_SUBSCRIPTION_MESSAGE_LOST
            )
    except UnsupportedEventTypeError:
        return None
