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
"""Every number of a report, computed again from its bag with NumPy alone.

By the words of docs/metrics.md, to the last printed digit. Nothing of the package is used but the
page that it writes.
"""

from functools import cache
from html import unescape
from importlib import import_module
from itertools import accumulate
import math
from pathlib import Path
import re

from mcap.reader import make_reader
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from support.long_tests import few_of
from support.recorded_stories import SIGNALS_STORY, STORIES

from t3mpc_ros.evaluation.bag_report.metrics import (
    CHANNEL_NUMBERS,
    LINK_NUMBERS,
    PATH_NUMBERS,
    RUN_NUMBERS,
)
from t3mpc_ros.evaluation.bag_report.report_page import write_report

DEMO = Path(__file__).parents[2] / 'bench' / 'frozen' / 'demo.mcap'
STORE = get_typestore(Stores.ROS2_JAZZY)
RADIUS, SEPARATION = 0.035, 0.147
TRUTH, ODOM, REFERENCE, COMMAND = '/ground_truth/odom', '/odom', '/reference', '/cmd_vel'


# -- the bag --------------------------------------------------------------------------------------


def decoded(kind, data):
    """Return stamp (ns, None without one) and numbers of a message."""
    message = STORE.deserialize_cdr(data, kind)
    if kind.endswith('/Int32MultiArray'):
        return None, message.data
    if kind.endswith('/Twist'):
        return None, (message.linear.x, message.angular.z)
    stamp, pose, twist = message.header.stamp, message.pose.pose, message.twist.twist
    yaw = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
    numbers = pose.position.x, pose.position.y, yaw, twist.linear.x, twist.angular.z
    return stamp.sec * 10**9 + stamp.nanosec, numbers


class Recording:
    """Receipts, stamps (s since the first message) and numbers by topic."""

    def __init__(self, path):
        rows, self.counts, times = {}, {}, []
        with path.open('rb') as file:
            for schema, channel, message in make_reader(file).iter_messages():
                self.counts[channel.topic] = self.counts.get(channel.topic, 0) + 1
                times.append(message.log_time)
                if channel.topic in (TRUTH, ODOM, REFERENCE, COMMAND, '/reference/signals'):
                    rows.setdefault(channel.topic, []).append(
                        (message.log_time, *decoded(schema.name, message.data))
                    )
        self.start, self.duration = min(times), (max(times) - min(times)) / 1e9
        self.received, self.time, self.numbers = {}, {}, {}
        for topic, found in rows.items():
            received = np.array([(row[0] - self.start) / 1e9 for row in found])
            stamped = found[0][1] is not None
            stamps = [(row[1] - self.start) / 1e9 for row in found] if stamped else received
            self.received[topic] = received
            time, numbers = np.array(stamps), np.array([row[2] for row in found])
            if topic != '/reference/signals':
                # Of two messages for one instant the later one.
                last = {instant: row for row, instant in enumerate(time.tolist())}
                order = [last[instant] for instant in sorted(last)]
                time, numbers = time[order], numbers[order]
            self.time[topic], self.numbers[topic] = time, numbers
        self.lead = 0.0
        if REFERENCE in rows:
            stamps = np.array([(row[1] - self.start) / 1e9 for row in rows[REFERENCE]])
            self.lead = max(0.0, float(np.median(stamps - self.received[REFERENCE])))

    def twist(self, topic):
        return self.numbers[topic][:, -2:]

    def wheels(self, topic):
        v, w = self.twist(topic).T
        return (v + 0.5 * SEPARATION * w) / RADIUS, (v - 0.5 * SEPARATION * w) / RADIUS


def shown(value):
    """Return three significant digits."""
    return f'{value:.0f}' if abs(value) >= 99.95 else f'{value:#.3g}'


# -- definitions, in the order of docs/metrics.md -------------------------------------------------


def gaps_of(time):
    steps = np.diff(time)
    least = max(2.0, 20.0 * np.median(steps))
    return [(time[k], time[k + 1]) for k in range(steps.size) if steps[k] > least]


def drive_of(bag):
    moving = [t for t, (v, w) in zip(bag.time[COMMAND], bag.twist(COMMAND), strict=True) if v or w]
    return moving[0], moving[-1]


