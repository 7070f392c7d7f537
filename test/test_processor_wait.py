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
"""What is inconclusive on an overloaded machine: a wait that timed out, and nothing else."""

import ast
import os
from pathlib import Path
import re
import subprocess
import sys
import time

import pytest
from support import processor_wait, waiting
from support.processor_wait import ProcessorWait, descendants
from support.signals import attended

from t3mpc_ros.cli.process_group import ProcessError

pytestmark = pytest.mark.slow

TESTS = Path(__file__).resolve().parent
TESTED = """
import pytest
from support.waiting import ProcessTimeoutError, communicate, run, wait_until

SLEEP = ['sleep', '60']

def test_value():
    seed = 3
    assert seed == 4

def test_exception():
    raise ValueError('the robot drove through the wall')

def test_program_error():
    1 / 0

@pytest.fixture
def waited():
    raise ProcessTimeoutError('the story of the fixture')

@pytest.fixture
def wrong():
    yield
    1 / 0

def test_error_in_a_fixture(wrong):
    pass

@pytest.fixture(scope='module')
def shared():
    wait_until(lambda: False, 'the story of the shared fixture', 0.0)

def test_wait():
    wait_until(lambda: False, 'the story of the failure', 0.0)

def test_wait_in_a_fixture(waited):
    pass

def test_wait_in_a_shared_fixture(shared):
    pass

def test_wait_in_a_shared_fixture_again(shared):
    pass

def test_command():
    run(SLEEP, 0.0)

def test_wrong_value_after_a_wait():
    with pytest.raises(Exception):
        run(SLEEP, 0.0)
    assert not 'sound'

def test_sound():
    pass
"""
STARVED = """
from support import processor_wait
shares = iter([{shares}])
processor_wait.ProcessorWait.share = lambda self: next(shares, 0.9)
"""
BUSY = 'import time\nwhile True: time.monotonic()'


