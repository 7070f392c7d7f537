# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fixtures: an isolated ROS graph for each test that needs one."""

import fcntl
from pathlib import Path
import random
import tempfile

import pytest

from t3mpc_ros.cli.process_group import ProcessGroup, private_graph


@pytest.fixture
def graph(monkeypatch):
    """Return an unused ``ROS_DOMAIN_ID``, set for this process and its children.

    A lock file per domain isolates concurrent test runs. Domains above 101 use ports of the
    ephemeral range.
    """
    for domain in random.SystemRandom().sample(range(1, 102), 101):
        lock = (Path(tempfile.gettempdir()) / f't3mpc_ros_domain_{domain}.lock').open('w')
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        except BlockingIOError:
            lock.close()
    else:
        pytest.fail('every ROS domain is in use by other tests')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
    for name, value in private_graph().items():
        monkeypatch.setenv(name, value)
    yield domain
    lock.close()


@pytest.fixture
def ros(graph):
    """Initialise rclpy in the process of the test, for the duration of a test."""
    import rclpy

    rclpy.init(args=[])
    yield graph
    rclpy.try_shutdown()


@pytest.fixture
def processes(graph, tmp_path):
    """Return a process group; processes that still run at the end are killed."""
    started = ProcessGroup(tmp_path / 'log', private_graph())
    yield started
    for name in list(started.running()):
        started.kill(name)
