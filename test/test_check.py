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
"""``scripts/check`` with a Python of the test: stages, repetition, exit codes, summary."""

import json
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys

import pytest
from support.waiting import communicate, is_running, run, wait_until

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = """
set -euo pipefail
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
PYTHON="$ROOT/python"
say() { printf '%s\\n' "$*" >&2; }
"""
# No path with a blank can stand behind "#!".
STAND_IN = """#!/bin/sh
exec '{python}' -IS '{program}' "$@"
"""
PROGRAM = """
import json, os, signal, sys, time
_, _, module, *words = sys.argv
with open('calls', 'a') as calls:
    calls.write(json.dumps([module, *words]) + '\\n')
plan = json.load(open('plan'))
stage = ' '.join([module, *words[:1]]) if module == 'ruff' else module
path = words[0].removeprefix('--outcomes=') if module == 'pytest' else os.devnull
if path.endswith('computed'):
    stage = 'computing'
elif module == 'pytest':
    known = [json.loads(line) for line in open('calls')]
    number = sum(call[0] == 'pytest' and call[1].endswith('outcomes') for call in known)
    stage = 'again' if words[1:3] == ['-n', '0'] else f'pytest {number}'
code, *lines = plan.get(stage, [0])
with open(path, 'a') as outcomes:
    outcomes.writelines(line + '\\n' for line in lines)
if code == 'wait':
    signal.signal(signal.SIGINT, lambda *_: sys.exit(2))
    open(f'waiting {os.getpid()}', 'w').close()
    time.sleep(60.0)
if code < 0:
    os.kill(os.getpid(), -code)
sys.exit(code)
"""
"""Notes its arguments; outcomes and exit code of each stage are in the file ``plan``."""

A, B = 'test/test_a.py::test_one[a b]', 'test/test_a.py::test_two[a b-\\n]'
WAITED = [6, 'passed x', f'inconclusive {A}', f'inconclusive {B}']
FAILURE = [1, 'passed x', 'failed test/test_b.py::test_three']
CASES = [
    # plan of the stages, exit code, texts of the summary
    ({}, 0, ['passed']),
    ({'ruff check': [1]}, 1, ['failed stage: ruff: lint (exit code 1)']),
    ({'mypy': [6], 'pytest 1': WAITED, 'again': [0, f'passed {A}', f'passed {B}']}, 1, []),
    ({'pytest 1': FAILURE}, 1, ['failed: test/test_b.py::test_three', 'failed: exit code 1']),
    ({'pytest 1': [-signal.SIGSEGV]}, 1, ['(exit code 139)']),
    ({'pytest 1': [6, 'passed x']}, 1, []),
    (
        {'pytest 1': WAITED, 'again': [0, f'passed {A}', f'passed {B}']},
        0,
        [f'passed when repeated, inconclusive before: {A}', 'passed'],
    ),
    (
        {'pytest 1': WAITED, 'again': [1, f'failed {A}', f'passed {B}']},
        1,
        [f'failed when repeated, inconclusive before: {A}'],
    ),
    (
        {'pytest 1': WAITED, 'again': [6, f'inconclusive {A}', f'passed {B}']},
        4,
        [f'inconclusive when repeated, inconclusive before: {A}', 'inconclusive: 1 tests'],
    ),
    ({'pytest 1': WAITED, 'again': [0, f'skipped {A}', f'passed {B}']}, 4, []),
    ({'pytest 1': WAITED, 'again': [-9, f'passed {A}', f'passed {B}']}, 1, []),
    (
        {'pytest 1': [1, *FAILURE[1:], *WAITED[1:]], 'again': [0, f'passed {A}', f'passed {B}']},
        1,
        ['failed: test/test_b.py::test_three', f'passed when repeated, inconclusive before: {B}'],
    ),
    ({'mypy': [1], 'pytest 1': WAITED, 'again': [6, f'inconclusive {A}', f'passed {B}']}, 1, []),
]
LATER = [
    ({'pytest 2': FAILURE}, 1, ['test_three']),
    (
        {'pytest 3': WAITED, 'again': [6, f'inconclusive {A}', f'inconclusive {B}']},
        4,
        ['inconclusive: 2 tests'],
    ),
    ({'computing': FAILURE}, 1, ['test_three', 'tests that only compute (exit code 1)']),
    ({'computing': [-9, 'passed x']}, 1, ['tests that only compute (exit code 137)']),
    ({'computing': WAITED, 'again': [0, f'passed {A}', f'passed {B}']}, 0, ['passed']),
]
"""The same in later stages, which a run without arguments has."""
STAGES = ['ruff', 'ruff', 'mypy', 'pytest']


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """Return a folder with ``scripts/check`` and a Python of the test."""
    monkeypatch.delenv('T3MPC_COVERAGE', raising=False)  # of a check that runs this test
    scripts = tmp_path / 'a checkout' / 'scripts'
    scripts.mkdir(parents=True)
    (scripts / 'environment.sh').write_text(ENVIRONMENT)
    shutil.copy(ROOT / 'scripts' / 'check', scripts)
    (program := scripts.parent / 'program.py').write_text(PROGRAM)
    (scripts.parent / 'python').write_text(STAND_IN.format(python=sys.executable, program=program))
    (scripts.parent / 'python').chmod(0o755)
    return scripts.parent


