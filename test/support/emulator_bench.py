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
"""Bench of the host link against the emulator in virtual time."""

import math
import random

from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.radio.link.actions_and_states import Close, LinkState, Open, Wait, Write
from t3mpc_ros.radio.link.link import Link
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol.codec import decode_downlink, decode_to_dongle
from t3mpc_ros.radio.protocol.frames import Command, Transmit
from t3mpc_ros.radio.protocol.framing import FrameDecoder
from t3mpc_ros.radio.radio_robot import RadioRobot, RadioRobotParameters
from t3mpc_ros.robot.interface import RobotCommand

MS = 1_000_000
START_NS = 5_000_000_000
TTL_AND_SLACK = 0.25  # s

STEP = math.tau / 3200  # turn of a wheel by a microstep, rad


class Bench:
    """Runs a link against an emulator; faults are injected by name."""

    def __init__(
        self, flat=None, key=b'', robot_key=None, link=None, seed=1, emulator=None, erased=False
    ):
        robot_key = key if robot_key is None else robot_key
        self.clock_error = 0.0
        if emulator is None:
            parameters = EmulatorParameters.from_dict(flat or {})
            self.clock_error = parameters.robot_clock_error
            emulator = Emulator(parameters, robot_key, seed, START_NS, erased)
        self.emulator = emulator
        """The emulator, or an object with its interface such as ``avr_bench.AvrEmulator``."""
        self.link = Link(link or LinkParameters(), key, random.Random(seed).randbytes)
        self.now_ns = emulator.now_ns
        self.is_open = False
        self.killed = False
        self.wake_ns = self.now_ns
        self.wheels = None
        self.commanded_ns = 0
        self.written = []  # each write of the host, with its time
        self.followed = []  # each command that the robot has executed, with its time
        self.problem = ('dongle is not there', True)
        """Why the port cannot be opened, and whether it is absent."""
        self.opens = []  # time of each attempt to open the port
        self.closes = 0
        self.link_states = []  # states of the link, in order
        self.each = None
        self.emulator.board.on_command = self._record_command

    def _record_command(self, now_us, command):
        self.followed.append((self.emulator.now_ns, command))

    @property
    def board(self):
        return self.emulator.board

    @property
    def plant(self):
        return self.emulator.plant

    def inject(self, *arguments):
        self.emulator.inject(*arguments)

    def run(self, seconds, until=None):
        """Run for a time or until ``until`` holds; return the elapsed time, s."""
        start, end = self.now_ns, self.now_ns + round(seconds * 1e9)
        while self.now_ns < end:
            self._command()
            self._step(b'')
            if until is not None and until():
                return (self.now_ns - start) / 1e9
            self._wait(end)
            if self.each is not None:
                self.each()
        if until is not None:
            raise AssertionError(f'not within {seconds} s: {self.link.reason(self.now_ns)}')
        return seconds

    def _wait(self, end):
        """Advance to the next event of the link, the setpoint or the emulator."""
        times = [max(self.wake_ns, self.now_ns + 1000), end]
        if self.wheels is not None:
            times.append(max(self.commanded_ns + 20 * MS, self.now_ns + 1000))
        until = min(times)
        while True:
            next_ns = self.emulator.next_ns
            self.now_ns = until if next_ns is None else max(min(until, next_ns), self.now_ns)
            received_blocks = self.emulator.run_to(self.now_ns)
            if self.is_open and not self.emulator.port_open:
                self.is_open = False
                self.link.port_failed('dongle is not there', True, self.now_ns)
                return
            if received_blocks and self.is_open:
                self._step(b''.join(data for _, data in received_blocks))
                return
            if self.now_ns >= until:
                return

    def _step(self, received):
        if self.killed:
            self.wake_ns = self.now_ns + 1000 * MS
            return
        actions = self._step_link(received)
        assert [isinstance(action, Wait) for action in actions].index(True) == len(actions) - 1
        assert actions[-1].until_ns >= self.now_ns
        self.wake_ns = actions[-1].until_ns
        for action in actions[:-1]:
            if isinstance(action, Write) and self.is_open:
                self.written.append((self.now_ns, action.data))
                self.emulator.feed(action.data, self.now_ns)
            elif isinstance(action, Close):
                self.closes += 1
                self.is_open = False
            elif isinstance(action, Open):
                self._open()
        if not self.link_states or self.link_states[-1] is not self.link.state:
            self.link_states.append(self.link.state)

    def _open(self):
        self.opens.append(self.now_ns)
        self.wake_ns = self.now_ns
        self.is_open = self.emulator.port_open and self.problem[1]
        if self.is_open:
            self.link.port_opened(self.now_ns)
        else:
            self.link.port_failed(*self.problem, self.now_ns)

    def _command(self):
        if self.wheels is not None and self.now_ns >= self.commanded_ns + 20 * MS:
            self.commanded_ns = self.now_ns
            self._send_setpoint(RobotCommand(self.wheels, self.now_ns))

    def _step_link(self, received):
        return self.link.step(self.now_ns, received)

    def _send_setpoint(self, command):
        self.link.command(command.wheels, command.stamp_ns + 250 * MS)

    def drive(self, right, left):
        """Command these wheel speeds 50 times a second from now on."""
        self.wheels = WheelSpeeds(right, left)

    def release_controls(self):
        """Send no more setpoints."""
        self.wheels = None

    def suspend(self, seconds):
        """Stop the host, like SIGSTOP; what arrives meanwhile waits in the buffer of the port."""
        self.now_ns += round(seconds * 1e9)
        waiting = self.emulator.run_to(self.now_ns)
        self._step(b''.join(data for _, data in waiting))

    def run_to_rest(self):
        """Drive to standstill, and send no more setpoints."""
        self.drive(0.0, 0.0)
        self.run(0.6)
        self.release_controls()
        self.run(1.0)

    @property
    def counted_pulses(self):
        """Microsteps, right and left, as the telemetry of the robot has them."""
        right, left = self.link.telemetry.angles
        return round(left / STEP), round(right / STEP)

    def kill(self):
        """Stop the host at once, like SIGKILL."""
        self.killed = True
        self.wheels = None

    def connect(self):
        """Run until the link is in the state RUN; return the elapsed time, s."""
        return self.run(10.0, lambda: self.link.state is LinkState.RUN)


