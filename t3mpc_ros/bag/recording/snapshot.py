# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Snapshots: a circular cache of the last seconds of all topics, and bags written from it."""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
import re
import threading

from t3mpc_ros.bag.mcap_file import Attachment, SerializedMessage
from t3mpc_ros.bag.metadata import TopicInformation
from t3mpc_ros.bag.schema import BagError, DataError, MessageDefinitions, UnknownTypeError
from t3mpc_ros.bag.writer import BagWriter

SNAPSHOT_RECORD = 'snapshot'
"""Title of the metadata record that contains the reason of a snapshot."""
FOLDER = 'snapshots'
SLICE_PAUSE = 0.01
"""Pause between the slices of a snapshot, s, so that its compression does not delay recording."""
MESSAGES_PER_SLICE = 200
"""Messages between two calls of ``pause``, which yields to the running recording."""


class CircularMessageCache:
    """Messages of the last seconds, and the last transient-local messages before them.

    Parameters
    ----------
    span_ns
        Time of receipt that the cache covers, nanoseconds.
    max_bytes
        Maximum memory of the messages; at this limit the cache covers less time.
    """

    def __init__(self, span_ns: int, max_bytes: int) -> None:
        self._span_ns = span_ns
        self._max_bytes = max_bytes
        self._messages: deque[SerializedMessage] = deque()
        self._latched: dict[str, deque[SerializedMessage]] = {}
        self._bytes = 0
        self._newest_ns = 0

    @property
    def bytes(self) -> int:
        """Memory of the cached messages, without the transient-local messages before the span."""
        return self._bytes

    def keep_last(self, topic: str, count: int) -> None:
        """Keep the last ``count`` messages of a transient-local topic regardless of their age."""
        kept = self._latched.get(topic, ())
        self._latched[topic] = deque(kept, maxlen=max(1, count))

    def add(self, messages: Iterable[SerializedMessage]) -> None:
        """Add ``messages`` in order of receipt, and remove the expired ones."""
        for message in messages:
            self._messages.append(message)
            self._bytes += message.memory_size
            self._newest_ns = max(self._newest_ns, message.received_ns)
        oldest_ns = self._newest_ns - self._span_ns
        cached = self._messages
        while cached and (self._bytes > self._max_bytes or cached[0].received_ns < oldest_ns):
            self._expire(cached.popleft())

    def messages(self, now_ns: int) -> list[SerializedMessage]:
        """Return the messages received in the span before ``now_ns``, transient-local ones first.

        A transient-local message from before the span gets the beginning of the span as its time
        of receipt, so that the bag is not longer than the span; its publish stamp is unchanged.
        """
        start_ns = max(0, now_ns - self._span_ns)
        recent = [message for message in self._messages if message.received_ns >= start_ns]
        if recent:
            start_ns = min(message.received_ns for message in recent)
        latched = [message for kept in self._latched.values() for message in kept]
        latched += [
            message
            for message in self._messages
            if message.received_ns < start_ns and message.topic in self._latched
        ]
        newest = {}
        for topic, kept in self._latched.items():
            of_topic = [message for message in latched if message.topic == topic]
            newest[topic] = of_topic[-(kept.maxlen or 1) :]
        first = [item._replace(received_ns=start_ns) for kept in newest.values() for item in kept]
        return [*first, *recent]

    def _expire(self, message: SerializedMessage) -> None:
        self._bytes -= message.memory_size
        if message.topic in self._latched:
            self._latched[message.topic].append(message)


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


