# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""YAML files that users write: worlds, fault schedules, paths, profiles, settings of a robot."""

import os
from pathlib import Path
import reprlib
from typing import Any

import yaml

MAX_FILE_SIZE = 1_000_000
"""Bytes."""


_ERRORS = yaml.YAMLError, ValueError, TypeError, LookupError, AttributeError, RecursionError
"""Of the parser itself, too: an invalid date, endless brackets, ``!!int`` without digits."""
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 80


class YamlError(ValueError):
    """What is read is not such a file; the text goes on after the name of the file."""


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
        raise YamlError(f'is not YAML: {line}{error.problem}') from error
    except _ERRORS as error:
        raise YamlError(f'is not YAML: {" ".join(str(error).split())}') from error


def shortened(value: object) -> str:
    """Return a value of a file for an error, in 80 characters at most.

    A file of a few lines can hold a list of lists whose whole text has gigabytes.
    """
    text = _SHORT.repr(value)
    return text if len(text) <= 80 else f'{text[:77]}...'


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
