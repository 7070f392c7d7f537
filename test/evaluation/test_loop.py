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
"""The closed loop at kernel speed: same physics, same runs, honest cases and statistics."""

from copy import deepcopy
from dataclasses import dataclass
import math

import numpy as np
import pytest
from support.records import record_of

from t3mpc_ros.control.velocity_actuation import VelocityActuation
from t3mpc_ros.evaluation import loop
from t3mpc_ros.evaluation.baselines.baseline_controller import BaselineController
from t3mpc_ros.evaluation.cases import CASES, NO_FAULTS, PLANTS
from t3mpc_ros.evaluation.confidence_intervals import interval, mean, paired, student_quantile
from t3mpc_ros.evaluation.experiment import JobError, WorkerPool
from t3mpc_ros.evaluation.loop import MadeMethod, MethodSpec, run
from t3mpc_ros.evaluation.proposed_method import ProposedController, ProposedParameters
from t3mpc_ros.evaluation.run_record import RATE
from t3mpc_ros.evaluation.scenario import (
    HELD_OUT_SEEDS,
    KINDS,
    PRETRAINING_SEEDS,
    TUNING_SEEDS,
    Scenario,
)
from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.parameters.table import Parameters, parameter
from t3mpc_ros.simulation.paper_robot import PaperRobot
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia
from t3mpc_ros.simulation.plant.paper_plant import PaperPlant, PaperRobotParameters

pytestmark = pytest.mark.slow

# -- methods to run ---------------------------------------------------------------------------


@dataclass(frozen=True)
class ProportionalParameters(Parameters):
    gain: float = parameter(8.0, 'feedback gain', '1/s')
    broken_from: int = parameter(-1, 'step from which the answer is not a number')
    fails: bool = parameter(False, 'whether it raises an exception')


class Proportional(BaselineController):
    """Feed-forward, proportional feedback, and the unexplained acceleration cancelled."""

    parameters_type = ProportionalParameters

    def __init__(self, parameters, nominal_model):
        self.parameters, self.nominal_model, self.steps = parameters, nominal_model, 0

    def step(self, observation):
        if self.parameters.fails:
            raise ZeroDivisionError('on purpose')
        self.steps += 1
        if 0 <= self.parameters.broken_from < self.steps:
            return np.full(2, math.nan)
        slope = (observation.next_reference - observation.reference) / self.nominal_model.period
        return (
            slope
            - self.parameters.gain * (observation.speeds - observation.reference)
            - observation.unexplained
        )


class Foreseeing(Proportional):
    preview = True


class Noting(Proportional):
    """Notes what it is shown and told, and publishes terms."""

    def __init__(self, parameters, nominal_model):
        super().__init__(parameters, nominal_model)
        self.seen, self.answers, self.told, self.terms = [], [], [], np.zeros((5, 2))

    def step(self, observation):
        self.seen.append(deepcopy(observation))
        self.answers.append(super().step(observation))
        self.terms = np.zeros((5, 2))
        self.terms[2] = self.answers[-1]
        return self.answers[-1].copy()

    def applied(self, acceleration, *, limited):
        self.told.append((acceleration.copy(), limited))


class ForeseeingNoting(Noting):
    preview = True


P = MethodSpec('P', Proportional, ProportionalParameters())
FULL = MethodSpec('full', ProposedController, ProposedParameters())


def noted(kind, scenario):
    """Return a run, and the method that noted it."""
    made = MadeMethod(kind(ProportionalParameters(), scenario.nominal_model()))
    return run(scenario, made), made.controller


def assert_equal_records(first, second):
    assert first.columns.keys() == second.columns.keys()
    for name, column in first.columns.items():
        np.testing.assert_array_equal(column, second[name])


