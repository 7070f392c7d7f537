# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bounded queue of messages between the subscriptions and the writer thread.

The queue bridges pauses of the disk. A full queue drops new messages and keeps the oldest ones.
"""

from collections.abc import Callable, Iterable
import threading
from typing import Generic, TypeVar

from t3mpc_ros.bag.mcap_file import SerializedMessage

T = TypeVar('T')
WriterTask = Callable[[T], None]
"""Operation on the bag, executed between two messages."""


class MessageQueue(Generic[T]):
    """Messages and writer tasks in first-in, first-out order, between two threads.

    Parameters
    ----------
    max_bytes
        Maximum memory of the messages, including the batch taken last. Tasks are not limited.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._condition = threading.Condition()
        self._waiting: list[SerializedMessage | WriterTask[T]] = []
        self._bytes = 0
        self._taken_bytes = 0
        self._urgent = False
        self._dropped: dict[str, int] = {}

    @property
    def bytes(self) -> int:
        """Memory of the messages."""
        return self._bytes

    @property
    def dropped(self) -> dict[str, int]:
        """Number of dropped messages by topic."""
        with self._condition:
            return dict(self._dropped)

    def put(self, messages: Iterable[SerializedMessage]) -> dict[str, int]:
        """Append messages; return the number of dropped messages by topic.

        After the first message that does not fit, the rest of ``messages`` is dropped as well:
        dropping only large messages would hide the gap.
        """
        dropped: dict[str, int] = {}
        with self._condition:
            for message in messages:
                if dropped or self._bytes + message.memory_size > self._max_bytes:
                    dropped[message.topic] = dropped.get(message.topic, 0) + 1
                else:
                    self._bytes += message.memory_size
                    self._waiting.append(message)
            for topic, count in dropped.items():
                self._dropped[topic] = self._dropped.get(topic, 0) + count
            if self._bytes > self._max_bytes // 2:
                self._wake()
        return dropped

    def put_task(self, task: WriterTask[T]) -> None:
        """Append a task and wake the consumer."""
        with self._condition:
            self._waiting.append(task)
            self._wake()

    def take(self, timeout: float = 0.0) -> list[SerializedMessage | WriterTask[T]]:
        """Return all items, and release the memory of the batch taken before.

        Waits up to ``timeout`` seconds; a task or a half-full queue ends the wait. A message does
        not: waking the consumer for each one would cost more than writing it.
        """
        with self._condition:
            self._bytes -= self._taken_bytes
            if not self._urgent and timeout > 0.0:
                self._condition.wait(timeout)
            self._urgent = False
            taken, self._waiting = self._waiting, []
            self._taken_bytes = sum(
                item.memory_size for item in taken if isinstance(item, SerializedMessage)
            )
        return taken

    def _wake(self) -> None:
        self._urgent = True
        self._condition.notify()
