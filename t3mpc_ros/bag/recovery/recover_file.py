# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recovery of one damaged MCAP file into a complete one."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
import io
import struct
from typing import Any, BinaryIO
import zlib

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    DataEnd,
    Header,
    MessageIndex,
    Metadata,
    Schema,
    Statistics,
)
from mcap.writer import CompressionType, Writer

from t3mpc_ros.bag.mcap_file import (
    FOOTER,
    HEAD,
    MAGIC,
    MESSAGE_HEAD,
    ChunkError,
    DecodedChunk,
    FileWindow,
    attachment_is_valid,
    decode_chunk,
    summary_is_valid,
)
from t3mpc_ros.bag.recovery.result import Damage, FileResult, TopicResult
from t3mpc_ros.bag.recovery.scanner import (
    INDEX_RECORDS,
    RecordFit,
    Scanner,
    Span,
    chunk_time_range,
    classify_record,
)
from t3mpc_ros.bag.schema import BagError

CHUNK_BYTES = 256 * 1024
LIBRARY_MARK = 'recovered by t3mpc_ros'
"""Appended to the library name in the header of a recovered file."""
UNKNOWN_TYPE = 'unknown/msg/Unknown'
"""Type of a channel whose schema is lost: its messages are kept but cannot be decoded."""


Progress = Callable[[int, int], None]
"""Callback with the number of processed bytes and the size of the file."""

_BLOCK = 2**20
_SUMMARY_RECORDS = INDEX_RECORDS - {Opcode.MESSAGE_INDEX}
_PARSE_ERRORS = (McapError, ValueError, struct.error)  # errors of a record that cannot be parsed


class UnreadableError(BagError):
    """The input contains no recoverable MCAP data."""


def recover_file(
    source: BinaryIO,
    output: BinaryIO,
    name: str = '',
    progress: Progress | None = None,
    compress: bool = True,
) -> FileResult:
    """Recover the records of ``source`` into ``output``, a complete MCAP file.

    Memory is bounded by the largest record. Both files remain open.

    Parameters
    ----------
    name
        Name of the file in the result and in errors.
    compress
        False saves time if the output is discarded.

    Raises
    ------
    UnreadableError
        ``source`` contains no MCAP data.
    OSError
        Reading or writing failed.
    """
    window = FileWindow(source, source.seek(0, io.SEEK_END))
    return _FileRecovery(window, output, name, compress).run(progress or (lambda done, size: None))


