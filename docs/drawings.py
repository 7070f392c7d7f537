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
"""Source of the dimensioned drawings of docs/hardware.md, and of the strip board of the adapter.

``python docs/drawings.py`` writes ``docs/images/drawing_*.svg``. Positions that the software knows
are its parameters; the others are a proposal. All lengths are mm.
"""

from collections.abc import Iterator
import math
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import RANGE_SENSORS
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters

IMAGES = Path(__file__).resolve().parent / 'images'

GEOMETRY, SENSORS = WheelGeometry(), RangeSensorParameters()
RADIUS = 1e3 * GEOMETRY.wheel_radius
TRACK = 1e3 * GEOMETRY.wheel_separation
HALF_LENGTH, HALF_WIDTH = 1e3 * SENSORS.half_length, 1e3 * SENSORS.half_width
OFFSET = 1e3 * SENSORS.offset
TYRE = 20.0
PLATE = 1.5
"""Thickness of the bottom plate, of aluminium (the paper)."""
SPACER = 70.0
"""Length of the four spacers under the circuit board (the paper)."""
AXLE_ABOVE_PLATE = 24.5
PIN_RADIUS = 0.35 * RADIUS
PIN = HALF_LENGTH - PIN_RADIUS
"""Distance of each idle pin from the axle: 12 mm behind the faces of the sensors."""
MOTOR, MOTOR_LENGTH = 42.3, 40.0
"""NEMA 17 of 0.4 N m: face and length."""
HOLES, COLLAR = 31.0, 22.0
"""Distance of the four M3 holes, diameter of the collar: NEMA ICS 16, size 17."""
SENSOR = (13.0, 37.0)
"""Depth and length of a GP2Y0A21YK0F without its mounting lugs."""


class Sheet:
    """A drawing of lines and texts in mm, y up; ``scale`` pixels per mm."""

    def __init__(
        self, size: tuple[float, float], origin: tuple[float, float], scale: float
    ) -> None:
        self._size, self._origin, self._scale = size, origin, scale
        self._parts: list[str] = []

    def _at(self, x: float, y: float) -> tuple[str, str]:
        return (
            f'{(self._origin[0] + x) * self._scale:.1f}',
            f'{(self._size[1] - self._origin[1] - y) * self._scale:.1f}',
        )

    def line(self, start: tuple[float, float], end: tuple[float, float], kind: str = '') -> None:
        """Draw a line; ``kind`` is '', 'thin' or 'axis'."""
        (x1, y1), (x2, y2) = self._at(*start), self._at(*end)
        self._parts.append(f'<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" class="{kind}"/>')

    def box(self, x: float, y: float, width: float, height: float, kind: str = '') -> None:
        """Draw a rectangle around its centre."""
        left, top = self._at(x - width / 2, y + height / 2)
        w, h = width * self._scale, height * self._scale
        self._parts.append(
            f'<rect x="{left}" y="{top}" width="{w:.1f}" height="{h:.1f}" class="{kind}"/>'
        )

    def circle(self, x: float, y: float, diameter: float, kind: str = '') -> None:
        """Draw a circle."""
        cx, cy = self._at(x, y)
        r = diameter / 2 * self._scale
        self._parts.append(f'<circle cx="{cx}" cy="{cy}" r="{r:.1f}" class="{kind}"/>')

    def text(
        self, text: str, x: float, y: float, side: str = 'middle', turn: bool = False
    ) -> None:
        """Write a text; ``side`` is its anchor, ``turn``: upward."""
        px, py = self._at(x, y)
        turned = f' transform="rotate(-90 {px} {py})"' if turn else ''
        self._parts.append(
            f'<text x="{px}" y="{py}" text-anchor="{side}"{turned}>{escape(text)}</text>'
        )

    def width(self, x1: float, x2: float, y: float, reference: float, text: str = '') -> None:
        """Draw a horizontal dimension at ``y`` of two points at the height ``reference``."""
        for x in (x1, x2):
            self.line((x, reference), (x, y + math.copysign(2.0, y - reference)), 'thin')
            self.line((x - 1.2, y - 1.2), (x + 1.2, y + 1.2), 'thin')
        self.line((x1, y), (x2, y), 'thin')
        self.text(text or f'{abs(x2 - x1):g}', (x1 + x2) / 2, y + 1.5)

    def height(self, y1: float, y2: float, x: float, reference: float, text: str = '') -> None:
        """Draw a vertical dimension at ``x`` of two points at ``reference``."""
        for y in (y1, y2):
            self.line((reference, y), (x + math.copysign(2.0, x - reference), y), 'thin')
            self.line((x - 1.2, y - 1.2), (x + 1.2, y + 1.2), 'thin')
        self.line((x, y1), (x, y2), 'thin')
        self.text(text or f'{abs(y2 - y1):g}', x - 1.5, (y1 + y2) / 2, turn=True)

    def save(self, path: Path) -> None:
        """Write the drawing."""
        width, height = (side * self._scale for side in self._size)
        style = (
            'line,rect,circle{stroke:#111;stroke-width:1.4;fill:none}'
            '.thin{stroke:#666;stroke-width:.7}.axis{stroke:#666;stroke-width:.7;'
            'stroke-dasharray:9 3 2 3}.copper{stroke:none;fill:#e8c9a0}.cut{stroke:none;fill:#fff}'
            '.part{fill:#fff}.link{stroke:#1457a8;stroke-width:2}.hole{stroke:#888;stroke-width:.6;fill:#fff}'
            'text{font:11px sans-serif;fill:#111;stroke:none}'
        )
        path.write_text(
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
            f'viewBox="0 0 {width:.0f} {height:.0f}"><style>{style}</style>'
            '<rect width="100%" height="100%" style="fill:#fff;stroke:none"/>\n'
            + '\n'.join(self._parts)
            + '\n</svg>\n',
            encoding='utf-8',
        )


