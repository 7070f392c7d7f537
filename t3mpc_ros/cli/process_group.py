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
"""Processes of the package's executables, and a ROS graph of their own.

Two processes of one machine meet if they use the same ``ROS_DOMAIN_ID``. A private graph, of a
demo or a test, has a domain that is not the caller's, in which no participant of any ROS program
runs, and that no other private graph of the machine reserves.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
import json
import os
from pathlib import Path
import random
import signal
import socket
import subprocess
import sys
import sysconfig
import time
from typing import Self

from t3mpc_ros.nodes.node_main import PROFILES, provide_log_directory, uses_fast_dds
from t3mpc_ros.parent_process import end_with_parent

READY_TIMEOUT = 1200.0
"""Maximum start of a node, s: a busy machine compiles the kernels for minutes."""
PROGRESS_PERIOD = 5.0
"""Time between two lines of progress in a wait, s."""


class ProcessError(RuntimeError):
    """An executable that did not start, or ended when it should not have."""


class ProcessTimeoutError(ProcessError):
    """An executable that did not become ready, or did not end, in time."""


class StopRequestedError(ProcessError):
    """A stop was requested while the processes were being started, watched or stopped."""


def executable(name: str) -> Path:
    """Return the file that ``ros2 run t3mpc_ros NAME`` would start, or that pip has installed."""
    by_pip = Path(sysconfig.get_path('scripts')) / name
    try:
        return installed_file(Path('lib') / 't3mpc_ros' / name)
    except ProcessError:
        if by_pip.exists():
            return by_pip
        raise


def _prefixes() -> list[Path]:
    # A workspace that was sourced comes before the environment it runs in, as for `ros2 run`.
    found = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    return [Path(prefix) for prefix in dict.fromkeys(found) if prefix]


def installed_file(path: Path) -> Path:
    """Return the installed file of a path relative to the prefix; ProcessError without one."""
    for prefix in _prefixes():
        if (prefix / path).exists():
            return prefix / path
    raise ProcessError(
        f'{path} is not installed below any of {", ".join(map(str, _prefixes()))}; run the '
        'command through scripts/run, or build the workspace and source its setup file'
    )


class ProcessGroup:
    """Executables of one run, each a process with a log file in the folder ``logs``.

    When ``stop_requested`` returns True, every wait raises :class:`StopRequestedError`;
    ``progress`` gets a line of text about every 5 s of a wait.
    """

    def __init__(
        self,
        logs: Path,
        environment: Mapping[str, str],
        stop_requested: Callable[[], bool] = lambda: False,
        progress: Callable[[str], None] = lambda line: None,
    ) -> None:
        logs.mkdir(parents=True, exist_ok=True)
        self._logs = logs
        self._environment = dict(environment)
        self._stop_requested = stop_requested
        self._progress = progress
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._log_start: dict[str, int] = {}

    def start(
        self,
        name: str,
        *arguments: str,
        parameters: Mapping[str, object] | None = None,
        program: str = '',
    ) -> None:
        """Start one executable with ROS parameters and append its output to its log.

        It ends when this process ends, even if it is killed.

        ``program`` is the executable if ``name`` is not: ``start('emulator', 'emulator',
        '--link', 'x', program='t3mpc')``.
        """
        command = [str(executable(program or name)), *arguments]
        given = dict(parameters or {})
        if given:
            command.append('--ros-args')
            for key, value in given.items():
                # JSON is YAML, which the parser of ROS reads.
                command += ['-p', f'{key}:={json.dumps(value, ensure_ascii=False)}']
        with self.log(name).open('ab') as output:
            self._log_start[name] = output.tell()
            self._processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=self._environment,
                # Ctrl-C in a terminal reaches the whole group: here the processes are stopped
                # in order instead, the recorder last.
                start_new_session=True,
                preexec_fn=partial(end_with_parent, os.getpid()),
            )

    def log(self, name: str) -> Path:
        """Return the log file of one executable."""
        return self._logs / f'{name}.log'

    def wait_ready(self, name: str, seconds: float = READY_TIMEOUT) -> None:
        """Wait for the ready message of the executable, see :meth:`wait_for`."""
        self.wait_for(name, f'{name} ready', seconds)

    def wait_for(self, name: str, words: str, seconds: float = 30.0) -> None:
        """Wait until the output since the start of the executable holds ``words``.

        ProcessError, with its last lines, if it ends, ProcessTimeoutError after ``seconds``.
        """
        begin = time.monotonic()
        deadline, shown = begin + seconds, begin
        process = self._processes[name]
        while words not in (output := self._fresh_output(name)):
            self._raise_if_requested()
            if time.monotonic() - shown > PROGRESS_PERIOD:
                shown = time.monotonic()
                last = output.rstrip().rpartition('\n')[2].rpartition(']: ')[2]
                self._progress(f'{name}, {shown - begin:.0f} s: {last or "importing"}')
            if process.poll() is not None:
                raise ProcessError(
                    f'{name} ended with code {process.returncode} before it printed '
                    f'"{words}":\n' + self._tail(name)
                )
            if time.monotonic() > deadline:
                raise ProcessTimeoutError(
                    f'{name} did not print "{words}" within {seconds:g} s:\n' + self._tail(name)
                )
            time.sleep(0.05)

    def check(self) -> None:
        """Raise :class:`ProcessError` when one of the processes has ended by itself."""
        self._raise_if_requested()
        for name, process in self._processes.items():
            if process.poll() is not None:
                raise ProcessError(
                    f'{name} ended with code {process.returncode} during the run:\n'
                    + self._tail(name)
                )

    def running(self) -> tuple[str, ...]:
        """Return the names of the running executables."""
        return tuple(self._processes)

    def pid(self, name: str) -> int:
        """Return the process id of one executable."""
        return self._processes[name].pid

    def kill(self, name: str) -> None:
        """Kill one executable, as a crash would."""
        process = self._processes.pop(name)
        process.kill()
        process.wait()

    def stop(self, name: str, number: int = signal.SIGINT, seconds: float = 10.0) -> int:
        """Send a stop signal to one executable and return its exit code.

        ProcessTimeoutError if it did not end in time and was killed.
        """
        process = self._processes[name]
        process.send_signal(number)
        deadline = time.monotonic() + seconds
        while process.poll() is None:
            self._raise_if_requested()
            if time.monotonic() > deadline:
                self.kill(name)
                raise ProcessTimeoutError(
                    f'{name} did not end within {seconds:g} s of signal {number}:\n'
                    + self._tail(name)
                )
            time.sleep(0.01)
        del self._processes[name]
        return process.returncode

    def stop_all(self, order: Sequence[str] = ()) -> dict[str, int]:
        """Stop all running executables, first in the given order; return exit codes."""
        names = [name for name in order if name in self._processes]
        names += [name for name in self._processes if name not in names]
        return {name: self.stop(name) for name in names}

    def end_all(self, last: Sequence[str] = (), seconds: float = 10.0) -> None:
        """End all running executables, at once except for the ``last``; kill those that remain.

        The last ones end in their order; each has ``seconds``, as the others together.
        """
        first = tuple(name for name in self._processes if name not in last)
        for names in (first, *((name,) for name in last if name in self._processes)):
            for name in names:
                self._processes[name].send_signal(signal.SIGINT)
            deadline = time.monotonic() + seconds
            for name in names:
                try:
                    self._processes[name].wait(max(0.0, deadline - time.monotonic()))
                    del self._processes[name]
                except subprocess.TimeoutExpired:
                    self.kill(name)

    def _raise_if_requested(self) -> None:
        if self._stop_requested():
            raise StopRequestedError('stopped')

    def _fresh_output(self, name: str) -> str:
        with self.log(name).open('rb') as source:
            source.seek(self._log_start[name])
            return source.read().decode(errors='replace')

    def _tail(self, name: str) -> str:
        lines = self._fresh_output(name).splitlines()[-12:]
        return '\n'.join(f'  {line}' for line in lines)


# -- private graph --------------------------------------------------------------------------------


DOMAINS = range(1, 102)
"""Domains of private graphs: 0 is the default of all robots, those above use ephemeral ports."""
_PORT_BASE, _DOMAIN_PORTS = 7400, 250
"""UDP ports of a domain by the DDSI-RTPS specification (9.6.1.1)."""
_LOOPBACK_PROFILE = Path('share') / 't3mpc_ros' / 'config' / 'fastdds_loopback.xml'
_NETWORK_VARIABLES = ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER')


class NoDomainError(RuntimeError):
    """Every domain is in use on this machine."""


class PrivateGraph:
    """A reserved domain and the environment of its processes; a context manager.

    The reservation is a socket with an abstract name, which exists once per network of the
    machine, for all users and checkouts. It ends with the process at the latest. NoDomainError if
    every domain is reserved or in use.
    """

    def __init__(self) -> None:
        avoided = used_domains(Path('/proc/net'))
        of_caller = os.environ.get('ROS_DOMAIN_ID', '')  # in which a robot of the caller may run
        if of_caller.isdigit():
            avoided.add(int(of_caller))
        candidates = [domain for domain in DOMAINS if domain not in avoided]
        for domain in random.SystemRandom().sample(candidates, len(candidates)):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                self._socket.bind(f'\0t3mpc_ros_domain_{domain}')
            except OSError:
                self._socket.close()
                continue
            self.domain = domain
            return
        raise NoDomainError(
            'every ROS domain from 1 to 101 is in use on this machine; stop other ROS programs'
        )

    def environment(self) -> dict[str, str]:
        """Return the environment of the processes of this graph.

        Fast DDS uses UDP on loopback only: its shared memory may block a publisher for a third of
        a second when a subscriber joins (Fast-DDS issue 6535).
        """
        environment = {k: v for k, v in os.environ.items() if k not in _NETWORK_VARIABLES}
        provide_log_directory(environment)
        environment.setdefault('RCUTILS_COLORIZED_OUTPUT', '0')
        environment['ROS_DOMAIN_ID'] = str(self.domain)
        environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        environment.pop(PROFILES, None)
        if uses_fast_dds(environment):
            environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'SYSTEM_DEFAULT'
            environment[PROFILES] = str(installed_file(_LOOPBACK_PROFILE))
        return environment

    def close(self) -> None:
        """End the reservation."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def used_domains(tables: Path) -> set[int]:
    """Return the domains in which a participant runs: its UDP ports are bound on this machine.

    ``tables`` is the folder of the kernel's tables ``udp`` and ``udp6``, either of which may lack.
    """
    found = set()
    for table in (tables / 'udp', tables / 'udp6'):
        try:
            lines = table.read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            port = int(line.split()[1].rpartition(':')[2], 16)
            if port >= _PORT_BASE:
                found.add((port - _PORT_BASE) // _DOMAIN_PORTS)
    return found
