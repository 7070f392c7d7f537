# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recording over several files, split by size or duration."""

from collections.abc import Mapping
from pathlib import Path

from t3mpc_ros.bag.schema import MessageDefinitions
from t3mpc_ros.bag.writer import Attachment, BagWriter, SerializedMessage, TopicMetadata
from t3mpc_ros.geometry.types import NANOSECONDS

SYNC_PERIOD_NS = NANOSECONDS
"""Shortest time between two waits for the disk itself."""


class SplitWriter:
    """Writes a recording, into one file after the other.

    A process that is killed loses what came within ``chunk_ns`` before, as far as :meth:`tick` is
    called often; a machine without power what came within that and :data:`SYNC_NS`.

    Parameters
    ----------
    folder
        Of the bag; one that exists is continued.
    details
        Tables of text for every file.
    chunk_bytes, chunk_ns
        A chunk goes to the file when it holds so much, and when its oldest message came so long
        ago.
    split_bytes, split_ns
        A file is followed by another when it is at least so long, and when its first message was
        received so long before the one to write; 0 = never.
    definitions
        Where schemas and type hashes come from.

    Raises
    ------
    FolderError
        The folder or the file cannot be made.
    DataError
        The details are not text.
    """

    def __init__(
        self,
        folder: Path,
        metadata_records: Mapping[str, Mapping[str, str]],
        *,
        chunk_bytes: int = 256 * 1024,
        chunk_ns: int = NANOSECONDS // 2,
        split_bytes: int = 0,
        split_ns: int = 0,
        definitions: MessageDefinitions | None = None,
    ) -> None:
        self._folder = folder
        self._metadata_records = {title: dict(table) for title, table in metadata_records.items()}
        self._attachments: dict[str, tuple[Attachment, int]] = {}
        self._topics: dict[str, TopicMetadata] = {}
        self._definitions = definitions or MessageDefinitions()
        self._chunk_bytes, self._chunk_ns = chunk_bytes, chunk_ns
        self._split_bytes, self._split_ns = split_bytes, split_ns
        self._bag = self._open()
        self._first_ns: int | None = None
        self._oldest_ns: int | None = None
        self._synced_ns = 0

    @property
    def path(self) -> Path:
        """The file that is being written."""
        return self._bag.path

    def add_metadata_record(self, title: str, table: Mapping[str, str]) -> None:
        """Put one more table of text into this and all later files, or a newer one."""
        self._metadata_records[title] = dict(table)
        self._bag.add_metadata_record(title, table)

    def add_attachment(self, attachment: Attachment, read_ns: int) -> None:
        """Put a file into this and all later files of the bag."""
        self._attachments[attachment.name] = attachment, read_ns
        self._bag.add_attachment(attachment, read_ns)

    def add_topic(self, topic: TopicMetadata) -> None:
        """Announce a topic before its first message."""
        self._announce(topic)
        self._topics[topic.topic] = topic

    def write(self, message: SerializedMessage, now_ns: int) -> None:
        """Record one message; ``now_ns`` is of the clock of :meth:`tick`.

        Raises
        ------
        DiskError
            Writing failed; what was written before is kept.
        FolderError
            The next file cannot be made.
        DataError, UnknownTopicError
            As :meth:`BagWriter.write`.
        """
        if self._is_long(message.received_ns):
            self.split()
        if self._first_ns is None:
            self._first_ns = message.received_ns
        if self._oldest_ns is None:
            self._oldest_ns = now_ns
        self._bag.write(*message)

    def tick(self, now_ns: int) -> None:
        """Bring to the file, and to the disk, what has waited long enough.

        ``now_ns`` is of any clock that only runs forward.

        Raises
        ------
        DiskError
            As :meth:`write`.
        """
        if self._oldest_ns is not None and now_ns - self._oldest_ns >= self._chunk_ns:
            self._bag.flush()
            self._oldest_ns = None
        if now_ns - self._synced_ns >= SYNC_PERIOD_NS:
            self._bag.sync()
            self._synced_ns = now_ns

    def split(self) -> Path:
        """Return the next file, in which the recording goes on; the one before is complete.

        Raises
        ------
        DiskError, FolderError
            As :meth:`write`.
        """
        self._bag.close()
        self._bag = self._open()
        self._first_ns = self._oldest_ns = None
        for attachment, read_ns in self._attachments.values():
            self._bag.add_attachment(attachment, read_ns)
        for topic in self._topics.values():
            self._announce(topic)
        return self.path

    def close(self) -> None:
        """Complete the last file; again, do nothing.

        Raises
        ------
        DiskError
            As :meth:`write`.
        """
        self._bag.close()

    def _open(self) -> BagWriter:
        return BagWriter(
            self._folder,
            metadata_records=self._metadata_records,
            chunk_bytes=self._chunk_bytes,
            chunk_ns=self._chunk_ns,
            definitions=self._definitions,
        )

    def _announce(self, topic: TopicMetadata) -> None:
        self._bag.add_topic(topic.topic, topic.type_name, topic.profiles, topic.type_hash)

    def _is_long(self, received_ns: int) -> bool:
        if self._split_bytes and self._bag.size >= self._split_bytes:
            return self._first_ns is not None
        if self._split_ns and self._first_ns is not None:
            return received_ns - self._first_ns >= self._split_ns
        return False


def message_loss_record(dropped: Mapping[str, int], lost: Mapping[str, int]) -> dict[str, str]:
    """Return the table of details that says what a bag lacks, by cause and by topic.

    Parameters
    ----------
    dropped
        Messages of each topic that found no room while the disk was busy.
    lost
        Messages of each topic that the middleware lost before the recorder had them.
    """
    table = {'dropped': str(sum(dropped.values())), 'lost': str(sum(lost.values()))}
    for cause, counts in (('dropped', dropped), ('lost', lost)):
        table |= {f'{cause} {topic}': str(count) for topic, count in sorted(counts.items())}
    return table
