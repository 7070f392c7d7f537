# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Models fitted to bags and to simulated runs: the run is rebuilt exactly."""

from dataclasses import replace
import math

import numpy as np
import pytest
from support.training_runs import GEOMETRY, STORE, ClosedLoopObjective, Tape

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.run import model_file
from t3mpc_ros.bag.run.model_file import (
    ModelError,
    find_model,
    load_model,
    read_model_header,
    save_model,
)
from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.cli.main import main
from t3mpc_ros.control.actuation import LimitParameters, VelocityActuation
from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.control.speed_filter import SpeedFilterParameters
from t3mpc_ros.evaluation.process_replay.journal_alignment import match_commands
from t3mpc_ros.evaluation.record import RATE
from t3mpc_ros.evaluation.scenario import HELD_OUT_SEEDS, PRETRAINING_SEEDS
from t3mpc_ros.evaluation.training.fit import (
    UNCERTAIN,
    estimate_move_effect,
    explained,
    feedback_slope,
    fit_coefficients,
    fit_predictor,
    periods,
    skills,
    stretches,
)
from t3mpc_ros.evaluation.training.recorded_runs import blocks, fit_bags
from t3mpc_ros.evaluation.training.simulated_runs import (
    fit_simulated_runs,
    full_parameters,
    held_out_seeds,
)
from t3mpc_ros.evaluation.training.training_data import (
    NEEDED,
    TrainingData,
    TrainingError,
    load_training_data,
)
from t3mpc_ros.fuzzy.estimator import FuzzyEstimator
from t3mpc_ros.mpc.boltzmann_machine import (
    LayerSizes,
    make_machine,
    make_rls_state,
    predict_error,
    set_visible,
)
from t3mpc_ros.mpc.predictive_controller import PredictiveController, PredictiveParameters
from t3mpc_ros.mpc.pretraining import ExcitationParameters, pretrain, ridge_regression, split_runs
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.simulation.plant.disturbances import friction_torque
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

pytestmark = pytest.mark.slow

# -- runs and their bags ----------------------------------------------------------------------


@pytest.fixture(scope='module')
def run():
    return ClosedLoopObjective(3, 40.0, tape=True, **{'predictive.dither': 4.0})


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
def calm(tmp_path_factory):
    """Return the bag of an ordinary run, in which nothing but feedback moves v_p."""
    return ClosedLoopObjective(5, 16.0, tape=True).tape.write(
        tmp_path_factory.mktemp('calm') / 'bag'
    )


# -- rebuilding ---------------------------------------------------------------------------------


def test_the_replay_is_the_run(run, replayed):
    replay, parameters, notes = replayed
    assert notes == []
    assert parameters == run.controller.parameters
    assert len(replay) == len(run.statuses)
    np.testing.assert_allclose(replay.errors, run.errors, atol=1e-9)
    np.testing.assert_allclose(replay.speeds, run.estimates, atol=1e-9)
    np.testing.assert_allclose(replay.unexplained, run.unexplained, atol=1e-7)
    published = np.flatnonzero(np.isfinite(replay.moves[:, 0]))
    np.testing.assert_array_equal(published, np.arange(4, 4000, 5))
    np.testing.assert_array_equal(replay.moves[published], run.terms[published, 4])
    limited = [status.limited for status in run.statuses]
    assert np.mean(replay.limited == limited) > 0.999
    assert np.flatnonzero(replay.begins).tolist() == [0]


def test_periods_are_sampled_as_the_machine_samples_them(run, sampled):
    """Errors as means of five, v_p as held from then on: whatever the step of publishing."""
    errors, moves = sampled
    inner = np.flatnonzero(np.isfinite(errors[:, 0]))
    np.testing.assert_array_equal(np.diff(inner), 1)
    last = 3995
    for back, row in enumerate(inner[::-1]):
        step = last - 5 * back
        np.testing.assert_allclose(errors[row], run.errors[step - 4 : step + 1].mean(axis=0))
        if np.isfinite(moves[row]).all():
            np.testing.assert_array_equal(moves[row], run.terms[step, 4])
    assert inner.size > 790
    # v_p is not what acted where limits cut u for most of a period, at switches.
    cut = [np.mean([s.limited for s in run.statuses[k : k + 5]]) > 0.5 for k in range(0, 4000, 5)]
    assert np.count_nonzero(np.isnan(moves[inner, 0])) <= np.count_nonzero(cut) + 5


