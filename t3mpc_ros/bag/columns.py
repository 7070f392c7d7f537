# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Columns of numbers from the messages of a topic, extracted from CDR bytes without decoding each message."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.bag.chunk_reader import BagIndex, read_blocks
from t3mpc_ros.bag.writer import DataError
from t3mpc_ros.geometry.types import NANOSECONDS

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

BUFFER_BYTES = 2**21
"""Bytes that are gathered before numbers are taken out of them: so many as a cache holds."""

PADDING_BYTES = 64
"""Bytes behind a buffer that are read before the length of its last message is known."""

_CDR_HEADER = 4  # after the four bytes that say how a message is encoded
_RECORD_HEAD = 31  # opcode, length, channel, counter and two stamps in front of a message
_LITTLE_ENDIAN = 1


@dataclass(frozen=True)
class CdrLayout:
    """Where the numbers of a message type are."""

    stamped: bool
    """Whether it begins with a stamp."""
    texts: int
    """How many texts follow then; aligned to 8 bytes, the numbers come after them."""
    numbers: tuple[int, ...]
    """Which of the 8-byte numbers are wanted."""
    skipped: int = 0
    """Bytes of other things, before the texts."""
    whole: bool = False
    """Whether the numbers are integers."""


ODOMETRY = CdrLayout(True, 2, (0, 1, 3, 4, 5, 6, 43, 48))
"""x, y, quaternion x, y, z, w, linear x, angular z of ``nav_msgs/msg/Odometry``."""
TWIST = CdrLayout(False, 0, (0, 5))
"""Linear x and angular z of ``geometry_msgs/msg/Twist``."""
TWIST_STAMPED = CdrLayout(True, 1, (0, 5))
FLOAT64 = CdrLayout(False, 0, (0,))
JOURNAL = CdrLayout(False, 0, (0, 1, 2, 3, 4), skipped=12, whole=True)
"""A ``std_msgs/msg/Int64MultiArray`` of five numbers without named dimensions."""

CDR_LAYOUTS: Mapping[str, CdrLayout] = {
    'nav_msgs/msg/Odometry': ODOMETRY,
    'geometry_msgs/msg/Twist': TWIST,
    'geometry_msgs/msg/TwistStamped': TWIST_STAMPED,
    'std_msgs/msg/Float64': FLOAT64,
    'std_msgs/msg/Int64MultiArray': JOURNAL,
}


@dataclass(frozen=True)
class TopicColumns:
    """The messages of one topic, in order of receipt."""

    received_ns: Integers
    """By the recorder, shape (n,)."""
    published_ns: Integers
    """By the clock of the publisher, shape (n,); the same as received where nobody noted it."""
    stamps_ns: Integers
    """What the headers say, zeros without one, shape (n,)."""
    numbers: Array
    """As :class:`Layout` has them, shape (n, wanted)."""
    integers: Integers
    """The same, of a layout with whole numbers; else empty."""

    def __len__(self) -> int:
        return int(self.received_ns.size)


