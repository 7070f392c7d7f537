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
"""Fixtures of the node tests."""

from types import SimpleNamespace

import pytest
from support.waiting import Processes

from t3mpc_ros.cli.process_group import PrivateGraph


@pytest.fixture(scope='module')
def shared_processes(tmp_path_factory):
    """Return a process group in a graph of its own for all tests of a file."""
    with PrivateGraph() as private:
        started = Processes(tmp_path_factory.mktemp('log'), private.environment())
        yield started
        for name in list(started.running()):
            started.kill(name)


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
    from t3mpc_ros.nodes.node_main import run

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
