# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parse parameters (``NAME=VALUE``) and bounded numbers given on a command line."""

from argparse import ArgumentTypeError
import ast
from collections.abc import Callable, Iterable
from typing import TypeVar

from t3mpc_ros.parameters.table import ParameterError, Parameters

N = TypeVar('N', int, float)

_BOOLEANS = {'true': 'True', 'false': 'False'}
"""Parameters are written so elsewhere, and Python writes them otherwise."""


def parse_assignments(table: type[Parameters], texts: Iterable[str]) -> dict[str, object]:
    """Return values by name for :meth:`Settings.from_flat`, which checks them.

    What the table has as text stays text, even if it looks like a number; an unknown name is left
    to be refused.

    Raises
    ------
    ParameterError
        A text is not ``NAME=VALUE``.
    """
    texts_only = {row.name for row in table.specs() if row.kind is str and not row.many}
    found: dict[str, object] = {}
    for text in texts:
        name, sign, value = text.partition('=')
        if not sign or not name:
            raise ParameterError(f'--set must be NAME=VALUE: got {text!r}')
        found[name] = value if name in texts_only else _parse_value(value)
    return found


def _parse_value(text: str) -> object:
    """Return what a text stands for, else the text."""
    try:
        return ast.literal_eval(_BOOLEANS.get(text, text))
    except (SyntaxError, ValueError):
        return text


def bounded_float(low: float, high: float, unit: str = '') -> Callable[[str], float]:
    """Return what reads a number from ``low`` to ``high`` off a command line, for argparse."""
    return _bounded(float, low, high, unit)


def bounded_int(low: int, high: int) -> Callable[[str], int]:
    """Return what reads a whole number from ``low`` to ``high`` off a command line."""
    return _bounded(int, low, high, '')


def _bounded(kind: type[N], low: float, high: float, unit: str) -> Callable[[str], N]:
    bounds = f'from {low:.10g} to {high:.10g}' + (f' {unit}' if unit else '')

    def read(text: str) -> N:
        value = kind(text)
        if not low <= value <= high:
            raise ArgumentTypeError(f'must be {bounds}: got {text}')
        return value

    read.__name__ = 'number'  # argparse: "invalid number value: 'x'"
    return read
