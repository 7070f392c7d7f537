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
"""Registry of the nodes: class and interface by executable name; docs tables.

Node modules are imported on request only: an entry point installs its signal handlers first, and
one node does not load the code of the others.
"""

from pathlib import Path
from pkgutil import resolve_name
import sys
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from t3mpc_ros.nodes.base_node import BaseNode
    from t3mpc_ros.parameters.table import Parameters


CALIBRATED_GYRO = {'body.gyro_scale_tolerance': 0.001}
"""Parameters of the controller of a robot with a calibrated gyro, such as the simulated one."""


class NodeInterface(NamedTuple):
    """Where a node stands, what it is for, its topics and services; ``*``: several names."""

    place: str
    """Its module below ``t3mpc_ros.nodes``, and its class."""
    summary: str
    subscribes: tuple[str, ...] = ()
    publishes: tuple[str, ...] = ()
    services: tuple[str, ...] = ()


_ROBOT_TOPICS = ('odom', 'joint_states', 'imu/data_raw', 'range/*', 'battery_state', '/tf')
_ROBOT_SERVICES = ('reset_odometry', 'e_stop')

INTERFACES = {
    'reference_generator': NodeInterface(
        'reference_generator:ReferenceGeneratorNode',
        'Publishes the reference: chaotic signals, a chaotic path, or a given path or twist.',
        subscribes=(
            'odom',
            'path',
            'target_twist',
            'keep_out/map',
            'goal_pose',
            'map_changes/suspected',
        ),
        publishes=('reference', 'reference/path', 'reference/signals', '/diagnostics'),
        services=('~/reseed', '~/pause'),
    ),
    'controller': NodeInterface(
        'controller:ControllerNode',
        'Tracks the reference with the odometry of a robot and publishes its velocity commands.',
        subscribes=('reference', 'odom', 'range/*'),
        publishes=(
            'cmd_vel',
            '~/error/*',
            '~/estimate/*',
            '~/skill/*',
            '~/terms/*',
            '~/lyapunov/*',
            '~/journal',
            '~/parameters',
            '~/initial_inputs/*',
            'keep_out/map',
            '/diagnostics',
        ),
        services=('~/enable', '~/reset', '~/save_model', '~/save_map'),
    ),
    'sim_robot': NodeInterface(
        'sim_robot:SimRobotNode',
        'Simulates the robot: executes velocity commands, publishes odometry and sensors.',
        subscribes=('cmd_vel',),
        publishes=(*_ROBOT_TOPICS, 'ground_truth/odom', '/clock', '/diagnostics'),
        services=(*_ROBOT_SERVICES, '~/set_pose', '~/step'),
    ),
    'radio_bridge': NodeInterface(
        'radio_bridge:RadioBridgeNode',
        'Connects the real robot: sends velocity commands, publishes odometry and sensors.',
        subscribes=('cmd_vel',),
        publishes=(*_ROBOT_TOPICS, '/diagnostics'),
        services=_ROBOT_SERVICES,
    ),
    'recorder': NodeInterface(
        'recorder:RecorderNode',
        'Records topics into an MCAP bag that rosbag2 reads.',
        subscribes=('*', '/diagnostics'),
        publishes=('/diagnostics',),
        services=('~/split_bagfile', '~/snapshot'),
    ),
    'player': NodeInterface(
        'player:PlayerNode',
        'Publishes the messages of bags at the recorded times; storage.uris names the bags.',
        publishes=('*', '/clock', '/diagnostics'),
        services=(
            '~/pause',
            '~/resume',
            '~/toggle_paused',
            '~/seek',
            '~/play_next',
            '~/set_rate',
        ),
    ),
    'localizer': NodeInterface(
        'localizer:LocalizerNode',
        'Finds the pose on a map by odometry and ranges, or a scan (particle filter).',
        subscribes=('odom', 'range/*', 'map', 'initialpose'),
        publishes=(
            'odometry/filtered',
            'pose',
            'map_to_odom',
            'particlecloud',
            'map_changes',
            'map_changes/markers',
            'map_changes/suspected',
            '/tf',
            '/diagnostics',
        ),
        services=('reinitialize_global_localization',),
    ),
    'composed': NodeInterface(
        'composed:ComposedNode',
        'Runs the nodes that its parameter nodes lists in one process.',
        publishes=('/diagnostics',),
    ),
}
"""Interface of each node, for ``--help``."""

NODES = tuple(INTERFACES)
"""Names of the nodes, which are those of their executables."""

MARK = '<!-- generated from here on: python -m t3mpc_ros.nodes.registry docs/nodes.md -->'
"""First line of the generated part of ``docs/nodes.md``."""


def node_class(node: str) -> 'type[BaseNode[Any]]':
    """Return the class of a node."""
    found: type[BaseNode[Any]] = resolve_name(f't3mpc_ros.nodes.{INTERFACES[node].place}')
    return found


def parameter_class(node: str) -> 'type[Parameters]':
    """Return the parameter class of a node."""
    return node_class(node).parameter_class


def parameters_section() -> str:
    """Return the generated end of ``docs/nodes.md``: the parameters of all nodes."""
    lines = [
        MARK,
        '',
        '## Parameters',
        '',
        '*Dynamic* parameters can be set while the node runs (`ros2 param set`), the others are '
        'read-only after start. Defaults that neither the paper nor a data sheet gives are '
        '*assumed*.',
    ]
    for node in NODES:
        lines += ['', f'### {node}', '']
        lines += ['| parameter | default | range | dynamic | description | source |']
        lines += ['|---|---|---|---|---|---|']
        for spec in parameter_class(node).specs():
            cells = (
                f'`{spec.name}`',
                spec.default_text() or '*(empty)*',
                spec.bounds_text(),
                'dynamic' if spec.dynamic else '',
                spec.text,
                spec.source,
            )
            lines.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
    return '\n'.join(lines) + '\n'


def with_parameters(page: str) -> str:
    """Return ``docs/nodes.md`` with the present parameters behind its mark."""
    return page[: page.index(MARK)] + parameters_section()


if __name__ == '__main__':
    path = Path(sys.argv[1])
    path.write_text(with_parameters(path.read_text(encoding='utf-8')), encoding='utf-8')
