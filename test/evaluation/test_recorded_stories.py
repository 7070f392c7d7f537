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

from html import unescape
import re

import pytest
from support.page_data import read_all
from support.recorded_stories import STORIES

from t3mpc_ros.cli.main import main as t3mpc
from t3mpc_ros.cli.recorded_run import recorded_run

HEADLINE = re.compile(r'<div class="verdict (\w+)"><p class="headline">(.*?)</p>')


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
    banner = read_all(recorded_run(bag))[0]['facts']['banner']
    assert banner['headline'] == sentence
    assert (banner['kind'] == 'good') == (kind == 'good')
