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
"""Architecture of the package: import direction, import closure, names, licence headers."""

import ast
from collections import defaultdict
from collections.abc import Iterator, Sequence
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import yaml

import t3mpc_ros
from t3mpc_ros.missing_library import REQUIREMENTS

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / 't3mpc_ros'
SOURCES = sorted(PACKAGE.rglob('*.py'))
TESTS = ROOT / 'test'

BASE = {'parameters', 'geometry', 'kernels'}
CORE = BASE | {'chaos', 'fuzzy', 'mpc', 'robot', 'bag', 'control', 'simulation'}
# Packages that each package may import beside itself, the standard library and numpy.
PACKAGES = {
    'parameters': set(),
    'kernels': set(),
    'stop_signal': set(),
    'parent_process': set(),
    'missing_library': set(),
    'atomic_file': set(),
    'model_file': {'parameters', 'atomic_file'},
    'version': set(),
    'script_error': set(),
    'gym': CORE | {'missing_library', 'script_error', 'evaluation'},
    'geometry': {'parameters', 'kernels'},
    'chaos': BASE,
    'fuzzy': BASE,
    'mpc': BASE,
    'robot': BASE,
    'bag': BASE | {'atomic_file', 'model_file'},
    'control': BASE | {'fuzzy', 'mpc'},
    'simulation': BASE | {'robot', 'script_error'},
    'radio': BASE | {'robot'},
    'localization': BASE | {'simulation'},
    'emulator': BASE | {'robot', 'simulation', 'radio'},
    'evaluation': CORE
    | {'localization', 'page', 'atomic_file', 'stop_signal', 'parent_process', 'missing_library'}
    | {'script_error', 'model_file'},
    'nodes': CORE
    | {'radio', 'localization', 'atomic_file', 'model_file', 'stop_signal', 'missing_library'},
    'cli': CORE
    | {'radio', 'atomic_file', 'model_file', 'stop_signal', 'parent_process', 'missing_library'}
    | {'emulator', 'evaluation', 'nodes', 'view'},
    'page': set(),
    'view': {'page'},
}
FRONT = {'evaluation', 'simulation', 'script_error'}
"""Packages that hold the names of the top level, which imports them when they are used."""
# Libraries that each package may import.
LIBRARIES = {
    'kernels': {'numba'},
    'parameters': {'yaml'},
    'radio': {'serial'},
    'bag': {'mcap', 'rosbags', 'yaml'},
    'mpc': {'daqp'},
    'evaluation': {'matplotlib', 'PIL', 'yaml', 'cma', 'casadi', 'jinja2', 'tqdm', 'daqp'}
    | {'pyarrow', 'distributed', 'cloudpickle'},
    'nodes': {'yaml'},
    'cli': {'yaml', 'shtab'},
    'gym': {'gymnasium'},
}
ROS = re.compile(
    r'^(rclpy|rcl_interfaces|builtin_interfaces|tf2_ros|std_srvs|\w+_msgs|launch\w*|ament_index_python)$'
)
# Basenames of several modules that belong to one concept.
SHARED_BASENAMES = {
    'controller': 'the controller, and the node that runs it',
    'emulator': 'the emulator, and the command that starts it',
    'fault_injection': 'faults injected into the twin, and into the emulated board',
    'localizer': 'the localizer, and the node that runs it',
    'player': 'the playback of bags, and the node that plays them',
}
MAX_CLOSURE = 42
"""Maximum number of modules of the package that the controller node imports."""


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def _nodes(path: Path) -> list[ast.AST]:
    return [*ast.walk(_tree(path))]


@cache
def _imports(path: Path, *, lazy: bool = True) -> frozenset[str]:
    """Return the imported modules; without ``lazy`` only those imported at import time."""
    found = set()
    pending: list[ast.AST] = [_tree(path)]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.expr):
            continue  # it imports nothing
        if not lazy and (
            isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) or _is_type_checking(node)
        ):
            continue
        pending.extend(ast.iter_child_nodes(node))
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{path}: relative import'
            found.add(node.module or '')
            if (node.module or '').split('.')[0] == 't3mpc_ros':
                found |= {f'{node.module}.{name.name}' for name in node.names}
    return frozenset(found)


