# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Arguments and nodes that the launch files of the package have in common.

Parameters of a node come from, the later the stronger: its file in ``config/``, the launch file,
``params_file``, and the launch arguments that are given.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchContext, LaunchDescription

PACKAGE = 't3mpc_ros'
FLAG = ('true', 'false', 'True', 'False')

COMMON = (
    DeclareLaunchArgument('namespace', default_value='', description='namespace of all nodes'),
    DeclareLaunchArgument(
        'log_level',
        default_value='info',
        choices=('debug', 'info', 'warn', 'error', 'fatal'),
        description='log level of all nodes',
    ),
)
"""Arguments of every launch file."""

SEED = DeclareLaunchArgument(
    'seed', default_value='', description='seed; empty: that of the parameter files'
)
USE_SIM_TIME = DeclareLaunchArgument(
    'use_sim_time', default_value='false', choices=FLAG, description='use the time of /clock'
)
RECORD = DeclareLaunchArgument(
    'record', default_value='true', choices=FLAG, description='record a bag'
)


def params_file(default: str = '') -> DeclareLaunchArgument:
    """Return the argument for a file with parameters of the nodes."""
    return DeclareLaunchArgument(
        'params_file',
        default_value=default,
        description='YAML file with parameters of the nodes, or the name of one in config/',
    )


class PackageNodes:
    """Makes the nodes of one launch file from the values of its arguments.

    Parameters
    ----------
    arguments
        Values of the launch arguments, as texts.
    """

    def __init__(self, arguments: Mapping[str, str]) -> None:
        self._arguments = arguments
        self._config = Path(get_package_share_directory(PACKAGE)) / 'config'

    def text(self, name: str) -> str:
        """Return the value of an argument."""
        return self._arguments[name]

    def flag(self, name: str) -> bool:
        """Return whether an argument is true."""
        return self._arguments[name].lower() == 'true'

    def given(self, name: str, kind: Callable[[str], Any] = str) -> dict[str, Any]:
        """Return the parameter of the same name, empty if the argument is.

        Raises
        ------
        ValueError
            The value is of another type.
        """
        value = self._arguments[name]
        try:
            return {name: kind(value)} if value else {}
        except ValueError as error:
            raise ValueError(f'{name} must be of type {kind.__name__}: got {value}') from error

    def node(
        self,
        name: str,
        given: Mapping[str, Any] | None = None,
        *,
        defaults: Mapping[str, Any] | None = None,
        namespace: str = '',
        remappings: Sequence[tuple[str, str]] = (),
    ) -> Node:
        """Return a node.

        Parameters
        ----------
        name
            Its name, which is that of its executable.
        given
            Parameters that override every file.
        defaults
            Parameters that ``params_file`` may override.
        namespace
            Namespace below that of all nodes.
        remappings
            Pairs of a topic and its new name.
        """
        parts = (self.text('namespace').strip('/'), namespace)
        simulated = 'use_sim_time' in self._arguments and self.flag('use_sim_time')
        levels = [
            str(self._config / f'{name}.yaml'),
            {'use_sim_time': simulated} | _typed(defaults or {}),
            *self._params_files(),
            _typed(given or {}),
        ]
        return Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace='/'.join(part for part in parts if part),
            output='screen',
            parameters=[level for level in levels if level],
            remappings=list(remappings),
            ros_arguments=['--log-level', self.text('log_level')],
        )

    def _params_files(self) -> list[str]:
        name = self.text('params_file')
        if not name:
            return []
        for path in (Path(name).expanduser(), self._config / name):
            if path.is_file():
                return [str(path)]
        # Without the check, launch continues with a warning and the defaults.
        raise FileNotFoundError(f'params_file is neither a file nor one in {self._config}: {name}')


def _typed(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters whose texts stay texts: launch takes 7 or the empty text for YAML."""
    return {
        name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
        for name, value in parameters.items()
    }


def describe(
    make_nodes: Callable[[PackageNodes], list[Node]], *arguments: DeclareLaunchArgument
) -> LaunchDescription:
    """Return the description of a launch file.

    Parameters
    ----------
    make_nodes
        Returns the nodes for the values of the arguments.
    arguments
        Arguments beside those of every launch file.
    """

    def run(context: LaunchContext) -> list[Node]:
        return make_nodes(PackageNodes(context.launch_configurations))

    return LaunchDescription([*COMMON, *arguments, OpaqueFunction(function=run)])
