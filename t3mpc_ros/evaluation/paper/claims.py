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
"""Claims of the paper and of this package: each a sentence, and a query on the study's runs.

A method that diverged satisfies no claim. Results of fewer seeds or shorter runs than those of the
claims decide only what their interval over the seeds leaves no doubt about; other claims are
inconclusive.
"""

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
import math
import re
from statistics import median
from typing import NamedTuple

import numpy as np

from t3mpc_ros.evaluation.cases import NOMINAL
from t3mpc_ros.evaluation.confidence_intervals import Difference, mean, paired
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.fuzzy_estimation_error import KINDS
from t3mpc_ros.evaluation.method_table import EXACT_MODEL, FULL
from t3mpc_ros.evaluation.paper import paper_study
from t3mpc_ros.evaluation.result_output import Table, format_number
from t3mpc_ros.evaluation.scenario import HELD_OUT_SEEDS
from t3mpc_ros.geometry.types import Array

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
    ('NT3FS', 'mass +30 %', paper_study.DRIVES),
    ('NT3FS', 'friction x3', paper_study.DRIVES),
    ('compensator', 'disturbance', paper_study.DRIVES),
    ('MPC', 'dead time', ('velocity',)),
    ('preview', NOMINAL, ('velocity',)),
)
"""Each part with the case and the drives it is meant for."""
ALONE = (
    ('MPC, equal bound', 'dead time', ('velocity',)),
    ('MPC, equal bound', 'friction x3', ('velocity',)),
    ('trained predictor', 'dead time', ('velocity',)),
)
"""The same of what is left out, and never added."""


class NotMeasuredError(LookupError):
    """A claim asks for runs that were not made."""


class Finding(NamedTuple):
    """What the runs say about a claim."""

    held: bool
    """Whether they satisfy its criterion."""
    text: str
    numbers: Mapping[str, object]
    margins: Sequence[Difference]
    """By how much each part of the claim is satisfied, with its interval over the seeds."""


