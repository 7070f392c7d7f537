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
"""The controller node with good, invalid and missing input."""

import math
from unittest.mock import Mock

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry
import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Range
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger
from support.ros_graph import (
    LATCHED,
    ControllerHarness,
    diagnostic,
    diagnostic_level,
    odometry,
    reason,
    stamp,
)

from t3mpc_ros.geometry.occupancy_map_file import load_map
from t3mpc_ros.model_file import ModelError, load_model
from t3mpc_ros.nodes import controller as controller_module
from t3mpc_ros.nodes import topic_endpoints
from t3mpc_ros.nodes.base_node import ERROR, OK, WARN
from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.ros_messages import grid_from_occupancy, time_from_ns
from t3mpc_ros.parameters.table import ParameterError

pytestmark = pytest.mark.ros


def test_a_stale_reference_gives_a_zero_command_with_the_reason(harness):
    bench = ControllerHarness(harness)
    controller = bench.controller
    bench.publish_odometry()
    assert reason(controller) == 'stopped: no reference yet'
    bench.publish_reference()
    bench.run(5)
    assert (diagnostic_level(controller), reason(controller)) == (OK, 'tracking')
    assert bench.last_command().linear.x > 0.0
    bench.run(30, linear=0.1)  # the reference ends after 0.1 s and is valid for 0.15 s more
    assert (diagnostic_level(controller), reason(controller)) == (
        ERROR,
        'stopped: reference is stale',
    )
    assert bench.last_command() == Twist()


def test_the_map_of_the_keep_out_is_in_the_frame_of_odom(harness, tmp_path):
    file = str(tmp_path / 'room.yaml')
    keep_out = {'pose__enabled': True, 'keep_out__enabled': True}
    bench = ControllerHarness(harness, **keep_out, map_output=file)
    maps = harness.subscribe(OccupancyGrid, 'keep_out/map', LATCHED)
    ranges = harness.connected_publisher(Range, 'range/front_left')
    place = odometry(0)
    place.header.frame_id = 'one/odom'
    place.pose.pose.position.x = 1.0

    def seen():
        bench.stamp_ns += 10_000_000
        place.header.stamp = time_from_ns(bench.stamp_ns)
        bench.odom_publisher.publish(place)
        ranges.publish(Range(range=0.5))
        return maps and 100 in maps[-1].data

    harness.spin_until(seen)
    grid = grid_from_occupancy(maps[-1])
    assert maps[-1].header.frame_id == 'one/odom'
    row, column = np.argwhere(grid.cells == 100)[0]
    assert grid.x + (column + 0.5) * grid.resolution == pytest.approx(1.6, abs=grid.resolution)
    assert grid.y + (row + 0.5) * grid.resolution == pytest.approx(0.05, abs=grid.resolution)
    column, row = (
        int((at - low) / grid.resolution) for at, low in ((1.3, grid.x), (0.05, grid.y))
    )
    assert grid.cells[row, column] == 0
    assert grid.cells[0, 0] == -1
    assert file in harness.done(Trigger, 'controller/save_map')
    assert (load_map(file).cells == 100).any()
    # Another one begins with its obstacles, and looks at the floor again.
    other = harness.add(
        ControllerNode, namespace='other', **keep_out, keep_out__yaml_filename=file
    )
    known = other._controller.keep_out.map.occupancy()
    assert (known.cells == 100).sum() == (load_map(file).cells == 100).sum()
    assert not (known.cells == 0).any()
    with pytest.raises(ParameterError, match=r'keep_out.yaml_filename: .*none.yaml'):
        harness.add(
            ControllerNode, namespace='none', **keep_out, keep_out__yaml_filename='none.yaml'
        )


@pytest.mark.parametrize('repeated', [False, True])
def test_an_odometry_timeout_gives_zero_commands(repeated, harness):
    """A message that is repeated says nothing new, but kept the robot going."""
    bench = ControllerHarness(harness, odometry_timeout=0.2)
    bench.publish_odometry()
    bench.publish_reference()
    bench.run(5)
    harness.spin_until(lambda: any(message.linear.x > 0.0 for message in bench.commands))

    def stopped():
        if repeated:
            bench.odom_publisher.publish(odometry(bench.stamp_ns))
        return reason(bench.controller) == 'stopped: no odometry'

    harness.spin_until(stopped)
    harness.spin_until(lambda: bench.commands[-4:] == 4 * [Twist()], 'zero commands continue')


