# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The measure by which a failure on an overloaded machine is called inconclusive."""

import os
from pathlib import Path
import subprocess
import sys
import time

import pytest
from support.processor_wait import ProcessorWait, descendants

pytestmark = pytest.mark.slow

TESTS = Path(__file__).resolve().parent
STARVED = """
import time
import pytest

def fail_slowly(error):
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        pass
    raise error('the story of the failure')

@pytest.mark.ros
def test_with_nodes():
    fail_slowly(RuntimeError)

def test_without_nodes():
    fail_slowly(RuntimeError)

@pytest.mark.ros
def test_with_a_broken_callback():
    fail_slowly(TypeError)
"""
BUSY = 'import time\nwhile True: time.monotonic()'


@pytest.fixture
def busy():
    """Leave a further process half a processor."""
    count = -(-3 * len(os.sched_getaffinity(0)) // 2)
    started = [subprocess.Popen([sys.executable, '-c', BUSY]) for _ in range(count)]
    yield {process.pid for process in started}
    for process in started:
        process.kill()
        process.wait()


def test_processes_that_share_a_processor_wait_for_it(busy):
    wait = ProcessorWait()
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        pass
    assert busy <= {*descendants(os.getpid())}
    assert 0.3 < wait.share() < 1.0


@pytest.mark.parametrize('workers', [0, 1])
def test_only_a_failure_of_nodes_is_inconclusive(busy, workers, tmp_path):
    """With worker processes nothing was listed at the end: the failure was a mere skip.

    A callback with a wrong signature was inconclusive on a busy machine.
    """
    path = tmp_path / 'test_starved.py'
    path.write_text(STARVED)
    words = ['-c', TESTS.parent / 'pyproject.toml', '-p', 'conftest', '-n', workers, path]
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', *map(str, words)],
        cwd=tmp_path,
        env=os.environ | {'PYTHONPATH': f'{TESTS}{os.pathsep}{TESTS.parent}'},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert '2 failed, 1 skipped' in done.stdout
    listed = done.stdout.partition('inconclusive: the machine is too busy')[2]
    assert '::test_with_nodes: its nodes waited for a processor' in listed
    assert 'the story of the failure' in listed


def test_what_sleeps_does_not_wait():
    sleeper = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])
    time.sleep(0.3)
    assert sleeper.pid in descendants(os.getpid())
    assert ProcessorWait().share() <= 1.0
    sleeper.kill()
    sleeper.wait()
    assert sleeper.pid not in descendants(os.getpid())
