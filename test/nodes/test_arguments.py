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
"""Start of the node executables: help, version, wrong arguments, logs, missing libraries."""

import os
from pathlib import Path
import re
import subprocess
import sys

import pytest
from support import waiting
from support.long_tests import few_of

import t3mpc_ros
from t3mpc_ros.cli.process_group import executable
from t3mpc_ros.missing_library import REQUIREMENTS, remedy
from t3mpc_ros.nodes import node_main
from t3mpc_ros.nodes.arguments import Origin, parameter_origins, unmatched_files
from t3mpc_ros.nodes.node_main import environment_problem, isolation, provide_log_directory
from t3mpc_ros.nodes.registry import INTERFACES, NODES, parameter_class


@pytest.mark.parametrize(
    'content, node, matches',
    [
        ('controller: {ros__parameters: {rate: 50.0}}', '/controller', True),
        ('/**/controller: {ros__parameters: {rate: 50.0}}', '/controller', True),
        ('/**/controller: {ros__parameters: {rate: 50.0}}', '/a/robot_1/controller', True),
        ('/**: {ros__parameters: {rate: 50.0}}', '/robot_1/controller', True),
        ('/*/controller: {ros__parameters: {rate: 50.0}}', '/robot_1/controller', True),
        ('robot_1: {controller: {ros__parameters: {rate: 5.0}}}', '/robot_1/controller', True),
        ('sim_robot: {ros__parameters: {rate: 50.0}}', '/controller', True),
        ('controller: {ros__parameters: {rate: 50.0}}', '/robot_1/controller', False),
        ('contoller: {ros__parameters: {rate: 50.0}}', '/controller', False),
        ('controller: {rate: 50.0}', '/controller', False),
    ],
)
def test_a_parameter_file_without_effect_is_named(content, node, matches, tmp_path):
    """A key without the namespace of the node, or misspelt, was ignored."""
    file = tmp_path / 'own.yaml'
    file.write_text(content)
    problems = unmatched_files(['x', '--ros-args', '--params-file', str(file)], [node])
    assert [str(file) in problem and node in problem for problem in problems] == (
        [] if matches else [True]
    )


@pytest.mark.ros
def test_a_parameter_file_without_effect_is_a_warning(execute, tmp_path):
    file = tmp_path / 'own.yaml'
    file.write_text('contoller: {ros__parameters: {rate: 50.0}}')
    done = execute('controller', '--ros-args', '--params-file', str(file))
    assert done.code == 0
    assert f'{file} sets nothing: its keys /contoller' in done.err


ORIGINS = [
    ('-p rate:=5', {'rate': Origin.OPTION}),
    ('--param rate:=a:=b', {'rate': Origin.OPTION}),
    ('-p controller:rate:=5', {'rate': Origin.SECTION}),
    ('--params-file {}', {'a': Origin.SHARED, 'b.c': Origin.SHARED, 'rate': Origin.SECTION}),
    ('--params-file {} -p a:=1', {'a': Origin.OPTION, 'b.c': 1, 'rate': 2}),
    ('-p a:=1 --params-file {}', {'a': Origin.OPTION, 'b.c': 1, 'rate': 2}),
    ('-r odom:=x', {}),
]
"""Arguments with a file, and where each parameter of the controller comes from."""


@pytest.mark.parametrize('words, origins', ORIGINS)
def test_the_origin_is_the_one_most_meant_for_the_node(words, origins, tmp_path):
    file = tmp_path / 'own.yaml'
    file.write_text(
        '/**: {ros__parameters: {a: 1, b: {c: 2}}}\n'
        '/**/controller: {ros__parameters: {rate: 5.0}}\n'
        '/*: {ros__parameters: {rate: 4.0}}\n'
        'sim_robot: {ros__parameters: {other: 5.0}}\n'
    )
    words = words.format(file).split()
    assert parameter_origins(['x', '--ros-args', *words], '/controller') == origins


SHARED = """\
/**:
  ros__parameters: {use_sim_time: false, rate: 50.0, robot_radius: 0.1, law.gian: 3.0, seed: 7}
nav2_node:
  ros__parameters: {law.gain: 1.0, anything: 2}
"""


@pytest.mark.ros
def test_names_for_other_nodes_in_a_shared_file_are_ignored(execute, tmp_path):
    """A foreign name under ``/**`` ended every node of the package, but no node of rclcpp."""
    file = tmp_path / 'shared.yaml'
    file.write_text(SHARED)
    done = execute('controller', '--ros-args', '--params-file', str(file))
    assert done.code == 0
    warnings = [line for line in done.err.splitlines() if 'WARN' in line]
    assert len(warnings) == 1, 'robot_radius and seed resemble nothing, or have an owner'
    assert 'law.gian in a section for all nodes is ignored; did you mean law.gain?' in warnings[0]


