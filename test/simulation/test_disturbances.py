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
"""Friction, disturbance and noise; each random channel has numbers of its own.

Both wheels once had the same random walk; a robot that is disturbed straight on is a better one.
"""

import itertools
import math

import numpy as np
import pytest
from support.constants import with_constants
from support.fresh_state import alternatives, leaves

from t3mpc_ros.emulator.plant import Plant
from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters, TransportDelay
from t3mpc_ros.simulation.paper_robot import PaperRobot
from t3mpc_ros.simulation.plant.disturbances import (
    Disturbance,
    DisturbanceParameters,
    NoiseParameters,
    SpeedNoise,
    friction_torque,
    reflect,
)
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters
from t3mpc_ros.simulation.sensors.imu import SimulatedImu
from t3mpc_ros.simulation.sensors.range_sensor import SimulatedRangeSensors


def test_friction_is_odd_and_dissipative():
    for speed in np.random.default_rng(1).uniform(-50.0, 50.0, 200):
        torque = friction_torque(speed, 2e-4, 0.004, 0.2)
        assert torque == -friction_torque(-speed, 2e-4, 0.004, 0.2)
        assert torque * speed > 0.0
    assert friction_torque(0.0, 2e-4, 0.004, 0.2) == 0.0


def test_friction_is_viscous_plus_smoothed_coulomb():
    assert friction_torque(10.0, 2e-4, 0.004, 0.2) == pytest.approx(0.004 + 2e-3)
    assert friction_torque(0.2, 0.0, 0.004, 0.2) == pytest.approx(0.76 * 0.004, rel=0.01)
    slope = friction_torque(1e-6, 2e-4, 0.004, 0.2) / 1e-6
    assert slope == pytest.approx(2e-4 + 0.004 / 0.2, rel=1e-9)


def test_disturbance_never_exceeds_its_bound():
    generator = np.random.default_rng(2)
    for seed in range(8):
        share = float(generator.choice([0.0, 1.0, generator.uniform()]))
        parameters = with_constants(DisturbanceParameters, walk_share=share)(
            bound=generator.uniform(0.0, 0.1),
            frequencies=tuple(generator.uniform(0.0, 5.0, generator.integers(0, 6)).tolist()),
            walk_rate=float(generator.choice([0.1, 100.0])),
        )
        disturbance = Disturbance(parameters, np.random.default_rng(seed))
        for tick in range(200):
            disturbance.draw(0.01)
            for torque in disturbance.torque(0.01 * tick):
                assert abs(torque) <= parameters.bound


def test_disturbance_reaches_its_bound_on_each_wheel():
    parameters = with_constants(DisturbanceParameters, walk_share=0.0)(bound=1.0)
    disturbance = Disturbance(parameters, np.random.default_rng(3))
    torques = np.array([disturbance.torque(0.05 * tick) for tick in range(8000)])
    assert np.abs(torques).max(axis=0) == pytest.approx([1.0, 1.0], abs=0.05)
    assert abs(np.corrcoef(torques.T)[0, 1]) < 0.9


def test_random_walk_spreads_with_the_square_root_of_time():
    parameters = DisturbanceParameters(walk_rate=0.1)
    ends = []
    for seed in range(400):
        disturbance = Disturbance(parameters, np.random.default_rng(seed))
        for _ in range(100):
            disturbance.draw(0.01)
        ends.append(disturbance.walk.copy())
    assert np.std(ends) == pytest.approx(0.1, rel=0.1)


def test_reflection_is_bounded_and_continuous():
    for value in np.random.default_rng(4).uniform(-50.0, 50.0, 500):
        assert -1.0 <= reflect(value) <= 1.0
        assert abs(reflect(value + 1e-6) - reflect(value)) == pytest.approx(1e-6, rel=1e-3)
    assert reflect(0.3) == pytest.approx(0.3)
    assert reflect(1.2) == pytest.approx(0.8)
    assert reflect(-1.2) == pytest.approx(-0.8)


