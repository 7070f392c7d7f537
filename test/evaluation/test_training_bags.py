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

from t3mpc_ros.bag.model_file import load_model, read_model
from t3mpc_ros.cli.bag import program_parser
from t3mpc_ros.control.controller import Controller
from t3mpc_ros.evaluation.training import trained_models
from t3mpc_ros.evaluation.training.trained_models import (
    fit_bags,
    mean_and_spread,
    spread_text,
)

pytestmark = pytest.mark.slow

SECONDS, DITHER = 18.0, 4.0
RECORDED = (21, 22, 23)


def lossy_bag(seed, folder):
    """Return a bag as a busy machine records it: late by turns, some commands not."""
    tape = TrainingRun(seed, SECONDS, **{'predictive.dither': DITHER}).tape
    rng = np.random.default_rng(seed)
    kept = tape.where(lambda t, topic, i: topic != '/cmd_vel' or rng.random() > 0.002)
    late = rng.exponential(5e5, round(SECONDS * 1e9 / STEP) + 2).astype(int).tolist()
    kept.rows = [(row[0] + late[(row[0] - START) // STEP], *row[1:]) for row in kept.rows]
    return kept.write(folder / f'run{seed}' / 'bag')


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return lossy_bag(RECORDED[0], tmp_path_factory.mktemp('one'))


@pytest.fixture(scope='module')
def bags(bag, tmp_path_factory):
    return [bag, *(lossy_bag(seed, tmp_path_factory.mktemp('more')) for seed in RECORDED[1:])]


@pytest.fixture(scope='module')
def model(bags):
    return fit_bags(bags)


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
        trained_models, 'fit_bags', lambda folders, **how: asked.append((folders, how)) or model
    )
    assert program('train', *bags, '--output', path) == 0
    assert asked == [(bags, {'keep_predictor': False, 'count': trained_models.FOLDS})]
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
