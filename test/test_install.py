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
"""Installation with colcon: what a workspace contains, and that it runs."""

from fnmatch import fnmatch
import functools
import os
from pathlib import Path
import re
import subprocess
import sys

import pytest
from support.checkout import EXECUTABLES, clean_environment, copy_package
from support.launch_files import nodes_of
from support.long_tests import few_of
from support.waiting import TIMEOUT, Processes
import yaml

from t3mpc_ros.nodes.registry import NODES

# All tests share one build.
pytestmark = pytest.mark.ros

IN_FEW = 'composed', 'localizer', 'player', 'radio_bridge'
"""Executables that run every node of the package, four of them in one process."""

# --- colcon -------------------------------------------------------------------------------------


class Tree:
    """A colcon workspace with the package built into it."""

    def __init__(self, folder, *options):
        self.source = copy_package(folder / 'src' / 't3mpc_ros')
        self.symlinked = '--symlink-install' in options
        self.prefix = folder / 'install' / 't3mpc_ros'
        self.share = self.prefix / 'share' / 't3mpc_ros'
        # colcon and "#!" know no blank in the path of Python: that of the checkout may have one.
        self.python_prefix = folder / '.python'  # hidden from colcon
        self.python_prefix.symlink_to(sys.prefix)
        programs = self.python_prefix / 'bin'
        self.colcon = [programs / 'python', programs / 'colcon']
        assert self.colcon[1].exists(), 'colcon is missing: pip install -r requirements-colcon.txt'
        self.environment = clean_environment(
            AMENT_PREFIX_PATH=self.python_prefix,
            COLCON_HOME=folder / 'colcon',
        )
        built = subprocess.run(
            [*self.colcon, 'build', *options],
            cwd=folder,
            env=self.environment,
            capture_output=True,
            text=True,
        )
        assert built.returncode == 0, built.stdout + built.stderr
        self.environment = self._sourced(folder / 'install' / 'setup.bash')
        self.scratch = folder / 'scratch'
        self.scratch.mkdir()

    def _sourced(self, setup):
        """Return the environment of a shell that has sourced the workspace."""
        output = subprocess.run(
            ['bash', '-c', 'source "$1" && env -0', 'bash', setup],
            env=self.environment,
            capture_output=True,
            text=True,
            check=True,
        )
        return dict(line.split('=', 1) for line in output.stdout.split('\0') if line)

    def run(self, name, *arguments):
        return subprocess.run(
            [self.prefix / 'lib' / 't3mpc_ros' / name, *arguments],
            cwd=self.scratch,
            env=self.environment,
            capture_output=True,
            text=True,
        )


@pytest.fixture(scope='module')
def build(tmp_path_factory):
    """Return a function that builds the package, once for each set of options."""

    @functools.cache
    def built(*options):
        return Tree(tmp_path_factory.mktemp('workspace'), *options)

    return built


@pytest.fixture(scope='module', params=few_of(['copied', 'symlinked']))
def tree(request, build):
    """Return the package built by ``colcon build``, and again with ``--symlink-install``."""
    return build() if request.param == 'copied' else build('--symlink-install')


@pytest.fixture(scope='module')
def copied(build):
    """Return the package built by a plain ``colcon build``."""
    return build()


def test_a_workspace_contains_all_files_that_ros_needs(tree):
    assert (tree.prefix / 'share/ament_index/resource_index/packages/t3mpc_ros').is_file()
    executables = {path.name for path in (tree.prefix / 'lib' / 't3mpc_ros').iterdir()}
    assert executables == EXECUTABLES == {*NODES, 't3mpc'}
    assert all(os.access(tree.prefix / 'lib/t3mpc_ros' / name, os.X_OK) for name in executables)
    for pattern in ('package.xml', 'config/*', 'launch/*.launch.py'):
        wanted = {path.relative_to(tree.source) for path in tree.source.glob(pattern)}
        there = {path.relative_to(tree.share) for path in tree.share.glob(pattern)}
        assert wanted == there != set()
    for path in tree.share.glob('config/*'):
        # Symlinked: an edited YAML takes effect. Copied: independent of the source.
        assert path.is_relative_to(tree.prefix)
        assert path.resolve().is_relative_to(tree.source.resolve()) == tree.symlinked


