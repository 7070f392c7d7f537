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
"""System (85), the sum of exponentials of its memory, and both fractional solvers, by theory."""

from decimal import Decimal, localcontext
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gammaln
from support.equations import interval_weights, linear_decay_system, solve_full_memory
from support.long_tests import few_of

from t3mpc_ros.chaos.solver import FractionalSolver, mode_weights
from t3mpc_ros.chaos.sum_of_exponentials import fit_sum_of_exponentials
from t3mpc_ros.chaos.system_equations import (
    QuadraticSystem,
    hyperchaotic_system,
    jacobian,
    right_hand_side,
)

ONE = np.ones(1)
START = np.array([1.0, 1.0, 1.0, 1.0])


def mittag_leffler(order, time, second=1.0):
    """Return E_(q,p)(-t^q) by its series: no cancellation to speak of for t <= 2."""
    k = np.arange(150)
    return math.fsum((-1.0) ** k * np.exp(order * k * np.log(time) - gammaln(order * k + second)))


def mittag_leffler_tail(order, time):
    """Return E_q(-t^q) as a Laplace integral of a positive density: accurate for any t > 0."""

    def density(x):
        rate = math.exp(x)
        power = rate**order
        denominator = power * power + 2.0 * power * math.cos(math.pi * order) + 1.0
        return math.exp(-rate * time) * power / denominator

    value = quad(density, -300.0, 40.0, points=[-5.0, 0.0, 5.0], limit=2000, epsabs=1e-14)[0]
    return math.sin(math.pi * order) / math.pi * value


def diethelm(order, slope, step, initial, steps):
    """Return the states of the published predictor-corrector, from its published weights."""
    p = order + 1.0
    corrector = step**order / math.gamma(order + 2.0)
    predictor = step**order / math.gamma(order + 1.0)
    states = np.array([initial])
    slopes = np.array([slope(initial)])
    for n in range(steps):
        j = np.arange(n + 1.0)
        rectangle = (n + 1 - j) ** order - (n - j) ** order
        trapezoid = (n - j + 2) ** p + (n - j) ** p - 2 * (n - j + 1) ** p
        trapezoid[0] = n**p - (n - order) * (n + 1) ** order
        guess = initial + predictor * rectangle @ slopes
        states = np.append(
            states, [initial + corrector * (slope(guess) + trapezoid @ slopes)], axis=0
        )
        slopes = np.append(slopes, [slope(states[-1])], axis=0)
    return states


def hyperchaos(y):
    y1, y2, y3, y4 = y
    return np.array(
        [35 * (y2 * y3 + y2 - y1), -5 * y1 * y3 + 25 * y1 + y2 + y4, -4 * y3 + y1 * y2, -100 * y2]
    )


def run(solver, samples, every=1):
    return np.array([solver.state, *(solver.advance(every) for _ in range(samples))])


@pytest.mark.parametrize('order', [0.3, 0.98])
def test_full_memory_weights_are_exact_at_large_lags(order):
    """In double precision the closed form of lag 20 000 keeps eight digits of sixteen.

    An oracle that is wrong by 1e-8 cannot judge a solver that states 1e-8; the reference here is
    the closed form in 60 digits.
    """
    older, newer = interval_weights(order, 20_001)
    with localcontext() as context:
        context.prec = 60
        q = Decimal(order)
        for m in (0, 1, 2, 10, 500, 20_000):
            a, b = Decimal(m), Decimal(m + 1)
            first = (b ** (q + 1) - a ** (q + 1)) / (q + 1)
            zeroth = (b**q - a**q) / q
            expected_older = float(first - a * zeroth) / math.gamma(order)
            expected_newer = float(b * zeroth - first) / math.gamma(order)
            assert older[m] == pytest.approx(expected_older, rel=4e-15)
            assert newer[m] == pytest.approx(expected_newer, rel=4e-15)


def test_mode_weights_are_exact_for_any_product_of_rate_and_step():
    """For a small product the closed forms cancel: at 1e-9 nothing would be left of them."""
    decay = np.array([0.0, 1e-300, 1e-12, 1e-9, 1e-5, 0.01, 0.3, 0.499, 0.5, 0.7, 3.0, 40.0, 800])
    older, newer = mode_weights(decay)
    with localcontext() as context:
        context.prec = 700
        for index, value in enumerate(decay):
            if value == 0.0:
                assert (older[index], newer[index]) == (0.5, 0.5)
                continue
            a = Decimal(float(value))
            fall = (-a).exp()
            assert older[index] == pytest.approx(
                float((1 - (1 + a) * fall) / (a * a)), rel=2e-15, abs=0.0
            )
            assert newer[index] == pytest.approx(float((a - 1 + fall) / (a * a)), rel=2e-15)


