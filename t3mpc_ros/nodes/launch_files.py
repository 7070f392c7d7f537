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
"""Arguments and nodes that the launch files of the package have in common.

Parameters of a node come from, the later the stronger: its file in ``config/``, the launch file,
``params_file``, and the launch arguments that are given.
"""

from collections.abc import Callable, Mapping, Sequence
import logging
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchContext, LaunchDescription
from t3mpc_ros.nodes.arguments import file_values
from t3mpc_ros.nodes.registry import parameter_class
from t3mpc_ros.robot.description import Masses, urdf
from t3mpc_ros.simulation.plant.dynamics import BodyParameters

PACKAGE = 't3mpc_ros'


def argument(name: str, description: str, default: str = '') -> DeclareLaunchArgument:
    """Return an argument with any text as its value."""
    return DeclareLaunchArgument(name, default_value=default, description=description)


def flag(name: str, description: str, default: str = 'false') -> DeclareLaunchArgument:
    """Return an argument that is true or false."""
    return DeclareLaunchArgument(
        name,
        default_value=default,
        choices=('true', 'false', 'True', 'False'),
        description=description,
    )


def params_file(default: str = '') -> DeclareLaunchArgument:
    """Return the argument for a file with parameters of the nodes."""
    text = 'YAML file with parameters of the nodes, or the name of one in config/'
    return argument('params_file', text, default)


COMMON = (
    argument('namespace', 'namespace of all nodes'),
    DeclareLaunchArgument(
        'log_level',
        default_value='info',
        choices=('debug', 'info', 'warn', 'error', 'fatal'),
        description='log level of all nodes',
    ),
)
"""Arguments of every launch file."""

SEED = argument('seed', 'seed; empty: that of the parameter files')
USE_SIM_TIME = flag('use_sim_time', 'use the time of /clock')
RECORD = flag('record', 'record a bag', 'true')
ROBOT_DESCRIPTION = flag(
    'robot_description',
    'start robot_state_publisher, if it is installed, with the URDF of the robot',
)


class PackageNodes:
    """Makes the nodes of one launch file from the values of its arguments, which are texts."""

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
        """Return the parameter of the same name, empty if the argument is."""
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
        """Return a node, named as its executable, in a namespace below that of all nodes.

        ``given`` parameters override every file, ``defaults`` are overridden by ``params_file``.
        """
        levels = self._levels(name, given, defaults)
        return Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=self._namespace(namespace),
            output='screen',
            parameters=[_typed(level) if isinstance(level, dict) else level for level in levels],
            remappings=list(remappings),
            ros_arguments=['--log-level', self.text('log_level')],
        )

    def robot(
        self,
        name: str,
        given: Mapping[str, Any] | None = None,
        *,
        defaults: Mapping[str, Any] | None = None,
        namespace: str = '',
    ) -> list[Node]:
        """Return the node of a robot, and with ``robot_description`` its robot_state_publisher.

        The URDF is that of the parameters of the node; robot_state_publisher then publishes the
        fixed transforms in its place. Parameters as of :meth:`node`.
        """
        if not self.flag('robot_description') or not _is_installed('robot_state_publisher'):
            return [self.node(name, given, defaults=defaults, namespace=namespace)]
        place = self._namespace(namespace)
        values: dict[str, Any] = {}
        for level in self._levels(name, given, defaults):
            full = f'/{place}/{name}' if place else f'/{name}'
            values |= level if isinstance(level, dict) else file_values(level, full)
        kind = parameter_class(name)
        # A file for all nodes also holds names of other nodes.
        known = {spec.name for spec in kind.specs()}
        parameters = kind.from_dict({key: values[key] for key in values if key in known})
        base = parameters.base_frame_id
        publisher = Node(
            package='robot_state_publisher',
            executable='robot_state_publisher',
            name='robot_state_publisher',
            namespace=place,
            output='screen',
            parameters=[
                _typed(
                    {
                        'robot_description': urdf(
                            parameters.frame_names,
                            parameters.geometry,
                            parameters.range_sensor,
                            _masses(getattr(parameters, 'body', BodyParameters())),
                        ),
                        'frame_prefix': parameters.prefixed(base, f'/{place}').removesuffix(base),
                        'use_sim_time': self._simulated,
                    }
                )
            ],
            ros_arguments=['--log-level', self.text('log_level')],
        )
        given = {**(given or {}), 'enable_static_tf': False}
        return [self.node(name, given, defaults=defaults, namespace=namespace), publisher]

    @property
    def _simulated(self) -> bool:
        return 'use_sim_time' in self._arguments and self.flag('use_sim_time')

    def _namespace(self, below: str) -> str:
        parts = (self.text('namespace').strip('/'), below)
        return '/'.join(part for part in parts if part)

    def _levels(
        self, name: str, given: Mapping[str, Any] | None, defaults: Mapping[str, Any] | None
    ) -> list[str | dict[str, Any]]:
        """Return files and values of the parameters of a node, later ones stronger."""
        levels = [
            str(self._config / f'{name}.yaml'),
            {'use_sim_time': self._simulated, **(defaults or {})},
            *self._params_files(),
            dict(given or {}),
        ]
        return [level for level in levels if level]

    def _params_files(self) -> list[str]:
        name = self.text('params_file')
        if not name:
            return []
        for path in (Path(name).expanduser(), self._config / name):
            if path.is_file():
                return [str(path)]
        # Without the check, launch continues with a warning and the defaults.
        raise FileNotFoundError(f'params_file is neither a file nor one in {self._config}: {name}')


def _is_installed(package: str) -> bool:
    try:
        get_package_share_directory(package)
    except PackageNotFoundError:
        logging.getLogger(PACKAGE).warning(
            '%s is not installed: no robot_description; sudo apt install ros-jazzy-%s',
            package,
            package.replace('_', '-'),
        )
        return False
    return True


def _masses(body: BodyParameters) -> Masses:
    """Return the masses of the simulation, which the real robot is assumed to have, too."""
    return Masses(
        body.body_mass,
        body.body_inertia,
        body.com_offset,
        body.wheel_mass,
        body.wheel_inertia,
        body.wheel_turn_inertia,
    )


def _typed(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters whose texts stay texts: launch takes 7 or the empty text for YAML."""
    return {
        name: ParameterValue(value, value_type=str) if isinstance(value, str) else value
        for name, value in parameters.items()
    }


def describe(
    make_nodes: Callable[[PackageNodes], list[Node]], *arguments: DeclareLaunchArgument
) -> LaunchDescription:
    """Return the description of a launch file, with ``arguments`` beside the common ones."""

    def run(context: LaunchContext) -> list[Node]:
        return make_nodes(PackageNodes(context.launch_configurations))

    return LaunchDescription([*COMMON, *arguments, OpaqueFunction(function=run)])
