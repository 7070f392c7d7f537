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
"""The paper's study: its runs, and what is measured of each."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.evaluation.cases import CASES, NOMINAL
from t3mpc_ros.evaluation.controller_adapters import MethodSpec
from t3mpc_ros.evaluation.experiment import Run
from t3mpc_ros.evaluation.method_table import STAGES as METHOD_STAGES
from t3mpc_ros.evaluation.method_table import methods
from t3mpc_ros.evaluation.run_key import digest
from t3mpc_ros.evaluation.run_record import START, Record
from t3mpc_ros.evaluation.scenario import HELD_OUT_SEEDS, KINDS, PLANT_OF, Scenario, held_out

DRIVES = ('torque', 'velocity')
"""torque: u is applied as the torque theta_bar u, as in the paper; velocity: the wheels follow
commanded speeds with delay and lag, as on the robot."""
NOISES = (0.0, 0.01, 0.04, 0.1)
"""Noise variance of the measured wheel speeds, (rad/s)²: the paper's range."""
PAPER_NOISE = 0.04
"""The paper's own noise variance, (rad/s)²."""
DEAD_TIME = 'dead time'
"""The case that only the velocity drive has."""
STAGES = tuple(METHOD_STAGES)
"""The controller as it grows; the last step, to :data:`FULL`, adds preview."""
PARTS = ('NT3FS', 'compensator', 'MPC', 'preview')
"""Part that each stage adds."""
WITHOUT = {
    'NT3FS': 'full without NT3FS',
    'compensator': 'full without compensator',
    'MPC': 'full without MPC',
    'MPC, equal bound': 'full without MPC, equal bound',
    'preview': 'full without preview',
    'trained predictor': 'full with random predictor',
}
"""The full controller with one part left out, by that part."""
INTENDED_CASES = {
    WITHOUT['NT3FS']: ('mass +30 %', 'friction x3'),
    WITHOUT['compensator']: ('disturbance',),
    WITHOUT['MPC']: (DEAD_TIME, 'friction x3'),
    WITHOUT['MPC, equal bound']: (DEAD_TIME, 'friction x3'),
    WITHOUT['trained predictor']: (DEAD_TIME,),
}
"""The cases beside the nominal one in which the controller runs without a part."""
DURATION = 59.5
"""Length of a run, s: four switches, and an end before the fifth, which methods with preview would
begin to cross without the run seeing what it is good for."""
SETTLING = KINDS['servo'].settling
"""Time before and after each switch that the settled RMSE leaves out, s."""
NUMBERS = ('rmse', 'settled', 'chatter', 'largest_error')
"""Numbers of a run: RMSE of both wheels with and without switches, rad/s, total variation of the
effort per second and wheel, rad/s³, and largest tracking error, rad/s."""


@dataclass(frozen=True, slots=True)
class Extent:
    """How much is run."""

    seeds: tuple[int, ...] = HELD_OUT_SEEDS
    duration: float = DURATION
    """s"""
    cases: tuple[str, ...] = tuple(name for name, case in CASES.items() if case.reproduced)
    noises: tuple[float, ...] = NOISES
    """Noises of the nominal case."""
    perturbed_noises: tuple[float, ...] = (0.0, PAPER_NOISE)
    """Noises at which the stages of the controller run the other cases."""
    baseline_cases: tuple[str, ...] = ('mass +30 %', 'mass -30 %')
    """The cases beside the nominal one that baselines with preview run."""

    def __post_init__(self) -> None:
        if not self.duration >= 5.0:
            raise ValueError(f'duration must be at least 5 s, 3 do not count: got {self.duration}')


def chosen_extent(*, quick: bool = False, seeds: Sequence[int] | None = None) -> Extent:
    """Return how much is run: everything, or with ``quick`` enough to see that all works."""
    chosen = held_out(seeds or (HELD_OUT_SEEDS[:3] if quick else HELD_OUT_SEEDS))
    if not quick:
        return Extent(chosen)
    cases = (NOMINAL, 'mass +30 %', 'friction x3', 'disturbance', DEAD_TIME)
    return Extent(chosen, 26.0, cases, (0.0, PAPER_NOISE), (PAPER_NOISE,), ())


def study_runs(extent: Extent) -> list[Run]:
    """Return all runs, seed by seed, so that fast and slow methods stay mixed.

    Every baseline and every stage of the controller in the nominal case at every noise; the stages
    in every other case at ``perturbed_noises``; at the paper's noise the controller with one part
    left out in the cases that part is for, and baselines with preview in ``baseline_cases``.
    """
    made = {
        (drive, method.name): digest(method, measure)
        for drive in DRIVES
        for method in methods(drive).values()
    }
    situations = list(_situations(extent))
    found = []
    for seed in extent.seeds:
        for method, drive, noise, case in situations:
            scenario = Scenario(PLANT_OF[drive], case, seed, extent.duration, noise)
            fields = {
                'controller': method.name,
                'baseline': method.baseline,
                'preview': method.preview,
                'drive': drive,
                'noise': noise,
                'case': case,
                'seed': seed,
                'duration': extent.duration,
            }
            key = digest(scenario, made[drive, method.name])
            found.append(Run((scenario, method), fields, key))
    return found


def _situations(extent: Extent) -> Iterator[tuple[MethodSpec, str, float, str]]:
    for drive in DRIVES:
        for case in extent.cases:
            if PLANT_OF[drive] not in CASES[case].robots:
                continue
            for noise in extent.noises:
                for method in methods(drive).values():
                    if noise in _noises(extent, method, case):
                        yield method, drive, noise, case


def _noises(extent: Extent, method: MethodSpec, case: str) -> tuple[float, ...]:
    """Return the noises at which a method runs a case."""
    if method.name in WITHOUT.values():
        wanted = case == NOMINAL or case in INTENDED_CASES.get(method.name, ())
        return (PAPER_NOISE,) if wanted else ()
    if case == NOMINAL:
        return extent.noises
    if method.baseline:
        return (PAPER_NOISE,) if method.preview and case in extent.baseline_cases else ()
    return extent.perturbed_noises


def measure(record: Record) -> dict[str, object]:
    """Return :data:`NUMBERS`, NaN where a run left the finite ones; the start does not count."""
    arrays = record.reference, record.speeds, record['acceleration'], record['terms']
    if not all(bool(np.isfinite(values).all()) for values in arrays):
        return {**dict.fromkeys(NUMBERS, math.nan), 'finite': False}
    return {
        'rmse': record.rmse(START),
        'settled': record.rmse(START, margins=SETTLING),
        'chatter': record.variation(),
        'largest_error': record.largest_error(START),
        'finite': True,
    }