INVALID = [
    ('player', '--ros-args -p rate:=2.0', 'no parameter rate', 'did you mean play.rate?'),
    ('recorder', '--ros-args -p rate:=5', 'no parameter rate', 'controller', 'sim_robot'),
    ('controller', '--ros-args --params-file SECTION', 'no parameter seed'),
    ('composed', '--ros-args -p play.rate:=2.0', 'no parameter play.rate (player has)'),
    ('composed', '--ros-args -p controller:seed:=2', 'controller has no parameter seed'),
    ('controller', '--gain 30', 'unknown arguments --gain 30', '-p law.gain:='),
    ('controller', 'law.gain:=30', 'law.gain:=30', '-p law.gain:='),
    ('player', 'mybag', 'unknown argument mybag', '-p NAME:=VALUE'),
    ('sim_robot', '--ros-args -p rate:=50.0 -- -v', 'argument -v:'),
    ('sim_robot', '--ros-args --no-such', '--no-such'),
    ('controller', '--ros-args -p law.gain:=-1.0', 'law.gain', '0', '-1'),
    ('controller', '--ros-args -p law.gian:=1.0', 'law.gian', 'did you mean law.gain'),
    ('controller', '--ros-args -p model:=BROKEN', 'BROKEN', 'not a model file'),
    ('reference_generator', '--ros-args -p rate:=fast', 'rate', 'a number', 'fast'),
    ('sim_robot', '--ros-args -p drive.kind:=warp', 'drive.kind', 'one of', 'warp'),
    ('sim_robot', '--ros-args -p world:=rome', 'rome', 'did you mean room?'),
    ('player', '--ros-args -p storage.uris:=["/nowhere"]', 'player: there is no bag /nowhere'),
    ('recorder', '--ros-args --params-file MISSING', 'MISSING', 'cannot be read'),
    ('recorder', '--ros-args --params-file BROKEN', 'BROKEN', 'is not YAML'),
    ('recorder', '--ros-args -p storage.uri:=FILE/bag', 'must be a folder', 'FILE is a file'),
    ('recorder', '--ros-args -p storage.uri:=FILE', 'storage.uri must be a folder', 'FILE'),
]
"""Executable, arguments, and the words of the one line that it prints."""


@pytest.mark.ros
@pytest.mark.parametrize('case', INVALID, ids=' '.join)
def test_invalid_input_at_start_is_one_line_and_code_2(case, execute, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'SECTION').write_text('controller: {ros__parameters: {seed: 2}}')
    (tmp_path / 'BROKEN').write_text('controller:\n  ros__parameters: [1,\n')
    (tmp_path / 'FILE').write_text('a file where a folder is wanted')
    name, arguments, *words = case
    done = execute(name, *arguments.split())
    assert done.code == 2
    (line,) = (line for line in done.err.splitlines() if not line.startswith('['))
    assert line.startswith(f'{name}: ')
    for word in words:
        assert word in line


@pytest.mark.ros
@pytest.mark.parametrize('name', NODES)
def test_help_lists_topics_services_and_parameters(name, execute):
    """``--help`` started the node."""
    done = execute(name, '--help')
    assert (done.code, done.err) == (0, '')
    interface = INTERFACES[name]
    for word in (*interface.subscribes, *interface.publishes, *interface.services):
        assert word in done.out
    for spec in parameter_class(name).specs():
        assert f' {spec.name} = ' in done.out
    done = execute(name, '--version')
    assert (done.code, done.out) == (0, f't3mpc_ros {t3mpc_ros.__version__}\n')


# -- logs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'given, replaced',
    [
        ({'HOME': 'FOLDER/home'}, False),
        ({'HOME': 'FOLDER/file'}, True),
        ({}, True),
        ({'HOME': 'FOLDER/file', 'ROS_HOME': 'FOLDER/ros'}, False),
        ({'HOME': 'FOLDER/home', 'ROS_HOME': 'FOLDER/file'}, True),
        ({'HOME': 'FOLDER/file', 'ROS_LOG_DIR': 'FOLDER/file/log'}, False),
    ],
)
def test_a_folder_that_cannot_be_written_is_replaced(given, replaced, tmp_path):
    """By a temporary one, unless it is the choice of the user."""
    (tmp_path / 'file').touch()
    given = {name: text.replace('FOLDER', str(tmp_path)) for name, text in given.items()}
    environment = dict(given)
    provide_log_directory(environment)
    assert (environment != given) == replaced
    if replaced:
        made = Path(environment.pop('ROS_LOG_DIR'))
        assert environment == given
        assert f't3mpc_ros-{os.getuid()}' in made.parts