class _FileRecovery:
    """Recovery of one file."""

    def __init__(self, window: FileWindow, output: BinaryIO, name: str, compress: bool) -> None:
        self._window = window
        self._rewriter = RecoveredFileWriter(output, compress)
        self._result = FileResult(name, window.size)
        self._topics: dict[int, str] = {}  # by channel
        self._summary_definitions: dict[tuple[int, int], Any] | None = None
        self._statistics: Statistics | None = None
        self._lost: dict[int, int] = {}  # messages by channel, from message indexes
        self._unattributed: dict[int, int] = {}  # messages by undefined channel
        self._lost_chunk: Damage | None = None  # its message indexes may follow
        self._lost_chunk_is_uncertain = False  # further chunks may be lost with it
        self._position = 0
        self._record_count = 0

    def run(self, progress: Progress) -> FileResult:
        has_magic = self._window.read(0, len(MAGIC)) == MAGIC
        start = len(MAGIC) if has_magic else self._find_start()
        if start > len(MAGIC):
            reason = 'bytes before the MCAP magic'
            self._result.damages.append(Damage(0, start - len(MAGIC), reason))
        size = self._window.size
        reached = 0

        def report(position: int) -> None:
            nonlocal reached
            if position > reached:
                reached = position
                progress(position, size)

        progress(0, size)
        for span in Scanner(self._window, start, self._is_known_channel, report).spans():
            report(span.start)
            self._position = span.end
            if span.opcode != Opcode.MESSAGE_INDEX:
                self._close_lost_chunk()
            self._record_count += span.opcode != 0
            if span.reason:
                self._take_damaged(span)
            else:
                self._take(span)
        self._close_lost_chunk()
        if not has_magic and not self._record_count:
            name = self._result.name or 'the input'
            raise UnreadableError(f'{name} contains no MCAP data')
        if not has_magic:
            self._add_note('the MCAP magic at the beginning of the file is damaged')
        if not self._result.ended:
            self._add_note('the file has no end: the last chunk of its writer was not written')
        self._count_losses()
        self._rewriter.finish()
        progress(self._window.size, self._window.size)
        return self._result

    def _find_start(self) -> int:
        """Return the start of the records in a file that does not begin with the magic."""
        for start in (0, len(MAGIC)):
            if classify_record(self._window, start).fit is RecordFit.VALID:
                return start
        magic = self._window.read(0, _BLOCK).find(MAGIC)
        return magic + len(MAGIC) if magic > 0 else 0

    # -- records --------------------------------------------------------------------------------

    def _take(self, span: Span) -> None:
        if span.opcode in _SUMMARY_RECORDS:
            self._result.ended = True
        try:
            if span.opcode == Opcode.CHUNK:
                self._take_chunk(span)
            elif span.opcode == Opcode.MESSAGE_INDEX:
                if self._lost_chunk:
                    index = MessageIndex.read(self._stream(span))
                    self._lost_chunk = self._add_losses(self._lost_chunk, index)
            else:
                self._take_record(span.opcode, memoryview(self._content(span)), checked=False)
                if span.opcode == Opcode.DATA_END:
                    self._verify_data_checksum(span)
                elif span.opcode == Opcode.FOOTER and not summary_is_valid(self._window, span.end):
                    self._statistics = None
                    self._add_note('the summary of the file is damaged')
        except _PARSE_ERRORS as error:
            self._damage(span, f'a record cannot be read: {error or type(error).__name__}')

    def _take_record(self, opcode: int, content: memoryview, checked: bool) -> None:
        """Copy a record other than a chunk, from inside or outside of a chunk."""
        if opcode == Opcode.MESSAGE:
            self._take_message(content, checked)
            return
        stream = ReadDataStream(io.BytesIO(content))
        if opcode == Opcode.SCHEMA:
            self._rewriter.schema(Schema.read(stream))
        elif opcode == Opcode.CHANNEL:
            self._add_channel(Channel.read(stream))
        elif opcode == Opcode.HEADER:
            header = Header.read(stream)
            self._rewriter.start(header.profile, header.library)
        elif opcode == Opcode.METADATA:
            self._rewriter.metadata(Metadata.read(stream))
        elif opcode == Opcode.ATTACHMENT:
            if not attachment_is_valid(bytes(content)):
                raise ValueError('the checksum of an attachment is wrong')
            self._rewriter.attachment(Attachment.read(stream))
        elif opcode == Opcode.STATISTICS:
            self._statistics = Statistics.read(stream)

    def _take_message(self, content: memoryview, checked: bool) -> None:
        if len(content) < MESSAGE_HEAD.size:
            raise ValueError('a message is shorter than its head')
        channel = int.from_bytes(content[:2], 'little')
        if not self._is_known_channel(channel):
            self._unattributed[channel] = self._unattributed.get(channel, 0) + 1
            return
        self._rewriter.message(content)
        topic = self._result.topics[self._topics[channel]]
        topic.kept += 1
        topic.unchecked += not checked

    def _take_chunk(self, span: Span) -> None:
        try:
            chunk = decode_chunk(self._window, span.start)
            if not chunk.complete:
                raise ChunkError('the file ends inside the data of a chunk')
        except ChunkError as error:
            time_range = chunk_time_range(self._window, span.start)
            self._lost_chunk = Damage(span.start, span.end, str(error), span_ns=time_range)
            self._lost_chunk_is_uncertain = False
            return
        if invalid := self._take_records(chunk):
            self._damage(span, f'{invalid} records of a chunk cannot be read')

    def _take_records(self, chunk: DecodedChunk) -> int:
        """Copy the records of a chunk; return the number of invalid ones."""
        invalid = 0
        self._rewriter.close_chunk()
        for opcode, content in chunk.records():
            if opcode not in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                invalid += 1
                continue
            try:
                self._take_record(opcode, content, chunk.checked)
            except _PARSE_ERRORS:
                invalid += 1
        self._rewriter.close_chunk()
        return invalid

    # -- channels -------------------------------------------------------------------------------

    def _add_channel(self, record: Channel) -> None:
        if not self._rewriter.has_schema(record.schema_id):
            schema = self._find_definition(Opcode.SCHEMA, record.schema_id)
            if schema is None:
                self._add_note(
                    f'the type of {record.topic} is lost: its messages cannot be decoded'
                )
            else:
                self._rewriter.schema(schema)
        if self._rewriter.channel(record):
            self._topics[record.id] = record.topic
            type_name = self._rewriter.type_of(record)
            self._result.topics.setdefault(record.topic, TopicResult(record.topic, type_name))

    def _is_known_channel(self, channel: int) -> bool:
        """Return whether a channel is defined, before this position or in the summary."""
        if channel in self._topics:
            return True
        record = self._find_definition(Opcode.CHANNEL, channel)
        if record is None:
            return False
        self._add_channel(record)
        return True

    def _find_definition(self, opcode: int, number: int) -> Any:
        if self._summary_definitions is None:
            self._summary_definitions = _find_definitions(self._window, self._position)
        return self._summary_definitions.get((opcode, number))

    # -- losses ---------------------------------------------------------------------------------

    def _take_damaged(self, span: Span) -> None:
        if span.truncated and span.opcode == Opcode.CHUNK:
            self._take_truncated_chunk(span)
        elif span.opcode == Opcode.CHUNK or span.opcode == 0:
            time_range = chunk_time_range(self._window, span.start) if span.opcode else None
            harmless = self._result.ended  # the data section has ended
            self._lost_chunk_is_uncertain = span.opcode == 0
            self._lost_chunk = Damage(
                span.start, span.end, span.reason, harmless=harmless, span_ns=time_range
            )
        else:
            self._damage(span, span.reason)

    def _take_truncated_chunk(self, span: Span) -> None:
        time_range = chunk_time_range(self._window, span.start)
        before = {name: topic.kept for name, topic in self._result.topics.items()}
        with suppress(ChunkError):  # the span already has a reason
            self._take_records(decode_chunk(self._window, span.start))
        kept = sum(t.kept - before.get(name, 0) for name, t in self._result.topics.items())
        reason = f'{span.reason}; {kept} messages of it are kept, unchecked'
        self._result.damages.append(Damage(span.start, span.end, reason, span_ns=time_range))

    def _damage(self, span: Span, reason: str) -> None:
        harmless = span.opcode in INDEX_RECORDS or self._result.ended
        if span.opcode in _SUMMARY_RECORDS:
            self._result.ended = True
        messages = 0 if span.opcode in (Opcode.METADATA, Opcode.ATTACHMENT) else None
        self._result.damages.append(
            Damage(span.start, span.end, reason, harmless, messages=messages)
        )

    def _add_losses(self, damage: Damage, index: MessageIndex) -> Damage:
        """Return a lost chunk with the messages listed in one of its message indexes."""
        times = [time for time, _ in index.records]
        if not times:
            return damage
        self._lost[index.channel_id] = self._lost.get(index.channel_id, 0) + len(times)
        if self._lost_chunk_is_uncertain:  # the index may belong to one of several chunks
            return damage
        first, last = damage.span_ns or (times[0], times[0])
        return replace(
            damage,
            messages=(damage.messages or 0) + len(times),
            span_ns=(min(first, *times), max(last, *times)),
        )

    def _close_lost_chunk(self) -> None:
        """Add the lost chunk to the result after its last message index."""
        if self._lost_chunk:
            self._result.damages.append(self._lost_chunk)
            self._lost_chunk = None

    def _count_losses(self) -> None:
        """Count the lost messages; exactly if the file has its statistics."""
        result = self._result
        statistics = self._statistics
        if result.clean and not self._unattributed:
            result.exact = True
            return
        if statistics is not None and all(
            self._is_known_channel(channel) for channel in statistics.channel_message_counts
        ):
            totals: dict[str, int] = {}
            for channel, count in statistics.channel_message_counts.items():
                name = self._topics[channel]
                totals[name] = totals.get(name, 0) + count
            for topic in result.topics.values():
                topic.lost = max(0, totals.get(topic.name, 0) - topic.kept)
            result.exact = True
            return
        for channel, count in [*self._lost.items(), *self._unattributed.items()]:
            unknown = f'(channel {channel}, name lost)'
            name = self._topics[channel] if self._is_known_channel(channel) else unknown
            result.topics.setdefault(name, TopicResult(name, '')).lost += count
        if self._unattributed:
            count = sum(self._unattributed.values())
            reason = f'{count} messages of channels whose names are lost'
            result.damages.append(Damage(0, 0, reason, messages=count))
        open_ends = [d for d in result.damages if not d.harmless and d.messages is None]
        result.exact = result.ended and not open_ends

    def _verify_data_checksum(self, span: Span) -> None:
        """Verify the checksum of the data section, which covers records without a checksum."""
        expected = DataEnd.read(self._stream(span)).data_section_crc
        if not expected or self._result.damages:
            return
        checksum = 0
        for start in range(0, span.start, _BLOCK):
            count = min(_BLOCK, span.start - start)
            checksum = zlib.crc32(self._window.read(start, count), checksum)
        if checksum != expected:
            reason = (
                'the checksum of the data section is wrong: a record outside the chunks differs'
            )
            self._result.damages.append(Damage(0, 0, reason))

    def _add_note(self, text: str) -> None:
        if text not in self._result.notes:
            self._result.notes.append(text)

    def _content(self, span: Span) -> bytes:
        return self._window.read(span.start + HEAD.size, span.end - span.start - HEAD.size)

    def _stream(self, span: Span) -> ReadDataStream:
        return ReadDataStream(io.BytesIO(self._content(span)))