def draw_top(folder: Path) -> None:
    """Draw the robot from above: plate, axle, wheels, motors, idle pins and sensors."""
    sheet = Sheet((330, 300), (150, 135), 3.0)
    plate = 2 * (HALF_LENGTH - SENSOR[0]), TRACK - TYRE - 4
    sheet.box(0, 0, plate[1], plate[0])
    sheet.line((-105, 0), (105, 0), 'axis')
    sheet.line((0, -115), (0, 115), 'axis')
    for side in (1, -1):
        sheet.box(side * TRACK / 2, 0, TYRE, 2 * RADIUS)
        sheet.box(side * (TRACK / 2 - TYRE / 2 - 8 - MOTOR_LENGTH / 2), 0, MOTOR_LENGTH, MOTOR)
        sheet.circle(0, side * PIN, 2 * PIN_RADIUS)
        for end in (1, -1):
            sheet.circle(side * 50, end * 75, 3.2)
    sheet.box(0, 0, 16, 21)
    sheet.text('MPU6050', 0, -4)
    # Seen from above with x forward up, y (to the left) is to the left of the drawing.
    for name, (x, y, direction) in zip(RANGE_SENSORS, sensor_mounts(SENSORS), strict=True):
        ahead, left = 1e3 * float(x), 1e3 * float(y)
        across = abs(math.cos(direction)) > 0.5
        depth, length = SENSOR[0], SENSOR[1] if across else SENSOR[0]
        inward = depth / 2
        cx = -left + (0 if across else math.copysign(inward, left))
        cy = ahead - (math.copysign(inward, ahead) if across else 0)
        sheet.box(cx, cy, *((length, depth) if across else (depth, length)))
        outside = 4.5 if across else 0
        sheet.text(
            name.replace('_', ' '),
            cx + (0 if across else math.copysign(12, -left)),
            cy + math.copysign(inward + outside, ahead) - 1.5,
            'middle' if across else 'end' if left > 0 else 'start',
        )
    sheet.text('front, x', 3, 108, 'start')
    sheet.text('idle pin', 15, PIN - 2, 'start')
    sheet.text('idle pin', 15, -PIN - 2, 'start')
    sheet.width(-TRACK / 2, TRACK / 2, 124, RADIUS, f'track {TRACK:g}')
    sheet.width(
        -HALF_WIDTH, HALF_WIDTH, 134, OFFSET, f'faces of the side sensors {2 * HALF_WIDTH:g}'
    )
    sheet.width(-OFFSET, OFFSET, 114, HALF_LENGTH, f'{2 * OFFSET:g}')
    sheet.width(-TRACK / 2 - TYRE / 2, -TRACK / 2 + TYRE / 2, -48, -RADIUS, f'{TYRE:g}')
    sheet.width(-50, 50, -122, -75, '100 (spacers, M3)')
    for y, x, text in (
        (HALF_LENGTH, 150, f'faces {HALF_LENGTH:g}'),
        (PIN, 138, f'pins {PIN:g}'),
        (OFFSET, 126, f'sensors {OFFSET:g}'),
        (RADIUS, 114, f'wheel {RADIUS:g}'),
    ):
        sheet.height(0, y, x, 92, text)
    sheet.height(0, -75, 126, 52, 'spacers 75')
    sheet.save(folder / 'drawing_top.svg')


