# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bag writer: serialized messages, attachments and metadata records into MCAP files."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
import mimetypes
import os
from pathlib import Path
import re
from types import TracebackType
from typing import NamedTuple, Self

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from t3mpc_ros.bag.mcap_file import MCAP_SUFFIX, finalize_file, open_unbuffered, write_all
from t3mpc_ros.bag.metadata import BagMetadata, FileInformation, collect_metadata, write_metadata
from t3mpc_ros.bag.qos import QosProfile, dump_yaml, profiles_to_yaml
from t3mpc_ros.bag.schema import BagError, MessageDefinitions

_MEDIA_TYPES = {'.npz': 'application/zip', '.yaml': 'application/yaml', '.csv': 'text/csv'}
"""What ``mimetypes`` does not know everywhere; an npz file is a zip archive of arrays."""


class AttachmentError(BagError):
    """A file that cannot be put into a bag."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """One file, as it was read."""

    name: str
    media_type: str
    data: bytes
    changed_ns: int = 0
    """When the file was last changed, nanoseconds since 1970; 0 = unknown."""


def read_attachment(path: Path, max_bytes: int, name: str = '') -> Attachment:
    """Return the file at ``path`` under ``name``, its own name by default.

    Raises
    ------
    AttachmentError
        There is no such file, it cannot be read, or it is larger than ``most_bytes``.
    """
    try:
        with path.open('rb') as file:
            data = file.read(max_bytes + 1)
        changed_ns = path.stat().st_mtime_ns
    except OSError as error:
        raise AttachmentError(f'{path} cannot be attached: {error.strerror or error}') from error
    if len(data) > max_bytes:
        raise AttachmentError(
            f'{path} must have at most {max_bytes} bytes to be attached (attach_bytes)'
        )
    kind = _MEDIA_TYPES.get(path.suffix) or mimetypes.guess_type(path.name)[0]
    return Attachment(name or path.name, kind or 'application/octet-stream', data, changed_ns)


def read_attachments(path: Path) -> dict[str, Attachment]:
    """Return the files in a finished MCAP file by name; of one name the newest.

    Raises
    ------
    AttachmentError
        The file cannot be read, has no sound end, or an attachment is damaged.
    """
    try:
        with path.open('rb') as file:
            found = list(make_reader(file, validate_crcs=True).iter_attachments())
    except Exception as error:  # whatever a damaged file does to the library's parser
        raise AttachmentError(f'the attachments of {path} cannot be read: {error}') from error
    found.sort(key=lambda item: item.log_time)
    return {
        item.name: Attachment(item.name, item.media_type, bytes(item.data), item.create_time)
        for item in found
    }


MESSAGE_OVERHEAD = 256
"""Bytes that a message costs in memory besides its data."""


class SerializedMessage(NamedTuple):
    """One serialised message, unopened; stamps in nanoseconds since 1970."""

    topic: str
    received_ns: int
    published_ns: int
    data: bytes

    @property
    def cost(self) -> int:
        """Bytes that it takes in memory."""
        return len(self.data) + MESSAGE_OVERHEAD


@dataclass(frozen=True, slots=True)
class TopicMetadata:
    """What a bag has to know of a topic before its first message."""

    topic: str
    type_name: str
    profiles: tuple[QosProfile, ...] = ()
    """What its publishers offer."""
    type_hash: str | None = None


# Publishers older than the hashes report "INVALID".
_TYPE_HASH = re.compile(r'RIHS\d\d_[0-9a-f]{64}')


class FolderError(BagError):
    """The folder, or a file in it, cannot be made."""


class DiskError(BagError):
    """Writing failed, most often because the disk is full; what was written is kept."""


class UnknownTopicError(BagError):
    """A topic that was not added, or is not in the bag."""


class DataError(BagError):
    """A message, stamp or detail that cannot be recorded as it is."""


@dataclass
class _Topic:
    type_name: str
    channel: int
    count: int = 0


class BagWriter:
    """Records serialised messages into ``FOLDER/NAME_N.mcap``, N the next free number.

    A recorder that starts again in the same folder goes on beside what is there: earlier files
    are counted into ``metadata.yaml``; one that broke off is named in :attr:`unfinished` and left
    alone (:func:`t3mpc_ros.bag.mcap_file.finalize_file` mends it). ``metadata.yaml`` lists finished
    files only, so the folder can be read at any time, even after the recorder was killed.

    Parameters
    ----------
    folder
        Made when it is not there, with its parents.
    name
        Stem of the file; the folder's own name by default, as rosbag2 has it.
    details
        Tables of text kept in the file as MCAP metadata records: settings, version, commit.
        The name ``rosbag2`` is taken.
    chunk_bytes, chunk_ns
        A chunk is compressed and written when it holds this many bytes, or when its oldest
        message came this long ago: so much is lost at most when the recorder is killed.
    definitions
        Where schemas and type hashes come from.

    Raises
    ------
    FolderError
        The folder or the file cannot be made.
    DataError
        ``details`` holds anything but text, or a record called ``rosbag2``.
    """

    def __init__(
        self,
        folder: Path | str,
        name: str | None = None,
        *,
        metadata_records: Mapping[str, Mapping[str, str]],
        chunk_bytes: int = 256 * 1024,
        chunk_ns: int = 1_000_000_000,
        definitions: MessageDefinitions | None = None,
    ) -> None:
        self.folder = Path(folder).absolute()
        self._chunk_ns = chunk_ns
        self._definitions = definitions or MessageDefinitions()
        self._topics: dict[str, _Topic] = {}
        self._schemas: dict[str, int] = {}
        self._chunk_start: int | None = None
        self._closed = self._failed = False
        self.lost = 0
        """Messages dropped because writing had failed before."""
        self.unfinished: tuple[str, ...] = ()
        """Earlier files that broke off."""
        check_metadata_records(metadata_records)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            earlier, self.unfinished = collect_metadata(self.folder)
            write_metadata(self.folder, earlier)
            self.path, self._output = _create_next_file(self.folder, name or self.folder.name)
        except OSError as error:
            raise _folder_error(self.folder, error) from error
        try:
            self._writer = Writer(
                self._output,
                chunk_size=chunk_bytes,
                compression=CompressionType.ZSTD,
                enable_data_crcs=True,
            )
            self._writer.start(profile='ros2', library='t3mpc_ros')
            # What `ros2 bag info FILE` and `ros2 bag reindex` look for inside the file.
            own = BagMetadata(files=(FileInformation(self.path.name),)).to_mapping()
            self._writer.add_metadata('rosbag2', {'serialized_metadata': dump_yaml(own)})
            for title, table in metadata_records.items():
                self._writer.add_metadata(title, dict(table))
        except OSError as error:
            self._output.abandon()
            self.path.unlink(missing_ok=True)
            raise _folder_error(self.folder, error) from error

    def add_metadata_record(self, title: str, table: Mapping[str, str]) -> None:
        """Record one more table of text, or a newer one under the same title.

        Raises
        ------
        DataError
            As the constructor.
        DiskError
            As :meth:`write`.
        """
        check_metadata_records({title: table})
        if not self._is_open():
            return
        with self._writing():
            self._writer.add_metadata(title, dict(table))

    def add_attachment(self, attachment: Attachment, now_ns: int) -> None:
        """Put a file into the bag; ``now_ns`` is when it was read (nanoseconds since 1970).

        Raises
        ------
        DiskError
            As :meth:`write`.
        """
        if not self._is_open():
            return
        with self._writing():
            self._writer.add_attachment(
                attachment.changed_ns,
                now_ns,
                attachment.name,
                attachment.media_type,
                attachment.data,
            )

    def add_topic(
        self,
        name: str,
        type_name: str,
        profiles: Iterable[QosProfile] = (),
        type_hash: str | None = None,
    ) -> None:
        """Announce a topic before its first message; adding it again changes nothing.

        ``profiles`` is what its publishers offer. The hash of the installed definition stands in
        for a ``type_hash`` that is not given or not valid.

        Raises
        ------
        UnknownTypeError
            Nobody here knows the type.
        DataError
            The topic was added with another type.
        DiskError
            As :meth:`write`.
        """
        if name in self._topics:
            if self._topics[name].type_name != type_name:
                raise DataError(
                    f'{name} is recorded as {self._topics[name].type_name}, not {type_name}'
                )
            return
        schema = self._definitions.schema(type_name)
        channel_details = {
            'offered_qos_profiles': profiles_to_yaml(profiles),
            'topic_type_hash': type_hash
            if _TYPE_HASH.fullmatch(type_hash or '')
            else self._definitions.type_hash(type_name),
        }
        if not self._is_open():
            return
        with self._writing():
            if type_name not in self._schemas:
                self._schemas[type_name] = self._writer.register_schema(
                    type_name, 'ros2msg', schema.encode()
                )
            channel = self._writer.register_channel(
                name, 'cdr', self._schemas[type_name], channel_details
            )
        self._topics[name] = _Topic(type_name, channel)

    def write(self, topic: str, received_ns: int, published_ns: int, data: bytes) -> None:
        """Record one message, serialised as CDR, with both stamps in nanoseconds.

        Raises
        ------
        UnknownTopicError
            The topic was not added.
        DataError
            ``data`` is not bytes, or a stamp is negative.
        DiskError
            Writing failed. Raised once: the file has been closed as well as possible, and
            later messages are only counted in :attr:`lost`.
        BagError
            The writer was closed.
        """
        if type(data) is not bytes:
            raise DataError(f'a message of {topic} must be bytes: got {type(data).__name__}')
        for stamp in (received_ns, published_ns):
            if not 0 <= stamp < 2**63:
                raise DataError(f'a stamp of {topic} must be from 0 ns: got {stamp}')
        if not self._is_open():
            self.lost += 1
            return
        entry = self._topics.get(topic)
        if entry is None:
            raise UnknownTopicError(f'{topic} was not added to {self.path.name}')
        with self._writing():
            if self._chunk_start is None:
                self._chunk_start = received_ns
            elif received_ns - self._chunk_start >= self._chunk_ns:
                self._writer.flush()
                self._chunk_start = received_ns
            written = self._output.size
            self._writer.add_message(entry.channel, received_ns, data, published_ns, entry.count)
            if self._output.size != written:
                self._chunk_start = None
        entry.count = (entry.count + 1) % 2**32  # the counter's width in the file

    def flush(self) -> None:
        """Put what was recorded so far into the file, as a chunk of its own.

        Raises
        ------
        DiskError
            As :meth:`write`.
        """
        if not self._is_open():
            return
        with self._writing():
            self._writer.flush()
            self._chunk_start = None

    def sync(self) -> None:
        """Wait until the disk has what was handed to the system, if anything is new.

        A process that dies loses nothing of it anyway; a machine without power does.

        Raises
        ------
        DiskError
            As :meth:`write`.
        """
        if not self._is_open():
            return
        with self._writing():
            self._output.sync()

    @property
    def size(self) -> int:
        """Bytes in the file so far; the chunk that is being filled does not count."""
        return self._output.size

    def close(self) -> None:
        """Finish the file and count it into ``metadata.yaml``; again, do nothing.

        Raises
        ------
        DiskError
            As :meth:`write`; the file has then been closed as well as possible.
        """
        if self._closed:
            return
        self._closed = True
        if self._failed:
            return
        with self._writing():
            self._writer.finish()
            self._output.close()
            write_metadata(self.folder, collect_metadata(self.folder)[0])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _is_open(self) -> bool:
        """Return whether to go on; False once writing has failed."""
        if self._closed:
            raise BagError(f'{self.path.name} is closed')
        return not self._failed

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Turn the first failure to write into a :class:`DiskError`."""
        try:
            yield
        except OSError as error:
            raise self._fail(error) from error

    def _fail(self, error: OSError) -> DiskError:
        """Close as well as possible, and return what to raise."""
        self._failed = True
        self._output.abandon()
        kept = 'nothing of it can be read'
        try:
            kept = f'{finalize_file(self.path)} messages are kept'
            write_metadata(self.folder, collect_metadata(self.folder)[0])
        except (OSError, BagError):
            pass  # the first error is the one to report
        return DiskError(f'recording into {self.path} failed: {error.strerror or error}; {kept}')


