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
"""The columns of a bag: ``read_bag``."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import fields, is_dataclass
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.api.one_sentence_errors import one_sentence
from t3mpc_ros.geometry.types import NANOSECONDS, read_only
from t3mpc_ros.parameters.table import nearest_hint
from t3mpc_ros.script_error import ScriptError

Array = NDArray[Any]
RECEIVED, STAMP = 'received', 'stamp'


class BagColumns(Mapping[str, Mapping[str, Array]]):
    """Columns by topic and field: ``bag['/odom']['twist.twist.linear.x']``.

    A column has one entry for each message, in order of receipt. Each topic also has the columns
    ``received``, and ``stamp`` where its type has a header, in s since the first message of the
    bag. Numbers and truth values are NumPy arrays, texts arrays of objects. An array field of
    constant length has one column for each element, ``field[0]``; one of varying length is left
    out. A topic is read when it is first used.

    Parameters
    ----------
    path
        The bag: a folder, or a file.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path).expanduser()
        """The bag."""
        from t3mpc_ros.bag.reader import open_bag  # the interface is there without its libraries

        with open_bag(self.path) as bag:
            self.types = {name: topic.type_name for name, topic in bag.topics.items()}
            """Type of each topic by name."""
            self.duration = bag.duration
            """s between the first and the last message."""
        self._columns: dict[str, FieldColumns] = {}

    @one_sentence
    def __getitem__(self, topic: str) -> Mapping[str, Array]:
        """Return the columns of a topic by field."""
        if topic not in self.types:
            hint = nearest_hint(topic, self.types)
            raise ScriptError(f'{topic} is not in {self.path}{hint}; its topics: {self._names()}')
        if topic not in self._columns:
            self._columns[topic] = FieldColumns(_read(self.path, topic))
            self._columns[topic].topic = topic
        return self._columns[topic]

    def __contains__(self, topic: object) -> bool:
        return topic in self.types

    def __iter__(self) -> Iterator[str]:
        return iter(self.types)

    def __len__(self) -> int:
        return len(self.types)

    def __repr__(self) -> str:
        return f'BagColumns({str(self.path)!r}: {self._names()})'

    def _names(self) -> str:
        return ', '.join(self.types) or 'none'


class FieldColumns(dict[str, Array]):
    """Columns of one topic by field; an unknown field is an error that names the nearest one."""

    topic = ''

    def __missing__(self, field: str) -> Array:
        raise ScriptError(f'{self.topic} has no field {field}{nearest_hint(field, self)}')


def _read(path: Path, topic: str) -> dict[str, Array]:
    from t3mpc_ros.bag.reader import open_bag

    rows: list[dict[str, Any]] = []
    with open_bag(path) as bag:
        for received, message in bag.messages(topic):
            row: dict[str, Any] = {RECEIVED: received}
            header = getattr(message, 'header', None)
            if header is not None:
                stamp_ns = header.stamp.sec * NANOSECONDS + header.stamp.nanosec
                row[STAMP] = (stamp_ns - bag.start_ns) / NANOSECONDS
            _flatten(message, '', row)
            rows.append(row)
    # A field that is not in every message is an array of varying length.
    names: Collection[str] = rows[0] if rows else ()
    kept = [name for name in names if all(name in row for row in rows)]
    kinds = {name: object if isinstance(rows[0][name], str) else None for name in kept}
    return {name: read_only(np.array([row[name] for row in rows], kinds[name])) for name in kept}


def _flatten(value: Any, name: str, row: dict[str, Any]) -> None:
    """Write the numbers and texts of a message into a row, by their paths."""
    if is_dataclass(value):
        for each in fields(value):
            if not each.name.startswith('_'):
                _flatten(getattr(value, each.name), f'{name}.{each.name}'.lstrip('.'), row)
    elif isinstance(value, np.ndarray | list | tuple):
        for i, item in enumerate(value):
            _flatten(item, f'{name}[{i}]', row)
    elif isinstance(value, bool | int | float | str | np.generic):
        row[name] = value


@one_sentence
def read_bag(path: str | os.PathLike[str]) -> BagColumns:
    """Return the columns of a bag by topic and field, without ROS.

    MCAP, sqlite3 and ROS 1 files are read.

    Raises
    ------
    ScriptError
        There is no bag, or it is damaged.
    """
    return BagColumns(path)
