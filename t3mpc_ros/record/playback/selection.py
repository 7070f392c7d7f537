# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Which topics of a bag are played, under which name, and which must not move a robot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
import re

COMMAND = 'cmd_vel'
COMMAND_TYPES = ('geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistStamped')


class SelectionError(ValueError):
    """A pattern or a renaming that cannot be used; the text names it."""


@dataclass(frozen=True)
class Selection:
    """Which topics are played: those of ``topics`` or ``regex``, less the excluded ones.

    Patterns are names in which ``*`` stands for anything; a name without a leading slash is taken
    to begin with one. Regular expressions have to match the whole name, as in ``ros2 bag``.
    With neither ``topics`` nor ``regex`` everything is played.
    """

    topics: tuple[str, ...] = ()
    regex: str = ''
    exclude: tuple[str, ...] = ()
    exclude_regex: str = ''
    remap: Mapping[str, str] = field(default_factory=dict)
    """New names by recorded ones."""

    def __post_init__(self) -> None:
        for name in ('regex', 'exclude_regex'):
            try:
                re.compile(getattr(self, name))
            except re.error as error:
                raise SelectionError(
                    f'{name} must be a regular expression: got {getattr(self, name)!r} ({error})'
                ) from error

    def plays(self, topic: str) -> bool:
        """Return whether a topic of a bag is wanted."""
        if _matches(topic, self.exclude, self.exclude_regex):
            return False
        return not (self.topics or self.regex) or _matches(topic, self.topics, self.regex)

    def new_name(self, topic: str) -> str:
        """Return the name under which a topic of a bag is played."""
        return self.remap.get(topic, topic)


def renamings(items: Sequence[str]) -> dict[str, str]:
    """Return new names by old ones from ``old:=new``.

    Raises
    ------
    SelectionError
        An item is not of that form, or renames a topic a second time.
    """
    result: dict[str, str] = {}
    for item in items:
        old, mark, new = (part.strip() for part in item.partition(':='))
        if not (old and mark and new):
            raise SelectionError(f'remap must be a list of old:=new: got {item!r}')
        if _absolute(old) in result:
            raise SelectionError(f'remap must name a topic once: got {_absolute(old)} again')
        result[_absolute(old)] = _absolute(new)
    return result


def command_problem(recorded: str, name: str, type_name: str) -> str:
    """Return why a topic could drive a robot, empty when it cannot.

    A robot listens to ``cmd_vel``, or to a velocity of any other name that its launch file gave
    it: only a velocity that was renamed on purpose, to something else than ``cmd_vel``, is safe.
    """
    if name.rsplit('/', 1)[-1] == COMMAND:
        return f'{name} may drive a robot'
    if type_name in COMMAND_TYPES and name == recorded:
        return f'{name} is a velocity ({type_name}) and may drive a robot'
    return ''


def _matches(topic: str, patterns: tuple[str, ...], regex: str) -> bool:
    if regex and re.fullmatch(regex, topic):
        return True
    return any(fnmatchcase(topic, _absolute(pattern)) for pattern in patterns)


def _absolute(name: str) -> str:
    return name if name.startswith(('/', '*')) else f'/{name}'
