# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recovers one MCAP file: reads every record that is sound, and writes it into a new file."""

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

from t3mpc_ros.record.mcap_file import MAGIC
from t3mpc_ros.record.recovery.chunk import ChunkError, OpenChunk, chunk_span, open_chunk
from t3mpc_ros.record.recovery.layout import HEAD, MESSAGE_HEAD, Fit, Window, look
from t3mpc_ros.record.recovery.outcome import Damage, FileOutcome, TopicOutcome
from t3mpc_ros.record.recovery.rewrite import Rewriter
from t3mpc_ros.record.recovery.scan import INDEXES, Piece, Scan, attachment_is_sound
from t3mpc_ros.record.schema import RecordError

Progress = Callable[[int, int], None]
"""Called now and then with how many bytes of how many are done."""

_BLOCK = 2**20
_FOOTER = struct.Struct('<QQI')  # start of the summary, of its offsets, checksum
_SUMMARY = INDEXES - {Opcode.MESSAGE_INDEX}
_BROKEN = (McapError, ValueError, struct.error)  # what a record raises that cannot be parsed


class UnreadableError(RecordError):
    """An input of which nothing can be recovered here."""


def salvage(
    source: BinaryIO,
    output: BinaryIO,
    name: str = '',
    progress: Progress | None = None,
    compress: bool = True,
) -> FileOutcome:
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
    window = Window(source, source.seek(0, io.SEEK_END))
    return _Salvage(window, output, name, compress).run(progress or (lambda done, size: None))


