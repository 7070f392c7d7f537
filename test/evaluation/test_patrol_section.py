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
"""Section of a report on coverage and predictability."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.evaluation.bag_report.patrol_section import followed_reference, patrol_blocks
from t3mpc_ros.evaluation.bag_report.recorded_run import Series, load_run
from t3mpc_ros.evaluation.result_output import Table
from t3mpc_ros.evaluation.topic_roles import REFERENCE, TRUTH

GOLDEN = Path(__file__).parents[1] / 'golden' / 'switches.mcap'


@pytest.fixture(scope='module')
def recorded():
    with open_bag(GOLDEN) as recording:
        return load_run(recording)


def _driven(recorded, time, x, y, offset=0.0, world=''):
    """Return the run of a robot on a path, with the reference ``offset`` metres beside it."""
    still = np.zeros(time.size)
    motions = {
        TRUTH: Series(time, {'x': x, 'y': y, 'yaw': still, 'linear': still, 'angular': still}),
        REFERENCE: Series(time, {'x': x + offset, 'y': y, 'linear': still, 'angular': still}),
    }
    return replace(recorded, motions=motions, world=world)


def _rows(blocks):
    (table,) = [each for each in blocks if isinstance(each, Table)]
    return dict(table.rows)


def test_equal_laps_are_predicted_and_their_error_measured(recorded):
    time = np.arange(0.0, 140.0, 0.05)
    run = _driven(recorded, time, 1.2 * np.cos(time / 4.0), 0.8 * np.sin(time / 4.0), 0.03)
    rows = _rows(patrol_blocks(replace(run, follows_path=True)))
    assert rows['path error, root mean square'] == '30.0 mm'
    assert rows['skill of an observer, 5 s ahead'].startswith('1.000')
    assert float(rows['cells entered'].split()[0]) < 30.0  # an ellipse in its bounding box
    assert rows['90 % of the cells'] == 'not reached'


def test_cells_that_the_robot_cannot_enter_do_not_count(recorded):
    lanes = np.linspace(-1.4, 1.4, 57)
    corners = np.array(
        [[side * (-1) ** k, y] for k, y in enumerate(lanes) for side in (-1.9, 1.9)]
    )
    time = np.linspace(0.0, 100.0, 20_000)
    grid = np.linspace(0.0, 100.0, len(corners))
    x, y = (np.interp(time, grid, column) for column in corners.T)
    rows = _rows(patrol_blocks(_driven(recorded, time, x, y, world='room')))
    assert rows['cells entered'] == '100.0 %'
    assert 'skill of an observer, 5 s ahead' not in rows  # shorter than two minutes


def test_a_gap_leaves_predictions_out_and_standstill_all(recorded):
    time = np.concatenate([np.arange(0.0, 100.0, 0.05), np.arange(150.0, 250.0, 0.05)])
    run = _driven(recorded, time, np.cos(time / 4.0), np.sin(time / 4.0))
    rows = _rows(patrol_blocks(run))
    assert 'evenness of the time in the cells' in rows
    assert not any('skill' in name or 'entropy' in name for name in rows)
    assert list(patrol_blocks(_driven(recorded, time, 0.0 * time, 0.0 * time))) == []


def test_a_reference_is_followed_by_a_controller_of_paths(recorded):
    """A path controller far from its path once lost the line that says how far."""
    time = np.arange(0.0, 60.0, 0.05)
    beside = _driven(recorded, time, np.cos(time / 4.0), np.sin(time / 4.0), 0.5)
    assert followed_reference(beside) is None
    followed = replace(beside, follows_path=True)
    assert followed_reference(followed) is followed.motions[REFERENCE]
    del followed.motions[REFERENCE].values['x']
    assert followed_reference(followed) is None
