# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Snapshots: writes the circular message cache into a bag of its own."""

from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
import threading

from t3mpc_ros.bag.mcap_file import Attachment, SerializedMessage
from t3mpc_ros.bag.metadata import TopicInformation
from t3mpc_ros.bag.recording.diagnostics_monitor import snapshot_folder_name
from t3mpc_ros.bag.recording.snapshot import (
    SNAPSHOT_RECORD,
    CircularMessageCache,
    unused_folder,
    write_snapshot,
)
from t3mpc_ros.bag.schema import BagError, MessageDefinitions

FOLDER = 'snapshots'
SLICE_PAUSE = 0.01
"""Pause between the slices of a snapshot, s, so that its compression does not delay recording."""


class SnapshotWriter:
    """Caches the last seconds and writes them on request, one snapshot at a time.

    Parameters
    ----------
    folder
        Folder of the bag; snapshots are written to a folder below it.
    cache
        Cache of the messages.
    definitions
        Source of the message schemas.
    """

    def __init__(
        self, folder: Path, cache: CircularMessageCache, definitions: MessageDefinitions
    ) -> None:
        self._folder = folder / FOLDER
        self._cache = cache
        self._definitions = definitions
        self._topics: dict[str, TopicInformation] = {}
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self.completed: list[Path] = []
        """Folders of the complete snapshots."""
        self.problem = ''
        """Why the last snapshot failed; empty if it did not."""

    @property
    def busy(self) -> bool:
        """Whether a snapshot is being written."""
        return self._thread is not None and self._thread.is_alive()

    def add_topic(self, topic: TopicInformation, latched: int) -> None:
        """Add the metadata of a topic with ``latched`` transient-local publishers."""
        self._topics[topic.name] = topic
        if latched:
            self._cache.keep_last(topic.name, latched)

    def add(self, messages: list[SerializedMessage]) -> None:
        """Add messages to the cache, in order of reception."""
        self._cache.add(messages)

    def start(
        self,
        reason: str,
        now_ns: int,
        metadata_records: Mapping[str, Mapping[str, str]],
        attachments: list[tuple[Attachment, int]],
        finished: Callable[[bool, str], None],
    ) -> Path:
        """Start writing a snapshot in a thread and return its folder.

        Parameters
        ----------
        reason
            Reason of the snapshot, for the folder name and the metadata.
        now_ns
            System time, ns since 1970, as the stamps of reception.
        metadata_records, attachments
            Further content of the bag.
        finished
            Called by the writing thread with success and a text.

        Raises
        ------
        BagError
            Another snapshot is being written, or the cache is empty.
        """
        if self.busy:
            raise BagError('another snapshot is being written: try again after it')
        messages = self._cache.messages(now_ns)
        if not messages:
            raise BagError('no message was received within snapshot_time')
        time = datetime.fromtimestamp(now_ns / 1e9)
        folder = unused_folder(
            self._folder, snapshot_folder_name(f'{time:%Y_%m_%d-%H_%M_%S}', reason)
        )
        record = {SNAPSHOT_RECORD: {'reason': reason, 'time_ns': str(now_ns)}}
        topics = dict(self._topics)

        def write() -> None:
            try:
                count = write_snapshot(
                    folder,
                    messages,
                    topics=topics,
                    metadata_records={**metadata_records, **record},
                    attachments=attachments,
                    definitions=self._definitions,
                    pause=lambda: self._closing.wait(SLICE_PAUSE),
                )
            except Exception as error:  # a silent thread would look like a complete snapshot
                self.problem = f'no snapshot of "{reason}": {error}'
                finished(False, self.problem)
            else:
                self.problem = ''
                self.completed.append(folder)
                finished(True, f'snapshot of "{reason}": {count} messages in {folder}')

        self._thread = threading.Thread(target=write, name='snapshot', daemon=True)
        self._thread.start()
        return folder

    def close(self, timeout: float) -> None:
        """Complete the current snapshot without pauses, within ``timeout`` seconds."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(timeout)
