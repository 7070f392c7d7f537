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
"""Signals as a flag; processes that end with their parent."""

import os
from pathlib import Path
import runpy
import signal
import subprocess
import sys
import time

import pytest
from support.long_tests import few_of
from support.signals import attended
from support.waiting import is_running, wait_until

from t3mpc_ros.stop_signal import SIGNALS, StopSignal


@pytest.mark.parametrize('number', SIGNALS)
def test_the_first_signal_is_kept(number):
    with attended():
        before = [signal.getsignal(each) for each in SIGNALS]
        with StopSignal() as stop:
            assert not stop()
            os.kill(os.getpid(), number)
            os.kill(os.getpid(), signal.SIGTERM)
            assert stop()
            assert stop.number == number
        assert [signal.getsignal(each) for each in SIGNALS] == before


def test_an_ignored_hangup_stays_ignored():
    """A handler would end what was started with nohup when its terminal closes."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopSignal() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_during_the_start_ends_the_process_with_code_0():
    program = (
        'import os, signal; from t3mpc_ros.stop_signal import StopSignal; '
        'StopSignal().install().exit_at_once = True; '
        'os.kill(os.getpid(), signal.SIGTERM); raise SystemExit(3)'
    )
    assert subprocess.run([sys.executable, '-c', program], check=False).returncode == 0


@pytest.mark.parametrize(('module', 'code'), [('nodes.entry_points', 0), ('cli.entry_point', 130)])
def test_ctrl_c_while_an_executable_imports_is_quiet(module, code):
    """It ended with a traceback of 34 lines."""
    program = (
        f'import sys; known = set(sys.modules); import t3mpc_ros.{module}\n'
        "own = {name for name in sys.modules if name.startswith('t3mpc_ros')}\n"
        "loaded = set(sys.modules) - known - own - {'signal', '__future__'}\n"
        "assert loaded <= {'importlib', 'importlib._abc', 'typing', 'types', 'warnings',\n"
        "    'collections.abc', 're', 'enum', 'functools'} | BARE, loaded\n"
        'import os, signal; os.kill(os.getpid(), signal.SIGINT)\n'
    )
    # What the scripting interface needs before its names are used.
    bare = subprocess.run(
        [sys.executable, '-c', 'import sys, typing, importlib; print(set(sys.modules))'],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    program = program.replace('BARE', bare.strip())
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (code, '')


ROOT = Path(__file__).resolve().parent.parent


def installed_executable(folder, name):
    """Return an executable as pip installs it, with the Python of the test."""
    for each in ('bin', 'lib/t3mpc_ros'):
        (folder / each).mkdir(parents=True)
    (folder / 'bin' / 'python3').symlink_to(sys.executable)
    program = folder / 'lib' / 't3mpc_ros' / name
    program.write_bytes((ROOT / 'resource' / 'executable').read_bytes())
    program.chmod(0o755)
    return program


@pytest.mark.parametrize('number', SIGNALS)
def test_a_signal_before_the_imports_is_quiet(number, tmp_path):
    """While Python reads its path files, where the wheels of ROS start it anew."""
    program = installed_executable(tmp_path, 'controller')
    (tmp_path / 'sitecustomize.py').write_text(
        f'import os\nprint("here", flush=True)\nos.kill(os.getpid(), {int(number)})\n'
    )
    environment = os.environ | {'PYTHONPATH': f'{tmp_path}{os.pathsep}{ROOT}'}
    with attended():
        done = subprocess.run([program], capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'here\n', '')


@pytest.mark.parametrize(
    'delay', few_of([0.02, 0.005, 0.0, 0.01, 0.015, 0.03, 0.04, 0.06, 0.1, 0.2, 0.5], 2)
)
@pytest.mark.parametrize('name', few_of(['controller', 't3mpc']))
def test_ctrl_c_while_python_starts_is_quiet(name, delay, tmp_path):
    """It ended with 16 lines, or 34, where Python had its own handler and not ours yet."""
    program = installed_executable(tmp_path, name)
    environment = os.environ | {'PYTHONPATH': str(ROOT)}
    with attended():
        done = subprocess.Popen(
            [program, 'topic', 'list'],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        time.sleep(delay)
        done.send_signal(signal.SIGINT)
        errors = done.communicate()[1]
    assert errors.count('\n') <= 1
    # The shell, which is there for the first milliseconds, is ended by the signal.
    assert done.returncode in (-signal.SIGINT, 0, 1, 130)


def test_a_process_of_a_pool_may_import_the_executable():
    """Each ran the program anew: ``t3mpc compare`` under ``scripts/run`` ended with an error."""
    executable = ROOT / 'resource' / 'executable'
    assert 'main' in runpy.run_path(str(executable), run_name='__mp_main__')


@pytest.mark.slow
@pytest.mark.parametrize('number', few_of([signal.SIGKILL, signal.SIGTERM]))
def test_the_workers_of_a_killed_process_end_with_it(number, tmp_path):
    """``t3mpc compare`` that was terminated left its workers computing, for minutes."""
    program = tmp_path / 'study.py'
    program.write_text(
        'import os, time\n'
        'from t3mpc_ros.evaluation.experiment import WorkerPool\n'
        'def task(job):\n'
        '    os.write(1, b"%d\\n" % os.getpid())\n'  # in one piece: the other prints at once too
        '    time.sleep(600.0)\n'
        'if __name__ == "__main__":\n'
        '    with WorkerPool(2) as pool:\n'
        '        list(pool.map(task, [1, 2]))\n'
    )
    # A worker whose coverage is measured once hung while it saved what it had measured.
    unmeasured = {k: v for k, v in os.environ.items() if not k.startswith('COVERAGE')}
    with subprocess.Popen(
        [sys.executable, program], stdout=subprocess.PIPE, text=True, env=unmeasured
    ) as study:
        workers = [int(study.stdout.readline()) for _ in range(2)]
        study.send_signal(number)
        study.wait()
        wait_until(lambda: not any(map(is_running, workers)))
