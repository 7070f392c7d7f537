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
"""Source of the schematics of docs/hardware.md: parts, their pins and nets, and the drawings.

``python docs/schematic.py`` writes ``docs/images/schematic_*.svg`` with the library schemdraw.
"""

from dataclasses import dataclass
import itertools
from pathlib import Path

IMAGES = Path(__file__).resolve().parent / 'images'

Point = tuple[float, float]
Pins = tuple[tuple[str, str], ...]
"""Name of the pin, and its net; '' is not connected."""


@dataclass(frozen=True)
class Part:
    """A part with its pins, in the order of the drawing."""

    name: str
    left: Pins = ()
    right: Pins = ()
    width: float = 4.0

    def nets(self) -> dict[str, str]:
        """Return the net of each pin."""
        return dict(self.left + self.right)


MEGA = Part(
    'robot board\nArduino Mega 2560',
    left=(
        ('52 SCK', 'SCK'),
        ('51 MOSI', 'MOSI'),
        ('50 MISO', 'MISO'),
        ('53', 'CSN'),
        ('10', 'CE'),
        ('2', 'IRQ'),
        ('20 SDA', 'SDA'),
        ('21 SCL', 'SCL'),
        ('3', 'ESTOP'),
        ('A8', 'BATTERY'),
        ('11', 'BUZZER'),
        ('5V', '+5V'),
        ('GND', 'GND'),
        ('3.3V', '+3V3'),
        ('VIN', ''),
    ),
    right=(
        ('22', 'STEP_L'),
        ('24', 'DIR_L'),
        ('23', 'STEP_R'),
        ('25', 'DIR_R'),
        ('26', 'ENABLE'),
        ('A0', 'RANGE_0'),
        ('A1', 'RANGE_1'),
        ('A2', 'RANGE_2'),
        ('A3', 'RANGE_3'),
        ('A4', 'RANGE_4'),
        ('A5', 'RANGE_5'),
        ('A6', 'RANGE_6'),
        ('A7', 'RANGE_7'),
    ),
    width=5.0,
)

NANO = Part(
    'dongle\nArduino Nano or Uno',
    right=(
        ('13 SCK', 'SCK'),
        ('11 MOSI', 'MOSI'),
        ('12 MISO', 'MISO'),
        ('10', 'CSN'),
        ('9', 'CE'),
        ('2', 'IRQ'),
        ('5V', '+5V'),
        ('GND', 'GND'),
    ),
)

RADIO = Part(
    'nRF24L01+\nmodule',
    left=(
        ('VCC', '+3V0'),
        ('GND', 'GND'),
        ('SCK', 'SCK'),
        ('MOSI', 'MOSI'),
        ('CSN', 'CSN'),
        ('CE', 'CE'),
        ('MISO', 'MISO_3V'),
        ('IRQ', 'IRQ_3V'),
    ),
)

BUFFER = Part(
    'U2 74AHCT125',
    left=(
        ('1A', 'MISO_3V'),
        ('1OE', 'CSN'),
        ('2A', 'IRQ_3V'),
        ('2OE', 'GND'),
        ('3A 4A', 'GND'),
        ('3OE 4OE', '+5V'),
    ),
    right=(('VCC', '+5V'), ('1Y', 'MISO'), ('2Y', 'IRQ'), ('GND', 'GND')),
)

IMU = Part(
    'MPU6050\nbreakout',
    left=(
        ('VCC', '+5V'),
        ('GND', 'GND'),
        ('SDA', 'SDA_3V'),
        ('SCL', 'SCL_3V'),
        ('AD0', 'GND'),
        ('INT', ''),
    ),
    width=3.2,
)

SHIFTER = Part(
    'level shifter\n2 × BSS138',
    left=(('HV', '+5V'), ('HV1', 'SDA'), ('HV2', 'SCL'), ('GND', 'GND')),
    right=(('LV', '+3V3'), ('LV1', 'SDA_3V'), ('LV2', 'SCL_3V')),
    width=3.4,
)


ADAPTER = Part(
    'radio adapter\n(other sheet)',
    right=(
        ('SCK', 'SCK'),
        ('MOSI', 'MOSI'),
        ('MISO', 'MISO'),
        ('CSN', 'CSN'),
        ('CE', 'CE'),
        ('IRQ', 'IRQ'),
        ('5V', '+5V'),
        ('GND', 'GND'),
    ),
    width=3.2,
)


BUZZER = Part('BZ1 active buzzer', left=(('+', 'BUZZER'), ('-', 'GND')), width=3.2)


