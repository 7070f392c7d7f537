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
"""Emulator of dongle, radio channel, robot board and plant: timed bytes in, timed bytes out."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
import math
import random
import string

from t3mpc_ros.emulator.dongle import Dongle
from t3mpc_ros.emulator.event_queue import MICROSECOND
from t3mpc_ros.emulator.fault_injection import Fault, FaultInjection
from t3mpc_ros.emulator.nrf24_radio import Medium, RadioChannel, RadioParameters
from t3mpc_ros.emulator.plant import Plant
from t3mpc_ros.emulator.robot_board import RadioSettings, RobotBoard
from t3mpc_ros.emulator.serial_line import SerialLine
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter
from t3mpc_ros.radio.protocol.frames import RATES, Command
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters

_EXTERNAL_RESET, _BROWN_OUT_RESET = 2, 4  # reset flags as in the MCUSR register of an AVR
_ROBOT_BOOT_LOADER_NS = NANOSECONDS
_CONSOLE_PERIOD_US = 500.0
"""Period at which the board is advanced while its console is busy, to reply in time."""


@dataclass(frozen=True)
class EmulatorParameters(Parameters):
    """Parameters of dongle, radio, robot board and plant."""

    twin: DigitalTwinParameters = group(DigitalTwinParameters)
    robot_clock_error: float = parameter(
        0.0,
        'relative error of the clock of the robot board',
        bounds=(-0.02, 0.02),
        source='ceramic resonators: 0.5 %',
    )
    dongle_boot_time: float = parameter(
        1.5, 'duration of the boot loader of the dongle', 's', (0.0, 10.0)
    )
    channel: int = parameter(
        82, 'channel in the settings of the robot: 2400 MHz plus this', 'MHz', (0, 125)
    )
    rate: str = parameter('1M', 'bit rate in the settings of the robot', choices=RATES)
    address: str = parameter(
        '54334d5043', 'address in the settings of the robot, 10 hexadecimal digits'
    )

    def check_consistency(self) -> None:
        """Raise ParameterError if the plant does not suit the board."""
        if len(self.address) != 10 or set(self.address.lower()) - set(string.hexdigits):
            raise ParameterError(f'address must be 10 hexadecimal digits: got {self.address!r}')
        twin = self.twin
        if twin.drive.kind != 'stepper':
            raise ParameterError(f'twin.drive.kind must be stepper: got {twin.drive.kind}')
        if twin.motor.microsteps != 16 or twin.motor.full_steps != 200:
            raise ParameterError(
                'twin.motor must have 16 microsteps and 200 full steps, the values with which the '
                f'board boots: got {twin.motor.microsteps} and {twin.motor.full_steps}'
            )


class Emulator:
    """A dongle on a serial line and a robot in its radio range, in virtual time.

    At ``now_ns`` both boards have booted and the robot is at rest. ``erased``: its EEPROM
    holds neither settings nor a key. ``seed`` is that of all but the plant. With a ``medium``,
    other emulators are in range, and ``now_ns`` is its time.
    FirmwareLibraryError: there is no C compiler, for example.
    """

    def __init__(
        self,
        parameters: EmulatorParameters,
        key: bytes = b'',
        seed: int = 1,
        now_ns: int = 0,
        erased: bool = False,
        medium: Medium | None = None,
    ) -> None:
        self._parameters = parameters
        medium = medium or Medium(now_ns)
        self._events = medium.events
        self._start_ns = now_ns = self._events.now_ns
        self.faults = FaultInjection(lambda: self._events.now_ns, seed)
        self._clock_rate = 1.0 + parameters.robot_clock_error
        self.plant = Plant(parameters.twin, self._clock_rate)
        rate = RATES.index(parameters.rate)
        self._channel = RadioChannel(
            medium,
            RadioParameters(channel=parameters.channel, rate=rate),
            self._advance_robot,
            lambda payload: self.board.receive(payload),
            self.faults,
            random.Random(f'air {seed}'),
        )
        self.board = RobotBoard(
            self.plant,
            key,
            random.Random(f'nonces {seed}').getrandbits(32),
            self._channel.load,
            rate,
            None if erased else parameters.channel,
            bytes.fromhex(parameters.address),
        )
        self.board.on_settings = self._follow_settings
        self._follow_settings(self.board.radio_settings)
        self._boot_ns = now_ns
        self.powered = True  # whether the robot board runs: with power, behind its boot loader
        self.dongle = Dongle(
            self._events,
            self._channel,
            lambda: not self.faults.active('radio_dead'),
            lambda data: self._to_host.send(data),
        )
        self._from_host = SerialLine(self._events, self.faults, self.dongle.feed)
        self._to_host = SerialLine(self._events, self.faults, self._deliver_to_host)
        self._host_input: list[tuple[int, bytes]] = []
        # Faults of the serial line act on the dongle's line, not on the console's.
        no_faults = FaultInjection(lambda: self._events.now_ns, seed)
        self._to_console = SerialLine(self._events, no_faults, self._deliver_to_console)
        self._from_console = SerialLine(self._events, no_faults, self._deliver_from_console)
        self._console_output: list[tuple[int, bytes]] = []
        self.board.on_console = self._from_console.send
        self.port_open = True  # whether the dongle is plugged in
        self.port_number = 0
        """Number of the device; increments when the dongle changes its device name."""

    @property
    def now_ns(self) -> int:
        """Virtual time up to which all events have run."""
        return self._events.now_ns

    @property
    def next_ns(self) -> int | None:
        """Time of the next event; None: no event is scheduled."""
        return self._events.next_ns

    # -- serial line ------------------------------------------------------------------------------

    def feed(self, data: bytes, now_ns: int) -> None:
        """Send bytes from the host to the dongle at this time."""
        self._events.run_to(now_ns)
        if self.port_open:
            self._from_host.send(data)

    def run_to(self, now_ns: int) -> list[tuple[int, bytes]]:
        """Advance to a time; return the blocks that reached the host, with arrival times."""
        self._events.run_to(now_ns)
        self._advance_robot()
        received, self._host_input = self._host_input, []
        return received

    def _deliver_to_host(self, data: bytes) -> None:
        if self.port_open:
            self._host_input.append((self._events.now_ns, data))

    # -- USB console of the robot board -----------------------------------------------------------

    def feed_console(self, data: bytes, now_ns: int) -> None:
        """Send bytes to the USB console of the robot board at this time."""
        self._events.run_to(now_ns)
        self._to_console.send(data)

    def take_console(self) -> list[tuple[int, bytes]]:
        """Return the blocks that the console has sent, with arrival times."""
        sent, self._console_output = self._console_output, []
        return sent

    def restart_robot(self) -> None:
        """Reboot the robot board, as most boards do when their port is opened."""
        if self.powered:
            self._to_console.clear()
            self._from_console.clear()
            self._cut_power()
            self._events.schedule(
                self._events.now_ns + _ROBOT_BOOT_LOADER_NS,
                lambda: self._boot_robot(_EXTERNAL_RESET),
            )

    def _deliver_to_console(self, data: bytes) -> None:
        if self._advance_robot():
            self.board.feed_console(data)
            self._await_console()

    def _await_console(self) -> None:
        def advance() -> None:
            if self._advance_robot():
                self._await_console()

        if self.board.busy:
            self._events.schedule_after(_CONSOLE_PERIOD_US, advance)

    def _deliver_from_console(self, data: bytes) -> None:
        self._console_output.append((self._events.now_ns, data))

    # -- faults -----------------------------------------------------------------------------------

    def schedule_fault(self, fault: Fault) -> None:
        """Schedule a fault; its start counts from the start of the emulator."""
        self._schedule_fault(fault, self._start_ns)

    def inject(self, name: str, duration: float = math.nan, value: float = math.nan) -> None:
        """Begin a fault now."""
        self._schedule_fault(Fault(name, 0.0, duration, value), self._events.now_ns)
        self._events.run_to(self._events.now_ns)

    def end_fault(self, name: str) -> None:
        """End all faults of a kind now."""
        self.faults.clear(name)
        self._effects(name)[1]()

    def _schedule_fault(self, fault: Fault, start_ns: int) -> None:
        interval = self.faults.add(fault, start_ns)
        begin, end = self._effects(fault.name)
        self._events.schedule(interval.start_ns, begin)
        if math.isfinite(interval.end_ns):
            self._events.schedule(round(interval.end_ns), end)

    def _effects(self, name: str) -> tuple[Callable[[], None], Callable[[], None]]:
        """Return the actions at the begin and at the end of a fault."""
        if name == 'robot_reset':
            return self._cut_power, lambda: self._boot_robot(_EXTERNAL_RESET)
        if name in ('dongle_reset', 'move_link'):
            return partial(self._reset_dongle, name == 'move_link'), lambda: None
        switches: dict[str, Callable[[bool], None]] = {
            'imu_absent': partial(self._set_plant, 'imu_absent'),
            'battery_wire': partial(self._set_plant, 'battery_wire_broken'),
            'button': self._press_button,
            'close_port': self._unplug,
        }
        # The components query the other faults while they are active.
        switch = switches.get(name, lambda on: None)
        return partial(switch, True), partial(switch, False)

    def restart_dongle(self) -> None:
        """Reboot the dongle, as most boards do when their port is opened."""
        self._from_host.clear()
        self._to_host.clear()
        self.dongle.boot(_EXTERNAL_RESET, round(self._parameters.dongle_boot_time * NANOSECONDS))

    def _reset_dongle(self, moves: bool) -> None:
        self.port_number += moves
        self.restart_dongle()

    def _unplug(self, out: bool) -> None:
        self.port_open = not out
        self._host_input.clear()
        self.restart_dongle()

    def _set_plant(self, name: str, value: bool) -> None:
        self._advance_robot()
        setattr(self.plant, name, value)
        self.board.sense()

    def _press_button(self, pressed: bool) -> None:
        self._advance_robot()
        self.board.press_button(pressed)

    def _follow_settings(self, settings: RadioSettings) -> None:
        self._channel.robot = self._channel.robot._replace(**settings._asdict())

    # -- robot ------------------------------------------------------------------------------------

    def _advance_robot(self) -> bool:
        """Advance the robot to now; return whether its board runs."""
        elapsed = self._events.now_ns - self._boot_ns
        time_us = int(elapsed * self._clock_rate) // MICROSECOND
        if not self.powered:
            self.plant.run(time_us)
            self._boot_ns = self._events.now_ns
            return False
        self.board.run_to(time_us)
        if self.plant.undervoltage:
            self._lose_power()
            self._boot_later(_BROWN_OUT_RESET)
            return False
        return True

    def _boot_later(self, cause: int) -> None:
        boot_ns = round(self._parameters.twin.boot_time * NANOSECONDS)
        self._events.schedule(self._events.now_ns + boot_ns, lambda: self._boot_robot(cause))

    def _cut_power(self) -> None:
        self._advance_robot()
        self._lose_power()

    def _lose_power(self) -> None:
        self.powered = False
        self._boot_ns = self._events.now_ns
        self._channel.clear()
        self.plant.set_motors(False, False)

    def _boot_robot(self, cause: int) -> None:
        if self.powered:
            return
        self._advance_robot()
        if self.plant.undervoltage:
            self._boot_later(cause)
            return
        self.powered = True
        self._boot_ns = self._events.now_ns
        self.board.boot(cause)


class StopTimeMonitor:
    """Measures the time from the last command to standstill, unless standstill was commanded.

    Stops after silence, reset, emergency stop and shutdown of the host are measured. It takes
    over ``on_command`` of the board.
    """

    def __init__(self, emulator: Emulator) -> None:
        self._plant = emulator.plant
        self._command: Command | None = None
        self._command_time = 0.0
        emulator.board.on_command = self._on_command

    def poll(self) -> str:
        """Return a report if the wheels have stopped since the last call, else an empty text."""
        command, stopped = self._command, self._plant.stopped_at
        if command is None or stopped is None or stopped < self._command_time:
            return ''
        self._command = None
        if not command.left and not command.right:
            return ''
        right, left = command.right / 1000.0, command.left / 1000.0
        return (
            f'wheels at rest {stopped - self._command_time:.3f} s after the last command '
            f'(right {right:g}, left {left:g} rad/s)'
        )

    def _on_command(self, now_us: int, command: Command) -> None:
        self._command, self._command_time = command, self._plant.elapsed
