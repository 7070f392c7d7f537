# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros recorder``: writes topics into an MCAP bag, bytes as they came.

A timer empties the subscriptions (:mod:`t3mpc_ros.nodes.recording.ears`), a thread compresses and
writes (:mod:`~t3mpc_ros.nodes.recording.pen`), and between them stands a queue that is bounded.
"""

from collections.abc import Mapping
from datetime import datetime
from functools import partial
from pathlib import Path
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.nodes.plumbing import quality
from t3mpc_ros.nodes.plumbing.package_node import ERROR, OK, WARN, PackageNode
from t3mpc_ros.nodes.recording.attention import Attention
from t3mpc_ros.nodes.recording.camera import Camera
from t3mpc_ros.nodes.recording.ears import Ears
from t3mpc_ros.nodes.recording.offers import announcement
from t3mpc_ros.nodes.recording.pen import Pen
from t3mpc_ros.nodes.recording.provenance import SEEDS, Provenance
from t3mpc_ros.nodes.recording.questions import Questions
from t3mpc_ros.nodes.tables import RecorderSettings
from t3mpc_ros.record.schema import Definitions, RecordError, UnknownTypeError
from t3mpc_ros.record.writer import FolderError
from t3mpc_ros.record.writing.attachment import Attachment
from t3mpc_ros.record.writing.backlog import Backlog
from t3mpc_ros.record.writing.faults import Budget, Fault, FaultWatch
from t3mpc_ros.record.writing.selection import Selection
from t3mpc_ros.record.writing.series import BagSeries, losses
from t3mpc_ros.record.writing.snapshot import Ring
from t3mpc_ros.settings.fingerprint import KEY

TAKE_EVERY = 0.02
"""Seconds; a queue of the middleware holds a thousand messages of each topic meanwhile."""
LATELY_NS = 2 * NANOSECONDS
"""So long messages that were dropped are an error; then it is known that the bag lacks them."""
ANSWER = 5.0
"""Seconds that ~/split waits for the disk."""


class RecorderNode(PackageNode[RecorderSettings]):
    """Subscribes to what is published under the wanted names and writes it down unopened."""

    def __init__(self, **given: Any) -> None:
        super().__init__('recorder', RecorderSettings, **given)
        settings = self.settings
        self._folder = Path(settings.folder or f'bag_{datetime.now():%Y_%m_%d-%H_%M_%S}').resolve()
        self._origin = Provenance(
            settings.attach, settings.attach_bytes, settings.attach_models, time.time_ns()
        )
        self._definitions = Definitions()
        self._backlog: Backlog[BagSeries] = Backlog(settings.queue_bytes)
        self._pen = None if settings.snapshot_only else self._make_pen()
        self._camera = self._make_camera() if settings.snapshot_time else None
        self._added: dict[str, str] = {}
        self._ears = Ears(self)
        self._attention = Attention(
            self, self._select(), self._ears, self._take, self._added.__contains__
        )
        self._received = self._dropped = 0
        self._dropped_ns: int | None = None
        self._failure = ''
        self._watch = FaultWatch(map(self._diagnosed, settings.snapshot_nodes))
        self._budget = Budget(round(settings.snapshot_pause * NANOSECONDS), settings.snapshot_most)
        self._attention.expect()
        self._questions = Questions(self, self._on_settings)
        self.create_subscription(
            DiagnosticArray, '/diagnostics', self._on_diagnostics, quality.DIAGNOSTICS
        )
        self.create_service(Trigger, '~/split', self._on_split)
        self.create_service(Trigger, '~/snapshot', self._on_snapshot)
        self.every(0.2, self._attention.discover)
        self.every(0.2, self._questions.ask)
        self.every(TAKE_EVERY, self._take)
        self.every(1.0, self._look_around)
        self.get_logger().info(
            f'recording to {self._folder}'
            if self._pen
            else f'keeping the last {settings.snapshot_time:g} s for {self._folder}'
        )

    # -- what it is made of -----------------------------------------------------------------------

    def _make_pen(self) -> Pen:
        settings = self.settings
        series = BagSeries(
            self._folder,
            self._origin.details,
            chunk_bytes=settings.chunk_bytes,
            chunk_ns=round(settings.chunk_time * NANOSECONDS),
            split_bytes=settings.split_bytes,
            split_ns=round(settings.split_time * NANOSECONDS),
            definitions=self._definitions,
        )
        for attachment, read_ns in self._origin.attachments.values():
            series.add_attachment(attachment, read_ns)
        return Pen(series, self._backlog, self.steady_ns)

    def _make_camera(self) -> Camera:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FolderError(f'cannot record into {self._folder}: {error.strerror}') from error
        span_ns = round(self.settings.snapshot_time * NANOSECONDS)
        ring = Ring(span_ns, self.settings.snapshot_bytes)
        return Camera(self._folder, ring, self._definitions)

    def _select(self) -> Selection:
        topics = self.settings.topics
        # A name with a star is no topic name: it cannot be resolved, and is a pattern.
        names = [self.resolve_topic_name(name) for name in topics if '*' not in name]
        return Selection(
            names,
            topics,
            regex=self.settings.regex,
            exclude=self.settings.exclude,
            types=self.settings.types,
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
                f'{", ".join(lost)} (queue_bytes is {self.settings.queue_bytes})',
                throttle_duration_sec=1.0,
            )

    def _add(self, topic: str, kind: str) -> None:
        if topic in self._added:
            self._attention.leave_out(topic, f'it is recorded as {self._added[topic]}, not {kind}')
            return
        found, latched = announcement(topic, kind, self.get_publishers_info_by_topic(topic))
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
    def _details(self) -> dict[str, dict[str, str]]:
        return self._origin.details

    def _on_settings(self, title: str, name: str, values: Mapping[str, str]) -> None:
        files, problem = self._origin.settings(title, name, values, time.time_ns())
        if problem:
            self.get_logger().warning(f'the model of {title} is not in the bag: {problem}')
        self._write_down(lambda series: series.add_details(title, values))
        self._attach(files)

    def _attach(self, files: list[Attachment]) -> None:
        for item in files:
            self._write_down(
                partial(BagSeries.add_attachment, attachment=item, read_ns=time.time_ns())
            )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            level = int.from_bytes(status.level, 'little')
            fault = self._watch.hear(status.name, level, status.message, self.steady_ns())
            if fault:
                self._on_fault(fault)
            for value in status.values:
                if value.key == KEY and self._origin.seed(status.name, value.value):
                    table = dict(self._details[SEEDS])
                    self._write_down(partial(BagSeries.add_details, title=SEEDS, table=table))

    # -- split and snapshot -----------------------------------------------------------------------

    def _on_split(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._take()
        if self._pen is None:
            response.message = 'there is no recording to split with snapshot_only'
            return response
        table = self._losses()

        def split(series: BagSeries) -> Path:
            series.add_details('losses', table)
            return series.split()

        try:
            path = self._pen.ask(split).result(ANSWER)
        except RecordError as error:
            response.message = str(error)
        except TimeoutError:
            response.message = f'the disk has not answered for {ANSWER:g} s'
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
        except RecordError as error:
            response.message = str(error)
        return response

    def _on_fault(self, fault: Fault) -> None:
        reason = f'{fault.node}: {fault.reason}'
        if self._camera is None:
            return
        if refusal := self._budget.spend(self.steady_ns()):
            self.get_logger().warning(f'no snapshot of "{reason}": {refusal}')
            return
        try:
            self._snap(reason)
        except RecordError as error:
            self.get_logger().warning(f'no snapshot of "{reason}": {error}')

    def _snap(self, reason: str) -> Path:
        if self._camera is None:
            raise RecordError('snapshot_time must be above 0 for snapshots: got 0')
        self._take()
        files = list(self._origin.attachments.values())
        details = {title: dict(table) for title, table in self._details.items()}
        return self._camera.take(reason, time.time_ns(), details, files, self._say)

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
        return losses(self._backlog.dropped, self._ears.lost)

    def health(self) -> tuple[bytes, str, Mapping[str, object]]:
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
        if self._dropped_ns is not None and self.steady_ns() - self._dropped_ns < LATELY_NS:
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
        self._write_down(lambda series: series.add_details('losses', table))
        problem = self._pen.close() if self._pen else ''
        if self._camera:
            self._camera.close(30.0)
        if problem and not self._failure:
            self._fail(problem)


def make() -> list[RecorderNode]:
    """Return the nodes of this process."""
    return [RecorderNode()]