def code_below(package):
    """Return the modules of a package, and the C files its emulator compiles, as relative paths.

    Flashing and the drivers of the boards belong to a checkout, not to an installation.
    """
    files = {
        path.relative_to(package)
        for path in package.rglob('*')
        if path.suffix in ('.py', '.c', '.h')
    }
    board = Path('emulator/firmware')
    compiled = (board / 'core', board / 'host')
    return {path for path in files if board not in path.parents or path.parent in compiled}


def test_a_sourced_workspace_runs_its_own_complete_code(tree):
    """``packages=[name]`` in setup.py would omit the sub-packages, which .venv would hide."""
    code = 'import t3mpc_ros; print(t3mpc_ros.__path__[0])'
    output = subprocess.check_output(
        [sys.executable, '-c', code], cwd=tree.scratch, env=tree.environment, text=True
    )
    installed = Path(output.strip())
    assert installed.is_relative_to(tree.prefix.parent.parent)
    source = tree.source / 't3mpc_ros'
    assert code_below(installed) == code_below(source)
    core = Path('emulator/firmware/core')
    assert core / 't3_robot.c' in code_below(installed)
    prefixes = tree.environment['AMENT_PREFIX_PATH'].split(os.pathsep)
    assert prefixes == [str(tree.prefix), str(tree.python_prefix)]


@pytest.mark.slow
@pytest.mark.parametrize(
    'tree, names',
    few_of([('copied', IN_FEW), ('copied', tuple(NODES)), ('symlinked', tuple(NODES))]),
    indirect=['tree'],
)
def test_every_installed_node_starts_and_exits_with_0(tree, names, graph, monkeypatch):
    for name in NODES:
        assert tree.run(name, '--version').returncode == 0, name
    monkeypatch.setenv('AMENT_PREFIX_PATH', tree.environment['AMENT_PREFIX_PATH'])
    monkeypatch.chdir(tree.scratch)
    of_graph = {k: v for k, v in os.environ.items() if k.startswith(('ROS_', 'FASTRTPS_'))}
    group = Processes(tree.scratch / 'log', tree.environment | of_graph)
    try:
        for name in names:
            group.start(name)
        for name in names:
            group.wait_ready(name, 180.0)
            assert group.stop(name, seconds=TIMEOUT) == 0, group.log(name).read_text()
            assert 'Traceback' not in group.log(name).read_text()
    finally:
        group.end_all()


def test_colcon_test_runs_the_tests_and_reports_them(copied):
    """Without pytest as a test dependency it ran nothing and reported success."""
    workspace = copied.source.parent.parent
    some = ['--pytest-args', 'test/geometry/test_sample_scheduler.py']
    for words in (['test', *some], ['test-result', '--all']):
        done = subprocess.run(
            [*copied.colcon, *words],
            cwd=workspace,
            env=copied.environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout + done.stderr
    (count,) = re.findall(
        r'^Summary: (\d+) tests, 0 errors, 0 failures', done.stdout, re.MULTILINE
    )
    assert int(count) > 10


# --- launch --------------------------------------------------------------------------------------


def test_the_launch_file_names_only_what_is_installed(copied, monkeypatch):
    """The package ``launch`` is available from apt only: the file runs with substitutes."""
    monkeypatch.setenv('AMENT_PREFIX_PATH', copied.environment['AMENT_PREFIX_PATH'])
    for file in (copied.share / 'launch').iterdir():
        for node in nodes_of(file):
            assert node.executable in EXECUTABLES
            files = [Path(level) for level in node.parameters if isinstance(level, str)]
            assert all(path.is_relative_to(copied.share) for path in files)
            keys = [key for path in files for key in yaml.safe_load(path.read_text())]
            assert any(fnmatch(f'/{node.name}', key.replace('/**', '*')) for key in keys)