def test_a_recording_may_begin_in_mid_run(run, sampled, tmp_path):
    """Which step v_p changes at is then seen in u alone."""
    late = run.tape.where(lambda t, topic, i: 7.033 < t < 22.0).write(tmp_path / 'bag')
    replay, parameters, _ = load_training_data(late)
    errors, moves = periods(replay, parameters.predictive, parameters.rate)
    errors, moves = errors[-202:-2], moves[-202:-2]
    first = int(np.flatnonzero(np.isfinite(moves[:, 0]))[0])
    start = int(np.nanargmin(np.abs(sampled[1][:, 0] - moves[first, 0]))) - first
    np.testing.assert_allclose(errors, sampled[0][start : start + 200], atol=1e-3)
    np.testing.assert_array_equal(moves, sampled[1][start : start + 200])


def test_what_is_lost_leaves_gaps_and_spoils_nothing_else(run, sampled, tmp_path):
    def keep(t, topic, i):
        if topic.startswith('/controller'):
            return i % 40 != 7
        return not (topic == '/cmd_vel' and i % 301 == 150) and t < 20.0

    replay, parameters, notes = load_training_data(run.tape.where(keep).write(tmp_path / 'bag'))
    assert any('have no cmd_vel after them' in note for note in notes)
    errors, moves = periods(replay, parameters.predictive, parameters.rate)
    whole = {tuple(move): error for error, move in zip(*sampled, strict=True)}
    known = np.flatnonzero(np.isfinite(errors + moves).all(axis=1))
    assert 330 < known.size < 392
    found = np.array([whole[tuple(moves[row])] for row in known])
    missed = np.abs(found - errors[known]).max(axis=1)
    assert np.percentile(missed, 95) < 1e-6
    assert missed.max() < 0.02
    # No two runs were joined: neighbours in the table were neighbours in time.
    order = {tuple(move): i for i, move in enumerate(sampled[1])}
    places = np.array([order[tuple(moves[row])] for row in known])
    np.testing.assert_array_equal(np.diff(places)[np.diff(known) == 1], 1)


def test_a_stretch_in_which_the_robot_was_stopped_is_left_out(tmp_path):
    stopped = ClosedLoopObjective(3, 14.0, tape=True, off=(600, 803), **{'predictive.dither': 4.0})
    replay, parameters, _ = load_training_data(stopped.tape.write(tmp_path / 'bag'))
    errors, moves = periods(replay, parameters.predictive, parameters.rate)
    known = np.isfinite(errors + moves).all(axis=1)
    held = {tuple(status.terms[4]) for status in stopped.statuses if status.reason.moves}
    assert all(tuple(move) in held for move in moves[known])
    samples = {
        tuple(stopped.terms[step, 4]): stopped.errors[step - 4 : step + 1].mean(axis=0)
        for part in (range(5, 600, 5), range(808, 1400, 5))
        for step in part
    }
    assert np.count_nonzero(known) > 200
    missed = [np.abs(samples[tuple(moves[k])] - errors[k]).max() for k in np.flatnonzero(known)]
    assert np.percentile(missed, 90) < 1e-6


def test_jumps_that_the_law_is_told_of_are_no_errors(tmp_path):
    """Left to the program, a switch makes the error jump; the machine does not see that part."""
    jumping = ClosedLoopObjective(3, 14.0, tape=True, **{'jump_transition.method': 'predictive'})
    replay, _, _ = load_training_data(jumping.tape.write(tmp_path / 'bag'))
    part = slice(1150, 1400)
    assert np.abs(jumping.errors[part]).max() > 1.0
    assert np.abs(replay.errors[part]).max() < 0.5 * np.abs(jumping.errors[part]).max()
    quiet = slice(300, 1150)
    np.testing.assert_allclose(replay.errors[quiet], jumping.errors[quiet], atol=1e-3)


