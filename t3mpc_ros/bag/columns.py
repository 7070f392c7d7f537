# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Columns of numbers from the messages of a topic, without decoding each message.

Inputs and outputs of the controller have simple CDR layouts: at most a stamp, some strings, then
8-byte numbers. The position of a number thus follows from the lengths of the strings, which are
verified for every message.
"""

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
"""Size of a buffer from which numbers are extracted; it fits into the processor cache."""

PADDING_BYTES = 64
"""Bytes after a buffer, which are read before the length of the last message is verified."""

_CDR_HEADER = 4  # encapsulation header of a message
_RECORD_HEAD = 31  # opcode, length, channel, sequence number and two stamps before the data
_LITTLE_ENDIAN = 1


@dataclass(frozen=True)
class CdrLayout:
    """Positions of the numbers in a message type."""

    stamped: bool
    """Whether the message begins with a stamp."""
    strings: int
    """Number of strings after the stamp; the numbers follow them, aligned to 8 bytes."""
    numbers: tuple[int, ...]
    """Indices of the extracted 8-byte numbers."""
    skipped: int = 0
    """Bytes of other fields before the strings."""
    integer: bool = False
    """Whether the numbers are integers."""


ODOMETRY = CdrLayout(True, 2, (0, 1, 3, 4, 5, 6, 43, 48))
"""x, y, quaternion x, y, z, w, linear x, angular z of ``nav_msgs/msg/Odometry``."""
TWIST = CdrLayout(False, 0, (0, 5))
"""Linear x and angular z of ``geometry_msgs/msg/Twist``."""
TWIST_STAMPED = CdrLayout(True, 1, (0, 5))
FLOAT64 = CdrLayout(False, 0, (0,))
JOURNAL = CdrLayout(False, 0, (0, 1, 2, 3, 4), skipped=12, integer=True)
"""A ``std_msgs/msg/Int64MultiArray`` with five numbers and without dimensions."""

CDR_LAYOUTS: Mapping[str, CdrLayout] = {
    'nav_msgs/msg/Odometry': ODOMETRY,
    'geometry_msgs/msg/Twist': TWIST,
    'geometry_msgs/msg/TwistStamped': TWIST_STAMPED,
    'std_msgs/msg/Float64': FLOAT64,
    'std_msgs/msg/Int64MultiArray': JOURNAL,
}


@dataclass(frozen=True)
class TopicColumns:
    """Numbers of the n messages of one topic, in order of receipt."""

    received_ns: Integers
    """Receive times, shape (n,)."""
    published_ns: Integers
    """Publish times, shape (n,); equal to ``received_ns`` if not recorded."""
    stamps_ns: Integers
    """Stamps of the headers, shape (n,); zeros for a type without a header."""
    numbers: Array
    """Floating-point numbers of the :class:`CdrLayout`, shape (n, number of columns)."""
    integers: Integers
    """Integers of a layout of integers, same shape; else empty."""

    def __len__(self) -> int:
        return int(self.received_ns.size)


@dataclass
class _PendingMessages:
    """Messages of one topic in the buffer, and the numbers extracted so far."""

    layout: CdrLayout
    pairs: list[bytes] = field(default_factory=list)
    """Message offsets by block, see :data:`~t3mpc_ros.bag.chunk_reader.MessageOffsets`."""
    blocks: list[int] = field(default_factory=list)
    """Positions of these blocks in the buffer."""
    received: list[Integers] = field(default_factory=list)
    """Receive times, by call of :meth:`resolve_offsets`."""
    starts: list[Integers] = field(default_factory=list)
    """Positions of the records in the buffer."""
    parts: list[tuple[Integers, Integers, Integers, NDArray[Any]]] = field(default_factory=list)
    """Receive times, publish times, stamps and numbers by buffer."""

    def resolve_offsets(self) -> None:
        """Convert all pairs to receive times and positions in one operation."""
        if not self.pairs:
            return
        table = np.frombuffer(b''.join(self.pairs), '<i8').reshape(-1, 2)
        counts = [len(each) // 16 for each in self.pairs]
        self.received.append(table[:, 0])
        self.starts.append(table[:, 1] + np.repeat(self.blocks, counts))
        self.pairs.clear()
        self.blocks.clear()


def read_columns(index: BagIndex, topics: Iterable[str]) -> dict[str, TopicColumns]:
    """Return the numbers of several topics of a bag.

    Parameters
    ----------
    index
        Index of the bag.
    topics
        Full names of topics with a type of :data:`CDR_LAYOUTS`.

    Raises
    ------
    DataError
        A type has no layout here, or a message does not have the layout of its type.
    BagError
        The bag cannot be read.
    """
    pending: dict[str, _PendingMessages] = {}
    for name in topics:
        type_name = index.types.get(name, 'missing')
        if type_name not in CDR_LAYOUTS:
            raise DataError(f'{name} must be of {", ".join(CDR_LAYOUTS)}: got {type_name}')
        pending[name] = _PendingMessages(CDR_LAYOUTS[type_name])
    for data in _buffers(index, pending):
        for layout in CDR_LAYOUTS.values():
            alike = {
                k: each for k, each in pending.items() if each.layout is layout and each.starts
            }
            if alike:
                _extract(alike, layout, data)
    columns = {name: _to_columns(each) for name, each in pending.items()}
    for name, column in columns.items():
        if len(column) != index.counts[name]:
            raise DataError(
                f'{name} must have {index.counts[name]} messages according to the statistics of '
                f'the bag: its message indexes have {len(column)}'
            )
    return columns


def read_strings(index: BagIndex, topic: str) -> list[tuple[int, str]]:
    """Return (received, text) of the ``std_msgs/msg/String`` messages of a topic, times in ns.

    Raises
    ------
    DataError
        A message is not a string.
    BagError
        The bag cannot be read.
    """
    pending = {topic: _PendingMessages(FLOAT64)}
    found = []
    for data in _buffers(index, pending):
        messages = pending[topic]
        for received, starts in zip(messages.received, messages.starts, strict=True):
            sizes = _values_at(data, starts + _RECORD_HEAD + _CDR_HEADER, '<u4').tolist()
            limits = (starts + 9 + _values_at(data, starts + 1, '<i8')).tolist()
            begins = (starts + _RECORD_HEAD + _CDR_HEADER + 4).tolist()
            for when, begin, size, limit in zip(
                received.tolist(), begins, sizes, limits, strict=True
            ):
                _check(topic, begin + size <= limit)
                found.append((when, bytes(data[begin : begin + size - 1]).decode()))
        messages.received.clear()
        messages.starts.clear()
    return sorted(found, key=lambda item: item[0])


def _buffers(index: BagIndex, pending: Mapping[str, _PendingMessages]) -> Iterator[Bytes]:
    """Yield buffers of records; store the positions of the messages in ``pending``."""
    for path, summary in index.files:
        buffers: list[bytes] = []
        size = 0
        for data, found in read_blocks(path, summary, pending.keys()):
            for name, pairs in found:
                pending[name].pairs.append(pairs)
                pending[name].blocks.append(size)
            buffers.append(data)
            size += len(data)
            if size >= BUFFER_BYTES:
                yield _join_buffers(path, buffers, pending)
                buffers, size = [], 0
        if buffers:
            yield _join_buffers(path, buffers, pending)


def _join_buffers(
    path: Path, buffers: list[bytes], pending: Mapping[str, _PendingMessages]
) -> Bytes:
    """Return one padded buffer, after verifying that every index entry points to its message."""
    size = sum(map(len, buffers))
    for each in pending.values():
        each.resolve_offsets()
    data = np.frombuffer(b''.join([*buffers, bytes(PADDING_BYTES)]), dtype=np.uint8)
    starts = _concatenate(each.starts for each in pending.values())
    received = _concatenate(each.received for each in pending.values())
    # A message index has no checksum: the receive stamp of the record must agree.
    within = starts.size == 0 or 0 <= starts.min() <= starts.max() < size
    if not within or (_values_at(data, starts + 15, '<i8') != received).any():
        raise DataError(f'{path}: a message index is damaged')
    return data


def _concatenate(parts: Iterable[list[Integers]]) -> Integers:
    return np.concatenate(
        [np.zeros(0, dtype=np.int64), *(each for part in parts for each in part)]
    )


def _extract(alike: Mapping[str, _PendingMessages], layout: CdrLayout, data: Bytes) -> None:
    """Extract the numbers of all topics of one type from a buffer."""
    starts = [np.concatenate(each.starts) for each in alike.values()]
    parts = _numbers(', '.join(alike), layout, data, np.concatenate(starts))
    first = 0
    for each, own in zip(alike.values(), starts, strict=True):
        rows = slice(first, first + own.size)
        published, stamps, numbers = (part[rows] for part in parts)
        received = np.concatenate(each.received)
        each.parts.append((received, published, stamps, numbers))
        each.received.clear()
        each.starts.clear()
        first += own.size


def _numbers(
    name: str, layout: CdrLayout, data: Bytes, records: Integers
) -> tuple[Integers, Integers, NDArray[Any]]:
    """Return publish times, header stamps and numbers of messages."""
    lengths = _values_at(data, records + 1, '<i8') - 22
    published = _values_at(data, records + 23, '<i8')
    starts = records + _RECORD_HEAD
    _check(
        name,
        bool(((lengths >= _CDR_HEADER) & (starts + lengths <= data.size - PADDING_BYTES)).all()),
    )
    if np.any(data[starts + 1] != _LITTLE_ENDIAN):
        raise DataError(f'{name} has a message that is not little-endian CDR')
    # A scalar for types without strings, else one offset per message.
    at: Any = _CDR_HEADER + 8 * layout.stamped + layout.skipped
    for _ in range(layout.strings):
        at = (at + 3) // 4 * 4
        sizes = _values_at(data, starts + at, '<u4').astype(np.int64)
        at = at + 4 + sizes
        _check(name, bool((at <= lengths).all()))
    at = (at - _CDR_HEADER + 7) // 8 * 8 + _CDR_HEADER
    _check(name, bool((at + 8 * max(layout.numbers) + 8 <= lengths).all()))
    if layout is JOURNAL:
        # No dimensions, no offset, and five numbers.
        for k, expected in enumerate((0, 0, len(layout.numbers))):
            found = _values_at(data, starts + _CDR_HEADER + 4 * k, '<u4')
            _check(name, bool((found == expected).all()))
    stamps = np.zeros(starts.shape, dtype=np.int64)
    if layout.stamped:
        seconds = _values_at(data, starts + _CDR_HEADER, '<i4').astype(np.int64)
        rest = _values_at(data, starts + _CDR_HEADER + 4, '<u4').astype(np.int64)
        stamps = seconds * NANOSECONDS + rest
    dtype = '<i8' if layout.integer else '<f8'
    first = starts + at
    numbers = np.empty((starts.size, len(layout.numbers)), dtype)
    for column, k in enumerate(layout.numbers):
        numbers[:, column] = _values_at(data, first + 8 * k, dtype)
    return published, stamps, numbers


def _values_at(data: Bytes, starts: Integers, dtype: str) -> NDArray[Any]:
    """Return the number at each position, of any alignment, shape (n,)."""
    size = np.dtype(dtype).itemsize
    everywhere = np.ndarray((data.size - size + 1,), dtype, data.data, strides=(1,))
    return everywhere[starts]


def _check(name: str, valid: bool) -> None:
    if not valid:
        raise DataError(f'{name} has a message that does not have the layout of its type')


def _to_columns(messages: _PendingMessages) -> TopicColumns:
    none = np.zeros(0, dtype=np.int64)
    layout = messages.layout
    no_numbers = np.zeros((0, len(layout.numbers)), np.int64 if layout.integer else float)
    parts = messages.parts or [(none, none, none, no_numbers)]
    received, published, stamps, numbers = (
        np.concatenate([part[i] for part in parts]) for i in range(4)
    )
    if (np.diff(received) < 0).any():  # several files, or another order of the recorder
        order = np.argsort(received, kind='stable')
        received, published, stamps, numbers = (
            each[order] for each in (received, published, stamps, numbers)
        )
    empty = np.zeros((len(received), 0))
    if layout.integer:
        return TopicColumns(received, published, stamps, empty, numbers)
    return TopicColumns(received, published, stamps, numbers, empty.astype(np.int64))
