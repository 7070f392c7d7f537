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
"""Our path tracking, with and without each part, against pure pursuit on four paths.

Every method drives the digital twin with noise, lag, slippery patches on the path and lost
commands; dead time, wheel radius and wheel separation are drawn from the seed and are not those
that the methods assume. All have the same place, the same top speed along the path and the same
limits of the command. The gains of ours and the lookaheads of the baselines are the best of grids
of equal size on a path that is not compared (:func:`tune_trackers`).
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from t3mpc_ros.control.velocity_actuation import LimitParameters
from t3mpc_ros.evaluation import html_page, result_output
from t3mpc_ros.evaluation.confidence_intervals import format_interval, interval, mean, rms
from t3mpc_ros.evaluation.experiment import Report, ResultTable, Row, Run, run_experiment
from t3mpc_ros.evaluation.patrol import patrol_run
from t3mpc_ros.evaluation.patrol.patrol_run import LIMITS
from t3mpc_ros.evaluation.patrol.pure_pursuit import (
    PurePursuitParameters,
    Pursuit,
    RegulatedParameters,
)
from t3mpc_ros.evaluation.run_cache_key import digest
from t3mpc_ros.evaluation.run_record import RATE, Record
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.path_file import load_path
from t3mpc_ros.geometry.path_timing import time_path
from t3mpc_ros.geometry.polyline import distance_to_path, polyline_length, resample
from t3mpc_ros.geometry.types import ORIGIN, Array
from t3mpc_ros.parameters.table import find_names
from t3mpc_ros.version import VERSION

RECORDED_PATH = Path(__file__).with_name('recorded_path.csv')
"""Odometry of a robot that followed switching chaotic wheel speeds, thinned to 10 mm."""
SPARE_TIME, SLOW_SPARE_TIME = 1.25, 3.0
"""Time for a path as a multiple of that of its reference; for a baseline that slows down."""
ARRIVED = 0.05
"""Distance from the goal (m) within which a robot that has arrived stays."""
LAST_PIECE = 1.0
"""Time for the rest of the path after the arrival, which counts, s."""
PATCHES, PATCH_RADIUS = 2, 0.08
"""Slippery places on each path: number, radius (m)."""
TUNING_SEEDS = (901, 902)
SPACING = 0.005
"""Distance of the places at which errors are measured, m."""

WITHOUT_SHAPER = {
    'command_shaper.straight_frequency': 0.0,
    'command_shaper.turning_frequency': 0.0,
}
WITHOUT_WHEEL_PARTS = {**WITHOUT_SHAPER, 'estimate_dead_time': False, 'body.enabled': False}


@dataclass(frozen=True)
class TrackingMethod:
    """A way to follow a path."""

    name: str
    controller: Mapping[str, object] = field(default_factory=dict)
    """Parameters of our controller that differ."""
    pursuit: PurePursuitParameters | RegulatedParameters | None = None
    """A baseline in place of our controller."""


TUNED_GAINS: Mapping[str, object] = {'pose.gain_across': 240.0, 'pose.gain_yaw': 8.0}
"""The best of :func:`tune_trackers`, as the lookaheads of the baselines below."""
OURS = 'ours'
METHODS = {
    method.name: method
    for method in (
        TrackingMethod(OURS, TUNED_GAINS),
        TrackingMethod('with the default gains'),
        TrackingMethod('without the pose loop', {'pose.enabled': False}),
        TrackingMethod('without the command shaper', {**TUNED_GAINS, **WITHOUT_SHAPER}),
        TrackingMethod(
            'without the estimate of the dead time', {**TUNED_GAINS, 'estimate_dead_time': False}
        ),
        TrackingMethod('without the body correction', {**TUNED_GAINS, 'body.enabled': False}),
        TrackingMethod(
            'wheels by feed-forward only, with the pose loop',
            {**TUNED_GAINS, **WITHOUT_WHEEL_PARTS},
        ),
        TrackingMethod(
            'wheels by feed-forward only, without it',
            {**WITHOUT_WHEEL_PARTS, 'pose.enabled': False},
        ),
        TrackingMethod('pure pursuit', pursuit=PurePursuitParameters(0.08)),
        TrackingMethod(
            'regulated pure pursuit',
            pursuit=RegulatedParameters(lookahead_time=0.4, min_radius=0.9),
        ),
    )
}


def straight_line() -> Array:
    """Return 2 m straight ahead, m, shape (2, 2)."""
    return np.array([[0.0, 0.0], [2.0, 0.0]])


def square() -> Array:
    """Return a closed square with sides of 1 m, shape (5, 2)."""
    return np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])


def figure_of_eight() -> Array:
    """Return the lemniscate of Gerono, half a length of 0.6 m, which begins along x, m."""
    angle = np.linspace(0.0, math.tau, 721)
    points = 0.6 * np.column_stack([np.sin(angle), np.sin(angle) * np.cos(angle)])
    turn = math.sqrt(0.5) * np.array([[1.0, -1.0], [1.0, 1.0]])
    return points @ turn


def recorded_path() -> Array:
    """Return a path that a robot has driven, m, shape (n, 2)."""
    return load_path(RECORDED_PATH)


def hook() -> Array:
    """Return the path of the tuning: straight, an arc, straight, a sharp corner, straight."""
    angle = np.linspace(0.0, 0.5 * math.pi, 91)
    arc = np.array([0.5, 0.2]) + 0.2 * np.column_stack([np.sin(angle), -np.cos(angle)])
    corner = np.array([0.7, 0.6])
    way = 0.5 * np.array([math.sqrt(0.75), -0.5])
    return np.vstack([[[0.0, 0.0]], arc, [corner], [corner + way]])


TRACKED_PATHS = {
    'straight line': straight_line,
    'square': square,
    'figure of eight': figure_of_eight,
    'recorded path': recorded_path,
}


@dataclass(frozen=True)
class TrackingPlan:
    """What is compared."""

    paths: Sequence[str] = tuple(TRACKED_PATHS)
    seeds: Sequence[int] = (101, 102, 103, 104, 105)
    methods: Sequence[str] = tuple(METHODS)

    def __post_init__(self) -> None:
        for kind, known in (('path', TRACKED_PATHS), ('method', METHODS)):
            names = find_names(kind, getattr(self, f'{kind}s'), known)
            object.__setattr__(self, f'{kind}s', names)
        if not self.paths or not self.seeds or not self.methods:
            raise ValueError('at least one path, one seed and one method must be given')


class TrackingStudy(NamedTuple):
    """What was compared, and what came out."""

    plan: TrackingPlan
    table: ResultTable
    """One row a drive with its ``path``, method as ``controller``, and :func:`errors_of` it."""


class TrackingJob(NamedTuple):
    """A path, its points and a seed."""

    path: str
    points: Array
    seed: int
    drawn: bool = False
    """Whether the true positions are kept."""

    def __str__(self) -> str:
        return f'{self.path}, seed {self.seed}'


def compare_trackers(
    plan: TrackingPlan,
    store: Path | None = None,
    workers: int | Executor = 1,
    report: Report | None = None,
) -> TrackingStudy:
    """Return the drives of every path, method and seed; arguments as of :func:`run_experiment`."""
    runs = []
    for seed in plan.seeds:
        for path in plan.paths:
            points = TRACKED_PATHS[path]()
            for name in plan.methods:
                drawn = seed == plan.seeds[0]
                job = TrackingJob(path, points, seed, drawn), METHODS[name]
                fields = {'path': path, 'controller': name, 'seed': seed}
                runs.append(Run(job, fields, digest(job)))
    return TrackingStudy(
        plan, run_experiment(runs, measured_drive, workers, store=store, report=report)
    )


def measured_drive(job: tuple[TrackingJob, TrackingMethod]) -> Row:
    """Return the errors of a method on a path."""
    (_, points, _, drawn), method = job
    row = errors_of(drive(job), points, timed=method.pursuit is None)
    if not drawn:
        del row['track']
    return row


def drive(job: tuple[TrackingJob, TrackingMethod]) -> Record:
    """Return the record of a method on a path; equal arguments give equal records."""
    (_, points, seed, _), method = job
    generator = np.random.default_rng((seed, 31))
    late, radius, separation = generator.uniform([0.0, -0.005, -0.01], [0.03, 0.005, 0.01])
    robot: dict[str, object] = {
        'drive.dead_time': 0.01 + float(late),
        'right_wheel_radius_multiplier': 1.0 + float(radius),
        'wheel_separation_multiplier': 1.0 + float(separation),
    }
    least = float(
        time_path(points, patrol_run.LIMITS, WheelGeometry(), 1.0 / RATE, ORIGIN).time[-1]
    )
    spare = SLOW_SPARE_TIME if isinstance(method.pursuit, RegulatedParameters) else SPARE_TIME
    tracker = None if method.pursuit is None else Pursuit(points, method.pursuit)
    with patrol_run.world_file(slippery_floor(points, generator)) as world:
        scenario = patrol_run.PatrolScenario(
            seed=seed,
            duration=math.ceil(spare * least) + 2.0,
            world=world,
            keep_out=False,
            robot=robot,
            controller=method.controller,
        )
        return patrol_run.run_patrol(iter([points]), scenario, tracker=tracker)


def slippery_floor(points: Array, generator: np.random.Generator) -> str:
    """Return the YAML text of a world whose slippery patches are on a path (m)."""
    along = resample(points, SPACING)
    places = along[generator.integers(0, len(along), PATCHES)]
    lines = ['name: slippery_floor', 'patches:']
    for x, y in places.tolist():
        lines.append(
            f'  - {{center: [{x:.4f}, {y:.4f}], radius: {PATCH_RADIUS}, grip: {patrol_run.GRIP}}}'
        )
    return '\n'.join(lines) + '\n'


def errors_of(record: Record, points: Array, *, timed: bool) -> Row:
    """Return the errors of a drive along a path (m), shape (n, 2).

    ``cross_track``, root mean square distance from the path, each piece of the drive counted by
    its length (m); ``largest``, distance of the drive from the path, or of the path from the drive
    (m); ``timed``, root mean square distance from the reference at the same time (m), NaN for a
    baseline; ``time`` until the robot stays near the goal (s), NaN if it never does; ``speed``,
    largest commanded |v| (m/s) and |omega| (rad/s); ``acceleration``, their largest changes from
    one command to the next (m/s², rad/s²); ``within_limits``, whether these are those of the
    controller; ``track``, true positions (m).
    """
    away = np.hypot(*(record['truth'][:, :2] - points[-1]).T) > ARRIVED
    arrival = int(np.flatnonzero(away)[-1]) + 1 if away.any() else 0
    track = record['truth'][: arrival + round(LAST_PIECE * RATE), :2]
    driven = resample(track, SPACING) if polyline_length(track) > SPACING else track[[0, -1]]
    path = resample(points, SPACING)
    distance = distance_to_path(driven, path)
    changes = np.abs(np.diff(record['command'], axis=0, prepend=0.0)) * RATE
    speed, acceleration = np.abs(record['command']).max(axis=0), changes.max(axis=0)
    limits = LimitParameters()
    fastest = limits.linear, limits.angular
    steepest = limits.linear_acceleration, limits.angular_acceleration
    return {
        'cross_track': rms(distance),
        'largest': float(max(distance.max(), distance_to_path(path, driven).max())),
        'timed': rms(patrol_run.path_error(record)[: len(track)]) if timed else math.nan,
        'time': float(record.time[arrival]) if arrival < record.time.size else math.nan,
        'speed': speed.tolist(),
        'acceleration': acceleration.tolist(),
        'within_limits': all(
            bool((values <= np.array(bounds) * (1.0 + 1e-9)).all())
            for values, bounds in ((speed, fastest), (acceleration, steepest))
        ),
        'track': track.tolist(),
    }


def tuning_grids() -> Mapping[str, Sequence[TrackingMethod]]:
    """Return the methods to choose from, equally many for ours and each baseline."""
    ours = [
        TrackingMethod(f'k_y {across:g}, k_theta {yaw:g}', {'pose.gain_across': across,
                                                            'pose.gain_yaw': yaw})
        for across in (30.0, 60.0, 120.0, 240.0)
        for yaw in (4.0, 8.0, 16.0)
    ]  # fmt: skip
    plain = [
        TrackingMethod(f'lookahead {1e3 * each:g} mm', pursuit=PurePursuitParameters(each))
        for each in (0.03, 0.04, 0.05, 0.065, 0.08, 0.09, 0.1, 0.11, 0.12, 0.14, 0.17, 0.2)
    ]
    regulated = [
        TrackingMethod(
            f'lookahead {time:g} s, radius {1e3 * radius:g} mm',
            pursuit=RegulatedParameters(lookahead_time=time, min_radius=radius),
        )
        for time in (0.15, 0.25, 0.4)
        for radius in (0.15, 0.3, 0.6, 0.9)
    ]
    return {OURS: ours, 'pure pursuit': plain, 'regulated pure pursuit': regulated}


def tune_trackers(
    workers: int | Executor = 1, report: Report | None = None
) -> Mapping[str, Sequence[tuple[str, float]]]:
    """Return by method each choice with its mean cross-track error (m) on the hook, best first.

    The error of a choice that does not arrive in time is infinite.
    """
    grids, points = tuning_grids(), hook()
    runs = [
        Run(
            (TrackingJob('hook', points, seed), choice),
            {'controller': name, 'choice': choice.name},
        )
        for name, grid in grids.items()
        for choice in grid
        for seed in TUNING_SEEDS
    ]
    table = run_experiment(runs, measured_drive, workers, report=report)

    def error(name: str, choice: TrackingMethod) -> float:
        rows = table.where(controller=name, choice=choice.name)
        return mean([row['cross_track'] if math.isfinite(row['time']) else math.inf
                     for row in rows])  # fmt: skip

    return {
        name: sorted(
            ((choice.name, error(name, choice)) for choice in grid), key=lambda found: found[1]
        )
        for name, grid in grids.items()
    }


# -- tables, page and picture ---------------------------------------------------------------------


VERDICTS = {1: 'ours is better', -1: 'ours is worse', 0: 'inconclusive'}
"""By the sign of how much the error of a method is above ours."""
_DRAWN = {OURS: '#be123c', 'pure pursuit': '#0284c7', 'regulated pure pursuit': '#65a30d'}


def path_table(study: TrackingStudy, path: str) -> result_output.Table:
    """Return errors, time and verdict of each method on a path."""
    head = ['method', 'error rms, mm', 'largest, mm', 'from the timed reference rms, mm']
    head += ['time, s', 'commands within the limits']
    compared = OURS in study.plan.methods
    if compared:
        head += ['rms above ours, mm', 'verdict']
    lines = []
    for name in study.plan.methods:
        rows = study.table.where(path=path, controller=name)
        line: list[str | result_output.Mark] = [name]
        for column in ('cross_track', 'largest', 'timed'):
            line.append(result_output.format_mean([1e3 * row[column] for row in rows], 2))
        line.append(_time([row['time'] for row in rows]))
        line.append('yes' if all(row['within_limits'] for row in rows) else 'no')
        own = {'path': path, 'controller': OURS}
        above = study.table.difference('cross_track', {**own, 'controller': name}, own)
        if name == OURS:
            line += [result_output.EMPTY_CELL, result_output.EMPTY_CELL]
        elif above is not None:
            difference = format_interval(1e3 * above.mean, 1e3 * above.half, '+', 2)
            line += [difference, result_output.verdict_mark(VERDICTS[above.sign])]
        lines.append(line)
    return result_output.Table(path.capitalize(), head, lines, (OURS,), wrap=True)


def summary_table(study: TrackingStudy) -> result_output.Table:
    """Return the rms error and the verdict of each method on each path."""
    lines = []
    for name in study.plan.methods:
        line = [name]
        for path in study.plan.paths:
            errors = [
                1e3 * row['cross_track'] for row in study.table.where(path=path, controller=name)
            ]
            own = {'path': path, 'controller': OURS}
            above = study.table.difference('cross_track', {**own, 'controller': name}, own)
            judged = f'; {VERDICTS[above.sign]}' if name != OURS and above is not None else ''
            line.append(result_output.format_mean(errors, 2) + judged)
        lines.append(line)
    return result_output.Table(
        'Error rms, mm; verdict', ('method', *study.plan.paths), lines, (OURS,)
    )


def _time(times: Sequence[float]) -> str:
    arrived = [time for time in times if math.isfinite(time)]
    if len(arrived) == len(times):
        return format_interval(mean(times), interval(times), digits=1)
    return f'arrived in {len(arrived)} of {len(times)}'


def description(plan: TrackingPlan) -> str:
    """Return in one paragraph what was driven and how it is counted."""
    seeds = len(plan.seeds)
    return (
        'Digital twin with noise, lag, two slippery patches on each path and 10 % of the commands '
        'lost; dead time 0 to 30 ms above the nominal 10 ms, right wheel within 0.5 % and wheel '
        'separation within 1 % of nominal, drawn from the seed; position given within 3 mm, yaw '
        f'within 5 mrad. Every method plans at most {LIMITS.linear:g} m/s, and all '
        f'commands have the limits of the controller. {seeds} seed{"s" * (seeds > 1)}, '
        f'{plan.seeds[0]} to {plan.seeds[-1]}; mean ± half the 95 % interval. Error: distance of '
        'the true position from the path, each piece of the drive counted by its length; largest: '
        'of the drive from the path or of the path from the drive, so that a corner that is cut '
        'counts. The timed reference is that of ours, pure pursuit has none. Time: until the '
        f'robot stays within {1e3 * ARRIVED:g} mm of the goal.'
    )


EXPLANATION = (
    'The verdict compares rms errors seed by seed. Each of its intervals is a 95 % interval by '
    'itself: of twenty comparisons of equal methods, one would be wrong. Errors alone are '
    'compared, not time: ours stops at corners and turns on the spot.'
)


def markdown(study: TrackingStudy) -> str:
    """Return all tables in Markdown."""
    tables = [summary_table(study), *(path_table(study, path) for path in study.plan.paths)]
    texts = [table.markdown() for table in tables]
    return '\n\n'.join([description(study.plan), *texts, EXPLANATION])


def page(study: TrackingStudy, drawn: Mapping[str, bytes]) -> str:
    """Return the page as self-contained HTML, with the pictures by their stems."""
    blocks: list[html_page.Block] = [
        html_page.Contents(),
        html_page.Paragraph(description(study.plan)),
    ]
    if 'tracks' in drawn:
        blocks.append(html_page.Picture(PICTURES[0].title, drawn['tracks'], PICTURES[0].title))
    for path in study.plan.paths:
        blocks += [html_page.Heading(path.capitalize()), path_table(study, path)]
    blocks.append(html_page.Paragraph(EXPLANATION, 'quiet'))
    return html_page.html_page('Path tracking compared', blocks)


def tuning_markdown(found: Mapping[str, Sequence[tuple[str, float]]]) -> str:
    """Return the choices of :func:`.path_tracker_comparison.tune_trackers` in Markdown."""
    tables = [
        result_output.Table(
            f'{name}, seeds {TUNING_SEEDS[0]} to {TUNING_SEEDS[-1]}',
            ('choice', 'error rms, mm'),
            [(choice, f'{1e3 * error:.2f}') for choice, error in each],
        ).markdown()
        for name, each in found.items()
    ]
    return '\n\n'.join(tables)


def record(study: TrackingStudy) -> dict[str, Any]:
    """Return plan and every number for a JSON file."""
    plan = study.plan
    numbers = ('cross_track', 'largest', 'timed', 'time', 'speed', 'acceleration')
    return {
        'format': 1,
        'version': VERSION,
        'seeds': list(plan.seeds),
        'limits': LIMITS.to_dict(),
        'paths': {
            path: {
                method: [
                    {name: row[name] for name in numbers}
                    for row in study.table.where(path=path, controller=method)
                ]
                for method in plan.methods
            }
            for path in plan.paths
        },
    }


def draw_tracks(study: TrackingStudy) -> Any:
    """Return each path with the drives of ours and of the baselines, first seed."""
    from t3mpc_ros.evaluation.figure_style import new_figure  # a run does without it

    figure, axes = new_figure(6.4, (2, 2))
    axes = axes.ravel()
    for axis in axes[len(study.plan.paths) :]:
        axis.set_visible(False)
    for axis, path in zip(axes, study.plan.paths, strict=False):
        axis.plot(*TRACKED_PATHS[path]().T, color='#9ca3af', linewidth=2.5, label='path')
        for method, colour in _DRAWN.items():
            for track in study.table.values('track', path=path, controller=method):
                axis.plot(*np.transpose(track), color=colour, linewidth=0.9, label=method)
        axis.set_title(path)
        axis.set_aspect('equal', adjustable='datalim')
        axis.set(xlabel='x / m', ylabel='y / m')
    axes[0].legend(loc='upper left')
    return figure


PICTURES = (html_page.TitledDrawing('tracks', 'Drives of the first seed', draw_tracks),)
