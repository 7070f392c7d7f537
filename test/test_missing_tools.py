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
"""Tests that need a tool beyond the README: skipped in one way, and listed with a remedy."""

import ast
import os
from pathlib import Path
import re
import subprocess
import sys

import pytest
from support import missing_tools

TESTS = Path(__file__).resolve().parent
USERS = """
import pytest
from support.missing_tools import needing, needs, skip
from t3mpc_ros.emulator.firmware_library import CompilerMissingError

@needing('make', 'avr-gcc')
def test_marked(): pass

@pytest.fixture(scope='module')
def tool(): needs('make')

@pytest.mark.parametrize('number', [1, 2])
def test_fixture(tool, number): pass

def test_core(): raise CompilerMissingError('none')

def test_other(): pytest.skip('of another reason: make')
"""
LISTED = [
    'not installed: C compiler, 1 test skipped; remedy: apt-get install gcc libc6-dev',
    'not installed: avr-gcc, 1 test skipped; remedy: '
    'apt-get install gcc-avr avr-libc binutils-avr',
    'not installed: make, 3 tests skipped; remedy: apt-get install make',
]


@pytest.mark.long
def test_what_is_missing_is_listed_once_with_its_remedy(tmp_path):
    """By the process that writes the summary, and for several runs at the end of the last."""
    (tmp_path / 'test_users.py').write_text(USERS)
    notes = tmp_path / 'notes'
    notes.touch()

    folders = os.pathsep.join(map(str, (TESTS, TESTS.parent)))

    def run(*words, **extra):
        done = subprocess.run(
            [sys.executable, *map(str, words)],
            cwd=tmp_path,
            env={**os.environ, 'PATH': '', 'PYTHONPATH': folders, **extra},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return re.findall('^not installed: .*', done.stdout + done.stderr, re.MULTILINE)

    words = ['-m', 'pytest', '-c', TESTS.parent / 'pyproject.toml', '-p', 'conftest', tmp_path]
    assert run(*words, '-n', 1, T3MPC_MISSING_TOOLS='') == LISTED
    assert run(*words, '-n', 0, T3MPC_MISSING_TOOLS=str(notes)) == []
    notes.write_text(2 * notes.read_text())  # a second run appends as much
    both = [line.replace('3 tests', '6 tests').replace('1 test ', '2 tests ') for line in LISTED]
    assert run(missing_tools.__file__, notes) == both


OTHERS = {
    ('test_scripts.py', 'skipif'): 'not started by scripts/check',
    ('test_scripts.py', 'which'): 'what the scripts themselves need',
    ('support/missing_tools.py', 'skip'): 'the way',
    ('support/missing_tools.py', 'skipif'): 'the way',
    ('support/missing_tools.py', 'which'): 'the way',
}
"""Files that use such a name, and what for."""


def test_no_skip_for_want_of_a_tool_goes_another_way():
    """It would not be listed: a check without the tool would look like one with it."""
    files = TESTS.parent.glob('requirements-*.txt')  # one of them names the others
    installed = ''.join(path.read_text() for path in files)
    owners = {'skip': ('pytest', 'mark'), 'skipif': ('mark',), 'which': ('shutil',)}
    found = set()
    for path in TESTS.rglob('*.py'):
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if re.search(r'\.(skip|which)', text) else ():
            if not isinstance(node, ast.Attribute):
                continue
            owner = ast.unparse(node.value).rpartition('.')[2]
            if owner in owners.get(node.attr, ()):
                found.add((str(path.relative_to(TESTS)), node.attr))
        # Libraries: only those that scripts/check installs.
        for name in re.findall(r"importorskip\('(\w+)", text):
            assert re.search(rf'^{name}\b', installed, re.MULTILINE), path
    assert found <= {*OTHERS}
