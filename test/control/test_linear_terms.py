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
"""Coulomb friction (E23) and wrong inertia (E24) in the estimate g."""

import numpy as np
import pytest

from t3mpc_ros.control.control_law import (
    FRICTION_WEIGHTS,
    INERTIA_WEIGHTS,
    LinearTerm,
    Nt3fsMpcController,
    Nt3fsMpcParameters,
    add_friction,
    add_inertia,
)
from t3mpc_ros.evaluation.proposed_method import ProposedParameters
from t3mpc_ros.fuzzy.estimator import AdaptationGains, adapt

DT = 0.01
FRICTION = np.array([[9.0, 4.0], [4.0, 9.0]])
"""Accelerations (rad/s²) by the friction of the two wheels of a body."""
HEAVY = np.array([[1.3, 0.1], [0.1, 1.3]])
"""True over assumed inertia of both wheels."""


def controller(**changes):
    parameters = {'predictive.enabled': False, 'jump_transition.preview': False}
    return Nt3fsMpcController(Nt3fsMpcParameters.from_dict(parameters | changes))


def heavy_controller(**changes):
    parameters = {'predictive.enabled': False, 'adaptation.gamma': 0.0, 'friction.gamma': 0.0}
    return Nt3fsMpcController(ProposedParameters.from_dict(parameters | changes))


def track(law, seconds, friction=FRICTION, inertia=None):
    """Return the RMS error (rad/s) over the last half of slow turns back and forth."""
    chi, errors = np.zeros(2), []
    inertia, pace = (np.eye(2), 2.0) if inertia is None else (inertia, 3.0)
    for k in range(round(seconds / DT)):
        time = k * DT + np.array([0.0, 1.1])
        reference, rate = 2.0 * np.sin(pace * time), 2.0 * pace * np.cos(pace * time)
        errors.append(chi - reference)
        u = law.step(chi, reference, rate, DT)
        law.set_applied(u, saturated=False)
        chi = chi + DT * (np.linalg.solve(inertia, u) - friction @ np.tanh(chi / 0.2))
    return np.sqrt(np.mean(np.square(errors[len(errors) // 2 :])))


def track_heavy(law, seconds):
    return track(law, seconds, 0.0 * FRICTION, HEAVY)


@pytest.mark.parametrize('term', ['friction', 'inertia'])
def test_the_estimate_is_the_fuzzy_one_plus_the_term_e23_e24(term):
    rng = np.random.default_rng(1)
    tables = LinearTerm(np.zeros(2), rng.normal(size=(2, 2)))
    given, fuzzy = rng.normal(size=(2, 2))
    estimate = fuzzy.copy()
    if term == 'friction':
        add_friction(given, 0.3, tables, estimate)
        basis = np.tanh(given / 0.3)
    else:
        add_inertia(given, 50.0, tables, estimate)
        basis = given / 50.0
    np.testing.assert_allclose(tables.basis, basis, rtol=1e-15)
    np.testing.assert_allclose(estimate, fuzzy + tables.coefficients @ basis, rtol=1e-14)


def test_v_rate_is_79_if_the_coefficients_follow_e23():
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
    track(law, 40.0)
    # g is what the robot adds to u: friction acts against the motion.
    np.testing.assert_allclose(law.friction, -FRICTION, atol=1.5)


@pytest.mark.compiled
@pytest.mark.slow
def test_with_much_friction_the_error_is_less_than_half():
    with_term, without = (track(controller(**{'friction.gamma': g}), 20.0) for g in (10.0, 0.0))
    assert with_term < 0.5 * without
    smooth = [
        track(controller(**{'friction.gamma': g}), 20.0, 0.0 * FRICTION) for g in (10.0, 0.0)
    ]
    assert smooth[0] < 1.02 * smooth[1] + 1e-6


@pytest.mark.compiled
def test_a_wrong_inertia_of_both_wheels_is_learnt():
    with_term = track_heavy(heavy_controller(**{'inertia.gamma': 3000.0}), 30.0)
    assert with_term < 0.2 * track_heavy(heavy_controller(), 30.0)


@pytest.mark.compiled
def test_without_gamma_g_is_31_as_printed():
    law = controller(**{'friction.gamma': 0.0})
    track(law, 2.0)
    assert not law.friction.any()
    assert not law.inertia.any()
    assert INERTIA_WEIGHTS not in law.get_weights()
    chi = np.array([1.0, -2.0])
    law.step(chi, chi, np.zeros(2), DT)
    np.testing.assert_array_equal(-law.terms[0], law.fuzzy.evaluate(chi))


@pytest.mark.compiled
def test_coefficients_stay_in_the_ball_under_any_error():
    law = controller(**{'adaptation.radius': 3.0, 'friction.gamma': 1e4})
    rng = np.random.default_rng(3)
    for _ in range(500):
        law.step(*rng.uniform(-20.0, 20.0, (3, 2)), DT)
        assert np.linalg.norm(law.friction, axis=1).max() <= np.sqrt(2.0) * 3.0 * (1.0 + 1e-12)


@pytest.mark.compiled
@pytest.mark.parametrize('name', [FRICTION_WEIGHTS, INERTIA_WEIGHTS])
def test_weights_of_the_term_are_kept_and_discarded(name):
    """A model from before the term has none."""
    term = name.split('.')[0]
    changes = {f'{term}.gamma': 300.0}
    law, other = (
        (controller(), controller())
        if term == 'friction'
        else (heavy_controller(**changes), heavy_controller(**changes))
    )
    (track if term == 'friction' else track_heavy)(law, 2.0)
    weights = law.get_weights()
    assert np.abs(weights[name]).max() > 0.01
    other.set_weights(weights)
    np.testing.assert_array_equal(getattr(other, term), getattr(law, term))
    del weights[name]
    other.set_weights(weights)
    assert not getattr(other, term).any()
    with pytest.raises(ValueError, match=rf'{term}\.coefficients must be finite, of shape'):
        other.set_weights(weights | {name: np.zeros(2)})
    law.reset_estimate()
    assert not getattr(law, term).any()
    assert not law.fuzzy.coefficients.any()
