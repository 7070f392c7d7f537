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
"""Coulomb friction in the estimate g (E23)."""

import numpy as np
import pytest

from t3mpc_ros.control.control_law import (
    FRICTION_WEIGHTS,
    FrictionTermParameters,
    LinearTerm,
    Nt3fsMpcController,
    Nt3fsMpcParameters,
    add_friction,
)
from t3mpc_ros.fuzzy.estimator import AdaptationGains, adapt

DT = 0.01
FRICTION = np.array([[9.0, 4.0], [4.0, 9.0]])
"""Accelerations (rad/s²) by the friction of the two wheels of a body."""


def controller(**changes):
    parameters = {'predictive.enabled': False, 'jump_transition.preview': False}
    return Nt3fsMpcController(Nt3fsMpcParameters.from_dict(parameters | changes))


def track(law, seconds, friction=FRICTION):
    """Return the RMS error (rad/s) over the last half of slow turns back and forth."""
    chi, errors = np.zeros(2), []
    for k in range(round(seconds / DT)):
        time = k * DT + np.array([0.0, 1.1])
        reference, rate = 2.0 * np.sin(2.0 * time), 4.0 * np.cos(2.0 * time)
        u = law.step(chi, reference, rate, DT)
        law.set_applied(u, saturated=False)
        chi = chi + DT * (u - friction @ np.tanh(chi / 0.2))
        errors.append(chi - reference)
    return np.sqrt(np.mean(np.square(errors[len(errors) // 2 :])))


def test_the_estimate_is_the_fuzzy_one_plus_the_friction_e23():
    rng = np.random.default_rng(1)
    tables = LinearTerm(np.zeros(2), rng.normal(size=(2, 2)))
    reference, fuzzy = rng.normal(size=(2, 2))
    estimate = fuzzy.copy()
    add_friction(reference, 0.3, tables, estimate)
    np.testing.assert_allclose(tables.basis, np.tanh(reference / 0.3), rtol=1e-15)
    expected = fuzzy + tables.coefficients @ np.tanh(reference / 0.3)
    np.testing.assert_allclose(estimate, expected, rtol=1e-14)


def test_v_rate_is_79_if_the_friction_coefficients_follow_e23():
    """(76) contains delta_i phi~_i's; the adaptation of the same form as (77) cancels it."""
    rng = np.random.default_rng(2)
    gamma, dt = 10.0, 1e-7
    for _ in range(20):
        truth, known = rng.normal(size=(2, 2, 2))
        basis, delta, others = np.tanh(rng.normal(size=2)), rng.normal(size=2), rng.normal(size=2)
        adapted = known.copy()
        assert adapt(adapted, basis, delta, dt, AdaptationGains(gamma, 100.0, 0.0, 0.0, 2.0))
        delta_rate = (truth - known) @ basis + others
        change = 2.0 * delta @ delta_rate * dt / 2.0
        change += (np.sum((truth - adapted) ** 2) - np.sum((truth - known) ** 2)) / (2.0 * gamma)
        assert change / dt == pytest.approx(delta @ others, rel=1e-4, abs=1e-4)


@pytest.mark.compiled
def test_friction_of_both_wheels_is_learnt_through_the_body():
    law = controller(**{'adaptation.gamma': 0.0, 'friction.gamma': 30.0})
    track(law, 60.0)
    # g is what the robot adds to u: friction acts against the motion.
    np.testing.assert_allclose(law.friction, -FRICTION, atol=1.5)


@pytest.mark.compiled
@pytest.mark.slow
def test_with_much_friction_the_error_is_less_than_half():
    with_term, without = (track(controller(**{'friction.gamma': g}), 30.0) for g in (10.0, 0.0))
    assert with_term < 0.5 * without
    smooth = [
        track(controller(**{'friction.gamma': g}), 30.0, 0.0 * FRICTION) for g in (10.0, 0.0)
    ]
    assert smooth[0] < 1.02 * smooth[1] + 1e-6


@pytest.mark.compiled
def test_without_gamma_g_is_31_as_printed():
    law = controller(**{'friction.gamma': 0.0})
    track(law, 2.0)
    assert not law.friction.any()
    chi = np.array([1.0, -2.0])
    law.step(chi, chi, np.zeros(2), DT)
    np.testing.assert_array_equal(-law.terms[0], law.fuzzy.evaluate(chi))


@pytest.mark.compiled
def test_coefficients_stay_in_the_ball_under_any_error():
    parameters = {'adaptation.radius': 3.0, 'friction.gamma': 1e4}
    law = controller(**parameters)
    rng = np.random.default_rng(3)
    for _ in range(500):
        law.step(*rng.uniform(-20.0, 20.0, (3, 2)), DT)
        assert np.linalg.norm(law.friction, axis=1).max() <= np.sqrt(2.0) * 3.0 * (1.0 + 1e-12)


@pytest.mark.compiled
def test_a_model_from_before_the_term_has_no_friction():
    law = controller()
    track(law, 2.0)
    weights = law.get_weights()
    assert np.abs(weights[FRICTION_WEIGHTS]).max() > 0.1
    other = controller()
    other.set_weights(weights)
    np.testing.assert_array_equal(other.friction, law.friction)
    del weights[FRICTION_WEIGHTS]
    other.set_weights(weights)
    assert not other.friction.any()
    with pytest.raises(ValueError, match=r'friction\.coefficients must be finite, of shape'):
        other.set_weights(weights | {FRICTION_WEIGHTS: np.zeros(2)})
    law.reset_estimate()
    assert not law.friction.any()
    assert not law.fuzzy.coefficients.any()


def test_at_the_width_friction_has_76_percent():
    assert np.tanh(1.0) == pytest.approx(0.76, abs=0.005)
    tables = LinearTerm(np.zeros(1), np.ones((1, 1)))
    estimate, width = np.zeros(1), FrictionTermParameters().width
    add_friction(np.array([width]), width, tables, estimate)
    assert estimate[0] == pytest.approx(0.76, abs=0.005)