def test_each_command_matches_its_message_for_any_receive_order():
    rng = np.random.default_rng(1)
    asked = 0.01 * np.arange(3000)
    given = asked + rng.exponential(0.004, asked.size)  # now and then behind the next message
    given[::50] -= 0.006  # or even heard before its own
    order = np.argsort(given)
    np.testing.assert_array_equal(match_commands(asked, given[order]), np.arange(3000))
    lost = np.delete(np.arange(3000), [500, 1300, 1301, 2200])
    found = match_commands(asked, np.sort(given[lost]))
    assert np.mean(found == lost) > 0.99
    late = match_commands(asked, given[order][700:])  # the first commands are not in the bag
    np.testing.assert_array_equal(late, np.arange(700, 3000))
    # When messages stop, the watchdog says stop: that answers none.
    silent = match_commands(asked[:500], np.append(given[:500], [5.3, 5.35, 5.4]))
    assert silent[-3:].tolist() == [-1, -1, -1]


# -- what is learnt -----------------------------------------------------------------------------


def predictor_of(learnt):
    prefix = 'predictive.'
    return {k.removeprefix(prefix): v for k, v in learnt.items() if k.startswith(prefix)}


def test_a_predictor_from_a_bag_is_as_good_as_from_simulation(run, sampled):
    """On the quarter that it has not seen; the training data are 120 s of three other runs."""
    parameters = run.controller.parameters
    errors, moves = sampled
    cut = 3 * len(errors) // 4
    unseen = stretches(errors[cut:], moves[cut:])
    fit = fit_predictor(parameters, errors[:cut], moves[:cut])
    assert 28.0 < fit.duration <= 30.0
    own, pretrained, nominal = (
        skills(parameters.predictive, 0.05, weights, unseen)
        for weights in (
            fit.weights,
            predictor_of(fit_simulated_runs('velocity')[0]),
            Controller(parameters).law.predictive.get_weights(),
        )
    )
    assert own.min() > 0.5
    assert np.all(own > 0.9 * pretrained)
    assert np.all(own > nominal)


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
    assert [len(part) for part in parts] == [1333, 1334, 1333]
    assert all(part.begins[0] for part in parts)
    np.testing.assert_array_equal(np.concatenate([p.speeds for p in parts]), replay.speeds)
    assert np.flatnonzero(replay.begins).tolist() == [0]
    with pytest.raises(ValueError, match='folds must be at least 2: got 1'):
        blocks(replay, 1)


def test_the_effect_of_v_p_is_that_of_the_loop(run, sampled):
    """A lasting v_p leaves v_p over the slope of all that works against a small error."""
    expected = 1.0 / feedback_slope(run.controller.parameters)
    for z in range(2):
        errors, moves = (np.ascontiguousarray(table[::-1, z]) for table in sampled)
        found = estimate_move_effect(errors, moves, 4, 4, 5)
        assert found.response == pytest.approx(expected, abs=3.0 * found.error)
        assert found.error < 0.25 * expected


def test_the_coefficients_are_the_friction(replayed):
    """What the servo feels of it, on speeds that were kept back."""
    replay, parameters, _ = replayed
    *taught, kept_back = blocks(replay, 4)
    coefficients = fit_coefficients(parameters, TrainingData.joined(taught))
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


def test_the_model_improves_the_first_seconds(trained, tmp_path):
    save_model(tmp_path / 'm.npz', trained.learnt, trained.parameters.to_dict())
    loaded = load_model(tmp_path / 'm.npz')
    for seed in (103, 104):
        fresh, taught = (
            ClosedLoopObjective(seed, 6.0),
            ClosedLoopObjective(seed, 6.0, learnt=loaded),
        )
        assert taught.rmse(6.0) < 0.85 * fresh.rmse(6.0)
    assert np.all(taught.statuses[0].skill > 0.0)


def test_equal_bags_give_equal_models(bag, trained):
    again = fit_bags([bag])
    assert (again.parameters, again.text, again.origin) == (
        trained.parameters,
        trained.text,
        trained.origin,
    )
    assert set(again.learnt) == set(trained.learnt)
    for name, values in again.learnt.items():
        np.testing.assert_array_equal(values, trained.learnt[name])


