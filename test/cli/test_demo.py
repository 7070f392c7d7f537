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
"""``t3mpc demo``: signals end everything at every phase; private graphs never meet."""

from contextlib import ExitStack, suppress
from datetime import datetime
import os
from pathlib import Path
import re
import signal
import socket
import subprocess
import sys
from types import SimpleNamespace

import pytest
from support.bag_messages import START, diagnostics, twist_message
from support.long_tests import few_of
from support.robot_bags import following_rows, write
from support.signals import attend
from support.waiting import communicate, is_running, run, wait_until

from t3mpc_ros.cli import process_group
from t3mpc_ros.cli.demo import DEMO_EXIT_CODES, _new_run
from t3mpc_ros.cli.main import main
from t3mpc_ros.cli.process_group import DOMAINS, NoDomainError, PrivateGraph, used_domains

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]

NODES = ('recorder', 'controller', 'sim_robot', 'reference_generator')

# No path with a blank can stand behind "#!".
STAND_IN = """#!/bin/sh
'''exec' '{python}' "$0" "$@"
'''
import os, pathlib, resource, shutil, signal, sys, time
name = pathlib.Path(sys.argv[0]).name
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
if name == 'recorder' and os.path.exists('{folder}/recorded'):
    shutil.copytree('{folder}/recorded', '{folder}/run/bag')
code = {ends}.get(name, 0)
end = (lambda: os.kill(os.getpid(), -code)) if code < 0 else (lambda: os._exit(code))
signal.signal(signal.SIGINT, lambda *_: end())
pathlib.Path('{folder}', name + '.pid').write_text(str(os.getpid()))
pathlib.Path('{folder}', name + '.domain').write_text(os.environ.get('ROS_DOMAIN_ID', ''))
for number in {ignored}:
    signal.signal(number, lambda *_: pathlib.Path('{folder}', name + '.asked').touch())
for text in {output}.get(name, ()):
    print(text, flush=True)
while True:
    time.sleep(0.1)
"""
"""A node without ROS: writes its process id, prints, and sleeps until SIGINT."""


def stand_ins(folder, silent=(), ignored=(), ends=None):
    """Return the environment of a demo whose nodes are stand-ins in ``folder``.

    The ``silent`` nodes never print that they are ready or track; ``ignored`` are signals;
    ``ends`` are exit codes, or signals as negative numbers, by node.
    """
    programs = folder / 'lib' / 't3mpc_ros'
    programs.mkdir(parents=True)
    output = {name: [f'{name} ready'] for name in NODES if name not in silent}
    if 'tracking' not in silent and 'controller' in output:
        output['controller'].append('tracking')
    for name in NODES:
        program = programs / name
        text = STAND_IN.format(
            python=sys.executable,
            folder=folder,
            ignored=[int(n) for n in ignored],
            output=output,
            ends=ends or {},
        )
        program.write_text(text)
        program.chmod(0o755)
    return {**os.environ, 'AMENT_PREFIX_PATH': str(folder)}


def start_demo(folder, environment, *arguments):
    """Return a running ``t3mpc demo``."""
    command = [sys.executable, '-m', 't3mpc_ros.cli.main', 'demo', '--headless']
    return subprocess.Popen(
        [*command, '--output', str(folder / 'run'), *arguments],
        env=environment,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=attend,
    )


def read_until(demo, text):
    """Read the progress of a demo up to a line that contains ``text``."""
    while text not in (line := demo.stderr.readline()):
        assert line, f'the demo has ended without "{text}"'


def alive(folder):
    """Return the names of the stand-ins that still run."""
    return [
        path.stem for path in folder.glob('*.pid') if (pid := path.read_text()) and is_running(pid)
    ]


PHASES = {
    'start': (('controller',), 'starting controller'),
    'discovery': (('tracking',), 'waiting for discovery'),
    'run': ((), 'running: 0'),
}
"""Silent nodes, and the line of the demo after which the signal is sent, by phase."""


