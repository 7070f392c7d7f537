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
"""QoS profiles: the encoding of rosbag2, offers for playback, override files.

Policy names and numbers follow ``rosbag2_storage/src/rosbag2_storage/qos.cpp`` (branch jazzy,
metadata version 9) and ``rmw/src/qos_string_conversions.c``. The offer for playback follows
``rosbag2_transport/src/rosbag2_transport/qos.cpp`` with two differences: if recorded offers
differ, rosbag2 offers the default profile, whereas :func:`adapt_offer_to_recorded_offers` offers
the strongest policy of each kind, which is compatible with every subscription to the recorded
publishers; and a transient-local topic keeps one message per recorded publisher instead of ten.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.parameters.yaml_loader import PlainDumper, file_errors, read_yaml, shortened

UNLIMITED = 2**63 - 1
"""RMW_DURATION_INFINITE in nanoseconds: 9223372036 s and 854775807 ns."""
TRANSIENT_LOCAL = 'transient_local'
PUBLISHER_DEPTH = 1000
"""History depth of a publisher of the player."""

# In the order of the enumerations in rmw/types.h: metadata before version 9 contains the numbers.
POLICIES = {
    'history': ('system_default', 'keep_last', 'keep_all', 'unknown'),
    'reliability': ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available'),
    'durability': ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available'),
    'liveliness': (
        'system_default', 'automatic', 'manual_by_node', 'manual_by_topic', 'unknown',
        'best_available',
    ),
}  # fmt: skip

# Infinite durations of Fast DDS and Connext in bags of Foxy; rosbag2 converts them as well.
_FOXY_UNLIMITED = {(0x7FFFFFFF, 0xFFFFFFFF), (0x7FFFFFFF, 0x7FFFFFFF)}
_LIVELINESS = ('automatic', 'manual_by_node', 'manual_by_topic')
"""From the weakest to the strongest."""
_DURATIONS = ('deadline', 'lifespan', 'liveliness_lease_duration')


class QosError(BagError):
    """A QoS profile that rosbag2 rejects."""


@dataclass(frozen=True)
class QosProfile:
    """Offered QoS profile of one publisher; policy names as in :data:`POLICIES`.

    Durations are ``int`` nanoseconds; 0 means unspecified.
    """

    history: str = 'keep_last'
    depth: int = 10
    reliability: str = 'reliable'
    durability: str = 'volatile'
    deadline_ns: int = UNLIMITED
    lifespan_ns: int = UNLIMITED
    liveliness: str = 'automatic'
    liveliness_lease_ns: int = UNLIMITED
    avoid_ros_namespace_conventions: bool = False

    def __post_init__(self) -> None:
        for name, policies in POLICIES.items():
            if getattr(self, name) not in policies:
                raise QosError(
                    f'{name} must be one of {", ".join(policies)}: got {getattr(self, name)!r}'
                )
        for name in ('depth', 'deadline_ns', 'lifespan_ns', 'liveliness_lease_ns'):
            value = getattr(self, name)
            if not isinstance(value, int) or not 0 <= value <= UNLIMITED:
                raise QosError(f'{name} must be a non-negative integer: got {value!r}')

    def to_mapping(self) -> dict[str, Any]:
        """Return the profile as in metadata version 9, in the order of rosbag2."""
        return {
            'history': self.history,
            'depth': self.depth,
            'reliability': self.reliability,
            'durability': self.durability,
            'deadline': _duration_to_mapping(self.deadline_ns),
            'lifespan': _duration_to_mapping(self.lifespan_ns),
            'liveliness': self.liveliness,
            'liveliness_lease_duration': _duration_to_mapping(self.liveliness_lease_ns),
            'avoid_ros_namespace_conventions': self.avoid_ros_namespace_conventions,
        }

    @classmethod
    def from_object(cls, profile: Any, nanoseconds: Callable[[Any], int]) -> 'QosProfile':
        """Return a profile of rclpy or rosbags, given how to convert its durations."""
        fields: dict[str, Any] = {name: getattr(profile, name).name.lower() for name in POLICIES}
        for name in _DURATIONS:
            value = min(nanoseconds(getattr(profile, name)), UNLIMITED)
            fields[f'{name.removesuffix("_duration")}_ns'] = value
        fields['avoid_ros_namespace_conventions'] = profile.avoid_ros_namespace_conventions
        return cls(depth=max(0, profile.depth), **fields)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> 'QosProfile':
        """Return the profile in ``mapping``; policies are names or numbers."""
        try:
            return cls(
                depth=int(mapping['depth']),
                deadline_ns=_duration_from_mapping(mapping['deadline']),
                lifespan_ns=_duration_from_mapping(mapping['lifespan']),
                liveliness_lease_ns=_duration_from_mapping(mapping['liveliness_lease_duration']),
                avoid_ros_namespace_conventions=bool(mapping['avoid_ros_namespace_conventions']),
                **{
                    name: known[value] if isinstance(value, int) else str(value)
                    for name, known in POLICIES.items()
                    for value in (mapping[name],)
                },
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise QosError(f'not a QoS profile: {error!r}') from error


def profiles_to_yaml(profiles: Iterable[QosProfile]) -> str:
    """Return the value of ``offered_qos_profiles`` in the metadata of a channel."""
    return dump_yaml([profile.to_mapping() for profile in profiles]).rstrip('\n')


def profiles_from_yaml(text: str) -> tuple[QosProfile, ...]:
    """Return the profiles in ``offered_qos_profiles`` of a channel; none for an empty text."""
    try:
        items = yaml.safe_load(text) if text else []
    except yaml.YAMLError as error:
        raise QosError(f'not YAML: {error}') from error
    if not isinstance(items, list):
        raise QosError(f'profiles must be a list: got {type(items).__name__}')
    return tuple(QosProfile.from_mapping(item) for item in items)


def dump_yaml(value: object) -> str:
    """Return ``value`` as block YAML in the given order, without anchors or folded lines."""
    return yaml.dump(
        value,
        Dumper=PlainDumper,
        sort_keys=False,
        default_flow_style=False,
        allow_unicode=True,
        width=2**31,
    )


def adapt_offer_to_recorded_offers(recorded: Iterable[QosProfile]) -> QosProfile:
    """Return a profile that is compatible with every subscription to the recorded publishers."""
    profiles = list(recorded)
    if not profiles:
        return QosProfile(depth=PUBLISHER_DEPTH)
    latched = sum(max(1, p.depth) for p in profiles if p.durability == TRANSIENT_LOCAL)
    weak = all(profile.reliability == 'best_effort' for profile in profiles)
    liveliness = [p.liveliness for p in profiles if p.liveliness in _LIVELINESS]
    return QosProfile(
        history='keep_last',
        depth=latched or PUBLISHER_DEPTH,
        reliability='best_effort' if weak else 'reliable',
        durability=TRANSIENT_LOCAL if latched else 'volatile',
        deadline_ns=_shortest(profile.deadline_ns for profile in profiles),
        lifespan_ns=max(profile.lifespan_ns or UNLIMITED for profile in profiles),
        liveliness=max(liveliness, key=_LIVELINESS.index, default='automatic'),
        liveliness_lease_ns=_shortest(profile.liveliness_lease_ns for profile in profiles),
        avoid_ros_namespace_conventions=all(p.avoid_ros_namespace_conventions for p in profiles),
    )


def read_qos_overrides(path: Path | str) -> dict[str, QosProfile]:
    """Return profiles by topic from a file in the format of ``--qos-profile-overrides-path``.

    Unspecified policies are those of the default publisher: reliable, volatile, keep last 10.
    What ``ros2 bag`` does not accept raises :class:`QosError`.
    """
    path = Path(path).expanduser()
    with file_errors(path, QosError):
        content = read_yaml(path)
    if not isinstance(content, dict):
        raise QosError(f'{path} must contain profiles by topic: got {type(content).__name__}')
    return {
        str(topic): _override_profile(str(topic), policies) for topic, policies in content.items()
    }


def _override_profile(topic: str, policies: Any) -> QosProfile:
    default = QosProfile().to_mapping()
    if not isinstance(policies, Mapping):
        raise QosError(
            f'{topic} must have policies such as reliability: got {shortened(policies)}'
        )
    for name, value in policies.items():
        if name not in default:
            raise QosError(f'{topic}: {name!r} is none of {", ".join(default)}')
        complete = isinstance(value, Mapping) and {'sec', 'nsec'} <= set(value)
        if name in _DURATIONS and not complete:
            raise QosError(f'{topic}: {name} must have sec and nsec: got {shortened(value)}')
    try:
        return QosProfile.from_mapping({**default, **policies})
    except QosError as error:
        raise QosError(f'{topic}: {error}') from error


def _shortest(durations_ns: Iterable[int]) -> int:
    """Return the strictest duration; 0 means unspecified."""
    return min((duration for duration in durations_ns if duration), default=UNLIMITED)


def _duration_to_mapping(duration_ns: int) -> dict[str, int]:
    return {'sec': duration_ns // NANOSECONDS, 'nsec': duration_ns % NANOSECONDS}


def _duration_from_mapping(mapping: Mapping[str, Any]) -> int:
    seconds, nanoseconds = int(mapping['sec']), int(mapping['nsec'])
    if (seconds, nanoseconds) in _FOXY_UNLIMITED:
        return UNLIMITED
    return min(seconds * NANOSECONDS + nanoseconds, UNLIMITED)
