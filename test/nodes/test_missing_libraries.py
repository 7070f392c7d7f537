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
"""Executables without the libraries that rosdep does not install."""

from pathlib import Path
import re
import subprocess
import sys

import pytest
from support import waiting
from support.long_tests import few_of

from t3mpc_ros.cli.process_group import executable
from t3mpc_ros.missing_library import REQUIREMENTS, remedy

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[2]
BAG_LIBRARIES = ('mcap', 'rosbags', 'zstandard', 'lz4', 'matplotlib', 'cma', 'casadi')


@pytest.fixture
def without(monkeypatch, tmp_path):
    """Return a function that removes libraries from processes started afterwards."""

    def remove(*libraries):
        for name in libraries:
            text = f"raise ModuleNotFoundError('No module named {name}', name='{name}')\n"
            (tmp_path / f'{name}.py').write_text(text)
        monkeypatch.setenv('PYTHONPATH', str(tmp_path))

    return remove


def test_nodes_without_bags_need_no_bag_library(without, graph, tmp_path):
    """The parameters of other nodes, which a file may hold, were looked up in their modules."""
    without(*BAG_LIBRARIES)
    file = tmp_path / 'shared.yaml'
    file.write_text('/**: {ros__parameters: {play.rate: 1.0, publish_clok: false, law.gian: 1.0}}')
    start = (
        'import sys; from t3mpc_ros.nodes.node_main import run\n'
        'class Stop:\n'
        '    def __call__(self): return True\n'
        "for name in ('reference_generator', 'controller', 'sim_robot', 'radio_bridge'):\n"
        f"    assert run(name, Stop(), [name, '--ros-args', '--params-file', '{file}']) == 0\n"
    )
    done = subprocess.run([sys.executable, '-c', start], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


CASES = [
    ('rosbags', 'player', []),
    ('mcap', 'recorder', []),
    ('numba', 'controller', []),
    ('serial', 'radio_bridge', []),
    ('rclpy', 'sim_robot', []),
    ('casadi', 't3mpc', ['paper', '--quick', '--output', 'out']),
    ('mcap', 'composed', []),
    ('mcap', 't3mpc', ['bag', 'info', 'bag']),
    ('matplotlib', 't3mpc', ['paper', '--quick', '--output', 'out']),
    ('casadi', 't3mpc', ['compare']),
    ('casadi', 't3mpc', ['tune', '--output', 'out.json']),
]


@pytest.mark.parametrize('library, name, arguments', few_of(CASES, 6))
def test_a_missing_library_is_one_line_with_its_remedy(
    library, name, arguments, without, graph, tmp_path
):
    """It was a traceback."""
    without(library)
    done = waiting.run([executable(name), *arguments], cwd=tmp_path)
    assert done.returncode == 1
    lines = [line for line in done.stderr.splitlines() if not line.startswith('[')]
    assert len(lines) == 1, done.stderr
    assert f' {library} is missing: ' in lines[0]


def test_remedies_are_the_requirements_of_the_package():
    files = [*ROOT.glob('requirements*.txt')]
    wanted = {line.strip() for file in files for line in file.read_text().splitlines()}
    assert set(REQUIREMENTS.values()) <= wanted
    listed = re.findall(r"^        '([\w-]+)',$", (ROOT / 'setup.py').read_text(), re.MULTILINE)
    names = {re.split('[<>=]', requirement)[0] for requirement in REQUIREMENTS.values()}
    assert set(listed) - {'setuptools'} <= names
    assert remedy(ModuleNotFoundError(name='t3mpc_ros.no_such_module')) == ''
