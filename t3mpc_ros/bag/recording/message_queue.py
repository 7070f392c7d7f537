# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Bounded queue of messages between the subscriptions and the writer thread."""

from collections.abc import Callable, Iterable
import threading
from typing import Generic, TypeVar

from t3mpc_ros.bag.writer import SerializedMessage

T = TypeVar('T')
WriterTask = Callable[[T], None]
"""Something to be done with the bag between two messages."""


class MessageQueue(Generic[T]):
    """Messages and orders from one thread to another, in the order in which they were given.

    Parameters
    ----------
    most_bytes
        What messages may take in memory, those in the hands of the taker included. Orders are
        always taken in.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._condition = threading.Condition()
        self._waiting: list[SerializedMessage | WriterTask[T]] = []
        self._bytes = 0
        self._in_hand = 0
        self._urgent = False
        self._dropped: dict[str, int] = {}

    @property
    def bytes(self) -> int:
        """Memory that the messages take."""
        return self._bytes

    @property
    def dropped(self) -> dict[str, int]:
        """How many messages of each topic found no room so far."""
        with self._condition:
            return dict(self._dropped)

    def put(self, messages: Iterable[SerializedMessage]) -> dict[str, int]:
        """Return how many of ``messages`` found no room, by topic; empty when all did.

        From the first one that does not fit on, the rest is dropped as well: a bag in which big
        messages are missing but small ones are there would look as if nothing had happened.
        """
        lost: dict[str, int] = {}
        with self._condition:
            for message in messages:
                if lost or self._bytes + message.cost > self._max_bytes:
                    lost[message.topic] = lost.get(message.topic, 0) + 1
                else:
                    self._bytes += message.cost
                    self._waiting.append(message)
            for topic, count in lost.items():
                self._dropped[topic] = self._dropped.get(topic, 0) + count
            if self._bytes > self._max_bytes // 2:
                self._wake()
        return lost

    def order(self, order: WriterTask[T]) -> None:
        """Let the taker do ``order`` after what was put before, and soon."""
        with self._condition:
            self._waiting.append(order)
            self._wake()

    def take(self, timeout: float = 0.0) -> list[SerializedMessage | WriterTask[T]]:
        """Return all that waits; what was taken the time before is done, and its room free.

        Waits up to ``patience`` seconds, less when there is an order or much waits: to be woken
        for each message would cost more than to write it.
        """
        with self._condition:
            self._bytes -= self._in_hand
            if not self._urgent and timeout > 0.0:
                self._condition.wait(timeout)
            self._urgent = False
            taken, self._waiting = self._waiting, []
            self._in_hand = sum(item.cost for item in taken if isinstance(item, SerializedMessage))
        return taken

    def _wake(self) -> None:
        self._urgent = True
        self._condition.notify()
