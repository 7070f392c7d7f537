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
"""Launch files without ROS's launch, which exists from apt only: substitutes, and a launcher.

``python -m support.launch_files FILE name:=value ...`` stands for ``ros2 launch``: it runs the
installed launch, if there is one, else it starts the processes that the file describes.
"""

from contextlib import contextmanager
from dataclasses import dataclass
import importlib.util
from pathlib import Path
import runpy
import signal
import subprocess
import sys
import tempfile
import time
import types
from unittest import mock

from ament_index_python import packages
import numpy  # noqa: F401  (not within the substitutes: it cannot be imported twice)
import yaml

from t3mpc_ros.cli.process_group import executable

HELPER = 't3mpc_ros.nodes.launch_files'


CLASSES = {
    'launch': ['LaunchDescription', 'LaunchContext'],
    'launch.actions': ['DeclareLaunchArgument', 'OpaqueFunction'],
    'launch_ros': [],
    'launch_ros.actions': ['Node'],
    'launch_ros.parameter_descriptions': ['ParameterValue'],
}
"""Classes of the launch packages, which the substitutes replace."""


class Recorded:
    """Replaces a class of the launch packages; stores the arguments."""

    def __init__(self, *arguments, **named):
        self.arguments = arguments
        self.named = named


@contextmanager
def _substitutes(share):
    modules = {}
    for name, classes in CLASSES.items():
        modules[name] = types.ModuleType(name)
        vars(modules[name]).update({each: type(each, (Recorded,), {}) for each in classes})
    with mock.patch.dict(sys.modules, modules):
        sys.modules.pop(HELPER, None)
        found = packages.get_package_share_directory
        with mock.patch.object(
            packages, 'get_package_share_directory', lambda name: str(share or found(name))
        ):
            yield


@dataclass(frozen=True)
class LaunchedNode:
    """A node of a launch file; ``parameters`` are files and dictionaries, later ones stronger."""

    executable: str
    name: str
    namespace: str
    parameters: list
    remappings: list
    ros_arguments: list

    @property
    def values(self):
        """Parameters that do not come from a file."""
        return {
            name: value
            for level in self.parameters
            if isinstance(level, dict)
            for name, value in level.items()
        }

    @property
    def all_values(self):
        """Parameters with those of the files."""
        merged = {}
        for level in self.parameters:
            if isinstance(level, dict):
                merged |= level
                continue
            for key, entry in yaml.safe_load(Path(level).read_text()).items():
                if key.rpartition('/')[2] == self.name:
                    merged |= dict(_flat(entry['ros__parameters']))
        return merged


def _flat(tree, prefix=''):
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flat(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


def _value(given):
    if isinstance(given, Recorded):  # a ParameterValue
        return given.named['value_type'](given.arguments[0])
    # launch reads a bare text as YAML.
    return yaml.safe_load(given) if isinstance(given, str) else given


def arguments_of(file, share=None):
    """Return the arguments of a launch file as name: (default, choices)."""
    return {
        item.arguments[0]: (item.named['default_value'], item.named.get('choices'))
        for item in _items(file, share)
        if 'default_value' in item.named
    }


def _items(file, share):
    with _substitutes(share):
        return runpy.run_path(str(file))['generate_launch_description']().arguments[0]


def nodes_of(file, given=None, share=None):
    """Return the nodes of a launch file for given arguments.

    ``share`` is the share directory of the package; None: that of the installed one.
    """
    given = dict(given or {})
    items = _items(file, share)
    with _substitutes(share):
        values = {}
        for item in items:
            if 'default_value' in item.named:
                name = item.arguments[0]
                values[name] = given.pop(name, item.named['default_value'])
                assert values[name] in item.named.get('choices', [values[name]]), name
        assert not given, f'unknown launch arguments: {given}'
        context = types.SimpleNamespace(launch_configurations=values)
        made = [
            node
            for item in items
            if 'function' in item.named
            for node in item.named['function'](context)
        ]
    for node in made:
        own = 'robot_state_publisher' if 'state' in node.named['executable'] else 't3mpc_ros'
        assert node.named['package'] == own
    return [
        LaunchedNode(
            node.named['executable'],
            node.named['name'],
            node.named['namespace'],
            [
                {name: _value(value) for name, value in level.items()}
                if isinstance(level, dict)
                else level
                for level in node.named['parameters']
            ],
            node.named.get('remappings', []),
            node.named['ros_arguments'],
        )
        for node in made
    ]


# -- launcher -------------------------------------------------------------------------------------


def _command(node, folder):
    """Return the command line with which launch_ros starts a node."""
    command = [str(executable(node.executable)), '--ros-args', *node.ros_arguments]
    command += ['-r', f'__node:={node.name}']
    if node.namespace:
        command += ['-r', f'__ns:=/{node.namespace}']
    for old, new in node.remappings:
        command += ['-r', f'{old}:={new}']
    for number, level in enumerate(node.parameters):
        file = level
        if isinstance(level, dict):
            file = Path(folder) / f'{node.namespace.replace("/", "_")}_{node.name}_{number}.yaml'
            file.write_text(yaml.safe_dump({'/**': {'ros__parameters': level}}))
        command += ['--params-file', str(file)]
    return command


def _run(nodes):
    """Start the nodes, pass SIGINT on, and print what launch prints about their ends."""
    with tempfile.TemporaryDirectory() as folder:
        running = {}
        stopped = []
        signal.signal(signal.SIGINT, lambda number, frame: stopped.append(number))
        for number, node in enumerate(nodes, 1):
            process = subprocess.Popen(_command(node, folder))
            running[f'{node.executable}-{number}'] = process
            print(f'[INFO] [{node.executable}-{number}]: process started with pid [{process.pid}]')
        sys.stdout.flush()
        while running:
            time.sleep(0.02)
            if stopped:
                stopped.clear()
                for process in running.values():
                    process.send_signal(signal.SIGINT)
            for name, process in list(running.items()):
                if (code := process.poll()) is None:
                    continue
                del running[name]
                if code:
                    text = f'process has died [pid {process.pid}, exit code {code}, cmd '
                    print(f'[ERROR] [{name}]: {text}{process.args}].', flush=True)
                else:
                    text = f'process has finished cleanly [pid {process.pid}]'
                    print(f'[INFO] [{name}]: {text}', flush=True)
    return 0


def main(words):
    """Run a launch file: its path, then ``name:=value``."""
    file, *given = words
    pairs = [tuple(word.split(':=', 1)) for word in given]
    if importlib.util.find_spec('launch_ros') is None:
        return _run(nodes_of(file, dict(pairs)))
    from launch.actions import IncludeLaunchDescription

    from launch import LaunchDescription, LaunchService

    service = LaunchService()
    included = IncludeLaunchDescription(file, launch_arguments=pairs)
    service.include_launch_description(LaunchDescription([included]))
    return service.run()


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
