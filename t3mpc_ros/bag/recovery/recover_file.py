# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recovery of one damaged MCAP file into a complete one."""

from collections.abc import Callable
from dataclasses import replace
import io
import re
import struct
from typing import Any, BinaryIO
import zlib

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    DataEnd,
    Header,
    MessageIndex,
    Metadata,
    Schema,
)
from mcap.writer import CompressionType, Writer

from t3mpc_ros.bag.mcap_file import (
    HEAD,
    MAGIC,
    MESSAGE_HEAD,
    DecodedChunk,
    FileWindow,
    RecordError,
    chunk_end,
    decode_chunk,
    parse_record,
    read_record,
    read_summary,
)
from t3mpc_ros.bag.recovery.result import Damage, FileResult, TopicResult
from t3mpc_ros.bag.schema import BagError

CHUNK_BYTES = 256 * 1024
LIBRARY_MARK = 'recovered by t3mpc_ros'
"""Appended to the library name in the header of a recovered file."""
UNKNOWN_TYPE = 'unknown/msg/Unknown'
"""Type of a channel whose schema is lost: its messages are kept but cannot be decoded."""


Progress = Callable[[int, int], None]
"""Callback with the number of processed bytes and the size of the file."""

_BLOCK = 2**20
_OPCODES = frozenset(Opcode)
_DATA_END = HEAD.pack(Opcode.DATA_END, 4)
_CANDIDATE = re.compile(rb'[\x05\x06].{5}\x00\x00\x00|' + re.escape(MAGIC), re.DOTALL)
"""A message or chunk of less than 2^40 bytes, or the beginning or end of a file."""
_TRUNCATED_LIMIT = 2**28
"""Maximum plausible size of a truncated record, bytes."""


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
        self._lost: dict[int, int] = {}  # messages by channel, from message indexes
        self._unattributed: dict[int, int] = {}  # messages by undefined channel
        self._after_lost_chunk = False  # its message indexes may follow
        self._record_count = 0
        self._chunked = False  # then a message behind damaged bytes is a part of a damaged chunk
        found = read_summary(window)
        self._summary = found and found[0]
        self._data_end = found[1] if found else window.size
        self._statistics = self._summary.statistics if self._summary else None
        self._result.ended = found is not None

    def run(self, progress: Progress) -> FileResult:
        size, reached = self._window.size, 0

        def report(position: int) -> None:
            nonlocal reached
            if position > reached:
                reached = position
                progress(position, size)

        self._report = report
        progress(0, size)
        position = self._start()
        while position < size:
            report(position)
            position = self._take(position)
        if self._window.read(0, len(MAGIC)) != MAGIC:
            if not self._record_count:
                name = self._result.name or 'the input'
                raise UnreadableError(f'{name} contains no MCAP data')
            self._add_note('the MCAP magic at the beginning of the file is damaged')
        if not self._result.ended:
            self._add_note('the file has no end: the last chunk of its writer was not written')
        self._count_losses()
        self._rewriter.finish()
        progress(size, size)
        return self._result

    def _start(self) -> int:
        """Return the start of the records, also without the magic before them."""
        magic = self._window.read(0, _BLOCK).find(MAGIC)
        for start in (0, len(MAGIC)):
            if magic != 0 and self._begins_record(start):
                return start
        if magic > 0:
            self._result.damages.append(Damage(0, magic, 'bytes before the MCAP magic'))
        return magic + len(MAGIC) if magic >= 0 else 0

    # -- records --------------------------------------------------------------------------------

    def _take(self, start: int) -> int:
        """Copy the record at ``start``; return where the next one begins."""
        opcode, end = self._head(start)
        was_after_lost_chunk, self._after_lost_chunk = self._after_lost_chunk, False
        try:
            if opcode == Opcode.CHUNK:
                self._chunked = True
                return self._take_chunk(start, end)
            if opcode == Opcode.MESSAGE and end <= self._window.size:
                if not self._begins_record(end):
                    raise RecordError('no record found')
                content = self._window.read(start + HEAD.size, end - start - HEAD.size)
                self._take_message(memoryview(content), checked=False)
                self._record_count += 1
                return end
            record, end = read_record(self._window, start)
        except RecordError as error:
            return self._skip(start, str(error))
        self._record_count += 1
        if isinstance(record, MessageIndex):
            if was_after_lost_chunk:
                self._add_losses(record)
                self._after_lost_chunk = True
        elif isinstance(record, DataEnd):
            self._result.ended = True
            self._data_end = min(self._data_end, start)
            self._verify_data_checksum(start, record.data_section_crc)
        elif opcode == Opcode.FOOTER:
            return self._end_file(end)
        elif start < self._data_end:
            self._take_record(record)
        return end

    def _take_record(self, record: Any) -> None:
        if isinstance(record, Schema):
            self._rewriter.schema(record)
        elif isinstance(record, Channel):
            self._add_channel(record)
        elif isinstance(record, Header):
            self._rewriter.start(record.profile, record.library)
        elif isinstance(record, Metadata):
            self._rewriter.metadata(record)
        elif isinstance(record, Attachment):
            self._rewriter.attachment(record)

    def _take_message(self, content: memoryview, checked: bool) -> bool:
        """Copy a message; return False if its channel is unknown."""
        if len(content) < MESSAGE_HEAD.size:
            raise RecordError('a message is shorter than its head')
        channel = int.from_bytes(content[:2], 'little')
        if not self._is_known_channel(channel):
            self._unattributed[channel] = self._unattributed.get(channel, 0) + 1
            return False
        self._rewriter.message(content)
        topic = self._result.topics[self._topics[channel]]
        topic.kept += 1
        topic.unchecked += not checked
        return True

    def _take_chunk(self, start: int, end: int) -> int:
        inner_end = chunk_end(self._window, start)
        agree = inner_end == end
        if inner_end > self._window.size and not agree:  # not to read the rest of a long file
            raise RecordError('the lengths in a chunk are inconsistent')
        chunk = decode_chunk(self._window, start)
        if not chunk.complete:
            kept = self._take_records(chunk)
            reason = f'the file ends inside a chunk; {kept} messages of it are kept, unchecked'
            self._add_damage(start, self._window.size, reason, self._time_range(start))
            return self._window.size
        if not (chunk.checked or agree):
            raise RecordError('the lengths in a chunk are inconsistent')
        self._record_count += 1
        self._take_records(chunk)
        if agree:
            return end
        ends = [each for each in (inner_end, end) if self._begins_record(each)]
        return ends[0] if ends else self._skip(inner_end, 'no record found')

    def _take_records(self, chunk: DecodedChunk) -> int:
        """Copy the records of a chunk; return the number of kept messages."""
        invalid = count = 0
        self._rewriter.close_chunk()
        for opcode, content in chunk.records():
            try:
                if opcode == Opcode.MESSAGE:
                    count += self._take_message(content, chunk.checked)
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._take_record(parse_record(opcode, bytes(content)))
                else:
                    invalid += chunk.complete
            except RecordError:
                invalid += 1
        self._rewriter.close_chunk()
        if invalid:
            self._add_damage(0, 0, f'{invalid} records of a chunk cannot be read')
        return count

    def _end_file(self, position: int) -> int:
        """Return the end of the file after its footer."""
        self._result.ended = True
        if self._summary is None:
            self._add_note('the summary of the file is damaged')
        if self._window.read(position, len(MAGIC)) == MAGIC:
            position += len(MAGIC)
        if position < self._window.size:
            self._add_damage(position, self._window.size, 'bytes after the end of the file')
        return self._window.size

    # -- damaged records ------------------------------------------------------------------------

    def _skip(self, start: int, reason: str) -> int:
        """Record a damaged record; return where the next one begins.

        This is its end, if a record begins there, or the next record that is reliable.
        """
        opcode, end = self._head(start)
        rest = self._window.read(start, len(_DATA_END) + 4)
        if start + len(rest) == self._window.size and _DATA_END.startswith(rest[: HEAD.size]):
            self._result.ended = True
            self._data_end = start
        span_ns, messages, harmless = None, None, False
        if start < end and self._begins_record(end):
            if opcode == Opcode.CHUNK:
                self._after_lost_chunk = True
                span_ns = self._time_range(start)
            elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
                messages = 0
            harmless = opcode == Opcode.MESSAGE_INDEX and self._statistics is not None
        else:
            end = self._next_record(start + 1)
        self._add_damage(start, end, reason, span_ns, harmless, messages)
        return end

    def _begins_record(self, position: int) -> bool:
        """Return whether a record, possibly truncated, or the end of the file is at a position."""
        size = self._window.size
        if position + HEAD.size > size:
            return position <= size
        opcode, end = self._head(position)
        if opcode == Opcode.MESSAGE:
            channel = self._window.read(position + HEAD.size, 2)
            if len(channel) == 2 and not self._is_known_channel(int.from_bytes(channel, 'little')):
                return False
        if end > size:
            return opcode in _OPCODES and end - position < _TRUNCATED_LIMIT
        if opcode in (Opcode.CHUNK, Opcode.MESSAGE):
            return opcode == Opcode.MESSAGE or chunk_end(self._window, position) == end
        try:
            read_record(self._window, position)
        except RecordError:
            return False
        return True

    def _next_record(self, start: int) -> int:
        """Return the start of the next reliable chunk or message, or the end of the file.

        A message or attachment may contain a valid MCAP file: bytes between two MCAP magics are
        skipped.
        """
        within = False
        size = self._window.size
        for block_start in range(start, size, _BLOCK):
            self._report(block_start)
            block = self._window.read(block_start, _BLOCK + HEAD.size - 1)
            offset = 0
            while (match := _CANDIDATE.search(block, offset)) and match.start() < _BLOCK:
                offset = match.start() + 1
                if match[0] == MAGIC:
                    within = not within
                elif not within and self._is_reliable(block_start + match.start()):
                    return block_start + match.start()
        return size

    def _is_reliable(self, start: int) -> bool:
        """Return whether a valid chunk begins at ``start``, or a message and two more records."""
        opcode, end = self._head(start)
        if opcode == Opcode.MESSAGE:
            places = start, end, self._head(end)[1]
            return not self._chunked and all(map(self._begins_record, places))
        if end > self._window.size or chunk_end(self._window, start) != end:
            return False
        try:
            chunk = decode_chunk(self._window, start)
        except RecordError:
            return False
        return chunk.checked or all(opcode for opcode, _ in chunk.records())

    def _head(self, start: int) -> tuple[int, int]:
        """Return opcode and end of a record according to its head; zeros after the last byte."""
        head = self._window.read(start, HEAD.size)
        if len(head) < HEAD.size:
            return 0, 0
        opcode, length = HEAD.unpack(head)
        return opcode, start + HEAD.size + length

    # -- channels -------------------------------------------------------------------------------

    def _add_channel(self, record: Channel) -> None:
        if not self._rewriter.has_schema(record.schema_id):
            schema = self._summary and self._summary.schemas.get(record.schema_id)
            if not schema:
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
        if self._summary and channel in self._summary.channels:
            self._add_channel(self._summary.channels[channel])
        return channel in self._topics

    # -- losses ---------------------------------------------------------------------------------

    def _add_damage(
        self,
        start: int,
        end: int,
        reason: str,
        span_ns: tuple[int, int] | None = None,
        harmless: bool = False,
        messages: int | None = None,
    ) -> None:
        after_data = self._result.ended and start >= self._data_end
        damage = Damage(start, end, reason, harmless or after_data, messages, span_ns)
        self._result.damages.append(damage)

    def _add_losses(self, index: MessageIndex) -> None:
        """Add the messages of one message index to those of the last, damaged chunk."""
        count = len(index.records)
        self._lost[index.channel_id] = self._lost.get(index.channel_id, 0) + count
        chunk = self._result.damages[-1]
        self._result.damages[-1] = replace(chunk, messages=(chunk.messages or 0) + count)

    def _time_range(self, start: int) -> tuple[int, int] | None:
        """Return first and last message time in the head of a chunk, ns; None if invalid."""
        head = self._window.read(start + HEAD.size, 16)
        if len(head) < 16:
            return None
        first, last = struct.unpack('<QQ', head)
        return (first, last) if first <= last < 2**63 else None

    def _count_losses(self) -> None:
        """Count the lost messages; exactly if the file has its statistics."""
        result = self._result
        statistics = self._statistics
        if statistics is not None and all(
            self._is_known_channel(channel) for channel in statistics.channel_message_counts
        ):
            totals: dict[str, int] = {}
            for channel, count in statistics.channel_message_counts.items():
                name = self._topics[channel]
                totals[name] = totals.get(name, 0) + count
            for topic in result.topics.values():
                topic.lost = max(0, totals.get(topic.name, 0) - topic.kept)
            lost = sum(topic.lost for topic in result.topics.values())
            if lost and result.clean:
                result.damages.append(Damage(0, 0, f'{lost} messages are missing'))
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

    def _add_note(self, text: str) -> None:
        if text not in self._result.notes:
            self._result.notes.append(text)


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
