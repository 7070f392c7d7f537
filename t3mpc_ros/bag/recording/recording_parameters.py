# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parameters of a recording: topics, files, queue, snapshots and attachments."""

from dataclasses import dataclass

from t3mpc_ros.bag.topic_filter import TopicFilterError, compile_regex
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

MEBIBYTE = 2**20


@dataclass(frozen=True)
class RecordingParameters(Parameters):
    """A recording."""

    folder: str = parameter(
        '', 'folder of the bag; empty = bag_<time> here; one that exists is continued'
    )
    topics: tuple[str, ...] = parameter(
        (
            'reference',
            'reference/*',
            'odom',
            'ground_truth/*',
            'joint_states',
            'imu/*',
            'range/*',
            'battery_state',
            'cmd_vel',
            'controller/*',
            '/diagnostics',
        ),
        'topics to record; * stands for anything; relative names are of this namespace',
    )
    regex: str = parameter(
        '',
        'also record topics whose full name matches this regular expression from end to end, '
        'such as /camera/.*; empty = none',
    )
    exclude: str = parameter(
        '',
        'never record topics whose full name matches this regular expression from end to end; '
        'empty = none',
    )
    types: tuple[str, ...] = parameter(
        (), 'also record every topic of these message types, such as nav_msgs/msg/Odometry'
    )
    chunk_bytes: int = parameter(
        262_144, 'size at which a compressed chunk is closed', unit='B', low=1024, high=2**26
    )
    chunk_time: float = parameter(
        0.5,
        'age of its oldest message at which a chunk is closed and handed to the disk: what a '
        'killed recorder loses, but for a tenth of a second',
        unit='s',
        low=0.05,
        high=60.0,
    )
    split_bytes: int = parameter(
        0, 'size at which a file of the bag is followed by another; 0 = never', unit='B', low=0
    )
    split_time: float = parameter(
        0.0,
        'time of recording after which a file of the bag is followed by another; 0 = never',
        unit='s',
        low=0.0,
    )
    queue_bytes: int = parameter(
        64 * MEBIBYTE,
        'memory for messages that wait for the disk; what finds no room is dropped, counted, '
        'and told',
        unit='B',
        low=65_536,
        high=2**34,
    )
    snapshot_time: float = parameter(
        30.0,
        'how far back a snapshot reaches: ~/snapshot, or a fault, writes what came in this time '
        'as a bag of its own into snapshots; 0 = no snapshots',
        unit='s',
        low=0.0,
        high=3600.0,
    )
    snapshot_bytes: int = parameter(
        128 * MEBIBYTE,
        'memory for the messages of a snapshot; it reaches less far back when they need more',
        unit='B',
        low=65_536,
        high=2**34,
    )
    snapshot_only: bool = parameter(
        False, 'record nothing but the snapshots: for days of waiting for something rare'
    )
    snapshot_nodes: tuple[str, ...] = parameter(
        ('controller', 'sim_robot', 'radio_bridge'),
        'nodes whose change to an error in /diagnostics, or whose silence there, takes a '
        'snapshot: a controller that stops, an emergency stop, a lost link; relative names are '
        'of this namespace; empty = none',
    )
    snapshot_pause: float = parameter(
        10.0,
        'shortest time between two snapshots that nobody asked for',
        unit='s',
        low=0.0,
        high=86_400.0,
    )
    snapshot_most: int = parameter(
        50, 'most snapshots that nobody asked for in one run', low=0, high=100_000
    )
    attach: tuple[str, ...] = parameter(
        (), 'files to put into the bag as attachments, such as the description of a world'
    )
    attach_models: bool = parameter(
        True,
        'put the model file that a controller starts from, and the one it saves during the '
        'recording, into the bag, where the recorder can read them',
    )
    attach_bytes: int = parameter(
        16 * MEBIBYTE, 'largest file that is attached', unit='B', low=1, high=2**30
    )

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for what is no expression, no type, or records nothing."""
        super().check_consistency()
        for name in ('regex', 'exclude'):
            try:
                compile_regex(name, getattr(self, name))
            except TopicFilterError as error:
                raise ParameterError(str(error)) from error
        for name in self.types:
            if name.count('/') != 2 or '/msg/' not in name:
                raise ParameterError(
                    f'types must be names like nav_msgs/msg/Odometry: got {name!r}'
                )
        if self.snapshot_only and not self.snapshot_time:
            raise ParameterError(
                'snapshot_time must be above 0 with snapshot_only, or nothing is recorded: got 0'
            )
