# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Claims of the paper and of this package, decided from the results.

A method that diverged satisfies no claim. Results of fewer seeds or shorter runs than those of the
claims decide only what their interval over the seeds leaves no doubt about; other claims are
inconclusive.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
import math
import re
from statistics import median

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.bag_report.metrics import format_number
from t3mpc_ros.evaluation.confidence_intervals import interval, mean
from t3mpc_ros.evaluation.methods import FULL
from t3mpc_ros.evaluation.open_loop_estimation import KINDS, EstimationResult
from t3mpc_ros.evaluation.paper.experiment_runs import (
    DRIVES,
    EXACT,
    NOMINAL,
    PAPER_NOISE,
    WITHOUT,
    Experiment,
)
from t3mpc_ros.evaluation.paper.results import PairedDifference, ResultRow, Results, step_to
from t3mpc_ros.evaluation.reporting import Table

Array = NDArray[np.float64]

SLIGHTLY = 0.10
"""Relative growth of an RMSE that still is "only slightly"; the paper gives no number."""
REFERENCE_SPREAD = 3.0
"""Standard deviation of the reference of a wheel, rad/s."""
WRONG_INERTIA = ('mass +30 %', 'mass -30 %')
LOUDEST = 0.1
"""The largest noise variance of the paper, (rad/s)²."""
ESTIMATION_SEEDS = 20
"""Seeds of the comparison (86) that the claims are about."""
INTENDED = (
    ('NT3FS', 'mass +30 %', DRIVES),
    ('NT3FS', 'friction x3', DRIVES),
    ('compensator', 'disturbance', DRIVES),
    ('MPC', 'dead time', ('velocity',)),
    ('preview', NOMINAL, ('velocity',)),
)
"""Each part with the case and the drives it is meant for."""
_EQUAL = 'MPC, equal bound'
ALONE = ((_EQUAL, 'dead time'), (_EQUAL, 'friction x3'), ('trained predictor', 'dead time'))


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim with its verdict."""

    name: str
    origin: str
    """``'ours'`` or ``'paper'``."""
    text: str
    """The claim and its criterion."""
    found: str = 'not measured'
    held: bool | None = None
    """None: not measured, or inconclusive."""
    numbers: dict[str, object] = field(default_factory=dict)
    inconclusive: bool = False
    """Whether too little was measured to decide."""

    @property
    def verdict(self) -> str:
        """``'held'``, ``'not held'``, ``'inconclusive'`` or ``'not measured'``."""
        if self.held is None:
            return 'inconclusive' if self.inconclusive else 'not measured'
        return 'held' if self.held else 'not held'

    def record(self) -> dict[str, object]:
        """Return the claim as plain data."""
        found = asdict(self) | {'verdict': self.verdict}
        del found['inconclusive']
        return found


def all_claims(results: Results, estimated: Sequence[EstimationResult]) -> list[Claim]:
    """Return all claims: of this package, then of the paper."""
    found = [
        share_of_best(results, 'velocity', PAPER_NOISE, 0.60),
        share_of_best(results, 'velocity', 0.0, 0.50),
        *(no_worse_than_preview(results, drive) for drive in DRIVES),
        *(no_worse_than_exact_model(results, drive) for drive in DRIVES),
    ]
    for part, case, drives in INTENDED:
        found += [part_helps(results, part, case, drive) for drive in drives]
    for part, case, drives in INTENDED:
        found += [part_is_missed(results, part, case, drive) for drive in drives]
    found += [part_is_missed(results, part, case, 'velocity') for part, case in ALONE]
    found += [no_larger_than_pi(results, drive) for drive in DRIVES]
    found += [smallest_growth(results, drive) for drive in DRIVES]
    found += [settled(results, drive) for drive in DRIVES]
    found += [share_of_best(results, drive, PAPER_NOISE, 0.50, paper=True) for drive in DRIVES]
    found += [grows_slightly(results, drive) for drive in DRIVES]
    found += [others_grow(results, drive) for drive in DRIVES]
    found += [calm_control(results, drive) for drive in DRIVES]
    enough = all(len(each.speed) >= ESTIMATION_SEEDS for each in estimated)
    return found + estimation_claims(estimated, complete=results.complete and enough)


def share_of_best(
    results: Results, drive: str, noise: float, limit: float, *, paper: bool = False
) -> Claim:
    """Decide whether the full controller's RMSE is at most ``limit`` of the best baseline's.

    Ours leaves baselines with preview to :func:`no_worse_than_preview`; the paper's, that it is
    better by half, is against all of them.
    """
    kind = 'baseline' if paper else 'baseline without preview'
    words = 'About 50 % more accurate than other methods: RMSE' if paper else 'RMSE'
    name = 'half of the best baseline' if paper else 'share of the best baseline without preview'
    claim = Claim(
        f'{name}, {drive}, noise {noise:g}',
        'paper' if paper else 'ours',
        f'{words} at most {limit:.2f} of that of the best {kind} ({drive} drive, nominal, noise '
        f'{noise:g})',
    )
    full = results.row(FULL, drive, noise)
    baselines = results.rows_of(drive, noise, baseline=True, preview=None if paper else False)
    baselines = [row for row in baselines if EXACT not in row.controller]
    best = _best(baselines)
    if full is None or best is None:
        return claim
    share = full.rmse_mean / best.rmse_mean
    margin = limit * _rmses(results, best) - _rmses(results, full)
    return _decide(
        claim,
        results.complete,
        share <= limit,
        f'{_rmse(full)} against {_rmse(best)} of {best.controller}, the best of {len(baselines)}: '
        f'{share:.2f} of it',
        {
            'full': full.rmse_mean,
            'best_rival': best.controller,
            'best': best.rmse_mean,
            'share': share,
            'limit': limit,
        },
        (margin,),
    )


def no_worse_than_preview(results: Results, drive: str) -> Claim:
    """Decide whether RMSE is no larger than any baseline's that plans with a wrong inertia."""
    claim = Claim(
        f'baselines with preview, wrong inertia in their models, {drive}',
        'ours',
        'RMSE no larger than that of any predictive baseline with preview whose model is 30 % off '
        f'in its inertia, or within the paired interval ({drive} drive, noise {PAPER_NOISE:g})',
    )
    return _against_preview(claim, results, drive, (NOMINAL,), exact=False)