VERDICTS = 'held', 'not held', 'inconclusive', 'not measured'


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim with its verdict."""

    name: str
    origin: str
    """``'ours'`` or ``'paper'``."""
    text: str
    """The claim and its criterion."""
    found: str = 'not measured'
    verdict: str = 'not measured'
    """One of :data:`VERDICTS`; inconclusive: too little was measured to decide."""
    numbers: Mapping[str, object] = field(default_factory=dict)

    @property
    def held(self) -> bool | None:
        """None: not measured, or inconclusive."""
        return {'held': True, 'not held': False}.get(self.verdict)

    def record(self) -> dict[str, object]:
        """Return the claim as plain data."""
        names = ('name', 'origin', 'text', 'found', 'held', 'numbers', 'verdict')
        return {name: getattr(self, name) for name in names}


Query = Callable[..., Finding]
"""Asks the runs about a claim."""


def all_claims(runs: ResultTable, estimated: ResultTable) -> list[Claim]:
    """Return all claims with their verdicts: of this package, then of the paper."""
    complete = {*runs.unique('seed')} >= {*HELD_OUT_SEEDS}
    complete &= all(duration >= paper_study.DURATION for duration in runs.unique('duration'))
    found = [_decided(*each, runs, complete=complete) for each in definitions()]
    complete &= len(estimated.unique('seed')) >= ESTIMATION_SEEDS
    return found + [_decided(*each, estimated, complete=complete) for each in OF_ESTIMATION]


def _decided(claim: Claim, query: Query, runs: ResultTable, *, complete: bool) -> Claim:
    """Return the claim with its verdict.

    With ``complete``, where as much was measured as the claim is about, its criterion decides.
    Otherwise the claim is inconclusive, unless all its parts are satisfied beyond doubt, one
    of them is not, or a run diverged.
    """
    try:
        held, text, numbers, margins = query(runs)
    except NotMeasuredError:
        return claim
    signs = {margin.sign for margin in margins}
    diverged = not all(math.isfinite(margin.mean) for margin in margins)
    sure = complete or diverged or signs == {1} or -1 in signs
    verdict = ('held' if held else 'not held') if sure else 'inconclusive'
    return replace(claim, found=text, verdict=verdict, numbers=numbers)


def definitions() -> Iterator[tuple[Claim, Query]]:
    """Yield the claims about the runs of the study, each with what decides it."""
    ours, paper = partial(_of_drives, 'ours'), partial(_of_drives, 'paper')
    for noise, limit in ((paper_study.PAPER_NOISE, 0.60), (0.0, 0.50)):
        yield from ours(
            f'share of the best baseline without preview, {{drive}}, noise {noise:g}',
            f'RMSE at most {limit:.2f} of that of the best baseline without preview ({{drive}} '
            f'drive, nominal, noise {noise:g})',
            partial(share_of_best, noise=noise, limit=limit, preview=False),
            ('velocity',),
        )
    yield from ours(
        'baselines with preview, wrong inertia in their models, {drive}',
        'RMSE no larger than that of any predictive baseline with preview whose model is 30 % off '
        'in its inertia, or within the paired interval ({drive} drive, noise '
        f'{paper_study.PAPER_NOISE:g})',
        partial(against_preview, cases=(NOMINAL,), exact=False),
    )
    yield from ours(
        'baselines with preview, wrong inertia of the robot, {drive}',
        'RMSE no larger than that of any predictive baseline with preview and the nominal model '
        'when mass and inertia of the robot are 30 % more or less ({drive} drive, noise '
        f'{paper_study.PAPER_NOISE:g})',
        partial(against_preview, cases=WRONG_INERTIA, exact=True),
    )
    for part, case, drives in INTENDED:
        less, more = paper_study.STAGES[paper_study.PARTS.index(part) :][:2]
        yield from ours(
            f'{part} lowers RMSE, {case}, {{drive}}',
            f'Adding {part} lowers RMSE in the case {case} ({{drive}} drive, noise '
            f'{paper_study.PAPER_NOISE:g}; {more} less {less}, same seeds, 95 % interval below '
            'zero)',
            partial(lowers_rmse, first=more, second=less, case=case),
            drives,
        )
    for part, case, drives in INTENDED + ALONE:
        less = paper_study.WITHOUT[part]
        yield from ours(
            f'{part} is missed, {case}, {{drive}}',
            f'Leaving {part} out of the full controller costs RMSE in the case {case} ({{drive}} '
            f'drive, noise {paper_study.PAPER_NOISE:g}; {FULL} less {less}, same seeds, interval '
            'below zero)',
            partial(lowers_rmse, first=FULL, second=less, case=case),
            drives,
        )
    yield from ours(
        'noise-free against PI, {drive}',
        'RMSE no larger than that of PI with feed-forward ({drive} drive, nominal, no noise)',
        no_larger_than_pi,
    )
    yield from ours(
        'smallest growth with noise, {drive}',
        f'RMSE grows by no more than that of any baseline from no noise to {LOUDEST:g} ({{drive}} '
        'drive, nominal, in rad/s)',
        smallest_growth,
    )
    yield from ours(
        'settled, {drive}',
        f'Settled RMSE, without 1 s about each switch, at most 2 % of {REFERENCE_SPREAD:g} rad/s '
        '({drive} drive, nominal, no noise)',
        partial(settled_share, limit=0.02 * REFERENCE_SPREAD),
    )
    yield from paper(
        f'half of the best baseline, {{drive}}, noise {paper_study.PAPER_NOISE:g}',
        'About 50 % more accurate than other methods: RMSE at most 0.50 of that of the best '
        f'baseline ({{drive}} drive, nominal, noise {paper_study.PAPER_NOISE:g})',
        partial(share_of_best, noise=paper_study.PAPER_NOISE, limit=0.50),
    )
    yield from paper(
        'grows only slightly, {drive}',
        f'RMSE grows only slightly from no noise to {LOUDEST:g} (here: by at most '
        f'{100 * SLIGHTLY:.0f} %; {{drive}} drive, nominal)',
        grows_slightly,
    )
    yield from paper(
        'others grow by half, {drive}',
        f'RMSE of every other method grows by more than 50 % from no noise to {LOUDEST:g} '
        '({drive} drive, nominal)',
        others_grow,
    )
    yield from paper(
        'no chatter, {drive}',
        'Control signals without high-frequency fluctuation (here: total variation of what is '
        'asked of the robot no more than the median of the baselines; {drive} drive, nominal, '
        f'noise {paper_study.PAPER_NOISE:g})',
        calm_control,
    )


def _of_drives(
    origin: str, name: str, text: str, query: Query, drives: Sequence[str] = paper_study.DRIVES
) -> Iterator[tuple[Claim, Query]]:
    """Yield a claim for each drive; name and text have its name in place of ``{drive}``."""
    for drive in drives:
        claim = Claim(name.format(drive=drive), origin, text.format(drive=drive))
        yield claim, partial(query, drive=drive)


def share_of_best(
    runs: ResultTable, drive: str, noise: float, limit: float, preview: bool | None = None
) -> Finding:
    """Compare RMSE with a share of the best baseline's."""
    full = by_seed(runs, FULL, drive, noise)
    others = baselines(runs, drive, noise, exact=False, preview=preview)
    best = best_of(others)
    own, least = mean(full), mean(others[best])
    share = own / least
    text = f'{_rmse(own)} against {_rmse(least)} of {best}, the best of {len(others)}'
    numbers = {'full': own, 'best_rival': best, 'best': least, 'share': share, 'limit': limit}
    margins = (paired(limit * others[best], full),)
    return Finding(share <= limit, f'{text}: {share:.2f} of it', numbers, margins)


