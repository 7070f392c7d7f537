# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bag reader: decoded messages and time series of numbers from MCAP and sqlite3 bags."""

from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
import re
import struct
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.rosbag2 import ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from t3mpc_ros.bag.mcap_file import MCAP_SUFFIX, read_file_summary
from t3mpc_ros.bag.metadata import METADATA_FILE_NAME, collect_metadata
from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.bag.writer import DataError, UnknownTopicError
from t3mpc_ros.geometry.types import NANOSECONDS

Array = NDArray[np.float64]

_STEP = re.compile(r'(\w+)\[(\d+)\]')


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """Topic of a bag."""

    name: str
    type_name: str
    message_count: int


class BagReader:
    """Open bag with decoded messages; created by :func:`open_bag`, a context manager.

    Times are seconds since :attr:`start_ns`, the receive time of the first message.
    """

    def __init__(
        self,
        folder: Path,
        reader: Any,
        incomplete_files: tuple[str, ...],
        metadata_records: Mapping[str, Mapping[str, str]],
    ) -> None:
        self._reader = reader
        self.folder = folder
        self.incomplete_files = incomplete_files
        """Files without a valid end, which are skipped; ``finalize_file`` completes them."""
        self.metadata_records = metadata_records
        """Tables of text by title; the newest of each title."""
        some = reader.message_count > 0
        self.start_ns: int = reader.start_time if some else 0
        self.end_ns: int = reader.end_time - 1 if some else 0  # the end of rosbags is exclusive
        counts: dict[str, int] = {}
        for connection in reader.connections:
            counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        self.topics: dict[str, TopicSummary] = {
            name: TopicSummary(name, types[name], counts[name]) for name in sorted(types)
        }
        """By name, including topics without messages."""

    @property
    def duration(self) -> float:
        """Seconds between the first and the last message."""
        return (self.end_ns - self.start_ns) / NANOSECONDS

    @property
    def message_count(self) -> int:
        """Number of messages of all topics."""
        return sum(topic.message_count for topic in self.topics.values())

    def messages(self, topic: str) -> Iterator[tuple[float, Any]]:
        """Yield (received, message) in order of receipt.

        Raises
        ------
        UnknownTopicError
            The topic is not in the bag.
        DataError
            A message cannot be decoded.
        """
        if topic not in self.topics:
            available = ', '.join(self.topics) or 'no topic'
            raise UnknownTopicError(f'{topic} is not in {self.folder}, which contains {available}')
        selected = [item for item in self._reader.connections if item.topic == topic]
        with _read_errors(topic):
            for connection, received_ns, data in self._reader.messages(selected):
                message = self._reader.deserialize(data, connection.msgtype)
                yield (received_ns - self.start_ns) / NANOSECONDS, message

    def series(self, topic: str, fields: Mapping[str, str]) -> dict[str, Array]:
        """Return one array for each of ``fields``, with times of receipt and stamps.

        Parameters
        ----------
        topic
            Full name.
        fields
            Path of each field in the message, such as ``'twist.twist.linear.x'`` or
            ``'pose.covariance[7]'``. An element beyond the end of an array is NaN.

        Returns
        -------
        dict
            The fields; ``received``, the time of receipt; and ``stamp``, that of the header or,
            for a type without a header, ``received``. All have shape (n,), n the number of
            messages, in order of receipt.

        Raises
        ------
        UnknownTopicError
            The topic is not in the bag; :attr:`topics` lists the available ones.
        DataError
            The type has no such field, or the field is not a number.
        """
        getters = [_field_getter(path) for path in fields.values()]
        rows = array('d')  # a list of floats would take five times the memory
        for received, message in self.messages(topic):
            header = getattr(message, 'header', None)
            stamp = received if header is None else self._seconds(header.stamp)
            try:
                rows.extend([received, stamp, *[float(get(message)) for get in getters]])
            except (AttributeError, TypeError, ValueError) as error:
                kind = self.topics[topic].type_name
                raise DataError(f'{topic} ({kind}) has no such number: {error}') from error
        table = np.frombuffer(rows).reshape(-1, 2 + len(getters))
        names = ['received', 'stamp', *fields]
        return {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(names)}

    def close(self) -> None:
        """Close the files; idempotent."""
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _seconds(self, stamp: Any) -> float:
        nanoseconds = stamp.sec * NANOSECONDS + stamp.nanosec
        return float((nanoseconds - self.start_ns) / NANOSECONDS)


def open_bag(folder: Path | str) -> BagReader:
    """Open the bag in ``folder``, or a single bag file.

    All complete MCAP files of the folder are read, independently of ``metadata.yaml``, which is
    outdated if the recorder was killed. Bags of another storage are read through their
    ``metadata.yaml``.

    Raises
    ------
    BagError
        The folder contains no complete bag file, or a file is damaged.
    """
    folder = Path(folder)
    incomplete_files: tuple[str, ...] = ()
    if folder.is_file():
        paths = [folder]
    else:
        metadata, incomplete_files = collect_metadata(folder)
        paths = [folder / file.path for file in metadata.files]
    metadata_records: dict[str, dict[str, str]] = {}
    for path in paths:
        summary = read_file_summary(path) if path.suffix == MCAP_SUFFIX else None
        for title, table in (summary.metadata_records if summary else {}).items():
            if title != 'rosbag2':
                metadata_records[title] = dict(table)
    if not paths and not incomplete_files and (folder / METADATA_FILE_NAME).is_file():
        paths = [folder]
    if not paths:
        listing = f'; incomplete: {", ".join(incomplete_files)}' if incomplete_files else ''
        raise BagError(f'no complete bag file in {folder}{listing}')
    with _read_errors(str(folder)):
        reader = AnyReader(paths, default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    return BagReader(folder, reader, incomplete_files, metadata_records)


def missing_sample_ratio(stamps: Array, rate: float) -> float:
    """Return the ratio of missing samples, from 0 to 1.

    The number of distinct finite stamps is compared with the number of periods of ``rate``
    between the first and the last one. Latency, bursts and the order have no influence, and a
    duplicate does not replace a missing sample. The ratio of fewer than two stamps is 0.

    Parameters
    ----------
    stamps
        Seconds, shape (n,).
    rate
        Nominal samples per second.

    Raises
    ------
    ValueError
        ``rate`` is not positive.
    """
    if not rate > 0.0:
        raise ValueError(f'rate must be positive: got {rate}')
    present = np.unique(stamps[np.isfinite(stamps)])
    if present.size < 2:
        return 0.0
    expected = round(float(present[-1] - present[0]) * rate) + 1
    return max(0.0, 1.0 - present.size / expected)


def _field_getter(path: str) -> Callable[[Any], Any]:
    """Return a function that reads the field ``path`` of a message."""
    if '[' not in path:
        return attrgetter(path)
    steps: list[tuple[str, int | None]] = []
    for word in path.split('.'):
        match = _STEP.fullmatch(word)
        steps.append((match[1], int(match[2])) if match else (word, None))

    def get_field(message: Any) -> Any:
        for name, index in steps:
            message = getattr(message, name)
            if index is not None:
                if index >= len(message):
                    return np.nan
                message = message[index]
        return message

    return get_field


@contextmanager
def _read_errors(what: str) -> Iterator[None]:
    """Convert the errors of the reading library to :class:`DataError`."""
    try:
        yield
    except (AnyReaderError, ReaderError, SerdeError, OSError, struct.error, ValueError) as error:
        raise DataError(f'{what} cannot be read: {error}') from error
