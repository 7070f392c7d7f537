# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Decides which topics are recorded: by name, pattern, regular expression or type."""

from collections.abc import Iterable
from fnmatch import fnmatchcase
import re

from t3mpc_ros.record.schema import RecordError


class SelectionError(RecordError):
    """A regular expression that is none."""


def expression(name: str, text: str) -> re.Pattern[str] | None:
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
        raise SelectionError(f'{name} must be a regular expression: got {text!r} ({error})') from (
            error
        )


class Selection:
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
        self._regex = expression('regex', regex)
        self._exclude = expression('exclude', exclude)
        self._types = frozenset(types)

    def wants(self, topic: str, types: Iterable[str] = ()) -> bool:
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
