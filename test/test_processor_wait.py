# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The measure by which a failure on an overloaded machine is called inconclusive."""

import os
import subprocess
import sys
import time

import pytest
from support.processor_wait import ProcessorWait, descendants

BUSY = 'import time\nwhile True: time.monotonic()'


@pytest.fixture
def busy():
    """Keep every processor busy four times."""
    count = 4 * len(os.sched_getaffinity(0))
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


def test_what_sleeps_does_not_wait():
    sleeper = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])
    time.sleep(0.3)
    assert sleeper.pid in descendants(os.getpid())
    assert ProcessorWait().share() <= 1.0
    sleeper.kill()
    sleeper.wait()
    assert sleeper.pid not in descendants(os.getpid())
