# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The host's end of the link against the emulator, in virtual time; hardware that only counts."""

import math
import random

from t3mpc_ros.emulator.board.hardware import Registers
from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.radio.link.link import Link
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.port_actions import Close, LinkState, Open, Wait, Write
from t3mpc_ros.radio.protocol.codec import decode_downlink, decode_to_dongle
from t3mpc_ros.radio.protocol.frames import Command, Transmit
from t3mpc_ros.radio.protocol.framing import FrameDecoder
from t3mpc_ros.radio.radio_robot import RadioRobot, RadioRobotParameters
from t3mpc_ros.robot.interface import RobotCommand

MS = 1_000_000
START_NS = 5_000_000_000
TTL_AND_SLACK = 0.25
"""s"""
SAMPLE = Registers(164, -5, 8192, -4000, -12, 13, -131)


class Bench:
    """Runs a link and an emulator; whoever wants a fault injects it by name."""

    def __init__(self, flat=None, key=b'', robot_key=None, link=None, seed=1, emulator=None):
        robot_key = key if robot_key is None else robot_key
        if emulator is None:
            parameters = EmulatorParameters.from_dict(flat or {})
            emulator = Emulator(parameters, robot_key, seed, START_NS)
        self.emulator = emulator
        """Or whatever behaves like one: ``avr_bench.AvrEmulator`` does."""
        self.link = Link(link or LinkParameters(), key, random.Random(seed).randbytes)
        self.now_ns = emulator.now_ns
        self.is_open = False
        self.killed = False
        self.wake_ns = self.now_ns
        self.wheels = None
        self.commanded_ns = 0
        self.written = []
        """Each piece of data that the host has written, with its time."""
        self.followed = []
        """Each command that the robot has followed, with the time of the host."""
        self.each = None
        self.emulator.board.followed = self._note

    def _note(self, now_us, command):
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
        """Let time pass; return how long it took until ``until`` held."""
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
        """Let time pass until the link or whoever drives it has something to do."""
        times = [max(self.wake_ns, self.now_ns + 1000), end]
        if self.wheels is not None:
            times.append(max(self.commanded_ns + 20 * MS, self.now_ns + 1000))
        until = min(times)
        while True:
            next_ns = self.emulator.next_ns
            self.now_ns = until if next_ns is None else max(min(until, next_ns), self.now_ns)
            arrived = self.emulator.run_to(self.now_ns)
            if self.is_open and not self.emulator.port_open:
                self.is_open = False
                self.link.port_failed('dongle is not there', True, self.now_ns)
                return
            if arrived and self.is_open:
                self._step(b''.join(data for _, data in arrived))
                return
            if self.now_ns >= until:
                return

    def _step(self, received):
        if self.killed:
            self.wake_ns = self.now_ns + 1000 * MS
            return
        deeds = self._ask(received)
        while deeds:
            deed = deeds.pop(0)
            if isinstance(deed, Wait):
                self.wake_ns = deed.until_ns
            elif isinstance(deed, Write) and self.is_open:
                self.written.append((self.now_ns, deed.data))
                self.emulator.feed(deed.data, self.now_ns)
            elif isinstance(deed, Close):
                self.is_open = False
            elif isinstance(deed, Open):
                self.is_open = self.emulator.port_open
                if self.is_open:
                    self.link.port_opened(self.now_ns)
                else:
                    self.link.port_failed('dongle is not there', True, self.now_ns)
                self.wake_ns = self.now_ns
                deeds = []

    def _command(self):
        if self.wheels is not None and self.now_ns >= self.commanded_ns + 20 * MS:
            self.commanded_ns = self.now_ns
            self._order(RobotCommand(self.wheels, self.now_ns))

    def _ask(self, received):
        return self.link.step(self.now_ns, received)

    def _order(self, command):
        self.link.command(command, self.now_ns)

    def drive(self, right, left):
        """Command these wheel speeds fifty times a second from now on."""
        self.wheels = WheelSpeeds(right, left)

    def release_controls(self):
        """Command nothing any more."""
        self.wheels = None

    def kill(self):
        """Let the host be gone in the middle of whatever it does, as SIGKILL does."""
        self.killed = True
        self.wheels = None

    def connect(self):
        """Run until the link runs."""
        return self.run(10.0, lambda: self.link.state is LinkState.RUN)


class RobotBench(Bench):
    """A bench whose host is the bridge's: guard, odometry and slip stop around the link."""

    def __init__(self, parameters=None, **given):
        super().__init__(**given)
        key = given.get('key', b'')
        self.robot = RadioRobot(RadioRobotParameters.from_dict(parameters or {}), key)
        self.link = self.robot.link
        self.states = []

    def _ask(self, received):
        deeds = self.robot.step(self.now_ns, received)
        self.states += self.robot.take_states()
        return deeds

    def _order(self, command):
        self.robot.apply(command, self.now_ns)


def sent_commands(*benches):
    """Return every command in what the hosts have written; of one host in order."""
    found = []
    for bench in benches:
        splitter = FrameDecoder()
        for _, data in bench.written:
            for frame in map(decode_to_dongle, splitter.feed(data)):
                if isinstance(frame, Transmit):
                    payload = decode_downlink(frame.first)
                    if isinstance(payload, Command):
                        found.append(payload)
    return found


def check_followed(bench, *others):
    """Every command that was followed was sent, once, in the order of its host, and is not old."""
    sent = sent_commands(bench, *others)
    position = {command: index for index, command in enumerate(sent)}
    assert len(position) == len(sent)
    order = {}
    for now_ns, command in bench.followed:
        order.setdefault(command.session, []).append(position[command])
        age = (now_ns // 1000 - command.host_us) % (1 << 32) / 1e6
        assert age <= TTL_AND_SLACK, f'{command} was followed after {age} s'
    for followed in order.values():
        assert followed == sorted(set(followed))


class PulseCounter:
    """Hardware that steps exactly: a phase of each wheel, cut to whole pulses."""

    def __init__(self):
        self.phase = [0.0, 0.0]
        self.speeds = (0, 0)
        self.on = None
        self.registers = SAMPLE
        self.ranges = bytes(8)
        self.battery = 0

    def boot(self, microsteps):
        self.phase = [0.0, 0.0]
        self.gain = 200 * microsteps / math.tau / 1e12

    def run(self, elapsed_us):
        for wheel in (0, 1):
            self.phase[wheel] += self.speeds[wheel] * elapsed_us * self.gain

    def turn(self, left, right):
        self.speeds = left, right

    def power(self, on):
        self.on = on

    @property
    def counters(self):
        return math.floor(self.phase[0]), math.floor(self.phase[1])
