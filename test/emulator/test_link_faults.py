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
"""What the host knows after a fault: path, restarts, and the hop that it names."""

from pathlib import Path
import re

import pytest
from support.emulator_bench import STEP
from support.long_tests import few_of

from bench import link_faults

PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'radio.md'
FAULTS = {fault.name: fault for fault in link_faults.faults()}
BRIEF = [name for name in FAULTS if 'host suspended' not in name or 'resets' in name]


def expect_right(fault, trials):
    """The path is exact unless the robot lost its counters, and nothing else is made up."""
    in_motion = 'robot resets' in fault.name and 'rest' not in fault.name.split()
    for trial in trials:
        assert trial.missed == 0 or in_motion, fault.name
        missed = STEP * link_faults.GEOMETRY.wheel_radius * abs(trial.missed)
        assert missed < trial.unknown if in_motion else trial.unknown == 0.0
        assert trial.error < 1e-9
        if 'unplugged' not in fault.name:  # the port is closed, and opened anew
            assert trial.counted == trial.happened
        assert link_faults.named(trial) == fault.hop, trial.shown
        for text in trial.shown:
            assert 'restarted' not in text or 'are lost' not in text, 'the restart explains it'
            assert not fault.cable or not re.search('dongle|radio|channel', text), text


@pytest.mark.slow
@pytest.mark.parametrize('name', few_of(BRIEF, step=2))
def test_path_restarts_and_hop_are_right_after(name):
    """A restarted robot was called a bad radio, a noisy cable a robot out of range."""
    expect_right(FAULTS[name], [link_faults.measure(FAULTS[name], 0.35)])


@pytest.mark.long
def test_the_table_of_the_page_is_what_is_measured():
    """All suspensions from 0.3 s to 10 s, and every other fault, at 20 phases of the cycle."""
    rows = []
    for fault in FAULTS.values():
        phases = [number / link_faults.PHASES for number in range(link_faults.PHASES)]
        trials = [link_faults.measure(fault, phase) for phase in phases]
        expect_right(fault, trials)
        rows.append(link_faults.format_row(fault, trials))
    table = '\n'.join((*link_faults.TABLE.head, *rows))
    assert table in PAGE.read_text(), 'run bench/link_faults.py --page docs/radio.md'


def test_the_page_names_every_fault():
    text = PAGE.read_text()
    assert [name for name in FAULTS if f'| {name} |' not in text] == []
