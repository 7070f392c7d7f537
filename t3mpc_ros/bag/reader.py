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
    """One topic of a recording."""

    name: str
    type_name: str
    message_count: int


class BagReader:
    """A bag that is open for reading; made by :func:`open_recording`, closed by ``with``.

    Times are seconds since :attr:`start_ns`, the receipt of the first message.
    """

    def __init__(
        self,
        folder: Path,
        reader: Any,
        unfinished: tuple[str, ...],
        metadata_records: Mapping[str, Mapping[str, str]],
    ) -> None:
        self._reader = reader
        self.folder = folder
        self.unfinished = unfinished
        """Files that broke off and are not read; ``mcap_file.finish`` mends them."""
        self.metadata_records = metadata_records
        """Tables of text by title, as given to the writer; of one title the newest."""
        some = reader.message_count > 0
        self.start_ns: int = reader.start_time if some else 0
        self.end_ns: int = reader.end_time - 1 if some else 0  # rosbags' end is exclusive
        counts: dict[str, int] = {}
        for connection in reader.connections:
            counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        self.topics: dict[str, TopicSummary] = {
            name: TopicSummary(name, types[name], counts[name]) for name in sorted(types)
        }
        """By name; a topic may have no message."""

    @property
    def duration(self) -> float:
        """Seconds between the first and the last message."""
        return (self.end_ns - self.start_ns) / NANOSECONDS

    @property
    def message_count(self) -> int:
        """Messages on all topics."""
        return sum(topic.message_count for topic in self.topics.values())

    def messages(self, topic: str) -> Iterator[tuple[float, Any]]:
        """Yield (received, message) in order of receipt.

        Raises
        ------
        UnknownTopicError
            The topic is not in the bag.
        DataError
            A message cannot be read.
        """
        if topic not in self.topics:
            near = ', '.join(self.topics) or 'nothing'
            raise UnknownTopicError(f'{topic} is not in {self.folder}, which holds {near}')
        chosen = [item for item in self._reader.connections if item.topic == topic]
        with _read_errors(topic):
            for connection, received_ns, data in self._reader.messages(chosen):
                message = self._reader.deserialize(data, connection.msgtype)
                yield (received_ns - self.start_ns) / NANOSECONDS, message

    def series(self, topic: str, fields: Mapping[str, str]) -> dict[str, Array]:
        """Return one array for each of ``fields``, and the times they belong to.

        Parameters
        ----------
        topic
            Full name.
        fields
            Where to find each array in a message, such as ``'twist.twist.linear.x'`` or
            ``'pose.covariance[7]'``. An element beyond the end of an array reads as NaN.

        Returns
        -------
        dict
            The fields; ``received``, when each message came; and ``stamp``, what its header says
            or, for a type without a header, ``received`` again. All are shape (n,), n the
            number of messages, and in order of receipt; a topic without messages gives n = 0.

        Raises
        ------
        UnknownTopicError
            The topic is not in the bag: look into :attr:`topics` first where it may be absent.
        DataError
            The type has no such field, or it is not a number.
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
        """Let go of the files; again, do nothing."""
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
    """Return the bag in ``folder``, or in the one file that is given instead.

    Every finished MCAP file of the folder is read, whatever ``metadata.yaml`` says, so that a
    bag whose recorder was killed can be read too; a bag of another storage is read through its
    ``metadata.yaml``.

    Raises
    ------
    BagError
        There is no bag, no finished file in it, or one that is damaged.
    """
    folder = Path(folder)
    unfinished: tuple[str, ...] = ()
    if folder.is_file():
        paths = [folder]
    else:
        metadata, unfinished = collect_metadata(folder)
        paths = [folder / file.path for file in metadata.files]
    metadata_records: dict[str, dict[str, str]] = {}
    for path in paths:
        summary = read_file_summary(path) if path.suffix == MCAP_SUFFIX else None
        for title, table in (summary.metadata_records if summary else {}).items():
            if title != 'rosbag2':
                metadata_records[title] = dict(table)
    if not paths and not unfinished and (folder / METADATA_FILE_NAME).is_file():
        paths = [folder]
    if not paths:
        broken = f'; unfinished: {", ".join(unfinished)}' if unfinished else ''
        raise BagError(f'no finished bag file in {folder}{broken}')
    with _read_errors(str(folder)):
        reader = AnyReader(paths, default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    return BagReader(folder, reader, unfinished, metadata_records)


def missing_sample_ratio(stamps: Array, rate: float) -> float:
    """Return which share of the samples is missing, from 0 to 1.

    Between the first stamp and the last lies a grid of ``rate`` points per second; what counts
    is how many different stamps there are for it. So lateness and bursts are not losses, a stamp
    that came twice does not hide one, and the order does not matter. Not-a-number is no stamp.
    Fewer than two stamps span no grid: 0.

    Parameters
    ----------
    stamps
        Seconds, shape (n,).
    rate
        Samples per second that should be there.

    Raises
    ------
    ValueError
        ``rate`` is not positive.
    """
    if not rate > 0.0:
        raise ValueError(f'rate must be positive: got {rate}')
    there = np.unique(stamps[np.isfinite(stamps)])
    if there.size < 2:
        return 0.0
    expected = round(float(there[-1] - there[0]) * rate) + 1
    return max(0.0, 1.0 - there.size / expected)


def _field_getter(path: str) -> Callable[[Any], Any]:
    """Return what follows ``path`` into a message."""
    if '[' not in path:
        return attrgetter(path)
    steps: list[tuple[str, int | None]] = []
    for word in path.split('.'):
        match = _STEP.fullmatch(word)
        steps.append((match[1], int(match[2])) if match else (word, None))

    def follow(message: Any) -> Any:
        for name, index in steps:
            message = getattr(message, name)
            if index is not None:
                if index >= len(message):
                    return np.nan
                message = message[index]
        return message

    return follow


@contextmanager
def _read_errors(what: str) -> Iterator[None]:
    """Turn the reading library's errors into ours."""
    try:
        yield
    except (AnyReaderError, ReaderError, SerdeError, OSError, struct.error, ValueError) as error:
        raise DataError(f'{what} cannot be read: {error}') from error
