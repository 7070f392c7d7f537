# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the node tests."""

from types import SimpleNamespace

import pytest


@pytest.fixture
def harness(ros):
    """Return a harness that runs nodes in the test's own process."""
    from support.ros_graph import NodeHarness

    made = NodeHarness()
    yield made
    made.close()


@pytest.fixture
def logged(capfd):
    """Return a function that returns the lines with a text that nodes have printed so far.

    Read from the terminal: a subscription to /rosout may miss what precedes its match.
    """
    text = ''

    def logged(words):
        nonlocal text
        text += ''.join(capfd.readouterr())
        return [line for line in text.splitlines() if words in line]

    return logged


@pytest.fixture
def execute(graph, capfd):
    """Return a function that runs an executable in this process until its nodes have started."""
    from t3mpc_ros.nodes.process import run

    class Stop:
        exit_at_once = False

        def __call__(self):
            return True

    def execute(name, *arguments):
        """Return the exit code, and what was written to standard output and error."""
        code = run(name, Stop(), [name, *arguments])
        output = capfd.readouterr()
        return SimpleNamespace(code=code, out=output.out, err=output.err)

    return execute
