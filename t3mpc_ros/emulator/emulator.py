# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Emulator of dongle, radio channel, robot board and plant: timed bytes in, timed bytes out."""

from collections.abc import Callable
from dataclasses import dataclass
import math
import random

from t3mpc_ros.emulator.board.robot_board import LOOP_US, SETTLE_SLOW_US, SETTLE_US, RobotBoard
from t3mpc_ros.emulator.event_queue import MICROSECOND, EventQueue
from t3mpc_ros.emulator.fault_injection import Fault, FaultInjection
from t3mpc_ros.emulator.link.dongle import Dongle
from t3mpc_ros.emulator.link.radio_channel import RadioChannel, RadioParameters
from t3mpc_ros.emulator.link.serial_line import SerialLine
from t3mpc_ros.emulator.plant import Plant
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter
from t3mpc_ros.radio.protocol.frames import Command
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters

_RATES = ('250k', '1M', '2M')
_POWER_ON, _EXTERNAL, _BROWN_OUT = 1, 2, 4
"""Causes of a reset, as the MCUSR of an AVR has them."""
_BOOT_LOADER_NS = NANOSECONDS
"""Of the robot's board."""


@dataclass(frozen=True)
class EmulatorParameters(Parameters):
    """What can be set of dongle, radio and robot."""

    twin: DigitalTwinParameters = group(DigitalTwinParameters)
    robot_clock: float = parameter(
        0.0,
        "by how much the robot's clock is fast; the resonator of a small board may be off by this",
        low=-0.02,
        high=0.02,
        source='ceramic resonators: 0.5 %',
    )
    dongle_start: float = parameter(
        1.5, 'how long the boot loader of the dongle takes', unit='s', low=0.0, high=10.0
    )
    channel: int = parameter(82, 'of the robot: 2400 MHz plus this', unit='MHz', low=0, high=125)
    rate: str = parameter('1M', 'bits per second of the robot in the air', choices=_RATES)

    def check_consistency(self) -> None:
        """Raise ParameterError when the robot would not be the one the board is made for."""
        twin = self.twin
        if twin.drive.kind != 'stepper':
            raise ParameterError(f'twin.drive.kind must be stepper: got {twin.drive.kind}')
        if twin.motor.microsteps != 16 or twin.motor.full_steps != 200:
            raise ParameterError(
                'twin.motor must have 16 microsteps and 200 full steps, which is what the board '
                f'starts with: got {twin.motor.microsteps} and {twin.motor.full_steps}'
            )