# -- the plant --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'drive, changes',
    [
        (
            'velocity',
            {'noise.variance': 0.1, 'drive.dead_time': 0.03, 'disturbance.walk_rate': 20.0},
        ),
        (
            'torque',
            {'mass_factor': 1.3, 'inertia_factor': 0.8, 'substep': 0.0007, 'rate': 200.0},
        ),
    ],
    ids=['late, wild walk', 'heavy, other grid'],
)
def test_the_plant_of_the_loop_is_that_of_the_simulated_robot(drive, changes):
    """Limiter, odometry and time grid of the robot change nothing within the limits."""
    parameters = PaperRobotParameters.from_dict({'drive.kind': drive, 'seed': 7, **changes})
    later = parameters.with_values({'mass_factor': 1.7, 'friction_factor': 0.5})
    steps, generator = 300, np.random.default_rng(1)
    robot, plant = PaperRobot(parameters), PaperPlant(parameters)
    state, measured = robot.advance(0), plant.measure(0.0)
    command = np.zeros(2)
    for k in range(steps):
        assert measured == state.wheels
        if k == steps // 2:
            robot.configure(later)
            plant.configure(later)
        if drive == 'torque':
            # Beyond the torque limit of 0.4 N m now and then.
            command = generator.normal(0.0, 0.2, 2)
            state = robot.step_torque(*command.tolist())
        else:
            # Within what the guard passes: 30 rad/s² and 10 rad/s.
            reach = 28.0 / parameters.rate
            command = np.clip(command + generator.uniform(-reach, reach, 2), -7.0, 7.0)
            state = robot.step(WheelSpeeds(*command.tolist()))
        plant.run(tuple(command.tolist()), parameters.substeps)
        measured = plant.measure(parameters.substeps * parameters.step)
        assert plant.wheels == state.true_wheels
        assert plant.pose == state.truth.pose
    assert max(map(abs, plant.wheels)) > 0.1  # it did move


# -- scenarios --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'changes, text',
    [
        ({'robot': 'belt'}, 'robot must be one of twin, servo, torque: got belt'),
        ({'case': 'windy'}, 'case must be one of nominal, .*: got windy'),
        ({'case': 'dead time'}, 'case must be one of nominal, .*: got dead time'),
        ({'noise': -0.1}, r'noise must be from 0 to 100 \(rad/s\)²: got -0.1'),
        ({'noise': math.nan}, 'noise must be from 0 to 100 .*: got nan'),
        ({'seed': -1}, 'seed must be a whole number of at least 0: got -1'),
        ({'seed': 1.5}, 'seed must be a whole number of at least 0: got 1.5'),
        ({'duration': 0.0}, 'duration must be from 0.01 to 3600 s: got 0.0'),
        ({'gyro': True}, 'gyro is for the twin alone: got robot torque'),
        ({'robot': 'twin', 'duration': 1.9}, 'duration must be from 2 to 3600 s: got 1.9'),
    ],
)
def test_a_scenario_names_what_is_wrong_with_it(changes, text):
    with pytest.raises(ValueError, match=text):
        Scenario(**({'robot': 'torque', 'case': 'nominal', 'seed': 1} | changes))


def test_tuning_held_out_and_robot_seeds_are_disjoint():
    assert len(TUNING_SEEDS) == 9
    assert len(HELD_OUT_SEEDS) == 20
    seeds = [*TUNING_SEEDS, *PRETRAINING_SEEDS, *HELD_OUT_SEEDS]
    robots = [Scenario('torque', 'nominal', seed, noise=0.0).true_robot().seed for seed in seeds]
    assert len({*seeds, *robots}) == 2 * len(seeds)


EXPECTED = {
    'mass +30 %': {'mass_factor': 1.3, 'inertia_factor': 1.3},
    'mass -30 %': {'mass_factor': 0.7, 'inertia_factor': 0.7},
    'friction x3': {'friction_factor': 3.0},
    'disturbance': {'disturbance.bound': 0.006},
    'dead time': {'drive.dead_time': 0.03},
    'dead time 60 ms': {'drive.dead_time': 0.06},
    'unknown dead time': {'drive.dead_time': 0.03},
    'unknown dead time 60 ms': {'drive.dead_time': 0.06},
}


