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
"""Digital twin: determinism, convergence, and the errors of a real robot."""

import math
from pathlib import Path
import re

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.geometry.types import RANGE_SENSORS, Pose, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.robot.sensor_parameters import ImuParameters
from t3mpc_ros.simulation.digital_twin import (
    BROWN_OUT_REASON,
    DigitalTwin,
    DigitalTwinParameters,
    make_robot,
)
from t3mpc_ros.simulation.paper_robot import PaperRobot
from t3mpc_ros.simulation.sensors.imu import SimulatedImuParameters

PERIOD = 10_000_000
STILL = WheelSpeeds(0.0, 0.0)


def parameters(**changes: object) -> DigitalTwinParameters:
    return DigitalTwinParameters.from_dict(
        {name.replace('__', '.'): value for name, value in changes.items()}
    )


def course(seed: int, periods: int) -> list[WheelSpeeds]:
    """Return wheel speeds similar to the chaotic reference: smooth, up to 6 rad/s, both signs."""
    generator = np.random.default_rng(seed)
    time = 0.01 * np.arange(periods)
    speeds = np.full((2, periods), 1.5)
    for _ in range(4):
        frequency = generator.uniform(0.05, 0.6, (2, 1))
        phase = generator.uniform(0.0, 2.0 * np.pi, (2, 1))
        speeds += 1.5 * np.sin(2.0 * np.pi * frequency * time + phase)
    return [WheelSpeeds(*pair) for pair in speeds.T.tolist()]


def drive(robot: DigitalTwin, speeds: list[WheelSpeeds]) -> list:
    robot.advance(0)
    return [robot.step(wheels) for wheels in speeds]


def faulty(robot: DigitalTwin, **faults: object) -> None:
    robot.configure(
        robot.parameters.with_values({f'faults.{name}': value for name, value in faults.items()})
    )


def astray(state) -> float:
    """Return the distance (m) of the odometry from the ground truth."""
    true, odometry = state.truth.pose, state.odometry.pose
    return math.hypot(true.x - odometry.x, true.y - odometry.y)


# -- determinism ----------------------------------------------------------------------------------


def test_drive_kind_selects_the_robot_class():
    assert type(make_robot(parameters())) is DigitalTwin
    assert type(make_robot(parameters(drive__kind='velocity'))) is PaperRobot
    with pytest.raises(ValueError, match='stepper is for DigitalTwin'):
        PaperRobot(parameters())


@pytest.mark.compiled
def test_twins_in_one_process_are_independent():
    """A sweep may step its robots in any order."""
    tables = [parameters(seed=seed, world='room', noise__variance=0.04) for seed in range(5)]
    speeds = course(1, 150)
    alone = [drive(DigitalTwin(table), speeds)[-1] for table in tables]
    robots = [DigitalTwin(table) for table in tables]
    for robot in robots:
        robot.advance(0)
    for wheels in speeds:
        together = [robot.step(wheels) for robot in robots]
    for one, other in zip(alone, together, strict=True):
        assert repr(one) == repr(other)
    assert len({repr(state.imu) for state in alone}) == 5


