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
"""Recorded runs computed again: exactly where all is known, and saying so where it is not."""

import contextlib
import functools
import math
from pathlib import Path
from types import SimpleNamespace

from mcap.reader import make_reader
from mcap.writer import Writer
import numpy as np
import pytest
from support.bag_files import copied_bag
from support.bag_messages import START, odometry_message
from support.golden_bags import GOLDEN_SCENARIOS, RecordedController
from support.long_tests import few_of
from support.other_parameters import with_other_value
from support.robot_bags import write_with_records

from t3mpc_ros.bag.columns import read_columns
from t3mpc_ros.bag.controller_input_journal import (
    Event,
    Journal,
    parameters_from_json,
    parameters_to_json,
)
from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.writer import BagWriter, DataError
from t3mpc_ros.cli.bag import program_parser
from t3mpc_ros.control import watchdog
from t3mpc_ros.control.controller import ControllerParameters, StepperControllerParameters
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.bag_report.recorded_run import load_run
from t3mpc_ros.evaluation.process_replay.controller_inputs import (
    FIELDS,
    SPEEDS,
    ReplayError,
    commands_of,
    load_inputs,
    match,
)
from t3mpc_ros.evaluation.process_replay.controller_replay import ControllerBag, replay_controller
from t3mpc_ros.evaluation.process_replay.replay_comparison import (
    ELSEWHERE,
    Tolerances,
    compare,
    compare_bags,
    compare_columns,
)
from t3mpc_ros.evaluation.topic_roles import SCALARS, ReportOptions, choose_topics, find_topics
from t3mpc_ros.geometry.types import ORIGIN, STANDSTILL, BodyTwist, Pose, State
from t3mpc_ros.model_file import save_model
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.simulation.world import load_world

pytestmark = pytest.mark.slow

GOLDEN = sorted((Path(__file__).parents[1] / 'golden').glob('*.mcap'))
JOURNAL = '/controller/journal'


golden_inputs = functools.cache(load_inputs)


def golden(stem):
    (path,) = (path for path in GOLDEN if path.stem == stem)
    return path


def bag_program(*arguments):
    """Run a command of ``bag`` as its program does; return the exit code."""
    options = program_parser().parse_args([str(argument) for argument in arguments])
    return options.run(options) or 0


def columns_of(path, topics):
    with open_bag(path) as reader:
        return read_columns(reader, topics)


@pytest.fixture(scope='module')
def bag():
    return golden('stops')


@pytest.fixture(scope='module')
def inputs(bag):
    return golden_inputs(bag)


@pytest.fixture(scope='module')
def again(inputs):
    return replay_controller(inputs)


def without(bag, folder, drop):
    """Write a copy of a bag without the messages for which ``drop(topic, count)`` is true."""

    def kept(topic, k, *times):
        return () if drop(topic, k) else [(topic, *times)]

    return copied_bag(bag, folder, kept)


# -- golden bags ----------------------------------------------------------------------------------


@pytest.mark.parametrize('path', GOLDEN, ids=lambda path: path.stem)
def test_golden_runs_come_out_as_they_were_recorded(path):
    """If this fails on purpose: renew them with ``test/support/golden_bags.py``, and say why."""
    inputs = golden_inputs(path)
    assert inputs.notes == ()
    assert inputs.exact.all()
    outcome = compare(inputs, replay_controller(inputs), Tolerances(ELSEWHERE, ELSEWHERE))
    assert outcome.same, outcome.table()
    assert {row.field for row in outcome.rows} == set(FIELDS)


@pytest.mark.parametrize('path', few_of(GOLDEN))
def test_a_report_without_scalars_has_those_of_the_journal(path, tmp_path):
    """The recorder leaves them out; the golden bags hold every second one of them."""
    bare = without(path, tmp_path / 'bare', lambda topic, k: topic.removeprefix('/') in SCALARS)
    with open_bag(path) as recording, open_bag(bare) as rest:
        recorded, found = load_run(recording), load_run(rest)
    assert not SCALARS & found.topics.keys()
    assert found.absent == recorded.absent
    assert found.numbers.keys() == recorded.numbers.keys()
    for name in SCALARS:
        was, now = recorded.numbers[name], found.numbers[name]
        near = np.abs(now.time[:, None] - was.time).argmin(axis=0)
        np.testing.assert_allclose(now.time[near], was.time, atol=1e-4)
        np.testing.assert_allclose(
            now['value'][near], was['value'], rtol=ELSEWHERE, atol=ELSEWHERE
        )
        assert len(now) >= 2 * len(was)
    assert any('recomputed from its journal' in note for note in found.remarks)
    assert not any('approximate' in note for note in found.remarks)


