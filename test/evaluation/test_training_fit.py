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
"""Models fitted to bags and to simulated runs: the run is rebuilt exactly."""

import math
import re

import numpy as np
import pytest
from support.checkout import ROOT
from support.training_runs import GEOMETRY, TrainingRun

from t3mpc_ros import model_file
from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.cli.main import main
from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.control.speed_kalman_filter import SpeedFilterParameters
from t3mpc_ros.control.velocity_actuation import LimitParameters, VelocityActuation
from t3mpc_ros.evaluation.proposed_method import ProposedParameters
from t3mpc_ros.evaluation.scenario import HELD_OUT_SEEDS, PRETRAINING_SEEDS, Scenario
from t3mpc_ros.evaluation.training import train_models
from t3mpc_ros.evaluation.training.model_fit import (
    blocks,
    estimate_move_effect,
    explained,
    fit_coefficients,
    fit_predictor,
    periods,
    skills,
    stretches,
)
from t3mpc_ros.evaluation.training.train_models import fit_bags
from t3mpc_ros.evaluation.training.training_data import (
    TrainingData,
    TrainingError,
    load_training_data,
)
from t3mpc_ros.fuzzy.estimator import FuzzyEstimator
from t3mpc_ros.model_file import (
    ModelError,
    find_model,
    load_model,
    read_model,
    save_model,
)
from t3mpc_ros.mpc.boltzmann_machine import (
    LayerSizes,
    make_machine,
    make_rls_state,
    predict_error,
    set_visible,
)
from t3mpc_ros.mpc.predictive_controller import PredictiveController, PredictiveParameters
from t3mpc_ros.mpc.pretraining import ExcitationParameters, pretrain, ridge_regression
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.simulation.plant.disturbances import friction_torque
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters
from t3mpc_ros.version import VERSION

pytestmark = pytest.mark.slow

# -- runs and their bags ----------------------------------------------------------------------


@pytest.fixture(scope='module')
def run():
    return TrainingRun(3, 40.0, **{'predictive.dither': 4.0})


@pytest.fixture(scope='module')
def bag(run, tmp_path_factory):
    return run.tape.write(tmp_path_factory.mktemp('whole') / 'bag')


@pytest.fixture(scope='module')
def replayed(bag):
    return load_training_data(bag)


@pytest.fixture(scope='module')
def sampled(replayed):
    replay, parameters, _ = replayed
    return periods(replay, parameters.predictive, parameters.rate)


@pytest.fixture(scope='module')
def trained(bag):
    return fit_bags([bag])


@pytest.fixture(scope='module')
def learnt():
    """Return weights as a model has them."""
    return Controller(ControllerParameters()).law.get_weights()


@pytest.fixture(scope='module')
def calm(tmp_path_factory):
    """Return the bag of an ordinary run, in which nothing but feedback moves v_p."""
    return TrainingRun(5, 16.0).tape.write(tmp_path_factory.mktemp('calm') / 'bag')


# -- rebuilding ---------------------------------------------------------------------------------


def test_training_data_are_the_run(run, replayed, sampled):
    """Errors as means of five, v_p as held from then on, whatever the step of publishing."""
    replay, parameters, notes = replayed
    assert notes == []
    assert parameters == run.controller.parameters
    np.testing.assert_allclose(replay.errors, run.errors, atol=1e-9)
    np.testing.assert_array_equal(replay.moves, run.terms[:, 4])
    np.testing.assert_allclose(replay.speeds, run.estimates, atol=1e-9)
    np.testing.assert_allclose(replay.unexplained, run.unexplained, atol=1e-7)
    np.testing.assert_array_equal(replay.limited, [status.limited for status in run.statuses])
    assert np.flatnonzero(replay.begins).tolist() == [0]
    errors, moves = (table[1:-1] for table in sampled)
    starts = np.arange(5, 4000, 5)
    assert errors.shape == moves.shape == (starts.size, 2)
    means = run.errors[starts[:, None] - np.arange(5)].mean(axis=1)
    np.testing.assert_allclose(errors, means, atol=1e-9)
    limited = replay.limited[starts[:, None] + np.arange(5)].mean(axis=1) > 0.5
    assert 0 < np.count_nonzero(limited) < 80
    np.testing.assert_array_equal(np.isnan(moves).all(axis=1), limited)
    np.testing.assert_array_equal(moves[~limited], run.terms[starts[~limited], 4])


