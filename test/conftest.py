# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Short default set of tests; fixtures: an isolated ROS graph for each test that needs one."""

import os
from pathlib import Path

import pytest

from t3mpc_ros.cli.private_graph import PrivateGraph
from t3mpc_ros.cli.process_group import ProcessGroup

ROOT = Path(__file__).resolve().parent
DEFAULT = ('geometry', 'parameters', 'robot', 'fuzzy', 'test_launch_files.py')
"""What ``colcon test``, and pytest without arguments, runs in less than two minutes; kernels that
have to be compiled first take another one."""


def pytest_collection_modifyitems(config, items):
    """Run the default set unless paths, markers or names select tests; scripts/check runs all."""
    chosen = config.args_source is config.ArgsSource.ARGS or config.option.markexpr
    if chosen or config.option.keyword or hasattr(config, 'workerinput'):
        return
    default = [
        item
        for item in items
        if {*item.path.relative_to(ROOT).parts} & {*DEFAULT}
        and not item.get_closest_marker('slow')
    ]
    config.hook.pytest_deselected(items=[item for item in items if item not in default])
    items[:] = default


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
