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
"""Path trackers against geometry, and the comparison of ``t3mpc patrol --tracking``."""

import math
from pathlib import Path

import numpy as np
import pytest
from support.records import record_of

from bench.path_samplings import FeedbackLinearisation, LinearisationParameters
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.cli.main import main
from t3mpc_ros.control.velocity_actuation import LimitParameters
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.patrol import path_tracker_comparison
from t3mpc_ros.evaluation.patrol.path_tracker_comparison import (
    METHODS,
    OURS,
    TRACKED_PATHS,
    TrackingJob,
    TrackingPlan,
    TrackingStudy,
    drive,
    errors_of,
    figure_of_eight,
    hook,
    recorded_path,
    straight_line,
    tuning_grids,
)
from t3mpc_ros.evaluation.patrol.pure_pursuit import (
    PurePursuitParameters,
    Pursuit,
    RegulatedParameters,
    pursuit_curvature,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, advance_pose, wheels_from_twist
from t3mpc_ros.geometry.polyline import distance_to_path, resample
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, Pose

PERIOD = 0.01
KINDS = (PurePursuitParameters(lookahead=0.1), RegulatedParameters())


def _follow(points, parameters, start=ORIGIN, duration=20.0):
    """Return poses and commands of a robot that does exactly as commanded."""
    tracker, pose, rows = Pursuit(points, parameters), start, []
    for _ in range(round(duration / PERIOD)):
        twist = tracker.step(pose)
        rows.append((*pose, *twist))
        pose = advance_pose(pose, twist, PERIOD)
    rows = np.array(rows)
    return rows[:, :3], rows[:, 3:]


@pytest.mark.parametrize('radius', [-2.0, -0.1, 0.05, 0.7])
@pytest.mark.parametrize('turn', [0.1, 1.0, 3.0])
def test_the_arc_through_a_point_of_a_circle_is_that_circle(radius, turn):
    start = Pose(0.3, -0.2, 2.1)
    x, y, _ = advance_pose(start, BodyTwist(abs(radius) * turn, math.copysign(turn, radius)), 1.0)
    assert pursuit_curvature(start, (x, y)) == pytest.approx(1.0 / radius)


@pytest.mark.parametrize('parameters', KINDS)
@pytest.mark.parametrize('offset', [-0.08, 0.08])
def test_pursuit_converges_to_a_straight_line(parameters, offset):
    poses, _ = _follow(straight_line(), parameters, Pose(0.0, offset, 0.0))
    beyond = poses[poses[:, 0] > 1.0]
    assert np.abs(beyond[:, 1]).max() < 1e-3
    assert math.dist(poses[-1, :2], (2.0, 0.0)) < 0.01


@pytest.mark.parametrize('parameters', KINDS)
def test_pursuit_holds_a_circle(parameters):
    """A chord of a circle is at half its angle: with exact motion there is no error at all."""
    angle = np.linspace(0.0, 1.5 * math.pi, 4000)
    circle = 0.4 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    poses, twists = _follow(circle, parameters, duration=5.0)
    assert np.abs(np.hypot(poses[:, 0], poses[:, 1] - 0.4) - 0.4).max() < 1e-4
    steady = twists[100:]
    assert steady[:, 1] / steady[:, 0] == pytest.approx(1.0 / 0.4, rel=0.01)


def test_regulated_pursuit_slows_below_its_radius():
    parameters = RegulatedParameters(min_radius=0.2)
    assert parameters.regulated(1.0 / 0.25, 1.0) == parameters.speed
    assert parameters.regulated(-1.0 / 0.1, 1.0) == pytest.approx(0.5 * parameters.speed)
    angle = np.linspace(0.0, 1.8 * math.pi, 4000)
    circle = 0.1 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    _, twists = _follow(circle, parameters, duration=3.0)
    assert twists[150:250, 0] == pytest.approx(0.5 * parameters.speed, rel=0.02)


@pytest.mark.parametrize('parameters', KINDS)
@pytest.mark.parametrize('seed', range(4))
def test_commands_keep_the_limits_on_any_path(parameters, seed):
    points = np.random.default_rng(seed).uniform(-0.4, 0.4, (8, 2))
    _, twists = _follow(points, parameters, duration=15.0)
    limits, wheels = LimitParameters(), []
    for linear, angular in twists:
        wheels.append(wheels_from_twist(BodyTwist(linear, angular), WheelGeometry()))
    for values, speed, acceleration in (
        (twists[:, 0], limits.linear, limits.linear_acceleration),
        (twists[:, 1], limits.angular, limits.angular_acceleration),
        (np.array(wheels), limits.wheel_speed, limits.wheel_acceleration),
    ):
        assert np.abs(values).max() <= speed * (1.0 + 1e-9)
        assert np.abs(np.diff(values, axis=0)).max() <= acceleration * PERIOD * (1.0 + 1e-9)


@pytest.mark.parametrize('parameters', KINDS)
def test_pursuit_drives_both_loops_where_a_path_crosses(parameters):
    poses, twists = _follow(figure_of_eight(), parameters, duration=30.0)
    assert distance_to_path(resample(figure_of_eight(), 0.02), poses[:, :2]).max() < 0.02
    assert not twists[-1].any()


def _record(track):
    count = len(track)
    poses = np.column_stack([track, np.zeros(count)])
    command = np.zeros((count, 2))
    return record_of(
        PERIOD * np.arange(count), truth=poses, reference_pose=0.0 * poses, command=command
    )


def test_errors_are_distances_both_ways():
    """A drive beside the line is off by its offset; one that ends half-way leaves the rest."""
    line = straight_line()
    ahead = np.linspace(0.0, 2.0, 1001)
    beside = np.column_stack([ahead, np.full(1001, 0.01)])
    run = errors_of(_record(beside), line, timed=False)
    assert run['cross_track'] == pytest.approx(0.01)
    assert run['largest'] == pytest.approx(0.01)
    assert run['time'] == pytest.approx(9.76, abs=0.02)
    half = errors_of(_record(np.column_stack([0.5 * ahead, 0.0 * ahead])), line, timed=False)
    assert half['cross_track'] == pytest.approx(0.0, abs=1e-9)
    assert half['largest'] == pytest.approx(1.0, abs=0.01)
    assert math.isnan(half['time'])


def test_the_recorded_path_is_that_of_the_golden_bag():
    with open_bag(Path(__file__).parents[1] / 'golden' / 'switches.mcap') as bag:
        fields = {'x': 'pose.pose.position.x', 'y': 'pose.pose.position.y'}
        odometry = bag.series('/odom', fields)
    driven = np.column_stack([odometry['x'], odometry['y']])
    assert distance_to_path(recorded_path(), driven).max() < 1e-4
    assert distance_to_path(driven, recorded_path()).max() < 0.01


def test_grids_are_equally_large_and_contain_what_is_compared():
    grids = tuning_grids()
    assert {len(choices) for choices in grids.values()} == {12}
    for name, choices in grids.items():
        method = METHODS[name]
        assert any((method.controller, method.pursuit) == (c.controller, c.pursuit)
                   for c in choices)  # fmt: skip
    assert not any(np.array_equal(hook(), path()) for path in TRACKED_PATHS.values())


@pytest.mark.slow
def test_a_drive_is_repeatable_and_the_pose_loop_pays():
    """Off by a wheel of another radius, speeds alone leave the path; the pose loop does not."""
    job = TrackingJob('recorded path', recorded_path(), 101)
    closed, again, open_loop = (
        drive((job, METHODS[name])) for name in (OURS, OURS, 'without the pose loop')
    )
    assert np.array_equal(closed['truth'], again['truth'])
    errors = [errors_of(each, job.points, timed=True) for each in (closed, open_loop)]
    assert errors[0]['cross_track'] < 0.5 * errors[1]['cross_track']
    assert errors[0]['within_limits']
    assert math.isfinite(errors[0]['time'])


@pytest.mark.parametrize(
    'baseline, verdict',
    [
        ([0.004, 0.005, 0.006], 'ours is better'),
        ([0.0010, 0.0011, 0.0012], 'ours is worse'),
        ([0.001, 0.003, 0.002], 'inconclusive'),
    ],
)
def test_the_verdict_is_that_of_paired_seeds(baseline, verdict):
    times = {OURS: (10.0, [0.0020, 0.0021, 0.0022]), 'pure pursuit': (math.nan, baseline)}
    rows = [
        {'path': 'square', 'controller': name, 'seed': seed, 'cross_track': error,
         'largest': 2.0 * error, 'timed': math.nan, 'time': time, 'within_limits': True}
        for name, (time, errors) in times.items()
        for seed, error in enumerate(errors)
    ]  # fmt: skip
    plan = TrackingPlan(('square',), (0, 1, 2), tuple(times))
    study = TrackingStudy(plan, ResultTable(rows))
    text = path_tracker_comparison.path_table(study, 'square').markdown()
    (row,) = (line for line in text.splitlines() if line.startswith('| pure pursuit'))
    assert row.endswith(f'| {verdict} |')
    assert 'arrived in 0 of 3' in row


def test_an_unknown_path_or_method_is_refused(capsys, tmp_path):
    words = ['patrol', '--tracking', '--paths', 'squere', '--output', str(tmp_path)]
    assert main(words) == 1
    assert 'did you mean square?' in capsys.readouterr().err
    with pytest.raises(ValueError, match='method must be one of'):
        TrackingPlan(methods=('pursuit',))


def test_regulated_pursuit_turns_on_the_spot_where_it_may():
    """Without the turn it drives an arc away from a path behind it."""
    points, behind = straight_line(), Pose(0.0, 0.0, 3.0)
    for rotate_from, farthest in ((0.785, 0.01), (math.inf, 0.1)):
        parameters = RegulatedParameters(rotate_from=rotate_from)
        poses, _ = _follow(points, parameters, behind)
        away = distance_to_path(poses[:, :2], np.array([[0.0, 0.0], [2.0, 0.0]]))
        assert (away.max() < farthest) == (rotate_from < 1.0)


@pytest.mark.parametrize('points', [straight_line(), figure_of_eight()], ids=['line', 'eight'])
def test_feedback_linearisation_brings_its_point_to_the_path(points):
    """The point ahead converges at rate k; the axle cuts curves by about d² times half of it."""
    parameters = LinearisationParameters()
    tracker, pose, rows = FeedbackLinearisation(points, parameters), Pose(0.0, 0.02, 0.5), []
    for _ in range(2000):
        command = tracker.step(pose)
        pose = advance_pose(pose, command, PERIOD)
        rows.append((*pose, *command))
    found = np.array(rows)
    ahead = found[:, :2] + parameters.ahead * np.column_stack(
        [np.cos(found[:, 2]), np.sin(found[:, 2])]
    )
    assert distance_to_path(ahead[200:700], points).max() < 2e-3
    assert distance_to_path(found[200:700, :2], points).max() < 0.01
    assert np.hypot(*(found[-1, :2] - points[-1])) < 3e-3
    limits = LimitParameters()
    assert np.abs(np.diff(found[:, 3])).max() <= limits.linear_acceleration * PERIOD * 1.001
