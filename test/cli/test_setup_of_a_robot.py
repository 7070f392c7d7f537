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
"""From an erased board to a calibrated, driving robot with the commands of the pages.

Virtual time, on the emulated boards and on the firmware of both boards in simavr.
"""

from contextlib import ExitStack
import math
import os
from pathlib import Path
import re
import shlex
import sys

import numpy as np
import pytest
from support.avr_bench import on_avr
from support.calibration_bench import Person
from support.emulator_bench import CablePort, RobotBench
from support.missing_tools import AVR, needing
from support.tool_bench import START_NS, ToolBench
import yaml

from t3mpc_ros.cli import robot as cli
from t3mpc_ros.cli import robot_calibrate
from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters
from t3mpc_ros.radio.link.actions_and_states import LinkState
from t3mpc_ros.radio.protocol.authentication import read_key
from t3mpc_ros.radio.radio_robot import RadioRobotParameters
from t3mpc_ros.radio.tool import procedure

ROOT = Path(__file__).resolve().parents[2]
WHEEL_CIRCUMFERENCE = 0.2199
"""m"""
ERRORS = {
    'twin.right_wheel_radius_multiplier': 1.02,
    'twin.left_wheel_radius_multiplier': 1.02,
    'twin.wheel_separation_multiplier': 1.03,
    'twin.imu.gyro_scale_error': 0.03,
}
DONGLE, ROBOT = {'/dev/t3mpc_dongle', 'dongle'}, {'/dev/ttyACM0', 'robot_usb'}
"""Names of the two ports in the pages."""
SHORTENED = {
    'jog left 50 ': 'jog left 2 ',
    'calibrate --port /dev/t3mpc_dongle': (
        'calibrate --port /dev/t3mpc_dongle --steps rest,radius,track --turns 5 --speed 8'
    ),
    'calibrate --port /dev/t3mpc_dongle --robot-port /dev/ttyACM0': (
        'calibrate --port /dev/t3mpc_dongle --robot-port /dev/ttyACM0 --steps battery'
    ),
    'calibrate --robot-port /dev/ttyACM0': (
        'calibrate --robot-port /dev/ttyACM0 --steps rest --save cable.yaml'
    ),
}
"""What takes many minutes, with fewer turns or steps."""


def documented_commands():
    """Return the commands from a new board to a calibrated robot, in the order of the pages.

    As the pages say, those of the checklist and of the calibration get file and key; the section
    that needs no robot is left out.
    """
    text = (ROOT / 'docs' / 'robot.md').read_text()
    text = re.sub(r'^## Try it without a robot\n.*?(?=^## )', '', text, flags=re.M | re.S)
    before, _, checklist = text.partition('## Bench checklist')
    commands = _commands(before)
    more = '--params-file robot.yaml --key ~/.t3mpc_key'
    commands += _commands(checklist.partition('| # |')[0])
    for line in re.findall(r'^\| \d+ \|.*', checklist, re.M):
        _, _, step, _, otherwise, _ = line.split('|')
        (channel,) = re.findall(r'`t3mpc robot (setup --channel.*?)`', otherwise) or ['']
        if channel:
            commands.append(f't3mpc robot {channel} --port /dev/ttyACM0 --yes')
        for command in re.findall(r'`(t3mpc robot .*?)`', step):
            if 'calibrate' not in command:
                command = command.replace(' [--key FILE]', '').replace('…', '/dev/t3mpc_dongle')
                keyed = 'jog' in command or 'parameters' in command
                commands.append(f'{command} {more if keyed else more.partition(" --key")[0]}')
    commands += _commands(checklist.partition('| # |')[2])
    calibration = _commands((ROOT / 'docs' / 'calibration.md').read_text())
    commands += [f'{command} {more}' for command in map(_shortened, calibration)]
    return [shlex.split(_shortened(command)) for command in commands]


