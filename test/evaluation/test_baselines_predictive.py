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
"""Predictive baselines: optimality, bounds, offset, agreement with theory."""

import math
import sys

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from support.long_tests import few_of

from t3mpc_ros.evaluation.baselines.baseline_controller import (
    NominalModel,
    Observation,
    WheelLoads,
)
from t3mpc_ros.evaluation.baselines.dynamic_matrix_control import (
    DynamicMatrix,
    DynamicMatrixPreview,
    identify_step_responses,
)
from t3mpc_ros.evaluation.baselines.model_predictive_control import (
    CasadiNmpc,
    CasadiNmpcParameters,
    LinearMpc,
    LinearMpcParameters,
    LinearMpcPreview,
    condense,
    wheel_dynamics,
)
from t3mpc_ros.evaluation.baselines.predictive_baseline import (
    BoxProgram,
    predict_reference,
    response_matrix,
    wheel_model,
)
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia
from t3mpc_ros.simulation.plant.paper_plant import PaperPlant, PaperRobotParameters

pytestmark = pytest.mark.slow

PERIOD, LAG, REACH = 0.01, 0.02, 28.0
KEPT = math.exp(-PERIOD / LAG)
AHEAD = 40
"""Rows of the future that preview gives."""
DRIVES = ('velocity', 'torque')
FREE = {'friction.viscous': 0.0, 'friction.coulomb': 0.0, 'body.com_offset': 0.0}
"""A robot whose wheels are exactly what the linear model says."""
LINEAR = (LinearMpc, LinearMpcPreview, DynamicMatrix, DynamicMatrixPreview)
EVERY = (*LINEAR, CasadiNmpc)


def _knowledge(drive, robot=FREE):
    reach = REACH if drive == 'velocity' else math.inf
    parameters = PaperRobotParameters().with_values(robot)
    return NominalModel(drive, PERIOD, LAG, reach, parameters)


def _make(kind, drive, robot=FREE, **parameters):
    if kind is CasadiNmpc:
        pytest.importorskip('casadi')
    rows = {row.name for row in kind.parameters_type.specs()}
    chosen = {name: value for name, value in parameters.items() if name in rows}
    return kind(kind.parameters_type().with_values(chosen), _knowledge(drive, robot))


def _run(baseline, drive, reference, load=None, seen=None, noise=0.0):
    """Close the loop with the plant of the interface; return chi, c (or u) and the answers.

    wanted : shape (n + AHEAD + 1, 2); load : chi -> true acceleration; seen : shape (n, 2), the
    estimate of it that the baseline is given
    """
    steps = len(reference) - AHEAD - 1
    generator = np.random.default_rng(5)
    speeds, command = np.zeros(2), np.zeros(2)
    record = np.zeros((3, steps, 2))
    for k in range(steps):
        observation = Observation(
            speeds + noise * generator.standard_normal(2),
            np.zeros(2) if seen is None else seen[k].copy(),
            reference[k].copy(),
            # Its slope is known at any rate, its jumps are not.
            reference[k]
            + np.where(np.abs(step := reference[k + 1] - reference[k]) < 0.3, step, 0.0),
            command.copy(),
            reference[k : k + AHEAD].copy() if baseline.preview else None,
        )
        u = baseline.step(observation)
        record[0, k], record[2, k] = speeds, u
        acting = np.zeros(2) if load is None else load(speeds)
        if drive == 'velocity':
            command = observation.speeds + PERIOD * u / (1.0 - KEPT)
            speeds = KEPT * speeds + (1.0 - KEPT) * command + LAG * (1.0 - KEPT) * acting
        else:
            command = u
            speeds = speeds + PERIOD * (u + acting)
        baseline.applied(u, limited=False)
        record[1, k] = command
    return record


def _jump(size, steps=200, at=100):
    """Return a reference that jumps up right and down left."""
    reference = np.zeros((steps + AHEAD + 1, 2))
    reference[at:] = size, -size
    return reference


def _energy(speeds, reference):
    """Return the integral of the squared error of one wheel, rad²/s."""
    return float(np.sum((speeds - reference[: len(speeds)]) ** 2) * PERIOD / 2.0)


