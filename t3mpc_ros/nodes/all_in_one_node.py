# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros all_in_one``: the package's nodes in one process."""

from importlib import import_module
from typing import Any

from t3mpc_ros.nodes.plumbing.graph import RCLError
from t3mpc_ros.nodes.plumbing.package_node import PackageNode
from t3mpc_ros.nodes.tables import AllInOneSettings
from t3mpc_ros.settings import SettingError


class AllInOneNode(PackageNode[AllInOneSettings]):
    """Says which nodes this process runs."""

    def __init__(self, **given: Any) -> None:
        super().__init__('all_in_one', AllInOneSettings, **given)


def make() -> list[PackageNode]:
    """Return the nodes of this process, the chosen ones and one that stands for the process.

    Raises
    ------
    SettingError
        Two nodes want one topic in different types: within a process ROS refuses the second.
    """
    chooser = AllInOneNode()
    nodes: list[PackageNode] = []
    # The recorder last: what it expects must not forbid what the others publish.
    for name in sorted(chooser.settings.nodes, key='recorder'.__eq__):
        try:
            nodes += import_module(f't3mpc_ros.nodes.{name}_node').make()
        except RCLError as error:
            raise SettingError(
                f'{name} cannot share a process with {", ".join(n.get_name() for n in nodes)}; '
                f'is stamped the same for all? ({error})'
            ) from error
    return [*nodes, chooser]
