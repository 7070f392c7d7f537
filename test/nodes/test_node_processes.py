# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The executables as processes over DDS: start, closed loop, killed peers, exit codes."""

import signal
import time

import numpy as np
import pytest

from t3mpc_ros.bag.reader import missing_sample_ratio, open_bag
from t3mpc_ros.cli.private_graph import PrivateGraph
from t3mpc_ros.cli.process_group import ProcessGroup
from t3mpc_ros.geometry.types import NANOSECONDS

pytestmark = [pytest.mark.ros, pytest.mark.alone]

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
    # One handler serves all signals in all executables.
    'name, number',
    [*zip(EXECUTABLES, 2 * [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], strict=True)],
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


class Run:
    """A recorded run in which each process was killed and started again in turn.

    The recorder, which leaves a file without its end, is killed in a bag of its own.
    """

    def __init__(self, folder, environment):
        self.bag, self.last_bag = folder / 'bag', folder / 'last_bag'
        self.killed_ns, self.restarted_ns = {}, {}
        processes = ProcessGroup(folder / 'log', environment)
        try:
            _start_loop(processes, self.bag)
            time.sleep(8.0)
            self._replace('reference_generator', 2.0, 7.0, processes)
            self._replace('controller', 2.0, 7.0, processes)  # discovery takes up to three seconds
            self._replace('sim_robot', 1.5, 7.0, processes)
            self.codes = [processes.stop('recorder')]
            _start(processes, 'recorder', self.last_bag)
            time.sleep(3.0)
            self._replace('recorder', 1.0, 6.0, processes)
            order = ('reference_generator', 'controller', 'sim_robot', 'recorder')
            self.codes += processes.stop_all(order).values()
        finally:
            for name in list(processes.running()):
                processes.kill(name)

    def _replace(self, victim, pause, drive, processes):
        """Kill a process, and start it again after a pause; then drive for some seconds."""
        self.killed_ns[victim] = time.time_ns()
        processes.kill(victim)
        time.sleep(pause)
        processes.check()  # the other processes run on
        _start(processes, victim, self.last_bag)
        self.restarted_ns[victim] = time.time_ns()
        time.sleep(drive)
        processes.check()


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    with PrivateGraph() as private:
        return Run(tmp_path_factory.mktemp('run'), private.environment())


def test_the_loop_runs_at_100_hz_in_four_processes(run):
    assert set(run.codes) == {0}
    with open_bag(run.bag) as recording:
        end = (run.killed_ns['reference_generator'] - recording.start_ns) / NANOSECONDS
        for topic in ('/reference', '/odom'):
            stamps = recording.series(topic, {})['stamp']
            assert missing_sample_ratio(stamps[stamps < end], 100.0) < 0.01, topic
        commands = recording.series('/cmd_vel', {'v': 'linear.x', 'w': 'angular.z'})
        odometry = recording.series('/odom', {'v': 'twist.twist.linear.x'})
        # One command per odometry message, once both topics are recorded.
        first, received = commands['received'][0], commands['received']
        compared = (odometry['received'] >= first) & (odometry['received'] < end)
        assert np.count_nonzero(received < end) >= 0.99 * compared.sum()
        assert compared.sum() >= 0.99 * 800
        assert np.ptp(odometry['v'][compared]) > 0.02
        parameters = recording.metadata_records
        assert parameters['provenance']['version']
        assert float(parameters['controller']['rate']) == 100.0
        assert float(parameters['sim_robot']['rate']) == 100.0
        assert int(parameters['reference_generator']['seed']) >= 0
    # The last command is the stop of the controller's shutdown; the robot moved before.
    with open_bag(run.last_bag) as recording:
        commands = recording.series('/cmd_vel', {'v': 'linear.x', 'w': 'angular.z'})
    assert commands['v'].any()
    assert commands['v'][-1] == commands['w'][-1] == 0.0


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
def test_killed_source_stops_robot_in_half_a_second(victim, run):
    killed_ns, restarted_ns = run.killed_ns[victim], run.restarted_ns[victim]
    stamps, speed = _speeds(run.bag)
    assert _moving_share(stamps, speed, killed_ns - NANOSECONDS, 1.0) > 0.8
    assert _moving_share(stamps, speed, restarted_ns + 5 * NANOSECONDS, 1.5) > 0.5
    late = (stamps > killed_ns + NANOSECONDS) & (stamps < killed_ns + 2 * NANOSECONDS)
    assert speed[late].max() < 0.01, 'the robot still moved a second after the kill'
    # The body oscillates by about a millimetre after the stepper motors have stopped.
    stamps, pulses = _speeds(run.bag, '/odom')
    late = (stamps > killed_ns + NANOSECONDS // 2) & (stamps < killed_ns + 2 * NANOSECONDS)
    assert pulses[late].max() < 0.01, 'the motors still turned half a second after the kill'


def test_a_killed_robot_zeroes_commands_until_its_restart(run):
    killed_ns = run.killed_ns['sim_robot']
    with open_bag(run.bag) as recording:
        commands = recording.series('/cmd_vel', {'v': 'linear.x', 'w': 'angular.z'})
        stamps = recording.start_ns + np.round(commands['received'] * NANOSECONDS).astype(np.int64)
    silent = (stamps > killed_ns + NANOSECONDS // 2) & (stamps < killed_ns + 1.4 * NANOSECONDS)
    assert silent.sum() >= 5, 'zero commands during the odometry timeout'
    assert not commands['v'][silent].any()
    assert not commands['w'][silent].any()
    stamps, speed = _speeds(run.bag)
    restarted_ns = run.restarted_ns['sim_robot']
    assert _moving_share(stamps, speed, restarted_ns + 5 * NANOSECONDS, 1.5) > 0.5


def test_a_restarted_recorder_continues_the_bag(run):
    assert len(list(run.last_bag.glob('*.mcap'))) == 2
    stamps, speed = _speeds(run.last_bag)
    restarted_ns = run.restarted_ns['recorder']
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