def _wander(steps, seed=3):
    """Return a smooth reference with jumps, shape (steps + AHEAD + 1, 2)."""
    generator = np.random.default_rng(seed)
    time = PERIOD * np.arange(steps + AHEAD + 1)[:, None]
    reference = np.zeros((time.size, 2))
    for rate in (0.3, 0.7, 1.1):
        reference += 1.5 * np.sin(2 * np.pi * rate * time + generator.uniform(0, 6, 2))
    for at in range(60, steps, 90):
        reference[at:] += generator.uniform(-5, 5, 2)
    return reference


# -- the program ----------------------------------------------------------------------------------


def _random_program(generator):
    """Return a program, and H, g, low, high: sizes and scales of the field."""
    n = int(generator.integers(1, 41))
    steps = (generator.standard_normal(n), 1.0 - KEPT ** np.arange(1, n + 1), np.full(n, PERIOD))
    matrix = response_matrix(steps[generator.integers(0, 3)], n)
    hessian = matrix.T @ matrix + 10 ** generator.uniform(-5, 1) * np.eye(n)
    slope = matrix.T @ (generator.standard_normal(n).cumsum() * 10 ** generator.uniform(-2, 2))
    program = BoxProgram(hessian, 1.0)
    program.high[:] = 10 ** generator.uniform(-2, 2, n)
    program.low[:] = -program.high
    program.high[generator.random(n) < 0.1] = math.inf
    return program, hessian, slope


def test_programs_satisfy_karush_kuhn_tucker():
    generator = np.random.default_rng(8)
    for _ in range(100):
        program, hessian, slope = _random_program(generator)
        for last in (0.3 * slope, slope):  # the second one starts from the first
            x = program.solve(last)
            scale = np.abs(last).max() + (np.abs(hessian) @ np.abs(x)).max()
            gradient = (hessian @ x + last) / scale
            low, high = program.low, program.high
            assert np.all((x >= low) & (x <= high))
            at_low, at_high = np.isclose(x, low, 1e-9, 0.0), np.isclose(x, high, 1e-9, 0.0)
            assert np.abs(gradient[~at_low & ~at_high]).max(initial=0.0) < 1e-10
            assert gradient[at_low].min(initial=0.0) > -1e-10
            assert gradient[at_high].max(initial=0.0) < 1e-10


def test_a_program_without_optimum_leaves_the_last_moves():
    program = BoxProgram(np.eye(2), 1.0)
    kept = program.solve(np.array([-0.5, 3.0]))
    assert kept == pytest.approx([0.5, -1.0])
    assert program.solve(np.array([1.0, math.nan])) == pytest.approx(kept)
    assert program.solve(np.array([0.5, 0.0])) == pytest.approx([-0.5, 0.0])


# -- what is expected of the reference ------------------------------------------------------------


def test_future_goes_on_by_its_slope_but_a_jump_is_no_slope():
    ramp = np.array([[0.0, 5.0], [1.0, 5.0], [2.0, 5.0], [3.0, 9.0]])
    found = predict_reference(ramp, 1.0, 8, preview=True)
    assert np.array_equal(found[:, 0], np.arange(8.0))
    assert np.array_equal(found[:, 1], [5, 5, 5, 9, 9, 9, 9, 9])
    known = np.outer(np.arange(20.0), [1, 2])
    assert np.array_equal(predict_reference(known, 1.0, 8, preview=True), known[:8])
    # Without preview the slope dies away.
    fade = math.exp(-PERIOD / 0.2)
    found = predict_reference(np.array([[1.0, 0.0], [1.1, 0.0]]), fade, 400, preview=False)
    assert found[1, 0] == 1.1
    assert found[-1, 0] == pytest.approx(1.0 + 0.1 / (1.0 - fade), rel=1e-6)
    assert not found[:, 1].any()


# -- optimality -----------------------------------------------------------------------------------


