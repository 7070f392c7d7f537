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
"""Predictive controller in an independently implemented nominal loop, and its benefit."""

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm
from support.long_tests import few_of

from t3mpc_ros.mpc.predictive_controller import PredictiveController, PredictiveParameters
from t3mpc_ros.parameters.table import ParameterError

PERIOD, GAIN = 0.01, 8.0
DEFAULT = PredictiveParameters()


class Loop:
    """delta' = -K (delta + noise) + a + w, lag a' = v_p(t - dead time) - a, two wheels, exact."""

    def __init__(self, gain=GAIN, lag=0.02, delay_steps=1):
        rates = np.zeros((5, 5))
        rates[0] = (-gain, 1.0, 0.0, 1.0, -gain)
        rates[1] = (0.0, -1.0 / lag, 1.0 / lag, 0.0, 0.0)
        self._map = expm(rates * PERIOD)[:2]
        self._sent = [np.zeros(2)] * delay_steps
        self.state = np.zeros((2, 2))

    @property
    def error(self):
        return self.state[0].copy()

    def step(self, v_p, disturbance, noise):
        self._sent.append(np.array(v_p))
        inputs = np.vstack((self.state, self._sent.pop(0), disturbance, noise))
        self.state = self._map @ inputs


def _levels(count, seed, size=6.0, hold=1.0):
    """Return piecewise constant disturbances (rad/s²), uniform in ±size, for two wheels."""
    generator = np.random.default_rng(seed)
    out = np.zeros((count, 2))
    for z in range(2):
        level = 0.0
        for k in range(count):
            if generator.random() < PERIOD / hold:
                level = generator.uniform(-size, size)
            out[k, z] = level
    return out


def _waves(count):
    """Return slowly varying disturbances (rad/s²)."""
    t = PERIOD * np.arange(count)[:, None] + np.array([0.0, 3.0])
    return 4.0 * np.sin(2 * np.pi * 0.2 * t) + 2.0 * np.sin(2 * np.pi * 0.53 * t + 1.0)


def _run(controller, disturbance, noise=0.0, seed=7, **plant):
    """Return (true errors, v_p) of a closed loop, each of shape (N, 2)."""
    loop, count = Loop(**plant), len(disturbance)
    noises = noise * np.random.default_rng(seed).standard_normal((count, 2))
    errors, moves = np.zeros((count, 2)), np.zeros((count, 2))
    for k in range(count):
        errors[k] = loop.error
        if controller is not None:
            moves[k] = controller.step(loop.error + noises[k])
        loop.step(moves[k], disturbance[k], noises[k])
    return errors, moves


def _rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def _gain(disturbance, parameters=DEFAULT, noise=0.0, nominal_gain=GAIN, **plant):
    """Return RMSE with the controller over RMSE without it, from the first second on."""
    controller = PredictiveController(parameters, PERIOD, nominal_gain)
    on, _ = _run(controller, disturbance, noise, **plant)
    off, _ = _run(None, disturbance, noise, **plant)
    assert controller.solved.all()
    return _rms(on) / _rms(off)


@cache
def _weights():
    return PredictiveController(DEFAULT, PERIOD, GAIN).get_weights()


SLOW = DEFAULT.with_values({'decimation': 10, 'average': 10})


@pytest.mark.compiled
@pytest.mark.slow
@pytest.mark.parametrize(
    ('largest', 'changes'),
    few_of(
        [
            (0.40, {}),  # without pretraining v_p stays at 0.3 % of u, with a random step response
            (0.35, {'disturbance': _waves(3000)}),
            (0.55, {'noise': 0.2}),
            (0.45, {'parameters': SLOW, 'nominal_gain': 4.0, 'gain': 4.0}),
            (0.65, {'noise': 0.05, 'lag': 0.1, 'delay_steps': 3}),
            (0.65, {'noise': 0.05, 'gain': 5.0}),
            (0.65, {'noise': 0.05, 'lag': 0.05}),
            (0.65, {'noise': 0.05, 'delay_steps': 5}),
            (0.65, {'noise': 0.05, 'delay_steps': 10}),
            (0.65, {'noise': 0.05, 'gain': 12.0}),
        ],
        6,
    ),
)
def test_it_removes_most_of_a_disturbance(largest, changes):
    """Also of a robot other than the nominal one."""
    given = {'disturbance': _levels(3000, 1 if largest < 0.6 else 2)} | changes
    assert _gain(**given) < largest