@cache
def switches_of(bag):
    if '/reference/signals' not in bag.time:
        return []
    numbers = bag.numbers['/reference/signals']
    time, reference = bag.received['/reference/signals'] + bag.lead, bag.time[REFERENCE]
    steps = np.abs(np.diff(bag.wheels(REFERENCE), axis=1)).sum(axis=0)
    found = set()
    for row in range(1, time.size):
        if (numbers[row] != numbers[row - 1]).any():
            near = [k for k in range(steps.size) if abs(reference[k + 1] - time[row]) < 0.25]
            found.add(float(reference[1 + max(near, key=lambda k: steps[k])]))
    return sorted(found)


def wanted_at(bag, time):
    """Return the reference of both wheels at an instant; None where it is undefined."""
    reference, switches = bag.time[REFERENCE], switches_of(bag)
    wheels = np.array(bag.wheels(REFERENCE))
    gaps = gaps_of(reference)
    found = []
    for t in time:
        if not reference[0] <= t <= reference[-1] or any(a < t < b for a, b in gaps):
            found.append((math.nan, math.nan))
            continue
        k = np.searchsorted(reference, t, 'right') - 1
        after = min(k + 1, reference.size - 1)
        if after == k or reference[after] in switches:
            found.append(wheels[:, k])
        else:
            share = (t - reference[k]) / (reference[after] - reference[k])
            found.append((1.0 - share) * wheels[:, k] + share * wheels[:, after])
    return np.array(found).T


def smoothed(time, value):
    """Return times and values of parabolas fitted to windows."""
    width = max(0.2, 8.0 * np.median(np.diff(time)))
    step = width / 20.0
    grid = time[0] + step * np.arange(int((time[-1] - time[0]) / step) + 1)
    windows = np.lib.stride_tricks.sliding_window_view(np.interp(grid, time, value), 21)
    offsets = step * np.arange(-10, 11)
    middle = np.linalg.lstsq(np.vander(offsets, 3), windows.T, rcond=None)[0][2]
    at = grid[10:-10]
    k = np.clip(np.searchsorted(time, at, 'right'), 1, time.size - 1)
    return at, np.where(time[k] - time[k - 1] > width, math.nan, middle)


def stretches(rows):
    """Return the first and last row of each stretch that is true."""
    found = []
    for k in np.flatnonzero(rows).tolist():
        if found and found[-1][1] == k - 1:
            found[-1][1] = k
        else:
            found.append([k, k])
    return found


def held(time, values, at):
    return values[np.maximum(np.searchsorted(time, at, 'right') - 1, 0)]


@cache
def stops_of(bag, measured):
    """Return start and end of each stop of a run whose nodes report no other ones."""
    time, twist = bag.time[measured], bag.twist(measured)
    at, v = smoothed(time, twist[:, 0])
    _, w = smoothed(time, twist[:, 1])
    first, last = drive_of(bag)
    end = min(last, bag.time[REFERENCE][-1] - bag.lead)
    limits = np.array([0.05, 0.25])
    found = []
    still = (np.abs(v) < 0.01) & (np.abs(w) < 0.05)
    for a, b in stretches((np.abs(v) < 0.03) & (np.abs(w) < 0.15)):
        if still[a : b + 1].mean() < 0.5:
            continue
        middle = 0.5 * (at[a] + at[b])
        fast = (np.abs(twist) > limits).any(axis=1)
        before = time[fast & (np.abs(time - at[a]) <= 0.25) & (time < middle)]
        after = time[fast & (np.abs(time - at[b]) <= 0.25) & (time > middle)]
        low = before[-1] if before.size else at[a]
        high = after[0] if after.size else at[b]
        near = (time >= low - 0.5) & (time <= low)
        asked = held(bag.time[COMMAND], bag.twist(COMMAND), time[near])
        follows = (np.abs(twist[near] - asked) <= limits).all(axis=1)
        follows &= (np.abs(twist[near]) > limits).any(axis=1)
        start = max(time[near][follows][-1] if follows.any() else low, first)
        stop = min(high, end)
        probe = np.linspace(start, stop, 50)
        wanted = np.abs(held(bag.time[REFERENCE], bag.twist(REFERENCE), probe))
        demanded = (wanted > (0.02, 0.1)).any(axis=1) & (probe >= bag.time[REFERENCE][0])
        if stop - start >= 0.5 and demanded.mean() >= 0.5:
            found.append((start, stop))
    return found


