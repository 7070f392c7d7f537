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
"""The controller with the parameter files for other robots: slow odometry, coarse commands.

In virtual time, without ROS; ``test/nodes/test_launch_files.py`` does the same with processes.
"""

from pathlib import Path

import numpy as np
import pytest
from support.long_tests import few_of
from support.velocity_robot import VelocityRobot
import yaml

from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceParameters
from t3mpc_ros.control.controller import Controller, StepperControllerParameters
from t3mpc_ros.control.odometry_plausibility import InputMonitor
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.geometry.types import NANOSECONDS, ORIGIN, BodyTwist, Pose, State

pytestmark = pytest.mark.compiled

CONFIG = Path(__file__).resolve().parents[2] / 'config'
LEAD = 0.4
DURATION = 40.0


def values_of(file, node):
    """Return the parameters of a node in a file."""
    return yaml.safe_load((CONFIG / file).read_text())[f'/**/{node}']['ros__parameters']


def follow(file, rate, lag, dead_time):
    """Return RMS error and RMS reference (rad/s), reasons, and what the diagnostics say."""
    values = values_of(file, 'controller') | {'rate': rate}
    controller = Controller(StepperControllerParameters.from_dict(values))
    geometry = controller.parameters.geometry
    amplitude = values_of(file, 'reference_generator')['amplitude']
    given = {'rate': rate, 'seed': 1, 'amplitude': amplitude}
    generator = ChaoticReference(ReferenceParameters.from_dict(given), geometry)
    robot = VelocityRobot(geometry.wheel_radius, 2 * geometry.half_separation, lag, dead_time)
    monitor = InputMonitor(controller.parameters.rate)
    half = geometry.half_separation
    wheels = np.array([[1.0, half], [1.0, -half]]) / geometry.wheel_radius
    references, speeds, reasons, command = [], [], set(), None
    for k in range(round(DURATION * rate)):
        time_ms = round((k + 1) * 1000 / rate)
        robot.advance((time_ms - round(k * 1000 / rate)) / 1000.0)
        twist = generator.advance().twist
        stamp_ns = time_ms * (NANOSECONDS // 1000)
        ahead = State(stamp_ns + round(LEAD * NANOSECONDS), ORIGIN, twist)
        controller.add_reference(ahead)
        pose, linear, angular = robot.odometry()
        measured = State(stamp_ns, Pose(*pose), BodyTwist(linear, angular))
        given, status = controller.step(measured)
        monitor.update(measured, stamp_ns, command)
        robot.command(given.linear, given.angular)
        command = given if status.reason.moves else None
        reasons.add(status.reason)
        references.append((ahead.stamp_ns / NANOSECONDS, *twist))
        speeds.append((stamp_ns / NANOSECONDS, *robot.speeds))
    known, found = np.array(references), np.array(speeds)
    found = found[found[:, 0] > 10.0]
    twists = [np.interp(found[:, 0], known[:, 0], known[:, i]) for i in (1, 2)]
    wanted = (wheels @ twists).T
    rms = [float(np.sqrt(np.mean(some**2))) for some in (found[:, 1:] - wanted, wanted)]
    return (
        *rms,
        reasons,
        monitor.warnings(simulated_time=False, tolerated_gap=0.1, geometry=geometry),
    )


@pytest.mark.parametrize(
    'file, rate, lag, dead_time',
    few_of(
        [
            ('turtlebot3.yaml', 20.0, 0.05, 0.03),
            ('turtlebot3.yaml', 30.0, 0.1, 0.08),
            ('generic.yaml', 25.0, 0.2, 0.05),
            ('turtlebot3.yaml', 30.0, 0.05, 0.03),
            ('turtlebot3.yaml', 30.0, 0.02, 0.01),
            ('turtlebot3.yaml', 30.0, 0.1, 0.01),
            ('turtlebot3.yaml', 30.0, 0.02, 0.08),
            ('generic.yaml', 50.0, 0.1, 0.05),
            ('generic.yaml', 50.0, 0.03, 0.02),
        ],
        2,
    ),
)
@pytest.mark.slow
def test_another_robot_follows_without_exact_time_constants(file, rate, lag, dead_time):
    error, reference, reasons, warnings = follow(file, rate, lag, dead_time)
    assert reasons == {Reason.NO_REFERENCE, Reason.TRACKING}
    assert warnings == []
    assert error < 0.15 * reference
