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
"""Parameters of a recording."""

from dataclasses import dataclass

from t3mpc_ros.bag.topic_filter import compile_regex
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

MEBIBYTE = 2**20


@dataclass(frozen=True)
class RecordingParameters(Parameters):
    """Parameters of a recording."""

    prefix = 'storage.'
    uri: str = parameter(
        '',
        'folder of the bag; empty = bag_<time> in the working directory; an existing bag is '
        'continued',
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
            'controller/journal',
            'controller/parameters',
            'controller/initial_inputs/*',
            '/diagnostics',
        ),
        'topics to record; * matches any text; relative names are in the namespace of the node; '
        'the scalars of the controller are recomputed from its journal',
        name='record.topics',
    )
    regex: str = parameter(
        '',
        'also record topics whose full name matches this regular expression from end to end, '
        'such as /camera/.*; empty = none',
        name='record.regex',
    )
    exclude_topics: tuple[str, ...] = parameter(
        (),
        'topics that are not recorded; * matches any text; relative names are in the namespace '
        'of the node',
        name='record.exclude_topics',
    )
    exclude_regex: str = parameter(
        '',
        'do not record topics whose full name matches this regular expression from end to end; '
        'empty = none',
        name='record.exclude_regex',
    )
    topic_types: tuple[str, ...] = parameter(
        (),
        'also record all topics of these message types, such as nav_msgs/msg/Odometry',
        name='record.topic_types',
    )
    chunk_size: int = parameter(
        262_144, 'size at which a chunk is compressed and written', 'B', (1024, 2**26)
    )
    chunk_duration: float = parameter(
        0.5,
        'age of the oldest message at which a chunk is compressed and written; a killed recorder '
        'loses the messages of this time plus at most 0.1 s',
        's',
        (0.05, 60.0),
    )
    max_bagfile_size: int = parameter(
        0, 'size at which the next file of the bag begins; 0 = never', 'B', (0, None)
    )
    max_bagfile_duration: float = parameter(
        0.0, 'duration at which the next file of the bag begins; 0 = never', 's', (0.0, None)
    )
    max_cache_size: int = parameter(
        64 * MEBIBYTE,
        'maximum memory of the write queue; further messages are dropped, counted and reported',
        'B',
        (65_536, 2**34),
    )
    snapshot_mode: bool = parameter(
        False, 'record snapshots only, to wait for rare events over days'
    )
    snapshot_duration: float = parameter(
        30.0,
        'time that a snapshot covers: ~/snapshot or a fault writes the messages received in this '
        'time to a bag in the folder snapshots; 0 = no snapshots',
        's',
        (0.0, 3600.0),
    )
    snapshot_cache_size: int = parameter(
        128 * MEBIBYTE,
        'maximum memory of the messages of a snapshot; at this limit a snapshot covers less time',
        'B',
        (65_536, 2**34),
    )
    monitored_nodes: tuple[str, ...] = parameter(
        ('controller', 'sim_robot', 'radio_bridge'),
        'nodes whose change to an error in /diagnostics, or whose missing report, triggers a '
        'snapshot: a stopped controller, an emergency stop, a lost link; relative names are in '
        'the namespace of the node; empty = none',
        name='snapshot.monitored_nodes',
    )
    snapshot_min_interval: float = parameter(
        10.0,
        'minimum time between two automatic snapshots',
        's',
        (0.0, 86_400.0),
        name='snapshot.min_interval',
    )
    snapshot_max_count: int = parameter(
        50,
        'maximum number of automatic snapshots per run',
        name='snapshot.max_count',
        bounds=(0, 100_000),
    )
    attachments: tuple[str, ...] = parameter(
        (),
        'files attached to the bag, such as the description of a world',
        name='record.attachments',
    )
    attach_models: bool = parameter(
        True,
        'attach the model file that a controller loads at the start, and the one it saves during '
        'the recording, if the recorder can read them',
        name='record.attach_models',
    )
    max_attachment_size: int = parameter(
        16 * MEBIBYTE,
        'maximum size of an attached file',
        'B',
        (1, 2**30),
        name='record.max_attachment_size',
    )

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for an invalid filter or an empty recording."""
        super().check_consistency()
        compile_regex('record.regex', self.regex)
        compile_regex('record.exclude_regex', self.exclude_regex)
        for name in self.topic_types:
            if name.count('/') != 2 or '/msg/' not in name:
                raise ParameterError(
                    f'record.topic_types must be names like nav_msgs/msg/Odometry: got {name!r}'
                )
        if self.snapshot_mode and not self.snapshot_duration:
            raise ParameterError(
                'storage.snapshot_duration must be above 0 with storage.snapshot_mode, because '
                'nothing would be recorded: got 0'
            )