def against_preview(
    runs: ResultTable, drive: str, cases: Sequence[str], *, exact: bool
) -> Finding:
    """Compare RMSE with that of the best baseline with preview, within the paired interval."""
    held, words, margins = True, [], []
    numbers: dict[str, object] = {}
    for case in cases:
        full = by_seed(runs, FULL, drive, paper_study.PAPER_NOISE, case)
        others = baselines(runs, drive, paper_study.PAPER_NOISE, case, exact=exact, preview=True)
        best = best_of(others)
        own, least = mean(full), mean(others[best])
        margins.append(margin := paired(others[best], full))
        half = margin.half if math.isfinite(margin.half) else 0.0
        held &= own <= least + half
        words.append(f'{case}: {_rmse(own)} against {_rmse(least)} of {best} (± {half:.4f})')
        numbers |= {f'{case}, full': own, f'{case}, best': least}
    return Finding(held, '; '.join(words), numbers, margins)


def lowers_rmse(runs: ResultTable, first: str, second: str, drive: str, case: str) -> Finding:
    """Compare two methods on the same seeds: the whole interval is below zero."""
    lower = by_seed(runs, first, drive, paper_study.PAPER_NOISE, case)
    higher = by_seed(runs, second, drive, paper_study.PAPER_NOISE, case)
    margin = paired(higher, lower)
    difference, ci95 = paired(lower, higher)
    seeds = len(lower)
    if not math.isfinite(difference):
        return Finding(False, 'a run left the finite numbers', {'seeds': seeds}, [margin])
    text = f'{difference:+.4f}' + (f' ± {ci95:.4f}' if math.isfinite(ci95) else '')
    return Finding(
        difference + ci95 < 0.0,
        f'{text} rad/s over {seeds} seed' + ('s' if seeds > 1 else ''),
        {'difference': difference, 'ci95': ci95, 'seeds': seeds},
        [margin],
    )


def no_larger_than_pi(runs: ResultTable, drive: str) -> Finding:
    """Compare RMSE without noise with that of PI with feed-forward."""
    full = by_seed(runs, FULL, drive, 0.0)
    others = baselines(runs, drive, 0.0)
    pi = best_of({name: each for name, each in others.items() if re.match(r'(?i)pi\b', name)})
    own, other = mean(full), mean(others[pi])
    text = f'{_rmse(own)} against {_rmse(other)} of {pi}'
    return Finding(own <= other, text, {'full': own, 'pi': other}, [paired(others[pi], full)])


def smallest_growth(runs: ResultTable, drive: str) -> Finding:
    """Compare what the noise adds to RMSE with what it adds to that of any baseline, in rad/s."""
    full, others = growths(runs, drive)
    added = {name: each.ends[1] - each.ends[0] for name, each in others.items()}
    least = min(added, key=lambda name: added[name])
    own = full.ends[1] - full.ends[0]
    return Finding(
        math.isfinite(own) and own <= added[least],
        f'{own:+.3f} rad/s against {added[least]:+.3f} of {least}, the least of {len(added)}',
        {'full': own, 'least_rival': least, 'least': added[least]},
        [paired(each.last - each.first, full.last - full.first) for each in others.values()],
    )


