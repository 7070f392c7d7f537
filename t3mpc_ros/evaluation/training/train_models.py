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
"""Models fitted to bags, and to the training runs of the simulation, with their skill."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import hashlib
from pathlib import Path

import numpy as np

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.control.control_law import TERM_NAMES, Nt3fsMpcController
from t3mpc_ros.control.controller import ControllerParameters
from t3mpc_ros.evaluation.cases import NOMINAL
from t3mpc_ros.evaluation.confidence_intervals import interval, mean, rms
from t3mpc_ros.evaluation.experiment import Job, Run, print_report, run_experiment
from t3mpc_ros.evaluation.loop import MethodSpec, pretrain, run
from t3mpc_ros.evaluation.method_table import FULL, methods
from t3mpc_ros.evaluation.proposed_method import ProposedController, ProposedParameters
from t3mpc_ros.evaluation.result_output import Table
from t3mpc_ros.evaluation.run_record import RATE, Record
from t3mpc_ros.evaluation.scenario import (
    PLANT_OF,
    PRETRAINING_DURATION,
    PRETRAINING_NOISE,
    PRETRAINING_SEEDS,
    Scenario,
    held_out,
)
from t3mpc_ros.evaluation.topic_roles import bag_display_name
from t3mpc_ros.evaluation.training.model_fit import (
    FITTED,
    LOOP,
    MIDDLE,
    NEXT_STEP,
    Fold,
    blocks,
    cross_validate,
    fit_coefficients,
    fit_predictor,
    fold_table,
    mean_and_spread,
    pair,
    periods,
    skills,
    stretches,
)
from t3mpc_ros.evaluation.training.training_data import (
    TrainingData,
    TrainingError,
    check_compatible,
    load_training_data,
)
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.mpc.predictive_controller import PredictiveController
from t3mpc_ros.parameters.version_and_commit import provenance

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

    Of several bags each is a fold. A single bag is cut into ``count`` consecutive blocks: they are
    less independent than bags, so the skill is slightly optimistic. With ``keep_predictor`` the
    predictor stays pre-trained on the nominal loop: for bags in which v_p moved too little.

    TrainingError: a bag cannot be used, or the bags do not belong together.
    """
    runs: dict[str, TrainingData] = {}
    origins, lines = [], []
    parameters: ControllerParameters | None = None
    for folder in folders:
        data, found, notes = load_training_data(folder)
        lines += [f'note: {note}' for note in notes]
        parameters = parameters or found
        check_compatible(parameters, found, folders[0], folder)
        name = bag_display_name(folder)
        while name in runs:
            name += "'"
        runs[name] = data
        origins.append({'name': name, **origin_of(folder)})
    if parameters is None:
        raise TrainingError('at least one bag must be given')
    if len({str(each['files']) for each in origins}) < len(origins):
        raise TrainingError('each bag must be given once: two have the same content')
    whole = TrainingData.joined(list(runs.values()))
    lines.append(
        f'rebuilt {len(whole) / parameters.rate:.1f} s of control from {len(folders)} bag'
        f'{"s" if len(folders) > 1 else ""}'
    )
    # First fitted to all: errors that concern all bags are reported before the folds.
    learnt = Nt3fsMpcController(parameters).get_weights()
    learnt['fuzzy.coefficients'] = fit_coefficients(parameters, whole)
    status = 'predictor: pre-trained on the nominal loop, unchanged'
    if not keep_predictor:
        try:
            fit = fit_predictor(
                parameters, *periods(whole, parameters.predictive, parameters.rate)
            )
        except TrainingError as error:
            raise TrainingError('\n'.join([str(error), *lines])) from error
        learnt |= {f'predictive.{name}': value for name, value in fit.weights.items()}
        status = (
            f'predictor: fitted to {fit.duration:.1f} s; the effect of v_p is known to '
            f'{pair(100.0 * fit.uncertainty, ".0f")} % of the nominal one (standard error)'
        )
    parts = runs
    if len(runs) == 1:
        parts = {f'block {i + 1}': part for i, part in enumerate(blocks(whole, count))}
    folds = cross_validate(parameters, parts, keep_predictor=keep_predictor)
    lines += [
        f'cross-validated in {len(folds)} folds: each {"bag" if len(runs) > 1 else "block"} is '
        'evaluated with the model of the others (right/left); 0 is no prediction',
        fold_table(folds),
        status + '; the model is fitted to all',
        *_warnings(folds),
    ]
    return FittedModel(learnt, parameters, _origin(origins, folds), folds, '\n'.join(lines))


def _warnings(folds: Sequence[Fold]) -> list[str]:
    found = []
    if folds[0].skills:
        fitted, nominal = (
            mean_and_spread([fold.skills[name] for fold in folds])[0] for name in (FITTED, LOOP)
        )
        if (fitted <= 0.0).any():
            found.append(
                'warning: in part the fitted predictor is no better than none; record for longer, '
                'or with more predictive.dither'
            )
        elif (fitted <= nominal).any():
            found.append(
                'warning: in part the nominal loop predicts as well; --keep-predictor keeps it'
            )
    share = mean_and_spread([fold.explained for fold in folds])[0]
    if (share <= 0.0).any():
        found.append('warning: the coefficients explain nothing of the held-out data')
    return found


def _origin(bags: Sequence[Mapping[str, object]], folds: Sequence[Fold]) -> dict[str, object]:
    """Return the provenance for the header of the model file."""
    found = {'explained': [fold.explained for fold in folds]}
    if folds[0].skills:
        found['skill'] = [fold.skills[FITTED] for fold in folds]
    worth: dict[str, object] = {'folds': len(folds)}
    for name, values in found.items():
        mean, spread = np.round(mean_and_spread(values), 4).tolist()
        worth[name] = {'mean': mean, 'spread': spread}
    return {'bags': list(bags), 'program': provenance(), 'cross_validation': worth}


def origin_of(folder: Path) -> dict[str, object]:
    """Return the files of a bag (SHA-256 by name) and their provenance, as plain data."""
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


# -- simulated runs -------------------------------------------------------------------------------

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
    return TrainingData(
        errors=-record['terms'][:, TERM_NAMES.index('feedback')] / parameters.law.gain,
        moves=record['terms'][:, TERM_NAMES.index('predictive')],
        speeds=record['estimated'],
        unexplained=record['unexplained'],
        limited=record['limited'].astype(np.bool_),
        begins=np.arange(record.time.size) == 0,
    )
