# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What one publisher has to offer in the place of those that were recorded.

As ``ros2 bag play`` does it (``rosbag2_transport/src/rosbag2_transport/qos.cpp``), with two
differences: where recorded offers differ it gives up and offers the default, this offers the
strongest of each kind, so that everyone who heard the recorded publishers hears this one; and a
latched topic keeps one message for each of its publishers instead of ten.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from t3mpc_ros.record.playback.bag import LATCHED
from t3mpc_ros.record.quality import UNLIMITED, QualityError, QualityProfile

BACKLOG = 1000
"""Messages that wait for a listener that is busy; DDS gives up the oldest beyond that."""

_LIVELINESS = ('automatic', 'manual_by_node', 'manual_by_topic')
"""From the weakest to the strongest."""
_DURATIONS = ('deadline', 'lifespan', 'liveliness_lease_duration')


def profile_to_offer(recorded: Iterable[QualityProfile]) -> QualityProfile:
    """Return a profile that everyone who heard all the recorded publishers is satisfied with."""
    profiles = list(recorded)
    if not profiles:
        return QualityProfile(depth=BACKLOG)
    latched = sum(max(1, p.depth) for p in profiles if p.durability == LATCHED)
    weak = all(profile.reliability == 'best_effort' for profile in profiles)
    liveliness = [p.liveliness for p in profiles if p.liveliness in _LIVELINESS]
    return QualityProfile(
        history='keep_last',
        depth=latched or BACKLOG,
        reliability='best_effort' if weak else 'reliable',
        durability=LATCHED if latched else 'volatile',
        deadline_ns=_shortest(profile.deadline_ns for profile in profiles),
        lifespan_ns=max(profile.lifespan_ns or UNLIMITED for profile in profiles),
        liveliness=max(liveliness, key=_LIVELINESS.index, default='automatic'),
        liveliness_lease_ns=_shortest(profile.liveliness_lease_ns for profile in profiles),
        avoid_ros_namespace_conventions=all(p.avoid_ros_namespace_conventions for p in profiles),
    )


def read_overrides(path: Path | str) -> dict[str, QualityProfile]:
    """Return profiles by topic from a file as ``--qos-profile-overrides-path`` takes it.

    What a topic does not say is that of a default publisher: reliable, volatile, the last 10.

    Raises
    ------
    QualityError
        The file cannot be read, or holds what ``ros2 bag`` would refuse.
    """
    path = Path(path).expanduser()
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise QualityError(f'{path} cannot be read: {error.strerror}') from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise QualityError(f'{path} is not YAML: {" ".join(str(error).split())}') from error
    if not isinstance(content, dict):
        raise QualityError(f'{path} must hold profiles by topic: got {type(content).__name__}')
    return {str(topic): _override(str(topic), policies) for topic, policies in content.items()}


def _override(topic: str, policies: Any) -> QualityProfile:
    default = QualityProfile().to_mapping()
    if not isinstance(policies, Mapping):
        raise QualityError(f'{topic} must have policies such as reliability: got {policies!r}')
    for name, value in policies.items():
        if name not in default:
            raise QualityError(f'{topic}: {name!r} is none of {", ".join(default)}')
        whole = isinstance(value, Mapping) and {'sec', 'nsec'} <= set(value)
        if name in _DURATIONS and not whole:
            raise QualityError(f'{topic}: {name} must have sec and nsec: got {value!r}')
    try:
        return QualityProfile.from_mapping({**default, **policies})
    except QualityError as error:
        raise QualityError(f'{topic}: {error}') from error


def _shortest(durations_ns: Iterable[int]) -> int:
    """Return the strictest duration; 0 is none at all."""
    return min((duration for duration in durations_ns if duration), default=UNLIMITED)
