# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The schematics of docs/hardware.md agree with the firmware, with their source and the page."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
import re
import xml.etree.ElementTree as ElementTree

import pytest

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


@pytest.fixture(scope='module')
def schematic():
    spec = spec_from_file_location('schematic', ROOT / 'docs' / 'schematic.py')
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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


def test_the_pins_of_the_dongle_are_those_of_its_firmware(schematic):
    text = _firmware('board.h').split('#elif')[0]
    pins = _defined_pins(text, _SHARED)
    assert set(pins) == set(_SHARED)
    assert _ports(schematic.NANO, _NANO) == {pins[name]: net for name, net in _SHARED.items()}


def test_the_pins_of_the_robot_are_those_of_its_firmware(schematic):
    text = _firmware('board.h').split('#elif')[1]
    pins = _defined_pins(text, _ROBOT)
    assert set(pins) == set(_ROBOT)
    expected = {pins[name]: net for name, net in _ROBOT.items()}
    assert re.search(r'#define STEPPER_PORT (\w+)', text)[1] == 'PORTA'
    for name, net in _STEPS.items():
        mask = int(re.search(rf'#define {name} (\d+)u', _firmware('t3_steps.h'))[1])
        expected[f'PA{mask.bit_length() - 1}'] = net
    assert _ports(schematic.MEGA, _MEGA) == expected


def test_the_analogue_inputs_are_those_of_the_firmware(schematic):
    battery = re.search(r'#define T3_ADC_BATTERY (\d+)u', _firmware('t3_port.h'))[1]
    inputs = {p: net for p, net in schematic.MEGA.nets().items() if re.fullmatch(r'A\d', p)}
    ranges = {f'A{number}': f'RANGE_{number}' for number in range(8)}
    assert inputs == {**ranges, f'A{battery}': 'BATTERY'}


def test_every_net_connects_at_least_two_pins(schematic):
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
def test_the_wiring_tables_have_the_pins_of_the_schematic(schematic, heading, board):
    pins = [pin.split()[0] for pin in getattr(schematic, board).nets()]
    signals = [pin for pin in pins if re.fullmatch(r'A?\d+', pin)]
    assert sorted(_table(heading)) == sorted(signals)


def _texts(path):
    return sorted(element.text for element in ElementTree.parse(path).iter() if element.text)


@pytest.mark.parametrize('sheet', SHEETS)
@pytest.mark.slow
def test_the_pictures_are_drawn_from_their_source(schematic, sheet, tmp_path):
    """Compared by their texts: another release of the library may place a line elsewhere."""
    pytest.importorskip('schemdraw')
    getattr(schematic, f'draw_{sheet}')(tmp_path)
    name = f'schematic_{sheet}.svg'
    assert _texts(tmp_path / name) == _texts(ROOT / 'docs' / 'images' / name)


def test_every_component_of_the_schematics_is_in_the_parts(schematic):
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