def draw_side(folder: Path) -> None:
    """Draw the robot from the left: heights above the floor."""
    sheet = Sheet((330, 170), (150, 30), 3.0)
    top = RADIUS - AXLE_ABOVE_PLATE
    sheet.line((-130, 0), (130, 0))
    sheet.circle(0, RADIUS, 2 * RADIUS)
    sheet.circle(0, RADIUS, 5)
    sheet.box(0, top - PLATE / 2, 2 * (HALF_LENGTH - SENSOR[0]), PLATE)
    board = top + SPACER
    sheet.box(0, board + 0.8, 2 * (HALF_LENGTH - SENSOR[0]), 1.6)
    for end in (1, -1):
        sheet.box(end * 75, top + SPACER / 2, 6, SPACER)
        sheet.box(end * PIN, (top - PLATE) / 2, 10, top - PLATE)
        sheet.box(end * (HALF_LENGTH - SENSOR[0] / 2), RADIUS, SENSOR[0], 13)
    sheet.text('circuit board', 0, board + 4)
    sheet.text('bottom plate, aluminium 1.5 mm', 0, top + 2)
    sheet.text('floor', -128, 2, 'start')
    sheet.height(0, RADIUS, 128, 5, f'axle, beams {RADIUS:g}')
    sheet.height(0, top, 116, 90, f'plate {top:g}')
    sheet.height(top, board, 140, 90, f'spacers {SPACER:g}')
    sheet.height(0, top - PLATE, -112, -PIN, f'pins {top - PLATE:g}')
    sheet.width(-PIN, PIN, -12, 0, f'idle pins {2 * PIN:g}')
    sheet.width(
        -HALF_LENGTH, HALF_LENGTH, -20, RADIUS, f'faces of the sensors {2 * HALF_LENGTH:g}'
    )
    sheet.save(folder / 'drawing_side.svg')


