# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The single runs that the figures show, and the claims decided from them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.evaluation.methods import FULL
from t3mpc_ros.evaluation.metrics import START
from t3mpc_ros.evaluation.open_loop_estimation import (
    KINDS,
    NORMALISED_GAIN,
    SETTLE,
    estimate,
    estimator,
    simulate_open_loop,
    torque_robot,
)
from t3mpc_ros.evaluation.paper.claims import REFERENCE_SPREAD, Claim
from t3mpc_ros.evaluation.paper.experiment_runs import (
    NOMINAL,
    PAPER_NOISE,
    SETTLING,
    WITHOUT,
    ExperimentGrid,
    ExperimentSetup,
)
from t3mpc_ros.evaluation.paper.results import Results
from t3mpc_ros.evaluation.record import Record, switch_times
from t3mpc_ros.evaluation.workers import full_record

Array = NDArray[np.float64]

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

    seed: int
    torque: Record
    """The full controller in the paper's parameter."""
    velocity: Record
    """The full controller as the nodes close the loop."""
    blind: Record | None
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
        return [switches_claim(self.torque), follows_claim(self.torque), estimate_claim(self)]


def simulate_figure_runs(
    setup: ExperimentSetup, grid: ExperimentGrid, results: Results, team: Any
) -> FigureRuns:
    """Return the runs that are drawn, with the first held-out seed."""
    seed = grid.seeds[0]
    shown = portrait_methods(results)
    requested = [('torque', name) for name in shown] + [('velocity', FULL)]
    if NO_PREVIEW in setup.methods('velocity'):
        requested.append(('velocity', NO_PREVIEW))
    methods = {kind: setup.methods(kind) for kind in ('torque', 'velocity')}
    jobs = [
        (
            setup.scenario(
                drive=kind, noise=PAPER_NOISE, case=NOMINAL, seed=seed, duration=grid.duration
            ),
            methods[kind][name],
        )
        for kind, name in requested
    ]
    found: dict[tuple[str, str], Record] = {}
    for index, run in setup.measure_many(jobs, full_record, team):
        found[requested[index]] = run
    if len(found) != len(requested):
        raise RuntimeError(f'{len(requested) - len(found)} runs never came back')
    alone = simulate_open_loop(torque_robot(PAPER_NOISE, seed), SETTLE + grid.duration, seed)
    first = round(SETTLE / alone.period)
    return FigureRuns(
        seed=seed,
        torque=found['torque', FULL],
        velocity=found['velocity', FULL],
        blind=found.get(('velocity', NO_PREVIEW)),
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
    rows = results.rows_of('torque', PAPER_NOISE, baseline=True)
    rows.sort(key=lambda row: math.inf if math.isnan(row.rmse_mean) else row.rmse_mean)
    names = [row.controller for row in rows]
    kinds = re.compile(r'fuzzy|type.?[12]\b|\bi?t[12]\b', re.IGNORECASE)
    fuzzy = [name for name in results.kinds if kinds.search(name)]
    measured = [name for name in fuzzy if results.row(name, 'torque', PAPER_NOISE)]
    return list(dict.fromkeys([FULL, *measured, *names]))[:PORTRAITS]


def switches_of(run: Record) -> Array:
    """Return the times (s) at which the reference switches."""
    return switch_times(run.time, run['mode'])


def largest_switch(run: Record) -> int | None:
    """Return the row of the switch with the largest jump, None when there is none.

    Switches so near the end that nothing of what follows could be shown do not count, unless
    there are no others.
    """
    rows = np.flatnonzero(np.diff(run['mode']) != 0) + 1
    early = rows[run.time[rows] < run.time[-1] - 3.0]
    rows = early if early.size else rows
    if not rows.size:
        return None
    jumps = np.abs(run.reference[rows] - run.reference[rows - 1]).sum(axis=1)
    return int(rows[int(np.argmax(jumps))])


def estimated_unknown(run: Record) -> Array:
    """Return g of (31) as the law used it, rad/s², shape (n, 2): its term in (66) is -g."""
    found: Array = -run['terms'][:, TERM_NAMES.index('fuzzy')]
    return found


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
    count = switches_of(run).size
    text = 'The reference changes its signals four times in a run, suddenly (60 s here)'
    long_enough = run.time[-1] > LONG_ENOUGH
    return Claim(
        'four switches',
        'paper',
        text,
        f'{count} switches in {run.time[-1]:.0f} s',
        count == 4 if long_enough else None,
        {'switches': count},
    )


def follows_claim(run: Record) -> Claim:
    """Decide whether the outputs follow between switches, in the run that is drawn."""
    text = (
        'The outputs track the switching references very well (here: settled RMSE at most '
        f'{100 * FOLLOWS:.0f} % of the reference, torque drive, noise {PAPER_NOISE:g}, run shown)'
    )
    settled = run.rmse(START, margins=SETTLING)
    found = f'settled RMSE {settled:.3f} rad/s, {100 * settled / REFERENCE_SPREAD:.1f} %'
    held = bool(settled <= FOLLOWS * REFERENCE_SPREAD)
    return _of_run(run, Claim('outputs follow', 'paper', text, found, held, {'settled': settled}))


def estimate_claim(showcase: FigureRuns) -> Claim:
    """Decide whether the fuzzy systems' estimates follow the true unknown acceleration."""
    text = (
        'The estimated signals follow their targets (here: they explain at least '
        f'{100 * EXPLAINS:.0f} % of the variance on both wheels, run shown)'
    )
    right, left = explained(showcase.torque)
    found = f'{100 * right:.0f} % of the variance explained on the right, {100 * left:.0f} % left'
    held = bool(min(right, left) >= EXPLAINS)
    numbers: dict[str, object] = {'right': right, 'left': left}
    claim = Claim('estimates follow', 'paper', text, found, held, numbers)
    return _of_run(showcase.torque, claim)


def _of_run(run: Record, claim: Claim) -> Claim:
    if claim.held or run.time[-1] > LONG_ENOUGH:
        return claim
    return replace(claim, held=None, inconclusive=True)


def broken_at_switches(run: Record, values: Sequence[Array] | Array) -> Array:
    """Return ``values`` (n, 2) with a gap before each switch: a jump is no line in a portrait."""
    rows = np.flatnonzero(np.diff(run['mode']) != 0) + 1
    broken: Array = np.insert(np.asarray(values, dtype=np.float64), rows, np.nan, axis=0)
    return broken
