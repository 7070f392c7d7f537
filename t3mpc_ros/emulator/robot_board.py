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
"""Robot board: the C core of its firmware between radio channel, USB console and plant.

All rules of the board (docs/radio.md) are in the core; here are its clock, its EEPROM and what it
exchanges with its surroundings.
"""

from collections.abc import Callable
import ctypes
from typing import NamedTuple

from t3mpc_ros.emulator.firmware_library import Board, Motion
from t3mpc_ros.emulator.plant import Plant
from t3mpc_ros.radio.protocol.codec import decode_downlink
from t3mpc_ros.radio.protocol.frames import PAYLOAD_LIMIT, Command, StatusFlag

CELL_US = 3_400  # time to erase and write one EEPROM cell of an AVR
UNPOWERED_US = 20_000
"""Longest time between two samples of the sensors while the motors have no power."""
_LEFT, _RIGHT = 0, 1
_USB_ROOM = 4096
_DEFAULT_MICROSTEPS = 16
_ADDRESS_SIZE = 5
_Registers, _Counts = ctypes.c_int16 * 7, ctypes.c_uint16 * 9


class RadioSettings(NamedTuple):
    """Settings of the transceiver that the robot board holds in its EEPROM."""

    channel: int
    rate: int
    address: bytes


class RobotBoard:
    """The robot board with its firmware.

    ``load`` loads the payload that the next packet fetches. ``noise`` is the start (32 bits)
    of what the board takes for noise, for nonces only. ``rate`` and ``channel`` are in the
    settings, as in CFG; without a channel the EEPROM is blank.
    """

    def __init__(
        self,
        plant: Plant,
        key: bytes,
        noise: int,
        load: Callable[[bytes], None],
        rate: int,
        channel: int | None,
        address: bytes = b'T3MPC',
    ) -> None:
        self._plant = plant
        self._load = load
        self._board = Board('robot')
        call = self._board.call
        if channel is None:
            call('erase')
        else:
            call('store_settings', channel, _DEFAULT_MICROSTEPS, address)
            call('store_rate', rate)
        if key:
            call('store_key', key)
        call('set_cell_us', CELL_US)
        call('set_noise', noise)
        self._motion = Motion()
        self._by_reference = ctypes.byref(self._motion)
        self._payload = ctypes.create_string_buffer(PAYLOAD_LIMIT)
        self._usb = ctypes.create_string_buffer(_USB_ROOM)
        self._advance_core = self._board.function('advance')
        # In the memory of the board.
        self._registers = _Registers.from_address(call('imu'))
        self._counts = _Counts.from_address(call('adcs'))
        self._imu_present: bool | None = None
        self._loads = self._setups = 0
        self.on_command: Callable[[int, Command], None] = lambda now_us, command: None
        """Called with time and content of each command that sets the wheel speeds."""
        self.on_settings: Callable[[RadioSettings], None] = lambda settings: None
        """Called with the settings in effect, at boot and after a change."""
        self.on_console: Callable[[bytes], None] = lambda data: None
        """Called with the bytes that the USB console sends."""
        self.boot(1)

    def boot(self, reset_cause: int) -> None:
        """Boot with reset flags as in MCUSR: the RAM is cleared, writes to the EEPROM end."""
        self.now_us = 0  # time since boot, without the wrap to 32 bits
        self.sense()
        self._board.call('boot', reset_cause, 0)
        self._plant.boot(self._board.call('microsteps'))
        self._advance(0)
        self.on_settings(self.radio_settings)

    # -- state ------------------------------------------------------------------------------------

    @property
    def session(self) -> int:
        """Number of the session; 0: none."""
        return int(self._board.call('session'))

    @property
    def status(self) -> StatusFlag:
        """Status flags of the uplink frames."""
        return StatusFlag(self._board.call('status'))

    @property
    def speeds(self) -> tuple[int, int]:
        """Current speeds of the ramp, left first, urad/s."""
        return self._board.call('speed', _LEFT), self._board.call('speed', _RIGHT)

    @property
    def powered(self) -> bool:
        """Whether the motor drivers have power."""
        return bool(self._motion.powered)

    @property
    def counters(self) -> tuple[int, int]:
        """Microsteps issued, left first, as in STATE."""
        return self._board.call('steps', _LEFT), self._board.call('steps', _RIGHT)

    @property
    def stale(self) -> int:
        """Number of commands refused for the age of their echo, as in AUX."""
        return int(self._board.call('stale'))

    @property
    def busy(self) -> bool:
        """Whether the console writes a key or settings, or has a reply to a transaction."""
        return bool(self._board.call('changing'))

    @property
    def radio_settings(self) -> RadioSettings:
        """Settings in effect."""
        address = ctypes.create_string_buffer(_ADDRESS_SIZE)
        self._board.call('address', address)
        return RadioSettings(self._board.call('channel'), self._board.call('rate'), address.raw)

    def read_eeprom(self, address: int, size: int) -> bytes:
        """Return cells of the EEPROM."""
        return bytes(self._board.call('cell', address + index) for index in range(size))

    def write_eeprom(self, address: int, data: bytes) -> None:
        """Overwrite cells of the EEPROM; the firmware reads them at its next boot."""
        for index, value in enumerate(data):
            self._board.call('poke_eeprom', address + index, value)

    # -- time and input ---------------------------------------------------------------------------

    def run_to(self, time_us: int) -> None:
        """Advance board and plant to a time since boot."""
        while self.now_us < time_us:
            # Without power the robot stands: its sensors need not be read at each sample.
            powered = self._motion.powered
            longest = self._plant.until_sample_us if powered else UNPOWERED_US
            self._advance(min(time_us - self.now_us, longest))

    def receive(self, data: bytes) -> None:
        """Process a payload that the radio receives now."""
        if self._board.call('packet', data, min(len(data), 0xFF)):
            command = decode_downlink(data)
            if isinstance(command, Command):
                self.on_command(self.now_us, command)

    def feed_console(self, data: bytes) -> None:
        """Process bytes that the USB console receives now."""
        self._board.call('usb', data, len(data))
        self._advance(0)

    def press_button(self, pressed: bool) -> None:
        """Press or release the emergency stop button."""
        self._board.call('press', pressed)

    def sense(self) -> None:
        """Pass the newest samples of the plant's sensors to the board."""
        sample = self._plant.registers
        if sample is not None:
            self._registers[:] = sample  # type: ignore[call-overload]  # any sequence will do
        if (sample is not None) != self._imu_present:
            self._imu_present = sample is not None
            self._board.call('set_imu', self._imu_present, self._registers)
        self._counts[:] = self._plant.adc_counts  # type: ignore[call-overload]

    def _advance(self, us: int) -> None:
        """Advance by this time, or to the next change of the motors' power or speed."""
        motion = self._motion
        passed = self._advance_core(us, self._by_reference)
        self.now_us += passed
        if self._plant.run(passed, motion.left, motion.right):
            self.sense()
        self._plant.set_motors(motion.powered, motion.turning)
        if motion.loads != self._loads:
            self._loads = motion.loads
            size = self._board.call('ack', self._payload)
            self._load(self._payload.raw[:size])
        if motion.usb_size:
            size = self._board.call('usb_take', self._usb, _USB_ROOM)
            self.on_console(self._usb.raw[:size])
        if motion.setups != self._setups:
            self._setups = motion.setups
            self._plant.boot(self._board.call('microsteps'))
            self.on_settings(self.radio_settings)
