# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Runs what the plan needs and is not there yet, and says how long it will take."""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
import contextlib
import math
import sys
from typing import Any, TextIO

from t3mpc_ros.lab.paper.plan import Bench, Cell, Extent
from t3mpc_ros.lab.paper.store import RunFile, RunKey, RunNumbers, fingerprint, measure

Numbers = Mapping[Cell, tuple[RunNumbers, ...]]


class Progress:
    """Writes how many runs are done and how much time is left; the last line stays.

    Parameters
    ----------
    clock
        Seconds from any origin.
    stream
        A terminal gets one line that is rewritten, anything else a line now and then; standard
        error when None.
    """

    def __init__(self, clock: Callable[[], float], stream: TextIO | None = None) -> None:
        self._clock = clock
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty()
        self._last = 0.0
        self._total = 0
        self._marks = [(0, 0.0)]

    def say(self, text: str) -> None:
        """Write a line."""
        print(text, file=self._stream, flush=True)

    def begin(self, total: int) -> None:
        """Start to count ``total`` runs."""
        self._total = total
        self._last = self._clock()
        self._marks = [(0, self._last)]

    def done(self, count: int) -> None:
        """Take note that ``count`` runs are done, and say so when it is time to."""
        now = self._clock()
        self._marks.append((count, now))
        pause = 0.5 if self._live else 15.0
        if now - self._last < pause and count < self._total:
            return
        self._last = now
        left = self._pace() * (self._total - count)
        text = f'  {count} of {self._total} runs, {100 * count // self._total} %'
        text += f', {in_clock(left)} left' if count < self._total else ', done in '
        text += '' if count < self._total else in_clock(now - self._marks[0][1])
        end = '' if self._live and count < self._total else '\n'
        begin = '\r\x1b[K' if self._live else ''
        print(f'{begin}{text}', end=end, file=self._stream, flush=True)

    def _pace(self) -> float:
        """Return seconds per run over the later half of the runs: the first ones compile."""
        count, now = self._marks[-1]
        earlier, then = self._marks[bisect_right(self._marks, (count // 2, math.inf)) - 1]
        return (now - then) / (count - earlier)

    def broken_off(self) -> None:
        """Leave the line that is being rewritten."""
        if self._live:
            print(file=self._stream, flush=True)


def in_clock(seconds: float) -> str:
    """Return a stretch of time as people say it, rounded up to whole seconds."""
    whole = int(-(-seconds // 1))
    if whole < 60:
        return f'{whole} s'
    if whole < 3600:
        return f'{whole // 60} min {whole % 60:02d} s'
    return f'{whole // 3600} h {whole % 3600 // 60:02d} min'


def conduct(
    bench: Bench,
    extent: Extent,
    needed: Sequence[Cell],
    file: RunFile,
    sources: str,
    *,
    team: Any = 1,
    progress: Progress | None = None,
) -> Numbers:
    """Return the numbers of every needed cell, one per seed in the extent's order.

    Runs that ``file`` holds with the same fingerprint are not run again; what is run is added to
    it at once, so that a campaign that is stopped goes on where it was. The answer does not
    depend on what was there, nor on how many processes worked.

    Parameters
    ----------
    bench
        Where methods and runs come from.
    extent, needed
        Seeds and duration, and which cells.
    file
        Entered by this function.
    sources
        Digest of the sources, :func:`t3mpc_ros.lab.paper.store.source_digest`.
    team
        Who works: how many processes, or what the bench's own ``team`` enters.
    progress
        Told what is going on; None keeps silent.

    Raises
    ------
    RuntimeError
        The runner gave fewer runs than it was asked for, or another campaign has the file.
    """
    methods = {drive: bench.methods(drive) for drive in extent.drives}
    prints = {
        (drive, name): fingerprint(method, sources)
        for drive, table in methods.items()
        for name, method in table.items()
    }
    # Seed by seed: cheap and dear methods stay mixed, so the estimate of the time left holds.
    keys = [
        RunKey(cell, seed, extent.duration, prints[cell.drive, cell.method])
        for seed in extent.seeds
        for cell in needed
    ]
    with file:
        known = file.read()
        found = {key: known[key] for key in keys if key in known}
        missing = [key for key in keys if key not in found]
        if progress is not None:
            progress.say(_welcome(file, len(keys), len(found), len(known) - len(found)))
            progress.begin(len(missing))
        jobs = [
            (
                bench.scenario(
                    drive=key.cell.drive,
                    noise=key.cell.noise,
                    case=key.cell.case,
                    seed=key.seed,
                    duration=key.duration,
                ),
                methods[key.cell.drive][key.cell.method],
            )
            for key in missing
        ]
        try:
            with contextlib.ExitStack() as stack:
                runs = bench.measure_many(jobs, measure, team) if jobs else ()
                if close := getattr(runs, 'close', None):
                    stack.callback(close)  # its processes end with this loop, however it ends
                for count, (index, numbers) in enumerate(runs, 1):
                    file.add(missing[index], numbers)
                    found[missing[index]] = numbers
                    if progress is not None:
                        progress.done(count)
        except BaseException:
            if progress is not None:
                progress.broken_off()
                progress.say(
                    f'{len(found)} of {len(keys)} runs are kept in {file.path}: '
                    'the same command goes on from there'
                )
            raise
    if len(found) != len(keys):
        raise RuntimeError(f'{len(keys) - len(found)} runs never came back')
    return {
        cell: tuple(
            found[RunKey(cell, seed, extent.duration, prints[cell.drive, cell.method])]
            for seed in extent.seeds
        )
        for cell in needed
    }


def _welcome(file: RunFile, total: int, found: int, others: int) -> str:
    text = f'{total} runs; {found} are there already, {total - found} to do'
    if others:
        text += f'; {others} of other versions, settings or extents are left alone'
    if file.unreadable:
        text += f'; {file.unreadable} torn lines are skipped'
    return text
