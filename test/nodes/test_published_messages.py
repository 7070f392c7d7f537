# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What consumers of the messages rely on: frames, gravity, covariances, hardware names."""

import sys
import types

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
import pytest
from sensor_msgs.msg import Imu, Range
from std_srvs.srv import Trigger
from support.ros_graph import LATCHED

from t3mpc_ros.nodes.controller import ControllerNode
from t3mpc_ros.nodes.conversions import FrameParameters
from t3mpc_ros.nodes.radio_bridge import RadioBridgeNode
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode


@pytest.mark.parametrize(
    'values, namespace, expected',
    [
        ({}, '/', 'odom'),
        ({}, '/robot_1', 'robot_1/odom'),
        ({}, '/fleet/robot_1', 'fleet/robot_1/odom'),
        ({'tf_frame_prefix': 'left'}, '/', 'left/odom'),
        ({'tf_frame_prefix': '/left/'}, '/robot_1', 'left/odom'),
        ({'tf_frame_prefix_enable': False}, '/robot_1', 'odom'),
    ],
)
def test_a_frame_is_prefixed_by_the_namespace(values, namespace, expected):
    frames = FrameParameters.from_dict(values)
    assert frames.prefixed('odom', namespace) == expected
    assert frames.prefixed(expected, namespace) == expected, 'not twice'


@pytest.mark.ros
def test_the_frames_of_a_namespace_have_its_prefix(harness):
    """Two robots published the transforms of one frame ``odom``."""
    for kind, values in (
        (SimRobotNode, {'enable_stamped_cmd_vel': True}),
        (ControllerNode, {'enable_stamped_cmd_vel': True}),
        (ReferenceGeneratorNode, {}),
    ):
        harness.add(kind, namespace='one', **values)
    wanted = {
        'odom': (Odometry, 'one/odom'),
        'ground_truth/odom': (Odometry, 'map'),
        'reference': (Odometry, 'one/odom'),
        'cmd_vel': (TwistStamped, 'one/base_link'),
        'imu/data_raw': (Imu, 'one/imu_link'),
        'range/front_left': (Range, 'one/front_left_range_link'),
    }
    received = {name: harness.subscribe(kind, f'one/{name}') for name, (kind, _) in wanted.items()}
    paths = harness.subscribe(Path, 'one/reference/path', LATCHED)
    harness.spin_until(lambda: all(received.values()) and paths)
    for name, (kind, frame) in wanted.items():
        message = received[name][-1]
        assert message.header.frame_id == frame, name
        if kind is Odometry:
            assert message.child_frame_id == 'one/base_link', name
    assert {paths[-1].header.frame_id, paths[-1].poses[-1].header.frame_id} == {'one/odom'}


@pytest.mark.ros
def test_fixed_frames_have_the_names_of_the_messages(harness, monkeypatch):
    """Ranges and accelerations came in frames that no transform led to."""
    sent = []

    class Broadcaster:
        def __init__(self, node):
            pass

        def sendTransform(self, transforms):
            sent.append(transforms)

    tf2_ros = types.SimpleNamespace(
        StaticTransformBroadcaster=Broadcaster, TransformBroadcaster=Broadcaster
    )
    monkeypatch.setitem(sys.modules, 'tf2_ros', tf2_ros)
    mounted = {'range_sensor.half_length': 0.2, 'range_frame_prefix': 'sharp_'}
    harness.add(SimRobotNode, namespace='one', enable_odom_tf=False, **mounted)
    ranges = harness.subscribe(Range, 'one/range/rear_left')
    imu = harness.subscribe(Imu, 'one/imu/data_raw')
    harness.spin_until(lambda: ranges and imu)
    (transforms,) = sent
    found = {transform.child_frame_id: transform for transform in transforms}
    assert {transform.header.frame_id for transform in transforms} == {'one/base_link'}
    assert len(found) == 9
    assert imu[-1].header.frame_id in found
    rear = found[ranges[-1].header.frame_id].transform
    assert rear.translation.x == -0.2
    assert abs(rear.rotation.z) == pytest.approx(1.0), 'it looks backwards'
    sent.clear()
    harness.add(SimRobotNode, namespace='two', enable_odom_tf=False, enable_static_tf=False)
    assert not sent


@pytest.mark.ros
def test_the_covariance_of_a_reset_pose_is_positive_definite(harness):
    """It was exactly 0, which filters cannot invert."""
    odom = harness.subscribe(Odometry, 'odom')
    harness.add(SimRobotNode)
    harness.spin_until(lambda: odom)
    assert harness.call(Trigger, 'reset_odometry').success
    count = len(odom)
    harness.spin_until(lambda: len(odom) > count)
    for message in (odom[0], odom[-1]):
        covariance = np.reshape(message.pose.covariance, (6, 6))
        assert np.linalg.eigvalsh(covariance).min() > 1e-7


@pytest.mark.ros
@pytest.mark.parametrize(
    'kind, values, expected',
    [
        (ControllerNode, {}, 'none'),
        (SimRobotNode, {'seed': 7}, 'simulated robot 7'),
        (RadioBridgeNode, {'port': '/dev/no_dongle'}, '/dev/no_dongle'),
    ],
)
def test_hardware_id_names_the_device(kind, values, expected, harness):
    """It was the name of the package."""
    node = harness.add(kind, **values)
    assert harness.next_status(node.get_name()).hardware_id == expected
