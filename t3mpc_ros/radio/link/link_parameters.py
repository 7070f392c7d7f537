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
"""Parameters of the link: radio, cycle rate, and the parameters of the robot board."""

from dataclasses import dataclass, fields
from typing import ClassVar

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter
from t3mpc_ros.radio.protocol import frames

_GAP_UNIT = 250e-6
_GAPS = {'250k': 2.75e-3, '1M': 1.5e-3, '2M': 1.75e-3}
"""s; at 250k acknowledgements are long, at 2M the tag check takes longer than 1.5 ms."""
_HELLO_GAP = 5e-3  # s; the robot computes four hashes at 16 MHz
TTL_UNIT_NS = NANOSECONDS // 100  # unit of the time to live of a command, ns


@dataclass(frozen=True)
class RobotParameters(Parameters):
    """Board parameters that the host writes at the start of every session.

    Microsteps, steps per revolution and gyro range are set on the board; the host reads them.
    """

    max_speed: float = parameter(
        10.0,
        'maximum wheel speed; the faster wheel sets the scale of both',
        'rad/s',
        (0.0, 19.6),
        source='10 000 microsteps per second at 16 microsteps are 19.6 rad/s',
    )
    acceleration: float = parameter(
        30.0,
        'maximum acceleration of the wheel whose speed changes faster',
        'rad/s²',
        (0.1, 100.0),
    )
    deceleration: float = parameter(
        60.0,
        'the same while stopping: from 10 rad/s to rest within 0.37 s of the last command',
        'rad/s²',
        (0.1, 200.0),
    )
    ttl_max: float = parameter(0.25, 'maximum time to live of a command', 's', (0.02, 0.5))
    battery_low: float = parameter(
        10.2, 'supply voltage below which the robot warns', 'V', (0.0, 30.0)
    )
    battery_cutoff: float = parameter(
        9.0,
        'supply voltage below which the robot stops, until it is above battery_low; 0: none',
        'V',
        (0.0, 30.0),
        source='3 V per Li-ion cell',
    )
    idle_off: float = parameter(
        0.0,
        'standstill after which the drivers switch off, without holding torque; 0: never',
        's',
        (0.0, 600.0),
    )
    invert_left: bool = parameter(False, 'the left motor is mounted or wired in reverse')
    invert_right: bool = parameter(False, 'the right motor is mounted or wired in reverse')

    def to_wire(self) -> dict[int, int]:
        """Return the values on the wire, by id of the board parameter."""
        values = {each.name: round(1000.0 * getattr(self, each.name)) for each in fields(self)}
        values['invert_wheels'] = self.invert_left + 2 * self.invert_right
        return {
            number: values[parameter.name]
            for number, parameter in enumerate(frames.BOARD_PARAMETERS)
            if parameter.name in values
        }


@dataclass(frozen=True)
class LinkParameters(Parameters):
    """Parameters of the radio link on the host."""

    channel: int = parameter(
        82,
        '2400 MHz plus this; 82 is in the band, above Bluetooth advertising, at the edge of Wi-Fi',
        'MHz',
        (0, 125),
        source='nRF24L01+ data sheet 1.0, 6.3',
    )
    rate: str = parameter(
        '1M', 'air data rate, bit/s; 250k only with nRF24L01+ chips', choices=frames.RATES
    )
    power: str = parameter('0', 'transmitter output power, dBm', choices=frames.POWERS)
    retries: ClassVar[int] = 4
    """Retransmissions without an acknowledgement, 0.7 ms each: late commands are worthless."""
    address: str = parameter(
        '54334d5043',
        'address of the robot: 10 hexadecimal digits, last transmitted byte first; this is T3MPC',
    )
    cycle_rate: float = parameter(50.0, 'rate of commands and measurements', 'Hz', (1.0, 100.0))
    ttl: float = parameter(
        0.2, 'time for which the robot follows a command without a newer one', 's', (0.02, 0.5)
    )
    robot: RobotParameters = group(RobotParameters)

    def check_consistency(self) -> None:
        """Raise ParameterError for an invalid address or a TTL unfit for robot or rate."""
        try:
            size = len(bytes.fromhex(self.address))
        except ValueError:
            size = 0
        if size != 5 or len(self.address) != 10:
            raise ParameterError(f'address must be 10 hexadecimal digits: got {self.address!r}')
        if self.ttl > self.robot.ttl_max:
            raise ParameterError(
                f'ttl must be at most robot.ttl_max ({self.robot.ttl_max:g} s): got {self.ttl:g}'
            )
        if self.cycle_rate * self.ttl < 1.0:
            raise ParameterError(
                f'cycle_rate must be at least {1.0 / self.ttl:.4g} Hz, one command within ttl '
                f'({self.ttl:g} s), or the robot stops between two: got {self.cycle_rate:g}'
            )

    @property
    def gap(self) -> int:
        """Gap between CMD and POLL, unit 250 us: the acknowledgement ends within it."""
        return round(_GAPS[self.rate] / _GAP_UNIT)

    def gap_after(self, first: frames.Downlink) -> int:
        """Return the gap after a first packet; it is longer for a signed HELLO."""
        signed = isinstance(first, frames.Hello) and first.tag
        return max(self.gap, round(_HELLO_GAP / _GAP_UNIT)) if signed else self.gap

    @property
    def ttl_units(self) -> int:
        """TTL of a CMD, unit 10 ms."""
        return round(self.ttl * NANOSECONDS / TTL_UNIT_NS)

    def configure(self, number: int) -> frames.Configure:
        """Return the frame that configures the radio of the dongle."""
        # A shorter delay would cut off acknowledgements of 32 bytes (data sheet 7.4.2).
        delay = 5 if self.rate == '250k' else 1
        return frames.Configure(
            number,
            self.channel,
            frames.RATES.index(self.rate),
            frames.POWERS.index(self.power),
            delay,
            self.retries,
            bytes.fromhex(self.address),
        )