@cache
def errors_of(bag, source, measured):
    """Return the rows that count, and the error of both wheels, at the stamps of a motion."""
    time, wanted = bag.time[source], wanted_at(bag, bag.time[source])
    error = np.array(bag.wheels(source)) - wanted
    known = ~np.isnan(wanted[0])
    first, last = drive_of(bag)
    first, last = max(first, time[known][0]), min(last, time[known][-1])
    driven = known & (time <= last) & (time >= first + min(3.0, 0.5 * (last - first)))
    for start, end in stops_of(bag, measured):
        driven &= (time < start - 0.5) | (time >= end + 1.0)
    for switch in switches_of(bag):
        if last < switch + 0.5:
            driven &= time < switch - 0.5
    settled = driven.copy()
    for switch in switches_of(bag):
        settled &= (time < switch - 0.5) | (time >= switch + 1.0)
    period = np.median(np.diff(time[known]))
    return {'driven': driven, 'driven, settled': settled}, error, period


def variation(time, values):
    before_gaps = {a for a, _ in gaps_of(time)}
    counted = [k for k in range(time.size - 1) if time[k] not in before_gaps]
    steps = np.diff(time)
    return np.abs(np.diff(values))[counted].sum() / steps[counted].sum()


def missing(stamps):
    stamps = np.unique(stamps)
    steps = np.diff(stamps)
    period = np.median(steps)
    span = sum(period if step > max(2.0, 20.0 * period) else step for step in steps)
    return max(0.0, 1.0 - stamps.size / (round(span / period) + 1))


def busiest_part(time, commanded_at, commanded):
    """Return start and end of the part without a gap in which the command varies most."""
    edges = [max(time[0], commanded_at[0]), min(time[-1], commanded_at[-1])]
    gaps = gaps_of(time) + gaps_of(commanded_at)
    for gap in gaps:
        edges[1:1] = gap
    edges = sorted(edges)
    parts = [
        (a, b)
        for a, b in zip(edges, edges[1:], strict=False)
        if not any(a < high and low < b for low, high in gaps)
    ]
    moved = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(commanded)))])
    return max(parts, key=lambda part: np.diff(np.interp(part, commanded_at, moved))[0])


@cache
def response(bag, measured, wheel):
    """Return dead time, lag (s), gain and explained share of one wheel, by exhaustion."""
    time, speed = bag.time[measured], bag.wheels(measured)[wheel]
    commanded_at, commanded = bag.time[COMMAND], bag.wheels(COMMAND)[wheel]
    step = min(max(0.25 * float(np.median(np.diff(time))), 0.002), 0.01)
    start, end = busiest_part(time, commanded_at, commanded)
    grid = start + step * np.arange(int((end - start) / step) + 1)
    u, y = held(commanded_at, commanded, grid), np.interp(grid, time, speed)
    shifts = int(1.0 / step) + 1
    y = y[shifts:] - y[shifts:].mean()

    def explained(lag):
        x = u - u.mean()
        if lag > 0.0:
            keep, before = math.exp(-step / lag), [x[0], *x[:-1].tolist()]
            filtered = accumulate(before, lambda out, new: keep * out + (1.0 - keep) * new)
            x = np.array([*filtered])
        # For each shift the part of x beside y, which has a mean of zero.
        product = np.correlate(x, y, 'valid')[:0:-1]
        sums = [np.concatenate([[0.0], np.cumsum(each)]) for each in (x, x**2)]
        total, squares = ((each[y.size :] - each[: -y.size])[:0:-1] for each in sums)
        energy = squares - total**2 / y.size
        shares = np.where(product > 0.0, product**2 / (energy * (y @ y)), -math.inf)
        shift = int(shares.argmax())
        return float(shares[shift]), -shift, float(product[shift] / energy[shift])

    lags = [0.0, *np.geomspace(0.5 * step, 3.0, 30).tolist()]
    coarse = [explained(lag) for lag in lags]
    row = max(range(len(lags)), key=lambda k: coarse[k][0])
    low = 0.0 if row == 0 else lags[max(row - 1, 1)]
    high = lags[min(row + 1, len(lags) - 1)]
    fine = [lags[row], *np.linspace(low, high, 16).tolist()]
    found = max(((explained(lag), lag) for lag in fine), key=lambda each: each[0][0])
    (share, shift, gain), lag = found
    return -shift * step, lag, gain, share


# -- the page -------------------------------------------------------------------------------------


