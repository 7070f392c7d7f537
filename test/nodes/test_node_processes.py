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
"""The executables as processes over DDS: start, closed loop, killed peers, exit codes."""

import signal
import time

from nav_msgs.msg import Odometry
import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from support.long_tests import few_of
from support.ros_graph import speed, stamp
from support.signals import attended
from support.waiting import Processes, wait_until

from t3mpc_ros.bag.controller_input_journal import Event
from t3mpc_ros.bag.reader import missing_sample_ratio, open_bag
from t3mpc_ros.cli.process_group import PrivateGraph
from t3mpc_ros.evaluation.process_replay.controller_inputs import load_inputs
from t3mpc_ros.evaluation.process_replay.controller_replay import replay_controller
from t3mpc_ros.evaluation.process_replay.replay_comparison import Tolerances, compare
from t3mpc_ros.geometry.types import NANOSECONDS

pytestmark = pytest.mark.ros

VICTIMS = ('reference_generator', 'controller', 'sim_robot')
RECORDED = ('/cmd_vel', '/controller/journal', '/ground_truth/odom', '/odom', '/reference')
"""Topics that a recorder has to discover."""
MOVING = 0.01
"""Smallest speed of a robot that moves, m/s."""


# One handler serves all signals in all executables.
@pytest.mark.parametrize(
    'name, number', [('controller', signal.SIGTERM), ('player', signal.SIGHUP)]
)
def test_a_signal_ends_an_executable_at_once_with_code_0(
    name, number, tmp_path, monkeypatch, request
):
    """The teardown of the interpreter took 0.5 to 1 s after the shutdown."""
    (tmp_path / 'sitecustomize.py').write_text(
        'import atexit\natexit.register(print, "interpreter teardown")\n'
    )
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))
    processes = request.getfixturevalue('processes')  # reads the environment
    with attended():
        processes.start(name)
    processes.wait_ready(name)
    assert processes.stop(name, number) == 0
    output = processes.log(name).read_text()
    assert 'Traceback' not in output
    assert 'teardown' not in output


@pytest.mark.parametrize('delay', few_of([0.4, 0.9, 1.6], 2))
def test_a_signal_during_start_ends_quietly_with_code_0(delay, processes):
    """A signal during the slow imports must not end in a traceback."""
    processes.start('controller')
    time.sleep(delay)
    assert processes.stop('controller', signal.SIGINT) == 0
    assert 'Traceback' not in processes.log('controller').read_text()


class Observer:
    """Receives the true motion of the robot in the process of the test."""

    def __init__(self):
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context)
        self._node = Node('observer', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._begin_ns = self._moved = 0
        self._node.create_subscription(Odometry, 'ground_truth/odom', self._take, 100)

    def _take(self, message):
        if stamp(message) > self._begin_ns:  # it did not wait while nothing was received
            self._moved = self._moved + 1 if speed(message) > MOVING else 0

    def recorders(self):
        """Return the subscriptions of recorders, dead ones included, by topic and endpoint."""
        return {
            (topic, tuple(info.endpoint_gid))
            for topic in RECORDED
            for info in self._node.get_subscriptions_info_by_topic(topic)
            if info.node_name == 'recorder'
        }

    def wait_for_motion(self, seconds):
        """Wait until the robot has moved without a stop for some seconds from now on."""
        self._moved, self._begin_ns = 0, time.time_ns()
        self.wait(lambda: self._moved >= 100 * seconds, 'the robot does not move')

    def wait(self, condition, problem):
        """Wait for a condition."""
        wait_until(condition, problem, step=lambda: self._executor.spin_once(timeout_sec=0.1))

    def close(self):
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)


class Run:
    """A recorded run in which each process was killed and started again in turn.

    The recorder is started last, and killed in a bag of its own, for it leaves a file without
    its end.
    """

    def __init__(self, folder, processes, observer):
        self.bag, self.last_bag = folder / 'bag', folder / 'last_bag'
        self.killed_ns = {}
        self._processes, self._observer = processes, observer
        for name in VICTIMS:
            processes.start(name)
        for name in VICTIMS:
            processes.wait_ready(name)
        processes.wait_for('controller', 'tracking')
        self._record(self.bag)
        for victim in VICTIMS:
            self._kill(victim, 1.5)
            self._start(victim)
            observer.wait_for_motion(1.5)
        self.codes = [processes.stop('recorder')]
        self._start_recorder(self.last_bag)
        self._kill('recorder', 0.5)
        self._record(self.last_bag)
        self.end_ns = time.time_ns()
        order = ('reference_generator', 'controller', 'sim_robot', 'recorder')
        self.codes += processes.stop_all(order).values()

    def _start(self, name, **parameters):
        self._processes.start(name, parameters=parameters)
        self._processes.wait_ready(name)

    def _record(self, bag):
        """Start a recorder and wait until it receives all."""
        self._start_recorder(bag)
        # The publishers discover it, too: a lost message of discovery is repeated after 3 s.
        self._observer.wait_for_motion(3.5)

    def _start_recorder(self, bag):
        """Start a recorder and wait until it has subscribed."""
        known = self._observer.recorders()
        self._start('recorder', **{'storage.uri': str(bag)})
        self._observer.wait(
            lambda: len(self._observer.recorders() - known) == len(RECORDED),
            'the recorder has not discovered the topics',
        )

    def _kill(self, victim, pause):
        """Kill a process and wait; the other ones run on."""
        self.killed_ns[victim] = time.time_ns()
        self._processes.kill(victim)
        time.sleep(pause)
        self._processes.check()


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp('run')
    with PrivateGraph() as private, pytest.MonkeyPatch.context() as patch:
        for name, value in private.environment().items():
            patch.setenv(name, value)
        processes, observer = Processes(folder / 'log', private.environment()), Observer()
        try:
            return Run(folder, processes, observer)
        finally:
            observer.close()
            for name in list(processes.running()):
                processes.kill(name)