def test_non_finite_odometry_or_reference_moves_nothing(harness):
    bench = ControllerHarness(harness)
    controller = bench.controller
    bench.publish_odometry()
    bench.publish_reference(math.nan)
    bench.publish_reference(0.1, math.inf)
    harness.spin_until(lambda: diagnostic(controller, 'references_rejected') == 22)
    bench.publish_odometry()
    assert reason(controller) == 'stopped: no reference yet'
    bench.publish_reference()
    bench.run(3)
    assert diagnostic_level(controller) == WARN, 'tracking, but some were refused'
    assert bench.last_command().linear.x > 0.0
    bench.publish_odometry(math.nan)
    assert (diagnostic_level(controller), reason(controller)) == (
        ERROR,
        'stopped: odometry is not finite',
    )
    assert bench.last_command() == Twist()


def test_huge_numbers_stop_the_robot_without_a_crash(harness):
    bench = ControllerHarness(harness)
    odom = harness.create_publisher(Odometry, 'odom')
    bench.publish_odometry()
    for value in (1e19, 1e160, 1e200, 1.7e308):
        bench.publish_reference(seconds=0.0)
        bench.publish_odometry()
        assert diagnostic_level(bench.controller) != ERROR, 'such references are ignored'
        bad = odometry(bench.stamp_ns + 1, value, value)
        bad.pose.pose.position.x = bad.pose.pose.orientation.y = value
        steps = diagnostic(bench.controller, 'steps')
        odom.publish(bad)
        harness.spin_until(lambda count=steps: diagnostic(bench.controller, 'steps') > count)
        assert diagnostic_level(bench.controller) == ERROR
        assert bench.last_command() == Twist()
        bench.publish_reference(value, -value)
        bench.run(60)  # the stop lasts half a second
        assert diagnostic_level(bench.controller) == ERROR
        assert bench.last_command() == Twist()
        bench.run(80)
    assert all(math.isfinite(message.linear.x) for message in bench.commands)


def test_enable_and_disable(harness):
    bench = ControllerHarness(harness)
    bench.publish_odometry()
    bench.publish_reference(seconds=0.5)
    for enabled in (True, False, True):
        harness.done(SetBool, 'controller/enable', data=enabled)
        bench.run(5)
        found = diagnostic_level(bench.controller), reason(bench.controller)
        disabled = ERROR, 'stopped: disabled by request'
        assert found == ((OK, 'tracking') if enabled else disabled)
        assert (bench.last_command().linear.x > 0.0) == enabled
        assert enabled or bench.last_command() == Twist()


def test_stamped_commands_have_frame_and_stamp_of_the_odometry(harness):
    bench = ControllerHarness(
        harness, TwistStamped, enable_stamped_cmd_vel=True, frame_id='a/base'
    )
    bench.publish_odometry()
    bench.publish_reference()
    bench.run(5)
    newest = bench.last_command()
    assert stamp(newest) == bench.stamp_ns
    assert newest.header.frame_id == 'a/base'
    assert newest.twist.linear.x > 0.0
    count = len(bench.commands)
    bench.controller.on_shutdown()
    harness.spin_until(lambda: len(bench.commands) > count)
    assert bench.commands[-1].twist == Twist(), 'the last command is a stop'


def test_weights_survive_in_a_model_file_and_not_a_reset(harness, tmp_path):
    bench = ControllerHarness(
        harness, composition='paper', model_output=str(tmp_path / 'model.npz')
    )

    def saved():
        assert str(tmp_path / 'model.npz') in harness.done(Trigger, 'controller/save_model')
        return load_model(tmp_path / 'model.npz')

    initial = saved()
    bench.publish_odometry()
    bench.publish_reference(0.1, 1.0, seconds=0.8)
    bench.run(50)  # a robot that does not follow: large adaptation
    learnt = saved()
    change = learnt['fuzzy.coefficients'] - initial['fuzzy.coefficients']
    assert np.abs(change).max() > 1e-3

    files = {name: str(tmp_path / f'{name}.npz') for name in ('model', 'copy')}
    harness.add(
        ControllerNode,
        namespace='copy',
        composition='paper',
        model=files['model'],
        model_output=files['copy'],
    )
    harness.done(Trigger, 'copy/controller/save_model')
    loaded = load_model(tmp_path / 'copy.npz')
    assert loaded.keys() == learnt.keys()
    for name in learnt:
        np.testing.assert_array_equal(loaded[name], learnt[name])

    harness.done(Trigger, 'controller/reset')
    for name, value in saved().items():
        np.testing.assert_array_equal(value, initial[name])
    bench.publish_odometry()
    assert reason(bench.controller) == 'stopped: no reference yet', 'a new reference is needed'


