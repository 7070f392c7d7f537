# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Quality-of-service profiles as data, in the YAML that rosbag2 of Jazzy writes and reads.

Words and numbers follow ``rosbag2_storage/src/rosbag2_storage/qos.cpp`` (branch jazzy, metadata
version 9) and ``rmw/src/qos_string_conversions.c``.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.record.schema import RecordError

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


class QualityError(RecordError):
    """A quality-of-service profile that rosbag2 would refuse."""


@dataclass(frozen=True)
class QualityProfile:
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
                raise QualityError(
                    f'{name} must be one of {", ".join(words)}: got {getattr(self, name)!r}'
                )
        for name in ('depth', 'deadline_ns', 'lifespan_ns', 'liveliness_lease_ns'):
            value = getattr(self, name)
            if not isinstance(value, int) or not 0 <= value <= UNLIMITED:
                raise QualityError(f'{name} must be a whole number from 0: got {value!r}')

    def to_mapping(self) -> dict[str, Any]:
        """Return the mapping that version 9 has for one profile, in rosbag2's order."""
        return {
            'history': self.history,
            'depth': self.depth,
            'reliability': self.reliability,
            'durability': self.durability,
            'deadline': _split(self.deadline_ns),
            'lifespan': _split(self.lifespan_ns),
            'liveliness': self.liveliness,
            'liveliness_lease_duration': _split(self.liveliness_lease_ns),
            'avoid_ros_namespace_conventions': self.avoid_ros_namespace_conventions,
        }

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> 'QualityProfile':
        """Return the profile in ``mapping``; numbers in place of words are understood.

        Raises
        ------
        QualityError
            A field is missing or holds what rosbag2 does not know.
        """
        try:
            return cls(
                history=_word(mapping['history'], HISTORY),
                depth=int(mapping['depth']),
                reliability=_word(mapping['reliability'], RELIABILITY),
                durability=_word(mapping['durability'], DURABILITY),
                deadline_ns=_join(mapping['deadline']),
                lifespan_ns=_join(mapping['lifespan']),
                liveliness=_word(mapping['liveliness'], LIVELINESS),
                liveliness_lease_ns=_join(mapping['liveliness_lease_duration']),
                avoid_ros_namespace_conventions=bool(mapping['avoid_ros_namespace_conventions']),
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise QualityError(f'not a quality-of-service profile: {error!r}') from error


def profiles_to_yaml(profiles: Iterable[QualityProfile]) -> str:
    """Return the text of a channel's ``offered_qos_profiles``."""
    return dump_yaml([profile.to_mapping() for profile in profiles]).rstrip('\n')


def profiles_from_yaml(text: str) -> tuple[QualityProfile, ...]:
    """Return the profiles in a channel's ``offered_qos_profiles``; none for an empty text."""
    try:
        items = yaml.safe_load(text) if text else []
    except yaml.YAMLError as error:
        raise QualityError(f'not YAML: {error}') from error
    if not isinstance(items, list):
        raise QualityError(f'profiles must be a list: got {type(items).__name__}')
    return tuple(QualityProfile.from_mapping(item) for item in items)


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


def _split(duration_ns: int) -> dict[str, int]:
    return {'sec': duration_ns // NANOSECONDS, 'nsec': duration_ns % NANOSECONDS}


def _join(mapping: Mapping[str, Any]) -> int:
    seconds, nanoseconds = int(mapping['sec']), int(mapping['nsec'])
    if (seconds, nanoseconds) in _FOXY_UNLIMITED:
        return UNLIMITED
    return min(seconds * NANOSECONDS + nanoseconds, UNLIMITED)


def _word(value: Any, words: tuple[str, ...]) -> str:
    return words[value] if isinstance(value, int) else str(value)
