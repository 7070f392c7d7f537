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
"""Playback thread: publishes each message when it is due.

A cycle of the rclpy executor takes half a millisecond and more; a thread of its own wakes up
without that delay.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import os
import threading
import time

from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from t3mpc_ros.bag.player import DueMessage, PlaybackTimeline
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import ros_messages


@dataclass(frozen=True)
class PlaybackStatus:
    """Position and state of a playback."""

    stamp_ns: int
    remaining_ns: int
    loops: int
    rate: float
    paused: bool
    finished: bool

    @property
    def state(self) -> str:
        """``playing``, ``paused`` or ``finished``."""
        return 'finished' if self.finished else 'paused' if self.paused else 'playing'


class PlayerThread:
    """Publishes the due messages of a playback timeline.

    Without ``clock`` the time of the bag is not published; with ``clock_with_messages`` it is
    before each message, too. ``priority`` is that of SCHED_FIFO, 0 = none.
    """

    def __init__(
        self,
        timeline: PlaybackTimeline,
        publishers: Mapping[str, Publisher],
        clock: Publisher | None,
        clock_with_messages: bool,
        priority: int = 0,
    ) -> None:
        self._timeline = timeline
        self._publishers = dict(publishers)
        self._clock = clock
        self._clock_with_messages = clock_with_messages
        self._priority = priority
        self.priority_problem = ''
        """Why the operating system does not grant the priority."""
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name='player', daemon=True)
        self.latency_max_ns = 0
        """Largest time from the due time of a message to its publication."""
        self.published = 0
        self.failure = ''
        """Why playback has ended early; empty if it has not."""

    def start(self) -> None:
        """Start publishing."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the bag; idempotent."""
        self._closing = True
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()
        self._timeline.close()

    def control(self, action: Callable[[PlaybackTimeline, int], str | None]) -> str:
        """Apply an action to the timeline at the present time; return its problem, or nothing."""
        with self._lock:
            problem = action(self._timeline, time.monotonic_ns())
        self._wake.set()
        return problem or ''

    def disable(self, topic: str) -> None:
        """Stop publishing a topic."""
        with self._lock:
            self._publishers.pop(topic, None)

    def status(self) -> PlaybackStatus:
        """Return position and state of the playback."""
        with self._lock:
            now_ns, timeline = time.monotonic_ns(), self._timeline
            return PlaybackStatus(
                timeline.bag_time_ns(now_ns),
                timeline.remaining_ns(now_ns),
                timeline.loops(now_ns),
                timeline.rate,
                timeline.paused,
                timeline.finished,
            )

    def _set_priority(self) -> None:
        try:
            # Process number 0 is the calling thread.
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(self._priority))
        except OSError as error:
            self.priority_problem = str(error.strerror)

    def _run(self) -> None:
        if self._priority:
            self._set_priority()
        try:
            while not self._closing:
                self._wake.clear()
                with self._lock:
                    due, wake_ns = self._timeline.due_messages(time.monotonic_ns())
                for item in due:
                    self._publish(item)
                if wake_ns is None:
                    self._wake.wait()
                elif (wait_ns := wake_ns - time.monotonic_ns()) > 0:
                    self._wake.wait(wait_ns / NANOSECONDS)
        except Exception as error:  # a silent thread would look like a bag without messages
            self.failure = str(error) or type(error).__name__

    def _publish(self, due: DueMessage) -> None:
        message = due.message
        if self._clock is not None and (message is None or self._clock_with_messages):
            self._clock.publish(Clock(clock=ros_messages.time_from_ns(due.stamp_ns)))
        if message is None:
            return
        publisher = self._publishers.get(message.topic)
        if publisher is not None:
            self.latency_max_ns = max(self.latency_max_ns, time.monotonic_ns() - due.due_ns)
            publisher.publish(message.data)
            self.published += 1