def _is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) == 'TYPE_CHECKING'


def _package(path: Path) -> str:
    """Return the package or the module directly below ``t3mpc_ros`` that holds a file."""
    part = path.relative_to(PACKAGE).parts[0]
    return '' if part == '__init__.py' else part.removesuffix('.py')


def _module_file(module: str) -> Path | None:
    """Return the file of a module of the package, None if the name is no module."""
    path = ROOT.joinpath(*module.split('.'))
    files = (path / '__init__.py', path.with_suffix('.py'))
    return next((file for file in files if file.is_file()), None)


def _closure(module: str) -> set[str]:
    """Return the modules of the package that importing a module imports, with itself."""
    found: set[str] = set()
    pending = [module]
    while pending:
        name = pending.pop()
        file = _module_file(name)
        if not name.startswith('t3mpc_ros') or name in found or file is None:
            continue
        found.add(name)
        pending += [name.rpartition('.')[0], *_imports(file, lazy=False)]
    return found


def test_a_replay_imports_neither_report_nor_methods():
    """The report and the training recompute with it what a bag lacks: they import the replay."""
    above = {'bag_report', 'training', 'tuning', 'methods', 'patrol', 'paper'}
    for path in PACKAGE.joinpath('evaluation', 'process_replay').glob('*.py'):
        for module in set().union(*map(_closure, _imports(path))):
            package, *rest = module.split('.')[1:] or ['']
            assert package != 'evaluation' or not above & {*rest[:1]}, f'{path} needs {module}'


def test_imports_follow_the_direction_of_the_packages():
    for path in SOURCES:
        _check_imports(path)


def _check_imports(path):
    package = _package(path)
    for name in _imports(path):
        top, *rest = name.split('.')
        if top == 't3mpc_ros':
            if rest and rest[0] in PACKAGES:
                allowed = PACKAGES[package] | {package} if package else FRONT
                assert rest[0] in allowed | {'version'}, f'{path} imports {rest[0]}'
        elif ROS.match(top):
            assert package == 'nodes', f'{path} imports {name}: only nodes/ may import ROS'
        else:
            allowed = set(sys.stdlib_module_names) | {'numpy'} | LIBRARIES.get(package, set())
            assert top in allowed, f'{path} imports {name}'


def test_the_engine_does_not_import_its_interface():
    interface = PACKAGE / 'evaluation' / 'api'
    inside = PACKAGE.joinpath('evaluation').rglob('*.py')
    for path in (each for each in inside if interface not in each.parents):
        names = {name.removeprefix('t3mpc_ros.evaluation.') for name in _imports(path)}
        assert not [name for name in names if name.split('.')[0] == 'api'], path
        assert not names & {'pyarrow', 'pyarrow.parquet', 'distributed'}, path


def test_no_module_imports_the_root_package():
    assert [path for path in SOURCES if 't3mpc_ros' in _imports(path)] == []


def test_only_the_serial_port_of_the_radio_imports_pyserial():
    users = [path for path in SOURCES if 'serial' in _imports(path)]
    assert users == [PACKAGE / 'radio' / 'serial_port.py']


def test_the_table_of_packages_is_complete():
    packages = {path.name for path in PACKAGE.iterdir() if (path / '__init__.py').exists()}
    modules = {path.stem for path in PACKAGE.glob('*.py')} - {'__init__'}
    assert packages | modules == set(PACKAGES)


def test_the_controller_node_imports_few_modules():
    closure = _closure('t3mpc_ros.nodes.controller')
    assert len(closure) <= MAX_CLOSURE, '\n'.join(sorted(closure))


def test_a_module_basename_has_one_meaning():
    paths = defaultdict(list)
    for path in SOURCES:
        if path.name != '__init__.py':
            paths[path.stem].append(str(path.relative_to(PACKAGE)))
    repeated = {stem: found for stem, found in paths.items() if len(found) > 1}
    unknown = {stem: found for stem, found in repeated.items() if stem not in SHARED_BASENAMES}
    assert not unknown
    assert set(SHARED_BASENAMES) == set(repeated), 'an entry of the list is not needed'


