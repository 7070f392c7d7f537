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
"""Measures how fast the robot stops: real bridge processes, and emulated boards on a pty.

    PYTHONPATH=.:test .venv/bin/python bench/stopping_times.py [--trials 20] [--file F] [KIND ...]

It prints the table of docs/safety.md and writes its trials to a file, as
docs/measured/stopping_times.csv; ``test/nodes/test_stopping_times.py`` is its short form.
Times are those of the emulator, which knows when the motors pulse. It is in this process and may
be interrupted on a busy machine: a trial in which its time has lagged is repeated.
"""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager, suppress
import csv
from functools import partial
import math
import os
from pathlib import Path
import random
import signal
import tempfile
import threading
import time
from typing import NamedTuple

from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
import rclpy
from sensor_msgs.msg import JointState
from support.waiting import Processes, WaitTimeoutError, wait_until

from t3mpc_ros.cli.process_group import PrivateGraph
from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters
from t3mpc_ros.emulator.pty_port import PtyPort, serve
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import topic_endpoints

FULL = 0.35  # speed with both wheels at their maximum of 10 rad/s, m/s
LIMIT = 0.45  # time to rest that no trial may exceed, s
TIMEOUT = 0.25  # ``cmd_vel_timeout`` of the bridge, s
CREEP = 0.002  # way of the rotors while they settle at the field that stands, m
DURATIONS = (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0)  # durations of a suspension, s
COUNTED = (0.3, 1.2, 2.0, 10.0)
"""Durations of a suspension after which the microsteps are compared, s."""
STEP = math.tau / 3200  # turn of a wheel by a microstep, rad
_MAX_LAG = 0.01  # lag of the emulator's time during a trial, s
_SETTLING = 1.0  # time observed after the last event of a trial, s


class Sample(NamedTuple):
    """State of the emulated robot at one update."""

    wall: float  # monotonic clock of this process, s
    time: float  # time of the emulator, s
    speed: float  # speed of the faster motor, rad/s
    x: float
    y: float


class Trial(NamedTuple):
    """Result of one trial."""

    rest: float | None
    """Time from the last valid command to rest, s; None if it is not known, or did not stop."""
    way: float  # distance from there to rest, m
    after: float = 0.0  # distance on commands that had expired, m
    missed: int | None = None
    """Microsteps that the bridge has not counted, of the worse wheel; None: not compared."""


class Disturbed(RuntimeError):
    """The measurement itself was interrupted."""