class RecoveredFileWriter:
    """Writer of the recovered file.

    A chunk ends where a chunk of the input ends, and at :data:`CHUNK_BYTES`. Equal records thus
    give equal bytes: the recovery of a recovered file does not change it.
    """

    def __init__(self, output: BinaryIO, compress: bool = True) -> None:
        self._writer: Any = Writer(
            output,
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD if compress else CompressionType.NONE,
            enable_data_crcs=True,
        )
        self._started = False
        self._schemas: dict[int, tuple[Schema, int]] = {}
        self._channels: dict[int, tuple[Channel, int]] = {}
        self._unknown_schema = 0

    def start(self, profile: str, library: str) -> None:
        """Write the header once; without a header in the input the profile is ``ros2``."""
        if not self._started:
            self._started = True
            mark = (
                library if LIBRARY_MARK in library else f'{library}; {LIBRARY_MARK}'.lstrip('; ')
            )
            self._writer.start(profile=profile, library=mark)

    def schema(self, record: Schema) -> None:
        """Write a schema unless it was written before."""
        self._ensure_started()
        known = self._schemas.get(record.id)
        if known is None or known[0] != record:
            number = self._writer.register_schema(record.name, record.encoding, record.data)
            self._schemas[record.id] = (record, number)

    def has_schema(self, number: int) -> bool:
        """Return whether a schema was written; 0 means no schema."""
        return number == 0 or number in self._schemas

    def channel(self, record: Channel) -> bool:
        """Write a channel unless it was written before; return whether it is new."""
        self._ensure_started()
        known = self._channels.get(record.id)
        if known is not None and known[0] == record:
            return False
        if record.schema_id == 0:
            schema = 0
        elif record.schema_id in self._schemas:
            schema = self._schemas[record.schema_id][1]
        else:
            schema = self._unknown_schema = self._unknown_schema or self._writer.register_schema(
                UNKNOWN_TYPE, '', b''
            )
        number = self._writer.register_channel(
            record.topic, record.message_encoding, schema, dict(record.metadata)
        )
        self._channels[record.id] = (record, number)
        return True

    def type_of(self, record: Channel) -> str:
        """Return the message type of a channel; empty for a channel without a schema."""
        if record.schema_id == 0:
            return ''
        known = self._schemas.get(record.schema_id)
        return str(known[0].name) if known else UNKNOWN_TYPE

    def message(self, content: memoryview) -> None:
        """Write one message, given as the content of its record."""
        channel, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(content)
        data = bytes(content[MESSAGE_HEAD.size :])
        number = self._channels[channel][1]
        self._writer.add_message(number, log_time, data, publish_time, sequence)

    def metadata(self, record: Metadata) -> None:
        """Write a metadata record."""
        self.close_chunk()
        self._writer.add_metadata(record.name, record.metadata)

    def attachment(self, record: Attachment) -> None:
        """Write an attachment."""
        self.close_chunk()
        self._writer.add_attachment(
            record.create_time, record.log_time, record.name, record.media_type, record.data
        )

    def close_chunk(self) -> None:
        """End the current chunk."""
        self._ensure_started()
        self._writer.flush()

    def finish(self) -> None:
        """Write the summary section; the output remains open."""
        self._ensure_started()
        self._writer.finish()

    def _ensure_started(self) -> None:
        self.start('ros2', '')


def _find_definitions(window: FileWindow, position: int) -> dict[tuple[int, int], Any]:
    """Return schemas and channels after ``position`` by opcode and number.

    They are usually in the summary; a summary with a wrong checksum is ignored.
    """
    end = window.size - len(MAGIC)
    footer = Span(end - HEAD.size - FOOTER.size, end, Opcode.FOOTER)
    head = window.read(max(0, footer.start), HEAD.size)
    if footer.start >= position and head == HEAD.pack(Opcode.FOOTER, FOOTER.size):
        if not summary_is_valid(window, end):
            return {}
        (start,) = struct.unpack('<Q', window.read(footer.start + HEAD.size, 8))
        position = max(position, start)
    found: dict[tuple[int, int], Any] = {}
    for span in Scanner(window, position, lambda channel: True).spans():
        if span.reason or span.opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            continue
        content = window.read(span.start + HEAD.size, span.end - span.start - HEAD.size)
        stream = ReadDataStream(io.BytesIO(content))
        try:
            record = (Schema if span.opcode == Opcode.SCHEMA else Channel).read(stream)
        except _PARSE_ERRORS:
            continue
        found.setdefault((span.opcode, record.id), record)
    return found
