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
"""Recording that the live page starts and ends, and its report."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
import os
from pathlib import Path
import subprocess
import time

from t3mpc_ros.cli.process_group import ProcessError, ProcessGroup, executable
from t3mpc_ros.view.live_data import Json, LiveData

NAME = 'recorder'
"""The executable, the fact and the command of the page."""
START_TIMEOUT = 60.0
"""Longest start of the recorder, s."""
END_TIMEOUT = 20.0
"""Longest time in which the recorder completes the bag, s."""
REPORT_TIMEOUT = 900.0
"""Longest time in which a report is drawn, s."""
WATCH_PERIOD = 0.2
"""Time between two looks at the recorder, s."""


class RunRecorder:
    """Records the graph into a folder of its own for each recording; then draws the report.

    The fact ``recorder`` of ``data`` says what it does: ``state`` is ``idle``, ``starting``,
    ``recording``, ``ending`` or ``drawing``; ``text`` is for the person, and names a problem if
    ``failed``; ``report`` is the folder of a report. ``report_ready`` gets the file of a report
    that is complete.
    """

    def __init__(
        self, runs: Path, namespace: str, data: LiveData, report_ready: Callable[[Path], None]
    ) -> None:
        self._runs, self._namespace, self._data = runs, namespace, data
        self._report_ready = report_ready
        # One thread, which lives as long: a process ends with the thread that has started it, and
        # those of the server end with the answer.
        self._worker = ThreadPoolExecutor(1)
        self._state, self._text = 'idle', ''
        self._folder = Path()
        self._processes: ProcessGroup | None = None
        self._drawing: subprocess.Popen[bytes] | None = None
        self._problem = ''
        """Why the recording has ended by itself."""
        self._show('idle', '')

    def switch(self, on: object) -> str:
        """Start a recording, or end it and begin its report; return what was done.

        RuntimeError if there is nothing to start or to end, or the recorder fails.
        """
        if not isinstance(on, bool):
            raise RuntimeError(f'record needs on, true or false: got {on!r}')
        return self._worker.submit(self._start if on else self._end).result()

    def close(self) -> None:
        """Complete a bag that is being recorded; its report is not drawn."""
        if self._drawing is not None:
            self._drawing.terminate()
        self._worker.submit(self._stop_processes)
        self._worker.shutdown()

    def _start(self) -> str:
        if self._state != 'idle':
            raise RuntimeError(f'nothing new is recorded: {self._text}')
        self._folder = self._runs.resolve() / time.strftime('view_%Y%m%d_%H%M%S')
        bag = self._folder / 'bag'
        self._show('starting', 'the recorder starts')
        try:
            processes = ProcessGroup(self._folder / 'log', os.environ)
            remap = ('--ros-args', '-r', f'__ns:=/{self._namespace.strip("/")}')
            arguments = remap if self._namespace.strip('/') else ()
            processes.start(NAME, *arguments, parameters={'storage.uri': str(bag)})
            self._processes = processes
            processes.wait_ready(NAME, START_TIMEOUT)
        except (OSError, ProcessError) as error:
            self._stop_processes()
            reason = _reason(error)
            self._show('idle', f'not recorded: {reason}', failed=True)
            raise RuntimeError(reason) from None
        self._problem = ''
        self._show('recording', f'recording into {bag}')
        self._worker.submit(self._watch)
        return f'recording into {bag}'

    def _watch(self) -> None:
        """Draw the report of a recording that ends by itself, as with a full disk."""
        if self._state != 'recording' or self._processes is None:
            return
        if not (bag := self._folder / 'bag').is_dir():
            self._stop_processes()
            self._show('idle', f'nothing is recorded: {bag} was removed', failed=True)
            return
        try:
            self._processes.check()
        except ProcessError as error:
            self._problem = _reason(error)
            self._processes = None
            self._show('drawing', f'{self._problem}; the report is being drawn', failed=True)
            self._worker.submit(self._draw, self._folder)
        else:
            time.sleep(WATCH_PERIOD)
            self._worker.submit(self._watch)

    def _end(self) -> str:
        if self._state != 'recording' or self._processes is None:
            raise RuntimeError('nothing is being recorded')
        self._show('ending', 'the recorder completes the bag')
        try:
            self._processes.stop(NAME, seconds=END_TIMEOUT)
        except ProcessError as error:
            self._show('idle', f'the bag may be unfinished: {error}', failed=True)
            raise RuntimeError(str(error)) from None
        finally:
            self._processes = None
        self._show('drawing', 'the report is being drawn')
        self._worker.submit(self._draw, self._folder)
        return f'recorded: {self._folder / "bag"}'

    def _draw(self, folder: Path) -> None:
        """Draw the report in a process that gives way to the robot's nodes."""
        command = [str(executable('t3mpc')), 'bag', 'report', str(folder / 'bag')]
        text = ''
        try:
            with (folder / 'log' / 'report.log').open('wb') as output:
                drawing = self._drawing = subprocess.Popen(
                    ['nice', '-n', '10', *command, '--output', str(folder)],
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,  # Ctrl-C in a terminal reaches this process only
                )
                code = drawing.wait(REPORT_TIMEOUT)
        except OSError as error:
            text = str(error)
        except subprocess.TimeoutExpired as error:
            drawing.kill()
            text = str(error)
        else:
            if code:
                lines = (folder / 'log' / 'report.log').read_text(errors='replace').splitlines()
                text = lines[-1] if lines else f'exit code {code}'
        if text:
            why = '; '.join(filter(None, (text, self._problem)))
            self._show('idle', f'no report of {folder / "bag"}: {why}', failed=True)
            return
        self._report_ready(folder / 'report.html')
        early = f', which ends early: {self._problem}' if self._problem else ''
        text = f'report of {folder / "bag"}{early}'
        self._show('idle', text, report=folder.name, failed=bool(early))

    def _stop_processes(self) -> None:
        if self._processes is not None:
            self._processes.end_all(seconds=END_TIMEOUT)
        self._processes = None

    def _show(self, state: str, text: str, report: str = '', failed: bool = False) -> None:
        self._state, self._text = state, text
        shown: dict[str, Json] = {'state': state, 'text': text, 'report': report, 'failed': failed}
        self._data.set(NAME, shown)


def _reason(error: Exception) -> str:
    """Return the last error that the recorder has printed, in one sentence, else how it ended."""
    first, *lines = str(error).splitlines()
    for line in reversed(lines):
        if '[ERROR]' in line or line.strip().startswith(f'{NAME}: '):
            return (
                line.rpartition(f'{NAME}]: ')[2].strip().removeprefix(f'{NAME}: ').split('. ')[0]
            )
    return first.removesuffix(':')
