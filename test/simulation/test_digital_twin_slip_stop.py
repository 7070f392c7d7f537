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
"""Slip stop of the digital twin: it lasts until motion commands pause."""

import numpy as np
import pytest

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.robot.command_limiter import SLIP_RELEASE_TIME, SLIP_STOP_REASON
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand
from t3mpc_ros.simulation.digital_twin import BROWN_OUT_REASON, DigitalTwin, DigitalTwinParameters

FORWARD = WheelSpeeds(5.0, 5.0)
PERIOD_NS = 10_000_000


def make_robot(**changes):
    """Return a robot with a calibrated gyro, after a standstill of more than a second."""
    robot = DigitalTwin(DigitalTwinParameters.from_dict(changes))
    drive(robot, ZERO_WHEEL_SPEEDS, 1.3)
    return robot


def drive(robot, wheels, seconds):
    """Command ``wheels`` in every period and return all states."""
    return [robot.step(wheels) for _ in range(round(100 * seconds))]


def silence(robot, seconds):
    """Send no command and return all states."""
    start = robot.state.stamp_ns
    return [robot.advance(start + PERIOD_NS * (k + 1)) for k in range(round(100 * seconds))]


def fault(robot, **changes):
    given = {f'faults.{name}': value for name, value in changes.items()}
    robot.configure(robot.parameters.with_values(given))


def stopped(**changes):
    """Return a robot stopped by a blocked right wheel."""
    robot = make_robot(**changes)
    drive(robot, FORWARD, 1.0)
    fault(robot, wheel_blocked='right')
    drive(robot, FORWARD, 1.5)
    return robot


def test_blocked_wheel_stops_the_robot():
    """The limiter accepted the next command 10 ms after each stop, so the robot drove on."""
    robot = stopped()
    states = drive(robot, FORWARD, 5.0)
    assert {state.reason for state in states} == {SLIP_STOP_REASON}
    assert all(state.commanded == ZERO_WHEEL_SPEEDS for state in states)
    assert np.abs([state.true_wheels for state in states[50:]]).max() < 0.1
    start, end = states[50].truth.pose, states[-1].truth.pose
    np.testing.assert_allclose(start, end, atol=1e-3)


def test_robot_stops_after_the_set_slip_time():
    robot = make_robot(slip_stop=0.6)
    drive(robot, FORWARD, 1.0)
    fault(robot, wheel_blocked='right')
    states = drive(robot, FORWARD, 2.0)
    first = next(k for k, state in enumerate(states) if state.reason)
    # Slip is timed from when the smoothed disagreement exceeds the threshold.
    assert 0.6 < 0.01 * first < 0.8


def test_robot_stays_stopped_when_the_fault_ends():
    """A restart by itself would push against the obstacle again."""
    robot = stopped()
    fault(robot, wheel_blocked='none')
    states = drive(robot, FORWARD, 6.0)
    assert not any(state.status.slipping for state in states[100:])
    assert all(state.commanded == ZERO_WHEEL_SPEEDS for state in states)


@pytest.mark.parametrize(
    'pause', [silence, lambda robot, time: drive(robot, ZERO_WHEEL_SPEEDS, time)]
)
def test_robot_resumes_after_the_release_time(pause):
    robot = stopped()
    fault(robot, wheel_blocked='none')
    drive(robot, FORWARD, 1.0)
    states = pause(robot, SLIP_RELEASE_TIME + 0.05)
    assert {state.reason for state in states[:-10]} == {SLIP_STOP_REASON}
    states = drive(robot, FORWARD, 1.0)
    assert states[-1].reason == ''
    assert states[-1].true_wheels == pytest.approx(FORWARD, abs=0.2)


def test_pause_shorter_than_the_release_time_does_not_count():
    robot = stopped()
    fault(robot, wheel_blocked='none')
    drive(robot, FORWARD, 1.0)
    for _ in range(5):
        drive(robot, ZERO_WHEEL_SPEEDS, 0.8 * SLIP_RELEASE_TIME)
        states = drive(robot, FORWARD, 0.1)
    assert states[-1].reason == SLIP_STOP_REASON
    assert states[-1].commanded == ZERO_WHEEL_SPEEDS


def test_robot_stops_again_while_the_wheel_is_blocked():
    robot = stopped()
    drive(robot, ZERO_WHEEL_SPEEDS, SLIP_RELEASE_TIME + 0.05)
    states = drive(robot, FORWARD, 2.0)
    assert any(state.commanded != ZERO_WHEEL_SPEEDS for state in states)
    assert states[-1].reason == SLIP_STOP_REASON
    assert states[-1].commanded == ZERO_WHEEL_SPEEDS


def test_delayed_commands_count_at_their_arrival():
    """A delayed motion command restarts the pause when it arrives."""
    robot = stopped()
    fault(robot, wheel_blocked='none', command_delay=0.2)
    drive(robot, FORWARD, 0.1)
    silence(robot, SLIP_RELEASE_TIME - 0.1)
    robot.apply(RobotCommand(FORWARD, robot.state.stamp_ns), robot.state.stamp_ns)
    assert silence(robot, 0.25)[-1].reason == SLIP_STOP_REASON
    silence(robot, SLIP_RELEASE_TIME)
    assert drive(robot, FORWARD, 0.4)[-1].reason == ''


def test_zero_disables_the_slip_stop():
    robot = make_robot(slip_stop=0.0)
    fault(robot, wheel_blocked='right')
    states = drive(robot, FORWARD, 3.0)
    assert any(state.status.slipping for state in states)
    assert not any(state.reason for state in states)
    robot.configure(robot.parameters.with_values({'slip_stop': 0.5}))
    assert drive(robot, FORWARD, 0.1)[-1].commanded == ZERO_WHEEL_SPEEDS
    robot.configure(robot.parameters.with_values({'slip_stop': 0.0}))
    assert drive(robot, FORWARD, 0.2)[-1].commanded == FORWARD


def test_emergency_stop_reason_shows_and_releases_the_slip_stop():
    robot = stopped()
    fault(robot, wheel_blocked='none')
    robot.latch_estop('a person', robot.state.stamp_ns)
    states = drive(robot, FORWARD, 1.0)
    assert all('a person' in state.reason for state in states)
    robot.release_estop(robot.state.stamp_ns)
    assert drive(robot, FORWARD, 0.5)[-1].reason == ''


def test_board_restart_releases_the_slip_stop():
    robot = stopped()
    fault(robot, wheel_blocked='none', brown_out=True)
    assert drive(robot, FORWARD, 0.3)[-1].reason == BROWN_OUT_REASON
    assert drive(robot, FORWARD, 0.8)[-1].reason == ''


def test_external_rotation_stop_ends_with_the_rotation():
    """An external rotation alone does not reject the next command."""
    robot = make_robot()
    fault(robot, gyro_bias_jump=1.0)
    assert drive(robot, ZERO_WHEEL_SPEEDS, 1.4)[-1].reason == SLIP_STOP_REASON
    fault(robot, gyro_bias_jump=0.0)
    drive(robot, ZERO_WHEEL_SPEEDS, SLIP_RELEASE_TIME + 0.3)
    assert drive(robot, FORWARD, 0.3)[-1].reason == ''
