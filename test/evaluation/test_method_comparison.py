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
"""Comparison: equal runs, pairing, what each case changes, feed-forward against its plan."""

from dataclasses import replace
from itertools import product
import json
import math
import re

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.cli.main import main
from t3mpc_ros.cli.shared_options import ROBOTS
from t3mpc_ros.control.controller import Controller, StepperControllerParameters
from t3mpc_ros.evaluation import comparison
from t3mpc_ros.evaluation.baselines.baseline_controller import NominalModel, Observation
from t3mpc_ros.evaluation.baselines.feed_forward import FeedForward, FeedForwardParameters
from t3mpc_ros.evaluation.baselines.feedback_control import (
    ProportionalIntegral,
    ProportionalIntegralParameters,
)
from t3mpc_ros.evaluation.cases import NOMINAL, LinkFaults, cases_for
from t3mpc_ros.evaluation.comparison import draw_seeds, record
from t3mpc_ros.evaluation.experiment import ResultTable, measured_run
from t3mpc_ros.evaluation.loop import (
    MethodDriver,
    MethodSpec,
    NodeDriver,
    reports_of,
    run,
    run_loop,
)
from t3mpc_ros.evaluation.method_table import (
    FEED_FORWARD,
    FULL,
    default_methods,
    methods_for,
    twin_start,
)
from t3mpc_ros.evaluation.run_record import DRIFT, SETTLED, STOPPED, YAW_RATE, measure, stamp_of
from t3mpc_ros.evaluation.scenario import (
    HELD_OUT_SEEDS,
    KINDS,
    PRETRAINING_SEEDS,
    TUNING_SEEDS,
    Scenario,
    noisy_twin,
)
from t3mpc_ros.geometry.kinematics import twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, Pose, State, WheelSpeeds
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

T = 0.01
PI = 'PI + feed-forward'


def twin(case='nominal', method=FEED_FORWARD, seed=201, duration=4.0, **changes):
    """Return scenario and record of a short run on the twin."""
    scenario = Scenario('twin', case, seed, duration, **changes)
    return scenario, run(scenario, methods_for('twin')[method])


def ideal_drive(commands, lag, late, steps, substeps=20):
    """Return the speeds of a servo whose command arrives ``late`` periods after it is sent."""
    chi, keep = np.zeros(2), math.exp(-T / substeps / lag)
    speeds = np.empty((steps * substeps, 2))
    for k in range(steps):
        command = commands[k - late] if k >= late else np.zeros(2)
        for i in range(substeps):
            speeds[k * substeps + i] = chi
            chi = command + keep * (chi - command)
    return speeds


def commands_of(forward, model, reference, late, skip=()):
    """Return the commands of feed-forward along a reference; no measurement enters them."""
    rows = len(reference) - 45
    commands, last = np.empty((rows, 2)), -1
    for k in range(rows):
        if k in skip:
            commands[k] = commands[k - 1]
            continue
        future = reference[k + late : k + 41]
        observation = Observation(
            np.full(2, 7.0), np.zeros(2), future[0], future[1], np.zeros(2), future, k - last
        )
        u = forward.step(observation)
        commands[k] = observation.speeds + T * u / model.share
        last = k
    return commands


def servo_model(lag=0.02):
    return NominalModel('velocity', T, lag, 28.0, PaperRobotParameters())


# --- pure feed-forward --------------------------------------------------------------------------


@pytest.mark.parametrize(('lag', 'late'), [(0.003, 1), (0.02, 1), (0.02, 3)])
def test_on_an_ideal_drive_feed_forward_is_the_reference(lag, late):
    """The mean error of a ramp and a slow sine is far below what one period of delay costs."""
    time = T * np.arange(600)
    sine = np.column_stack([2.0 * np.sin(3.0 * time), 1.0 * time])
    model = servo_model(lag)
    commands = commands_of(FeedForward(FeedForwardParameters(), model), model, sine, late)
    speeds = ideal_drive(commands, lag, late, len(commands))
    fine = (T / 20) * np.arange(len(speeds))
    truth = np.column_stack([2.0 * np.sin(3.0 * fine), 1.0 * fine])
    error = (speeds - truth)[fine > 1.0]
    one_period = T * np.sqrt(np.mean(np.diff(truth, axis=0)[2000:] ** 2)) / (T / 20)
    assert abs(error.mean(axis=0)).max() < 0.03 * one_period
    assert np.sqrt(np.mean(error**2)) < 0.5 * one_period