def test_scalars_after_a_lost_input_are_called_approximate(bag, tmp_path):
    torn = without(
        bag,
        tmp_path / 'torn',
        lambda topic, k: topic[1:] in SCALARS or (topic, k) == ('/odom', 300),
    )
    with open_bag(torn) as recording:
        notes = load_run(recording).remarks
    assert any(' s on they are approximate' in note for note in notes)
    gone = without(
        bag, tmp_path / 'gone', lambda topic, k: topic[1:] in SCALARS or topic == JOURNAL
    )
    with open_bag(gone) as recording:
        run = load_run(recording)
    assert set(run.absent) >= SCALARS
    assert not any('journal' in note for note in run.remarks)


def test_the_golden_runs_have_all_that_they_are_for(inputs, again):
    assert {path.stem for path in GOLDEN} == set(GOLDEN_SCENARIOS)
    assert all(path.stat().st_size < 300_000 for path in GOLDEN)
    assert {*again.reasons} >= {
        Reason.TRACKING, Reason.DISABLED, Reason.REFERENCE_STALE, Reason.NO_ODOMETRY,
        Reason.NO_REFERENCE, Reason.ODOMETRY_BAD,
    }  # fmt: skip
    changed = golden_inputs(golden('changes'))
    assert list(changed.events).count(Event.CONFIGURE) == 5
    gains = {name: each.law.gain for name, each in changed.sessions[0].parameters.items()}
    assert gains[0] != 20.0
    assert gains[1] == gains[5] == 20.0
    assert Reason.NOT_FOLLOWING in replay_controller(changed).reasons
    references = golden_inputs(golden('switches')).references.numbers
    linear, angular = np.abs(np.diff(references[:, 6:8], axis=0)).T
    assert np.count_nonzero((linear > 0.022) | (angular > 0.31)) >= 3, 'jumps as the track has it'


# -- what is detected -----------------------------------------------------------------------------


def test_a_gain_one_percent_off_is_found_and_named(inputs):
    parameters = inputs.sessions[0].parameters[0]
    gain, fitting = parameters.law.gain, parameters.resolved().law.gain
    outcome = compare(
        inputs, replay_controller(inputs, {'law.gain': 1.01 * fitting}), Tolerances(1e-6, 1e-6)
    )
    assert not outcome.same
    differing = {row.field for row in outcome.rows if row.differing}
    assert {'cmd_vel.linear.x', 'cmd_vel.angular.z', 'terms/feedback/right'} <= differing
    assert 'terms/feedforward/right' not in {
        row.field for row in outcome.rows if row.absolute > 0.5
    }
    assert any('law.gain' in text and str(gain) in text for text in outcome.parameters)
    assert outcome.first.field.startswith('cmd_vel')
    assert outcome.first.field in outcome.verdict()


def test_named_settings_exist_and_the_same_change_nothing(inputs):
    gain = inputs.sessions[0].parameters[0].law.gain
    outcome = compare(inputs, replay_controller(inputs, {'law.gain': gain}))
    assert outcome.same
    assert outcome.parameters == ()
    with pytest.raises(ParameterError, match='law.gian.*did you mean law.gain'):
        replay_controller(inputs, {'law.gian': 1.0})


# -- tolerances -----------------------------------------------------------------------------------


def compared(was, now, tolerances):
    everywhere = np.full(len(was), math.nan)
    recorded, computed = (dict.fromkeys(FIELDS, everywhere) for _ in range(2))
    recorded[SPEEDS[0]], computed[SPEEDS[0]] = np.array(was), np.array(now)
    time = np.arange(float(len(was)))
    outcome = compare_columns(time, recorded, computed, np.ones(len(was), dtype=bool), tolerances)
    [row] = outcome.rows
    return row