def test_an_unusable_model_file_is_named(harness, tmp_path):
    harness.add(ControllerNode, model_output=str(tmp_path / 'no' / 'folder.npz'))
    assert 'no/folder.npz' in harness.refused(Trigger, 'controller/save_model')
    small = harness.add(
        ControllerNode,
        namespace='small',
        fuzzy__sets=5,
        model_output=str(tmp_path / 'small.npz'),
    )
    harness.done(Trigger, 'small/controller/save_model')
    harness.remove(small)
    with pytest.raises(ModelError, match=r'small.npz does not fit the parameters'):
        harness.add(ControllerNode, namespace='other', model=str(tmp_path / 'small.npz'))


def test_scalars_are_published_at_terms_rate(harness):
    harness.add(ControllerNode, namespace='quiet', terms_rate=0.0)
    bench = ControllerHarness(harness, terms_rate=20.0)
    names = {
        name
        for name, kinds in harness.probe.get_topic_names_and_types()
        if 'std_msgs/msg/Float64' in kinds
    }
    assert not any(name.startswith('/quiet/') for name in names)
    assert len(names) >= 20
    received = {name: harness.subscribe(Float64, name) for name in sorted(names)}
    for name in names:
        harness.spin_until(lambda topic=name: bench.controller.count_subscribers(topic) > 0)
    bench.publish_odometry()
    bench.publish_reference(seconds=0.9)
    bench.run(99)
    harness.spin_until(lambda: all(len(values) == 20 for values in received.values()))
    # The speed filter expects the wheels to follow the command; here they do not.
    assert received['/controller/error/right'][-1].data == pytest.approx(-0.1 / 0.035, rel=0.03)
    for name in ('terms/applied/right', 'terms/feedback/left', 'lyapunov/value', 'skill/left'):
        assert math.isfinite(received[f'/controller/{name}'][-1].data), name


def test_a_scalar_without_subscribers_is_not_published(harness):
    bench = ControllerHarness(harness, terms_rate=20.0)
    publishers = {
        name: Mock(get_subscription_count=lambda wanted=name == 'skill/left': int(wanted))
        for name in bench.controller._scalar_publishers
    }
    bench.controller._scalar_publishers = publishers
    bench.publish_odometry()
    bench.publish_reference(seconds=0.9)
    bench.run(10)
    counts = {name: each.publish.call_count for name, each in publishers.items()}
    assert {name: count for name, count in counts.items() if count} == {'skill/left': 2}


# -- initial inputs -------------------------------------------------------------------------------


def test_initial_inputs_reach_a_late_subscriber(harness):
    bench = ControllerHarness(harness)
    odom = harness.subscribe(Odometry, 'odom')
    reference = harness.subscribe(Odometry, 'reference')
    harness.wait_for_subscriber(bench.odom_publisher, 2)
    harness.wait_for_subscriber(bench.reference_publisher, 2)
    bench.publish_reference(0.1, 0.5)
    bench.run(20)
    late = {
        name: harness.subscribe(Odometry, f'controller/initial_inputs/{name}', LATCHED)
        for name in ('odom', 'reference')
    }
    harness.spin_until(lambda: len(late['odom']) >= 20 and len(late['reference']) >= 11)
    assert late == {'odom': odom, 'reference': reference}
    bench.run(1)
    harness.spin_until(lambda: len(late['odom']) == 21, 'later inputs are republished, too')


@pytest.mark.parametrize(
    'limit, value, kept', [('INITIAL_INPUT_TIME_NS', 0, 0), ('INITIAL_INPUTS', 5, 5)]
)
def test_initial_inputs_end_and_keep_the_first(limit, value, kept, harness, monkeypatch):
    """After the time limit, or beyond the depth, no later message replaces the first ones."""
    if limit == 'INITIAL_INPUTS':
        profile = QoSProfile(depth=value, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        monkeypatch.setattr(topic_endpoints, limit, profile)
    else:
        monkeypatch.setattr(controller_module, limit, value)
    bench = ControllerHarness(harness)
    odom = harness.subscribe(Odometry, 'odom')
    harness.wait_for_subscriber(bench.odom_publisher, 2)
    bench.run(20)
    late = harness.subscribe(Odometry, 'controller/initial_inputs/odom', LATCHED)
    (publisher,) = harness.probe.get_publishers_info_by_topic('/controller/initial_inputs/odom')
    assert publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    harness.spin_until(lambda: len(late) >= kept)
    bench.run(5)
    harness.next_status('controller')  # time for what is kept to arrive
    assert late == odom[:kept]