@pytest.mark.parametrize(
    'case, robot',
    [(name, robot) for name in CASES for robot in CASES[name].robots if robot in PLANTS],
)
def test_only_the_dead_time_of_a_case_is_known_to_methods(case, robot):
    scenario = Scenario(robot, case, 3, noise=0.07)
    drive = KINDS[robot].drive
    plain = PaperRobotParameters.from_dict(
        {'drive.kind': drive, 'noise.variance': 0.07, 'seed': scenario.true_robot().seed}
    ).to_dict()
    true = scenario.true_robot().to_dict()
    expected = EXPECTED.get(case, {})
    assert {k: true[k] for k in true if true[k] != plain[k]} == pytest.approx(expected)
    told = scenario.nominal_model().robot
    nominal = PaperRobotParameters.from_dict({'drive.kind': drive}).to_dict()
    known = {name: value for name, value in told.to_dict().items() if value != nominal[name]}
    is_known = case in ('dead time', 'dead time 60 ms')
    assert known == (expected if is_known else {})
    estimate = scenario.estimate()
    assert estimate.noise_variance == 0.07
    assert estimate.lag == told.drive.lag
    assert estimate.dead_time == (expected['drive.dead_time'] if is_known else 0.01)


@pytest.mark.parametrize('robot', PLANTS)
def test_every_case_affects_the_run_load_change_from_half(robot):
    runs = {
        case: run(Scenario(robot, case, 2, 2.0), P)
        for case in CASES
        if robot in CASES[case].robots and CASES[case].links == NO_FAULTS
    }
    nominal = runs.pop('nominal')
    for case, changed in runs.items():
        differs = np.flatnonzero((changed.speeds != nominal.speeds).any(axis=1))
        assert differs.size > 50, case
        np.testing.assert_array_equal(changed.reference, nominal.reference)
        np.testing.assert_allclose(
            changed['measured'] - changed.speeds, nominal['measured'] - nominal.speeds, atol=1e-12
        )
        assert differs[0] == 101 if case == 'load change' else differs[0] < 10


def test_faults_of_the_links_begin_in_time():
    nominal, overload = (
        run(Scenario('servo', case, 2, 12.0), P) for case in ('nominal', 'overload')
    )
    begin = 600
    np.testing.assert_array_equal(nominal.speeds[: begin + 1], overload.speeds[: begin + 1])
    np.testing.assert_array_equal(nominal.reference, overload.reference)
    span = slice(begin + 50, begin + 400)
    error = [np.sqrt(np.mean(record.error[span] ** 2)) for record in (nominal, overload)]
    assert error[1] > 1.5 * error[0]
    assert overload.finite


def test_a_method_knows_how_fast_both_wheels_may_change_at_once():
    known = Scenario('servo', 'nominal', 1, noise=0.0).nominal_model()
    geometry, limits = known.robot.geometry, Scenario('servo', 'nominal', 1, noise=0.0).limits
    for right, left in ((1, 1), (1, -1), (1, 0)):
        linear = 0.5 * geometry.wheel_radius * (right + left) * known.acceleration
        angular = 0.5 * geometry.wheel_radius * (right - left) / geometry.half_separation
        assert abs(linear) <= limits.linear_acceleration * (1 + 1e-12)
        assert abs(angular * known.acceleration) <= limits.angular_acceleration * (1 + 1e-12)
    assert 28.0 < known.acceleration <= limits.wheel_acceleration
    assert Scenario('torque', 'nominal', 1, noise=0.0).nominal_model().acceleration == math.inf
    assert known.period == 0.01


# -- the reference ----------------------------------------------------------------------------


@pytest.mark.long
def test_reference_deviation_is_three_rad_per_second():
    values = np.array(
        [
            Scenario('torque', 'nominal', s, noise=0.0).reference().speeds[300:6000]
            for s in TUNING_SEEDS[:5]
        ]
    )
    assert values.std(axis=(0, 1)) == pytest.approx([3.0, 3.0], rel=0.08)
    assert np.abs(values.mean(axis=(0, 1))).max() < 0.5


@pytest.mark.parametrize('seed', [1, 101])
def test_reference_jumps_only_at_switches_its_slope_does_not(seed):
    reference = Scenario('servo', 'nominal', seed, noise=0.0).reference()
    switches = [1200, 2400, 3600, 4800, 6000]  # the last one lies in the preview
    assert np.flatnonzero(reference.switched).tolist() == switches
    assert (np.flatnonzero(np.diff(reference.modes)) + 1).tolist() == switches
    # Between switches r is the integral of its slope (trapezoid).
    jump = np.diff(reference.speeds, axis=0) - 0.5 / RATE * (
        reference.rate[1:] + reference.rate[:-1]
    )
    size = np.abs(jump).max(axis=1)
    assert (np.flatnonzero(size > 0.1) + 1).tolist() == switches
    assert np.delete(size, np.array(switches) - 1).max() < 0.005
    assert np.abs(reference.rate).max() < 80.0
    assert reference.time[-1] > 60.0 + 0.4 + 0.03