def test_the_tolerance_is_absolute_plus_relative():
    was, now = [0.0, 1.0, 100.0], [0.01, 1.02, 101.1]
    assert compared(was, now, Tolerances(0.01, 0.011)).differing == 0
    row = compared(was, now, Tolerances(0.01, 0.0105))
    assert (row.differing, row.first, row.first_step) == (1, 2.0, 2)
    assert compared(was, now, Tolerances(0.009, 0.011)).first == 0.0
    assert row.absolute == pytest.approx(1.1)
    assert row.relative == pytest.approx(0.02)


def test_nan_differs_from_a_number_and_missing_is_not_compared():
    row = compared([math.nan, 1.0, 1.0], [5.0, 1.0, math.nan], Tolerances(1e9, 1e9))
    assert (row.count, row.differing, row.first_step, row.absolute) == (2, 1, 2, math.inf)


def test_the_last_matching_field_tolerance_counts():
    tolerances = Tolerances(1.0, 0.5, {'cmd_vel.*': 0.1, 'cmd_vel.angular.z': 0.2})
    assert tolerances.of('cmd_vel.linear.x') == (0.1, 0.0)
    assert tolerances.of('cmd_vel.angular.z') == (0.2, 0.0)
    assert tolerances.of('error/left') == (1.0, 0.5)


@pytest.mark.parametrize(
    'arguments, words',
    [
        ({'absolute': -1.0}, 'absolute must be from 0'),
        ({'relative': math.nan}, 'relative must be from 0'),
        ({'fields': {'cmd_vel.x': 1.0}}, 'cmd_vel.x is none of the fields cmd_vel.linear.x'),
    ],
)
def test_a_tolerance_that_cannot_be_used_is_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        Tolerances(**arguments)


# -- bags from which something is missing --------------------------------------------------------


@pytest.mark.parametrize(
    ('lost', 'words'),
    [
        (JOURNAL, 'no journal of the controller .* record it, as the'),
        ('/cmd_vel', 'not in the bag: cmd_vel; .*t3mpc tune --robot BAG take a bag of any robot'),
    ],
)
def test_a_bag_without_what_a_replay_needs_is_refused(lost, words, bag, tmp_path):
    copy = without(bag, tmp_path / 'copy', lambda topic, _: topic == lost)
    with pytest.raises(ReplayError, match=words):
        load_inputs(copy)


def test_a_late_recorder_is_noted_and_compared_from_the_reset_on(bag, tmp_path):
    late = without(
        bag, tmp_path / 'late', lambda topic, n: topic != '/controller/parameters' and n < 100
    )
    inputs = load_inputs(late)
    assert any('100 events of the controller were before' in note for note in inputs.notes)
    assert not inputs.exact.all()
    assert inputs.exact.any()
    first = int(np.flatnonzero(inputs.exact)[0])
    assert inputs.events[first] == Event.RESET
    outcome = compare(inputs, replay_controller(inputs))
    assert any('left out' in remark for remark in outcome.remarks)
    assert outcome.same, outcome.table()
    assert 200 < next(row.count for row in outcome.rows) < 300


@pytest.mark.parametrize(
    'topic, words',
    [
        ('/odom', '1 odometry messages that the controller processed are not in the bag'),
        ('/reference', '1 references that the controller received are not in the bag'),
        (JOURNAL, '1 events are missing in the journal'),
    ],
)
def test_after_a_lost_message_comparison_resumes_at_a_reset(topic, words, bag, tmp_path):
    inputs = load_inputs(without(bag, tmp_path / 'copy', lambda *it: it == (topic, 120)))
    assert any(words in note for note in inputs.notes), inputs.notes
    reset = int(np.flatnonzero(inputs.events == Event.RESET)[0])
    gap = np.flatnonzero(~inputs.exact)
    assert 60 < gap[0] < 125  # of the references 40 are ahead
    assert gap[-1] == reset - 1
    assert inputs.exact[reset:].all()
    outcome = compare(inputs, replay_controller(inputs))
    assert outcome.same, outcome.table()
    assert int(np.count_nonzero(outcome.compared)) == inputs.events.size - gap.size


