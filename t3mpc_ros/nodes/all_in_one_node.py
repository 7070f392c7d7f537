# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros all_in_one``: the package's nodes in one process."""

from importlib import import_module

from t3mpc_ros.nodes.plumbing.package_node import PackageNode
from t3mpc_ros.nodes.tables import AllInOneSettings


class AllInOneNode(PackageNode[AllInOneSettings]):
    """Says which nodes this process runs."""

    def __init__(self) -> None:
        super().__init__('all_in_one', AllInOneSettings)


def make() -> list[PackageNode]:
    """Return the nodes of this process, the chosen ones and one that stands for the process."""
    chooser = AllInOneNode()
    others = [
        node
        for name in chooser.settings.nodes
        for node in import_module(f't3mpc_ros.nodes.{name}_node').make()
    ]
    return [*others, chooser]
