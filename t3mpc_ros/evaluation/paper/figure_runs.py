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
"""The single runs that the paper's figures show, and the claims decided from them."""

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
import re

import numpy as np

from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.evaluation.cases import NOMINAL
from t3mpc_ros.evaluation.experiment import map_jobs, recorded_run
from t3mpc_ros.evaluation.fuzzy_estimation_error import (
    KINDS,
    NORMALISED_GAIN,
    SETTLE,
    estimate,
    estimator,
    simulate_open_loop,
    torque_robot,
)
from t3mpc_ros.evaluation.method_table import FULL, methods
from t3mpc_ros.evaluation.paper.claims import REFERENCE_SPREAD, Claim
from t3mpc_ros.evaluation.paper.paper_study import PAPER_NOISE, SETTLING, WITHOUT, Extent
from t3mpc_ros.evaluation.paper.paper_tables import Results, rank
from t3mpc_ros.evaluation.run_record import START, Record, switch_times
from t3mpc_ros.evaluation.scenario import PLANT_OF, Scenario
from t3mpc_ros.geometry.types import Array

NO_PREVIEW = WITHOUT['preview']
PORTRAITS = 6
"""How many phase portraits are compared, the full controller's among them."""
FOLLOWS = 0.10
"""Settled RMSE over the reference's spread that counts as following under noise."""
LONG_ENOUGH = 59.0
"""Length of a run that the claims are about, s; a shorter one cannot refute them."""
EXPLAINS = 0.5
"""Share of the unknown acceleration's variance that an estimate must explain to follow it."""


@dataclass(frozen=True, slots=True)
class FigureRuns:
    """One run of each kind, all with the same seed and the paper's noise."""

    torque: Record
    """The full controller in the paper's parameter."""
    velocity: Record
    """The full controller as the nodes close the loop."""
    blind: Record
    """The same without preview."""
    portraits: Mapping[str, Record]
    """Of several methods in the paper's parameter, the full controller first."""
    pairs: tuple[tuple[int, int], ...]
    """Signals, from 1, that drive right and left wheel in each mode."""
    driven: Array
    """True speeds of a robot without a controller (86) after it has settled, rad/s, shape
    (n, 2)."""
    estimated: Mapping[str, Array]
    """Their estimates by each kind of fuzzy system."""

    def claims(self) -> list[Claim]:
        """Return the paper's claims on single runs, decided for these."""
        return [decide(self.torque) for decide in (switches_claim, follows_claim, estimate_claim)]


def simulate_figure_runs(extent: Extent, results: Results, workers: int | Executor) -> FigureRuns:
    """Return the runs that are drawn, with the first held-out seed."""
    seed = extent.seeds[0]
    shown = portrait_methods(results)
    wanted = [('torque', name) for name in shown]
    wanted += [('velocity', FULL), ('velocity', NO_PREVIEW)]
    jobs = []
    for drive, name in wanted:
        scenario = Scenario(PLANT_OF[drive], NOMINAL, seed, extent.duration, PAPER_NOISE)
        jobs.append((scenario, methods(drive)[name]))
    found = dict(zip(wanted, map_jobs(recorded_run, jobs, workers), strict=True))
    alone = simulate_open_loop(torque_robot(PAPER_NOISE, seed), SETTLE + extent.duration, seed)
    first = round(SETTLE / alone.period)
    return FigureRuns(
        torque=found['torque', FULL],
        velocity=found['velocity', FULL],
        blind=found['velocity', NO_PREVIEW],
        portraits={name: found['torque', name] for name in shown},
        pairs=ReferenceParameters().switching.pairs,
        driven=alone.speeds[first:],
        estimated={
            kind: estimate(alone, estimator(kind, PAPER_NOISE, NORMALISED_GAIN))[0][first:]
            for kind in KINDS
        },
    )


def portrait_methods(results: Results) -> list[str]:
    """Return the methods of the phase portraits: proposed, other fuzzy kinds, best baselines."""
    rows = results.methods('torque')
    kinds = re.compile(r'fuzzy|type.?[12]\b|\bi?t[12]\b', re.IGNORECASE)
    fuzzy = [row['controller'] for row in rows if kinds.search(row['controller'])]
    best = sorted((row for row in rows if row['baseline']), key=lambda row: rank(row['rmse_mean']))
    return list(dict.fromkeys([FULL, *fuzzy, *(row['controller'] for row in best)]))[:PORTRAITS]


def estimated_unknown(run: Record) -> Array:
    """Return g of (31) as the law used it, rad/s², shape (n, 2): its term in (66) is -g."""
    return -run['terms'][:, TERM_NAMES.index('fuzzy')]


def true_unknown(run: Record) -> Array:
    """Return chi' - u of (30), from the true speeds over each period, rad/s², shape (n - 1, 2)."""
    period = (run.time[-1] - run.time[0]) / (run.time.size - 1)
    found: Array = np.diff(run.speeds, axis=0) / period - run['acceleration'][:-1]
    return found


def explained(run: Record) -> tuple[float, float]:
    """Return the share of the unknown acceleration that g explains, of right and left wheel.

    1 - mean((unknown - g)²)/var(unknown) after the start: 1 is perfect, 0 no better than the
    mean, negative worse than that.
    """
    counted = run.time[:-1] >= START
    target = true_unknown(run)[counted]
    miss = target - estimated_unknown(run)[:-1][counted]
    shares = 1.0 - np.mean(miss**2, axis=0) / np.var(target, axis=0)
    return float(shares[0]), float(shares[1])


def switches_claim(run: Record) -> Claim:
    """Decide whether the reference changes its signals as often as in the paper's run."""
    count = switch_times(run.time, run['mode']).size
    verdict = 'held' if count == 4 else 'not held'
    return Claim(
        'four switches',
        'paper',
        'The reference changes its signals four times in a run, suddenly (60 s here)',
        f'{count} switches in {run.time[-1]:.0f} s',
        verdict if run.time[-1] > LONG_ENOUGH else 'not measured',
        {'switches': count},
    )


def follows_claim(run: Record) -> Claim:
    """Decide whether the outputs follow between switches, in the run that is drawn."""
    settled = run.rmse(START, margins=SETTLING)
    return _of_run(
        run,
        'outputs follow',
        'The outputs track the switching references very well (here: settled RMSE at most '
        f'{100 * FOLLOWS:.0f} % of the reference, torque drive, noise {PAPER_NOISE:g}, run shown)',
        f'settled RMSE {settled:.3f} rad/s, {100 * settled / REFERENCE_SPREAD:.1f} %',
        settled <= FOLLOWS * REFERENCE_SPREAD,
        {'settled': settled},
    )


def estimate_claim(run: Record) -> Claim:
    """Decide whether the fuzzy systems' estimates follow the true unknown acceleration."""
    right, left = explained(run)
    return _of_run(
        run,
        'estimates follow',
        'The estimated signals follow their targets (here: they explain at least '
        f'{100 * EXPLAINS:.0f} % of the variance on both wheels, run shown)',
        f'{100 * right:.0f} % of the variance explained on the right, {100 * left:.0f} % left',
        min(right, left) >= EXPLAINS,
        {'right': right, 'left': left},
    )


def _of_run(
    run: Record, name: str, text: str, found: str, held: bool, numbers: dict[str, object]
) -> Claim:
    """Return the claim with its verdict; a short run refutes nothing."""
    refuted = 'not held' if run.time[-1] > LONG_ENOUGH else 'inconclusive'
    return Claim(name, 'paper', text, found, 'held' if held else refuted, numbers)
