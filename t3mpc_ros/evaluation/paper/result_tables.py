# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The paper's Table 3 and further tables, for Markdown and HTML."""

from collections.abc import Callable, Sequence
import math

from t3mpc_ros.evaluation.confidence_intervals import interval, mean
from t3mpc_ros.evaluation.open_loop_estimation import EstimationResult, difference
from t3mpc_ros.evaluation.paper.claims import Claim
from t3mpc_ros.evaluation.paper.experiment_grid import FULL, NOMINAL, PAPER_NOISE, STAGES, WITHOUT
from t3mpc_ros.evaluation.paper.results import PairedDifference, ResultRow, Results
from t3mpc_ros.evaluation.reporting import EMPTY_CELL, Table, format_interval


def comparison(results: Results, drive: str, *, settled: bool = False) -> Table:
    """Return every method's RMSE against noise, the paper's Table 3: best at its noise on top.

    ``settled`` leaves out the second about each switch.
    """
    noises = results.noises
    known = [n for n in results.kinds if any(results.row(n, drive, v) for v in noises)]
    what = 'RMSE settled, without 1 s about each switch' if settled else 'RMSE'
    head = ['method', *(f'noise {noise:g}' for noise in noises)]
    head.append(f'growth from {noises[0]:g} to {noises[-1]:g}')

    def value(row: ResultRow) -> tuple[float, float]:
        return (row.settled_mean, row.settled_ci95) if settled else (row.rmse_mean, row.rmse_ci95)

    def rank(name: str) -> float:
        row = results.row(name, drive, PAPER_NOISE)
        found = math.inf if row is None else value(row)[0]
        return math.inf if math.isnan(found) else found

    lines = []
    for name in sorted(known, key=rank):
        rows = [results.row(name, drive, noise) for noise in noises]
        cells = [EMPTY_CELL if row is None else format_interval(*value(row)) for row in rows]
        first, last = rows[0], rows[-1]
        growth = EMPTY_CELL
        if first is not None and last is not None:
            growth = _growth(value(first)[0], value(last)[0])
        labelled = all(results.kinds[name]) and 'preview' not in name
        mark = ' (preview)' if labelled else ''
        lines.append((name + mark, *cells, growth))
    title = f'{what} (rad/s), {drive} drive, nominal robot'
    return Table(title, tuple(head), tuple(lines), (FULL,))


def chatter(results: Results, drive: str) -> Table:
    """Return every method's total variation of the effort against noise."""
    rows = []
    for name in results.kinds:
        found = [results.row(name, drive, noise) for noise in results.noises]
        if any(found):
            rows.append((name, *(_number(row, lambda r: r.chatter_mean, 0) for row in found)))
    head = ('method', *(f'noise {noise:g}' for noise in results.noises))
    title = f'Total variation of what is asked per second (rad/s³), {drive} drive, nominal robot'
    return Table(title, head, tuple(rows), (FULL,))


def cases(results: Results, drive: str, noise: float, *, baselines: bool) -> Table | None:
    """Return RMSE by case: of the baselines and the full controller, or of its stages.

    None when nothing beside the nominal case was measured at this noise.
    """
    if baselines:
        names = [n for n, (baseline, _) in results.kinds.items() if baseline or n == FULL]
    else:
        names = [*STAGES, *WITHOUT.values()]
    shown = [
        case
        for case in results.cases(drive)
        if any(results.row(name, drive, noise, case) for name in names)
    ]
    if set(shown) <= {NOMINAL}:
        return None
    rows = []
    for name in names:
        found = [results.row(name, drive, noise, case) for case in shown]
        if any(found):
            rows.append((name, *(_rmse(row) for row in found)))
    what = (
        'Methods in every case' if baselines else 'The controller as it grows, and less one part'
    )
    title = f'{what}: RMSE (rad/s), {drive} drive, noise {noise:g}'
    return Table(title, (('method' if baselines else 'stage'), *shown), tuple(rows), (FULL,))