def test_feed_forward_crosses_a_jump_half_way_by_its_ramp():
    reference = np.zeros((300, 2))
    reference[150:] = 3.0, -3.0
    model = servo_model()
    commands = commands_of(FeedForward(FeedForwardParameters(), model), model, reference, 1)
    change = np.diff(commands, axis=0) / T
    assert np.abs(change).max() <= 30.0 + 1e-6
    assert np.abs(commands[:100]).max() < 1e-9
    assert commands[-1] == pytest.approx([3.0, -3.0])
    speeds = ideal_drive(commands, model.lag, 1, len(commands))
    right = speeds[:, 0]
    middle = np.argmax(right >= 1.5) * T / 20
    # The jump of the samples lies between rows 149 and 150; the servo's lag rounds the ramp.
    assert middle == pytest.approx(1.495, abs=0.004)


def test_lost_measurements_do_not_delay_the_ramp():
    """After a gap within a ramp the commands are those of the run without it."""
    reference = np.zeros((300, 2))
    reference[150:] = 4.0, 2.0
    model = servo_model()
    whole, gap = (
        commands_of(FeedForward(FeedForwardParameters(), model), model, reference, 1, skip)
        for skip in ((), range(140, 147))
    )
    assert np.array_equal(whole[:140], gap[:140])
    assert np.abs(whole[147:] - gap[147:]).max() < 1e-9
    assert np.abs(whole[140:147] - gap[140:147]).max() > 0.1


def test_feed_forward_of_torques_is_the_rate_of_the_plan():
    wave = np.column_stack([np.sin(0.03 * np.arange(60)), np.zeros(60)])
    model = NominalModel('torque', T, 0.02, math.inf, PaperRobotParameters())
    u = FeedForward(FeedForwardParameters(), model).step(
        Observation(np.ones(2), np.ones(2), wave[0], wave[1], np.zeros(2), wave[:41])
    )
    assert u == pytest.approx((wave[1] - wave[0]) / T)


def test_feed_forward_needs_a_future():
    forward = FeedForward(FeedForwardParameters(), servo_model())
    zero = np.zeros(2)
    with pytest.raises(ValueError, match='future must have at least 5 rows: got 0'):
        forward.step(Observation(zero, zero, zero, zero, zero, None))


# --- the loop on the twin -----------------------------------------------------------------------


@pytest.mark.slow
def test_equal_seeds_give_equal_runs():
    """Also with reports that are late or lost; of the plants see ``test_loop.py``."""
    (_, first), (_, second) = (twin('overload', FULL, duration=3.0) for _ in range(2))
    for name, column in first.columns.items():
        np.testing.assert_array_equal(column, second[name])


@pytest.mark.slow
def test_methods_are_paired():
    """Reference, noise and lost messages are the same for every method of a seed."""
    (scenario, mine), (_, other) = (twin('dropouts', method) for method in (FEED_FORWARD, PI))
    assert np.array_equal(mine.reference, other.reference)
    still = mine.rows(0.0, mine.start)
    assert np.array_equal(mine['measured'][still], other['measured'][still])
    assert all(mine.driver_reasons[still])
    assert not any(mine.driver_reasons[still.stop :])
    assert scenario.true_robot().noise.variance == 0.04
    _, another = twin('dropouts', seed=202)
    assert not np.array_equal(mine.reference, another.reference)


@pytest.mark.parametrize('case', few_of(cases_for('twin'), step=3))
def test_every_case_of_the_twin_drives(case):
    """The robot follows in every case: worse than usual, but it does not stop or diverge."""
    scenario, record = twin(case, FEED_FORWARD)
    numbers = measure(record)
    assert numbers[SETTLED.name] < 2.0
    assert numbers[STOPPED.name] == 0.0
    assert np.abs(record['sent']).max() > 0.5


def test_feed_forward_does_not_depend_on_noise():
    scenario, quiet = twin(noise=0.0)
    _, noisy = twin(noise=0.1)
    moving = quiet.time > quiet.start + 1.0  # before: from the measured speed to the plan
    assert np.abs(quiet['sent'] - noisy['sent'])[moving].max() < 1e-9
    assert scenario.noise == 0.0


