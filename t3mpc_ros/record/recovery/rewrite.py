# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Writes what was found in a damaged file into a whole one, in the order of the damaged one."""

from typing import Any, BinaryIO

from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import CompressionType, Writer

from t3mpc_ros.record.recovery.layout import MESSAGE_HEAD

CHUNK_BYTES = 256 * 1024
MARK = 'recovered by t3mpc_ros'
"""Stands behind the name of the library in the header of a recovered file."""
UNKNOWN_TYPE = 'unknown/msg/Unknown'
"""The type of a channel whose schema was lost: its messages are kept, but cannot be decoded."""


class Rewriter:
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
            mark = library if MARK in library else f'{library}; {MARK}'.lstrip('; ')
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
