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
"""How long this process and its descendants waited for a processor."""

import contextlib
import os
from pathlib import Path
from typing import NamedTuple

PROC = Path('/proc')


class ProcessorTime(NamedTuple):
    """Time of a thread since its start, ns."""

    running: int
    waiting: int  # time in which it could have run, but had no processor


def thread_times(pids):
    """Return the times of the living threads of these processes by thread."""
    found = {}
    for pid in pids:
        try:
            for thread in (PROC / str(pid) / 'task').iterdir():
                words = (thread / 'schedstat').read_text().split()
                found[thread.name] = ProcessorTime(int(words[0]), int(words[1]))
        except OSError:
            continue
    return found


def descendants(pid):
    """Return the processes that ``pid`` has started, and those that they have started."""
    found, open_pids = [], [pid]
    while open_pids:
        new = _children(open_pids.pop())
        found += new
        open_pids += new
    return found


def _children(pid):
    """Return the processes that the threads of a process have started."""
    found = []
    for path in PROC.glob(f'{pid}/task/*/children'):
        with contextlib.suppress(OSError):
            found += map(int, path.read_text().split())
    return found


def _has_children():
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return False
    return True


class ProcessorWait:
    """Measures how busy others kept the processors, from now on.

    A thread that has ended counts as of the last :meth:`note` before its end.
    """

    def __init__(self):
        self._last = {}
        self.note()
        self._first = dict(self._last)

    def note(self):
        """Measure this process and its descendants."""
        pid = os.getpid()
        self._last |= thread_times([pid, *(descendants(pid) if _has_children() else ())])

    def share(self):
        """Return the share of the time with work to do that was spent waiting, from 0 to 1.

        0 where the kernel does not count it.
        """
        self.note()
        spans = [
            (last.running - first.running, last.waiting - first.waiting)
            for thread, last in self._last.items()
            for first in [self._first.get(thread, ProcessorTime(0, 0))]
        ]
        running, waiting = (sum(column) for column in zip(*spans, strict=True))
        return waiting / max(waiting + running, 1)


_of_test = []


def begin():
    """Return the measurement of a test that begins now."""
    _of_test[:] = [ProcessorWait()]
    return _of_test[0]


def note():
    """Measure the processes of the running test, before they end."""
    for wait in _of_test:
        wait.note()
