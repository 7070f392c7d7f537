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
"""What the live page gets, and what its legends say."""

import numpy as np
import pytest

from t3mpc_ros.view.live_data import Cursor


def read_all(data, cursor=None):
    """Return the news of all answers from a cursor on, as one, and the last cursor."""
    found, cursor = {}, cursor or Cursor()
    while True:
        news, cursor = data.read(cursor)
        more = news.pop('more', False)
        for stream, new in news.pop('streams', {}).items():
            known = found.setdefault('streams', {}).setdefault(
                stream, {'time': [], 'values': [[] for _ in new['values']]}
            )
            known['time'] += new['time']
            for column, values in zip(known['values'], new['values'], strict=True):
                column += values
        if events := news.pop('events', []):
            found.setdefault('events', []).extend(events)
        if facts := news.pop('facts', {}):
            found.setdefault('facts', {}).update(facts)
        assert not news
        if not more:
            return found, cursor


LEGENDS = """
charts.moveTo(arguments[0]);
const shown = charts.charts.map((chart) => [chart.title, Object.fromEntries(chart.series.map(
  ({label}, i) => [label, chart.values[i].textContent]))]);
return [cursorTime, Object.fromEntries(shown)];
"""


def value(text):
    return None if text == '–' else float(text.replace('−', '-'))


def legends(browser, at):
    """Return the instant of the cursor and the numbers of all legends, by chart and line."""
    instant, shown = browser.run(LEGENDS, at)
    return instant, {
        chart: {label: value(text) for label, text in lines.items()}
        for chart, lines in shown.items()
    }


DELAY = 0.03  # with which a command, which has no stamp, may have been received, s


def check_legends(browser, run, seed):
    """Compare the legends at 50 instants with the messages of the same run."""
    odom, reference, command = (run.motions[each] for each in ('odom', 'reference', 'cmd_vel'))
    begin = max(odom.time[0], reference.time[0])
    end = min(odom.time[-1], reference.time[-1])
    instants = np.random.default_rng(seed).uniform(begin + 0.1, end - 0.1, 50)
    period = float(np.median(np.diff(odom.time)))
    # The lines of the page are those of every second sample, fewer where it was too slow.
    drawn = np.array(browser.run('return streams.reference.time'))
    measured = np.array(browser.run('return streams.odometry.time'))
    moved = np.array(browser.run('return (streams.truth ?? streams.odometry).time'))
    lost = 0
    for at in instants.tolist():
        instant, shown = legends(browser, at)
        assert abs(instant - at) < np.min(np.abs(measured - at)) + 5e-3, 'not the nearest one'
        row = int(np.argmin(np.abs(odom.time - instant)))
        if abs(odom.time[row] - instant) > 2e-5:
            # A sample that the recorder has lost: its neighbours are further apart than others.
            after = int(np.searchsorted(odom.time, instant))
            assert odom.time[after] - odom.time[after - 1] > 1.5 * period, 'not a measurement'
            lost += 1
            continue
        for wheel in ('right', 'left'):
            lines = shown[f'{wheel.capitalize()} wheel']
            assert lines['odometry'] == pytest.approx(odom[wheel][row], abs=6e-4)
            if lines['reference'] is None:  # a gap of the page
                lost += 1
                continue
            known = np.interp(drawn, reference.time, reference[wheel])
            wanted = float(np.interp(instant, drawn, known))
            near = drawn[(k := int(np.searchsorted(drawn, instant))) - 1 : k + 1]
            slope = np.ptp(known[k - 1 : k + 1]) / max(np.ptp(near), 1e-3)
            assert lines['reference'] == pytest.approx(wanted, abs=6e-4 + 2e-5 * slope)
            # The error is that of the true motion at this very instant, else of the odometry.
            motion = run.motions[run.measured]
            error = (
                np.interp(instant, moved, np.interp(moved, motion.time, motion[wheel])) - wanted
            )
            assert shown['Error'][wheel] == pytest.approx(error, abs=1.6e-3 + 0.02 * slope)
            sent = command[wheel][np.abs(command.time - instant) < DELAY]
            if lines['command'] is None or not sent.size:  # no processor for the controller
                assert np.max(np.diff(command.time[np.abs(command.time - instant) < 5.0])) > DELAY
                continue
            assert sent.min() - 1e-3 <= lines['command'] <= sent.max() + 1e-3
    assert lost < 10, 'too few instants were compared'
