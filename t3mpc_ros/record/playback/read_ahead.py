# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A stream that is read by a thread of its own, a bounded number of items ahead."""

from collections import deque
from collections.abc import Iterator
import queue
import threading
from typing import Generic, Self, TypeVar

T = TypeVar('T')

_BATCH = 50
"""Items handed over at once: waking the other thread costs more than reading one."""


class ReadAhead(Generic[T]):
    """The items of ``source``, in order, read before they are asked for.

    What the source raises is raised where its next item would have come. :meth:`close` ends the
    thread and the source.
    """

    def __init__(self, source: Iterator[T], items: int) -> None:
        self._source = source
        self._batches: queue.Queue[list[T] | BaseException | None] = queue.Queue(
            max(1, items // _BATCH)
        )
        self._ready: deque[T] = deque()
        self._over = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._read, name='read ahead', daemon=True)
        self._thread.start()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> T:
        while not self._ready:
            if self._over:
                raise StopIteration
            got = self._batches.get()
            if isinstance(got, list):
                self._ready.extend(got)
                continue
            self._over = True
            if got is not None:
                raise got
        return self._ready.popleft()

    def close(self) -> None:
        """Stop reading; nothing more comes."""
        self._closing.set()
        self._over = True
        self._ready.clear()
        while self._thread.is_alive():
            try:
                self._batches.get(timeout=0.01)  # room for what the thread waits to hand over
            except queue.Empty:
                continue
        self._thread.join()

    def _read(self) -> None:
        end: BaseException | None = None
        batch: list[T] = []
        size = 1  # the first item by itself: somebody is waiting for it
        try:
            for item in self._source:
                batch.append(item)
                if len(batch) == size:
                    self._batches.put(batch)
                    batch, size = [], _BATCH
                if self._closing.is_set():
                    break
        except BaseException as error:  # handed over to whoever reads
            end = error
        finally:
            close = getattr(self._source, 'close', None)
            if close is not None:
                close()
            self._batches.put(batch)
            self._batches.put(end)