class DrivenRobot:
    """A bridge process in a namespace, its emulated boards, and the publisher of its commands."""

    def __init__(self, node, processes, folder, name='', cable=False):
        self.name = f'bridge{name}'
        dongle, usb = folder / f'dongle{name}', folder / f'robot{name}'
        self._path = usb if cable else dongle
        self._namespace = f'/robot{name}'
        self._processes = processes
        self._emulator = Emulator(EmulatorParameters())
        self._emulator.plant.warm_up()
        self._samples = []
        self._faults = []
        self._ended = False
        self._publisher = node.create_publisher(Twist, f'{self._namespace}/cmd_vel', 1)
        self._node, self._joints = node, []
        node.create_subscription(
            JointState,
            f'{self._namespace}/joint_states',
            self._joints.append,
            topic_endpoints.SCALARS,
        )
        self.speed = None
        """Commanded speed, m/s; None: the publisher is gone."""
        self._published = []
        ports = [PtyPort(path) for path in (dongle, usb)]
        self._threads = [
            threading.Thread(target=self._serve, args=ports, daemon=True),
            threading.Thread(target=self._publish, daemon=True),
        ]
        for thread in self._threads:
            thread.start()
        self.start_bridge()

    def start_bridge(self):
        """Start the bridge at the port of the emulator."""
        self._processes.start(
            self.name,
            '--ros-args',
            '-r',
            f'__ns:={self._namespace}',
            parameters={'port': str(self._path)},
            program='radio_bridge',
        )

    @property
    def pid(self):
        """Return the process of the bridge."""
        return self._processes.pid(self.name)

    def kill_bridge(self):
        """Kill the bridge."""
        self._processes.kill(self.name)

    def inject(self, *fault):
        """Begin a fault of the emulator at its next update."""
        self._faults.append(fault)

    def drive(self):
        """Drive at full speed, from a random phase of the cycle on."""
        self.speed = FULL
        wait_until(self._at_full_speed, f'{self.name} does not reach full speed')
        time.sleep(random.uniform(0.0, 0.04))

    def _at_full_speed(self):
        """Return whether the robot has driven at full speed for a while."""
        since = time.monotonic() - 0.2
        speeds = [sample.speed for sample in self._samples[-2000:] if sample.wall >= since]
        return len(speeds) > 5 and min(speeds) > 9.99

    def last_publication(self, until):
        """Return the time of the last command published until then."""
        return max(when for when in self._published if when <= until)

    def observe(self, begin, end):
        """Return the samples between two times of the monotonic clock."""
        samples = [sample for sample in self._samples if begin <= sample.wall <= end]
        lag = (samples[-1].wall - samples[0].wall) - (samples[-1].time - samples[0].time)
        if lag > _MAX_LAG or samples[0].wall - begin > 0.05:
            raise Disturbed(f'the emulator lagged by {lag:.3f} s')
        return samples

    def count(self):
        """Let the robot rest; return the microsteps counted by the bridge, and the true ones."""
        self.speed = None
        wait_until(self._rests, f'{self.name} does not rest')
        del self._joints[:]
        end = time.monotonic() + 0.3
        while time.monotonic() < end or not self._joints:
            rclpy.spin_once(self._node, timeout_sec=0.1)
        angles = dict(zip(self._joints[-1].name, self._joints[-1].position, strict=True))
        counted = [round(angles[f'{side}_wheel_joint'] / STEP) for side in ('left', 'right')]
        return counted, self._emulator.plant.pulses

    def _rests(self):
        since = time.monotonic() - 0.3
        return not any(each.speed for each in self._samples[-2000:] if each.wall >= since)

    def forget(self):
        """Discard old samples."""
        del self._samples[:-2000], self._published[:-100]

    def close(self):
        """End the bridge, the emulator and the publisher."""
        self._ended = True
        for thread in self._threads:
            thread.join()
        with suppress(KeyError):
            self._processes.kill(self.name)

    def _serve(self, dongle, usb):
        serve(
            self._emulator, dongle, 1.0, self._stopped, console_port=usb, on_update=self._on_update
        )
        dongle.close()
        usb.close()

    def _stopped(self):
        while self._faults:
            name, *rest = self._faults.pop(0)
            if rest:
                self._emulator.inject(name, *rest)
            else:
                self._emulator.end_fault(name)
        return self._ended

    def _on_update(self):
        now, pose = self._emulator.now_ns / NANOSECONDS, self._emulator.plant.pose
        speed = max(map(abs, self._emulator.board.speeds)) / 1e6
        self._samples.append(Sample(time.monotonic(), now, speed, pose.x, pose.y))

    def _publish(self):
        message = Twist()
        while not self._ended:
            if self.speed is not None:
                message.linear.x = self.speed
                self._published.append(time.monotonic())
                self._publisher.publish(message)
            time.sleep(0.02)


def way(samples):
    """Return the distance between the first and the last sample, m."""
    return math.hypot(samples[-1].x - samples[0].x, samples[-1].y - samples[0].y)


def check_speed(samples):
    """Raise Disturbed if the robot was slowing down before the fault: nothing was published."""
    if samples[0].speed < 9.9:
        raise Disturbed(f'the robot was at {samples[0].speed:.1f} rad/s')


def first_rest(samples):
    """Return the time to the first rest and the distance until then; None if there is none."""
    check_speed(samples)
    for count, sample in enumerate(samples):
        if not sample.speed:
            # The rotors settle within a tenth of a second.
            later = [each for each in samples[count:] if each.time - sample.time < 0.1]
            return sample.time - samples[0].time, way([samples[0], later[-1]])
    return None, 0.0


def last_rest(samples):
    """Return the time to the last motion and the whole distance."""
    check_speed(samples)
    moving = [sample for sample in samples if sample.speed]
    return (moving[-1].time - samples[0].time if moving else 0.0), way(samples)


def suspend(robot, duration, publishing):
    """Suspend the bridge; without ``publishing`` the publisher ends during the suspension."""
    robot.drive()
    begin = time.monotonic()
    os.kill(robot.pid, signal.SIGSTOP)
    try:
        if not publishing:
            time.sleep(random.uniform(0.0, duration))
            robot.speed = None
        time.sleep(max(begin + duration - time.monotonic(), 0.0))
    finally:
        os.kill(robot.pid, signal.SIGCONT)
    resumed = time.monotonic()
    time.sleep(_SETTLING)
    end = time.monotonic()
    valid = robot.last_publication(begin)
    if publishing:
        return Trial(*first_rest(robot.observe(valid, resumed)))
    # A command that was young enough when the bridge resumed was still valid.
    if resumed - (last := robot.last_publication(end)) < TIMEOUT:
        valid = last
    rest, distance = last_rest(robot.observe(valid, end))
    after = 0.0
    if resumed - valid > LIMIT:
        after = way(robot.observe(resumed, end))
    return Trial(rest, distance, after)


