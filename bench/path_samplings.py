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
"""Times and errors on twelve samplings of paths, against the bound and other trackers.

``python bench/path_samplings.py``: the table of ``docs/patrol.md``, in Markdown, on the twin with
noise, lag and 10 % of the commands lost. The bound is that of toppra (``pip install toppra``) for
the shape without its sampling and all of the limits, and empty without it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.evaluation.confidence_intervals import mean
from t3mpc_ros.evaluation.patrol.path_tracker_comparison import errors_of
from t3mpc_ros.evaluation.patrol.patrol_run import LIMITS, PatrolScenario, run_patrol
from t3mpc_ros.evaluation.patrol.pure_pursuit import (
    SPACING,
    PathTracker,
    PurePursuitParameters,
    Pursuit,
    RegulatedParameters,
    TwistLimiter,
)
from t3mpc_ros.evaluation.run_record import RATE
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.path_smoothing import SmoothedPath
from t3mpc_ros.geometry.path_timing import time_path
from t3mpc_ros.geometry.polyline import check_points, polyline_length, resample
from t3mpc_ros.geometry.types import Array, BodyTwist, Pose

GEOMETRY = WheelGeometry()
TOLERANCE = 0.02
SEEDS = (101,)
SLOWEST = 3.0  # time for a drive as a multiple of that of the shape at full speed


def line() -> Array:
    """Return 2 m straight ahead, m."""
    return np.column_stack([np.linspace(0.0, 2.0, 2001), np.zeros(2001)])


def circle() -> Array:
    """Return a circle of 0.5 m, m."""
    angle = np.linspace(0.0, math.tau, 4001)
    return 0.5 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])


def eight() -> Array:
    """Return the lemniscate of Gerono, half a length of 1 m, which begins along x, m."""
    angle = np.linspace(0.0, math.tau, 8001)
    turn = math.sqrt(0.5) * np.array([[1.0, -1.0], [1.0, 1.0]])
    found: Array = np.column_stack([np.sin(angle), np.sin(angle) * np.cos(angle)]) @ turn
    return found


def diagonal() -> Array:
    """Return 2 m diagonally, m."""
    return line() @ (math.sqrt(0.5) * np.array([[1.0, 1.0], [-1.0, 1.0]]))


def sampled(shape: Array, spacing: float, noise: float = 0.0) -> Array:
    """Return points at even distances, with noise."""
    points = resample(shape, spacing)
    points += np.random.default_rng(7).normal(0.0, 1.0, points.shape) * noise
    return points


def staircase(cell: float) -> Array:
    """Return the steps of a grid (m) along the diagonal."""
    steps = 2 * round(math.sqrt(2.0) / cell)
    return np.array([(cell * (n - n // 2), cell * (n // 2)) for n in range(steps + 1)])


SAMPLINGS: Mapping[str, tuple[Array, Array]] = {
    'circle, 5 mm': (circle(), sampled(circle(), 0.005)),
    'circle, 50 mm': (circle(), sampled(circle(), 0.05)),
    'circle, 200 mm': (circle(), sampled(circle(), 0.2)),
    'circle, 5 mm, noise 2 mm': (circle(), sampled(circle(), 0.005, 0.002)),
    'circle, 50 mm, noise 2 mm': (circle(), sampled(circle(), 0.05, 0.002)),
    'circle, 200 mm, noise 2 mm': (circle(), sampled(circle(), 0.2, 0.002)),
    'line, 5 mm, noise 1 mm': (line(), sampled(line(), 0.005, 0.001)),
    'line, 20 mm, noise 2 mm': (line(), sampled(line(), 0.02, 0.002)),
    'figure of eight, 20 mm, noise 2 mm': (eight(), sampled(eight(), 0.02, 0.002)),
    'figure of eight, 100 mm': (eight(), sampled(eight(), 0.1)),
    'steps of a grid, 25 mm': (diagonal(), staircase(0.025)),
    'steps of a grid, 50 mm': (diagonal(), staircase(0.05)),
}
"""Shape, and the path given, m."""


@dataclass(frozen=True)
class LinearisationParameters:
    """Parameters of feedback linearisation."""

    ahead: float = 0.05  # d, m
    gain: float = 3.0  # k, 1/s
    speed: float = 0.25  # m/s
    acceleration: float = 0.5  # m/s²


class FeedbackLinearisation:
    r"""A point ahead of the axle follows a path (m, shape (n, 2)) with a trapezoid of speed.

    At the distance :math:`d` ahead it moves like a point mass (d'Andréa-Novel, Campion and Bastin,
    Int. J. Robotics Research 14, 1995, doi 10.1177/027836499501400602): :math:`(v, \omega d)` is
    its wanted velocity :math:`\dot p_r + k (p_r - p)` in the frame of the robot. Every command has
    the limits of the controller.
    """

    def __init__(self, points: Array, parameters: LinearisationParameters) -> None:
        check_points(points)
        self._parameters, self._limiter = parameters, TwistLimiter()
        # The axle is to reach the end: the path of the point goes on by its distance.
        run = points[-1] - points[-2]
        end = points[-1] + parameters.ahead * run / np.hypot(*run)
        self._path = resample(np.vstack([points, end]), SPACING)
        self._length = polyline_length(self._path)
        self._along, self._speed = parameters.ahead, 0.0

    def step(self, pose: Pose) -> BodyTwist:
        """Return the commanded twist for a pose; called once per period."""
        parameters = self._parameters
        braking = math.sqrt(2.0 * parameters.acceleration * max(self._length - self._along, 0.0))
        faster = self._speed + parameters.acceleration / RATE
        self._speed = min(parameters.speed, braking, faster)
        before = self._place()
        self._along = min(self._along + self._speed / RATE, self._length)
        after = self._place()
        ahead = np.array([math.cos(pose.yaw), math.sin(pose.yaw)])
        point = np.array(pose[:2]) + parameters.ahead * ahead
        velocity = (after - before) * RATE + parameters.gain * (after - point)
        left = float(velocity @ np.array([-ahead[1], ahead[0]]))
        return self._limiter.limited(BodyTwist(float(velocity @ ahead), left / parameters.ahead))

    def _place(self) -> Array:
        """Return where the point is to be, m."""
        index = self._along / self._length * (len(self._path) - 1)
        first = min(int(index), len(self._path) - 2)
        found: Array = self._path[first] + (index - first) * (
            self._path[first + 1] - self._path[first]
        )
        return found


TRACKERS = ('pure pursuit', 'regulated pure pursuit with rotation', 'feedback linearisation')


def tracker(name: str, points: Array) -> PathTracker:
    """Return a tracker with the parameters of the comparison of the page."""
    if name == 'pure pursuit':
        return Pursuit(points, PurePursuitParameters(0.08))
    if name == 'feedback linearisation':
        return FeedbackLinearisation(points, LinearisationParameters())
    regulated = RegulatedParameters(lookahead_time=0.4, min_radius=0.9, rotate_from=0.785)
    return Pursuit(points, regulated)


def bound(shape: Array) -> float:
    """Return the least time (s) on a smooth shape (m) by toppra, NaN without it."""
    try:
        import toppra
        from toppra import algorithm, constraint
    except ImportError:
        return math.nan
    toppra.setup_logging('ERROR')
    points = resample(shape, 0.01)
    runs = np.diff(points, axis=0)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*runs.T))])
    middle = 0.5 * (along[1:] + along[:-1])
    yaw = np.interp(along, middle, np.unwrap(np.arctan2(runs[:, 1], runs[:, 0])))
    half, radius = GEOMETRY.half_separation, GEOMETRY.wheel_radius
    motion = np.column_stack([along, yaw, along + half * yaw, along - half * yaw])
    wheel_speed, wheel = LIMITS.wheel_speed * radius, LIMITS.wheel_acceleration * radius
    speeds = np.array([LIMITS.linear, LIMITS.angular, wheel_speed, wheel_speed])
    changes = [LIMITS.linear_acceleration, LIMITS.angular_acceleration, wheel, wheel]
    limits = [
        constraint.JointVelocityConstraint(np.column_stack([-speeds, speeds])),
        constraint.JointAccelerationConstraint(np.column_stack([-np.array(changes), changes])),
    ]
    path = toppra.SplineInterpolator(along, motion)
    grid = np.linspace(0.0, along[-1], 2001)
    found = algorithm.TOPPRA(limits, path, gridpoints=grid).compute_trajectory(0.0, 0.0)
    return float(found.duration)


def drives(name: str, points: Array) -> Sequence[Mapping[str, object]]:
    """Return the errors of a method on a path, one drive a seed."""
    pieces = SmoothedPath(points, TOLERANCE, LIMITS, GEOMETRY).pieces
    least = polyline_length(resample(points, 0.05)) / LIMITS.linear
    rows = []
    for seed in SEEDS:
        late, wheel, separation = np.random.default_rng((seed, 31)).uniform(
            [0.0, -0.005, -0.01], [0.03, 0.005, 0.01]
        )
        robot = {
            'drive.dead_time': 0.01 + float(late),
            'right_wheel_radius_multiplier': 1.0 + float(wheel),
            'wheel_separation_multiplier': 1.0 + float(separation),
        }
        duration = (1.3 if name == 'ours' else SLOWEST) * least + 4.0
        scenario = PatrolScenario(seed=seed, duration=duration, keep_out=False, robot=robot)
        other = None if name == 'ours' else tracker(name, points)
        record = run_patrol(iter(pieces()), scenario, tracker=other)
        rows.append(errors_of(record, points, timed=False))
    return rows


def cell(rows: Sequence[Mapping[str, object]]) -> str:
    """Return time, rms and largest error of a method, means over the seeds."""
    times, errors, largest = (
        mean([float(str(row[key])) for row in rows]) for key in ('time', 'cross_track', 'largest')
    )
    text = f'{times:.1f} s' if math.isfinite(times) else 'not reached'
    return f'{text}; {1e3 * errors:.1f}, {1e3 * largest:.1f}'


def row(name: str, methods: Sequence[str]) -> list[str]:
    """Return the cells of a row of the table."""
    shape, points = SAMPLINGS[name]
    least = bound(shape)
    given = time_path(points, LIMITS, GEOMETRY).time[-1]
    pieces = SmoothedPath(points, TOLERANCE, LIMITS, GEOMETRY).pieces()
    planned = time_path(np.vstack(list(pieces)), LIMITS, GEOMETRY).time[-1]
    times = [f'{least:.1f} s', f'{given:.1f} s', f'{planned:.1f} s', f'{planned / least:.2f}']
    return times + [cell(drives(method, points)) for method in methods]


def main() -> None:
    """Print the table."""
    head = 'path', 'bound', 'as given', 'smoothed', 'of the bound', 'ours', *TRACKERS
    print(f'| {" | ".join(head)} |', '|---' * len(head) + '|', sep='\n')
    for name in SAMPLINGS:
        print(f'| {name} |', ' | '.join(row(name, ('ours', *TRACKERS))), '|', flush=True)


if __name__ == '__main__':
    main()
