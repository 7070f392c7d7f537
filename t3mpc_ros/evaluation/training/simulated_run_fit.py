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
"""Model fitted to simulated runs, assessed on held-out seeds."""

from collections.abc import Mapping, Sequence

import numpy as np

from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.evaluation.cases import NOMINAL
from t3mpc_ros.evaluation.confidence_intervals import interval, mean, rms
from t3mpc_ros.evaluation.drivers import MethodSpec, pretrain
from t3mpc_ros.evaluation.experiment import Job, Run, print_report, run_experiment
from t3mpc_ros.evaluation.loop import run
from t3mpc_ros.evaluation.methods import FULL, methods
from t3mpc_ros.evaluation.proposed_method import ProposedController, ProposedParameters
from t3mpc_ros.evaluation.record import RATE, Record
from t3mpc_ros.evaluation.reporting import Table
from t3mpc_ros.evaluation.scenario import (
    PLANT_OF,
    PRETRAINING_DURATION,
    PRETRAINING_NOISE,
    PRETRAINING_SEEDS,
    Scenario,
    held_out,
)
from t3mpc_ros.evaluation.training.bag_fit import MIDDLE, NEXT_STEP, pair
from t3mpc_ros.evaluation.training.fit import TrainingData, periods, skills, stretches
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.mpc.predictive_controller import PredictiveController

WITHOUT, WITH = 'without model', 'with model'
EARLY = 10.0
"""Length of the initial phase, in which a model matters most, s."""


def fit_simulated_runs(drive: str) -> tuple[Mapping[str, Array], ProposedParameters]:
    """Return the model of the training runs, and the parameters of our full controller."""
    parameters = methods(drive)[FULL].parameters
    assert isinstance(parameters, ProposedParameters)
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


def assess(drive: str, seeds: Sequence[int], *, progress: bool = False) -> str:
    """Return a report on the model: runs on held-out seeds with it and without."""
    _, parameters = fit_simulated_runs(drive)
    specs = {
        name: MethodSpec(FULL, ProposedController, parameters, pretrained=name == WITH)
        for name in (WITHOUT, WITH)
    }
    scenarios = [
        Scenario(PLANT_OF[drive], NOMINAL, seed, PRETRAINING_DURATION, PRETRAINING_NOISE)
        for seed in held_out(seeds)
    ]
    table = run_experiment(
        [
            Run((scenario, spec), {'model': name, 'seed': scenario.seed})
            for scenario in scenarios
            for name, spec in specs.items()
        ],
        measured_phases,
        report=print_report if progress else None,
    )
    phases = 'early', 'late'
    rows = []
    for name in specs:
        numbers = [table.values(phase, model=name) for phase in phases]
        rows.append([name, *(f'{mean(each):.4f} ± {interval(each):.4f}' for each in numbers)])
    gains = [table.difference(phase, {'model': WITH}, {'model': WITHOUT}) for phase in phases]
    rows.append(['difference', *(f'{each.mean:+.4f} ± {each.half:.4f}' for each in gains if each)])
    what = f'RMSE (rad/s), seeds {seeds[0]} to {seeds[-1]}, mean ± 95 %'
    return '\n\n'.join(
        [
            f'Trained on runs of {PRETRAINING_DURATION:g} s with seeds '
            f'{", ".join(map(str, PRETRAINING_SEEDS))}: drive {drive}, noise '
            f'{PRETRAINING_NOISE:g} (rad/s)².',
            _skill_table(drive, run(scenarios[0], specs[WITHOUT])).markdown(),
            Table('', (what, f'first {EARLY:g} s', 'from 3 s on'), rows).markdown(),
        ]
    )


def measured_phases(job: Job) -> dict[str, float]:
    """Return the tracking RMSE over both wheels in the initial phase and after 3 s, rad/s."""
    record = run(*job)
    return {'early': rms(record.error[record.time < EARLY]), 'late': record.rmse()}


def _skill_table(drive: str, record: Record) -> Table:
    """Return the skills of both wheels before and after the fit, on the last quarter of a run."""
    weights, parameters = fit_simulated_runs(drive)
    predictive, prefix = parameters.predictive, 'predictive.'
    term = PredictiveController(predictive, 1.0 / RATE, parameters.law.gain)
    after = {key.removeprefix(prefix): each for key, each in weights.items() if prefix in key}
    errors, moves = periods(training_data_of(record, parameters), predictive, RATE)
    cut = 3 * len(errors) // 4
    last_quarter = stretches(errors[cut:], moves[cut:])
    rows = [
        [name, *map(pair, skills(predictive, term.span, each, last_quarter))]
        for name, each in (('before', term.get_weights()), ('after', after))
    ]
    return Table(
        '', ('skill on the last quarter of the first run (right/left)', NEXT_STEP, MIDDLE), rows
    )


def training_data_of(record: Record, parameters: ProposedParameters) -> TrainingData:
    """Return a simulated run in the form of training data from a bag."""
    begins = np.zeros(record.time.size, dtype=np.bool_)
    begins[0] = True
    return TrainingData(
        errors=-record['terms'][:, TERM_NAMES.index('feedback')] / parameters.law.gain,
        moves=record['terms'][:, TERM_NAMES.index('predictive')],
        speeds=record['estimated'],
        unexplained=record['unexplained'],
        limited=record['limited'].astype(np.bool_),
        begins=begins,
    )