@pytest.mark.parametrize('order', [0.5, 0.98])
@pytest.mark.parametrize('kind', ['full memory', 'running'])
def test_convergence_order_on_linear_decay_is_one_plus_q(kind, order):
    counts = np.array([256, 512, 1024])
    errors = []
    for count in counts:
        if kind == 'running':
            solver = FractionalSolver(linear_decay_system(order), 1.0 / count, ONE, 10.0, 1e-11)
            final = solver.advance(int(count))[0]
        else:
            final = solve_full_memory(linear_decay_system(order), 1.0 / count, ONE, count)[-1, 0]
        errors.append(abs(final - mittag_leffler(order, 1.0)))
    found = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(found, min(2.0, 1.0 + order), atol=0.05)


def test_scheme_coincides_with_diethelms_on_a_linear_equation():
    ours = solve_full_memory(linear_decay_system(0.5), 0.01, ONE, 200)
    published = diethelm(0.5, np.negative, 0.01, ONE, 200)
    np.testing.assert_allclose(ours, published, rtol=0.0, atol=1e-12)


def test_order_one_is_heuns_method_to_rounding():
    step, steps = 1e-3, 400
    state, expected = START, [START]
    for _ in range(steps):
        now = hyperchaos(state)
        state = state + 0.5 * step * (now + hyperchaos(state + step * now))
        expected.append(state)
    system = hyperchaotic_system(orders=(1.0,) * 4)
    solver = FractionalSolver(system, step, START)
    np.testing.assert_allclose(run(solver, steps), expected, rtol=0.0, atol=1e-10)
    full = solve_full_memory(system, step, START, steps)
    np.testing.assert_allclose(full, expected, rtol=0.0, atol=1e-10)


@pytest.mark.compiled
@pytest.mark.parametrize('tolerance', [1e-6, 1e-10])
def test_solver_follows_the_full_memory_for_a_lyapunov_time(tolerance):
    """Over 0.4 s of (85), states up to 40, running and full memory differ by 100 tolerances.

    With 1e-8 that is 6.6e-7, five orders below the scheme's own error at this step, so the
    exponentials cost no accuracy at all.
    """
    step, steps = 1e-3, 400
    full = solve_full_memory(hyperchaotic_system(), step, START, steps)
    fine = solve_full_memory(hyperchaotic_system(), step / 8, START, 8 * steps)[::8]
    running = run(FractionalSolver(hyperchaotic_system(), step, START, 1e5, tolerance), steps)
    difference = np.abs(running - full).max()
    assert difference < 200.0 * tolerance
    assert difference < 1e-2 * np.abs(full - fine).max()


def test_states_of_different_orders_follow_the_full_memory():
    system = hyperchaotic_system(orders=(0.9, 1.0, 0.98, 0.95))
    full = solve_full_memory(system, 1e-3, START, 400)
    running = run(FractionalSolver(system, 1e-3, START), 400)
    np.testing.assert_allclose(running, full, rtol=0.0, atol=1e-5)


def test_the_past_is_never_truncated():
    """A fractional decay ends in a power of time, which a windowed memory cannot follow."""
    step = 0.01
    solver = FractionalSolver(linear_decay_system(0.8), step, ONE, 1e4)
    for time in (10.0, 50.0, 200.0):
        solver.advance(round((time - solver.time) / step))
        assert solver.state[0] == pytest.approx(mittag_leffler_tail(0.8, time), rel=1e-4)


@pytest.mark.parametrize('order', [0.8, 1.0])
def test_rate_is_the_time_derivative_and_converges(order):
    # d/dt E_q(-t^q) = -t^(q-1) E_(q,q)(-t^q)
    errors = []
    for count in (256, 512, 1024):
        solver = FractionalSolver(linear_decay_system(order), 1.0 / count, ONE, 10.0, 1e-11)
        solver.advance(count)
        errors.append(abs(solver.rate[0] + mittag_leffler(order, 1.0, order)))
    assert errors[-1] < 2e-6
    assert np.log2(errors[1] / errors[2]) > 2.0 * order - 0.1


def test_rate_is_unknown_at_time_zero_unless_the_order_is_one():
    solver = FractionalSolver(hyperchaotic_system(orders=(0.98, 1.0, 1.0, 0.98)), 1e-3, START)
    assert np.isnan(solver.rate).tolist() == [True, False, False, True]
    assert solver.rate[1] == hyperchaos(START)[1]
    solver.advance()
    assert np.isfinite(solver.rate).all()


def test_many_steps_at_once_equal_single_ones():
    single, many = (FractionalSolver(hyperchaotic_system(), 1e-3, START) for _ in range(2))
    for _ in range(60):
        single.advance()
    many.advance(60)
    assert single.state.tolist() == many.state.tolist()
    assert single.rate.tolist() == many.rate.tolist()
    assert single.time == many.time == pytest.approx(0.06)
    many.state[:] = np.nan
    assert np.isfinite(many.advance()).all()