def test_the_miscalibrated_twin_turns_otherwise():
    (_, good), (_, bad) = twin(), twin('miscalibrated')
    moving = good.time > good.start + 1.0
    assert np.abs(good['sent'] - bad['sent'])[moving].max() < 1e-9
    numbers = [measure(record) for record in (good, bad)]
    assert numbers[1][YAW_RATE.name] > 2.0 * numbers[0][YAW_RATE.name]
    assert numbers[1][SETTLED.name] < 0.1


def test_a_known_dead_time_is_known_to_all():
    for case, assumed in (('dead time 60 ms', 0.06), ('unknown dead time 60 ms', 0.01)):
        scenario = Scenario('twin', case, 201)
        assert scenario.true_robot().drive.dead_time == 0.06
        assert scenario.estimate().dead_time == assumed
        assert scenario.kind.controller_parameters(scenario).speed_filter.dead_time == assumed
        assert scenario.nominal_model().robot.drive.dead_time == assumed
    (_, known), (_, unknown) = twin('dead time 60 ms'), twin('unknown dead time 60 ms')
    shift = known['sent'][250:350] - unknown['sent'][255:355]
    assert np.abs(shift).max() < 1e-9


def test_the_yaw_of_the_odometry_is_the_gyro_measurement():
    """The measured wheel speeds have the mean of the counters and the turn of the yaw."""
    spec = MethodSpec('PI', ProportionalIntegral, ProportionalIntegralParameters())
    geometry = noisy_twin().geometry
    for gyro in (False, True):
        scenario = Scenario('twin', NOMINAL, 201, 4.0, gyro=gyro)
        driver, robot = MethodDriver(spec, scenario), scenario.simulation()
        wheels = wheels_from_twist(BodyTwist(0.1, 0.5), geometry)
        for stamp, pose in ((2_000_000_000, ORIGIN), (2_010_000_000, Pose(0.001, 0.0, 0.003))):
            odometry = State(stamp, pose, BodyTwist(0.1, 0.5))
            state = robot.advance(0)._replace(stamp_ns=stamp, wheels=wheels, odometry=odometry)
            driver.step(state)
            measured = driver._measured(state)
        twist = twist_from_wheels(WheelSpeeds(*measured), geometry)
        assert twist.linear == pytest.approx(0.1)
        assert twist.angular == pytest.approx(0.3 if gyro else 0.5)


def test_reports_arrive_late_in_order_and_not_at_all():
    """A controller receives what the faults leave, in order and no earlier than its delay."""
    received = []

    class Spy(NodeDriver):
        def begin(self, k, *, enabled):
            self.now_ns = stamp_of(k)
            super().begin(k, enabled=enabled)

        def step(self, state):
            received.append((state.stamp_ns, self.now_ns))
            return super().step(state)

    faults = LinkFaults(
        odometry_loss=0.2, odometry_delay=(0.02, 0.12), begin=1.0 / 3.0, lasting=1.0
    )
    scenario = Scenario('twin', NOMINAL, 3, 3.0)
    controller = Controller(StepperControllerParameters())
    driver = Spy(controller, noisy_twin().geometry, scenario.reference().speeds)
    loop = reports_of(scenario.simulation(), driver, 300, start=1.5, links=faults, seed=3)
    run_loop(loop, driver)
    stamps = [stamp for stamp, _ in received]
    assert stamps == sorted(stamps)
    during = [now - stamp for stamp, now in received if 1_000_000_000 <= stamp < 2_000_000_000]
    assert 60 < len(during) < 95
    assert min(during) >= 10_000_000
    assert 80_000_000 < max(during) <= 120_000_000
    assert all(now == stamp for stamp, now in received if stamp < 1_000_000_000)
    assert received[-1][0] == received[-1][1]


# --- methods, plans, results --------------------------------------------------------------------


def test_the_quick_seeds_are_in_no_other_table():
    assert not set(comparison.QUICK_SEEDS) & {*TUNING_SEEDS, *PRETRAINING_SEEDS, *HELD_OUT_SEEDS}


def test_seeds_on_which_methods_were_tuned_are_named():
    """Of 2001 it said that no table has it, of 1 to 12 it said nothing."""

    def seeds_of(*seeds):
        return re.search(
            r'seeds (.*?)\. True', comparison.description(plan_of('servo', PI, seeds=seeds))
        )[1]

    told = '(methods of the package were tuned or trained on 9, 12)'
    assert seeds_of(9, 2001, 12) == f'9, 2001, 12 {told}'
    assert seeds_of(2001, 101) == '2001, 101'


