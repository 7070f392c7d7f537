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
"""The schematics of docs/hardware.md agree with the firmware, with their source and the page."""

import math
from pathlib import Path
import re
import xml.etree.ElementTree as ElementTree

import pytest

from docs import drawings, schematic
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import RANGE_SENSORS
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / 'docs' / 'hardware.md'
SHEETS = ('power', 'robot', 'radio')

# Port pins of the Arduino pins, as in the pin mappings of the boards.
_MEGA = {
    '2': 'PE4',
    '3': 'PE5',
    '10': 'PB4',
    '11': 'PB5',
    '20': 'PD1',
    '21': 'PD0',
    '50': 'PB3',
    '51': 'PB2',
    '52': 'PB1',
    '53': 'PB0',
    **{str(22 + bit): f'PA{bit}' for bit in range(8)},
}
_NANO = {'2': 'PD2', '9': 'PB1', '10': 'PB2', '11': 'PB3', '12': 'PB4', '13': 'PB5'}
# Net of each pin that the firmware names.
_SHARED = {
    'SPI_SCK': 'SCK',
    'SPI_MOSI': 'MOSI',
    'SPI_MISO': 'MISO',
    'RADIO_CSN': 'CSN',
    'RADIO_CE': 'CE',
    'RADIO_IRQ_HIGH': 'IRQ',
}
_ROBOT = {
    **_SHARED,
    'STEPPER_OFF': 'ENABLE',
    'SIGNAL_BUZZER': 'BUZZER',
    'ESTOP_PULL_UP': 'ESTOP',
    'TWI_SCL': 'SCL',
    'TWI_SDA': 'SDA',
}
_STEPS = {
    'T3_PIN_STEP_LEFT': 'STEP_L',
    'T3_PIN_STEP_RIGHT': 'STEP_R',
    'T3_PIN_BACK_LEFT': 'DIR_L',
    'T3_PIN_BACK_RIGHT': 'DIR_R',
}


def _firmware(name):
    [path] = (ROOT / 'firmware').rglob(name)
    return path.read_text()


def _defined_pins(text, names):
    """Return the port pin in the definition of each name."""
    return {
        name: re.search(rf'#define {name} .*?\b(P[A-L][0-7])\b', text)[1]
        for name in names
        if re.search(rf'#define {name} ', text)
    }


def _ports(part, mapping):
    """Return the net of each port pin of a board that the schematic connects."""
    nets = {pin.split()[0]: net for pin, net in part.nets().items()}
    return {mapping[pin]: net for pin, net in nets.items() if pin in mapping and net}


def test_the_pins_of_the_dongle_are_those_of_its_firmware():
    text = _firmware('board.h').split('#elif')[0]
    pins = _defined_pins(text, _SHARED)
    assert set(pins) == set(_SHARED)
    assert _ports(schematic.NANO, _NANO) == {pins[name]: net for name, net in _SHARED.items()}


def test_the_pins_of_the_robot_are_those_of_its_firmware():
    text = _firmware('board.h').split('#elif')[1]
    pins = _defined_pins(text, _ROBOT)
    assert set(pins) == set(_ROBOT)
    expected = {pins[name]: net for name, net in _ROBOT.items()}
    assert re.search(r'#define STEPPER_PORT (\w+)', text)[1] == 'PORTA'
    for name, net in _STEPS.items():
        mask = int(re.search(rf'#define {name} (\d+)u', _firmware('t3_steps.h'))[1])
        expected[f'PA{mask.bit_length() - 1}'] = net
    assert _ports(schematic.MEGA, _MEGA) == expected


def test_the_analogue_inputs_are_those_of_the_firmware():
    battery = re.search(r'#define T3_ADC_BATTERY (\d+)u', _firmware('t3_port.h'))[1]
    inputs = {p: net for p, net in schematic.MEGA.nets().items() if re.fullmatch(r'A\d', p)}
    ranges = {f'A{number}': f'RANGE_{number}' for number in range(8)}
    assert inputs == {**ranges, f'A{battery}': 'BATTERY'}


def test_every_net_connects_at_least_two_pins():
    """Nets that the sheet of the supplies has as wires count as connected."""
    supplies = {'+5V', 'GND', '+3V0', 'VMOT', 'BATTERY', 'ESTOP'}
    motors = re.compile(r'MOTOR_[LR]_[12][AB]|see table')
    for parts in (schematic.ROBOT_PARTS, schematic.RADIO_PARTS):
        nets = [net for part in parts for net in part.nets().values() if net]
        single = {net for net in nets if nets.count(net) == 1 and not motors.fullmatch(net)}
        assert single <= supplies


def _table(heading):
    """Return the pins of a wiring table, in order."""
    table = re.search(rf'^{heading}:\n\n(.*?)\n\n', PAGE.read_text(), re.DOTALL | re.MULTILINE)[1]
    rows = [[cell.strip() for cell in line.strip('|').split('|')] for line in table.splitlines()]
    return [pin for row in rows[2:] for pin in row[1].split(', ')]


@pytest.mark.parametrize('heading, board', [('Robot board', 'MEGA'), ('Dongle', 'NANO')])
def test_the_wiring_tables_have_the_pins_of_the_schematic(heading, board):
    pins = [pin.split()[0] for pin in getattr(schematic, board).nets()]
    signals = [pin for pin in pins if re.fullmatch(r'A?\d+', pin)]
    assert sorted(_table(heading)) == sorted(signals)


def _texts(path):
    return sorted(element.text for element in ElementTree.parse(path).iter() if element.text)


