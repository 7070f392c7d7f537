# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parameters of other nodes: description and values, changes, and set requests."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
import re
import sys
from typing import Any, TypeVar

from rcl_interfaces.msg import Parameter, ParameterDescriptor, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.task import Future

T = TypeVar('T')

_UNIT = re.compile(r' \[([^\]]+)\](?=$| \()')
"""Unit at the end of a description; a source may follow in parentheses."""
_RANGE_KINDS = {
    ParameterType.PARAMETER_INTEGER: 'integer_range',
    ParameterType.PARAMETER_DOUBLE: 'floating_point_range',
}
_FIELDS = {
    ParameterType.PARAMETER_BOOL: 'bool_value',
    ParameterType.PARAMETER_INTEGER: 'integer_value',
    ParameterType.PARAMETER_DOUBLE: 'double_value',
    ParameterType.PARAMETER_STRING: 'string_value',
    ParameterType.PARAMETER_BOOL_ARRAY: 'bool_array_value',
    ParameterType.PARAMETER_INTEGER_ARRAY: 'integer_array_value',
    ParameterType.PARAMETER_DOUBLE_ARRAY: 'double_array_value',
    ParameterType.PARAMETER_STRING_ARRAY: 'string_array_value',
}
TYPE_NAMES = {
    ParameterType.PARAMETER_BOOL: 'bool',
    ParameterType.PARAMETER_INTEGER: 'int',
    ParameterType.PARAMETER_DOUBLE: 'float',
    ParameterType.PARAMETER_STRING: 'str',
    ParameterType.PARAMETER_BOOL_ARRAY: 'list of bool',
    ParameterType.PARAMETER_INTEGER_ARRAY: 'list of int',
    ParameterType.PARAMETER_DOUBLE_ARRAY: 'list of float',
    ParameterType.PARAMETER_STRING_ARRAY: 'list of str',
}


class RemoteParameters:
    """Parameters of one other node; every answer arrives through a callback.

    Parameters
    ----------
    node
        Node that asks; an executor spins it.
    name
        Full name of the other node.
    """

    def __init__(self, node: Node, name: str) -> None:
        self.name = name
        self._node = node
        self._clients: dict[str, Client] = {
            word: node.create_client(kind, f'{name}/{word}')
            for word, kind in (
                ('list_parameters', ListParameters),
                ('describe_parameters', DescribeParameters),
                ('get_parameters', GetParameters),
                ('set_parameters', SetParameters),
            )
        }
        self._types: dict[str, int] = {}

    def destroy(self) -> None:
        """Destroy the clients."""
        for client in self._clients.values():
            self._node.destroy_client(client)

    def ready(self) -> bool:
        """Return whether all services of the other node are there."""
        return all(client.service_is_ready() for client in self._clients.values())

    def read(self, found: Callable[[Sequence[Mapping[str, Any]]], None]) -> None:
        """Ask for all parameters; ``found`` gets one row each, see :func:`parameter_row`."""

        def described(names: list[str], answer: Any) -> None:
            descriptors = answer.descriptors
            self._types = {each.name: each.type for each in descriptors}
            request = GetParameters.Request(names=names)
            self._call('get_parameters', request, partial(valued, descriptors))

        def valued(descriptors: list[ParameterDescriptor], answer: Any) -> None:
            found([parameter_row(*pair) for pair in zip(descriptors, answer.values, strict=False)])

        def listed(answer: Any) -> None:
            names = sorted(answer.result.names)
            request = DescribeParameters.Request(names=names)
            self._call('describe_parameters', request, partial(described, names))

        self._call('list_parameters', ListParameters.Request(), listed)

    def set(self, name: str, value: Any, done: Callable[[str], None]) -> None:
        """Ask the node to set a parameter; ``done`` gets the reason of a refusal, or nothing.

        Raises
        ------
        ValueError
            The node has no such parameter, or the value cannot be one of its type.
        """
        if name not in self._types:
            raise ValueError(f'{self.name} has no parameter {name}')
        kind = self._types[name]
        message = ParameterValue(type=kind, check_fields=True)
        try:
            setattr(message, _FIELDS[kind], _converted(kind, value))
        except (AssertionError, TypeError, ValueError):
            raise ValueError(f'{name} must be {TYPE_NAMES[kind]}: got {value!r}') from None
        request = SetParameters.Request(parameters=[Parameter(name=name, value=message)])

        def answered(answer: Any) -> None:
            (result,) = answer.results
            done('' if result.successful else result.reason or 'refused without a reason')

        self._call('set_parameters', request, answered)

    def _call(self, word: str, request: Any, done: Callable[[Any], None]) -> None:
        def finish(future: Future) -> None:
            if (answer := future.result()) is not None:
                done(answer)

        self._clients[word].call_async(request).add_done_callback(finish)


def parameter_row(descriptor: ParameterDescriptor, value: ParameterValue) -> Mapping[str, Any]:
    """Return name, type, value, unit, low, high, text, choices and dynamic of a parameter.

    Units and choices are those that the nodes of this package write into their descriptions;
    bounds are None where there are none.
    """
    text, unit = descriptor.description, ''
    if match := _UNIT.search(text):
        text, unit = text[: match.start()] + text[match.end() :], match[1]
    low = high = None
    for bound in getattr(descriptor, _RANGE_KINDS.get(descriptor.type, ''), ()):
        low, high = (
            None if abs(each) >= limit else each
            for each, limit in (
                (bound.from_value, _LIMITS[descriptor.type]),
                (bound.to_value, _LIMITS[descriptor.type]),
            )
        )
    return {
        'name': descriptor.name,
        'type': TYPE_NAMES.get(descriptor.type, 'unset'),
        'value': plain_value(value),
        'unit': unit,
        'low': low,
        'high': high,
        'text': text,
        'choices': _choices(descriptor.additional_constraints),
        'dynamic': not descriptor.read_only,
    }


_LIMITS = {
    ParameterType.PARAMETER_INTEGER: 2**63 - 1,
    ParameterType.PARAMETER_DOUBLE: sys.float_info.max,
}
"""Bounds from which on a range has no bound."""


def _choices(constraints: str) -> list[str]:
    prefix = 'one of '
    return constraints.removeprefix(prefix).split(', ') if constraints.startswith(prefix) else []


def plain_value(message: ParameterValue) -> Any:
    """Return the value of a parameter: a number, a text, a list, or None."""
    value = parameter_value_to_python(message)
    return value if value is None or isinstance(value, bool | int | float | str) else list(value)


def _converted(kind: int, value: Any) -> Any:
    """Return a value of JSON or a command line as a parameter of the type takes it."""
    expected = _EXPECTED.get(kind)
    if expected is not None and (not isinstance(value, expected) or _is_flag(value, kind)):
        raise TypeError
    if kind == ParameterType.PARAMETER_DOUBLE:
        return float(value)
    if kind == ParameterType.PARAMETER_DOUBLE_ARRAY:
        return [float(each) for each in value]
    return value


_EXPECTED: Mapping[int, Any] = {
    ParameterType.PARAMETER_BOOL: bool,
    ParameterType.PARAMETER_INTEGER: int,
    ParameterType.PARAMETER_DOUBLE: int | float,
    ParameterType.PARAMETER_STRING: str,
}


def _is_flag(value: Any, kind: int) -> bool:
    return isinstance(value, bool) and kind != ParameterType.PARAMETER_BOOL
