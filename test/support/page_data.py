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


def check_legends(browser, run, seed, origin=0.0, span=None, delay=0.03):
    """Compare the legends at 50 instants with the messages of the same run.

    ``origin`` is the time of the page at which the recording begins, s; ``span`` is the part of
    the recording, s, in which the instants are; ``delay`` is that with which a command, which has
    no stamp, may have been received, s.
    """
    odom, reference, command = (run.motions[each] for each in ('odom', 'reference', 'cmd_vel'))
    begin, end = span or (
        max(odom.time[0], reference.time[0]),
        min(odom.time[-1], reference.time[-1]),
    )
    instants = np.random.default_rng(seed).uniform(begin + 0.1, end - 0.1, 50)
    for at in instants.tolist():
        instant, shown = legends(browser, at + origin)
        instant -= origin
        row = int(np.argmin(np.abs(odom.time - instant)))
        assert odom.time[row] == pytest.approx(instant, abs=2e-5), 'not a measurement'
        assert abs(instant - at) < 0.05
        for wheel in ('right', 'left'):
            lines = shown[f'{wheel.capitalize()} wheel']
            assert lines['odometry'] == pytest.approx(odom[wheel][row], abs=6e-4)
            # Every second sample is shown: across a jump the line is 10 ms less steep.
            wanted = float(np.interp(instant, reference.time, reference[wheel]))
            spread = np.ptp(reference[wheel][np.abs(reference.time - instant) < 0.021])
            near = 6e-4 + (spread if spread > 0.1 else 0.02 * spread)
            assert lines['reference'] == pytest.approx(wanted, abs=near)
            # The legends agree with each other to the last digit: one instant.
            error = lines['odometry'] - lines['reference']
            assert shown['Error'][wheel] == pytest.approx(error, abs=1.6e-3)
            sent = command[wheel][np.abs(command.time - instant) < delay]
            if lines['command'] is None:  # the controller was not given the processor
                assert np.max(np.diff(command.time[np.abs(command.time - instant) < 5.0])) > 0.4
                continue
            assert sent.min() - 1e-3 <= lines['command'] <= sent.max() + 1e-3
