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
"""``ros2 run t3mpc_ros player``: publishes the recorded messages of bags at the recorded times."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
import gc
import sys
import time
from typing import Any

from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.player import MergedReader, PlaybackParameters, PlaybackTimeline, ReadAheadQueue
from t3mpc_ros.bag.qos import read_qos_overrides
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import topic_endpoints
from t3mpc_ros.nodes.base_node import ERROR, OK, WARN, BaseNode
from t3mpc_ros.nodes.player_publishers import CLOCK, PlayerThread, TopicPublishers
from t3mpc_ros.nodes.player_terminal import KeyboardHandler, ProgressLine
from t3mpc_ros.parameters.table import ParameterError, parameter

SWITCH_INTERVAL = 0.0005
"""Thread switch interval of Python, s; with its default of 5 ms a due message waits that long for
the thread that reads ahead."""
ACK_TIMEOUT = 1.0
"""Maximum wait at the end of the bag for the acknowledgements of subscribers, s."""
RATE_KEYS = {'up': 1.1, 'down': 1.0 / 1.1}
"""Factor of the rate by key."""
SEEK_BACK = 5.0
"""Time that a key seeks back, s."""

Action = Callable[[PlaybackTimeline, int], str | None]
"""Changes the playback at a time of the monotonic clock; returns a problem."""

NO_BAG = 'no bag is open: set storage.uris'


@dataclass(frozen=True)
class PlayerParameters(PlaybackParameters):
    """Parameters of the player node."""

    allow_commands: bool = parameter(
        False,
        'publish cmd_vel and other velocities under their own name: a robot may move',
        name='play.allow_commands',
    )
    qos_profile_overrides_path: str = parameter(
        '',
        'YAML file with QoS profiles by topic, in the format of ros2 bag play',
        name='play.qos_profile_overrides_path',
    )
    subscriber_timeout: float = parameter(
        0.5,
        'maximum wait for a subscriber to every topic before playing',
        's',
        (0.0, None),
        name='play.subscriber_timeout',
    )
    delay: float = parameter(
        0.0, 'minimum wait before playing', 's', (0.0, None), name='play.delay'
    )
    realtime_priority: int = parameter(
        0,
        'real-time priority (SCHED_FIFO) of the thread that publishes; 0 = none. Needs the '
        'permission rtprio in limits.conf',
        bounds=(0, 99),
        name='play.realtime_priority',
    )
    enable_keyboard_controls: bool = parameter(
        True,
        'keyboard control in a terminal: space pauses, right plays the next message, left seeks '
        'back 5 s, up and down (+ and -) change the rate',
        name='play.enable_keyboard_controls',
    )
    enable_progress_bar: bool = parameter(
        True, 'show the progress in a terminal', name='play.enable_progress_bar'
    )
    exit_at_end: bool = parameter(
        True, 'end the process at the end of the bag', name='play.exit_at_end'
    )

    @property
    def publishes_clock(self) -> bool:
        """Whether the player publishes the time of the bag itself."""
        return self.clock_publish_frequency > 0.0 or self.clock_publish_on_topic_publish


class PlayerNode(BaseNode[PlayerParameters]):
    """Opens bags, creates their publishers and controls a :class:`PlayerThread`."""

    parameter_class = PlayerParameters
    configuration_errors = (BagError,)

    @classmethod
    def make(cls, **options: Any) -> list[BaseNode[Any]]:
        """Return the node, in a process that is set up for exact times."""
        sys.setswitchinterval(SWITCH_INTERVAL)
        nodes = super().make(**options)
        # The present objects live until the end: the garbage collector need not visit them again.
        gc.freeze()
        return nodes

    def __init__(self, **options: Any) -> None:
        super().__init__('player', **options)
        self._thread: PlayerThread | None = None
        self._reader: MergedReader | None = None
        self._keyboard: KeyboardHandler | None = None
        self._progress: ProgressLine | None = None
        self._other_publishers: dict[str, str] = {}
        self._logged: set[str] = set()
        self._started = self._ended = False
        self._damaged = 0
        if self.parameters.uris:
            self._open()
        else:
            self.get_logger().warning(NO_BAG)
        actions: dict[str, Action] = {
            'pause': PlaybackTimeline.pause,
            'resume': PlaybackTimeline.resume,
            'toggle_paused': _toggle_paused,
            'seek': self._seek,
            'play_next': lambda timeline, now_ns: timeline.play_next(
                now_ns, self.parameters.play_next_count
            ),
            'set_rate': self._set_rate,
        }
        for name, action in actions.items():
            self.offer(Trigger, f'~/{name}', partial(self._serve, action))

    def _open(self) -> None:
        parameters = self.parameters
        path = parameters.qos_profile_overrides_path
        overrides = read_qos_overrides(path) if path else {}
        reader, unfinished = parameters.open_reader()
        try:
            self._span = begin_ns, end_ns = parameters.time_range_ns(reader)
        except ParameterError:
            reader.close()
            raise
        self._reader, self._first_ns = reader, reader.start_ns
        self._topic_publishers = TopicPublishers(self, reader, overrides)
        for topic, reason in self._topic_publishers.unusable.items():
            self.get_logger().error(f'{topic} is not played: {reason}')
        for topic, reason in self._topic_publishers.blocked.items():
            self.get_logger().warning(
                f'{topic} is not played: {reason}; set play.allow_commands to true, or remap it '
                'to another name (play.topic_remapping_options: ["old:=new"])'
            )
        if unfinished:
            self.get_logger().warning(
                f'incomplete files are not played: {", ".join(unfinished)}; t3mpc bag recover '
                'repairs them'
            )
        if not reader.topics:
            self.get_logger().warning('the bags have no topic to play')
        clock = None
        if parameters.publishes_clock:
            clock = self.create_publisher(Clock, CLOCK, topic_endpoints.LATEST)
        timeline = PlaybackTimeline(
            lambda at_ns: ReadAheadQueue(
                reader.schedule(at_ns, begin_ns, end_ns, parameters.loop),
                parameters.read_ahead_queue_size,
            ),
            begin_ns,
            end_ns,
            origin_ns=reader.start_ns,
            rate=parameters.rate,
            loop=parameters.loop,
            paused=parameters.start_paused,
            clock_rate=parameters.clock_publish_frequency,
        )
        self._thread = PlayerThread(
            timeline,
            self._topic_publishers.by_topic,
            clock,
            parameters.clock_publish_on_topic_publish,
            parameters.realtime_priority,
        )
        if parameters.enable_progress_bar:
            self._progress = ProgressLine(sys.stdout, begin_ns, end_ns)
        self._opened_ns = time.monotonic_ns()
        self._start_timer = self.create_steady_timer(0.02, self._start)
        self.create_steady_timer(0.2, self._monitor)
        self.create_steady_timer(1.0, self._check_other_publishers)
        self.get_logger().info(
            f'{len(reader.topics)} topics, {(end_ns - begin_ns) / NANOSECONDS:.3f} s'
        )

    def _start(self) -> None:
        """Start playing once all topics have subscribers, or after the maximum wait."""
        parameters, thread = self.parameters, self._thread
        if thread is None:
            return
        # Only while the process spins: a signal before would leave the terminal unrestored.
        if (
            parameters.enable_keyboard_controls
            and self._keyboard is None
            and KeyboardHandler.usable()
        ):
            self._keyboard = KeyboardHandler(self._on_key)
        waited = (time.monotonic_ns() - self._opened_ns) / NANOSECONDS
        waiting = (
            waited < parameters.subscriber_timeout and not self._topic_publishers.all_subscribed()
        )
        if waited < parameters.delay or waiting:
            return
        self._start_timer.cancel()
        self._block_robots(thread)
        self._check_other_publishers()
        thread.start()
        self._started = True

    # -- during playback --------------------------------------------------------------------------

    def on_parameters_changed(self, parameters: PlayerParameters) -> None:
        """Apply the rate."""
        self._control(self._set_rate)

    def _monitor(self) -> None:
        thread = self._thread
        if thread is None or self._ended:
            return
        self._block_robots(thread)
        self._warn_of_damage()
        status = thread.status()
        if self._progress is not None and self._started:
            self._progress.show(status)
        if thread.priority_problem and self._is_new('priority'):
            self.get_logger().warning(
                f'play.realtime_priority {self.parameters.realtime_priority} is not available: '
                f'{thread.priority_problem}; playing without it'
            )
        if thread.failure:
            self._ended = True
            self.get_logger().error(f'playback has ended early: {thread.failure}')
            self.exit_code = 1
        elif status.finished and self.parameters.exit_at_end:
            self._ended = True
            self._topic_publishers.wait_for_acked(ACK_TIMEOUT)
            if not thread.published:
                self._warn_of_damage()
                self.get_logger().error(f'nothing was played: {self._why_nothing()}')
                self.exit_code = 1
            self.exit_requested = True

    def _why_nothing(self) -> str:
        topics = self._topic_publishers
        if self._reader is not None and self._reader.empty:
            return 'the bags hold no message: record them anew'
        if self._damaged:
            return f'all {self._damaged} messages are in damaged chunks'
        if excluded := {**topics.unusable, **topics.blocked}:
            return '; '.join(f'{topic}: {reason}' for topic, reason in excluded.items())
        return 'the bags have no message in the topics and the time to play'

    def _warn_of_damage(self) -> None:
        """Warn when further messages of damaged chunks are not played."""
        count = self._reader.damaged_count if self._reader is not None else 0
        if count > self._damaged:
            self._damaged = count
            self.get_logger().warning(
                f'the bag is damaged: {count} messages so far are not played; t3mpc bag recover '
                'reports the loss'
            )

    def _block_robots(self, thread: PlayerThread) -> None:
        """Disable renamed velocity topics that a robot subscribes to."""
        for topic, robot in self._topic_publishers.subscribed_robots().items():
            if self._is_new(f'robot {topic}'):
                thread.disable(topic)
                self.get_logger().error(
                    f'{topic} is disabled: it would move {robot}; set play.allow_commands to true '
                    'to play it'
                )

    def _check_other_publishers(self) -> None:
        """Warn once about each topic that another node publishes, too."""
        self._other_publishers = self._topic_publishers.other_publishers()
        for topic, node in self._other_publishers.items():
            if self._is_new(f'publisher {topic}'):
                self.get_logger().warning(
                    f'{topic} is published by {node}, too: subscribers receive both; remap or '
                    'exclude it'
                )

    def _is_new(self, warning: str) -> bool:
        """Return whether a warning was not logged before."""
        is_new = warning not in self._logged
        self._logged.add(warning)
        return is_new

    # -- diagnostics and shutdown -----------------------------------------------------------------

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return the state, position and timing error of the playback."""
        thread = self._thread
        if thread is None:
            return WARN, NO_BAG, {}
        status, begin_ns, topics = thread.status(), self._span[0], self._topic_publishers
        values = {
            'position_s': (status.stamp_ns - begin_ns) / NANOSECONDS,
            'length_s': (self._span[1] - begin_ns) / NANOSECONDS,
            'rate': status.rate,
            'loops': status.loops,
            'messages': thread.published,
            'latency_max_ms': thread.latency_max_ns / 1e6,
            'damaged': self._damaged,
            'excluded': ', '.join([*topics.unusable, *topics.blocked]),
        }
        if thread.failure:
            return ERROR, thread.failure, values
        if not self._started:
            return OK, 'waiting for subscribers', values
        if self._damaged:
            return WARN, f'{self._damaged} messages of damaged chunks are not played', values
        if self._other_publishers:
            shared = ', '.join(self._other_publishers)
            return WARN, f'also published by other nodes: {shared}', values
        return OK, status.state, values

    def on_shutdown(self) -> None:
        """Restore the terminal, stop playing and log the timing error."""
        if self._keyboard is not None:
            self._keyboard.close()
            self._keyboard = None
        if self._progress is not None:
            self._progress.close()
        thread, self._thread = self._thread, None
        if thread is not None:
            self._warn_of_damage()
            thread.stop()
            late = f'timing error at most {thread.latency_max_ns / 1e6:.2f} ms'
            self.get_logger().info(f'{thread.published} messages, {late}')
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    # -- services and keys ------------------------------------------------------------------------

    def _serve(self, action: Action) -> tuple[str, str]:
        problem = self._control(action)
        if self._thread is None:
            return problem, ''
        status = self._thread.status()
        position = (status.stamp_ns - self._first_ns) / NANOSECONDS
        return problem, f'{status.state} at {position:.3f} s, rate {status.rate:g}'

    def _control(self, action: Action) -> str:
        return self._thread.control(action) if self._thread is not None else NO_BAG

    def _seek(self, timeline: PlaybackTimeline, now_ns: int) -> str:
        target_ns = self._first_ns + round(self.parameters.seek_time * NANOSECONDS)
        return timeline.seek(now_ns, target_ns)

    def _seek_back(self, timeline: PlaybackTimeline, now_ns: int) -> str:
        target_ns = timeline.bag_time_ns(now_ns) - round(SEEK_BACK * NANOSECONDS)
        return timeline.seek(now_ns, max(target_ns, self._span[0]))

    def _set_rate(self, timeline: PlaybackTimeline, now_ns: int) -> None:
        timeline.set_rate(now_ns, self.parameters.rate)

    def _on_key(self, key: str) -> None:
        """Execute the action of a key in the thread of the executor."""
        if self.executor is not None:
            self.executor.create_task(self._execute_key, key)

    def _execute_key(self, key: str) -> None:
        if key in RATE_KEYS:
            rate = round(self.parameters.rate * RATE_KEYS[key], 6)
            (result,) = self.set_parameters([Parameter('play.rate', value=rate)])
            problem = '' if result.successful else str(result.reason)
        else:
            actions: dict[str, Action] = {
                'space': _toggle_paused,
                'right': PlaybackTimeline.play_next,
                'left': self._seek_back,
            }
            problem = self._control(actions[key])
        if problem:
            self.get_logger().warning(problem)


def _toggle_paused(timeline: PlaybackTimeline, now_ns: int) -> None:
    (timeline.resume if timeline.paused else timeline.pause)(now_ns)
