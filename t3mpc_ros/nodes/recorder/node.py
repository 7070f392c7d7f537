# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros recorder``: records topics as serialized messages into an MCAP bag."""

from collections.abc import Mapping
from datetime import datetime
from functools import partial
from pathlib import Path
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger

from t3mpc_ros.bag.recording.diagnostics_monitor import (
    DiagnosticsMonitor,
    NodeFault,
    SnapshotRateLimiter,
)
from t3mpc_ros.bag.recording.message_queue import MessageQueue
from t3mpc_ros.bag.recording.snapshot import CircularMessageCache
from t3mpc_ros.bag.recording.split_writer import SplitWriter, message_loss_record
from t3mpc_ros.bag.schema import BagError, MessageDefinitions, UnknownTypeError
from t3mpc_ros.bag.topic_filter import TopicFilter
from t3mpc_ros.bag.writer import Attachment, FolderError
from t3mpc_ros.chaos.seed_fingerprint import FINGERPRINT_KEY
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.common import qos
from t3mpc_ros.nodes.common.base_node import ERROR, OK, WARN, BaseNode
from t3mpc_ros.nodes.node_parameters import RecorderParameters
from t3mpc_ros.nodes.recorder.metadata import SEED_TABLE, ParameterCollector, RecordingMetadata
from t3mpc_ros.nodes.recorder.snapshot_writer import SnapshotWriter
from t3mpc_ros.nodes.recorder.subscriptions import RawSubscriptions, TopicDiscovery, offered_qos
from t3mpc_ros.nodes.recorder.writer_thread import WriterThread

TAKE_PERIOD = 0.02
"""Seconds; a queue of the middleware holds a thousand messages of each topic meanwhile."""
DROP_ERROR_TIME_NS = 2 * NANOSECONDS
"""So long messages that were dropped are an error; then it is known that the bag lacks them."""
SPLIT_TIMEOUT = 5.0
"""Seconds that ~/split waits for the disk."""


