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
"""Waits of the tests; on a busy machine their time-outs, and nothing else, are inconclusive."""

from pathlib import Path
import subprocess
import time

from support import processor_wait
from t3mpc_ros.cli.process_group import ProcessGroup, ProcessTimeoutError

TIMEOUT = 90.0
"""Timeout of a condition on a busy machine, s; usually a fraction of it passes."""


class WaitTimeoutError(Exception):
    """What a test waits for has not happened in time."""

    def __init__(self, text):
        super().__init__(text)
        processor_wait.note()  # what did not answer still runs


TIMEOUTS = WaitTimeoutError, ProcessTimeoutError
"""Errors that a lack of processor time may explain."""


def pause():
    time.sleep(0.02)


def wait_until(condition, problem='', seconds=TIMEOUT, step=pause):
    """Call ``step`` until ``condition`` holds; after ``seconds`` raise :class:`WaitTimeoutError`.

    ``problem``, its text or a function that returns it, says what is wrong.
    """
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            text = problem() if callable(problem) else problem or condition
            raise WaitTimeoutError(f'timeout of {seconds:g} s: {text}')
        step()


def wait_for_text(process, output, text, seconds=TIMEOUT):
    """Wait until ``output()`` of a process holds ``text``; fail if the process ends before."""

    def shown():
        ended = process.poll() is not None
        found = text in output()
        assert found or not ended, f'ended before it printed "{text}":\n{output()}'
        return found

    wait_until(shown, lambda: f'no "{text}" in:\n{output()}', seconds)


def wait_for_acknowledgement(publisher):
    """Wait until every subscriber has acknowledged what a publisher has published."""
    from rclpy.duration import Duration

    acknowledged = Duration(seconds=0.02)
    wait_until(
        lambda: publisher.wait_for_all_acked(acknowledged), publisher.topic, step=lambda: None
    )


def wait_for_end(process, seconds=TIMEOUT):
    """Return the exit code of a process once it has ended."""
    wait_until(lambda: process.poll() is not None, f'{process.args} runs', seconds)
    return process.returncode


def is_running(pid):
    """Return whether a process runs: a zombie does not."""
    try:
        return Path('/proc', str(pid), 'stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except (FileNotFoundError, ProcessLookupError):
        return False


def communicate(process, seconds=TIMEOUT):
    """Return the remaining output and errors of a process once it has ended."""
    try:
        return process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired as error:
        raise WaitTimeoutError(str(error)) from None


def run(command, seconds=TIMEOUT, **options):
    """Run a command to its end, with its output as text; return the completed process."""
    pipes = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE, 'text': True}
    with subprocess.Popen(command, **(pipes | options)) as process:
        try:
            output, errors = communicate(process, seconds)
        finally:
            process.kill()
    return subprocess.CompletedProcess(command, process.returncode, output, errors)


class Processes(ProcessGroup):
    """The processes of a test; how long they waited for a processor is noted before they end."""

    def kill(self, name):
        processor_wait.note()
        super().kill(name)

    def stop(self, *arguments, **options):
        processor_wait.note()
        return super().stop(*arguments, **options)
