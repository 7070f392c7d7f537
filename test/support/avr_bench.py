# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The boards' real programs in simavr where else the Python emulator stands: same words and host.

What the line does to bytes is the emulator's own; what the boards make of them is not. Their
wheels drive the digital twin, and what its sensors would measure goes back to the robot's pins.
"""

from contextlib import contextmanager
from functools import cache
import math
import subprocess
import tempfile

import numpy as np

from support.avr_boards import DONGLE, FIRMWARE, ROBOT, booted
from support.emulator_bench import Bench
from t3mpc_ros.emulator.board.hardware import Registers
from t3mpc_ros.emulator.emulator import EmulatorParameters
from t3mpc_ros.emulator.event_queue import EventQueue
from t3mpc_ros.emulator.fault_injection import Fault, FaultInjection
from t3mpc_ros.emulator.link.serial_line import SerialLine
from t3mpc_ros.emulator.plant import Plant
from t3mpc_ros.radio.protocol.codec import decode_downlink
from t3mpc_ros.radio.protocol.frames import Command
from t3mpc_ros.radio.protocol.framing import crc16
from t3mpc_ros.robot.interface import RANGE_SENSORS
from t3mpc_ros.simulation.sensors.range_sensor import output_voltage, sensor_mounts
from t3mpc_ros.simulation.world import cast_rays, load_world

START_NS = 5_000_000_000
KEY_PLACE = 8
BOOT_US = 130_000.0
SLICE_US = 200.0
"""Between two looks at the boards."""
PLANT_US = 5000.0
"""Between two looks of the twin at the pulses, and of the sensors at the twin."""
DIVIDER = 4
"""Before the converter that measures the battery."""
FIELDS = (
    'seq',
    'ttl_from_us',
    'session.id',
    'counters.stale',
    'ramp.speed',
    'ramp.target',
    'loaded_us',
)
STEP = math.tau / 3200


@cache
def places():
    """Return where each field of the robot's variables is, as its compiler has laid them out."""
    lines = [
        f'char at_{name.replace(".", "_")}[offsetof(struct t3_robot, {name}) + 1];'
        for name in FIELDS
    ]
    source = '\n'.join(['#include <stddef.h>', '#include "t3_robot.h"', *lines])
    with tempfile.NamedTemporaryFile(suffix='.o') as made:
        command = [
            'avr-gcc',
            '-mmcu=atmega2560',
            '-fno-common',
            f'-I{FIRMWARE}/core',
            '-c',
            '-xc',
            '-',
        ]
        subprocess.run([*command, '-o', made.name], input=source, text=True, check=True)
        table = subprocess.run(
            ['avr-nm', '-S', made.name], capture_output=True, text=True, check=True
        )
    rows = [line.split() for line in table.stdout.splitlines()]
    sizes = {row[3]: int(row[1], 16) - 1 for row in rows if len(row) == 4}
    return {name: sizes[f'at_{name.replace(".", "_")}'] for name in FIELDS}


@contextmanager
def on_avr(bench=Bench, **given):
    """Yield a bench whose boards are simulated by instructions; check them at the end."""
    parameters = {name: given.pop(name) for name in ('flat', 'seed') if name in given}
    with contextmanager(booted)(parameters.get('seed', 1)) as boards:
        emulator = AvrEmulator(boards, key=given.get('key', b''), **parameters)
        yield bench(emulator=emulator, **given)


class Ram:
    """The robot's variables, read while its program runs."""

    def __init__(self, boards):
        self._boards = boards
        self._base = boards.symbol(ROBOT, 'robot')
        self._places = places()

    def get(self, name, size, index=0, signed=False):
        at = self._base + self._places[name] + index * size
        data = bytes(self._boards.call('peek', ROBOT, at + i) for i in range(size))
        return int.from_bytes(data, 'little', signed=signed)

    def put(self, name, value, size=4):
        at = self._base + self._places[name]
        for i, byte in enumerate(value.to_bytes(size, 'little')):
            self._boards.call('poke', ROBOT, at + i, byte)


