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
"""Three attackers who predict where a patrol is in five seconds, and what the schedule tells.

``python bench/patrol_attackers.py``: the table of ``docs/patrol.md``, in Markdown: paths in
an empty room, and the planned patrol of the simulated robot in ``room``, seeds 141 to 146, 18 min.
``--planned``: the last one alone. Each attacker sees positions without error, predicts at
each instant of the second half, and says how much he trusts the prediction:

* *arc*: speed and turn rate go on; he trusts steady ones;
* *watcher*: what followed the most similar 4 s of the first half; he trusts what followed each;
* *method*: the same in two hours of the method's own paths of other seeds, with their mirror
  images, so he knows the method but not the seed.

An attacker who knows the state, all but the seed, knows the place exactly unless a switch comes
within the five seconds; the moments of which he is certain are those that the public bounds of the
dwell leave him.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.chaos.chaotic_path import PortraitParameters, PortraitPath
from t3mpc_ros.chaos.path_replanning import PlanParameters
from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.chaos.switching_signal import SwitchingParameters, SwitchingSchedule
from t3mpc_ros.evaluation.confidence_intervals import mean
from t3mpc_ros.evaluation.patrol.baseline_paths import BASELINE_PATHS, Rectangle
from t3mpc_ros.evaluation.patrol.patrol_comparison import PatrolPlan, free_cells
from t3mpc_ros.evaluation.patrol.patrol_metrics import (
    CoverageGrid,
    coverage_at,
    delay_vectors,
    resampled,
    square_distances,
    visits,
)
from t3mpc_ros.evaluation.patrol.patrol_run import (
    LIMITS,
    PatrolScenario,
    portrait_points,
    run_patrol,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.path_timing import PathTiming
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.simulation.world import load_world

STEP, HORIZON = 0.25, 20
"""Interval of the observations, s, and how many of them are five seconds."""
LAGS = (0, 1, 2, 4, 8, 12, 16)
NEIGHBOURS = 5
KNOWN = 0.25  # error below which a place is known, m
TRUSTED = 0.1  # share of the moments that an attacker chooses
DURATION = 1080.0
SEEDS, OTHER_SEEDS = tuple(range(141, 147)), (301, 302)
ARENA = PortraitParameters().arena

Patrol = Callable[[int], tuple[Array, float]]
"""Returns of a seed the places every 0.25 s, m, shape (n, 2), and the coverage."""


def portraits(switching: SwitchingParameters) -> Patrol:
    """Return patrols on portraits that are switched so."""

    def points(seed: int) -> Iterator[Array]:
        parameters = replace(PortraitParameters(), switching=switching)
        path = PortraitPath(ReferenceParameters(), parameters, LIMITS.linear, seed)
        while True:
            yield path.advance(1.0)

    return lambda seed: driven(points(seed))


def random_walk(seed: int) -> tuple[Array, float]:
    """Return a random walk with legs of 1 m."""
    left, bottom, right, top = ARENA
    area = Rectangle((left, bottom), (right, top))
    length = LIMITS.linear * DURATION + 10.0
    path = BASELINE_PATHS['random walk'](area, length, np.random.default_rng((seed, 21)))
    return driven(iter([path]))


def planned(seed: int) -> tuple[Array, float]:
    """Return the patrol of the simulated robot that plans its path in the bundled room."""
    scenario = PatrolScenario(seed, DURATION, world='room', plan=PlanParameters(enabled=True))
    record = run_patrol(portrait_points(seed, PortraitParameters()), scenario)
    x, y, _ = record['truth'][::10].T
    return observed(record.time[::10], x, y, free_cells(PatrolPlan(), load_world('room')))


DEFAULT = PortraitParameters().switching
BEFORE = replace(DEFAULT, kind='random')
PLANNED = 'planned in `room`'
PATHS: dict[str, tuple[Patrol, SwitchingParameters | None]] = {
    'dwell of 8 to 16 s': (portraits(BEFORE), BEFORE),
    **{
        f'memoryless, mean {dwell:g} s': (portraits(made), made)
        for dwell in (5.0, 8.0, 12.0)
        for made in [replace(DEFAULT, mean_dwell=dwell)]
    },
    'random walk': (random_walk, None),
    PLANNED: (planned, None),
}


def driven(points: Iterator[Array]) -> tuple[Array, float]:
    """Return the places of a drive every 0.25 s, shape (n, 2), and its coverage."""
    timing = PathTiming(LIMITS, WheelGeometry(), 0.01)
    rows = [timing.advance_along(points)[0][:2] for _ in range(round(DURATION / 0.01))]
    track = np.array(rows)[::10]
    time = 0.1 * np.arange(len(track))
    left, bottom, right, top = ARENA
    return observed(time, *track.T, CoverageGrid((left, bottom), (right, top)))


def observed(time: Array, x: Array, y: Array, grid: CoverageGrid) -> tuple[Array, float]:
    """Return places (m) every 0.25 s, and which share of the cells was entered."""
    covered = coverage_at(visits(time, x, y, grid), grid, time[-1:] - time[0])
    return resampled(time, x, y, STEP), float(covered[0])


def inputs(track: Array) -> tuple[Array, Array]:
    """Return place and past displacements of each moment, and the displacement that follows."""
    rows = delay_vectors(track, LAGS)[:-HORIZON]
    here = rows[:, :2]
    followed = track[LAGS[-1] + HORIZON :] - here
    return np.hstack([here, 2.0 * (here[:, None] - rows[:, 2:].reshape(len(rows), -1, 2)).reshape(
        len(rows), -1)]), followed  # fmt: skip


def arc(track: Array) -> tuple[Array, Array]:
    """Return displacement predicted and mistrust of each moment."""
    moved = np.diff(track, axis=0) @ np.array([1.0, 1.0j])
    last = moved[LAGS[-1] - 1 : -HORIZON]
    turn = np.angle(moved[1:] * moved[:-1].conj())
    turns = np.stack([turn[LAGS[-1] - 2 - k : len(turn) - HORIZON - k] for k in range(8)])
    ahead = np.exp(1j * np.outer(turns.mean(axis=0), np.arange(1, HORIZON + 1))).sum(axis=1)
    reached = last * ahead
    return np.column_stack([reached.real, reached.imag]), turns.std(axis=0)


def analogues(known: tuple[Array, Array], asked: Array) -> tuple[Array, Array]:
    """Return displacement predicted and mistrust, from what followed similar moments."""
    found, spread = [], []
    for first in range(0, len(asked), 256):
        squares = square_distances(asked[first : first + 256], known[0])
        nearest = np.argpartition(squares, NEIGHBOURS, axis=1)[:, :NEIGHBOURS]
        outcomes = known[1][nearest]
        found.append(outcomes.mean(axis=1))
        away = np.take_along_axis(squares, nearest, axis=1).mean(axis=1)
        spread.append(outcomes.var(axis=1).sum(axis=1) + away / len(LAGS))
    return np.vstack(found), np.concatenate(spread)


class Knowledge(NamedTuple):
    """What an attacker knows of a path in five seconds."""

    median: float  # error, m
    known: float  # share of the moments known to 25 cm
    trusted: float  # the same of the moments that he trusts most


def knowledge(predicted: tuple[Array, Array], followed: Array) -> Knowledge:
    """Return what a prediction is worth."""
    place, mistrust = predicted
    errors = np.hypot(*(place - followed).T)
    chosen = np.argsort(mistrust, kind='stable')[: round(TRUSTED * len(errors))]
    near = errors < KNOWN
    return Knowledge(float(np.median(errors)), float(near.mean()), float(near[chosen].mean()))


def attacked(track: Array, method: tuple[Array, Array]) -> list[Knowledge]:
    """Return what each attacker knows of the second half of a path."""
    asked, followed = inputs(track)
    half = len(track) // 2
    later = slice(half - LAGS[-1], None)
    first = asked[: half - LAGS[-1] - HORIZON], followed[: half - LAGS[-1] - HORIZON]
    straight = arc(track)
    predictions = (
        (straight[0][later], straight[1][later]),
        analogues(first, asked[later]),
        analogues(method, asked[later]),
    )
    return [knowledge(each, followed[later]) for each in predictions]


def library(patrol: Patrol) -> tuple[Array, Array]:
    """Return what an attacker learns from the method: other seeds, and their mirror images."""
    pairs = []
    left, bottom, right, top = ARENA
    middle = 0.5 * np.array([left + right, bottom + top])
    for seed in OTHER_SEEDS:
        track = patrol(seed)[0]
        for mirror in ([1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]):
            pairs.append(inputs(middle + (track - middle) * mirror))
    known, followed = (np.vstack(each) for each in zip(*pairs, strict=True))
    return known, followed


def schedule_knowledge(switching: SwitchingParameters) -> tuple[float, float]:
    """Return the shares of moments without a switch in five seconds: that occur, that are certain.

    The second one is that of the bounds of the dwell: none without a bound.
    """
    schedule, horizon = SwitchingSchedule(switching, 5), HORIZON * STEP
    times = np.arange(0.0, 2e5, 0.5)
    modes = [schedule.at(time) for time in times.tolist()]
    quiet = [mode.until - time > horizon for mode, time in zip(modes, times, strict=True)]
    least = switching.shortest_dwell if switching.kind == 'random' else 0.0
    certain = [
        time - mode.since < least - horizon for mode, time in zip(modes, times, strict=True)
    ]
    return float(np.mean(quiet)), float(np.mean(certain))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--planned', action='store_true', help='the planned patrol alone')
    options = parser.parse_args()
    print('| path | coverage, % | arc | watcher | method | state: right, certain, % |')
    print('|---|---|---|---|---|---|')
    for name, (patrol, switching) in PATHS.items():
        if options.planned and name != PLANNED:
            continue
        method = library(patrol)
        rows, covered = [], []
        for seed in SEEDS:
            track, share = patrol(seed)
            rows.append(attacked(track, method))
            covered.append(share)
        cells = [f'{100 * mean(covered):.1f} (least {100 * min(covered):.1f})']
        for each in zip(*rows, strict=True):
            values = [mean(column) for column in zip(*each, strict=True)]
            cells.append(f'{values[0]:.2f} m; {100 * values[1]:.0f}, {100 * values[2]:.0f}')
        state = schedule_knowledge(switching) if switching else (math.nan, math.nan)
        known = ', '.join(f'{100 * value:.0f}' for value in state)
        cells.append(known if switching else '–')
        print(f'| {name} |', ' | '.join(cells), '|', flush=True)


if __name__ == '__main__':
    main()