@pytest.mark.parametrize(
    ('phase', 'number'),
    few_of(
        [
            *((phase, signal.SIGTERM) for phase in PHASES),
            ('run', signal.SIGINT),
            ('run', signal.SIGHUP),
        ],
        len(PHASES),
    ),
)
def test_a_signal_ends_the_demo_and_all_nodes(phase, number, tmp_path):
    """SIGTERM and SIGHUP once left four processes that recorded for ever."""
    silent, line = PHASES[phase]
    demo = start_demo(tmp_path, stand_ins(tmp_path, silent))
    read_until(demo, line)
    expected = 2 if phase == 'start' else 4
    wait_until(lambda: len(list(tmp_path.glob('*.pid'))) == expected)
    demo.send_signal(number)
    _, errors = communicate(demo)
    assert demo.returncode == 128 + number
    assert 'Traceback' not in errors
    assert 'stopped' in errors
    assert alive(tmp_path) == []


def test_nodes_that_ignore_the_signal_are_killed(tmp_path):
    environment = stand_ins(tmp_path, ignored=(signal.SIGINT, signal.SIGTERM))
    demo = start_demo(tmp_path, environment)
    read_until(demo, 'running')
    demo.send_signal(signal.SIGTERM)
    communicate(demo)
    assert demo.returncode == 128 + signal.SIGTERM
    assert alive(tmp_path) == []


def test_a_signal_while_the_nodes_are_stopped_ends_the_demo(tmp_path):
    """The nodes do not end at the end of the run; the demo would wait 10 s for each."""
    demo = start_demo(tmp_path, stand_ins(tmp_path, ignored=(signal.SIGINT,)), '--duration', '1')
    wait_until((tmp_path / 'reference_generator.asked').exists)
    demo.send_signal(signal.SIGHUP)
    communicate(demo)
    assert demo.returncode == 128 + signal.SIGHUP
    assert alive(tmp_path) == []


def test_the_nodes_of_a_killed_demo_end_with_it(tmp_path):
    demo = start_demo(tmp_path, stand_ins(tmp_path))
    read_until(demo, 'running')
    assert sorted(alive(tmp_path)) == sorted(NODES)
    demo.kill()
    communicate(demo)
    wait_until(lambda: not alive(tmp_path))


def test_an_interrupted_demo_says_how_to_get_the_report(tmp_path):
    demo = start_demo(tmp_path, stand_ins(tmp_path))
    read_until(demo, 'running')
    bag = tmp_path / 'run' / 'bag'
    bag.mkdir()
    (bag / 'bag_0.mcap').write_bytes(b'')
    demo.send_signal(signal.SIGINT)
    _, errors = communicate(demo)
    assert f't3mpc bag report {bag}' in errors


def test_a_wait_shows_progress(tmp_path, monkeypatch):
    """Compilation takes a minute, discovery seconds: the last line of the node is shown."""
    monkeypatch.setattr(process_group, 'PROGRESS_PERIOD', 0.05)
    environment = stand_ins(tmp_path, silent=('tracking',))
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    shown = []
    group = process_group.ProcessGroup(
        tmp_path / 'log', environment, lambda: 'ready' in str(shown[-1:]), shown.append
    )
    group.start('controller')
    with pytest.raises(process_group.StopRequestedError):
        group.wait_for('controller', 'tracking')
    group.kill('controller')
    assert re.fullmatch(r'controller, \d+ s: (importing|controller ready)', shown[0])
    assert re.fullmatch(r'controller, \d+ s: controller ready', shown[-1])


# -- exit codes -----------------------------------------------------------------------------------

