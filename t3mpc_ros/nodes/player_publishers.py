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
"""Publishers of the player, with their QoS, and the thread that publishes when it is due.

Velocity commands are excluded by default. A cycle of the rclpy executor takes half a millisecond
and more; a thread of its own wakes up without that delay.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import os
import threading
import time
from typing import Any

from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rosgraph_msgs.msg import Clock

from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.player import (
    VELOCITY_TYPES,
    DueMessage,
    MergedReader,
    PlaybackTimeline,
    velocity_command_risk,
)
from t3mpc_ros.bag.qos import UNLIMITED, QosProfile, adapt_offer_to_recorded_offers
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import ros_messages
from t3mpc_ros.nodes.base_node import BaseNode
from t3mpc_ros.nodes.topic_endpoints import RCLError, node_of

CLOCK = '/clock'
ROBOT_NODES = ('radio_bridge', 'sim_robot')
"""Nodes of this package that execute velocity commands."""
SHARED_TOPICS = ('/diagnostics', '/rosout', '/parameter_events', '/tf', '/tf_static')
"""Topics with several publishers in every graph."""


class TopicPublishers:
    """The publishers of a player's topics; other topics are excluded from the reader.

    The rule on velocity commands applies to the names after the remapping of the node.
    ``qos_overrides`` are by topic, under the recorded or the new name.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        reader: MergedReader,
        qos_overrides: Mapping[str, QosProfile],
    ) -> None:
        self._node = node
        self._allow_commands = node.parameters.allow_commands
        self._qos_overrides = qos_overrides
        self.by_topic: dict[str, Publisher] = {}
        self.unusable: dict[str, str] = {}
        """Reasons by topic that cannot be published."""
        self.blocked: dict[str, str] = {}
        """Reasons by topic that is not published because it could move a robot."""
        for topic in list(reader.topics):
            try:
                if problem := self._velocity_risk(reader, topic):
                    self.blocked[topic] = problem
                else:
                    self.by_topic[topic] = self._create(reader, topic)
                    continue
            except (BagError, ImportError, NameValidationException, RCLError) as error:
                self.unusable[topic] = str(error)
            except ValueError as error:
                self.unusable[topic] = f'its type is unusable: {error}'
            reader.exclude_topic(topic)

    def _velocity_risk(self, reader: MergedReader, topic: str) -> str:
        if self._allow_commands:
            return ''
        name = self._node.resolve_topic_name(topic)
        type_name = reader.topics[topic].type_name
        problems = (
            velocity_command_risk(old, name, type_name) for old in reader.recorded_names[topic]
        )
        return next(filter(None, problems), '')

    def _create(self, reader: MergedReader, topic: str) -> Publisher:
        track = reader.topics[topic]
        if track.serialization_format != 'cdr':
            raise BagError(f'its messages are {track.serialization_format}, not cdr')
        if self._node.parameters.publishes_clock and self._node.resolve_topic_name(topic) == CLOCK:
            raise BagError('the player publishes its own clock (play.clock_publish_frequency)')
        names = [topic, *reader.recorded_names[topic]]
        overrides = [self._qos_overrides[name] for name in names if name in self._qos_overrides]
        offer = (*overrides, adapt_offer_to_recorded_offers(track.offered_qos_profiles))[0]
        message = ros_messages.message_class(track.type_name)
        return self._node.create_publisher(message, topic, qos_profile(offer))

    def all_subscribed(self) -> bool:
        """Return whether every topic has a subscriber."""
        return all(each.get_subscription_count() for each in self.by_topic.values())

    def subscribed_robots(self) -> dict[str, str]:
        """Return the robots that subscribe to a blocked velocity under another name, by topic."""
        found = {}
        for topic, publisher in self.by_topic.items():
            if (
                self._allow_commands
                or ros_messages.type_name(publisher.msg_type) not in VELOCITY_TYPES
            ):
                continue
            for info in self._node.get_subscriptions_info_by_topic(publisher.topic_name):
                if info.node_name in ROBOT_NODES:
                    found[topic] = node_of(info)
        return found

    def other_publishers(self) -> dict[str, str]:
        """Return another node that publishes a played topic, by topic."""
        found = {}
        own = self._node.get_fully_qualified_name()
        for topic, publisher in self.by_topic.items():
            if publisher.topic_name in SHARED_TOPICS:
                continue
            for info in self._node.get_publishers_info_by_topic(publisher.topic_name):
                if node_of(info) != own:
                    found[topic] = node_of(info)
        return found

    def wait_for_acked(self, timeout: float) -> None:
        """Wait, at most ``timeout`` seconds, until reliable subscribers have all messages."""
        end = time.monotonic() + timeout  # the node's time may be paused
        for publisher in self.by_topic.values():
            remaining = end - time.monotonic()
            if remaining <= 0.0:
                return
            publisher.wait_for_all_acked(Duration(nanoseconds=round(remaining * NANOSECONDS)))


