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
"""Baselines with all that ours has: ramp, shaper, dead time, gyro, and what each states to know.

Each is checked by the property that it is there for, and its statement by what its commands do
not depend on.
"""

from dataclasses import replace
import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.stats import ttest_rel
from support.long_tests import few_of

from t3mpc_ros.control.input_shaper import InputShaperParameters
from t3mpc_ros.evaluation import loop
from t3mpc_ros.evaluation.baselines.baseline_controller import NominalModel, Observation
from t3mpc_ros.evaluation.baselines.feed_forward import (
    FeedForward,
    FeedForwardParameters,
    LmsBodyCorrection,
    LmsBodyCorrectionParameters,
)
from t3mpc_ros.evaluation.baselines.feedback_control import ProportionalIntegral
from t3mpc_ros.evaluation.cases import LinkFaults
from t3mpc_ros.evaluation.comparison import (
    BETTER,
    INCONCLUSIVE,
    WORSE,
    ComparisonPlan,
    case_table,
    first_verdicts,
    front,
    record,
    run_plan,
    step_times,
    summary_table,
    verdicts,
)
from t3mpc_ros.evaluation.confidence_intervals import Difference, holm, paired
from t3mpc_ros.evaluation.loop import MethodDriver, MethodSpec, NodeMethod, ReportLink, run
from t3mpc_ros.evaluation.method_table import (
    FEED_FORWARD,
    FULL,
    FULL_WRONG,
    LMS,
    OFFSET_FREE,
    RAMP,
    SHAPED,
    SHAPED_IN_TIME,
    default_methods,
    methods_for,
)
from t3mpc_ros.evaluation.run_record import SETTLED, measure
from t3mpc_ros.evaluation.scenario import KINDS, OwnParts, Scenario, sampled_speeds
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

T = 0.01
PI = 'PI + feed-forward'
SHAPER = InputShaperParameters()


def servo(lag=0.003):
    return NominalModel('velocity', T, lag, 28.0, PaperRobotParameters())


def waves(rows):
    time = T * np.arange(rows)
    return np.column_stack([3.0 * np.sin(1.3 * time), 2.0 * np.sin(2.1 * time + 1.0)])


def drive(method, model, reference, turn=None, late=lambda k: 1, seen=None):
    """Return the commands of a method whose wheels follow each of them after a period.

    ``turn(mean, half)`` is half the difference of the wheel speeds that the body turns like.
    """
    geometry, rows = model.robot.geometry, len(reference) - 50
    commands, sent = np.zeros((rows, 2)), [np.zeros(2)] * 3
    for k in range(rows):
        yaw_rate = math.nan
        if turn is not None:
            right, left = sent[-2]
            half = turn(0.5 * (right + left), 0.5 * (right - left))
            yaw_rate = half * geometry.wheel_radius / geometry.half_separation
        future = reference[k + late(k) : k + 41]
        speeds = np.full(2, 7.0) if seen is None else seen(k)
        observation = Observation(
            speeds, np.zeros(2), future[0], future[1], sent[-1], future, 1, late(k), yaw_rate
        )
        commands[k] = speeds + T * method.step(observation) / model.share
        sent.append(commands[k])
    return commands


# -- feed-forward, step by step -------------------------------------------------------------------


def test_the_shaper_cancels_the_frequencies_of_the_rotors():
    """Each frequency vanishes from the sum, or the difference of the wheels."""
    model = servo()
    made = FeedForwardParameters(advance=0.005, command_shaper=SHAPER)
    time = T * np.arange(500)
    for shape, frequency in (([1, 1], 14.6), ([1, -1], 9.1)):
        wave = 0.1 * np.outer(np.sin(2.0 * np.pi * frequency * time), shape)
        plain, shaped = (
            drive(FeedForward(table, model), model, wave)[100:]
            for table in (FeedForwardParameters(advance=0.005), made)
        )
        assert np.abs(shaped).max() < 0.25 * np.abs(plain).max()  # linear between the samples
    slow = waves(500)
    plain, shaped = (
        drive(FeedForward(table, model), model, slow)[100:]
        for table in (FeedForwardParameters(advance=0.005), made)
    )
    assert np.abs(shaped - plain).max() < 0.03
    assert np.abs(shaped).max() > 2.0


