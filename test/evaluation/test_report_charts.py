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
"""Charts, numbers and sentences of a bag report; no two quantities of the run are equal."""

from dataclasses import replace
import math
from pathlib import Path
import re

import numpy as np
import pytest
from support.report_run import COMMANDED, LINK, MOTIONS, NUMBERS, RUN, TIME, WHEELS

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.evaluation.bag_report import report_page
from t3mpc_ros.evaluation.bag_report.diagnostic_history import (
    COUNTED,
    Cause,
    LinkHistory,
    cause_between,
)
from t3mpc_ros.evaluation.bag_report.incidents import Incidents, Stop, find_incidents
from t3mpc_ros.evaluation.bag_report.metrics import (
    compute_metrics,
    estimation_target,
)
from t3mpc_ros.evaluation.bag_report.recorded_run import (
    BY_WHEEL,
    SIGNAL_NAMES,
    Series,
)
from t3mpc_ros.evaluation.bag_report.report_charts import SECTIONS
from t3mpc_ros.evaluation.bag_report.report_page import link_table, response_table
from t3mpc_ros.evaluation.bag_report.run_comparison import _sentence
from t3mpc_ros.evaluation.bag_report.verdict import (
    KNOWN_PARAMETERS,
    KNOWN_RMSE,
    MAX_RATIO,
    judge,
    known_rmse,
)
from t3mpc_ros.evaluation.confidence_intervals import Difference
from t3mpc_ros.evaluation.drive_response import ResponseFit
from t3mpc_ros.evaluation.html_page import Plane
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE, TRUTH

DEMO = Path(__file__).parents[2] / 'bench' / 'frozen' / 'demo.mcap'
GOLDEN = Path(__file__).parents[1] / 'golden' / 'switches.mcap'
METRICS = compute_metrics(RUN, Path('r.html'), 7)


def motion(topic, name):
    return RUN.motions[topic][name]


def recorded(name):
    return NUMBERS[f'controller/{name}']['value']


def of_wheels(name):
    return {f'{wheel} wheel': recorded(f'{name}/{wheel}') for wheel in WHEELS}


def expected():
    """Return unit and lines of every chart by its title."""
    found = {}
    symbols = dict(
        zip((*TERM_NAMES, 'applied'), ('−g', '−Kδ', 'ṙ', 'v_c', 'v_p', 'u'), strict=True)
    )
    for name, title, *_ in BY_WHEEL:
        truth = {'robot (ground truth)': motion(TRUTH, name)}
        command = {'command': motion(COMMAND, name)}
        both = {'robot (odometry)': motion(ODOMETRY, name), 'reference': motion(REFERENCE, name)}
        of_law = {
            f'{term} {sign}': recorded(f'terms/{term}/{name}') for term, sign in symbols.items()
        }
        target = estimation_target(RUN, name)['value']
        found |= {
            title: ('rad/s', truth | both),
            f'Command, {title}': ('rad/s', command),
            f'Response, {title}': ('rad/s', truth | command),
            f'Terms, {title}': ('rad/s²', of_law),
            f'Estimate, {title}': (
                'rad/s²', {'estimate g': recorded(f'estimate/{name}'), 'target': target},
            ),
        }  # fmt: skip
    errors = {f'{w} wheel': motion(TRUTH, w) - motion(REFERENCE, w) for w in WHEELS}
    labels = ('active mode', 'right wheel', 'left wheel')
    signals = (NUMBERS[name]['value'] for name in SIGNAL_NAMES)
    trips = {'median': LINK['round_trip_median_ms'], '99 % below': LINK['round_trip_p99_ms']}
    faults = {
        'resets of the robot board': 'robot_resets',
        'resets of the dongle': 'dongle_resets',
        'port failures': 'port_failures',
        'wrong checksums': 'crc_errors',
        'malformed frames': 'frame_errors',
    }
    latency = 2.0 + 4.0 * (np.arange(1999) % 20 == 0)
    answered = np.array([math.nan, 95.0])
    return found | {
        'Error': ('rad/s', errors),
        'Acceleration u applied': ('rad/s²', of_wheels('terms/applied')),
        'Skill of the predictor': ('share', of_wheels('skill')),
        'V, half the squared error': ('rad²/s²', {'V': recorded('lyapunov/value')}),
        'Margin of the guaranteed decrease': ('rad²/s³', {'margin': recorded('lyapunov/margin')}),
        'Active mode and chaotic signals': ('number', dict(zip(labels, signals, strict=True))),
        'radio: cycles answered since the report before': ('%', {'answered': answered}),
        'Round trip': ('ms', trips),
        'Faults since the first report': (
            'number', {label: LINK[key] - 1.0 for label, key in faults.items()},
        ),
        'From odometry to command': ('ms', {'latency': latency}),
        'Between two messages of odom': ('ms', {'odom': np.full(1999, 10.0)}),
        'Between two messages of cmd_vel': (
            'ms', {'cmd_vel': 1e3 * np.diff(RUN.receipts[COMMAND])},
        ),
    }  # fmt: skip


