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
"""Both fractional solvers against theory, and the running one against the full memory."""

from decimal import Decimal, localcontext
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gammaln
from support.equations import interval_weights, linear_decay_system, solve_full_memory

from t3mpc_ros.chaos.solver import FractionalSolver, mode_weights
from t3mpc_ros.chaos.system import QuadraticSystem, hyperchaotic_system

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


@pytest.mark.parametrize(
    'call, name',
    [
        (lambda: FractionalSolver(hyperchaotic_system(), 1e-3, ONE), 'initial'),
        (lambda: FractionalSolver(hyperchaotic_system(), 1e-3, START * np.nan), 'initial'),
        (lambda: FractionalSolver(hyperchaotic_system(), 0.0, START), 'shortest'),
        (lambda: FractionalSolver(hyperchaotic_system(), 1e-3, START, tolerance=1.0), 'tolerance'),
        (lambda: FractionalSolver(hyperchaotic_system(), 1e-3, START).advance(-1), 'steps'),
        (lambda: FractionalSolver(hyperchaotic_system(), 1e-3, START).reset(ONE), 'initial'),
    ],
)
def test_arguments_out_of_range_are_rejected_by_name(call, name):
    with pytest.raises(ValueError, match=name):
        call()