@pytest.mark.compiled
@pytest.mark.slow
def test_with_noise_alone_it_costs_a_few_per_cent():
    """With only noise to predict, the effect of v_p must be negligible."""
    controller = PredictiveController(DEFAULT, PERIOD, GAIN)
    nothing = np.zeros((4000, 2))
    on, moves = _run(controller, nothing, 0.2)
    off, _ = _run(None, nothing, 0.2)
    assert _rms(on) < 1.10 * _rms(off)
    assert _rms(on[2000:]) < 1.03 * _rms(off[2000:])
    assert np.max(np.abs(moves)) < 0.2 * DEFAULT.v_max


@pytest.mark.compiled
def test_step_response_is_right_from_the_first_second():
    controller = PredictiveController(DEFAULT, PERIOD, GAIN)
    assert np.all(controller.skill > 0.8)  # on unseen data
    controller.step(np.zeros(2))
    loop, fine = Loop(), []
    for _ in range(50):
        loop.step(np.ones(2), np.zeros(2), np.zeros(2))
        fine.append(loop.error[0])
    true = np.mean(np.reshape(fine, (10, 5)), axis=1)
    assert np.all(controller.responses.steps > 0.0)
    np.testing.assert_allclose(controller.responses.steps[:, 4], true[4], rtol=0.2)
    np.testing.assert_allclose(controller.responses.steps[:, -1], true[9], rtol=0.25)


@pytest.mark.compiled
@pytest.mark.slow
def test_random_weights_get_no_authority():
    """With the skill half a horizon ahead alone, a third would get authority."""
    controller = PredictiveController(DEFAULT.with_values({'learning': False}), PERIOD, GAIN)
    disturbance = _levels(1000, 3)
    off, _ = _run(None, disturbance)
    figures = []
    for size in (0.03, 0.3, 3.0):
        for seed in range(2):
            generator = np.random.default_rng(seed)
            weights = dict(_weights())
            for name, spread in (('visible_weights', 0.3), ('output_weights', size)):
                weights[name] = spread * generator.standard_normal(weights[name].shape)
            controller.set_weights(weights)
            on, moves = _run(controller, disturbance)
            assert _rms(on) < 1.02 * _rms(off)
            figures.append(_rms(moves))
    assert np.median(figures) < 1e-3 * DEFAULT.v_max
    assert np.mean(np.array(figures) < 1e-2 * DEFAULT.v_max) > 0.9


@pytest.mark.compiled
def test_a_wrong_sign_of_v_p_gets_no_authority():
    """A decaying error is predictable without a model of v_p."""
    parameters = DEFAULT.with_values({'learning': False})
    controller = PredictiveController(parameters, PERIOD, GAIN)
    weights = {name: array.copy() for name, array in _weights().items()}
    lags = parameters.delta_lags
    square = np.einsum('zih,zjh->zij', weights['visible_weights'], weights['visible_weights'])
    # Reverse the sign of the response to v_p, in the linear range.
    for z in range(2):
        passed = weights['visible_weights'][z].T @ square[z] / 8.0
        linear = passed.T @ weights['output_weights'][z]
        linear[lags:] *= -1.0
        weights['output_weights'][z] = np.linalg.lstsq(passed.T, linear, rcond=None)[0]
    controller.set_weights(weights)
    _, moves = _run(controller, _levels(1000, 3))
    assert np.all(controller.responses.steps[:, 4] < 0.0)
    np.testing.assert_array_equal(controller.signals.authorities, 0.0)
    np.testing.assert_array_equal(moves, 0.0)


@pytest.mark.compiled
def test_a_steady_disturbance_leaves_no_steady_error():
    """Without learning, the offset e alone removes the error."""
    parameters = DEFAULT.with_values({'learning': False, 'offset_gain': 0.2})
    controller = PredictiveController(parameters, PERIOD, GAIN)
    errors, moves = _run(controller, np.full((2000, 2), 4.0))
    np.testing.assert_allclose(errors[-1], 0.0, atol=2e-3)
    np.testing.assert_allclose(moves[-1], -4.0, atol=0.02)


@pytest.mark.compiled
def test_v_p_keeps_its_bounds_for_any_errors():
    parameters = DEFAULT.with_values({'v_max': 3.0, 'dv_max': 0.8})
    controller = PredictiveController(parameters, PERIOD, GAIN)
    generator = np.random.default_rng(4)
    v = np.array([controller.step(e) for e in 4.0 * generator.standard_cauchy((1000, 2))])
    assert np.max(np.abs(v)) <= 3.0
    changes = np.abs(np.diff(v[::5], axis=0))
    assert np.max(changes) <= 0.8 + 1e-9
    assert np.max(np.abs(v)) > 0.3  # v_p is active