DRAWN = [each for section in SECTIONS for each in section.draw(RUN, METRICS)]
CHARTS = {chart.title: chart for chart in DRAWN if not isinstance(chart, Plane)}


def test_charts_show_what_their_labels_say():
    assert CHARTS.keys() == expected().keys()
    for title, (unit, lines) in expected().items():
        assert CHARTS[title].unit == unit, title
        found = {line.label: line for line in CHARTS[title].lines if line.label != 'fit'}
        assert found.keys() == lines.keys(), title
        for label, values in lines.items():
            # A step is drawn to the end of the run.
            shown = found[label].value[: values.size]
            np.testing.assert_allclose(shown, values, atol=1e-9, err_msg=title)
    colours = {line.label: line.colour for title in BY_WHEEL for line in CHARTS[title.title].lines}
    assert colours == {
        'robot (ground truth)': 'truth', 'robot (odometry)': 'odometry', 'reference': 'reference',
    }  # fmt: skip
    for title in ('Error', 'Acceleration u applied', 'Skill of the predictor'):
        assert [line.colour for line in CHARTS[title].lines] == [*WHEELS]


def test_planes_have_the_axes_of_their_titles():
    incidents = Incidents((Stop(3.0, 4.0, Cause('')),), slips=((5.0, 5.5), (6.0, 6.5)))
    metrics = replace(METRICS, incidents=incidents)
    planes = {
        each.title: each
        for section in SECTIONS
        for each in section.draw(RUN, metrics)
        if isinstance(each, Plane)
    }
    portrait, floor = planes['Right wheel over left wheel'], planes['Floor']
    assert (portrait.unit, floor.unit) == ('rad/s', 'm')
    for curve, topic in zip(portrait.curves, (REFERENCE, TRUTH), strict=True):
        assert (curve.x[0], curve.y[0]) == (motion(topic, 'left')[0], motion(topic, 'right')[0])
    assert portrait.summary.startswith('The right wheel upwards over the left wheel;')
    truth = {curve.label: curve for curve in floor.curves}['robot (ground truth)']
    assert np.isin(motion(TRUTH, 'x'), truth.x).all()
    assert np.isin(motion(TRUTH, 'y'), truth.y).all()
    places = {colour: (t, x, y) for t, x, y, colour in floor.marks}
    assert places['switch'][0] == pytest.approx(8.0, abs=0.02)
    assert places['stopped'][0] == pytest.approx(3.0, abs=0.02)
    assert floor.summary.endswith('A wheel slips for 1.0 s. Points: switches and stops.')
    slip = floor.curves[-1]
    assert slip.label == 'a wheel slips'
    slipping = np.isfinite(slip.x)
    expected = [(5.0 <= t <= 5.5) or (6.0 <= t <= 6.5) for t in slip.time]
    assert slipping.tolist() == expected
    assert slip.x[slipping].tolist() == truth.x[slipping].tolist()


