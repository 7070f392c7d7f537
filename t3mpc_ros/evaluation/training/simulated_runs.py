# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Model fitted to simulated runs, assessed on held-out seeds."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.evaluation.cases import NOMINAL
from t3mpc_ros.evaluation.confidence_intervals import interval, mean, paired, rms
from t3mpc_ros.evaluation.loop import run
from t3mpc_ros.evaluation.method import MadeMethod, MethodSpec, pretrain
from t3mpc_ros.evaluation.methods import FULL, methods, proposed_parameters
from t3mpc_ros.evaluation.proposed_method import ProposedController, ProposedParameters
from t3mpc_ros.evaluation.record import RATE, Record
from t3mpc_ros.evaluation.reporting import progress_bar
from t3mpc_ros.evaluation.scenario import (
    HELD_OUT_SEEDS,
    PLANT_OF,
    PRETRAINING_DURATION,
    PRETRAINING_NOISE,
    PRETRAINING_SEEDS,
    Scenario,
)
from t3mpc_ros.evaluation.training.fit import periods, skills
from t3mpc_ros.evaluation.training.recorded_runs import MIDDLE, NEXT_STEP, pair
from t3mpc_ros.evaluation.training.training_data import TrainingData
from t3mpc_ros.evaluation.tuning.tuned_parameters import PACKAGED_FILE
from t3mpc_ros.mpc.predictive_controller import PredictiveController
from t3mpc_ros.mpc.pretraining import split_runs

Array = NDArray[np.float64]

EARLY = 10.0
"""Length of the initial phase, in which a model matters most, s."""
_FOLLOWED = [TERM_NAMES.index(name) for name in ('feedback', 'feedforward', 'compensator')]


def full_parameters(drive: str) -> ProposedParameters:
    """Return the parameters of our full controller: the tuned ones of the package, if any."""
    parameters = (
        methods(drive)[FULL].parameters
        if PACKAGED_FILE.is_file()
        else proposed_parameters()[drive]
    )
    if not isinstance(parameters, ProposedParameters):
        raise TypeError(f'{FULL} must have ComposedParameters: got {type(parameters).__name__}')
    return parameters


def fit_simulated_runs(drive: str) -> tuple[Mapping[str, Array], ProposedParameters]:
    """Return the model fitted to the training runs, and the parameters of the controller."""
    parameters = full_parameters(drive)
    return pretrain(ProposedController, parameters, drive), parameters


def origin(drive: str) -> Mapping[str, object]:
    """Return the origin of the model fitted to the training runs, for the model file."""
    return {
        'command': f't3mpc train --robot {"servo" if drive == "velocity" else drive}',
        'drive': drive,
        'seeds': list(PRETRAINING_SEEDS),
        'duration': PRETRAINING_DURATION,
        'noise_variance': PRETRAINING_NOISE,
    }


def assess(
    drive: str,
    parameters: ProposedParameters,
    learnt: Mapping[str, Array],
    seeds: Sequence[int],
    *,
    progress: bool = False,
) -> str:
    """Return a report on a model: runs on held-out seeds with it and without."""
    without = MethodSpec(FULL, ProposedController, parameters)

    def with_model(scenario: Scenario) -> MadeMethod:
        controller = ProposedController(parameters, scenario.nominal_model())
        controller.set_weights(learnt)
        return MadeMethod(controller)

    fresh, trained = [], []
    with progress_bar(2 * len(seeds), show=progress) as bar:
        for seed in seeds:
            scenario = Scenario(
                PLANT_OF[drive], NOMINAL, seed, PRETRAINING_DURATION, PRETRAINING_NOISE
            )
            fresh.append(run(scenario, without))
            trained.append(run(scenario, with_model(scenario)))
            bar.update(2)
    early, late = (
        [[measure(record) for record in records] for records in (fresh, trained)]
        for measure in (early_rmse, Record.rmse)
    )
    lines = [
        f'training: {len(PRETRAINING_SEEDS)} runs of {PRETRAINING_DURATION:g} s, drive {drive}, '
        f'noise {PRETRAINING_NOISE:g} (rad/s)², seeds {", ".join(map(str, PRETRAINING_SEEDS))}',
        f'predictor: skill on errors and v_p in the last quarter of seed {seeds[0]} (right/left)',
        skill_table(held_out_skills(parameters, learnt, fresh[0])),
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


def early_rmse(record: Record) -> float:
    """Return the tracking RMSE over both wheels in the initial phase, rad/s."""
    return rms(record.error[record.time < EARLY])


def held_out_skills(
    parameters: ProposedParameters, learnt: Mapping[str, Array], record: Record
) -> dict[str, Array]:
    """Return the skills before and after the fit on the last quarter of a run."""
    predictive = parameters.predictive
    term = PredictiveController(predictive, 1.0 / RATE, parameters.law.gain)
    prefix = 'predictive.'
    after = {key[len(prefix) :]: value for key, value in learnt.items() if key.startswith(prefix)}
    errors, moves = periods(training_data_of(record, parameters), predictive, RATE)
    last_quarter = [[trial for _, trial in split_runs(errors, moves, 2)]]
    return {
        name: skills(predictive, term.span, weights, last_quarter)
        for name, weights in (('before', term.get_weights()), ('after', after))
    }


def skill_table(skills: Mapping[str, Array]) -> str:
    """Return the skills of both wheels as lines; each is (next step, middle) by (right, left)."""
    width = max(11, *map(len, skills))
    lines = [f'  {"skill after":<{width}}  {NEXT_STEP}     {MIDDLE}']
    for name, values in skills.items():
        lines.append(f'  {name:<{width}}  {pair(values[0], ".2f"):<12}  {pair(values[1], ".2f")}')
    return '\n'.join(lines)


def training_data_of(record: Record, parameters: ProposedParameters) -> TrainingData:
    """Return a simulated run in the form of training data from a bag."""
    terms = record['terms']
    begins = np.zeros(record.time.size, dtype=np.bool_)
    begins[0] = True
    return TrainingData(
        time=record.time,
        errors=-terms[:, TERM_NAMES.index('feedback')] / parameters.law.gain,
        moves=terms[:, TERM_NAMES.index('predictive')],
        rest=record['acceleration'] - terms[:, _FOLLOWED].sum(axis=1),
        speeds=record['estimated'],
        unexplained=record['unexplained'],
        limited=record['limited'].astype(np.bool_),
        begins=begins,
    )


def held_out_seeds(count: int) -> Sequence[int]:
    """Return the first seeds of those used for results."""
    if not 1 <= count <= len(HELD_OUT_SEEDS):
        raise ValueError(f'seeds must be from 1 to {len(HELD_OUT_SEEDS)}: got {count}')
    return HELD_OUT_SEEDS[:count]
