# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fixtures: a ROS graph of its own for every test that needs one."""

import fcntl
from pathlib import Path
import random
import tempfile

import pytest

from t3mpc_ros.cli.process_group import ProcessGroup, private_graph


@pytest.fixture
def graph(monkeypatch):
    """Return a ``ROS_DOMAIN_ID`` nobody else uses, set for this process and its children.

    Two runs of the tests at once would hear each other's robots: a lock file per domain keeps
    them apart. Beyond 101 the ports of DDS are handed out to others.
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
    """Initialise rclpy in the test's own process for the length of a test."""
    import rclpy

    rclpy.init(args=[])
    yield graph
    rclpy.try_shutdown()


@pytest.fixture
def fleet(graph, tmp_path):
    """Return a fleet of executables; whatever still runs at the end is killed."""
    started = ProcessGroup(tmp_path / 'log', private_graph())
    yield started
    for name in list(started.running()):
        started.kill(name)