def test_sentences_give_the_numbers_of_their_charts():
    def number(value):
        return f'{value:#.3g}' if abs(value) < 99.95 else f'{value:.0f}'

    found = METRICS.wheels['right']
    rmse, settled, largest = map(
        number, (found.overall.rmse, found.settled.rmse, found.overall.largest)
    )
    size = np.abs(motion(TRUTH, 'right') - motion(REFERENCE, 'right'))
    at = TIME[np.argmax(np.where(TIME >= 3.0, size, 0.0))]
    assert CHARTS['Error'].summary.startswith(
        f'Right wheel: RMSE {rmse} rad/s while driven, {settled} rad/s while driven and settled; '
        f'the largest error is {largest} rad/s at {at:.1f} s.'
    )
    wanted = motion(REFERENCE, 'right')
    assert CHARTS['right wheel'].summary == (
        f'The reference runs from {number(wanted.min())} to {number(wanted.max())} rad/s; the '
        f'robot (ground truth) follows it with a settled RMSE of {settled} rad/s.'
    )
    varied, demand = (
        number(np.abs(np.diff(values)).sum() / 19.99)
        for values in (COMMANDED['right'], motion(REFERENCE, 'right'))
    )
    command = COMMANDED['right']
    assert CHARTS['Command, right wheel'].summary == (
        f'The command runs from {number(command.min())} to {number(command.max())} rad/s and '
        f'varies by {varied} rad/s per second; the reference varies by {demand}.'
    )
    assert CHARTS['Active mode and chaotic signals'].summary == (
        'The reference switches 1 times, at 8.0 s.'
    )
    margin = CHARTS['Margin of the guaranteed decrease'].summary
    assert margin == 'The margin is below zero 25.0 % of the time.'
    skills = [np.mean(each) for each in of_wheels('skill').values()]
    assert CHARTS['Skill of the predictor'].summary == (
        f'Mean: {number(skills[0])} of the right wheel, {number(skills[1])} of the left wheel.'
    )
    assert CHARTS['Round trip'].summary == 'The round trip is from 6.00 to 11.0 ms.'
    assert CHARTS['Faults since the first report'].summary == (
        'resets of the robot board 2, resets of the dongle 3, port failures 4, '
        'wrong checksums 5, malformed frames 7.'
    )
    assert CHARTS['From odometry to command'].summary == (
        'Median 2.00 ms, 99 % below 6.00 ms, largest 6.00 ms.'
    )
    sizes = CHARTS['Terms, left wheel'].summary
    for term in (*TERM_NAMES, 'applied'):
        values = recorded(f'terms/{term}/left')
        assert f'{term} {number(np.sqrt(np.mean(values**2)))}' in sizes


# -- metrics --------------------------------------------------------------------------------------


def test_tables_of_response_and_link_in_full():
    rows = response_table(RUN, {'right': ResponseFit(0.031, 0.012, 0.98, 0.994, 0.001)}).rows
    assert [*map(list, rows)] == [
        ['right wheel', '31', '12', '43', '0.980', '99.4'],
        ['left wheel', *5 * [rows[1][1]]],
    ]
    counts = dict(zip(COUNTED, (1000.0, 13.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0), strict=True))
    gauges = {'round_trip_median_ms': 6.5, 'round_trip_p99_ms': 12.0, 'telemetry_age_s': 0.4}
    values = {key: np.array([0.0, value]) for key, value in counts.items()}
    values |= {key: np.array([value, value]) for key, value in gauges.items()}
    link = LinkHistory('radio', np.arange(2.0), values)
    assert [row[1] for row in link_table([link]).rows] == [
        '98.7 %', '6.50 ms', '12.0 ms', '0.400 s', '1000', '13', '2', '3', '4', '5', '6', '7',
    ]  # fmt: skip


@pytest.mark.parametrize(
    ('command', 'text'),
    [
        (COMMANDED, 'from the first command other than zero, at 0.0 s, to the last, at 20.0 s,'),
        (dict.fromkeys(MOTIONS, 0.0 * TIME), 'Every command was zero: the robot was not'),
        (None, 'the bag holds no command that would show when'),
    ],
)
def test_what_is_counted_in_words(command, text):
    motions = {**RUN.motions, COMMAND: Series(TIME, command)} if command else {
        name: each for name, each in RUN.motions.items() if name != COMMAND
    }  # fmt: skip
    page = report_page.extents(replace(RUN, motions=motions))
    assert text in page
    assert ('the 0.5 s before each switch' in page) == ('Every' not in text)


# -- verdicts -------------------------------------------------------------------------------------

JUDGED = {'counted': 19.0, 'missing': 0.0, 'latency_99': 0.001}
SMALL = 0.01 * np.sin(3.0 * TIME)
FOLLOWING = {
    **RUN.motions,
    TRUTH: Series(TIME, {**RUN.motions[REFERENCE].values,
                         **{w: motion(REFERENCE, w) + SMALL for w in WHEELS}}),
}  # fmt: skip
SIZE = max(np.sqrt(np.mean(motion(REFERENCE, wheel) ** 2)) for wheel in WHEELS)
QUIET = replace(RUN, motions=FOLLOWING, receipts={ODOMETRY: TIME, COMMAND: TIME + 0.001})
RMSE = r'settled RMSE 0\.00(69|7\d)\d / 0\.00(69|7\d)\d rad/s'
ESTOP = (5.0, 'error', 'robot', 'emergency stop: a')
LATE = r'The machine was slow: 99 % of the commands came within 11\.0 ms of their odometry, .*'


