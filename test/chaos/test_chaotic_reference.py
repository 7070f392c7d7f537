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
"""The switching chaotic reference: scale, derivative, switches, seeds."""

import hashlib

import numpy as np
import pytest
from support.constants import with_constants
from support.long_tests import few_of

from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceParameters
from t3mpc_ros.chaos.solver import FractionalSolver
from t3mpc_ros.chaos.switching_signal import SwitchingSchedule
from t3mpc_ros.chaos.system_equations import hyperchaotic_system
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels
from t3mpc_ros.parameters.table import ParameterError

GEOMETRY = WheelGeometry()


def samples(count, geometry=GEOMETRY, **values):
    reference = ChaoticReference(ReferenceParameters.from_dict(values), geometry)
    return [reference.advance() for _ in range(count)]


def wheels_of(run):
    return np.array([sample.wheels for sample in run])


def rates_of(run):
    return np.array([sample.rate for sample in run])


def states_of(run):
    return np.array([sample.states for sample in run])


@pytest.mark.compiled
def test_a_seed_is_the_same_reference_on_every_processor():
    """NumPy's exponentials differ by processor: seed 1 was another signal after five seconds."""
    run = samples(4000, seed=1)
    np.testing.assert_array_equal(run[-1].wheels, (4.296055162817732, -4.214351290862628))
    digest = hashlib.sha256(np.array(wheels_of(run)).tobytes()).hexdigest()
    assert digest.startswith('68088730636de8fe')


def derivative(values, rate):
    """Return the five-point derivative, shape (n - 4, 2), of samples 2 ... n - 3."""
    inner = 8.0 * (values[3:-1] - values[1:-3]) - (values[4:] - values[:-4])
    return inner * rate / 12.0


@pytest.mark.compiled
@pytest.mark.slow
def test_wheels_are_the_selected_scaled_states():
    parameters = ReferenceParameters(ramp=0.0)
    for sample in samples(2600, ramp=0.0):
        signals = np.array(parameters.amplitude) * (np.array(sample.states) - parameters.offset)
        expected = signals[np.array(sample.selected) - 1]
        np.testing.assert_allclose(sample.wheels, expected, rtol=1e-14)
        assert sample.selected == parameters.switching.pairs[sample.mode]


@pytest.mark.compiled
@pytest.mark.parametrize(
    'output, blend', few_of([('body', 0.0), ('wheels', 4.0), ('wheels', 0.0), ('body', 4.0)], 2)
)
@pytest.mark.slow
def test_rate_is_the_derivative_of_the_wheels_away_from_jumps(output, blend):
    """Finite differences over 60 s with ramp, transitions and constant modes, without jumps."""
    run = samples(6000, **{'output': output, 'switching.blend': blend})
    difference = derivative(wheels_of(run), 100.0)
    error = np.abs(difference - rates_of(run)[2:-2]).max(axis=1)
    jump = np.array([sample.switched for sample in run])
    near = (
        np.convolve(jump, np.ones(5), 'same')[2:-2] > 0
    )  # includes kinks of the second derivative
    assert near.sum() == 20
    assert error[~near].max() < 0.02
    assert rates_of(run).std() > 3.0  # scale of the error
    if blend:
        assert error.max() < 0.2


@pytest.mark.compiled
def test_it_starts_at_rest_and_a_jump_has_no_impulse_in_its_rate():
    run = samples(6000)
    wheels, rates = wheels_of(run), rates_of(run)
    assert [sample.elapsed for sample in run] == [n / 100.0 for n in range(6000)]
    assert run[0].wheels == run[0].rate == run[0].twist == (0.0, 0.0)
    assert np.abs(wheels[:30]).max() < 0.3
    jumps = [sample.index for sample in run if sample.switched]
    assert jumps == [1200, 2400, 3600, 4800]
    steps = np.abs(wheels[jumps] - wheels[np.array(jumps) - 1]).max(axis=1)
    assert steps.max() > 1.0  # a sudden switch
    parameters = ReferenceParameters()
    scale = np.array(parameters.amplitude)
    for jump in jumps:
        # Central difference of the new signal alone, from the raw states around the jump.
        slope = scale * (states_of(run)[jump + 1] - states_of(run)[jump - 1]) * 50.0
        np.testing.assert_allclose(rates[jump], slope[np.array(run[jump].selected) - 1], atol=0.1)


