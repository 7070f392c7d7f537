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
"""The bag reader: contents, serialized and decoded messages, and time series of any bag.

Inputs and outputs of the controller have simple CDR layouts: at most a stamp, some strings, then
8-byte numbers. The position of a number thus follows from the lengths of the strings, which are
verified for every message: their columns are read without decoding each message.
"""

from array import array
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
import heapq
from operator import attrgetter
from pathlib import Path
import re
from typing import Any, Self

from mcap.records import Attachment
import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from t3mpc_ros.bag import mcap_file
from t3mpc_ros.bag.errors import BagError, DataError, UnknownTopicError
from t3mpc_ros.bag.metadata_yaml import METADATA_FILE_NAME, TopicInformation
from t3mpc_ros.bag.qos import UNLIMITED, QosProfile
from t3mpc_ros.geometry.types import NANOSECONDS, Array

SQLITE_SUFFIX, ROS1_SUFFIX = '.db3', '.bag'
_RUN_BAG = 'bag'
"""Folder of the bag in the folder of a run, beside its logs and its report."""

_STORAGES = {mcap_file.MCAP_SUFFIX: 'mcap', SQLITE_SUFFIX: 'sqlite3', ROS1_SUFFIX: 'ROS 1'}
_COMPRESSION = re.compile(r'^\s*compression_format:\s*[\'"]?\w', re.MULTILINE)
_STEP = re.compile(r'(\w+)\[(\d+)\]')