def test_a_reference_is_computed_once_and_cannot_be_written_to():
    first = Scenario('torque', 'nominal', 5, 3.0, noise=0.0).reference()
    assert Scenario('servo', 'friction x3', 5, 3.0, noise=0.1).reference() is first
    assert Scenario('torque', 'nominal', 6, 3.0, noise=0.0).reference() is not first
    with pytest.raises(ValueError, match='read-only'):
        first.speeds[0] = 1.0


# -- the loop ---------------------------------------------------------------------------------


@pytest.mark.parametrize('method', [P, FULL], ids=lambda method: method.name)
@pytest.mark.parametrize('robot', PLANTS)
def test_equal_runs_are_equal_bit_for_bit_whatever_ran_between(robot, method):
    scenario = Scenario(robot, 'mass +30 %', 4, 3.0)
    first = run(scenario, method)
    run(Scenario(robot, 'nominal', 5, 1.0, noise=0.1), MethodSpec('F', Foreseeing, P.parameters))
    assert_equal_records(first, run(scenario, method))
    other = run(Scenario(robot, 'mass +30 %', 5, 3.0), method)
    assert not np.array_equal(first.speeds, other.speeds)


@pytest.mark.parametrize('robot', PLANTS)
def test_a_simple_controller_tracks_in_both_drives(robot):
    record = run(Scenario(robot, 'nominal', 1, 14.0, noise=0.0), P)
    assert record.finite
    assert record.rmse() < 0.5  # by the jump at 12 s
    assert record.rmse(margins=(0.4, 0.6)) < 0.15


@pytest.mark.parametrize('robot', PLANTS)
def test_what_is_recorded_fits_together(robot):
    scenario = Scenario(robot, 'nominal', 9, 14.0)
    record, method = noted(Noting, scenario)
    reference = scenario.reference()
    np.testing.assert_array_equal(record.reference, reference.speeds[:1400])
    assert record.time[-1] == 13.99
    noise = record['measured'] - record.speeds
    assert np.var(noise) == pytest.approx(0.04, rel=0.1)
    np.testing.assert_array_equal(record['terms'][:, 2], method.answers)
    np.testing.assert_array_equal(record['acceleration'], [told[0] for told in method.told])
    np.testing.assert_array_equal(record['limited'], [told[1] for told in method.told])
    np.testing.assert_array_equal(
        record['unexplained'], [seen.unexplained for seen in method.seen]
    )
    if robot == 'torque':
        inertia = wheel_inertia(scenario.true_robot().body, scenario.true_robot().geometry)
        np.testing.assert_allclose(record['sent'], record['acceleration'] @ inertia, atol=1e-15)
        np.testing.assert_array_equal(record['estimated'], [seen.speeds for seen in method.seen])
        assert not record['limited'].any()
    else:
        commands = np.array([seen.command for seen in method.seen])
        np.testing.assert_array_equal(record['sent'][:-1], commands[1:])
        change = np.abs(np.diff(record['sent'], axis=0)).max() * RATE
        assert change <= scenario.limits.wheel_acceleration * (1 + 1e-9)
        assert record['limited'].any()  # the jump at 12 s cannot be followed at once


@pytest.mark.parametrize(
    'robot, case, late',
    [('torque', 'nominal', 0), ('servo', 'nominal', 1), ('servo', 'dead time', 3)],
)
def test_observation_holds_the_reference_after_the_dead_time(robot, case, late):
    scenario = Scenario(robot, case, 6, 12.5)
    sampled = scenario.reference()
    _, blind = noted(Noting, scenario)
    _, seer = noted(ForeseeingNoting, scenario)
    for k in (0, 500, 1200 - late - 1, 1200 - late, 1199, 1200, 1249):
        seen = seer.seen[k]
        assert seen.future.shape == (40, 2)
        np.testing.assert_array_equal(seen.future, sampled.speeds[k + late : k + late + 40])
        np.testing.assert_array_equal([seen.reference, seen.next_reference], seen.future[:2])
        seen = blind.seen[k]
        assert seen.future is None
        r, slope = sampled.speeds[k], sampled.rate[k]
        np.testing.assert_allclose(seen.reference, r + late * 0.01 * slope, atol=1e-12)
        np.testing.assert_allclose(seen.next_reference, r + (late + 1) * 0.01 * slope, atol=1e-12)


