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
"""Roles of the topics of a bag: odometry, command, reference, ground truth."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from t3mpc_ros.control.controller import SCALAR_NAMES

if TYPE_CHECKING:  # a figure of a simulated run needs the names only
    from t3mpc_ros.bag.metadata_yaml import TopicInformation
    from t3mpc_ros.bag.reader import BagReader

TRUTH, ODOMETRY, REFERENCE, COMMAND = 'ground_truth/odom', 'odom', 'reference', 'cmd_vel'
SIGNALS = 'reference/signals'
SCALARS = frozenset(f'controller/{name}' for name in SCALAR_NAMES)
"""Scalars of the controller, which follow from its journal."""
JOURNAL = 'controller/journal'
INITIAL_INPUTS = 'controller/initial_inputs/'
"""Topics on which the controller republishes its first inputs; they are no topics of a robot."""
NAMES = (
    REFERENCE, ODOMETRY, TRUTH, COMMAND, SIGNALS, *(f'controller/{name}' for name in SCALAR_NAMES)
)  # fmt: skip

_ODOMETRY, _TWIST = 'nav_msgs/msg/Odometry', 'geometry_msgs/msg/Twist'
_TWISTS = (_TWIST, f'{_TWIST}Stamped')
KINDS: Mapping[str, tuple[str, ...]] = {
    TRUTH: (_ODOMETRY,),
    ODOMETRY: (_ODOMETRY,),
    REFERENCE: (_ODOMETRY, *_TWISTS),
    COMMAND: _TWISTS,
    SIGNALS: ('std_msgs/msg/Int32MultiArray',),
    **dict.fromkeys(SCALARS, ('std_msgs/msg/Float64',)),
}
"""Message types by role."""


class ReportError(RuntimeError):
    """No report can be made of the bag; the text names what is missing and what was found."""


@dataclass(frozen=True)
class ReportOptions:
    """Options of a report; all optional."""

    namespace: str | None = None
    """Namespace; by default that of the robot with the most known topics."""
    odom: str = ''
    """Full topic name, as the next two; empty: chosen by name, else by type."""
    cmd_vel: str = ''
    reference: str = ''
    wheel_radius: float | None = None
    """m; by default from the recorded parameters."""
    track: float | None = None
    """Distance between the wheels, m; by default from the recorded parameters."""


@dataclass(frozen=True)
class TopicChoice:
    """Topics a report is made from."""

    topics: Mapping[str, str]
    """Full name by relative name, of topics with at least one message."""
    namespaces: tuple[str, ...]
    """The chosen namespace, then others with known topics."""
    ours: bool
    """Whether the bag holds more than any robot's: a reference, or control terms."""
    notes: tuple[str, ...]


def choose_topics(recording: 'BagReader', wanted: ReportOptions) -> TopicChoice:
    """Return the topic of each role."""
    names, namespaces = find_topics(recording.topics, wanted.namespace)
    if wanted.namespace:
        _check_namespace(recording, namespaces)
    filled = {name: topic for name, topic in recording.topics.items() if topic.message_count}
    chosen = {
        name: full
        for name, full in names.items()
        if full in filled and filled[full].type_name in KINDS[name]
    }
    given = {ODOMETRY: wanted.odom, COMMAND: wanted.cmd_vel, REFERENCE: wanted.reference}
    for name, full in given.items():
        if full:
            chosen[name] = _requested_topic(recording, name, full)
    if wanted.odom and not wanted.namespace:
        chosen.pop(TRUTH, None)  # errors refer to the given topic
    notes = _choose_by_type(chosen, filled.values(), wanted, namespaces[0])
    _check_distinct(chosen)
    if not chosen:
        raise ReportError(
            f'{recording.folder}: there is nothing to report: no message of odometry '
            f'({_ODOMETRY}) and none of a command ({" or ".join(_TWISTS)}); found: '
            f'{_listing(recording)}'
        )
    ours = bool({REFERENCE, SIGNALS, *SCALARS} & set(chosen)) and not wanted.reference
    return TopicChoice(chosen, namespaces, ours, tuple(notes))


def _check_namespace(recording: 'BagReader', namespaces: Sequence[str]) -> None:
    """Raise ReportError unless a topic is in the first namespace."""
    if not any(topic.startswith(f'{namespaces[0]}/') for topic in recording.topics):
        known = ', '.join(each or '/' for each in namespaces[1:]) or 'none with known topics'
        raise ReportError(
            f'{recording.folder}: no topic is in the namespace {namespaces[0]}; namespaces in the '
            f'bag: {known}'
        )