def test_request_rate_does_not_change_the_state():
    speeds = course(2, 200)
    whole, parts = DigitalTwin(parameters()), DigitalTwin(parameters())
    for robot in (whole, parts):
        robot.advance(0)
    for k, wheels in enumerate(speeds):
        for robot in (whole, parts):
            robot.apply(RobotCommand(wheels, k * PERIOD), k * PERIOD)
        last = whole.advance((k + 1) * PERIOD)
        for tenth in range(1, 11):
            asked = parts.advance(k * PERIOD + tenth * PERIOD // 10)
    assert repr(last) == repr(asked)


@pytest.mark.compiled
@pytest.mark.slow
@pytest.mark.parametrize('periods', few_of([1000, 6000]))
def test_halving_the_step_changes_a_path_by_less_than_10_um(periods):
    """Pulses evaluated at the stages alone were half a step late: 0.36 mm after a minute."""
    speeds = course(4, periods)
    coarse, fine = (
        np.array(
            [
                state.truth.pose[:2]
                for state in drive(DigitalTwin(parameters(substep=step)), speeds)
            ]
        )
        for step in (0.001, 0.0005)
    )
    assert np.ptp(coarse, axis=0).max() > 0.1  # the robot moved
    assert np.hypot(*(coarse - fine).T).max() < 0.01e-3


# -- odometry errors from lost steps and sliding tyres --------------------------------------------


@pytest.mark.compiled
@pytest.mark.parametrize(
    ('cause', 'changes'),
    [
        ('nothing', {}),
        ('a tyre that slides', {'tyres__grip': 0.03}),
        ('lost steps', {'motor__phase_current': 0.12}),
        ('a held wheel', {'faults__wheel_blocked': 'left'}),
    ],
)
def test_odometry_misses_slip_and_lost_steps(cause, changes):
    robot = DigitalTwin(parameters(odometry__use_gyro=False, slip_stop=0.0, **changes))
    last = drive(robot, course(5, 1000))[-1]
    missed = max(robot.diagnostics.slid) > 0.02 or max(map(abs, last.lost_steps)) >= 4
    if cause == 'nothing':
        assert robot.diagnostics.slid == (0.0, 0.0)
        assert last.lost_steps == (0, 0)
        assert astray(last) < 1e-3
    else:
        assert missed
        assert astray(last) > 0.02


# -- board ----------------------------------------------------------------------------------------


def test_command_reaches_the_wheels_after_the_dead_time():
    robot = DigitalTwin(parameters(drive__dead_time=0.03))
    robot.advance(0)
    speeds = [robot.step(WheelSpeeds(1.0, 1.0)).wheels.right for _ in range(8)]
    assert speeds[:3] == [0.0, 0.0, 0.0]
    assert speeds[4] > 0.2


def test_stale_command_is_rejected_before_sending():
    """The board would drop it without a report to the host."""
    robot = DigitalTwin(parameters())
    now_ns = robot.advance(10**10).stamp_ns
    for age, stale in ((0.0, False), (0.249, False), (0.25, True), (2.0, True), (-1.0, False)):
        command = RobotCommand(WheelSpeeds(1.0, 1.0), now_ns - round(age * 1e9))
        assert ('too old' in robot.apply(command, now_ns)) == stale, age


def test_brown_out_restarts_the_board_and_commands_resume():
    robot = DigitalTwin(parameters())
    drive(robot, [WheelSpeeds(4.0, 4.0)] * 100)
    before = robot.state
    faulty(robot, brown_out=True)
    states = [robot.step(WheelSpeeds(4.0, 4.0)) for _ in range(45)]
    assert states[-1].reason == BROWN_OUT_REASON
    assert not states[-1].status.enabled
    assert (
        robot.apply(RobotCommand(STILL, states[-1].stamp_ns), states[-1].stamp_ns)
        == BROWN_OUT_REASON
    )
    assert states[-1].imu is None
    assert abs(states[-1].true_wheels.right) < 3.0  # no torque: friction brakes
    faulty(robot, brown_out=False)
    back = [robot.step(WheelSpeeds(4.0, 4.0)) for _ in range(60)]
    assert back[-1].reason == ''
    assert back[-1].wheels.right == pytest.approx(4.0, abs=0.4)
    # The host accumulates the counts over restarts: the wheel angle continues.
    assert back[-1].angles.right > before.angles.right


def test_battery_collapse_causes_a_brown_out():
    full, weak = (DigitalTwin(parameters(battery__resistance=ohms)) for ohms in (0.15, 8.0))
    assert drive(full, [WheelSpeeds(3.0, 3.0)] * 20)[-1].reason == ''
    states = drive(weak, [WheelSpeeds(3.0, 3.0)] * 20)
    assert BROWN_OUT_REASON in {state.reason for state in states}


# -- world and sensors ----------------------------------------------------------------------------


def test_wall_stops_the_body_and_range_sensors_measure_it(tmp_path):
    wall = tmp_path / 'wall.yaml'
    wall.write_text('walls:\n  - points: [[1.0, -2.0], [1.0, 2.0]]\n')
    exact = {'range_sensor__voltage_noise': 0.0, 'range_sensor__voltage_offset': 0.0}
    robot = DigitalTwin(parameters(world=str(wall), **exact))
    states = drive(robot, [WheelSpeeds(5.0, 5.0)] * 800)
    radius = robot.parameters.bumper.radius
    assert states[-1].truth.pose.x == pytest.approx(1.0 - radius, abs=0.005)
    assert max(state.truth.pose.x for state in states) < 1.0 - radius + 0.01
    assert robot.diagnostics.max_contact_force > 3.0
    assert states[-1].odometry.pose.x > 1.1  # the wheels kept turning
    # 0.5 m before the wall, a front sensor measures the distance from its face.
    halfway = min(states, key=lambda state: abs(state.truth.pose.x - 0.5))
    front = halfway.ranges[RANGE_SENSORS.index('front_left')]
    assert front == pytest.approx(1.0 - 0.5 - robot.parameters.range_sensor.half_length, abs=0.03)
    assert halfway.ranges[RANGE_SENSORS.index('rear_left')] == math.inf
    assert halfway.ranges[RANGE_SENSORS.index('left_front')] == math.inf


def test_set_pose_inside_a_wall_is_rejected(tmp_path):
    box = tmp_path / 'box.yaml'
    box.write_text('boxes:\n  - center: [1.0, 0.0]\n    size: [0.5, 0.5]\n')
    robot = DigitalTwin(parameters(world=str(box)))
    robot.advance(0)
    robot.set_pose(Pose(1.0, 1.0, 0.3))
    for wrong in (Pose(1.0, 0.0, 0.0), Pose(0.7, 0.0, 0.0)):
        with pytest.raises(ValueError, match=r'pose must be at least 0.11 m away'):
            robot.set_pose(wrong)
    with pytest.raises(ValueError, match='pose must be finite'):
        robot.set_pose(Pose(math.nan, 0.0, 0.0))
    assert robot.state.truth.pose == pytest.approx((1.0, 1.0, 0.3))


def test_tyres_slide_only_on_the_slippery_patch(tmp_path):
    ice = tmp_path / 'ice.yaml'
    ice.write_text('patches:\n  - center: [0.5, 0.0]\n    radius: 0.2\n    grip: 0.0\n')
    robot = DigitalTwin(parameters(world=str(ice)))
    speeds = [WheelSpeeds(4.0, 4.0)] * 230 + [WheelSpeeds(2.0, 2.0)] * 200
    slid, last = [], 0.0
    robot.advance(0)
    for wheels in speeds:
        place = robot.step(wheels).truth.pose.x
        now = robot.diagnostics.slid[0]
        if now > last + 1e-9:
            slid.append(place)
        last = now
    assert slid
    assert min(slid) > 0.29
    assert max(slid) < 0.76


def test_integrated_gyro_equals_the_turn():
    quiet = {'imu__gyro_noise': 0.0, 'imu__gyro_offset': 0.0, 'imu__gyro_drift': 0.0}
    robot = DigitalTwin(parameters(imu__gyro_scale_error=0.0, **quiet))
    states = drive(robot, [WheelSpeeds(2.0, -2.0)] * 300 + [STILL] * 100)
    turned = 0.01 * sum(state.imu.angular for state in states)
    truth = 0.01 * sum(state.truth.twist.angular for state in states)
    assert turned > 2.0
    assert turned == pytest.approx(truth, rel=0.002)


def test_accelerometer_measures_linear_and_centripetal_parts(monkeypatch):
    monkeypatch.setattr(ImuParameters, 'accel_noise', 0.0)
    monkeypatch.setattr(SimulatedImuParameters, 'accel_offset', 0.0)
    robot = DigitalTwin(parameters(body__com_offset=0.0))
    states = drive(robot, [WheelSpeeds(6.0, 4.0)] * 300)
    speed, turning = states[-1].truth.twist
    sideways = np.mean([state.imu.sideways for state in states[200:]])
    assert sideways == pytest.approx(speed * turning, rel=0.03)
    assert max(state.imu.forward for state in states[:30]) > 0.5


# -- inconsistent parameters ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ('wrong', 'words', 'right'),
    [
        (
            {'motor__microsteps': 256},
            r'wheel.max_velocity must be at most 1\.227 rad/s',
            {'wheel__max_velocity': 1.2},
        ),
        (
            {'imu__low_pass': '6'},
            'odometry.gyro_delay must be about 0.041 s',
            {'odometry__gyro_delay': 0.041},
        ),
        ({'imu__low_pass': '6'}, 'odometry.gyro_delay', {'odometry__use_gyro': False}),
        ({'substep': 0.002}, r'substep must be at most 0\.0018 s', {'substep': 0.0018}),
    ],
)
def test_what_contradicts_is_rejected_with_its_bound(wrong, words, right):
    with pytest.raises(ParameterError, match=words):
        parameters(**wrong)
    parameters(**wrong | right)


