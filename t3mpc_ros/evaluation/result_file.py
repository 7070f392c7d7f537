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
"""Finished runs in a file of JSON lines."""

from collections.abc import Collection, Mapping
import contextlib
import fcntl
from io import TextIOWrapper
from itertools import starmap
import json
from pathlib import Path
from typing import Any, Self

from t3mpc_ros.atomic_file import write_atomically

Row = dict[str, Any]
"""Plain data by name."""
KEY = 'run'
"""Name in a line of what tells its run from all others."""


class ResultFile:
    """Finished runs by key in a file of JSON lines; a context that one writer has at a time.

    A line is written as a whole and flushed. Should a writer be killed within one, what is torn
    is that line alone: reading skips it, and the next writer begins on a line of its own. With
    ``fresh``, what the file holds is thrown away on first entry.
    """

    def __init__(self, path: Path, *, fresh: bool = False) -> None:
        self.path = path
        self._fresh = fresh
        self.unreadable = 0
        """Lines of the last reading that were torn or of another kind."""
        self._stream: TextIOWrapper | None = None

    def read(self) -> dict[str, Row]:
        """Return every run the file holds, of whatever version; empty when there is no file."""
        self.unreadable = 0
        found: dict[str, Row] = {}
        text = ''
        with contextlib.suppress(FileNotFoundError):
            text = self.path.read_text(encoding='utf-8', errors='replace')
        for line in text.split('\n'):
            if not line.strip():
                continue
            try:
                row = json.loads(line)
                found[str(row.pop(KEY))] = row
            except (ValueError, KeyError, TypeError, AttributeError):
                self.unreadable += 1
        return found

    def add(self, key: str, row: Mapping[str, Any]) -> None:
        """Append a finished run."""
        if self._stream is None:
            raise RuntimeError('the file must be entered before runs are added')
        self._stream.write(_line(key, row))
        self._stream.flush()

    def __enter__(self) -> Self:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.is_dir():
            raise RuntimeError(f'{self.path} must be a file for the runs: move that folder away')
        stream = self.path.open('a+', encoding='utf-8', errors='replace')
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.close()
            raise RuntimeError(f'another process is writing to {self.path}') from None
        if self._fresh:
            stream.truncate(0)
            self._fresh = False
        content = self.path.read_bytes()
        if content and not content.endswith(b'\n'):
            stream.write('\n')
            stream.flush()
        self._stream = stream
        return self

    def __exit__(self, *_: object) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def remove(self, keys: Collection[str]) -> None:
        """Remove runs from the file, and the file if it holds no others."""
        with self:
            others = {key: row for key, row in self.read().items() if key not in keys}
            if others:
                write_atomically(self.path, ''.join(starmap(_line, others.items())))
            else:
                self.path.unlink()


def _line(key: str, row: Mapping[str, Any]) -> str:
    return json.dumps({KEY: key, **row}, ensure_ascii=False) + '\n'