def no_worse_than_exact_model(results: Results, drive: str) -> Claim:
    """Decide the same of baselines that know the nominal inertia, where the robot has another."""
    claim = Claim(
        f'baselines with preview, wrong inertia of the robot, {drive}',
        'ours',
        'RMSE no larger than that of any predictive baseline with preview and the nominal model '
        'when '
        f'mass and inertia of the robot are 30 % more or less ({drive} drive, noise '
        f'{PAPER_NOISE:g})',
    )
    return _against_preview(claim, results, drive, WRONG_INERTIA, exact=True)


def part_helps(results: Results, part: str, case: str, drive: str) -> Claim:
    """Decide whether adding a part to the stage before it lowers RMSE, interval below zero."""
    more, less = step_to(part)
    claim = Claim(
        f'{part} lowers RMSE, {case}, {drive}',
        'ours',
        f'Adding {part} lowers RMSE in the case {case} ({drive} drive, noise {PAPER_NOISE:g}; '
        f'{more} less {less}, same seeds, 95 % interval below zero)',
    )
    return _paired(claim, results, results.paired(more, less, drive, PAPER_NOISE, case))


def part_is_missed(results: Results, part: str, case: str, drive: str) -> Claim:
    """Decide whether the full controller beats itself without one part, interval below zero."""
    less = WITHOUT[part]
    claim = Claim(
        f'{part} is missed, {case}, {drive}',
        'ours',
        f'Leaving {part} out of the full controller costs RMSE in the case {case} ({drive} '
        f'drive, noise {PAPER_NOISE:g}; {FULL} less {less}, same seeds, interval below zero)',
    )
    return _paired(claim, results, results.paired(FULL, less, drive, PAPER_NOISE, case))


def no_larger_than_pi(results: Results, drive: str) -> Claim:
    """Decide whether noise-free RMSE is no larger than that of PI with feed-forward."""
    claim = Claim(
        f'noise-free against PI, {drive}',
        'ours',
        f'RMSE no larger than that of PI with feed-forward ({drive} drive, nominal, no noise)',
    )
    full = results.row(FULL, drive, 0.0)
    pi = _best(
        [row for row in results.rows_of(drive, 0.0, baseline=True) if _is_pi(row.controller)]
    )
    if full is None or pi is None:
        return claim
    return _decide(
        claim,
        results.complete,
        full.rmse_mean <= pi.rmse_mean,
        f'{_rmse(full)} against {_rmse(pi)} of {pi.controller}',
        {'full': full.rmse_mean, 'pi': pi.rmse_mean},
        (_rmses(results, pi) - _rmses(results, full),),
    )