def write_snapshot(
    folder: Path,
    messages: Sequence[SerializedMessage],
    *,
    topics: Mapping[str, TopicInformation],
    metadata_records: Mapping[str, Mapping[str, str]],
    attachments: Iterable[tuple[Attachment, int]] = (),
    definitions: MessageDefinitions | None = None,
    pause: Callable[[], object] = lambda: None,
) -> int:
    """Write the messages of ``topics`` to a bag in ``folder``; return their number.

    Raises
    ------
    FolderError
        The folder cannot be created.
    DiskError
        Writing failed; messages written before are kept.
    """
    count = 0
    with BagWriter(folder, metadata_records=metadata_records, definitions=definitions) as bag:
        for attachment, read_ns in attachments:
            bag.add_attachment(attachment, read_ns)
        present = {message.topic for message in messages}
        for name in [name for name in topics if name in present]:
            topic = topics[name]
            try:
                bag.add_topic(name, topic.type_name, topic.offered_qos_profiles, topic.type_hash)
            except (UnknownTypeError, DataError):
                present.discard(name)  # the recorder reported it when the topic appeared
        for message in messages:
            if message.topic in present and message.topic in topics:
                bag.write(*message)
                count += 1
                if count % MESSAGES_PER_SLICE == 0:
                    pause()
    return count


class SnapshotWriter:
    """Caches the last seconds and writes them on request, one snapshot at a time.

    Parameters
    ----------
    folder
        Folder of the bag; snapshots are written to a folder below it.
    cache
        Cache of the messages.
    definitions
        Source of the message schemas.
    """

    def __init__(
        self, folder: Path, cache: CircularMessageCache, definitions: MessageDefinitions
    ) -> None:
        self._folder = folder / FOLDER
        self._cache = cache
        self._definitions = definitions
        self._topics: dict[str, TopicInformation] = {}
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self.completed: list[Path] = []
        """Folders of the complete snapshots."""
        self.problem = ''
        """Why the last snapshot failed; empty if it did not."""

    @property
    def busy(self) -> bool:
        """Whether a snapshot is being written."""
        return self._thread is not None and self._thread.is_alive()

    def add_topic(self, topic: TopicInformation, latched: int) -> None:
        """Add the metadata of a topic with ``latched`` transient-local publishers."""
        self._topics[topic.name] = topic
        if latched:
            self._cache.keep_last(topic.name, latched)

    def add(self, messages: list[SerializedMessage]) -> None:
        """Add messages to the cache, in order of reception."""
        self._cache.add(messages)

    def start(
        self,
        reason: str,
        now_ns: int,
        metadata_records: Mapping[str, Mapping[str, str]],
        attachments: list[tuple[Attachment, int]],
        finished: Callable[[bool, str], None],
    ) -> Path:
        """Start writing a snapshot in a thread and return its folder.

        Parameters
        ----------
        reason
            Reason of the snapshot, for the folder name and the metadata.
        now_ns
            System time, ns since 1970, as the stamps of reception.
        metadata_records, attachments
            Further content of the bag.
        finished
            Called by the writing thread with success and a text.

        Raises
        ------
        BagError
            Another snapshot is being written, or the cache is empty.
        """
        if self.busy:
            raise BagError('another snapshot is being written: try again after it')
        messages = self._cache.messages(now_ns)
        if not messages:
            raise BagError('no message was received within snapshot_time')
        time = datetime.fromtimestamp(now_ns / 1e9)
        folder = unused_folder(
            self._folder, snapshot_folder_name(f'{time:%Y_%m_%d-%H_%M_%S}', reason)
        )
        record = {SNAPSHOT_RECORD: {'reason': reason, 'time_ns': str(now_ns)}}
        topics = dict(self._topics)

        def write() -> None:
            try:
                count = write_snapshot(
                    folder,
                    messages,
                    topics=topics,
                    metadata_records={**metadata_records, **record},
                    attachments=attachments,
                    definitions=self._definitions,
                    pause=lambda: self._closing.wait(SLICE_PAUSE),
                )
            except Exception as error:  # a silent thread would look like a complete snapshot
                self.problem = f'no snapshot of "{reason}": {error}'
                finished(False, self.problem)
            else:
                self.problem = ''
                self.completed.append(folder)
                finished(True, f'snapshot of "{reason}": {count} messages in {folder}')

        self._thread = threading.Thread(target=write, name='snapshot', daemon=True)
        self._thread.start()
        return folder

    def close(self, timeout: float) -> None:
        """Complete the current snapshot without pauses, within ``timeout`` seconds."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(timeout)
