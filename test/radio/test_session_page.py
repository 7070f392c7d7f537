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
"""docs/radio_session.md is what host and firmware say to each other."""

from pathlib import Path
import runpy

import pytest
from support.missing_tools import needs

from t3mpc_ros.radio.protocol import codec, frames

DOCS = Path(__file__).parents[2] / 'docs'


@pytest.fixture(scope='module')
def generator():
    needs('C compiler')
    return runpy.run_path(str(DOCS / 'radio_session.py'))


def test_the_page_is_what_the_code_sends(generator):
    page = (DOCS / 'radio_session.md').read_text(encoding='utf-8')
    assert page == generator['page'](), 'run .venv/bin/python docs/radio_session.py'


def test_the_robot_moves_in_the_session_and_is_off_at_the_end(generator):
    lines = generator['record_session'](b'', 0.06)
    states = []
    for line in lines:
        for data in generator['payloads'](line.frame, line.from_host):
            if not line.from_host and isinstance(state := codec.decode_uplink(data), frames.State):
                states.append(state)
    assert max(state.left for state in states) > 10
    assert any(state.status & frames.StatusFlag.MOVING for state in states)
    assert not states[-1].status & (frames.StatusFlag.ENABLED | frames.StatusFlag.MOVING)