@pytest.mark.slow
def test_ros_starts_without_a_home_folder(tmp_path):
    """Every node said that its command line was invalid."""
    code = 'from t3mpc_ros.nodes.node_main import init_ros; init_ros([])'
    environment = {k: v for k, v in os.environ.items() if k != 'ROS_LOG_DIR'}
    for home in (str(tmp_path), os.devnull):
        words = [sys.executable, '-c', code]
        done = subprocess.run(words, env=environment | {'HOME': home}, capture_output=True)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / '.ros' / 'log').is_dir()


@pytest.mark.parametrize('text', ['233', '-1', '1.5', 'abc'])
def test_a_domain_that_cannot_be_is_named(text):
    """Some were accepted, others ended in the words of a port number or of a source file."""
    assert environment_problem({'ROS_DOMAIN_ID': text}).endswith(f'from 0 to 232: got {text}')
    assert all(not environment_problem({'ROS_DOMAIN_ID': each}) for each in ('', '0', '232'))
    assert not environment_problem({})


def test_a_node_that_nobody_can_find_says_so(monkeypatch):
    """It said *ready*, with every network interface down or with discovery switched off."""
    off = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'}
    assert isolation(off).endswith('ROS_AUTOMATIC_DISCOVERY_RANGE is OFF: unset it')
    assert not isolation(off | {'ROS_LOCALHOST_ONLY': '1'})  # which rcl prefers
    flags = {'up': b'\x49\x00', 'down': b'\x48\x00'}  # of lo, the least bit is IFF_UP
    for state, text in (('up', ''), ('down', 'no network interface is up: `ip link set lo up`')):
        answer = bytes(16) + flags[state] + bytes(22)
        monkeypatch.setattr(node_main.fcntl, 'ioctl', lambda *asked, answer=answer: answer)
        assert text in isolation({})
        assert bool(isolation({})) == bool(text)
    monkeypatch.setattr(node_main.socket, 'if_nameindex', refused)
    assert not isolation({})  # where the kernel does not say


def refused():
    raise PermissionError


def test_a_profile_that_does_not_exist_is_named(tmp_path):
    """Fast DDS ignored it, and the robot hesitated whenever somebody subscribed."""
    name = 'FASTRTPS_DEFAULT_PROFILES_FILE'
    for path in (f'{tmp_path}', f'{tmp_path}/none.xml'):
        found = environment_problem({name: path})
        assert found == f'{name} must be an existing file, with its whole path: got {path}'
        other = environment_problem({name: path, 'RMW_IMPLEMENTATION': 'rmw_zenoh_cpp'})
        assert name not in other  # which has no such profiles
    assert not environment_problem({name: __file__})
    assert not environment_problem({name: ''})


@pytest.mark.slow
@pytest.mark.parametrize('words, code', [(['sim_robot'], 2), (['t3mpc', 'topic', 'list'], 1)])
def test_a_middleware_that_is_not_installed_is_named(words, code):
    """The text of a source file of rcl, and exit code 102."""
    program = str(executable(words[0]))
    environment = os.environ | {'RMW_IMPLEMENTATION': 'rmw_none'}
    done = subprocess.run([program, *words[1:]], env=environment, capture_output=True, text=True)
    assert done.returncode == code
    (line,) = done.stderr.splitlines()
    assert re.search('RMW_IMPLEMENTATION must be one .*, rmw_fastrtps_cpp: got rmw_none', line)


# -- missing libraries ----------------------------------------------------------------------------


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


@pytest.mark.ros
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


@pytest.mark.ros
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


@pytest.mark.ros
def test_remedies_are_the_requirements_of_the_package():
    files = [*ROOT.glob('requirements*.txt')]
    wanted = {line.strip() for file in files for line in file.read_text().splitlines()}
    assert set(REQUIREMENTS.values()) <= wanted
    listed = re.findall(r"^        '([\w-]+)',$", (ROOT / 'setup.py').read_text(), re.MULTILINE)
    names = {re.split('[<>=]', requirement)[0] for requirement in REQUIREMENTS.values()}
    assert set(listed) - {'setuptools'} <= names
    assert remedy(ModuleNotFoundError(name='t3mpc_ros.no_such_module')) == ''
