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
"""A recorded controller node is recomputed from its bag, bit for bit."""

import numpy as np
import pytest
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger
from support.ros_graph import ControllerHarness, diagnostic, odometry, reason

from t3mpc_ros.bag.controller_input_journal import Event
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recorder_parameters import RecordingParameters
from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.process_replay.controller_inputs import load_inputs
from t3mpc_ros.evaluation.process_replay.controller_replay import (
    recompute_scalars,
    replay_controller,
)
from t3mpc_ros.evaluation.process_replay.replay_comparison import Tolerances, compare
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.model_file import save_model
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.recorder import RecorderNode
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode

pytestmark = pytest.mark.ros

TERMS_RATE = 50.0
"""Rate of the scalars, not the default, Hz."""


def listed_as_missing(bag, topic):
    """Return the number of messages of a topic that the bag lacks by its own record."""
    with open_bag(bag) as recording:
        losses = recording.metadata_records['losses']
    return sum(int(count) for key, count in losses.items() if key.endswith(f' {topic}'))


def start_recorder(harness, bag):
    # Scalars are not recorded by default.
    topics = [*RecordingParameters().topics, 'controller/*']
    return harness.add(RecorderNode, storage__uri=str(bag), record__topics=topics)


def drive(bench, steps, mean=0.1, linear=None):
    """Follow a reference that varies about a mean, or measure a constant velocity instead."""
    for _ in range(steps // 10):
        phase = 1e-9 * bench.stamp_ns
        wanted = mean + 0.05 * np.sin(phase)
        for ahead in range(20, 30):  # each stamp once
            stamp_ns = bench.stamp_ns + ahead * NANOSECONDS // 100
            bench.reference_publisher.publish(odometry(stamp_ns, wanted, 0.3 * np.cos(phase)))
        bench.run(10, wanted if linear is None else linear)


def eventful_run(harness, bag, model, late):
    """Record a controller with every event of its journal."""
    learnt = Controller(ControllerParameters()).law.get_weights()
    learnt['fuzzy.coefficients'] += 0.25
    save_model(model, learnt, {})
    recorder = None if late else start_recorder(harness, bag)
    bench = ControllerHarness(
        harness, odometry_timeout=1.0, model=str(model), terms_rate=TERMS_RATE
    )
    controller = bench.controller
    drive(bench, 50)
    recorder = recorder or start_recorder(harness, bag)
    harness.wait_for_subscriber(bench.odom_publisher, 2)
    harness.wait_for_subscriber(bench.reference_publisher, 2)
    for topic in ('cmd_vel', 'controller/journal', 'controller/lyapunov/margin'):
        count = 2 if topic == 'cmd_vel' else 1  # the harness subscribes, too
        harness.spin_until(lambda t=topic, n=count: controller.count_subscribers(t) >= n, topic)
    drive(bench, 100)
    harness.done(Trigger, 'controller/reset')
    drive(bench, 50)
    drive(bench, 200, mean=0.3, linear=0.0)
    for name, value in (('law.gain', 90.0), ('linear.x.max_velocity', 0.12)):
        assert controller.set_parameters([Parameter(name, value=value)])[0].successful
        drive(bench, 50)
    for enabled in (False, True):
        harness.done(SetBool, 'controller/enable', data=enabled)
        drive(bench, 30)
    harness.spin_until(lambda: reason(controller) == 'stopped: no odometry')
    drive(bench, 100)
    harness.remove(controller)
    harness.spin_until(lambda: recorder.count_publishers('cmd_vel') == 0)
    harness.remove(recorder)


@pytest.mark.parametrize('late', [pytest.param(False, marks=pytest.mark.long), True])
def test_a_recorded_controller_replays_bit_for_bit(late, harness, tmp_path):
    """With stops, an unresponsive robot, a timeout, dynamic parameters and a model file.

    A late recorder lacks the first messages: the controller keeps its first inputs for it.
    """
    bag = tmp_path / 'bag'
    eventful_run(harness, bag, tmp_path / 'model.npz', late)
    inputs = load_inputs(bag)
    [session] = inputs.sessions
    assert session.rows[0, 0] == 0, 'the journal begins with the first event'
    # Ranges are in the journal with the keep-out only, gaps that are followed for other robots.
    elsewhere = {Event.RANGE, Event.STEP_WITHOUT_ODOMETRY}
    assert {Event(value) for value in session.events.tolist()} == set(Event) - elsewhere
    assert session.exact.all(), inputs.notes
    again = replay_controller(inputs)
    reasons = set(again.reasons)
    assert {Reason.TRACKING, Reason.NOT_FOLLOWING, Reason.DISABLED, Reason.NO_ODOMETRY} <= reasons
    outcome = compare(inputs, again, Tolerances(absolute=1e-9, relative=0.0))
    assert outcome.same, outcome.table()
    recorded_commands = np.isfinite(inputs.recorded['cmd_vel.linear.x'])
    missing = np.count_nonzero(inputs.commanding & ~recorded_commands)
    assert missing == listed_as_missing(bag, '/cmd_vel'), inputs.notes
    assert not late or any(
        note.startswith(f'{missing} commands of the controller') for note in inputs.notes
    )
    assert (missing > 0) == late
    for name in ('cmd_vel.linear.x', 'cmd_vel.angular.z'):
        compared = inputs.commanding & inputs.exact & recorded_commands
        assert np.count_nonzero(compared) > 500
        recorded, computed = inputs.recorded[name][compared], again.fields[name][compared]
        np.testing.assert_array_equal(computed, recorded)
    numbers = [row for row in outcome.rows if not row.field.startswith('cmd_vel')]
    assert len(numbers) == 20
    assert all(row.count > 50 and row.absolute == 0.0 for row in numbers), outcome.table()
    with open_bag(bag) as recording:
        scalars, _ = recompute_scalars(recording, '')
        for name in ('controller/error/left', 'controller/lyapunov/margin'):
            recorded = recording.series(f'/{name}', {'value': 'data'})['value']
            assert recorded.size > 200
            assert recorded.tolist() == scalars[name]['value'][-recorded.size :].tolist()


def test_a_patrol_replays_bit_for_bit(harness, tmp_path):
    """Its commands depend on the range sensors, too, whose readings are in the journal.

    The robot also keeps out of walls of its world, which no sensor sees.
    """
    bag, world = tmp_path / 'bag', tmp_path / 'walls.yaml'
    world.write_text(
        'name: walls\nwalls:\n'
        '  - {points: [[-0.3, -0.3], [0.3, -0.3], [0.3, 0.3], [-0.3, 0.3]], closed: true}\n'
    )
    recorder = start_recorder(harness, bag)
    controller = harness.add(
        ControllerNode,
        pose__enabled=True,
        keep_out__enabled=True,
        keep_out__world=str(world),
        keep_out__scan_rate=5.0,  # it looks around before it drives
    )
    harness.spin_until(lambda: recorder.count_publishers('controller/journal') > 0)
    harness.add(SimRobotNode, world='room')
    harness.add(ReferenceGeneratorNode, source='portrait', seed=7)
    harness.spin_until(lambda: diagnostic(controller, 'steps') > 500)
    harness.remove(controller)
    harness.remove(recorder)
    inputs = load_inputs(bag)
    (session,) = inputs.sessions
    assert np.count_nonzero(session.events == Event.RANGE) > 100
    again = replay_controller(inputs)
    outcome = compare(inputs, again, Tolerances(absolute=0.0, relative=0.0))
    assert outcome.same, outcome.table()
    recorded_commands = np.isfinite(inputs.recorded['cmd_vel.linear.x'])
    compared = inputs.commanding & inputs.exact & recorded_commands
    assert np.count_nonzero(compared) > 200
    assert np.ptp(inputs.recorded['cmd_vel.angular.z'][compared]) > 0.0, 'the robot moved'