def count_pulses(robot, duration, publishing):
    """Return the trial of a suspension with the microsteps that the bridge has not counted."""
    counted, true = robot.count()
    trial = suspend(robot, duration, publishing)
    after, after_true = robot.count()
    changes = zip(counted, after, true, after_true, strict=True)
    missed = [(now - then) - (end - begin) for then, now, begin, end in changes]
    return trial._replace(missed=max(map(abs, missed)))


def break_link(robot, fault, *values):
    """Inject a fault that lasts 1.5 s while the publisher goes on."""
    robot.drive()
    valid = robot.last_publication(time.monotonic())
    robot.inject(fault, 1.5, *values)
    time.sleep(1.3)
    return Trial(*first_rest(robot.observe(valid, time.monotonic())))


def end_publisher(robot):
    """Return the trial of a publisher that ends; the bridge goes on."""
    robot.drive()
    robot.speed = None
    time.sleep(_SETTLING)
    end = time.monotonic()
    return Trial(*last_rest(robot.observe(robot.last_publication(end), end)))


def kill_host(robot, other=None):
    """Kill the bridge of a robot; another robot goes on."""
    robot.drive()
    if other is not None:
        other.drive()
    begin = time.monotonic()
    robot.kill_bridge()
    time.sleep(_SETTLING)
    end = time.monotonic()
    robot.speed = None
    robot.start_bridge()
    samples = robot.observe(robot.last_publication(begin), end)
    if other is not None and any(each.speed < 5.0 for each in other.observe(begin, end)):
        raise Disturbed('the other robot was slowed down')
    return Trial(*last_rest(samples))


class SimulatedRobot:
    """A sim_robot process: the suspension stops the robot together with its node."""

    def __init__(self, node, processes):
        self._node, self._processes = node, processes
        self._publisher = node.create_publisher(Twist, '/twin/cmd_vel', 1)
        self._truth = []
        node.create_subscription(Odometry, '/twin/ground_truth/odom', self._truth.append, 100)
        processes.start('twin', '--ros-args', '-r', '__ns:=/twin', program='sim_robot')

    def suspend(self, duration):
        """Suspend the process; its publisher ends meanwhile."""
        message = Twist()
        message.linear.x = FULL

        def publish():
            self._publisher.publish(message)
            self._spin(0.02)

        wait_until(
            lambda: self._truth and self._truth[-1].twist.twist.linear.x >= 0.98 * FULL,
            'sim_robot does not reach full speed',
            step=publish,
        )
        pid = self._processes.pid('twin')
        os.kill(pid, signal.SIGSTOP)
        try:
            begin = time.monotonic()
            until = begin + random.uniform(0.0, duration)
            while time.monotonic() < until:
                self._publisher.publish(message)
                self._spin(0.02)
            last = time.monotonic()
            self._spin(max(begin + duration - time.monotonic(), 0.0))
        finally:
            before = self._truth[-1]
            del self._truth[:]
            os.kill(pid, signal.SIGCONT)
        resumed = time.monotonic()
        self._spin(1.5)
        poses = [message.pose.pose.position for message in (before, *self._truth)]
        distance = math.hypot(poses[-1].x - poses[0].x, poses[-1].y - poses[0].y)
        if resumed - last < LIMIT:
            raise Disturbed('the publisher ended too late')
        # Its time goes on with the process, but leaves out what is more than 0.5 s late.
        return Trial(None, distance)

    def _spin(self, seconds):
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            rclpy.spin_once(self._node, timeout_sec=left)


def repeat(measure, trials, robots=()):
    """Return the results of undisturbed trials, and the number of disturbed ones."""
    results, disturbed = [], 0
    while len(results) < trials:
        if disturbed > 3 * trials + 10:
            raise WaitTimeoutError('the machine is too busy to measure')
        for robot in robots:
            robot.forget()
        try:
            results.append(measure())
        except Disturbed:
            disturbed += 1
    return results, disturbed


@contextmanager
def bench(folder: Path, environment: dict[str, str]) -> Iterator[tuple[object, Processes]]:
    """Yield a node and a process group; the processes end at the end."""
    os.environ.update(environment)
    processes = Processes(folder / 'log', environment)
    rclpy.init(args=[])
    node = rclpy.create_node('stopping_times')
    try:
        yield node, processes
    finally:
        for name in list(processes.running()):
            with suppress(ProcessLookupError):
                os.kill(processes.pid(name), signal.SIGCONT)
            processes.kill(name)
        node.destroy_node()
        rclpy.try_shutdown()