@pytest.mark.compiled
def test_v_p_changes_by_the_first_optimal_change_63():
    """Without active bounds, (61) gives pi dv_0 = -mu sum of s_j Psi_j."""
    parameters = DEFAULT.with_values({'v_max': 1e3, 'dv_max': 1e3, 'learning': False})
    controller, loop = PredictiveController(parameters, PERIOD, GAIN), Loop()
    before, changes = np.zeros(2), []
    for w in _waves(500):
        due = controller.due
        v_p = controller.step(loop.error)
        if due:
            assert controller.solved.all()
            np.testing.assert_allclose(controller.signals.authorities, 1.0)
            first = -parameters.error_weight * np.sum(
                controller.responses.steps * controller.responses.prediction, axis=1
            )
            np.testing.assert_allclose(v_p - before, first / parameters.move_weight, atol=1e-9)
            changes.append(v_p - before)
        else:
            np.testing.assert_array_equal(v_p, before)
        before = v_p
        loop.step(v_p, w, np.zeros(2))
    assert len(changes) == 100
    assert np.max(np.abs(changes)) > 0.1


@pytest.mark.compiled
def test_a_reduced_bound_takes_effect_at_once():
    controller = PredictiveController(DEFAULT, PERIOD, GAIN)
    _run(controller, np.full((300, 2), 8.0))
    assert np.all(np.abs(controller.step(np.zeros(2))) > 5.0)
    controller.configure(replace(DEFAULT, v_max=2.0))
    v = [controller.step(np.zeros(2)) for _ in range(5)]
    assert np.max(np.abs(v[-1])) <= 2.0
    with pytest.raises(ParameterError, match='horizon is read-only'):
        controller.configure(replace(DEFAULT, horizon=8))


@pytest.mark.compiled
def test_disabled_it_returns_zero_and_still_learns():
    controller = PredictiveController(DEFAULT.with_values({'enabled': False}), PERIOD, GAIN)
    before = controller.get_weights()['output_weights']
    _, moves = _run(controller, _levels(1000, 6))
    np.testing.assert_array_equal(moves, 0.0)
    np.testing.assert_array_equal(controller.signals.authorities, 0.0)
    assert np.any(controller.get_weights()['output_weights'] != before)


def _jumping(known, preview):
    """Return the true errors of a run with jumps of the reference, and the controller."""
    count, controller = 3000, PredictiveController(DEFAULT, PERIOD, GAIN)
    generator, loop = np.random.default_rng(8), Loop()
    jumps = np.zeros((count + 60, 2))
    jumps[150:count:150] = generator.uniform(-3.0, 3.0, jumps[150:count:150].shape)
    noise = 0.05 * generator.standard_normal((count, 2))
    errors = np.zeros((count, 2))
    for k in range(count):
        loop.state[0] += jumps[k]
        errors[k] = loop.error
        if known and jumps[k].any():
            controller.notify_jump(jumps[k])
        coming = None
        if preview and controller.due:
            coming = jumps[k + 1 : k + 51].reshape(10, 5, 2).sum(axis=1)
        v_p = controller.step(loop.error + noise[k], coming)
        loop.step(v_p, np.zeros(2), noise[k])
    return errors, controller


@pytest.mark.compiled
@pytest.mark.slow
def test_a_known_jump_is_not_learned_and_preview_helps():
    """Unknown jumps look like dynamics of the robot, so a wrong gain is learned."""
    unknown, unaware = _jumping(known=False, preview=False)
    known, aware = _jumping(known=True, preview=False)
    previewed, _ = _jumping(known=True, preview=True)
    assert np.all(aware.skill > unaware.skill + 0.2)
    true = PredictiveController(DEFAULT, PERIOD, GAIN)
    true.step(np.zeros(2))
    ratio = aware.responses.steps[:, 4] / true.responses.steps[:, 4]
    wrong = unaware.responses.steps[:, 4] / true.responses.steps[:, 4]
    assert np.all(np.abs(ratio - 1.0) < 0.25)
    assert np.max(np.abs(wrong - 1.0)) > np.max(np.abs(ratio - 1.0))
    assert _rms(known) < _rms(unknown)
    assert _rms(previewed) < 0.75 * _rms(known)


@pytest.mark.compiled
def test_a_known_jump_decays_in_the_prediction_with_the_feedback():
    parameters = DEFAULT.with_values({'enabled': False})
    controller = PredictiveController(parameters, PERIOD, GAIN)
    controller.notify_jump(np.array([100.0, -2.0]))
    controller.step(np.array([100.0, -2.0]))
    fall = np.exp(-GAIN * 0.05 * np.arange(1, 11))
    np.testing.assert_allclose(
        controller.responses.prediction, np.outer([100.0, -2.0], fall), atol=1e-9
    )
    controller.reset()
    coming = np.zeros((10, 2))
    coming[3] = (1.0, 0.0)
    controller.step(np.zeros(2), coming)
    expected = np.r_[np.zeros(3), np.exp(-GAIN * 0.05 * np.arange(7))]
    np.testing.assert_allclose(controller.responses.prediction[0], expected, atol=1e-9)
    np.testing.assert_allclose(controller.responses.prediction[1], 0.0, atol=1e-9)