def test_noise_has_the_set_variance_and_zero_mean():
    noise = SpeedNoise(NoiseParameters(variance=0.04), np.random.default_rng(6))
    drawn = np.array([noise.measure(WheelSpeeds(5.0, -3.0)) for _ in range(20000)])
    deviations = drawn - [5.0, -3.0]
    assert np.mean(deviations, axis=0) == pytest.approx([0.0, 0.0], abs=4.0 * 0.2 / 20000**0.5)
    assert np.var(deviations, axis=0) == pytest.approx([0.04, 0.04], rel=0.05)
    assert abs(np.corrcoef(deviations.T)[0, 1]) < 0.03
    assert abs(np.corrcoef(deviations[1:, 0], deviations[:-1, 0])[0, 1]) < 0.03


def test_zero_variance_is_exact_and_draws_the_same_numbers():
    silent = SpeedNoise(NoiseParameters(), np.random.default_rng(7))
    loud = SpeedNoise(NoiseParameters(variance=0.25), np.random.default_rng(7))
    assert silent.measure(WheelSpeeds(5.0, -3.0)) == (5.0, -3.0)
    loud.measure(WheelSpeeds(5.0, -3.0))
    silent.parameters = NoiseParameters(variance=0.01)
    quiet, strong = silent.measure(WheelSpeeds(0.0, 0.0)), loud.measure(WheelSpeeds(0.0, 0.0))
    assert strong.right == pytest.approx(5.0 * quiet.right)
    assert math.isfinite(quiet.left)


NOISY = {'noise.variance': 1.0, 'disturbance.walk_rate': 0.01}
IMU = {'imu.gyro_drift': 10.0, 'imu.gyro_noise': 0.5}
COUNT = 1000
STILL = WheelSpeeds(0.0, 0.0)


def parts_of(robot):
    """Return the random components of a robot by their class."""
    parts = [*vars(robot).values(), *vars(getattr(robot, '_plant', robot)).values()]
    return {type(part): part for part in parts}


def channels(robot):
    """Yield the names and the numbers of every channel of a robot, shape (COUNT,) each."""
    parts = parts_of(robot)
    if disturbance := parts.get(Disturbance):
        walk = np.zeros((COUNT + 1, 2))
        for row in walk[1:]:
            disturbance.draw(0.01)
            row[:] = disturbance.walk
        yield from zip(('walk right', 'walk left'), np.diff(walk, axis=0).T, strict=True)
    if noise := parts.get(SpeedNoise):
        speeds = [noise.measure(STILL) for _ in range(COUNT)]
        yield from zip(('speed right', 'speed left'), np.array(speeds).T, strict=True)
    if imu := parts.get(SimulatedImu):
        rows = []
        for _ in range(COUNT):
            imu.measure(np.zeros((3, 2)), 0.003)  # both stages of the filter matter
            rows.append((imu._walk, *imu.counts))
        walk, turn, ahead, aside = np.array(rows).T
        walk = np.diff(walk, prepend=0.0)
        noise = (
            np.diff(turn, prepend=0.0) - walk * np.polyfit(walk, np.diff(turn, prepend=0.0), 1)[0]
        )
        yield from {'bias': walk, 'gyro': noise, 'ahead': ahead, 'aside': aside}.items()
    if ranges := parts.get(SimulatedRangeSensors):
        rows = np.empty((COUNT, 8))
        for row in rows:
            for sensor in range(8):
                ranges.measure(sensor, 0.3)
                row[sensor] = ranges.counts[sensor]
        yield from zip((f'range {k}' for k in range(8)), rows.T, strict=True)
    if (delay := parts.get(TransportDelay)) is not None:  # empty, and so false
        rows = []
        for _ in range(COUNT):
            state = delay._generator.bit_generator.state
            delay.send(RobotCommand(STILL, 0), 0, 0.0, 1.0, 0.0)
            jitter = delay.next_ns
            delay.clear()
            delay._generator.bit_generator.state = state
            lowest, highest = 0.0, 1.0  # the loss from which on this command is lost
            for _ in range(12):
                loss = 0.5 * (lowest + highest)
                delay._generator.bit_generator.state = state
                delay.send(RobotCommand(STILL, 0), 0, 0.0, 1.0, loss)
                lowest, highest = (loss, highest) if delay.next_ns else (lowest, loss)
                delay.clear()
            rows.append((jitter, lowest))
        yield from zip(('jitter', 'loss'), np.array(rows).T, strict=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('make', 'count'),
    [
        (lambda: DigitalTwin(DigitalTwinParameters.from_dict(NOISY | IMU)), 18),
        (lambda: Plant(DigitalTwinParameters.from_dict(NOISY | IMU)), 14),
        (lambda: PaperRobot(PaperRobotParameters.from_dict(NOISY)), 4),
    ],
    ids=['twin', 'plant of the emulator', 'paper robot'],
)
def test_no_two_channels_are_correlated(make, count):
    """Neither at the same time nor one step apart: 5 standard deviations of independent ones."""
    found = dict(channels(make()))
    assert len(found) == count
    for (one, first), (other, second) in itertools.combinations(found.items(), 2):
        for a, b in ((first, second), (first[1:], second[:-1]), (first[:-1], second[1:])):
            assert abs(np.corrcoef(a, b)[0, 1]) < 5.0 / np.sqrt(COUNT), (one, other)


