# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros replayer``: plays bags, the recorded bytes at the recorded times."""

from collections.abc import Callable, Mapping
import gc
import sys
import time
from typing import Any

from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.nodes.plumbing import quality
from t3mpc_ros.nodes.plumbing.package_node import ERROR, OK, WARN, PackageNode
from t3mpc_ros.nodes.replaying.keyboard import Keyboard
from t3mpc_ros.nodes.replaying.progress import ProgressLine
from t3mpc_ros.nodes.replaying.publishers import CLOCK, Publishers, Rules
from t3mpc_ros.nodes.replaying.sender import Sender, Where
from t3mpc_ros.nodes.tables import ReplayerSettings
from t3mpc_ros.record.playback.offer import read_overrides
from t3mpc_ros.record.playback.playback import Playback
from t3mpc_ros.record.playback.read_ahead import ReadAhead
from t3mpc_ros.record.playback.tape import Tape

SWITCH = 0.0005
"""s after which a thread that computes lets another one go on; Python's default is 5 ms, and a
message that is due would wait so long for the one that reads ahead."""
LAST_WORDS = 1.0
"""s that listeners are given, at the end of the bag, to get what they have not got yet."""
FASTER, BACK = 1.1, 5.0
"""By how much a key changes the rate; how many seconds of the bag a key goes back."""

NO_BAG = 'no bag is open: set bags'


class ReplayerNode(PackageNode[ReplayerSettings]):
    """Opens bags, makes their publishers, and lets a :class:`Sender` play them."""

    def __init__(self, **given: Any) -> None:
        super().__init__('replayer', ReplayerSettings, **given)
        self._sender: Sender | None = None
        self._tape: Tape | None = None
        self._keyboard: Keyboard | None = None
        self._progress: ProgressLine | None = None
        self._rivals: dict[str, str] = {}
        self._warned: set[str] = set()
        self._started = self._ended = False
        if self.settings.bags:
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
        settings = self.settings
        path = settings.quality_overrides
        overrides = read_overrides(path) if path else {}
        self._tape, unfinished = settings.open_tape()
        tape = self._tape
        own_clock = settings.clock_rate > 0.0 or settings.clock_with_messages
        self._span = begin_ns, end_ns = settings.span_ns(tape)
        self._offered = Publishers(
            self, tape, Rules(settings.allow_commands, own_clock, overrides)
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
        clock = self.create_publisher(Clock, CLOCK, quality.NEWEST) if own_clock else None
        playback = Playback(
            lambda at_ns: ReadAhead(
                tape.plan(at_ns, begin_ns, end_ns, settings.loop), settings.read_ahead
            ),
            begin_ns,
            end_ns,
            origin_ns=tape.start_ns,
            rate=settings.rate,
            loop=settings.loop,
            paused=settings.start_paused,
            clock_rate=settings.clock_rate,
        )
        self._sender = Sender(
            playback,
            self._offered.by_topic,
            clock,
            settings.clock_with_messages,
            settings.realtime_priority,
        )
        if settings.progress:
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
        settings, sender = self.settings, self._sender
        if sender is None:
            return
        # Not before the process spins: a signal would end it with the terminal as it is.
        if settings.keyboard and self._keyboard is None and Keyboard.usable():
            self._keyboard = Keyboard(self._on_key)
        waited = (time.monotonic_ns() - self._opened_ns) / NANOSECONDS
        patient = waited < settings.wait_for_subscribers and not self._offered.heard()
        if waited < settings.delay or patient:
            return
        self._waiting.cancel()
        self._guard(sender)
        self._look_around()
        sender.start()
        self._started = True

    # -- while it plays ---------------------------------------------------------------------------

    def configure(self, settings: ReplayerSettings) -> None:
        """Play at another rate."""
        if self._sender is not None:
            self._sender.ask(lambda playback, now_ns: playback.set_rate(now_ns, settings.rate))

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
                f'realtime_priority {self.settings.realtime_priority} cannot be had: '
                f'{sender.priority_problem}; it plays without'
            )
        if sender.failure:
            self._ended = True
            self.get_logger().error(f'playing has ended early: {sender.failure}')
            self.exit_code = 1
        elif where.finished and self.settings.exit_at_end:
            self._ended = True
            self._offered.flush(LAST_WORDS)
            self.done = True

    def _guard(self, sender: Sender) -> None:
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

    def health(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether it plays, where it is, and how punctual it has been."""
        sender = self._sender
        if sender is None:
            return WARN, NO_BAG, {}
        where, begin_ns = sender.where(), self._span[0]
        values = {
            'position_s': (where.stamp_ns - begin_ns) / NANOSECONDS,
            'length_s': (self._span[1] - begin_ns) / NANOSECONDS,
            'rate': where.rate,
            'laps': where.laps,
            'messages': sender.published,
            'lateness_p50_ms': sender.lateness.percentile_ns(50) / 1e6,
            'lateness_p99_ms': sender.lateness.percentile_ns(99) / 1e6,
            'lateness_max_ms': sender.lateness.largest_ns / 1e6,
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
                f'largest {late.largest_ns / 1e6:.2f} ms'
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

    def _ask(self, what: Callable[[Playback, int], str | None]) -> str:
        return self._sender.ask(what) if self._sender is not None else NO_BAG

    def _pause(self) -> str:
        return self._ask(Playback.pause)

    def _resume(self) -> str:
        return self._ask(Playback.resume)

    def _toggle(self) -> str:
        return self._ask(
            lambda playback, now_ns: (
                playback.resume(now_ns) if playback.paused else playback.pause(now_ns)
            )
        )

    def _seek(self) -> str:
        target_ns = self._first_ns + round(self.settings.seek_time * NANOSECONDS)
        return self._ask(lambda playback, now_ns: playback.seek(now_ns, target_ns))

    def _back(self) -> str:
        def back(playback: Playback, now_ns: int) -> str:
            target_ns = playback.stamp_ns(now_ns) - round(BACK * NANOSECONDS)
            return playback.seek(now_ns, max(target_ns, self._span[0]))

        return self._ask(back)

    def _step(self) -> str:
        count = self.settings.step_count
        return self._ask(lambda playback, now_ns: playback.step(now_ns, count))

    def _next(self) -> str:
        return self._ask(lambda playback, now_ns: playback.step(now_ns, 1))

    def _set_rate(self) -> str:
        rate = self.settings.rate
        return self._ask(lambda playback, now_ns: playback.set_rate(now_ns, rate))

    def _change_rate(self, factor: float) -> str:
        rate = round(self.settings.rate * factor, 6)
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
            'up': lambda: self._change_rate(FASTER),
            'down': lambda: self._change_rate(1.0 / FASTER),
        }[key]()
        if problem:
            self.get_logger().warning(problem)


def _state(where: Where) -> str:
    return 'finished' if where.finished else 'paused' if where.paused else 'playing'


def make() -> list[ReplayerNode]:
    """Return the nodes of this process."""
    sys.setswitchinterval(SWITCH)
    nodes = [ReplayerNode()]
    # What is there now stays until the end: looking through it again and again takes time.
    gc.freeze()
    return nodes
