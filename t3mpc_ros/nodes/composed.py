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
"""``ros2 run t3mpc_ros composed``: runs several nodes of the package in one process."""

from dataclasses import dataclass
from typing import Any

from t3mpc_ros.nodes.base_node import BaseNode, accepted_names
from t3mpc_ros.nodes.registry import node_class, parameter_class
from t3mpc_ros.nodes.topic_endpoints import RCLError
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter


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

    parameter_class = ComposedParameters

    def __init__(self, **options: Any) -> None:
        super().__init__('composed', **options)

    def names_of_siblings(self, parameters: ComposedParameters) -> frozenset[str]:
        """Return the parameter names of all nodes of the process."""
        tables = (ComposedParameters, *map(parameter_class, parameters.nodes))
        return frozenset().union(*map(accepted_names, tables))

    @classmethod
    def make(cls, **options: Any) -> list[BaseNode[Any]]:
        """Return the chosen nodes and the node of the process.

        ParameterError also if two nodes use one topic with different types, which ROS does not
        allow within a process.
        """
        process = cls(**options)
        names = process.names_of_siblings(process.parameters)
        nodes: list[BaseNode[Any]] = []
        # The recorder last: its early subscriptions must not fix the type of a topic.
        for name in sorted(process.parameters.nodes, key='recorder'.__eq__):
            kind = node_class(name)
            try:
                nodes += kind.make(siblings=names, **options)
            except kind.configuration_errors as error:
                raise ParameterError(str(error)) from error
            except RCLError as error:
                raise ParameterError(
                    f'{name} cannot share a process with '
                    f'{", ".join(each.get_name() for each in nodes)}; '
                    f'set enable_stamped_cmd_vel to the same value for all ({error})'
                ) from error
        return [*nodes, process]