def verdict_on(run, **given):
    """Return a verdict. The poses of these runs do not belong to their speeds."""
    return judge(run, replace(find_incidents(run), carried=()), **(JUDGED | given))


def shifted(**wheels):
    """Return motions whose wheels have these errors, rad/s."""
    found = {w: motion(REFERENCE, w) + wheels.get(w, 0.0) for w in WHEELS}
    return {**RUN.motions, TRUTH: Series(TIME, {**RUN.motions[REFERENCE].values, **found})}


def standing(start, end, *, commanded=False):
    """Return motions of a robot that stands from one time to another."""
    stands = (start <= TIME) & (end > TIME)
    values = FOLLOWING[TRUTH].values
    still = {
        k: v if k in ('x', 'y', 'yaw') else np.where(stands, 0.0, v) for k, v in values.items()
    }
    found = {**FOLLOWING, TRUTH: Series(TIME, still)}
    if commanded:
        values = {k: np.where(stands, 0.0, v) for k, v in COMMANDED.items()}
        found[COMMAND] = Series(TIME, values)
    return found


ZERO = {**FOLLOWING, COMMAND: Series(TIME, {k: 0.0 * v for k, v in COMMANDED.items()})}


@pytest.mark.parametrize(
    ('run', 'given', 'sentence', 'kind', 'sound'),
    [
        ({}, {}, rf'Good run: {RMSE}, and the robot never stood\.', 'good', True),
        ({}, {'missing': 0.02, 'counted': 10.0, 'latency_99': 0.01}, r'Good run: .*',
         'good', True),
        ({}, {'missing': 0.031}, rf'3\.1 % of odom is missing; {RMSE}\.', 'bad', False),
        ({}, {'counted': 8.4}, rf'Only 8\.4 of 17\.0 s count: {RMSE}\.', 'bad', False),
        ({}, {'latency_99': 0.011}, r'Good run: .*', 'good', True),
        (
            {'motions': shifted(right=0.26 * SIZE)}, {},
            rf'The robot did not follow its reference: settled RMSE {0.26 * SIZE:#.3g} / 0\.00 '
            rf'rad/s on a reference of {SIZE:.2g} rad/s\.', 'bad', False,
        ),
        ({'motions': shifted(right=0.24 * SIZE)}, {}, r'Good run: .*', 'good', True),
        ({'motions': shifted(right=math.nan, left=math.nan)}, {},
         r'No settled motion was measured\.', 'bad', False),
        ({'motions': ZERO}, {}, r'The robot was never driven: every command was zero\.',
         'bad', False),
        ({'motions': ZERO, 'changes': (ESTOP,)}, {},
         r'The robot was never driven \(E-stop\): every command was zero\.', 'bad', False),
        ({'damage': {'torn': ''}}, {}, rf'Torn; {RMSE}\.', 'bad', False),
        (
            {'complaints': ((1.0, 'warning', 'a', 'processor overloaded'),)}, {},
            r'The machine was overloaded from 1\.0 s on \(a: processor overloaded\): errors since '
            rf"then may not be the controller's; {RMSE}\.", 'open', True,
        ),
        (
            {'motions': standing(5.0, 9.0), 'changes': (ESTOP,)}, {},
            rf'E-stop at 5\.0 s, the robot stood for 4\.0 s; while it drove {RMSE}\.',
            'bad', False,
        ),
        (
            {'motions': standing(15.0, 99.0), 'changes': ((15.2, *ESTOP[1:]),)}, {},
            rf'E-stop at 15\.0 s, the robot stood for 4\.[89] s; until then {RMSE}\.',
            'bad', False,
        ),
        (
            {'motions': standing(5.0, 9.0, commanded=True)}, {},
            r'The robot stood for 4\.0 s from 5\.0 s on \(the bag holds no diagnostics of that '
            rf'time\); while it drove {RMSE}\.', 'bad', False,
        ),
        (
            {'motions': standing(-1.0, 99.0), 'changes': ((0.0, *ESTOP[1:]),)}, {},
            r'E-stop: the robot never moved, although it was to for 19\.\d s\.', 'bad', False,
        ),
        (
            {'follows_path': True, 'motions': RUN.motions}, {},
            r'The robot did not follow its path: within 50 mm of its path for only 0 % of the '
            r'drive, path error \d+\.\d mm \(RMS\)\.', 'bad', False,
        ),
    ],
)  # fmt: skip
def test_each_verdict_in_words_and_its_limit(run, given, sentence, kind, sound):
    run = replace(QUIET, **run)
    verdict = verdict_on(run, **given)
    assert re.fullmatch(sentence, verdict.sentence), verdict.sentence
    assert (verdict.kind, verdict.sound) == (kind, sound)
    late = [each for each in verdict.reasons() if re.fullmatch(LATE, each)]
    assert bool(late) == (given.get('latency_99') == 0.011)
    assert verdict.text() == ' '.join([verdict.sentence, *verdict.reasons()])


