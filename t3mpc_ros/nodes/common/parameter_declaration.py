# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Declare ROS parameters from a parameter class, with descriptors, ranges and validation."""

from collections.abc import Callable
import difflib
import sys
from typing import TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from t3mpc_ros.parameters.table import ParameterError, Parameters, ParameterSpec

S = TypeVar('S', bound=Parameters)

_PARAMETER_TYPES = {
    (bool, False): Parameter.Type.BOOL,
    (int, False): Parameter.Type.INTEGER,
    (float, False): Parameter.Type.DOUBLE,
    (str, False): Parameter.Type.STRING,
    (bool, True): Parameter.Type.BOOL_ARRAY,
    (int, True): Parameter.Type.INTEGER_ARRAY,
    (float, True): Parameter.Type.DOUBLE_ARRAY,
    (str, True): Parameter.Type.STRING_ARRAY,
}

_RCLPY_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides')


def declare_parameters(node: Node, table: type[S], changed: Callable[[S], None]) -> S:
    """Return the node's settings: the table's defaults under what the user has given.

    Every row becomes a parameter with its text, unit and range. Rows that are not live are read
    only. Live ones call ``changed`` with the new table after a change has been accepted.

    Raises
    ------
    ParameterError
        A given parameter is unknown to this node (with the nearest known name), of the wrong
        type or out of range; the text names it, the bound and the value.
    """
    given = _overrides(node)
    rows = {row.name: row for row in table.specs()}
    _reject_unknown(node, given, rows)
    parameters = table.from_dict({name: given[name] for name in rows if name in given})
    values = parameters.to_dict()
    for name, row in rows.items():
        node.declare_parameter(
            name,
            _parameter_value(row, values[name]),
            parameter_descriptor(row),
            ignore_override=True,
        )

    state = [parameters]

    def check(asked: list[Parameter]) -> SetParametersResult:
        try:
            _with_changes(state[0], rows, asked)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def apply(done: list[Parameter]) -> None:
        new = _with_changes(state[0], rows, done)
        if new != state[0]:
            state[0] = new
            changed(new)

    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(apply)
    return parameters


def parameter_descriptor(row: ParameterSpec) -> ParameterDescriptor:
    """Return what ``ros2 param describe`` and sliders show of one setting."""
    unit = f' [{row.unit}]' if row.unit else ''
    origin = '' if row.source == 'assumed' else f' ({row.source})'
    descriptor = ParameterDescriptor(
        name=row.name,
        type=_PARAMETER_TYPES[row.kind, row.many].value,
        description=f'{row.text}{unit}{origin}',
        additional_constraints=row.bounds(),
        read_only=not row.dynamic,
    )
    if row.many or (row.low is None and row.high is None):
        return descriptor
    if row.kind is float:
        largest = sys.float_info.max
        low = -largest if row.low is None else row.low
        high = largest if row.high is None else row.high
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    elif row.kind is int:
        low = -(2**63) if row.low is None else int(row.low)
        high = 2**63 - 1 if row.high is None else int(row.high)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    return descriptor


def _overrides(node: Node) -> dict[str, object]:
    # rclpy has no public word for "what the user gave": declaring it all automatically fails on
    # an empty list and forbids describing it afterwards.
    return {
        name: (() if parameter.value is None else parameter.value)
        for name, parameter in node._parameter_overrides.items()
    }


def _reject_unknown(node: Node, given: dict[str, object], rows: dict[str, ParameterSpec]) -> None:
    for name in given:
        if (
            name in rows
            or name.split('.')[0] in _RCLPY_PARAMETERS
            or name in _names_of_all_nodes()
        ):
            continue
        near = difflib.get_close_matches(name, rows, n=1)
        hint = f'; did you mean {near[0]}?' if near else ''
        raise ParameterError(
            f'{node.get_name()} has no parameter {name}{hint} '
            f'(`ros2 param list /{node.get_name()}` shows them all)'
        )


def _names_of_all_nodes() -> frozenset[str]:
    """Return the names other nodes know: a file or command line may speak to several nodes."""
    from t3mpc_ros.nodes.node_parameters import PARAMETER_CLASSES

    return frozenset(row.name for table in PARAMETER_CLASSES.values() for row in table.specs())


def _parameter_value(row: ParameterSpec, value: object) -> object:
    return list(value) if row.many and isinstance(value, tuple) else value


def _with_changes(parameters: S, rows: dict[str, ParameterSpec], asked: list[Parameter]) -> S:
    return parameters.with_values(
        {parameter.name: parameter.value for parameter in asked if parameter.name in rows}
    )
