# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Writer thread of the recorder: compresses and writes the message queue."""

from collections.abc import Callable
from concurrent.futures import Future
import contextlib
import threading
from typing import Any, TypeVar

from t3mpc_ros.bag.recording.message_queue import MessageQueue
from t3mpc_ros.bag.recording.split_writer import SplitWriter
from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.bag.writer import SerializedMessage

T = TypeVar('T')

POLL_PERIOD = 0.04
"""Seconds between two looks into the backlog; a part of what a killed recorder loses."""
SHUTDOWN_TIMEOUT = 60.0
"""Seconds that the disk is given at the end, before what waits is given up."""


class WriterThread:
    """Writes a backlog into a series of files, in a thread of its own.

    Parameters
    ----------
    series
        The recording; from now on only this thread touches it.
    backlog
        What waits.
    clock
        Steady nanoseconds.
    """

    def __init__(
        self, series: SplitWriter, backlog: MessageQueue[SplitWriter], clock: Callable[[], int]
    ) -> None:
        self._series = series
        self._backlog = backlog
        self._clock = clock
        self.failure = ''
        """Why nothing is written any more; empty while all is well."""
        self.file_name = series.path.name
        self._lock = threading.Lock()
        self._unanswered: list[Future[Any]] = []
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name='writer', daemon=True)
        self._thread.start()

    def ask(self, order: Callable[[SplitWriter], T]) -> 'Future[T]':
        """Return the answer, once there is one, of what is done after all that waits.

        It is a :class:`BagError` when nothing is written any more.
        """
        answer: Future[T] = Future()

        def do(series: SplitWriter) -> None:
            answer.set_result(order(series))

        with self._lock:
            if self.failure:
                answer.set_exception(BagError(self.failure))
            else:
                self._unanswered = [item for item in self._unanswered if not item.done()]
                self._unanswered.append(answer)
                self._backlog.order(do)
        return answer

    def close(self) -> str:
        """Return what went wrong, after all that waits has been written and the file closed."""
        self._ending.set()
        self._backlog.order(lambda series: None)  # so that it wakes up
        self._thread.join(SHUTDOWN_TIMEOUT)
        if self._thread.is_alive():
            return f'the disk did not take the last messages within {SHUTDOWN_TIMEOUT:g} s'
        return self.failure

    def _run(self) -> None:
        try:
            while True:
                # Once more after the end was asked for: what was put before it is then there.
                ending = self._ending.is_set()
                for item in self._backlog.take(0.0 if ending else POLL_PERIOD):
                    self._do(item)
                self._series.tick(self._clock())
                self.file_name = self._series.path.name
                if ending:
                    break
            self._series.close()
        except BagError as error:
            self._fail(str(error))
        except Exception as error:  # a dead thread must not look like a recording that goes on
            self._fail(f'writing has failed: {type(error).__name__}: {error}')

    def _do(self, item: Any) -> None:
        if isinstance(item, SerializedMessage):
            self._series.write(item, self._clock())
        else:
            item(self._series)

    def _fail(self, why: str) -> None:
        with contextlib.suppress(BagError):  # the first error is the one to report
            self._series.close()
        with self._lock:
            self.failure = why
            for answer in self._unanswered:  # or somebody would wait for ever
                if not answer.done():
                    answer.set_exception(BagError(why))
