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
"""The calibration wizard against the emulated boards, in virtual time."""

import math
import os
from pathlib import Path
import re
import shlex
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from support.calibration_bench import Person
from support.tool_bench import START_NS, ToolBench
import yaml

from t3mpc_ros.cli import robot as robot_cli
from t3mpc_ros.cli import robot_calibrate as cli
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.nodes.registry import parameter_class
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.tool import eeprom_records, procedure
from t3mpc_ros.radio.tool.calibration_wizard import (
    CalibrationRobot,
    CalibrationWizard,
    WizardOptions,
)
from t3mpc_ros.robot import calibration
from t3mpc_ros.robot.calibration import (
    COVERAGE,
    Calibration,
    CalibrationError,
    DividerCorrection,
    Estimate,
    Recording,
    SharpCurve,
)
from t3mpc_ros.simulation.sensors.range_sensor import output_voltage

RADIUS, TRACK = 1.02 * 0.035, 1.03 * 0.147
ERRORS = {
    'twin.right_wheel_radius_multiplier': 1.02,
    'twin.left_wheel_radius_multiplier': 1.02,
    'twin.wheel_separation_multiplier': 1.03,
    'twin.imu.gyro_scale_error': 0.03,
    # Without power the smooth friction of the twin lets any torque move the wheels.
    'twin.disturbance.bound': 0.0,
}


@pytest.fixture
def person(monkeypatch):
    bench = ToolBench(**ERRORS)
    monkeypatch.setattr(
        procedure,
        'run_at_port',
        lambda task, path, stop, device='': bench.run(task, robot='ACM' in path, seconds=300.0),
    )
    return Person(bench)


class PerfectRobot(CalibrationRobot):
    """Drives as commanded, with the errors of the twin, in no time."""

    def drive(self, angles, speed, rests):
        duration = max(map(abs, angles)) / speed
        times = np.arange(0.0, sum(rests) + duration, 0.02)
        share = np.clip((times - rests[0]) / duration, 0.0, 1.0)
        rate = 1.03 * (angles.right - angles.left) * RADIUS / TRACK / duration
        begin, end = np.searchsorted(times, (rests[0], rests[0] + duration))
        rates = np.where((share > 0.0) & (share < 1.0), rate, 0.0)
        return Recording(times, share * angles.right, share * angles.left, rates, begin, end)


def wizard(person, *steps, start=None, robot_port='', robot=CalibrationRobot, **options):
    robot = robot(
        *('dongle', robot_port, LinkParameters(), b''), os.urandom, lambda: False, person.show
    )
    options = WizardOptions(steps=steps, **options)
    return CalibrationWizard(robot, person.ask, person.show, options, start or Calibration())


