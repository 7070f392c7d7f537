# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros player``: publishes the recorded messages of bags at the recorded times."""

from collections.abc import Callable, Mapping
import gc
import sys
import time
from typing import Any

from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from t3mpc_ros.bag.merged_reader import MergedReader
from t3mpc_ros.bag.player import PlaybackTimeline, ReadAheadQueue
from t3mpc_ros.bag.qos import read_qos_overrides
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.common import qos
from t3mpc_ros.nodes.common.base_node import ERROR, OK, WARN, BaseNode
from t3mpc_ros.nodes.node_parameters import ReplayerParameters
from t3mpc_ros.nodes.player.player_thread import PlaybackStatus, PlayerThread
from t3mpc_ros.nodes.player.publishers import CLOCK, PublishingRules, TopicPublishers
from t3mpc_ros.nodes.player.terminal import KeyboardHandler, ProgressLine

SWITCH_INTERVAL = 0.0005
"""s after which a thread that computes lets another one go on; Python's default is 5 ms, and a
message that is due would wait so long for the one that reads ahead."""
ACK_TIMEOUT = 1.0
"""s that listeners are given, at the end of the bag, to get what they have not got yet."""
RATE_FACTOR, SEEK_BACK = 1.1, 5.0
"""By how much a key changes the rate; how many seconds of the bag a key goes back."""

NO_BAG = 'no bag is open: set bags'