def differences(
    results: Results, pairs: Sequence[PairedDifference], drive: str, noise: float, title: str
) -> Table | None:
    """Return paired differences by case; with an asterisk where the interval excludes zero."""
    here = [pair for pair in pairs if (pair.drive, pair.noise) == (drive, noise)]
    by = {(pair.first, pair.second, pair.case): pair for pair in here}
    shown = [case for case in results.cases(drive) if any(key[2] == case for key in by)]
    rows = [
        (f'{first} less {second}', *(_paired(by.get((first, second, case))) for case in shown))
        for first, second in dict.fromkeys((pair.first, pair.second) for pair in here)
    ]
    if not rows:
        return None
    text = f'{title}: paired difference of RMSE (rad/s), {drive} drive, noise {noise:g}'
    return Table(text, ('', *shown), tuple(rows))


def estimation(results: Sequence[EstimationResult]) -> list[Table]:
    """Return the comparison of (86): RMSE of chi_hat, its excess over type 3, RMSE of g."""
    by = {(result.kind, result.noise_variance): result for result in results}
    kinds = list(dict.fromkeys(result.kind for result in results))
    noises = list(dict.fromkeys(result.noise_variance for result in results))
    if not kinds:
        return []
    head = tuple(f'noise {noise:g}' for noise in noises)

    def by_noise(title: str, key: str) -> Table:
        rows = []
        for kind in kinds:
            records = [by[kind, noise].record() for noise in noises]
            means = [float(str(record[f'{key}_mean'])) for record in records]
            cis = [float(str(record[f'{key}_ci95'])) for record in records]
            cells = [format_interval(m, c, digits=4) for m, c in zip(means, cis, strict=True)]
            rows.append((kind, *cells, _growth(means[0], means[-1])))
        return Table(title, ('kind', *head, 'growth'), tuple(rows), ('type3',))

    more = []
    for kind in kinds:
        if kind != 'type3':
            pairs = [(by[kind, noise], by['type3', noise]) for noise in noises]
            found = [_of_sample(difference(*pair)) for pair in pairs]
            more.append((kind, *(_starred(*item) for item in found)))
    return [
        by_noise('Estimation without a controller (86): RMSE of the speed (rad/s)', 'speed'),
        Table('The same, more than type3 with the same seeds (rad/s)', ('kind', *head), (*more,)),
        by_noise('RMSE of g against what it should be (rad/s²)', 'unknown'),
    ]


def all_tables(results: Results, estimated: Sequence[EstimationResult]) -> dict[str, list[Table]]:
    """Return all tables by their heading."""
    stages, losses = results.stage_differences(), results.losses()
    found: dict[str, list[Table | None]] = {
        'Methods against noise (Table 3)': [],
        'Methods in every case': [],
        'What each part is worth': [],
        'Total variation of the control': [],
        'Estimation without a controller': [*estimation(estimated)],
    }
    methods, perturbed, parts, varied, _ = found.values()
    for drive in results.drives:
        methods += [comparison(results, drive), comparison(results, drive, settled=True)]
        varied.append(chatter(results, drive))
        perturbed += [cases(results, drive, noise, baselines=True) for noise in (PAPER_NOISE,)]
        for noise in results.noises:
            parts += [
                cases(results, drive, noise, baselines=False),
                differences(results, stages, drive, noise, 'Adding a part'),
                differences(results, losses, drive, noise, 'Leaving a part out'),
            ]
    return {heading: [t for t in tables if t is not None] for heading, tables in found.items()}


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


def _number(row: ResultRow | None, value: Callable[[ResultRow], float], digits: int) -> str:
    if row is None:
        return EMPTY_CELL
    number = value(row)
    return f'{number:.{digits}f}' if math.isfinite(number) else 'diverged'


def _rmse(row: ResultRow | None) -> str:
    return EMPTY_CELL if row is None else format_interval(row.rmse_mean, row.rmse_ci95)


def _paired(pair: PairedDifference | None) -> str:
    return EMPTY_CELL if pair is None else _starred(pair.difference, pair.ci95)


def _starred(mean: float, ci95: float) -> str:
    return format_interval(mean, ci95, '+', 4) + (' *' if abs(mean) > ci95 else '')


def _of_sample(values: Sequence[float]) -> tuple[float, float]:
    return mean(values), interval(values)


def _growth(first: float, last: float) -> str:
    if not (math.isfinite(first) and math.isfinite(last)) or first <= 0.0:
        return EMPTY_CELL
    return f'{last - first:+.3f} ({100.0 * (last / first - 1.0):+.0f} %)'
