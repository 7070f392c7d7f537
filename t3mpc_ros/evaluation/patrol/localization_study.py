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
"""How well a patrol knows its place: odometry alone against the particle filter, in a known room.

The simulated robot drives its chaotic path by the pose in question, with the noise of its sensors,
oil on the floor, and a tenth of the commands lost.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
import math
from pathlib import Path
from types import MappingProxyType

import numpy as np

from t3mpc_ros.chaos.chaotic_path import PortraitParameters
from t3mpc_ros.chaos.path_replanning import PlanParameters
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.experiment import Report, ResultTable, Row, Run, run_experiment
from t3mpc_ros.evaluation.patrol import patrol_run
from t3mpc_ros.evaluation.result_output import Table
from t3mpc_ros.evaluation.run_cache_key import digest
from t3mpc_ros.evaluation.run_record import RATE, Record, spans_of
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import find_names

CARRIED_AT = 30.0
"""When the robot is carried, s."""
LOST_DISTANCE, LOST_TIME = 0.3, 10.0
"""A robot is lost whose pose is so far off (m) for so long (s)."""
FOUND_WITHIN = 60.0
"""Time in which a robot that was carried is to be found, s."""
TRIPLED = MappingProxyType(
    {
        'noise.variance': 9.0 * 0.04,
        'imu.gyro_noise': 3.0 * 0.005,
        'range_sensor.voltage_noise': 3.0 * 0.01,
        'range_sensor.voltage_offset': 3.0 * 0.01,
    }
)
"""Parameters of a twin with three times the noise of wheels, gyro and ranges."""
_LOCALIZED = patrol_run.PatrolScenario(localization='filter')
_TRIPLED = replace(_LOCALIZED, range_loss=0.2, robot=dict(TRIPLED))
CASES: Mapping[str, patrol_run.PatrolScenario] = {
    'odometry alone': patrol_run.PatrolScenario(localization='odometry'),
    'particle filter': _LOCALIZED,
    'noise x 3, 20 % of the readings lost': _TRIPLED,
    'carried by 1 m and 90 degrees': replace(_LOCALIZED, carried_at=CARRIED_AT),
    'carried, noise x 3, 20 % lost': replace(_TRIPLED, carried_at=CARRIED_AT),
}
"""The cases by name."""


@dataclass(frozen=True)
class LocalizationPlan:
    """What is compared."""

    cases: Sequence[str] = tuple(CASES)
    seeds: Sequence[int] = tuple(range(101, 121))
    duration: float = 1800.0
    """s"""
    world: str = 'room'
    """Known room: a name or a file."""
    planned: bool = False
    """Whether the path goes around what is known."""

    def __post_init__(self) -> None:
        object.__setattr__(self, 'cases', find_names('case', self.cases, CASES))
        if self.duration < CARRIED_AT + FOUND_WITHIN:
            raise ValueError(
                f'duration must be at least {CARRIED_AT + FOUND_WITHIN:g} s, so that a robot that '
                f'is carried may be found: got {self.duration:g}'
            )


def compare_localizations(
    plan: LocalizationPlan,
    store: Path | None = None,
    workers: int | Executor = 1,
    report: Report | None = None,
) -> ResultTable:
    """Return a row for each case and seed; arguments as of :func:`run_experiment`."""
    runs, path = [], PlanParameters(enabled=plan.planned)
    for name in plan.cases:
        known = replace(CASES[name], duration=plan.duration, known_world=plan.world, plan=path)
        for seed in plan.seeds:
            case = replace(known, seed=seed)
            job = case, name
            runs.append(Run(job, {'controller': name, 'seed': seed}, digest(job)))
    return run_experiment(runs, measured_localization, workers, store=store, report=report)


def measured_localization(job: tuple[patrol_run.PatrolScenario, str]) -> Row:
    """Return the row of one patrol, see :func:`localization_errors`."""
    case, _ = job
    points = patrol_run.portrait_points(case.seed, PortraitParameters())
    return localization_errors(patrol_run.run_patrol(points, case), case.carried_at)


def localization_errors(record: Record, carried_at: float = math.inf) -> Row:
    """Return how far the pose in use was from the true one.

    ``position`` and ``yaw``, root mean squares (m, rad), up to when the robot is carried;
    ``largest`` position error up to then (m); ``lost``, time in which the robot was lost (s);
    ``found``, time from carrying until it was lost no more (s), infinite if it still was at the
    end; ``deceived``, time in which it was off by :data:`LOST_DISTANCE` and took its place for
    known (s); ``on_path``, see :func:`.share_on_path`; ``contacts``.
    """
    apart = record['pose'] - record['truth']
    position = np.hypot(apart[:, 0], apart[:, 1])
    yaw = np.abs(np.remainder(apart[:, 2] + math.pi, math.tau) - math.pi)
    before = record.time < carried_at
    off = (position > LOST_DISTANCE) | (yaw > LOST_DISTANCE)
    after = np.flatnonzero(off & ~before)
    found = (float(record.time[after[-1]]) - carried_at) if after.size else 0.0
    if after.size and after[-1] == len(record) - 1:
        found = math.inf
    return {
        'position': rms(position[before]),
        'yaw': rms(yaw[before]),
        'largest': float(position[before].max()),
        'lost': lost_time(position),
        'found': found if math.isfinite(carried_at) else math.nan,
        'deceived': float((off & record['localized'].astype(np.bool_)).sum()) / RATE,
        'on_path': patrol_run.share_on_path(record),
        'contacts': patrol_run.contact_count(record),
    }


def lost_time(position: Array) -> float:
    """Return the time (s) of all spans of an error above the distance that last long enough."""
    spans = [(each.stop - each.start) / RATE for each in spans_of(position > LOST_DISTANCE)]
    return float(sum(span for span in spans if span > LOST_TIME))


def markdown(plan: LocalizationPlan, table: ResultTable) -> str:
    """Return the medians, with the worst of all seeds in brackets, as a table in Markdown."""

    def cell(
        name: str, column: str, scale: float, digits: int, worst: Callable[..., float] = max
    ) -> str:
        values = [scale * value for value in table.values(column, controller=name)]
        return f'{np.median(values):.{digits}f} ({worst(values):.{digits}f})'

    rows = []
    for name in plan.cases:
        times = table.values('found', controller=name)
        again = sum(time <= FOUND_WITHIN for time in times)
        carried = math.isfinite(CASES[name].carried_at)
        rows.append(
            (
                name,
                cell(name, 'position', 1e3, 1),
                cell(name, 'yaw', 180.0 / math.pi, 2),
                cell(name, 'largest', 1e3, 0),
                '' if carried else cell(name, 'lost', 1.0, 0),
                f'{again} of {len(times)}' if carried else '',
                cell(name, 'deceived', 1.0, 1),
                cell(name, 'on_path', 100.0, 1, min),
                f'{sum(table.values("contacts", controller=name)):.0f}',
            )
        )
    head = (
        'pose',
        'position rms, mm',
        'yaw rms, degrees',
        'largest, mm',
        'lost, s',
        f'found within {FOUND_WITHIN:g} s',
        'wrong and sure, s',
        f'on its path from minute {patrol_run.explored_after(plan.duration) / 60.0:g} on, %',
        'contacts',
    )
    planned = ', planned path' if plan.planned else ''
    title = (
        f'{plan.duration / 60.0:g} min in {plan.world}{planned}, {len(plan.seeds)} seeds from '
        f'{plan.seeds[0]}: median (worst)'
    )
    return Table(title, head, rows).markdown()
