# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fixtures: a ROS graph of its own for every test that needs one."""

import itertools
import os

import pytest

from t3mpc_ros.lab.processes import Fleet, private_graph

_DOMAINS = itertools.count(os.getpid())


@pytest.fixture
def graph(monkeypatch):
    """Return a ``ROS_DOMAIN_ID`` nobody else uses, set for this process and its children."""
    domain = 1 + next(_DOMAINS) % 101  # beyond 101 the ports of DDS are handed out to others
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
    for name, value in private_graph().items():
        monkeypatch.setenv(name, value)
    return domain


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
    started = Fleet(tmp_path / 'log', private_graph())
    yield started
    for name in list(started.running()):
        started.kill(name)
