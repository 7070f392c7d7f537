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
"""Snapshots: the last seconds of all topics, written to a bag on request or at a fault of a node.

Nodes report once per second. A shorter fault is not detected, but its messages are in the bag.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
import re

from mcap.records import Attachment

from t3mpc_ros.bag.errors import BagError, DataError, UnknownTypeError
from t3mpc_ros.bag.mcap_file import SerializedMessage
from t3mpc_ros.bag.message_definitions import MessageDefinitions
from t3mpc_ros.bag.metadata_yaml import TopicInformation
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.bag.writer_thread import WriterThread
from t3mpc_ros.geometry.types import NANOSECONDS

SNAPSHOT_RECORD = 'snapshot'
"""Title of the metadata record that contains the reason of a snapshot."""
FOLDER = 'snapshots'
MESSAGES_PER_SLICE = 200
"""Messages of a snapshot between which the recording is written."""


class CircularMessageCache:
    """Messages of the last ``span_ns``, and the last transient-local messages before them.

    At ``max_bytes`` of memory it covers less time.
    """

    def __init__(self, span_ns: int, max_bytes: int) -> None:
        self._span_ns = span_ns
        self._max_bytes = max_bytes
        self._messages: deque[SerializedMessage] = deque()
        self._latched: dict[str, deque[SerializedMessage]] = {}
        self.bytes = 0
        """Memory of the messages, without the transient-local ones before the span."""
        self._newest_ns = 0

    def keep_last(self, topic: str, count: int) -> None:
        """Keep the last ``count`` messages of a transient-local topic regardless of their age."""
        kept = self._latched.get(topic, ())
        self._latched[topic] = deque(kept, maxlen=max(1, count))

    def add(self, messages: Iterable[SerializedMessage]) -> None:
        """Add ``messages`` in order of receipt, and remove the expired ones."""
        for message in messages:
            self._messages.append(message)
            self.bytes += message.memory_size
            self._newest_ns = max(self._newest_ns, message.received_ns)
        self._expire(self._newest_ns - self._span_ns)

    def messages(self, now_ns: int) -> list[SerializedMessage]:
        """Return the messages received in the span before ``now_ns``, transient-local ones first.

        A transient-local message from before the span gets the beginning of the span as its time
        of receipt, so that the bag is not longer than the span; its publish stamp is unchanged.
        """
        self._expire(now_ns - self._span_ns)
        earliest_ns = max(0, now_ns - self._span_ns)
        start_ns = min((each.received_ns for each in self._messages), default=earliest_ns)
        latched = [each for kept in self._latched.values() for each in kept]
        return [*(each._replace(received_ns=start_ns) for each in latched), *self._messages]

    def _expire(self, oldest_ns: int) -> None:
        cached = self._messages
        while cached and (self.bytes > self._max_bytes or cached[0].received_ns < oldest_ns):
            message = cached.popleft()
            self.bytes -= message.memory_size
            if message.topic in self._latched:
                self._latched[message.topic].append(message)


class SnapshotWriter:
    """Caches the last seconds and writes them on request, one snapshot at a time.

    ``thread`` writes each to a folder of its own in ``folder/snapshots``.
    """

    def __init__(
        self,
        folder: Path,
        cache: CircularMessageCache,
        definitions: MessageDefinitions,
        thread: WriterThread,
    ) -> None:
        self._folder = folder / FOLDER
        self._cache = cache
        self._definitions = definitions
        self._thread = thread
        self._topics: dict[str, TopicInformation] = {}
        self.busy = False
        self.completed = 0
        self.problem = ''
        """Why the last snapshot failed; empty if it did not."""

    def add_topic(self, topic: TopicInformation) -> None:
        """Add the metadata of a topic."""
        self._topics[topic.name] = topic
        if count := topic.transient_local_count:
            self._cache.keep_last(topic.name, count)

    def add(self, messages: list[SerializedMessage]) -> None:
        """Add messages to the cache, in order of reception."""
        self._cache.add(messages)

    def start(
        self,
        reason: str,
        now_ns: int,
        metadata_records: Mapping[str, Mapping[str, str]],
        attachments: Iterable[Attachment],
        finished: Callable[[bool, str], None],
    ) -> Path:
        """Start writing a snapshot and return its folder; raise :class:`BagError` if it cannot be.

        The cache ends at ``now_ns``, system time. The writing thread calls ``finished`` with
        success and a text.
        """
        if self.busy:
            raise BagError('another snapshot is being written: try again after it')
        messages = self._cache.messages(now_ns)
        if not messages:
            raise BagError('no message was received within storage.snapshot_duration')
        time = datetime.fromtimestamp(now_ns / 1e9)
        name = snapshot_folder_name(f'{time:%Y_%m_%d-%H_%M_%S}', reason)
        folder = unused_folder(self._folder, name)
        records = {**metadata_records, SNAPSHOT_RECORD: {'reason': reason, 'time_ns': str(now_ns)}}
        topics = dict(self._topics)  # the recorder adds others meanwhile
        self.busy = True

        def write() -> Iterator[None]:
            count = 0
            try:
                with BagWriter(
                    folder, metadata_records=records, definitions=self._definitions
                ) as bag:
                    for attachment in attachments:
                        bag.add_attachment(attachment)
                    recorded = _add_topics(bag, topics, {each.topic for each in messages})
                    for message in messages:
                        if message.topic in recorded:
                            bag.write(*message)
                            count += 1
                            if count % MESSAGES_PER_SLICE == 0:
                                yield
            except Exception as error:  # a silent thread would look like a complete snapshot
                self.problem = f'no snapshot of "{reason}": {error}'
            else:
                self.problem = ''
                self.completed += 1
            self.busy = False
            done = f'snapshot of "{reason}": {count} messages in {folder}'
            finished(not self.problem, self.problem or done)

        self._thread.run_in_slices(write())
        return folder


def _add_topics(
    bag: BagWriter, topics: Mapping[str, TopicInformation], present: set[str]
) -> set[str]:
    """Add the topics that have messages and known types; return their names."""
    added = set()
    for name, topic in topics.items():
        if name in present:
            try:
                bag.add_topic(name, topic.type_name, topic.offered_qos_profiles, topic.type_hash)
                added.add(name)
            except (UnknownTypeError, DataError):
                continue  # the recorder reported it when the topic appeared
    return added


def unused_folder(parent: Path, name: str) -> Path:
    """Return a path in ``parent`` that does not exist: ``name``, or ``name`` with a number."""
    path, number = parent / name, 2
    while path.exists():
        path, number = parent / f'{name}_{number}', number + 1
    return path


def snapshot_folder_name(time: str, reason: str) -> str:
    """Return the folder name of a snapshot: ``time`` and ``reason`` in ASCII letters."""
    words = re.sub(r'[^a-z0-9]+', '-', reason.lower()).strip('-')[:48].rstrip('-')
    return f'{time}_{words}' if words else time


# -- triggers -------------------------------------------------------------------------------------


ERROR_LEVEL = 2
"""``diagnostic_msgs/msg/DiagnosticStatus.ERROR``; STALE is higher."""
WAITING_PREFIX = 'stopped'
"""Beginning of the status message of a node that is not active yet."""
REPORT_TIMEOUT_NS = 5 * NANOSECONDS
"""Time without a report after which a node has failed; nodes report once per second."""


class DiagnosticsMonitor:
    """Detects the beginning of faults of the monitored nodes, by their names in the diagnostics.

    A fault begins when a healthy node reports an error (a stopped controller, an emergency stop,
    a lost link) or stops reporting. It ends with the next report below the error level; only then
    can the next fault of that node begin. A node that has not been healthy yet, because it waits
    for another node, has no fault.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self._names = frozenset(names)
        self._healthy: dict[str, int] = {}
        """Time of the last report of each healthy node, steady nanoseconds."""

    def update(self, name: str, level: int, text: str, now_ns: int) -> str:
        """Return node and text of the fault that begins with this report, else nothing."""
        if name not in self._names:
            return ''
        if level >= ERROR_LEVEL:
            return f'{name}: {text}' if self._healthy.pop(name, None) is not None else ''
        if text.startswith(WAITING_PREFIX):
            self._healthy.pop(name, None)  # the node was restarted
        else:
            self._healthy[name] = now_ns
        return ''

    def check_timeouts(self, now_ns: int) -> list[str]:
        """Return the faults of healthy nodes whose reports have timed out."""
        expired = [
            name for name, last in self._healthy.items() if now_ns - last > REPORT_TIMEOUT_NS
        ]
        for name in expired:
            del self._healthy[name]
        return [f'{name}: diagnostics timed out' for name in expired]


class SnapshotRateLimiter:
    """Limits the number of automatic snapshots in a run, and the time between two."""

    def __init__(self, min_interval_ns: int, max_count: int) -> None:
        self._min_interval_ns = min_interval_ns
        self._max_count = max_count
        self._count = 0
        self._last_ns: int | None = None

    def acquire(self, now_ns: int) -> str:
        """Return an empty text and count a permitted snapshot, or return why it is rejected."""
        if self._count >= self._max_count:
            return f'there have been {self._count} already (snapshot.max_count)'
        if self._last_ns is not None and now_ns - self._last_ns < self._min_interval_ns:
            ago = (now_ns - self._last_ns) / NANOSECONDS
            return f'the last one was {ago:.1f} s ago (snapshot.min_interval)'
        self._count += 1
        self._last_ns = now_ns
        return ''
