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
"""Cross-validation: the skill of a fit on recordings that it has not seen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
import math
import warnings

import numpy as np

from t3mpc_ros.control.control_law import Nt3fsMpcParameters
from t3mpc_ros.evaluation.proposed_method import (
    random_output_weights,
)
from t3mpc_ros.evaluation.report_table import Table
from t3mpc_ros.evaluation.training.model_fit import (
    explained,
    fit_coefficients,
    fit_predictor,
    periods,
    skills,
    stretches,
)
from t3mpc_ros.evaluation.training.training_data import (
    TrainingData,
    TrainingError,
)
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.mpc.predictive_controller import PredictiveController

FITTED, LOOP, RANDOM = 'fitted', 'nominal loop', 'random'
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


def blocks(data: TrainingData, count: int) -> list[TrainingData]:
    """Return a run in ``count`` parts of equal length, each a run of its own."""
    if count < 2:
        raise ValueError(f'folds must be at least 2: got {count}')
    names = [item.name for item in fields(TrainingData)]
    columns = zip(*(np.array_split(getattr(data, name), count) for name in names), strict=True)
    parts = [TrainingData(*(column.copy() for column in each)) for each in columns]
    for part in parts:
        part.begins[:1] = True
    return parts


def cross_validate(
    parameters: Nt3fsMpcParameters,
    runs: Mapping[str, TrainingData],
    *,
    keep_predictor: bool = False,
) -> list[Fold]:
    """Return for each run the model of all others, evaluated on it.

    With ``keep_predictor`` the fuzzy coefficients only. There are at least two runs, with common
    parameters.
    """
    predictive = parameters.predictive
    span = predictive.decimation / parameters.rate
    found = []
    for name, left_out in runs.items():
        others = TrainingData.joined([run for other, run in runs.items() if other != name])
        judged = len(left_out) / parameters.rate
        ratings: dict[str, Array] = {}
        try:
            coefficients = fit_coefficients(parameters, others)
            if not keep_predictor:
                fit = fit_predictor(parameters, *periods(others, predictive, parameters.rate))
                parts = stretches(*periods(left_out, predictive, parameters.rate))
                judged = sum(part[0][0].size for part in parts) * span
                nominal = PredictiveController(
                    predictive, 1.0 / parameters.rate, parameters.law.gain
                ).get_weights()
                ratings = {
                    title: skills(predictive, span, weights, parts)
                    for title, weights in (
                        (FITTED, fit.weights),
                        (LOOP, nominal),
                        (RANDOM, random_output_weights(fit.weights, predictive.seed)),
                    )
                }
        except TrainingError as error:
            raise TrainingError(
                f'without {name} to learn from: {error}; record for longer, or give another bag'
            ) from error
        found.append(Fold(name, judged, ratings, explained(parameters, coefficients, left_out)))
    if not keep_predictor and not any(fold.judged for fold in found):
        raise TrainingError('there must be a stretch without a gap to evaluate: there is none')
    return found


def mean_and_spread(values: Sequence[Array]) -> tuple[Array, Array]:
    """Return mean and standard deviation over the folds with a value."""
    with warnings.catch_warnings():  # there may be one fold with a value, or none
        warnings.simplefilter('ignore', RuntimeWarning)
        return np.nanmean(values, axis=0), np.nanstd(values, axis=0, ddof=1)


def fold_table(folds: Sequence[Fold]) -> str:
    """Return the result in Markdown: rows are folds, each number is (right/left)."""
    names = [f'{fold.name} ({fold.judged:.1f} s)' for fold in folds]
    columns = {
        f'skill, {when}': {
            title: [fold.skills[title][row] for fold in folds] for title in folds[0].skills
        }
        for row, when in enumerate((NEXT_STEP, MIDDLE) if folds[0].skills else ())
    }
    columns['g explains'] = {'share': [fold.explained for fold in folds]}
    tables = []
    for what, measured in columns.items():
        cells = [[pair(value) for value in values] for values in measured.values()]
        spreads = [spread_text(values) for values in measured.values()]
        rows = [*zip(names, *cells, strict=True), ('mean ± spread', *spreads)]
        tables.append(Table('', (what, *measured), rows).markdown())
    return '\n\n'.join(tables)


def spread_text(values: Sequence[Array]) -> str:
    """Return mean ± standard deviation of both wheels as text."""
    return ' / '.join(
        f'{mean:.2f} ± {spread:.2f}' if math.isfinite(spread) else f'{mean:.2f}'
        for mean, spread in zip(*mean_and_spread(values), strict=True)
    )


def pair(values: Array, form: str = '.2f') -> str:
    """Return the numbers of both wheels as text, a dash for an unknown one."""
    return '/'.join(f'{value:{form}}' if math.isfinite(value) else '–' for value in values)