@pytest.mark.compiled
@pytest.mark.slow
def test_it_learns_from_the_applied_v_p():
    """When a limit suppresses v_p, the machine must not learn that v_p has no effect."""
    disturbance = _levels(4000, 9)

    def gain(notify):
        controller, loop = PredictiveController(DEFAULT, PERIOD, GAIN), Loop()
        for k, w in enumerate(disturbance):
            v_p = controller.step(loop.error)
            applied = v_p * (k % 100 >= 50)  # the limit is active half of the time
            if notify:
                controller.signals.applied[:] = applied
            loop.step(applied, w, np.zeros(2))
        return np.mean(controller.responses.steps[:, 4])

    fresh = PredictiveController(DEFAULT, PERIOD, GAIN)
    fresh.step(np.zeros(2))
    true = np.mean(fresh.responses.steps[:, 4])
    assert abs(gain(notify=True) / true - 1.0) < 0.35
    assert abs(gain(notify=True) - true) < abs(gain(notify=False) - true)


@pytest.mark.compiled
def test_after_a_limit_changes_start_between_zero_and_v_p():
    """A limit may exceed v_p; a change that starts there would move v_p to its bound."""
    for applied, start in ((-50.0, 0.0), (0.5, 0.5), (99.0, None)):
        controller = PredictiveController(DEFAULT, PERIOD, GAIN)
        for _ in range(50):
            v = controller.step(np.full(2, -0.5))
        assert np.all(v > 1.0)
        controller.signals.applied[:] = applied
        controller.configure(replace(DEFAULT, dv_max=1e-6))
        after = controller.step(np.full(2, -0.5))
        np.testing.assert_allclose(after, v if start is None else start, atol=1e-5)
        assert controller.solved.all()


@pytest.mark.compiled
def test_invalid_input_is_rejected_without_effect():
    controller = PredictiveController(DEFAULT, PERIOD, GAIN)
    good = controller.get_weights()
    for wrong, match in (
        ({**good, 'extra': np.zeros(2)}, 'weights must be'),
        ({**good, 'anchor': np.zeros(3)}, 'anchor must have shape'),
        ({**good, 'anchor': np.full((2, 12), np.nan)}, 'finite'),
        ({**good, 'scales': 2.0 * good['scales']}, 'scales must be'),
    ):
        with pytest.raises(ValueError, match=match):
            controller.set_weights(wrong)
    with pytest.raises(ValueError, match='finite'):
        controller.step(np.array([0.0, np.inf]))
    with pytest.raises(ParameterError, match='control_horizon must be at most horizon'):
        DEFAULT.with_values({'control_horizon': 11})
    fast = DEFAULT.with_values({'decimation': 1, 'average': 1})
    with pytest.raises(ParameterError, match=r'must cover the dead time .* got 0.003 s'):
        PredictiveController(fast, 0.003, GAIN)
    PredictiveController(fast, 0.004, GAIN)
    with pytest.raises(ValueError, match='positive'):
        PredictiveController(DEFAULT, PERIOD, 0.0)
    untouched = PredictiveController(DEFAULT, PERIOD, GAIN)
    disturbance = _levels(200, 14)
    np.testing.assert_array_equal(
        _run(controller, disturbance)[1], _run(untouched, disturbance)[1]
    )


@pytest.mark.compiled
def test_a_deep_copy_is_independent():
    controller, errors = PredictiveController(DEFAULT, PERIOD, GAIN), np.array([0.3, -0.2])
    controller.warm_up()  # changes nothing
    fresh = PredictiveController(DEFAULT, PERIOD, GAIN)
    for k in range(60):
        sample = errors * np.sin(0.1 * k)
        np.testing.assert_array_equal(controller.step(sample), fresh.step(sample))
    twin, other = deepcopy(controller), deepcopy(controller)
    for _ in range(20):
        other.step(-errors)
    for k in range(60, 160):
        sample = errors * np.sin(0.1 * k)
        np.testing.assert_array_equal(twin.step(sample), controller.step(sample))
    np.testing.assert_array_equal(twin.skill, controller.skill)
    for name, value in controller.get_weights().items():
        np.testing.assert_array_equal(twin.get_weights()[name], value)