def qos_profile(profile: QosProfile) -> QoSProfile:
    """Return a QoS profile of a bag as one of rclpy."""
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
    return Duration(nanoseconds=0 if nanoseconds == UNLIMITED else nanoseconds)  # 0: unlimited


@dataclass(frozen=True)
class PlaybackStatus:
    """Position and state of a playback."""

    stamp_ns: int
    remaining_ns: int
    loops: int
    rate: float
    paused: bool
    finished: bool

    @property
    def state(self) -> str:
        """``playing``, ``paused`` or ``finished``."""
        return 'finished' if self.finished else 'paused' if self.paused else 'playing'


class PlayerThread:
    """Publishes the due messages of a playback timeline.

    Without ``clock`` the time of the bag is not published; with ``clock_with_messages`` it is
    before each message, too. ``priority`` is that of SCHED_FIFO, 0 = none.
    """

    def __init__(
        self,
        timeline: PlaybackTimeline,
        publishers: Mapping[str, Publisher],
        clock: Publisher | None,
        clock_with_messages: bool,
        priority: int = 0,
    ) -> None:
        self._timeline = timeline
        self._publishers = dict(publishers)
        self._clock = clock
        self._clock_with_messages = clock_with_messages
        self._priority = priority
        self.priority_problem = ''
        """Why the operating system does not grant the priority."""
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name='player', daemon=True)
        self.latency_max_ns = 0
        """Largest time from the due time of a message to its publication."""
        self.published = 0
        self.failure = ''
        """Why playback has ended early; empty if it has not."""

    def start(self) -> None:
        """Start publishing."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the bag; idempotent."""
        self._closing = True
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()
        self._timeline.close()

    def control(self, action: Callable[[PlaybackTimeline, int], str | None]) -> str:
        """Apply an action to the timeline at the present time; return its problem, or nothing."""
        with self._lock:
            problem = action(self._timeline, time.monotonic_ns())
        self._wake.set()
        return problem or ''

    def disable(self, topic: str) -> None:
        """Stop publishing a topic."""
        with self._lock:
            self._publishers.pop(topic, None)

    def status(self) -> PlaybackStatus:
        """Return position and state of the playback."""
        with self._lock:
            now_ns, timeline = time.monotonic_ns(), self._timeline
            return PlaybackStatus(
                timeline.bag_time_ns(now_ns),
                timeline.remaining_ns(now_ns),
                timeline.loops(now_ns),
                timeline.rate,
                timeline.paused,
                timeline.finished,
            )

    def _set_priority(self) -> None:
        try:
            # Process number 0 is the calling thread.
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(self._priority))
        except OSError as error:
            self.priority_problem = str(error.strerror)

    def _run(self) -> None:
        if self._priority:
            self._set_priority()
        try:
            while not self._closing:
                self._wake.clear()
                with self._lock:
                    due, wake_ns = self._timeline.due_messages(time.monotonic_ns())
                for item in due:
                    self._publish(item)
                if wake_ns is None:
                    self._wake.wait()
                elif (wait_ns := wake_ns - time.monotonic_ns()) > 0:
                    self._wake.wait(wait_ns / NANOSECONDS)
        except Exception as error:  # a silent thread would look like a bag without messages
            self.failure = str(error) or type(error).__name__

    def _publish(self, due: DueMessage) -> None:
        message = due.message
        if self._clock is not None and (message is None or self._clock_with_messages):
            self._clock.publish(Clock(clock=ros_messages.time_from_ns(due.stamp_ns)))
        if message is None:
            return
        publisher = self._publishers.get(message.topic)
        if publisher is not None:
            self.latency_max_ns = max(self.latency_max_ns, time.monotonic_ns() - due.due_ns)
            publisher.publish(message.data)
            self.published += 1