def test_what_happened_besides_follows_with_the_remedy():
    """The reason of the robot stands before that of the controller, whichever came first."""
    changes = (
        (4.9, 'error', 'controller', 'stopped: odometry is not finite'),
        (5.3, 'error', 'radio_bridge', 'emergency stop: a'),
    )
    run = replace(QUIET, motions=standing(5.0, 9.0), changes=changes)
    verdict = verdict_on(run, missing=0.5)
    assert verdict.label == 'E-stop at 5.0 s'
    assert verdict.remedy.startswith('When the way is clear, release it')
    assert verdict.reasons()[1:] == ['50.0 % of odom is missing.']


@pytest.mark.parametrize(
    ('changes', 'name'),
    [
        ((), ''),
        (((7.4, 'error', 'robot', 'emergency stop: a'),), ''),  # too late to be the reason
        (((1.0, 'error', 'robot', 'emergency stop: a'),), 'E-stop'),  # it still holds
        (((1.0, 'error', 'robot', 'emergency stop: a'), (3.0, 'ok', 'robot', 'well')), ''),
        (((5.0, 'warning', 'sim_robot', 'the battery is low: 10 V'),), ''),  # no reason to stop
        (((5.0, 'warning', 'sim_robot', 'a; processor overloaded: b'),), ''),
        (((5.0, 'error', 'recorder', 'the disk is full'),), ''),  # not the robot's
        (((5.0, 'error', 'base/motors', 'overcurrent'),), 'base/motors: overcurrent'),
    ],
)
def test_the_reason_of_a_stop_is_of_its_time_and_of_the_robot(changes, name):
    assert cause_between(changes, 5.0, 5.4).name == name


def test_a_poor_run_is_far_worse_than_what_its_robot_reaches():
    for ratio, label in ((0.99 * MAX_RATIO, 'Good run'), (1.01 * MAX_RATIO, 'Poor run')):
        error = ratio * KNOWN_RMSE
        run = replace(QUIET, motions=shifted(left=error), parameters=KNOWN_PARAMETERS)
        found = verdict_on(run)
        assert (found.label, found.sound) == (label, label == 'Good run')
    assert f'{1.01 * MAX_RATIO:.0f} times the {KNOWN_RMSE:g} rad/s' in found.sentence


def test_a_recorded_demo_is_known_and_other_conditions_are_not():
    with open_bag(DEMO) as recording:
        records = recording.metadata_records
    assert known_rmse(records) == KNOWN_RMSE
    for node, other in (
        ('sim_robot', {'mass_factor': '2.0'}), ('sim_robot', {'noise.variance': '0.05'}),
        ('sim_robot', {'faults.slippery': '0.3'}), ('sim_robot', {'world': 'room'}),
        ('sim_robot', {'noise.variance': 'much'}), ('reference_generator', {'source': 'path'}),
    ):  # fmt: skip
        assert known_rmse({**records, node: {**records[node], **other}}) == math.inf
    assert known_rmse({}) == math.inf


@pytest.mark.parametrize(
    ('difference', 'half', 'text'),
    [
        (-0.2, 0.1, 'right wheel: mean squared error -0.2 ± 0.100 (rad/s)², smaller error'),
        (0.2, 0.1, 'right wheel: mean squared error +0.2 ± 0.100 (rad/s)², larger error'),
        (0.1, 0.1, 'right wheel: mean squared error +0.1 ± 0.100 (rad/s)², inconclusive'),
        (math.nan, math.inf,
         'right wheel: mean squared error unknown ± unknown (rad/s)², inconclusive'),
    ],
)  # fmt: skip
def test_a_difference_of_two_runs_in_words(difference, half, text):
    assert _sentence(BY_WHEEL[0], Difference(difference, half)) == f'{text}.'
