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
"""Measures what a host knows after a fault: its path, the restarts, and which hop it names.

    PYTHONPATH=.:test .venv/bin/python bench/link_faults.py [--phases 20] [--page FILE] [WORD ...]

It prints the table of docs/radio.md, or writes it there with ``--page``; words select faults. Each
fault begins at every phase of the cycle of the link, in virtual time on emulated boards.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
import math
import re
from typing import NamedTuple

from support.emulator_bench import MS, RobotBench, cable_bench

from bench.page_table import PageTable
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.nodes.robot_messages import state_warnings
from t3mpc_ros.radio.link.actions_and_states import LinkState
from t3mpc_ros.radio.link.statistics import DiagnosticLevel

PHASES = 20  # trials of each fault
CYCLE = 0.02  # cycle of the link, s
SAMPLE_NS = 50 * MS  # period at which the diagnostics are read
SUSPENSIONS = (0.3, 0.5, 0.9, 1.2, 2.0, 5.0, 10.0)  # s
GEOMETRY = WheelGeometry()
HOPS = {
    'cable': r'on the cable',
    'dongle or its cable': r'(?<!of )the dongle (stopped|does not)|is not there',
    'robot board or its cable': r'robot board stopped',
    'radio': r'on the radio|is it on, in range',
    'radio chip': r'radio chip',
    'robot': r'the robot restarted|at the robot',
    'host': r'was not executed',
}
"""What names a hop in the diagnostics; a silent line and a silent board look alike."""


class Trial(NamedTuple):
    """What the host knew after one fault, and what had happened."""

    missed: int  # microsteps that the counters of the host lack, of the worse wheel
    error: float  # difference between the pose and that of the counted pulses, m
    counted: tuple[int, int]  # restarts of robot and dongle, as the host counted them
    happened: tuple[int, int]  # the true ones
    shown: Counter[str]  # texts of the diagnostics, by the number of samples that had them
    unknown: float  # longest path that the host says it does not know, m


class Fault(NamedTuple):
    """A fault, how it is provoked, and the hop that the diagnostics name."""

    name: str
    provoke: Callable[[RobotBench], None]
    hop: str = ''
    """Key of HOPS; empty: a moment is too short to name one."""
    cable: bool = False  # whether the robot is driven over its own USB


def diagnosis(bench: RobotBench) -> str:
    """Return the text in the diagnostics of ``radio_bridge``; empty when all is well."""
    robot, now_ns = bench.robot, bench.now_ns
    state, quality = robot.advance(now_ns), robot.quality(now_ns)
    if robot.link.state is not LinkState.RUN:
        return state.reason
    if quality.level is DiagnosticLevel.ERROR:
        return quality.text
    return '; '.join(filter(None, (*state_warnings(state), robot.restart(now_ns), quality.text)))


class Observer:
    """Counts the true restarts and pulses of a bench, and samples its diagnostics."""

    def __init__(self, bench: RobotBench) -> None:
        self._bench = bench
        self._before = (0, 0)
        self.restarts = [0, 0]
        self.shown: Counter[str] = Counter()
        self._due_ns = bench.now_ns
        self._count(bench.board, 0)
        self._count(bench.emulator.dongle, 1)
        bench.each = self._sample

    @property
    def pulses(self) -> tuple[int, int]:
        """Microsteps issued since the start, left and right."""
        left, right = self._bench.plant.pulses
        return self._before[0] + left, self._before[1] + right

    def _count(self, board: object, index: int) -> None:
        boot = board.boot

        def counted(*arguments: int) -> None:
            if not index:
                self._before = self.pulses
            self.restarts[index] += 1
            boot(*arguments)

        board.boot = counted

    def _sample(self) -> None:
        if self._bench.now_ns >= self._due_ns:
            self._due_ns = self._bench.now_ns + SAMPLE_NS
            if text := diagnosis(self._bench):
                self.shown[re.sub(r'\d+(\.\d+)?', '…', text)] += 1


def measure(fault: Fault, phase: float) -> Trial:
    """Return the trial of a fault that begins at a phase of the cycle, 0 to 1."""
    given = {'flat': {'robot_clock_error': 0.003}, 'parameters': {'odometry.use_gyro': False}}
    bench = cable_bench(kind=RobotBench, **given) if fault.cable else RobotBench(**given)
    bench.connect()
    bench.drive(6.0, 4.5)
    bench.run(1.5)
    bench.run(phase * CYCLE + 1e-6)
    observer = Observer(bench)
    fault.provoke(bench)
    bench.run_to_rest()
    counted, issued = bench.counted_pulses, observer.pulses
    quality = bench.link.quality(bench.now_ns)
    angles, pose = bench.link.telemetry.angles, bench.states[-1].odometry.pose
    turned = GEOMETRY.wheel_radius * (angles.right - angles.left) / 2.0
    error = math.remainder(pose.yaw - turned / GEOMETRY.half_separation, math.tau)
    return Trial(
        max((there - here for here, there in zip(counted, issued, strict=True)), key=abs),
        abs(error) * GEOMETRY.half_separation,
        (quality.robot_resets, quality.dongle_resets),
        tuple(observer.restarts),
        observer.shown,
        bench.robot.unknown_travel,
    )


def suspended(seconds: float, publishes: bool) -> Callable[[RobotBench], None]:
    """Return a fault in which the host gets no processor time."""

    def provoke(bench: RobotBench) -> None:
        if not publishes:
            bench.release_controls()
        bench.suspend(seconds)
        bench.run(0.5)

    return provoke


def injected(
    name: str, seconds: float, value: float = math.nan, wait: float = 3.0
) -> Callable[[RobotBench], None]:
    """Return a fault of the emulator that lasts so long, and the time after it."""

    def provoke(bench: RobotBench) -> None:
        bench.inject(name, seconds, value)
        bench.run(seconds + wait)

    return provoke


def at_rest(provoke: Callable[[RobotBench], None]) -> Callable[[RobotBench], None]:
    """Return a fault that begins at standstill."""

    def stop_first(bench: RobotBench) -> None:
        bench.run_to_rest()
        provoke(bench)

    return stop_first


def three_robot_resets(bench: RobotBench) -> None:
    """Restart the robot three times while the host is suspended."""
    for _ in range(3):
        bench.inject('robot_reset', 0.1)
        bench.emulator.run_to(bench.now_ns + 400 * MS)
        bench.suspend(0.4)
    bench.run(3.0)


def dongle_reset_while_suspended(bench: RobotBench) -> None:
    """Restart the dongle, and let the host go on three seconds later."""
    bench.inject('dongle_reset')
    bench.suspend(3.0)
    bench.run(3.0)


def robot_cable_out(bench: RobotBench) -> None:
    """Unplug the USB of the robot board for a second."""
    bench.emulator.unplugged = True
    bench.run(1.0)
    bench.emulator.unplugged = False
    bench.run(3.0)


def faults() -> Iterator[Fault]:
    """Yield the faults in the order of the page."""
    for cable in (False, True):
        for publishes, who in ((True, 'publisher goes on'), (False, 'publisher ends')):
            for seconds in SUSPENSIONS:
                name = f'{"over the cable: " * cable}host suspended {seconds:g} s, {who}'
                yield Fault(name, suspended(seconds, publishes), 'host', cable)
    for seconds in (0.8, 2.0):
        yield Fault(
            f'USB of the dongle stalls {seconds:g} s',
            injected('stall', seconds),
            'dongle or its cable',
        )
    yield Fault('robot resets in motion', injected('robot_reset', 0.3), 'robot')
    yield Fault('robot resets at rest', at_rest(injected('robot_reset', 0.3)), 'robot')
    yield Fault('robot resets three times, host suspended', three_robot_resets, 'robot')
    yield Fault('over the cable: robot resets', injected('robot_reset', 0.3), 'robot', True)
    yield Fault('dongle resets', injected('dongle_reset', 0.001), 'dongle or its cable')
    yield Fault('dongle resets, host suspended 3 s', dongle_reset_while_suspended)
    yield Fault('dongle unplugged 1 s', injected('close_port', 1.0), 'dongle or its cable')
    yield Fault('cable of the dongle dead 2 s', injected('silence', 2.0), 'dongle or its cable')
    for name, what in (('drop_bytes', 'loses'), ('flip_bits', 'flips bits of')):
        yield Fault(f'cable {what} 1 % of the bytes', injected(name, 6.0, 0.01), 'cable')
    yield Fault('over the cable: unplugged 1 s', robot_cable_out, 'robot board or its cable', True)
    yield Fault('radio loses half of the packets', injected('loss', 6.0, 0.5), 'radio')
    yield Fault('radio jammed 3 s', injected('jam', 3.0), 'radio')
    yield Fault('radio chip of the dongle dead 3 s', injected('radio_dead', 3.0), 'radio chip')


def named(trial: Trial) -> str:
    """Return the hop that the diagnostics of a trial named for the longest time; empty: none."""
    samples: Counter[str] = Counter()
    for text, count in trial.shown.items():
        for hop, words in HOPS.items():
            if re.search(words, text):
                samples[hop] += count
    return samples.most_common(1)[0][0] if samples else ''


def format_row(fault: Fault, trials: list[Trial]) -> str:
    """Return a row of the table: the worst of the trials."""
    missed = sorted(trial.missed for trial in trials)
    steps = f'{missed[0]}' if missed[0] == missed[-1] else f'{missed[0]} to {missed[-1]}'
    error = max(trial.error for trial in trials)
    counted = ', '.join(sorted({'{} + {}'.format(*trial.counted) for trial in trials}))
    happened = ', '.join(sorted({'{} + {}'.format(*trial.happened) for trial in trials}))
    hops = Counter(map(named, trials))
    hop = ', '.join(f'{name or "-"} ({count})' for name, count in hops.most_common())
    hop = hop.partition(' (')[0] if len(hops) == 1 else hop
    return f'| {fault.name} | {steps} | {1e3 * error:.2f} | {counted} | {happened} | {hop} |'


def _measured_row(fault: Fault, phases: int) -> str:
    return format_row(fault, [measure(fault, phase / phases) for phase in range(phases)])


TABLE = PageTable(
    'faults',
    (
        'fault',
        'microsteps missed',
        'pose, mm',
        'restarts counted',
        'true ones',
        'named for longest',
    ),
    ('phases', PHASES),
    [(fault.name, partial(_measured_row, fault)) for fault in faults()],
)

if __name__ == '__main__':
    TABLE.main(__doc__)
