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
"""Random channels of a robot: each has numbers of its own, whatever the others do.

Both wheels once had the same random walk; a robot that is disturbed straight on is a better one.
"""

import itertools

import numpy as np
import pytest
from support.fresh_state import alternatives, leaves

from t3mpc_ros.emulator.plant import Plant
from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters, TransportDelay
from t3mpc_ros.simulation.plant.disturbances import Disturbance, SpeedNoise
from t3mpc_ros.simulation.plant.paper_plant import PaperRobot, PaperRobotParameters
from t3mpc_ros.simulation.sensors.imu import SimulatedImu
from t3mpc_ros.simulation.sensors.range_sensor import SimulatedRangeSensors

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
        for changed in itertools.islice(alternatives(parameters, spec), 2):
            if not spec.name.startswith(OTHER_EVENTS):
                tried += 1
                assert drive(make(changed)) == usual, spec.name
    assert tried > 30