def straight_on(folder, begins=(START,), steps=200, first=0, model=None):
    """Record processes whose robot is reported at one place; references from step ``first`` on.

    Return the weights of the last one, which began with those of a file if one is given.
    """
    parameters, twist = StepperControllerParameters(), BodyTwist(0.1, 0.2)
    with ControllerBag(folder, parameters) as writer:
        for begin in begins:
            recorded = RecordedController(parameters, writer, begin, model=model)
            for k in range(steps):
                now = begin + 10_000_000 * k
                if k >= first:
                    recorded.add_reference(now, State(now + 400_000_000, ORIGIN, twist))
                recorded.step(now + 1000, State(now, ORIGIN, BodyTwist(0.09, 0.18)))
    return recorded.controller.law.get_weights()


def test_odometry_lost_before_the_first_reference_is_harmless(tmp_path):
    """The robot has not moved yet, as when the nodes have not all found each other."""
    straight_on(tmp_path / 'bag', first=51)
    lost = without(tmp_path / 'bag/bag_0.mcap', tmp_path / 'copy', lambda *it: it == ('/odom', 20))
    inputs = load_inputs(lost)
    assert any('1 odometry messages' in note for note in inputs.notes)
    assert np.flatnonzero(~inputs.exact).tolist() == [20]
    assert compare(inputs, replay_controller(inputs)).same


def test_a_recorder_that_notes_no_time_of_publication_will_do(bag, tmp_path):
    """A command received after its row of the journal is still the one of that row."""

    def late(topic, _, received, __):
        received += 300_000 if topic == '/cmd_vel' else 0
        received += 1_000_000 if topic.startswith('/controller/l') else 0
        return [(topic, received, received)]

    inputs = load_inputs(copied_bag(bag, tmp_path / 'moved', late))
    assert inputs.notes == ()
    outcome = compare(inputs, replay_controller(inputs))
    assert not any(row.differing for row in outcome.rows[:2]), outcome.table()


@pytest.mark.parametrize(
    'stem, lost, words, kept',
    [
        ('stops', ('/cmd_vel', 120), '1 commands of the controller', None),
        ('changes', ('/controller/parameters', 0), 'settings at the start are not in the bag', 0),
        ('changes', ('/controller/parameters', 3), '1 changes of settings are not in the bag', 3),
    ],
)
def test_what_is_lost_is_said_and_harms_nothing_before(stem, lost, words, kept, tmp_path):
    """Exact are all events, or those before the first change of settings that is not known."""
    inputs = load_inputs(without(golden(stem), tmp_path / 'copy', lambda *it: it == lost))
    assert any(words in note for note in inputs.notes)
    changes = [0, *np.flatnonzero(inputs.events == Event.CONFIGURE).tolist()]
    exact = len(inputs.events) if kept is None else changes[kept]
    assert inputs.exact[:exact].all()
    assert not inputs.exact[exact:].any()
    if kept is None:
        assert compare(inputs, replay_controller(inputs)).same


def record_late(folder, lost, republished):
    """Copy a golden bag as a recorder writes it that has discovered the inputs late.

    Of each input it lacks the first messages, of which the controller has republished some.
    """

    def late(topic, k, received, published):
        is_input = topic in ('/reference', '/odom')
        if is_input and k < republished:
            initial = f'/controller/initial_inputs{topic}'
            yield initial, received + 1_000_000_000, published + 1000
        if not is_input or k >= lost:
            yield topic, received, published

    return copied_bag(golden('switches'), folder, late)


@pytest.mark.parametrize('lost, republished', few_of([(150, 200), (0, 200), (150, 150)]))
def test_initial_inputs_complete_a_late_recording(lost, republished, tmp_path):
    inputs, complete = (
        load_inputs(record_late(tmp_path / 'bag', lost, republished)),
        golden_inputs(golden('switches')),
    )
    for name in ('odometry', 'references'):
        one, other = getattr(inputs, name), getattr(complete, name)
        np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
        np.testing.assert_array_equal(one.numbers, other.numbers)
    assert inputs.notes == ()
    assert inputs.exact.all()
    outcome = compare(inputs, replay_controller(inputs), Tolerances(ELSEWHERE, ELSEWHERE))
    assert outcome.same, outcome.table()


@pytest.mark.parametrize('republished', few_of([100, 0]))
def test_without_all_initial_inputs_a_recording_is_not_exact(republished, tmp_path):
    inputs = load_inputs(record_late(tmp_path / 'bag', 150, republished))
    complete = golden_inputs(golden('switches'))
    assert not inputs.exact.all()
    assert len(inputs.odometry) == len(complete.odometry) - 150 + republished
    assert any('odometry messages' in note for note in inputs.notes)


