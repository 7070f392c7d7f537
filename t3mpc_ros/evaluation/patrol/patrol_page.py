# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Tables, page and JSON of a comparison of patrols."""

from collections.abc import Mapping, Sequence
import math
from typing import Any, NamedTuple

import numpy as np

from t3mpc_ros.evaluation.confidence_intervals import interval, mean, paired
from t3mpc_ros.evaluation.patrol.patrol_comparison import (
    BOXES,
    CLEARANCE,
    OURS,
    PatrolPlan,
    PatrolResult,
    Results,
)
from t3mpc_ros.evaluation.patrol.patrol_figures import PICTURES
from t3mpc_ros.evaluation.patrol.patrol_metrics import SHARES
from t3mpc_ros.evaluation.patrol.predictability import HORIZONS
from t3mpc_ros.evaluation.reporting import (
    EMPTY_CELL,
    Block,
    Contents,
    Heading,
    Mark,
    Paragraph,
    Picture,
    Table,
    format_interval,
    html_page,
)
from t3mpc_ros.version import VERSION

COVERED, TIMES_SLOWER = 0.9, 3.0
"""Share of the cells, and how many times longer than the boustrophedon a path may take for it."""
JUDGED_HORIZON, MARGIN = 5.0, 0.05
"""Horizon (s), and by which share of a random walk's skill that of a path may exceed it."""
HOLDS, FAILS, INCONCLUSIVE = 'holds', 'does not hold', 'inconclusive'
_KINDS = {HOLDS: 'yes', FAILS: 'no', INCONCLUSIVE: 'open'}


class Claim(NamedTuple):
    """A claim about our path, and what the seeds say of it."""

    text: str
    verdict: str
    numbers: str


def claims(plan: PatrolPlan, results: Results) -> list[Claim]:
    """Return the claims that the compared paths permit to be judged."""
    found = []
    if {OURS, 'boustrophedon'} <= set(results):
        found.append(_coverage_claim(plan, results))
    if {OURS, 'random walk'} <= set(results) and results[OURS][0].metrics.skills:
        found += [_error_claim(results), _skill_claim(results)]
    if OURS in results and plan.robot == 'twin':
        touched = sum(result.contacts > 0 for result in results[OURS])
        found.append(
            Claim(
                'the robot touches nothing',
                FAILS if touched else HOLDS,
                f'contacts in {touched} of {len(results[OURS])} patrols',
            )
        )
    return found


def _coverage_claim(plan: PatrolPlan, results: Results) -> Claim:
    text = (
        f'{100.0 * COVERED:g} % of the cells within {TIMES_SLOWER:g} times what the '
        'boustrophedon needs'
    )
    own = [result.metrics.times[COVERED] for result in results[OURS]]
    other = [result.metrics.times[COVERED] for result in results['boustrophedon']]
    if not all(map(math.isfinite, other)):
        return Claim(text, INCONCLUSIVE, 'the boustrophedon does not reach it in this time')
    bound = TIMES_SLOWER * mean(other)
    # A patrol that never gets there took longer than it lasted, and nothing more is known of it.
    censored = [min(time, plan.duration) for time in own]
    difference = paired(censored, [TIMES_SLOWER * time for time in other])
    reached = [time for time in own if math.isfinite(time)]
    verdict = INCONCLUSIVE
    if difference.certain and difference.mean > 0.0:
        verdict = FAILS
    elif difference.certain and len(reached) == len(own):
        verdict = HOLDS
    within = sum(time <= bound for time in own)
    numbers = (
        f'in seconds: {_time(own)} against {TIMES_SLOWER:g} × {_time(other)} = {bound:.0f}; '
        f'{within} of {len(own)} seeds within it'
    )
    return Claim(text, verdict, numbers)


def _error_claim(results: Results) -> Claim:
    own, walk = (
        [result.metrics.prediction_error(JUDGED_HORIZON) for result in results[name]]
        for name in (OURS, 'random walk')
    )
    least = (1.0 - MARGIN) * mean(walk)
    found = paired(own, [(1.0 - MARGIN) * error for error in walk])
    verdict = INCONCLUSIVE
    if found.certain:
        verdict = HOLDS if found.mean > 0.0 else FAILS
    return Claim(
        f'error of the observer at {JUDGED_HORIZON:g} s at least {100.0 * (1.0 - MARGIN):g} % of '
        'that on a random walk',
        verdict,
        f'in metres: {format_interval(mean(own), interval(own))} against '
        f'{format_interval(mean(walk), interval(walk))}, of which {least:.3f}; difference '
        f'{format_interval(found.mean, found.half, "+")}',
    )


