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
"""Columns of a topic: fields with a simple CDR layout, read without decoding each message."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.bag.errors import DataError
from t3mpc_ros.bag.reader import BagReader
from t3mpc_ros.geometry.types import NANOSECONDS

Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]
BATCH_SIZE = 2000
"""Number of messages from which numbers are extracted at once; they fit into the cache."""
PADDING = bytes(64)
"""Bytes after a batch, which are read before the length of the last message is verified."""
_CDR_HEADER = 4  # encapsulation header of a message
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
    head: tuple[int, ...] = ()
    """Expected 4-byte numbers before the strings."""
    integer: bool = False


CDR_LAYOUTS: Mapping[str, CdrLayout] = {
    # x, y, quaternion x, y, z, w, linear x, angular z, linear y
    'nav_msgs/msg/Odometry': CdrLayout(True, 2, (0, 1, 3, 4, 5, 6, 43, 48, 44)),
    # linear x and angular z
    'geometry_msgs/msg/Twist': CdrLayout(False, 0, (0, 5)),
    'geometry_msgs/msg/TwistStamped': CdrLayout(True, 1, (0, 5)),
    'std_msgs/msg/Float64': CdrLayout(False, 0, (0,)),
    # a row of the journal: no dimensions, no offset, and five numbers
    'std_msgs/msg/Int64MultiArray': CdrLayout(False, 0, (0, 1, 2, 3, 4), (0, 0, 5), True),
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
    numbers: NDArray[Any]
    """Those of the :class:`CdrLayout`, integers or not, shape (n, number of columns)."""

    def __len__(self) -> int:
        return int(self.received_ns.size)


@dataclass
class _Batches:
    """Messages of one topic, converted in batches."""

    topic: str
    layout: CdrLayout
    times: list[tuple[int, int]] = field(default_factory=list)
    """Receive and publish times of all messages."""
    waiting: list[bytes] = field(default_factory=list)
    parts: list[tuple[Integers, NDArray[Any]]] = field(default_factory=list)
    """Stamps and numbers by batch."""

    def add(self, received_ns: int, published_ns: int, data: bytes) -> None:
        self.times.append((received_ns, published_ns))
        self.waiting.append(data)
        if len(self.waiting) == BATCH_SIZE:
            self.convert()

    def convert(self) -> None:
        """Convert the waiting messages."""
        self.parts.append(_numbers(self.topic, self.layout, self.waiting))
        self.waiting = []

    def columns(self) -> TopicColumns:
        self.convert()
        times = np.array(self.times, dtype=np.int64).reshape(-1, 2)
        stamps, numbers = (np.concatenate(each) for each in zip(*self.parts, strict=True))
        received, published = np.ascontiguousarray(times.T)
        return TopicColumns(received, published, stamps, numbers)


def read_columns(bag: BagReader, topics: Iterable[str]) -> dict[str, TopicColumns]:
    """Return the numbers of several topics of a bag, of the types in :data:`CDR_LAYOUTS`.

    Another type, or a message with another layout, raises :class:`DataError`.
    """
    batches: dict[str, _Batches] = {}
    for name in topics:
        type_name = bag.topics[name].type_name if name in bag.topics else 'missing'
        if type_name not in CDR_LAYOUTS:
            raise DataError(f'{name} must be of {", ".join(CDR_LAYOUTS)}: got {type_name}')
        batches[name] = _Batches(name, CDR_LAYOUTS[type_name])
    for name, received_ns, published_ns, data in bag.serialized_messages(batches.keys()):
        batches[name].add(received_ns, published_ns, data)
    for name, each in batches.items():
        if len(each.times) != bag.topics[name].message_count:
            raise DataError(
                f'{name} must have {bag.topics[name].message_count} messages according to the '
                f'statistics of the bag: it has {len(each.times)}'
            )
    return {name: each.columns() for name, each in batches.items()}


def _numbers(
    name: str, layout: CdrLayout, messages: Sequence[bytes]
) -> tuple[Integers, NDArray[Any]]:
    """Return header stamps and numbers of messages."""
    data = np.frombuffer(b''.join([*messages, PADDING]), dtype=np.uint8)
    lengths = np.array([*map(len, messages)], dtype=np.int64)
    starts = np.cumsum(lengths) - lengths
    _check(name, bool((lengths >= _CDR_HEADER).all()))
    if np.any(data[starts + 1] != _LITTLE_ENDIAN):
        raise DataError(f'{name} has a message that is not little-endian CDR')
    # A scalar for types without strings, else one offset per message.
    at: Any = _CDR_HEADER + 8 * layout.stamped + 4 * len(layout.head)
    for _ in range(layout.strings):
        at = (at + 3) // 4 * 4
        at = at + 4 + _values_at(data, starts + at, '<u4').astype(np.int64)
        _check(name, bool((at <= lengths).all()))
    at = (at - _CDR_HEADER + 7) // 8 * 8 + _CDR_HEADER
    _check(name, bool((at + 8 * max(layout.numbers) + 8 <= lengths).all()))
    for k, expected in enumerate(layout.head):
        found = _values_at(data, starts + _CDR_HEADER + 4 * k, '<u4')
        _check(name, bool((found == expected).all()))
    stamps = np.zeros(starts.shape, dtype=np.int64)
    if layout.stamped:
        seconds = _values_at(data, starts + _CDR_HEADER, '<i4').astype(np.int64)
        rest = _values_at(data, starts + _CDR_HEADER + 4, '<u4').astype(np.int64)
        stamps = seconds * NANOSECONDS + rest
    dtype = '<i8' if layout.integer else '<f8'
    numbers = np.empty((starts.size, len(layout.numbers)), dtype)
    for column, k in enumerate(layout.numbers):
        numbers[:, column] = _values_at(data, starts + at + 8 * k, dtype)
    return stamps, numbers


def _values_at(data: Bytes, starts: Integers, dtype: str) -> NDArray[Any]:
    """Return the number at each position, of any alignment, shape (n,)."""
    size = np.dtype(dtype).itemsize
    everywhere = np.ndarray((data.size - size + 1,), dtype, data.data, strides=(1,))
    return everywhere[starts]


def _check(name: str, valid: bool) -> None:
    if not valid:
        raise DataError(f'{name} has a message that does not have the layout of its type')