SOUND = following_rows()
ASTRAY = following_rows(offset=0.3)
NOT_DRIVEN = [
    (t, topic, twist_message((0.0, 0.0)) if topic == '/cmd_vel' else message)
    for t, topic, message in SOUND
]
OVERLOADED = [(5.0, '/diagnostics', diagnostics(START, 'sim_robot', 1, 'processor overloaded'))]
RUNS = [
    # exit codes of the nodes, what the recorder has recorded, whether a file of it is unfinished,
    # exit code of the demo, words of its output
    ({}, SOUND, False, 0, 'Good run: settled RMSE 0.571'),
    ({}, ASTRAY, False, 3, 'settled RMSE'),
    ({}, NOT_DRIVEN, False, 3, 'never driven'),
    ({}, [*NOT_DRIVEN, *OVERLOADED], False, 3, 'never driven'),
    (
        {},
        [row for row in SOUND if row[1] != '/reference'],
        False,
        3,
        'the bag holds no reference, so tracking cannot be judged',
    ),
    ({}, SOUND, True, 3, 'truncated'),
    ({}, [*ASTRAY, *OVERLOADED], False, 4, 'overloaded'),
    ({}, [*ASTRAY, *OVERLOADED], True, 3, 'truncated'),
    ({}, [*SOUND, *OVERLOADED], False, 0, 'overloaded'),
    ({}, [], False, 1, 'error: '),
    *(
        ({node: code}, SOUND, False, 1, f'not every node ended cleanly: {node} with code {code};')
        for node, code in zip(
            NODES, (1, -signal.SIGSEGV, -signal.SIGKILL, -signal.SIGABRT), strict=True
        )
    ),
]


@pytest.mark.parametrize('ends, rows, unfinished, code, words', few_of(RUNS, 6))
def test_the_exit_code_says_what_became_of_the_run(
    ends, rows, unfinished, code, words, tmp_path, monkeypatch, capsys
):
    """A robot that did not follow was excused as a slow machine: both were code 3."""
    if rows:
        write(tmp_path / 'recorded', sorted(rows, key=lambda row: row[0]))
    if unfinished:
        (tmp_path / 'recorded' / 'bag_1.mcap').write_bytes(b'\x89MCAP0\r\n')
    monkeypatch.setenv('AMENT_PREFIX_PATH', stand_ins(tmp_path, ends=ends)['AMENT_PREFIX_PATH'])
    monkeypatch.setattr('t3mpc_ros.cli.demo._watch', lambda processes, options: processes.check())
    assert main(['demo', '--headless', '--output', str(tmp_path / 'run')]) == code
    output = capsys.readouterr()
    assert words in output.out + output.err
    assert alive(tmp_path) == []


def test_every_exit_code_of_the_demo_is_documented_and_produced(capsys):
    """128 + N: :func:`test_a_signal_ends_the_demo_and_all_nodes`."""
    documented = re.findall(r'(?<=[ :])(\d)(?= )', DEMO_EXIT_CODES)
    with pytest.raises(SystemExit) as wrong_use:
        main(['demo', '--duration', '0'])
    produced = {wrong_use.value.code, main(['demo', '--patrol', '--robot', 'servo'])}
    assert produced == {2}
    assert sorted(map(int, documented)) == sorted(produced | {code for *_, code, _ in RUNS})
    with pytest.raises(SystemExit):
        main(['demo', '--help'])
    for text in (capsys.readouterr().out, (ROOT / 'scripts' / 'demo').read_text()):
        assert DEMO_EXIT_CODES in text


@pytest.mark.parametrize(
    'codes, end, count',
    [
        ([0], 0, 1),
        ([4, 0], 0, 2),
        ([4, 4, 0], 0, 3),
        ([4, 4, 4, 0], 4, 3),
        ([3, 0], 3, 1),
        ([4, 3, 0], 3, 2),
        ([1, 0], 1, 1),
        ([139, 0], 139, 1),
    ],
)
def test_a_demo_on_a_slow_machine_is_repeated_twice_at_most(codes, end, count, tmp_path):
    """Any demo without a valid measurement passed."""
    (tmp_path / 'codes').write_text('\n'.join(map(str, codes)))
    command = 'code=$(head -n 1 codes); sed -i 1d codes; exit "$code"'
    done = run([ROOT / '.ci' / 'demo', 'bash', '-c', command], cwd=tmp_path)
    assert done.returncode == end
    assert len(codes) - len((tmp_path / 'codes').read_text().split()) == count