def _commands(text):
    """Return the commands of the package in the blocks of a text."""
    blocks = ''.join(re.findall(r'```(?:sh|console)\n(.*?)```', text, re.S))
    return re.findall(r'^scripts/run (.*)', blocks, re.M)


def _shortened(command):
    for long, short in SHORTENED.items():
        if command.endswith(long) or (long.endswith(' ') and long in command):
            return command.replace(long, short)
    return command


class Walk:
    """Executes the commands at the ports of one robot, at first with erased EEPROM."""

    def __init__(self, emulator, monkeypatch, capsys):
        self.bench = ToolBench(emulator=emulator)
        self.person = person = Person(self.bench)
        self._capsys = capsys
        self.questions = []
        monkeypatch.setattr(procedure, 'run_at_port', self._run_at_port)
        monkeypatch.setattr(robot_calibrate, '_asker', lambda stop: person.ask)
        monkeypatch.setattr(robot_calibrate, '_show', person.show)
        monkeypatch.setattr(cli, 'ask_line', self._agree)
        monkeypatch.setattr(sys.stdin, 'isatty', lambda: True)

    def _agree(self, question, stop):
        self.questions.append(question)
        return 'yes'

    def _run_at_port(self, task, path, interrupted, device='the dongle'):
        assert path in DONGLE | ROBOT
        self.bench.run(task, robot=path in ROBOT)

    def robot(self, arguments):
        """Execute a command of the bench tool; return its output."""
        arguments = [os.path.expanduser(word) for word in arguments]
        assert cli.main(arguments) == 0, self._capsys.readouterr()
        return self._capsys.readouterr().out

    def bridge(self, arguments):
        """Return the host of radio_bridge with these arguments, at the same boards."""
        marker, *rest = arguments
        assert marker == '--ros-args'
        values, key, emulator = {}, b'', self.bench.emulator
        for option, text in zip(rest[::2], rest[1::2], strict=True):
            if option == '--params-file':
                content = yaml.safe_load(Path(text).read_text())['/**']['ros__parameters']
                values |= {f'link.{name}': value for name, value in content['link'].items()}
                continue
            name, value = text.split(':=')
            assert option == '-p'
            if name == 'key_file':
                key = read_key(Path(os.path.expandvars(value)))
            else:
                assert name == 'port'
                emulator = CablePort(emulator) if value in ROBOT else emulator
        RadioRobotParameters.from_dict(values)
        return RobotBench(values, key=key, emulator=emulator)

    def leave(self, host):
        """End a host of radio_bridge as by Ctrl-C: it disables the drives."""
        host.robot.shut_down()
        host.run(5.0, lambda: host.link.state is LinkState.DONE)
        self.bench.now_ns = host.now_ns


