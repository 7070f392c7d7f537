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
"""Drives identified from bags: of known robots, and bags that do not determine them."""

import math

import numpy as np
import pytest
from support.bag_messages import START, serialised_odometry, serialised_twist
from support.long_tests import few_of
from support.training_runs import Tape
from support.velocity_robot import VelocityRobot
import yaml

from t3mpc_ros.cli.main import main
from t3mpc_ros.control.controller import StepperControllerParameters
from t3mpc_ros.control.dead_time_estimator import IDENTIFIED_DEVIATION
from t3mpc_ros.evaluation.topic_roles import ReportOptions
from t3mpc_ros.evaluation.tuning.drive_identification import (
    MAX_RELATIVE_DEVIATION,
    IdentificationError,
    drive_file,
    fitting_parameters,
    identify_bag,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, State, WheelSpeeds
from t3mpc_ros.simulation.paper_robot import PaperRobot
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

pytestmark = pytest.mark.slow

GEOMETRY = WheelGeometry()
RATE = 100.0
METADATA = {
    'sim_robot': {
        'wheel_radius': str(GEOMETRY.wheel_radius),
        'wheel_separation': str(GEOMETRY.wheel_separation),
    }
}


def ramps(seed, count, rate=RATE, middle=3.0, span=2.5, slope=15.0):
    """Return wheel speeds (rad/s) with ramps between random levels, shape (count, 2)."""
    random = np.random.default_rng(seed)
    speeds = np.empty((count, 2))
    for wheel in range(2):
        k, speed = 0, middle
        while k < count:
            goal = middle + random.uniform(-span, span)
            while k < count and speed != goal:
                speed += float(np.clip(goal - speed, -slope / rate, slope / rate))
                speeds[k, wheel] = speed
                k += 1
            hold = round(random.uniform(0.05, 0.6) * rate)
            speeds[k : k + hold, wheel] = speed
            k += hold
    return speeds


def recorded(wheels, seed=1, metadata_records=METADATA, **parameters):
    """Return the messages of the simulated robot that is sent wheel speeds (rad/s)."""
    robot = PaperRobot(
        PaperRobotParameters.from_dict(
            {
                'drive.kind': 'velocity',
                'rate': RATE,
                'seed': seed,
                **{name.replace('__', '.'): value for name, value in parameters.items()},
            }
        )
    )
    tape = Tape(metadata_records)
    state = robot.advance(START)
    for speeds in wheels:
        command, stamp_ns = WheelSpeeds(*speeds.tolist()), state.stamp_ns
        twist = twist_from_wheels(command, GEOMETRY)
        tape.add('/odom', stamp_ns + 1000, serialised_odometry(stamp_ns, state.odometry.twist))
        tape.add('/cmd_vel', stamp_ns, serialised_twist(twist))
        state = robot.step(command)
    return tape


def identified(tape, folder, **options):
    return identify_bag(tape.write(folder), ReportOptions(**options))


def assert_within(estimate, truth):
    assert abs(estimate.value - truth) <= 3.0 * estimate.uncertainty, (estimate, truth)


@pytest.mark.parametrize(
    'lag, dead_time, noise, seed',
    few_of(
        [
            (0.02, 0.03, 0.04, 2),
            (0.2, 0.1, 0.04, 5),
            (0.01, 0.0, 0.01, 6),
            (0.02, 0.01, 0.04, 1),
            (0.05, 0.03, 0.0, 3),
            (0.1, 0.05, 0.1, 4),
            (0.03, 0.06, 0.01, 7),
        ],
    ),
)
def test_a_known_drive_is_recovered(tmp_path, lag, dead_time, noise, seed):
    tape = recorded(
        ramps(seed, 4000), seed, drive__lag=lag, drive__dead_time=dead_time, noise__variance=noise
    )
    drive, composition = identified(tape, tmp_path / 'bag')
    assert_within(drive.lag, lag)
    assert_within(drive.dead_time, dead_time)
    assert_within(drive.noise_variance, noise)
    assert drive.dead_time.uncertainty <= IDENTIFIED_DEVIATION
    assert drive.lag.uncertainty <= max(IDENTIFIED_DEVIATION, MAX_RELATIVE_DEVIATION * lag)
    assert drive.rate == RATE
    assert composition == 'paper'
    assert drive.duration == pytest.approx(40.0, abs=0.1)


@pytest.mark.long
def test_more_noise_gives_a_larger_deviation(tmp_path):
    found = []
    for noise in (0.002, 0.1):
        tape = recorded(ramps(1, 2500), drive__lag=0.1, noise__variance=noise)
        found.append(identified(tape, tmp_path / f'{noise}')[0])
    assert found[1].lag.uncertainty > 1.1 * found[0].lag.uncertainty
    assert found[1].noise_variance.value > 40.0 * found[0].noise_variance.value


@pytest.mark.parametrize('lag, dead_time', few_of([(0.1, 0.04), (0.2, 0.1)]))
def test_a_robot_of_another_make_is_identified(tmp_path, lag, dead_time):
    """Odometry with 30 Hz of mean speeds, commands with 25 Hz in steps, without geometry."""
    robot = VelocityRobot(lag=lag, dead_time=dead_time)
    geometry = WheelGeometry(wheel_radius=0.033, wheel_separation=0.16)
    wheels = ramps(3, 1500, 25.0, middle=2.5, span=2.0, slope=8.0)
    tape = Tape({})
    for k in range(60_000):
        now = START + k * 1_000_000
        if k % 40 == 0:
            twist = twist_from_wheels(WheelSpeeds(*wheels[k // 40].tolist()), geometry)
            robot.command(twist.linear, twist.angular)
            tape.add('/cmd_vel', now, serialised_twist(twist))
        robot.advance(0.001)
        if k % 33 == 32:
            _, linear, angular = robot.odometry()
            state = State(now + 1_000_000, ORIGIN, BodyTwist(linear, angular))
            tape.add('/odom', now + 1_500_000, serialised_odometry(state.stamp_ns, state.twist))
    folder = tape.write(tmp_path / 'bag')
    drive, _ = identify_bag(folder, ReportOptions(wheel_radius=0.033, track=0.16))
    assert drive.mean_speeds
    assert_within(drive.lag, lag)
    assert_within(drive.dead_time, dead_time)
    with pytest.raises(IdentificationError, match='give --wheel-radius and --track'):
        identify_bag(folder, ReportOptions())


@pytest.fixture(scope='module')
def driven():
    return recorded(ramps(1, 3000), drive__lag=0.02, noise__variance=0.04)


def test_the_drive_file_has_the_gain_by_the_rule(driven, tmp_path):
    records = METADATA | {'/robot/controller': {'composition': 'body'}}
    drive, kept = identified(Tape(records, driven.rows), tmp_path / 'bag')
    assert kept == 'body', 'the recorded composition'
    for composition in ('paper', 'body'):
        text = drive_file(drive, composition, 'bag')
        values = yaml.safe_load(text)['/**/controller']['ros__parameters']
        parameters = StepperControllerParameters.from_dict(values)
        fitting = fitting_parameters(drive, composition).to_dict()
        assert {'rate', 'mean_speeds', 'law.gain', 'speed_filter.dead_time'} <= set(values)
        for name, value in values.items():
            rounded = value if isinstance(value, str) else pytest.approx(value, rel=1e-4)
            assert fitting[name] == rounded, name
        parameters = parameters.resolved()
        total = (1.0 - math.exp(-0.01 / drive.lag.value)) * RATE
        slope = 0.0
        if parameters.law.compensator:
            slope = parameters.compensated_bound / parameters.law.smoothing
        assert parameters.law.gain + slope == pytest.approx(total, rel=1e-3)
        assert parameters.law.compensator == (composition == 'paper')
        assert f'{drive.lag.value:.5g}  # standard deviation {drive.lag.uncertainty:.2g} s' in text
        assert text.count('standard deviation') == 5


# Bags that do not determine the drive


def at_rest(driven):
    return recorded(np.zeros((2000, 2)), noise__variance=0.04)


def not_following(driven):
    rows = [row for row in driven.rows if row[1] == '/cmd_vel'][:2000]
    return Tape(METADATA, rows + [row for row in at_rest(driven).rows if row[1] == '/odom'])


def slow(driven):
    time = np.arange(3000)[:, np.newaxis] / RATE
    wheels = 3.0 + np.sin(0.5 * time + np.array([0.0, 1.0]))
    return recorded(wheels, drive__lag=0.02, noise__variance=0.04)


def short(driven):
    return driven.where(lambda seconds, topic, count: seconds < 6.0)


def torn(lost):
    return lambda tape: tape.where(
        lambda seconds, topic, _: topic != lost or not 9 < seconds < 21.5
    )


def in_millimetres(driven):
    """The pose is in metres, the twist in millimetres per second."""
    tape, poses = Tape(METADATA), [(0.0, 0.0, 0.0)]
    for k in range(3000):
        stamp_ns, speed = START + k * 10_000_000, 0.15 + 0.1 * math.sin(0.02 * k)
        poses.append((poses[-1][0] + 0.01 * speed, 0.0, 0.0))
        twist = BodyTwist(1000.0 * speed, 0.0)
        tape.add('/odom', stamp_ns + 1000, serialised_odometry(stamp_ns, twist, poses[-1]))
        tape.add('/cmd_vel', stamp_ns, serialised_twist(BodyTwist(speed, 0.0)))
    return tape


def without(lost):
    return lambda tape: tape.where(lambda seconds, topic, _: topic != lost)


@pytest.mark.parametrize(
    ('tape_of', 'words'),
    [
        (at_rest, r'vary by at least 0\.1 rad/s .*: got 0 rad/s$'),
        (not_following, r'explain at least 50 % .*: got \d %$'),
        (short, r'at least 10 s without a gap: got 6\.0 s'),
        (torn('/odom'), r'at least 10 s without a gap: got [89]\.\d s'),
        (torn('/cmd_vel'), r'at least 10 s without a gap: got [89]\.\d s'),
        pytest.param(
            slow, r'deviation of the .* at most \d+\.\d ms: got \d+\.\d ms', marks=pytest.mark.long
        ),
        (in_millimetres, 'twist of /odom cannot be in m/s and rad/s: .*Correct the units'),
        (without('/odom'), 'cmd_vel and odom: no odom, a topic of nav_msgs/msg/Odometry with'),
        (
            without('/cmd_vel'),
            'cmd_vel and odom: no cmd_vel, a topic of geometry_msgs/msg/Twist or',
        ),
    ],
)
def test_a_bag_that_does_not_determine_the_drive_is_refused(tape_of, words, driven, tmp_path):
    with pytest.raises(IdentificationError, match=words):
        identified(tape_of(driven), tmp_path / 'bag')


# The command line


def test_what_is_unusual_in_the_bag_stands_in_the_file(tmp_path, driven, capsys):
    """The file looked as sound as that of a whole bag."""

    def kept(seconds, topic, _):
        return topic != '/odom' or not 12.0 < seconds < 14.0

    folder = driven.where(kept).write(tmp_path / 'drive')
    assert main(['tune', '--robot', str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith('# Drive identified from drive: ')
    assert lines[1].startswith('# No message of /odom for 2.0 s from ')
    assert lines[2] == '/**/controller:'


def test_an_output_that_cannot_be_written_is_said_first(tmp_path, driven, capsys):
    """The file was identified and printed, then: [Errno 21] Is a directory."""
    folder = driven.write(tmp_path / 'drive')
    assert main(['tune', '--robot', str(folder), '--output', str(tmp_path)]) == 1
    assert capsys.readouterr() == (
        '',
        f'error: {tmp_path} cannot be written: give a file in a folder that exists\n',
    )


def test_the_command_prints_and_writes_the_file(tmp_path, driven, capsys):
    folder, output = driven.write(tmp_path / 'drive'), tmp_path / 'new' / 'robot.yaml'
    assert main(['tune', '--robot', str(folder), '--output', str(output)]) == 0
    text = capsys.readouterr().out
    assert output.read_text() == text
    assert text.startswith('# Drive identified from drive: 30.0 s, ')
    values = yaml.safe_load(text)['/**/controller']['ros__parameters']
    assert values['speed_filter.lag'] == pytest.approx(0.02, abs=0.006)
    assert values['wheel_radius'] == GEOMETRY.wheel_radius