class _Salvage:
    """The recovery of one file."""

    def __init__(self, window: Window, output: BinaryIO, name: str, compress: bool) -> None:
        self._window = window
        self._rewriter = Rewriter(output, compress)
        self._outcome = FileOutcome(name, window.size)
        self._topics: dict[int, str] = {}  # by channel
        self._elsewhere: dict[tuple[int, int], Any] | None = None
        self._statistics: Statistics | None = None
        self._lost: dict[int, int] = {}  # messages by channel, as message indexes tell
        self._unattributed: dict[int, int] = {}  # messages by channel that nobody announced
        self._waiting: Damage | None = None  # a lost chunk, its message indexes may follow
        self._waiting_is_vague = False  # nobody knows what else was there
        self._position = 0
        self._found = 0

    def run(self, progress: Progress) -> FileOutcome:
        begins_well = self._window.read(0, len(MAGIC)) == MAGIC
        start = len(MAGIC) if begins_well else self._beginning()
        if start > len(MAGIC):
            reason = 'bytes before the mark of an MCAP file'
            self._outcome.damages.append(Damage(0, start - len(MAGIC), reason))
        for piece in Scan(self._window, start, self._knows).pieces():
            progress(piece.start, self._window.size)
            self._position = piece.end
            if piece.opcode != Opcode.MESSAGE_INDEX:
                self._settle()
            self._found += piece.opcode != 0
            if piece.reason:
                self._take_damaged(piece)
            else:
                self._take(piece)
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
            if look(self._window, start).fit is Fit.SOUND:
                return start
        mark = self._window.read(0, _BLOCK).find(MAGIC)
        return mark + len(MAGIC) if mark > 0 else 0

    # -- records --------------------------------------------------------------------------------

    def _take(self, piece: Piece) -> None:
        if piece.opcode in _SUMMARY:
            self._outcome.ended = True
        try:
            if piece.opcode == Opcode.CHUNK:
                self._take_chunk(piece)
            elif piece.opcode == Opcode.MESSAGE_INDEX:
                if self._waiting:
                    index = MessageIndex.read(self._stream(piece))
                    self._waiting = self._with_losses(self._waiting, index)
            else:
                self._take_record(piece.opcode, memoryview(self._content(piece)), checked=False)
                if piece.opcode == Opcode.DATA_END:
                    self._check_all(piece)
                elif piece.opcode == Opcode.FOOTER and not _summary_is_sound(self._window, piece):
                    self._statistics = None
                    self._note('the index of the file is damaged')
        except _BROKEN as error:
            self._damage(piece, f'a record cannot be read: {error or type(error).__name__}')

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
            if not attachment_is_sound(bytes(content)):
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

    def _take_chunk(self, piece: Piece) -> None:
        try:
            chunk = open_chunk(self._window, piece.start)
            if not chunk.whole:
                raise ChunkError('the data of a chunk reach behind the end of the file')
        except ChunkError as error:
            span = chunk_span(self._window, piece.start)
            self._waiting = Damage(piece.start, piece.end, str(error), span_ns=span)
            self._waiting_is_vague = False
            return
        if broken := self._take_records(chunk):
            self._damage(piece, f'{broken} records of a chunk cannot be read')

    def _take_records(self, chunk: OpenChunk) -> int:
        """Take what is in a chunk, and return how many of its records make no sense."""
        broken = 0
        self._rewriter.close_chunk()
        for opcode, content in chunk.records():
            if opcode not in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                broken += 1
                continue
            try:
                self._take_record(opcode, content, chunk.checked)
            except _BROKEN:
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
            self._outcome.topics.setdefault(record.topic, TopicOutcome(record.topic, kind))

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
            self._elsewhere = _announced(self._window, self._position)
        return self._elsewhere.get((kind, number))

    # -- losses ---------------------------------------------------------------------------------

    def _take_damaged(self, piece: Piece) -> None:
        if piece.torn and piece.opcode == Opcode.CHUNK:
            self._take_torn_chunk(piece)
        elif piece.opcode == Opcode.CHUNK or piece.opcode == 0:
            span = chunk_span(self._window, piece.start) if piece.opcode else None
            harmless = self._outcome.ended  # only the index is left
            self._waiting_is_vague = piece.opcode == 0
            self._waiting = Damage(
                piece.start, piece.end, piece.reason, harmless=harmless, span_ns=span
            )
        else:
            self._damage(piece, piece.reason)

    def _take_torn_chunk(self, piece: Piece) -> None:
        span = chunk_span(self._window, piece.start)
        before = {name: topic.kept for name, topic in self._outcome.topics.items()}
        with suppress(ChunkError):  # the piece's own reason says enough
            self._take_records(open_chunk(self._window, piece.start))
        kept = sum(t.kept - before.get(name, 0) for name, t in self._outcome.topics.items())
        reason = f'{piece.reason}; {kept} messages of it are kept, unchecked'
        self._outcome.damages.append(Damage(piece.start, piece.end, reason, span_ns=span))

    def _damage(self, piece: Piece, reason: str) -> None:
        harmless = piece.opcode in INDEXES or self._outcome.ended
        if piece.opcode in _SUMMARY:
            self._outcome.ended = True
        messages = 0 if piece.opcode in (Opcode.METADATA, Opcode.ATTACHMENT) else None
        self._outcome.damages.append(
            Damage(piece.start, piece.end, reason, harmless, messages=messages)
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
            outcome.topics.setdefault(name, TopicOutcome(name, '')).lost += count
        if self._unattributed:
            count = sum(self._unattributed.values())
            reason = f'{count} messages of channels whose names are lost'
            outcome.damages.append(Damage(0, 0, reason, messages=count))
        open_ends = [d for d in outcome.damages if not d.harmless and d.messages is None]
        outcome.exact = outcome.ended and not open_ends

    def _check_all(self, piece: Piece) -> None:
        """Compare the checksum over everything, which also covers what has none of its own."""
        wanted = DataEnd.read(self._stream(piece)).data_section_crc
        if not wanted or self._outcome.damages:
            return
        checksum = 0
        for start in range(0, piece.start, _BLOCK):
            count = min(_BLOCK, piece.start - start)
            checksum = zlib.crc32(self._window.read(start, count), checksum)
        if checksum != wanted:
            reason = (
                'the checksum over the whole file is wrong: a record outside the chunks differs'
            )
            self._outcome.damages.append(Damage(0, 0, reason))

    def _note(self, text: str) -> None:
        if text not in self._outcome.notes:
            self._outcome.notes.append(text)

    def _content(self, piece: Piece) -> bytes:
        return self._window.read(piece.start + HEAD.size, piece.end - piece.start - HEAD.size)

    def _stream(self, piece: Piece) -> ReadDataStream:
        return ReadDataStream(io.BytesIO(self._content(piece)))


def _summary_is_sound(window: Window, piece: Piece) -> bool:
    """Return whether the checksum in the footer fits the summary before it, or there is none."""
    start, _, checksum = _FOOTER.unpack(window.read(piece.end - _FOOTER.size, _FOOTER.size))
    if not checksum:
        return True
    start = start or piece.start
    return bool(zlib.crc32(window.read(start, piece.end - 4 - start)) == checksum)


def _announced(window: Window, position: int) -> dict[tuple[int, int], Any]:
    """Return schemas and channels that stand behind ``position``, by kind and number.

    Usually in the summary at the end of the file; one whose checksum is wrong is not believed.
    """
    end = window.size - len(MAGIC)
    footer = Piece(end - HEAD.size - _FOOTER.size, end, Opcode.FOOTER)
    head = window.read(max(0, footer.start), HEAD.size)
    if footer.start >= position and head == HEAD.pack(Opcode.FOOTER, _FOOTER.size):
        if not _summary_is_sound(window, footer):
            return {}
        (start,) = struct.unpack('<Q', window.read(footer.start + HEAD.size, 8))
        position = max(position, start)
    found: dict[tuple[int, int], Any] = {}
    for piece in Scan(window, position, lambda channel: True).pieces():
        if piece.reason or piece.opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            continue
        content = window.read(piece.start + HEAD.size, piece.end - piece.start - HEAD.size)
        stream = ReadDataStream(io.BytesIO(content))
        try:
            record = (Schema if piece.opcode == Opcode.SCHEMA else Channel).read(stream)
        except _BROKEN:
            continue
        found.setdefault((piece.opcode, record.id), record)
    return found