class RosbagsFile:
    """File that ``rosbags`` reads: sqlite3, ROS 1, or a folder that rosbag2 compressed.

    The library does not return publish stamps: they are the receive stamps.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata_records: Mapping[str, Mapping[str, str]] = {}
        self.damaged: dict[int, int] = {}
        with mcap_file.read_errors(str(path), DataError):
            self._reader: Any = (Ros1Reader if path.suffix == ROS1_SUFFIX else Reader)(path)
            self._reader.open()
        self.message_count: int = self._reader.message_count
        some = self.message_count > 0
        self.start_ns: int = self._reader.start_time if some else 0
        self.end_ns: int = self._reader.end_time - 1 if some else -1  # its end is exclusive
        self.topics = [_topic_information(each) for each in self._reader.connections]

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int = 0,
        stop_ns: int = mcap_file.END_NS,
        skip_damaged: bool = False,
    ) -> Iterator[mcap_file.SerializedMessage]:
        """Yield messages as :meth:`McapFile.messages`; damaged ones are always an error."""
        selected = [x for x in self._reader.connections if topics is None or x.topic in topics]
        if not selected or start_ns > self.end_ns:
            return  # the library would read all topics for an empty selection
        last_ns = min(stop_ns, UNLIMITED)  # the largest integer of sqlite3
        with mcap_file.read_errors(str(self.path), DataError):
            for item, stamp_ns, data in self._reader.messages(selected, start_ns, last_ns):
                yield mcap_file.SerializedMessage(item.topic, stamp_ns, stamp_ns, bytes(data))

    def close(self) -> None:
        """Close the file; idempotent."""
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()


BagFile = mcap_file.McapFile | RosbagsFile


class BagReader:
    """Open bag; created by :func:`open_bag`, a context manager.

    Stamps are nanoseconds since 1970, times are seconds since :attr:`start_ns`. The time ranges
    of the files of a split or continued bag may overlap.
    """

    def __init__(
        self, path: Path, files: Collection[BagFile], incomplete_files: tuple[str, ...]
    ) -> None:
        self.folder = path
        """Folder, or file, of the bag."""
        self.files = tuple(files)
        self.incomplete_files = incomplete_files
        """MCAP files without a valid end, which are skipped; they need a recovery."""
        some = [file for file in files if file.message_count]
        self.start_ns = min((file.start_ns for file in some), default=0)
        """Receive time of the first message."""
        self.end_ns = max((file.end_ns for file in some), default=0)
        """Receive time of the last message."""
        self.duration = (self.end_ns - self.start_ns) / NANOSECONDS
        """Seconds between the first and the last message."""
        self.storage = _STORAGES.get(self.files[0].path.suffix, 'other') if files else ''
        """Name of the file format."""
        self.message_count = sum(file.message_count for file in files)
        self.topics: dict[str, TopicInformation] = merge_topics(
            topic for file in files for topic in file.topics
        )
        """By name, including topics without messages."""
        self.metadata_records: dict[str, Mapping[str, str]] = {}
        """Tables of text by title; the newest of each title."""
        for file in files:
            self.metadata_records |= file.metadata_records
        self._decoders: dict[str, Callable[[bytes, str], Any]] = {}

    def serialized_messages(
        self, topics: Collection[str] | None = None
    ) -> Iterator[mcap_file.SerializedMessage]:
        """Yield the serialized messages of ``topics``, or of all, in order of receipt."""
        return merge_streams((file.start_ns, file.messages(topics)) for file in self.files)

    def messages(self, topic: str) -> Iterator[tuple[float, Any]]:
        """Yield (received, decoded message) in order of receipt, s."""
        if topic not in self.topics:
            available = ', '.join(self.topics) or 'no topic'
            raise UnknownTopicError(f'{topic} is not in {self.folder}, which contains {available}')
        for number, message in enumerate(self.serialized_messages([topic]), 1):
            received = (message.received_ns - self.start_ns) / NANOSECONDS
            yield received, self.decode(message, number)

    def decode(self, message: mcap_file.SerializedMessage, number: int) -> Any:
        """Return a message of this bag as an object; its number in the topic is for the error."""
        type_name = self.topics[message.topic].type_name
        if type_name not in self._decoders:
            with mcap_file.read_errors(message.topic, DataError):
                self._decoders[type_name] = self._make_decoder(type_name)
        try:
            return self._decoders[type_name](message.data, type_name)
        except Exception as error:  # the library raises anything on damaged bytes
            raise DataError(
                f'message {number} of {message.topic} in {self.folder} does not have the layout '
                f'of {type_name}: correct its publisher, or choose another topic'
            ) from error

    def _make_decoder(self, type_name: str) -> Callable[[bytes, str], Any]:
        """Return the function that decodes messages of a type by its definition in the bag."""
        definitions = [
            f.definition(type_name) for f in self.files if isinstance(f, mcap_file.McapFile)
        ]
        if text := next(filter(None, definitions), ''):
            store: Any = get_typestore(Stores.EMPTY)
            store.register(get_types_from_msg(text, type_name))
            is_ros1 = False
        else:
            default = get_typestore(Stores.ROS2_JAZZY)
            with AnyReader([f.path for f in self.files], default_typestore=default) as reader:
                store, is_ros1 = reader.typestore, not reader.is2
        decode: Callable[[bytes, str], Any] = store.deserialize_cdr
        return store.deserialize_ros1 if is_ros1 else decode

    def series(self, topic: str, fields: Mapping[str, str]) -> dict[str, Array]:
        """Return one array, shape (n,), for each of ``fields``, in order of receipt.

        ``fields`` are paths in the message by name, such as ``'twist.twist.linear.x'`` or
        ``'pose.covariance[7]'``; an element beyond the end of an array is NaN, what is no number
        raises :class:`DataError`. ``received``, the time of receipt, and ``stamp``, that of the
        header or, for a type without a header, ``received``, are returned as well.
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

    def attachments(self) -> dict[str, Attachment]:
        """Return the attachments by name; the newest of each name."""
        files = [file for file in self.files if isinstance(file, mcap_file.McapFile)]
        found = [item for file in files for item in file.attachments()]
        return {item.name: item for item in sorted(found, key=attrgetter('log_time'))}

    def close(self) -> None:
        """Close the files; idempotent."""
        for file in self.files:
            if isinstance(file, RosbagsFile):
                file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _seconds(self, stamp: Any) -> float:
        nanoseconds = stamp.sec * NANOSECONDS + stamp.nanosec
        return float((nanoseconds - self.start_ns) / NANOSECONDS)