def test_what_is_lost_leaves_gaps_and_spoils_nothing_else(run, replayed, tmp_path):
    def keep(t, topic, i):
        return t < 20.0 and (topic, i) not in (('/odom', 1500), ('/cmd_vel', 400))

    data, parameters, notes = load_training_data(run.tape.where(keep).write(tmp_path / 'bag'))
    assert any('1499 of 1999 commands come out of the replay' in note for note in notes)
    whole = replayed[0]
    known = np.isfinite(data.moves).all(axis=1)
    assert np.flatnonzero(~known).tolist() == [400, *range(1500, 1999)]
    rows = np.delete(np.arange(2000), 1500)
    np.testing.assert_array_equal(data.moves[known], whole.moves[rows][known])
    for name in ('errors', 'speeds', 'unexplained'):
        missed = np.abs(getattr(data, name) - getattr(whole, name)[rows]).max(axis=1)
        assert missed[:1500].max() < 1e-9
        assert np.percentile(missed, 99) < (1.0 if name == 'unexplained' else 0.02)
    errors, _ = periods(data, parameters.predictive, parameters.rate)
    # No two runs were joined: there is a gap between rows that were not neighbours in time.
    gaps = np.flatnonzero(np.isnan(errors).any(axis=1)).tolist()
    assert gaps == [0, 80, len(errors) - 1]


def test_a_stretch_in_which_the_robot_was_stopped_is_left_out(tmp_path):
    stopped = TrainingRun(3, 14.0, off=(600, 803), **{'predictive.dither': 4.0})
    data, parameters, _ = load_training_data(stopped.tape.write(tmp_path / 'bag'))
    moving = [status.reason.moves for status in stopped.statuses]
    assert np.flatnonzero(np.diff(moving)).tolist() == [599, 802]
    np.testing.assert_array_equal(data.moves, stopped.terms[moving, 4])
    assert np.flatnonzero(data.begins).tolist() == [0, 600]
    errors, _ = periods(data, parameters.predictive, parameters.rate)
    assert np.count_nonzero(np.isnan(errors[:, 0])) == 3


def test_jumps_that_the_law_knows_are_no_errors(tmp_path):
    """Left to the program, a switch makes the error jump; the machine does not see that part."""
    jumping = TrainingRun(3, 14.0, **{'jump_transition.method': 'predictive'})
    data, _, _ = load_training_data(jumping.tape.write(tmp_path / 'bag'))
    part = slice(1150, 1400)
    assert np.abs(jumping.errors[part]).max() > 1.0
    assert np.abs(data.errors[part]).max() < 0.5 * np.abs(jumping.errors[part]).max()
    quiet = slice(300, 1150)
    np.testing.assert_allclose(data.errors[quiet], jumping.errors[quiet], atol=1e-3)


# -- what is learnt -----------------------------------------------------------------------------


@pytest.mark.long
def test_the_model_is_fitted_to_all_and_evaluated_by_folds(run, sampled, trained):
    """Each block with the model of the other four, so never with its own data."""
    parameters = run.controller.parameters
    fit = fit_predictor(parameters, *sampled)
    for name, values in fit.weights.items():
        np.testing.assert_array_equal(trained.learnt[f'predictive.{name}'], values)
    assert fit.duration > 38.0
    assert [fold.name for fold in trained.folds] == [f'block {i}' for i in range(1, 6)]
    assert sum(fold.judged for fold in trained.folds) > 30.0
    for fold in trained.folds:
        assert fold.skills['fitted'].min() > 0.3
        assert np.all(fold.skills['fitted'] > fold.skills['nominal loop'])
        assert np.all(fold.skills['fitted'] > fold.skills['random'])
        for value in (*fold.skills['fitted'].ravel(), *fold.skills['random'].ravel()):
            assert f'{value:.2f}' in trained.text
    assert np.mean([fold.explained for fold in trained.folds]) > 0.2
    assert f'predictor: fitted to {fit.duration:.1f} s' in trained.text