def _skill_claim(results: Results) -> Claim:
    own, walk = (
        [result.metrics.skill(JUDGED_HORIZON) for result in results[name]]
        for name in (OURS, 'random walk')
    )
    allowed = MARGIN * mean(walk)
    found = paired(own, walk)
    verdict = INCONCLUSIVE
    if found.mean + found.half <= allowed:
        verdict = HOLDS
    elif found.mean - found.half > allowed:
        verdict = FAILS
    return Claim(
        f'skill of the observer at {JUDGED_HORIZON:g} s within {100.0 * MARGIN:g} % of a random '
        "walk's",
        verdict,
        f'{format_interval(mean(own), interval(own))} against '
        f'{format_interval(mean(walk), interval(walk))}; difference '
        f'{format_interval(found.mean, found.half, "+")}, allowed {allowed:.3f}',
    )


def _time(times: Sequence[float]) -> str:
    """Return a time (s) with its interval, or in how many seeds it was reached."""
    if all(map(math.isfinite, times)):
        return format_interval(mean(times), interval(times), digits=0)
    reached = [time for time in times if math.isfinite(time)]
    return f'reached in {len(reached)} of {len(times)}' if reached else 'not reached'


def claims_table(plan: PatrolPlan, results: Results) -> Table:
    """Return the claims with their verdicts."""
    rows = [
        (claim.text, Mark(claim.verdict, _KINDS[claim.verdict]), claim.numbers)
        for claim in claims(plan, results)
    ]
    return Table('', ('claim', 'verdict', 'measured'), rows, text=3, wrap=True)


def coverage_table(plan: PatrolPlan, results: Results) -> Table:
    """Return coverage, times, evenness and, on the twin, errors and contacts of each path."""
    head = ['path', 'coverage, %', *(f'{100.0 * share:g} %, s' for share in SHARES), 'evenness']
    twin = plan.robot == 'twin'
    if twin:
        head += ['path error, mm', 'avoiding, %', 'patrols with contacts']
    rows = []
    for name, each in results.items():
        row = [name, _cell(each, lambda one: 100.0 * one.metrics.coverage, 1)]
        row += [_time([one.metrics.times[share] for one in each]) for share in SHARES]
        row.append(_cell(each, lambda one: one.metrics.evenness))
        if twin:
            row.append(_cell(each, lambda one: 1e3 * one.metrics.path_error, 1))
            row.append(_cell(each, lambda one: 100.0 * one.avoiding, 1))
            row.append(str(sum(one.contacts > 0 for one in each)))
        rows.append(tuple(row))
    return Table('Coverage of a 20 × 20 grid', head, rows, (OURS,), wrap=True)


def surprise_table(results: Results) -> Table:
    """Return skill of the observer, entropies and exponent of each path."""
    head = ['path', *(f'skill at {horizon:g} s' for horizon in HORIZONS)]
    head += [
        'error at 5 s, m',
        'best predictor at 5 s',
        'permutation entropy',
        'spectral entropy',
        'exponent, 1/s',
    ]
    rows = []
    for name, each in results.items():
        row = [name]
        for horizon in HORIZONS:
            row.append(_cell(each, lambda one, h=horizon: one.metrics.skill(h)))
        row.append(_cell(each, lambda one: one.metrics.prediction_error(JUDGED_HORIZON)))
        names = [
            skill.predictor
            for one in each
            for skill in one.metrics.skills
            if skill.horizon == JUDGED_HORIZON
        ]
        row.append(max(set(names), key=names.count) if names else EMPTY_CELL)
        row.append(_cell(each, lambda one: one.metrics.permutation_entropy))
        row.append(_cell(each, lambda one: one.metrics.spectral_entropy))
        row.append(_cell(each, lambda one: one.metrics.exponent))
        rows.append(tuple(row))
    return Table('How hard the path is to predict', head, rows, (OURS,), wrap=True)