def test_a_jump_is_crossed_once_when_the_dead_time_changes():
    """Announced by its instant, not by the row of the future in which it stands."""
    reference = np.zeros((300, 2))
    reference[150:] = 3.0, -3.0
    model = servo(0.02)
    steady = drive(FeedForward(FeedForwardParameters(), model), model, reference, late=lambda k: 4)
    for change in (100, 140, 146, 152):
        found = drive(
            FeedForward(FeedForwardParameters(), model),
            model,
            reference,
            late=lambda k, change=change: 1 if k < change else 4,
        )
        assert found[-1] == pytest.approx([3.0, -3.0], abs=1e-9)
        assert found[change + 20 :] == pytest.approx(steady[change + 20 :], abs=1e-9)
        assert np.abs(found).max() < 3.0 + 1e-9


@pytest.mark.parametrize('gains', [(0.015, -0.03), (-0.025, 0.0)])
def test_lms_learns_a_body_that_then_turns_as_the_reference(gains):
    model, reference = servo(), waves(3000)
    table = LmsBodyCorrectionParameters(advance=0.0, learning_rate=0.2)
    method = LmsBodyCorrection(table, model)

    def turn(mean, half):
        return half + gains[0] * mean + gains[1] * half

    commands = drive(method, model, reference, turn)
    assert method.gains == pytest.approx(gains, abs=0.002)
    plain = drive(FeedForward(FeedForwardParameters(), model), model, reference)
    wanted = 0.5 * (plain[-500:, 0] - plain[-500:, 1])
    errors = []
    for each in (commands, plain):
        right, left = each[-500:].T
        errors.append(np.std(turn(0.5 * (right + left), 0.5 * (right - left)) - wanted))
    assert errors[0] < 0.1 * errors[1]


def test_a_gap_teaches_lms_nothing():
    """The mean over a gap belongs to several commands."""
    model = servo()
    made = LmsBodyCorrection(LmsBodyCorrectionParameters(learning_rate=1.0), model)
    future = waves(60)
    for k, elapsed in enumerate((1, 1, 1, 5, 1)):
        before = made.gains
        made.step(
            Observation(
                *(np.ones(2), np.zeros(2), future[k], future[k + 1], np.ones(2)),
                *(future[k : k + 41], elapsed, 1, 5.0),
            )
        )
        assert (made.gains != before).any() == (k in (2, 4))


@pytest.mark.slow
def test_on_an_exact_body_the_controller_is_feed_forward():
    """The issue that made these rows: where the body is exact, nothing else of ours acts.

    But in the last periods: they end a known future in different ways.
    """
    scenario = Scenario('twin', 'nominal', 2002, 12.0)
    known = methods_for('twin')
    mine, shaped, plain = (
        run(scenario, known[name])['sent'][600:1180]
        for name in ('full without body correction', SHAPED_IN_TIME, FEED_FORWARD)
    )
    assert (mine - shaped).std() < 0.001
    assert (mine - plain).std() > 10.0 * (mine - shaped).std()


@pytest.mark.slow
def test_a_creeping_robot_rings_half_as_much():
    """At 0.025 rad/s single microsteps met the frequency of the rotors: an error of 300 %."""
    straight = np.minimum(np.linspace(0.0, 0.2, 1600), 0.025)
    own = OwnParts(reference=sampled_speeds(np.column_stack([straight, straight])))
    scenario = Scenario('twin', 'nominal', 4001, 12.0, own=own)
    mine = methods_for('twin')[FULL]
    plain = replace(mine, changes={**mine.changes, 'wheel.deadband_velocity': 0.0})
    errors = [measure(run(scenario, method))['settled'] for method in (mine, plain)]
    assert errors[0] < 0.6 * errors[1]
    assert errors[1] > 0.05


@pytest.mark.slow
@pytest.mark.parametrize('name', few_of([SHAPED_IN_TIME, LMS]))
def test_the_dead_time_is_found(name):
    known = methods_for('twin')
    scenario = Scenario('twin', 'unknown dead time 60 ms', 2002, 12.0)
    settled = [measure(run(scenario, known[each]))[SETTLED.name] for each in (name, SHAPED)]
    assert settled[0] < 0.5 * settled[1]


# -- feedback with the ramp -----------------------------------------------------------------------