def driver(side: str) -> Part:
    """Return the carrier of the driver of a side, L or R."""
    return Part(
        f'driver {side}',
        left=(
            ('ENABLE', 'ENABLE'),
            ('MS1 / M0', 'see table'),
            ('MS2 / M1', 'see table'),
            ('MS3 / M2', 'see table'),
            ('RESET', '+5V'),
            ('SLEEP', '+5V'),
            ('STEP', f'STEP_{side}'),
            ('DIR', f'DIR_{side}'),
        ),
        right=(
            ('VMOT', 'VMOT'),
            ('GND', 'GND'),
            ('2B', f'MOTOR_{side}_2B'),
            ('2A', f'MOTOR_{side}_2A'),
            ('1A', f'MOTOR_{side}_1A'),
            ('1B', f'MOTOR_{side}_1B'),
            ('VDD', '+5V'),
            ('GND ', 'GND'),
        ),
    )


DRIVERS = (driver('L'), driver('R'))

RANGES = Part(
    '8 × GP2Y0A21YK0F',
    left=(
        ('VCC', '+5V'),
        ('GND', 'GND'),
        ('front left', 'RANGE_0'),
        ('front right', 'RANGE_1'),
        ('left front', 'RANGE_2'),
        ('left back', 'RANGE_3'),
        ('rear left', 'RANGE_4'),
        ('rear right', 'RANGE_5'),
        ('right front', 'RANGE_6'),
        ('right back', 'RANGE_7'),
    ),
)

ROBOT_PARTS = (MEGA, SHIFTER, IMU, ADAPTER, BUZZER, *DRIVERS, RANGES)
RADIO_PARTS = (NANO, BUFFER, RADIO)


# -- drawings -------------------------------------------------------------------------------------

_NET_COLOUR = '#0b5394'
_PITCH = 0.6
"""Distance of two pins."""


class _Sheet:
    """A drawing of parts with named nets, and of single components between points."""

    def __init__(self) -> None:
        import schemdraw
        from schemdraw import elements

        schemdraw.use('svg')
        self._elements = elements
        self._drawing = schemdraw.Drawing(show=False)
        self._drawing.config(unit=2.0, fontsize=11, lw=1.3, bgcolor='white', margin=0.3)

    def save(self, path: Path) -> None:
        """Write the picture of the sheet."""
        self._drawing.save(str(path))

    def part(self, part: Part, at: Point) -> None:
        """Draw a part with its upper left corner at a point, and the nets of its pins."""
        x, y = at
        self.box(part.name, at, part.width, _PITCH * (max(len(part.left), len(part.right)) + 1))
        for row, (pin, net) in enumerate(part.left):
            self._pin((x, y - _PITCH * (row + 1)), pin, net, -1)
        for row, (pin, net) in enumerate(part.right):
            self._pin((x + part.width, y - _PITCH * (row + 1)), pin, net, 1)

    def box(self, name: str, at: Point, width: float, height: float) -> None:
        """Draw a box with its upper left corner at a point, and its name above it."""
        x, y = at
        corners = {'corner1': (0, 0), 'corner2': (width, -height)}
        self._drawing += self._elements.Rect(**corners).theta(0).at(at)
        for number, line in enumerate(reversed(name.split('\n'))):
            self.text(line, (x + width / 2, y + 0.3 + 0.45 * number))

    def _pin(self, at: Point, pin: str, net: str, side: int) -> None:
        x, y = at
        self.text(pin, (x - 0.15 * side, y), side, size=10)
        end = x + 0.6 * side
        self.wire((x, y), (end, y))
        if net:
            self.net(net, (end, y), side)
        else:
            self._drawing += self._elements.NoConnect().theta(0).at((end, y))

    def net(self, name: str, at: Point, side: int) -> None:
        """Write the name of a net at the end of a wire: -1 to its left, 1 to its right."""
        x, y = at
        self.text(name, (x + 0.12 * side, y), -side, size=10, colour=_NET_COLOUR)

    def text(
        self, text: str, at: Point, side: int = 0, *, size: float = 11, colour: str = 'black'
    ) -> None:
        """Write a text that ends at a point (1), begins there (-1) or is centred there (0)."""
        from schemdraw.segments import SegmentText

        align = ({-1: 'left', 0: 'center', 1: 'right'}[side], 'center')
        element = self._elements.Element()
        element.segments.append(
            SegmentText((0, 0), text, align=align, fontsize=size, color=colour)
        )
        self._drawing += element.theta(0).at(at)

    def wire(self, *points: Point) -> None:
        """Draw a wire through points."""
        for start, end in itertools.pairwise(points):
            self._drawing += self._elements.Line().at(start).to(end)

    def component(self, kind: str, start: Point, end: Point, text: str, beside: Point) -> None:
        """Draw a component with two terminals; its text begins at an offset from its middle."""
        options = {'nc': True} if kind == 'Button' else {}  # closed until it is pressed
        self._drawing += getattr(self._elements, kind)(**options).at(start).to(end)
        x, y = (start[0] + end[0]) / 2 + beside[0], (start[1] + end[1]) / 2 + beside[1]
        lines = text.split('\n')
        side = 0 if start[1] == end[1] else (-1 if beside[0] > 0 else 1)
        for number, line in enumerate(lines):
            self.text(line, (x, y + 0.4 * ((len(lines) - 1) / 2 - number)), side, size=10)

    def ground(self, *points: Point) -> None:
        """Draw ground symbols."""
        for at in points:
            self._drawing += self._elements.Ground().theta(0).at(at)

    def dot(self, *points: Point) -> None:
        """Draw junctions."""
        for at in points:
            self._drawing += self._elements.Dot().theta(0).at(at)


