# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Finished runs in a file of JSON lines, and the runs that it lacks."""

from collections.abc import Callable, Iterable, Mapping, Sequence
import contextlib
import fcntl
from io import TextIOWrapper
from pathlib import Path
from typing import Generic, Self, TypeVar

from t3mpc_ros.evaluation.reporting import progress_bar

Key = TypeVar('Key')
Value = TypeVar('Value')
Job = TypeVar('Job')


class ResultFile(Generic[Key, Value]):
    """Finished runs in a file of JSON lines; a context that one set of runs has at a time.

    A line is written as a whole and flushed. Should a writer be killed within one, what is torn
    is that line alone: reading skips it, and the next writer begins on a line of its own. With
    ``fresh``, what the file holds is thrown away on first entry.

    Parameters
    ----------
    encode, decode
        Make a line of a run, and a run of a line; ``decode`` raises ValueError, KeyError or
        TypeError for a line of another kind.
    """

    def __init__(
        self,
        path: Path,
        encode: Callable[[Key, Value], str],
        decode: Callable[[str], tuple[Key, Value]],
        *,
        fresh: bool = False,
    ) -> None:
        self.path = path
        self._encode, self._decode = encode, decode
        self._fresh = fresh
        self.unreadable = 0
        """Lines of the last reading that were torn or of another kind."""
        self._stream: TextIOWrapper | None = None

    def read(self) -> dict[Key, Value]:
        """Return every run the file holds, of whatever version; empty when there is no file."""
        self.unreadable = 0
        found: dict[Key, Value] = {}
        text = ''
        with contextlib.suppress(FileNotFoundError):
            text = self.path.read_text(encoding='utf-8', errors='replace')
        for line in text.split('\n'):
            if not line.strip():
                continue
            try:
                key, value = self._decode(line)
            except (ValueError, KeyError, TypeError):
                self.unreadable += 1
                continue
            found[key] = value
        return found

    def add(self, key: Key, value: Value) -> None:
        """Append a finished run."""
        if self._stream is None:
            raise RuntimeError('the file must be entered before runs are added')
        self._stream.write(self._encode(key, value) + '\n')
        self._stream.flush()

    def __enter__(self) -> Self:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        stream = self.path.open('a+', encoding='utf-8', errors='replace')
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.close()
            raise RuntimeError(f'another campaign is writing to {self.path}') from None
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


def run_missing_jobs(
    file: ResultFile[Key, Value],
    jobs: Mapping[Key, Job],
    run: Callable[[Sequence[Job]], Iterable[tuple[int, Value]]],
    report: Callable[[str], None] | None = None,
) -> dict[Key, Value]:
    """Return the result of every job, in any order; those that ``file`` holds are not run again.

    What is run is added to it at once, so that a set of runs that is stopped goes on where it
    was. The answer does not depend on what was there.

    Parameters
    ----------
    run
        Gets the missing jobs; yields (index, result) in any order.
    report
        Receives messages; with None there is no progress line either.

    Raises
    ------
    RuntimeError
        Another process writes to the file, or a run never came back.
    """
    write = report or (lambda text: None)
    with file:
        known = file.read()
        found = {key: known[key] for key in jobs if key in known}
        missing = [key for key in jobs if key not in found]
        write(_resume_message(file, len(jobs), len(found), len(known) - len(found)))
        try:
            with contextlib.ExitStack() as stack:
                bar = stack.enter_context(progress_bar(len(missing), show=report is not None))
                runs = run([jobs[key] for key in missing]) if missing else ()
                if close := getattr(runs, 'close', None):
                    stack.callback(close)  # its processes end with this loop, however it ends
                for index, value in runs:
                    file.add(missing[index], value)
                    found[missing[index]] = value
                    bar.update()
        except BaseException:
            write(
                f'{len(found)} of {len(jobs)} runs are kept in {file.path}: '
                'the same command goes on from there'
            )
            raise
    if len(found) != len(jobs):
        raise RuntimeError(f'{len(jobs) - len(found)} runs never came back')
    return found


def _resume_message(file: ResultFile[Key, Value], total: int, found: int, others: int) -> str:
    text = f'{total} runs; {found} are there already, {total - found} to do'
    if others:
        text += f'; {others} of other versions, settings or extents are left alone'
    if file.unreadable:
        text += f'; {file.unreadable} torn lines are skipped'
    return text