@pytest.mark.parametrize('robot', ['servo', 'torque'])
def test_every_feedback_baseline_has_a_variant_with_the_ramp(robot):
    known = methods_for(robot)
    ramped = [name for name in known if name.endswith(RAMP)]
    assert len(ramped) == 6
    for name in ramped:
        mine, other = known[name], known[name.removesuffix(RAMP)]
        assert mine.preview
        assert not other.preview
        assert mine.controller_type is other.controller_type
        assert name in default_methods(robot)
        assert name.removesuffix(RAMP) not in default_methods(robot)
    ours = known[FULL].parameters.to_dict()['jump_transition.acceleration']
    for name in (*ramped, FEED_FORWARD):
        values = known[name].parameters.to_dict()
        assert values['jump_transition.acceleration'] == ours


@pytest.mark.parametrize('lag', [0.003, 0.02])
def test_with_the_ramp_an_ideal_drive_leaves_no_feedback(lag):
    """It crosses a jump by the ramp, half of it before the jump, without an error."""
    model = servo(lag)
    table = ProportionalIntegral.parameters_type().with_values({'jump_transition.preview': True})
    method, keep = ProportionalIntegral(table, model), math.exp(-T / lag)
    reference = np.zeros((300, 2))
    reference[150:] = 3.0, -3.0
    speeds, found = np.zeros(2), np.zeros((250, 2))
    for k in range(250):
        future = reference[k : k + 41]
        observation = Observation(speeds, np.zeros(2), future[0], future[1], np.zeros(2), future)
        found[k] = speeds
        u = method.step(observation)
        command = speeds + T * u / model.share
        speeds = command + keep * (speeds - command)
        assert np.abs(method.integral).max() < 1e-9
    assert found[-1] == pytest.approx([3.0, -3.0], abs=1e-9)
    change = np.diff(found, axis=0) / T
    assert np.abs(change).max() < 30.0 + 1e-6
    assert found[149, 0] > 0.8
    assert found[140, 0] < 1e-3


def test_the_offset_free_mpc_has_no_offset():
    """Against a constant load and a gain that is wrong, which its model does not know."""
    table = methods_for('servo')[OFFSET_FREE]
    assert table.parameters.model_error == 1.0
    assert table.parameters.disturbance_share == table.parameters.load_share == 0.0
    model = servo(0.02)
    keep = math.exp(-T / 0.02)
    reference = np.tile([2.0, -1.0], (900, 1))
    ends = []
    for values in ({}, {'integral_time': 50.0}):
        parameters = table.parameters.with_values(values)
        method = table.controller_type(parameters, model)
        speeds, command = np.zeros(2), np.zeros(2)
        for k in range(800):
            future = reference[k : k + 41]
            seen = Observation(speeds, np.zeros(2), future[0], future[1], command, future)
            command = speeds + T * method.step(seen) / model.share
            target = np.array([1.05, 0.9]) * command + 0.2
            speeds = target + keep * (speeds - target)
        ends.append(np.abs(speeds - reference[0]).max())
    assert ends[0] < 1e-3
    assert ends[1] > 0.05


def test_the_error_of_the_inertia_reaches_the_torques():
    known = methods_for('torque')
    assert known[FULL_WRONG].parameters.inertia_error == 1.3
    sent = []
    for error in (1.0, 1.3):
        table = FeedForwardParameters()

        class Wrong(FeedForward):
            inertia_error = error

        scenario = Scenario('torque', 'nominal', 201, 2.0, 0.0)
        driver = MethodDriver(MethodSpec('wrong', Wrong, table), scenario)
        driver.begin(0, enabled=True)
        state = scenario.simulation().advance(0)
        sent.append(np.array(driver.step(state).wheels))
    assert np.abs(sent[0]).max() > 1e-6
    assert sent[1] == pytest.approx(1.3 * sent[0], rel=1e-9)


# -- reports out of order -------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize('name', few_of([LMS, FULL, PI]))
def test_a_repeated_report_changes_nothing(name):
    method = methods_for('twin')[name]
    plain = Scenario('twin', 'nominal', 2001, 4.0)
    runs = [run(each, method) for each in (plain, replace(plain, case='repeated'))]
    assert np.array_equal(runs[0]['sent'], runs[1]['sent'])