def draw_power(folder: Path) -> None:
    """Draw battery, supplies and emergency stop."""
    sheet = _Sheet()
    component, right, above = sheet.component, (0.45, 0.0), (0.0, 0.55)
    # Battery, fuse and switch, to the supply +BAT at the top.
    component('Battery', (0, -4), (0, -1), 'BT1\n3 Li-ion cells,\nprotected', (0.6, 0.0))
    sheet.wire((0, -1), (0, 0))
    component('Fuse', (0, 0), (2, 0), 'F1  5 A', above)
    component('Switch', (2, 0), (4, 0), 'S1  main switch', (0.0, 0.9))
    sheet.wire((4, 0), (27.5, 0))
    sheet.net('+BAT', (27.5, 0), 1)
    sheet.ground((0, -4))
    # Divider for the measurement of the battery.
    component('ResistorIEC', (4.5, 0), (4.5, -2), 'R1\n30 kΩ', (-0.45, 0.0))
    component('ResistorIEC', (4.5, -2), (4.5, -4), 'R2\n10 kΩ', (-0.45, 0.0))
    component('Capacitor', (5.6, -2), (5.6, -4), 'C1\n100 nF', right)
    sheet.wire((4.5, -2), (6.2, -2))
    sheet.net('BATTERY', (6.2, -2), 1)
    sheet.dot((4.5, 0), (4.5, -2), (5.6, -2))
    sheet.ground((4.5, -4), (5.6, -4))
    # Supply of 5 V.
    component('Schottky', (8.8, 0), (8.8, -2), 'D1\nSS34', right)
    sheet.wire((8.8, -2), (8.8, -2.6), (9.4, -2.6))
    sheet.box('', (9.4, -2), 2.6, 1.6)
    sheet.text('U1', (10.7, -2.45))
    sheet.text('step-down', (10.7, -2.85), size=10)
    sheet.text('5 V, 2 A', (10.7, -3.25), size=10)
    sheet.wire((10.7, -3.6), (10.7, -4))
    sheet.wire((12, -2.6), (14, -2.6))
    component('Capacitor', (12.8, -2.6), (12.8, -4), 'C2\n470 µF', right)
    sheet.net('+5V', (14, -2.6), 1)
    sheet.dot((8.8, 0), (12.8, -2.6))
    sheet.ground((10.7, -4), (12.8, -4))
    # Relay of the motor supply, held by the second contact of the emergency stop; C9 delays it.
    component('Button', (16.2, 0), (16.2, -2), 'S2b\nemergency\nstop', (-0.55, 0.0))
    component('ResistorIEC', (16.2, -2.4), (18.2, -2.4), 'R7  10 Ω', above)
    component('Capacitor', (18.4, -2.4), (18.4, -4.4), 'C9\n2200 µF', (-0.45, 0.0))
    component('Inductor2', (19.6, -2.4), (19.6, -4.4), 'K1', (0.5, 0.0))
    component('Diode', (20.8, -4.4), (20.8, -2.4), 'D2\n1N4007', right)
    sheet.wire((16.2, -2), (16.2, -2.4))
    sheet.wire((18.2, -2.4), (20.8, -2.4))
    sheet.wire((18.4, -4.4), (20.8, -4.4))
    component('Switch', (23.4, 0), (23.4, -2), 'K1\ncontact', (0.75, 0.0))
    sheet.wire((23.4, -2), (23.4, -2.4), (27.5, -2.4))
    component('DiodeTVS', (23.4, -2.4), (23.4, -4.4), 'D3\nSMBJ16A', right)
    component('Capacitor', (26, -2.4), (26, -4.4), 'C3, C4\n100 µF at\neach driver', right)
    sheet.net('VMOT', (27.5, -2.4), 1)
    sheet.dot((16.2, 0), (18.4, -2.4), (19.6, -2.4), (19.6, -4.4), (23.4, 0), (23.4, -2.4))
    sheet.dot((26, -2.4))
    sheet.ground((19.6, -4.4), (23.4, -4.4), (26, -4.4))
    # First contact of the emergency stop: the signal.
    sheet.net('+5V', (0, -6.5), -1)
    component('ResistorIEC', (0, -6.5), (2, -6.5), 'R3  10 kΩ', above)
    sheet.wire((2, -6.5), (5, -6.5))
    component('Capacitor', (2.6, -6.5), (2.6, -8.5), 'C5\n100 nF', (-0.45, 0.0))
    component('ResistorIEC', (4, -6.5), (4, -8.5), 'R4\n1 kΩ', right)
    component('Button', (4, -8.5), (4, -10.5), 'S2a\nemergency stop', (0.75, 0.0))
    sheet.net('ESTOP', (5, -6.5), 1)
    sheet.dot((2.6, -6.5), (4, -6.5))
    sheet.ground((2.6, -8.5), (4, -10.5))
    # The drivers are off while no pin drives their enable input.
    sheet.net('+5V', (8.8, -6.5), -1)
    component('ResistorIEC', (8.8, -6.5), (10.8, -6.5), 'R5  10 kΩ', above)
    sheet.wire((10.8, -6.5), (11.2, -6.5))
    sheet.net('ENABLE', (11.2, -6.5), 1)
    for number, line in enumerate(_POWER_NOTES):
        sheet.text(line, (14.2, -6.5 - 0.5 * number), -1, size=10)
    sheet.save(folder / 'schematic_power.svg')


