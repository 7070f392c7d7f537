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
"""Definitions, schema texts and type hashes of ROS 2 message types.

A bag contains the definition of every type in it. The text is read from the installed ``.msg``
file; types that are not installed are taken from the Jazzy definitions of the ``rosbags`` library.
"""

from collections.abc import Iterable, Mapping
from functools import cache
import os
from pathlib import Path
import re
import sys
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from t3mpc_ros.bag.errors import UnknownTypeError

SEPARATOR = '=' * 80
"""Line before each dependency in ``ros2msg`` text."""

_TYPE = re.compile(r'(?P<package>[A-Za-z]\w*)/(?:msg/)?(?P<name>[A-Za-z]\w*)')
_PRIMITIVES = re.compile(r'bool|byte|char|float(32|64)|u?int(8|16|32|64)|w?string')


class MessageDefinitions:
    """Definitions of message types, with a cache.

    The file of a type is ``PREFIX/share/PACKAGE/msg/NAME.msg``; ``prefixes`` are in order of
    precedence, by default the :func:`installation_prefixes` of the process environment.
    """

    def __init__(self, prefixes: Iterable[Path] | None = None) -> None:
        self._prefixes = tuple(installation_prefixes(os.environ) if prefixes is None else prefixes)
        self._schemas: dict[str, str] = {}
        self._hashes: dict[str, str] = {}

    def schema(self, type_name: str) -> str:
        """Return the ``ros2msg`` text of ``type_name``, such as ``geometry_msgs/msg/Twist``.

        The definition of the type is followed by each of its direct and indirect dependencies
        once, after a line of 80 ``=`` and a line ``MSG: package/Type``. A type that is neither
        installed nor part of Jazzy raises :class:`UnknownTypeError`.
        """
        if type_name not in self._schemas:
            own = _full_name(type_name)
            texts: dict[str, str] = {}
            self._collect(own, texts, needed_by='')
            parts = [_with_newline(texts.pop(own))]
            for name, text in texts.items():
                short = name.replace('/msg/', '/')
                parts.append(f'{SEPARATOR}\nMSG: {short}\n{_with_newline(text)}')
            self._schemas[type_name] = ''.join(parts)
        return self._schemas[type_name]

    def type_hash(self, type_name: str) -> str:
        """Return the RIHS01 hash of a type (REP 2016), which Jazzy compares during discovery."""
        if type_name not in self._hashes:
            own, store = _full_name(type_name), get_typestore(Stores.EMPTY)
            store.register(get_types_from_msg(self.schema(own), own))
            self._hashes[type_name] = str(store.hash_rihs01(own))
        return self._hashes[type_name]

    def _collect(self, name: str, texts: dict[str, str], needed_by: str) -> None:
        texts[name] = text = self._own_text(name, needed_by)
        for dependency in _dependencies(text, name.partition('/')[0]):
            if dependency not in texts:
                self._collect(dependency, texts, needed_by=name)

    def _own_text(self, name: str, needed_by: str) -> str:
        package, _, own = name.partition('/msg/')
        paths = [prefix / 'share' / package / 'msg' / f'{own}.msg' for prefix in self._prefixes]
        if path := next((each for each in paths if each.is_file()), None):
            return path.read_text(encoding='utf-8')
        store = _jazzy()
        if name in store.fielddefs:
            text, _ = store.generate_msgdef(name, ros_version=2)
            return str(text).partition(SEPARATOR)[0]
        searched = ', '.join(map(str, paths))
        dependent = f' (needed by {needed_by})' if needed_by else ''
        raise UnknownTypeError(
            f'no definition of {name}{dependent}; searched {searched or "no file"} '
            'and the Jazzy types of the rosbags library'
        )


def installation_prefixes(environment: Mapping[str, str]) -> tuple[Path, ...]:
    """Return the installation prefixes: ``AMENT_PREFIX_PATH``, then the prefix of this Python."""
    listed = environment.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    return tuple(Path(entry) for entry in [*listed, sys.prefix] if entry)


def _full_name(type_name: str) -> str:
    match = _TYPE.fullmatch(type_name)
    if not match:
        raise UnknownTypeError(f'a message type must be package/msg/Name: got {type_name!r}')
    return f'{match["package"]}/msg/{match["name"]}'


def _with_newline(text: str) -> str:
    return text if text.endswith('\n') else text + '\n'


def _dependencies(text: str, package: str) -> list[str]:
    """Return the full names of the message types of the fields in ``text``, in order."""
    found = []
    for line in text.splitlines():
        words = line.partition('#')[0].split()
        # 'geometry_msgs/Point32[<=4] corners', 'string<=10 name', 'byte OK=0'
        kind = re.split(r'[\[<]', words[0])[0] if words else ''
        if kind and not _PRIMITIVES.fullmatch(kind):
            found.append(_full_name(kind if '/' in kind else f'{package}/{kind}'))
    return found


@cache
def _jazzy() -> Any:
    return get_typestore(Stores.ROS2_JAZZY)