def smallest_growth(results: Results, drive: str) -> Claim:
    """Decide whether RMSE grows by no more rad/s with the noise than that of any baseline."""
    claim = Claim(
        f'smallest growth with noise, {drive}',
        'ours',
        f'RMSE grows by no more than that of any baseline from no noise to {LOUDEST:g} ({drive} '
        'drive, nominal, in rad/s)',
    )
    grown = _growths(results, drive)
    others = {name: last - first for name, (first, last) in grown.items() if name != FULL}
    if FULL not in grown or not others:
        return claim
    own = grown[FULL][1] - grown[FULL][0]
    least = min(others, key=lambda name: others[name])
    growth = _growth(results, drive, FULL)
    return _decide(
        claim,
        results.complete,
        math.isfinite(own) and own <= others[least],
        f'{own:+.3f} rad/s against {others[least]:+.3f} of {least}, the least of {len(others)}',
        {'full': own, 'least_rival': least, 'least': others[least]},
        [_growth(results, drive, name) - growth for name in others],
    )


def settled(results: Results, drive: str) -> Claim:
    """Decide whether the settled RMSE without noise is at most 2 % of the reference's spread."""
    limit = 0.02 * REFERENCE_SPREAD
    claim = Claim(
        f'settled, {drive}',
        'ours',
        f'Settled RMSE, without 1 s about each switch, at most 2 % of {REFERENCE_SPREAD:g} rad/s '
        f'({drive} drive, nominal, no noise)',
    )
    full = results.row(FULL, drive, 0.0)
    if full is None:
        return claim
    share = full.settled_mean / REFERENCE_SPREAD
    found = f'{format_number(full.settled_mean)} rad/s, {100.0 * share:.1f} %'
    return _decide(
        claim,
        results.complete,
        full.settled_mean <= limit,
        found,
        {'settled': full.settled_mean, 'limit': limit},
        (limit - np.array([run.settled for run in results.runs(full.experiment)]),),
    )


def grows_slightly(results: Results, drive: str) -> Claim:
    """Decide the paper's claim that RMSE grows only slightly with the noise."""
    claim = Claim(
        f'grows only slightly, {drive}',
        'paper',
        f'RMSE grows only slightly from no noise to {LOUDEST:g} (here: by at most '
        f'{100 * SLIGHTLY:.0f} %; {drive} drive, nominal)',
    )
    grown = _growths(results, drive)
    if FULL not in grown:
        return claim
    share = grown[FULL][1] / grown[FULL][0] - 1.0
    return _decide(
        claim,
        results.complete,
        share <= SLIGHTLY,
        f'{100 * share:+.0f} %',
        {'growth': share},
        (-_growth(results, drive, FULL, SLIGHTLY),),
    )


def others_grow(results: Results, drive: str) -> Claim:
    """Decide the paper's claim that the RMSE of every other method grows by more than half."""
    claim = Claim(
        f'others grow by half, {drive}',
        'paper',
        f'RMSE of every other method grows by more than 50 % from no noise to {LOUDEST:g} '
        f'({drive} drive, nominal)',
    )
    shares = {
        name: last / first - 1.0
        for name, (first, last) in _growths(results, drive).items()
        if name != FULL
    }
    if not shares:
        return claim
    low, high = (f(shares, key=lambda name: shares[name]) for f in (min, max))
    found = f'from {100 * shares[low]:+.0f} % ({low}) to {100 * shares[high]:+.0f} % ({high})'
    margins = [_growth(results, drive, name, 0.5) for name in shares]
    return _decide(claim, results.complete, min(shares.values()) > 0.5, found, shares, margins)


def calm_control(results: Results, drive: str) -> Claim:
    """Decide whether the effort varies no more than that of the median baseline."""
    claim = Claim(
        f'no chatter, {drive}',
        'paper',
        'Control signals without high-frequency fluctuation (here: total variation of what is '
        f'asked of the robot no more than the median of the baselines; {drive} drive, nominal, '
        f'noise {PAPER_NOISE:g})',
    )
    full = results.row(FULL, drive, PAPER_NOISE)
    rows = results.rows_of(drive, PAPER_NOISE, baseline=True)
    rows = [row for row in rows if math.isfinite(row.chatter_mean)]
    others = [row.chatter_mean for row in rows]
    if full is None or not others:
        return claim
    middle = median(others)
    by_seed = np.array(
        [[run.chatter for run in results.runs(row.experiment)] for row in (full, *rows)]
    )
    return _decide(
        claim,
        results.complete,
        full.chatter_mean <= middle,
        f'{full.chatter_mean:.0f} rad/s³ against a median of {middle:.0f}, from '
        f'{min(others):.0f} to {max(others):.0f}',
        {'full': full.chatter_mean, 'median': middle},
        (np.median(by_seed[1:], axis=0) - by_seed[0],),
    )


