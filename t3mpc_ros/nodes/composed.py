# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros composed``: runs several nodes of the package in one process."""

from importlib import import_module
from typing import Any

from t3mpc_ros.nodes.common.base_node import BaseNode
from t3mpc_ros.nodes.common.introspection import RCLError
from t3mpc_ros.nodes.node_parameters import AllInOneParameters
from t3mpc_ros.parameters.table import ParameterError

MODULES = {'recorder': 'recorder.node', 'reference': 'reference_generator'}


class ComposedNode(BaseNode[AllInOneParameters]):
    """Says which nodes this process runs."""

    def __init__(self, **given: Any) -> None:
        super().__init__('all_in_one', AllInOneParameters, **given)


def make() -> list[BaseNode]:
    """Return the nodes of this process, the chosen ones and one that stands for the process.

    Raises
    ------
    ParameterError
        Two nodes want one topic in different types: within a process ROS refuses the second.
    """
    chooser = ComposedNode()
    nodes: list[BaseNode] = []
    # The recorder last: what it expects must not forbid what the others publish.
    for name in sorted(chooser.parameters.nodes, key='recorder'.__eq__):
        try:
            module = MODULES.get(name, name)
            nodes += import_module(f't3mpc_ros.nodes.{module}').make()
        except RCLError as error:
            raise ParameterError(
                f'{name} cannot share a process with {", ".join(n.get_name() for n in nodes)}; '
                f'is stamped the same for all? ({error})'
            ) from error
    return [*nodes, chooser]