def draw_bracket(folder: Path) -> None:
    """Draw the bracket of a motor: an angle of aluminium, 3 mm."""
    sheet = Sheet((210, 120), (50, 30), 4.0)
    width, tall = 48.0, AXLE_ABOVE_PLATE + MOTOR / 2 + 2
    sheet.box(0, tall / 2, width, tall)
    sheet.line((-width / 2, 3), (width / 2, 3), 'thin')
    sheet.circle(0, AXLE_ABOVE_PLATE, COLLAR + 0.5)
    for x in (1, -1):
        for y in (1, -1):
            sheet.circle(x * HOLES / 2, AXLE_ABOVE_PLATE + y * HOLES / 2, 3.2)
    sheet.line((-28, AXLE_ABOVE_PLATE), (28, AXLE_ABOVE_PLATE), 'axis')
    sheet.line((0, -4), (0, tall + 4), 'axis')
    sheet.width(-width / 2, width / 2, -14, 0)
    sheet.width(-HOLES / 2, HOLES / 2, tall + 8, AXLE_ABOVE_PLATE + HOLES / 2)
    sheet.height(0, AXLE_ABOVE_PLATE, -34, -width / 2)
    sheet.height(AXLE_ABOVE_PLATE - HOLES / 2, AXLE_ABOVE_PLATE + HOLES / 2, 32, HOLES / 2)
    sheet.height(0, tall, -42, -width / 2, f'{tall:.1f}')
    sheet.text(f'4 holes 3.2, hole {COLLAR + 0.5:g}', 0, tall + 16)
    # The foot, from above.
    sheet.box(85, 20, width, 40)
    sheet.line((85 - width / 2, 3), (85 + width / 2, 3), 'thin')
    for x in (1, -1):
        sheet.circle(85 + x * 15, 28, 3.2)
    sheet.width(70, 100, 46, 28)
    sheet.height(0, 28, 116, 109)
    sheet.height(0, 40, 126, 109)
    sheet.text('foot, from above: angle of aluminium 50 × 50 × 3, cut', 85, -10)
    sheet.save(folder / 'drawing_bracket.svg')


# -- radio adapter on strip board -----------------------------------------------------------------


class Hole(NamedTuple):
    """A hole of the strip board: strips run along the columns of a row."""

    row: str
    column: int


ROWS, COLUMNS = 'ABCDEFGHIJKLM', 25
_U2_PINS = {
    **{number: Hole('ABCDEFG'[number - 1], 9) for number in range(1, 8)},
    **{number: Hole('GFEDCBA'[number - 8], 12) for number in range(8, 15)},
}
_U2_NAMES = (
    *('1OE', '1A', '1Y', '2OE', '2A', '2Y', 'GND'),
    *('3Y', '3A', '3OE', '4Y', '4A', '4OE', 'VCC'),
)
PINS: dict[str, dict[str, Hole]] = {
    'U2 74AHCT125': {_U2_NAMES[n - 1]: hole for n, hole in _U2_PINS.items()},
    'U3 MCP1700-3002E': {'VOUT': Hole('G', 18), 'VIN': Hole('H', 18), 'GND': Hole('I', 18)},
    'radio': {
        'GND': Hole('I', 21),
        'VCC': Hole('I', 22),
        'CE': Hole('J', 21),
        'CSN': Hole('J', 22),
        'SCK': Hole('K', 21),
        'MOSI': Hole('K', 22),
        'MISO': Hole('L', 21),
        'IRQ': Hole('L', 22),
    },
    'C6 1 µF': {'+': Hole('H', 7), '-': Hole('I', 7)},
    'C7 10 µF': {'+': Hole('G', 19), '-': Hole('I', 19)},
    'C8 100 nF': {'+': Hole('I', 23), '-': Hole('I', 20)},
    'R6 10 kΩ': {'1': Hole('G', 24), '2': Hole('J', 24)},
    'wires to the board': {
        'MISO': Hole('C', 2),
        'CSN': Hole('A', 2),
        'IRQ': Hole('F', 2),
        '5V': Hole('H', 2),
        'GND': Hole('I', 2),
        'CE': Hole('J', 2),
        'SCK': Hole('K', 2),
        'MOSI': Hole('M', 2),
    },
}
"""Holes of the pins of each part, seen from the side of the parts; the radio from its header."""
CUTS = [*((row, 10.5) for row in 'ABCDEFG'), ('G', 15.5), *((row, 21.5) for row in 'IJKL')]
"""Row and column of each cut; those at 21.5 with a knife, between two holes."""
LINKS = [
    (Hole('A', 8), Hole('J', 25)),  # CSN
    (Hole('B', 3), Hole('L', 3)),  # MISO of the radio
    (Hole('E', 4), Hole('L', 25)),  # IRQ of the radio
    (Hole('M', 23), Hole('K', 23)),  # MOSI
    (Hole('D', 5), Hole('I', 5)),  # 2OE
    (Hole('G', 6), Hole('I', 6)),  # GND of U2
    (Hole('C', 13), Hole('I', 13)),  # 4A
    (Hole('F', 14), Hole('I', 14)),  # 3A
    (Hole('A', 16), Hole('H', 16)),  # VCC of U2
    (Hole('B', 17), Hole('H', 17)),  # 4OE
    (Hole('E', 15), Hole('H', 15)),  # 3OE
    (Hole('G', 25), Hole('I', 25)),  # 3.0 V to the radio
]