def estimation_claims(
    estimated: Sequence[EstimationResult], *, complete: bool = True
) -> list[Claim]:
    """Decide the paper's claims on the fuzzy system without a controller, (86)."""
    ours, *others = KINDS
    half = Claim(
        'estimation, half of the others',
        'paper',
        'Without a controller (86), type 3 estimates the speeds about 50 % better than type 1 '
        f'and type 2 (RMSE at most half of the best, noise {PAPER_NOISE:g})',
    )
    slight = Claim(
        'estimation, grows only slightly',
        'paper',
        'Without a controller (86), the RMSE of type 3 grows only slightly with noise up to '
        f'{LOUDEST:g} (here: by at most {100 * SLIGHTLY:.0f} %), that of the others by over 50 %',
    )
    speeds = {(each.kind, each.noise_variance): np.array(each.speed) for each in estimated}
    means = {key: mean(each.tolist()) for key, each in speeds.items()}
    if all((kind, PAPER_NOISE) in means for kind in KINDS):
        best = min(others, key=lambda kind: means[kind, PAPER_NOISE])
        own, other = means[ours, PAPER_NOISE], means[best, PAPER_NOISE]
        margin = 0.5 * speeds[best, PAPER_NOISE] - speeds[ours, PAPER_NOISE]
        half = _decide(
            half,
            complete,
            own <= 0.5 * other,
            f'{own:.4f} rad/s against {other:.4f} of {best}: {own / other:.2f} of it',
            {'type3': own, 'best': best, 'share': own / other},
            (margin,),
        )
    if all((kind, noise) in means for kind in KINDS for noise in (0.0, LOUDEST)):
        grown = {kind: means[kind, LOUDEST] / means[kind, 0.0] - 1.0 for kind in KINDS}
        margins = (
            (1.0 + SLIGHTLY) * speeds[ours, 0.0] - speeds[ours, LOUDEST],
            *(speeds[kind, LOUDEST] - 1.5 * speeds[kind, 0.0] for kind in others),
        )
        slight = _decide(
            slight,
            complete,
            grown[ours] <= SLIGHTLY and all(grown[kind] > 0.5 for kind in others),
            ', '.join(f'{kind} {100 * share:+.0f} %' for kind, share in grown.items()),
            grown,
            margins,
        )
    return [half, slight]


def claims_table(claims: Sequence[Claim], origin: str) -> Table:
    """Return the claims of one origin, ``'ours'`` or ``'paper'``, with what was found."""
    title = 'Claims of this package' if origin == 'ours' else 'Claims of the paper'
    rows = [(claim.text, claim.found, claim.verdict) for claim in claims if claim.origin == origin]
    return Table(title, ('claim', 'found', 'verdict'), tuple(rows))


def markdown(tables: dict[str, list[Table]], claims: Sequence[Claim] = ()) -> str:
    """Return all tables, and claims if there are any, as one Markdown text."""
    parts = [
        'Means over held-out seeds ± half the 95 % interval (Student\'s t). RMSE: true wheel '
        'speeds less reference, both wheels, without the first 3 s. Noise: variance of the '
        'measured wheel speeds, (rad/s)². An asterisk: the interval of a paired difference '
        'excludes zero.'
    ]  # fmt: skip
    if claims:
        judged = [claims_table(claims, origin) for origin in ('ours', 'paper')]
        parts += ['## Claims', *(table.markdown() for table in judged)]
    for heading, group in tables.items():
        if group:
            parts += [f'## {heading}', *(table.markdown() for table in group)]
    return '\n\n'.join(parts) + '\n'