class AvrBoard:
    """The robot's program, under the words of ``t3mpc_ros.emulator.board.robot_board.RobotBoard``."""

    def __init__(self, boards):
        self._boards = boards
        self.ram = Ram(boards)
        self.followed = lambda now_us, command: None

    @property
    def session(self):
        return self.ram.get('session.id', 1)

    @property
    def speeds(self):
        """Of the ramp, urad/s."""
        return tuple(self.ram.get('ramp.speed', 4, wheel, True) for wheel in (0, 1))

    @property
    def counters(self):
        return self._boards.pulses()

    @property
    def stale(self):
        return self.ram.get('counters.stale', 2)

    def packet(self, data):
        """Let a packet reach the robot's radio that the dongle has not sent."""
        assert self._boards.call('inject', data, len(data), len(data))


class AvrEmulator:
    """Dongle and robot in simavr, their surroundings in Python, in virtual time."""

    def __init__(self, boards, flat=None, key=b'', seed=1):
        self.boards = boards
        parameters = EmulatorParameters.from_dict(flat or {})
        self._parameters = parameters
        if key:
            boards.store(KEY_PLACE, key + crc16(key).to_bytes(2, 'little'))
        self.plant = Plant(parameters.twin)
        self.plant.boot(parameters.twin.motor.microsteps)
        self._world = load_world(parameters.twin.world)
        self._mounts = sensor_mounts(parameters.twin.range_sensor)
        self.distances = np.full(len(RANGE_SENSORS), math.inf)
        """m, of the faces of the sensors from what is before them."""
        self._plant_us = 0.0
        self._pulses = (0, 0)
        self.board = AvrBoard(boards)
        self._ttl_from_us = self._seen_us = 0
        self._events = EventQueue(START_NS)
        self.faults = FaultInjection(lambda: self._events.now_ns, seed)
        self._air = (0.0, 0.0, False)
        self._to_dongle = SerialLine(self._events, self.faults, self._write, 0)
        self._to_host = SerialLine(self._events, self.faults, self._arrive, 0)
        self._piece = b''
        self._arrived = []
        self.port_open = True
        self._deaf_until_ns = START_NS
        self._look_around(0.0)
        self._run(BOOT_US)
        self._offset_ns = START_NS - round(boards.now_us * 1000)

    @property
    def now_ns(self):
        return self._events.now_ns

    @property
    def next_ns(self):
        return self.now_ns + round(SLICE_US * 1000)

    @property
    def powered(self):
        return self.boards.call('powered')

    # -- the line ---------------------------------------------------------------------------------

    def feed(self, data, now_ns):
        self.run_until(now_ns)
        if self.port_open:
            self._to_dongle.send(data)
            self._events.run_to(now_ns)

    def run_to(self, now_ns):
        self.run_until(now_ns)
        arrived, self._arrived = self._arrived, []
        return arrived

    def run_until(self, now_ns):
        while self._events.now_ns < now_ns:
            until_ns = min(self._events.now_ns + round(SLICE_US * 1000), now_ns)
            self._set_air()
            self._run((until_ns - self._offset_ns) / 1000 - self.boards.now_us)
            self._note_followed()
            self._read()
            self._events.run_to(until_ns)

    def _run(self, us):
        self.boards.run_until(self.boards.now_us + us)
        elapsed = self.boards.now_us - self._plant_us
        if elapsed >= PLANT_US:
            self._plant_us = self.boards.now_us
            self._look_around(elapsed)

    def _write(self, data):
        if self.now_ns >= self._deaf_until_ns:
            self.boards.write(data)

    def _read(self):
        """Hand on whole frames, as the emulator does."""
        for byte in self.boards.read_bytes():
            self._piece += byte
            if byte == b'\0':
                piece, self._piece = self._piece, b''
                if self.now_ns >= self._deaf_until_ns:
                    self._to_host.send(piece)

    def _arrive(self, data):
        if self.port_open:
            self._arrived.append((self.now_ns, data))

    # -- the robot --------------------------------------------------------------------------------

    def _note_followed(self):
        """Tell of a command that the wheels are to follow: its packet was the last one heard.

        A look later than its time has changed: the program may be in the middle of taking it.
        """
        before, self._seen_us = self._seen_us, self.board.ram.get('ttl_from_us', 4)
        if self._seen_us != before or self._seen_us in (self._ttl_from_us, 0):
            return
        self._ttl_from_us = self._seen_us
        command = decode_downlink(self.boards.heard())
        assert isinstance(command, Command)
        assert command.seq == self.board.ram.get('seq', 1)
        target = [self.board.ram.get('ramp.target', 4, wheel, True) for wheel in (0, 1)]
        assert target == [1000 * command.left, 1000 * command.right]
        self.board.followed(self._seen_us, command)

    def _look_around(self, elapsed_us):
        """Let the twin turn its wheels as the pulses say, and the robot's sensors see it."""
        boards, plant = self.boards, self.plant
        pulses = boards.pulses()
        if elapsed_us:
            left, right = (
                round((after - before) * STEP * 1e12 / elapsed_us)
                for before, after in zip(self._pulses, pulses, strict=True)
            )
            plant.power(self.powered)
            plant.turn(left, right)
            plant.run(round(elapsed_us))
        self._pulses = pulses
        registers = plant.registers
        boards.imu(registers is not None, registers or Registers())
        boards.call('millivolts', len(RANGE_SENSORS), plant.battery // DIVIDER)
        if self._world.segments.size or self._world.circles.size:
            every = np.arange(len(RANGE_SENSORS))
            walls = self._world.segments, self._world.circles
            cast_rays(*plant.pose, self._mounts, every, *walls, self.distances)
        for channel, distance in enumerate(self.distances):
            boards.call('millivolts', channel, round(1000.0 * output_voltage(distance)))

    # -- what goes wrong --------------------------------------------------------------------------

    def inject(self, name, duration=math.nan, value=math.nan):
        """Let a fault of the emulator begin now."""
        span = self.faults.add(Fault(name, 0.0, duration, value), self.now_ns)
        begins, ends = self._effects(name)
        begins()
        if math.isfinite(span.end_ns):
            self._events.at(round(span.end_ns), ends)

    def end(self, name):
        self.faults.clear(name)
        self._effects(name)[1]()

    def _effects(self, name):
        def nothing():
            pass

        effects = {
            'robot_reset': (self._reset_robot, self._reset_robot),
            'imu_absent': (lambda: self._imu(True), lambda: self._imu(False)),
            'button': (lambda: self._press(True), lambda: self._press(False)),
            'dongle_reset': (self.restart_dongle, nothing),
            'close_port': (self._pull_out, self._plug_in),
            'radio_dead': (lambda: self._supply(False), lambda: self._supply(True)),
        }
        return effects.get(name, (nothing, nothing))

    def _set_air(self):
        faults = self.faults
        air = (
            faults.share('loss', 'loss_down'),
            faults.share('loss', 'loss_up'),
            faults.active('jam'),
        )
        if air != self._air:
            self._air = air
            self.boards.call('loss', *air[:2])
            self.boards.call('jam', air[2])

    def restart_dongle(self):
        """Start the dongle's program anew, behind a boot loader that hears nothing."""
        self._to_dongle.clear()
        self._to_host.clear()
        self._piece = b''
        self.boards.call('reset', DONGLE)
        self._deaf_until_ns = self.now_ns + round(self._parameters.dongle_start * 1e9)

    def _pull_out(self):
        self.port_open = False
        self._arrived.clear()
        self.restart_dongle()

    def _plug_in(self):
        self.port_open = True
        self.restart_dongle()

    def _reset_robot(self):
        self.boards.call('reset', ROBOT)

    def _imu(self, absent):
        self.plant.imu_absent = absent
        self._look_around(0.0)

    def _press(self, pressed):
        self.boards.call('press', pressed)

    def _supply(self, on):
        self.boards.suffered = True  # nobody tells the firmware: it goes on for a while
        self.boards.call('radio_power', DONGLE, on)
