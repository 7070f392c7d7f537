# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Every command of the README and the tutorial works from a shell."""

from contextlib import contextmanager
from pathlib import Path
import re
import signal
import subprocess
import sys
import time

import pytest

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parent.parent

BOARDS = 'scripts/run t3mpc emulator --link dongle --robot-link robot_usb --erased'

# For each command: the additional arguments, and whether it runs until it is stopped.
PARAMETERS, KEY_FILE = '--params-file robot.yaml', '-p key_file:=robot.key'
SET = 'scripts/run t3mpc robot set --port robot_usb --save robot.yaml'
SHORTENED = {
    # Long enough for training.
    'scripts/demo': (['--duration', '20', '--headless', '--output', 'OUTPUT/run'], False),
    'scripts/check': (['--version'], False),  # runs this test
    'scripts/run sim_robot --ros-args -p world:=room': ([], True),
    'scripts/run sim_robot --ros-args -p world:=room -p faults.schedule:=rough_ride': ([], True),
    'scripts/run t3mpc --help': ([], False),
    'scripts/run t3mpc twin --quick': (['--output', 'OUTPUT/twin'], False),
    'scripts/run t3mpc faults': (['brown_out', 'collision'], False),
    'scripts/demo --robot servo': (
        ['--duration', '5', '--headless', '--output', 'OUTPUT/servo'],
        False,
    ),
    'scripts/demo --robot emulator --loss 0.1': (
        ['--duration', '5', '--headless', '--output', 'OUTPUT/emulator'],
        False,
    ),
    'scripts/run controller --ros-args -p law.gain:=20.0': ([], True),
    'scripts/run reference_generator --ros-args -p seed:=7': ([], True),
    'scripts/run composed': (['--ros-args', '-p', 'storage.uri:=OUTPUT/bag'], True),
    'scripts/run t3mpc paper --quick': (['--seeds', '1', '--output', 'OUTPUT/paper'], False),
    'scripts/run t3mpc compare': (
        ['--seeds', '201', '--duration', '3', '--methods', 'full', '--cases', 'nominal'],
        False,
    ),
    'scripts/run t3mpc tune': (
        ['PI + feed-forward', '--evaluations', '2', '--output', 'OUTPUT/tuned.json'],
        False,
    ),
    'scripts/run t3mpc train': (['--seeds', '1', '--output', 'OUTPUT/model.npz'], False),
    'scripts/run t3mpc exponents': (['--duration', '20'], False),
    'scripts/run t3mpc estimation': (['--seeds', '2'], False),
    BOARDS: ([], True),
    SET: ([], False),
    'scripts/run t3mpc robot key create robot.key': ([], False),
    'scripts/run t3mpc robot key write robot.key --port robot_usb': ([], False),
    'scripts/run t3mpc robot ping --port dongle --params-file robot.yaml': ([], False),
    f'scripts/run t3mpc robot jog left 1 --port dongle {PARAMETERS} --key robot.key --yes': (
        [],
        False,
    ),
    f'scripts/run radio_bridge --ros-args {PARAMETERS} -p port:=dongle {KEY_FILE}': ([], True),
    'scripts/run t3mpc bag info runs/latest/bag': ([], False),
    'scripts/run t3mpc bag report runs/latest/bag': (['--output', 'OUTPUT/report'], False),
    'scripts/run t3mpc bag replay runs/latest/bag': ([], False),
    'scripts/run t3mpc bag replay runs/latest/bag --set law.gain=20.0': ([], False),
    'scripts/run t3mpc bag compare runs/latest/bag --picture divergence.png': ([], False),
    'scripts/run t3mpc bag recover runs/latest/bag --output recovered': ([], False),
    'scripts/run player --ros-args -p storage.uris:=[runs/latest/bag]': (
        ['-p', 'play.rate:=10.0'],
        False,
    ),
}


def _commands(page):
    blocks = re.findall(r'```console\n(.*?)```', page.read_text(), re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.strip()]


@pytest.mark.parametrize(
    'page', ['README.md', *sorted(f'docs/{path.name}' for path in (ROOT / 'docs').glob('*.md'))]
)
def test_every_command_of_the_page_is_run_here(page):
    assert set(_commands(ROOT / page)) <= set(SHORTENED)


def test_every_command_run_here_is_in_a_page():
    pages = [ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md'))]
    text = '\n'.join(page.read_text() for page in pages)
    assert [command for command in SHORTENED if command not in text] == []


def test_the_readme_is_short():
    assert len((ROOT / 'README.md').read_bytes()) <= 6000


def test_the_controller_of_the_tutorial_runs(tmp_path):
    """The Python block of the tutorial runs in the local environment."""
    [code] = re.findall(r'```python\n(.*?)```', (ROOT / 'docs/tutorial.md').read_text(), re.DOTALL)
    script = tmp_path / 'mine.py'
    script.write_text(code)
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr
    found = dict(re.findall(r'^(.+): RMSE ([0-9.]+) rad/s$', done.stdout, re.MULTILINE))
    assert set(found) == {'mine', 'PI + feed-forward'}
    assert float(found['mine']) < 0.5


@pytest.fixture(scope='module')
def output(tmp_path_factory):
    return tmp_path_factory.mktemp('readme')


@pytest.fixture
def boards(command, output):
    """Run the emulated boards for a command that connects to them."""
    if command == BOARDS or not re.search(r'dongle|robot_usb', command):
        yield
        return
    key = ['--key', 'robot.key'] if 'robot.key' in command and 'write' not in command else []
    log = output / 'boards.txt'
    with _started([*BOARDS.split(), *key], output, log) as process:
        _wait_until(process, log, 'stop with Ctrl-C')
        if command != SET:  # the boards are erased at every start
            (output / 'robot.yaml').unlink(missing_ok=True)
            subprocess.run([ROOT / SET.split()[0], *SET.split()[1:]], cwd=output, check=True)
        yield
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0, log.read_text()


@pytest.mark.parametrize('command', list(SHORTENED))
def test_the_command_works(command, output, tmp_path, graph, boards):
    extra, endless = SHORTENED[command]
    arguments = command.replace('runs/latest', 'run').split()
    arguments += [word.replace('OUTPUT', str(output)) for word in extra]
    log = tmp_path / 'output.txt'
    with _started(arguments, output, log) as process:
        if endless:
            ready = 'stop with Ctrl-C' if command == BOARDS else f'{arguments[1]} ready'
            _wait_until(process, log, ready)
            process.send_signal(signal.SIGINT)
        code = process.wait(timeout=240)
    # On a busy machine the round trip is long, and ping fails with a report.
    assert code == 0 or ('ping' in command and 'robot answers' in log.read_text()), log.read_text()
    assert 'Traceback' not in log.read_text()
    if command == 'scripts/demo':
        assert (output / 'run' / 'report.html').stat().st_size > 100_000


@contextmanager
def _started(arguments, folder, log):
    """Run a command in ``folder``; kill it at the end, so that it does not disturb other tests."""
    with log.open('wb') as target:
        process = subprocess.Popen(
            [str(ROOT / arguments[0]), *arguments[1:]],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=target,
            stderr=subprocess.STDOUT,
        )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def _wait_until(process, log, text):
    deadline = time.monotonic() + 120.0
    while text not in log.read_text():
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(0.05)
