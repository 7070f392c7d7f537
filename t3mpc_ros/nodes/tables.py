# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What can be set on each node: its room's table plus names of topics, frames and files."""

from dataclasses import dataclass

from t3mpc_ros.chaos.reference import ReferenceSettings
from t3mpc_ros.control.controller import ControllerSettings
from t3mpc_ros.control.estimate import EstimateSettings
from t3mpc_ros.motion import Geometry, Pose
from t3mpc_ros.radio.host.robot import RadioRobotSettings
from t3mpc_ros.record.playback.settings import PlaybackSettings
from t3mpc_ros.record.writing.settings import RecordingSettings
from t3mpc_ros.robot.sensors.battery import BatterySettings
from t3mpc_ros.robot.sensors.mpu6050 import ImuSettings
from t3mpc_ros.robot.sensors.sharp import SharpSettings
from t3mpc_ros.robot.twin.faults import active
from t3mpc_ros.robot.twin.settings import TwinSettings
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
    secret_seed: bool = setting(
        False,
        'draw the seed from the operating system, so that nobody can know beforehand where the '
        'robot will go; it is told nowhere, only a fingerprint of it is',
    )
    frame_id: str = setting('odom', 'frame of the reference pose')
    child_frame_id: str = setting('base_link', 'frame of the reference twist')
    path_points: int = setting(
        600, 'most poses in reference/path (one every 0.1 s); 0 = no path', low=0, high=100_000
    )
    geometry: Geometry = nested(Geometry)

    def check_together(self) -> None:
        """Raise :class:`SettingError` for a secret seed beside one that all can read."""
        super().check_together()
        if self.secret_seed and self.seed:
            raise SettingError(f'seed must be 0 with secret_seed: got {self.seed}')


@dataclass(frozen=True)
class ControllerNodeSettings(ControllerSettings):
    """The controller as a node."""

    # A stepper's rotor follows its field at once; the lag of 0.02 s is that of the servo.
    estimate: EstimateSettings = nested(EstimateSettings, lag=0.003)
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
class RobotTopicSettings(Settings):
    """Names, frames and rates of what every robot tells, simulated or real."""

    stamped: bool = setting(False, 'expect cmd_vel as TwistStamped instead of Twist')
    odom_frame: str = setting('odom', 'frame of the odometry')
    base_frame: str = setting('base_link', 'frame of the robot')
    imu_frame: str = setting('imu_link', 'frame of imu/data_raw')
    range_frame_prefix: str = setting(
        '', 'put in front of the frames of range/*, which are called <sensor>_range_link'
    )
    right_joint: str = setting('right_wheel_joint', 'name of the right wheel in joint_states')
    left_joint: str = setting('left_wheel_joint', 'name of the left wheel in joint_states')
    joint_rate: float = setting(
        20.0, 'how often joint_states is published; 0 = never', unit='Hz', low=0.0, high=1000.0
    )
    range_rate: float = setting(
        20.0, 'how often each of range/* is published; 0 = never', unit='Hz', low=0.0, high=1000.0
    )
    range_infinity: bool = setting(
        True,
        'tell inf where a distance sensor sees nothing (REP 117); false: max_range, which some '
        'take for a free view (clear_on_max_reading of the range sensor layer)',
        live=True,
    )
    publish_tf: bool = setting(True, 'publish the transform, where tf2_ros is installed')


