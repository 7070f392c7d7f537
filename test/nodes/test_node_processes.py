# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The executables as processes over DDS: start, closed loop, killed peers, exit codes."""

import signal
import time

import numpy as np
import pytest

from t3mpc_ros.bag.reader import missing_sample_ratio, open_bag
from t3mpc_ros.cli.process_group import ProcessError
from t3mpc_ros.geometry.types import NANOSECONDS

pytestmark = pytest.mark.ros

EXECUTABLES = ('reference_generator', 'controller', 'sim_robot', 'recorder', 'player', 'composed')
LOOP = ('recorder', 'controller', 'sim_robot', 'reference_generator')


def _start_loop(processes, bag):
    for name in LOOP:
        _start(processes, name, bag)
    processes.wait_for('controller', 'tracking')


def _start(processes, name, bag):
    processes.start(name, parameters={'storage.uri': str(bag)} if name == 'recorder' else None)
    processes.wait_ready(name)


@pytest.mark.parametrize(
    'name, number',
    [
        *((name, number) for name in EXECUTABLES for number in (signal.SIGINT, signal.SIGTERM)),
        ('sim_robot', signal.SIGHUP),
    ],
)
def test_each_executable_starts_and_ends_with_code_0(
    name, number, processes, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    processes.start(name)
    processes.wait_ready(name)
    assert processes.stop(name, number) == 0
    assert 'Traceback' not in processes.log(name).read_text()


@pytest.mark.parametrize('delay', [0.4, 0.9, 1.6])
def test_a_signal_during_start_ends_quietly_with_code_0(delay, processes):
    """A signal during the slow imports must not end in a traceback."""
    processes.start('controller')
    time.sleep(delay)
    assert processes.stop('controller', signal.SIGINT) == 0
    assert 'Traceback' not in processes.log('controller').read_text()


def test_the_loop_runs_at_100_hz_in_four_processes(processes, tmp_path):
    bag = tmp_path / 'bag'
    _start_loop(processes, bag)
    time.sleep(8.0)
    processes.check()
    codes = processes.stop_all(('reference_generator', 'controller', 'sim_robot', 'recorder'))
    assert set(codes.values()) == {0}
    with open_bag(bag) as recording:
        for topic in ('/reference', '/odom'):
            stamps = recording.series(topic, {})['stamp']
            assert missing_sample_ratio(stamps, 100.0) < 0.01, topic
        commands = recording.series('/cmd_vel', {'v': 'linear.x', 'w': 'angular.z'})
        odometry = recording.series('/odom', {'v': 'twist.twist.linear.x'})
        # One command per odometry message, once both topics are recorded.
        compared = (odometry['received'] >= commands['received'][0]) & (
            odometry['received'] <= commands['received'][-1]
        )
        assert commands['v'].size >= 0.99 * compared.sum()
        assert compared.sum() >= 0.99 * 800
        # The last command is the stop of the controller's shutdown; the robot moved before.
        assert commands['v'][-1] == 0.0
        assert commands['w'][-1] == 0.0
        assert np.ptp(odometry['v']) > 0.02
        parameters = recording.metadata_records
        assert parameters['provenance']['version']
        assert float(parameters['controller']['law.gain']) > 0.0
        assert float(parameters['sim_robot']['rate']) == 100.0
        assert int(parameters['reference_generator']['seed']) >= 0


def _speeds(bag, topic='/ground_truth/odom'):
    """Return stamps (ns) and |v| plus the share of |omega| in a wheel speed, m/s."""
    with open_bag(bag) as recording:
        data = recording.series(topic, {'v': 'twist.twist.linear.x', 'w': 'twist.twist.angular.z'})
        stamps = recording.start_ns + np.round(data['stamp'] * NANOSECONDS).astype(np.int64)
    return stamps, np.abs(data['v']) + 0.0735 * np.abs(data['w'])


def _moving_share(stamps, speed, start_ns, seconds):
    chosen = (stamps >= start_ns) & (stamps < start_ns + seconds * NANOSECONDS)
    assert chosen.any()
    return float(np.mean(speed[chosen] > 0.01))


@pytest.mark.parametrize('victim', ['reference_generator', 'controller'])
def test_killed_source_stops_robot_in_half_a_second(victim, processes, tmp_path):
    bag = tmp_path / 'bag'
    _start_loop(processes, bag)
    time.sleep(5.0)
    killed_ns = time.time_ns()
    processes.kill(victim)
    time.sleep(2.0)
    processes.check()  # the other processes run on
    _start(processes, victim, bag)
    restarted_ns = time.time_ns()
    time.sleep(7.0)  # discovery takes up to three seconds
    processes.check()
    assert set(
        processes.stop_all(('reference_generator', 'controller', 'sim_robot', 'recorder')).values()
    ) == {0}

    stamps, speed = _speeds(bag)
    assert _moving_share(stamps, speed, killed_ns - NANOSECONDS, 1.0) > 0.8
    assert _moving_share(stamps, speed, restarted_ns + 5 * NANOSECONDS, 1.5) > 0.5
    late = (stamps > killed_ns + NANOSECONDS) & (stamps < killed_ns + 2 * NANOSECONDS)
    assert speed[late].max() < 0.01, 'the robot still moved a second after the kill'
    # The body oscillates by about a millimetre after the stepper motors have stopped.
    stamps, pulses = _speeds(bag, '/odom')
    late = (stamps > killed_ns + NANOSECONDS // 2) & (stamps < killed_ns + 2 * NANOSECONDS)
    assert pulses[late].max() < 0.01, 'the motors still turned half a second after the kill'


def test_a_killed_robot_zeroes_commands_until_its_restart(processes, tmp_path):
    bag = tmp_path / 'bag'
    _start_loop(processes, bag)
    time.sleep(5.0)
    killed_ns = time.time_ns()
    processes.kill('sim_robot')
    time.sleep(1.5)
    processes.check()
    _start(processes, 'sim_robot', bag)
    restarted_ns = time.time_ns()
    time.sleep(7.0)
    processes.check()
    assert set(
        processes.stop_all(('reference_generator', 'controller', 'sim_robot', 'recorder')).values()
    ) == {0}

    with open_bag(bag) as recording:
        commands = recording.series('/cmd_vel', {'v': 'linear.x', 'w': 'angular.z'})
        stamps = recording.start_ns + np.round(commands['received'] * NANOSECONDS).astype(np.int64)
    silent = (stamps > killed_ns + NANOSECONDS // 2) & (stamps < killed_ns + 1.4 * NANOSECONDS)
    assert silent.sum() >= 5, 'zero commands during the odometry timeout'
    assert not commands['v'][silent].any()
    assert not commands['w'][silent].any()
    stamps, speed = _speeds(bag)
    assert _moving_share(stamps, speed, restarted_ns + 5 * NANOSECONDS, 1.5) > 0.5


def test_a_restarted_recorder_continues_the_bag(processes, tmp_path):
    bag = tmp_path / 'bag'
    _start_loop(processes, bag)
    time.sleep(3.0)
    processes.kill('recorder')
    time.sleep(1.0)
    processes.check()
    _start(processes, 'recorder', bag)
    restarted_ns = time.time_ns()
    time.sleep(6.0)
    processes.check()
    assert set(
        processes.stop_all(('reference_generator', 'controller', 'sim_robot', 'recorder')).values()
    ) == {0}
    assert len(list(bag.glob('*.mcap'))) == 2
    stamps, speed = _speeds(bag)
    assert _moving_share(stamps, speed, restarted_ns + 4 * NANOSECONDS, 1.5) > 0.8


def test_composed_closes_the_loop_in_one_process(processes, tmp_path):
    bag = tmp_path / 'bag'
    processes.start('composed', parameters={'storage.uri': str(bag)})
    processes.wait_ready('composed')
    time.sleep(6.0)
    assert processes.stop('composed') == 0
    stamps, speed = _speeds(bag)
    assert speed.max() > 0.02
    with open_bag(bag) as recording:
        assert missing_sample_ratio(recording.series('/odom', {})['stamp'], 100.0) < 0.01


@pytest.mark.parametrize(
    'name, arguments, words',
    [
        ('controller', ['--ros-args', '-p', 'law.gain:=-1.0'], ['law.gain', '0', '-1']),
        (
            'controller',
            ['--ros-args', '-p', 'law.gian:=1.0'],
            ['law.gian', 'did you mean law.gain'],
        ),
        ('reference_generator', ['--ros-args', '-p', 'rate:=fast'], ['rate', 'a number', 'fast']),
        ('sim_robot', ['--ros-args', '-p', 'drive.kind:=warp'], ['drive.kind', 'one of', 'warp']),
        ('recorder', ['--ros-args', '--params-file', 'MISSING'], ['MISSING', 'cannot read']),
        ('recorder', ['--ros-args', '--params-file', 'BROKEN'], ['BROKEN', 'not valid YAML']),
        ('recorder', ['--ros-args', '-p', 'storage.uri:=FILE/bag'], ['FILE/bag']),
        ('controller', ['--ros-args', '-p', 'model:=BROKEN'], ['BROKEN', 'not a model file']),
    ],
)
def test_invalid_input_at_start_is_one_line_and_code_2(
    name, arguments, words, processes, tmp_path
):
    (tmp_path / 'BROKEN').write_text('controller:\n  ros__parameters: [1,\n')
    (tmp_path / 'FILE').write_text('a file where a folder is wanted')
    places = {word: str(tmp_path / word) for word in ('BROKEN', 'FILE', 'MISSING')}
    given = list(arguments)
    for word, path in places.items():
        given = [argument.replace(word, path) for argument in given]
    processes.start(name, *given)
    with pytest.raises(ProcessError, match='code 2'):
        processes.wait_ready(name)
    status = processes.log(name).read_text()
    assert 'Traceback' not in status
    line = next(line for line in status.splitlines() if line.startswith(f'{name}: '))
    for word in words:
        assert word in line


def test_an_integer_for_a_float_parameter_is_accepted(processes):
    processes.start('controller', '--ros-args', '-p', 'law.gain:=5')
    processes.wait_ready('controller')
    assert processes.stop('controller') == 0


def test_a_process_ends_without_interpreter_teardown(tmp_path, monkeypatch, request):
    """The teardown took 0.5 to 1 s after the shutdown, up to 2 s on a busy machine."""
    (tmp_path / 'sitecustomize.py').write_text(
        'import atexit\natexit.register(print, "interpreter teardown")\n'
    )
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))
    group = request.getfixturevalue('processes')  # reads the environment
    group.start('reference_generator')
    group.wait_ready('reference_generator')
    assert group.stop('reference_generator') == 0
    assert 'teardown' not in group.log('reference_generator').read_text()
