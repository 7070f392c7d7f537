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
"""The real firmware of both boards in simavr, with the interface of the Python emulator.

The serial line is that of the emulator; the boards are not. Their step pulses drive the digital
twin, and the values of its sensors are applied to the pins of the robot board.
"""

from contextlib import contextmanager
from functools import cache
import math
import subprocess
import tempfile

import numpy as np

from support.avr_boards import DONGLE, FIRMWARE, ROBOT, booted
from support.emulator_bench import Bench
from t3mpc_ros.emulator.emulator import EmulatorParameters
from t3mpc_ros.emulator.event_queue import EventQueue
from t3mpc_ros.emulator.fault_injection import Fault, FaultInjection
from t3mpc_ros.emulator.plant import Plant, Registers
from t3mpc_ros.emulator.serial_line import SerialLine
from t3mpc_ros.geometry.types import RANGE_SENSORS
from t3mpc_ros.radio.protocol.codec import decode_downlink
from t3mpc_ros.radio.protocol.frames import Command
from t3mpc_ros.radio.protocol.framing import FrameDecoder, crc16
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.simulation.sensors.range_sensor import output_voltage
from t3mpc_ros.simulation.world import cast_rays, load_world

START_NS = 5_000_000_000
KEY_ADDRESS = 8
BOOT_US = 130_000.0
SLICE_US = 200.0  # period at which the boards are polled
PLANT_US = 5000.0  # period of the plant and of its sensors
FIELDS = (
    'seq', 'ttl_from_us', 'session.id', 'counters.stale', 'ramp.speed', 'ramp.target', 'loaded_us',
    'longest_us',
)  # fmt: skip


@cache
def field_offsets():
    """Return the offset of each field of the firmware's robot structure, from the compiler."""
    lines = [
        f'char at_{name.replace(".", "_")}[offsetof(struct t3_robot, {name}) + 1];'
        for name in FIELDS
    ]
    source = '\n'.join(['#include <stddef.h>', '#include "t3_robot.h"', *lines])
    with tempfile.NamedTemporaryFile(suffix='.o') as made:
        options = f'-mmcu=atmega2560 -fno-common -I{FIRMWARE}/core -c -xc - -o {made.name}'
        command = ['avr-gcc', *options.split()]
        subprocess.run(command, input=source, text=True, check=True)
        table = subprocess.run(
            ['avr-nm', '-S', made.name], capture_output=True, text=True, check=True
        )
    rows = [line.split() for line in table.stdout.splitlines()]
    sizes = {row[3]: int(row[1], 16) - 1 for row in rows if len(row) == 4}
    return {name: sizes[f'at_{name.replace(".", "_")}'] for name in FIELDS}


@contextmanager
def on_avr(bench=Bench, **given):
    """Yield a bench with both boards in simavr; check the boards at the end."""
    parameters = {name: given.pop(name) for name in ('flat', 'seed') if name in given}
    erased = given.pop('erased', False)
    with contextmanager(booted)(parameters.get('seed', 1), erased) as boards:
        emulator = AvrEmulator(boards, key=given.get('key', b''), **parameters)
        yield bench(emulator=emulator, **given)


class Ram:
    """Variables of the robot firmware, read and written while it runs."""

    def __init__(self, boards):
        self._boards = boards
        self._base = boards.symbol(ROBOT, 'robot')
        self._offsets = field_offsets()

    def get(self, name, size, index=0, signed=False):
        at = self._base + self._offsets[name] + index * size
        data = bytes(self._boards.call('peek', ROBOT, at + i) for i in range(size))
        return int.from_bytes(data, 'little', signed=signed)

    def put(self, name, value, size=4):
        at = self._base + self._offsets[name]
        for i, byte in enumerate(value.to_bytes(size, 'little')):
            self._boards.call('poke', ROBOT, at + i, byte)


