# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Cross-validation of fitted models over recorded runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.control_law import Nt3fsMpcParameters
from t3mpc_ros.evaluation.proposed_method import random_output_weights
from t3mpc_ros.evaluation.training.fit import (
    explained,
    fit_coefficients,
    fit_predictor,
    periods,
    skills,
    stretches,
)
from t3mpc_ros.evaluation.training.training_data import TrainingData, TrainingError
from t3mpc_ros.mpc.predictive_controller import PredictiveController

Array = NDArray[np.float64]

FITTED, NOMINAL, RANDOM = 'taught', 'nominal loop', 'random'
"""Compared predictors: fitted to the other folds, nominal only, and with random output
weights of the same size. Skill 0 is no prediction."""
NEXT_STEP, MIDDLE = 'next step', 'middle of the horizon'


@dataclass(frozen=True)
class Fold:
    """Model of the other folds, evaluated on this one."""

    name: str
    judged: float
    """Length of the evaluated part, s."""
    skills: Mapping[str, Array]
    """For each predictor (next step, middle) by (right, left); empty when none was fitted."""
    explained: Array
    """Explained share of the variance of the unexplained acceleration, by g, (2,)."""


def blocks(replay: TrainingData, count: int) -> list[TrainingData]:
    """Return a run in ``count`` parts of equal length, each a run of its own.

    Raises
    ------
    ValueError
        ``count`` is below 2.
    """
    if count < 2:
        raise ValueError(f'folds must be at least 2: got {count}')
    edges = np.linspace(0, len(replay), count + 1).round().astype(int).tolist()
    parts = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        part = TrainingData(
            *(getattr(replay, item.name)[low:high] for item in fields(TrainingData))
        )
        begins = part.begins.copy()
        begins[:1] = True
        parts.append(replace(part, begins=begins))
    return parts


def cross_validate(
    parameters: Nt3fsMpcParameters,
    runs: Mapping[str, TrainingData],
    *,
    keep_predictor: bool = False,
) -> list[Fold]:
    """Return for each run the model of all others, evaluated on it.

    Parameters
    ----------
    settings
        Common parameters of all runs.
    runs
        Runs by displayed name; at least 2.
    keep_predictor
        Evaluate the fuzzy coefficients only.

    Raises
    ------
    TrainingError
        Without one of the runs too little data is left, or no run can be evaluated.
    """
    predictive = parameters.predictive
    span = predictive.decimation / parameters.rate
    found = []
    for name, held_out in runs.items():
        others = TrainingData.joined([run for other, run in runs.items() if other != name])
        judged = len(held_out) / parameters.rate
        ratings: dict[str, Array] = {}
        try:
            coefficients = fit_coefficients(parameters, others)
            if not keep_predictor:
                lesson = fit_predictor(parameters, *periods(others, predictive, parameters.rate))
                parts = stretches(*periods(held_out, predictive, parameters.rate))
                judged = sum(part[0][0].size for part in parts) * span
                nominal = PredictiveController(
                    predictive, 1.0 / parameters.rate, parameters.law.gain
                ).get_weights()
                ratings = {
                    title: skills(predictive, span, weights, parts)
                    for title, weights in (
                        (FITTED, lesson.weights),
                        (NOMINAL, nominal),
                        (RANDOM, random_output_weights(lesson.weights, predictive.seed)),
                    )
                }
        except TrainingError as error:
            raise TrainingError(f'without {name} to learn from: {error}') from error
        found.append(Fold(name, judged, ratings, explained(parameters, coefficients, held_out)))
    if not keep_predictor and not any(fold.judged for fold in found):
        raise TrainingError('there must be a stretch without a gap to judge by: there is none')
    return found


def mean_and_spread(values: Sequence[Array]) -> tuple[Array, Array]:
    """Return mean and standard deviation over the folds with a value."""
    table = np.stack(values)
    known = np.isfinite(table)
    count = known.sum(axis=0)
    with np.errstate(invalid='ignore', divide='ignore'):
        mean = np.where(known, table, 0.0).sum(axis=0) / count
        squares = np.where(known, (table - mean) ** 2, 0.0).sum(axis=0)
        return mean, np.sqrt(squares / (count - 1))


def fold_table(folds: Sequence[Fold]) -> str:
    """Return the result as lines: rows are folds, each number is (right/left)."""
    rows = [(f'{fold.name} ({fold.judged:.1f} s)', fold) for fold in folds]
    width = max(len(f'skill, {MIDDLE}'), *(len(name) for name, _ in rows))
    lines = []
    titles = list(folds[0].skills)
    for row, when in enumerate((NEXT_STEP, MIDDLE) if titles else ()):
        lines.append(_line(f'skill, {when}', titles, width))
        for name, fold in rows:
            lines.append(_line(name, [pair(fold.skills[t][row], '.2f') for t in titles], width))
        spreads = [spread_in_words([fold.skills[t][row] for fold in folds], 1.0) for t in titles]
        lines.append(_line('mean ± spread', spreads, width))
    lines.append(_line('g explains', [], width))
    for name, fold in rows:
        lines.append(_line(name, [f'{pair(100.0 * fold.explained, ".0f")} %'], width))
    shares = spread_in_words([fold.explained for fold in folds], 100.0)
    lines.append(_line('mean ± spread', [f'{shares} %'], width))
    return '\n'.join(lines)


def _line(title: str, cells: Sequence[str], width: int) -> str:
    return f'  {title:<{width}}  {"".join(f"{cell:<31}" for cell in cells)}'.rstrip()


def spread_in_words(values: Sequence[Array], scale: float) -> str:
    """Return mean ± standard deviation of both wheels as text."""
    mean, spread = mean_and_spread(values)
    form = '.2f' if scale == 1.0 else '.0f'
    return ' / '.join(
        f'{scale * m:{form}} ± {scale * s:{form}}' if math.isfinite(s) else f'{scale * m:{form}}'
        for m, s in zip(mean, spread, strict=True)
    )


def pair(values: Array, form: str) -> str:
    """Return the numbers of both wheels as text, a dash for an unknown one."""
    return '/'.join(f'{value:{form}}' if math.isfinite(value) else '–' for value in values)
