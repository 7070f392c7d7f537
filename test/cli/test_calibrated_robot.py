# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""From an erased board to a calibrated, driving robot, with the commands of docs/robot.md.

Virtual time, on the emulated boards and on the firmware of both boards in simavr.
"""

from contextlib import ExitStack
import math
import sys

import numpy as np
import pytest
from support.avr_bench import on_avr
from support.calibration_bench import CalibrationBench, Person
from support.emulator_bench import RobotBench
from support.missing_tools import AVR, needing
import yaml

from t3mpc_ros.cli import robot as cli
from t3mpc_ros.cli import robot_calibrate
from t3mpc_ros.radio.protocol.authentication import read_key
from t3mpc_ros.radio.tool import procedure

ERRORS = {
    'twin.right_wheel_radius_multiplier': 1.02,
    'twin.left_wheel_radius_multiplier': 1.02,
    'twin.wheel_separation_multiplier': 1.03,
    'twin.imu.gyro_scale_error': 0.03,
}
SETUP = (
    'setup --port usb --microsteps 16 --save robot.yaml --yes',
    'key create robot.key',
    'key write robot.key --port usb',
    'calibrate --port dongle --robot-port usb --params-file robot.yaml --key robot.key '
    '--steps rest,radius,track --turns 5 --speed 8',
)


NEEDS_TOOLS = needing(*AVR)


@pytest.fixture(params=['emulator', pytest.param('avr', marks=[pytest.mark.long, NEEDS_TOOLS])])
def bench(request):
    """Return a bench with a robot whose EEPROM is erased."""
    if request.param == 'emulator':
        yield CalibrationBench(erased=True, **ERRORS)
        return
    with ExitStack() as stack:
        emulator = stack.enter_context(on_avr(flat=ERRORS, erased=True)).emulator
        yield CalibrationBench(emulator=emulator)


@pytest.mark.slow
def test_a_new_robot_is_set_up_calibrated_and_knows_where_it_is(bench, monkeypatch, tmp_path):
    """With nominal values its odometry would be wrong by 2 % of the way and 1 % of the turn."""
    monkeypatch.chdir(tmp_path)
    person = Person(bench)
    monkeypatch.setattr(
        procedure,
        'run_at_port',
        lambda task, path, stop, device='': bench.run(task, robot=path == 'usb'),
    )
    monkeypatch.setattr(robot_calibrate, '_asker', lambda stop: person.ask)
    monkeypatch.setattr(robot_calibrate, '_show', person.show)
    monkeypatch.setattr(sys.stdin, 'isatty', lambda: True)
    for command in SETUP:
        assert cli.main(command.split()) == 0

    content = yaml.safe_load((tmp_path / 'calibration.yaml').read_text())
    values = content['/**/radio_bridge']['ros__parameters']
    host = RobotBench(values, key=read_key(tmp_path / 'robot.key'), emulator=bench.emulator)
    host.connect()
    host.run(3.0)
    start, before = host.plant.pose, host.states[-1].odometry.pose
    host.drive(6.0, 6.0)
    host.run(4.0)
    host.drive(0.0, 0.0)
    host.run(1.0)
    middle, between = host.plant.pose, host.states[-1].odometry.pose
    true = math.hypot(middle.x - start.x, middle.y - start.y)
    found = math.hypot(between.x - before.x, between.y - before.y)
    assert true > 0.7
    assert found == pytest.approx(true, rel=2e-3)
    true = turned(host, 10.0)
    found = unwrapped(state.odometry.pose.yaw for state in host.states)
    assert abs(true) > 15.0
    assert found == pytest.approx(true, rel=2e-3)


def turned(host, seconds):
    """Turn on the spot; return the true angle."""
    host.states.clear()
    yaws = [host.plant.pose.yaw]
    host.drive(4.0, -4.0)
    for step in range(round(10.0 * (seconds + 1.0))):
        if step == round(10.0 * seconds):
            host.drive(0.0, 0.0)
        host.run(0.1)
        yaws.append(host.plant.pose.yaw)
    return unwrapped(yaws)


def unwrapped(yaws):
    """Return the angle between the first and the last of many yaws."""
    continuous = np.unwrap(list(yaws))
    return continuous[-1] - continuous[0]