@pytest.fixture
def busy():
    """Leave a further process half a processor or less."""
    count = max(4, -(-3 * len(os.sched_getaffinity(0)) // 2))
    started = [subprocess.Popen([sys.executable, '-c', BUSY]) for _ in range(count)]
    yield {process.pid for process in started}
    for process in started:
        process.kill()
        process.wait()


def run_pytest(folder, *words, shares=''):
    """Return the completed run of the tests above, and the outcomes by name."""
    (folder / 'test_starved.py').write_text(f'{TESTED}\npytestmark = pytest.mark.ros\n')
    (folder / 'starved.py').write_text(STARVED.format(shares=shares))
    words = ['-c', TESTS.parent / 'pyproject.toml', '--outcomes', 'outcomes', *words]
    words += ['-p', 'conftest', '-p', 'starved']
    paths = map(str, (TESTS, TESTS.parent, folder))
    done = waiting.run(
        [sys.executable, '-m', 'pytest', *map(str, words), 'test_starved.py'],
        cwd=folder,
        env=os.environ | {'PYTHONPATH': os.pathsep.join(paths)},
    )
    lines = (folder / 'outcomes').read_text().splitlines()
    (folder / 'outcomes').unlink()
    found = [line.partition(' ')[::2] for line in lines]
    return done, {name.rpartition('::')[2]: outcome for outcome, name in found}


def test_only_a_timeout_of_a_wait_is_inconclusive(tmp_path):
    """With worker processes nothing was listed at the end: the failure was a mere skip."""
    done, outcomes = run_pytest(tmp_path, '-n', '1')
    assert done.returncode == 1
    inconclusive = {name for name, outcome in outcomes.items() if outcome == 'inconclusive'}
    assert inconclusive == {
        'test_wait',
        'test_command',
        'test_wait_in_a_fixture',
        'test_wait_in_a_shared_fixture',
        'test_wait_in_a_shared_fixture_again',
    }
    failed = {name for name, outcome in outcomes.items() if outcome == 'failed'}
    assert failed == {
        'test_value',
        'test_exception',
        'test_program_error',
        'test_wrong_value_after_a_wait',
        'test_error_in_a_fixture',
    }
    assert outcomes['test_sound'] == 'passed'
    assert '4 failed, 2 passed, 1 error, 5 inconclusive' in done.stdout
    listed = done.stdout.partition('inconclusive: the machine is too busy')[2]
    assert '::test_wait: its processes waited for a processor for 90%' in listed
    for words in ('failure', 'fixture', 'shared fixture'):
        assert f'the story of the {words}' in listed
    assert 'processor wait of 8 tests with nodes: median 90%, above the limit of 30%: 8' in listed


def test_inconclusive_tests_alone_have_an_exit_code_of_their_own(tmp_path):
    done, outcomes = run_pytest(tmp_path, '-k', 'test_wait or test_sound')
    assert (done.returncode, len(outcomes)) == (6, 5)


def test_a_timeout_on_a_quiet_machine_is_a_failure(tmp_path):
    done, outcomes = run_pytest(tmp_path, '-k', 'test_wait', shares='0.3, ' * 20)
    assert done.returncode == 1
    assert {*outcomes.values()} == {'failed'}


# -- the measure ----------------------------------------------------------------------------------


@pytest.mark.long
def test_processes_that_share_a_processor_wait_for_it(busy):
    wait = ProcessorWait()
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        pass
    assert busy <= {*descendants(os.getpid())}
    assert 0.3 < wait.share() < 1.0


def test_what_sleeps_does_not_wait():
    sleeper = subprocess.Popen(['sleep', '60'])
    assert sleeper.pid in descendants(os.getpid())
    sleeper.kill()
    sleeper.wait()
    assert sleeper.pid not in descendants(os.getpid())


@pytest.fixture
def times(monkeypatch):
    """Return the times of threads that are measured, by thread."""
    found = {}
    monkeypatch.setattr(processor_wait, 'thread_times', lambda pids: dict(found))
    return found


def test_a_test_has_the_time_since_its_start(times):
    """A process of an earlier test counted from its start."""
    times['old'] = processor_wait.ProcessorTime(100, 900)
    wait = ProcessorWait()
    assert wait.share() == 0.0
    times['old'] = processor_wait.ProcessorTime(160, 900)
    times['new'] = processor_wait.ProcessorTime(20, 20)
    assert wait.share() == 0.2


def test_a_process_that_has_ended_counts_as_last_noted(times):
    """It counted 0: what was killed for its delay was no sign of a busy machine."""
    wait = processor_wait.begin()
    times['command'] = processor_wait.ProcessorTime(20, 60)
    with pytest.raises(waiting.WaitTimeoutError):
        waiting.wait_until(lambda: False, 'no answer', 0.0)
    times.clear()
    assert wait.share() == 0.75


@pytest.fixture
def processes_of(tmp_path, monkeypatch):
    """Return a function that gives processes whose one executable runs a command of the shell."""

    def make(name, command):
        program = tmp_path / 'lib' / 't3mpc_ros' / name
        program.parent.mkdir(parents=True)
        program.write_text(f'#!/bin/sh\n{command}\n')
        program.chmod(0o755)
        monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
        return waiting.Processes(tmp_path / 'log', os.environ)

    return make


@pytest.mark.parametrize('end', ['kill', 'stop'])
def test_what_the_fixture_ends_is_noted_before(end, processes_of, monkeypatch):
    wait = processor_wait.begin()
    noted = []
    monkeypatch.setattr(wait, 'note', lambda: noted.append(group.running()))
    group = processes_of('sleeper', 'exec sleep 60')
    with attended():
        group.start('sleeper')
    getattr(group, end)('sleeper')
    assert noted == [('sleeper',)]


def test_a_process_that_ended_is_no_timeout(processes_of):
    """It will never answer, however quiet the machine is."""
    group = processes_of('node', '[ -z "$1" ] || exec sleep 60')
    group.start('node')
    with pytest.raises(ProcessError, match='ended with code 0') as ended:
        group.wait_ready('node')
    assert not isinstance(ended.value, waiting.TIMEOUTS)
    group.start('node', 'sleep')
    with pytest.raises(waiting.TIMEOUTS):
        group.wait_ready('node', 0.0)
    with pytest.raises(waiting.TIMEOUTS):
        group.stop('node', 0, 0.0)
    with (
        subprocess.Popen(['true']) as process,
        pytest.raises(AssertionError, match='ended before it printed "ready"'),
    ):
        waiting.wait_for_text(process, lambda: 'text', 'ready')
    with subprocess.Popen(['sleep', '60']) as process:
        for wait in (
            lambda: waiting.wait_for_text(process, str, 'ready', 0.0),
            lambda: waiting.wait_for_end(process, 0.0),
            lambda: waiting.communicate(process, 0.0),
        ):
            with pytest.raises(waiting.WaitTimeoutError):
                wait()
        process.kill()


# -- no other waits -------------------------------------------------------------------------------

CLOCKS = {'monotonic', 'monotonic_ns', 'perf_counter', 'perf_counter_ns', 'time', 'time_ns'}
COMMANDS = {'run', 'call', 'check_call', 'check_output', 'wait', 'communicate'}


def waits(text):
    """Return the lines of a Python file with a wait of its own that can time out."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.While | ast.For):
            inner = [*ast.walk(node)]
            reads_clock = any(
                isinstance(each, ast.Call)
                and isinstance(each.func, ast.Attribute)
                and (each.func.attr in CLOCKS or each.func.attr in ('sleep', 'spin_once'))
                for each in inner
            )
            # A bare raise passes an error on.
            ends = any(
                isinstance(each, ast.Assert) or (isinstance(each, ast.Raise) and each.exc)
                for each in inner
            )
            if reads_clock and ends:
                found.add(node.lineno)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            owner = ast.unparse(node.func.value)
            limited = any(keyword.arg == 'timeout' for keyword in node.keywords)
            of_process = node.func.attr == 'wait' and owner.endswith(('process', 'child'))
            if (node.func.attr in COMMANDS and limited) or (of_process and node.args):
                found.add(node.lineno)
        if isinstance(node, ast.Attribute | ast.Name) and 'TimeoutExpired' in ast.unparse(node):
            found.add(node.lineno)
    return sorted(found)


def test_every_wait_of_a_test_is_one_that_can_be_inconclusive():
    """Other time-outs would be failures on a busy machine."""
    own = {TESTS / 'support' / 'waiting.py'}
    texts = {path: path.read_text() for path in TESTS.rglob('*.py') if path not in own}
    calls = '|'.join((*CLOCKS, 'sleep', 'spin_once', 'wait'))
    words = re.compile(rf'\.(?:{calls})\(|imeout')  # most files have none and are not parsed
    found = {path.name: waits(text) for path, text in texts.items() if words.search(text)}
    assert {name: lines for name, lines in found.items() if lines} == {}