def settled_share(runs: ResultTable, drive: str, limit: float) -> Finding:
    """Compare the settled RMSE without noise with a limit."""
    settled = by_seed(runs, FULL, drive, 0.0, column='settled')
    own = mean(settled)
    text = f'{_rmse(own)}, {100.0 * (own / REFERENCE_SPREAD):.1f} %'
    margins = [paired(np.full(settled.shape, limit), settled)]
    return Finding(own <= limit, text, {'settled': own, 'limit': limit}, margins)


def grows_slightly(runs: ResultTable, drive: str) -> Finding:
    """Compare the growth of RMSE with noise with :data:`SLIGHTLY`."""
    full, _ = growths(runs, drive)
    growth, margin = full.share, full.below(SLIGHTLY)
    return Finding(growth <= SLIGHTLY, f'{100 * growth:+.0f} %', {'growth': growth}, [margin])


def others_grow(runs: ResultTable, drive: str) -> Finding:
    """Compare the growth of every baseline's RMSE with noise with half of it."""
    _, others = growths(runs, drive)
    shares = {name: each.share for name, each in others.items()}
    low, high = (pick(shares, key=lambda name: shares[name]) for pick in (min, max))
    return Finding(
        shares[low] > 0.5,
        f'from {100 * shares[low]:+.0f} % ({low}) to {100 * shares[high]:+.0f} % ({high})',
        shares,
        [each.above(0.5) for each in others.values()],
    )


def calm_control(runs: ResultTable, drive: str) -> Finding:
    """Compare the total variation of the effort with that of the median baseline."""
    full = by_seed(runs, FULL, drive, paper_study.PAPER_NOISE, column='chatter')
    found = baselines(runs, drive, paper_study.PAPER_NOISE, column='chatter')
    others = {name: each for name, each in found.items() if math.isfinite(mean(each))}
    if not others:
        raise NotMeasuredError
    own, means = mean(full), [mean(each) for each in others.values()]
    middle = median(means)
    return Finding(
        own <= middle,
        f'{own:.0f} rad/s³ against a median of {middle:.0f}, from {min(means):.0f} to '
        f'{max(means):.0f}',
        {'full': own, 'median': middle},
        [paired(np.median(list(others.values()), axis=0), full)],
    )


def by_seed(
    runs: ResultTable,
    controller: str,
    drive: str,
    noise: float,
    case: str = NOMINAL,
    column: str = 'rmse',
) -> Array:
    """Return a number of each seed."""
    return measured(runs, column, controller=controller, drive=drive, noise=noise, case=case)


def measured(runs: ResultTable, column: str, **wanted: Hashable) -> Array:
    """Return a column of the rows with some values."""
    found = runs.values(column, **wanted)
    if not found:
        raise NotMeasuredError
    return np.array(found)


def baselines(
    runs: ResultTable,
    drive: str,
    noise: float,
    case: str = NOMINAL,
    *,
    exact: bool | None = None,
    preview: bool | None = None,
    column: str = 'rmse',
) -> dict[str, Array]:
    """Return a number of each seed of every baseline, or of those of a kind."""
    found: dict[str, list[float]] = {}
    for row in runs.where(drive=drive, noise=noise, case=case, baseline=True):
        if exact in (None, EXACT_MODEL in row['controller']) and preview in (None, row['preview']):
            found.setdefault(row['controller'], []).append(row[column])
    return {name: np.array(values) for name, values in found.items()}


def best_of(candidates: Mapping[str, Array]) -> str:
    """Return the name with the smallest finite mean."""
    means = {name: mean(values) for name, values in candidates.items()}
    known = [name for name in means if math.isfinite(means[name])]
    if not known:
        raise NotMeasuredError
    return min(known, key=lambda name: means[name])


class Growth(NamedTuple):
    """RMSE of each seed in the nominal case without noise and with the most, rad/s."""

    first: Array
    last: Array

    @property
    def ends(self) -> tuple[float, float]:
        """Both means; the second one is infinite for what diverges under noise."""
        last = mean(self.last)
        return mean(self.first), last if math.isfinite(last) else math.inf

    @property
    def share(self) -> float:
        """What the noise adds, relative to the RMSE without it."""
        first, last = self.ends
        return last / first - 1.0

    def above(self, share: float) -> Difference:
        """Return by how much RMSE grows beyond a share of its start, rad/s."""
        return paired(self.last, (1.0 + share) * self.first)

    def below(self, share: float) -> Difference:
        """Return by how much it stays below this."""
        return paired((1.0 + share) * self.first, self.last)