@pytest.mark.parametrize('robot', ROBOTS)
def test_every_robot_has_feed_forward_and_the_full_controller(robot):
    assert default_methods(robot)[:2] == (FULL, FEED_FORWARD)
    assert set(default_methods(robot)) < set(methods_for(robot))
    assert cases_for(robot)[0] == 'nominal'
    assert set(KINDS) == set(ROBOTS)


def test_the_gain_that_tuning_starts_with_cancels_the_noise():
    """On the twin the command of PI without integral does not contain the measured speed."""
    method = methods_for('twin')[PI]
    scenario = Scenario('twin', 'nominal', 201)
    model = scenario.nominal_model()
    parameters = twin_start(method.parameters).with_values({'integral': 0.1})
    commands = []
    for speed in (1.0, 1.2):
        pi = ProportionalIntegral(parameters, model)
        for chi in (1.0, speed):  # the first error counts as a jump
            here = np.full(2, chi)
            u = pi.step(Observation(here, np.zeros(2), np.ones(2), np.ones(2), here, None))
        commands.append(here + T * u / model.share)
    assert abs(commands[1] - commands[0]).max() < 0.001


def plan_of(robot, *names, seeds=comparison.QUICK_SEEDS, duration=4.0, **own):
    """Return the comparison of methods of a robot, by name, and of others."""
    known = methods_for(robot)
    methods = {name: known[name] for name in names} | own
    return comparison.ComparisonPlan(
        Scenario(robot, NOMINAL, 1, duration), (NOMINAL,), methods, seeds
    )


def test_differences_are_paired_with_their_verdict():
    plan = plan_of('servo', PI)

    def found(mine, other, method=PI):
        rows = [
            {'controller': name, 'case': NOMINAL, 'seed': seed, SETTLED.name: value}
            for name, values in ((PI, mine), (FEED_FORWARD, reversed(other)))
            for seed, value in enumerate(values)
        ]
        for row in rows[len(mine) :]:
            row['seed'] = len(other) - 1 - row['seed']  # paired by seed, not by place
        return comparison.difference(plan, ResultTable(rows), NOMINAL, method, SETTLED)

    def judged(mine, other):
        return comparison.verdicts({0: found(mine, other)}, len(mine))[0]

    assert judged([1.1, 2.1, 3.1], [1.0, 2.0, 3.0]) == comparison.WORSE
    assert judged([0.9, 1.91, 2.9], [1.0, 2.0, 3.0]) == comparison.BETTER
    assert judged([0.9, 2.1, 3.0], [1.0, 2.0, 3.0]) == comparison.INCONCLUSIVE
    assert judged([math.nan, 2.0, 3.0], [1.0, 2.0, 3.0]) == comparison.WORSE
    assert judged([1.0, 2.0, 3.0], [1.0, math.nan, 3.0]) == comparison.BETTER, 'was worse'
    assert judged([math.nan, 2.0, 3.0], [1.0, math.nan, 3.0]) == comparison.INCONCLUSIVE
    assert judged([0.5], [1.0]) == comparison.INCONCLUSIVE
    assert found([1.0], [1.0], FEED_FORWARD) is None


class NotFinite(ProportionalIntegral):
    """A controller whose accelerations are no numbers."""

    def step(self, observation):
        return np.full(2, math.nan)


class Diverging:
    """A method that diverges with one seed only."""

    name = 'diverging'
    parameters = ProportionalIntegralParameters()
    settings = (('gain', 3.0), ('law', object))

    def knowledge(self, scenario):
        return 'nothing'

    def driver(self, scenario):
        kind = NotFinite if scenario.seed == 2 else ProportionalIntegral
        return MethodDriver(lambda model: kind(self.parameters, model), scenario)


