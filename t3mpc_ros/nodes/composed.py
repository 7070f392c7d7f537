# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros composed``: runs several nodes of the package in one process."""

from dataclasses import dataclass
from typing import Any

from t3mpc_ros.nodes.base_node import BaseNode
from t3mpc_ros.nodes.qos import RCLError
from t3mpc_ros.nodes.registry import node_module
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

CONFIGURATION_ERRORS: tuple[type[Exception], ...] = ()
"""Errors of :func:`make` other than :class:`ParameterError`; it converts those of the nodes."""


@dataclass(frozen=True)
class ComposedParameters(Parameters):
    """Parameters of the composed process."""

    nodes: tuple[str, ...] = parameter(
        ('sim_robot', 'controller', 'reference_generator', 'recorder'),
        'nodes to run in this process',
        choices=('sim_robot', 'controller', 'reference_generator', 'recorder'),
    )


class ComposedNode(BaseNode[ComposedParameters]):
    """Node of the process itself: holds the list of nodes to run."""

    def __init__(self, **options: Any) -> None:
        super().__init__('composed', ComposedParameters, **options)


def make() -> list[BaseNode]:
    """Return the chosen nodes and the node of the process.

    ParameterError also if two nodes use one topic with different types, which ROS does not allow
    within a process.
    """
    process = ComposedNode()
    nodes: list[BaseNode] = []
    # The recorder last: its early subscriptions must not fix the type of a topic.
    for name in sorted(process.parameters.nodes, key='recorder'.__eq__):
        module = node_module(name)
        try:
            nodes += module.make()
        except module.CONFIGURATION_ERRORS as error:
            raise ParameterError(str(error)) from error
        except RCLError as error:
            raise ParameterError(
                f'{name} cannot share a process with {", ".join(n.get_name() for n in nodes)}; '
                f'set enable_stamped_cmd_vel to the same value for all ({error})'
            ) from error
    return [*nodes, process]