def test_several_bags_teach_together_and_each_is_a_fold(run, tmp_path):
    halves = [
        run.tape.where(lambda t, topic, i, a=a: a <= t < a + 20.0).write(tmp_path / f'bag{a:g}')
        for a in (0.0, 20.0)
    ]
    both = fit_bags(halves)
    assert 'from 2 bags' in both.text
    assert [fold.name for fold in both.folds] == ['bag0', 'bag20']
    replays = [load_training_data(half)[0] for half in halves]
    parameters = both.parameters
    sampled = [periods(replay, parameters.predictive, parameters.rate) for replay in replays]
    first = fit_predictor(parameters, *sampled[0])
    found = skills(parameters.predictive, 0.05, first.weights, stretches(*sampled[1]))
    np.testing.assert_array_equal(both.folds[1].skills['fitted'], found)
    share = explained(parameters, fit_coefficients(parameters, replays[0]), replays[1])
    np.testing.assert_array_equal(both.folds[1].explained, share)
    assert found.min() > 0.4
    replay = TrainingData.joined(replays)
    assert np.flatnonzero(replay.begins).tolist() == [0, 2000]
    fit = fit_predictor(parameters, *periods(replay, parameters.predictive, parameters.rate))
    assert np.max(fit.uncertainty) < 0.3
    np.testing.assert_array_equal(
        both.learnt['predictive.output_weights'], fit.weights['output_weights']
    )
    with pytest.raises(TrainingError, match='two have the same content'):
        fit_bags([halves[0], halves[0]])  # before anything is fitted


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


def test_too_little_movement_of_v_p_is_refused_with_its_size(calm):
    with pytest.raises(TrainingError, match=r'moved by 0\.0\d+ rad/s².*predictive\.dither'):
        fit_bags([calm])


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


@pytest.mark.parametrize('gone', NEEDED)
def test_missing_topics_are_named(run, tmp_path, gone):
    folder = run.tape.where(lambda t, topic, i: t < 0.5 and topic != f'/{gone}').write(
        tmp_path / 'bag'
    )
    with pytest.raises(TrainingError, match=f'missing, or have no message: {gone}'):
        load_training_data(folder)


def test_all_missing_topics_are_named_at_once(run, tmp_path):
    folder = run.tape.where(lambda t, topic, i: t < 0.5 and topic == '/odom').write(
        tmp_path / 'bag'
    )
    with pytest.raises(TrainingError) as caught:
        load_training_data(folder)
    assert all((name in str(caught.value)) == (name != 'odom') for name in NEEDED)


def test_too_short_a_run_is_refused_with_its_length(run, tmp_path):
    folder = run.tape.where(lambda t, topic, i: t < 12.0).write(tmp_path / 'bag')
    with pytest.raises(
        TrainingError, match=r'without block 1 to learn from: .* 10 s of motion: got 7\.\d s'
    ):
        fit_bags([folder])
    shorter = run.tape.where(lambda t, topic, i: t < 3.0).write(tmp_path / 'short')
    with pytest.raises(TrainingError, match=r'at least 10 s of motion: got 2\.\d s'):
        fit_bags([shorter], keep_predictor=True)


def test_v_p_that_is_published_too_seldom_is_refused(run, tmp_path):
    folder = run.tape.where(
        lambda t, topic, i: t < 15.0 and not (topic.startswith('/controller') and i % 2)
    ).write(tmp_path / 'bag')
    with pytest.raises(TrainingError, match='terms_rate to 20 Hz'):
        fit_bags([folder])


def nan_tape(tape, topic, share, seed=1):
    """Return the tape with a share of the messages of a topic not a number."""
    rng = np.random.default_rng(seed)
    rows = []
    for received_ns, name, kind, data in tape.rows:
        if name == topic and rng.random() < share:
            message = STORE.deserialize_cdr(data, kind)
            if kind.endswith('Odometry'):
                message.twist.twist.linear.x = math.nan
            elif kind.endswith('Twist'):
                message.linear.x = math.nan
            else:
                message.data = math.nan
            data = bytes(STORE.serialize_cdr(message, kind))
        rows.append((received_ns, name, kind, data))
    return Tape(tape.metadata_records, rows)


