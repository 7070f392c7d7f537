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
"""Wrong inertia in the estimate g (E24)."""

import numpy as np
import pytest

from t3mpc_ros.control.control_law import (
    INERTIA_WEIGHTS,
    LinearTerm,
    Nt3fsMpcController,
    add_inertia,
)
from t3mpc_ros.evaluation.proposed_method import ProposedParameters

DT = 0.01
HEAVY = np.array([[1.3, 0.1], [0.1, 1.3]])
"""True over assumed inertia of both wheels."""


def controller(**changes):
    parameters = {'predictive.enabled': False, 'adaptation.gamma': 0.0, 'friction.gamma': 0.0}
    return Nt3fsMpcController(ProposedParameters.from_dict(parameters | changes))


def track(law, seconds, inertia=HEAVY):
    """Return the RMS error (rad/s) over the last half of turns back and forth."""
    chi, errors = np.zeros(2), []
    for k in range(round(seconds / DT)):
        time = k * DT + np.array([0.0, 1.1])
        reference, rate = 2.0 * np.sin(3.0 * time), 6.0 * np.cos(3.0 * time)
        errors.append(chi - reference)
        u = law.step(chi, reference, rate, DT)
        law.set_applied(u, saturated=False)
        chi = chi + DT * np.linalg.solve(inertia, u)
    return np.sqrt(np.mean(np.square(errors[len(errors) // 2 :])))


def test_the_estimate_is_the_other_one_plus_the_inertia_e24():
    rng = np.random.default_rng(1)
    term = LinearTerm(np.zeros(2), rng.normal(size=(2, 2)))
    rate, other = rng.normal(size=(2, 2))
    estimate = other.copy()
    add_inertia(rate, 50.0, term, estimate)
    np.testing.assert_allclose(term.basis, rate / 50.0, rtol=1e-15)
    np.testing.assert_allclose(estimate, other + term.coefficients @ rate / 50.0, rtol=1e-14)


@pytest.mark.compiled
def test_a_wrong_inertia_of_both_wheels_is_learnt():
    with_term = track(controller(**{'inertia.gamma': 3000.0}), 60.0)
    assert with_term < 0.2 * track(controller(), 60.0)


@pytest.mark.compiled
def test_without_gamma_there_is_no_term_and_no_weight():
    law = controller()
    track(law, 1.0)
    assert not law.inertia.any()
    assert INERTIA_WEIGHTS not in law.get_weights()


@pytest.mark.compiled
def test_weights_of_the_term_are_kept_and_discarded():
    law, other = controller(**{'inertia.gamma': 300.0}), controller(**{'inertia.gamma': 300.0})
    track(law, 2.0)
    weights = law.get_weights()
    assert np.abs(weights[INERTIA_WEIGHTS]).max() > 0.01
    other.set_weights(weights)
    np.testing.assert_array_equal(other.inertia, law.inertia)
    del weights[INERTIA_WEIGHTS]
    other.set_weights(weights)
    assert not other.inertia.any()
    with pytest.raises(ValueError, match=r'inertia\.coefficients must be finite, of shape'):
        other.set_weights(weights | {INERTIA_WEIGHTS: np.zeros(2)})
    law.reset_estimate()
    assert not law.inertia.any()
