#!/usr/bin/env python3
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
"""Bodies that two gains cannot describe: the controller beside simpler corrections on the twin.

Usage: body_map.py [--seeds 4001-4012] [--workers N]

- creep: soft tyres lose up to 12 % of the turn, more at higher speed and curvature
- payload: half-way through the run the radii change by -3 and +2 %, the track by +2 %
- floors: on every other strip of 0.4 m across x the track is 6 % wider

For each body and method the settled RMSE of the yaw rate and the yaw drift, means over the seeds,
and the difference of the controller to each other method, paired, with half its 95 % interval.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
import math
from pathlib import Path
import sys
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from t3mpc_ros.evaluation.confidence_intervals import interval
from t3mpc_ros.evaluation.experiment import map_jobs
from t3mpc_ros.evaluation.loop import run
from t3mpc_ros.evaluation.method_table import FULL, LMS, SHAPED_IN_TIME, methods_for
from t3mpc_ros.evaluation.run_record import Numbers, measure
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.geometry.kinematics import twist_from_wheels
from t3mpc_ros.simulation.digital_twin import DigitalTwin

METHODS = (FULL, LMS, SHAPED_IN_TIME)
METRICS = 'yaw_rate_settled', 'drift'
CHANGE, STRIP = 30.0, 0.4
"""Time at which the payload shifts, s; width of a floor, m."""
Multipliers = tuple[float, float, float]
"""Of the radius of the right and of the left wheel, and of the track."""


def creep(twin: DigitalTwin) -> Multipliers:
    """Return those of soft tyres, by yaw rate and lateral acceleration."""
    twist = twist_from_wheels(twin._drivetrain.ground, twin._parameters.true_geometry)
    lost = 0.02 * abs(twist.angular) + 0.15 * abs(twist.linear * twist.angular)
    return 1.0, 1.0, 1.0 + 0.12 * math.tanh(lost / 0.12)


def payload(twin: DigitalTwin) -> Multipliers:
    """Return those of a payload that shifts once."""
    return (1.01, 0.99, 1.0) if twin._elapsed < CHANGE else (0.98, 1.01, 1.02)


def floors(twin: DigitalTwin) -> Multipliers:
    """Return those of two floors."""
    other = math.floor(twin._drivetrain.pose.x / STRIP + 0.5) % 2
    return 1.0, 1.0, 1.06 if other else 1.0


BODIES: dict[str, Callable[[DigitalTwin], Multipliers]] = {
    'creep': creep,
    'payload': payload,
    'floors': floors,
}


@dataclass(frozen=True)
class Job:
    """One run."""

    body: str
    method: str
    seed: int

    @property
    def name(self) -> str:
        """Name in errors."""
        return f'{self.body}, {self.method}, seed {self.seed}'


def change(twin: DigitalTwin, multipliers: Multipliers) -> None:
    """Give the twin other radii and another track; the rotors keep their angles and speeds."""
    drivetrain, before = twin._drivetrain, twin._drivetrain._multipliers
    right, left, track = multipliers
    twin._parameters = replace(
        twin._parameters,
        right_wheel_radius_multiplier=right,
        left_wheel_radius_multiplier=left,
        wheel_separation_multiplier=track,
    )
    twin._update_load()
    for wheel, ratio in enumerate((right / before[0], left / before[1])):
        drivetrain._state[[3 + wheel, 5 + wheel, 7 + wheel]] *= ratio
    drivetrain._read()


def run_job(pair: tuple[Job, Job]) -> Numbers:
    """Return the numbers of a run in which the body changes with each measurement."""
    job, original = pair[0], DigitalTwin._measure

    def changed(twin: DigitalTwin) -> None:
        original(twin)
        change(twin, BODIES[job.body](twin))

    scenario = Scenario('twin', 'nominal', job.seed)
    with patch.object(DigitalTwin, '_measure', changed):
        return measure(run(scenario, methods_for('twin')[job.method]))


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n', maxsplit=1)[0])
    parser.add_argument('--seeds', default='4001-4012')
    parser.add_argument('--workers', type=int, default=2)
    chosen = parser.parse_args()
    first, _, last = chosen.seeds.partition('-')
    seeds = range(int(first), int(last or first) + 1)
    jobs = [Job(body, name, seed) for body in BODIES for name in METHODS for seed in seeds]
    results = map_jobs(run_job, [(job, job) for job in jobs], chosen.workers, progress=True)
    found = dict(zip(jobs, results, strict=True))
    print(
        '| body | number | ' + ' | '.join(METHODS) + ' |\n|---' + len(METHODS) * '|---' + '|---|'
    )
    for body in BODIES:
        for metric in METRICS:
            values = {
                name: np.array([found[Job(body, name, seed)][metric] for seed in seeds])
                for name in METHODS
            }
            cells = [f'{np.mean(values[FULL]):.4f}']
            for name in METHODS[1:]:
                less = values[FULL] - values[name]
                cells.append(
                    f'{np.mean(values[name]):.4f} ({np.mean(less):+.4f} ± {interval(less):.4f})'
                )
            print(f'| {body} | {metric} | ' + ' | '.join(cells) + ' |')
    return 0


if __name__ == '__main__':
    sys.exit(main())
