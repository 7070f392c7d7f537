# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A recorded run of processes over DDS replays bit for bit."""

import os
import signal
import time

import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recording.recording_parameters import RecordingParameters
from t3mpc_ros.bag.run.journal import Event
from t3mpc_ros.bag.run.model_file import save_model
from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.process_replay.comparison import Tolerances, compare
from t3mpc_ros.evaluation.process_replay.controller_inputs import load_inputs
from t3mpc_ros.evaluation.process_replay.controller_replay import replay_controller

pytestmark = [pytest.mark.ros, pytest.mark.alone, pytest.mark.slow]

LOOP = ('recorder', 'controller', 'sim_robot', 'reference_generator')


class Operator:
    """Calls services of the running nodes."""

    def __init__(self):
        rclpy.init(args=[])
        self._node = Node('operator')

    def call(self, kind, name, **request):
        client = self._node.create_client(kind, name)
        assert client.wait_for_service(10.0), name
        future = client.call_async(kind.Request(**request))
        rclpy.spin_until_future_complete(self._node, future, timeout_sec=10.0)
        assert future.result() is not None, name
        return future.result()

    def set(self, name, value):
        number = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
        request = [Parameter(name=name, value=number)]
        [result] = self.call(
            SetParameters, '/controller/set_parameters', parameters=request
        ).results
        assert result.successful, result.reason

    def close(self):
        self._node.destroy_node()
        rclpy.try_shutdown()


def live_run(processes, bag, model):
    """Drive for about 20 s with every event of the controller journal."""
    learnt = Controller(ControllerParameters()).law.get_weights()
    learnt['fuzzy.coefficients'] += 0.25
    save_model(model, learnt, {})
    # Scalars are not recorded by default.
    topics = [*RecordingParameters().topics, 'controller/*']
    parameters = {
        'recorder': {'storage.uri': str(bag), 'record.topics': topics},
        'controller': {'model': str(model)},
    }
    for name in LOOP:
        processes.start(name, parameters=parameters.get(name))
        processes.wait_ready(name)
    processes.wait_for('controller', 'tracking')
    operator = Operator()
    try:
        time.sleep(1.0)
        # The recorder may discover a topic later than the controller; a reset makes the replay
        # independent of earlier messages.
        assert operator.call(Trigger, '/controller/reset').success
        time.sleep(2.0)
        operator.set('law.gain', 17.0)
        time.sleep(1.0)
        operator.set('linear.x.max_velocity', 0.2)
        time.sleep(1.0)
        assert operator.call(
            SetBool, '/e_stop', data=True
        ).success  # the robot does not follow commands
        # As soon as the reference is faster than a robot at rest explains.
        processes.wait_for('controller', Reason.NOT_FOLLOWING.value)
        time.sleep(0.5)
        assert operator.call(SetBool, '/e_stop', data=False).success
        time.sleep(2.0)
        assert operator.call(SetBool, '/controller/enable', data=False).success
        time.sleep(0.5)
        assert operator.call(SetBool, '/controller/enable', data=True).success
        time.sleep(1.5)
        os.kill(processes.pid('sim_robot'), signal.SIGSTOP)  # odometry timeout
        time.sleep(0.6)
        os.kill(processes.pid('sim_robot'), signal.SIGCONT)
        time.sleep(2.0)
        assert operator.call(Trigger, '/controller/reset').success
        operator.set('law.gain', 12.0)
        time.sleep(2.0)
        processes.check()
    finally:
        operator.close()
    # The controller first: the recorder then has all messages that the controller received.
    codes = processes.stop_all(('controller', 'reference_generator', 'sim_robot', 'recorder'))
    assert set(codes.values()) == {0}


def listed_as_missing(bag, topic):
    """Return the number of messages of a topic that the bag lacks by its own record."""
    with open_bag(bag) as recording:
        losses = recording.metadata_records['losses']
    return sum(int(count) for key, count in losses.items() if key.endswith(f' {topic}'))


def test_a_live_run_replays_bit_for_bit(processes, tmp_path):
    """With stops, an unresponsive robot, a timeout, dynamic parameters and a model file."""
    live_run(processes, tmp_path / 'bag', tmp_path / 'model.npz')
    inputs = load_inputs(tmp_path / 'bag')
    assert inputs.journalled
    [life] = inputs.lives
    assert {Event(value) for value in life.events.tolist()} == set(Event)
    reset = np.flatnonzero(life.events == Event.RESET)
    assert reset.size == 2
    assert life.exact[reset[0] :].all(), inputs.notes
    # Only messages from before the discovery by the recorder may be missing.
    assert life.exact.all() or any('references' in note for note in inputs.notes), inputs.notes
    again = replay_controller(inputs)
    reasons = set(again.reasons)
    assert {Reason.TRACKING, Reason.NOT_FOLLOWING, Reason.DISABLED, Reason.NO_ODOMETRY} <= reasons
    outcome = compare(inputs, again, Tolerances(absolute=1e-9, relative=0.0))
    assert outcome.same, outcome.table()
    held = np.isfinite(inputs.recorded['cmd_vel.linear.x'])
    # On a busy machine the recorder discovers cmd_vel after the first commands, or does not
    # acknowledge a command within the 0.5 s for which the controller keeps it.
    missing = np.count_nonzero(inputs.commanding & ~held)
    assert missing == listed_as_missing(tmp_path / 'bag', '/cmd_vel'), inputs.notes
    for name in ('cmd_vel.linear.x', 'cmd_vel.angular.z'):
        compared = inputs.commanding & inputs.exact & held
        assert np.count_nonzero(compared) > 1200
        recorded, computed = inputs.recorded[name][compared], again.fields[name][compared]
        np.testing.assert_array_equal(computed, recorded)
    numbers = [row for row in outcome.rows if not row.field.startswith('cmd_vel')]
    assert len(numbers) == 20
    assert all(row.count > 100 and row.absolute == 0.0 for row in numbers), outcome.table()


def test_a_late_recorder_can_replay_from_the_beginning(processes, tmp_path):
    """Without the initial inputs of the controller the first odometry messages would be lost."""
    bag = tmp_path / 'bag'
    for name in ('sim_robot', 'reference_generator', 'controller'):
        processes.start(name)
        processes.wait_ready(name)
    processes.wait_for('controller', 'tracking')
    processes.start('recorder', parameters={'storage.uri': str(bag)})
    processes.wait_ready('recorder')
    time.sleep(5.0)
    processes.check()
    order = ('controller', 'reference_generator', 'sim_robot', 'recorder')
    assert set(processes.stop_all(order).values()) == {0}
    inputs = load_inputs(bag)
    assert inputs.journalled
    [life] = inputs.lives
    assert life.rows[0, 0] == 0, 'the journal begins with the first event'
    assert life.exact.all(), inputs.notes
    held = np.isfinite(inputs.recorded['cmd_vel.linear.x'])
    missing = np.count_nonzero(inputs.commanding & ~held)
    assert 0 < missing == listed_as_missing(bag, '/cmd_vel')
    assert any(note.startswith(f'{missing} commands of the controller') for note in inputs.notes)
    assert (life.events == Event.STEP).sum() > 500
    outcome = compare(inputs, replay_controller(inputs), Tolerances(absolute=1e-9, relative=0.0))
    assert outcome.same, outcome.table()