@pytest.mark.timed
def test_the_loop_runs_at_100_hz_in_four_processes(run):
    assert set(run.codes) == {0}
    with open_bag(run.bag) as recording:
        end = (run.killed_ns['reference_generator'] - recording.start_ns) / NANOSECONDS
        for topic in ('/reference', '/odom'):
            stamps = recording.series(topic, {})['stamp']
            assert missing_sample_ratio(stamps[stamps < end], 100.0) < 0.01, topic
        velocity = recording.series('/odom', {'v': 'twist.twist.linear.x'})
        assert np.ptp(velocity['v'][velocity['stamp'] < end]) > 0.02
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


@pytest.mark.timed
def test_each_controller_of_the_run_replays_bit_for_bit(run):
    """Before the kill and after it; its first inputs reached the late recorder."""
    inputs = load_inputs(run.bag)
    assert len(inputs.sessions) == 2
    first = inputs.sessions[0]
    assert first.rows[0, 0] == 0, 'the journal begins with the first event'
    # A reference that starts again is discovered by controller and recorder at different times.
    before = first.rows[:, 2] < run.killed_ns['reference_generator']
    assert first.exact[before].all(), inputs.notes
    assert np.count_nonzero(first.events[before] == Event.STEP) > 400
    outcome = compare(inputs, replay_controller(inputs), Tolerances(absolute=1e-9, relative=0.0))
    assert outcome.same, outcome.table()


def _speeds(bag, topic='/ground_truth/odom'):
    """Return stamps (ns) and |v| plus the share of |omega| in a wheel speed, m/s."""
    with open_bag(bag) as recording:
        data = recording.series(topic, {'v': 'twist.twist.linear.x', 'w': 'twist.twist.angular.z'})
        stamps = recording.start_ns + np.round(data['stamp'] * NANOSECONDS).astype(np.int64)
    return stamps, np.abs(data['v']) + 0.0735 * np.abs(data['w'])


def _during(stamps, values, start_ns, begin, end):
    """Return the values from ``begin`` to ``end`` s after a time; there are some."""
    chosen = (stamps > start_ns + begin * NANOSECONDS) & (stamps < start_ns + end * NANOSECONDS)
    assert chosen.any()
    return values[chosen]


@pytest.mark.timed
@pytest.mark.parametrize('victim', ['reference_generator', 'controller'])
def test_killed_source_stops_robot_in_half_a_second(victim, run):
    killed_ns = run.killed_ns[victim]
    stamps, speeds = _speeds(run.bag)
    assert np.mean(_during(stamps, speeds, killed_ns, -1.0, 0.0) > MOVING) > 0.8
    still = _during(stamps, speeds, killed_ns, 1.0, 1.5)
    assert still.max() < MOVING, 'the robot still moved a second after the kill'
    # The body oscillates by about a millimetre after the stepper motors have stopped.
    pulses = _during(*_speeds(run.bag, '/odom'), killed_ns, 0.5, 1.5)
    assert pulses.max() < MOVING, 'the motors still turned half a second after the kill'


@pytest.mark.timed
def test_a_killed_robot_zeroes_commands_until_its_restart(run):
    with open_bag(run.bag) as recording:
        commands = recording.series('/cmd_vel', {'v': 'linear.x', 'w': 'angular.z'})
        stamps = recording.start_ns + np.round(commands['received'] * NANOSECONDS).astype(np.int64)
    for name in 'vw':
        silent = _during(stamps, commands[name], run.killed_ns['sim_robot'], 0.5, 1.4)
        assert silent.size >= 5, 'zero commands during the odometry timeout'
        assert not silent.any()


@pytest.mark.timed
def test_a_restarted_recorder_continues_the_bag(run):
    assert len(list(run.last_bag.glob('*.mcap'))) == 2
    stamps, speeds = _speeds(run.last_bag)
    assert np.mean(_during(stamps, speeds, run.end_ns, -1.0, 0.0) > MOVING) > 0.8
