# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Finished runs in a file of JSON lines, and the runs that it lacks."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
import contextlib
import fcntl
from io import TextIOWrapper
from itertools import starmap
import json
from pathlib import Path
from typing import Any, Self

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation.reporting import progress_bar

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

    def complete(
        self,
        jobs: Mapping[str, Any],
        make: Callable[[Sequence[Any]], Iterable[tuple[int, Row]]],
        report: Callable[[str], None] | None = None,
    ) -> dict[str, Row]:
        """Return the row of every job, in any order; those that the file holds are not made again.

        What is made is added to the file at once, so that a set of runs that is stopped goes on
        where it was. The answer does not depend on what was there.

        Parameters
        ----------
        make
            Gets the missing jobs; yields (index, row) in any order.
        report
            Receives messages; with None there is no progress line either.

        Raises
        ------
        RuntimeError
            Another process writes to the file, or a run never came back.
        """
        write = report or (lambda text: None)
        with self:
            known = self.read()
            found = {key: known[key] for key in jobs if key in known}
            missing = [key for key in jobs if key not in found]
            write(self._resume_message(len(jobs), len(found), len(known) - len(found)))
            try:
                with contextlib.ExitStack() as stack:
                    bar = stack.enter_context(progress_bar(len(missing), show=report is not None))
                    runs = make([jobs[key] for key in missing]) if missing else ()
                    if close := getattr(runs, 'close', None):
                        stack.callback(close)  # its processes end with this loop, however it ends
                    for index, row in runs:
                        self.add(missing[index], row)
                        found[missing[index]] = row
                        bar.update()
            except BaseException:
                write(
                    f'{len(found)} of {len(jobs)} runs are kept in {self.path}: '
                    'the same command goes on from there'
                )
                raise
        if len(found) != len(jobs):
            raise RuntimeError(f'{len(jobs) - len(found)} runs never came back')
        return found

    def _resume_message(self, total: int, found: int, others: int) -> str:
        text = f'{total} runs; {found} are there already, {total - found} to do'
        if others:
            text += f'; {others} of other versions, settings or extents are left alone'
        if self.unreadable:
            text += f'; {self.unreadable} lines that are torn or of an older version are skipped'
        return text


def _line(key: str, row: Mapping[str, Any]) -> str:
    return json.dumps({KEY: key, **row}, ensure_ascii=False) + '\n'
