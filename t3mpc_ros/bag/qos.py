# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""QoS profiles of recorded publishers: encoding of rosbag2, offers for playback, override files."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.geometry.types import NANOSECONDS

TRANSIENT_LOCAL = 'transient_local'


UNLIMITED = 2**63 - 1
"""Nanoseconds that mean "no limit": 9223372036 s and 854775807 ns, RMW_DURATION_INFINITE."""

# In the order of the enumerations in rmw/types.h: bags before version 9 hold the numbers.
HISTORY = ('system_default', 'keep_last', 'keep_all', 'unknown')
RELIABILITY = ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available')
DURABILITY = ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available')
LIVELINESS = (
    'system_default',
    'automatic',
    'manual_by_node',
    'manual_by_topic',
    'unknown',
    'best_available',
)

# What Fast DDS and Connext called infinite when Foxy recorded; rosbag2 translates them too.
_FOXY_UNLIMITED = {(0x7FFFFFFF, 0xFFFFFFFF), (0x7FFFFFFF, 0x7FFFFFFF)}


class QosError(BagError):
    """A quality-of-service profile that rosbag2 would refuse."""


@dataclass(frozen=True)
class QosProfile:
    """What one publisher offers; the words are those of :data:`HISTORY` and its neighbours.

    Durations are ``int`` nanoseconds; :data:`UNLIMITED` is what publishers usually report and
    0 means unspecified.
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
        for name, words in (
            ('history', HISTORY),
            ('reliability', RELIABILITY),
            ('durability', DURABILITY),
            ('liveliness', LIVELINESS),
        ):
            if getattr(self, name) not in words:
                raise QosError(
                    f'{name} must be one of {", ".join(words)}: got {getattr(self, name)!r}'
                )
        for name in ('depth', 'deadline_ns', 'lifespan_ns', 'liveliness_lease_ns'):
            value = getattr(self, name)
            if not isinstance(value, int) or not 0 <= value <= UNLIMITED:
                raise QosError(f'{name} must be a whole number from 0: got {value!r}')

    def to_mapping(self) -> dict[str, Any]:
        """Return the mapping that version 9 has for one profile, in rosbag2's order."""
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
    def from_mapping(cls, mapping: Mapping[str, Any]) -> 'QosProfile':
        """Return the profile in ``mapping``; numbers in place of words are understood.

        Raises
        ------
        QosError
            A field is missing or holds what rosbag2 does not know.
        """
        try:
            return cls(
                history=_policy_name(mapping['history'], HISTORY),
                depth=int(mapping['depth']),
                reliability=_policy_name(mapping['reliability'], RELIABILITY),
                durability=_policy_name(mapping['durability'], DURABILITY),
                deadline_ns=_duration_from_mapping(mapping['deadline']),
                lifespan_ns=_duration_from_mapping(mapping['lifespan']),
                liveliness=_policy_name(mapping['liveliness'], LIVELINESS),
                liveliness_lease_ns=_duration_from_mapping(mapping['liveliness_lease_duration']),
                avoid_ros_namespace_conventions=bool(mapping['avoid_ros_namespace_conventions']),
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise QosError(f'not a quality-of-service profile: {error!r}') from error


def profiles_to_yaml(profiles: Iterable[QosProfile]) -> str:
    """Return the text of a channel's ``offered_qos_profiles``."""
    return dump_yaml([profile.to_mapping() for profile in profiles]).rstrip('\n')


def profiles_from_yaml(text: str) -> tuple[QosProfile, ...]:
    """Return the profiles in a channel's ``offered_qos_profiles``; none for an empty text."""
    try:
        items = yaml.safe_load(text) if text else []
    except yaml.YAMLError as error:
        raise QosError(f'not YAML: {error}') from error
    if not isinstance(items, list):
        raise QosError(f'profiles must be a list: got {type(items).__name__}')
    return tuple(QosProfile.from_mapping(item) for item in items)


def dump_yaml(value: object) -> str:
    """Return ``value`` as block YAML in the order given, without anchors or folded lines."""
    return yaml.dump(
        value,
        Dumper=_PlainDumper,
        sort_keys=False,
        default_flow_style=False,
        allow_unicode=True,
        width=2**31,
    )


class _PlainDumper(yaml.SafeDumper):
    """Equal profiles are written out, not as ``*id001``, which few would read in a bag."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _duration_to_mapping(duration_ns: int) -> dict[str, int]:
    return {'sec': duration_ns // NANOSECONDS, 'nsec': duration_ns % NANOSECONDS}


def _duration_from_mapping(mapping: Mapping[str, Any]) -> int:
    seconds, nanoseconds = int(mapping['sec']), int(mapping['nsec'])
    if (seconds, nanoseconds) in _FOXY_UNLIMITED:
        return UNLIMITED
    return min(seconds * NANOSECONDS + nanoseconds, UNLIMITED)


def _policy_name(value: Any, words: tuple[str, ...]) -> str:
    return words[value] if isinstance(value, int) else str(value)


PUBLISHER_DEPTH = 1000
"""Messages that wait for a listener that is busy; DDS gives up the oldest beyond that."""

_LIVELINESS = ('automatic', 'manual_by_node', 'manual_by_topic')
"""From the weakest to the strongest."""
_DURATIONS = ('deadline', 'lifespan', 'liveliness_lease_duration')


def adapt_offer_to_recorded_offers(recorded: Iterable[QosProfile]) -> QosProfile:
    """Return a profile that everyone who heard all the recorded publishers is satisfied with."""
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
    """Return profiles by topic from a file as ``--qos-profile-overrides-path`` takes it.

    What a topic does not say is that of a default publisher: reliable, volatile, the last 10.

    Raises
    ------
    QosError
        The file cannot be read, or holds what ``ros2 bag`` would refuse.
    """
    path = Path(path).expanduser()
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise QosError(f'{path} cannot be read: {error.strerror}') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise QosError(f'{path} is not YAML: {" ".join(str(error).split())}') from error
    if not isinstance(content, dict):
        raise QosError(f'{path} must hold profiles by topic: got {type(content).__name__}')
    return {
        str(topic): _override_profile(str(topic), policies) for topic, policies in content.items()
    }


def _override_profile(topic: str, policies: Any) -> QosProfile:
    default = QosProfile().to_mapping()
    if not isinstance(policies, Mapping):
        raise QosError(f'{topic} must have policies such as reliability: got {policies!r}')
    for name, value in policies.items():
        if name not in default:
            raise QosError(f'{topic}: {name!r} is none of {", ".join(default)}')
        whole = isinstance(value, Mapping) and {'sec', 'nsec'} <= set(value)
        if name in _DURATIONS and not whole:
            raise QosError(f'{topic}: {name} must have sec and nsec: got {value!r}')
    try:
        return QosProfile.from_mapping({**default, **policies})
    except QosError as error:
        raise QosError(f'{topic}: {error}') from error


def _shortest(durations_ns: Iterable[int]) -> int:
    """Return the strictest duration; 0 is none at all."""
    return min((duration for duration in durations_ns if duration), default=UNLIMITED)
