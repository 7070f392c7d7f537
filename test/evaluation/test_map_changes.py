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
"""What a patrol found is in its report: by a bag with the messages of the localizer."""

import pytest
from support.bag_messages import diagnostics
from support.robot_bags import following_rows, write

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.evaluation.bag_report.recorded_run import load_run
from t3mpc_ros.evaluation.bag_report.report_page import write_report


def change(second, number, *, kind='new', first=4.5, last=6.0, **state):
    values = {
        'present': True,
        **state,
        'x_m': 0.5,
        'y_m': -0.25,
        'size_m': 0.3,
        'confidence': 0.97,
    }
    times = {'first_seen_s': first, 'found_s': first + 1.5, 'last_seen_s': last}
    message = diagnostics(round(second * 1e9), f'change {number}', kind=kind, **values, **times)
    return second, '/map_changes', message


def test_changes_are_as_last_published_when_they_were_found(tmp_path):
    rows = [
        *following_rows(),
        change(6.0, 1),
        change(9.0, 1, kind='moving', present=False, last=8.0),
        change(10.0, 2, kind='missing', first=8.5, last=10.0),
        change(10.5, 3, present=False, withdrawn=True),
        (11.0, '/map_changes', diagnostics(11 * 10**9, 'of another publisher', kind='new')),
    ]
    folder = write(tmp_path / 'bag', sorted(rows, key=lambda row: row[0]))
    with open_bag(folder) as recording:
        walker, missing, withdrawn = load_run(recording).map_changes
    assert (walker.kind, walker.state) == ('moving', 'gone')
    assert (missing.state, withdrawn.state) == ('there', 'withdrawn')
    assert (walker.x, walker.y, walker.size, walker.confidence) == (0.5, -0.25, 0.3, 0.97)
    assert (walker.found, walker.seen_before) == pytest.approx((6.0, 1.5), abs=0.05)
    assert walker.seen_for == pytest.approx(3.5)
    assert (missing.kind, missing.found) == ('missing', pytest.approx(10.0, abs=0.05))
    page = write_report(folder, tmp_path / 'page').report.read_text(encoding='utf-8')
    assert 'What contradicts the map' in page
    assert 'x 0.50 m, y -0.25 m' in page
    assert 'Points: what contradicts the map' in page


def test_a_bag_without_changes_has_no_section(tmp_path):
    folder = write(tmp_path / 'bag', following_rows())
    page = write_report(folder, tmp_path / 'page').report.read_text(encoding='utf-8')
    assert 'contradicts the map' not in page
