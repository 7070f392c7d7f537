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
"""Command line of the node executables: help, version, parameter files, rejection of the rest."""

from collections.abc import Iterator, Sequence
import enum
import re
import textwrap

from t3mpc_ros.nodes.registry import INTERFACES, NODES, parameter_class
from t3mpc_ros.parameters.table import nearest_name

ROS_ARGUMENTS = (
    ('-p NAME:=VALUE', 'set a parameter'),
    ('--params-file FILE', 'set the parameters of a YAML file'),
    ('-r OLD:=NEW', 'rename a topic or service; -r __ns:=/robot_1 sets the namespace'),
    ('--log-level LEVEL', 'debug, info, warn, error or fatal'),
)
"""The usual arguments after ``--ros-args``."""

_WIDTH = 99


def unknown_arguments(node: str, words: Sequence[str]) -> str:
    """Return why words outside ``--ros-args`` are rejected, or nothing."""
    if not words:
        return ''
    plural = 's' if len(words) > 1 else ''
    return (
        f'unknown argument{plural} {" ".join(words)}: parameters are set with '
        f'--ros-args -p NAME:=VALUE{_hint(node, words[0])} (--help lists them)'
    )


def _hint(node: str, word: str) -> str:
    """Return the parameter that an argument such as ``--gain`` may mean."""
    wanted = word.lstrip('-').partition('=')[0].rstrip(':').replace('-', '_')
    near = nearest_name(wanted, [spec.name for spec in parameter_class(node).specs()])
    return f', for example -p {near}:=...' if near else ''


def help_text(node: str) -> str:
    """Return usage, topics, services and parameters of a node."""
    interface = INTERFACES[node]
    lines = [
        f'usage: ros2 run t3mpc_ros {node} [--help] [--version] [--ros-args ARGUMENT ...]',
        '',
        interface.summary,
        '',
    ]
    for title in ('subscribes', 'publishes', 'services'):
        names: tuple[str, ...] = getattr(interface, title)
        lines += _wrapped(f'{title:<12}', ', '.join(names) or 'none')
    lines += ['', 'arguments after --ros-args:']
    lines += [f'  {argument:<20}{text}' for argument, text in ROS_ARGUMENTS]
    lines += ['', 'parameters, with default and range (* can be set while the node runs):']
    for spec in parameter_class(node).specs():
        default = spec.default_text() or '(empty)'
        bounds = f', {spec.bounds_text()}' if spec.bounds_text() else ''
        mark = '*' if spec.dynamic else ' '
        lines += [
            *_wrapped(f'{mark} {spec.name} = ', default + bounds),
            *_wrapped('      ', spec.text),
        ]
    return '\n'.join(lines)


def _wrapped(head: str, text: str) -> list[str]:
    indent = ' ' * (12 if len(head) == 12 else 6)
    return textwrap.wrap(
        text, _WIDTH, initial_indent=head, subsequent_indent=indent, break_long_words=False
    )


def parameter_file_problem(argv: Sequence[str]) -> str:
    """Return why a ``--params-file`` of the command line is unusable; empty if usable."""
    from t3mpc_ros.parameters.yaml_loader import YamlError, read_yaml

    for name in _parameter_files(argv):
        try:
            content = read_yaml(name)
        except YamlError as error:
            return f'the parameter file {name} {error}'
        if not isinstance(content, dict):
            return (
                f'the parameter file {name} must hold "<node>: ros__parameters: ...": got nothing'
            )
    return ''


def unmatched_files(argv: Sequence[str], nodes: Sequence[str]) -> list[str]:
    """Return a warning for each parameter file that matches none of the nodes of the process.

    A file for other nodes of the package is no mistake: launch files pass one to every node.
    """
    names = [name.rpartition('/')[2] for name in nodes]
    problems = []
    for file in _parameter_files(argv):
        keys = list(dict.fromkeys(key for key, _, _ in _entries(file)))
        matched = any(_key_pattern(key).fullmatch(node) for key in keys for node in nodes)
        others = set(NODES) - set(names)
        if matched or (keys and all(key.rpartition('/')[2] in others for key in keys)):
            continue
        problems.append(
            f'the parameter file {file} sets nothing: its keys {", ".join(keys) or "(none)"} do '
            f'not match {", ".join(nodes)}'
        )
    return problems


def _parameter_files(argv: Sequence[str]) -> list[str]:
    return [
        name for flag, name in zip(argv, list(argv)[1:], strict=False) if flag == '--params-file'
    ]


class Origin(enum.IntEnum):
    """Where the value of a parameter comes from; a larger one is meant more for this node."""

    SHARED = 1
    """The section of a parameter file for nodes of any name, as ``/**``."""
    SECTION = 2
    """The section of a parameter file for this node, or ``-p NODE:NAME:=VALUE``."""
    OPTION = 3
    """``-p NAME:=VALUE``: for all nodes of the process."""


_OPTION = re.compile(r'(?:(?P<node>[^:=]+):)?(?P<name>[^:=]+):=')


def parameter_origins(argv: Sequence[str], node: str) -> dict[str, Origin]:
    """Return the origin of each parameter that a command line sets at ``/namespace/name``."""
    found: dict[str, Origin] = {}

    def add(name: str, origin: Origin) -> None:
        found[name] = max(found.get(name, origin), origin)

    for flag, word in zip(argv, list(argv)[1:], strict=False):
        if flag in ('-p', '--param') and (given := _OPTION.match(word)):
            add(given['name'], Origin.SECTION if given['node'] else Origin.OPTION)
    for file in _parameter_files(argv):
        for key, name, _ in _entries(file):
            if _key_pattern(key).fullmatch(node):
                shared = '*' in key.rpartition('/')[2]
                add(name, Origin.SHARED if shared else Origin.SECTION)
    return found


def file_values(file: str, node: str) -> dict[str, object]:
    """Return the parameters by name that a valid parameter file sets at ``/namespace/name``."""
    return {
        name: value
        for key, name, value in _entries(file)
        if name and _key_pattern(key).fullmatch(node)
    }


def _entries(file: str) -> Iterator[tuple[str, str, object]]:
    """Yield node, parameter and value; namespaces may be nested keys, as groups are."""
    from t3mpc_ros.parameters.yaml_loader import read_yaml  # a missing library has a remedy

    def leaves(tree: object, path: tuple[str, ...]) -> Iterator[tuple[str, str, object]]:
        if isinstance(tree, dict) and tree:
            for key, value in tree.items():
                yield from leaves(value, (*path, str(key)))
        elif 'ros__parameters' in path:
            at = path.index('ros__parameters')
            node = ''.join(f'/{part.strip("/")}' for part in path[:at])
            yield node, '.'.join(path[at + 1 :]), tree

    yield from leaves(read_yaml(file), ())


def _key_pattern(key: str) -> 're.Pattern[str]':
    """Return the pattern of a node name: ``*`` is one part of it, ``**`` any number."""
    text = re.escape(key).replace(r'/\*\*', '(/[^/]+)*').replace(r'\*', '[^/]+')
    return re.compile(text)