def check(checkout, plan, *arguments):
    """Return the completed process, and the calls of Python."""
    (checkout / 'plan').write_text(json.dumps(plan))
    (checkout / 'calls').unlink(missing_ok=True)
    done = run([checkout / 'scripts' / 'check', *arguments])
    calls = [json.loads(line) for line in (checkout / 'calls').read_text().splitlines()]
    return done, calls


@pytest.mark.parametrize(
    'arguments, stages, cases',
    [
        pytest.param([], [*STAGES, *3 * ['pytest']], CASES + LATER, marks=pytest.mark.long),
        (['--quick'], STAGES, CASES[1::3]),
        (['-k', 'some test'], STAGES, CASES[:1]),
        (['--tests', '-k', 'some test'], ['pytest'], CASES[5:7]),
        (['--long', '2/7'], ['pytest', 'pytest'], LATER[:1]),
    ],
    ids=['all', 'quick', 'arguments', 'tests', 'long'],
)
@pytest.mark.slow
def test_every_stage_runs_and_the_exit_code_says_what_remains(arguments, stages, cases, checkout):
    """A stage that failed ended the run, and a skip in place of a failure was a pass."""
    for plan, code, texts in cases:
        done, calls = check(checkout, plan, *arguments)
        assert done.returncode == code, (plan, done.stderr)
        for text in texts:
            assert re.search(rf'^.*{re.escape(text)}.*$', done.stderr, re.M), (plan, done.stderr)
        again = [words for words in calls if words[2:4] == ['-n', '0']]
        expected = [[A, B]] if 'again' in plan else []
        assert [words[4:] for words in again] == expected
        assert sorted(call[0] for call in calls if call not in again) == sorted(stages), plan
        assert again == calls[len(calls) - len(again) :]  # at the end, when nothing runs beside it


def test_the_documented_exit_codes_are_produced():
    text = (ROOT / 'scripts' / 'check').read_text()
    (words,) = re.findall(r'Exit code: (.*?)128 \+ N', text.replace('\n# ', ' '))
    assert {int(number) for number in re.findall(r'(?:^|; )(\d)', words)} == {c[1] for c in CASES}
    rows = (ROOT / 'CONTRIBUTING.md').read_text()
    assert all(f'exit code {code}' in rows for code in (1, 4))


@pytest.mark.parametrize('waiting', [['pytest 1'], ['pytest 2', 'computing', 'mypy']])
def test_ctrl_c_ends_the_run_at_once(waiting, checkout):
    """For pytest it is a failure, after which the next stage would begin."""
    (checkout / 'plan').write_text(json.dumps(dict.fromkeys(waiting, ['wait'])))
    process = subprocess.Popen(
        [checkout / 'scripts' / 'check'],
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    wait_until(lambda: len([*checkout.glob('waiting *')]) == len(waiting))
    os.killpg(process.pid, signal.SIGINT)
    communicate(process)
    assert process.returncode == 128 + signal.SIGINT
    begun = [int(path.name.split()[1]) for path in checkout.glob('waiting *')]
    wait_until(lambda: not any(map(is_running, begun)))
    calls = (checkout / 'calls').read_text().splitlines()
    assert sum('/outcomes"' in call for call in calls) == int(waiting[0][-1])