@pytest.mark.slow
def test_what_is_drawn_at_the_start_is_independent():
    """Offsets, scales, phases and periods of 60 robots: no two follow each other."""
    rows = []
    for seed in range(60):
        parts = parts_of(DigitalTwin(DigitalTwinParameters(seed=seed)))
        imu, ranges = parts[SimulatedImu], parts[SimulatedRangeSensors]
        phases = parts[Disturbance].signals.phases.ravel().tolist()
        drawn = (imu._scale, imu._forward, imu._sideways, imu._offset)
        rows.append((*drawn, *phases, *ranges.periods, *ranges._offsets, *ranges._left))
    correlations = np.corrcoef(np.array(rows).T) - np.eye(len(rows[0]))
    # The first measurement of a sensor is due within a period, which differs by a quarter.
    assert np.abs(correlations).max() < 0.62


def generators(robot):
    """Return the state of each random generator of a robot by its path."""
    return {path: value for path, value in leaves(robot) if path.endswith('_generator')}


def drive(robot):
    """Drive for 0.12 s."""
    for k in range(12):
        now = k * NANOSECONDS // 100
        robot.apply(RobotCommand(WheelSpeeds(3.0, 2.0), now), now)
        robot.advance(now)
    return generators(robot)


OTHER_EVENTS = 'faults.brown_out', 'faults.supply_sag', 'battery.', 'cmd_vel_timeout', 'slip_stop'
"""With a restart of the board the IMU draws another offset; a stop changes what is sent."""


@pytest.mark.compiled
@pytest.mark.slow
@pytest.mark.parametrize('table', [DigitalTwinParameters, PaperRobotParameters])
def test_no_parameter_shifts_the_numbers_of_a_channel(table):
    """Any dynamic parameter changes, on and off: every generator is where it would have been."""
    make = DigitalTwin if table is DigitalTwinParameters else PaperRobot
    values = {'world': 'room'} if make is DigitalTwin else {}
    parameters = table.from_dict({'noise.variance': 0.04, **values})
    usual, tried = drive(make(parameters)), 0
    assert len(usual) >= (5 if make is DigitalTwin else 2)
    for spec in table.specs():
        for changed in itertools.islice(alternatives(parameters, spec), 3):
            if not spec.name.startswith(OTHER_EVENTS):
                tried += 1
                assert drive(make(changed)) == usual, spec.name
    assert tried > 50