def test_a_seed_that_diverges_makes_every_mean_diverge():
    """Its missing metrics once ended the JSON, or left means over the other seeds beside it."""
    plan = plan_of('twin', FEED_FORWARD, seeds=(2, 1), duration=3.0, diverging=Diverging())
    results = comparison.run_plan(plan)
    for metric in (SETTLED, DRIFT, YAW_RATE, STOPPED):
        assert len(results.values(metric.name, controller='diverging')) == 2
    (row,) = (
        row for row in comparison.case_table(plan, results, NOMINAL).rows if row[0] == 'diverging'
    )
    assert '1 of 2 diverged' in row, 'it was: diverged (2)'
    assert not any('±' in cell for cell in row[:-1])
    assert comparison.WORSE in row
    found = record(plan, results)
    assert found['parameters']['diverging'] == {'gain': 3.0, 'law': "<class 'object'>"}
    stored = found['cases'][NOMINAL]['methods']['diverging']
    assert stored['difference_from_feed_forward'][SETTLED.name]['verdict'] == comparison.WORSE


def test_a_plan_has_every_case_and_seed_of_every_method():
    plan = replace(plan_of('servo', FULL, PI, seeds=(1, 2)), cases=(NOMINAL, 'dropouts'))
    runs = [(run.job[0].case, run.job[0].seed, run.job[1].name) for run in plan.runs()]
    assert runs == [*product(plan.cases, plan.seeds, plan.methods)]
    names = 'case', 'seed', 'controller'
    assert [tuple(run.fields[name] for name in names) for run in plan.runs()] == runs


def test_the_body_decides_where_it_is_not_known():
    assert comparison.judged_metrics(NOMINAL)[0] is SETTLED
    assert DRIFT in comparison.judged_metrics('miscalibrated')


def test_the_plant_of_the_paper_is_compared_too():
    plan = plan_of('torque', FEED_FORWARD, PI, seeds=(201,), duration=2.0)
    results = comparison.run_plan(plan)
    assert results.values('controller') == [FEED_FORWARD, PI]
    (row,) = results.where(controller=PI, case='nominal')
    numbers = measured_run((Scenario('torque', 'nominal', 201, 2.0), methods_for('torque')[PI]))
    assert numbers.items() <= row.items()
    assert all(math.isfinite(value) for value in numbers.values())


@pytest.mark.slow
def test_the_command_writes_tables_json_and_page(tmp_path, capsys):
    files = tmp_path / 'new' / 'c.json', tmp_path / 'new' / 'c.html'
    words = 'compare --robot twin --seeds 201-202 --duration 2 --workers 1'
    words += ' --cases nominal miscalibrated --methods feed-forward pi-feed-forward'
    assert main([*words.split(), '--json', str(files[0]), '--html', str(files[1])]) == 0
    text = capsys.readouterr()
    assert '8/8 [' in text.err
    record = json.loads(files[0].read_text())
    runs = record['cases']['nominal']['methods'][PI]['runs']
    assert len(runs) == 2
    mean = record['cases']['nominal']['methods'][PI]['mean'][SETTLED.name]
    assert mean == pytest.approx(sum(run[SETTLED.name] for run in runs) / 2)
    assert re.search(rf'\| {re.escape(PI)} \| {mean:.4f} ', text.out)
    page = files[1].read_text()
    headline = re.search(r'<p class="headline">(.*?)</p>', page)[1]
    assert re.fullmatch(
        rf'Settled error \(rad/s\): {re.escape(PI)} {mean:.4f} ± [\d.]+, '
        r'feed-forward [\d.]+ ± [\d.]+: (better|worse|inconclusive)\.',
        headline,
    ), headline
    assert page.count('<img ') == 6
    assert page.index('<img ') < page.index('<nav') < page.index('<table')
    assert 'http' not in page.replace('http-equiv', '')
    assert 'What the methods know' in page


def test_a_figure_has_no_mean_of_the_seeds_that_did_not_diverge():
    """The mean of those alone praised a method that often diverges."""
    plan = plan_of('servo', FEED_FORWARD, PI, seeds=(1, 2))
    rows = [
        {'controller': name, 'case': NOMINAL, 'seed': seed, 'settled': value}
        for name, values in ((FEED_FORWARD, (0.1, math.nan)), (PI, (0.2, 0.3)))
        for seed, value in enumerate(values)
    ]
    (axis,) = draw_seeds(plan, ResultTable(rows), NOMINAL).axes
    names = [text.get_text() for text in axis.get_yticklabels()]
    assert names == [f'{FEED_FORWARD} (1 diverged)', PI]
    means = [line.get_xdata().tolist() for line in axis.lines if line.get_marker() == 'o']
    assert means == [[pytest.approx(0.25)]]
