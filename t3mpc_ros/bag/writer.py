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
"""Bag writer: serialized messages, attachments and metadata records in MCAP files of rosbag2."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
import errno
import fcntl
import mimetypes
import os
from pathlib import Path
import re
from typing import Self
import weakref

from mcap.records import Attachment
from mcap.writer import CompressionType, Writer

from t3mpc_ros.atomic_file import sync_folder
from t3mpc_ros.bag.errors import BagError, DataError, UnknownTopicError
from t3mpc_ros.bag.mcap_file import MCAP_SUFFIX, collect_metadata
from t3mpc_ros.bag.message_definitions import MessageDefinitions
from t3mpc_ros.bag.metadata_yaml import (
    BagMetadata,
    FileInformation,
    TopicInformation,
    write_metadata,
)
from t3mpc_ros.bag.qos import QosProfile, dump_yaml, profiles_to_yaml
from t3mpc_ros.geometry.types import NANOSECONDS

_MEDIA_TYPES = {'.npz': 'application/zip', '.yaml': 'application/yaml', '.csv': 'text/csv'}
"""Media types that ``mimetypes`` lacks on some systems; an npz file is a zip archive."""

SYNC_PERIOD_NS = NANOSECONDS
"""Minimum time between two synchronizations with the disk."""

END_RESERVE = 65_536
"""Bytes for the end of a file and ``metadata.yaml``, in addition to what grows with the file."""

# Publishers of releases before type hashes report "INVALID".
_TYPE_HASH = re.compile(r'RIHS\d\d_[0-9a-f]{64}')


class AttachmentError(BagError):
    """A file cannot be attached to a bag."""


class FolderError(BagError):
    """The folder or a file in it cannot be created."""


class FolderInUseError(FolderError):
    """Another writer writes the bag."""


class DiskError(BagError):
    """Writing failed, usually because the disk is full; messages written before are kept."""

    def __init__(self, path: Path, reason: str, rest: str) -> None:
        super().__init__(f'recording into {path} failed: {reason}; {rest}')


def read_attachment(path: Path, max_bytes: int, now_ns: int, name: str = '') -> Attachment:
    """Return the file at ``path`` as an attachment called ``name``, by default its file name."""
    try:
        with path.open('rb') as file:
            data = file.read(max_bytes + 1)
        modified_ns = path.stat().st_mtime_ns
    except OSError as error:
        raise AttachmentError(f'{path} cannot be attached: {error.strerror or error}') from error
    if len(data) > max_bytes:
        raise AttachmentError(
            f'{path} must have at most {max_bytes} bytes to be attached '
            '(record.max_attachment_size)'
        )
    media_type = _MEDIA_TYPES.get(path.suffix) or mimetypes.guess_type(path.name)[0]
    media_type = media_type or 'application/octet-stream'
    return Attachment(modified_ns, now_ns, name or path.name, media_type, data)


class BagWriter:
    """Writes serialized messages to ``FOLDER/NAME_N.mcap``, N the next free number.

    An existing bag is continued with a new file, and its complete files are included in
    ``metadata.yaml``. Incomplete files are listed in :attr:`incomplete_files` and left unchanged
    (``t3mpc bag recover`` reads them). ``metadata.yaml`` lists complete files only, so the folder
    is readable at any time, even after the recorder was killed. Before the disk is full, the file
    is completed.

    Each file is complete in itself: schemas and channels of its messages, all metadata records
    (tables of text by title), all attachments. Transient-local messages of earlier files are not
    repeated: a reader of the folder would receive them twice.

    A chunk is compressed and written at ``chunk_bytes``, or when its oldest message is
    ``chunk_ns`` old, by receive time or between two calls of :meth:`tick`: a killed recorder
    loses at most the current chunk. The next file begins at ``max_file_bytes`` or
    ``max_file_ns``, 0 = never. What cannot be created raises :class:`FolderError`, a bag that
    another writer of any process has not closed :class:`FolderInUseError`; a failed write raises
    :class:`DiskError`, once, from any method.
    """

    path: Path
    """Current file."""
    incomplete_files: tuple[str, ...]
    """Existing files without a valid end."""

    def __init__(
        self,
        folder: Path | str,
        name: str | None = None,
        *,
        metadata_records: Mapping[str, Mapping[str, str]],
        chunk_bytes: int = 256 * 1024,
        chunk_ns: int = NANOSECONDS,
        max_file_bytes: int = 0,
        max_file_ns: int = 0,
        definitions: MessageDefinitions | None = None,
    ) -> None:
        self.folder = Path(folder).absolute()
        self._stem = name or self.folder.name
        self._chunk_bytes, self._chunk_ns = chunk_bytes, chunk_ns
        self._max_file_bytes, self._max_file_ns = max_file_bytes, max_file_ns
        self._definitions = definitions or MessageDefinitions()
        check_metadata_records(metadata_records)
        self._metadata_records = {title: dict(table) for title, table in metadata_records.items()}
        self._attachments: dict[str, Attachment] = {}
        self._topics: dict[str, TopicInformation] = {}
        self._closed = self._failed = False
        self._synced_ns = 0
        self.lost = 0
        """Messages dropped after a write error."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            sync_folder(self.folder.parent)
            self._unlock = weakref.finalize(self, os.close, _lock_folder(self.folder))
            existing, self.incomplete_files = collect_metadata(self.folder)
            write_metadata(self.folder, existing)
        except OSError as error:
            raise _folder_error(self.folder, error) from error
        self._open_file()

    def _open_file(self) -> None:
        """Begin the next file with all metadata records, attachments and topics."""
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._first_ns: int | None = None
        self._chunk_start_ns: int | None = None
        self._chunk_seen: tuple[int, int] | None = None
        self._end_size = END_RESERVE
        """Upper bound of the size of the summary and ``metadata.yaml``, bytes."""
        try:
            self.path, self._output = _create_next_file(self.folder, self._stem)
            sync_folder(self.folder)
        except OSError as error:
            raise _folder_error(self.folder, error) from error
        try:
            if not self._has_room(0):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._writer = Writer(
                self._output,
                chunk_size=self._chunk_bytes,
                compression=CompressionType.ZSTD,
                enable_data_crcs=True,
            )
            self._writer.start(profile='ros2', library='t3mpc_ros')
            # `ros2 bag info FILE` and `ros2 bag reindex` read this record.
            own = BagMetadata(files=(FileInformation(self.path.name),)).to_mapping()
            self._writer.add_metadata('rosbag2', {'serialized_metadata': dump_yaml(own)})
            for title, table in self._metadata_records.items():
                self._writer.add_metadata(title, table)
        except OSError as error:
            self._output.abandon()
            self.path.unlink(missing_ok=True)
            raise _folder_error(self.folder, error) from error
        for attachment in self._attachments.values():
            self.add_attachment(attachment)
        for topic in self._topics.values():
            self._register(topic)

    def add_metadata_record(self, title: str, table: Mapping[str, str]) -> None:
        """Write a metadata record to this and all later files; it replaces one of its title."""
        check_metadata_records({title: table})
        self._metadata_records[title] = dict(table)
        if self._is_open():
            with self._writing(sum(map(len, [title, *table, *table.values()]))):
                self._writer.add_metadata(title, dict(table))

    def add_attachment(self, item: Attachment) -> None:
        """Write an attachment to this and all later files."""
        self._attachments[item.name] = item
        if self._is_open():
            with self._writing(len(item.data)):
                self._writer.add_attachment(**vars(item))

    def add_topic(
        self, name: str, type_name: str, profiles: Iterable[QosProfile] = (), type_hash: str = ''
    ) -> None:
        """Add a topic before its first message; adding it again has no effect.

        ``profiles`` are those that the publishers offer. Without a valid ``type_hash`` (RIHS01)
        that of the installed definition is used.
        """
        if known := self._topics.get(name):
            if known.type_name != type_name:
                raise DataError(f'{name} is recorded as {known.type_name}, not {type_name}')
            return
        if not _TYPE_HASH.fullmatch(type_hash):
            type_hash = self._definitions.type_hash(type_name)
        topic = TopicInformation(name, type_name, tuple(profiles), type_hash)
        self._register(topic)
        self._topics[name] = topic

    def _register(self, topic: TopicInformation) -> None:
        """Write schema and channel of a topic to the current file."""
        name, type_name = topic.name, topic.type_name
        schema = self._definitions.schema(type_name)
        if not self._is_open():
            return
        with self._writing(len(schema)):
            self._end_size += len(schema)
            if type_name not in self._schemas:
                self._schemas[type_name] = self._writer.register_schema(
                    type_name, 'ros2msg', schema.encode()
                )
            channel_details = {
                'offered_qos_profiles': profiles_to_yaml(topic.offered_qos_profiles),
                'topic_type_hash': topic.type_hash,
            }
            self._channels[name] = self._writer.register_channel(
                name, 'cdr', self._schemas[type_name], channel_details
            )
        self._counts[name] = 0

    def write(self, topic: str, received_ns: int, published_ns: int, data: bytes) -> None:
        """Write one CDR message with its stamps in nanoseconds.

        After a :class:`DiskError` later messages are only counted in :attr:`lost`.
        """
        if type(data) is not bytes:
            raise DataError(f'a message of {topic} must be bytes: got {type(data).__name__}')
        for stamp in (received_ns, published_ns):
            if not 0 <= stamp < 2**63:
                raise DataError(f'a stamp of {topic} must not be negative: got {stamp} ns')
        if not self._is_open():
            self.lost += 1
            return
        if topic not in self._channels:
            raise UnknownTopicError(f'{topic} was not added to {self.path.name}')
        if self._exceeds_limit(received_ns):
            self.split()
        if self._first_ns is None:
            self._first_ns = received_ns
        with self._writing(len(data)):
            if self._chunk_start_ns is None:
                self._chunk_start_ns = received_ns
            elif received_ns - self._chunk_start_ns >= self._chunk_ns:
                self._writer.flush()
                self._chunk_start_ns = received_ns
            written, count = self._output.size, self._counts[topic]
            self._writer.add_message(self._channels[topic], received_ns, data, published_ns, count)
            if self._output.size != written:
                self._chunk_start_ns = None
        self._counts[topic] = (count + 1) % 2**32  # width of the sequence number in MCAP

    def _exceeds_limit(self, received_ns: int) -> bool:
        if self._first_ns is None:
            return False
        if self._max_file_bytes and self.size >= self._max_file_bytes:
            return True
        return bool(self._max_file_ns) and received_ns - self._first_ns >= self._max_file_ns

    def tick(self, now_ns: int) -> None:
        """Write the chunk to the file and synchronize with the disk when their time has passed.

        A power failure loses the messages of ``chunk_ns`` and :data:`SYNC_PERIOD_NS`, provided
        that this is called often. ``now_ns`` is a time of any monotonic clock.
        """
        if self._chunk_start_ns is None:
            self._chunk_seen = None
        elif self._chunk_seen is None or self._chunk_seen[0] != self._chunk_start_ns:
            self._chunk_seen = self._chunk_start_ns, now_ns
        elif now_ns - self._chunk_seen[1] >= self._chunk_ns:
            self.flush()
        if now_ns - self._synced_ns >= SYNC_PERIOD_NS and self._is_open():
            with self._writing():
                self._output.sync()
            self._synced_ns = now_ns

    def flush(self) -> None:
        """Write the current chunk to the file."""
        if self._is_open():
            with self._writing():
                self._writer.flush()
                self._chunk_start_ns = None

    @property
    def size(self) -> int:
        """Size of the file in bytes, without the current chunk."""
        return self._output.size

    def split(self) -> Path:
        """Complete the current file, begin the next one and return its path."""
        if self._is_open():
            self._complete()
            try:
                self._open_file()
            except FolderError:
                self._closed = True
                self._unlock()
                raise
        return self.path

    def close(self) -> None:
        """Complete the file and add it to ``metadata.yaml``; idempotent."""
        if not self._closed:
            self._closed = True
            try:
                if not self._failed:
                    self._complete()
            finally:
                self._unlock()

    def _complete(self) -> None:
        try:
            self._writer.finish()
            self._output.close()
            write_metadata(self.folder, collect_metadata(self.folder)[0])
        except OSError as error:
            raise self._fail(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _is_open(self) -> bool:
        """Return whether the file is writable: False after a write error."""
        if self._closed:
            raise BagError(f'{self.path.name} is closed')
        return not self._failed

    @contextmanager
    def _writing(self, size: int = 0) -> Iterator[None]:
        """Complete the file if there is no room for ``size`` bytes and its end; convert errors.

        Raises :class:`DiskError`.
        """
        if not self._has_room(size):
            self._failed = True
            self._complete()
            raise DiskError(
                self.path, os.strerror(errno.ENOSPC), 'the file is complete until here'
            )
        written = self._output.size
        try:
            yield
        except OSError as error:
            raise self._fail(error) from error
        if self._output.size != written:  # each chunk, attachment or record has an index
            self._end_size += 256 + 16 * len(self._channels)

    def _has_room(self, size: int) -> bool:
        """Return whether ``size`` bytes, the current chunk and the end of the file fit the disk.

        The index of a chunk is smaller than its messages.
        """
        return self._output.free() > 2 * (size + self._chunk_bytes) + self._end_size

    def _fail(self, error: OSError) -> DiskError:
        """Close the file as it is; return the error to raise."""
        self._failed = True
        self._output.abandon()
        rest = 't3mpc bag recover keeps the messages until here'
        return DiskError(self.path, error.strerror or str(error), rest)


def _lock_folder(folder: Path) -> int:
    """Return a descriptor that holds the lock of a folder until it is closed, or its process ends.

    Without a lock where the file system has none: no file is overwritten in any case.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if isinstance(error, BlockingIOError):
            os.close(descriptor)
            reason = 'another recorder writes this bag: set storage.uri'
            raise FolderInUseError(f'cannot record into {folder}: {reason}') from error
    return descriptor


def _folder_error(folder: Path, error: OSError) -> FolderError:
    return FolderError(f'cannot record into {folder}: {error.strerror or error}')


def check_metadata_records(metadata_records: Mapping[str, Mapping[str, str]]) -> None:
    """Raise :class:`DataError` unless every name and value is text."""
    for title, table in metadata_records.items():
        if title == 'rosbag2':
            raise DataError('the metadata record rosbag2 is reserved for the bag format')
        for item in (title, *table.keys(), *table.values()):
            if not isinstance(item, str):
                raise DataError(f'the metadata record {title} must be text: got {item!r}')


class _Output:
    """Unbuffered file that tracks its size."""

    def __init__(self, path: Path) -> None:
        # Each write succeeds or fails at once; FileExistsError if another process created it.
        self._file = path.open('xb', buffering=0)
        self.size = 0
        self._synced = 0

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        while view:  # unbuffered writes may be partial
            view = view[self._file.write(view) :]
        self.size += len(data)
        return len(data)

    def free(self) -> int:
        """Return the free space of the disk, bytes."""
        disk = os.fstatvfs(self._file.fileno())
        return disk.f_bavail * disk.f_frsize

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        """Do nothing: the file is unbuffered."""

    def sync(self) -> None:
        if self._synced != self.size:
            os.fsync(self._file.fileno())
            self._synced = self.size

    def close(self) -> None:
        self.sync()
        self._file.close()

    def abandon(self) -> None:
        self._file.close()


def _create_next_file(folder: Path, stem: str) -> tuple[Path, _Output]:
    """Create the file with the next free number."""
    pattern = re.compile(re.escape(stem) + r'_(\d+)' + re.escape(MCAP_SUFFIX))
    taken = [int(match[1]) for path in folder.iterdir() if (match := pattern.fullmatch(path.name))]
    number = max(taken, default=-1) + 1
    while True:
        path = folder / f'{stem}_{number}{MCAP_SUFFIX}'
        try:
            return path, _Output(path)
        except FileExistsError:
            number += 1
