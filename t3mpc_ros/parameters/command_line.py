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
"""Parse parameters (``NAME=VALUE``) and bounded numbers given on a command line."""

from argparse import ArgumentTypeError
import ast
from collections.abc import Callable, Iterable
import os
from pathlib import Path
from typing import TypeVar

from t3mpc_ros.parameters.table import ParameterError, Parameters

N = TypeVar('N', int, float)

_BOOLEANS = {'true': 'True', 'false': 'False'}
"""ROS and YAML spelling, and Python's."""


def parse_assignments(table: type[Parameters], texts: Iterable[str]) -> dict[str, object]:
    """Return values by name, for :meth:`Parameters.from_dict`, which validates them.

    The value of a text parameter stays text, even if it looks like a number. Unknown names are
    kept; :meth:`Parameters.from_dict` rejects them. ParameterError: an argument is not
    ``NAME=VALUE``.
    """
    constants = table.class_constants()
    text_parameters = {spec.name for spec in table.specs() if spec.kind is str and not spec.many}
    text_parameters |= {name for name in constants if isinstance(constants[name], str)}
    values: dict[str, object] = {}
    for text in texts:
        name, sign, value = text.partition('=')
        if not sign or not name:
            raise ParameterError(f'--set must be NAME=VALUE: got {text!r}')
        if name in values:
            raise ParameterError(f'--set must name each parameter once: got {name} again')
        values[name] = value if name in text_parameters else parsed_value(value)
    return values


def parsed_value(text: str) -> object:
    """Return the Python literal that ``text`` spells, else ``text``."""
    try:
        return ast.literal_eval(_BOOLEANS.get(text, text))
    except (SyntaxError, ValueError):
        return text


def bounded_float(low: float, high: float, unit: str = '') -> Callable[[str], float]:
    """Return an argparse type that accepts a number from ``low`` to ``high``."""
    return _bounded(float, low, high, unit)


def bounded_int(low: int, high: int) -> Callable[[str], int]:
    """Return an argparse type that accepts a whole number from ``low`` to ``high``."""
    return _bounded(int, low, high, '')


def _bounded(kind: type[N], low: float, high: float, unit: str) -> Callable[[str], N]:
    bounds = f'from {low:.10g} to {high:.10g}' + (f' {unit}' if unit else '')

    def parse(text: str) -> N:
        value = kind(text)
        if not low <= value <= high:
            raise ArgumentTypeError(f'must be {bounds}: got {text}')
        return value

    parse.__name__ = 'number'  # argparse: "invalid number value: 'x'"
    return parse


def check_writable(path: Path) -> None:
    """Raise ParameterError if a file cannot be written: before the work whose result it takes."""
    target = path if path.exists() else path.parent
    if path.is_dir() or not path.parent.is_dir() or not os.access(target, os.W_OK):
        raise ParameterError(f'{path} cannot be written: give a file in a folder that exists')