def test_initial_inputs_are_no_topics_of_a_robot(tmp_path):
    folder = record_late(tmp_path / 'bag', 0, 10)
    with open_bag(folder) as recording:
        assert '/controller/initial_inputs/odom' in recording.topics
        assert find_topics(recording.topics)[1] == ('',)
        choice = choose_topics(recording, ReportOptions())
    assert choice.topics['odom'] == '/odom'
    assert not any('initial_inputs' in note for note in choice.notes)


# -- the journal and the model --------------------------------------------------------------------


def test_the_journal_numbers_events_and_counts_references():
    journal = Journal()
    journal.count_reference(7)
    journal.count_reference(9)
    assert list(journal.step(5)) == [0, Event.STEP, 5, 2, 9]
    assert list(journal.enable(False)) == [1, Event.ENABLE, 0, 2, 0]
    assert list(journal.reset()) == [2, Event.RESET, 0, 2, 0]
    assert list(journal.configure()) == [3, Event.CONFIGURE, 0, 2, 1]
    assert list(journal.odometry_timeout(5)) == [4, Event.ODOMETRY_TIMEOUT, 5, 2, 0]
    for text in ('', '{}', '[1]', '{"revision": null, "settings": {}}'):
        with pytest.raises(ValueError, match='no revision of parameters'):
            parameters_from_json(text)


def test_a_model_is_found_by_its_checksum_or_missed_and_said(tmp_path):
    learnt = straight_on(tmp_path / 'first')
    learnt['fuzzy.coefficients'] = learnt['fuzzy.coefficients'] + 0.3
    model = tmp_path / 'model.npz'
    save_model(model, learnt, {})
    straight_on(tmp_path / 'second', model=model)
    lost = load_inputs(tmp_path / 'second')
    assert any('give it by --model' in note for note in lost.notes)
    assert not lost.exact.any()
    assert not compare(lost, replay_controller(lost)).same
    given = load_inputs(tmp_path / 'second', model=learnt)
    assert given.exact.all()
    assert compare(given, replay_controller(given)).same


KEEP_OUT = {'pose.enabled': True, 'keep_out.enabled': True, 'keep_out.scan_rate': 5.0}
PAPER = {'composition': 'paper'}
OF_WHEELS = {
    'rate': 50.0,
    'wheel_radius': 0.05,
    'wheel_separation': 0.3,
    'mean_speeds': False,
    'speed_filter.dead_time': 0.05,
    'fuzzy.kind': 'type1',
    'fuzzy.sets': 3,
    'predictive.horizon': 4,
    'predictive.control_horizon': 2,
    'watchdog.reference_timeout': 0.02,
}
BUILT = {
    'composition': ({}, PAPER),
    'wheels': (PAPER, OF_WHEELS),
    'keep-out': ({}, {**KEEP_OUT, 'command_shaper.straight_frequency': 3.0}),
    'sensors and map': (KEEP_OUT, {'keep_out.mounts': (0.1, 0.0, 2.0), 'keep_out.map.range': 0.4}),
    'world of a file': (KEEP_OUT, {'keep_out.world': 'walls.yaml'}),
    'bundled world': (KEEP_OUT, {'keep_out.world': 'corridor'}),
}
"""Parameters of two controllers that are built in different ways, the second ones besides."""