@pytest.mark.parametrize(
    'topic', ['/odom', '/reference', '/cmd_vel', '/controller/terms/feedback/left']
)
def test_nothing_but_nan_is_an_error(run, tmp_path, topic):
    short = run.tape.where(lambda t, name, i: t < 1.0)
    folder = nan_tape(short, topic, 1.1).write(tmp_path / 'bag')
    with pytest.raises(TrainingError, match='finite'):
        load_training_data(folder)


def test_a_few_nan_leave_gaps_and_are_told(run, tmp_path):
    tape = run.tape.where(lambda t, name, i: t < 20.0)
    for topic in ('/cmd_vel', '/controller/terms/predictive/right'):
        tape = nan_tape(tape, topic, 0.01)
    model = fit_bags([tape.write(tmp_path / 'bag')])
    assert 'messages of /cmd_vel are not finite' in model.text
    assert all(np.isfinite(values).all() for values in model.learnt.values())


@pytest.mark.parametrize(
    'parameters, complaint',
    [
        ({'law.gain': '20.0'}, 'other settings'),
        ({'speed_filter.noise_variance': '1.0'}, 'other settings'),
        ({'law.gain': 'much'}, "law.gain must be a number: got 'much'"),
        ({'predictive.decimation': '0'}, 'predictive.decimation must be'),
        ({'predictive.horizon': 'None'}, 'predictive.horizon must be a whole number'),
    ],
    ids=str,
)
def test_wrong_settings_are_refused(run, tmp_path, parameters, complaint):
    tape = run.tape.where(lambda t, topic, i: t < 4.0).changed(**parameters)
    with pytest.raises(TrainingError, match=complaint):
        load_training_data(tape.write(tmp_path / 'bag'))


def test_settings_that_are_not_in_the_bag(run, tmp_path):
    tape = run.tape.where(lambda t, topic, i: t < 4.0)
    _, parameters, notes = load_training_data(
        tape.changed(integral_transfer=None).write(tmp_path / 'one')
    )
    assert parameters.integral_transfer == ControllerParameters().integral_transfer
    assert any('taken at their defaults: integral_transfer' in note for note in notes)
    with pytest.raises(TrainingError, match='settings are not in the bag'):
        load_training_data(Tape({}, tape.rows).write(tmp_path / 'none'))


def test_bags_made_under_different_settings_are_not_mixed(run, calm, tmp_path):
    tape = run.tape.where(lambda t, topic, i: t < 4.0)
    one = tape.write(tmp_path / 'one')
    other = tape.changed(**{'adaptation.radius': '30.0', 'predictive.dither': '1.0'})
    with pytest.raises(TrainingError, match=r'differ in adaptation\.radius \(40\.0, 30\.0\)$'):
        fit_bags([one, other.write(tmp_path / 'other')])
    with pytest.raises(TrainingError, match='at least one bag'):
        fit_bags([])
    with pytest.raises(BagError, match='there is no bag'):
        fit_bags([tmp_path / 'nowhere'])


def test_a_bag_without_learning_of_the_wheels_is_refused(run, tmp_path):
    bag = run.tape.changed(composition='body').write(tmp_path / 'bag')
    with pytest.raises(TrainingError, match='composition must be paper: got body'):
        fit_bags([bag])


# -- the pieces it rests on ---------------------------------------------------------------------


def _drive(kind='velocity'):
    estimate = SpeedFilterParameters(noise_variance=0.04)
    return VelocityActuation(estimate, LimitParameters(), GEOMETRY, kind, 0.01)


def test_a_drive_that_is_told_goes_on_as_the_one_that_sent():
    rng = np.random.default_rng(6)
    sender, told = _drive(), _drive()
    for _ in range(200):
        measured = rng.normal(size=2)
        for drive in (sender, told):
            drive.observe(measured, 0.01)
        np.testing.assert_allclose(told.predicted, sender.predicted, atol=1e-12)
        u = rng.uniform(-40.0, 40.0, 2)
        applied = sender.send_acceleration(u).copy()
        told.send_acceleration(rng.uniform(-40.0, 40.0, 2))
        told.set_command(sender.command)
        np.testing.assert_allclose(told.applied, applied, atol=1e-9)
        np.testing.assert_array_equal(told.command, sender.command)
        assert not told.limited


