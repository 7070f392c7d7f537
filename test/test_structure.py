# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The architecture, kept by a test: who may import whom, and what every file carries."""

import ast
from pathlib import Path
import re
import xml.etree.ElementTree as ElementTree

import pytest
import yaml

import t3mpc_ros

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / 't3mpc_ros'
SOURCES = sorted(PACKAGE.rglob('*.py'))

# What each room may import besides itself, the standard library and numpy.
ROOMS = {
    'kernels': set(),
    'settings': set(),
    'motion': {'settings', 'kernels'},
    'chaos': {'settings', 'kernels', 'motion'},
    'fuzzy': {'settings', 'kernels', 'motion'},
    'mpc': {'settings', 'kernels', 'motion'},
    'robot': {'settings', 'kernels', 'motion'},
    'radio': {'settings', 'kernels', 'motion', 'robot'},
    'emulator': {'settings', 'kernels', 'motion', 'robot', 'radio'},
    'record': {'settings', 'motion'},
    'control': {'settings', 'kernels', 'motion', 'fuzzy', 'mpc'},
    'lab': {
        'settings',
        'kernels',
        'motion',
        'chaos',
        'fuzzy',
        'mpc',
        'robot',
        'record',
        'control',
    },
    'nodes': {
        'settings',
        'kernels',
        'motion',
        'chaos',
        'fuzzy',
        'mpc',
        'robot',
        'radio',
        'record',
        'control',
    },
}
LIBRARIES = {
    'kernels': {'numba'},
    'robot': {'yaml'},
    'radio': {'serial'},
    'record': {'mcap', 'rosbags', 'yaml', 'zstandard', 'lz4'},
    'lab': {'matplotlib', 'yaml', 'cma', 'casadi'},
    'nodes': {'yaml'},
}
ROS = re.compile(
    r'^(rclpy|rcl_interfaces|builtin_interfaces|tf2_ros|std_srvs|\w+_msgs|launch\w*)$'
)


def _imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            found.add(node.module or '')
            if node.module == 't3mpc_ros':
                found |= {f't3mpc_ros.{name.name}' for name in node.names}
    return found


def _room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0] if path.parent != PACKAGE else ''


@pytest.mark.parametrize('path', SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_follow_the_rules_of_the_rooms(path):
    import sys

    room = _room(path)
    for name in _imports(path):
        top, *rest = name.split('.')
        if top == 't3mpc_ros':
            if rest and (PACKAGE / rest[0]).is_dir():
                assert room, f'{path}: the package itself imports no room'
                assert rest[0] == room or rest[0] in ROOMS[room], f'{room} imports {rest[0]}'
        elif ROS.match(top):
            assert room == 'nodes', f'{path} imports {name}: only nodes/ knows ROS'
        else:
            allowed = set(sys.stdlib_module_names) | {'numpy'} | LIBRARIES.get(room, set())
            assert top in allowed, f'{path} imports {name}'


def test_only_the_port_of_the_radio_knows_pyserial():
    users = [path for path in SOURCES if 'serial' in _imports(path)]
    assert users == [PACKAGE / 'radio' / 'host' / 'port.py']


def test_the_room_table_is_complete():
    rooms = {path.name for path in PACKAGE.iterdir() if (path / '__init__.py').exists()}
    assert rooms == set(ROOMS)


@pytest.mark.parametrize('room', sorted(ROOMS))
def test_a_room_can_be_read_in_one_sitting(room):
    for folder in {PACKAGE / room, *(p.parent for p in (PACKAGE / room).rglob('*.py'))}:
        files = [path for path in folder.glob('*.py') if path.name != '__init__.py']
        assert len(files) <= 8, f'{folder.name} has {len(files)} files'
        for path in files:
            length = len(path.read_text().splitlines())
            assert length <= 400, f'{path.name} has {length} lines'


def test_every_source_file_carries_the_licence():
    files = [*SOURCES, *(ROOT / 'test').rglob('*.py'), *(ROOT / 'launch').glob('*.py')]
    files += [path for path in (ROOT / 'scripts').iterdir() if path.is_file()]
    for path in files:
        assert 'SPDX-License-Identifier: Apache-2.0' in path.read_text()[:300], path


def test_version_is_the_same_everywhere():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert package.findtext('version') == t3mpc_ros.__version__
    assert f'\n{t3mpc_ros.__version__} (' in (ROOT / 'CHANGELOG.rst').read_text()


def test_package_xml_names_every_ros_package_that_is_imported():
    declared = {
        element.text
        for element in ElementTree.parse(ROOT / 'package.xml').getroot()
        if element.tag in ('depend', 'exec_depend')
    }
    for path in [*SOURCES, *(ROOT / 'launch').glob('*.py')]:
        for name in _imports(path):
            top = name.split('.')[0]
            if ROS.match(top) and top != 'tf2_ros':  # optional: used where it is installed
                assert top in declared, f'{path.name} imports {top}, package.xml does not name it'


def test_no_global_random_numbers_and_no_clock_outside_nodes():
    """Seeds are explicit, time is an argument; what runs processes is the exception."""
    clock = re.compile(
        r'\btime\.(time|monotonic|perf_counter|sleep)|datetime\.now|np\.random\.(?!Gen|def|SeedS)'
    )
    exempt = {
        'lab/processes.py',
        'lab/demo.py',
        'lab/program.py',
        'lab/bag/program.py',
        'lab/bag/rerun.py',
        'lab/tuning/command.py',
        'lab/paper/program.py',
        'emulator/serial_end.py',
        'radio/bench/carrier.py',
    }
    for path in SOURCES:
        name = str(path.relative_to(PACKAGE))
        if _room(path) != 'nodes' and name not in exempt:
            assert not clock.search(path.read_text()), (
                f'{name} reads a clock or global random state'
            )


def test_every_yaml_of_config_fits_its_node():
    from t3mpc_ros.nodes.node_parameters import PARAMETER_CLASSES

    files = sorted((ROOT / 'config').glob('*.yaml'))
    assert files
    for path in files:
        for node, content in yaml.safe_load(path.read_text()).items():
            table = PARAMETER_CLASSES[node.rsplit('/', 1)[-1]]
            table.from_dict(_flat(content['ros__parameters']))


def _flat(tree: dict, prefix: str = '') -> dict:
    result = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            result |= _flat(value, f'{prefix}{key}.')
        else:
            result[f'{prefix}{key}'] = value
    return result


def test_no_file_carries_a_path_of_a_machine_or_a_registry_host():
    words = re.compile(
        r'/(work|root|home|farm|tmp)/[a-z]|https?://[^\s]*(pypi|pythonhosted|npmjs|crates)'
    )
    for path in ROOT.rglob('*'):
        hidden = any(
            part.startswith('.') and part != '.ci' for part in path.relative_to(ROOT).parts
        )
        if hidden or not path.is_file() or path.suffix in ('.png', '.pyc', '.mcap', '.npz'):
            continue
        if {'build', 'install', 'log', 'runs', 'node_modules'} & set(path.relative_to(ROOT).parts):
            continue
        if path == Path(__file__).resolve():
            continue
        assert not words.search(path.read_text(errors='replace')), path
