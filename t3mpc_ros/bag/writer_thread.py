# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""The thread that writes a recording: a bounded queue of messages and tasks in front of a bag."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
import contextlib
from functools import partial
import queue
import threading
from typing import TypeVar

from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.mcap_file import SerializedMessage
from t3mpc_ros.bag.writer import BagWriter

T = TypeVar('T')

POLL_PERIOD = 0.04
"""Maximum time between two calls of :meth:`BagWriter.tick`, s."""
SHUTDOWN_TIMEOUT = 60.0
"""Shutdown timeout for the queue, s."""


class WriterThread:
    """Writes messages and runs tasks in first-in, first-out order.

    Only this thread uses ``writer``; None: it writes snapshots only. The messages, with those
    being written, take at most ``max_bytes``; tasks are not limited. ``clock`` is steady, ns.
    """

    def __init__(self, writer: BagWriter | None, max_bytes: int, clock: Callable[[], int]) -> None:
        self._writer = writer
        self._max_bytes = max_bytes
        self._clock = clock
        self._tasks: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self.bytes = 0
        """Memory of the messages."""
        self.dropped: dict[str, int] = {}
        self.failure = ''
        """Why writing has stopped; empty if it has not."""
        self.file_name = writer.path.name if writer else 'none'
        self._closing = False
        self._thread = threading.Thread(target=self._run, name='writer', daemon=True)
        self._thread.start()

    def put(self, messages: Sequence[SerializedMessage]) -> list[str]:
        """Queue messages for the bag; return the topics of dropped ones.

        After the first message that does not fit, the rest of ``messages`` is dropped as well:
        dropping only large messages would hide the gap.
        """
        size = count = 0
        for message in messages:
            if self.bytes + size + message.memory_size > self._max_bytes:
                break
            size, count = size + message.memory_size, count + 1
        for message in messages[count:]:
            self.dropped[message.topic] = self.dropped.get(message.topic, 0) + 1

        def write(writer: BagWriter) -> None:
            try:
                for message in messages[:count]:
                    writer.write(*message)
            finally:
                self._add_bytes(-size)

        self._add_bytes(size)
        self.submit(write)
        return list(dict.fromkeys(message.topic for message in messages[count:]))

    def submit(self, task: Callable[[BagWriter], T]) -> 'Future[T]':
        """Return the future result of a task that runs after all queued messages are written.

        The future raises :class:`BagError` if writing has stopped, or if there is no bag.
        """
        future: Future[T] = Future()

        def run() -> None:
            try:
                if self._writer is None or self.failure:
                    raise BagError(self.failure or 'there is no bag')
                future.set_result(task(self._writer))
            except Exception as error:
                future.set_exception(error if isinstance(error, BagError) else BagError(error))
                raise

        self._tasks.put(run)
        return future

    def run_in_slices(self, slices: Iterator[None]) -> None:
        """Run an iterator to its end; messages and tasks that arrive meanwhile run in between."""

        def step() -> None:
            for _ in slices:
                self._tasks.put(step)
                return

        self._tasks.put(step)

    def close(self) -> str:
        """Run all tasks, close the file and return the failure, or an empty text."""
        self._closing = True
        self._tasks.put(lambda: None)  # wakes the thread
        self._thread.join(SHUTDOWN_TIMEOUT)
        if self._thread.is_alive():
            return f'the disk did not accept the last messages within {SHUTDOWN_TIMEOUT:g} s'
        return self.failure

    def _add_bytes(self, size: int) -> None:
        with self._lock:
            self.bytes += size

    def _run(self) -> None:
        while not (self._closing and self._tasks.empty()):
            with contextlib.suppress(queue.Empty):
                self._attempt(self._tasks.get(timeout=POLL_PERIOD))
            if self._writer and not self.failure:
                self._attempt(partial(self._tick, self._writer))
        if self._writer:
            self._attempt(self._writer.close)

    def _tick(self, writer: BagWriter) -> None:
        writer.tick(self._clock())
        self.file_name = writer.path.name

    def _attempt(self, action: Callable[[], object]) -> None:
        """Run an action; after its error nothing more is written."""
        try:
            action()
        except Exception as error:  # a silent thread would look like a running recording
            if not self.failure:  # the first error is reported
                text = str(error)
                if not isinstance(error, BagError):
                    text = f'writing failed: {type(error).__name__}: {error}'
                self.failure = text
                if self._writer:
                    self._attempt(self._writer.close)