class Dropping(ReportLink):
    """A link that loses of 20 reports each the last."""

    count = 0

    def send(self, state):
        self.count += 1
        if self.count % 20:
            super().send(state)


@pytest.mark.slow
@pytest.mark.parametrize('name', few_of([FULL, LMS, 'linear MPC preview']))
def test_an_overtaken_report_is_a_lost_one(monkeypatch, name):
    method, scenario = methods_for('twin')[name], Scenario('twin', 'swapped', 2001, 4.0)
    swapped = run(scenario, method)
    monkeypatch.setattr(loop, 'ReportLink', Dropping)
    lost = run(replace(scenario, case='nominal'), method)
    assert np.array_equal(swapped['sent'][:-1], lost['sent'][:-1])


def test_swapped_and_thinned_reports_arrive_as_the_case_says():
    def stamps(**faults):
        seen = []

        class Spy(FeedForward):
            def step(self, observation):
                seen.append(observation.elapsed)
                return super().step(observation)

        own = OwnParts(links=LinkFaults(**faults))
        scenario = Scenario('servo', 'nominal', 1, 1.0, own=own)
        run(scenario, MethodSpec('spy', Spy, FeedForwardParameters()))
        return seen

    assert stamps() == [1] * 100
    assert stamps(odometry_repeated=3) == [1] * 100
    assert stamps(odometry_kept=2) == [1] + [2] * 49
    swapped = stamps(odometry_swapped=10)
    assert swapped.count(2) == 9  # the hundredth has no successor
    assert set(swapped) == {1, 2}


def test_after_a_gap_the_command_may_change_by_as_much_more():
    """At half the rate the limit of one period left feed-forward 7 rad/s behind a swing."""

    class Hasty(FeedForward):
        def step(self, observation):
            return np.full(2, 1e4)

    scenario = Scenario('servo', 'nominal', 201, 2.0, 0.0)
    driver = MethodDriver(MethodSpec('hasty', Hasty, FeedForwardParameters()), scenario)
    driver.begin(0, enabled=True)
    state, sent = scenario.simulation().advance(0), [np.zeros(2)]
    for stamp_ns in (0, 10_000_000, 60_000_000, 70_000_000):
        sent.append(np.array(driver.step(state._replace(stamp_ns=stamp_ns)).wheels))
    changes = np.diff(sent[1:], axis=0)[:, 0]
    assert changes == pytest.approx(changes[0] * np.array([1.0, 5.0, 1.0]))
    assert changes[0] > 0.1


# -- what each states to know ---------------------------------------------------------------------


@pytest.mark.parametrize('robot', KINDS)
def test_every_method_states_what_it_knows(robot):
    scenario = Scenario(robot, 'nominal', 201)
    known = methods_for(robot)
    texts = {name: method.knowledge(scenario) for name, method in known.items()}
    for name, method in known.items():
        parts = texts[name].split('; ')
        preview = True if isinstance(method, NodeMethod) else method.preview
        if name == 'full without preview':
            preview = False
        assert ('reference ahead' in parts) == preview, name
        assert ('reference now' in parts) != preview, name
    assert 'inertia × 1.3' in texts['linear MPC preview']
    assert 'exact inertia' in texts[OFFSET_FREE]
    assert 'nominal friction' in texts['computed torque']
    assert 'nominal friction' not in texts[OFFSET_FREE]
    assert 'wheel speeds' not in texts[FEED_FORWARD]


@pytest.mark.slow
@pytest.mark.parametrize('name', few_of([LMS, FEED_FORWARD, SHAPED]))
def test_what_is_not_stated_as_measured_does_not_matter(name):
    """Without the wheel speeds in its statement, commands do not depend on their noise."""
    method = methods_for('twin')[name]
    if name == LMS:  # which states that it estimates the dead time from them
        method = replace(method, parameters=method.parameters.with_values(
            {'estimate_dead_time': False}))  # fmt: skip
    scenario = Scenario('twin', 'nominal', 2001, 5.0, 0.0)
    assert 'wheel speeds' not in method.knowledge(scenario)
    quiet, noisy = (run(replace(scenario, noise=noise), method) for noise in (0.0, 0.1))
    moving = quiet.time > 3.0
    assert np.abs(quiet['sent'] - noisy['sent'])[moving].max() < 1e-9


