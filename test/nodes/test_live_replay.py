# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A run of real processes over DDS, recorded, and computed again: each command comes out alike."""

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

from t3mpc_ros.bag.run.journal import Event
from t3mpc_ros.bag.run.model_file import save_model
from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.process_replay.comparison import Tolerances, compare
from t3mpc_ros.evaluation.process_replay.controller_inputs import load_inputs
from t3mpc_ros.evaluation.process_replay.controller_replay import replay_controller

pytestmark = [pytest.mark.ros, pytest.mark.slow]

LOOP = ('recorder', 'controller', 'sim_robot', 'reference_generator')


class Person:
    """Somebody at the keyboard: calls services of the running nodes."""

    def __init__(self):
        rclpy.init(args=[])
        self._node = Node('person')

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

    def leave(self):
        self._node.destroy_node()
        rclpy.try_shutdown()


def live_run(fleet, bag, model):
    """Drive for about twenty seconds, with everything that can happen to a controller."""
    learnt = Controller(ControllerParameters()).law.get_weights()
    learnt['fuzzy.coefficients'] += 0.25
    save_model(model, learnt, {})
    parameters = {'recorder': {'folder': str(bag)}, 'controller': {'model': str(model)}}
    for name in LOOP:
        fleet.start(name, parameters=parameters.get(name))
        fleet.wait_ready(name)
    fleet.wait_for('controller', 'tracking')
    person = Person()
    try:
        time.sleep(1.0)
        # Over DDS a recorder may hear of the reference later than the controller does, and what
        # it missed is missing: from here on all is known.
        assert person.call(Trigger, '/controller/reset').success
        time.sleep(2.0)
        person.set('law.gain', 17.0)
        time.sleep(1.0)
        person.set('linear.x.max_velocity', 0.2)
        time.sleep(1.0)
        assert person.call(SetBool, '/e_stop', data=True).success  # the robot does not follow
        time.sleep(1.0)
        assert person.call(SetBool, '/e_stop', data=False).success
        time.sleep(2.0)
        assert person.call(SetBool, '/controller/enable', data=False).success
        time.sleep(0.5)
        assert person.call(SetBool, '/controller/enable', data=True).success
        time.sleep(1.5)
        os.kill(fleet.pid('sim_robot'), signal.SIGSTOP)  # the odometry goes silent
        time.sleep(0.6)
        os.kill(fleet.pid('sim_robot'), signal.SIGCONT)
        time.sleep(2.0)
        assert person.call(Trigger, '/controller/reset').success
        person.set('law.gain', 12.0)
        time.sleep(2.0)
        fleet.check()
    finally:
        person.leave()
    # The controller first: all that it has heard is then recorded, too.
    codes = fleet.stop_all(('controller', 'reference_generator', 'sim_robot', 'recorder'))
    assert set(codes.values()) == {0}


def test_a_live_run_replays_bit_for_bit(fleet, tmp_path):
    """Stops, starts, a robot that does not follow, silence, live settings and a model included."""
    live_run(fleet, tmp_path / 'bag', tmp_path / 'model.npz')
    inputs = load_inputs(tmp_path / 'bag')
    assert inputs.journalled
    [life] = inputs.lives
    assert {Event(value) for value in life.events.tolist()} == set(Event)
    reset = np.flatnonzero(life.events == Event.RESET)
    assert reset.size == 2
    assert life.exact[reset[0] :].all(), inputs.notes
    # Only what came before the recorder had found everybody may be missing.
    assert life.exact.all() or any('references' in note for note in inputs.notes), inputs.notes
    again = replay_controller(inputs)
    reasons = set(again.reasons)
    assert {Reason.TRACKING, Reason.NOT_FOLLOWING, Reason.DISABLED, Reason.NO_ODOMETRY} <= reasons
    outcome = compare(inputs, again, Tolerances(absolute=1e-9, relative=0.0))
    assert outcome.same, outcome.table()
    for name in ('cmd_vel.linear.x', 'cmd_vel.angular.z'):
        compared = inputs.commanding & inputs.exact
        recorded, computed = inputs.recorded[name][compared], again.fields[name][compared]
        assert np.isfinite(recorded).all(), 'a command of the run is not in the bag'
        assert recorded.size > 1200
        np.testing.assert_array_equal(computed, recorded)
    numbers = [row for row in outcome.rows if not row.field.startswith('cmd_vel')]
    assert len(numbers) == 20
    assert all(row.count > 100 and row.absolute == 0.0 for row in numbers), outcome.table()