class PlayerNode(BaseNode[ReplayerParameters]):
    """Opens bags, makes their publishers, and lets a :class:`Sender` play them."""

    def __init__(self, **given: Any) -> None:
        super().__init__('replayer', ReplayerParameters, **given)
        self._sender: PlayerThread | None = None
        self._tape: MergedReader | None = None
        self._keyboard: KeyboardHandler | None = None
        self._progress: ProgressLine | None = None
        self._rivals: dict[str, str] = {}
        self._warned: set[str] = set()
        self._started = self._ended = False
        if self.parameters.bags:
            self._open()
        else:
            self.get_logger().warning(NO_BAG)
        deeds: dict[str, Callable[[], str]] = {
            'pause': self._pause,
            'resume': self._resume,
            'toggle_paused': self._toggle,
            'seek': self._seek,
            'step': self._step,
            'set_rate': self._set_rate,
        }
        for name, deed in deeds.items():
            self.create_service(Trigger, f'~/{name}', self._answering(deed))

    def _open(self) -> None:
        parameters = self.parameters
        path = parameters.quality_overrides
        overrides = read_qos_overrides(path) if path else {}
        self._tape, unfinished = parameters.open_reader()
        tape = self._tape
        own_clock = parameters.clock_rate > 0.0 or parameters.clock_with_messages
        self._span = begin_ns, end_ns = parameters.span_ns(tape)
        self._offered = TopicPublishers(
            self, tape, PublishingRules(parameters.allow_commands, own_clock, overrides)
        )
        for topic, why in self._offered.left_out.items():
            self.get_logger().error(f'{topic} is not played: {why}')
        for topic, why in self._offered.refused.items():
            self.get_logger().warning(
                f'{topic} is not played: {why}; set allow_commands to true, or remap it to '
                'another name (remap: ["old:=new"])'
            )
        if unfinished:
            self.get_logger().warning(
                f'not played, because they broke off: {", ".join(unfinished)}; bag recover mends'
            )
        if not tape.tracks:
            self.get_logger().warning('there is no topic to play')
        clock = self.create_publisher(Clock, CLOCK, qos.LATEST) if own_clock else None
        playback = PlaybackTimeline(
            lambda at_ns: ReadAheadQueue(
                tape.plan(at_ns, begin_ns, end_ns, parameters.loop), parameters.read_ahead
            ),
            begin_ns,
            end_ns,
            origin_ns=tape.start_ns,
            rate=parameters.rate,
            loop=parameters.loop,
            paused=parameters.start_paused,
            clock_rate=parameters.clock_rate,
        )
        self._sender = PlayerThread(
            playback,
            self._offered.by_topic,
            clock,
            parameters.clock_with_messages,
            parameters.realtime_priority,
        )
        if parameters.progress:
            self._progress = ProgressLine(sys.stdout, begin_ns, end_ns)
        self._opened_ns = time.monotonic_ns()
        self._waiting = self.create_timer(0.02, self._start, clock=self._steady)
        self.every(0.2, self._watch)
        self.every(1.0, self._look_around)
        self.get_logger().info(
            f'{len(tape.tracks)} topics, {(end_ns - begin_ns) / NANOSECONDS:.3f} s'
        )

    def _start(self) -> None:
        """Begin once somebody listens to everything, or has had the time to."""
        parameters, sender = self.parameters, self._sender
        if sender is None:
            return
        # Not before the process spins: a signal would end it with the terminal as it is.
        if parameters.keyboard and self._keyboard is None and KeyboardHandler.usable():
            self._keyboard = KeyboardHandler(self._on_key)
        waited = (time.monotonic_ns() - self._opened_ns) / NANOSECONDS
        patient = waited < parameters.wait_for_subscribers and not self._offered.heard()
        if waited < parameters.delay or patient:
            return
        self._waiting.cancel()
        self._guard(sender)
        self._look_around()
        sender.start()
        self._started = True

    # -- while it plays ---------------------------------------------------------------------------

    def configure(self, parameters: ReplayerParameters) -> None:
        """Play at another rate."""
        if self._sender is not None:
            self._sender.ask(lambda playback, now_ns: playback.set_rate(now_ns, parameters.rate))

    def _watch(self) -> None:
        sender = self._sender
        if sender is None or self._ended:
            return
        self._guard(sender)
        where = sender.where()
        if self._progress is not None and self._started:
            self._progress.show(where)
        if sender.priority_problem and self._new('priority'):
            self.get_logger().warning(
                f'realtime_priority {self.parameters.realtime_priority} cannot be had: '
                f'{sender.priority_problem}; it plays without'
            )
        if sender.failure:
            self._ended = True
            self.get_logger().error(f'playing has ended early: {sender.failure}')
            self.exit_code = 1
        elif where.finished and self.parameters.exit_at_end:
            self._ended = True
            self._offered.flush(ACK_TIMEOUT)
            self.done = True

    def _guard(self, sender: PlayerThread) -> None:
        """Let no velocity that was renamed reach a robot by a detour."""
        for topic, robot in self._offered.driven().items():
            if self._new(f'driven {topic}'):
                sender.mute(topic)
                self.get_logger().error(
                    f'{topic} is played no longer: it would drive {robot}; '
                    'set allow_commands to true if it should'
                )

    def _look_around(self) -> None:
        """Find out who else publishes the same, and say so once."""
        self._rivals = self._offered.rivals()
        for topic, node in self._rivals.items():
            if self._new(f'rival {topic}'):
                self.get_logger().warning(
                    f'{topic} is published by {node}, too: who listens gets both; remap or '
                    'exclude it'
                )

    def _new(self, warning: str) -> bool:
        is_new = warning not in self._warned
        self._warned.add(warning)
        return is_new

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether it plays, where it is, and how punctual it has been."""
        sender = self._sender
        if sender is None:
            return WARN, NO_BAG, {}
        where, begin_ns = sender.where(), self._span[0]
        values = {
            'position_s': (where.stamp_ns - begin_ns) / NANOSECONDS,
            'length_s': (self._span[1] - begin_ns) / NANOSECONDS,
            'rate': where.rate,
            'laps': where.loops,
            'messages': sender.published,
            'lateness_p50_ms': sender.lateness.percentile_ns(50) / 1e6,
            'lateness_p99_ms': sender.lateness.percentile_ns(99) / 1e6,
            'lateness_max_ms': sender.lateness.max_ns / 1e6,
            'left_out': ', '.join([*self._offered.left_out, *self._offered.refused]),
        }
        if sender.failure:
            return ERROR, sender.failure, values
        if not self._started:
            return OK, 'waiting for subscribers', values
        if self._rivals:
            return WARN, f'also published by others: {", ".join(self._rivals)}', values
        return OK, _state(where), values

    def finish(self) -> None:
        """Say how punctual it was, and give the terminal back."""
        if self._keyboard is not None:
            self._keyboard.close()
            self._keyboard = None
        if self._progress is not None:
            self._progress.close()
        sender, self._sender = self._sender, None
        if sender is not None:
            sender.stop()
            late = sender.lateness
            self.get_logger().info(
                f'{sender.published} messages, timing error 50/99 %: '
                f'{late.percentile_ns(50) / 1e6:.2f}/{late.percentile_ns(99) / 1e6:.2f} ms, '
                f'largest {late.max_ns / 1e6:.2f} ms'
            )
        if self._tape is not None:
            self._tape.close()
            self._tape = None

    # -- what a user asks for ---------------------------------------------------------------------

    def _answering(
        self, deed: Callable[[], str]
    ) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
        def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            problem = deed() if self._sender is not None else NO_BAG
            response.success = not problem
            response.message = problem or self._said()
            return response

        return answer

    def _said(self) -> str:
        if self._sender is None:
            return NO_BAG
        where = self._sender.where()
        place = (where.stamp_ns - self._first_ns) / NANOSECONDS
        return f'{_state(where)} at {place:.3f} s, rate {where.rate:g}'

    @property
    def _first_ns(self) -> int:
        """When the first message of the bags came: what users count from."""
        return self._tape.start_ns if self._tape is not None else 0

    def _ask(self, what: Callable[[PlaybackTimeline, int], str | None]) -> str:
        return self._sender.ask(what) if self._sender is not None else NO_BAG

    def _pause(self) -> str:
        return self._ask(PlaybackTimeline.pause)

    def _resume(self) -> str:
        return self._ask(PlaybackTimeline.resume)

    def _toggle(self) -> str:
        return self._ask(
            lambda playback, now_ns: (
                playback.resume(now_ns) if playback.paused else playback.pause(now_ns)
            )
        )

    def _seek(self) -> str:
        target_ns = self._first_ns + round(self.parameters.seek_time * NANOSECONDS)
        return self._ask(lambda playback, now_ns: playback.seek(now_ns, target_ns))

    def _back(self) -> str:
        def back(playback: PlaybackTimeline, now_ns: int) -> str:
            target_ns = playback.stamp_ns(now_ns) - round(SEEK_BACK * NANOSECONDS)
            return playback.seek(now_ns, max(target_ns, self._span[0]))

        return self._ask(back)

    def _step(self) -> str:
        count = self.parameters.step_count
        return self._ask(lambda playback, now_ns: playback.step(now_ns, count))

    def _next(self) -> str:
        return self._ask(lambda playback, now_ns: playback.step(now_ns, 1))

    def _set_rate(self) -> str:
        rate = self.parameters.rate
        return self._ask(lambda playback, now_ns: playback.set_rate(now_ns, rate))

    def _change_rate(self, factor: float) -> str:
        rate = round(self.parameters.rate * factor, 6)
        (result,) = self.set_parameters([Parameter('rate', value=rate)])
        return '' if result.successful else str(result.reason)

    def _on_key(self, key: str) -> None:
        """Do what a key means, in the thread in which the node does everything."""
        executor = self.executor
        if executor is not None:
            executor.create_task(self._do_key, key)

    def _do_key(self, key: str) -> None:
        problem = {
            'space': self._toggle,
            'right': self._next,
            'left': self._back,
            'up': lambda: self._change_rate(RATE_FACTOR),
            'down': lambda: self._change_rate(1.0 / RATE_FACTOR),
        }[key]()
        if problem:
            self.get_logger().warning(problem)


def _state(where: PlaybackStatus) -> str:
    return 'finished' if where.finished else 'paused' if where.paused else 'playing'


def make() -> list[PlayerNode]:
    """Return the nodes of this process."""
    sys.setswitchinterval(SWITCH_INTERVAL)
    nodes = [PlayerNode()]
    # What is there now stays until the end: looking through it again and again takes time.
    gc.freeze()
    return nodes
