# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Playback thread: publishes each message when it is due."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import os
import threading
import time

from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from t3mpc_ros.bag.player import DueMessage, LatencyHistogram, PlaybackTimeline
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.common import conversions


@dataclass(frozen=True)
class PlaybackStatus:
    """How far a playback has come."""

    stamp_ns: int
    remaining_ns: int
    loops: int
    rate: float
    paused: bool
    finished: bool


class PlayerThread:
    """Publishes what a playback says, when it says it, from a thread of its own.

    Parameters
    ----------
    clock
        Where the time of the bag is told; None = nowhere.
    clock_with_messages
        Tell it before each message, too.
    priority
        Of the thread among those of the system that go before all others; 0 = one of the others.
    """

    def __init__(
        self,
        playback: PlaybackTimeline,
        publishers: Mapping[str, Publisher],
        clock: Publisher | None,
        clock_with_messages: bool,
        priority: int = 0,
    ) -> None:
        self._playback = playback
        self._publishers = dict(publishers)
        self._clock = clock
        self._clock_with_messages = clock_with_messages
        self._priority = priority
        self.priority_problem = ''
        """Why the system does not let the thread go before others."""
        self._lock = threading.Lock()
        self._nudge = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name='sender', daemon=True)
        self.lateness = LatencyHistogram()
        self.published = 0
        self.failure = ''
        """Why it has ended before the end; empty while all is well."""

    def start(self) -> None:
        """Begin to publish."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread and let go of the bag; again, do nothing."""
        self._closing = True
        self._nudge.set()
        if self._thread.is_alive():
            self._thread.join()
        self._playback.close()

    def ask(self, what: Callable[[PlaybackTimeline, int], str | None]) -> str:
        """Ask the playback for something at this time; return why it will not, or nothing."""
        with self._lock:
            problem = what(self._playback, time.monotonic_ns())
        self._nudge.set()
        return problem or ''

    def mute(self, topic: str) -> None:
        """Publish nothing more on a topic."""
        with self._lock:
            self._publishers.pop(topic, None)

    def where(self) -> PlaybackStatus:
        """Return how far it has come."""
        with self._lock:
            now_ns, playback = time.monotonic_ns(), self._playback
            return PlaybackStatus(
                playback.stamp_ns(now_ns),
                playback.remaining_ns(now_ns),
                playback.loops(now_ns),
                playback.rate,
                playback.paused,
                playback.finished,
            )

    def _hurry(self) -> None:
        """Ask the system to let this thread go before all others that have no such priority."""
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(self._priority))  # 0: this one
        except OSError as error:
            self.priority_problem = str(error.strerror)

    def _run(self) -> None:
        if self._priority:
            self._hurry()
        try:
            while not self._closing:
                self._nudge.clear()
                with self._lock:
                    emissions, wake_ns = self._playback.due(time.monotonic_ns())
                for emission in emissions:
                    self._publish(emission)
                if wake_ns is None:
                    self._nudge.wait()
                elif (wait_ns := wake_ns - time.monotonic_ns()) > 0:
                    self._nudge.wait(wait_ns / NANOSECONDS)
        except Exception as error:  # a dead thread must not look like a bag without messages
            self.failure = str(error) or type(error).__name__

    def _publish(self, emission: DueMessage) -> None:
        message = emission.message
        if self._clock is not None and (message is None or self._clock_with_messages):
            self._clock.publish(Clock(clock=conversions.time_from_ns(emission.stamp_ns)))
        if message is None:
            return
        publisher = self._publishers.get(message.topic)
        if publisher is not None:
            self.lateness.note(time.monotonic_ns() - emission.due_ns)
            publisher.publish(message.data)
            self.published += 1