class AvrBoard:
    """The robot firmware, with the interface of ``RobotBoard``."""

    def __init__(self, boards):
        self._boards = boards
        self.ram = Ram(boards)
        self.on_command = lambda now_us, command: None

    @property
    def session(self):
        return self.ram.get('session.id', 1)

    @property
    def speeds(self):
        """Speeds of the ramp, urad/s."""
        return tuple(self.ram.get('ramp.speed', 4, wheel, True) for wheel in (0, 1))

    @property
    def counters(self):
        return self._boards.pulses()

    @property
    def stale(self):
        return self.ram.get('counters.stale', 2)

    def receive(self, data):
        """Inject a packet into the radio of the robot."""
        assert self._boards.call('inject', data, len(data), len(data))


class AvrEmulator:
    """Dongle and robot in simavr; plant and serial line in Python."""

    def __init__(self, boards, flat=None, key=b'', seed=1):
        self.boards = boards
        parameters = EmulatorParameters.from_dict(flat or {})
        self._parameters = parameters
        if key:
            boards.store(KEY_ADDRESS, key + crc16(key).to_bytes(2, 'little'))
        self.plant = Plant(parameters.twin)
        self.plant.boot(parameters.twin.motor.microsteps)
        self._world = load_world(parameters.twin.world)
        self._mounts = sensor_mounts(parameters.twin.range_sensor)
        self.distances = np.full(len(RANGE_SENSORS), math.inf)
        """Distance in front of each range sensor, m."""
        self._plant_us = 0.0
        self._pulses = (0, 0)
        self.board = AvrBoard(boards)
        self._ttl_from_us = self._ttl_start_us = 0
        self._events = EventQueue(START_NS)
        self.faults = FaultInjection(lambda: self._events.now_ns, seed)
        self._radio_faults = (0.0, 0.0, False)
        self._to_dongle = SerialLine(self._events, self.faults, self._write, 0)
        self._to_host = SerialLine(self._events, self.faults, self._deliver, 0)
        self._piece = b''
        self._console = FrameDecoder()
        self._drives_over_cable = False
        """Whether the last command came over the USB of the robot board."""
        self._host_input = []
        self.port_open = True
        self._dongle_ready_ns = START_NS
        self._update_plant(0.0)
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

    # -- serial line ------------------------------------------------------------------------------

    def feed(self, data, now_ns):
        self.run_until(now_ns)
        self._drives_over_cable = False
        if self.port_open:
            self._to_dongle.send(data)
            self._events.run_to(now_ns)

    def feed_console(self, data, now_ns):
        """Send bytes to the USB console of the robot board at this time."""
        self.run_until(now_ns)
        self._drives_over_cable |= any(frame[0] == 1 for frame in self._console.feed(data))
        self.boards.call('usb_write', data, len(data))

    def take_console(self):
        """Return the bytes that the console has sent, with the current time."""
        data, _ = self.boards.received('usb_read')
        return [(self.now_ns, data)] if data else []

    def run_to(self, now_ns):
        self.run_until(now_ns)
        received, self._host_input = self._host_input, []
        return received

    def run_until(self, now_ns):
        while self._events.now_ns < now_ns:
            until_ns = min(self._events.now_ns + round(SLICE_US * 1000), now_ns)
            self._apply_radio_faults()
            self._run((until_ns - self._offset_ns) / 1000 - self.boards.now_us)
            self._report_command()
            self._read()
            self._events.run_to(until_ns)

    def _run(self, us):
        self.boards.run_until(self.boards.now_us + us)
        elapsed = self.boards.now_us - self._plant_us
        if elapsed >= PLANT_US:
            self._plant_us = self.boards.now_us
            self._update_plant(elapsed)

    def _write(self, data):
        if self.now_ns >= self._dongle_ready_ns:
            self.boards.write(data)

    def _read(self):
        """Forward whole frames, like the emulator."""
        *pieces, self._piece = (self._piece + self.boards.received()[0]).split(b'\0')
        for piece in pieces:
            if self.now_ns >= self._dongle_ready_ns:
                self._to_host.send(piece + b'\0')

    def _deliver(self, data):
        if self.port_open:
            self._host_input.append((self.now_ns, data))

    # -- robot ------------------------------------------------------------------------------------

    def _report_command(self):
        """Report a command that sets the wheel speeds: the last packet that was received.

        One poll after its time stamp has changed: the firmware may be interrupted in between.
        """
        before, self._ttl_start_us = self._ttl_start_us, self.board.ram.get('ttl_from_us', 4)
        if self._ttl_start_us != before or self._ttl_start_us in (self._ttl_from_us, 0):
            return
        self._ttl_from_us = self._ttl_start_us
        if self._drives_over_cable:
            return  # the packet below is one of the radio
        command = decode_downlink(self.boards.last_packet())
        assert isinstance(command, Command)
        assert command.seq == self.board.ram.get('seq', 1)
        target = [self.board.ram.get('ramp.target', 4, wheel, True) for wheel in (0, 1)]
        assert target == [1000 * command.left, 1000 * command.right]
        self.board.on_command(self._ttl_start_us, command)

    def _update_plant(self, elapsed_us):
        """Advance the plant by the step pulses, and apply its sensor values to the pins."""
        boards, plant = self.boards, self.plant
        pulses = boards.pulses()
        if elapsed_us:
            left, right = (
                float(after - before) for before, after in zip(self._pulses, pulses, strict=True)
            )
            plant.set_motors(self.powered, left != 0.0 or right != 0.0)
            plant.run(round(elapsed_us), left, right)
        self._pulses = pulses
        registers = plant.registers
        boards.imu(registers is not None, registers or Registers())
        battery = plant.adc_counts[-1] * 5000 // 1024
        boards.call('millivolts', len(RANGE_SENSORS), battery)
        if self._world.segments.size or self._world.circles.size:
            sensors = np.arange(len(RANGE_SENSORS))
            walls = self._world.segments, self._world.circles
            cast_rays(*plant.pose, self._mounts, sensors, *walls, self.distances)
        for channel, distance in enumerate(self.distances):
            boards.call('millivolts', channel, round(1000.0 * output_voltage(distance)))

    # -- faults -----------------------------------------------------------------------------------

    def inject(self, name, duration=math.nan, value=math.nan):
        """Begin a fault of the emulator now."""
        interval = self.faults.add(Fault(name, 0.0, duration, value), self.now_ns)
        begin, end = self._effects(name)
        begin()
        if math.isfinite(interval.end_ns):
            self._events.schedule(round(interval.end_ns), end)

    def end_fault(self, name):
        self.faults.clear(name)
        self._effects(name)[1]()

    def _effects(self, name):
        def no_action():
            pass

        effects = {
            'robot_reset': (self._reset_robot, self._reset_robot),
            'imu_absent': (lambda: self._set_imu(False), lambda: self._set_imu(True)),
            'button': (lambda: self._press_button(True), lambda: self._press_button(False)),
            'dongle_reset': (self.restart_dongle, no_action),
            'close_port': (self._unplug, self._plug_in),
            'radio_dead': (lambda: self._power_radio(False), lambda: self._power_radio(True)),
        }
        return effects.get(name, (no_action, no_action))

    def _apply_radio_faults(self):
        faults = self.faults
        values = (
            faults.combined_probability('loss', 'loss_down'),
            faults.combined_probability('loss', 'loss_up'),
            faults.active('jam'),
        )
        if values != self._radio_faults:
            self._radio_faults = values
            self.boards.call('loss', *values[:2])
            self.boards.call('jam', values[2])

    def restart_dongle(self):
        """Reset the dongle, followed by a boot loader that ignores all input."""
        self._to_dongle.clear()
        self._to_host.clear()
        self._piece = b''
        self.boards.call('reset', DONGLE)
        self._dongle_ready_ns = self.now_ns + round(self._parameters.dongle_boot_time * 1e9)

    def _unplug(self):
        self.port_open = False
        self._host_input.clear()
        self.restart_dongle()

    def _plug_in(self):
        self.port_open = True
        self.restart_dongle()

    def _reset_robot(self):
        self.boards.call('reset', ROBOT)

    def _set_imu(self, present):
        self.plant.imu_absent = not present
        self._update_plant(0.0)

    def _press_button(self, pressed):
        self.boards.call('press', pressed)

    def _power_radio(self, on):
        self.boards.rules_broken = True  # the firmware does not notice at once
        self.boards.call('radio_power', DONGLE, on)