@pytest.mark.long
@pytest.mark.slow
def test_a_whole_run_finds_the_errors_of_the_twin(person, monkeypatch, tmp_path):
    """The command of docs/calibration.md: transcript, file, and record of the robot."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, '_asker', lambda stop: person.ask)
    monkeypatch.setattr(cli, '_show', person.show)
    monkeypatch.setattr(sys.stdin, 'isatty', lambda: True)
    person.answers = {f'{side}: put the board': ['skip'] for side in ('left', 'rear', 'right')}
    for line in _transcript()[0]:
        command = shlex.split(line.removeprefix('scripts/run t3mpc robot '))
        assert robot_cli.main(command) == 0
    assert _numberless(person.transcript) == _numberless(_transcript()[1])

    found, _ = cli.read_parameter_file(tmp_path / 'calibration.yaml')
    for estimate, true in (
        (found.wheel_radius, RADIUS),
        (found.track, TRACK),
        (found.gyro_scale, 1.0 / (1.0 + 0.03 * person.plant._imu._scale)),
    ):
        assert abs(estimate.value - true) < 1.5 * COVERAGE * estimate.uncertainty
        assert estimate.uncertainty < 1e-3 * estimate.value
    for number in (0, 1):
        curve = found.curves[number]
        offset = person.plant._parameters.range_sensor.voltage_offset
        volts = output_voltage(0.3) + offset * person.plant._ranges._offsets[number]
        distance = curve.scale / (volts - curve.offset) - curve.shift
        assert abs(distance - 0.3) < 1.5 * COVERAGE * curve.uncertainty
    assert found.curves[2:] == 6 * (None,)
    # The converter truncates: half a count of 20 mV.
    volts = 11.0 - 0.0098
    corrected = found.divider.voltage(volts)
    assert abs(corrected - 11.0) < 1.5 * COVERAGE * found.divider.uncertainty

    stored = person.bench.at_robot(eeprom_records.read_calibration())
    for in_robot, in_file in zip(stored[:4], found[:4], strict=True):
        assert in_robot.value == pytest.approx(in_file.value, abs=2e-5)
    assert stored.curves[0][:3] == pytest.approx(found.curves[0][:3], abs=1e-4)


def _transcript():
    """Return the commands of the two passes on the page, and what they print."""
    text = (Path(__file__).resolve().parents[2] / 'docs' / 'calibration.md').read_text()
    commands = re.findall(r'```sh\n(scripts/run t3mpc robot calibrate .*?)\n```', text)
    (printed,) = re.findall(r'^```text\n(.*?)\n```', text, re.DOTALL | re.MULTILINE)
    return commands[:2], printed


def _numberless(text):
    """Return the lines of a text without numbers, whose last digits depend on the processor."""
    lines = [line.rstrip() for line in text.splitlines()]
    return [re.sub(r'[-+]?\d+(\.\d+)?', '#', line) for line in lines]


def test_nothing_moves_without_a_yes(person):
    person.moves = False
    person.answers = {'Enter to repeat': ['skip']}
    found = wizard(person, 'radius', 'track').run()
    assert found == Calibration()
    assert person.plant.pulses == (0, 0)
    assert person.transcript.count('Left out') == 2
    assert 'the track needs a wheel radius' in person.transcript


@pytest.mark.parametrize('fault', ['jam', 'silence', 'button', 'close_port', 'robot_reset'])
def test_a_fault_stops_the_drive_for_good(person, fault):
    """Whatever the link does afterwards, the wheels do not turn again."""
    bench = person.bench
    faults = []

    def inject(bench):
        if not faults and person.plant.pulses[0] > 800:
            faults.append(bench.now_ns)
            bench.emulator.inject(fault, 0.4)

    bench.each = inject
    person.answers = {'Enter to repeat': [_after(bench, 3.0)]}
    found = wizard(person, 'radius').run()
    assert found == Calibration()
    assert 'Refused: ' in person.transcript
    stopped = person.plant.stopped_at
    # The time to live, and the ramp from 4 rad/s at 8 rad/s².
    assert stopped - (faults[0] - START_NS) / 1e9 < 0.25 + 0.5 + 0.2
    assert bench.now_ns - faults[0] > 3e9


def _after(bench, seconds):
    def answer():
        bench.wait(seconds)
        return 'skip'

    return answer


def test_a_misread_distance_is_asked_for_again(person):
    """A typo cost the drive, and twice the way in both runs gave a wheel of 70 mm."""
    answers = ['-2', '1', '0.5 m', '0.55', *3 * ['0.51']]
    person.answers = {'Between both marks': answers, 'Enter to repeat': ['']}
    found = wizard(person, 'radius', distance=0.5, speed=8.0, robot=PerfectRobot).run()
    shown = person.transcript
    for answer in ('-2', '1'):
        assert f'must be from 0.4 to 0.6 m: got {answer}; the wheels drove 0.50 m' in shown
    assert "must be a number, or skip: got '0.5 m'" in shown
    # The other way is measured well: which one is wrong, only another drive can tell.
    assert 'the wheel radius (m) must be the same in all runs within 2 %: got 0.0385 and' in shown
    assert shown.count('Move now?') == 4
    assert found.wheel_radius.value == pytest.approx(RADIUS)


def test_a_misread_distance_of_the_board_is_asked_for_again(person):
    """-0.1 and 1e9 m were refused after all six placements, with another reason."""
    person.answers = {'front: put': ['-0.1', '1e9'], 'Store these values': ['no']}
    person.answers |= {f'{side}: put': ['skip'] for side in ('left', 'rear', 'right')}
    found = wizard(person, 'ranges', robot_port='ttyACM0').run()
    for answer in ('-0.1', '1e+09'):
        assert f'board must be from 0.05 to 0.2 m: got {answer}; measure' in person.transcript
    assert person.transcript.count('front: put the board') == 2 + 6
    assert found.curves[0] is not None


def test_a_loose_wire_is_named_at_the_first_placement(person):
    """It was, after all six."""
    person.plant._distances[:] = 1e-3
    person.answers = {'front: put': ['', 'skip'], 'Store these values': ['no']}
    person.answers |= {f'{side}: put': ['skip'] for side in ('left', 'rear', 'right')}
    wizard(person, 'ranges', robot_port='ttyACM0').run()
    assert 'front_left: counts must be from 12 to 983: got' in person.transcript


def test_a_misread_voltage_is_asked_for_again(person):
    """12.5 V, then 120 V, gave *must be at least 1 V apart: got 0.00*; -12 V was accepted."""
    person.answers = {'meter, first': ['120', '-12'], 'meter, second': ['12.5']}
    person.answers |= {'Store these values': ['no']}
    found = wizard(person, 'battery', robot_port='ttyACM0').run()
    for answer in ('120', '-12'):
        assert re.search(
            rf'meter must be from \S+ to \S+ V: got {answer}; the robot measured 1\S+ V',
            person.transcript,
        )
    assert re.search(r'1 V apart: got 1\S+ and 1\S+ V, measured by the robot', person.transcript)
    assert abs(found.divider.gain) < 0.1
    assert 'Enter to repeat' not in person.transcript


def test_a_track_far_from_the_nominal_one_is_refused(person):
    """Any was accepted: of turns that were miscounted, or by a wrong wheel radius."""
    person.answers = {'Degrees from the mark': ['-13.4', '13.4'], 'Enter to repeat': ['skip']}
    start = Calibration(wheel_radius=Estimate(RADIUS, 1e-5))
    given = {'speed': 4.0, 'turns': 2, 'geometry': WheelGeometry(0.035, 0.3)}
    found = wizard(person, 'track', start=start, robot=PerfectRobot, **given).run()
    assert 'the track must be from 0.24 to 0.36 m: got 0.15' in person.transcript
    assert found == start


def test_turns_that_are_refused_count_for_nothing(person, monkeypatch):
    """Their marks were misread: by 90 degrees in ten turns, 2.5 % of the scale of the gyro."""
    estimate, refused = calibration.estimate_track, []

    def refuse_once(turns, *others):
        if not refused:
            refused.append(turns)
            raise CalibrationError('misread')
        return estimate(turns, *others)

    monkeypatch.setattr(calibration, 'estimate_track', refuse_once)
    answers = ['-14.9', '14.9', '-104.9', '104.9']
    person.answers = {'Degrees from the mark': answers, 'Enter to repeat': ['']}
    start = Calibration(wheel_radius=Estimate(RADIUS, 1e-5))
    found = wizard(person, 'track', start=start, robot=PerfectRobot).run()
    assert refused
    error = abs(found.gyro_scale.value - 1.0 / 1.03)
    assert error < 1.5 * COVERAGE * found.gyro_scale.uncertainty < 0.005


@pytest.mark.parametrize('rate', [0.4, -0.4])
def test_a_bias_of_a_robot_that_turns_is_refused(person, rate):
    """Any was taken, and beyond 0.57 rad/s only the robot refused it, after all other steps."""
    times = np.arange(0.0, 10.0, 0.02)
    none = np.zeros_like(times)
    turning = Recording(times, none, none, none + rate, len(times), len(times))
    person.answers = {'Enter to repeat': ['skip']}
    made = wizard(person, 'rest')
    made._robot.rest = lambda seconds: turning
    assert made.run() == Calibration()
    degrees = math.degrees(rate)
    assert f'gyro must be from -20 to 20 deg/s: got {degrees:.4g}; the robot' in person.transcript


def test_what_is_left_out_keeps_its_value(person):
    start = Calibration(Estimate(0.036, 1e-4), Estimate(0.15, 1e-3), None, Estimate(0.1, 1e-3))
    person.answers = {'Enter to begin': ['skip']}
    assert wizard(person, 'rest', start=start).run() == start
    assert 'wheel radius        36.000 ± 0.196 mm' in person.transcript


def test_raw_counts_need_the_usb_of_the_robot(person):
    """Without it, both steps are not offered."""
    assert wizard(person, 'ranges', 'battery').run() == Calibration()
    assert 'Step' not in person.transcript


def test_a_robot_on_a_cable_is_not_moved(person):
    """It would drive 2 m and turn ten times."""
    person.moves = False
    person.answers = {'Store these values': ['no']}
    wizard(person, 'rest', 'radius', 'track', 'hand', robot_port='ttyACM0').run()
    assert 'Step' not in person.transcript
    assert person.plant.pulses == (0, 0)


# -- parameter file -------------------------------------------------------------------------------

CURVE = SharpCurve(0.2793, 0.0261, 0.0553, 0.004)
WHOLE = Calibration(
    Estimate(0.0356, 2e-5),
    Estimate(0.1514, 9e-5),
    Estimate(0.9873, 3e-4),
    Estimate(-0.021, 1.6e-4),
    DividerCorrection(0.0123, -0.04, 0.03),
    (CURVE, None, CURVE, *5 * (None,)),
)


@pytest.mark.parametrize('found', [WHOLE, Calibration(), WHOLE._replace(wheel_radius=None)])
def test_the_parameter_file_holds_the_calibration(found, tmp_path):
    path = tmp_path / 'calibration.yaml'
    link = {'channel': 100, 'address': '12345e6789'}
    path.write_text(cli.calibration_file(found, '2026-11-22', link))
    assert cli.read_parameter_file(path) == (found, link)
    assert "link.address: '12345e6789'" in path.read_text()
    assert '&' not in path.read_text()  # the parser of ROS knows no aliases
    for node, values in yaml.safe_load(path.read_text()).items():
        name = node.removeprefix('/**/')
        parameters = parameter_class(name).from_dict(values['ros__parameters']).to_dict()
        if found.wheel_radius is not None:
            assert parameters['wheel_radius'] == 0.0356


ANOTHER = '12345e6789'  # address of a robot that is not connected
ROBOT_PORT = '--robot-port /dev/ttyACM0'


@pytest.mark.parametrize('words', ['', ROBOT_PORT, f'{ROBOT_PORT} --set address={ANOTHER}'])
def test_another_robot_gets_no_calibration(words, person, monkeypatch, tmp_path, capsys):
    """The values of a file were stored in whichever robot was connected."""
    path = tmp_path / 'calibration.yaml'
    if ANOTHER not in words:
        path.write_text(cli.calibration_file(WHOLE, '2026-11-22', {'address': ANOTHER}))
    monkeypatch.setattr(sys, 'stdin', SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(cli, '_asker', lambda stop: lambda question: 'skip')
    before = person.bench.at_robot(eeprom_records.read_calibration())
    words = f'calibrate --port /dev/t3mpc_dongle --save {path} {words}'
    assert robot_cli.main(words.split()) == 2
    error = capsys.readouterr().err
    assert f'of the robot at address {ANOTHER}, and this robot has 54334d5043: give' in error
    assert person.bench.at_robot(eeprom_records.read_calibration()) == before


@pytest.mark.parametrize(
    'text, words',
    [
        ('a: [', 'is not YAML: line 1'),
        ('/**:\n  ros__parameters: {}\n', 'must be a parameter file'),
        (
            '/**/radio_bridge:\n  ros__parameters: {wheel_radius: 3.5}\n',
            'other.yaml: wheel_radius must be from 0.005 to 1 m: got 3.5',
        ),
    ],
)
def test_another_file_is_refused(text, words, tmp_path):
    path = tmp_path / 'other.yaml'
    path.write_text(text)
    with pytest.raises(ParameterError, match=words):
        cli.read_parameter_file(path)