class RecorderNode(BaseNode[RecorderParameters]):
    """Subscribes to what is published under the wanted names and writes it down unopened."""

    def __init__(self, **given: Any) -> None:
        super().__init__('recorder', RecorderParameters, **given)
        parameters = self.parameters
        self._folder = Path(
            parameters.folder or f'bag_{datetime.now():%Y_%m_%d-%H_%M_%S}'
        ).resolve()
        self._origin = RecordingMetadata(
            parameters.attach, parameters.attach_bytes, parameters.attach_models, time.time_ns()
        )
        self._definitions = MessageDefinitions()
        self._backlog: MessageQueue[SplitWriter] = MessageQueue(parameters.queue_bytes)
        self._pen = None if parameters.snapshot_only else self._make_pen()
        self._camera = self._make_camera() if parameters.snapshot_time else None
        self._added: dict[str, str] = {}
        self._ears = RawSubscriptions(self)
        self._attention = TopicDiscovery(
            self, self._select(), self._ears, self._take, self._added.__contains__
        )
        self._received = self._dropped = 0
        self._dropped_ns: int | None = None
        self._failure = ''
        self._watch = DiagnosticsMonitor(map(self._diagnosed, parameters.snapshot_nodes))
        self._budget = SnapshotRateLimiter(
            round(parameters.snapshot_pause * NANOSECONDS), parameters.snapshot_most
        )
        self._attention.expect()
        self._questions = ParameterCollector(self, self._on_settings)
        self.create_subscription(
            DiagnosticArray, '/diagnostics', self._on_diagnostics, qos.DIAGNOSTICS
        )
        self.create_service(Trigger, '~/split', self._on_split)
        self.create_service(Trigger, '~/snapshot', self._on_snapshot)
        self.every(0.2, self._attention.discover)
        self.every(0.2, self._questions.ask)
        self.every(TAKE_PERIOD, self._take)
        self.every(1.0, self._look_around)
        self.get_logger().info(
            f'recording to {self._folder}'
            if self._pen
            else f'keeping the last {parameters.snapshot_time:g} s for {self._folder}'
        )

    # -- what it is made of -----------------------------------------------------------------------

    def _make_pen(self) -> WriterThread:
        parameters = self.parameters
        series = SplitWriter(
            self._folder,
            self._origin.metadata_records,
            chunk_bytes=parameters.chunk_bytes,
            chunk_ns=round(parameters.chunk_time * NANOSECONDS),
            split_bytes=parameters.split_bytes,
            split_ns=round(parameters.split_time * NANOSECONDS),
            definitions=self._definitions,
        )
        for attachment, read_ns in self._origin.attachments.values():
            series.add_attachment(attachment, read_ns)
        return WriterThread(series, self._backlog, self.steady_ns)

    def _make_camera(self) -> SnapshotWriter:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FolderError(f'cannot record into {self._folder}: {error.strerror}') from error
        span_ns = round(self.parameters.snapshot_time * NANOSECONDS)
        ring = CircularMessageCache(span_ns, self.parameters.snapshot_bytes)
        return SnapshotWriter(self._folder, ring, self._definitions)

    def _select(self) -> TopicFilter:
        topics = self.parameters.topics
        # A name with a star is no topic name: it cannot be resolved, and is a pattern.
        names = [self.resolve_topic_name(name) for name in topics if '*' not in name]
        return TopicFilter(
            names,
            topics,
            regex=self.parameters.regex,
            exclude=self.parameters.exclude,
            types=self.parameters.types,
            namespace=self.get_namespace(),
        )

    def _diagnosed(self, node: str) -> str:
        """Return the name under which a node stands in the diagnostics."""
        name = node if node.startswith('/') else f'{self.get_namespace().rstrip("/")}/{node}'
        return name.lstrip('/')

    # -- from the middleware to the queue ---------------------------------------------------------

    def _take(self) -> None:
        if self._pen and self._pen.failure and not self._failure:
            self._fail(self._pen.failure)
        messages = self._ears.take()
        if not messages or self._failure:
            return
        for topic in dict.fromkeys(message.topic for message in messages):
            kind = self._ears.kind(topic)
            if self._added.get(topic) != kind:
                self._add(topic, kind)
        if left_out := self._attention.left_out:
            messages = [message for message in messages if message.topic not in left_out]
        if self._camera:
            self._camera.add(messages)
        self._received += len(messages)
        if self._pen and (lost := self._backlog.put(messages)):
            self._dropped += sum(lost.values())
            self._dropped_ns = self.steady_ns()
            self.get_logger().error(
                f'the disk is too slow: {self._dropped} messages dropped so far, now of '
                f'{", ".join(lost)} (queue_bytes is {self.parameters.queue_bytes})',
                throttle_duration_sec=1.0,
            )

    def _add(self, topic: str, kind: str) -> None:
        if topic in self._added:
            self._attention.leave_out(topic, f'it is recorded as {self._added[topic]}, not {kind}')
            return
        found, latched = offered_qos(topic, kind, self.get_publishers_info_by_topic(topic))
        try:
            self._definitions.schema(kind)
        except UnknownTypeError as error:
            self._attention.leave_out(topic, str(error))
            return
        self._added[topic] = kind
        self._write_down(lambda series: series.add_topic(found))
        if self._camera:
            self._camera.announce(found, latched)

    def _write_down(self, order: Any) -> None:
        if self._pen:
            self._pen.ask(order)

    def _fail(self, why: str) -> None:
        self._failure = why
        self.get_logger().error(
            f'recording has stopped: {why}. Make room, or choose another folder, and start the '
            'recorder again: it goes on beside what is there'
        )
        self.exit_code = 1

    # -- what belongs into the bag besides --------------------------------------------------------

    @property
    def _metadata_records(self) -> dict[str, dict[str, str]]:
        return self._origin.metadata_records

    def _on_settings(self, title: str, name: str, values: Mapping[str, str]) -> None:
        files, problem = self._origin.parameters(title, name, values, time.time_ns())
        if problem:
            self.get_logger().warning(f'the model of {title} is not in the bag: {problem}')
        self._write_down(lambda series: series.add_metadata_record(title, values))
        self._attach(files)

    def _attach(self, files: list[Attachment]) -> None:
        for item in files:
            self._write_down(
                partial(SplitWriter.add_attachment, attachment=item, read_ns=time.time_ns())
            )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            level = int.from_bytes(status.level, 'little')
            fault = self._watch.update(status.name, level, status.message, self.steady_ns())
            if fault:
                self._on_fault(fault)
            for value in status.values:
                if value.key == FINGERPRINT_KEY and self._origin.seed(status.name, value.value):
                    table = dict(self._metadata_records[SEED_TABLE])
                    self._write_down(
                        partial(SplitWriter.add_metadata_record, title=SEED_TABLE, table=table)
                    )

    # -- split and snapshot -----------------------------------------------------------------------

    def _on_split(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._take()
        if self._pen is None:
            response.message = 'there is no recording to split with snapshot_only'
            return response
        table = self._losses()

        def split(series: SplitWriter) -> Path:
            series.add_metadata_record('losses', table)
            return series.split()

        try:
            path = self._pen.ask(split).result(SPLIT_TIMEOUT)
        except BagError as error:
            response.message = str(error)
        except TimeoutError:
            response.message = f'the disk has not answered for {SPLIT_TIMEOUT:g} s'
        else:
            response.success = True
            response.message = f'goes on in {path.name}'
        return response

    def _on_snapshot(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        try:
            response.message = f'being written into {self._snap("asked for")}'
            response.success = True
        except BagError as error:
            response.message = str(error)
        return response

    def _on_fault(self, fault: NodeFault) -> None:
        reason = f'{fault.node}: {fault.reason}'
        if self._camera is None:
            return
        if refusal := self._budget.acquire(self.steady_ns()):
            self.get_logger().warning(f'no snapshot of "{reason}": {refusal}')
            return
        try:
            self._snap(reason)
        except BagError as error:
            self.get_logger().warning(f'no snapshot of "{reason}": {error}')

    def _snap(self, reason: str) -> Path:
        if self._camera is None:
            raise BagError('snapshot_time must be above 0 for snapshots: got 0')
        self._take()
        files = list(self._origin.attachments.values())
        metadata_records = {title: dict(table) for title, table in self._metadata_records.items()}
        return self._camera.take(reason, time.time_ns(), metadata_records, files, self._say)

    def _say(self, complete: bool, text: str) -> None:
        """Log how a snapshot came out; rclpy wants each level to have a line of its own."""
        if complete:
            self.get_logger().info(text)
        else:
            self.get_logger().error(text)

    # -- how it is --------------------------------------------------------------------------------

    def _look_around(self) -> None:
        self._ears.count_lost()
        for fault in self._watch.silent(self.steady_ns()):
            self._on_fault(fault)

    def _losses(self) -> dict[str, str]:
        return message_loss_record(self._backlog.dropped, self._ears.lost)

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether the bag grows and lacks nothing, and where it is."""
        lost = sum(self._ears.lost.values())
        values: dict[str, object] = {
            'folder': str(self._folder),
            'file': self._pen.file_name if self._pen else 'none',
            'messages': self._received,
            'topics': len(self._added),
            'dropped': self._dropped,
            'lost': lost,
            'queue_bytes': self._backlog.bytes,
            'snapshots': len(self._camera.done) if self._camera else 0,
        }
        if self._failure:
            return ERROR, self._failure, values
        if (
            self._dropped_ns is not None
            and self.steady_ns() - self._dropped_ns < DROP_ERROR_TIME_NS
        ):
            return ERROR, f'the disk is too slow: {self._dropped} messages dropped so far', values
        if self._camera and self._camera.problem:
            return WARN if self._pen else ERROR, self._camera.problem, values
        if self._dropped or lost:
            text = f'the bag lacks {self._dropped} messages that were dropped and {lost} lost'
            return WARN, text, values
        return OK, 'recording' if self._pen else 'keeping the last seconds', values

    def finish(self) -> None:
        """Write down what has come, and close the bag."""
        try:
            self._take()
            self._ears.count_lost()
            self._ears.close()
        finally:
            self._close()

    def _close(self) -> None:
        self._attach(self._origin.saved_models(time.time_ns()))
        table = self._losses()
        self._write_down(lambda series: series.add_metadata_record('losses', table))
        problem = self._pen.close() if self._pen else ''
        if self._camera:
            self._camera.close(30.0)
        if problem and not self._failure:
            self._fail(problem)


def make() -> list[RecorderNode]:
    """Return the nodes of this process."""
    return [RecorderNode()]
