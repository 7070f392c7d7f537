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
"""``ros2 run t3mpc_ros recorder``: records topics as serialized messages into an MCAP bag.

A timer takes the messages of the subscriptions (:mod:`~t3mpc_ros.nodes.recorder_subscriptions`),
a thread compresses and writes them (:mod:`~t3mpc_ros.bag.writer_thread`).
"""

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger

from t3mpc_ros.atomic_file import check_new_folder
from t3mpc_ros.bag.errors import BagError, UnknownTypeError
from t3mpc_ros.bag.message_definitions import MessageDefinitions
from t3mpc_ros.bag.recorder_parameters import RecordingParameters
from t3mpc_ros.bag.recording_metadata import (
    LOSSES,
    SEED_RECORD,
    RecordingMetadata,
    message_loss_record,
)
from t3mpc_ros.bag.snapshot_ring_buffer import (
    CircularMessageCache,
    DiagnosticsMonitor,
    SnapshotRateLimiter,
    SnapshotWriter,
)
from t3mpc_ros.bag.topic_filter import TopicFilter, resolve_name
from t3mpc_ros.bag.writer import BagWriter, FolderError, FolderInUseError
from t3mpc_ros.bag.writer_thread import WriterThread
from t3mpc_ros.chaos.salted_seed_hash import FINGERPRINT_KEY
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import topic_endpoints
from t3mpc_ros.nodes.base_node import ERROR, OK, WARN, BaseNode
from t3mpc_ros.nodes.recorder_subscriptions import TopicSubscriptions, topic_information
from t3mpc_ros.nodes.registry import NODES
from t3mpc_ros.nodes.remote_parameters import ParameterWatch, RemoteParameters
from t3mpc_ros.parameters.table import ParameterError

TAKE_PERIOD = 0.04
"""Time between two reads of the subscriptions, s; each queues up to 1000 messages meanwhile."""
DISCOVERY_PERIOD = 0.2
"""Time between two queries of the graph, s."""
DROP_ERROR_TIME_NS = 2 * NANOSECONDS
"""Time for which dropped messages are reported as an error; afterwards as a warning."""
SPLIT_TIMEOUT = 5.0
"""Timeout of ``~/split_bagfile`` for the disk, s."""


