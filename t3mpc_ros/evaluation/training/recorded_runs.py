# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Model fitted to recorded bags, of a simulated robot or a real one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.control.control_law import Nt3fsMpcController, Nt3fsMpcParameters
from t3mpc_ros.control.controller import ControllerParameters
from t3mpc_ros.evaluation.bag_report.topic_roles import bag_display_name
from t3mpc_ros.evaluation.training.cross_validation import (
    FITTED,
    NOMINAL,
    Fold,
    blocks,
    cross_validate,
    fold_table,
    mean_and_spread,
    pair,
)
from t3mpc_ros.evaluation.training.fit import fit_coefficients, fit_predictor, periods
from t3mpc_ros.evaluation.training.training_data import (
    TrainingData,
    TrainingError,
    load_training_data,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.parameters.provenance import provenance

Array = NDArray[np.float64]

FREE = ('predictive.dither',)
"""Parameters that may differ between the bags of one model, of all that affect the fit."""
FOLDS = 5
"""Number of blocks of a single bag."""
STORAGE = ('.mcap', '.db3')


@dataclass(frozen=True)
class FittedModel:
    """Model fitted to bags."""

    learnt: Mapping[str, Array]
    """Weights as in a model file."""
    parameters: ControllerParameters
    """Common parameters of the bags."""
    origin: Mapping[str, object]
    """Header of the model file: the bags, this program, and the skill of the model."""
    folds: Sequence[Fold]
    text: str
    """Report, in lines."""


def fit_bags(
    folders: Sequence[Path], *, keep_predictor: bool = False, count: int = FOLDS
) -> FittedModel:
    """Return the model of all bags, and its cross-validated skill.

    Of several bags each is a fold. A single bag is cut into consecutive blocks: they are
    less independent than bags, so the skill is slightly optimistic.

    Parameters
    ----------
    folders
        Bags with the same parameters.
    keep_predictor
        Fit the fuzzy coefficients only. The predictor stays pre-trained on the nominal loop: for
        bags in which v_p moved too little.
    count
        Number of blocks of a single bag, at least 2.

    Raises
    ------
    TrainingError
        A bag cannot be used, or the bags do not belong together.
    BagError
        A bag cannot be read.
    """
    runs: dict[str, TrainingData] = {}
    origins, lines = [], []
    parameters: ControllerParameters | None = None
    for folder in folders:
        replay, found, notes = load_training_data(folder)
        lines += [f'note: {note}' for note in notes]
        parameters = parameters or found
        check_compatible(parameters, found, folders[0], folder)
        name = bag_display_name(folder)
        while name in runs:
            name += "'"
        runs[name] = replay
        origins.append({'name': name, **origin_of(folder)})
    if parameters is None:
        raise TrainingError('at least one bag must be given')
    if len({str(each['files']) for each in origins}) < len(origins):
        raise TrainingError('each bag must be given once: two have the same content')
    replay = TrainingData.joined(list(runs.values()))
    lines.append(
        f'rebuilt {len(replay) / parameters.rate:.1f} s of control from {len(folders)} bag'
        f'{"s" if len(folders) > 1 else ""}'
    )
    # First fitted to all: errors that concern all bags are reported before the folds.
    learnt = Nt3fsMpcController(parameters).get_weights()
    learnt['fuzzy.coefficients'] = fit_coefficients(parameters, replay)
    status = 'predictor: pre-trained on the nominal loop, unchanged'
    if not keep_predictor:
        lesson = fit_predictor(
            parameters, *periods(replay, parameters.predictive, parameters.rate)
        )
        learnt |= {f'predictive.{name}': value for name, value in lesson.weights.items()}
        status = (
            f'predictor: learnt from {lesson.taught:.1f} s; the effect of v_p is known to '
            f'{pair(100.0 * lesson.uncertainty, ".0f")} % of the nominal one (standard error)'
        )
    parts = runs
    if len(runs) == 1:
        parts = {f'block {i + 1}': part for i, part in enumerate(blocks(replay, count))}
    folds = cross_validate(parameters, parts, keep_predictor=keep_predictor)
    lines += [
        f'cross-validated in {len(folds)} folds: each {"bag" if len(runs) > 1 else "block"} is '
        'judged by what the others teach (right/left); 0 is no prediction',
        fold_table(folds),
        status + '; the model is learnt from all',
        *_warnings(folds),
    ]
    return FittedModel(learnt, parameters, _origin(origins, folds), folds, '\n'.join(lines))


def _warnings(folds: Sequence[Fold]) -> list[str]:
    """Return warnings about the use of the model."""
    found = []
    if folds[0].skills:
        taught, nominal = (
            mean_and_spread([fold.skills[name] for fold in folds])[0] for name in (FITTED, NOMINAL)
        )
        if (taught <= 0.0).any():
            found.append(
                'warning: in part the taught predictor is no better than none; record for longer, '
                'or with more predictive.dither'
            )
        elif (taught <= nominal).any():
            found.append(
                'warning: in part the nominal loop predicts as well; --keep-predictor keeps it'
            )
    share = mean_and_spread([fold.explained for fold in folds])[0]
    if (share <= 0.0).any():
        found.append('warning: the coefficients explain nothing of the held-out data')
    return found


def _origin(bags: Sequence[Mapping[str, object]], folds: Sequence[Fold]) -> dict[str, object]:
    """Return the provenance for the header of the model file."""
    worth: dict[str, object] = {
        'folds': len(folds),
        'explained': _both([fold.explained for fold in folds]),
    }
    if folds[0].skills:
        worth['skill'] = _both([fold.skills[FITTED] for fold in folds])
    return {'bags': list(bags), 'program': provenance(), 'cross_validation': worth}


def _both(values: Sequence[Array]) -> dict[str, list[float] | list[list[float]]]:
    mean, spread = mean_and_spread(values)
    return {'mean': np.round(mean, 4).tolist(), 'spread': np.round(spread, 4).tolist()}


def origin_of(folder: Path) -> dict[str, object]:
    """Return the files of a bag (SHA-256 by name) and their provenance, as plain data.

    Raises
    ------
    BagError
        The bag cannot be read.
    """
    paths = [folder] if folder.is_file() else sorted(folder.iterdir())
    files = {}
    for path in paths:
        if path.suffix in STORAGE:
            with path.open('rb') as file:
                files[path.name] = hashlib.file_digest(file, 'sha256').hexdigest()
    with open_bag(folder) as recording:
        made_by = dict(recording.metadata_records.get('provenance', {}))
        start, duration = recording.start_ns, recording.duration
    return {'files': files, 'start_ns': start, 'duration_s': duration, 'made_by': made_by}


def check_compatible(
    first: ControllerParameters, other: ControllerParameters, path: Path, other_path: Path
) -> None:
    """Raise :class:`TrainingError` unless both models would be comparable."""
    mine, its = first.to_dict(), other.to_dict()
    names = [spec.name for spec in Nt3fsMpcParameters.specs() if spec.name not in FREE]
    names += [spec.name for spec in WheelGeometry.specs()]
    if differing := [name for name in names if mine[name] != its[name]]:
        raise TrainingError(
            f'{path} and {other_path} must have the same settings; they differ in '
            + ', '.join(f'{name} ({mine[name]}, {its[name]})' for name in differing)
        )