def _choose_by_type(
    chosen: dict[str, str],
    topics: 'Iterable[TopicInformation]',
    wanted: ReportOptions,
    preferred: str,
) -> list[str]:
    """Choose odometry and command by their type where no topic has their name; return notes."""
    notes = []
    for name, given, what, option in (
        (ODOMETRY, wanted.odom, 'Odometry', '--odom'),
        (COMMAND, wanted.cmd_vel, 'The command', '--cmd-vel'),
    ):
        if given:
            continue
        others = _candidates(name, topics, chosen, wanted.namespace, preferred)
        by_name = name in chosen
        if not by_name and others:
            chosen[name] = others.pop(0)
        if others or (name in chosen and not by_name):
            rest = f'; there is also {", ".join(others)} ({option} chooses)' if others else ''
            notes.append(f'{what} is taken from {chosen[name]}{rest}.')
    return notes


def _check_distinct(chosen: Mapping[str, str]) -> None:
    """Raise ReportError if two roles have the same topic."""
    for name, full in chosen.items():
        others = [other for other, topic in chosen.items() if topic == full and other != name]
        if others:
            raise ReportError(f'{full} is given as {name} and as {others[0]}: choose another one')


def _candidates(
    name: str,
    topics: 'Iterable[TopicInformation]',
    chosen: Mapping[str, str],
    namespace: str | None,
    preferred: str,
) -> list[str]:
    """Return the topics that a role may have by their type, beside the chosen ones.

    Those of the preferred namespace come first, then those with most messages.
    """
    space = f'/{namespace.strip("/")}/' if namespace else ''
    found = [
        topic
        for topic in topics
        if topic.type_name in KINDS[name]
        and topic.name not in chosen.values()
        and f'/{INITIAL_INPUTS}' not in topic.name
        and not any(topic.name.endswith(f'/{known}') for known in NAMES if known != name)
        and topic.name.startswith(space)
    ]
    found.sort(key=lambda t: (not t.name.startswith(f'{preferred}/'), -t.message_count, t.name))
    return [topic.name for topic in found]


def _requested_topic(recording: 'BagReader', name: str, full: str) -> str:
    """Return the full name of a given topic, after checking that it is usable."""
    topic = recording.topics.get(full) or recording.topics.get(f'/{full}')
    if topic is None:
        raise ReportError(
            f'{recording.folder}: there is no topic {full}; found: {_listing(recording)}'
        )
    if topic.type_name not in KINDS[name]:
        raise ReportError(
            f'{topic.name} must be {" or ".join(KINDS[name])}: it is {topic.type_name}'
        )
    if not topic.message_count:
        raise ReportError(f'{topic.name} has no message')
    return topic.name


_MAX_LISTED = 20  # further topics are only counted


def _listing(recording: 'BagReader') -> str:
    topics = list(recording.topics.values())
    words = [f'{t.name} ({t.type_name}, {t.message_count} messages)' for t in topics[:_MAX_LISTED]]
    more = [f'{len(topics) - _MAX_LISTED} more'] if len(topics) > _MAX_LISTED else []
    return ', '.join(words + more) or 'no topic at all'


def bag_display_name(folder: Path) -> str:
    """Return a short name of a bag: its folder, or the one above if the folder is ``bag``."""
    folder = folder.resolve()
    return f'{folder.parent.name}/bag' if folder.name == 'bag' else folder.name


def find_topics(
    names: Iterable[str], namespace: str | None = None
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return full names by relative names, and the namespaces, the chosen one first.

    A topic belongs to the longest known name it ends with, so ``/a/ground_truth/odom`` is never
    taken for the ``odom`` of ``/a/ground_truth``. Without ``namespace`` the one with the most
    known topics is chosen.
    """
    found: dict[str, dict[str, str]] = {}
    for full in names:
        if f'/{INITIAL_INPUTS}' in full:
            continue
        known = [name for name in NAMES if full.endswith(f'/{name}')]
        if known:
            name = max(known, key=len)
            found.setdefault(full[: -len(name) - 1], {})[name] = full
    order = sorted(found, key=lambda space: (-len(found[space]), space))
    if namespace is not None:
        chosen = '/' + namespace.strip('/') if namespace.strip('/') else ''
        order = [chosen, *(space for space in order if space != chosen)]
    order = order or ['']
    return found.get(order[0], {}), tuple(order)
