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
"""Several nodes in one process."""

import numpy as np
import pytest
import rclpy
from support.ros_graph import diagnostic, is_ok
from support.waiting import wait_until

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.nodes.composed import ComposedNode
from t3mpc_ros.nodes.node_main import make_executor
from t3mpc_ros.nodes.registry import NODES
from t3mpc_ros.parameters.table import ParameterError

pytestmark = pytest.mark.ros


@pytest.fixture
def compose(graph, tmp_path):
    """Return a function that makes the nodes of ``composed`` from parameters."""
    nodes = []

    def make(*parameters):
        words = [f'storage.uri:={tmp_path}', *parameters]
        words = ['--ros-args', *(word for item in words for word in ('-p', item))]
        rclpy.init(args=words)
        nodes.extend(ComposedNode.make(cli_args=words))
        return {node.get_name(): node for node in nodes}

    yield make
    for node in nodes:
        node.on_shutdown()
        node.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.parametrize(
    'order', ['', 'nodes:=[recorder, controller, sim_robot, reference_generator]']
)
def test_composed_runs_with_stamped_commands_in_any_order(order, compose, tmp_path):
    """An early subscription of the recorder must not fix the type of cmd_vel in the process."""

    def spin_until(condition):
        wait_until(condition, step=lambda: executor.spin_once(timeout_sec=0.05))

    nodes = compose('enable_stamped_cmd_vel:=true', *filter(None, [order]))
    assert nodes.keys() == set(NODES) - {'radio_bridge', 'player', 'localizer'}
    executor = make_executor()
    for node in nodes.values():
        executor.add_node(node)
    spin_until(lambda: is_ok(nodes['sim_robot'], 'following commands'))
    spin_until(lambda: nodes['recorder'].count_subscribers('cmd_vel') > 1)
    expected = 'geometry_msgs/msg/TwistStamped'
    spin_until(lambda: nodes['recorder']._recorded_types.get('/cmd_vel') == expected)
    spin_until(lambda: nodes['sim_robot']._state.status.moving)
    count = diagnostic(nodes['recorder'], 'messages')
    spin_until(lambda: diagnostic(nodes['recorder'], 'messages') > count + 500)
    executor.shutdown()
    nodes['recorder'].on_shutdown()
    with open_bag(tmp_path) as recording:
        odometry = recording.series('/odom', {'v': 'twist.twist.linear.x'})
        steps = np.diff(odometry['stamp']) / 0.01
        assert np.allclose(steps, np.round(steps), atol=1e-4)
        assert steps.min() > 0.5
        assert np.ptp(odometry['v']) > 0.0
        assert recording.topics['/cmd_vel'].type_name == expected


def test_two_types_on_one_topic_cannot_share_a_process(compose):
    with pytest.raises(ParameterError, match='controller cannot share a process with sim_robot'):
        compose('controller:enable_stamped_cmd_vel:=true')
