# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Every command in the README is run, from a shell, as a new user would."""

import os
from pathlib import Path
import re
import signal
import subprocess
import time

import pytest

from t3mpc_ros.lab.processes import private_graph

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parent.parent

# How each command is run here: what is added to it, and whether it runs until it is told to stop.
SHORTENED = {
    'scripts/demo': (['--duration', '5', '--headless', '--output', 'OUTPUT/run'], False),
    'scripts/check': (['--version'], False),  # this very test is part of it
    'scripts/run sim_robot': ([], True),
    'scripts/run controller --ros-args -p law.gain:=6.0': ([], True),
    'scripts/run all_in_one': (['--ros-args', '-p', 'folder:=OUTPUT/bag'], True),
    'scripts/run lab ablation': (['--seeds', '1', '--duration', '5'], False),
    'scripts/run lab exponents': (['--duration', '20'], False),
    'scripts/run lab estimation': (['--seeds', '2'], False),
    'scripts/run lab report runs/<time>/bag': (['--output', 'OUTPUT/report'], False),
}


def _commands():
    blocks = re.findall(r'```console\n(.*?)```', (ROOT / 'README.md').read_text(), re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.strip()]


def test_every_command_of_the_readme_is_known_here():
    assert sorted(_commands()) == sorted(SHORTENED)


@pytest.fixture(scope='module')
def output(tmp_path_factory):
    return tmp_path_factory.mktemp('readme')


@pytest.mark.parametrize('command', list(SHORTENED))
def test_the_command_works(command, output):
    extra, endless = SHORTENED[command]
    words = command.replace('runs/<time>', f'{output}/run').split()
    words += [word.replace('OUTPUT', str(output)) for word in extra]
    process = subprocess.Popen(
        [str(ROOT / words[0]), *words[1:]],
        cwd=ROOT,
        env=private_graph() | {'CI_CHECK_INSIDE': '1'},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if endless:
        _wait_until_ready(process, words[1])
        process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=240)
    assert process.returncode == 0, said
    assert 'Traceback' not in said
    if command == 'scripts/demo':
        assert (output / 'run' / 'report.html').stat().st_size > 100_000


def _wait_until_ready(process, name):
    os.set_blocking(process.stdout.fileno(), False)
    deadline, said = time.monotonic() + 120.0, ''
    while f'{name} ready' not in said:
        said += process.stdout.read() or ''
        assert process.poll() is None, said
        assert time.monotonic() < deadline, said
        time.sleep(0.05)
    os.set_blocking(process.stdout.fileno(), True)