class NotingActuation(VelocityActuation):
    """Notes what it is fed; ``assumed`` is the dead time (s) that it assumes, if not its own."""

    log, times, assumed = [], [], None

    def __init__(self, estimate, *arguments):
        if self.assumed is not None:
            estimate = estimate.with_values({'dead_time': self.assumed})
        super().__init__(estimate, *arguments)
        self.log.clear()
        self.times.clear()

    def reset(self, speeds):
        self.log.append(('reset', speeds.copy()))
        super().reset(speeds)

    def observe(self, measured, dt):
        self.times.append(dt)
        self.log.append(('observe', measured.copy()))
        super().observe(measured, dt)

    def send_acceleration(self, acceleration, *rest):
        self.log.append(('send', acceleration.copy()))
        return super().send_acceleration(acceleration, *rest)


@pytest.mark.parametrize('robot', PLANTS)
def test_estimator_gets_every_measurement_once_in_order(robot, monkeypatch):
    scenario = Scenario(robot, 'nominal', 6, 1.0)
    expected = run(scenario, P)
    monkeypatch.setattr(loop, 'VelocityActuation', NotingActuation)
    record, log = run(scenario, P), NotingActuation.log
    assert [entry[0] for entry in log] == ['reset', *['observe', 'send'] * 100]
    np.testing.assert_array_equal(log[0][1], record['measured'][0])
    np.testing.assert_array_equal([entry[1] for entry in log[1::2]], record['measured'])
    assert_equal_records(record, expected)


def test_method_and_estimator_know_of_lost_measurements(monkeypatch):
    monkeypatch.setattr(loop, 'VelocityActuation', NotingActuation)
    scenario = Scenario('servo', 'dropouts', 2, 10.0)
    record, method = noted(Noting, scenario)
    elapsed = np.array([seen.elapsed for seen in method.seen])
    assert 850 < len(elapsed) < 950
    assert 990 < sum(elapsed) <= scenario.steps
    np.testing.assert_allclose(NotingActuation.times, 0.01 * elapsed)
    held = (record['sent'][1:] == record['sent'][:-1]).all(axis=1).sum()
    assert held == scenario.steps - len(elapsed)
    assert_equal_records(record, noted(Noting, scenario)[0])


def test_estimator_and_method_get_the_torque_limited_u():
    scenario = Scenario('torque', 'nominal', 9, 14.0, noise=0.0)
    method = MethodSpec('steep', Proportional, ProportionalParameters(gain=80.0))
    record = run(scenario, method)
    limit = scenario.true_robot().drive.torque_limit
    inertia = wheel_inertia(scenario.true_robot().body, scenario.true_robot().geometry)
    np.testing.assert_allclose(record['sent'], record['acceleration'] @ inertia, atol=1e-12)
    assert np.abs(record['sent']).max() == pytest.approx(limit, rel=1e-12)
    cut = np.abs(record['sent']).max(axis=1) > limit * (1 - 1e-9)
    np.testing.assert_array_equal(record['limited'], cut)
    # Else the estimate would be off by whole rad/s after the jump.
    assert np.abs(record['estimated'] - record.speeds).max() < 0.3


def test_an_answer_that_is_no_number_ends_the_run_and_shows():
    method = MethodSpec('broken', Proportional, ProportionalParameters(broken_from=50))
    record = run(Scenario('torque', 'nominal', 1, 4.0), method)
    whole = run(Scenario('torque', 'nominal', 1, 4.0), P)
    assert not record.finite
    assert math.isnan(record.rmse())
    np.testing.assert_array_equal(record.speeds[:50], whole.speeds[:50])
    for name in ('measured', 'speeds', 'estimated', 'acceleration', 'sent', 'unexplained'):
        assert np.isnan(record[name][50:]).all(), name
    np.testing.assert_array_equal(record.reference, whole.reference)