def test_every_demo_of_the_ci_is_such_a_one():
    texts = ((ROOT / '.ci' / name).read_text() for name in ('run', 'wheel'))
    lines = [line.strip() for text in texts for line in text.replace('\\\n', ' ').splitlines()]
    demos = [line for line in lines if re.search(r'(scripts/|t3mpc )demo\b', line)]
    assert demos
    for line in demos:
        # As the last command of its line, whose exit code ends the script.
        assert re.fullmatch(
            r'(env -u \w+ )?"?(\$ROOT/)?\.ci/demo"? \S+(?: demo)?( --\w+( \d+)?)*', line
        )


def test_the_link_latest_leads_to_the_last_run(tmp_path, monkeypatch):
    """So that every command of the documentation can be pasted, after each demo."""
    times = (datetime(2026, 1, 2, 3, 4, second) for second in range(60))
    monkeypatch.setattr('t3mpc_ros.cli.demo.datetime', SimpleNamespace(now=lambda: next(times)))
    runs = tmp_path / 'runs'
    latest = runs / 'latest'
    found = []
    for before in (None, 'the last run', 'the last run', 'older', tmp_path, '..'):
        if before not in (None, 'the last run'):  # a run that was removed, or a folder elsewhere
            latest.unlink()
            latest.symlink_to(before)
        found.append(_new_run(runs))
        assert latest.is_symlink()
        assert latest.resolve() == found[-1].resolve(), before
        assert not latest.readlink().is_absolute()
    assert sorted(runs.iterdir()) == [*found, latest]
    assert not any(list(each.iterdir()) for each in found)


def test_what_is_no_link_is_left_alone_as_latest(tmp_path):
    latest = tmp_path / 'runs' / 'latest'
    latest.mkdir(parents=True)
    (latest / 'kept').touch()
    assert list(_new_run(latest.parent).iterdir()) == []
    assert (latest / 'kept').is_file()


# -- private graphs -------------------------------------------------------------------------------


def test_a_private_graph_is_not_in_the_domain_of_the_caller(monkeypatch):
    """The domain was once that of the caller, in which a robot may listen to cmd_vel."""
    monkeypatch.setenv('ROS_DOMAIN_ID', '42')
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')
    monkeypatch.setenv('ROS_STATIC_PEERS', '192.0.2.1')
    with ExitStack() as stack:
        graphs = []
        with suppress(NoDomainError):
            while True:
                graphs.append(stack.enter_context(PrivateGraph()))
        with pytest.raises(NoDomainError, match='every ROS domain'):
            PrivateGraph()
        domains = [graph.domain for graph in graphs]
        assert len(set(domains)) == len(domains) > 50
        assert 42 not in domains
        environment = graphs[0].environment()
        assert environment['ROS_DOMAIN_ID'] == str(domains[0])
        assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] != 'SUBNET'
        assert 'ROS_STATIC_PEERS' not in environment
        # Another process, of another checkout perhaps, gets none of them.
        code = 'from t3mpc_ros.cli.process_group import PrivateGraph; PrivateGraph()'
        other = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
        assert 'NoDomainError' in other.stderr
        free = graphs[0]
        free.close()
        assert stack.enter_context(PrivateGraph()).domain == free.domain


def test_a_domain_with_a_participant_is_left_out():
    """Any ROS program of the machine binds UDP ports that follow from its domain."""
    before = used_domains(Path('/proc/net'))
    domain = next(each for each in DOMAINS if each not in before)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(('127.0.0.1', 7400 + 250 * domain + 11))
        assert domain in used_domains(Path('/proc/net'))
    assert used_domains(Path('/nowhere')) == set()


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('law.gain=30', 'one of recorder, controller, sim_robot, reference_generator'),
        ('controller.law.gian=30', 'did you mean law.gain'),
        ('controller.law.gain=-1', 'law.gain must be'),
        ('controller.law.gain', 'NAME=VALUE'),
        ('radio_bridge.port=x', 'one of recorder'),
    ],
)
def test_a_wrong_setting_starts_nothing(text, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(['demo', '--headless', '--set', text]) == 1
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
