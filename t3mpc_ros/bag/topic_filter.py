# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Topic filters of recorder and player: names, wildcards, regular expressions and types."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
import re

from t3mpc_ros.bag.schema import BagError


class TopicFilterError(BagError):
    """A regular expression that is none."""


def compile_regex(name: str, text: str) -> re.Pattern[str] | None:
    """Return ``text`` as a regular expression, None when it is empty.

    Raises
    ------
    SelectionError
        It is none; the error says where, and names the setting ``name``.
    """
    if not text:
        return None
    try:
        return re.compile(text)
    except re.error as error:
        raise TopicFilterError(
            f'{name} must be a regular expression: got {text!r} ({error})'
        ) from (error)


class TopicFilter:
    """Which topics are wanted.

    A topic is wanted when any of the ways below names it, unless ``exclude`` does. Topics that
    ROS hides (a part of the name begins with ``_``) are wanted by their full name only.

    Parameters
    ----------
    names
        Full names, as the node resolves them.
    patterns
        Names in which ``*`` stands for anything, slashes too; relative ones are of
        ``namespace``.
    regex, exclude
        Regular expressions which the full name has to match from end to end, as
        ``ros2 bag record`` takes them; empty = none.
    types
        Names such as ``nav_msgs/msg/Odometry``.
    namespace
        Of the node, such as ``/robot``.

    Raises
    ------
    SelectionError
        ``regex`` or ``exclude`` is no regular expression.
    """

    def __init__(
        self,
        names: Iterable[str],
        patterns: Iterable[str] = (),
        *,
        regex: str = '',
        exclude: str = '',
        types: Iterable[str] = (),
        namespace: str = '/',
    ) -> None:
        base = namespace.rstrip('/')
        self._names = frozenset(names)
        self._patterns = [
            text if text.startswith('/') else f'{base}/{text}' for text in dict.fromkeys(patterns)
        ]
        self._regex = compile_regex('regex', regex)
        self._exclude = compile_regex('exclude', exclude)
        self._types = frozenset(types)

    def matches(self, topic: str, types: Iterable[str] = ()) -> bool:
        """Return whether ``topic``, which is published as ``types``, is to be recorded."""
        if self._exclude and self._exclude.fullmatch(topic):
            return False
        if topic in self._names:
            return True
        if '/_' in topic:
            return False
        if any(fnmatchcase(topic, pattern) for pattern in self._patterns):
            return True
        if self._regex and self._regex.fullmatch(topic):
            return True
        return not self._types.isdisjoint(types)


class PlayTopicFilterError(ValueError):
    """A pattern or a renaming that cannot be used; the text names it."""


@dataclass(frozen=True)
class PlayTopicFilter:
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
                raise PlayTopicFilterError(
                    f'{name} must be a regular expression: got {getattr(self, name)!r} ({error})'
                ) from error

    def selects(self, topic: str) -> bool:
        """Return whether a topic of a bag is wanted."""
        if _matches(topic, self.exclude, self.exclude_regex):
            return False
        return not (self.topics or self.regex) or _matches(topic, self.topics, self.regex)

    def remapped_name(self, topic: str) -> str:
        """Return the name under which a topic of a bag is played."""
        return self.remap.get(topic, topic)


def parse_remappings(items: Sequence[str]) -> dict[str, str]:
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
            raise PlayTopicFilterError(f'remap must be a list of old:=new: got {item!r}')
        if _absolute_name(old) in result:
            raise PlayTopicFilterError(
                f'remap must name a topic once: got {_absolute_name(old)} again'
            )
        result[_absolute_name(old)] = _absolute_name(new)
    return result


def _matches(topic: str, patterns: tuple[str, ...], regex: str) -> bool:
    if regex and re.fullmatch(regex, topic):
        return True
    return any(fnmatchcase(topic, _absolute_name(pattern)) for pattern in patterns)


def _absolute_name(name: str) -> str:
    return name if name.startswith(('/', '*')) else f'/{name}'
