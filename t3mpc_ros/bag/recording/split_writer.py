# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recording over several files, split by size, by duration or on request.

Each file is complete in itself: schemas and channels of its messages, all metadata records, all
attachments. Transient-local messages of earlier files are not repeated: a reader of the folder
would receive them twice. A player that starts in the middle reads the last ones from the earlier
files.
"""

from collections.abc import Mapping
from pathlib import Path

from t3mpc_ros.bag.mcap_file import Attachment, SerializedMessage
from t3mpc_ros.bag.metadata import TopicInformation
from t3mpc_ros.bag.schema import MessageDefinitions
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.geometry.types import NANOSECONDS

SYNC_PERIOD_NS = NANOSECONDS
"""Minimum time between two synchronizations with the disk."""


class SplitWriter:
    """Writes a recording to consecutive files of one bag.

    A killed process loses the messages of the last ``chunk_ns``, provided that :meth:`tick` is
    called often; a power failure loses those of the last ``chunk_ns`` and
    :data:`SYNC_PERIOD_NS`.

    Parameters
    ----------
    folder
        Folder of the bag; an existing bag is continued.
    metadata_records
        Tables of text by record name, written to every file.
    chunk_bytes, chunk_ns
        Size of a chunk, and age of its oldest message, at which it is written to the file.
    max_file_bytes, max_file_ns
        Size of a file, and age of its first message, after which the next file begins; 0 = no
        limit.
    definitions
        Source of schemas and type hashes.

    Raises
    ------
    FolderError
        The folder or the file cannot be created.
    DataError
        ``metadata_records`` contains values other than text.
    """

    def __init__(
        self,
        folder: Path,
        metadata_records: Mapping[str, Mapping[str, str]],
        *,
        chunk_bytes: int = 256 * 1024,
        chunk_ns: int = NANOSECONDS // 2,
        max_file_bytes: int = 0,
        max_file_ns: int = 0,
        definitions: MessageDefinitions | None = None,
    ) -> None:
        self._folder = folder
        self._metadata_records = {title: dict(table) for title, table in metadata_records.items()}
        self._attachments: dict[str, tuple[Attachment, int]] = {}
        self._topics: dict[str, TopicInformation] = {}
        self._definitions = definitions or MessageDefinitions()
        self._chunk_bytes, self._chunk_ns = chunk_bytes, chunk_ns
        self._max_file_bytes, self._max_file_ns = max_file_bytes, max_file_ns
        self._bag = self._open()
        self._first_ns: int | None = None
        self._oldest_ns: int | None = None
        self._synced_ns = 0

    @property
    def path(self) -> Path:
        """Current file."""
        return self._bag.path

    def add_metadata_record(self, title: str, table: Mapping[str, str]) -> None:
        """Write a metadata record to the current file and all later ones."""
        self._metadata_records[title] = dict(table)
        self._bag.add_metadata_record(title, table)

    def add_attachment(self, attachment: Attachment, read_ns: int) -> None:
        """Write an attachment to the current file and all later ones."""
        self._attachments[attachment.name] = attachment, read_ns
        self._bag.add_attachment(attachment, read_ns)

    def add_topic(self, topic: TopicInformation) -> None:
        """Add a topic before its first message."""
        self._add_topic(topic)
        self._topics[topic.name] = topic

    def write(self, message: SerializedMessage, now_ns: int) -> None:
        """Write one message; ``now_ns`` is a time of the clock of :meth:`tick`.

        Raises
        ------
        DiskError
            Writing failed; messages written before are kept.
        FolderError
            The next file cannot be created.
        DataError, UnknownTopicError
            As :meth:`BagWriter.write`.
        """
        if self._exceeds_limit(message.received_ns):
            self.split()
        if self._first_ns is None:
            self._first_ns = message.received_ns
        if self._oldest_ns is None:
            self._oldest_ns = now_ns
        self._bag.write(*message)

    def tick(self, now_ns: int) -> None:
        """Write the chunk to the file and synchronize with the disk when their time has passed.

        ``now_ns`` is a time of any monotonic clock.

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
        """Complete the current file, begin the next one and return its path.

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
            self._add_topic(topic)
        return self.path

    def close(self) -> None:
        """Complete the current file; idempotent.

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

    def _add_topic(self, topic: TopicInformation) -> None:
        self._bag.add_topic(
            topic.name, topic.type_name, topic.offered_qos_profiles, topic.type_hash
        )

    def _exceeds_limit(self, received_ns: int) -> bool:
        if self._max_file_bytes and self._bag.size >= self._max_file_bytes:
            return self._first_ns is not None
        if self._max_file_ns and self._first_ns is not None:
            return received_ns - self._first_ns >= self._max_file_ns
        return False


LOSSES = 'losses'
"""Name of the metadata record of :func:`message_loss_record`."""
LOSS_CAUSES = {
    'dropped': 'dropped because the disk was too slow',
    'lost': 'lost by the middleware',
    'undiscovered': 'published before the recorder had discovered their publisher',
}
"""Why messages are missing in a bag, by key of its loss record."""


def message_loss_record(
    dropped: Mapping[str, int],
    lost: Mapping[str, int],
    undiscovered: Mapping[str, int],
) -> dict[str, str]:
    """Return the metadata record of missing messages, by cause and topic.

    Parameters
    ----------
    dropped
        Messages by topic that the full write queue dropped.
    lost
        Messages by topic that the middleware lost.
    undiscovered
        Messages by topic that were published before their publisher was discovered.
    """
    causes = dict(zip(LOSS_CAUSES, (dropped, lost, undiscovered), strict=True))
    table = {cause: str(sum(counts.values())) for cause, counts in causes.items()}
    for cause, counts in causes.items():
        table |= {f'{cause} {topic}': str(count) for topic, count in sorted(counts.items())}
    return table


def message_loss_notes(records: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Return a sentence for each topic and cause in the loss record of a bag.

    ``records`` are the metadata records of the bag, by name.
    """
    notes = []
    for key, count in records.get(LOSSES, {}).items():
        cause, _, topic = key.partition(' ')
        if topic and cause in LOSS_CAUSES:
            notes.append(f'{count} messages of {topic} are missing: {LOSS_CAUSES[cause]}.')
    return notes