def _against_preview(
    claim: Claim, results: Results, drive: str, cases: Sequence[str], *, exact: bool
) -> Claim:
    held, words, margins = True, [], []
    numbers: dict[str, object] = {}
    for case in cases:
        full = results.row(FULL, drive, PAPER_NOISE, case)
        baselines = results.rows_of(drive, PAPER_NOISE, case, baseline=True, preview=True)
        best = _best([row for row in baselines if (EXACT in row.controller) is exact])
        if full is None or best is None:
            return claim
        gap = results.paired(FULL, best.controller, drive, PAPER_NOISE, case)
        half = gap.ci95 if gap is not None and math.isfinite(gap.ci95) else 0.0
        held &= full.rmse_mean <= best.rmse_mean + half
        words.append(
            f'{case}: {_rmse(full)} against {_rmse(best)} of {best.controller} (± {half:.4f})'
        )
        numbers[f'{case}, full'] = full.rmse_mean
        numbers[f'{case}, best'] = best.rmse_mean
        margins.append(_rmses(results, best) - _rmses(results, full))
    return _decide(claim, results.complete, held, '; '.join(words), numbers, margins)


def _best(rows: Sequence[ResultRow]) -> ResultRow | None:
    finite = [row for row in rows if math.isfinite(row.rmse_mean)]
    return min(finite, key=lambda row: row.rmse_mean, default=None)


def _is_pi(name: str) -> bool:
    return re.match(r'pi\b', name, re.IGNORECASE) is not None


def _growths(results: Results, drive: str) -> dict[str, tuple[float, float]]:
    """Return RMSE without and with the most noise; endless for what diverges under it."""
    found = {}
    for name, (baseline, _) in results.kinds.items():
        first, last = (results.row(name, drive, noise) for noise in (0.0, LOUDEST))
        if not (baseline or name == FULL) or EXACT in name or first is None or last is None:
            continue
        if math.isfinite(first.rmse_mean):
            end = last.rmse_mean if math.isfinite(last.rmse_mean) else math.inf
            found[name] = (first.rmse_mean, end)
    return found


def _growth(results: Results, drive: str, name: str, share: float = 0.0) -> Array:
    """Return the growth of RMSE with the most noise beyond a share of its start, by seed."""
    first, last = (
        np.array([run.rmse for run in results.runs(Experiment(name, drive, noise, NOMINAL))])
        for noise in (0.0, LOUDEST)
    )
    growth: Array = last - (1.0 + share) * first
    return growth


def _paired(claim: Claim, results: Results, pair: PairedDifference | None) -> Claim:
    if pair is None or (pair.seeds < 2 and results.complete):
        return claim
    if not math.isfinite(pair.difference):
        found = 'a run left the finite numbers'
        return replace(claim, found=found, held=False, numbers={'seeds': pair.seeds})
    known = math.isfinite(pair.ci95)
    found = f'{pair.difference:+.4f}' + (f' ± {pair.ci95:.4f}' if known else '')
    return _decide(
        claim,
        results.complete,
        pair.below,
        f'{found} rad/s over {pair.seeds} seed' + ('s' if pair.seeds > 1 else ''),
        {'difference': pair.difference, 'ci95': pair.ci95, 'seeds': pair.seeds},
        intervals=[(-pair.difference, pair.ci95)],
    )


def _rmse(row: ResultRow) -> str:
    return f'{format_number(row.rmse_mean)} rad/s'


def _rmses(results: Results, row: ResultRow) -> Array:
    """Return the RMSE of each seed, rad/s."""
    return np.array([run.rmse for run in results.runs(row.experiment)])


def _decide(
    claim: Claim,
    complete: bool,
    held: bool,
    found: str,
    numbers: Mapping[str, object],
    margins: Sequence[Array] = (),
    intervals: Sequence[tuple[float, float]] = (),
) -> Claim:
    """Return the claim as decided, or as inconclusive.

    Parameters
    ----------
    complete
        Whether as much was measured as the claim is about; its criterion then decides. Otherwise
        all parts must be satisfied beyond doubt, or one must not be.
    margins, intervals
        For each part of the claim, by how much each seed satisfies it, or mean and half the
        interval of that.
    """
    parts = [(mean(each.tolist()), interval(each.tolist())) for each in margins]
    parts += intervals
    sure = (
        complete
        or not all(math.isfinite(middle) for middle, _ in parts)
        or all(middle > half for middle, half in parts)
        or any(middle < -half for middle, half in parts)
    )
    return replace(
        claim,
        found=found,
        held=bool(held) if sure else None,
        numbers=dict(numbers),
        inconclusive=not sure,
    )