def table_after(page, heading):
    """Return the rows of cells of the first table after a heading."""
    table = page.partition(f'>{heading}</h2>')[2].partition('</table>')[0]
    rows = re.findall(r'<tr[^>]*>(.*?)</tr>', table, re.DOTALL)
    cells = [re.findall(r'<td[^>]*>(.*?)</td>', row, re.DOTALL) for row in rows]
    return [[unescape(cell) for cell in row] for row in cells if row]


BAGS = ['demo', 'switches', 'slip stop', 'gap', 'good']


@pytest.fixture(scope='module', params=few_of(BAGS, 2))
def reported(request, tmp_path_factory):
    """Return the page of a report, and the messages of its bag."""
    folder = tmp_path_factory.mktemp('numbers')
    if request.param == 'demo':
        file = DEMO
    else:
        story = SIGNALS_STORY if request.param == 'switches' else STORIES[request.param]
        (file,) = story.write(folder / 'bag').glob('*.mcap')
    page = write_report(file, folder).report.read_text(encoding='utf-8')
    return page, Recording(file)


pytestmark = pytest.mark.slow


def test_the_main_figures(reported):
    page, bag = reported
    tiles = {
        unescape(text): unescape(value)
        for value, text in re.findall(r'<li><b>(.*?)</b><span>(.*?)</span></li>', page)
    }
    measured = TRUTH
    rows, error, _ = errors_of(bag, measured, measured)
    expected = {}

    def both(title, values, unit):
        expected[f'{title}, right / left'] = f'{" / ".join(map(shown, values))} {unit}'

    for name, title in (
        ('driven', 'RMSE while driven'),
        ('driven, settled', 'RMSE while driven and settled'),
    ):
        both(title, [math.sqrt(np.mean(each[rows[name]] ** 2)) for each in error], 'rad/s')
    both('largest error', [np.abs(each[rows['driven']]).max() for each in error], 'rad/s')
    for topic, title in ((COMMAND, 'command'), (REFERENCE, 'reference')):
        values = [variation(bag.time[topic], each) for each in bag.wheels(topic)]
        both(f'variation of the {title} per second', values, 'rad/s')
    expected['duration'] = f'{shown(bag.duration)} s'
    expected['messages'] = str(sum(bag.counts.values()))
    if '/reference/signals' in bag.time:  # else it is not known which jumps are switches
        expected['switches'] = str(len(switches_of(bag)))
    stood = sum(end - start for start, end in stops_of(bag, measured))
    expected['stood although it was to move'] = f'{shown(float(stood))} s'
    received = bag.received[ODOM]
    waits = [
        t - received[received <= t][-1] for t in bag.received[COMMAND] if (received <= t).any()
    ]
    for title, percent in (('median', 50.0), ('99 % below', 99.0)):
        expected[f'odometry to command, {title}'] = (
            f'{shown(1e3 * np.percentile(waits, percent))} ms'
        )
    expected['odometry missing'] = f'{shown(100.0 * missing(bag.time[ODOM]))} %'
    delays = tiles.pop('command to motion, right / left', '– / – ms')
    assert tiles == expected
    for wheel, text in enumerate(delays.removesuffix(' ms').split(' / ')):
        if text != '–':
            dead_time, lag, *_ = response(bag, measured, wheel)
            assert text == shown(1e3 * (dead_time + lag))
    sentence = unescape(re.search(r'<p class="headline">(.*?)</p>', page)[1])
    if 'settled RMSE' in sentence and 'until then' not in sentence:
        pair = expected['RMSE while driven and settled, right / left']
        assert f'settled RMSE {pair}' in sentence


def test_the_table_of_errors(reported):
    page, bag = reported
    found = table_after(page, 'Tracking error')
    expected = []
    for source, name in ((TRUTH, 'robot (ground truth)'), (ODOM, 'robot (odometry)')):
        rows, error, period = errors_of(bag, source, TRUTH)
        for wheel, each in zip(('right wheel', 'left wheel'), error, strict=True):
            for extent, counted in rows.items():
                size = np.abs(each[counted])
                numbers = math.sqrt(np.mean(size**2)), size.mean(), size.max()
                seconds = f'{size.size * period:.1f}'
                expected.append(
                    [name, wheel, extent, *map(shown, numbers), seconds, str(size.size), 'rad/s']
                )
    assert found == expected


def test_the_table_of_responses(reported):
    page, bag = reported
    for wheel, cells in enumerate(table_after(page, 'From command to motion')):
        if set(cells[1:5]) == {'–'}:
            continue  # not determined
        dead_time, lag, gain, explained = response(bag, TRUTH, wheel)
        times = [f'{1e3 * value:.0f}' for value in (dead_time, lag, dead_time + lag)]
        assert cells[1:] == [*times, shown(gain), shown(100.0 * explained)]


