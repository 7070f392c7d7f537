# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``lab train BAG ...``: a model from recorded runs, of a simulated robot or of a real one."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.composition import ComposedLaw, CompositionSettings
from t3mpc_ros.control.controller import ControllerSettings
from t3mpc_ros.lab.training.lessons import periods, teach_coefficients, teach_predictor
from t3mpc_ros.lab.training.replay import Replay, TrainingError, replay_bag

Array = NDArray[np.float64]

FREE = ('predictive.dither',)
"""What may differ between the bags of one model, of all that shapes what is learnt."""


def learn_from_bags(
    folders: Sequence[Path], *, keep_predictor: bool = False
) -> tuple[dict[str, Array], ControllerSettings, str]:
    """Return what bags teach as a model file keeps it, their settings, and what there is to say.

    Parameters
    ----------
    folders
        Bags made under the same settings; the end of the last is kept back to judge by.
    keep_predictor
        Learn the coefficients only. The predictor stays as the nominal loop has taught it: for
        bags in which v_p moved too little.

    Raises
    ------
    TrainingError
        A bag cannot be learnt from, or the bags do not belong together.
    RecordError
        A bag cannot be read.
    """
    replays, lines = [], []
    settings: ControllerSettings | None = None
    for folder in folders:
        replay, found, notes = replay_bag(folder)
        lines += [f'note: {note}' for note in notes]
        settings = settings or found
        check_alike(settings, found, folders[0], folder)
        replays.append(replay)
    if settings is None:
        raise TrainingError('at least one bag must be given')
    replay = Replay.joined(replays)
    lines.append(
        f'rebuilt {len(replay) / settings.rate:.1f} s of control from {len(folders)} bag'
        f'{"s" if len(folders) > 1 else ""}; skills and shares are of the last quarter, which is '
        'not learnt'
    )
    coefficients = teach_coefficients(settings, replay)
    lines.append(
        f'fuzzy systems: g explains {_pair(100.0 * coefficients.explained, ".0f")} % of the '
        'variance of the acceleration that the estimate could not explain (right/left)'
    )
    learnt = ComposedLaw(settings).learnt()
    learnt['fuzzy.coefficients'] = coefficients.coefficients
    if keep_predictor:
        lines.append('predictor: kept as the nominal loop has taught it')
        return learnt, settings, '\n'.join(lines)
    lesson = teach_predictor(settings, *periods(replay, settings.predictive, settings.rate))
    learnt |= {f'predictive.{name}': value for name, value in lesson.weights.items()}
    lines += [
        f'predictor: learnt from {lesson.taught:.1f} s, judged by {lesson.kept_back:.1f} s '
        '(right/left)',
        skill_table({'nominal loop': lesson.before, 'bag': lesson.after}),
        f'  the effect of v_p is known to {_pair(100.0 * lesson.uncertainty, ".0f")} % of the '
        'nominal one (standard error)',
    ]
    return learnt, settings, '\n'.join(lines)


def check_alike(
    first: ControllerSettings, other: ControllerSettings, path: Path, other_path: Path
) -> None:
    """Raise :class:`TrainingError` unless what is learnt under both means the same."""
    mine, its = first.flat(), other.flat()
    names = [row.name for row in CompositionSettings.rows() if row.name not in FREE]
    names += [name for name in mine if name.startswith('geometry.')]
    if differing := [name for name in names if mine[name] != its[name]]:
        raise TrainingError(
            f'{path} and {other_path} must have the same settings; they differ in '
            + ', '.join(f'{name} ({mine[name]}, {its[name]})' for name in differing)
        )


def skill_table(skills: Mapping[str, Array]) -> str:
    """Return skills of both wheels as lines; each is (next step, middle) by (right, left)."""
    width = max(map(len, skills))
    lines = [f'  {"skill after":<{max(width, 11)}}  next step     middle of the horizon']
    for name, values in skills.items():
        lines.append(
            f'  {name:<{max(width, 11)}}  {_pair(values[0], ".2f"):<12}  {_pair(values[1], ".2f")}'
        )
    return '\n'.join(lines)


def _pair(values: Array, form: str) -> str:
    return '/'.join(f'{value:{form}}' for value in values)
