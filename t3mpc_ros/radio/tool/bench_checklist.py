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
"""Bench checklist of docs/robot.md: what is measured over both USB ports, and what is asked."""

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.frames import CALIBRATION_RECORD, Pong, Samples
from t3mpc_ros.radio.tool import eeprom_records
from t3mpc_ros.radio.tool.link_test import FAIL, PASS, SKIPPED, Check
from t3mpc_ros.radio.tool.procedure import Pause, Script, wait_for_board
from t3mpc_ros.radio.tool.robot_info import LogEntry, LogKind, read_log
from t3mpc_ros.radio.tool.robot_settings import SETTINGS_TEXTS, StoredSettings, read_settings
from t3mpc_ros.robot.calibration import (
    CONVERTER_COUNTS,
    MAX_GYRO_BIAS,
    MAX_SHARP_COUNT,
    Calibration,
    nominal_battery_voltage,
)
from t3mpc_ros.robot.sensor_parameters import GRAVITY, ImuParameters

SAMPLE_COUNT = 200
_SAMPLE_PERIOD = 0.01  # s; two seconds in all
_IMU = ImuParameters()
_GRAVITY_TOLERANCE = 0.1  # g; offsets of ±0.05 and ±0.08 g (PS-MPU-6000A 3.4, 6.2)
_MAX_NOISE = 0.5
"""deg/s: ten times the noise of the data sheet (0.05); a hand on the robot exceeds it"""
_WATCHDOG, _BROWN_OUT = 8, 4


class Question(NamedTuple):
    """A step of the checklist that only a person can judge."""

    step: int
    name: str
    text: str
    remedy: str


QUESTIONS = (
    Question(
        1,
        'drivers off at start',
        'Battery on, USB off: do both wheels turn freely by hand?',
        'pull-up R5 at ENABLE is missing',
    ),
    Question(
        4,
        'range of the radio',
        'Did ping at the far end of the room give more than 95 %?',
        'another channel: t3mpc robot setup --channel',
    ),
    Question(
        10,
        'signs of the sensors',
        'Turned left by hand: is imu/data_raw z positive, and do range/* follow a hand?',
        'sensor upside down; order of A0 to A7',
    ),
    Question(
        11,
        'emergency stop',
        'Driving, button pressed: do the wheels stop, and stay so after its release?',
        'contact of the button, wire at pin 3',
    ),
    Question(
        12,
        'bridge killed',
        'Driving, bridge ended with kill -9: were the wheels at rest within half a second?',
        'do not continue',
    ),
    Question(
        13,
        'dongle unplugged',
        'The same with the dongle unplugged; did it drive again within 2 s of plugging it in?',
        'udev rule: the port must keep its name',
    ),
    Question(
        14,
        'supply cut',
        'Robot supply cut for a second while driving: did nothing move afterwards?',
        'drivers must be off after a reset: R5 at ENABLE',
    ),
)
DRIVEN = (
    Question(
        6,
        'left wheel',
        'Did the LEFT wheel make exactly one turn FORWARD?',
        'other wheel: motors swapped; backward: t3mpc robot setup --invert left; half or double: '
        '--microsteps as the jumpers',
    ),
    Question(
        7,
        'right wheel',
        'Did the RIGHT wheel make exactly one turn FORWARD?',
        't3mpc robot setup --invert right, or both',
    ),
)
"""Questions after one turn of the left and of the right wheel."""


class BoardFindings(NamedTuple):
    """What the robot board reports over its USB port."""

    pong: Pong
    settings: StoredSettings
    calibration: eeprom_records.Stored[Calibration]  # all None unless the robot holds one
    log: tuple[LogEntry, ...]
    samples: tuple[Samples, ...]  # at rest


def examine_board() -> Script[BoardFindings]:
    """Return the records, the log and two seconds of samples of the robot board."""
    pong = yield from wait_for_board()
    settings = yield from read_settings()
    stored = yield from eeprom_records.read_record(CALIBRATION_RECORD)
    calibration = stored.decoded(eeprom_records.decode_calibration)
    log = yield from read_log()
    samples = []
    for _ in range(SAMPLE_COUNT):
        samples.append((yield from eeprom_records.read_samples()))
        yield Pause(_SAMPLE_PERIOD)
    return BoardFindings(pong, settings, calibration, log, tuple(samples))


def check_builds(dongle: Pong | None, robot: Pong | None) -> Check:
    """Return whether both boards have the same firmware."""
    if dongle is None or robot is None:
        return Check(5, 'build ids equal', SKIPPED, 'one of the boards did not answer')
    same = dongle.build == robot.build
    value = f'dongle {dongle.build:08x}, robot {robot.build:08x}'
    remedy = 'flash both boards from the same sources: make -C firmware flash, flash-dongle'
    return Check(5, 'build ids equal', PASS if same else FAIL, value, remedy)


def check_board(found: BoardFindings, parameters: LinkParameters) -> list[Check]:
    """Return what the robot board itself shows."""
    return [
        _verdict(
            2,
            'radio chip of the robot',
            bool(found.pong.chip_ok),
            'holds its configuration' if found.pong.chip_ok else 'does not answer',
            'wiring and supply of the radio; CSN, CE',
        ),
        *_check_settings(found, parameters),
        _check_calibration(found.calibration),
        _check_log(found.log),
        _check_battery(found, parameters),
        *_check_imu(found.samples),
        _check_ranges(found),
    ]


