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
"""``t3mpc view --bag``: a recorded run on the page."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from support.page_data import read_all

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.cli.bag_on_live_page import recorded_run
from t3mpc_ros.evaluation.bag_report.incidents import Incidents
from t3mpc_ros.evaluation.bag_report.recorded_run import load_run
from t3mpc_ros.evaluation.bag_report.verdict import Verdict
from t3mpc_ros.view.live_data import STEP

GOLDEN = Path(__file__).parents[1] / 'golden' / 'changes.mcap'


@pytest.fixture(scope='module')
def shown():
    return read_all(recorded_run(GOLDEN))[0]


def test_the_samples_are_those_of_the_bag(shown):
    fields = {'v': 'twist.twist.linear.x', 'w': 'twist.twist.angular.z'}
    with open_bag(GOLDEN) as recording:
        odom = recording.series('/odom', fields)
    found = shown['streams']['odometry']
    robot = shown['facts']['robot']
    radius, half = robot['wheel_radius'], 0.5 * robot['wheel_separation']
    at = np.array(found['time'])
    assert np.min(np.diff(at)) >= STEP
    assert at[-1] - at[0] == pytest.approx(np.ptp(odom['stamp']), abs=2.0 * STEP)
    right = np.interp(at, odom['stamp'] - odom['stamp'][0], odom['v'] + half * odom['w']) / radius
    np.testing.assert_allclose(np.interp(at, at - at[0], found['values'][0]), right, atol=1e-5)


def test_terms_are_recomputed_from_the_journal(shown):
    terms = shown['streams']['terms']
    assert len(terms['values']) == 2 * len(shown['facts']['terms'])
    assert np.max(np.abs(np.array(terms['values'], dtype=float))) > 1.0


def test_banner_and_switches_are_those_of_the_report(shown):
    facts = shown['facts']
    assert facts['banner']['detail'].startswith('Recording changes.mcap, 9.0 s.')
    assert facts['recording']['duration'] > 1.0
    with open_bag(GOLDEN) as recording:
        switches = load_run(recording).switches
    found = [each['time'] for each in shown.get('events', ()) if each['kind'] == 'switch']
    assert found == switches.tolist()


@pytest.mark.parametrize(
    ('found', 'kind'), [('good', 'good'), ('open', 'warning'), ('bad', 'warning')]
)
def test_the_banner_has_the_kind_and_the_words_of_the_verdict(found, kind, monkeypatch):
    verdict = Verdict('It was stopped.', 'Stopped', found, 'Release it.')
    metrics = SimpleNamespace(verdict=verdict, incidents=Incidents())
    monkeypatch.setattr('t3mpc_ros.cli.bag_on_live_page.compute_metrics', lambda *_: metrics)
    banner = read_all(recorded_run(GOLDEN))[0]['facts']['banner']
    assert (banner['kind'], banner['headline']) == (kind, verdict.sentence)
    assert banner['detail'].endswith(verdict.remedy)