def rows(node, processes, folder, trials, durations=DURATIONS, kinds=('all',)):
    """Yield the name of each row with its trials and the number of disturbed ones."""

    def wanted(kind):
        return 'all' in kinds or kind in kinds

    robot = DrivenRobot(node, processes, folder)
    links = (
        ('robot to host dead (uplink)', 'uplink', ('loss_up', 1.0)),
        ('host to robot dead (downlink)', 'downlink', ('loss_down', 1.0)),
        ('dongle unplugged', 'unplug', ('close_port',)),
    )
    try:
        for publishing, who in ((False, 'publisher ends meanwhile'), (True, 'publisher goes on')):
            for duration in durations if wanted('suspend') else ():
                yield (
                    f'bridge suspended {duration:g} s, {who}',
                    *repeat(partial(suspend, robot, duration, publishing), trials, [robot]),
                )
        if wanted('count'):
            yield from _counted_rows(robot, trials)
        for name, kind, fault in links:
            if wanted(kind):
                yield name, *repeat(partial(break_link, robot, *fault), trials, [robot])
        if wanted('publisher'):
            yield 'publisher ends', *repeat(partial(end_publisher, robot), trials, [robot])
        if wanted('kill'):
            yield 'bridge killed', *repeat(partial(kill_host, robot), trials, [robot])
        if wanted('two'):
            other = DrivenRobot(node, processes, folder, '_b')
            both = [robot, other]
            try:
                yield (
                    'two robots, one bridge killed; the other robot goes on',
                    *repeat(partial(kill_host, robot, other), trials, both),
                )
            finally:
                other.close()
    finally:
        robot.close()
    if wanted('cable') or wanted('count'):
        yield from _cable_rows(node, processes, folder, trials, wanted)
    if wanted('sim'):
        twin = SimulatedRobot(node, processes)
        for duration in [each for each in durations if each >= 1.0]:
            yield (
                f'sim_robot suspended {duration:g} s, publisher ends meanwhile',
                *repeat(partial(twin.suspend, duration), trials),
            )


def _counted_rows(robot, trials, where=''):
    """Yield rows of suspensions with the microsteps that the bridge has not counted."""
    for publishing, who in ((True, 'publisher goes on'), (False, 'publisher ends')):
        for duration in COUNTED:
            row = repeat(partial(count_pulses, robot, duration, publishing), trials, [robot])
            yield f'{where}bridge suspended {duration:g} s, {who}', *row


def _cable_rows(node, processes, folder, trials, wanted):
    """Yield rows of a robot that is driven over the USB of its board."""
    robot = DrivenRobot(node, processes, folder, '_c', cable=True)
    try:
        if wanted('count'):
            yield from _counted_rows(robot, trials, 'over the cable: ')
        if not wanted('cable'):
            return
        for name, measure in (
            ('publisher ends', end_publisher),
            ('bridge killed', kill_host),
            (
                'bridge suspended 1 s, publisher goes on',
                partial(suspend, duration=1.0, publishing=True),
            ),
        ):
            row = repeat(partial(measure, robot), trials, [robot])
            yield f'over the cable: {name}', *row
    finally:
        robot.close()


def format_row(name, trials, disturbed):
    """Return a row of the table: worst time, way, and way on expired commands."""
    times = [trial.rest for trial in trials if trial.rest is not None]
    worst = f'{max(times):.3f}' if times else '-'
    distance = f'{max(trial.way for trial in trials):.3f}' if any(t.way for t in trials) else '-'
    after = f'{max(trial.after for trial in trials):.4f}'
    missed = max((trial.missed for trial in trials if trial.missed is not None), default='-')
    return f'| {name} | {worst} | {distance} | {after} | {missed} | {len(trials)} | {disturbed} |'


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--trials', type=int, default=20)
    parser.add_argument('--file', type=Path)
    parser.add_argument('kinds', nargs='*', default=['all'])
    options = parser.parse_args()
    written = [('fault', *Trial._fields)]
    with (
        tempfile.TemporaryDirectory() as name,
        PrivateGraph() as graph,
        bench(Path(name), graph.environment()) as made,
    ):
        print('| fault | rest, s | way, m | after, m | missed | trials | repeated |')
        print('|---' * 7 + '|')
        for row in rows(*made, Path(name), options.trials, kinds=options.kinds):
            print(format_row(*row), flush=True)
            written += [(row[0], *map(_rounded, trial)) for trial in row[1]]
    if options.file is not None:
        with options.file.open('w', newline='', encoding='utf-8') as file:
            csv.writer(file, lineterminator='\n').writerows(written)


def _rounded(value):
    return value if value is None else round(value, 5)


if __name__ == '__main__':
    main()
