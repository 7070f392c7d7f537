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
from pathlib import Path
import re
import subprocess
import sys
from types import SimpleNamespace

from support import missing_tools

TESTS = Path(__file__).resolve().parent


class Terminal:
    """The terminal at the end of a run, with the reports of skipped tests."""

    config = None

    def __init__(self, *reasons):
        self.stats = {'skipped': [SimpleNamespace(longrepr=('', 0, each)) for each in reasons]}
        self.shown = []
        self.section = self.write_line = self.shown.append


def test_what_is_missing_is_listed_once_with_its_remedy(tmp_path, monkeypatch):
    """By the process that writes the summary, and for several runs at the end of the last."""
    texts = f'{missing_tools.REASON}make, avr-gcc', f'{missing_tools.REASON}make', 'another: make'
    reasons = [f'Skipped: {text}' for text in texts]
    listed = [
        'not installed: avr-gcc, 1 test skipped; remedy: '
        'apt-get install gcc-avr avr-libc binutils-avr',
        'not installed: make, 2 tests skipped; remedy: apt-get install make',
    ]
    monkeypatch.delenv('T3MPC_MISSING_TOOLS', raising=False)
    missing_tools.list_missing(terminal := Terminal(*reasons))
    assert terminal.shown[1].splitlines() == listed
    notes = tmp_path / 'notes'
    monkeypatch.setenv('T3MPC_MISSING_TOOLS', str(notes))
    for _ in range(2):
        missing_tools.list_missing(terminal := Terminal(*reasons))
        assert terminal.shown == []
    words = [sys.executable, missing_tools.__file__, notes]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    both = [line.replace('2 tests', '4 tests').replace('1 test ', '2 tests ') for line in listed]
    assert done.stderr.splitlines() == both


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