class RobotBench(Bench):
    """Bench with the host side of the radio bridge: limiter, odometry and slip monitor."""

    def __init__(self, parameters=None, **given):
        super().__init__(**given)
        key = given.get('key', b'')
        self.robot = RadioRobot(RadioRobotParameters.from_dict(parameters or {}), key)
        self.link = self.robot.link
        self.states = []

    def _step_link(self, received):
        actions = self.robot.step(self.now_ns, received)
        self.states += self.robot.take_states()
        return actions

    def _send_setpoint(self, command):
        self.robot.apply(command, self.now_ns)


class CablePort:
    """The USB port of the robot board of an emulator, or of one with its interface."""

    def __init__(self, emulator):
        self._emulator = emulator
        self.unplugged = False

    def __getattr__(self, name):
        return getattr(self._emulator, name)

    def feed(self, data, now_ns):
        if not self.unplugged:
            self._emulator.feed_console(data, now_ns)

    def run_to(self, now_ns):
        self._emulator.run_to(now_ns)
        blocks = self._emulator.take_console()
        return [] if self.unplugged else blocks


def cable_bench(flat=None, key=b'', robot_key=None, seed=1, kind=Bench, **given):
    """Return a bench at the USB port of the robot board."""
    parameters = EmulatorParameters.from_dict(flat or {})
    emulator = Emulator(parameters, key if robot_key is None else robot_key, seed, START_NS)
    made = kind(key=key, seed=seed, emulator=CablePort(emulator), **given)
    made.clock_error = parameters.robot_clock_error
    return made


def sent_commands(*benches):
    """Return time and content of every command in the writes of the hosts, each host in order."""
    found = []
    for bench in benches:
        splitter = FrameDecoder()
        for now_ns, data in bench.written:
            for frame in map(decode_to_dongle, splitter.feed(data)):
                if isinstance(frame, Transmit):
                    payload = decode_downlink(frame.first)
                    if isinstance(payload, Command):
                        found.append((now_ns, payload))
    return found


def check_followed(bench, *others):
    """Check the executed commands: sent by a host, in order, unique, and not late.

    The time from sending to execution is bounded, by the clock of the robot, because the echo of a
    command is older than the command.
    """
    bound = TTL_AND_SLACK * (1.0 + abs(bench.clock_error))
    sent = sent_commands(bench, *others)
    following = {}
    for now_ns, command in bench.followed:
        # Equal commands are told apart by their order.
        position = following.get(command.session, 0)
        while sent[position][1] != command:
            position += 1
        following[command.session] = position + 1
        age = (now_ns - sent[position][0]) / 1e9
        assert 0.0 <= age <= bound, f'{command} was executed after {age} s'