@pytest.mark.parametrize('sheet', SHEETS)
@pytest.mark.slow
def test_the_pictures_are_drawn_from_their_source(sheet, tmp_path):
    """Compared by their texts: another release of the library may place a line elsewhere."""
    pytest.importorskip('schemdraw')
    getattr(schematic, f'draw_{sheet}')(tmp_path)
    name = f'schematic_{sheet}.svg'
    assert _texts(tmp_path / name) == _texts(ROOT / 'docs' / 'images' / name)


def test_every_component_of_the_schematics_is_in_the_parts():
    page = PAGE.read_text()
    parts = page[page.index('## Parts') : page.index('## Supply')]
    drawn = {
        text
        for sheet in SHEETS
        for line in _texts(ROOT / 'docs' / 'images' / f'schematic_{sheet}.svg')
        for text in re.findall(r'\b(?:[CDFKRSU]|BT|BZ)\d\b', line)
    }
    ranges = {'C6', 'C7', 'C8', 'U2', 'U3'}  # of both radio adapters, named as ranges
    assert drawn >= ranges
    assert {text for text in drawn - ranges if not re.search(rf'\b{text}\b', parts)} == set()


def test_reference_voltages_follow_from_their_formulas():
    """Vref for 1 A: A4988 8 I Rs, DRV8825 5 I Rs, TMC2209 from its full scale at 2.5 V."""
    row = re.search(r'^\| Vref for 1 A \|(.*)\|$', PAGE.read_text(), re.MULTILINE)[1]
    values = [float(text) for text in re.findall(r'\d\.\d\d', row)]
    full_scale = 0.325 / (0.11 + 0.02)
    expected = [8.0 * rs for rs in (0.05, 0.068, 0.1)] + [5.0 * 0.1, 2.5 / full_scale]
    assert values == [pytest.approx(value, abs=0.005) for value in expected]


# -- drawings -------------------------------------------------------------------------------------


def test_the_drawings_are_drawn_from_their_source(tmp_path):
    """And so from the parameters of geometry and sensors."""
    drawings.draw_all(tmp_path)
    for path in sorted(tmp_path.glob('*.svg')):
        assert path.read_text() == (ROOT / 'docs' / 'images' / path.name).read_text(), (
            'run python docs/drawings.py'
        )
        assert f'images/{path.name}' in PAGE.read_text()


def test_the_dimensions_are_those_of_the_parameters():
    texts = set(_texts(ROOT / 'docs' / 'images' / 'drawing_top.svg'))
    geometry, sensors = WheelGeometry(), RangeSensorParameters()
    assert f'track {1e3 * geometry.wheel_separation:g}' in texts
    assert f'wheel {1e3 * geometry.wheel_radius:g}' in texts
    assert f'faces {1e3 * sensors.half_length:g}' in texts
    assert f'sensors {1e3 * sensors.offset:g}' in texts
    assert {name.replace('_', ' ') for name in RANGE_SENSORS} <= texts


def test_the_side_sensors_clear_the_tyres():
    """Lying, with 37 mm along the body, they would touch them."""
    depth, length = drawings.SENSOR
    inner = drawings.HALF_WIDTH - depth
    assert inner < drawings.TRACK / 2 + drawings.TYRE / 2
    assert drawings.OFFSET - depth / 2 > drawings.RADIUS
    assert drawings.OFFSET - length / 2 < drawings.RADIUS


def test_the_strip_board_connects_what_the_schematic_connects():
    """Groups of pins by strips, cuts and links are the nets of radio, buffer, regulator and R6."""
    nets = {}
    for name, part in (('U2', schematic.BUFFER), ('radio', schematic.RADIO)):
        for pins, net in part.nets().items():
            for pin in pins.split():  # 3OE 4OE are two
                nets.setdefault(net, set()).add(f'{name} {pin}')
    for pin, net in schematic.ADAPTER.nets().items():
        nets.setdefault(net, set()).add(f'wires {pin}')
    for pin, net in {
        'U3 VIN': '+5V',
        'U3 GND': 'GND',
        'U3 VOUT': '+3V0',
        'C6 +': '+5V',
        'C6 -': 'GND',
        'C7 +': '+3V0',
        'C7 -': 'GND',
        'C8 +': '+3V0',
        'C8 -': 'GND',
        'R6 1': '+3V0',
        'R6 2': 'CSN',
    }.items():
        nets.setdefault(net, set()).add(pin)
    found = [group for group in drawings.connected() if group not in ({'U2 3Y'}, {'U2 4Y'})]
    assert sorted(map(sorted, found)) == sorted(map(sorted, nets.values()))


def test_no_hole_of_the_strip_board_is_used_twice():
    holes = list(drawings.used_holes())
    assert len(holes) == len(set(holes))
    for row, column in holes:
        assert row in drawings.ROWS
        assert 1 <= column <= drawings.COLUMNS
        assert (row, float(column)) not in drawings.CUTS


def test_the_relay_pulls_in_at_the_battery_cut_off():
    """A relay of 12 V needs 9.0 V, and got 8.8 V."""
    coil, series, rated, operates = 200.0, 10.0, 9.0, 0.75
    cutoff = LinkParameters().robot.battery_cutoff
    at_coil = cutoff * coil / (coil + series)
    copper = 1.0 + 0.00393 * (60.0 - 23.0)
    assert at_coil > copper * operates * rated
    section = PAGE.read_text().split('## Emergency stop')[1]
    assert f'gets {at_coil:.1f} V behind R7' in section
    assert f'{operates * rated:.2f} V at 23' in section
    assert f'{copper * operates * rated:.1f} V with a coil' in section
    for charge, drop in ((cutoff, 0.4), (12.6, 0.1)):
        seconds = coil * 2200e-6 * math.log(charge * coil / (coil + series) / (drop * rated))
        print(f'{charge} V: {seconds:.2f} s')
        assert 0.35 < seconds < 1.25