@dataclass(frozen=True)
class SimRobotNodeSettings(RobotTopicSettings, TwinSettings):
    """The simulated robot as a node."""

    world_frame: str = setting('odom', 'frame of ground_truth/odom')
    publish_clock: bool = setting(
        False, 'make the time, and publish it as /clock, instead of following the machine'
    )
    speed: float = setting(
        1.0,
        'simulated seconds per second; 0 = time stands, and ~/step moves it. Other than 1 with '
        'publish_clock only',
        low=0.0,
        high=100.0,
        live=True,
    )
    step_time: float = setting(
        0.01,
        'time that ~/step lets pass: whole periods, at least one',
        unit='s',
        low=0.001,
        # Streams are made up for, and queues hold, no more than this at once.
        high=0.5,
        live=True,
    )
    start_x: float = setting(
        0.0, 'where the robot stands at first, and ~/set_pose puts it', unit='m', live=True
    )
    start_y: float = setting(
        0.0, 'where the robot stands at first, and ~/set_pose puts it', unit='m', live=True
    )
    start_heading: float = setting(
        0.0, 'where it looks at first, and ~/set_pose points it', unit='rad', live=True
    )

    @property
    def start(self) -> Pose:
        """Where the robot stands at first, in the world."""
        return Pose(self.start_x, self.start_y, self.start_heading)

    @property
    def step_periods(self) -> int:
        """How many periods ``~/step`` lets pass."""
        return max(1, round(self.step_time * self.rate))

    def check_together(self) -> None:
        """Raise :class:`SettingError` for a drive that takes no velocities, or has not the parts.

        And for a time of its own that nobody would hear of.
        """
        super().check_together()
        kind = self.drive.kind
        if kind == 'torque':
            raise SettingError(
                'drive.kind must be stepper or velocity, because cmd_vel is a velocity: '
                'got torque, which is for the lab'
            )
        if kind == 'velocity':
            faults = {'faults': active(self.faults), 'faults.schedule': self.faults.schedule}
            for name, value in {'world': self.world, **faults}.items():
                if value:
                    raise SettingError(
                        f'drive.kind must be stepper for {name} to have an effect: '
                        f'got velocity with {value if isinstance(value, str) else value[0]}'
                    )
        if self.speed != 1.0 and not self.publish_clock:
            raise SettingError(
                'publish_clock must be true at start for a speed other than 1, or nobody hears '
                f'what time it is: got speed {self.speed:g} without it'
            )


@dataclass(frozen=True)
class RadioBridgeSettings(RobotTopicSettings, RadioRobotSettings):
    """The real robot, over the radio, as a node."""

    port: str = setting(
        '/dev/t3mpc_dongle',
        'serial port of the dongle; the udev rule of the package gives it this name, otherwise '
        'one of /dev/serial/by-id',
    )
    key_file: str = setting(
        '', 'file with the key of the robot (32 hexadecimal digits, yours alone); empty = open'
    )
    imu: ImuSettings = nested(ImuSettings)
    sharp: SharpSettings = nested(SharpSettings)
    battery: BatterySettings = nested(BatterySettings)


@dataclass(frozen=True)
class RecorderSettings(RecordingSettings):
    """The recorder as a node."""


@dataclass(frozen=True)
class ReplayerSettings(PlaybackSettings):
    """The replayer as a node."""

    allow_commands: bool = setting(
        False, 'publish cmd_vel and other velocities under their own name: a robot may move'
    )
    quality_overrides: str = setting(
        '', 'YAML file with the quality of service of some topics, as ros2 bag play takes it'
    )
    wait_for_subscribers: float = setting(
        0.5, 'how long to wait at most until every topic is listened to', unit='s', low=0.0
    )
    delay: float = setting(0.0, 'how long to wait at least', unit='s', low=0.0)
    realtime_priority: int = setting(
        0,
        'priority of the thread that publishes before everything that has none (SCHED_FIFO), for '
        'punctuality on a busy machine; 0 = none. Needs the right to it: rtprio in limits.conf',
        low=0,
        high=99,
    )
    keyboard: bool = setting(
        True,
        'in a terminal: space pauses, right plays the next message, left goes back 5 s, up and '
        'down (+ and -) change the rate',
    )
    progress: bool = setting(True, 'in a terminal: show how far it is')
    exit_at_end: bool = setting(True, 'end the process at the end of the bag')


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
    'radio_bridge': RadioBridgeSettings,
    'recorder': RecorderSettings,
    'replayer': ReplayerSettings,
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
