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
"""Recovery of damaged MCAP files of any writer: whole chunks, and nothing that was not written."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
import shutil
from typing import Any, BinaryIO
import zlib

from mcap import records
from mcap.opcode import Opcode
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary
from mcap.writer import Writer

from t3mpc_ros.atomic_file import atomic_file, sync_folder
from t3mpc_ros.bag import mcap_file
from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.metadata_yaml import read_origin, write_metadata
from t3mpc_ros.bag.recording_metadata import LOSSES, damage_record
from t3mpc_ros.geometry.types import NANOSECONDS

LIBRARY_MARK = 'recovered by t3mpc_ros'
"""Appended to the library name in the header of a recovered file."""

Progress = Callable[[str, int, int], None]
"""Callback with the name of a file, the number of processed bytes and its size."""

_CHUNK_BYTES = 256 * 1024
_BLOCK = 2**20
_SQLITE = b'SQLite format 3\0'


class UnreadableError(BagError):
    """The input contains no recoverable MCAP data."""


class RecoveryOutputError(BagError):
    """The output folder is not permitted."""


# -- result ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Damage:
    """Range of a file that was not usable."""

    start: int
    end: int
    reason: str
    harmless: bool = False
    """Whether no information was lost, because it is duplicated elsewhere in the file."""
    messages: int | None = None
    """Number of lost messages; None if unknown."""
    span_ns: tuple[int, int] | None = None
    """Receive times between which messages were lost; None if unknown."""

    @property
    def size(self) -> int:
        """Size of the range, bytes."""
        return self.end - self.start


@dataclass
class TopicResult:
    """Messages of one topic."""

    name: str
    type_name: str
    kept: int = 0
    unchecked: int = 0
    """Number of kept messages that no checksum covers."""
    lost: int = 0
    """Number of messages known to be lost."""


@dataclass
class FileResult:
    """Result of one file."""

    name: str
    size: int
    """Bytes."""
    copied: bool = False
    """Whether the file was intact and copied."""
    ended: bool = False
    """Whether the end of the data section was found: the writer completed the file."""
    topics: dict[str, TopicResult] = field(default_factory=dict)
    damages: list[Damage] = field(default_factory=list)
    exact: bool = False
    """Whether :attr:`TopicResult.lost` is complete, because the file has its statistics."""
    notes: list[str] = field(default_factory=list)

    @property
    def clean(self) -> bool:
        """Whether nothing was lost; False without the end of the data section."""
        return self.ended and all(damage.harmless for damage in self.damages)

    @property
    def lost_bytes(self) -> int:
        """Bytes of the file that were not usable."""
        return sum(damage.size for damage in self.damages if not damage.harmless)


@dataclass(frozen=True)
class RecoveryResult:
    """Result of a bag."""

    output: Path
    files: tuple[FileResult, ...]

    @property
    def clean(self) -> bool:
        """Whether nothing was lost."""
        return all(file.clean for file in self.files)

    @property
    def exact(self) -> bool:
        """Whether the counts of lost messages are complete."""
        return all(file.exact or file.clean for file in self.files)

    @property
    def kept(self) -> int:
        """Messages in the output."""
        return sum(topic.kept for topic in self.topics.values())

    @property
    def lost(self) -> int:
        """Messages known to be lost."""
        return sum(topic.lost for topic in self.topics.values())

    @property
    def lost_bytes(self) -> int:
        """Bytes of the input that were not usable."""
        return sum(file.lost_bytes for file in self.files)

    @property
    def lost_seconds(self) -> float | None:
        """Seconds of the recording in which messages were lost; None if unknown."""
        damages = [d for file in self.files for d in file.damages if not d.harmless]
        spans = [damage.span_ns for damage in damages if damage.span_ns is not None]
        if len(spans) < len(damages) or not all(file.ended for file in self.files):
            return None
        total, reached = 0, -1  # of overlapping spans only the union
        for first, last in sorted(spans):
            total += max(0, last - max(first, reached))
            reached = max(reached, last)
        return total / NANOSECONDS

    @property
    def topics(self) -> dict[str, TopicResult]:
        """Topics of all files by name."""
        merged: dict[str, TopicResult] = {}
        for file in self.files:
            for topic in file.topics.values():
                total = merged.setdefault(topic.name, TopicResult(topic.name, topic.type_name))
                total.kept += topic.kept
                total.unchecked += topic.unchecked
                total.lost += topic.lost
        return dict(sorted(merged.items()))


# -- bags -----------------------------------------------------------------------------------------


def recover_bag(
    source: Path | str, output: Path | str, progress: Progress | None = None
) -> RecoveryResult:
    """Recover a bag into the folder ``output``; return the kept and lost messages.

    Intact files are copied after a verification of their checksums. Of damaged files the whole
    chunks are written anew, with a summary section. Messages keep their bytes, order, stamps and
    sequence numbers; channels, schemas, attachments and metadata records are kept as well, and
    ``metadata.yaml`` is generated. The input is not changed.

    ``source`` is an MCAP file of any writer, or a folder of such, without its sub-folders.
    RecoveryOutputError: ``output`` is, or is in, the folder of the bag, or is not empty.
    UnreadableError: there is no MCAP file, or the only one contains no message that can be read.
    OSError: reading or writing failed; an incomplete output file is removed.
    """
    source, output = Path(source), Path(output)
    files = _files(source)
    _check_output(source, output)
    created = not output.exists()
    output.mkdir(parents=True, exist_ok=True)
    report = progress or (lambda name, done, size: None)
    results = []
    for path in files:
        try:
            results.append(_recover_file(path, output, report))
        except UnreadableError as error:
            if len(files) == 1:
                if created:
                    output.rmdir()
                raise
            size = path.stat().st_size
            results.append(FileResult(path.name, size, damages=[Damage(0, size, str(error))]))
    metadata, _ = mcap_file.collect_metadata(output)
    if (origin := read_origin(files[0].parent)) is not None:  # usually missing
        metadata = replace(metadata, custom_data=origin[0], ros_distro=origin[1])
    write_metadata(output, metadata)
    sync_folder(output.parent)
    return RecoveryResult(output, tuple(results))


def default_output(source: Path | str) -> Path:
    """Return the default output folder: beside the input, with the suffix ``_recovered``."""
    source = Path(source).absolute()
    stem = source.name if source.is_dir() else source.name.removesuffix(mcap_file.MCAP_SUFFIX)
    return source.with_name(f'{stem}_recovered')


def _files(source: Path) -> list[Path]:
    if source.is_dir():
        files = sorted(path for path in source.glob(f'*{mcap_file.MCAP_SUFFIX}') if path.is_file())
        sqlite = [] if files else list(source.glob('*.db3'))
    elif source.is_file():
        files = [source]
        with source.open('rb') as file:
            sqlite = files if file.read(len(_SQLITE)) == _SQLITE else []
    else:
        raise UnreadableError(f'{source} is neither a file nor a folder')
    if sqlite:
        raise UnreadableError(
            f'{source} is an sqlite3 bag: sqlite3 bags are recovered by sqlite itself when they '
            'are opened; if that fails, run `sqlite3 FILE.db3 .recover | sqlite3 NEW.db3`, then '
            '`ros2 bag reindex FOLDER`'
        )
    if not files:
        raise UnreadableError(f'there is no MCAP file in {source}')
    return files


def _check_output(source: Path, output: Path) -> None:
    folder = (source if source.is_dir() else source.parent).resolve()
    target = output.resolve()
    if target == folder:
        raise RecoveryOutputError(f'{output} is the folder of the input: choose another one')
    if source.is_dir() and target.is_relative_to(folder):
        raise RecoveryOutputError(f'{output} is inside the bag {source}: choose another folder')
    if output.exists() and not output.is_dir():
        raise RecoveryOutputError(f'{output} is a file: choose a new folder')
    if output.is_dir() and any(output.iterdir()):
        raise RecoveryOutputError(f'{output} is not empty: choose a new folder')


def _recover_file(path: Path, folder: Path, progress: Progress) -> FileResult:
    suffix = '' if path.suffix == mcap_file.MCAP_SUFFIX else mcap_file.MCAP_SUFFIX
    target = folder / f'{path.name}{suffix}'
    with path.open('rb') as source:
        if mcap_file.read_mcap_file(path) is not None:
            # The chunks are verified by a pass without output.
            result = recover_file(source, None, path.name, progress)
            if result.clean and not result.damages and not result.notes:
                result.copied = True
                source.seek(0)
                with atomic_file(target) as output:
                    shutil.copyfileobj(source, output)
                return result
        with atomic_file(target) as output:
            result = recover_file(source, output, path.name, progress)
            if not result.ended and not result.topics:
                # An empty bag would look like a recovery.
                raise UnreadableError(f'{path.name} contains no message that can be read')
            return result


# -- files ----------------------------------------------------------------------------------------


def recover_file(
    source: BinaryIO,
    output: BinaryIO | None,
    name: str,
    progress: Progress = lambda name, done, size: None,
) -> FileResult:
    """Write the whole chunks of ``source`` to ``output``; without output they are verified only.

    Raises :class:`UnreadableError` if ``source`` is no MCAP file. Memory is bounded by the largest
    record. Both files remain open.
    """
    return _FileRecovery(source, output, name).run(progress)


class _FileRecovery:
    """One pass over the records of a file."""

    def __init__(self, source: BinaryIO, output: BinaryIO | None, name: str) -> None:
        self._window = mcap_file.FileWindow(source)
        found = mcap_file.read_summary(self._window)
        if found is None and self._window.read(0, len(mcap_file.MAGIC)) != mcap_file.MAGIC:
            raise UnreadableError(f'{name} contains no MCAP data')
        self._summary: Summary | None
        self._summary, self._end = found or (None, self._window.size)
        self._result = FileResult(name, self._window.size, ended=found is not None)
        if self._summary is None:
            self._result.notes.append('the file has no index, or a damaged one')
        self._chunks: dict[int, records.ChunkIndex] = {}
        self._places: list[int] = []
        """Starts of the chunks, attachments and metadata records in the index."""
        if self._summary:
            self._chunks = {each.chunk_start_offset: each for each in self._summary.chunk_indexes}
            others = [*self._summary.attachment_indexes, *self._summary.metadata_indexes]
            self._places = sorted([*self._chunks, *(each.offset for each in others)])
        self._topics: dict[int, TopicResult] = {}  # by channel
        self._unnamed = 0  # messages of unknown channels
        self._written: dict[tuple[type, int], tuple[Any, int]] = {}
        """Record and new number of each written schema and channel, by type and number."""
        self._writer = output and Writer(output, chunk_size=_CHUNK_BYTES, enable_data_crcs=True)

    def run(self, progress: Progress) -> FileResult:
        result, position = self._result, len(mcap_file.MAGIC)
        if self._writer:
            self._writer.start(*self._header(position))
        while position < self._end:
            progress(result.name, position, result.size)
            record = None
            try:
                kind = Opcode.CHUNK if position in self._chunks else 0
                record, end = mcap_file.read_record(self._window, position, kind)
                self._take(record)
            except mcap_file.RecordError as error:
                end = self._skip(position, str(error), record)
            if isinstance(record, records.DataEnd):
                result.ended = True
                self._verify_data_checksum(position, record.data_section_crc)
                break
            position = end
        if not result.ended:
            result.notes.append('the file has no end: the last chunk of its writer is not in it')
        self._count_losses()
        if self._writer:
            self._write_losses()
            self._writer.finish()
        progress(result.name, result.size, result.size)
        return result

    def _header(self, position: int) -> tuple[str, str]:
        """Return the profile and the library of the new file."""
        try:
            record, _ = mcap_file.read_record(self._window, position, Opcode.HEADER)
        except mcap_file.RecordError:
            record = records.Header('ros2', '')
        return record.profile, f'{record.library}; {LIBRARY_MARK}'.lstrip('; ')

    # -- records ----------------------------------------------------------------------------------

    def _take(self, record: Any) -> None:
        """Copy a record outside of the chunks, or all records of a chunk."""
        if isinstance(record, records.Chunk):
            mcap_file.chunk_data(record)  # verifies the checksum
            try:
                inner = breakup_chunk(record)
            except Exception as error:  # the library raises anything on damaged bytes
                raise mcap_file.RecordError(f'a chunk cannot be read: {error}') from error
            if self._writer:
                self._writer.flush()  # a chunk ends where one of the input does
            for each in inner:
                self._take_content(each, checked=record.uncompressed_crc != 0)
        else:
            self._take_content(record, checked=False)

    def _take_content(self, record: Any, checked: bool) -> None:
        writer = self._writer
        if isinstance(record, records.Message):
            topic = self._known_topic(record.channel_id)
            if topic is None:
                self._unnamed += 1
                return
            topic.kept += 1
            topic.unchecked += not checked
            if writer:
                number = self._written[records.Channel, record.channel_id][1]
                stamps = record.log_time, record.data, record.publish_time
                writer.add_message(number, *stamps, record.sequence)
        elif isinstance(record, records.Schema):
            self._take_schema(record)
        elif isinstance(record, records.Channel):
            self._take_channel(record)
        elif isinstance(record, records.Metadata) and writer:
            writer.flush()
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, records.Attachment) and writer:
            writer.flush()
            writer.add_attachment(**vars(record))

    def _take_schema(self, record: records.Schema) -> None:
        if self._written.get((records.Schema, record.id), (None,))[0] != record:
            number = 0
            if self._writer:
                number = self._writer.register_schema(record.name, record.encoding, record.data)
            self._written[records.Schema, record.id] = record, number

    def _take_channel(self, record: records.Channel) -> None:
        """Copy a channel whose schema is known, here or in the summary."""
        if self._written.get((records.Channel, record.id), (None,))[0] == record:
            return
        if self._summary and record.schema_id in self._summary.schemas:
            self._take_schema(self._summary.schemas[record.schema_id])
        schema, number = self._written.get((records.Schema, record.schema_id), (None, 0))
        if schema is None and record.schema_id:
            return
        if self._writer:
            about = record.topic, record.message_encoding, number, dict(record.metadata)
            number = self._writer.register_channel(*about)
        self._written[records.Channel, record.id] = record, number
        topic = TopicResult(record.topic, schema.name if schema else '')
        self._topics[record.id] = self._result.topics.setdefault(record.topic, topic)

    def _known_topic(self, channel: int) -> TopicResult | None:
        """Return the topic of a channel, defined before this position or in the summary."""
        if channel not in self._topics and self._summary and channel in self._summary.channels:
            self._take_channel(self._summary.channels[channel])
        return self._topics.get(channel)

    # -- damage -----------------------------------------------------------------------------------

    def _skip(self, start: int, reason: str, record: Any) -> int:
        """Note a damaged record; return where the next one begins.

        The index of the file knows it. Without index it is at the end of the record, if a record
        is there; else nothing behind the damage is read.
        """
        _, end = mcap_file.record_head(self._window, start)
        index, messages, span_ns = self._chunks.get(start), None, None
        if self._chunks:
            end = next((place for place in self._places if place > start), self._end)
        elif not self._begins_record(end):
            end = self._window.size
        if index:
            messages = mcap_file.chunk_message_count(self._window, index)
        if chunk := index or (record if isinstance(record, records.Chunk) else None):
            span_ns = chunk.message_start_time, chunk.message_end_time
        # Between the places in the index there is nothing that is not repeated elsewhere.
        harmless = bool(self._chunks) and start not in self._places
        self._result.damages.append(Damage(start, end, reason, harmless, messages, span_ns))
        return end

    def _begins_record(self, position: int) -> bool:
        try:
            mcap_file.read_record(self._window, position)
        except mcap_file.RecordError:
            return False
        return True

    def _count_losses(self) -> None:
        """Count the lost messages; exactly if the file has its statistics."""
        result = self._result
        if self._unnamed:
            reason = f'{self._unnamed} messages of channels whose names are lost'
            result.damages.append(Damage(0, 0, reason, messages=self._unnamed))
        statistics = self._summary.statistics if self._summary else None
        if statistics is None:
            return
        result.exact = True
        for channel, count in statistics.channel_message_counts.items():
            if topic := self._known_topic(channel):
                topic.lost += count
        for topic in result.topics.values():
            topic.lost = max(0, topic.lost - topic.kept)
        lost = sum(topic.lost for topic in result.topics.values())
        if lost and result.clean:
            result.damages.append(Damage(0, 0, f'{lost} messages are missing'))

    def _write_losses(self) -> None:
        """Write what is lost beside the record of the recorder, which it may have as well."""
        lost = {topic.name: topic.lost for topic in self._result.topics.values() if topic.lost}
        damages = [each for each in self._result.damages if not each.harmless]
        spans = [each.span_ns for each in damages if each.span_ns]
        if self._writer and (lost or spans):
            title = f'{LOSSES} in {self._result.name}'
            self._writer.add_metadata(title, damage_record(lost, spans))

    def _verify_data_checksum(self, end: int, expected: int) -> None:
        """Verify the checksum of the data section, which covers records without a checksum."""
        if not expected or self._result.damages:
            return
        checksum = 0
        for start in range(0, end, _BLOCK):
            checksum = zlib.crc32(self._window.read(start, min(_BLOCK, end - start)), checksum)
        if checksum != expected:
            reason = (
                'the checksum of the data section is wrong: a record outside the chunks differs'
            )
            self._result.damages.append(Damage(0, 0, reason))