def _verdict(step: int, name: str, good: bool, value: str, remedy: str) -> Check:
    return Check(step, name, PASS if good else FAIL, value, remedy)


def _check_settings(found: BoardFindings, parameters: LinkParameters) -> list[Check]:
    state, settings = found.settings
    checks = [
        _verdict(
            5,
            'settings stored',
            state == frames.SETTINGS_GOOD,
            SETTINGS_TEXTS[state],
            't3mpc robot setup --microsteps …',
        )
    ]
    if found.settings.valid:
        robot = settings.address.hex(), settings.channel, settings.rate
        host = parameters.address, parameters.channel, parameters.rate
        checks.append(
            _verdict(
                5,
                'settings equal to those of the host',
                robot == host,
                f'robot {" ".join(map(str, robot))}, host {" ".join(map(str, host))}',
                't3mpc robot setup --save robot.yaml, then --params-file robot.yaml',
            )
        )
    return checks


def _check_calibration(stored: eeprom_records.Stored[Calibration]) -> Check:
    usable, found = stored.valid or stored.state == frames.SETTINGS_MISSING, stored.content
    if stored.valid:
        parts = [name for name in found._fields[:-1] if getattr(found, name) is not None]
        curves = sum(curve is not None for curve in found.curves)
        value = ', '.join([*parts, f'{curves} curves'])
    else:
        value = 'never calibrated: nominal values' if usable else 'damaged'
    return _verdict(0, 'calibration', usable, value, 't3mpc robot calibrate')


def _check_log(log: Sequence[LogEntry]) -> Check:
    resets = [entry.value for entry in log if entry.kind == LogKind.BOOT]
    watchdog = sum(bool(value & _WATCHDOG) for value in resets)
    # Switching on can brown out as well.
    dips = sum(value & 7 == _BROWN_OUT for value in resets)
    return _verdict(
        0,
        'resets in the log',
        not watchdog and not dips,
        f'{len(resets)} boots, {watchdog} by the watchdog, {dips} after a dip of the supply',
        'watchdog: report the output of t3mpc robot log; dips: 5 V supply, wires, capacitors',
    )


def _check_battery(found: BoardFindings, parameters: LinkParameters) -> Check:
    counts = [sample.battery for sample in found.samples]
    if any(count >= CONVERTER_COUNTS for count in counts):
        return Check(9, 'battery', FAIL, 'not measured', 'divider at A8')
    voltage = nominal_battery_voltage(float(np.mean(counts)), found.settings.content.divider)
    if (divider := found.calibration.content.divider) is not None:
        voltage = divider.voltage(voltage)
    low = parameters.robot.battery_low
    value = f'{voltage:.1f} V' if voltage >= 1.0 else 'not connected'
    return _verdict(
        9, 'battery', voltage >= low, value, f'at least {low:g} V: charge it; divider at A8'
    )


def _check_imu(samples: Sequence[Samples]) -> list[Check]:
    registers = np.array([sample[3:] for sample in samples], dtype=float)
    accel = registers[:, :3].mean(axis=0) * _IMU.acceleration_step / GRAVITY
    rate_step = math.degrees(_IMU.rate_step)
    if not registers.any():
        wires = 'SDA at 20, SCL at 21, level shifter, supply'
        return [Check(9, 'inertial sensor', FAIL, 'does not answer', wires)]
    gravity, upward = float(np.linalg.norm(accel)), float(accel[2])
    bias = rate_step * float(np.abs(registers[:, 3:].mean(axis=0)).max())
    noise = rate_step * float(registers[:, 3:].std(axis=0).max())
    moved = 'the robot must stand still; otherwise a bad sensor'
    return [
        _verdict(
            9,
            'gravity',
            abs(gravity - 1.0) <= _GRAVITY_TOLERANCE and upward > 0.9 * gravity,
            f'{gravity:.3f} g, z up {upward:.3f} g',
            'sensor flat, z up, x forward; the robot level and at rest',
        ),
        _verdict(9, 'rate at rest', bias <= MAX_GYRO_BIAS, f'{bias:.2f} deg/s', moved),
        _verdict(9, 'noise of the rate', 0.0 < noise <= _MAX_NOISE, f'{noise:.3f} deg/s', moved),
    ]


def _check_ranges(found: BoardFindings) -> Check:
    counts = np.array([eeprom_records.range_counts(sample) for sample in found.samples])
    problems = []
    used = 0
    for number, kind in enumerate(found.settings.content.sensors):
        if kind == 'none':
            continue
        used += 1
        column = counts[counts[:, number] != eeprom_records.NOT_MEASURED, number]
        if not column.size:
            problems.append(f'A{number} not measured')
        elif (column > MAX_SHARP_COUNT).any():
            problems.append(f'A{number} at the supply')
        elif not column.any():
            problems.append(f'A{number} at ground')
    value = ', '.join(problems) or f'{used} sensors between 0 and 4.8 V'
    remedy = 'wires of the sensor; a sensor that is not there: t3mpc robot setup --sensors'
    return _verdict(10, 'distance sensors', not problems, value, remedy)