def test_what_does_not_fit_the_loop_is_refused(monkeypatch):
    scenario = Scenario('servo', 'nominal', 1, 1.0, noise=0.0)
    for dead_time, text in ((0.013, 'dead time must be whole periods'), (0.2, 'at most 0.0')):
        with monkeypatch.context() as patch:
            patch.setattr(loop, 'VelocityActuation', NotingActuation)
            patch.setattr(NotingActuation, 'assumed', dead_time)
            with pytest.raises(ValueError, match=text):
                run(scenario, P)
    with pytest.raises(
        ValueError, match='parameters of P must be ProportionalParameters: got Limit'
    ):
        MethodSpec('P', Proportional, scenario.limits)


# -- many runs --------------------------------------------------------------------------------


def whole(job):
    return run(*job)


def rmse(job):
    return run(*job).rmse(1.0)


def test_many_runs_are_the_same_in_one_process_and_in_two():
    jobs = [
        (
            Scenario(robot, 'load change', seed, 2.0),
            MethodSpec(f'P {gain}', Proportional, ProportionalParameters(gain=gain)),
        )
        for robot in [*PLANTS][:2]
        for seed, gain in ((1, 4.0), (2, 9.0))
    ]
    alone = dict(WorkerPool(1).map(whole, jobs))
    assert sorted(alone) == list(range(len(jobs)))
    bad = (jobs[0][0], MethodSpec('bad', Proportional, ProportionalParameters(fails=True)))
    with WorkerPool(2) as workers:
        together = dict(workers.map(whole, iter(jobs)))
        assert sorted(together) == sorted(alone)
        for index, record in together.items():
            assert_equal_records(record, alone[index])
        # The same processes serve the next batch, and outlive a failed one.
        assert dict(workers.map(rmse, jobs)) == {
            index: record.rmse(1.0) for index, record in alone.items()
        }
        with pytest.raises(JobError, match=r'bad on servo, .*, load change, seed 1 failed: Zero'):
            list(workers.map(whole, [jobs[1], bad, *jobs]))
        assert len(dict(workers.map(whole, jobs[:3]))) == 3
    with pytest.raises(JobError, match=r'bad on servo.*on purpose'):
        list(WorkerPool(1).map(whole, [jobs[1], bad]))
    with pytest.raises(ValueError, match='workers must be at least 1: got 0'):
        WorkerPool(0)


# -- records ----------------------------------------------------------------------------------


def test_rmse_leaves_out_the_start_and_what_follows_a_switch():
    record = record_of(np.arange(10.0), switches=[6.0])
    record.speeds[:, 0] = [9, 9, 9, 1, 1, 1, 7, 7, 1, 1]
    record.reference[:, 1] = [9, 9, 9, 1, 1, 1, 7, 7, 1, 1]
    assert record.rmse(margins=(0.8, 1.2)) == 1.0
    assert record.rmse() == pytest.approx(math.sqrt((5 + 2 * 49) / 7))
    assert record.largest_error(3.0) == 7.0
    assert record.largest_error(0.0) == 9.0
    with pytest.raises(ValueError, match='must leave rows of a run that ends at 9 s: got 20 s'):
        record.rmse(20.0)


@pytest.mark.parametrize('switch', [8.9, 9.1, 9.5, 9.8])
def test_a_crossing_counts_whole_or_not_at_all(switch):
    """A run of 60 s ended at the switch at 60 s, and preview paid for the half before it."""
    record = record_of(np.arange(96) / 10.0, switches=[5.0, switch])
    record.speeds[:] = 1.0
    record.speeds[record.time > switch - 0.5] = 100.0
    counted = 1.0 if switch + 0.5 > 9.5 else 100.0
    assert record.largest_error(3.0) == counted
    assert (record.rmse() == 1.0) == (counted == 1.0)


