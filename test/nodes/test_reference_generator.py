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
"""Grid, latched topics, pause and seeds of the reference generator node."""

import secrets

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry, Path
import numpy as np
import pytest
from std_msgs.msg import Int32MultiArray
from std_srvs.srv import SetBool, Trigger
from support.ros_graph import LATCHED, diagnostic, odometry, on_grid, reason, speed, stamp, twist

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


def test_reseed_changes_the_reference_and_hides_the_seed(harness, logged):
    """The seed determines the path of the robot."""
    seed = 918_273_645
    reference = harness.add(ReferenceGeneratorNode, seed=seed, ramp=1.0)
    received = harness.subscribe(Odometry, 'reference')
    harness.spin_until(lambda: len(received) > 150)
    response = harness.call(Trigger, 'reference_generator/reseed')
    assert response.success
    count = len(received)
    harness.spin_until(lambda: len(received) > count + 100)
    status = harness.next_status('reference_generator')
    texts = [response.message, str(status), *logged('')]
    for text in texts:
        assert not any(character.isdigit() for character in str(response.message))
        for number in range(seed - 2, seed + 3):
            assert str(number) not in text
    # The new reference starts from zero, so that a robot at rest can follow.
    assert min(speed(message) for message in received[140:]) < 1e-3
    assert on_grid(received, 100)
    assert reference.get_parameter('seed').value == seed


PATH_LIMIT = 0.25


def _odometry(stamp_ns=0):
    message = odometry(stamp_ns)
    message.pose.pose.position.x, message.pose.pose.position.y = 0.5, -0.2
    return message


def _drive(harness, topic, message, until, **parameters):
    """Return the references of a generator that gets an odometry and, on ``topic``, a message."""
    reference = harness.add(ReferenceGeneratorNode, **parameters)
    received = harness.subscribe(Odometry, 'reference')
    places = harness.create_publisher(Odometry, 'odom')
    inputs = None
    if isinstance(message, Path):
        harness.create_publisher(Path, topic, LATCHED).publish(message)
    elif message is not None:
        inputs = harness.create_publisher(type(message), topic)
    harness.spin_until(lambda: places.get_subscription_count() > 0)

    def done():
        # The robot is where its reference is.
        places.publish(received[-1] if received else _odometry())
        if inputs is not None and received:
            inputs.publish(message)
        return received and until(received[-1])

    harness.spin_until(done)
    return reference, received


@pytest.mark.parametrize('source', ['portrait', 'file', 'topic'])
def test_a_path_begins_where_the_robot_is(harness, tmp_path, source):
    """The first sample is the pose of odom, at rest; speeds stay within the limits."""
    (tmp_path / 'path.csv').write_text('0,0\n3,0\n')
    given = {'path_file': str(tmp_path / 'path.csv')} if source == 'file' else {}
    message = None
    if source == 'topic':
        message = Path(poses=[PoseStamped(), PoseStamped()])
        for x, pose in zip((0.5, 1.5), message.poses, strict=True):
            pose.pose.position.x, pose.pose.position.y = x, -0.2
    _, received = _drive(
        harness, 'path', message, lambda m: speed(m) > 0.1, source=source, **given
    )
    first, last = (received[k].pose.pose.position for k in (0, -1))
    assert (first.x, first.y) == pytest.approx((0.5, -0.2), abs=1e-9)
    assert speed(received[0]) == 0.0
    assert max(map(speed, received)) <= PATH_LIMIT
    if source == 'topic':
        assert last.x > 0.5
        assert last.y == pytest.approx(-0.2, abs=1e-6)


@pytest.mark.parametrize('source', ['portrait', 'twist'])
def test_a_path_waits_for_a_robot_that_stands(harness, source):
    """A controller that starts later finds the path where the robot is."""
    reference = harness.add(ReferenceGeneratorNode, source=source)
    received = harness.subscribe(Odometry, 'reference')
    places = harness.create_publisher(Odometry, 'odom')
    twists = harness.create_publisher(Twist, 'target_twist')
    began = []

    def waits():
        places.publish(_odometry(reference.now_ns()))
        twists.publish(twist(0.2))
        began.extend(each for each in received[-1:] if speed(each) > 0.05)
        return began and speed(received[-1]) == 0.0

    harness.spin_until(waits)
    at = received[-1].pose.pose.position
    assert np.hypot(at.x - 0.5, at.y + 0.2) < 0.35  # twice the distance, and the lead
    assert reason(reference) == 'waiting for the robot'


def test_a_twist_message_is_followed_until_it_expires(harness):
    wanted = twist(0.2, 0.4)
    _, received = _drive(
        harness, 'target_twist', wanted, lambda m: speed(m) > 0.19, source='twist'
    )
    assert received[-1].twist.twist.angular.z == pytest.approx(0.4, abs=0.02)
    harness.spin_until(lambda: speed(received[-1]) == 0.0)  # no more messages


def test_a_patrol_keeps_its_seed_and_its_future(harness, logged, monkeypatch):
    """No parameter, topic, log line or service answer has a seed; no path is ahead of the lead.

    Each further seed, by service or at random times, is as secret as the first.
    """
    seeds = []

    def random_seed():
        seeds.append(secrets.randbits(128))
        return seeds[-1]

    monkeypatch.setattr('t3mpc_ros.nodes.reference_generator._random_seed', random_seed)
    status = harness.subscribe(DiagnosticArray, '/diagnostics')
    path = harness.subscribe(Path, 'reference/path', LATCHED)
    reference, received = _drive(
        harness,
        '',
        None,
        lambda m: len(seeds) > 2 and path,
        source='portrait',
        reseed__shortest=0.3,
        reseed__longest=0.6,
    )
    answer = harness.call(Trigger, 'reference_generator/reseed').message
    texts = [repr(each) for each in (*logged(''), *status, *path, *received, answer)]
    texts.append(repr(reference.parameters.to_dict()))
    texts.append(repr([p.get_parameter_value() for p in reference._parameters.values()]))
    assert len(seeds) >= 4
    for seed in seeds:
        for form in (str(seed), f'{seed:x}', f'{seed:X}'):
            assert not [text for text in texts if form in text]
    newest = max(stamp(pose) for pose in path[-1].poses)
    assert newest <= reference.now_ns() + round(reference.parameters.lead * NANOSECONDS)
