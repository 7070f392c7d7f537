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
"""The ``metadata.yaml`` of a bag, version 9.

Fields follow ``rosbag2_storage/include/rosbag2_storage/yaml.hpp`` (branch jazzy).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.bag.qos import TRANSIENT_LOCAL, QosProfile, dump_yaml

METADATA_FILE_NAME = 'metadata.yaml'
METADATA_VERSION = 9
NO_START_NS = 2**63 - 1
"""Starting time of a file or bag without messages, as in rosbag2 (nanoseconds since 1970)."""

_ROOT = 'rosbag2_bagfile_information'


@dataclass(frozen=True)
class TopicInformation:
    """Topic of a bag and its message count."""

    name: str
    type_name: str
    offered_qos_profiles: tuple[QosProfile, ...] = ()
    """Profiles of the publishers."""
    type_hash: str = ''
    message_count: int = 0
    serialization_format: str = 'cdr'

    @property
    def transient_local_count(self) -> int:
        """Number of transient-local publishers."""
        return sum(p.durability == TRANSIENT_LOCAL for p in self.offered_qos_profiles)

    def merged(self, other: 'TopicInformation') -> 'TopicInformation':
        """Return this topic with the messages, and the other profiles, of ``other``."""
        own = self.offered_qos_profiles
        cdr = self.serialization_format == 'cdr'
        return replace(
            self,
            offered_qos_profiles=own
            + tuple(p for p in other.offered_qos_profiles if p not in own),
            message_count=self.message_count + other.message_count,
            serialization_format=other.serialization_format if cdr else self.serialization_format,
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return the entry of ``topics_with_message_count``."""
        return {
            'topic_metadata': {
                'name': self.name,
                'type': self.type_name,
                'serialization_format': self.serialization_format,
                'offered_qos_profiles': [
                    profile.to_mapping() for profile in self.offered_qos_profiles
                ],
                'type_description_hash': self.type_hash,
            },
            'message_count': self.message_count,
        }


@dataclass(frozen=True)
class FileInformation:
    """File of a bag; receive times in nanoseconds since 1970."""

    path: str
    """Relative to the folder of the bag."""
    start_ns: int = NO_START_NS
    duration_ns: int = 0
    message_count: int = 0

    def to_mapping(self) -> dict[str, Any]:
        """Return the entry of ``files``."""
        return {
            'path': self.path,
            'starting_time': {'nanoseconds_since_epoch': self.start_ns},
            'duration': {'nanoseconds': self.duration_ns},
            'message_count': self.message_count,
        }


@dataclass(frozen=True)
class BagMetadata:
    """Files and topics of a bag."""

    files: tuple[FileInformation, ...] = ()
    topics: tuple[TopicInformation, ...] = ()
    custom_data: Mapping[str, str] = field(default_factory=dict)
    ros_distro: str = 'jazzy'

    @property
    def start_ns(self) -> int:
        """Receive time of the first message; :data:`NO_START_NS` without messages."""
        return min(
            (file.start_ns for file in self.files if file.message_count), default=NO_START_NS
        )

    @property
    def duration_ns(self) -> int:
        """Time from the first to the last message of all files."""
        ends = [file.start_ns + file.duration_ns for file in self.files if file.message_count]
        return max(ends) - self.start_ns if ends else 0

    @property
    def message_count(self) -> int:
        """Number of messages in all files."""
        return sum(file.message_count for file in self.files)

    def to_mapping(self) -> dict[str, Any]:
        """Return the content below the root key, in the order of rosbag2."""
        return {
            'version': METADATA_VERSION,
            'storage_identifier': 'mcap',
            'duration': {'nanoseconds': self.duration_ns},
            'starting_time': {'nanoseconds_since_epoch': self.start_ns},
            'message_count': self.message_count,
            'topics_with_message_count': [topic.to_mapping() for topic in self.topics],
            # Chunks are compressed inside the MCAP file; the compression of rosbag2 is off.
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [file.path for file in self.files],
            'files': [file.to_mapping() for file in self.files],
            'custom_data': dict(self.custom_data),
            'ros_distro': self.ros_distro,
        }


def write_metadata(folder: Path, metadata: BagMetadata) -> None:
    """Replace ``metadata.yaml`` of a folder atomically."""
    text = dump_yaml({_ROOT: metadata.to_mapping()})
    write_atomically(folder / METADATA_FILE_NAME, text)


def read_origin(folder: Path) -> tuple[dict[str, str], str] | None:
    """Return custom data and ROS distribution in ``metadata.yaml``; None if it is unusable."""
    try:
        root = yaml.safe_load((folder / METADATA_FILE_NAME).read_text(encoding='utf-8'))[_ROOT]
        custom_data = {str(key): str(v) for key, v in (root['custom_data'] or {}).items()}
        return custom_data, str(root['ros_distro'])
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError):
        return None
