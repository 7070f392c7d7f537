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
"""Slip monitor: when it stops the robot, and when it lets it go."""

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.robot.command_limiter import SlipMonitor
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand

STAND, DRIVE = RobotCommand(ZERO_WHEEL_SPEEDS, 0), RobotCommand(WheelSpeeds(1.0, 0.0), 0)


def test_a_stop_begins_and_ends_at_its_bounds():
    """The largest permitted slip is permitted; a pause of just half a second ends the stop."""
    monitor = SlipMonitor()
    assert not monitor.update(1.0, 1.0, 10.0)
    assert not monitor.rejects(DRIVE, 10.0)
    assert monitor.update(1.001, 1.0, 20.0)
    assert monitor.rejects(DRIVE, 20.25)
    assert monitor.rejects(STAND, 20.5)
    assert monitor.update(0.0, 1.0, 20.625)
    assert not monitor.update(0.0, 1.0, 20.75)
    assert not monitor.rejects(DRIVE, 20.75)


def test_a_limit_of_zero_disables_the_stop():
    monitor = SlipMonitor()
    assert monitor.update(2.0, 1.0, 0.0)
    assert not monitor.update(2.0, 0.0, 0.1)
    assert not monitor.update(99.0, 0.0, 0.2)