@pytest.fixture(scope='module')
def turned_by_hand():
    """Let the robot of these runs turn whatever is commanded, which otherwise is a contact."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(watchdog, 'THROWN', math.inf)
        yield


@pytest.fixture(scope='module')
def plain_runs(tmp_path_factory, turned_by_hand):
    """Return the run with the usual parameters of a row of the table."""
    made = functools.cache(
        lambda items: built_run(tmp_path_factory.mktemp('run') / 'plain', dict(items))
    )
    return lambda parameters: made(tuple(parameters.items()))


def built_run(folder, changes):
    """Drive past some walls, open loop, with readings of a sensor that sees none of them."""
    parameters = StepperControllerParameters().with_values(changes)
    world = parameters.keep_out.world
    with ControllerBag(folder, parameters) as writer:
        recorded = RecordedController(
            parameters, writer, START, obstacles=load_world(world).obstacles if world else None
        )
        for k in range(240):
            now, way = START + 10_000_000 * k, 0.002 * max(k - 150, 0)
            turn = 0.05 * max(0, min(k, 150) - 5)  # a controller that looks around sees it turn
            if k < 230:  # later, the reference is stale
                twist = BodyTwist(0.2 + 0.1 * math.sin(0.15 * k), 0.3 * math.sin(0.1 * k))
                pose = Pose(way + 0.02, 0.3, 0.0)
                recorded.add_reference(now, State(now + 200_000_000, pose, twist))
            if k % 4 == 0:
                recorded.add_range(now + 1000, 0, math.inf)
            speeds = BodyTwist(0.2 + 0.02 * math.sin(0.2 * k), 0.3 * math.sin(0.1 * k - 0.2))
            recorded.step(now + 500_000, State(now, Pose(way, 0.3, turn), speeds))
    return load_inputs(folder)


@pytest.mark.parametrize('name', few_of(BUILT, 5))
def test_a_replay_builds_the_controller_as_its_node_did(name, plain_runs, tmp_path, monkeypatch):
    """Each parameter that is fixed when a controller is built has its effect in a replay, too."""
    monkeypatch.chdir(tmp_path)
    Path('walls.yaml').write_text('name: walls\nwalls:\n  - points: [[0.3, -1.0], [0.3, 1.0]]\n')
    usual, changes = BUILT[name]
    plain, built = plain_runs(usual), built_run(tmp_path / 'built', usual | changes)
    assert built.exact.all()
    again = replay_controller(built)
    # A yaw is rounded on its way through a message.
    outcome = compare(built, again, Tolerances(absolute=1e-9, relative=0.0))
    assert outcome.same, outcome.table()
    assert Reason.TRACKING in again.reasons
    unlike = [plain.recorded[key] - built.recorded[key] for key in SPEEDS]
    assert np.nanmax(np.abs(unlike)) > 1e-4, 'the parameters have no effect in this run'
    # What a replay is asked to change it builds so, too.
    changed = replay_controller(plain, changes).fields
    for key in SPEEDS:
        np.testing.assert_allclose(changed[key], built.recorded[key], atol=1e-9)


def one_step(folder, parameters, *, published=True):
    """Return a bag with one message of each topic of a controller, which stands still."""
    state = State(START, ORIGIN, STANDSTILL)
    with ControllerBag(folder, parameters) as writer:
        if published:
            text = parameters_to_json(0, parameters.to_dict())
            writer.add('controller/parameters', START, text)
        writer.add('reference', START, state)
        writer.add('odom', START, state)
        writer.add('cmd_vel', START + 1, STANDSTILL)
        writer.add('controller/journal', START + 2, Journal().step(START))
    return writer.path


def test_every_parameter_is_read_as_it_was_recorded(bag, tmp_path):
    """From the revisions that the node publishes, or from the record of the recorder alone."""
    parameters = StepperControllerParameters()
    for spec in ControllerParameters.specs():
        with contextlib.suppress(AssertionError):  # a file, and what others forbid
            parameters = with_other_value(parameters, spec)
    texts = {'keep_out.world': 'room', 'keep_out.mounts': (0.1, 0.0, 2.0)}
    parameters = parameters.with_values(KEEP_OUT | texts)
    path = one_step(tmp_path / 'bag', parameters)
    rest = without(path, tmp_path / 'rest', lambda topic, _: 'parameters' in topic)
    for each in (path, rest):
        (session,) = load_inputs(each).sessions
        assert session.parameters[session.start].to_dict() == parameters.to_dict()


@pytest.mark.parametrize('published', [True, False], ids=['revisions', 'record'])
def test_a_former_parameter_with_another_value_is_named(published, tmp_path):
    """With its value of today, the bag of an older version is replayed."""
    parameters = StepperControllerParameters()

    def path_of(name, memory):
        former = {'predictive.memory': memory, 'body.fuzzy.kind': 'type3'}
        older = SimpleNamespace(to_dict=lambda: parameters.to_dict() | former)
        return one_step(tmp_path / name, older, published=published)

    (session,) = load_inputs(path_of('same', 20.0)).sessions
    assert session.parameters[session.start].to_dict() == parameters.to_dict()
    with pytest.raises(ReplayError, match=r'predictive.memory .* always 20.0: got 10.0'):
        load_inputs(path_of('other', 10.0))


def test_a_command_before_a_kill_is_not_that_of_the_next_process():
    """Killed between a command and its row; the first command of the next one was not recorded."""
    second, step = 1_000_000_000, 10_000_000
    steps = step * np.arange(1, 4)
    rows = np.zeros((6, 5), dtype=np.int64)
    rows[:, 0] = [0, 1, 2, 0, 1, 2]
    published = np.concatenate([steps, 3 * second + steps])
    sent = np.concatenate([steps, [4 * step], 3 * second + steps[1:]]) - 100_000
    assert commands_of(rows, published, sent).tolist() == [0, 1, 2, -1, 4, 5]
    # A command has one row, also if the next process begins within the second.
    published = np.concatenate([steps, step + steps[-1] + steps])
    sent = np.delete(published, 3) - 100_000
    assert commands_of(rows, published, sent).tolist() == [0, 1, 2, -1, 3, 4]


def test_a_node_that_was_started_again_is_another_session(tmp_path):
    """Both are in one bag, and the second knows nothing of the first."""
    straight_on(tmp_path / 'bag', [START, START + 2_000_000_000], 100)
    inputs = load_inputs(tmp_path / 'bag')
    assert [len(session.events) for session in inputs.sessions] == [100, 100]
    assert inputs.notes == ()
    assert inputs.exact.all()
    assert compare(inputs, replay_controller(inputs)).same


# -- which message was when -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ('steps', 'stamps', 'begin', 'end'),
    [
        # References that only the recorder received are not passed.
        ([(1, 0, 0), (2, 2, 40), (3, 3, 50)], [0, 10, 20, 30, 40, 50], [3, 5], [5, 6]),
        # A source that starts again: the newest message is not the one with the latest stamp.
        ([(1, 3, 30), (2, 4, 10), (3, 6, 30)], [10, 20, 30, 10, 20, 30], [3, 4], [4, 6]),
        # The controller may get a reference after the recorder.
        ([(1, 1, 10), (2, 1, 10), (3, 3, 30)], [10, 20, 30], [1, 1], [1, 3]),
    ],
)
def test_a_step_passes_the_references_that_its_controller_had(steps, stamps, begin, end):
    """The rows of the journal are (stamp, number of references, stamp of the newest)."""
    rows = np.array([(k, 0, *step) for k, step in enumerate(steps)], dtype=np.int64)
    taken = match(rows, np.arange(4), np.array(stamps))
    assert (taken.begin[1:].tolist(), taken.end[1:].tolist()) == (begin, end)
    assert not taken.broken.any()


# -- reading in bulk ------------------------------------------------------------------------------


def test_bulk_reading_gives_what_a_deserialiser_gives(bag, tmp_path):
    """Also with frames of any length, of which the places of all numbers depend."""
    rows = []
    for k in range(12):
        twist, pose = (5.0 + k, 10.0 + k), (1.0 + k, 2.0 - k, 0.1 * k)
        message = odometry_message(k * 10**9 + 5, twist, pose, 'b' * (k % 5))
        message.header.frame_id = 'o' * (k % 7)
        rows.append((0.01 * k, '/odom', message))
    made = write_with_records(tmp_path / 'bag', rows, {})
    place, turn = 'pose.pose.position.', 'pose.pose.orientation.'
    fields = {'0': f'{place}x', '1': f'{place}y', '4': f'{turn}z', '5': f'{turn}w',
              '6': 'twist.twist.linear.x', '7': 'twist.twist.angular.z'}  # fmt: skip
    for path in (made, bag):
        column = columns_of(path, ['/odom'])['/odom']
        with open_bag(path) as recording:
            slow, start_ns = recording.series('/odom', fields), recording.start_ns
        for k in fields:
            np.testing.assert_array_equal(column.numbers[:, int(k)], slow[k])
        np.testing.assert_array_equal((column.received_ns - start_ns) / 1e9, slow['received'])
        np.testing.assert_array_equal((column.stamps_ns - start_ns) / 1e9, slow['stamp'])
    name = '/controller/error/right'
    columns = columns_of(bag, [name, JOURNAL])
    with open_bag(bag) as recording:
        numbers = recording.series(name, {'value': 'data'})['value']
        journal = [message.data for _, message in recording.messages(JOURNAL)]
    np.testing.assert_array_equal(columns[name].numbers[:, 0], numbers)
    np.testing.assert_array_equal(columns[JOURNAL].numbers, journal)


@pytest.mark.parametrize('length', [3, 4, 30, 400])
def test_a_message_that_is_cut_short_is_refused(length, tmp_path):
    with BagWriter(tmp_path / 'bag', metadata_records={}) as writer:
        writer.add_topic('/odom', 'nav_msgs/msg/Odometry')
        writer.write('/odom', 1, 1, (b'\x00\x01\x00\x00' + bytes(800))[:length])
    with pytest.raises(DataError, match='does not have the layout'):
        columns_of(tmp_path / 'bag', ['/odom'])


def test_a_bag_without_chunks_gives_the_same_numbers(bag, tmp_path):
    copy = tmp_path / 'flat.mcap'
    with bag.open('rb') as source, copy.open('wb') as target:
        writer = Writer(target, use_chunking=False)
        writer.start(profile='ros2', library='test')
        channels = {}
        for schema, channel, message in make_reader(source).iter_messages():
            if channel.topic not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, 'cdr', kind, dict(channel.metadata)
                )
            writer.add_message(
                channels[channel.topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    names = ['/odom', '/cmd_vel', JOURNAL]
    quick, slow = (columns_of(path, names) for path in (bag, copy))
    for name in names:
        for one, other in zip(vars(quick[name]).values(), vars(slow[name]).values(), strict=True):
            np.testing.assert_array_equal(one, other)


def test_a_damaged_bag_is_refused_or_read_never_more(bag, tmp_path):
    """Where the damage does no harm to what is asked for, the numbers are those of the run."""
    whole = bag.read_bytes()
    sound = columns_of(bag, ['/odom', JOURNAL])
    generator = np.random.default_rng(5)
    copy = tmp_path / 'damaged.mcap'
    refused = 0
    for k in range(30):
        content = bytearray(whole)
        if k % 3:
            content[int(generator.integers(len(whole)))] ^= 1 << int(generator.integers(8))
        else:
            del content[int(generator.integers(len(whole))) :]
        copy.write_bytes(content)
        try:
            read = columns_of(copy, ['/odom', JOURNAL])
        except BagError:
            refused += 1
            continue
        for name, column in read.items():
            np.testing.assert_array_equal(column.numbers, sound[name].numbers)
    assert refused > 15


# -- the commands ---------------------------------------------------------------------------------


def test_a_replay_written_as_a_bag_compares_with_its_source(bag, tmp_path, capsys):
    assert bag_program('replay', bag, '--output', tmp_path / 'again') == 0
    printed = capsys.readouterr().out
    assert 'x real time' in printed
    assert 's to compile and to warm up are not counted' in printed
    assert bag_program('compare', bag, tmp_path / 'again', '--abs', '1e-6', '--rel', '1e-6') == 0
    picture, limits = tmp_path / 'same.png', ('--abs', '1e-6', '--rel', '1e-6')
    assert bag_program('compare', tmp_path / 'again', *limits, '--picture', picture) == 0
    assert picture.read_bytes().startswith(b'\x89PNG')


def test_a_replay_with_other_parameters_reports_an_open_loop(bag, tmp_path, capsys):
    assert bag_program('replay', bag, '--output', tmp_path / 'what', '--set', 'law.gain=90') == 0
    assert 'open loop' in capsys.readouterr().out
    one, other = load_inputs(bag), load_inputs(tmp_path / 'what')
    outcome = compare_bags(one, other)
    assert not outcome.same
    assert any('law.gain is 90.0' in text for text in outcome.parameters)
    picture = tmp_path / 'picture.png'
    assert bag_program('compare', bag, tmp_path / 'what', '--picture', picture) == 3
    assert picture.read_bytes().startswith(b'\x89PNG')
    assert 'law.gain' in capsys.readouterr().out


def test_wrong_tolerances_are_refused(bag):
    with pytest.raises(ValueError, match='FIELD=NUMBER'):
        bag_program('compare', bag, '--field', 'cmd_vel.linear.x=little')
