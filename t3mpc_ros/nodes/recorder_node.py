# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros recorder``: writes topics into an MCAP bag, bytes as they came."""

from collections.abc import Callable, Mapping
from datetime import datetime
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_srvs.srv import Trigger

from t3mpc_ros.nodes.plumbing import graph, quality
from t3mpc_ros.nodes.plumbing.package_node import ERROR, OK, PackageNode
from t3mpc_ros.nodes.tables import TABLES, RecorderSettings
from t3mpc_ros.record.quality import QualityProfile
from t3mpc_ros.record.schema import RecordError, UnknownTypeError
from t3mpc_ros.record.writer import BagWriter, DataError
from t3mpc_ros.settings.provenance import provenance

EXPECTED = {
    'reference': 'nav_msgs/msg/Odometry',
    'odom': 'nav_msgs/msg/Odometry',
    'ground_truth/odom': 'nav_msgs/msg/Odometry',
    'cmd_vel': 'geometry_msgs/msg/Twist',
}
"""Topics subscribed to before anybody publishes them, so that their first message is kept."""


class Listening(NamedTuple):
    """How a topic is listened to."""

    kind: str
    quality: QoSProfile
    subscription: Subscription


class RecorderNode(PackageNode[RecorderSettings]):
    """Subscribes to what is published under the wanted names and writes it down unopened."""

    def __init__(self, **given: Any) -> None:
        super().__init__('recorder', RecorderSettings, **given)
        self._folder = Path(
            self.settings.folder or f'bag_{datetime.now():%Y_%m_%d-%H_%M_%S}'
        ).resolve()
        self._details: dict[str, dict[str, str]] = {'provenance': provenance()}
        self._writer = self._open()
        self._wanted = [self.resolve_topic_name(name) for name in self._plain_names()]
        self._listening: dict[str, Listening] = {}
        self._left_out: set[str] = set()
        self._added: dict[str, str] = {}
        self._asked: set[str] = set()
        self._received = 0
        self._failure = ''
        for name, kind in EXPECTED.items():
            topic = self.resolve_topic_name(name)
            if self._is_wanted(topic):
                self._expect(topic, kind)
        self.create_service(Trigger, '~/split', self._on_split)
        self.every(0.2, self._discover)
        self.every(1.0, self._flush)
        self.get_logger().info(f'recording to {self._folder}')

    def _open(self) -> BagWriter:
        return BagWriter(
            self._folder, details=self._details, chunk_bytes=self.settings.chunk_bytes
        )

    def _plain_names(self) -> list[str]:
        # A name with a star is no topic name: resolve it as if the star were a letter.
        return [name for name in self.settings.topics if '*' not in name]

    def _is_wanted(self, topic: str) -> bool:
        namespace = self.get_namespace().rstrip('/')
        patterns = [
            name if name.startswith('/') else f'{namespace}/{name}'
            for name in self.settings.topics
        ]
        return topic in self._wanted or any(fnmatchcase(topic, pattern) for pattern in patterns)

    def _discover(self) -> None:
        for topic, _ in self.get_topic_names_and_types():
            if topic in self._left_out or not self._is_wanted(topic):
                continue
            if publishers := self.get_publishers_info_by_topic(topic):
                self._attend(topic, publishers)
        self._ask_for_settings()

    def _expect(self, topic: str, kind: str) -> None:
        try:
            self._listen(topic, kind, quality.RECORDED)
        except graph.RCLError:
            # A node of this process has it with another type: the publisher will tell.
            return

    def _attend(self, topic: str, publishers: list[TopicEndpointInfo]) -> None:
        """Listen to a topic in such a way that its publishers are heard."""
        kinds = [info.topic_type for info in publishers]
        profiles = [info.qos_profile for info in publishers]
        held = self._listening.get(topic)
        if held and held.kind in kinds and quality.hears_all(held.quality, profiles):
            return
        kind = held.kind if held and held.kind in kinds else kinds[0]
        try:
            self._listen(topic, kind, quality.to_hear_all(profiles))
        except (ImportError, graph.RCLError) as error:
            self._leave_out(topic, str(error))

    def _listen(self, topic: str, kind: str, profile: QoSProfile) -> None:
        message = graph.message_class(kind)
        self._stop_listening(topic)
        subscription = self.create_subscription(
            message, topic, self._taker(topic, kind), profile, raw=True
        )
        self._listening[topic] = Listening(kind, profile, subscription)

    def _stop_listening(self, topic: str) -> None:
        if held := self._listening.pop(topic, None):
            self.destroy_subscription(held.subscription)

    def _leave_out(self, topic: str, why: str) -> None:
        self._stop_listening(topic)
        self._left_out.add(topic)
        self.get_logger().warning(f'{topic} is not recorded: {why}')

    def _taker(self, topic: str, kind: str) -> Callable[[bytes, Mapping[str, Any]], None]:
        def take(data: bytes, info: Mapping[str, Any]) -> None:
            self._write(topic, kind, data, info)

        return take

    def _write(self, topic: str, kind: str, data: bytes, info: Mapping[str, Any]) -> None:
        if self._failure or topic in self._left_out:
            return
        try:
            if self._added.get(topic) != kind:
                self._add(topic, kind)
            self._writer.write(
                topic, int(info['received_timestamp']), int(info['source_timestamp']), data
            )
        except (UnknownTypeError, DataError) as error:
            self._leave_out(topic, str(error))
            return
        except RecordError as error:
            self._fail(error)
            return
        self._received += 1

    def _flush(self) -> None:
        """Bring what was recorded to the disk, also while nothing new comes."""
        try:
            self._writer.flush()
        except RecordError as error:
            self._fail(error)

    def _fail(self, error: RecordError) -> None:
        self._failure = str(error)
        self.get_logger().error(f'recording has stopped: {error}')
        self.exit_code = 1

    def _add(self, topic: str, kind: str) -> None:
        profiles = []
        type_hash = None
        for info in self.get_publishers_info_by_topic(topic):
            profiles.append(_profile(info.qos_profile))
            type_hash = str(info.topic_type_hash)
        self._writer.add_topic(topic, kind, profiles, type_hash)
        self._added[topic] = kind

    def _ask_for_settings(self) -> None:
        """Ask each of the package's nodes for its settings, once: they belong into the bag."""
        for name, namespace in self.get_node_names_and_namespaces():
            full = f'{namespace.rstrip("/")}/{name}'
            if name not in TABLES or full in self._asked:
                continue
            lister = self.create_client(ListParameters, f'{full}/list_parameters')
            getter = self.create_client(GetParameters, f'{full}/get_parameters')
            if lister.service_is_ready() and getter.service_is_ready():
                self._asked.add(full)
                future = lister.call_async(ListParameters.Request())
                # One of another namespace has the same name but is another robot's.
                title = name if namespace == self.get_namespace() else full
                future.add_done_callback(partial(self._on_names, title, lister, getter))
            else:
                self.destroy_client(lister)
                self.destroy_client(getter)

    def _on_names(self, title: str, lister: Client, getter: Client, future: Any) -> None:
        names = list(future.result().result.names)
        self.destroy_client(lister)
        asked = getter.call_async(GetParameters.Request(names=names))
        asked.add_done_callback(partial(self._on_values, title, names, getter))

    def _on_values(self, title: str, names: list[str], getter: Client, future: Any) -> None:
        values = {
            key: str(parameter_value_to_python(value))
            for key, value in zip(names, future.result().values, strict=True)
        }
        self.destroy_client(getter)
        self._details[title] = values
        try:
            self._writer.add_details(title, values)
        except RecordError as error:
            self._fail(error)

    def _on_split(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            if not self._failure:
                self._writer.close()
                self._writer = self._open()
                self._added.clear()
        except RecordError as error:
            self._fail(error)
        response.success = not self._failure
        response.message = self._failure or f'goes on in {self._writer.path.name}'
        return response

    def health(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether the bag grows, and where it is."""
        values = {
            'folder': str(self._folder),
            'messages': self._received,
            'topics': len(self._added),
        }
        if self._failure:
            return ERROR, self._failure, values
        return OK, 'recording', values

    def finish(self) -> None:
        """Close the bag."""
        try:
            self._writer.close()
        except RecordError as error:
            self.get_logger().error(str(error))
            self.exit_code = 1


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


def make() -> list[RecorderNode]:
    """Return the nodes of this process."""
    return [RecorderNode()]