def test_a_drive_is_told_two_finite_wheel_speeds_or_nothing():
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
    taught = machine()
    pretrain(taught, make_rls_state(12), *joined, how, 20.0, 0.05)
    expected = ridge_regression(np.array(features), np.array(targets), how.ridge)
    np.testing.assert_allclose(taught.output_weights, expected, rtol=1e-9)
    with pytest.raises(ValueError, match='got inf'):
        pretrain(machine(), make_rls_state(12), joined[0], np.full(106, np.inf), how, 20.0, 0.05)


def test_the_trial_is_the_longest_gapless_part_at_the_end():
    errors = np.arange(80.0).reshape(40, 2)
    errors[[3, 33, 38]] = math.nan
    moves = -np.arange(80.0).reshape(40, 2)
    taught, trial = split_runs(errors, moves, 2)[0]
    np.testing.assert_array_equal(trial[0], errors[34:38, 0][::-1])
    np.testing.assert_array_equal(trial[1], moves[34:38, 0][::-1])
    assert taught[0].size == 30


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


def test_training_on_the_command_line(tmp_path, capsys):
    path = tmp_path / 'model.npz'
    assert main(['train', '--robot', 'servo', '--seeds', '2', '--output', str(path)]) == 0
    said = capsys.readouterr().out
    pretrained, parameters = fit_simulated_runs('velocity')
    loaded = load_model(path)
    assert set(loaded) == set(pretrained)
    for name, values in pretrained.items():
        np.testing.assert_array_equal(loaded[name], values)
    assert parameters == full_parameters('velocity')
    # The model of the package is the one that the command makes, with its origin inside.
    packaged = find_model('servo')
    assert read_model_header(packaged) == read_model_header(path)
    for name, values in load_model(packaged).items():
        np.testing.assert_allclose(values, loaded[name], rtol=1e-6, atol=1e-9, err_msg=name)
    Controller(ControllerParameters()).set_weights(loaded)
    for word in (
        f'seeds {", ".join(map(str, PRETRAINING_SEEDS))}',
        'next step',
        'without model',
        'with model',
        '±',
        f'on seeds {HELD_OUT_SEEDS[0]} to {HELD_OUT_SEEDS[1]}',
        f'saved {path}',
    ):
        assert word in said
    # The model makes the first seconds better.
    rows = {line[:15].strip(): line[15:].split() for line in said.splitlines()}
    assert float(rows['with model'][0]) < float(rows['without model'][0])
    assert float(rows['difference'][0]) < 0.0
    assert not set(held_out_seeds(20)) & set(PRETRAINING_SEEDS)


@pytest.mark.parametrize(
    'arguments, complaint',
    [
        (['--seeds', '21'], 'seeds must be from 1 to 20: got 21'),
        (['--seeds', '0'], 'seeds must be from 1 to 20: got 0'),
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
    assert f'cannot write the model file {path}' in capsys.readouterr().err


def test_a_model_of_another_format_is_refused_by_name(trained, tmp_path, monkeypatch):
    path = tmp_path / 'old.npz'
    monkeypatch.setattr(model_file, 'FORMAT', model_file.FORMAT + 1)
    save_model(path, trained.learnt, {})
    monkeypatch.undo()
    with pytest.raises(ModelError, match=rf'{path} has model format 2, this is format 1'):
        load_model(path)
    (tmp_path / 'text.npz').write_text('no model')
    with pytest.raises(ModelError, match='text.npz is not a model file'):
        load_model(tmp_path / 'text.npz')


def test_a_model_for_other_shapes_is_refused_when_it_is_loaded(trained):
    parameters = ControllerParameters()
    other = replace(parameters, predictive=replace(parameters.predictive, hidden=16))
    with pytest.raises(ValueError, match='must have shape'):
        Controller(other).law.set_weights(trained.learnt)


def test_the_bag_carries_the_settings_it_was_made_under(bag, run):
    with open_bag(bag) as recording:
        table = recording.metadata_records['controller']
    assert table['predictive.dither'] == '4.0'
    assert run.controller.parameters.rate == RATE
    assert UNCERTAIN < 1.0