def _cell(results: Sequence[PatrolResult], value: Any, digits: int = 3) -> str:
    numbers = [number for one in results if math.isfinite(number := float(value(one)))]
    if not numbers:
        return EMPTY_CELL
    return format_interval(mean(numbers), interval(numbers), digits=digits)


def description(plan: PatrolPlan) -> str:
    """Return in one paragraph what was driven and how it is counted."""
    left, bottom, right, top = plan.arena
    robots = {
        'exact': 'A robot that is always where its reference is, in an empty room',
        'twin': 'Digital twin with noise, lag, slip and 10 % of the commands lost, position '
        f'given within 3 mm, among {BOXES} unknown boxes, with the controller and the keep-out of '
        'the nodes',
    }
    cells = (
        f' Cells whose centre is within {CLEARANCE:g} m of a wall or box do not count.'
        if plan.robot == 'twin'
        else ''
    )
    return (
        f'{robots[plan.robot]}; {right - left:g} m × {top - bottom:g} m, '
        f'{plan.duration / 60.0:g} min, at most {plan.limits.linear:g} m/s and '
        f'{plan.limits.angular:g} rad/s for every path; '
        f'{len(plan.seeds)} seeds, {plan.seeds[0]} to {plan.seeds[-1]}. '
        'Mean ± half the 95 % interval over the seeds. A cell is covered when the centre of the '
        f'robot has entered it.{cells}'
    )


EXPLANATION = (
    'Evenness: entropy of the time in the cells, 1 for an even spread. Skill: an observer who '
    'learnt from the first half predicts positions in the second half; 1 exact, 0 no better than '
    'the mean position; the best of six predictors counts, and its error is in metres, because '
    'a path that covers more of the room has a higher skill at the same error. Entropies: 1 for '
    'white noise. The exponent is fitted to the path as driven; any data give a number, and a '
    'random path has no exponent, so it compares paths and proves no chaos.'
)


def markdown(plan: PatrolPlan, results: Results) -> str:
    """Return all tables in Markdown."""
    tables = [coverage_table(plan, results), surprise_table(results)]
    if claims(plan, results):
        tables.append(claims_table(plan, results))
    return '\n\n'.join([description(plan), *(each.markdown() for each in tables), EXPLANATION])


def page(plan: PatrolPlan, results: Results, drawn: Mapping[str, bytes]) -> str:
    """Return the page as self-contained HTML, with pictures (PNG) by their stems."""
    blocks: list[Block] = [*_shown(drawn, 'coverage'), Contents(), Paragraph(description(plan))]
    if claims(plan, results):
        blocks += [Heading('Does our path do what it should?'), claims_table(plan, results)]
    blocks += [Heading('Coverage'), coverage_table(plan, results)]
    blocks += _shown(drawn, 'heat_maps')
    blocks += [Heading('Predictability'), surprise_table(results)]
    blocks += [*_shown(drawn, 'predictability'), Paragraph(EXPLANATION, 'quiet')]
    blocks += [Heading('Paths'), *_shown(drawn, 'paths')]
    return html_page('Patrols compared', blocks)


def _shown(drawn: Mapping[str, bytes], *stems: str) -> list[Block]:
    return [
        Picture(each.title, drawn[each.stem], each.title)
        for each in PICTURES
        if each.stem in stems and each.stem in drawn
    ]


def record(plan: PatrolPlan, results: Results) -> dict[str, Any]:
    """Return plan, claims and every number for a JSON file."""
    return {
        'format': 1,
        'version': VERSION,
        'robot': plan.robot,
        'seeds': list(plan.seeds),
        'duration': plan.duration,
        'arena': list(plan.arena),
        'limits': plan.limits.to_dict(),
        'claims': [claim._asdict() for claim in claims(plan, results)],
        'paths': {
            name: {
                'runs': [
                    {
                        **one.metrics.record(),
                        'contacts': one.contacts,
                        'avoiding': one.avoiding,
                    }
                    for one in each
                ],
                'coverage': np.mean([one.curve for one in each], axis=0).tolist(),
            }
            for name, each in results.items()
        },
    }