def _dense(drive, before, speeds, reference, weight, nominal_model):
    """Return the best commands, shape (2, N), by simulating every unit input and least squares.

    wanted : shape (N, 2), for periods 1 ... N
    """
    n = len(reference)
    pole, push = (KEPT, 1.0 - KEPT) if drive == 'velocity' else (1.0, PERIOD)

    def outputs(start, commands):
        result, chi = [], start
        for command in commands:
            chi = pole * chi + push * command
            result.append(chi)
        return np.array(result)

    by_command = np.array([outputs(0.0, row) for row in np.eye(n)]).T
    changes = np.eye(n) - np.eye(n, k=-1)
    free = [outputs(speeds[z], np.zeros(n)) for z in range(2)]
    first = np.zeros((2, n))
    first[:, 0] = before
    if drive == 'velocity':
        answer = []
        for z in range(2):
            # unknown: changes of c
            sums = np.linalg.inv(changes)
            matrix = np.vstack((by_command @ sums, math.sqrt(weight) * np.eye(n)))
            held = by_command @ np.full(n, before[z])
            target = np.r_[reference[:, z] - free[z] - held, np.zeros(n)]
            reach = nominal_model.acceleration * PERIOD
            best = lsq_linear(matrix, target, (-reach, reach), 'bvls', tol=1e-15, max_iter=1000)
            answer.append(before[z] + sums @ best.x)
        return np.array(answer)
    inertia = wheel_inertia(nominal_model.robot.body, nominal_model.robot.geometry)
    one = np.vstack((by_command, math.sqrt(weight) * changes))
    target = [np.r_[reference[:, z] - free[z], math.sqrt(weight) * first[z]] for z in range(2)]
    limit = nominal_model.robot.drive.torque_limit
    best = lsq_linear(
        np.kron(np.linalg.inv(inertia), one),
        np.concatenate(target),
        (-limit, limit),
        'bvls',
        tol=1e-15,
        max_iter=1000,
    )
    return np.linalg.inv(inertia) @ best.x.reshape(2, n)