def _folder_error(folder: Path, error: OSError) -> FolderError:
    return FolderError(f'cannot record into {folder}: {error.strerror or error}')


def check_metadata_records(metadata_records: Mapping[str, Mapping[str, str]]) -> None:
    """Raise :class:`DataError` unless every name and value is text."""
    for title, table in metadata_records.items():
        if title == 'rosbag2':
            raise DataError("details called rosbag2 are the bag format's own")
        for item in (title, *table.keys(), *table.values()):
            if not isinstance(item, str):
                raise DataError(f'details of {title} must be text: got {item!r}')


class _Output:
    """An unbuffered file that knows its size and stays shut once abandoned."""

    def __init__(self, path: Path) -> None:
        self._file = open_unbuffered(path, 'xb')  # FileExistsError when another was faster
        self.size = 0
        self._synced = 0

    def write(self, data: bytes) -> int:
        write_all(self._file, data)
        self.size += len(data)
        return len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        """Nothing is held back."""

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
    """Make the file with the next free number."""
    pattern = re.compile(re.escape(stem) + r'_(\d+)' + re.escape(MCAP_SUFFIX))
    taken = [int(match[1]) for path in folder.iterdir() if (match := pattern.fullmatch(path.name))]
    number = max(taken, default=-1) + 1
    while True:
        path = folder / f'{stem}_{number}{MCAP_SUFFIX}'
        try:
            return path, _Output(path)
        except FileExistsError:
            number += 1