class Emulator:
    """A dongle on a serial line, and a robot that hears it, in virtual time.

    Parameters
    ----------
    settings
        Fixed for its life.
    key
        Of the robot, 16 bytes; empty for an open link.
    seed
        Of all dice but those of the twin.
    now_ns
        The start: both boards are ready, the robot stands.
    """

    def __init__(
        self,
        parameters: EmulatorParameters,
        key: bytes = b'',
        seed: int = 1,
        now_ns: int = 0,
    ) -> None:
        self._parameters = parameters
        self._start_ns = now_ns
        self._events = EventQueue(now_ns)
        self.faults = FaultInjection(lambda: self._events.now_ns, seed)
        self._rate = 1.0 + parameters.robot_clock
        self.plant = Plant(parameters.twin, self._rate)
        nonces = random.Random(f'nonces {seed}')
        self._channel = RadioChannel(
            self._events,
            RadioParameters(channel=parameters.channel, rate=_RATES.index(parameters.rate)),
            self._wake_robot,
            lambda payload: self.board.packet(payload),
            self.faults,
            random.Random(f'air {seed}'),
        )
        settle_us = SETTLE_SLOW_US if parameters.rate == '250k' else SETTLE_US
        self.board = RobotBoard(self.plant, key, nonces.randbytes, self._channel.load, settle_us)
        self._boot_ns = now_ns
        self._away = False
        """The robot has no power."""
        self.dongle = Dongle(
            self._events, self._channel, self._chip_ok, lambda data: self._to_host.send(data)
        )
        self._from_host = SerialLine(self._events, self.faults, self.dongle.feed)
        self._to_host = SerialLine(self._events, self.faults, self._arrive)
        self._arrived: list[tuple[int, bytes]] = []
        # The faults of the line are those of the dongle's.
        sound = FaultInjection(lambda: self._events.now_ns, seed)
        self._from_cable = SerialLine(self._events, sound, self._tell_console)
        self._to_cable = SerialLine(self._events, sound, self._arrive_by_cable)
        self._said: list[tuple[int, bytes]] = []
        self.board.console.reply = self._to_cable.send
        self.port_open = True
        """Whether there is a dongle to open."""
        self.port_name = 0
        """Counts up when the device comes back under another name."""

    @property
    def now_ns(self) -> int:
        """Up to when everything has happened."""
        return self._events.now_ns

    @property
    def next_ns(self) -> int | None:
        """When something happens next; None: nothing will."""
        return self._events.next_ns

    @property
    def powered(self) -> bool:
        """Whether the robot is on."""
        return not self._away

    # -- the line ---------------------------------------------------------------------------------

    def feed(self, data: bytes, now_ns: int) -> None:
        """Take what the host writes at this time."""
        self._events.run_to(now_ns)
        if self.port_open:
            self._from_host.send(data)

    def run_to(self, now_ns: int) -> list[tuple[int, bytes]]:
        """Return what has come to the host by then, each piece with its time of arrival."""
        self._events.run_to(now_ns)
        self._wake_robot()
        arrived, self._arrived = self._arrived, []
        return arrived

    def _arrive(self, data: bytes) -> None:
        if self.port_open:
            self._arrived.append((self._events.now_ns, data))

    # -- the USB of the robot ---------------------------------------------------------------------

    def feed_console(self, data: bytes, now_ns: int) -> None:
        """Take what somebody writes to the robot's own USB at this time."""
        self._events.run_to(now_ns)
        self._from_cable.send(data)

    def take_console(self) -> list[tuple[int, bytes]]:
        """Return what has come from the robot's own USB by now, each piece with its time."""
        said, self._said = self._said, []
        return said

    def restart_robot(self) -> None:
        """Start the robot anew, as opening its own port does to many boards."""
        if not self._away:
            self._from_cable.clear()
            self._to_cable.clear()
            self._cut_power()
            self._events.at(
                self._events.now_ns + _BOOT_LOADER_NS, lambda: self._boot_robot(_EXTERNAL)
            )

    def _tell_console(self, data: bytes) -> None:
        if not self._wake_robot():
            return
        self.board.console.feed(data)
        if (written_us := self.board.slot.due_us) is not None:
            # A loop of the board later, by a clock that may be slow.
            later_us = 1.02 * (written_us - self.board.now_us) + LOOP_US
            self._events.after_us(later_us, lambda: _ignore(self._wake_robot()))

    def _arrive_by_cable(self, data: bytes) -> None:
        self._said.append((self._events.now_ns, data))

    # -- what goes wrong --------------------------------------------------------------------------

    def play(self, fault: Fault) -> None:
        """Let a fault happen; its time counts from the start of the emulator.

        Raises
        ------
        FaultError
            There is no such fault, or a number is out of range.
        """
        self._play(fault, self._start_ns)

    def inject(self, name: str, duration: float = math.nan, value: float = math.nan) -> None:
        """Let a fault begin now."""
        self._play(Fault(name, 0.0, duration, value), self._events.now_ns)
        self._events.run_to(self._events.now_ns)

    def end(self, name: str) -> None:
        """End a fault now, however long it was meant to last."""
        self.faults.clear(name)
        self._effects(name)[1]()

    def _play(self, fault: Fault, start_ns: int) -> None:
        span = self.faults.add(fault, start_ns)
        begins, ends = self._effects(fault.name)
        self._events.at(span.start_ns, begins)
        if math.isfinite(span.end_ns):
            self._events.at(round(span.end_ns), ends)

    def _effects(self, name: str) -> tuple[Callable[[], None], Callable[[], None]]:
        """Return what the begin and the end of a fault do at once."""
        effects = {
            'robot_reset': (self._cut_power, lambda: self._boot_robot(_EXTERNAL)),
            'imu_absent': (lambda: self._imu(True), lambda: self._imu(False)),
            'button': (lambda: self._press(True), lambda: self._press(False)),
            'dongle_reset': (self.restart_dongle, _nothing),
            'close_port': (self._pull_out, self._plug_in),
            'move_link': (self._move_link, _nothing),
        }
        return effects.get(name, (_nothing, _nothing))

    def restart_dongle(self) -> None:
        """Start the dongle anew, as opening its port does to many boards."""
        self._from_host.clear()
        self._to_host.clear()
        self.dongle.boot(_EXTERNAL, round(self._parameters.dongle_start * NANOSECONDS))

    def _pull_out(self) -> None:
        self.port_open = False
        self._arrived.clear()
        self.restart_dongle()

    def _plug_in(self) -> None:
        self.port_open = True
        self.restart_dongle()

    def _move_link(self) -> None:
        self.port_name += 1
        self.restart_dongle()

    def _imu(self, absent: bool) -> None:
        self._wake_robot()
        self.plant.imu_absent = absent

    def _press(self, pressed: bool) -> None:
        self._wake_robot()
        self.board.press(pressed)

    def _chip_ok(self) -> bool:
        return not self.faults.active('radio_dead')

    # -- the robot --------------------------------------------------------------------------------

    def _wake_robot(self) -> bool:
        """Bring the robot to this instant; return whether it listens."""
        elapsed = self._events.now_ns - self._boot_ns
        time_us = int(elapsed * self._rate) // MICROSECOND
        if self._away:
            self.plant.run(time_us)
            self._boot_ns = self._events.now_ns
            return False
        self.board.run_to(time_us)
        if self.plant.collapsed:
            self._lose_power()
            away = round(self._parameters.twin.boot_time * NANOSECONDS)
            self._events.at(self._events.now_ns + away, lambda: self._boot_robot(_BROWN_OUT))
            return False
        return True

    def _cut_power(self) -> None:
        self._wake_robot()
        self._lose_power()

    def _lose_power(self) -> None:
        self._away = True
        self._boot_ns = self._events.now_ns
        self._channel.clear()
        self.plant.turn(0, 0)
        self.plant.power(False)

    def _boot_robot(self, cause: int) -> None:
        if not self._away:
            return
        self._wake_robot()
        if self.plant.collapsed:
            again = self._events.now_ns + round(self._parameters.twin.boot_time * NANOSECONDS)
            self._events.at(again, lambda: self._boot_robot(cause))
            return
        self._away = False
        self._boot_ns = self._events.now_ns
        self.board.boot(cause)


def _ignore(awake: bool) -> None:
    """Take no notice of whether the robot is awake."""


def _nothing() -> None:
    """Do nothing: most faults are looked up when they matter."""


class StopTimeMonitor:
    """Tells each stop but those for which a speed of zero was commanded.

    So after silence, a reset, an emergency stop, and when a host takes its leave.

    Parameters
    ----------
    emulator
        Its board tells of each command that it follows.
    """

    def __init__(self, emulator: Emulator) -> None:
        self._plant = emulator.plant
        self._command: Command | None = None
        self._followed = 0.0
        emulator.board.followed = self._follow

    def news(self) -> str:
        """Return a line when the wheels have come to rest since the last call, else nothing."""
        command, stopped = self._command, self._plant.stopped_at
        if command is None or stopped is None or stopped < self._followed:
            return ''
        self._command = None
        if not command.left and not command.right:
            return ''
        right, left = command.right / 1000.0, command.left / 1000.0
        return (
            f'wheels at rest {stopped - self._followed:.3f} s after the last command '
            f'(right {right:g}, left {left:g} rad/s)'
        )

    def _follow(self, now_us: int, command: Command) -> None:
        self._command, self._followed = command, self._plant.elapsed