# -- verdicts of a table --------------------------------------------------------------------------


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=30))
def test_holm_is_between_bonferroni_and_no_correction(values):
    found = holm(dict(enumerate(values)))
    assert found <= {i for i, p in enumerate(values) if p <= 0.05}
    assert found >= {i for i, p in enumerate(values) if p <= 0.05 / len(values)}
    if found:
        assert max(values[i] for i in found) <= min(
            [p for i, p in enumerate(values) if i not in found], default=1.0
        )


def test_holm_of_a_table_of_four():
    assert holm({'a': 0.01, 'b': 0.04, 'c': 0.03, 'd': 0.005}) == {'a', 'd'}
    assert holm({'a': 0.01, 'b': 0.02, 'c': 0.02, 'd': 0.005}) == {'a', 'b', 'c', 'd'}


@given(st.lists(st.tuples(*[st.floats(-100.0, 100.0)] * 2), min_size=3, max_size=12))
def test_p_is_that_of_students_test_and_agrees_with_the_interval(pairs):
    first, second = zip(*pairs, strict=True)
    found = paired(first, second)
    differences = np.subtract(first, second)
    if np.std(differences) < 1e-6 * (1.0 + np.abs(differences).max()):
        return
    p = found.p_value(len(pairs))
    assert p == pytest.approx(ttest_rel(first, second).pvalue, abs=1e-9)
    if abs(p - 0.05) > 1e-9:
        assert (p < 0.05) == (found.sign != 0)


def test_a_difference_among_many_counts_less():
    """One of twenty differences at p = 0.03 is what chance makes; alone it is a verdict."""
    least = Difference(-1.0, 0.9)
    assert verdicts({'a': least}, 6) == {'a': BETTER}
    others = {i: Difference(0.1, 1.0) for i in range(19)}
    assert set(verdicts({'a': least, **others}, 6).values()) == {INCONCLUSIVE}
    certain = Difference(0.3, 0.01)
    assert verdicts({'a': certain, **others}, 6)['a'] == WORSE
    diverged = {'a': Difference(math.inf, math.nan)}
    assert verdicts(diverged, 6) == {'a': WORSE}
    assert verdicts({'a': Difference(math.nan, math.nan)}, 6) == {'a': INCONCLUSIVE}
    assert Difference(-0.5, math.inf).p_value(1) == 1.0
    assert Difference(0.0, 0.0).p_value(3) == 1.0
    assert Difference(0.1, 0.0).p_value(3) == 0.0


@given(st.lists(st.tuples(*[st.floats(0.1, 10.0)] * 2), min_size=1, max_size=15))
def test_the_front_is_what_nobody_beats_in_both(points):
    found = front(points)
    assert found

    def beaten(i):
        return any(
            other[0] <= points[i][0] and other[1] <= points[i][1] and other != points[i]
            for other in points
        )

    assert not any(beaten(i) for i in found)
    assert {points[i] for i in range(len(points)) if not beaten(i)} == {points[i] for i in found}


def test_a_table_says_how_many_seeds_and_what_each_method_knows():
    known = methods_for('servo')
    chosen = {name: known[name] for name in (FULL, FEED_FORWARD, 'ADRC' + RAMP)}
    chosen[FULL] = replace(known[FULL], pretrained=False)
    plan = ComparisonPlan(Scenario('servo', 'nominal', 1, 3.0), ('nominal',), chosen, (201, 202))
    results = run_plan(plan)
    row = case_table(plan, results, 'nominal').rows[2]
    assert row[1].endswith('(2)')
    assert row[-1] == known['ADRC' + RAMP].knowledge(plan.scenario)
    ticks = iter(range(0, 10**9, 5000))
    times = step_times(plan, lambda: next(ticks))
    assert set(times.values()) == {5.0}
    table = summary_table(plan, results, first_verdicts(plan, results), times)
    assert table.head[-1] == 'step, µs'
    assert all(each[-1] == '5' for each in table.rows)
    written = record(plan, results, times)
    assert written['step_time_us'] == times
    assert {'commit', 'machine'} <= {*written['origin']}
    runs = written['cases']['nominal']['methods'][FULL]['runs']
    assert [each['seed'] for each in runs] == [201, 202]