@pytest.fixture(
    params=[
        'emulator',
        pytest.param(
            'avr',
            marks=[
                pytest.mark.long,
                needing(*AVR),
            ],
        ),
    ]
)
def walk(request, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('HOME', str(tmp_path))
    with ExitStack() as stack:
        if request.param == 'avr':
            emulator = stack.enter_context(on_avr(flat=ERRORS, erased=True)).emulator
        else:
            parameters = EmulatorParameters.from_dict(ERRORS)
            emulator = Emulator(parameters, b'', 1, START_NS, erased=True)
        yield Walk(emulator, monkeypatch, capsys)


@pytest.mark.long
def test_documented_commands_lead_to_a_driving_robot(walk):
    unset = RobotBench(emulator=walk.bench.emulator)
    unset.drive(4.0, 4.0)
    unset.run(2.0)
    assert 'no settings' in unset.link.reason(unset.now_ns)
    assert walk.bench.board.counters == (0, 0)
    walk.leave(unset)

    # Not stored twice: after the start of the robot, its gyro has another bias.
    walk.person.answers = {'Voltage of the meter': ['skip'], 'Store these': ['yes', 'no']}
    turned = np.zeros(2)
    for words in documented_commands():
        match words:
            case ['t3mpc', 'robot', 'jog', wheel, turns, *_]:
                before = np.array(walk.bench.board.counters)
                output = walk.robot(words[2:])
                turned += np.array([wheel == 'left', wheel == 'right']) * float(turns)
                after = np.array(walk.bench.board.counters) - before
                wanted = 3200 * float(turns) * np.array([wheel == 'left', wheel == 'right'])
                # At 0.2 rad/s, the last state is up to a cycle old, and the stop takes another.
                assert after == pytest.approx(wanted, abs=8)
                assert f'target {wanted.max():.0f}' in output
                assert 'in the air' in walk.questions[-1]
            case ['t3mpc', 'robot', *arguments]:
                walk.robot(arguments)
            case ['radio_bridge', *arguments]:
                expect_a_driving_robot(walk, walk.bridge(arguments))
            case _:
                raise AssertionError(f'the command must be known: got {words}')
    assert turned.tolist() == [4.0, 2.0]  # over the cable and the radio
    settings = yaml.safe_load(Path('robot.yaml').read_text())
    assert settings['/**']['ros__parameters']['link']['channel'] == 100
    values = yaml.safe_load(Path('calibration.yaml').read_text())
    values = values['/**/radio_bridge']['ros__parameters']
    over_cable = yaml.safe_load(Path('cable.yaml').read_text())
    over_cable = over_cable['/**/radio_bridge']['ros__parameters']
    for name in ('wheel_radius', 'wheel_separation'):  # as stored in the robot
        assert over_cable[name] == pytest.approx(values[name], rel=1e-4)
    host = RobotBench(values, key=read_key(Path('.t3mpc_key')), emulator=walk.bench.emulator)
    host.connect()
    host.run(3.0)
    bias = over_cable['calibration.gyro_bias']
    assert host.robot._odometry.bias == pytest.approx(bias, abs=1e-3)
    expect_exact_odometry(host)


def expect_a_driving_robot(walk, host):
    """It drives as commanded; over the cable, it rests in time when that is unplugged."""
    start = host.plant.pose
    host.connect()
    host.run(1.5)
    host.drive(4.0, 4.0)
    host.run(2.0)
    assert host.link.reason(host.now_ns) == ''
    assert host.link.authenticated
    if host.link.over_cable:
        host.emulator.unplugged = True
        host.run(0.45)
        assert walk.bench.board.speeds == (0, 0)
        host.emulator.unplugged = False
        host.run(3.0)
    else:
        end = host.plant.pose
        driven = math.hypot(end.x - start.x, end.y - start.y)
        assert driven == pytest.approx(2.0 * 4.0 * WHEEL_CIRCUMFERENCE / 6.2832, rel=0.1)
    host.drive(0.0, 0.0)
    host.run(0.5)
    assert host.link.telemetry.status.enabled
    walk.leave(host)


def expect_exact_odometry(host):
    """With nominal values it would be wrong by 2 % of the way and 1 % of the turn."""
    start, before = host.plant.pose, host.states[-1].odometry.pose
    host.drive(6.0, 6.0)
    host.run(4.0)
    host.drive(0.0, 0.0)
    host.run(1.0)
    middle, between = host.plant.pose, host.states[-1].odometry.pose
    true = math.hypot(middle.x - start.x, middle.y - start.y)
    assert true > 0.7
    assert math.hypot(between.x - before.x, between.y - before.y) == pytest.approx(true, rel=2e-3)
    host.states.clear()
    yaws = [host.plant.pose.yaw]
    for step in range(110):
        host.drive(*((4.0, -4.0) if step < 100 else (0.0, 0.0)))
        host.run(0.1)
        yaws.append(host.plant.pose.yaw)
    true = unwrapped(yaws)
    assert abs(true) > 15.0
    found = unwrapped([state.odometry.pose.yaw for state in host.states])
    assert found == pytest.approx(true, rel=2e-3)


def unwrapped(yaws):
    """Return the angle between the first and the last of many yaws."""
    continuous = np.unwrap(yaws)
    return continuous[-1] - continuous[0]