@pytest.mark.compiled
def test_a_long_run_stays_on_the_attractor():
    """150 s, some 350 Lyapunov times: the ranges are those of an earlier, shorter run.

    Longer runs reach a little further in rare peaks (41 for y1 in 10 000 s), so all but one
    in two hundred samples must lie inside the ranges, and every one within 1.5 times them. The
    fourth state has the longest memory and needs the widest margin.
    """
    solver = FractionalSolver(hyperchaotic_system(), 1e-3, START)
    solver.advance(10_000)
    states = run(solver, 15_000, every=10)
    ranges = np.array([36.0, 9.0, 8.6, 80.0])
    outside = (np.abs(states) > ranges) | (states < [-np.inf, -np.inf, 1.5, -np.inf])
    assert np.all(outside.mean(axis=0) < 0.005)
    assert np.all(np.abs(states) < 1.5 * ranges)
    assert np.all(states[:, 2] > 0.0)
    # Measured over 10 000 s; tolerances are twice the spread of windows as long as this one.
    change = states.std(axis=0) / [10.62, 2.215, 0.937, 22.2] - 1.0
    assert np.all(np.abs(change) < [0.01, 0.02, 0.15, 0.2])
    offset = states.mean(axis=0) - [0.0, 0.0, 4.786, 0.0]
    assert np.all(np.abs(offset) < [0.3, 0.02, 0.06, 15.0])


def test_a_diverging_solution_raises():
    system = QuadraticSystem((0.9,), linear=(), quadratic=((0, 0, 0, 1.0),))
    solver = FractionalSolver(system, 0.01, ONE)
    with pytest.raises(FloatingPointError, match='not finite'):
        solver.advance(1000)


STATES = np.random.default_rng(3).normal(0.0, (10.0, 2.0, 4.0, 20.0), (20, 4))


def slope_of(system, state):
    out = np.full(system.size, np.nan)
    right_hand_side(system.terms(), state, out)
    return out


def test_terms_are_those_of_equation_85_with_e6():
    for y in STATES:
        found = slope_of(hyperchaotic_system(), y)
        np.testing.assert_allclose(found, hyperchaos(y), rtol=1e-13, atol=1e-11)


def test_jacobian_is_the_derivative_of_the_slope():
    # Central differences of a quadratic function are exact up to rounding.
    system = hyperchaotic_system()
    out = np.full((4, 4), np.nan)
    for state in STATES:
        jacobian(system.terms(), state, out)
        for column in range(4):
            shift = np.eye(4)[column]
            difference = slope_of(system, state + shift) - slope_of(system, state - shift)
            np.testing.assert_allclose(out[:, column], difference / 2.0, rtol=1e-9, atol=1e-9)
        assert np.trace(out) == pytest.approx(-38.0)  # the rate at which volume contracts


def test_repeated_terms_and_squares_are_added():
    system = QuadraticSystem(
        (1.0, 1.0),
        linear=((0, 0, 1.0), (0, 0, 2.0)),
        quadratic=((1, 0, 0, 3.0), (1, 0, 1, 1.0)),
        constant=(0.5, -1.0),
    )
    state = np.array([2.0, 5.0])
    np.testing.assert_allclose(slope_of(system, state), [0.5 + 6.0, -1.0 + 12.0 + 10.0])
    out = np.empty((2, 2))
    jacobian(system.terms(), state, out)
    np.testing.assert_allclose(out, [[3.0, 0.0], [12.0 + 5.0, 2.0]])


@pytest.mark.compiled
@pytest.mark.parametrize('order', [0.98])
def test_plus_sign_of_e6_is_chaotic_and_minus_sign_decays(order):
    """The paper prints (85) with '- 5 y1 y3 25 y1'.

    With minus the origin attracts every state; with plus, as in the original publication, the
    states cover their full range.
    """
    # The range for q = 1 is sufficient to distinguish both cases for both orders.
    for sign, alive in ((1.0, True), (-1.0, False)):
        system = hyperchaotic_system(c=sign * 25.0, orders=(order,) * 4)
        solver = FractionalSolver(system, 1e-3, np.ones(4))
        solver.advance(8000)
        late = np.array([solver.advance(10) for _ in range(400)])
        if alive:
            assert np.all(np.ptp(late, axis=0) > (30.0, 6.0, 3.0, 40.0))
        else:
            assert np.all(np.abs(late) < 1e-2)


ORDERS = (0.05, 0.5, 0.98, 1.0 - 1e-9, 1.0)


def relative_error(memory, order, time):
    return memory.at(time) * math.gamma(order) * time ** (1.0 - order) - 1.0


