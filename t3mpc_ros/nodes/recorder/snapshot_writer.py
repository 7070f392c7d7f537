# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Snapshots: writes the circular message cache into a bag of its own."""

from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
import threading

from t3mpc_ros.bag.recording.diagnostics_monitor import snapshot_folder_name
from t3mpc_ros.bag.recording.snapshot import (
    SNAPSHOT_RECORD,
    CircularMessageCache,
    unused_folder,
    write_snapshot,
)
from t3mpc_ros.bag.schema import BagError, MessageDefinitions
from t3mpc_ros.bag.writer import Attachment, SerializedMessage, TopicMetadata

FOLDER = 'snapshots'
SLICE_PAUSE = 0.01
"""Seconds after every slice of a snapshot: compressing it at once would hold up the recording."""


class SnapshotWriter:
    """Keeps the last seconds, and writes them down when asked, one snapshot at a time.

    Parameters
    ----------
    folder
        Of the bag; snapshots go into a folder below it.
    ring
        Where the messages are kept.
    definitions
        Where schemas come from.
    """

    def __init__(
        self, folder: Path, ring: CircularMessageCache, definitions: MessageDefinitions
    ) -> None:
        self._folder = folder / FOLDER
        self._ring = ring
        self._definitions = definitions
        self._topics: dict[str, TopicMetadata] = {}
        self._hurry = threading.Event()
        self._thread: threading.Thread | None = None
        self.done: list[Path] = []
        """Folders of the snapshots that are complete."""
        self.problem = ''
        """Why the last one could not be written; empty when it was."""

    @property
    def busy(self) -> bool:
        """Whether a snapshot is being written."""
        return self._thread is not None and self._thread.is_alive()

    def announce(self, topic: TopicMetadata, latched: int) -> None:
        """Remember what a snapshot has to know of a topic.

        ``latched`` is how many of its publishers keep their last message for those who come late.
        """
        self._topics[topic.topic] = topic
        if latched:
            self._ring.latch(topic.topic, latched)

    def add(self, messages: list[SerializedMessage]) -> None:
        """Keep ``messages``, in order of receipt."""
        self._ring.add(messages)

    def take(
        self,
        reason: str,
        now_ns: int,
        metadata_records: Mapping[str, Mapping[str, str]],
        attachments: list[tuple[Attachment, int]],
        told: Callable[[bool, str], None],
    ) -> Path:
        """Return the folder into which a snapshot is being written from now on.

        Parameters
        ----------
        reason
            Why; part of the folder's name and of the details.
        now_ns
            Nanoseconds since 1970, the clock of the stamps of receipt.
        details, attachments
            What else the bag is to hold.
        told
            Called by the writing thread: whether it is complete, and the outcome in words.

        Raises
        ------
        BagError
            Another one is being written, or there is nothing to write.
        """
        if self.busy:
            raise BagError('another snapshot is being written: ask again when it is done')
        messages = self._ring.held(now_ns)
        if not messages:
            raise BagError('nothing has been received in the time of a snapshot')
        moment = datetime.fromtimestamp(now_ns / 1e9)
        folder = unused_folder(
            self._folder, snapshot_folder_name(f'{moment:%Y_%m_%d-%H_%M_%S}', reason)
        )
        title = {SNAPSHOT_RECORD: {'reason': reason, 'time_ns': str(now_ns)}}
        topics = dict(self._topics)

        def write() -> None:
            try:
                count = write_snapshot(
                    folder,
                    messages,
                    topics=topics,
                    metadata_records={**metadata_records, **title},
                    attachments=attachments,
                    definitions=self._definitions,
                    pause=lambda: self._hurry.wait(SLICE_PAUSE),
                )
            except Exception as error:  # a dead thread must not look like a snapshot that is there
                self.problem = f'no snapshot of "{reason}": {error}'
                told(False, self.problem)
            else:
                self.problem = ''
                self.done.append(folder)
                told(True, f'snapshot of "{reason}": {count} messages in {folder}')

        self._thread = threading.Thread(target=write, name='snapshot', daemon=True)
        self._thread.start()
        return folder

    def close(self, seconds: float) -> None:
        """Wait until the snapshot that is being written is complete, now at full speed."""
        self._hurry.set()
        if self._thread is not None:
            self._thread.join(seconds)