def test_package_init_files_hold_a_docstring_only():
    for path in SOURCES:
        if path.name == '__init__.py' and path.parent != PACKAGE:
            body = _tree(path).body
            assert len(body) == 1, path
            assert isinstance(body[0], ast.Expr), path


def test_tests_mirror_the_packages():
    """Folders of ``test/`` are packages, the firmware, or helpers; basenames are unique."""
    folders = {path.name for path in TESTS.iterdir() if path.is_dir()}
    known = set(PACKAGES) | {'firmware', 'golden', 'support', '__pycache__'}
    assert folders - known == set()
    names = [path.name for path in TESTS.rglob('test_*.py')]
    assert len(names) == len(set(names))


def test_no_private_name_of_a_library_is_used():
    """Six classes of the kernels were built on the inside of numba, which any release may change.

    Sees what is imported and what is read from it, not attributes of a library's objects.
    """
    found = {path: _private_names(_nodes(path)) for path in SOURCES}
    assert {path: names for path, names in found.items() if names} == {}


def _private_names(nodes: Sequence[ast.AST]) -> set[str]:
    """Return the private names of libraries that are imported or read from what is imported."""
    names, imported = set(), {}
    for node in nodes:
        if isinstance(node, ast.Import | ast.ImportFrom):
            module = f'{node.module}.' if isinstance(node, ast.ImportFrom) else ''
            for name in node.names:
                names.add(module + name.name)
                # Without a new name, import a.b binds a.
                top = name.name if module or name.asname else name.name.split('.')[0]
                imported[name.asname or top] = module + top
    for node in nodes:
        parts = []
        while isinstance(node, ast.Attribute):
            parts.append(node.attr)
            node = node.value
        if parts and isinstance(node, ast.Name) and node.id in imported:
            names.add('.'.join([imported[node.id], *reversed(parts)]))
    return {name for name in names if _is_private(name)}


def _is_private(name: str) -> bool:
    first, *parts = name.split('.')
    if first in sys.stdlib_module_names | {'t3mpc_ros'}:
        return False
    internal = first == 'numba' and parts[:1] == ['core']
    return internal or any(re.match('_(?!_)', part) for part in parts)


def test_no_test_imports_another_test():
    words = re.compile(r'^ *(?:from|import) +test[._]\w+.*', re.MULTILINE)
    found = {path: words.findall(path.read_text()) for path in TESTS.rglob('*.py')}
    assert {path: lines for path, lines in found.items() if lines} == {}


def test_the_core_of_the_firmware_has_no_circle():
    """Requests and telemetry needed the robot, which needed both."""
    users = defaultdict(set)
    for path in (ROOT / 'firmware' / 'core').glob('*.[ch]'):
        included = re.findall(r'#include "(\w+)\.h"', path.read_text())
        users[path.stem] |= {*included} - {path.stem}
    assert list(TopologicalSorter(users).static_order())


def test_names_of_tests_have_at_most_60_characters():
    for path in TESTS.rglob('test_*.py'):
        for name in re.findall(r'^ *def (test_\w+)', path.read_text(), re.MULTILINE):
            assert len(name) <= 60, f'{path}: {name}'


def test_the_tests_that_ci_names_exist():
    """One that had moved ended a run of 20 minutes with no test."""
    text = (ROOT / '.ci' / 'run').read_text()
    names = re.search(r'affected=\((.*?)\)', text, re.DOTALL)[1].replace('\n', ' ')
    listed = subprocess.check_output(['bash', '-c', f"printf '%s\\n' {names}"], text=True).split()
    assert len(listed) > 10
    assert [name for name in listed if not (ROOT / name).exists()] == []


def test_functions_have_at_most_12_parameters():
    for path in SOURCES:
        for node in _nodes(path):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                names = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
                assert len(names) <= 12, f'{path}: {node.name} has {len(names)} parameters'


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
            if ROS.match(top):
                package = {'tf2_ros': 'tf2_ros_py'}.get(top, top)
                assert package in declared, f'{path.name} imports {top}, absent in package.xml'