class RecorderNode(BaseNode[RecordingParameters]):
    """Subscribes to the selected topics and writes their serialized messages to a bag."""

    parameter_class = RecordingParameters
    configuration_errors = (BagError,)
    conflict_errors = (FolderInUseError,)

    def __init__(self, **options: Any) -> None:
        super().__init__('recorder', **options)
        parameters = self.parameters
        self._folder = Path(parameters.uri or f'bag_{datetime.now():%Y_%m_%d-%H_%M_%S}').resolve()
        try:
            check_new_folder(self._folder)
        except ValueError as error:
            raise ParameterError(f'storage.uri {error}') from None
        self._metadata = RecordingMetadata(
            parameters.attachments,
            parameters.max_attachment_size,
            parameters.attach_models,
            time.time_ns(),
        )
        self._definitions = MessageDefinitions()
        self._recording = not parameters.snapshot_mode
        self._writer = WriterThread(
            self._make_bag() if self._recording else None,
            parameters.max_cache_size,
            self.steady_ns,
        )
        self._snapshots = self._make_snapshot_writer() if parameters.snapshot_duration else None
        self._recorded_types: dict[str, str] = {}
        self._topics = TopicSubscriptions(self, self._make_topic_filter(), self._take_messages)
        self._received = 0
        self._dropped_ns: int | None = None
        self._failure = ''
        self._monitor = DiagnosticsMonitor(
            # In the diagnostics, names of nodes have no slash in front.
            resolve_name(node, self.get_namespace()).lstrip('/')
            for node in parameters.monitored_nodes
        )
        self._rate_limiter = SnapshotRateLimiter(
            round(parameters.snapshot_min_interval * NANOSECONDS), parameters.snapshot_max_count
        )
        self._topics.subscribe_expected()
        self._parameter_watch = ParameterWatch(
            self, lambda name, _: name in NODES, self._on_node_parameters
        )
        self.create_subscription(
            DiagnosticArray, '/diagnostics', self._on_diagnostics, topic_endpoints.DIAGNOSTICS
        )
        self.offer(Trigger, '~/split_bagfile', self._split)
        self.offer(Trigger, '~/snapshot', self._snapshot)
        self.create_steady_timer(DISCOVERY_PERIOD, self._topics.discover)
        self.create_steady_timer(DISCOVERY_PERIOD, self._parameter_watch.update)
        self.create_steady_timer(TAKE_PERIOD, self._take_messages)
        self.create_steady_timer(1.0, self._monitor_graph)
        self.get_logger().info(
            f'recording to {self._folder}'
            if self._recording
            else f'caching the last {parameters.snapshot_duration:g} s for snapshots in '
            f'{self._folder}'
        )

    # -- parts ------------------------------------------------------------------------------------

    def _make_bag(self) -> BagWriter:
        parameters = self.parameters
        writer = BagWriter(
            self._folder,
            metadata_records=self._metadata.records,
            chunk_bytes=parameters.chunk_size,
            chunk_ns=round(parameters.chunk_duration * NANOSECONDS),
            max_file_bytes=parameters.max_bagfile_size,
            max_file_ns=round(parameters.max_bagfile_duration * NANOSECONDS),
            definitions=self._definitions,
        )
        for attachment in self._metadata.attachments.values():
            writer.add_attachment(attachment)
        return writer

    def _make_snapshot_writer(self) -> SnapshotWriter:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FolderError(f'cannot record into {self._folder}: {error.strerror}') from error
        span_ns = round(self.parameters.snapshot_duration * NANOSECONDS)
        cache = CircularMessageCache(span_ns, self.parameters.snapshot_cache_size)
        return SnapshotWriter(self._folder, cache, self._definitions, self._writer)

    def _make_topic_filter(self) -> TopicFilter:
        topics = self.parameters.topics
        # A name with a star is a pattern, which rclpy cannot resolve.
        names = [self.resolve_topic_name(name) for name in topics if '*' not in name]
        return TopicFilter(
            names,
            topics,
            regex=self.parameters.regex,
            exclude_topics=self.parameters.exclude_topics,
            exclude_regex=self.parameters.exclude_regex,
            types=self.parameters.topic_types,
            namespace=self.get_namespace(),
        )

    # -- messages: subscriptions to queue ---------------------------------------------------------

    def _take_messages(self) -> None:
        if self._writer.failure and not self._failure:
            self._fail(self._writer.failure)
        messages = self._topics.take_messages()
        if not messages or self._failure:
            return
        for topic in dict.fromkeys(message.topic for message in messages):
            type_name = self._topics.type_name(topic)
            if self._recorded_types.get(topic) != type_name:
                self._add_topic(topic, type_name)
        if excluded := self._topics.excluded:
            messages = [message for message in messages if message.topic not in excluded]
        if self._snapshots:
            self._snapshots.add(messages)
        self._received += len(messages)
        if self._recording and (dropped := self._writer.put(messages)):
            self._dropped_ns = self.steady_ns()
            total = sum(self._writer.dropped.values())
            self.get_logger().error(
                f'the disk is too slow: {total} messages dropped so far, the last of '
                f'{", ".join(dropped)} '
                f'(storage.max_cache_size is {self.parameters.max_cache_size})',
                throttle_duration_sec=1.0,
            )

    def _add_topic(self, topic: str, type_name: str) -> None:
        if recorded := self._recorded_types.get(topic):
            self._topics.exclude(topic, f'it is recorded as {recorded}, not {type_name}')
            return
        publishers = self.get_publishers_info_by_topic(topic)
        metadata = topic_information(topic, type_name, publishers)
        try:
            self._definitions.schema(type_name)
        except UnknownTypeError as error:
            self._topics.exclude(topic, str(error))
            return
        self._recorded_types[topic] = type_name
        name, profiles = metadata.name, metadata.offered_qos_profiles
        self._submit(
            lambda writer: writer.add_topic(name, type_name, profiles, metadata.type_hash)
        )
        if self._snapshots:
            self._snapshots.add_topic(metadata)

    def _submit(self, task: Callable[[BagWriter], object]) -> None:
        if self._recording:
            self._writer.submit(task)

    def _fail(self, reason: str) -> None:
        self._failure = reason
        self.get_logger().error(
            f'recording has stopped: {reason}. Free disk space or choose another folder, then '
            'restart the recorder: it continues the bag with a new file'
        )
        self.exit_code = 1

    # -- metadata and attachments -----------------------------------------------------------------

    def _on_node_parameters(
        self, remote: RemoteParameters, rows: Sequence[Mapping[str, Any]]
    ) -> None:
        remote.destroy()
        node = remote.node_name
        # The nodes of other robots have the same names in other namespaces.
        own = remote.name == topic_endpoints.full_name(self.get_namespace(), node)
        record = node if own else remote.name
        values = {row['name']: str(row['value']) for row in rows}
        files, problem = self._metadata.add_parameters(record, node, values, time.time_ns())
        if problem:
            self.get_logger().warning(f'the model of {record} is not attached: {problem}')
        self._submit(lambda writer: writer.add_metadata_record(record, values))
        for item in files:
            self._submit(partial(BagWriter.add_attachment, item=item))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            level = int.from_bytes(status.level, 'little')
            fault = self._monitor.update(status.name, level, status.message, self.steady_ns())
            if fault:
                self._on_fault(fault)
            for value in status.values:
                if value.key == FINGERPRINT_KEY:
                    self._add_seed(status.name, value.value)

    def _add_seed(self, node: str, fingerprint: str) -> None:
        if self._metadata.add_seed(node, fingerprint):
            table = dict(self._metadata.records[SEED_RECORD])
            self._submit(lambda writer: writer.add_metadata_record(SEED_RECORD, table))

    # -- split and snapshot -----------------------------------------------------------------------

    def _split(self) -> tuple[str, str]:
        self._take_messages()
        if not self._recording:
            return 'no recording to split: storage.snapshot_mode is set', ''
        self._write_losses()
        try:
            path = self._writer.submit(BagWriter.split).result(SPLIT_TIMEOUT)
        except BagError as error:
            return str(error), ''
        except TimeoutError:
            return f'no response of the disk for {SPLIT_TIMEOUT:g} s', ''
        return '', f'continues in {path.name}'

    def _snapshot(self) -> tuple[str, str]:
        try:
            return '', f'writing to {self._start_snapshot("requested")}'
        except BagError as error:
            return str(error), ''

    def _on_fault(self, reason: str) -> None:
        if self._snapshots is None:
            return
        if problem := self._rate_limiter.acquire(self.steady_ns()):
            self.get_logger().warning(f'no snapshot of "{reason}": {problem}')
            return
        try:
            self._start_snapshot(reason)
        except BagError as error:
            self.get_logger().warning(f'no snapshot of "{reason}": {error}')

    def _start_snapshot(self, reason: str) -> Path:
        if self._snapshots is None:
            raise BagError('storage.snapshot_duration must be above 0 for snapshots: got 0')
        self._take_messages()
        files = list(self._metadata.attachments.values())
        records = {name: dict(table) for name, table in self._metadata.records.items()}
        return self._snapshots.start(reason, time.time_ns(), records, files, self._log_snapshot)

    def _log_snapshot(self, success: bool, text: str) -> None:
        # rclpy identifies a log call by its line, so each level has its own.
        if success:
            self.get_logger().info(text)
        else:
            self.get_logger().error(text)

    # -- diagnostics and shutdown -----------------------------------------------------------------

    def _monitor_graph(self) -> None:
        self._topics.count_lost()
        self._write_losses()
        for fault in self._monitor.check_timeouts(self.steady_ns()):
            self._on_fault(fault)

    def _write_losses(self) -> None:
        """Write the loss record if it has changed: a killed recorder leaves it, too."""
        table = message_loss_record(
            self._writer.dropped, self._topics.lost, self._topics.undiscovered
        )
        if table != self._metadata.records.get(LOSSES):
            self._metadata.records[LOSSES] = table
            self._submit(lambda writer: writer.add_metadata_record(LOSSES, table))

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether the recording runs and is complete, with its place and size."""
        lost = self._topics.lost.total()
        dropped = sum(self._writer.dropped.values())
        values: dict[str, object] = {
            'folder': str(self._folder),
            'file': self._writer.file_name,
            'messages': self._received,
            'topics': len(self._recorded_types),
            'dropped': dropped,
            'lost': lost,
            'undiscovered': self._topics.undiscovered.total(),
            'queue_bytes': self._writer.bytes,
            'snapshots': self._snapshots.completed if self._snapshots else 0,
        }
        if self._failure:
            return ERROR, self._failure, values
        if (
            self._dropped_ns is not None
            and self.steady_ns() - self._dropped_ns < DROP_ERROR_TIME_NS
        ):
            return ERROR, f'the disk is too slow: {dropped} messages dropped so far', values
        if self._snapshots and self._snapshots.problem:
            return WARN if self._recording else ERROR, self._snapshots.problem, values
        if dropped or lost:
            text = f'the bag lacks {dropped} dropped and {lost} lost messages'
            return WARN, text, values
        return OK, 'recording' if self._recording else 'caching for snapshots', values

    def on_shutdown(self) -> None:
        """Write the received messages and close the bag."""
        self._parameter_watch.close()
        try:
            self._take_messages()
            self._topics.close()
        finally:
            self._close()

    def _close(self) -> None:
        for item in self._metadata.saved_models(time.time_ns()):
            self._submit(partial(BagWriter.add_attachment, item=item))
        self._write_losses()
        problem = self._writer.close()
        if problem and not self._failure:
            self._fail(problem)
