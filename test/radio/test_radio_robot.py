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
"""RadioRobot in virtual time against a scripted dongle and robot."""

import pytest
from support.emulator_bench import RobotBench
from support.radio_bench import FakeDongle, FakeRobot

from t3mpc_ros.geometry.types import RANGE_SENSORS
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.radio_robot import RadioRobotParameters

KEY = bytes(range(16))


def bench(key=b''):
    """Return the host of the bridge at a scripted dongle and robot."""
    return RobotBench(key=key, emulator=FakeDongle(FakeRobot(key)))


def ramped(made, right, left, seconds):
    made.drive(right, left)
    made.run(seconds)
    return made.states[-1]


def test_driving_updates_the_odometry_from_the_counters():
    made = bench(KEY)
    made.connect()
    state = ramped(made, 4.0, 4.0, 3.0)
    assert state.reason == ''
    assert tuple(state.wheels) == pytest.approx((4.0, 4.0), rel=0.01)
    assert tuple(state.commanded) == (4.0, 4.0)
    way = 0.035 * state.angles.right
    assert way > 0.3
    assert state.odometry.pose.x == pytest.approx(way, rel=1e-9)
    assert state.odometry.twist.linear == pytest.approx(0.14, rel=0.01)
    assert len(state.ranges) == len(RANGE_SENSORS)
    assert state.status.enabled
    assert state.status.moving


def test_states_are_returned_once_and_in_order():
    made = bench()
    made.connect()
    ramped(made, 2.0, 1.0, 2.0)
    stamps = [state.stamp_ns for state in made.states]
    assert stamps == sorted(set(stamps))
    assert len(stamps) == pytest.approx(100, abs=6)
    assert made.robot.take_states() == []


def test_the_ramp_of_the_limiter_is_sent():
    made = bench()
    made.connect()
    made.drive(6.0, 6.0)
    made.run(0.5)
    sent = [f.right / 1000.0 for _, f in made.board.log if isinstance(f, frames.Command)]
    rises = [b - a for a, b in zip(sent, sent[1:], strict=False)]
    assert max(sent) == 6.0
    assert max(rises) <= 30.0 * 0.02 + 0.01


def test_a_restart_keeps_the_pose_and_resets_the_gyro_bias():
    made = bench()
    made.connect()
    made.run(2.5)  # calibration of the gyro bias at standstill
    assert made.robot._odometry.calibrated
    before = ramped(made, 4.0, 4.0, 2.0)
    made.board.boot(made.now_ns)
    made.run(1.5)
    after = made.states[-1]
    assert after.odometry.pose.x >= before.odometry.pose.x
    assert after.odometry.pose.x < before.odometry.pose.x + 0.3
    assert made.link.robot_resets == 1
    assert not made.robot._odometry.calibrated


def test_odometry_is_reset_at_standstill_only():
    made = bench()
    made.connect()
    ramped(made, 4.0, 4.0, 1.0)
    assert made.robot.reset_odometry(made.now_ns) == (
        'odometry cannot be reset while the robot moves'
    )
    made.drive(0.0, 0.0)
    made.run(1.0)
    assert made.robot.reset_odometry(made.now_ns) == ''
    assert made.robot.advance(made.now_ns).odometry.pose.x == 0.0


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('wheel.max_velocity', 12.0),
        ('wheel.max_acceleration', 35.0),
        ('wheel.stop_deceleration', 80.0),
    ],
)
def test_limits_above_those_of_the_board_are_rejected(name, value):
    with pytest.raises(ParameterError, match=f'{name} must be at most the limit of the board'):
        RadioRobotParameters.from_dict({name: value})


def test_a_cycle_longer_than_a_command_lasts_is_rejected():
    """One command a second was allowed, and every one had expired before the next."""
    slow = {'link.cycle_rate': 1.0, 'max_stopping_time': 2.0}
    with pytest.raises(ParameterError, match='cycle_rate must be at least 5 Hz.*: got 1$'):
        RadioRobotParameters.from_dict(slow)
    RadioRobotParameters.from_dict(slow | {'link.cycle_rate': 5.0})


@pytest.mark.parametrize(
    'changes',
    [
        {'link.robot.deceleration': 40.0, 'wheel.stop_deceleration': 40.0},
        {'link.ttl': 0.4, 'link.robot.ttl_max': 0.4},
        {'link.cycle_rate': 5.0},
        {'cmd_vel_timeout': 0.32},
    ],
)
def test_settings_of_board_that_stop_too_late_are_rejected(changes):
    with pytest.raises(ParameterError, match='within max_stopping_time'):
        RadioRobotParameters.from_dict(changes)
    RadioRobotParameters.from_dict(changes | {'max_stopping_time': 1.0})