def growths(runs: ResultTable, drive: str) -> tuple[Growth, dict[str, Growth]]:
    """Return the growth of the full controller, and of the baselines."""
    starts = baselines(runs, drive, 0.0, exact=False)
    found = {}
    for name, first in {**starts, FULL: by_seed(runs, FULL, drive, 0.0)}.items():
        last = by_seed(runs, name, drive, LOUDEST)
        if math.isfinite(mean(first)):
            found[name] = Growth(first, last)
    full = found.pop(FULL, None)
    if full is None or not found:
        raise NotMeasuredError
    return full, found


def _rmse(value: float) -> str:
    return f'{format_number(value)} rad/s'


# -- the fuzzy system without a controller, (86) --------------------------------------------------


def half_of_others(estimated: ResultTable) -> Finding:
    """Compare type 3 at the paper's noise with half of the best of the others."""
    speeds = _speeds(estimated, paper_study.PAPER_NOISE)
    ours, *others = KINDS
    best = best_of({kind: speeds[kind] for kind in others})
    own, other = mean(speeds[ours]), mean(speeds[best])
    return Finding(
        own <= 0.5 * other,
        f'{own:.4f} rad/s against {other:.4f} of {best}: {own / other:.2f} of it',
        {'type3': own, 'best': best, 'share': own / other},
        [paired(0.5 * speeds[best], speeds[ours])],
    )


def slight_growth(estimated: ResultTable) -> Finding:
    """Compare the growth with noise of each kind."""
    quiet, loud = (_speeds(estimated, noise) for noise in (0.0, LOUDEST))
    ours, *others = KINDS
    grown = {kind: Growth(quiet[kind], loud[kind]) for kind in KINDS}
    shares = {kind: each.share for kind, each in grown.items()}
    return Finding(
        shares[ours] <= SLIGHTLY and all(shares[kind] > 0.5 for kind in others),
        ', '.join(f'{kind} {100 * share:+.0f} %' for kind, share in shares.items()),
        shares,
        [grown[ours].below(SLIGHTLY), *(grown[kind].above(0.5) for kind in others)],
    )


def _speeds(estimated: ResultTable, noise: float) -> dict[str, Array]:
    """Return the RMSE of each seed by kind."""
    return {kind: measured(estimated, 'speed', kind=kind, noise_variance=noise) for kind in KINDS}


OF_ESTIMATION: Sequence[tuple[Claim, Query]] = (
    (
        Claim(
            'estimation, half of the others',
            'paper',
            'Without a controller (86), type 3 estimates the speeds about 50 % better than type 1 '
            f'and type 2 (RMSE at most half of the best, noise {paper_study.PAPER_NOISE:g})',
        ),
        half_of_others,
    ),
    (
        Claim(
            'estimation, grows only slightly',
            'paper',
            'Without a controller (86), the RMSE of type 3 grows only slightly with noise up to '
            f'{LOUDEST:g} (here: by at most {100 * SLIGHTLY:.0f} %), that of the others by over '
            '50 %',
        ),
        slight_growth,
    ),
)


# -- tables ---------------------------------------------------------------------------------------


def markdown(tables: Mapping[str, Sequence[Table]], claims: Sequence[Claim]) -> str:
    """Return claims and tables as one Markdown text."""
    rows: dict[str, list[tuple[str, str, str]]] = {'ours': [], 'paper': []}
    for claim in claims:
        rows[claim.origin].append((claim.text, claim.found, claim.verdict))
    titles = {'ours': 'Claims of this package', 'paper': 'Claims of the paper'}
    head = ('claim', 'found', 'verdict')
    parts = [
        'Means over held-out seeds ± half the 95 % interval (Student\'s t). RMSE: true wheel '
        'speeds less reference, both wheels, without the first 3 s. Noise: variance of the '
        'measured wheel speeds, (rad/s)². An asterisk: the interval of a paired difference '
        'excludes zero.',
        '## Claims',
        *(Table(title, head, rows[origin]).markdown() for origin, title in titles.items()),
    ]  # fmt: skip
    for heading, group in tables.items():
        if group:
            parts += [f'## {heading}', *(table.markdown() for table in group)]
    return '\n\n'.join(parts) + '\n'
