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

from t3mpc_ros.bag.mcap_file import MAGIC
from t3mpc_ros.bag.recovery.result import Damage, FileResult, TopicResult
from t3mpc_ros.bag.recovery.scanner import (
    HEAD,
    INDEX_RECORDS,
    MESSAGE_HEAD,
    ChunkError,
    DecodedChunk,
    FileWindow,
    RecordFit,
    Scanner,
    Span,
    attachment_is_valid,
    chunk_time_range,
    classify_record,
    decode_chunk,
)
from t3mpc_ros.bag.schema import BagError

CHUNK_BYTES = 256 * 1024
LIBRARY_MARK = 'recovered by t3mpc_ros'
"""Stands behind the name of the library in the header of a recovered file."""
UNKNOWN_TYPE = 'unknown/msg/Unknown'
"""The type of a channel whose schema was lost: its messages are kept, but cannot be decoded."""


class RecoveredFileWriter:
    """The output file; numbers of schemas and channels are those of the input, until they change.

    A chunk is closed wherever the input has one closed, and at :data:`CHUNK_BYTES`: the same
    records give the same bytes, so a recovered file, recovered again, stays as it is.
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
        self._unknown = 0

    def start(self, profile: str, library: str) -> None:
        """Write the header, once; what comes without one is taken to be of ROS 2."""
        if not self._started:
            self._started = True
            mark = (
                library if LIBRARY_MARK in library else f'{library}; {LIBRARY_MARK}'.lstrip('; ')
            )
            self._writer.start(profile=profile, library=mark)

    def schema(self, record: Schema) -> None:
        """Announce a schema; the same one again changes nothing."""
        self._begin()
        known = self._schemas.get(record.id)
        if known is None or known[0] != record:
            number = self._writer.register_schema(record.name, record.encoding, record.data)
            self._schemas[record.id] = (record, number)

    def has_schema(self, number: int) -> bool:
        """Return whether the schema was announced; 0 stands for none at all."""
        return number == 0 or number in self._schemas

    def channel(self, record: Channel) -> bool:
        """Announce a channel and return whether it is new; the same again changes nothing."""
        self._begin()
        known = self._channels.get(record.id)
        if known is not None and known[0] == record:
            return False
        if record.schema_id == 0:
            schema = 0
        elif record.schema_id in self._schemas:
            schema = self._schemas[record.schema_id][1]
        else:
            schema = self._unknown = self._unknown or self._writer.register_schema(
                UNKNOWN_TYPE, '', b''
            )
        number = self._writer.register_channel(
            record.topic, record.message_encoding, schema, dict(record.metadata)
        )
        self._channels[record.id] = (record, number)
        return True

    def type_of(self, record: Channel) -> str:
        """Return the type that messages of a channel have; empty for a channel without one."""
        if record.schema_id == 0:
            return ''
        known = self._schemas.get(record.schema_id)
        return str(known[0].name) if known else UNKNOWN_TYPE

    def message(self, content: memoryview) -> None:
        """Write one message of an announced channel, given as its record."""
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
        """End the chunk here, as the input does."""
        self._begin()
        self._writer.flush()

    def finish(self) -> None:
        """Write the index; the output itself stays open."""
        self._begin()
        self._writer.finish()

    def _begin(self) -> None:
        self.start('ros2', '')


Progress = Callable[[int, int], None]
"""Called now and then with how many bytes of how many are done."""

_BLOCK = 2**20
_FOOTER = struct.Struct('<QQI')  # start of the summary, of its offsets, checksum
_SUMMARY_RECORDS = INDEX_RECORDS - {Opcode.MESSAGE_INDEX}
_PARSE_ERRORS = (McapError, ValueError, struct.error)  # what a record raises that cannot be parsed


class UnreadableError(BagError):
    """An input of which nothing can be recovered here."""


def recover_file(
    source: BinaryIO,
    output: BinaryIO,
    name: str = '',
    progress: Progress | None = None,
    compress: bool = True,
) -> FileResult:
    """Return what of ``source`` was written to ``output``, a whole MCAP file.

    Memory is bounded by the largest record. ``source`` is only read, ``output`` only written,
    and both are left open.

    Parameters
    ----------
    name
        For the outcome and for errors.
    compress
        False to save time when the output is thrown away.

    Raises
    ------
    UnreadableError
        There is nothing of an MCAP file in ``source``.
    OSError
        Reading or writing failed.
    """
    window = FileWindow(source, source.seek(0, io.SEEK_END))
    return _FileRecovery(window, output, name, compress).run(progress or (lambda done, size: None))


class _FileRecovery:
    """The recovery of one file."""

    def __init__(self, window: FileWindow, output: BinaryIO, name: str, compress: bool) -> None:
        self._window = window
        self._rewriter = RecoveredFileWriter(output, compress)
        self._outcome = FileResult(name, window.size)
        self._topics: dict[int, str] = {}  # by channel
        self._elsewhere: dict[tuple[int, int], Any] | None = None
        self._statistics: Statistics | None = None
        self._lost: dict[int, int] = {}  # messages by channel, as message indexes tell
        self._unattributed: dict[int, int] = {}  # messages by channel that nobody announced
        self._waiting: Damage | None = None  # a lost chunk, its message indexes may follow
        self._waiting_is_vague = False  # nobody knows what else was there
        self._position = 0
        self._found = 0

    def run(self, progress: Progress) -> FileResult:
        begins_well = self._window.read(0, len(MAGIC)) == MAGIC
        start = len(MAGIC) if begins_well else self._beginning()
        if start > len(MAGIC):
            reason = 'bytes before the mark of an MCAP file'
            self._outcome.damages.append(Damage(0, start - len(MAGIC), reason))
        for span in Scanner(self._window, start, self._knows).spans():
            progress(span.start, self._window.size)
            self._position = span.end
            if span.opcode != Opcode.MESSAGE_INDEX:
                self._settle()
            self._found += span.opcode != 0
            if span.reason:
                self._take_damaged(span)
            else:
                self._take(span)
        self._settle()
        if not begins_well and not self._found:
            name = self._outcome.name or 'the input'
            raise UnreadableError(f'{name} holds nothing of an MCAP file')
        if not begins_well:
            self._note('the mark at the beginning of the file is damaged')
        if not self._outcome.ended:
            self._note('the file has no end: what its writer still held never reached the disk')
        self._count()
        self._rewriter.finish()
        progress(self._window.size, self._window.size)
        return self._outcome

    def _beginning(self) -> int:
        """Return where to start in a file that does not begin with its mark."""
        for start in (0, len(MAGIC)):
            if classify_record(self._window, start).fit is RecordFit.SOUND:
                return start
        mark = self._window.read(0, _BLOCK).find(MAGIC)
        return mark + len(MAGIC) if mark > 0 else 0

    # -- records --------------------------------------------------------------------------------

    def _take(self, span: Span) -> None:
        if span.opcode in _SUMMARY_RECORDS:
            self._outcome.ended = True
        try:
            if span.opcode == Opcode.CHUNK:
                self._take_chunk(span)
            elif span.opcode == Opcode.MESSAGE_INDEX:
                if self._waiting:
                    index = MessageIndex.read(self._stream(span))
                    self._waiting = self._with_losses(self._waiting, index)
            else:
                self._take_record(span.opcode, memoryview(self._content(span)), checked=False)
                if span.opcode == Opcode.DATA_END:
                    self._check_all(span)
                elif span.opcode == Opcode.FOOTER and not _summary_is_valid(self._window, span):
                    self._statistics = None
                    self._note('the index of the file is damaged')
        except _PARSE_ERRORS as error:
            self._damage(span, f'a record cannot be read: {error or type(error).__name__}')

    def _take_record(self, opcode: int, content: memoryview, checked: bool) -> None:
        """Take a record that is no chunk, from inside a chunk or between them."""
        if opcode == Opcode.MESSAGE:
            self._take_message(content, checked)
            return
        stream = ReadDataStream(io.BytesIO(content))
        if opcode == Opcode.SCHEMA:
            self._rewriter.schema(Schema.read(stream))
        elif opcode == Opcode.CHANNEL:
            self._announce(Channel.read(stream))
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
        if not self._knows(channel):
            self._unattributed[channel] = self._unattributed.get(channel, 0) + 1
            return
        self._rewriter.message(content)
        topic = self._outcome.topics[self._topics[channel]]
        topic.kept += 1
        topic.unchecked += not checked

    def _take_chunk(self, span: Span) -> None:
        try:
            chunk = decode_chunk(self._window, span.start)
            if not chunk.whole:
                raise ChunkError('the data of a chunk reach behind the end of the file')
        except ChunkError as error:
            time_range = chunk_time_range(self._window, span.start)
            self._waiting = Damage(span.start, span.end, str(error), span_ns=time_range)
            self._waiting_is_vague = False
            return
        if broken := self._take_records(chunk):
            self._damage(span, f'{broken} records of a chunk cannot be read')

    def _take_records(self, chunk: DecodedChunk) -> int:
        """Take what is in a chunk, and return how many of its records make no sense."""
        broken = 0
        self._rewriter.close_chunk()
        for opcode, content in chunk.records():
            if opcode not in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                broken += 1
                continue
            try:
                self._take_record(opcode, content, chunk.checked)
            except _PARSE_ERRORS:
                broken += 1
        self._rewriter.close_chunk()
        return broken

    # -- channels -------------------------------------------------------------------------------

    def _announce(self, record: Channel) -> None:
        if not self._rewriter.has_schema(record.schema_id):
            schema = self._look_elsewhere(Opcode.SCHEMA, record.schema_id)
            if schema is None:
                self._note(f'the type of {record.topic} is lost: its messages cannot be decoded')
            else:
                self._rewriter.schema(schema)
        if self._rewriter.channel(record):
            self._topics[record.id] = record.topic
            kind = self._rewriter.type_of(record)
            self._outcome.topics.setdefault(record.topic, TopicResult(record.topic, kind))

    def _knows(self, channel: int) -> bool:
        """Return whether a channel is announced; if not, the end of the file may know it."""
        if channel in self._topics:
            return True
        record = self._look_elsewhere(Opcode.CHANNEL, channel)
        if record is None:
            return False
        self._announce(record)
        return True

    def _look_elsewhere(self, kind: int, number: int) -> Any:
        if self._elsewhere is None:
            self._elsewhere = _find_definitions(self._window, self._position)
        return self._elsewhere.get((kind, number))

    # -- losses ---------------------------------------------------------------------------------

    def _take_damaged(self, span: Span) -> None:
        if span.torn and span.opcode == Opcode.CHUNK:
            self._take_torn_chunk(span)
        elif span.opcode == Opcode.CHUNK or span.opcode == 0:
            time_range = chunk_time_range(self._window, span.start) if span.opcode else None
            harmless = self._outcome.ended  # only the index is left
            self._waiting_is_vague = span.opcode == 0
            self._waiting = Damage(
                span.start, span.end, span.reason, harmless=harmless, span_ns=time_range
            )
        else:
            self._damage(span, span.reason)

    def _take_torn_chunk(self, span: Span) -> None:
        time_range = chunk_time_range(self._window, span.start)
        before = {name: topic.kept for name, topic in self._outcome.topics.items()}
        with suppress(ChunkError):  # the piece's own reason says enough
            self._take_records(decode_chunk(self._window, span.start))
        kept = sum(t.kept - before.get(name, 0) for name, t in self._outcome.topics.items())
        reason = f'{span.reason}; {kept} messages of it are kept, unchecked'
        self._outcome.damages.append(Damage(span.start, span.end, reason, span_ns=time_range))

    def _damage(self, span: Span, reason: str) -> None:
        harmless = span.opcode in INDEX_RECORDS or self._outcome.ended
        if span.opcode in _SUMMARY_RECORDS:
            self._outcome.ended = True
        messages = 0 if span.opcode in (Opcode.METADATA, Opcode.ATTACHMENT) else None
        self._outcome.damages.append(
            Damage(span.start, span.end, reason, harmless, messages=messages)
        )

    def _with_losses(self, damage: Damage, index: MessageIndex) -> Damage:
        """Return the lost chunk with what one of its message indexes says was in it."""
        times = [time for time, _ in index.records]
        if not times:
            return damage
        self._lost[index.channel_id] = self._lost.get(index.channel_id, 0) + len(times)
        if self._waiting_is_vague:  # more chunks than the one that this index belongs to
            return damage
        first, last = damage.span_ns or (times[0], times[0])
        return replace(
            damage,
            messages=(damage.messages or 0) + len(times),
            span_ns=(min(first, *times), max(last, *times)),
        )

    def _settle(self) -> None:
        """Note the lost chunk whose message indexes have ended."""
        if self._waiting:
            self._outcome.damages.append(self._waiting)
            self._waiting = None

    def _count(self) -> None:
        """Sum up the losses; exactly, when the file says how many messages there were."""
        outcome = self._outcome
        statistics = self._statistics
        if outcome.clean and not self._unattributed:
            outcome.exact = True
            return
        if statistics is not None and all(
            self._knows(channel) for channel in statistics.channel_message_counts
        ):
            totals: dict[str, int] = {}
            for channel, count in statistics.channel_message_counts.items():
                name = self._topics[channel]
                totals[name] = totals.get(name, 0) + count
            for topic in outcome.topics.values():
                topic.lost = max(0, totals.get(topic.name, 0) - topic.kept)
            outcome.exact = True
            return
        for channel, count in [*self._lost.items(), *self._unattributed.items()]:
            unknown = f'(channel {channel}, name lost)'
            name = self._topics[channel] if self._knows(channel) else unknown
            outcome.topics.setdefault(name, TopicResult(name, '')).lost += count
        if self._unattributed:
            count = sum(self._unattributed.values())
            reason = f'{count} messages of channels whose names are lost'
            outcome.damages.append(Damage(0, 0, reason, messages=count))
        open_ends = [d for d in outcome.damages if not d.harmless and d.messages is None]
        outcome.exact = outcome.ended and not open_ends

    def _check_all(self, span: Span) -> None:
        """Compare the checksum over everything, which also covers what has none of its own."""
        wanted = DataEnd.read(self._stream(span)).data_section_crc
        if not wanted or self._outcome.damages:
            return
        checksum = 0
        for start in range(0, span.start, _BLOCK):
            count = min(_BLOCK, span.start - start)
            checksum = zlib.crc32(self._window.read(start, count), checksum)
        if checksum != wanted:
            reason = (
                'the checksum over the whole file is wrong: a record outside the chunks differs'
            )
            self._outcome.damages.append(Damage(0, 0, reason))

    def _note(self, text: str) -> None:
        if text not in self._outcome.notes:
            self._outcome.notes.append(text)

    def _content(self, span: Span) -> bytes:
        return self._window.read(span.start + HEAD.size, span.end - span.start - HEAD.size)

    def _stream(self, span: Span) -> ReadDataStream:
        return ReadDataStream(io.BytesIO(self._content(span)))


def _summary_is_valid(window: FileWindow, span: Span) -> bool:
    """Return whether the checksum in the footer fits the summary before it, or there is none."""
    start, _, checksum = _FOOTER.unpack(window.read(span.end - _FOOTER.size, _FOOTER.size))
    if not checksum:
        return True
    start = start or span.start
    return bool(zlib.crc32(window.read(start, span.end - 4 - start)) == checksum)


def _find_definitions(window: FileWindow, position: int) -> dict[tuple[int, int], Any]:
    """Return schemas and channels that stand behind ``position``, by kind and number.

    Usually in the summary at the end of the file; one whose checksum is wrong is not believed.
    """
    end = window.size - len(MAGIC)
    footer = Span(end - HEAD.size - _FOOTER.size, end, Opcode.FOOTER)
    head = window.read(max(0, footer.start), HEAD.size)
    if footer.start >= position and head == HEAD.pack(Opcode.FOOTER, _FOOTER.size):
        if not _summary_is_valid(window, footer):
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
