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
"""Which tests a run selects: default set, parts, quick and long tests; none is left out of all."""

import itertools
from pathlib import Path
import re
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent


def collect(*words):
    """Return the names of the selected tests, in order."""
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', '--collect-only', *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return [line for line in done.stdout.splitlines() if '.py::' in line]


@pytest.mark.long
def test_the_default_set_is_a_part_that_needs_no_selection():
    """``colcon test`` gives no selection; scripts/check selects by marker and runs everything."""
    # The import of all of them takes seconds; these begin with some letters.
    few = '--ignore-glob=*/test_[!cdl]*.py'
    default = {name.partition(':')[0] for name in collect(few)}
    assert 'test/robot/test_command_limiter.py' in default
    assert 'test/nodes/test_launch_files.py' in default
    assert 'test/test_docs.py' not in default
    assert collect('test/test_docs.py') != []


def test_the_runs_of_check_select_every_test_once():
    """A test that no marker expression matches would run nowhere."""
    text = (ROOT / 'scripts' / 'check').read_text()
    computing, *long, quick, first, second, third = re.findall(r"-m '([^']+)'", text)
    # Of some folders, which the first run leaves out.
    assert computing == first
    assert text.count('"${COMPUTING[@]}"') == text.count('"${COMPUTING[@]/#/--ignore=}"') == 1
    runs = [first, second, third, *long]
    for marks in itertools.product((False, True), repeat=4):
        values = dict(zip(('ros', 'timed', 'slow', 'long'), marks, strict=True))
        matches = [eval(expression, {}, values) for expression in runs]
        assert sum(matches) == 1
        assert matches[0] or not eval(quick, {}, values)
        assert values['long'] == any(matches[3:])


def test_the_parts_of_a_run_are_the_run():
    parts = [collect('test/test_selection.py', '--part', f'{k}/2') for k in (1, 2)]
    names = sorted(name.rpartition('::')[2] for part in parts for name in part)
    assert names == sorted(name for name in globals() if name.startswith('test_'))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_ci_runs_each_part_of_the_long_tests_in_turn():
    """Every fifteenth day it measures the coverage in their place."""
    text = (ROOT / '.ci' / 'run').read_text()
    [choice] = re.findall(r'^turn=.*?^fi$', text, re.MULTILINE | re.DOTALL)
    shown = re.sub(r'^    (?=[.s])', '    echo ', choice, flags=re.MULTILINE)
    runs = {
        subprocess.check_output(
            ['bash', '-c', f'date() {{ echo {day:03}; }}; {shown}'], text=True
        ).splitlines()[-1]
        for day in (*range(1, 16), 80, 115, 257, 361, 366)
    }
    assert runs == {'.ci/coverage', *(f'scripts/check --long {k}/14' for k in range(1, 15))}
