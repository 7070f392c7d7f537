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
"""The report of a bag: right numbers from whole bags, and no crash from broken ones."""

import base64
from dataclasses import replace
from html.parser import HTMLParser
import json
import math
import re
import zlib

import numpy as np
import pytest
from support.bag_messages import (
    START,
    TYPES,
    diagnostics,
    header,
    number,
    odometry_message,
    twist_message,
)
from support.report_run import RUN, sections_of, text_of
from support.robot_bags import write_with_records

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.control.controller import SCALAR_NAMES
from t3mpc_ros.evaluation.bag_report.incidents import driving
from t3mpc_ros.evaluation.bag_report.metrics import (
    WINDOW,
    compute_metrics,
    estimation_target,
    path_of,
)
from t3mpc_ros.evaluation.bag_report.recorded_run import (
    SIGNAL_NAMES,
    Series,
    geometry_of,
    load_run,
)
from t3mpc_ros.evaluation.bag_report.report_charts import SECTIONS
from t3mpc_ros.evaluation.bag_report.report_page import write_report
from t3mpc_ros.evaluation.bag_report.run_comparison import error_differences
from t3mpc_ros.evaluation.bag_report.tracking_errors import (
    counted,
    settled_rmse,
    statistics,
    tracking_error,
)
from t3mpc_ros.evaluation.html_page import MAX_POINTS, PageData, thinned
from t3mpc_ros.evaluation.run_record import SETTLED, MeasuredRun, Record
from t3mpc_ros.evaluation.topic_roles import (
    COMMAND,
    NAMES,
    ODOMETRY,
    REFERENCE,
    SCALARS,
    TRUTH,
    ReportError,
    ReportOptions,
    find_topics,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, advance_pose
from t3mpc_ros.geometry.types import BodyTwist, Pose

pytestmark = pytest.mark.slow

GEOMETRY = WheelGeometry(wheel_radius=0.04, wheel_separation=0.16)
LEAD, SWITCHES, RATE = 0.2, (4.0, 8.0, 12.0), 50.0
TIMES = np.arange(round(16.0 * RATE)) / RATE
OFFSETS = 0.01 * (2.0 + np.sin(TIMES))
"""By which the robot is faster than its reference, m/s."""
RECORDS = {
    'provenance': {'version': '0.1.0', 'commit': '<script>alert(1)</script>'},
    'sim_robot': {'wheel_radius': '0.04', 'wheel_separation': '0.16'},
    'controller': {'law.gain': '8.0'},
}
LATE = diagnostics(START, 'controller: loop', 1, 'late <b>& later</b>')


def signals(mode):
    layout = TYPES['std_msgs/msg/MultiArrayLayout'](dim=[], data_offset=0)
    data = np.array([mode, mode + 1, mode + 2], dtype=np.int32)
    return TYPES['std_msgs/msg/Int32MultiArray'](layout, data)


def rows_of_nodes():
    """Return (receipt in s, topic, message) of all nodes, with a reference that jumps."""
    noise = np.random.default_rng(0).normal(0.0, 0.002, TIMES.size)
    rows, pose, mode = [], Pose(0.0, 0.0, 0.3), -1
    for k, (t, offset) in enumerate(zip(TIMES.tolist(), OFFSETS.tolist(), strict=True)):
        at, stamp, before = t + 0.5, START + round((t + 0.5) * 1e9), mode
        mode = sum(t >= switch for switch in SWITCHES)
        v, w = 0.2 + 0.05 * mode + 0.05 * math.sin(1.3 * t), 0.2 * mode + 0.5 * math.sin(0.7 * t)
        if mode != before:
            rows.append((at - LEAD, '/reference/signals', signals(mode)))
        rows += [
            (at - LEAD + 0.001, '/reference', odometry_message(stamp, (v, w))),
            (at + 0.001, f'/{TRUTH}', odometry_message(stamp, (v + offset, w), pose)),
            (at + 0.001, '/odom', odometry_message(stamp, (v + offset + noise[k], w), pose)),
            (at + 0.003, '/cmd_vel', twist_message((v, w))),
        ]
        pose = advance_pose(pose, BodyTwist(v + offset, w), 1.0 / RATE)
        if k % 5 == 0:
            rows += [
                (at + 0.003, f'/controller/{name}', number(math.sin(t + j)))
                for j, name in enumerate(SCALAR_NAMES)
            ]
    for second in range(1, 16):
        link = {'cycles': 50 * second, 'cycles_lost': second, 'round_trip_median_ms': 6.0}
        rows.append((second, '/diagnostics', diagnostics(START, 'radio_bridge', **link)))
    fine = diagnostics(START, 'controller: loop', 0, 'fine')
    rows += [(1.1, '/diagnostics', fine), (5.0, '/diagnostics', LATE), (6.0, '/diagnostics', LATE)]
    return sorted(rows, key=lambda row: row[0])


ROWS = rows_of_nodes()


def until(second, *without):
    """Return the rows up to a time, without some topics."""
    return [row for row in ROWS if row[0] < second and row[1][1:] not in without]


def run_of(folder, rows, records=RECORDS, **options):
    with open_bag(write_with_records(folder / 'bag', rows, records)) as recording:
        return load_run(recording, ReportOptions(**options))


def report_of(folder, rows):
    return write_report(write_with_records(folder / 'bag', rows, RECORDS))


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_with_records(tmp_path_factory.mktemp('whole') / 'bag', ROWS, RECORDS)


@pytest.fixture(scope='module')
def run(bag):
    with open_bag(bag) as recording:
        return load_run(recording)


@pytest.fixture(scope='module')
def report(bag, tmp_path_factory):
    return write_report(bag, tmp_path_factory.mktemp('report'))


class Tags(HTMLParser):
    """Asserts that the tags of a page are closed."""

    def __init__(self, page):
        super().__init__()
        self.stack = []
        self.feed(page)
        assert self.stack == []

    def handle_starttag(self, tag, attrs):
        if tag != 'meta':
            self.stack.append(tag)

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag


def page_of(figures):
    page = figures.report.read_text(encoding='utf-8')
    Tags(page)
    return page


# -- numbers ------------------------------------------------------------------------------------


def test_all_topics_are_placed_at_the_times_that_they_are_for(run):
    """Signals are announced a lead time ahead, like the reference itself."""
    errors = [tracking_error(run, source)['right'] for source in (ODOMETRY, TRUTH)]
    assert statistics(errors[0] - errors[1]).rmse == pytest.approx(0.05, rel=0.1)  # the noise
    assert (run.measured, run.absent) == (TRUTH, ())
    start = run.motions[REFERENCE].time[0]
    np.testing.assert_allclose(run.switches - start, SWITCHES, atol=1e-6)
    for name in SIGNAL_NAMES:
        series = run.numbers[name]
        changed = series.time[1:][np.diff(series['value']) != 0] - start
        np.testing.assert_allclose(changed, SWITCHES, atol=0.01)
    ((when, *complaint),) = run.complaints
    assert complaint == ['warning', 'controller: loop', 'late <b>& later</b>']
    assert when == pytest.approx(5.0 - 0.3)  # the bag begins with the reference, at 0.3 s


def test_the_target_of_the_estimate_is_the_unknown_dynamics():
    """Made from speeds and u alone, which see the same smoothing however curved both are."""
    time = np.arange(0.0, 5.0, 0.01)
    speed, rate = 0.3 * time**3 - time**2, 0.9 * time**2 - 2.0 * time
    applied = Series(time, {'value': rate - (1.0 - 0.4 * time)})
    made = replace(
        RUN,
        motions={TRUTH: Series(time, {'right': speed})},
        numbers={'controller/terms/applied/right': applied},
        switches=np.array([2.5]),
    )
    target = estimation_target(made, 'right')
    gap = np.isnan(target['value'])
    wanted = 1.0 - 0.4 * target.time[~gap]
    np.testing.assert_allclose(target['value'][~gap], wanted, atol=2e-4)
    away, reach = np.abs(target.time - 2.5), WINDOW / 2 + 0.01
    assert away[gap].max() <= reach + 1e-9 < away[~gap].min() + 1e-6


def test_the_path_is_the_exact_arc_of_each_twist():
    generator = np.random.default_rng(2)
    time = np.cumsum(generator.uniform(0.005, 0.05, 200))
    motion = Series(
        time, {'linear': generator.normal(0.3, 0.2, 200), 'angular': generator.normal(0, 2.0, 200)}
    )
    pose = Pose(0.5, -1.0, 2.0)
    x, y = path_of(motion, pose)
    for i in range(199):
        assert (x[i], y[i]) == pytest.approx((pose.x, pose.y))
        twist = BodyTwist(motion['linear'][i], motion['angular'][i])
        pose = advance_pose(pose, twist, time[i + 1] - time[i])


# -- which errors count -------------------------------------------------------------------------


def test_a_path_is_judged_by_the_distance_from_it(run):
    """A patrol leaves its path at obstacles: its speeds had *no valid measurement*."""
    pose = run.motions[run.measured]
    reference = replace(pose, values={**pose.values, 'x': pose['x'] + 0.02})
    beside = {**run.motions, REFERENCE: reference}
    followed = replace(run, motions=beside, follows_path=True)
    figures = compute_metrics(followed, None, 0)
    verdict = figures.verdict
    # Its reference is a path: errors of the speeds say nothing about it.
    said = [title for _, title in figures.numbers()]
    assert [title for title in said if 'RMSE' in title or 'error,' in title] == [
        'path error, root mean square',
        'path error, 99 % below',
    ]
    assert figures.numbers()[2] == ('100 %', 'of the drive within 50 mm of the path')
    assert verdict.sound
    assert verdict.on_path == 1.0
    assert (verdict.label, verdict.kind) == ('Good run', 'good')
    assert 'within 50 mm of its path for 100 % of the drive, path error 20.0 mm' in verdict.text()
    aside = replace(pose, values={**pose.values, 'y': pose['y'] + 0.03})
    other = replace(followed, motions={**run.motions, REFERENCE: aside})
    ((channel, difference),) = error_differences(followed, other).items()
    assert channel.title == 'distance from the path'
    assert difference.mean == pytest.approx(0.03**2 - 0.02**2)
    detour = pose.time > np.quantile(pose.time, 0.4)
    wide = replace(pose, values={**pose.values, 'x': pose['x'] + np.where(detour, 0.3, 0.02)})
    half = replace(followed, motions={**run.motions, REFERENCE: wide})
    verdict = compute_metrics(half, None, 0).verdict
    assert verdict.sound
    assert 0.3 < verdict.on_path < 0.5
    assert (verdict.label, verdict.kind) == ('Mostly off its path', 'open')
    away = replace(pose, values={**pose.values, 'x': pose['x'] + 0.3})
    lost = replace(followed, motions={**run.motions, REFERENCE: away})
    assert 'for only 0 % of the drive' in compute_metrics(lost, None, 0).verdict.text()


@pytest.mark.parametrize(
    ('duration', 'switches'),
    [(2.5, ()), (6.0, (4.6, 5.8)), (20.0, (3.0, 8.0, 8.9, 19.2, 19.7))],
)
def test_a_bag_and_a_run_have_the_same_settled_error(run, duration, switches):
    """The one counted from 1 s on and from 0.4 s before a switch, the other from 3 s and 0.5 s."""
    generator = np.random.default_rng(len(switches))
    time = np.arange(round(100.0 * duration)) / 100.0
    wanted, error = generator.normal(size=(2, time.size, 2))
    columns = {'time': time, 'reference': wanted, 'speeds': wanted + error}
    record = Record(columns, start=1.5, switches=np.array(switches))
    simulated = MeasuredRun(record)

    def series(wheels, twist):
        right, left = wheels.T
        named = {'right': right, 'left': left, 'linear': twist, 'angular': twist}
        return Series(time, named)

    drives = np.where(time >= record.start, 1.0, 0.0)
    motions = {
        REFERENCE: series(wanted, drives),
        TRUTH: series(wanted + error, drives),
        COMMAND: series(wanted, drives),
    }
    recorded = replace(run, motions=motions, switches=record.switches)
    truth = tracking_error(recorded, TRUTH).time
    np.testing.assert_array_equal(counted(truth, recorded), [simulated.counted, simulated.settled])
    both = math.hypot(*settled_rmse(recorded)) / math.sqrt(2.0)
    assert both == pytest.approx(SETTLED.value(simulated))


def test_the_drive_spans_the_first_to_the_last_nonzero_command(run):
    """A stop in between, by a time-out say, is not excused."""
    time = np.arange(8.0)
    linear = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    angular = np.array([0.0, -0.0, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0])
    motions = {COMMAND: Series(time, {'linear': linear, 'angular': angular})}
    made = replace(run, motions=motions, switches=np.empty(0))
    assert driving(made) == (2.0, 5.0)
    # The first half of a short drive is its start.
    assert time[counted(time, made)[0]].tolist() == [4.0, 5.0]
    # Where the reference comes later than the command, the robot has to catch up then.
    late = time[2:] + 1.5
    assert late[counted(late, made)[0]].tolist() == [4.5]
    assert not counted(np.empty(0), made)[0].size
    # A bag without commands does not say when the robot was driven.
    assert time[counted(time, replace(made, motions={}))[0]].tolist() == time[3:].tolist()


def test_a_long_line_keeps_its_extremes():
    generator = np.random.default_rng(3)
    time, value = np.arange(1e5), generator.normal(size=100_000)
    value[12_345], value[500:800] = 99.0, np.nan
    few, thin = thinned(time, value)
    assert few.size <= MAX_POINTS
    assert np.nanmax(thin) == 99.0
    assert np.nanmin(thin) == np.nanmin(value)


def test_a_page_contains_the_data_that_it_shows():
    """Unpacked as its script does it: times within 5 µs also after a month, values to 3e-5."""
    generator = np.random.default_rng(4)
    month = 30 * 86_400.0
    time = np.cumsum(generator.uniform(0.005, 0.02, 1000)) + np.repeat([0.0, month], 500)
    value = generator.normal(size=1000) * 10.0 ** generator.uniform(-6.0, 9.0, 1000)
    value[7] = np.nan
    data = PageData()
    assert [data.add('t', time), data.add('f', value), data.add('t', time)] == [0, 1, 0]
    assert data.columns == [('t', 1000), ('f', 1000)]
    content = np.frombuffer(zlib.decompress(base64.b64decode(data.packed())), np.uint8)
    steps = content[:8000].reshape(8, 1000).T.copy().view('<f8')[:, 0]
    np.testing.assert_allclose(np.cumsum(steps) * 1e-5, time, rtol=0.0, atol=5.1e-6)
    values = content[8000:].reshape(4, 1000).T.copy().view('<f4')[:, 0]
    assert np.isnan(values[7])
    np.testing.assert_allclose(np.delete(values, 7), np.delete(value, 7), rtol=3.1e-5)


# -- names and clocks ---------------------------------------------------------------------------


def test_topics_are_found_in_any_namespace_by_their_longest_name():
    """The truth was once taken for the odometry of a robot called ground_truth."""
    names = ['/a/ground_truth/odom', '/a/cmd_vel', '/a/reference', '/odom', '/other']
    found, spaces = find_topics(names)
    assert found == {TRUTH: names[0], COMMAND: '/a/cmd_vel', REFERENCE: '/a/reference'}
    assert spaces == ('/a', '')
    assert find_topics(names, '')[0] == {ODOMETRY: '/odom'}
    assert find_topics(names, 'a')[0] == find_topics(names, '/a/')[0] == found
    assert find_topics(names, 'b') == ({}, ('/b', '/a', ''))
    assert find_topics([]) == ({}, ('',))
    assert all(find_topics([f'/x/y/{name}'])[0] == {name: f'/x/y/{name}'} for name in NAMES)


def test_another_namespace_is_named_and_can_be_chosen(tmp_path):
    first, second = until(3.0, *SCALARS), until(1.5, *SCALARS)
    rows = [(t, f'/fleet/robot1{topic}', message) for t, topic, message in first]
    rows += [(t, f'/fleet/robot2{topic}', message) for t, topic, message in second]
    rows.append((1.0, '/fleet/robot1/controller/skill/right', number(1.0)))
    text = text_of(page_of(report_of(tmp_path, rows)))
    assert 'namespace /fleet/robot1' in text
    assert 'The bag also holds topics of /fleet/robot2' in text
    with open_bag(tmp_path / 'bag') as recording:
        second = load_run(recording, ReportOptions(namespace='fleet/robot2'))
        with pytest.raises(ReportError, match=r'namespace /r1; .*: /fleet/robot1, /fleet/robot2'):
            load_run(recording, ReportOptions(namespace='r1'))
    assert len(tracking_error(second, TRUTH)) == 50


def test_a_stamped_command_is_read_too(tmp_path):
    stamped = TYPES['geometry_msgs/msg/TwistStamped']
    rows = [(0.1 * k, '/cmd_vel', stamped(header(START), twist_message((0.1 * k, 0.3))))
            for k in range(5)]  # fmt: skip
    command = run_of(tmp_path, rows).motions[COMMAND]
    np.testing.assert_allclose(command['linear'], 0.1 * np.arange(5))
    np.testing.assert_allclose(command['right'] - command['left'], 0.3 * 0.16 / 0.04)


@pytest.mark.parametrize(
    ('metadata_records', 'expected', 'complaint'),
    [
        (RECORDS, GEOMETRY, ''),
        ({}, WheelGeometry(), 'are assumed'),
        ({'robot': {'a.wheel_radius': 'big'}}, WheelGeometry(), 'is not a number'),
        (
            {'robot': {'a.wheel_radius': '-1.0', 'a.wheel_separation': '0.2'}},
            WheelGeometry(),
            'cannot be used',
        ),
        # The reference node has a geometry of its own, at its default unless somebody set it.
        (
            {'reference': {'wheel_radius': '0.035', 'wheel_separation': '0.147'}, **RECORDS},
            GEOMETRY,
            '',
        ),
    ],
)
def test_the_geometry_is_that_of_the_robot(metadata_records, expected, complaint):
    notes = []
    assert geometry_of(metadata_records, ReportOptions(), True, notes) == expected
    assumed = '0.035 m radius and 0.147 m apart are assumed'
    assert any(assumed in note for note in notes) == bool(complaint)
    assert any(complaint in note for note in notes) == bool(complaint)


# -- the page -----------------------------------------------------------------------------------


def test_the_page_is_whole_and_needs_nothing_from_outside(report):
    text = page_of(report)
    sections = [each for each in SECTIONS if each.draw.__name__ != 'distance']  # follows no path
    assert len(sections_of(text)) == len(sections)
    data = json.loads(re.search(r'id="data">(.*?)</script>', text)[1])
    drawn = re.findall(r'<figure class="chart[^"]*" id="([^"]+)"', text)
    assert {*data['charts'], *data['planes']} == {*drawn}
    tags = re.sub(r'(<script[^>]*>).*?</script>', r'\1', text, flags=re.DOTALL)
    assert re.findall(r'\b(?:href|src)="[^#]', tags) == []
    assert 'width=device-width' in text
    assert not re.search(r'url\(|@import|https?:', text.partition('<script>')[0])
    assert not re.search(r'fetch\(|XMLHttp|import\(|WebSocket|EventSource', text)


def test_words_from_the_bag_cannot_become_markup(report):
    text = report.report.read_text()
    assert '<script>alert' not in text
    assert '&lt;script&gt;alert(1)&lt;/script&gt;' in text
    assert 'late &lt;b&gt;&amp; later&lt;/b&gt;' in text


def test_the_report_goes_beside_the_bag_unless_told_otherwise(tmp_path):
    figures = report_of(tmp_path, [(0.1 * i, '/reference/signals', signals(i)) for i in range(5)])
    assert figures.report == tmp_path / 'report.html'
    assert sections_of(figures.report.read_text()) == ['switching']
    other = write_report(str(tmp_path / 'bag'), str(tmp_path / 'deep' / 'er'))
    assert other.report == tmp_path / 'deep' / 'er' / 'report.html'
    assert other.report.is_file()


# -- bags that lack something -------------------------------------------------------------------


def test_absent_topics_leave_out_their_figures_and_are_named(tmp_path):
    figures = report_of(tmp_path, until(4.0, 'reference/signals', 'diagnostics', *SCALARS))
    own = {'tracking', 'error', 'control', 'portrait', 'path', 'timing'}
    assert set(sections_of(figures.report.read_text())) == {*own, 'response'}
    assert 'controller/estimate/right' in figures.run.absent
    text = text_of(page_of(figures))
    assert 'Not in the bag, or without a message: reference/signals, controller/' in text


@pytest.mark.parametrize('gone', [REFERENCE, ODOMETRY, TRUTH, COMMAND])
def test_any_topic_may_be_empty(tmp_path, gone):
    figures = report_of(tmp_path, until(3.0, gone))
    page_of(figures)
    assert figures.run.absent == (gone,)
    assert np.isfinite(figures.wheels['right'].overall.rmse) == (gone != REFERENCE)
    assert figures.run.measured == (ODOMETRY if gone == TRUTH else TRUTH)
    assert ('RMSE' in figures.summary()) == (gone != REFERENCE)


@pytest.mark.parametrize('count', [1, 2])
def test_a_handful_of_messages_does_no_harm(tmp_path, count):
    """Every series has ``count`` samples: no line, no median, no percentile may need more."""
    topics = {row[1]: [each for each in ROWS if each[1] == row[1]][:count] for row in until(2.0)}
    few = [row for rows in topics.values() for row in rows]
    figures = report_of(tmp_path, few)
    page_of(figures)
    assert figures.messages == len(few)
    assert len(figures.summary().splitlines()) == len(figures.numbers()) + 1


def test_only_nonsense_is_reported_as_nothing(tmp_path):
    rows = [
        (
            t,
            topic,
            odometry_message(START, (0.1, math.nan)) if hasattr(message, 'twist') else message,
        )
        for t, topic, message in until(1.5, *SCALARS)
    ]
    figures = report_of(tmp_path, rows)
    assert sections_of(figures.report.read_text()) == ['control', 'switching']
    page_of(figures)


def test_a_reference_that_starts_again_does_no_harm(tmp_path):
    """Stamps that go back: of two samples for one instant the later message counts."""
    later = [(4.0 + t, '/reference', odometry_message(START + round(t * 1e9), (0.7, 0.0)))
             for t in (1.0, 1.02, 1.04)]  # fmt: skip
    reference = run_of(tmp_path, until(3.0, *SCALARS) + later).motions[REFERENCE]
    assert np.all(np.diff(reference.time) > 0.0)
    changed = np.flatnonzero(np.isclose(reference['linear'], 0.7))
    np.testing.assert_allclose(reference.time[changed] + 0.3, [1.0, 1.02, 1.04], atol=1e-6)