@dataclass
class _PendingMessages:
    """The messages of one topic that wait in the buffer."""

    layout: CdrLayout
    pairs: list[bytes] = field(default_factory=list)
    """As :func:`~t3mpc_ros.bag.chunk_reader.read_blocks` yields them; then the next two."""
    blocks: list[int] = field(default_factory=list)
    """Where in the buffer their blocks begin."""
    received: list[Integers] = field(default_factory=list)
    starts: list[Integers] = field(default_factory=list)
    """Of the records in the buffer."""
    parts: list[tuple[Integers, Integers, Integers, NDArray[Any]]] = field(default_factory=list)

    def settle(self) -> None:
        """Turn pairs into times of receipt and starts, all at once: most are a few messages."""
        if not self.pairs:
            return
        table = np.frombuffer(b''.join(self.pairs), '<i8').reshape(-1, 2)
        counts = [len(each) // 16 for each in self.pairs]
        self.received.append(table[:, 0])
        self.starts.append(table[:, 1] + np.repeat(self.blocks, counts))
        self.pairs.clear()
        self.blocks.clear()


def read_columns(held: BagIndex, topics: Iterable[str]) -> dict[str, TopicColumns]:
    """Return the numbers of several topics of a bag.

    Parameters
    ----------
    held
        What the bag holds.
    topics
        Full names of topics with a type of :data:`LAYOUTS`.

    Raises
    ------
    DataError
        A type that has no layout here, or a message that is not laid out as its type is.
    BagError
        The bag cannot be read.
    """
    waiting: dict[str, _PendingMessages] = {}
    for name in topics:
        kind = held.types.get(name, 'missing')
        if kind not in CDR_LAYOUTS:
            raise DataError(f'{name} must be of {", ".join(CDR_LAYOUTS)}: got {kind}')
        waiting[name] = _PendingMessages(CDR_LAYOUTS[kind])
    for data in _buffers(held, waiting):
        for layout in CDR_LAYOUTS.values():
            alike = {
                k: each for k, each in waiting.items() if each.layout is layout and each.starts
            }
            if alike:
                _extract(alike, layout, data)
    columns = {name: _to_columns(gathered) for name, gathered in waiting.items()}
    for name, column in columns.items():
        if len(column) != held.counts[name]:
            raise DataError(
                f'{name} must have {held.counts[name]} messages, as the end of the bag says: '
                f'its indexes lead to {len(column)}'
            )
    return columns


def read_strings(held: BagIndex, topic: str) -> list[tuple[int, str]]:
    """Return (received, text) of the ``std_msgs/msg/String`` messages of a topic, times in ns.

    Raises
    ------
    DataError
        A message is no text.
    BagError
        The bag cannot be read.
    """
    waiting = {topic: _PendingMessages(FLOAT64)}
    found = []
    for data in _buffers(held, waiting):
        gathered = waiting[topic]
        for received, starts in zip(gathered.received, gathered.starts, strict=True):
            sizes = _values_at(data, starts + _RECORD_HEAD + _CDR_HEADER, '<u4').tolist()
            limits = (starts + 9 + _values_at(data, starts + 1, '<i8')).tolist()
            begins = (starts + _RECORD_HEAD + _CDR_HEADER + 4).tolist()
            for when, begin, size, limit in zip(
                received.tolist(), begins, sizes, limits, strict=True
            ):
                _check(topic, begin + size <= limit)
                found.append((when, bytes(data[begin : begin + size - 1]).decode()))
        gathered.received.clear()
        gathered.starts.clear()
    return sorted(found, key=lambda item: item[0])


def _buffers(held: BagIndex, waiting: Mapping[str, _PendingMessages]) -> Iterator[Bytes]:
    """Yield buffers of messages, after noting in ``waiting`` where in them each topic's are."""
    for path, summary in held.files:
        buffers: list[bytes] = []
        size = 0
        for data, found in read_blocks(path, summary, waiting.keys()):
            for name, pairs in found:
                waiting[name].pairs.append(pairs)
                waiting[name].blocks.append(size)
            buffers.append(data)
            size += len(data)
            if size >= BUFFER_BYTES:
                yield _join_buffers(path, buffers, waiting)
                buffers, size = [], 0
        if buffers:
            yield _join_buffers(path, buffers, waiting)


def _join_buffers(
    path: Path, buffers: list[bytes], waiting: Mapping[str, _PendingMessages]
) -> Bytes:
    """Return one buffer, after looking whether messages begin where the indexes say so."""
    size = sum(map(len, buffers))
    for each in waiting.values():
        each.settle()
    # What is read beyond the end of the last message, before its length is checked.
    data = np.frombuffer(b''.join([*buffers, bytes(PADDING_BYTES)]), dtype=np.uint8)
    starts = _concatenate(each.starts for each in waiting.values())
    received = _concatenate(each.received for each in waiting.values())
    # An index has no checksum of its own; what it leads to must be what it says.
    within = starts.size == 0 or 0 <= starts.min() <= starts.max() < size
    if not within or (_values_at(data, starts + 15, '<i8') != received).any():
        raise DataError(f'{path}: an index of messages is damaged')
    return data


def _concatenate(parts: Iterable[list[Integers]]) -> Integers:
    return np.concatenate(
        [np.zeros(0, dtype=np.int64), *(each for part in parts for each in part)]
    )


def _extract(alike: Mapping[str, _PendingMessages], layout: CdrLayout, data: Bytes) -> None:
    """Take the numbers of topics of one type out of a buffer; together, for there are many."""
    starts = [np.concatenate(gathered.starts) for gathered in alike.values()]
    parts = _numbers(', '.join(alike), layout, data, np.concatenate(starts))
    first = 0
    for gathered, own in zip(alike.values(), starts, strict=True):
        rows = slice(first, first + own.size)
        published, stamps, numbers = (part[rows] for part in parts)
        received = np.concatenate(gathered.received)
        gathered.parts.append((received, published, stamps, numbers))
        gathered.received.clear()
        gathered.starts.clear()
        first += own.size


def _numbers(
    name: str, layout: CdrLayout, data: Bytes, records: Integers
) -> tuple[Integers, Integers, NDArray[Any]]:
    """Return when the messages were published, their stamps, and their numbers."""
    lengths = _values_at(data, records + 1, '<i8') - 22
    published = _values_at(data, records + 23, '<i8')
    starts = records + _RECORD_HEAD
    _check(
        name,
        bool(((lengths >= _CDR_HEADER) & (starts + lengths <= data.size - PADDING_BYTES)).all()),
    )
    if np.any(data[starts + 1] != _LITTLE_ENDIAN):
        raise DataError(f'{name} holds a message that is not little-endian CDR')
    # One number for all as long as no text comes before.
    at: Any = _CDR_HEADER + 8 * layout.stamped + layout.skipped
    for _ in range(layout.texts):
        at = (at + 3) // 4 * 4
        sizes = _values_at(data, starts + at, '<u4').astype(np.int64)
        at = at + 4 + sizes
        _check(name, bool((at <= lengths).all()))
    at = (at - _CDR_HEADER + 7) // 8 * 8 + _CDR_HEADER
    _check(name, bool((at + 8 * max(layout.numbers) + 8 <= lengths).all()))
    if layout is JOURNAL:
        # No named dimensions, no offset, and five numbers.
        for k, said in enumerate((0, 0, len(layout.numbers))):
            _check(
                name, bool((_values_at(data, starts + _CDR_HEADER + 4 * k, '<u4') == said).all())
            )
    stamps = np.zeros(starts.shape, dtype=np.int64)
    if layout.stamped:
        seconds = _values_at(data, starts + _CDR_HEADER, '<i4').astype(np.int64)
        rest = _values_at(data, starts + _CDR_HEADER + 4, '<u4').astype(np.int64)
        stamps = seconds * NANOSECONDS + rest
    kind = '<i8' if layout.whole else '<f8'
    first = starts + at
    numbers = np.empty((starts.size, len(layout.numbers)), kind)
    for column, k in enumerate(layout.numbers):
        numbers[:, column] = _values_at(data, first + 8 * k, kind)
    return published, stamps, numbers


def _values_at(data: Bytes, starts: Integers, kind: str) -> NDArray[Any]:
    """Return the number at each start, wherever it is aligned, shape (n,)."""
    size = np.dtype(kind).itemsize
    everywhere = np.ndarray((data.size - size + 1,), kind, data.data, strides=(1,))
    return everywhere[starts]


def _check(name: str, sound: bool) -> None:
    if not sound:
        raise DataError(f'{name} holds a message that is not laid out as its type is')


def _to_columns(gathered: _PendingMessages) -> TopicColumns:
    none = np.zeros(0, dtype=np.int64)
    wanted = len(gathered.layout.numbers)
    empty = (none, none, none, np.zeros((0, wanted), np.int64 if gathered.layout.whole else float))
    parts = gathered.parts or [empty]
    received, published, stamps, numbers = (
        np.concatenate([part[i] for part in parts]) for i in range(4)
    )
    if (np.diff(received) < 0).any():  # several files, or a recorder that sorted otherwise
        order = np.argsort(received, kind='stable')
        received, published, stamps, numbers = (
            each[order] for each in (received, published, stamps, numbers)
        )
    nothing = np.zeros((len(received), 0))
    if gathered.layout.whole:
        return TopicColumns(received, published, stamps, nothing, numbers)
    return TopicColumns(received, published, stamps, numbers, nothing.astype(np.int64))
