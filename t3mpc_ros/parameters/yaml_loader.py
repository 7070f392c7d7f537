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
"""YAML files that users write: worlds, fault schedules, paths, profiles, settings of a robot."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import os
from pathlib import Path
import reprlib
from types import MappingProxyType
from typing import Any

import yaml

from t3mpc_ros.parameters.table import nearest_hint, number_hint

MAX_FILE_SIZE = 1_000_000
"""Bytes."""


_ERRORS = yaml.YAMLError, ValueError, TypeError, LookupError, AttributeError, RecursionError
"""Of the parser itself, too: an invalid date, endless brackets, ``!!int`` without digits."""
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 80


class YamlError(ValueError):
    """What is read is not such a file; the text goes on after the name of the file."""


class EntryError(ValueError):
    """An invalid value in a file; the text has its key, the bound and the value."""


@contextmanager
def file_errors(name: object, kind: type[Exception]) -> Iterator[None]:
    """Raise errors of this module as ``kind``, with the name of the file in front."""
    try:
        yield
    except EntryError as error:
        raise kind(f'{name}: {error}') from error
    except YamlError as error:
        raise kind(f'{name} {error}') from error


def read_yaml(path: str | os.PathLike[str]) -> object:
    """Return the content of a YAML file in UTF-8, in whatever locale.

    YamlError: also for more than :data:`MAX_FILE_SIZE` bytes.
    """
    return parse_yaml(read_text(path))


def read_text(path: str | os.PathLike[str], max_size: int = MAX_FILE_SIZE) -> str:
    """Return the text of a file in UTF-8; errors as of :func:`read_yaml`."""
    try:
        with Path(path).open('rb') as file:
            content = file.read(max_size + 1)
        if len(content) > max_size:
            raise YamlError(f'must have at most {max_size} bytes: it has more')
        return content.decode('utf-8')
    except OSError as error:
        raise YamlError(f'cannot be read: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise YamlError(f'must be UTF-8 text: {error}') from error


def parse_yaml(text: str) -> object:
    """Return the content of a YAML text; an empty one is None.

    YamlError: it is not YAML, or gives a key twice in one entry.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f'line {error.problem_mark.line + 1}: ' if error.problem_mark else ''
        hint = '; indent with spaces' if "'\\t'" in str(error.problem) else ''
        raise YamlError(f'is not YAML: {line}{error.problem}{hint}') from error
    except _ERRORS as error:
        raise YamlError(f'is not YAML: {" ".join(str(error).split())}') from error


def parameter_file(
    title: str,
    nodes: Mapping[str, Mapping[str, object]],
    comments: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Return a ROS parameter file: values by node and name, and comments by name."""
    content = {node: {'ros__parameters': dict(values)} for node, values in nodes.items()}
    lines = [f'# {title}']
    for line in yaml.dump(content, Dumper=_Dumper, sort_keys=False, width=1000).splitlines():
        comment = comments.get(line.partition(':')[0].strip())
        lines.append(f'{line}  # {comment}' if comment else line)
    return '\n'.join([*lines, ''])


class PlainDumper(yaml.SafeDumper):
    """Repeats equal values in place of aliases, which the parser of ROS does not know."""

    def ignore_aliases(self, data: object) -> bool:
        """Return True: no value has an alias."""
        return True


class _Dumper(PlainDumper):
    """Writes what the parser of ROS reads: to it 12345e6789 is a number."""


def _represent_text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    style = "'" if text[:1].isdigit() else None
    return dumper.represent_scalar('tag:yaml.org,2002:str', text, style)


def _represent_list(dumper: yaml.SafeDumper, values: list[object]) -> yaml.SequenceNode:
    return dumper.represent_sequence('tag:yaml.org,2002:seq', values, flow_style=True)


_Dumper.add_representer(str, _represent_text)
_Dumper.add_representer(list, _represent_list)


def shortened(value: object) -> str:
    """Return a value of a file for an error, in 80 characters at most.

    A file of a few lines can hold a list of lists whose whole text has gigabytes.
    """
    text = _SHORT.repr(value)
    return text if len(text) <= 80 else f'{text[:77]}...'


def check_entry(
    content: object, where: str, needed: tuple[str, ...], optional: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Return a mapping that has the needed keys, and no others than these and the optional."""
    known = (*needed, *optional)
    if not isinstance(content, dict):
        raise EntryError(f'{where} must hold {", ".join(known)} by name: got {shortened(content)}')
    for name in content:
        if name not in known:
            near = nearest_hint(str(name), known) or f'; known are {", ".join(known)}'
            raise EntryError(f'{where} has no {shortened(name)}{near}')
    for name in needed:
        if name not in content:
            raise EntryError(f'{where} must have {name}: got {shortened(content)}')
    return content


def check_list(content: object, where: str, least: int = 0, most: int | None = None) -> list[Any]:
    """Return a list of ``least`` to ``most`` entries."""
    if not isinstance(content, list):
        raise EntryError(f'{where} must be a list: got {shortened(content)}')
    if len(content) < least or (most is not None and len(content) > most):
        span = f'{least}' if least == most else f'from {least} to {most}'
        raise EntryError(f'{where} must have {span} entries: got {len(content)}')
    return content


def check_number(content: object, where: str, low: float, high: float, unit: str = '') -> float:
    """Return a number from ``low`` to ``high``."""
    bounds = f'{where} must be a number from {low:g} to {high:g} {unit}'.rstrip()
    if isinstance(content, bool) or not isinstance(content, int | float):
        raise EntryError(f'{bounds}: got {shortened(content)}{number_hint(content)}')
    if not low <= content <= high:  # false for NaN, too
        raise EntryError(f'{bounds}: got {shortened(content)}')
    return float(content)


def check_flag(content: object, where: str) -> bool:
    """Return true or false."""
    if not isinstance(content, bool):
        raise EntryError(f'{where} must be true or false: got {shortened(content)}')
    return content


class _Loader(yaml.SafeLoader):
    """Rejects a duplicate key, of which YAML would silently keep the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        seen: set[str] = set()
        for key in (key for key, _ in pairs if isinstance(key, yaml.ScalarNode)):
            if key.value in seen:
                problem = (
                    f'{key.value} is given twice in one entry; a new entry of a list begins '
                    'with "- "'
                )
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)