def test_package_xml_names_the_rosdep_keys_of_the_libraries():
    """Without them ``rosdep install`` left every node without its libraries."""
    text = (ROOT / 'package.xml').read_text()
    keys = {
        'numpy': 'python3-numpy',
        'yaml': 'python3-yaml',
        'serial': 'python3-serial',
        'matplotlib': 'python3-matplotlib',
        'PIL': 'python3-pil',
        'jinja2': 'python3-jinja2',
        'tqdm': 'python3-tqdm',
        'mcap': 'mcap-ros2-support',
        'rosbags': 'python3-rosbags-pip',
    }
    for key in keys.values():
        assert f'<exec_depend>{key}</exec_depend>' in text
    # Those without a key that fits are installed by the line of the README for apt ROS 2.
    readme = (ROOT / 'README.md').read_text()
    (line,) = re.findall(r'^.*pip install .*numba.*$', readme, re.MULTILINE)
    for library in {'numba', 'cma', 'daqp'}:
        assert REQUIREMENTS[library] in line
    assert set(REQUIREMENTS) - set(keys) == {
        'numba',
        'cma',
        'daqp',
        'lz4',
        'zstandard',
        'shtab',
        'casadi',
        'pyarrow',
        'distributed',
        'gymnasium',
    }


def test_no_global_random_numbers_and_no_clock_in_libraries():
    """Seeds are explicit and time is an argument, except in programs and at a serial port."""
    clock = re.compile(
        r'\btime\.(time|monotonic|perf_counter|sleep)|datetime\.now|np\.random\.(?!Gen|def|SeedS)'
    )
    exempt = {'emulator/pty_port.py', 'radio/tool/procedure.py'}
    for path in SOURCES:
        name = str(path.relative_to(PACKAGE))
        if _package(path) not in ('nodes', 'cli') and name not in exempt:
            assert not clock.search(path.read_text()), f'{name} reads a clock or global state'


def test_every_yaml_of_config_fits_its_node():
    from t3mpc_ros.nodes.registry import parameter_class

    files = sorted((ROOT / 'config').glob('*.yaml'))
    assert files
    for path in files:
        for node, content in yaml.safe_load(path.read_text()).items():
            parameters = parameter_class(node.rsplit('/', 1)[-1])
            parameters.from_dict(_flat(content['ros__parameters']))


def _flat(tree: dict, prefix: str = '') -> dict:
    result = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            result |= _flat(value, f'{prefix}{key}.')
        else:
            result[f'{prefix}{key}'] = value
    return result


def test_the_processes_of_a_study_load_no_matplotlib():
    """They draw nothing; it costs each a third of a second, and a cluster may lack it."""
    studies = (
        'comparison', 'fault_outcomes', 'patrol.patrol_comparison',
        'patrol.path_tracker_comparison', 'patrol.safety_study', 'api.parameter_sweep',
    )  # fmt: skip
    names = ', '.join(f't3mpc_ros.evaluation.{name}' for name in studies)
    code = f'import sys, {names}; print("matplotlib" in sys.modules)'
    assert subprocess.check_output([sys.executable, '-c', code], text=True, cwd=ROOT) == 'False\n'


def test_no_file_carries_a_path_of_a_machine_or_a_registry_host():
    words = re.compile(
        r'/(work|root|home|farm|tmp)/[a-z]|https?://[^\s]*(pypi|pythonhosted|npmjs|crates)'
    )
    for path in _files(ROOT):
        if path.suffix in ('.png', '.gif', '.pyc', '.mcap', '.npz'):
            continue
        if path == Path(__file__).resolve():
            continue
        assert not words.search(path.read_text(errors='replace')), path


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder, but those that are hidden or made by a build or a run."""
    made = 'build', 'install', 'log', 'runs', 'node_modules'
    for path in folder.iterdir():
        if path.name in made or (path.name.startswith('.') and path.name != '.ci'):
            continue
        if path.is_dir():
            yield from _files(path)
        elif path.is_file():
            yield path
