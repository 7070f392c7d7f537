# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Cache of the last seconds of all topics, and snapshots written from it."""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from t3mpc_ros.bag.schema import MessageDefinitions, UnknownTypeError
from t3mpc_ros.bag.writer import Attachment, BagWriter, DataError, SerializedMessage, TopicMetadata

SNAPSHOT_RECORD = 'snapshot'
"""Title of the details that say why a snapshot was taken."""
MESSAGES_PER_SLICE = 200
"""Messages between two calls of ``pause``: the recording must go on meanwhile."""


class CircularMessageCache:
    """Messages of the last seconds, and the latched ones that still held when those began.

    Parameters
    ----------
    span_ns
        How far back it reaches, nanoseconds of receipt.
    most_bytes
        What the messages may take in memory; beyond it, it reaches less far back.
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
        """Memory that it takes, without the latched messages."""
        return self._bytes

    def latch(self, topic: str, count: int) -> None:
        """Keep the last ``count`` messages of ``topic`` however old: one of each publisher."""
        kept = self._latched.get(topic, ())
        self._latched[topic] = deque(kept, maxlen=max(1, count))

    def add(self, messages: Iterable[SerializedMessage]) -> None:
        """Keep ``messages``, in order of receipt, and let go of what has become too old."""
        for message in messages:
            self._messages.append(message)
            self._bytes += message.cost
            self._newest_ns = max(self._newest_ns, message.received_ns)
        oldest_ns = self._newest_ns - self._span_ns
        held = self._messages
        while held and (self._bytes > self._max_bytes or held[0].received_ns < oldest_ns):
            self._let_go(held.popleft())

    def held(self, now_ns: int) -> list[SerializedMessage]:
        """Return what was received in the span before ``now_ns``, latched messages first.

        A latched message from before the span is given the receipt stamp of the span's begin,
        so that the bag is no longer than the span; its other stamp tells how old it is.
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

    def _let_go(self, message: SerializedMessage) -> None:
        self._bytes -= message.cost
        if message.topic in self._latched:
            self._latched[message.topic].append(message)


def unused_folder(parent: Path, name: str) -> Path:
    """Return a folder in ``parent`` that is not there yet: ``name``, or with a number behind."""
    path, number = parent / name, 2
    while path.exists():
        path, number = parent / f'{name}_{number}', number + 1
    return path


def write_snapshot(
    folder: Path,
    messages: Sequence[SerializedMessage],
    *,
    topics: Mapping[str, TopicMetadata],
    metadata_records: Mapping[str, Mapping[str, str]],
    attachments: Iterable[tuple[Attachment, int]] = (),
    definitions: MessageDefinitions | None = None,
    pause: Callable[[], object] = lambda: None,
) -> int:
    """Return how many messages the bag in ``folder`` got: those of announced topics.

    Raises
    ------
    FolderError
        The folder cannot be made.
    DiskError
        Writing failed; what was written before is kept.
    """
    count = 0
    with BagWriter(folder, metadata_records=metadata_records, definitions=definitions) as bag:
        for attachment, read_ns in attachments:
            bag.add_attachment(attachment, read_ns)
        there = {message.topic for message in messages}
        for name in [name for name in topics if name in there]:
            topic = topics[name]
            try:
                bag.add_topic(name, topic.type_name, topic.profiles, topic.type_hash)
            except (UnknownTypeError, DataError):
                there.discard(name)  # the recorder has said so when the topic came
        for message in messages:
            if message.topic in there and message.topic in topics:
                bag.write(*message)
                count += 1
                if count % MESSAGES_PER_SLICE == 0:
                    pause()
    return count