@pytest.mark.parametrize('drive', DRIVES)
@pytest.mark.parametrize('size', [0.02, 9.0])
def test_linear_plan_is_the_optimum_of_the_dense_program(drive, size):
    """Small: no bound is met. Large: some are, in the torque drive those of both motors."""
    nominal_model = _knowledge(drive)
    move_time = 0.01
    weight = (move_time / PERIOD) ** 2 if drive == 'velocity' else (move_time**2 / PERIOD) ** 2
    baseline = _make(LinearMpcPreview, drive, move_time=move_time)
    future = size * np.sin(0.2 * np.arange(41))[:, None] * [1.0, -0.4] + 0.1
    future[12:] += size, -size
    speeds, command = np.array([0.3, 0.1]), np.array([0.2, -0.1])
    baseline.applied(command, limited=False)
    u = baseline.step(Observation(speeds, np.zeros(2), future[0], future[1], command, future))
    best = _dense(drive, command, speeds, future[1:], weight, nominal_model)
    assert baseline.plan == pytest.approx(best, rel=1e-6, abs=1e-7 * max(1.0, np.abs(best).max()))
    first = u if drive == 'torque' else speeds + PERIOD * u / (1.0 - KEPT)
    assert first == pytest.approx(best[:, 0], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize('size', [10.0])
def test_jump_cost_equals_theory_with_and_without_preview(size):
    """Under a rate limit a, for a jump J.

    Without preview the command sets out when the jump comes: its ramp is J/a long, and the wheel
    is behind by a lag more. With preview the ramp is centred on the jump: a quarter of J³/(3a).
    """
    reference = _jump(size)
    ramp = size**3 / (3.0 * REACH)
    for late, early in ((LinearMpc, LinearMpcPreview), (DynamicMatrix, DynamicMatrixPreview)):
        costs = []
        for kind in (late, early):
            baseline = _make(kind, 'velocity', move_time=0.002)
            costs.append(_energy(_run(baseline, 'velocity', reference)[0], reference))
        assert costs[0] == pytest.approx(ramp + LAG * size**2, rel=0.02)
        assert costs[1] == pytest.approx(ramp / 4.0, rel=0.01)


@pytest.mark.parametrize('drive', DRIVES)
@pytest.mark.parametrize('kind', EVERY)
def test_bounds_are_never_left(kind, drive):
    baseline = _make(kind, drive, robot={}, move_time=0.003)
    inertia = wheel_inertia(
        baseline._nominal_model.robot.body, baseline._nominal_model.robot.geometry
    )
    _, command, u = _run(baseline, drive, _wander(300), noise=0.3)
    if drive == 'velocity':
        moves = np.diff(command, axis=0, prepend=0.0)
        assert np.abs(moves).max() <= REACH * PERIOD + 1e-9
        assert np.abs(moves).max() > 0.99 * REACH * PERIOD
    elif kind not in (DynamicMatrix, DynamicMatrixPreview):
        torque = np.abs(u @ inertia)
        assert torque.max() <= 0.4 + 1e-9
        assert torque.max() > 0.39


# -- disturbances, wrong models -------------------------------------------------------------------


@pytest.mark.parametrize('drive', DRIVES)
@pytest.mark.parametrize('kind', EVERY)
def test_no_offset_under_disturbance_and_model_error(kind, drive):
    """The shared estimate sees half of the disturbance."""
    push = np.array([5.0, -3.0])
    times = {'integral_time': 0.1, 'bias_time': 0.1, 'filter_time': 0.02}
    baseline = _make(kind, drive, model_error=1.3, disturbance_share=1.0, **times)
    reference = np.tile([2.0, 1.0], (300 + AHEAD + 1, 1))
    speeds, *_ = _run(baseline, drive, reference, lambda chi: push, np.tile(0.5 * push, (300, 1)))
    assert np.abs(speeds[150] - reference[0]).max() < 0.5
    assert np.abs(speeds[-1] - reference[0]).max() < 1e-6


@pytest.mark.parametrize('drive', few_of(DRIVES))
@pytest.mark.parametrize('kind', EVERY)
def test_knowing_the_friction_helps_where_the_estimate_is_late(kind, drive):
    """The estimate of a filter comes late by a tenth of a second, the sign of r does not."""
    robot = {'body.com_offset': 0.0}
    loads = WheelLoads(_knowledge(drive, robot))
    time = PERIOD * np.arange(300 + AHEAD + 1)
    reference = 3.0 * np.sin(6.0 * time)[:, None] * [1.0, -0.7]
    late = loads(reference[np.maximum(np.arange(300) - 10, 0)])
    errors = []
    for known in (robot, {**robot, 'friction.coulomb': 0.0, 'friction.viscous': 0.0}):
        baseline = _make(
            kind, drive, robot=known, disturbance_share=0.3 if known is robot else 1.0
        )
        speeds, *_ = _run(baseline, drive, reference, loads, late)
        errors.append(np.sqrt(np.mean((speeds - reference[:300])[100:] ** 2)))
    assert errors[0] < 0.7 * errors[1]


@pytest.mark.parametrize('kind', [CasadiNmpc, LinearMpcPreview])
def test_observer_parts_noise_from_following(kind):
    """With a true model a slow observer follows as sharply, and feeds back far less noise."""
    reference = _wander(200)
    quiet, noisy = [], []
    for filter_time in (0.001, 0.5):
        how = {'filter_time': filter_time, 'integral_time': 20.0, 'disturbance_share': 0.01}
        quiet.append(_run(_make(kind, 'velocity', **how), 'velocity', reference)[0])
        noisy.append(_run(_make(kind, 'velocity', **how), 'velocity', reference, noise=0.2)[0])
    assert np.abs(quiet[0] - quiet[1]).max() < 1e-3
    # It starts from a single noisy estimate, which takes its time to be forgotten.
    spread = [np.std((with_noise - quiet[0])[100:]) for with_noise in noisy]
    assert spread[1] < 0.6 * spread[0]


# -- dynamic matrix control -----------------------------------------------------------------------


@pytest.mark.parametrize('error', [1.0, 1.3])
def test_identified_responses_are_those_of_theory(error):
    nominal_model = _knowledge('velocity')
    steps, loads = identify_step_responses(wheel_model(nominal_model, error), 0.0, 41)
    passed = 1.0 - np.exp(-PERIOD * np.arange(1, len(steps) + 1) / (error * LAG))
    assert steps == pytest.approx(passed, abs=1e-12)
    assert loads == pytest.approx(error * LAG * passed, abs=1e-12)
    gain = 20.0
    steps, loads = identify_step_responses(wheel_model(_knowledge('torque'), error), gain, 41)
    passed = 1.0 - (1.0 - PERIOD * gain / error) ** np.arange(1, len(steps) + 1)
    assert steps == pytest.approx(passed, abs=1e-12)
    assert loads == pytest.approx(error / gain * passed, abs=1e-12)


def test_what_does_not_settle_cannot_be_identified():
    with pytest.raises(ValueError, match='settle'):
        identify_step_responses(wheel_model(_knowledge('torque'), 1.0), 0.0, 41)
    with pytest.raises(ValueError, match='settle'):
        _make(DynamicMatrix, 'torque', inner_gain=50.0, model_error=0.2)


@pytest.mark.parametrize('drive', DRIVES)
def test_convolution_of_moves_and_loads_is_the_wheel_itself(drive):
    """With a true model nothing is ever missed, however command and known disturbance move."""
    baseline = _make(DynamicMatrixPreview, drive, disturbance_share=1.0)
    seen = 4.0 * np.sign(np.sin(0.11 * np.arange(300)))[:, None] * [1.0, 0.5]
    missed, now, original = [], iter(seen), baseline.step

    def step(observation):
        u = original(observation)
        missed.append(np.abs(baseline.bias).max())
        return u

    baseline.step = step
    speeds, *_ = _run(baseline, drive, _wander(300), lambda chi: next(now), seen)
    assert np.abs(speeds).max() > 3.0
    assert max(missed) < 2e-3  # what of the responses is cut off


def test_dynamic_matrix_and_state_space_agree_on_a_true_model():
    """Peers with one model, one cost and one disturbance give one answer."""
    reference = _wander(300)
    same = {'move_time': 0.02, 'disturbance_share': 1.0}
    answers = [
        _run(_make(kind, 'velocity', **same), 'velocity', reference)[2]
        for kind in (LinearMpcPreview, DynamicMatrixPreview)
    ]
    assert np.abs(answers[0]).max() > 10.0
    assert np.abs(answers[0] - answers[1]).max() < 0.05


# -- nonlinear ------------------------------------------------------------------------------------


@pytest.mark.parametrize('drive', DRIVES)
def test_nonlinear_mpc_equals_linear_mpc_on_linear_wheels(drive):
    reference = _wander(120)
    seen = np.tile([2.0, -1.0], (120, 1))
    same = {'disturbance_share': 1.0, 'integral_time': 1.0}
    linear, nonlinear = (
        _run(_make(kind, drive, **same), drive, reference, lambda chi: seen[0], seen)[2]
        for kind in (LinearMpcPreview, CasadiNmpc)
    )
    assert np.abs(linear).max() > 20.0
    assert nonlinear == pytest.approx(linear, abs=1e-6)


@pytest.mark.parametrize('drive', DRIVES)
@pytest.mark.parametrize('factor', [1.0, 1.3])
def test_period_of_the_model_is_that_of_the_simulated_robot(drive, factor):
    """Friction, turning, and a body heavier than the nominal one that the servo knows."""
    casadi = pytest.importorskip('casadi')
    robot = PaperRobotParameters().with_values(
        {
            'mass_factor': factor,
            'inertia_factor': factor,
            'drive.kind': drive,
            'drive.dead_time': 0.0,
            'drive.acceleration': 0.0,
            'disturbance.bound': 0.0,
            'substep': PERIOD / 50,
        }
    )
    model = wheel_dynamics(_knowledge(drive, {}), factor, casadi)
    nominal = wheel_inertia(robot.body, robot.geometry)
    generator = np.random.default_rng(2)
    for _ in range(20):
        chi = generator.uniform(-6, 6, 2)
        command = generator.uniform(-30, 30, 2)
        told = nominal @ command if drive == 'torque' else chi + LAG * command
        plant = PaperPlant(robot)
        plant._state[5:] = chi
        plant._arrays.limited[:] = told
        plant.run(tuple(told), 50)
        given = command if drive == 'torque' else told
        reached = np.array(model(chi, given, np.zeros(2))[0]).ravel()
        assert reached == pytest.approx(np.array(plant.wheels), abs=5e-3)
        assert np.abs(reached - chi).max() > 5e-3


@pytest.mark.parametrize('lasting', [False, True])
def test_condensing_closes_the_gaps_and_superposes(lasting):
    """Against a run of the linearised model, with commands changed at will."""
    generator = np.random.default_rng(6)
    n = 7
    by_speed, by_command = generator.standard_normal((2, n, 2, 2))
    units, gaps = generator.standard_normal((2, 2)), generator.standard_normal((n, 2))
    response, closing = np.zeros((2 * n, 2 * n)), gaps.copy()
    condense(by_speed, by_command @ units, lasting, response, closing)
    moves = generator.standard_normal((n, 2))
    change, speeds = np.zeros(2), np.zeros(2)
    there = (response @ moves.ravel()).reshape(n, 2) + closing
    for j in range(n):
        change = lasting * change + units @ moves[j]
        speeds = by_speed[j] @ speeds + by_command[j] @ change + gaps[j]
        assert there[j] == pytest.approx(speeds, rel=1e-9, abs=1e-9)


def test_one_linearisation_a_step_follows_the_converged_plan():
    """Real-time iterations: what one leaves over, the next step takes up."""
    reference = _wander(90)
    once, often = (
        _run(_make(CasadiNmpc, 'velocity', robot={}, iterations=count), 'velocity', reference)[0]
        for count in (1, 4)
    )
    assert np.abs(once - often).max() < 0.02


def test_without_casadi_only_making_one_fails(monkeypatch):
    monkeypatch.setitem(sys.modules, 'casadi', None)
    with pytest.raises(ModuleNotFoundError, match='casadi'):
        CasadiNmpc(CasadiNmpcParameters(), _knowledge('velocity'))


# -- all ------------------------------------------------------------------------------------------


@pytest.mark.parametrize('drive', DRIVES)
@pytest.mark.parametrize('kind', EVERY)
def test_what_is_lent_stays_and_the_answer_too(kind, drive):
    reference = _wander(5)
    baseline = _make(kind, drive, robot={})
    lent = [np.array([0.1 * i, -0.2]) for i in range(1, 6)]
    copies = [array.copy() for array in lent]
    answer = baseline.step(Observation(*lent, reference[:AHEAD] if kind.preview else None))
    for array, copy in zip(lent, copies, strict=True):
        assert np.array_equal(array, copy)
    before = answer.copy()
    baseline.step(Observation(*lent, reference[:AHEAD] if kind.preview else None))
    assert np.array_equal(answer, before), 'the answer must not be overwritten by the next step'


def test_no_preview_and_settings_of_another_method_are_refused():
    baseline = _make(LinearMpcPreview, 'velocity')
    with pytest.raises(ValueError, match='future'):
        baseline.step(Observation(*(np.zeros(2) for _ in range(5)), None))
    with pytest.raises(ValueError, match='parameters must be LinearMpcPreviewParameters'):
        LinearMpcPreview(LinearMpcParameters(), _knowledge('velocity'))


@pytest.mark.parametrize('drive', DRIVES)
@pytest.mark.parametrize('kind', LINEAR)
def test_cut_answers_leave_no_wind_up(kind, drive):
    """A drive that lets only a tenth through for a while; afterwards all is as before."""
    baseline = _make(kind, drive)
    nominal_model = _knowledge(drive)
    speeds, command, far = np.zeros(2), np.zeros(2), np.array([6.0, -6.0])
    highest = 0.0
    for k in range(400):
        reference = far if k < 50 else 0.1 * far
        future = np.tile(reference, (AHEAD, 1)) if kind.preview else None
        u = baseline.step(
            Observation(speeds.copy(), np.zeros(2), reference, reference, command.copy(), future)
        )
        allowed = np.clip(u, -10.0, 10.0) if k < 200 else u
        if drive == 'velocity':
            command = speeds + PERIOD * allowed / nominal_model.share
            speeds = KEPT * speeds + (1.0 - KEPT) * command
        else:
            speeds = speeds + PERIOD * allowed
        baseline.applied(allowed, limited=bool(np.any(allowed != u)))
        if k > 100:
            highest = max(highest, float(np.abs(speeds - 0.1 * far).max()))
    assert highest < 4.5  # how far it had come when it was called back
    assert np.abs(speeds - 0.1 * far).max() < 1e-3