def open_bag(path: Path | str) -> BagReader:
    """Open the bag in a folder, or a single bag file; it must have a complete file.

    All complete MCAP files of a folder are read, independently of ``metadata.yaml``, which is
    outdated if the recorder was killed. Bags that rosbag2 compressed, by file or by message, are
    read through their ``metadata.yaml``. Of the folder of a run, its bag is opened.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise BagError(f'there is no bag {path}')
    files: list[BagFile] = []
    incomplete: tuple[str, ...] = ()
    others: list[Path] = []
    if path.is_dir():
        if _is_compressed(path):
            others = [path]
        else:
            complete, incomplete = mcap_file.find_files(path)
            files.extend(complete)
            others = sorted(path.glob(f'*{SQLITE_SUFFIX}'))
    elif not path.stat().st_size:
        raise BagError(f'{path} is empty: it has no byte')
    elif path.suffix == mcap_file.MCAP_SUFFIX or mcap_file.has_mcap_magic(path):
        if (file := mcap_file.read_mcap_file(path)) is not None:
            files.append(file)
        else:
            incomplete = (path.name,)
    elif path.suffix in (SQLITE_SUFFIX, ROS1_SUFFIX):
        others = [path]
    else:
        raise BagError(f'{path} is no MCAP file and no sqlite3 bag')
    for each in others:
        try:
            files.append(RosbagsFile(each))
        except BagError:
            BagReader(path, files, incomplete).close()
            raise
    if not files and not incomplete and (path / _RUN_BAG).is_dir():
        return open_bag(path / _RUN_BAG)
    if not files:
        advice = (
            f'; incomplete: {", ".join(incomplete)}: `t3mpc bag recover {path}` writes their '
            'messages to a new bag'
        )
        if not incomplete:
            advice = f', which holds no {mcap_file.MCAP_SUFFIX} and no {SQLITE_SUFFIX} file'
            below = sorted(each.parent for each in path.glob('*/metadata.yaml'))
            advice += f'; a bag is {below[0]}' if below else ''
        raise BagError(f'no complete bag file in {path}{advice}')
    return BagReader(path, files, incomplete)


def merge_topics(topics: Iterable[TopicInformation]) -> dict[str, TopicInformation]:
    """Return one entry per topic by name, with the sum of the counts and all distinct profiles."""
    result: dict[str, TopicInformation] = {}
    for topic in topics:
        before = result.get(topic.name)
        result[topic.name] = topic if before is None else before.merged(topic)
    return dict(sorted(result.items()))


def merge_streams(
    streams: Iterable[tuple[int, Iterator[mcap_file.SerializedMessage]]],
) -> Iterator[mcap_file.SerializedMessage]:
    """Merge sorted streams of messages by receive time; equal times keep the order of streams.

    Each stream comes with a lower bound of its receive times, before which it is not read.
    """
    heap: list[
        tuple[int, int, mcap_file.SerializedMessage | None, Iterator[mcap_file.SerializedMessage]]
    ]
    heap = [(start_ns, number, None, stream) for number, (start_ns, stream) in enumerate(streams)]
    heapq.heapify(heap)
    while heap:
        _, number, message, stream = heap[0]
        if message is not None:
            yield message
        if len(heap) == 1:
            yield from stream
            return
        if (following := next(stream, None)) is not None:
            heapq.heapreplace(heap, (following.received_ns, number, following, stream))
        else:
            heapq.heappop(heap)


def missing_sample_ratio(stamps: Array, rate: float) -> float:
    """Return the ratio of missing samples, from 0 to 1, of stamps in seconds, shape (n,).

    The number of distinct finite stamps is compared with the number of periods of ``rate``
    between the first and the last one. Latency, bursts and the order have no influence, and a
    duplicate does not replace a missing sample. The ratio of fewer than two stamps is 0.
    """
    if not rate > 0.0:
        raise ValueError(f'rate must be positive: got {rate}')
    present = np.unique(stamps[np.isfinite(stamps)])
    if present.size < 2:
        return 0.0
    expected = round(float(present[-1] - present[0]) * rate) + 1
    return max(0.0, 1.0 - present.size / expected)


def _is_compressed(folder: Path) -> bool:
    """Return whether rosbag2 compressed files or messages, according to ``metadata.yaml``."""
    try:
        text = (folder / METADATA_FILE_NAME).read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError):
        return False
    return _COMPRESSION.search(text) is not None


def _topic_information(connection: Any) -> TopicInformation:
    offers = getattr(connection.ext, 'offered_qos_profiles', ())
    return TopicInformation(
        connection.topic,
        connection.msgtype,
        tuple(
            QosProfile.from_object(each, lambda at: int(at.sec * NANOSECONDS + at.nsec))
            for each in offers
        ),
        connection.digest,
        connection.msgcount,
        getattr(connection.ext, 'serialization_format', 'ros1'),
    )


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


# -- columns --------------------------------------------------------------------------------------
