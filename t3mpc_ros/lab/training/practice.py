# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``lab train``: a model from simulated practice, and what it is worth on seeds never seen."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.law import TERMS
from t3mpc_ros.lab.composed import Composed, ComposedSettings
from t3mpc_ros.lab.contestants import FULL, methods, ours
from t3mpc_ros.lab.training.folds import MIDDLE, NEXT_STEP, pair
from t3mpc_ros.lab.training.lessons import periods, skills
from t3mpc_ros.lab.training.replay import Replay
from t3mpc_ros.lab.trial.loop import MethodSpec, practise, run
from t3mpc_ros.lab.trial.record import LoopRecord
from t3mpc_ros.lab.trial.scenario import (
    HELD_OUT,
    PRACTICE,
    PRACTICE_DURATION,
    PRACTICE_NOISE,
    RATE,
    Scenario,
)
from t3mpc_ros.lab.trial.statistics import interval, mean, paired
from t3mpc_ros.lab.tuning.store import SHIPPED
from t3mpc_ros.mpc.predictive import PredictiveTerm
from t3mpc_ros.mpc.training import split_runs

Array = NDArray[np.float64]

EARLY = 10.0
"""The first seconds, in which a model shows most."""
_FOLLOWED = [TERMS.index(name) for name in ('feedback', 'feedforward', 'compensator')]


def full_settings(drive: str) -> ComposedSettings:
    """Return the settings of our full controller: tuned, where tuned ones come with the package.

    Raises
    ------
    StoreError
        What is stored does not fit this version.
    """
    settings = methods(drive)[FULL].settings if SHIPPED.is_file() else ours()[drive]
    if not isinstance(settings, ComposedSettings):
        raise TypeError(f'{FULL} must have ComposedSettings: got {type(settings).__name__}')
    return settings


def learn_from_practice(drive: str) -> tuple[Mapping[str, Array], ComposedSettings]:
    """Return what the full controller learns in the practice runs, and its settings."""
    settings = full_settings(drive)
    return practise(Composed, settings, drive), settings


def assess(
    drive: str,
    settings: ComposedSettings,
    learnt: Mapping[str, Array],
    seeds: Sequence[int],
    progress: Callable[[str], None] = lambda text: None,
) -> str:
    """Return in words what a model is worth on seeds that it was not learnt on.

    Parameters
    ----------
    drive
        One of ``scenario.DRIVES``.
    settings, learnt
        Of the controller, and what it starts with.
    seeds
        Runs with the model and without it.
    progress
        Told what is done.
    """
    without = MethodSpec(FULL, Composed, settings)

    def with_model(*given: object) -> Composed:
        controller = Composed(settings, *given)  # type: ignore[arg-type]
        controller.restore(learnt)
        return controller

    fresh, taught = [], []
    for seed in seeds:
        scenario = Scenario(drive, PRACTICE_NOISE, 'nominal', seed, PRACTICE_DURATION)
        fresh.append(run(scenario, without))
        taught.append(run(scenario, with_model))
        progress(f'seed {seed} of {seeds[0]} to {seeds[-1]}')
    early, late = (
        [[measure(record) for record in records] for records in (fresh, taught)]
        for measure in (early_rmse, LoopRecord.rmse)
    )
    lines = [
        f'practice: {len(PRACTICE)} runs of {PRACTICE_DURATION:g} s, drive {drive}, noise '
        f'{PRACTICE_NOISE:g} (rad/s)², seeds {", ".join(map(str, PRACTICE))}',
        f'predictor: judged by errors and v_p in the last quarter of seed {seeds[0]} (right/left)',
        skill_table(held_out_skills(settings, learnt, fresh[0])),
        f'RMSE (rad/s) on seeds {seeds[0]} to {seeds[-1]}, mean ± 95 %',
        f'                 first {EARLY:g} s         from 3 s on',
    ]
    for row, name in enumerate(('without model', 'with model')):
        cells = [f'{mean(part[row]):.4f} ± {interval(part[row]):.4f}' for part in (early, late)]
        lines.append(f'  {name:<13}  {cells[0]}    {cells[1]}')
    gains = [paired(part[1], part[0]) for part in (early, late)]
    cells = [f'{gain.mean:+.4f} ± {gain.half:.4f}' for gain in gains]
    lines.append(f'  {"difference":<13} {cells[0]}   {cells[1]}')
    return '\n'.join(lines)


def early_rmse(record: LoopRecord) -> float:
    """Return the tracking RMSE over both wheels in the first seconds, rad/s."""
    return float(np.sqrt(np.mean(record.error[record.time < EARLY] ** 2)))


def held_out_skills(
    settings: ComposedSettings, learnt: Mapping[str, Array], record: LoopRecord
) -> dict[str, Array]:
    """Return the skills before and after on the last quarter of a run, as :func:`skills` does."""
    predictive = settings.predictive
    term = PredictiveTerm(predictive, 1.0 / RATE, settings.law.gain)
    prefix = 'predictive.'
    after = {key[len(prefix) :]: value for key, value in learnt.items() if key.startswith(prefix)}
    errors, moves = periods(lived(record, settings), predictive, RATE)
    last_quarter = [[trial for _, trial in split_runs(errors, moves, 2)]]
    return {
        name: skills(predictive, term.span, weights, last_quarter)
        for name, weights in (('before', term.weights()), ('after', after))
    }


def skill_table(skills: Mapping[str, Array]) -> str:
    """Return skills of both wheels as lines; each is (next step, middle) by (right, left)."""
    width = max(11, *map(len, skills))
    lines = [f'  {"skill after":<{width}}  {NEXT_STEP}     {MIDDLE}']
    for name, values in skills.items():
        lines.append(f'  {name:<{width}}  {pair(values[0], ".2f"):<12}  {pair(values[1], ".2f")}')
    return '\n'.join(lines)


def lived(record: LoopRecord, settings: ComposedSettings) -> Replay:
    """Return a run of the lab as the replay of a bag would have it."""
    terms = record.terms
    begins = np.zeros(record.time.size, dtype=np.bool_)
    begins[0] = True
    return Replay(
        time=record.time,
        errors=-terms[:, TERMS.index('feedback')] / settings.law.gain,
        moves=terms[:, TERMS.index('predictive')],
        rest=record.command - terms[:, _FOLLOWED].sum(axis=1),
        speeds=record.estimated,
        unexplained=record.unexplained,
        limited=record.limited,
        begins=begins,
    )


def held_out_seeds(count: int) -> Sequence[int]:
    """Return the first seeds of those on which results are reported.

    Raises
    ------
    ValueError
        There are not as many.
    """
    if not 1 <= count <= len(HELD_OUT):
        raise ValueError(f'seeds must be from 1 to {len(HELD_OUT)}: got {count}')
    return HELD_OUT[:count]
