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
"""Yaw error of steps and gyro on UMBmark's square and ten turns: the table of simulation.md.

Each leg ends at wheel angles by the step counters (Borenstein and Feng, doi:10.1109/70.544770), so
odometry has no influence on the drive, and the same slip acts on steps and gyro.
"""

import math
import re

import numpy as np
import pytest
from support.checkout import ROOT, load_example
from support.long_tests import few_of

from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.fault_schedule import FaultEvent

pytestmark = [pytest.mark.slow, pytest.mark.compiled]

example = load_example('digital_twin')
COURSES = ('square ccw', 'square cw', '10 turns')
# Fault, grip left, mean pause (s) to the next slip, mean (lost grip) or length (held wheel) in s.
SLIPS = {
    'none': None,
    'grip lost to 20 %': ('slippery', 0.2, 2.0, 0.5),
    'grip lost to 10 %': ('slippery', 0.1, 2.0, 0.5),
    'grip lost to 5 %': ('slippery', 0.05, 2.0, 0.5),
    'wheel held every 30 s': ('wheel_blocked', 1.0, 30.0, 0.2),
    'wheel held every 15 s': ('wheel_blocked', 1.0, 15.0, 0.2),
    'wheel held every 7.5 s': ('wheel_blocked', 1.0, 7.5, 0.2),
}
TABLE = (ROOT / 'docs/simulation.md').read_text().split('## Odometry under slip')[1]
DOCUMENTED = re.findall(r'([\d.]+)° → ([\d.]+)°', TABLE)
CELLS = [(slip, course) for slip in SLIPS for course in COURSES]


def slip_events(slip, course, seed):
    """Return slip at random times, independent of the motion."""
    if SLIPS[slip] is None:
        return []
    fault, grip, pause, length = SLIPS[slip]
    generator = np.random.default_rng([seed, COURSES.index(course), *slip.encode()])
    events, at = [], 1.5 + generator.exponential(pause)
    while at < 101.5:
        drawn, side = generator.exponential(length), int(generator.integers(2))
        held = fault == 'wheel_blocked'
        value, duration = (('right', 'left')[side], length) if held else (grip, max(drawn, 0.02))
        events.append(FaultEvent(at, fault, value, duration))
        at = events[-1].until + generator.exponential(pause)
    return events


def drive(slip, course, seed, side=4.0):
    """Return the robot, and its true pose, odometry and steps alone."""
    parameters = DigitalTwinParameters.from_dict({'seed': seed, 'slip_stop': 0.0})
    if course == '10 turns':
        angle = math.tau * parameters.geometry.half_separation / parameters.geometry.wheel_radius
        legs = [(angle, -angle)] * 10
    else:
        legs = example.square_legs(parameters.geometry, side, course == 'square cw')
    return example.drive(parameters, legs, slip_events(slip, course, seed))


def yaw_errors(slip, course, seed, side=4.0):
    """Return the yaw errors (rad) of the steps alone and with the gyro, and the gyro's own bound.

    The bound: the largest scale error, and three standard deviations of a bias that wanders from
    one standstill to the other, sigma t^1.5 / sqrt 3, and of the noise in the measured bias.
    """
    robot, truth, odometry, steps = drive(slip, course, seed, side)
    imu, moving = robot.parameters.imu, 0.01 * len(truth) - 3.0
    wandered = imu.gyro_drift * moving**1.5 / math.sqrt(3.0)
    unsure = imu.gyro_noise * moving / math.sqrt(2.0)
    bound = imu.gyro_scale_error * abs(truth[-1, 2])
    bound += 3.0 * math.radians(math.hypot(wandered, unsure))
    return steps[-1, 2] - truth[-1, 2], odometry[-1, 2] - truth[-1, 2], bound


@pytest.mark.long
@pytest.mark.parametrize(
    ('slip', 'course', 'steps', 'gyro'),
    [(*cell, *map(float, figures)) for cell, figures in zip(CELLS, DOCUMENTED, strict=True)],
)
def test_yaw_errors_are_those_of_the_documentation(slip, course, steps, gyro):
    """Root mean square of eight runs; the gyro's own errors bound those with slip."""
    errors = np.array([yaw_errors(slip, course, seed) for seed in range(1, 9)])
    found = np.degrees(np.sqrt(np.mean(errors[:, :2] ** 2, axis=0)))
    assert found == pytest.approx([steps, gyro], rel=0.05, abs=0.06)
    assert np.all(np.abs(errors[:, 1]) <= 1.5 * errors[:, 2])
    if slip != 'none':
        assert found[1] <= found[0] / 5.0
        certain = np.abs(errors[:, 0]) > 7.5 * errors[:, 2]
        assert np.all(np.abs(errors[certain, 1]) <= np.abs(errors[certain, 0]) / 5.0)


@pytest.mark.parametrize('course', few_of(COURSES))
def test_without_slip_both_headings_are_good(course):
    steps, gyro, bound = yaw_errors('none', course, 1, side=1.0)
    assert abs(steps) < math.radians(4.0)
    assert abs(gyro) <= bound


def test_a_held_wheel_loses_steps_the_gyro_measures_the_turn():
    robot, truth, odometry, steps = drive('wheel held every 7.5 s', 'square ccw', 1)
    assert sum(map(abs, robot.state.lost_steps)) > 100
    wrong, fused = (np.abs(poses[-1] - truth[-1]) for poses in (steps, odometry))
    assert wrong[2] > math.radians(30.0)
    assert fused[2] <= wrong[2] / 5.0
    assert math.hypot(*fused[:2]) < 0.2 * math.hypot(*wrong[:2])


@pytest.mark.parametrize(('course', 'sign'), [('square ccw', 1.0), ('square cw', -1.0)])
def test_a_square_is_one_to_the_steps_even_while_wheels_slip(course, sign):
    """It is driven by counting: what the floor makes of it does not show in the counters."""
    _, _, _, steps = drive('grip lost to 5 %', course, 2, side=0.5)
    assert steps[-1] == pytest.approx([0.0, 0.0, sign * math.tau], abs=5e-3)
    for corner in ((0.5, 0.0), (0.5, sign * 0.5), (0.0, sign * 0.5)):
        assert np.min(np.hypot(*(steps[:, :2] - corner).T)) < 5e-3
