# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How long this process and its children waited for a processor."""

import os
from pathlib import Path
from typing import NamedTuple

PROC = Path('/proc')


class ProcessorTime(NamedTuple):
    """Time of all threads of some processes, ns."""

    running: int
    waiting: int
    """Time in which they could have run, but had no processor."""


def processor_time(pids):
    """Return the time of these processes since their start; those that have ended count 0."""
    running = waiting = 0
    for pid in pids:
        try:
            for thread in (PROC / str(pid) / 'task').iterdir():
                words = (thread / 'schedstat').read_text().split()
                running, waiting = running + int(words[0]), waiting + int(words[1])
        except OSError:
            continue
    return ProcessorTime(running, waiting)


def descendants(pid):
    """Return the processes that ``pid`` has started, and those that they have started."""
    children = {}
    for stat in PROC.glob('[0-9]*/stat'):
        try:
            parent = int(stat.read_text().rpartition(')')[2].split()[1])
        except OSError:
            continue
        children.setdefault(parent, []).append(int(stat.parent.name))
    found, open_pids = [], [pid]
    while open_pids:
        new = children.get(open_pids.pop(), [])
        found += new
        open_pids += new
    return found


class ProcessorWait:
    """Measures how busy others kept the processors, from now on."""

    def __init__(self):
        self._start = processor_time([os.getpid()])

    def share(self):
        """Return the share of the time with work to do that was spent waiting, from 0 to 1.

        Of this process since the start of the measurement, and of its living descendants since
        theirs. 0 where the kernel does not count it.
        """
        own, others = processor_time([os.getpid()]), processor_time(descendants(os.getpid()))
        waiting = own.waiting - self._start.waiting + others.waiting
        running = own.running - self._start.running + others.running
        return waiting / max(waiting + running, 1)