def strip_of(hole: Hole) -> tuple[str, int]:
    """Return the strip of a hole: its row, and the number of cuts to its left."""
    return hole.row, sum(row == hole.row and at < hole.column for row, at in CUTS)


def connected() -> list[set[str]]:
    """Return the groups of connected pins, each ``part pin``."""
    groups: dict[tuple[str, int], int] = {}
    for number, strip in enumerate(
        {strip_of(Hole(row, c)) for row in ROWS for c in range(1, COLUMNS + 1)}
    ):
        groups[strip] = number
    for one, other in LINKS:
        keep, drop = groups[strip_of(one)], groups[strip_of(other)]
        groups = {strip: keep if group == drop else group for strip, group in groups.items()}
    found: dict[int, set[str]] = {}
    for part, pins in PINS.items():
        for pin, hole in pins.items():
            found.setdefault(groups[strip_of(hole)], set()).add(f'{part.split()[0]} {pin}')
    return list(found.values())


def used_holes() -> Iterator[Hole]:
    """Yield the hole of every pin and of every end of a link."""
    for pins in PINS.values():
        yield from pins.values()
    for link in LINKS:
        yield from link


def draw_adapter(folder: Path) -> None:
    """Draw the strip board of the radio adapter from the side of the parts."""
    pitch = 2.54
    sheet = Sheet((96, 50), (12, 6), 10.0)

    def at(hole: Hole) -> tuple[float, float]:
        return hole.column * pitch, (len(ROWS) - 1 - ROWS.index(hole.row)) * pitch

    for row in ROWS:
        _, y = at(Hole(row, 1))
        sheet.box((COLUMNS + 1) * pitch / 2, y, COLUMNS * pitch, 2.0, 'copper')
        sheet.text(row, -1.2, y - 0.4)
        for column in range(1, COLUMNS + 1):
            sheet.circle(column * pitch, y, 0.9, 'hole')
    for column in range(1, COLUMNS + 1):
        sheet.text(str(column), column * pitch, len(ROWS) * pitch - 0.6)
    for row, column in CUTS:
        _, y = at(Hole(row, 1))
        sheet.box(column * pitch, y, 0.9, 2.2, 'cut')
        sheet.text('×', column * pitch, y - 0.4)
    for one, other in LINKS:
        sheet.line(at(one), at(other), 'link')
    for part, pins in PINS.items():
        for pin, hole in pins.items():
            x, y = at(hole)
            sheet.circle(x, y, 1.5, 'part')
            if len(pins) == 2:
                continue  # its name is enough
            side = -1.1 if hole.column <= 10 or part == 'radio' and hole.column == 21 else 1.1
            sheet.text(pin, x + side, y + 0.5, 'end' if side < 0 else 'start')
        x, y = at(next(iter(pins.values())))
        name = part.split()[0] if len(pins) < 4 else part
        sheet.text(name, x, y + (1.2 if len(pins) < 8 else 4.6 if part == 'radio' else 5.6))
    sheet.text(
        'Side of the parts; strips along the rows. × cut of a strip, blue: wire link. 33 × 64 mm',
        40,
        len(ROWS) * pitch + 3,
    )
    sheet.save(folder / 'drawing_adapter.svg')


def draw_all(folder: Path) -> None:
    """Write all drawings into a folder."""
    draw_top(folder)
    draw_side(folder)
    draw_bracket(folder)
    draw_adapter(folder)


if __name__ == '__main__':
    draw_all(IMAGES)