def test_variation_is_that_of_the_effort_per_second_and_wheel():
    u = np.zeros((101, 2))
    u[:, 0] = np.arange(101)  # rises by 100 in a second
    u[1::2, 1] = 1.0  # to and fro: 100 as well
    time = np.arange(101) * 0.01
    record = record_of(time, acceleration=u)
    assert record.variation() == pytest.approx(100.0)
    assert record.variation(time >= 0.5) == pytest.approx(100.0)
    sent = np.cumsum(u, axis=0) * 0.01
    assert record_of(time, drive='velocity', sent=sent).variation() == pytest.approx(100.0)
    with pytest.raises(ValueError, match='at least 2 rows: got 1'):
        record_of([0.0]).variation()


def test_a_column_that_a_run_lacks_is_named():
    with pytest.raises(KeyError, match='no column truth: it has reference, measured'):
        record_of([0.0])['truth']


# -- statistics -------------------------------------------------------------------------------


def test_quantiles_are_students():
    from scipy.stats import t as student_of_scipy  # not by the processes that import this file

    for degrees in [*range(1, 60), 99, 100, 999, 1000, 20_001]:
        for confidence in (0.5, 0.95, 0.999):
            expected = student_of_scipy.ppf(0.5 + 0.5 * confidence, degrees)
            assert student_quantile(degrees, confidence) == pytest.approx(expected, rel=1e-10)
    assert student_quantile(1) == pytest.approx(12.706, abs=5e-4)
    assert student_quantile(19) == pytest.approx(2.093, abs=5e-4)
    with pytest.raises(ValueError, match='degrees must be at least 1: got 0'):
        student_quantile(0)
    with pytest.raises(ValueError, match='confidence must be above 0 and below 1: got 1.0'):
        student_quantile(3, 1.0)


def test_the_interval_of_a_mean_is_students():
    from scipy.stats import sem
    from scipy.stats import t as student_of_scipy

    for n in (2, 5, 20):
        values = np.random.default_rng(n).normal(5.0, 2.0, n)
        bounds = student_of_scipy.interval(0.95, n - 1, mean(values), sem(values))
        assert mean(values) + interval(values) * np.array([-1.0, 1.0]) == pytest.approx(bounds)
    assert interval([1.0]) == math.inf
    with pytest.raises(ValueError, match='must not be empty'):
        mean([])


def test_pairing_takes_out_what_both_have():
    generator = np.random.default_rng(4)
    seeds = generator.normal(0.0, 10.0, 20)
    a, b = (seeds + shift + generator.normal(0.0, 0.1, 20) for shift in (1.0, 0.0))
    difference = paired(a, b)
    assert difference.mean == pytest.approx(mean(a) - mean(b))
    assert difference.half == pytest.approx(interval(a - b))
    assert {paired(a, b).sign, paired(b, a).sign} == {-1, 1}
    assert paired(seeds, seeds[::-1]).sign == 0
    with pytest.raises(ValueError, match='equally many: got 20 and 19'):
        paired(a, b[1:])


# -- pretraining ------------------------------------------------------------------------------


class Counting(BaselineController):
    """Learns how many steps it has done."""

    parameters_type = ProportionalParameters

    def __init__(self, parameters, nominal_model):
        self.steps = np.zeros(1)

    def step(self, observation):
        self.steps += 1.0
        return np.zeros(2)

    def get_weights(self):
        return {'steps': self.steps.copy()}

    def set_weights(self, learnt):
        self.steps = learnt['steps'].copy()


def test_pretraining_carries_weights_from_run_to_run(monkeypatch):
    assert loop.PRETRAINING_DURATION == 40.0
    monkeypatch.setattr(loop, 'PRETRAINING_DURATION', 4.0)
    nominal_model = Scenario('torque', 'nominal', 101, noise=0.0).nominal_model()
    fresh = MethodSpec('count', Counting, ProportionalParameters())(nominal_model)
    pretrained = MethodSpec('count', Counting, ProportionalParameters(), pretrained=True)
    assert fresh.steps[0] == 0.0
    for _ in range(2):  # the second is the first's equal: nothing of a run is carried over
        controller = pretrained(nominal_model)
        assert controller.steps[0] == len(PRETRAINING_SEEDS) * 400
        controller.step(None)
    plain = MethodSpec('P', Proportional, ProportionalParameters(), pretrained=True)
    assert plain(nominal_model).get_weights() == {}