# -- documentation --------------------------------------------------------------------------------


@pytest.mark.compiled
@pytest.mark.slow
def test_documented_twin_example_runs(capsys):
    page = (Path(__file__).resolve().parents[2] / 'docs' / 'simulation.md').read_text()
    (example,) = re.findall(r'```python\n(.*?)```', page, re.DOTALL)
    exec(example, {})
    yaws = eval(capsys.readouterr().out)
    assert len(yaws) == 8
    assert all(math.isfinite(yaw) for yaw in yaws)


def test_body_moves_by_true_radii_and_separation():
    """Wheels that differ from the nominal ones turn the body by equation (1) with their own R."""
    true = {
        'right_wheel_radius_multiplier': 1.02,
        'left_wheel_radius_multiplier': 0.99,
        'wheel_separation_multiplier': 1.03,
        'disturbance__bound': 0.0,
    }
    wheels = WheelSpeeds(4.0, 2.5)
    state = drive(DigitalTwin(parameters(**true)), [wheels] * 150)[-1]
    geometry = parameters().geometry
    right, left = 1.02 * geometry.wheel_radius * 4.0, 0.99 * geometry.wheel_radius * 2.5
    assert state.true_wheels == pytest.approx(wheels, abs=0.01)
    assert state.truth.twist.linear == pytest.approx(0.5 * (right + left), abs=2e-4)
    assert state.truth.twist.angular == pytest.approx(
        (right - left) / (1.03 * geometry.wheel_separation), abs=2e-3
    )


def test_odometry_assumes_the_nominal_geometry():
    """Without a gyro the steps alone cannot see a wrong separation: yaw is off by its ratio."""
    state = drive(
        DigitalTwin(parameters(wheel_separation_multiplier=1.05, odometry__use_gyro=False)),
        [WheelSpeeds(1.0, -1.0)] * 300,
    )[-1]
    assert state.odometry.pose.yaw / state.truth.pose.yaw == pytest.approx(1.05, rel=2e-3)
