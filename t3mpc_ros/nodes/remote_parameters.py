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
"""Parameters of other nodes: description and values, changes, and set requests."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
import re
import sys
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.task import Future

from t3mpc_ros.nodes.topic_endpoints import full_name

SERVICES = {
    'list_parameters': ListParameters,
    'describe_parameters': DescribeParameters,
    'get_parameters': GetParameters,
    'set_parameters': SetParameters,
}
_UNIT = re.compile(r' \[([^\]]+)\](?=$| \()')
"""Unit at the end of a description; a source may follow in parentheses."""
_TYPES = {'BOOL': 'bool', 'INTEGER': 'int', 'DOUBLE': 'float', 'STRING': 'str'}
_UNBOUNDED = {'INTEGER': 2**63 - 1, 'DOUBLE': sys.float_info.max}
"""Magnitude of a bound of a range that has none."""


class RemoteParameters:
    """Parameters of the node ``name``; every answer arrives through a callback."""

    def __init__(self, node: Node, name: str) -> None:
        self.name = name
        self.node_name = name.rpartition('/')[2]
        """The name without its namespace."""
        self.requested = False
        """Whether :meth:`read` was called."""
        self._node = node
        self._clients: dict[str, Client] = {
            word: node.create_client(kind, f'{name}/{word}') for word, kind in SERVICES.items()
        }
        self._types: dict[str, int] = {}

    def destroy(self) -> None:
        """Destroy the clients; an answer that arrives later has no effect."""
        while self._clients:
            self._node.destroy_client(self._clients.popitem()[1])

    def ready(self) -> bool:
        """Return whether all services of the other node are there."""
        return all(client.service_is_ready() for client in self._clients.values())

    def read(self, found: Callable[[Sequence[Mapping[str, Any]]], None]) -> None:
        """Request all parameters; ``found`` gets one row each, see :func:`parameter_row`."""
        self.requested = True

        def listed(answer: Any) -> None:
            names = sorted(answer.result.names)
            self._call('describe_parameters', partial(described, names), names=names)

        def described(names: list[str], answer: Any) -> None:
            self._types = {each.name: each.type for each in answer.descriptors}
            self._call('get_parameters', partial(valued, answer.descriptors), names=names)

        def valued(descriptors: list[ParameterDescriptor], answer: Any) -> None:
            found([parameter_row(*pair) for pair in zip(descriptors, answer.values, strict=False)])

        self._call('list_parameters', listed)

    def set(self, name: str, value: Any, done: Callable[[str], None]) -> None:
        """Request a new value; ``done`` gets the reason of a refusal, or nothing.

        ValueError if the node has no such parameter, or the value cannot be one of its type.
        """
        if name not in self._types:
            raise ValueError(f'{self.name} has no parameter {name}')
        message = parameter_message(name, self._types[name], value)
        self._call('set_parameters', lambda answer: done(refusal(answer)), parameters=[message])

    def _call(self, word: str, done: Callable[[Any], None], **fields: Any) -> None:
        def finish(future: Future) -> None:
            if self._clients and (answer := future.result()) is not None:
                done(answer)

        request = SERVICES[word].Request(**fields)
        self._clients[word].call_async(request).add_done_callback(finish)


class ParameterWatch:
    """Reads the parameters of nodes of the graph, once after each start of a node.

    ``wanted`` decides by name and namespace; ``found`` gets the parameters of a node and a row
    of each.
    """

    def __init__(
        self,
        node: Node,
        wanted: Callable[[str, str], bool],
        found: Callable[[RemoteParameters, Sequence[Mapping[str, Any]]], None],
    ) -> None:
        self.nodes: dict[str, RemoteParameters] = {}
        """Parameters of the nodes that are present, by full name."""
        self._node = node
        self._wanted = wanted
        self._found = found

    def update(self) -> list[RemoteParameters]:
        """Request the parameters of new nodes; return those of the nodes that have left."""
        present = {
            full_name(namespace, name)
            for name, namespace in self._node.get_node_names_and_namespaces()
            if self._wanted(name, namespace)
        }
        left = [self.nodes.pop(name) for name in self.nodes.keys() - present]
        for remote in left:
            remote.destroy()
        for name in sorted(present):
            if name not in self.nodes:
                self.nodes[name] = RemoteParameters(self._node, name)
            remote = self.nodes[name]
            if not remote.requested and remote.ready():
                remote.read(partial(self._found, remote))
        return left

    def close(self) -> None:
        """Ignore the answers that have not arrived."""
        for remote in self.nodes.values():
            remote.destroy()


def refusal(answer: SetParameters.Response) -> str:
    """Return why a parameter was not set, or nothing."""
    (result,) = answer.results
    return '' if result.successful else result.reason or 'refused without a reason'


def parameter_row(descriptor: ParameterDescriptor, value: ParameterValue) -> Mapping[str, Any]:
    """Return name, type, value, unit, low, high, text, choices and dynamic of a parameter.

    Units and choices are those that the nodes of this package write into their descriptions;
    bounds are None where there are none.
    """
    text, unit = descriptor.description, ''
    if match := _UNIT.search(text):
        text, unit = text[: match.start()] + text[match.end() :], match[1]
    bounds: tuple[float | None, ...] = (None, None)
    for bound in (*descriptor.integer_range, *descriptor.floating_point_range):
        limit = _UNBOUNDED[Parameter.Type(descriptor.type).name]
        both = bound.from_value, bound.to_value
        bounds = tuple(None if abs(each) >= limit else each for each in both)
    values, prefix = descriptor.additional_constraints, 'one of '
    return {
        'name': descriptor.name,
        'type': type_text(descriptor.type),
        'value': plain_value(value),
        'unit': unit,
        'low': bounds[0],
        'high': bounds[1],
        'text': text,
        'choices': values.removeprefix(prefix).split(', ') if values.startswith(prefix) else [],
        'dynamic': not descriptor.read_only,
    }


def type_text(kind: int) -> str:
    """Return the name of a type of parameters: ``float``, ``list of int``."""
    word, is_list = _kind(kind)
    text = _TYPES.get(word, 'unset')
    return f'list of {text}' if is_list else text


def plain_value(message: ParameterValue) -> Any:
    """Return the value of a parameter: a number, a text, a list, or None."""
    value = parameter_value_to_python(message)
    return value if value is None or isinstance(value, bool | int | float | str) else list(value)


def parameter_message(name: str, kind: int, value: Any) -> ParameterMessage:
    """Return a parameter with a value of JSON or YAML; ValueError if its type has no such one."""
    word, is_list = _kind(kind)
    message = ParameterValue(type=kind, check_fields=True)
    try:
        # The message accepts True as a number, and no whole number as a float.
        numbers = value if is_list else [value]
        if word != 'BOOL' and any(isinstance(each, bool) for each in numbers):
            raise TypeError
        if word == 'DOUBLE':
            numbers = [float(each) if isinstance(each, int) else each for each in numbers]
            value = numbers if is_list else numbers[0]
        setattr(message, f'{Parameter.Type(kind).name.lower()}_value', value)
    except (AssertionError, TypeError, ValueError, OverflowError):
        raise ValueError(f'{name} must be {type_text(kind)}: got {value!r}') from None
    return ParameterMessage(name=name, value=message)


def _kind(kind: int) -> tuple[str, bool]:
    """Return the name of the element type of parameters, and whether they are lists."""
    word, _, array = Parameter.Type(kind).name.partition('_A')
    return word, bool(array)
