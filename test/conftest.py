# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fixtures: an isolated ROS graph for each test that needs one."""

import os

import pytest

from t3mpc_ros.cli.private_graph import PrivateGraph
from t3mpc_ros.cli.process_group import ProcessGroup


@pytest.fixture
def graph(monkeypatch):
    """Return the ``ROS_DOMAIN_ID`` of a private graph of this process and its children."""
    with PrivateGraph() as private:
        environment = private.environment()
        for name in set(os.environ) - set(environment):
            monkeypatch.delenv(name)
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        yield private.domain


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
    started = ProcessGroup(tmp_path / 'log', os.environ)
    yield started
    for name in list(started.running()):
        started.kill(name)