def test_the_table_of_the_path(reported):
    page, bag = reported
    time, twist = bag.time[TRUTH], bag.twist(TRUTH)
    at, v = smoothed(time, twist[:, 0])
    _, w = smoothed(time, twist[:, 1])
    step, known = at[1] - at[0], ~np.isnan(v)
    still = known & (np.abs(v) < 0.01) & (np.abs(w) < 0.05)
    stood = [(a, b) for a, b in stretches(still) if (b - a + 1) * step >= 0.5]
    lengths = [at[b] - at[a] for a, b in stood]
    distance, turned = np.abs(v[known]).sum() * step, np.abs(w[known]).sum() * step
    moving = np.count_nonzero(known & ~still) * step
    expected = [
        f'{shown(distance)} m', f'{shown(turned)} rad',
        f'{distance / moving:.3f} and {np.abs(v[known]).max():.3f} m/s', f'{moving:.1f} s',
        f'{len(stood)}, {sum(lengths):.1f} s in all, the longest {max([0.0, *lengths]):.1f} s',
    ]  # fmt: skip
    if stood:
        spans = [f'{at[a]:.1f} to {at[b]:.1f}' for a, b in stood]
        more = f', and {len(spans) - 5} more' if len(spans) > 5 else ''
        expected.append(f'{", ".join(spans[:5])}{more} s')
    asked = (np.abs(held(bag.time[COMMAND], bag.twist(COMMAND), at)) > (0.02, 0.1)).any(axis=1)
    asked &= at >= bag.time[COMMAND][0]
    expected.append(f'{step * sum(asked[a : b + 1].sum() for a, b in stood):.1f} s')
    assert [cells[1] for cells in table_after(page, 'Path and stops')] == expected


def test_the_table_of_timing_and_the_contents(reported):
    page, bag = reported
    for topic, count, rate, jitter, lost in table_after(page, 'Timing by topic'):
        waits = np.diff(bag.received[topic])
        period = np.median(waits)
        stamps = bag.time[topic] if topic != COMMAND else bag.received[topic]
        deviation = round(float(np.percentile(np.abs(waits - period), 99.0)), 9)
        assert [count, rate, jitter, lost] == [
            str(bag.counts[topic]), shown(1.0 / period), shown(1e3 * deviation),
            shown(100.0 * missing(stamps)),
        ], topic  # fmt: skip
    listed = {name: int(count) for name, _, count in table_after(page, 'Contents of the bag')}
    assert listed == bag.counts


def test_the_times_of_the_events(reported):
    page, bag = reported
    found = [
        (kind, time)
        for kind, time in re.findall(r'<li class="(\w+)"><span[^>]*>([\d.]+) s</span>', page)
        if kind in ('switch', 'stop')
    ]
    expected = [('switch', f'{time:.1f}') for time in switches_of(bag)]
    expected += [('stop', f'{start:.1f}') for start, _ in stops_of(bag, TRUTH)]
    assert sorted(found) == sorted(expected)


# -- the page of definitions ----------------------------------------------------------------------


def test_the_definitions_are_those_of_the_code():
    """Each number of a report has a row with its unit, and each constant its value."""
    text = (Path(__file__).parents[2] / 'docs' / 'metrics.md').read_text(encoding='utf-8')
    rows = {
        cells[0]: cells[1]
        for line in text.splitlines()
        if line.startswith('|')
        and len(cells := [each.strip() for each in line.split('|')[1:-1]]) > 2
    }
    for title, unit, _ in CHANNEL_NUMBERS:
        assert rows[title] == unit.format('that of the channel')
    for title, unit, _ in (*PATH_NUMBERS, *RUN_NUMBERS):
        assert rows[title] == unit
    for title, unit, _ in LINK_NUMBERS:
        assert f'{title} ({unit})' in text
    constants = re.findall(r'^\| `(\w+)` \| ([\d.]+) \| `(\w+)` \|$', text, re.MULTILINE)
    assert len(constants) > 15
    for name, value, module in constants:
        place = 'evaluation.bag_report'
        if module in ('drive_response', 'run_record'):
            place = 'evaluation'
        found = getattr(import_module(f't3mpc_ros.{place}.{module}'), name)
        assert found == float(value), name
