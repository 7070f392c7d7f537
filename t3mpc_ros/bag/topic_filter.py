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
"""Topic filters of recorder and player: names, wildcards, regular expressions and types.

``exclude_topics`` and ``exclude_regex`` have the same meaning in both, see :class:`TopicPatterns`.
"""

from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
import re

from t3mpc_ros.parameters.table import ParameterError


class TopicPatterns:
    """Topic names with wildcards, and a regular expression for the full name.

    In ``names`` ``*`` matches any text including slashes; a name that begins with neither ``/``
    nor ``*`` is relative to ``namespace``. ``regex`` must match the full name from end to end, as
    in ``ros2 bag``; empty = none. An error names ``parameter``.
    """

    def __init__(
        self, names: Iterable[str], regex: str, *, parameter: str, namespace: str = '/'
    ) -> None:
        self._names = [resolve_name(name, namespace) for name in dict.fromkeys(names)]
        self._regex = compile_regex(parameter, regex)

    def __bool__(self) -> bool:
        return bool(self._names or self._regex)

    def matches(self, topic: str) -> bool:
        """Return whether a name or the regular expression matches the full name ``topic``."""
        if self._regex and self._regex.fullmatch(topic):
            return True
        return any(fnmatchcase(topic, name) for name in self._names)


class TopicFilter:
    """Filter of the recorder.

    A topic is recorded if any of the inclusion rules (full ``names``, ``patterns``, ``regex``,
    message ``types``) matches and no exclusion rule does, see :class:`TopicPatterns`; but a
    pattern that begins with ``*`` is relative. Hidden topics (a part of the name begins with
    ``_``) are recorded by their full name only.
    """

    def __init__(
        self,
        names: Iterable[str],
        patterns: Iterable[str] = (),
        *,
        regex: str = '',
        types: Iterable[str] = (),
        exclude_topics: Iterable[str] = (),
        exclude_regex: str = '',
        namespace: str = '/',
    ) -> None:
        base = namespace.rstrip('/')
        full = [text if text.startswith('/') else f'{base}/{text}' for text in patterns]
        self._names = frozenset(names)
        self._included = TopicPatterns(full, regex, parameter='record.regex')
        self._types = frozenset(types)
        self._excluded = TopicPatterns(
            exclude_topics, exclude_regex, parameter='record.exclude_regex', namespace=namespace
        )

    def matches(self, topic: str, types: Iterable[str] = ()) -> bool:
        """Return whether ``topic``, published with ``types``, is recorded."""
        if topic in self._names or '/_' in topic:
            return topic in self._names and not self._excluded.matches(topic)
        wanted = self._included.matches(topic) or not self._types.isdisjoint(types)
        return wanted and not self._excluded.matches(topic)


class PlayTopicFilter:
    """Filter and remapping rules of the player.

    A topic is played if ``topics`` or ``regex`` matches, or if both are empty, and no exclusion
    rule matches, see :class:`TopicPatterns`. ``remappings`` are new names by recorded names.
    """

    def __init__(
        self,
        topics: Iterable[str] = (),
        regex: str = '',
        exclude_topics: Iterable[str] = (),
        exclude_regex: str = '',
        remappings: Mapping[str, str] | None = None,
    ) -> None:
        self._included = TopicPatterns(topics, regex, parameter='play.regex_to_filter')
        self._excluded = TopicPatterns(
            exclude_topics, exclude_regex, parameter='play.exclude_regex'
        )
        self._remappings = dict(remappings or {})

    def matches(self, topic: str) -> bool:
        """Return whether a recorded topic is played."""
        included = not self._included or self._included.matches(topic)
        return included and not self._excluded.matches(topic)

    def remapped_name(self, topic: str) -> str:
        """Return the name under which a recorded topic is played."""
        return self._remappings.get(topic, topic)


def parse_remappings(items: Sequence[str]) -> dict[str, str]:
    """Return new names by recorded names from rules ``old:=new``, one per topic."""
    result: dict[str, str] = {}
    for item in items:
        old, mark, new = (part.strip() for part in item.partition(':='))
        if not (old and mark and new):
            raise ParameterError(
                f'play.topic_remapping_options must be a list of old:=new: got {item!r}'
            )
        name = resolve_name(old)
        if name in result:
            raise ParameterError(
                f'play.topic_remapping_options must have one rule per topic: got {name} again'
            )
        result[name] = resolve_name(new)
    return result


def compile_regex(parameter: str, text: str) -> re.Pattern[str] | None:
    """Return ``text`` as a regular expression, None if empty; an error names ``parameter``."""
    if not text:
        return None
    try:
        return re.compile(text)
    except re.error as error:
        raise ParameterError(
            f'{parameter} must be a regular expression: got {text!r} ({error})'
        ) from error


def resolve_name(name: str, namespace: str = '/') -> str:
    """Return the full name of a topic or a node; one that begins with ``*`` stays as it is."""
    return name if name.startswith(('/', '*')) else f'{namespace.rstrip("/")}/{name}'
