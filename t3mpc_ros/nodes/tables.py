# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What can be set on each node: its room's table plus names of topics, frames and files."""

from dataclasses import dataclass

from t3mpc_ros.chaos.reference import ReferenceSettings
from t3mpc_ros.control.controller import ControllerSettings
from t3mpc_ros.motion import Geometry
from t3mpc_ros.robot.simulated import SimulatedRobotSettings
from t3mpc_ros.settings import SettingError, Settings, nested, setting


@dataclass(frozen=True)
class ReferenceNodeSettings(ReferenceSettings):
    """The reference generator as a node."""

    lead: float = setting(
        0.4,
        'how far ahead of now the reference is stamped, so that its value now never depends on '
        'when a message arrives',
        unit='s',
        low=0.0,
        high=10.0,
    )
    frame_id: str = setting('odom', 'frame of the reference pose')
    child_frame_id: str = setting('base_link', 'frame of the reference twist')
    path_points: int = setting(
        600, 'most poses in reference/path (one every 0.1 s); 0 = no path', low=0, high=100_000
    )
    geometry: Geometry = nested(Geometry)


@dataclass(frozen=True)
class ControllerNodeSettings(ControllerSettings):
    """The controller as a node."""

    stamped: bool = setting(False, 'publish cmd_vel as TwistStamped instead of Twist')
    frame_id: str = setting('base_link', 'frame of a stamped command')
    terms_rate: float = setting(
        20.0,
        'how often the plain numbers (~/error, ~/estimate, ~/terms, ~/lyapunov, ~/skill) are '
        'published; 0 turns them off',
        unit='Hz',
        low=0.0,
        high=1000.0,
    )
    model: str = setting('', 'model file to start from; empty = learn from nothing')
    model_output: str = setting('controller_model.npz', 'file that ~/save_model writes')


@dataclass(frozen=True)
class SimRobotNodeSettings(SimulatedRobotSettings):
    """The simulated robot as a node."""

    stamped: bool = setting(False, 'expect cmd_vel as TwistStamped instead of Twist')
    odom_frame: str = setting('odom', 'frame of the odometry')
    base_frame: str = setting('base_link', 'frame of the robot')
    right_joint: str = setting('right_wheel_joint', 'name of the right wheel in joint_states')
    left_joint: str = setting('left_wheel_joint', 'name of the left wheel in joint_states')
    joint_rate: float = setting(
        20.0, 'how often joint_states is published; 0 = never', unit='Hz', low=0.0, high=1000.0
    )
    publish_clock: bool = setting(False, 'publish /clock')
    publish_tf: bool = setting(True, 'publish the transform, where tf2_ros is installed')
    start_x: float = setting(0.0, 'where ~/set_pose puts the robot', unit='m', live=True)
    start_y: float = setting(0.0, 'where ~/set_pose puts the robot', unit='m', live=True)
    start_heading: float = setting(0.0, 'where ~/set_pose points it', unit='rad', live=True)

    def check_together(self) -> None:
        """Raise :class:`SettingError` for a drive that takes no velocities."""
        super().check_together()
        if self.drive.kind != 'velocity':
            raise SettingError(
                f'drive.kind must be velocity, because cmd_vel is one: got {self.drive.kind}; '
                'torques are for the lab'
            )


@dataclass(frozen=True)
class RecorderSettings(Settings):
    """The recorder as a node."""

    folder: str = setting(
        '', 'folder of the bag; empty = bag_<time> here; one that exists is continued'
    )
    topics: tuple[str, ...] = setting(
        (
            'reference',
            'reference/*',
            'odom',
            'ground_truth/*',
            'joint_states',
            'cmd_vel',
            'controller/*',
            '/diagnostics',
        ),
        'topics to record; * stands for anything; relative names are of this namespace',
    )
    chunk_bytes: int = setting(
        262_144, 'size at which a compressed chunk is closed', unit='B', low=1024, high=2**26
    )


@dataclass(frozen=True)
class AllInOneSettings(Settings):
    """Which nodes share the one process."""

    nodes: tuple[str, ...] = setting(
        ('sim_robot', 'controller', 'reference', 'recorder'),
        'nodes to run in this process',
        choices=('sim_robot', 'controller', 'reference', 'recorder'),
    )


TABLES: dict[str, type[Settings]] = {
    'reference': ReferenceNodeSettings,
    'controller': ControllerNodeSettings,
    'sim_robot': SimRobotNodeSettings,
    'recorder': RecorderSettings,
    'all_in_one': AllInOneSettings,
}
"""Every node's table, by the name of its executable."""


def settings_page() -> str:
    """Return ``docs/settings.md``: every parameter of every node, from the tables themselves."""
    lines = [
        '# Settings',
        '',
        'Every parameter of every node. This page is written by '
        '`python -m t3mpc_ros.nodes.tables > docs/settings.md`; a test keeps it up to date.',
        '*Live* ones may be changed while the node runs (`ros2 param set`), the others are fixed '
        'at start. Defaults that neither the paper nor a data sheet gives are *assumed*.',
    ]
    for node, table in TABLES.items():
        lines += ['', f'## {node}', '']
        lines += ['| parameter | default | range | live | meaning | source |']
        lines += ['|---|---|---|---|---|---|']
        for row in table.rows():
            default = ', '.join(map(str, row.default)) if row.many else str(row.default)  # type: ignore[arg-type]
            unit = f' {row.unit}' if row.unit else ''
            cells = (
                f'`{row.name}`',
                f'{default}{unit}' if default else '*(empty)*',
                row.bounds(),
                'live' if row.live else '',
                row.text,
                row.source,
            )
            lines.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
    return '\n'.join(lines) + '\n'


if __name__ == '__main__':
    print(settings_page(), end='')
