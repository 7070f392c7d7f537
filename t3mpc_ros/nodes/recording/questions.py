# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Asks the package's nodes for their settings, once each: they belong into the bag."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from t3mpc_ros.nodes.tables import TABLES

Answer = Callable[[str, str, Mapping[str, str]], None]
"""Called with a title for the bag, the name of the executable, and settings as text."""


class Questions:
    """Knows which nodes have been asked.

    Parameters
    ----------
    node
        Who asks.
    answered
        What to do with an answer.
    """

    def __init__(self, node: Node, answered: Answer) -> None:
        self._node = node
        self._answered = answered
        self._asked: set[str] = set()

    def ask(self) -> None:
        """Ask those that are new in the graph; one that left and came again is new."""
        present = set()
        for name, namespace in self._node.get_node_names_and_namespaces():
            full = f'{namespace.rstrip("/")}/{name}'
            present.add(full)
            if name not in TABLES or full in self._asked:
                continue
            lister = self._node.create_client(ListParameters, f'{full}/list_parameters')
            getter = self._node.create_client(GetParameters, f'{full}/get_parameters')
            if lister.service_is_ready() and getter.service_is_ready():
                self._asked.add(full)
                future = lister.call_async(ListParameters.Request())
                # One of another namespace has the same name but is another robot's.
                title = name if namespace == self._node.get_namespace() else full
                future.add_done_callback(partial(self._on_names, title, name, lister, getter))
            else:
                self._node.destroy_client(lister)
                self._node.destroy_client(getter)
        self._asked &= present

    def _on_names(
        self, title: str, name: str, lister: Client, getter: Client, future: Any
    ) -> None:
        names = list(future.result().result.names)
        self._node.destroy_client(lister)
        asked = getter.call_async(GetParameters.Request(names=names))
        asked.add_done_callback(partial(self._on_values, title, name, names, getter))

    def _on_values(
        self, title: str, name: str, names: list[str], getter: Client, future: Any
    ) -> None:
        values = {
            key: str(parameter_value_to_python(value))
            for key, value in zip(names, future.result().values, strict=True)
        }
        self._node.destroy_client(getter)
        self._answered(title, name, values)