_POWER_NOTES = (
    'Both contacts of S2 are closed until it is pressed.',
    'The contact of K1 is closed while its coil of 9 V, 200 Ω has current.',
    'Ground: one star point at the negative terminal of BT1.',
)


def draw_robot(folder: Path) -> None:
    """Draw the robot board and what it connects to."""
    sheet = _Sheet()
    sheet.part(SHIFTER, (-10.2, 0))
    sheet.part(IMU, (-10.2, -5))
    sheet.part(ADAPTER, (-10.2, -11))
    sheet.part(BUZZER, (-10.2, -17.3))
    sheet.part(MEGA, (0, 0))
    sheet.part(RANGES, (0.5, -11.4))
    sheet.part(DRIVERS[0], (11.2, 0))
    sheet.part(DRIVERS[1], (11.2, -7.6))
    for number, line in enumerate(_ROBOT_NOTES):
        sheet.text(line, (8.2, -14.2 - 0.5 * number), -1, size=10)
    sheet.save(folder / 'schematic_robot.svg')


_ROBOT_NOTES = (
    'Motor: one coil at 1A and 1B, the other at 2A and 2B.',
    'MS1 to MS3, M0 to M2: 16 microsteps, by the table.',
    'VDD: A4988, TMC2209 (VIO). DRV8825: FAULT, open.',
    'RESET, SLEEP: A4988, DRV8825. TMC2209: open.',
    '10 µF and 100 nF at each range sensor,',
    '100 nF at the MPU6050.',
)


def draw_radio(folder: Path) -> None:
    """Draw the dongle, and the adapter between a board of 5 V and its radio."""
    sheet = _Sheet()
    sheet.part(NANO, (0, 0))
    sheet.part(BUFFER, (9.4, 0))
    sheet.part(RADIO, (19, 0))
    # Supply of 3.0 V.
    component = sheet.component
    sheet.net('+5V', (8.8, -7), -1)
    sheet.wire((8.8, -7), (10.8, -7))
    component('Capacitor', (9.6, -7), (9.6, -9), 'C6\n1 µF', (0.45, 0.0))
    sheet.box('', (10.8, -6.4), 3, 1.6)
    sheet.text('U3', (12.3, -6.8))
    sheet.text('MCP1700-3002E', (12.3, -7.3), size=9)
    sheet.wire((12.3, -8), (12.3, -9))
    sheet.wire((13.8, -7), (19.4, -7))
    component('Capacitor', (14.8, -7), (14.8, -9), 'C7\n10 µF', (0.45, 0.0))
    component('Capacitor', (16.6, -7), (16.6, -9), 'C8\n100 nF', (0.45, 0.0))
    sheet.net('+3V0', (19.4, -7), 1)
    sheet.dot((9.6, -7), (14.8, -7), (16.6, -7))
    sheet.ground((9.6, -9), (12.3, -9), (14.8, -9), (16.6, -9))
    # The radio stays deselected while no pin drives CSN.
    sheet.net('+3V0', (0.6, -7), -1)
    component('ResistorIEC', (0.6, -7), (2.6, -7), 'R6  10 kΩ', (0.0, 0.55))
    sheet.wire((2.6, -7), (3, -7))
    sheet.net('CSN', (3, -7), 1)
    sheet.save(folder / 'schematic_radio.svg')


def draw_all(folder: Path) -> None:
    """Write all sheets into a folder."""
    draw_power(folder)
    draw_robot(folder)
    draw_radio(folder)


if __name__ == '__main__':
    draw_all(IMAGES)