def test_the_skill_of_segments_pools_their_squared_errors(run, sampled):
    parameters = run.controller.parameters
    weights = Controller(parameters).law.predictive.get_weights()
    errors, moves = sampled[0][-300:-2].copy(), sampled[1][-300:-2].copy()
    errors[[100, 120]] = math.nan
    parts = stretches(errors, moves)
    known = np.isfinite(errors + moves).all(axis=1)
    assert sum(part[0][0].size for part in parts) <= np.count_nonzero(known)
    assert all(np.isfinite(run).all() for part in parts for pair in part for run in pair)
    assert min(part[0][0].size for part in parts) >= 40
    each = [skills(parameters.predictive, 0.05, weights, [part]) for part in parts]
    both = skills(parameters.predictive, 0.05, weights, parts)
    assert np.all(both >= np.min(each, axis=0))
    assert np.all(both <= np.max(each, axis=0))
    assert np.isnan(skills(parameters.predictive, 0.05, weights, [])).all()


def test_blocks_are_the_run_cut_to_pieces_of_their_own(replayed):
    replay, _, _ = replayed
    parts = blocks(replay, 3)
    assert [len(part) for part in parts] == [1334, 1333, 1333]
    assert all(part.begins[0] for part in parts)
    np.testing.assert_array_equal(np.concatenate([p.speeds for p in parts]), replay.speeds)
    assert np.flatnonzero(replay.begins).tolist() == [0]
    with pytest.raises(ValueError, match='folds must be at least 2: got 1'):
        blocks(replay, 1)


def test_the_effect_of_v_p_is_that_of_the_loop(run, sampled):
    """A lasting v_p leaves v_p over the slope of all that works against a small error."""
    parameters = run.controller.parameters
    law = parameters.law
    expected = 1.0 / (law.gain + parameters.compensated_bound / law.smoothing)
    for z in range(2):
        errors, moves = (np.ascontiguousarray(table[::-1, z]) for table in sampled)
        found = estimate_move_effect(errors, moves, 4, 4, 5)
        assert found.response == pytest.approx(expected, abs=3.0 * found.error)
        assert found.error < 0.25 * expected


def test_the_coefficients_are_the_friction(replayed):
    """What the servo feels of it, on speeds that were kept back."""
    replay, parameters, _ = replayed
    *others, kept_back = blocks(replay, 4)
    coefficients = fit_coefficients(parameters, TrainingData.joined(others))
    robot = PaperRobotParameters()
    inverse = np.linalg.inv(wheel_inertia(robot.body, robot.geometry))
    table = robot.friction
    felt = 0.02 / 0.01 * (1.0 - math.exp(-0.01 / 0.02))
    estimator = FuzzyEstimator(parameters.fuzzy, parameters.adaptation)
    estimator.coefficients = coefficients
    speeds = replay.speeds[3000::10]
    found = np.array([estimator.evaluate(chi) for chi in speeds])
    torque = [
        [friction_torque(w, table.viscous, table.coulomb, table.coulomb_width) for w in chi]
        for chi in speeds
    ]
    true = -felt * np.array(torque) @ inverse.T
    share = 1.0 - np.mean((found - true) ** 2, axis=0) / np.var(true, axis=0)
    assert share.min() > 0.7
    # Of the acceleration itself it is less: disturbance and noise are no function of chi.
    shares = explained(parameters, coefficients, kept_back)
    assert 0.15 < shares.min() < shares.max() < 0.7
    nothing = explained(parameters, np.zeros_like(coefficients), replay)
    assert np.all(np.abs(nothing) < 0.15)


@pytest.mark.long
def test_several_bags_train_together_and_each_is_a_fold(bag, replayed, tmp_path):
    other = TrainingRun(4, 14.0, **{'predictive.dither': 3.0}).tape.write(tmp_path / 'other')
    both = fit_bags([bag, other])
    assert 'from 2 bags' in both.text
    assert len(both.folds) == 2
    data = [replayed[0], load_training_data(other)[0]]
    parameters = both.parameters
    sampled = [periods(each, parameters.predictive, parameters.rate) for each in data]
    first = fit_predictor(parameters, *sampled[0])
    found = skills(parameters.predictive, 0.05, first.weights, stretches(*sampled[1]))
    np.testing.assert_array_equal(both.folds[1].skills['fitted'], found)
    share = explained(parameters, fit_coefficients(parameters, data[0]), data[1])
    np.testing.assert_array_equal(both.folds[1].explained, share)
    assert found.min() > 0.3
    joined = TrainingData.joined(data)
    assert np.flatnonzero(joined.begins).tolist() == [0, 4000]
    fit = fit_predictor(parameters, *periods(joined, parameters.predictive, parameters.rate))
    assert np.max(fit.uncertainty) < 0.3
    np.testing.assert_array_equal(
        both.learnt['predictive.output_weights'], fit.weights['output_weights']
    )
    with pytest.raises(TrainingError, match='two have the same content'):
        fit_bags([bag, bag])  # before anything is fitted