@pytest.mark.parametrize('order', ORDERS)
@pytest.mark.parametrize('tolerance', few_of([1e-8, 1e-3, 1e-6, 1e-11]))
def test_stated_error_bounds_the_error_on_a_dense_grid(order, tolerance):
    memory = fit_sum_of_exponentials(order, 1e-3, 1e5, tolerance)
    error = np.abs(relative_error(memory, order, np.geomspace(1e-3, 1e5, 40_009)))
    assert memory.error <= tolerance
    # 1e-14: at order 1 both errors are zero, apart from rounding here.
    assert error.max() <= memory.error + 1e-14
    if order in (0.5, 0.98):  # it is tight, with not far more modes than the tolerance requires
        assert error.max() > 0.9 * memory.error
        assert memory.error > 0.1 * tolerance
    if order == 1.0:
        assert memory.rates.tolist() == [memory.error] == [0.0]
        assert memory.weights.tolist() == [1.0]
    # Positive modes: the kernel is monotone.
    assert (memory.weights > 0.0).all()
    assert (memory.rates >= 0.0).all()
    assert (np.diff(memory.rates) > 0.0).all()


def test_kernel_tends_to_a_single_mode_as_the_order_tends_to_1():
    """For q near 1 the weight s^-q is almost not integrable at s = 0.

    Truncating the integral there, as for q = 0.5, would lose nearly the whole kernel; the lumped
    slow mode represents it.
    """
    for distance in (1e-4, 1e-8, 1e-12):
        memory = fit_sum_of_exponentials(1.0 - distance, 1e-3, 1e5, 1e-8)
        assert memory.weights[0] == pytest.approx(1.0, abs=40.0 * distance)
        assert memory.weights[1:].sum() < 40.0 * distance
        assert memory.rates[0] < distance


def test_number_of_modes_grows_like_the_logarithm_of_the_horizon():
    sizes = [fit_sum_of_exponentials(0.98, 1e-3, 10.0**n, 1e-8).rates.size for n in (2, 4, 6, 8)]
    growth = np.diff(sizes)
    assert growth.max() - growth.min() <= 1
    assert sizes[-1] < 70


def test_error_grows_slowly_beyond_the_horizon():
    memory = fit_sum_of_exponentials(0.98, 1e-3, 1e3, 1e-8)
    assert abs(relative_error(memory, 0.98, np.array([1e4]))[0]) < 2e-7
    assert abs(relative_error(memory, 0.98, np.array([1e5]))[0]) < 2e-5


@pytest.mark.parametrize(
    ('make', 'arguments', 'name'),
    [
        (FractionalSolver, (hyperchaotic_system(), 1e-3, ONE), 'initial'),
        (FractionalSolver, (hyperchaotic_system(), 1e-3, START * np.nan), 'initial'),
        (FractionalSolver, (hyperchaotic_system(), 0.0, START), 'shortest'),
        (FractionalSolver(hyperchaotic_system(), 1e-3, START).advance, (-1,), 'steps'),
        (FractionalSolver(hyperchaotic_system(), 1e-3, START).reset, (ONE,), 'initial'),
        (hyperchaotic_system, (35.0, 4.0, 25.0, 5.0, 100.0, (0.98,)), 'orders must be four'),
        (QuadraticSystem, ((), ()), 'orders'),
        (QuadraticSystem, ((0.0,), ()), 'orders'),
        (QuadraticSystem, ((1.2,), ()), 'orders'),
        (QuadraticSystem, ((1.0,), ((0, 1, 1.0),)), 'states'),
        (QuadraticSystem, ((1.0,), ((0, -1, 1.0),)), 'states'),
        (QuadraticSystem, ((1.0,), ((0, 0, np.nan),)), 'gains'),
        (QuadraticSystem, ((1.0,), (), ((0, 0, 1, 1.0),)), 'states'),
        (QuadraticSystem, ((1.0,), (), (), (1.0, 2.0)), 'constant'),
        (QuadraticSystem, ((1.0,), (), (), (np.inf,)), 'constant'),
        (fit_sum_of_exponentials, (math.nan, 1e-3, 1.0, 1e-8), 'order'),
        (fit_sum_of_exponentials, (1.1, 1e-3, 1.0, 1e-8), 'order'),
        (fit_sum_of_exponentials, (0.9, 0.0, 1.0, 1e-8), 'lags'),
        (fit_sum_of_exponentials, (0.9, 1.0, 1.0, 1e-8), 'lags'),
        (fit_sum_of_exponentials, (0.9, 1e-3, math.inf, 1e-8), 'lags'),
        (fit_sum_of_exponentials, (0.9, 1e-3, 1.0, 1e-14), 'tolerance'),
    ],
)
def test_arguments_out_of_range_are_rejected_by_name(make, arguments, name):
    with pytest.raises(ValueError, match=name):
        make(*arguments)
