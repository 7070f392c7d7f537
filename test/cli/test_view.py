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
"""``t3mpc view``: a recorded run on the page, and recordings that the page starts and ends."""

from pathlib import Path
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
from support.page_data import read_all
from support.waiting import wait_until

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.cli.bag_on_live_page import recorded_run
from t3mpc_ros.cli.live_page_recording import RunRecorder
from t3mpc_ros.evaluation.bag_report.incidents import Incidents
from t3mpc_ros.evaluation.bag_report.recorded_run import load_run
from t3mpc_ros.evaluation.bag_report.verdict import Verdict
from t3mpc_ros.view.live_data import STEP, LiveData

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


# -- recordings -----------------------------------------------------------------------------------


RECORDER = """#!/bin/sh
bag=$(echo "$*" | sed 's/.*storage.uri:="\\([^"]*\\)".*/\\1/')
mkdir -p "$bag"
trap 'exit 0' INT
echo '[INFO] [1.0] [recorder]: recorder ready'
while [ ! -e "$bag/../../full" ]; do sleep 0.05; done
echo '[ERROR] [2.0] [recorder]: recording has stopped: the disk is full. Free disk space'
exit 1
"""
REPORT = """#!/bin/sh
echo drawn > "$5/report.html"
"""


class Recording:
    """A recorder of the page with programs that take its place, and what the page shows."""

    def __init__(self, runs):
        self.runs, self.data, self.reports = runs, LiveData(), []
        self.recorder = RunRecorder(runs, '', self.data, self.reports.append)

    def shown(self):
        return read_all(self.data)[0]['facts']['recorder']

    def wait_idle(self):
        wait_until(lambda: self.shown()['state'] == 'idle', lambda: f'busy: {self.shown()}')
        return self.shown()

    def folder(self):
        (found,) = self.runs.glob('view_*')
        return found


@pytest.fixture
def recording(tmp_path, monkeypatch):
    for name, text in (('recorder', RECORDER), ('t3mpc', REPORT)):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    for module in ('process_group', 'live_page_recording'):
        monkeypatch.setattr(f't3mpc_ros.cli.{module}.executable', lambda name: tmp_path / name)
    made = Recording(tmp_path / 'runs')
    yield made
    made.recorder.close()


@pytest.mark.slow
def test_a_recording_ends_in_its_report(recording):
    assert recording.recorder.switch(True).startswith('recording into')
    with pytest.raises(RuntimeError, match='nothing new is recorded: recording into'):
        recording.recorder.switch(True)
    recording.recorder.switch(False)
    shown = recording.wait_idle()
    assert not shown['failed']
    assert shown['text'] == f'report of {recording.folder() / "bag"}'
    assert [file.read_text() for file in recording.reports] == ['drawn\n']
    with pytest.raises(RuntimeError, match='nothing is being recorded'):
        recording.recorder.switch(False)


@pytest.mark.slow
def test_a_full_disk_ends_the_recording(recording):
    """The page said *recording* until somebody ended it, and then nothing of the rest."""
    recording.recorder.switch(True)
    (recording.runs / 'full').touch()
    shown = recording.wait_idle()
    assert shown['failed']
    end = 'which ends early: recording has stopped: the disk is full'
    assert shown['text'] == f'report of {recording.folder() / "bag"}, {end}'
    assert len(recording.reports) == 1


@pytest.mark.slow
def test_a_folder_that_is_removed_ends_the_recording(recording):
    """The page said *recording* into a folder that was no longer there."""
    recording.recorder.switch(True)
    shutil.rmtree(recording.folder())
    shown = recording.wait_idle()
    assert shown['failed']
    assert shown['text'].endswith('bag was removed')


@pytest.mark.slow
def test_a_report_without_a_folder_is_given_up(recording, monkeypatch):
    """The page said *the report is being drawn* for ever, and nothing could be recorded."""
    recording.recorder.switch(True)
    draw = recording.recorder._draw

    def removed(folder):
        shutil.rmtree(folder)
        draw(folder)

    monkeypatch.setattr(recording.recorder, '_draw', removed)
    recording.recorder.switch(False)
    shown = recording.wait_idle()
    assert shown['failed']
    assert shown['text'].startswith('no report of')
