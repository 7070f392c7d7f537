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
"""What happened in a run is the first sentence of its report, in the terminal and on the pages.

An e-stop of 17.7 s was *No valid measurement: settled RMSE 1.9 rad/s, stopped 0.0 s*; a run on a
machine that stalled, with an error nine times that of a quiet one, was a *good run*.
"""

from dataclasses import replace
from html import unescape
import re

import pytest
from support.bag_messages import (
    START,
    odometry_message,
    serialised,
    serialised_odometry,
    serialised_twist,
    twist_message,
)
from support.page_data import read_all
from support.recorded_stories import STORIES, TWIN, Story

from t3mpc_ros.cli.bag_on_live_page import recorded_run
from t3mpc_ros.cli.main import main as t3mpc
from t3mpc_ros.evaluation.bag_report.diagnostic_history import cause_of
from t3mpc_ros.evaluation.bag_report.report_page import write_report

LOSSES = {'losses': {'undiscovered': '25', 'undiscovered /imu/data_raw': '25'}}
HEADLINE = re.compile(r'<div class="verdict (\w+)"><p class="headline">(.*?)</p>')


def test_quick_messages_of_the_stories_are_those_of_the_library():
    motion = START + 987_654_321, (0.1, -0.2), (-1.0, 2.0, 3.0)
    assert serialised_odometry(*motion).data == serialised(odometry_message(*motion))
    assert serialised_twist(motion[1]).data == serialised(twist_message(motion[1]))


@pytest.mark.slow
@pytest.mark.parametrize('name', STORIES)
def test_the_first_sentence_tells_the_story_everywhere(name, tmp_path, capsys):
    story = STORIES[name]
    bag = story.write(tmp_path / 'bag')
    assert t3mpc(['bag', 'report', str(bag), '--output', str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    kind, found = HEADLINE.search((tmp_path / 'report.html').read_text(encoding='utf-8')).groups()
    sentence = unescape(found)
    assert re.fullmatch(story.sentence, sentence), sentence
    assert kind == story.kind
    assert printed.startswith(sentence)
    if name in ('good', 'e-stop'):
        banner = read_all(recorded_run(bag))[0]['facts']['banner']
        assert banner['headline'] == sentence
        assert (banner['kind'] == 'good') == (kind == 'good')


@pytest.mark.slow
def test_the_page_of_a_bag_marks_stops_and_slips(tmp_path):
    """It marked switches only: a robot that stood drove on in its charts."""
    events = read_all(recorded_run(STORIES['slip stop'].write(tmp_path / 'bag')))[0]['events']
    times = [event['time'] for event in events]
    assert times == sorted(times)
    found = {event['kind']: event['time'] for event in events}
    assert found['stop'] == pytest.approx(9.0, abs=0.2)
    assert found['slip'] == pytest.approx(9.5, abs=0.01)  # as its diagnostics say
    assert found['resume'] == pytest.approx(12.0, abs=0.2)
    # A robot that stands to the end does not move again.
    events = read_all(recorded_run(STORIES['e-stop'].write(tmp_path / 'stopped')))[0]['events']
    kinds = {event['kind'] for event in events}
    assert 'stop' in kinds
    assert 'resume' not in kinds


@pytest.mark.parametrize(
    ('text', 'name'),
    [
        (
            'stopped: odom is too old: 0.347 s, it has waited or the clocks of the computers '
            'differ; odom had 2 gaps in the last 10 s',
            'Odometry too old',
        ),
        ('a new error: 1; another one', 'controller: a new error: 1'),
    ],
)
def test_a_cause_is_one_sentence(text, name):
    """All that a controller reported, ten lines of it, was the headline of a report."""
    cause = cause_of((1.0, 'error', 'controller', text))
    assert cause.name == name
    assert cause.text == f'controller: {text}'


@pytest.mark.slow
@pytest.mark.parametrize('late', [False, True])
def test_what_a_recorder_misses_at_its_start_is_usual(late, tmp_path):
    """A normal demo had 870 unusual messages, so nobody read what is unusual in a bag.

    Where it records the odometry only after the robot drives, errors are missing.
    """
    story = STORIES['good']
    if late:
        story = replace(story, kept=lambda t, topic: topic != '/ground_truth/odom' or t > 4.0)
    story = replace(story, records={**TWIN, **LOSSES})
    page = write_report(story.write(tmp_path / 'bag')).report.read_text(encoding='utf-8')
    assert '25 messages of /imu/data_raw are missing: published before the recorder' in page
    assert ('Unusual in this bag' in page) == late


@pytest.mark.slow
def test_the_page_says_that_the_odometry_was_set(tmp_path):
    """Ground truth stayed in the old frame: a robot on its path was a metre off it."""
    figures = write_report(STORIES['odometry set'].write(tmp_path / 'bag'))
    page = figures.report.read_text(encoding='utf-8')
    assert 'odom was set at 12.0 s: from there on the path is in its new frame.' in page
    # That of the section on coverage, too, which takes fewer samples.
    (error,) = re.findall(r'path error, root mean square</td><td>([\d.]+) mm', page)
    assert float(error) == pytest.approx(1e3 * figures.path_error, abs=0.06)


@pytest.mark.slow
def test_errors_after_stalls_are_told_apart(tmp_path):
    """Nine times the error of a quiet machine, all of it after the stalls, was a good run."""
    calm = STORIES['stalls']

    class Shaken(Story):
        def _motion(self, t):
            v, w = super()._motion(t)
            shaken = any(0.0 < t - start < 0.5 for start in (6.0, 12.0, 15.0))
            return v + 0.01 * shaken, w

    story = Shaken(**{**vars(calm), 'sentence': ''})
    figures = write_report(story.write(tmp_path / 'bag'))
    found = re.fullmatch(
        r'The machine stalled 3 times, the longest 8\d ms at 12\.0 s: errors after them are not '
        r"the controller's; settled RMSE (\S+) / \S+ rad/s, (\d+) times the 0\.012 rad/s that the "
        r'digital twin is known to reach under these conditions, without the 1 s after them '
        r'(\S+) / \S+ rad/s\.',
        figures.verdict.sentence,
    )
    assert found, figures.verdict.sentence
    assert float(found[1]) > 0.07
    assert float(found[3]) == pytest.approx(0.01, rel=0.02)
    assert (figures.verdict.kind, figures.verdict.slow) == ('bad', True)
