# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Grid, latched topics, pause and seeds of the reference generator node."""

from nav_msgs.msg import Odometry, Path
import numpy as np
import pytest
from rcl_interfaces.msg import Log
from std_msgs.msg import Int32MultiArray
from std_srvs.srv import SetBool, Trigger
from support.ros_graph import LATCHED, diagnostic, on_grid, reason, speed, stamp

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode

pytestmark = pytest.mark.ros


def test_the_reference_has_an_exact_grid_ahead_by_the_lead(harness):
    reference = harness.add(
        ReferenceGeneratorNode, lead=0.5, frame_id='a/odom', child_frame_id='a/base', seed=7
    )
    received = []
    harness.probe.create_subscription(
        Odometry, 'reference', lambda m: received.append((reference.now_ns(), m)), 100
    )
    harness.spin_until(lambda: len(received) > 100)
    stamps = np.array([stamp(message) for _, message in received])
    assert on_grid([message for _, message in received], 100)
    ahead = (stamps - np.array([now for now, _ in received])) / NANOSECONDS
    # A sample is published when it is due, or late on a busy machine, but never early.
    assert ahead.max() <= 0.5
    assert ahead.max() > 0.4
    newest = received[-1][1]
    assert newest.header.frame_id == 'a/odom'
    assert newest.child_frame_id == 'a/base'


def test_late_subscribers_receive_signals_and_path(harness):
    reference = harness.add(ReferenceGeneratorNode)
    harness.spin_until(lambda: diagnostic(reference, 'mode') != 'none')
    mode = diagnostic(reference, 'mode')
    harness.next_status('reference_generator')  # the path is published at 1 Hz
    modes = reference.parameters.switching.modes
    signals = harness.subscribe(Int32MultiArray, 'reference/signals', LATCHED)
    path = harness.subscribe(Path, 'reference/path', LATCHED)
    harness.spin_until(lambda: signals and path)
    assert list(signals[0].data) == [mode, *modes[2 * mode : 2 * mode + 2]]
    assert path[0].header.frame_id == 'odom'
    stamps = np.array([stamp(pose) for pose in path[-1].poses])
    assert set(np.diff(stamps)) <= {NANOSECONDS // 10}


def test_a_paused_reference_stands_still_and_resumes(harness):
    reference = harness.add(ReferenceGeneratorNode, ramp=0.0)
    received = harness.subscribe(Odometry, 'reference')
    harness.spin_until(lambda: received and speed(received[-1]) > 0.0)
    assert harness.call(SetBool, 'reference_generator/pause', data=True).success
    harness.spin_until(lambda: speed(received[-1]) == 0.0)
    held = received[-1].pose.pose
    count = len(received)
    harness.spin_until(lambda: len(received) > count + 10, 'the paused reference is published')
    assert all(speed(message) == 0.0 for message in received[count:])
    assert received[-1].pose.pose == held
    assert reason(reference) == 'paused'
    assert harness.call(SetBool, 'reference_generator/pause', data=False).success
    harness.spin_until(lambda: speed(received[-1]) > 0.0)
    assert on_grid(received, 100)


def _twists(received, count):
    return [(m.twist.twist.linear.x, m.twist.twist.angular.z) for m in received[:count]]


def test_one_seed_gives_one_reference(harness):
    received = []
    for name, seed in (('a', 3), ('b', 3), ('c', 4)):
        received.append(harness.subscribe(Odometry, f'{name}/reference'))
        harness.add(ReferenceGeneratorNode, namespace=name, seed=seed, ramp=0.0)
    harness.spin_until(lambda: min(map(len, received)) >= 50)
    first, same, other = (_twists(messages, 50) for messages in received)
    assert first == same
    assert first != other


def test_reseed_changes_the_reference_and_hides_the_seed(harness):
    """The seed determines the path of the robot."""
    seed = 918_273_645
    log = harness.subscribe(Log, '/rosout', LATCHED)
    reference = harness.add(ReferenceGeneratorNode, seed=seed, ramp=1.0)
    received = harness.subscribe(Odometry, 'reference')
    harness.spin_until(lambda: len(received) > 150)
    response = harness.call(Trigger, 'reference_generator/reseed')
    assert response.success
    count = len(received)
    harness.spin_until(lambda: len(received) > count + 100)
    status = harness.next_status('reference_generator')
    texts = [response.message, str(status), *(entry.msg for entry in log)]
    for text in texts:
        assert not any(character.isdigit() for character in str(response.message))
        for number in range(seed - 2, seed + 3):
            assert str(number) not in text
    # The new reference starts from zero, so that a robot at rest can follow.
    assert min(speed(message) for message in received[140:]) < 1e-3
    assert on_grid(received, 100)
    assert reference.get_parameter('seed').value == seed
