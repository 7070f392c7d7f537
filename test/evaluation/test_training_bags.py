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
"""``bag train``: recorded bags train as simulated runs do; the file says where it is from."""

import hashlib

import numpy as np
import pytest
from support.training_runs import START, STEP, TrainingRun

from t3mpc_ros.cli.bag import program_parser
from t3mpc_ros.control.controller import Controller
from t3mpc_ros.evaluation.loop import MethodSpec, run
from t3mpc_ros.evaluation.method_table import FULL, methods
from t3mpc_ros.evaluation.proposed_method import ProposedController
from t3mpc_ros.evaluation.scenario import HELD_OUT_SEEDS, PRETRAINING_SEEDS, Scenario
from t3mpc_ros.evaluation.training import train_models
from t3mpc_ros.evaluation.training.model_fit import (
    explained,
    fit_coefficients,
    fit_predictor,
    mean_and_spread,
    periods,
    skills,
    spread_text,
    stretches,
)
from t3mpc_ros.evaluation.training.train_models import fit_bags, training_data_of
from t3mpc_ros.evaluation.training.training_data import TrainingData
from t3mpc_ros.model_file import load_model, read_model

pytestmark = pytest.mark.slow

SECONDS, LONG, DITHER = 18.0, 30.0, 4.0
RECORDED = (21, 22, 23)


def lossy(tape, seed, seconds):
    """Return the messages as a busy machine records them: late by turns, some commands not."""
    rng = np.random.default_rng(seed)
    kept = tape.where(lambda t, topic, i: topic != '/cmd_vel' or rng.random() > 0.002)
    late = rng.exponential(5e5, round(seconds * 1e9 / STEP) + 2).astype(int).tolist()
    kept.rows = [(row[0] + late[(row[0] - START) // STEP], *row[1:]) for row in kept.rows]
    return kept


def recorded_bags(folder, seconds, seeds=RECORDED):
    loops = {seed: TrainingRun(seed, seconds, **{'predictive.dither': DITHER}) for seed in seeds}
    return [
        lossy(loop.tape, seed, seconds).write(folder / f'run{seed}' / 'bag')
        for seed, loop in loops.items()
    ]


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('recorded')


@pytest.fixture(scope='module')
def bag(folder):
    return recorded_bags(folder, SECONDS, RECORDED[:1])[0]


@pytest.fixture(scope='module')
def bags(bag, folder):
    return [bag, *recorded_bags(folder, SECONDS, RECORDED[1:])]


@pytest.fixture(scope='module')
def model(bags):
    return fit_bags(bags)


def simulated_run(seed):
    parameters = methods('velocity')[FULL].parameters.with_values({'predictive.dither': DITHER})
    scenario = Scenario('servo', 'nominal', seed, LONG)
    return training_data_of(
        run(scenario, MethodSpec('full', ProposedController, parameters)), parameters
    )


@pytest.mark.long
def test_three_recorded_bags_train_as_well_as_three_simulations(tmp_path):
    """The same training data, the runs once rebuilt from lossy bags and once known exactly.

    Judged on simulated runs that neither has seen: skill within 5 %, and as much explained.
    """
    model = fit_bags(recorded_bags(tmp_path, LONG))
    parameters = model.parameters
    predictive = parameters.predictive
    lab = TrainingData.joined([simulated_run(seed) for seed in PRETRAINING_SEEDS])
    exact = fit_predictor(parameters, *periods(lab, predictive, parameters.rate)).weights
    prefix = 'predictive.'
    recorded = {
        name.removeprefix(prefix): values
        for name, values in model.learnt.items()
        if name.startswith(prefix)
    }
    nominal = Controller(parameters).law.predictive.get_weights()
    coefficients = fit_coefficients(parameters, lab), model.learnt['fuzzy.coefficients']
    found, shares = [], []
    for seed in HELD_OUT_SEEDS[:3]:
        judge = simulated_run(seed)
        parts = stretches(*periods(judge, predictive, parameters.rate))
        found.append([skills(predictive, 0.05, w, parts) for w in (exact, recorded, nominal)])
        shares.append([explained(parameters, each, judge) for each in coefficients])
    of_lab, of_bags, of_nominal = np.mean(found, axis=0)
    assert of_lab.min() > 0.5
    assert np.all(of_bags > 0.95 * of_lab)
    assert np.all(of_bags < 1.05 * of_lab)
    assert np.all(of_nominal < 0.3 * of_lab)
    lab_share, bag_share = np.mean(shares, axis=0)
    assert lab_share.min() > 0.4
    assert np.all(bag_share > 0.9 * lab_share)


def program(*arguments):
    options = program_parser().parse_args([str(argument) for argument in arguments])
    return options.run(options) or 0


@pytest.mark.long
def test_the_model_file_is_loaded_and_says_where_it_is_from(
    bags, model, tmp_path, monkeypatch, capsys
):
    path, asked = tmp_path / 'model.npz', []
    assert 'cross-validated in 3 folds: each bag' in model.text
    monkeypatch.setattr(
        train_models, 'fit_bags', lambda folders, **how: asked.append((folders, how)) or model
    )
    assert program('train', *bags, '--output', path) == 0
    assert asked == [(bags, {'keep_predictor': False, 'count': train_models.FOLDS})]
    said = capsys.readouterr().out
    assert model.text in said
    assert f'saved {path}' in said
    loaded = load_model(path)
    Controller(model.parameters).law.set_weights(loaded)
    for name, values in model.learnt.items():
        np.testing.assert_array_equal(loaded[name], values)
    header = read_model(path)[0]
    assert header['parameters']['predictive.dither'] == DITHER
    origin = header['origin']
    assert [bag['name'] for bag in origin['bags']] == [f'run{seed}/bag' for seed in RECORDED]
    for bag, folder in zip(origin['bags'], bags, strict=True):
        ((name, digest),) = bag['files'].items()
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
        assert bag['duration_s'] == pytest.approx(SECONDS, abs=0.1)
    assert {'version', 'commit'} <= set(origin['program'])
    assert str(tmp_path.parent) not in str(origin)


def test_one_bag_is_cut_into_as_many_blocks_as_asked_for(bag, tmp_path, capsys):
    path = tmp_path / 'model.npz'
    assert program('train', bag, '--folds', '3', '--output', path) == 0
    assert 'cross-validated in 3 folds: each block' in capsys.readouterr().out
    assert read_model(path)[0]['origin']['cross_validation']['folds'] == 3
    with pytest.raises(SystemExit):
        program('train', bag, '--folds', '1', '--output', path)
    assert 'must be from 2 to 1000: got 1' in capsys.readouterr().err


def test_mean_and_spread_leave_out_what_is_not_known():
    values = [np.array([1.0, np.nan]), np.array([3.0, 5.0]), np.array([2.0, np.nan])]
    mean, spread = mean_and_spread(values)
    np.testing.assert_allclose(mean, [2.0, 5.0])
    assert spread[0] == pytest.approx(1.0)
    assert np.isnan(spread[1])
    assert spread_text(values) == '2.00 ± 1.00 / 5.00'
