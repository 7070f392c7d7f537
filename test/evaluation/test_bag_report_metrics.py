# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The report of a bag: right numbers from whole bags, and no crash from broken ones."""

import base64
from dataclasses import replace
from html.parser import HTMLParser
import json
import re
import zlib

import numpy as np
import pytest
from support.bag_messages import (
    START,
    STORE,
    TYPES,
    diagnostics,
    header,
    number,
    odometry_message,
    twist_message,
)
from support.long_tests import few_of

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.control.controller import WHEELS
from t3mpc_ros.evaluation.bag_report.metrics import (
    SETTLING,
    WINDOW,
    ReportMetrics,
    compute_metrics,
    driven,
    driving,
    estimation_target,
    path_of,
    preview_before_switch,
    statistics,
    tracking_error,
    variation,
)
from t3mpc_ros.evaluation.bag_report.report_charts import SECTIONS
from t3mpc_ros.evaluation.bag_report.report_page import write_report
from t3mpc_ros.evaluation.bag_report.run_data import SIGNAL_NAMES, Series, load_run
from t3mpc_ros.evaluation.charts import MAX_POINTS, PageData, thinned
from t3mpc_ros.evaluation.topic_roles import (
    COMMAND,
    NAMES,
    ODOMETRY,
    REFERENCE,
    TRUTH,
    ReportOptions,
    find_topics,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, advance_pose, twist_from_wheels
from t3mpc_ros.geometry.types import ORIGIN, BodyTwist, Pose, WheelSpeeds

pytestmark = pytest.mark.slow

GEOMETRY = WheelGeometry(wheel_radius=0.04, wheel_separation=0.16)
LEAD = 0.2
SWITCHES = (4.0, 8.0, 12.0, 16.0)
DETAILS = {
    'provenance': {'version': '0.1.0', 'commit': '<script>alert(1)</script>'},
    'sim_robot': {'wheel_radius': '0.04', 'wheel_separation': '0.16'},
    'controller': {'law.gain': '8.0'},
}
LOOP = 'controller: loop'
TERMS = ('fuzzy', 'feedback', 'feedforward', 'compensator', 'predictive', 'applied')


# -- a run made up ------------------------------------------------------------------------------


def wanted(t, selected):
    """Return one of four smooth signals (rad/s) and its derivative (rad/s²)."""
    a, b, c = (0.5, 0.9, 1.3, 0.7)[selected - 1], (1.9, 1.2, 2.3, 1.6)[selected - 1], selected
    offset = (3.0, 5.0, 1.5, 4.0)[selected - 1]
    value = offset + 1.5 * np.sin(2 * a * t + c) + 0.8 * np.sin(2 * b * t)
    return value, 3.0 * a * np.cos(2 * a * t + c) + 1.6 * b * np.cos(2 * b * t)


def dynamics(speeds):
    """Return the unknown g of both wheels, rad/s²."""
    return np.array(
        [-0.8 * speeds[0] + 0.5 * np.sin(speeds[1]), -0.9 * speeds[1] + 0.4 * speeds[0]]
    )


def selection(t):
    mode = sum(t >= switch for switch in SWITCHES)
    return mode, ((1, 2), (3, 4), (2, 1), (4, 4), (1, 3))[mode]


def simulate(duration=20.0, rate=100.0):
    """Return rows of a robot that approaches its reference, with the terms that follow from it."""
    generator = np.random.default_rng(0)
    period = 1.0 / rate
    speeds, pose = np.array([1.0, 1.0]), Pose(0.0, 0.0, 0.3)
    rows = []
    for i in range(round(duration * rate)):
        t = i * period
        mode, chosen = selection(t)
        r, rate_r = np.array([wanted(t, one) for one in chosen]).T
        acceleration = rate_r - 6.0 * (speeds - r)
        terms = {name: 0.1 * k + np.sin([t, 2 * t]) for k, name in enumerate(TERMS)}
        rows.append(
            {
                't': t,
                'mode': mode,
                'chosen': chosen,
                'r': r,
                'speeds': speeds,
                'measured': speeds + generator.normal(0.0, 0.05, 2),
                'pose': pose,
                'error': speeds - r,
                'estimate': 0.9 * dynamics(speeds),
                'terms': terms | {'applied': acceleration - dynamics(speeds)},
                'command': speeds + acceleration * period,
            }
        )
        pose = advance_pose(pose, twist_from_wheels(WheelSpeeds(*speeds), GEOMETRY), period)
        speeds = speeds + period * acceleration
    return rows


def twist_of(wheels):
    return twist_message(twist_from_wheels(WheelSpeeds(*map(float, wheels)), GEOMETRY))


def odometry(stamp_ns, wheels, pose=ORIGIN):
    body = twist_from_wheels(WheelSpeeds(*map(float, wheels)), GEOMETRY)
    return odometry_message(stamp_ns, body, pose)


def signals(mode, chosen):
    layout = TYPES['std_msgs/msg/MultiArrayLayout'](dim=[], data_offset=0)
    data = np.array([mode, *chosen], dtype=np.int32)
    return TYPES['std_msgs/msg/Int32MultiArray'](layout, data)


class Sheet:
    """Collects messages by time of receipt, then writes them as one bag."""

    def __init__(self, namespace=''):
        self.rows = []
        self.topics = {}
        self.namespace = namespace

    def add(self, name, received, message):
        topic = name if name.startswith('/') else f'{self.namespace}/{name}'
        self.topics.setdefault(topic, message.__msgtype__)
        self.rows.append((received, topic, message))

    def write(self, folder, metadata_records=DETAILS, empty=()):
        with BagWriter(folder, metadata_records=metadata_records) as bag:
            for name, kind in empty:
                bag.add_topic(name, kind)
            for topic, kind in self.topics.items():
                bag.add_topic(topic, kind)
            for received, topic, message in sorted(self.rows, key=lambda row: row[0]):
                stamp = START + round(received * 1e9)
                data = bytes(STORE.serialize_cdr(message, message.__msgtype__))
                bag.write(topic, stamp, stamp, data)
        return folder


def sheet_of(rows, namespace='', announce=True, terms=True):
    """Return a run as the nodes would publish it."""
    sheet = Sheet(namespace)
    generator = np.random.default_rng(1)
    said = None
    for i, row in enumerate(rows):
        t, stamp = row['t'] + 0.5, START + round((row['t'] + 0.5) * 1e9)
        heard = t + 0.001
        sheet.add('reference', t - LEAD + 0.001, odometry(stamp, row['r']))
        if announce and said != (said := (row['mode'], row['chosen'])):
            sheet.add('reference/signals', t - LEAD, signals(*said))
        sheet.add('ground_truth/odom', heard, odometry(stamp, row['speeds'], row['pose']))
        sheet.add('odom', heard, odometry(stamp, row['measured'], row['pose']))
        told = heard + 0.002 + 0.001 * generator.random()
        sheet.add('cmd_vel', told, twist_of(row['command']))
        if i % 5 or not terms:
            continue
        for k, wheel in enumerate(WHEELS):
            sheet.add(f'controller/error/{wheel}', told, number(row['error'][k]))
            sheet.add(f'controller/estimate/{wheel}', told, number(row['estimate'][k]))
            sheet.add(f'controller/skill/{wheel}', told, number(0.4 + 0.1 * np.sin(t + k)))
            for name in TERMS:
                value = row['terms'][name][k]
                sheet.add(f'controller/terms/{name}/{wheel}', told, number(value))
        value = 0.5 * row['error'] @ row['error']
        sheet.add('controller/lyapunov/value', told, number(value))
        sheet.add('controller/lyapunov/margin', told, number(8.0 * value + 0.2 - 0.3 * (i < 50)))
    for second in range(len(rows) // 100 if terms else 0):
        link = {'cycles': 50 * second, 'cycles_lost': 2 * (second // 5), 'crc_errors': second // 9}
        link |= {'round_trip_median_ms': 6.0, 'round_trip_p99_ms': 9.0 + second, 'link': 'running'}
        sheet.add('/diagnostics', 1.0 + second, diagnostics(START, 'radio_bridge', **link))
    sheet.add('/diagnostics', 1.0, diagnostics(START, LOOP, 0, 'fine'))
    sheet.add('/diagnostics', 5.0, diagnostics(START, LOOP, 1, 'late <b>& later</b>'))
    sheet.add('/diagnostics', 6.0, diagnostics(START, LOOP, 1, 'late <b>& later</b>'))
    return sheet


@pytest.fixture(scope='module')
def rows():
    return simulate()


@pytest.fixture(scope='module')
def bag(rows, tmp_path_factory):
    return sheet_of(rows).write(tmp_path_factory.mktemp('whole') / 'bag')


@pytest.fixture(scope='module')
def run(bag):
    with open_bag(bag) as recording:
        return load_run(recording)


@pytest.fixture(scope='module')
def report(bag, tmp_path_factory):
    return write_report(bag, tmp_path_factory.mktemp('report'))


class Page(HTMLParser):
    """What a browser would make of the page, and whether its tags are closed."""

    def __init__(self, text):
        super().__init__()
        self.stack, self.charts, self.texts, self.external = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        if tag != 'meta':
            self.stack.append(tag)
        if 'chart' in attrs.get('class', '').split():
            self.charts.append(attrs['id'])
        self.external += [attrs[key] for key in ('href', 'src') if key in attrs]

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        if self.stack[-1:] not in (['script'], ['style']):
            self.texts.append(data)

    def text(self):
        return ' '.join(' '.join(self.texts).split())


def sections_of(figures):
    """Return the names of the sections with charts."""
    page = figures.report.read_text(encoding='utf-8')
    found = re.findall(r'<h2[^>]*>([^<]*)</h2>\n<div class="charts">', page)
    return [section.draw.__name__ for section in SECTIONS if section.title in found]


def page_of(figures):
    page = Page(figures.report.read_text(encoding='utf-8'))
    assert page.stack == []
    return page


# -- numbers ------------------------------------------------------------------------------------


def test_the_error_statistics_are_those_of_the_run(rows, report):
    """Computed here from what was simulated, there from bytes, twists and interpolation."""
    error = np.array([row['error'] for row in rows])
    times = np.array([row['t'] for row in rows])
    # The first command comes 3 to 4 ms after the first odometry, and a second later the robot
    # has caught up. The reference is received 199 ms ahead.
    moving = times > 1.005
    calm = moving.copy()
    for switch in SWITCHES:
        calm &= (times < switch - 0.195) | (times >= switch + 1.0)
    assert (np.count_nonzero(moving), np.count_nonzero(calm)) == (1899, 1423)
    for k, wheel in enumerate(WHEELS):
        found = report.wheels[wheel]
        for part, expected in ((found.overall, error[moving, k]), (found.settled, error[calm, k])):
            assert part.seconds == pytest.approx(0.01 * expected.size)
            assert part.rmse == pytest.approx(np.sqrt(np.mean(expected**2)), rel=1e-6)
            assert part.mae == pytest.approx(np.mean(np.abs(expected)), rel=1e-6)
            assert part.largest == pytest.approx(np.max(np.abs(expected)), rel=1e-6)
            assert part.count == expected.size


def test_over_a_switch_the_reference_is_not_interpolated(run):
    """A sample between the last of the old and the first of the new reference is no half."""
    reference = Series(
        np.array([0.0, 1.0, 2.0, 3.0]), {w: np.array([0.0, 1, 8, 9]) for w in WHEELS}
    )
    motion = Series(
        np.array([-1.0, 0.5, 1.5, 2.0, 2.5, 4.0]), {w: np.full(6, 10.0) for w in WHEELS}
    )
    made = {'motions': {REFERENCE: reference, TRUTH: motion}, 'switches': np.array([2.0])}
    error = tracking_error(type(run)(**{**vars(run), **made}), TRUTH)
    assert error.time.tolist() == [0.5, 1.5, 2.0, 2.5]
    assert error['left'].tolist() == [9.5, 9.0, 2.0, 1.5]


def test_noise_of_the_odometry_is_seen_in_its_error_only(run):
    noise = statistics(
        tracking_error(run, ODOMETRY)['right'] - tracking_error(run, TRUTH)['right']
    )
    assert noise.rmse == pytest.approx(0.05, rel=0.1)
    assert run.measured == TRUTH


def test_switches_are_found_where_the_reference_jumps(run):
    start = run.motions[REFERENCE].time[0]
    np.testing.assert_allclose(run.switches - start, SWITCHES, atol=1e-6)


def test_signals_are_drawn_where_they_apply(run):
    """They are announced a lead time ahead, like the reference itself."""
    for name in SIGNAL_NAMES:
        series = run.numbers[name]
        changed = series.time[1:][np.diff(series['value']) != 0] - run.motions[REFERENCE].time[0]
        np.testing.assert_allclose(changed, SWITCHES, atol=0.01)
    assert run.absent == ()


def test_chatter_is_total_variation_per_second():
    time = np.linspace(0.0, 4.0, 401)
    ramp = Series(time, {'a': 3.0 * time, 'b': np.where(np.arange(401) % 2, 0.5, -0.5)})
    assert variation(ramp, 'a') == pytest.approx(3.0)
    assert variation(ramp, 'b') == pytest.approx(100.0)
    assert np.isnan(variation(Series(time[:1], {'a': time[:1]}), 'a'))


def test_the_target_of_the_estimate_is_the_unknown_dynamics(run, rows):
    """The target is made from speeds and u alone, and must come out as g of the simulation."""
    times = np.array([row['t'] for row in rows]) + run.motions[TRUTH].time[0]
    true = np.array([dynamics(row['speeds']) for row in rows])
    for k, wheel in enumerate(WHEELS):
        target = estimation_target(run, wheel)
        sound = np.isfinite(target['value']) & (target.time > times[0] + 1.0)
        expected = np.interp(target.time[sound], times, true[:, k])
        difference = target['value'][sound] - expected
        assert np.sqrt(np.mean(difference**2)) < 0.1 * np.std(expected)
        gaps = np.isnan(target['value'])
        reach = WINDOW / 2 + 0.06
        assert np.abs(target.time[gaps, np.newaxis] - run.switches).min(axis=1).max() < reach


def test_slope_and_average_of_the_target_see_the_same_smoothing(run):
    """For a cubic speed and u = dchi/dt the target vanishes, however curved both are."""
    time = np.arange(0.0, 5.0, 0.01)
    speed, rate = 0.3 * time**3 - time**2, 0.9 * time**2 - 2.0 * time
    made = {TRUTH: Series(time, {'right': speed})}
    control = {'controller/terms/applied/right': Series(time, {'value': rate})}
    changed = type(run)(
        **{**vars(run), 'motions': made, 'numbers': control, 'switches': np.empty(0)}
    )
    target = estimation_target(changed, 'right')
    np.testing.assert_allclose(target['value'], 0.0, atol=2e-4)


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
    verdict = compute_metrics(followed, None, 0).verdict
    assert verdict.sound
    assert verdict.on_path == 1.0
    assert (verdict.headline, verdict.kind) == ('Good run', 'good')
    detour = pose.time > np.quantile(pose.time, 0.4)
    wide = replace(pose, values={**pose.values, 'x': pose['x'] + np.where(detour, 0.3, 0.02)})
    half = replace(followed, motions={**run.motions, REFERENCE: wide})
    verdict = compute_metrics(half, None, 0).verdict
    assert verdict.sound
    assert 0.3 < verdict.on_path < 0.5
    assert (verdict.headline, verdict.kind) == ('Mostly off its path', 'open')
    assert 'within 50 mm of it, for' in verdict.text()
    away = replace(pose, values={**pose.values, 'x': pose['x'] + 0.3})
    lost = replace(followed, motions={**run.motions, REFERENCE: away})
    assert 'for only 0 % of the drive' in compute_metrics(lost, None, 0).verdict.text()


def test_no_more_is_left_out_before_a_switch_than_after_it(run):
    """A reference may be stamped ten seconds ahead: then nothing would be left."""
    assert run.lead == pytest.approx(LEAD - 0.001)
    assert preview_before_switch(run) == run.lead
    assert preview_before_switch(replace(run, lead=10.0)) == SETTLING


def test_the_drive_spans_the_first_to_the_last_nonzero_command(run):
    """A stop in between, by a time-out say, is not excused."""
    time = np.arange(8.0)
    linear = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    angular = np.array([0.0, -0.0, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0])
    made = replace(run, motions={COMMAND: Series(time, {'linear': linear, 'angular': angular})})
    assert driving(made) == (2.0, 5.0)
    assert time[driven(time, made)].tolist() == [3.0, 4.0, 5.0]
    # Where the reference comes later than the command, the robot has to catch up then.
    late = time[2:] + 0.5
    assert late[driven(late, made)].tolist() == [3.5, 4.5]
    assert not driven(np.empty(0), made).size
    # A bag without commands does not say when the robot was driven.
    assert time[driven(time, replace(run, motions={}))].tolist() == time[1:].tolist()


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


def test_another_namespace_is_named_and_can_be_chosen(rows, tmp_path):
    bag = sheet_of(rows[:300], '/fleet/robot1', terms=False)
    for received, topic, message in sheet_of(rows[:100], '/fleet/robot2', terms=False).rows:
        bag.add(topic, received, message)
    bag.add('/fleet/robot1/controller/skill/right', 1.0, number(1.0))
    text = page_of(write_report(bag.write(tmp_path / 'bag'))).text()
    assert 'namespace /fleet/robot1' in text
    assert 'The bag also holds topics of /fleet/robot2' in text
    with open_bag(tmp_path / 'bag') as recording:
        second = load_run(recording, ReportOptions(namespace='fleet/robot2'))
    assert len(tracking_error(second, TRUTH)) == 100


def test_a_stamped_command_is_read_too(rows, tmp_path):
    sheet = Sheet()
    for row in rows[:50]:
        stamp = START + round(row['t'] * 1e9)
        stamped = TYPES['geometry_msgs/msg/TwistStamped'](header(stamp), twist_of(row['command']))
        sheet.add('cmd_vel', row['t'], stamped)
    with open_bag(sheet.write(tmp_path / 'bag')) as recording:
        command = load_run(recording).motions[COMMAND]
    np.testing.assert_allclose(command['right'], [row['command'][0] for row in rows[:50]])


@pytest.mark.parametrize(
    ('metadata_records', 'expected', 'complaint'),
    [
        (DETAILS, GEOMETRY, ''),
        ({}, WheelGeometry(), 'are assumed'),
        ({'robot': {'a.wheel_radius': 'big'}}, WheelGeometry(), 'is not a number'),
        (
            {'robot': {'a.wheel_radius': '-1.0', 'a.wheel_separation': '0.2'}},
            WheelGeometry(),
            'cannot be used',
        ),
        # The reference node has a geometry of its own, at its default unless somebody set it.
        (
            {'reference': {'wheel_radius': '0.035', 'wheel_separation': '0.147'}, **DETAILS},
            GEOMETRY,
            '',
        ),
    ],
)
def test_the_geometry_is_that_of_the_robot(rows, tmp_path, metadata_records, expected, complaint):
    bag = sheet_of(rows[:20], terms=False).write(tmp_path / 'bag', metadata_records)
    with open_bag(bag) as recording:
        run = load_run(recording)
    assert run.geometry == expected
    if complaint:
        assert any(complaint in note for note in run.notes)
    assumed = '0.035 m radius and 0.147 m apart are assumed'
    assert any(assumed in note for note in run.notes) == bool(complaint)


# -- the page -----------------------------------------------------------------------------------


def test_the_page_is_whole_and_needs_nothing_from_outside(report):
    page = page_of(report)
    assert len(sections_of(report)) == len(SECTIONS)
    text = report.report.read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', text)[1])
    assert {*data['charts'], *data['planes']} == set(page.charts)
    assert {each for each in page.external if not each.startswith('#')} == set()
    assert 'width=device-width' in text
    assert not re.search(r'url\(|@import|https?:', text.partition('<script>')[0])
    assert not re.search(r'fetch\(|XMLHttp|import\(|WebSocket|EventSource', text)


def test_words_from_the_bag_cannot_become_markup(report):
    text = report.report.read_text()
    assert '<script>alert' not in text
    assert '&lt;script&gt;alert(1)&lt;/script&gt;' in text
    assert 'late &lt;b&gt;&amp; later&lt;/b&gt;' in text


def test_a_complaint_is_shown_once_with_the_time_it_began(run):
    ((when, level, who, what),) = run.complaints
    assert (level, who, what) == ('warning', 'controller: loop', 'late <b>& later</b>')
    assert when == pytest.approx(5.0 - 0.3)  # the bag begins with the reference, at 0.3 s


def test_the_report_goes_beside_the_bag_unless_told_otherwise(tmp_path):
    sheet = Sheet()
    for i in range(5):
        sheet.add('reference/signals', 0.1 * i, signals(i, (1, 2)))
    bag = sheet.write(tmp_path / 'bag')
    figures = write_report(bag)
    assert figures.report == tmp_path / 'report.html'
    assert sections_of(figures) == ['switching']
    other = write_report(str(bag), str(tmp_path / 'deep' / 'er'))
    assert other.report == tmp_path / 'deep' / 'er' / 'report.html'
    assert other.report.is_file()


# -- bags that lack something -------------------------------------------------------------------


def test_an_absent_topic_leaves_out_its_figures_and_is_named(rows, tmp_path):
    sheet = sheet_of(rows[:300], announce=False, terms=False)
    figures = write_report(sheet.write(tmp_path / 'bag'))
    own = {'tracking', 'error', 'control', 'portrait', 'path', 'timing'}
    assert set(sections_of(figures)) == {*own, 'response'}
    assert 'controller/estimate/right' in figures.absent
    text = page_of(figures).text()
    assert 'Not in the bag, or without a message: reference/signals, controller/' in text


@pytest.mark.parametrize('gone', [REFERENCE, ODOMETRY, TRUTH, COMMAND, 'reference/signals'])
def test_any_topic_may_be_empty(rows, tmp_path, gone):
    sheet = sheet_of(rows[:150])
    sheet.rows = [row for row in sheet.rows if row[1] != f'/{gone}']
    figures = write_report(sheet.write(tmp_path / 'bag'))
    assert figures.absent == (gone,)
    page_of(figures)
    assert isinstance(figures, ReportMetrics)
    assert np.isfinite(figures.wheels['right'].overall.rmse) == (gone != REFERENCE)
    if gone == TRUTH:
        assert figures.measured == ODOMETRY
    if gone == REFERENCE:
        assert 'RMSE' not in figures.summary()


@pytest.mark.parametrize('count', few_of([2, 1, 3]))
def test_a_handful_of_messages_does_no_harm(rows, tmp_path, count):
    """Every series has ``count`` samples: no line, no median, no percentile may need more."""
    sheet = sheet_of(rows[:20])
    seen = dict.fromkeys(sheet.topics, 0)
    few = []
    for row in sorted(sheet.rows, key=lambda row: row[0]):
        seen[row[1]] += 1
        if seen[row[1]] <= count:
            few.append(row)
    sheet.rows = few
    figures = write_report(sheet.write(tmp_path / 'bag'))
    page_of(figures)
    assert figures.messages == len(few)
    assert '\n' not in figures.summary()


def test_only_nonsense_is_reported_as_nothing(rows, tmp_path):
    sheet = sheet_of(rows[:50], terms=False)
    for _, topic, message in sheet.rows:
        if topic in ('/odom', '/ground_truth/odom', '/reference'):
            message.twist.twist.angular.z = float('nan')
    figures = write_report(sheet.write(tmp_path / 'bag'))
    assert sections_of(figures) == ['control', 'switching']
    page_of(figures)


def test_a_reference_that_starts_again_does_no_harm(rows, tmp_path):
    """Stamps that go back: of two samples for one instant the later message counts."""
    sheet = sheet_of(rows[:300], terms=False)
    for row in rows[100:200]:
        stamp = START + round((row['t'] + 0.5) * 1e9)
        sheet.add('reference', 4.0 + row['t'], odometry(stamp, row['r'] + 1.0))
    with open_bag(sheet.write(tmp_path / 'bag')) as recording:
        reference = load_run(recording).motions[REFERENCE]
    assert np.all(np.diff(reference.time) > 0.0)
    changed = [row['r'][0] + (1.0 if 100 <= i < 200 else 0.0) for i, row in enumerate(rows[:300])]
    np.testing.assert_allclose(reference['right'], changed, atol=1e-9)
