# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Writer thread of the recorder: compresses and writes the message queue."""

from collections.abc import Callable
from concurrent.futures import Future
import contextlib
import threading
from typing import Any, TypeVar

from t3mpc_ros.bag.mcap_file import SerializedMessage
from t3mpc_ros.bag.recording.message_queue import MessageQueue
from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.bag.writer import BagWriter

T = TypeVar('T')

POLL_PERIOD = 0.04
"""Maximum time between two reads of the queue, s; a killed recorder loses this, too."""
SHUTDOWN_TIMEOUT = 60.0
"""Shutdown timeout for the write queue, s."""


class WriterThread:
    """Writes a message queue into a bag in a thread of its own.

    Parameters
    ----------
    writer
        Writer of the bag; only this thread uses it.
    queue
        Messages and tasks to process.
    clock
        Returns steady time, ns.
    """

    def __init__(
        self, writer: BagWriter, queue: MessageQueue[BagWriter], clock: Callable[[], int]
    ) -> None:
        self._writer = writer
        self._queue = queue
        self._clock = clock
        self.failure = ''
        """Why writing has stopped; empty if it has not."""
        self.file_name = writer.path.name
        self._lock = threading.Lock()
        self._pending: list[Future[Any]] = []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name='writer', daemon=True)
        self._thread.start()

    def submit(self, task: Callable[[BagWriter], T]) -> 'Future[T]':
        """Return the future result of a task that runs after all queued messages are written.

        The future raises :class:`BagError` if writing has stopped.
        """
        future: Future[T] = Future()

        def run(writer: BagWriter) -> None:
            future.set_result(task(writer))

        with self._lock:
            if self.failure:
                future.set_exception(BagError(self.failure))
            else:
                self._pending = [item for item in self._pending if not item.done()]
                self._pending.append(future)
                self._queue.put_task(run)
        return future

    def close(self) -> str:
        """Write the queue, close the file and return the failure, or an empty text."""
        self._closing.set()
        self._queue.put_task(lambda writer: None)  # wakes the thread
        self._thread.join(SHUTDOWN_TIMEOUT)
        if self._thread.is_alive():
            return f'the disk did not accept the last messages within {SHUTDOWN_TIMEOUT:g} s'
        return self.failure

    def _run(self) -> None:
        try:
            while True:
                # One more pass after the request to close: it finds all earlier items.
                closing = self._closing.is_set()
                for item in self._queue.take(0.0 if closing else POLL_PERIOD):
                    self._process(item)
                self._writer.tick(self._clock())
                self.file_name = self._writer.path.name
                if closing:
                    break
            self._writer.close()
        except BagError as error:
            self._fail(str(error))
        except Exception as error:  # a silent thread would look like a running recording
            self._fail(f'writing failed: {type(error).__name__}: {error}')

    def _process(self, item: Any) -> None:
        if isinstance(item, SerializedMessage):
            self._writer.write(*item)
        else:
            item(self._writer)

    def _fail(self, reason: str) -> None:
        with contextlib.suppress(BagError):  # the first error is reported
            self._writer.close()
        with self._lock:
            self.failure = reason
            for future in self._pending:  # no caller waits for ever
                if not future.done():
                    future.set_exception(BagError(reason))
