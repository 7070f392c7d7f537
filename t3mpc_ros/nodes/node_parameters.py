# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parameter class of each node by executable name, and the generated parameter reference."""

from dataclasses import dataclass

from t3mpc_ros.bag.player import PlaybackParameters
from t3mpc_ros.bag.recording.recording_parameters import RecordingParameters
from t3mpc_ros.nodes.controller import ControllerNodeParameters
from t3mpc_ros.nodes.radio_bridge import RadioBridgeParameters
from t3mpc_ros.nodes.reference_generator import ReferenceNodeParameters
from t3mpc_ros.nodes.sim_robot import SimRobotNodeParameters
from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class RecorderParameters(RecordingParameters):
    """The recorder as a node."""


@dataclass(frozen=True)
class ReplayerParameters(PlaybackParameters):
    """The replayer as a node."""

    allow_commands: bool = parameter(
        False, 'publish cmd_vel and other velocities under their own name: a robot may move'
    )
    quality_overrides: str = parameter(
        '', 'YAML file with the quality of service of some topics, as ros2 bag play takes it'
    )
    wait_for_subscribers: float = parameter(
        0.5, 'how long to wait at most until every topic is listened to', unit='s', low=0.0
    )
    delay: float = parameter(0.0, 'how long to wait at least', unit='s', low=0.0)
    realtime_priority: int = parameter(
        0,
        'priority of the thread that publishes before everything that has none (SCHED_FIFO), for '
        'punctuality on a busy machine; 0 = none. Needs the right to it: rtprio in limits.conf',
        low=0,
        high=99,
    )
    keyboard: bool = parameter(
        True,
        'in a terminal: space pauses, right plays the next message, left goes back 5 s, up and '
        'down (+ and -) change the rate',
    )
    progress: bool = parameter(True, 'in a terminal: show how far it is')
    exit_at_end: bool = parameter(True, 'end the process at the end of the bag')


@dataclass(frozen=True)
class AllInOneParameters(Parameters):
    """Which nodes share the one process."""

    nodes: tuple[str, ...] = parameter(
        ('sim_robot', 'controller', 'reference', 'recorder'),
        'nodes to run in this process',
        choices=('sim_robot', 'controller', 'reference', 'recorder'),
    )


PARAMETER_CLASSES: dict[str, type[Parameters]] = {
    'reference': ReferenceNodeParameters,
    'controller': ControllerNodeParameters,
    'sim_robot': SimRobotNodeParameters,
    'radio_bridge': RadioBridgeParameters,
    'recorder': RecorderParameters,
    'replayer': ReplayerParameters,
    'all_in_one': AllInOneParameters,
}
"""Every node's table, by the name of its executable."""


def parameters_page() -> str:
    """Return ``docs/settings.md``: every parameter of every node, from the tables themselves."""
    lines = [
        '# Settings',
        '',
        'Every parameter of every node. This page is written by '
        '`python -m t3mpc_ros.nodes.node_parameters > docs/settings.md`; a test keeps it up to date.',
        '*Live* ones may be changed while the node runs (`ros2 param set`), the others are fixed '
        'at start. Defaults that neither the paper nor a data sheet gives are *assumed*.',
    ]
    for node, table in PARAMETER_CLASSES.items():
        lines += ['', f'## {node}', '']
        lines += ['| parameter | default | range | live | meaning | source |']
        lines += ['|---|---|---|---|---|---|']
        for row in table.specs():
            default = ', '.join(map(str, row.default)) if row.many else str(row.default)  # type: ignore[arg-type]
            unit = f' {row.unit}' if row.unit else ''
            cells = (
                f'`{row.name}`',
                f'{default}{unit}' if default else '*(empty)*',
                row.bounds(),
                'live' if row.dynamic else '',
                row.text,
                row.source,
            )
            lines.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
    return '\n'.join(lines) + '\n'


if __name__ == '__main__':
    print(parameters_page(), end='')