def test_the_effect_is_found_within_its_standard_error():
    """delta_t = 0.6 delta_(t-1) + 0.03 v_(t-1) + w: 5 steps on it is 0.03 (1 - 0.6^5)/0.4."""
    rng = np.random.default_rng(4)
    true = 0.03 * (1.0 - 0.6**5) / 0.4
    misses, claimed = [], {400: [], 1600: []}
    for count in claimed:
        for _ in range(15):
            moves, errors = rng.uniform(-4.0, 4.0, count), np.zeros(count)
            for t in range(1, count):
                errors[t] = 0.6 * errors[t - 1] + 0.03 * moves[t - 1] + 0.05 * rng.normal()
            errors[count // 2] = math.nan
            found = estimate_move_effect(errors[::-1], moves[::-1], 4, 4, 5)
            misses.append((found.response - true) / found.error)
            claimed[count].append(found.error)
            assert found.own == pytest.approx(4.0 / math.sqrt(3.0), rel=0.1)
    assert np.std(misses) == pytest.approx(1.0, abs=0.3)
    assert np.mean(claimed[400]) == pytest.approx(2.0 * np.mean(claimed[1600]), rel=0.15)


def test_feedback_alone_does_not_show_the_effect():
    rng = np.random.default_rng(5)
    errors = rng.normal(size=500)
    assert estimate_move_effect(errors, -2.0 * errors, 4, 4, 5).error == math.inf
    assert estimate_move_effect(errors, np.zeros(500), 4, 4, 5).own == 0.0
    assert estimate_move_effect(errors[:12], errors[:12], 4, 4, 5).error == math.inf


# -- what cannot be learnt ----------------------------------------------------------------------


@pytest.mark.long
def test_the_coefficients_can_be_learnt_without_the_predictor(calm):
    kept = fit_bags([calm], keep_predictor=True)
    learnt = kept.learnt
    assert 'pre-trained on the nominal loop, unchanged' in kept.text
    assert 'skill,' not in kept.text
    assert 'skill' not in kept.origin['cross_validation']
    law = Controller(kept.parameters).law
    for name, values in law.get_weights().items():
        if name != 'fuzzy.coefficients':
            np.testing.assert_array_equal(learnt[name], values)
    assert np.abs(learnt['fuzzy.coefficients']).max() > 1.0
    law.set_weights(learnt)


def before(second, *without):
    return lambda tape: tape.where(lambda t, topic, i: t < second and topic not in without)


def of_another_controller(tape):
    """Its commands do not come out of the replay: another version, or other parameters."""
    return before(15.0, '/controller/parameters')(tape).changed(**{'law.gain': '20.0'})


@pytest.mark.parametrize(
    ('change', 'keep_predictor', 'complaint'),
    [
        (before(0.5, '/reference'), False, 'not in the bag: reference'),
        (before(0.5, '/odom'), False, 'not in the bag: odom'),
        (before(0.5, '/controller/journal'), False, 'no journal of the controller'),
        (
            before(12.0),
            False,
            r'without block 1 .* 10 s of motion: got 7\.\d s; record .* another bag',
        ),
        (before(3.0), True, r'at least 10 s of motion: got 2\.\d s'),
        (of_another_controller, False, 'of 1500 commands come out of the replay'),
    ],
)
def test_what_cannot_be_learnt_from_is_refused(change, keep_predictor, complaint, run, tmp_path):
    folder = change(run.tape).write(tmp_path / 'bag')
    with pytest.raises(TrainingError, match=complaint):
        fit_bags([folder], keep_predictor=keep_predictor)


def test_bags_that_do_not_belong_together_are_refused(calm, tmp_path):
    def bag_of(**parameters):
        return TrainingRun(3, 2.0, **parameters).tape.write(tmp_path / f'{parameters}')

    other = bag_of(**{'adaptation.radius': 30.0, 'predictive.dither': 1.0})
    with pytest.raises(TrainingError, match=r'differ in adaptation\.radius \(40\.0, 30\.0\)$'):
        fit_bags([calm, other])
    with pytest.raises(TrainingError, match='composition must be paper: got body'):
        fit_bags([bag_of(composition='body', **{'law.gain': 39.0})])
    with pytest.raises(TrainingError, match=r'moved by 0\.0\d+ rad/s².*predictive\.dither'):
        fit_bags([calm])  # too little of it
    with pytest.raises(TrainingError, match='at least one bag'):
        fit_bags([])
    with pytest.raises(BagError, match='there is no bag'):
        fit_bags([tmp_path / 'nowhere'])


def test_a_bag_whose_parameters_changed_is_named_once():
    """It was *changes.mcap and changes.mcap must have the same parameters*."""
    golden = ROOT / 'test' / 'golden' / 'changes.mcap'
    words = f'{golden} must have the same parameters throughout; during the run changed law.gain'
    with pytest.raises(TrainingError, match=f'^{words}'):
        fit_bags([golden])


# -- the pieces it rests on ---------------------------------------------------------------------


def _drive(kind='velocity'):
    estimate = SpeedFilterParameters(noise_variance=0.04)
    limits = LimitParameters(deadband=0.0)  # a command tells the acceleration
    return VelocityActuation(estimate, limits, GEOMETRY, kind, 0.01)


def test_a_drive_with_a_set_command_goes_on_as_its_sender():
    rng = np.random.default_rng(6)
    sender, other = _drive(), _drive()
    for _ in range(200):
        measured = rng.normal(size=2)
        for drive in (sender, other):
            drive.observe(measured, 0.01)
        np.testing.assert_allclose(other.predicted, sender.predicted, atol=1e-12)
        u = rng.uniform(-40.0, 40.0, 2)
        applied = sender.send_acceleration(u).copy()
        other.send_acceleration(rng.uniform(-40.0, 40.0, 2))
        other.set_command(sender.command)
        np.testing.assert_allclose(other.applied, applied, atol=1e-9)
        np.testing.assert_array_equal(other.command, sender.command)
        assert not other.limited


def test_a_set_command_is_two_finite_wheel_speeds():
    drive = _drive()
    before = drive.command.copy()
    for wrong in (np.array([1.0, math.nan]), np.ones(3)):
        with pytest.raises(ValueError, match='two finite numbers'):
            drive.set_command(wrong)
    np.testing.assert_array_equal(drive.command, before)
    with pytest.raises(ValueError, match='velocity drive'):
        _drive('torque').set_command(np.zeros(2))


def test_runs_with_a_gap_between_them_are_learnt_as_two_runs():
    """X_o is the ridge regression on the instants of both whose lags are all known."""
    rng = np.random.default_rng(7)
    runs = [(rng.normal(size=n), rng.normal(size=n)) for n in (60, 45)]
    how = ExcitationParameters(epochs=0)

    def machine():
        return make_machine(LayerSizes(4, 4, 12), 3.0, 20.0, 1.0, np.random.default_rng(8))

    features, targets = [], []
    for errors, moves in runs:
        seen = machine()
        for i in range(errors.size - 4):
            set_visible(seen, errors, moves, i + 1)
            predict_error(seen)
            features.append(seen.mu1.copy())
            targets.append(errors[i] / 3.0)
    joined = [np.concatenate([a, [math.nan], b]) for a, b in zip(*runs, strict=True)]
    pretrained = machine()
    pretrain(pretrained, make_rls_state(12), *joined, how, 20.0, 0.05)
    expected = ridge_regression(np.array(features), np.array(targets), how.ridge)
    np.testing.assert_allclose(pretrained.output_weights, expected, rtol=1e-9)
    with pytest.raises(ValueError, match='got inf'):
        pretrain(machine(), make_rls_state(12), joined[0], np.full(106, np.inf), how, 20.0, 0.05)


def _stepped(**changes):
    term = PredictiveController(PredictiveParameters().with_values(changes), 0.01, 39.3)
    errors = 0.3 * np.random.default_rng(9).normal(size=(600, 2))
    return np.array([term.step(error) for error in errors]), term.parameters


def test_dither_moves_v_p_by_itself_and_keeps_its_bound():
    calm, _ = _stepped()
    again, _ = _stepped(dither=0.0)
    np.testing.assert_array_equal(calm, again)
    moved, parameters = _stepped(dither=5.0)
    twice, _ = _stepped(dither=5.0)
    np.testing.assert_array_equal(moved, twice)
    assert np.abs(moved).max() <= parameters.v_max
    assert np.all(np.diff(moved, axis=0)[np.arange(599) % 5 != 4] == 0.0)
    levels = np.diff(moved[::5], axis=0)
    assert np.std(levels) == pytest.approx(5.0 * math.sqrt(2.0 / 3.0), rel=0.15)
    assert abs(np.corrcoef(moved[::5].T)[0, 1]) < 0.3
    np.testing.assert_array_equal(_stepped(dither=5.0, enabled=False)[0], 0.0)
    with pytest.raises(ParameterError, match='dither must be'):
        PredictiveParameters(dither=-1.0)


# -- simulated runs, and the command line -------------------------------------------------------


def test_training_on_the_command_line(tmp_path, monkeypatch, capsys):
    path = tmp_path / 'model.npz'
    # Runs of 12 s are enough to show that the model makes the first seconds better.
    monkeypatch.setattr(train_models, 'Scenario', lambda *a: Scenario(*a[:3], 12.0, noise=a[4]))
    assert main(['train', '--robot', 'servo', '--seeds', '101-102', '--output', str(path)]) == 0
    said = capsys.readouterr().out
    loaded = load_model(path)
    # The model of the package is the one that the command makes, with its origin inside.
    packaged = find_model('servo')
    header, made = read_model(packaged)[0], read_model(path)[0]
    # Its parameters include former ones, at the values that they always have now.
    former = ProposedParameters.class_constants()
    made['parameters'] |= {k: v for k, v in former.items() if k in header['parameters']}
    # What is newer than the packaged file has its default.
    defaults = ProposedParameters().to_dict()
    newer = made['parameters'].keys() - header['parameters']
    header['parameters'] |= {name: defaults[name] for name in newer}
    assert (header.pop('version'), made.pop('version')) == ('0.2.0', VERSION)
    assert header == made
    assert set(load_model(packaged)) == set(loaded)
    for name, values in load_model(packaged).items():
        np.testing.assert_allclose(values, loaded[name], rtol=1e-6, atol=1e-9, err_msg=name)
    Controller(ControllerParameters()).set_weights(loaded)
    assert f'seeds {", ".join(map(str, PRETRAINING_SEEDS))}' in said
    assert f'seeds {HELD_OUT_SEEDS[0]} to {HELD_OUT_SEEDS[1]}' in said
    assert f'saved {path}' in said
    gain = re.search(r'\| difference \| ([-+.\d]+)', said).group(1)
    assert float(gain) < 0.0
    assert not {*HELD_OUT_SEEDS} & {*PRETRAINING_SEEDS}


@pytest.mark.parametrize(
    'arguments, complaint',
    [
        (['--keep-predictor'], 'is for bags'),
        (['bag', '--robot', 'torque'], 'robot must be servo for bags'),
        (['nowhere'], 'there is no bag'),
    ],
    ids=str,
)
def test_what_cannot_be_done_is_said_and_nothing_is_written(
    arguments, complaint, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main(['train', *arguments]) == 1
    assert complaint in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_model_that_cannot_be_written_is_an_error(calm, tmp_path, capsys):
    path = tmp_path / 'none' / 'model.npz'
    assert main(['train', str(calm), '--keep-predictor', '--output', str(path)]) == 1
    assert f'{path} cannot be written' in capsys.readouterr().err


def test_a_model_of_another_format_is_refused_by_name(learnt, tmp_path, monkeypatch):
    path = tmp_path / 'old.npz'
    monkeypatch.setattr(model_file, 'FORMAT', model_file.FORMAT + 1)
    save_model(path, learnt, {})
    monkeypatch.undo()
    with pytest.raises(ModelError, match=rf'{path} has model format 2, this is format 1'):
        load_model(path)
    (tmp_path / 'text.npz').write_text('no model')
    with pytest.raises(ModelError, match='text.npz is not a model file'):
        load_model(tmp_path / 'text.npz')


def test_a_model_for_other_shapes_is_refused_when_it_is_loaded(learnt):
    other = ControllerParameters.from_dict({'fuzzy.sets': 5})
    with pytest.raises(ValueError, match='must have shape'):
        Controller(other).law.set_weights(learnt)