@pytest.mark.compiled
@pytest.mark.slow
def test_defaults_are_what_a_small_robot_can_follow():
    """Standard deviation near 3 rad/s, accelerations of 1 to 6 rad/s², peaks near 10 rad/s."""
    run = samples(8000)
    states, wheels, rates = states_of(run), wheels_of(run), rates_of(run)
    signals = (states - ReferenceParameters().offset) * ReferenceParameters().amplitude
    assert np.all(np.abs(signals.std(axis=0) - 2.8) < [0.2, 0.2, 0.6, 0.9])
    assert np.all(np.abs(wheels).max(axis=0) < 14.0)
    assert np.all(np.abs(wheels).max(axis=0) > 5.0)
    assert np.all(rates.std(axis=0) < 6.0)
    assert np.all(rates.std(axis=0) > 2.0)


@pytest.mark.compiled
def test_twist_is_equation_1_and_body_output_its_inverse():
    geometry = WheelGeometry(wheel_radius=0.05, wheel_separation=0.3)
    wheels, body = (
        samples(200, geometry, output=output, ramp=0.0) for output in ('wheels', 'body')
    )
    parameters = ReferenceParameters()
    for left, right in zip(wheels, body, strict=True):
        assert left.twist == twist_from_wheels(left.wheels, geometry)
        assert right.twist.linear == pytest.approx(parameters.linear_scale * left.wheels.right)
        assert right.twist.angular == pytest.approx(parameters.angular_scale * left.wheels.left)


@pytest.mark.compiled
def test_time_scale_only_slows_the_same_states_down():
    """reference(t) = y(kappa t): half the scale at half the rate gives identical states."""
    fast = samples(300, rate=100.0, time_scale=0.05, ramp=0.0)
    slow = samples(300, rate=50.0, time_scale=0.025, ramp=0.0)
    assert states_of(fast).tolist() == states_of(slow).tolist()
    np.testing.assert_allclose(rates_of(slow), 0.5 * rates_of(fast), rtol=1e-12)


@pytest.mark.parametrize(
    'rate, time_scale, steps',
    [(100.0, 0.05, 1), (100.0, 0.1, 1), (100.0, 0.11, 2), (10.0, 0.05, 5), (1000.0, 0.05, 1)],
)
def test_a_whole_number_of_solver_steps_makes_one_sample(rate, time_scale, steps):
    parameters = ReferenceParameters(rate=rate, time_scale=time_scale)
    assert parameters.steps_per_sample == steps
    assert parameters.step <= parameters.solver_step * (1.0 + 1e-9)
    assert parameters.step * steps * rate == pytest.approx(time_scale)


def test_seed_zero_starts_at_the_initial_state_others_near_it():
    parameters = ReferenceParameters(settle=0.1)
    solver = FractionalSolver(hyperchaotic_system(), parameters.step, np.array(parameters.initial))
    start = solver.advance(round(0.1 / parameters.step))
    table = with_constants(ReferenceParameters, perturbation=1e-7)
    exact, near, again, other = (
        ChaoticReference(table(settle=0.1, seed=seed), GEOMETRY).advance().states
        for seed in (0, 1, 1, 2)
    )
    assert list(exact) == start.tolist()
    assert near == again
    assert len({exact, near, other}) == 3
    np.testing.assert_allclose(near, exact, atol=1e-4)
    np.testing.assert_allclose(other, exact, atol=1e-4)


@pytest.mark.compiled
def test_switch_times_do_not_reveal_the_perturbation():
    """With a common random stream the first dwell is the scaled perturbation of y1."""
    table = with_constants(ReferenceParameters, perturbation=1e-6)
    parameters = table.from_dict({'settle': 0.1, 'switching.kind': 'random'})
    dwells, shifts = [], []
    reference = ChaoticReference(parameters, GEOMETRY)
    base = np.array(reference.advance().states)
    for seed in range(1, 200):
        reference.reset(seed)
        # Over 0.1 s the perturbation grows linearly: the shift is a combination of four draws.
        shifts.append(np.array(reference.advance().states) - base)
        dwells.append(SwitchingSchedule(parameters.switching, seed).at(0.0).until)
    # Remove the part of the dwell that a linear combination of the shifts explains.
    design = np.column_stack([np.ones(len(shifts)), np.array(shifts) * 1e6])
    centred = np.array(dwells) - np.mean(dwells)
    left = centred - design @ np.linalg.lstsq(design, centred, rcond=None)[0]
    assert left.var() > 0.8 * centred.var()


def test_lists_need_one_value_per_state():
    for name in ('orders', 'amplitude', 'offset', 'initial'):
        with pytest.raises(ParameterError, match=name):
            ReferenceParameters(**{name: (1.0, 1.0)})


def test_an_invalid_seed_is_rejected_without_printing_it():
    reference = ChaoticReference(ReferenceParameters(settle=0.1), GEOMETRY)
    with pytest.raises(ValueError, match='seed must not be negative') as caught:
        reference.reset(-123456)
    assert '123456' not in str(caught.value)
