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

import math
import sys
from types import SimpleNamespace

from geometry_msgs.msg import Point, PoseArray, PoseStamped, TransformStamped, Twist
from geometry_msgs.msg import Pose as Place
from nav_msgs.msg import OccupancyGrid, Odometry, Path
import numpy as np
import pytest
from sensor_msgs.msg import BatteryState
from std_msgs.msg import Int32MultiArray
from std_srvs.srv import SetBool, Trigger
from support.ros_graph import LATCHED, diagnostic, odometry, on_grid, reason, speed, stamp, twist

from t3mpc_ros.chaos.path_replanning import NOWHERE_TIME
from t3mpc_ros.evaluation.bag_report.diagnostic_history import cause_of
from t3mpc_ros.geometry.obstacles import OccupancyGrid as Cells
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.reference_generator import ReferenceGeneratorNode
from t3mpc_ros.nodes.ros_messages import occupancy_message

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


def _speeds(received):
    return np.array([message.twist.twist.linear.x for message in received])


def _largest_change(received):
    """Return the largest change of the speed from one sample to the next, m/s."""
    return np.abs(np.diff(_speeds(received))).max()


@pytest.mark.parametrize('source', ['signals', 'portrait'])
def test_a_pause_and_its_end_are_ramps(harness, source):
    """The reference jumped from 0.24 m/s to 0 and back; twice paused is as once."""
    reference = harness.add(ReferenceGeneratorNode, source=source, ramp=0.0)
    received = harness.subscribe(Odometry, 'reference')
    places = harness.create_publisher(Odometry, 'odom')

    def reached(condition):
        def done():
            places.publish(received[-1] if received else _odometry())
            return received and condition(speed(received[-1]))

        return done

    harness.spin_until(reached(lambda v: v > 0.1))
    first = len(received)
    for on, condition in ((True, lambda v: v == 0.0), (False, lambda v: v > 0.1)):
        for _ in range(2):
            harness.done(SetBool, 'reference_generator/pause', data=on)
        harness.spin_until(reached(condition))
        if on:
            held, count = received[-1].pose.pose, len(received)
            harness.spin_until(reached(lambda v, count=count: len(received) > count + 10))
            assert {speed(message) for message in received[count:]} == {0.0}
            assert received[-1].pose.pose == held
            assert reason(reference) == 'paused'
    limit = reference.parameters.motion.linear_acceleration / reference.parameters.rate
    assert _largest_change(received[first:]) <= limit * (1 + 1e-9)
    assert on_grid(received, 100)


PATH_LIMIT = 0.25


def _odometry(stamp_ns=0):
    message = odometry(stamp_ns)
    message.pose.pose.position.x, message.pose.pose.position.y = 0.5, -0.2
    return message


def _path(points, frame='odom'):
    message = Path(poses=[PoseStamped() for _ in points])
    message.header.frame_id = frame
    for (x, y), pose in zip(points, message.poses, strict=True):
        pose.pose.position.x, pose.pose.position.y = float(x), float(y)
    return message


class _PathDrive:
    """A generator with source topic, whose robot is where its reference is."""

    def __init__(self, harness, **parameters):
        self._harness = harness
        self.node = harness.add(ReferenceGeneratorNode, source='topic', **parameters)
        self.received = harness.subscribe(Odometry, 'reference')
        self._places = harness.create_publisher(Odometry, 'odom')

    def until(self, condition):
        """Drive until a condition holds for the last sample."""

        def done():
            self._places.publish(self.received[-1] if self.received else _odometry())
            return self.received and condition(self.received[-1])

        self._harness.spin_until(done)


def test_paths_of_volatile_and_latched_publishers_drive_once(harness):
    """Planners are volatile, and got no connection; RViz and scripts latch."""
    harness.create_publisher(Path, 'path', LATCHED).publish(_path([(0.5, -0.2), (0.75, -0.2)]))
    drive = _PathDrive(harness, path_mode='append')
    drive.until(lambda m: speed(m) > 0.1)
    drive.until(lambda m: speed(m) == 0.0)
    assert drive.received[-1].pose.pose.position.x == pytest.approx(0.75, abs=1e-6)
    planner = harness.connected_publisher(Path, 'path')
    planner.publish(_path([(0.75, -0.2), (1.0, -0.2)]))
    drive.until(lambda m: speed(m) > 0.1)
    drive.until(lambda m: speed(m) == 0.0)
    assert drive.received[-1].pose.pose.position.x == pytest.approx(1.0, abs=1e-6)
    assert min(_speeds(drive.received)) >= 0.0
    assert 'no message passes' not in reason(drive.node)
    assert diagnostic(drive.node, 'path_under_way') is False


def test_a_path_replaces_the_one_before_and_an_empty_one_stops(harness):
    """Each path was appended: the robot went back to the beginning of the next one."""
    drive = _PathDrive(harness)
    planner = harness.connected_publisher(Path, 'path')
    for end in (2.0, 2.1, 2.2):
        planner.publish(_path([(0.5, -0.2), (end, -0.2)]))
        drive.until(lambda m, end=end: m.pose.pose.position.x > end - 1.4)
    drive.until(lambda m: speed(m) > 0.2)
    planner.publish(Path())
    drive.until(lambda m: speed(m) == 0.0)
    places = np.array([message.pose.pose.position.x for message in drive.received])
    assert (np.diff(places) >= 0.0).all()
    assert places[-1] < 1.3
    limit = drive.node.parameters.motion.linear_acceleration * 0.01
    assert _largest_change(drive.received) <= limit * (1 + 1e-9)


class _SetOdometry(_PathDrive):
    """A robot that stands, at the end of a path of 0.5 m or on it, whose odom is set to 0."""

    def __init__(self, harness, *, at_rest, **parameters):
        super().__init__(harness, **parameters)
        planner = harness.connected_publisher(Path, 'path')
        self.until(bool)
        planner.publish(_path([(0.5, -0.2), (1.0, -0.2)]))
        self.until(lambda m: m.pose.pose.position.x > 0.75)
        if at_rest:
            self.until(lambda m: speed(m) == 0.0)
        self.before = self.received[-1]
        self.message = odometry(stamp(self.before))
        count = len(self.received) + 60

        def done():
            self._places.publish(self.message)
            return len(self.received) > count

        harness.spin_until(done)
        first = next(
            k for k, each in enumerate(self.received) if each.pose.pose.position == Point()
        )
        self.after = self.received[first:]


@pytest.mark.parametrize('at_rest', [True, False])
def test_a_robot_whose_odom_is_set_rests(harness, logged, at_rest):
    """It drove to where its path had been: a metre further with each reset at rest."""
    drive = _SetOdometry(harness, at_rest=at_rest)
    assert {(speed(each), each.pose.pose.position.x) for each in drive.after} == {(0.0, 0.0)}
    # What was published ahead is replaced, too.
    first, second = (stamp(each) for each in drive.after[:2])
    assert first <= stamp(drive.before)
    assert second - first == pytest.approx(4e8)
    assert logged('odom has jumped by')
    assert diagnostic(drive.node, 'odometry_jumps') == 1
    assert ('its path has ended' in reason(drive.node)) == (not at_rest)
    harness.connected_publisher(Path, 'path').publish(_path([(0.0, 0.0), (0.5, 0.0)]))
    drive.until(lambda m: m.pose.pose.position.x > 0.2)
    assert 'its path has ended' not in reason(drive.node)


def test_a_pose_may_jump_in_a_map(harness):
    """A localisation that finds the robot elsewhere leaves the path where it is."""
    drive = _PathDrive(harness, frame_id='map')
    planner = harness.connected_publisher(Path, 'path')
    drive.until(bool)
    planner.publish(_path([(0.5, -0.2), (1.0, -0.2)], 'map'))
    drive.until(lambda m: m.pose.pose.position.x > 0.75)
    drive._places.publish(odometry(stamp(drive.received[-1])))
    drive.until(lambda m: speed(m) == 0.0)
    assert drive.received[-1].pose.pose.position.x == pytest.approx(1.0, abs=1e-6)
    assert diagnostic(drive.node, 'odometry_jumps') == 0


def test_a_path_in_another_frame_needs_a_transform(harness, logged, monkeypatch):
    """A path in map was taken as one in odom, wherever that was."""
    known = {}
    buffer = SimpleNamespace(
        can_transform=lambda target, source, time: (target, source) in known,
        lookup_transform=lambda target, source, time: known[target, source],
    )
    tf2_ros = SimpleNamespace(Buffer=lambda: buffer, TransformListener=lambda buffer, node: None)
    monkeypatch.setitem(sys.modules, 'tf2_ros', tf2_ros)
    drive = _PathDrive(harness)
    drive.until(lambda m: True)
    planner = harness.connected_publisher(Path, 'path')
    refused = (
        (
            _path([(3.0, 2.0)], 'map'),
            'its frame is map, and no transform from it to odom is known',
        ),
        (_path([(0.0, 0.0), (float('nan'), 0.0)]), 'points must be finite: point 1'),
        (_path([(1e6, 0.0)]), 'at most 10000 m: point 0'),
    )
    for count, (message, text) in enumerate(refused, 1):
        planner.publish(message)
        harness.spin_until(lambda count=count: diagnostic(drive.node, 'rejected_inputs') == count)
        assert any(text in line for line in logged('path is ignored'))
        (warning,) = drive.node.warnings()  # it was in the log only
        assert warning.startswith('the last path is ignored')
        assert text in warning
    assert speed(drive.received[-1]) == 0.0
    # The map is turned by a quarter, its origin is at (1, -1): (0.8, 0.5) is at (0.5, -0.2).
    transform = TransformStamped().transform
    transform.translation.x, transform.translation.y = 1.0, -1.0
    transform.rotation.z = transform.rotation.w = np.sqrt(0.5)
    known['odom', 'map'] = SimpleNamespace(transform=transform)
    planner.publish(_path([(0.8, 0.5), (0.8, 0.2)], 'map'))
    drive.until(lambda m: m.pose.pose.position.x > 0.79)
    drive.until(lambda m: speed(m) == 0.0)
    place = drive.received[-1].pose.pose.position
    assert (place.x, place.y) == pytest.approx((0.8, -0.2), abs=1e-6)
    assert drive.node.warnings() == []


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
    paths = harness.subscribe(Path, 'reference/path', LATCHED)
    reference, received = _drive(
        harness, 'path', message, lambda m: speed(m) > 0.1 and paths, source=source, **given
    )
    # No path is published further ahead than the lead: a patrol keeps its future.
    newest = max(stamp(pose) for pose in paths[-1].poses)
    assert newest <= reference.now_ns() + round(reference.parameters.lead * NANOSECONDS)
    first, last = (received[k].pose.pose.position for k in (0, -1))
    assert (first.x, first.y) == pytest.approx((0.5, -0.2), abs=1e-9)
    assert speed(received[0]) == 0.0
    assert max(map(speed, received)) <= PATH_LIMIT
    if source == 'topic':
        assert last.x > 0.5
        assert last.y == pytest.approx(-0.2, abs=1e-6)


def test_a_goal_before_the_first_odometry_is_rejected(harness, logged):
    """It was forgotten without a word."""
    reference = harness.add(ReferenceGeneratorNode, source='portrait', plan__enabled=True)
    goals = harness.connected_publisher(PoseStamped, 'goal_pose')
    for x in (1.0, math.nan):
        goal = PoseStamped()
        goal.header.frame_id, goal.pose.position.x = 'odom', x
        goals.publish(goal)
    harness.spin_until(lambda: reference._rejected == 2)
    assert logged('goal_pose is ignored: no odom yet')
    assert logged('finite')


def test_a_low_battery_leads_to_the_charging_place(harness, logged, monkeypatch):
    monkeypatch.setattr('t3mpc_ros.chaos.path_replanning.BATTERY_TIME', 0.0)
    charging = {'plan__charging__min_voltage': 10.0, 'plan__charging__place': [0.9, -0.2]}
    reference = harness.add(
        ReferenceGeneratorNode, source='portrait', plan__enabled=True, **charging
    )
    received = harness.subscribe(Odometry, 'reference')
    places = harness.connected_publisher(Odometry, 'odom')
    maps = harness.connected_publisher(OccupancyGrid, 'keep_out/map', LATCHED)
    batteries = harness.connected_publisher(BatteryState, 'battery_state')
    goals = harness.connected_publisher(PoseStamped, 'goal_pose')
    free = occupancy_message(Cells(np.zeros((60, 60), np.int8), 0.05, -1.0, -1.7), 0, '')
    volts, known = 9.9, 0

    def says(words):
        nonlocal known
        if not received:
            places.publish(_odometry())
        elif len(received) >= known + 10:  # no more than the node can take
            known = len(received)
            places.publish(received[-1])
            maps.publish(free)
            batteries.publish(BatteryState(voltage=volts))
        return reason(reference) == words

    harness.spin_until(lambda: says('on the way to the charging place'))
    goals.publish(PoseStamped())
    harness.spin_until(lambda: says('at the charging place') and speed(received[-1]) == 0.0)
    at = received[-1].pose.pose.position
    assert np.hypot(at.x - 0.9, at.y + 0.2) < 0.05
    assert logged('goal_pose is ignored: the battery is charged first')
    volts = 0.0
    count = reference._rejected
    harness.spin_until(lambda: says('at the charging place') and reference._rejected > count + 1)
    assert [text.partition(':')[0] for text in reference.warnings()] == [
        'the last goal_pose is ignored'
    ]
    monkeypatch.setattr('t3mpc_ros.nodes.reference_generator.REFUSAL_SHOWN_NS', 0)
    assert reference.warnings() == []
    reference._planned._time += 40.0
    assert reference.warnings() == [
        f'no voltage in battery_state for {reference._planned.battery_silence:.0f} s: the robot '
        'does not leave the charging place'
    ]
    volts = 12.5
    harness.spin_until(lambda: says('running') and speed(received[-1]) > 0.1)


def test_a_planned_path_waits_for_a_map_and_leads_to_a_goal(harness):
    reference = harness.add(ReferenceGeneratorNode, source='portrait', plan__enabled=True)
    received = harness.subscribe(Odometry, 'reference')
    places = harness.connected_publisher(Odometry, 'odom')
    maps = harness.connected_publisher(OccupancyGrid, 'keep_out/map', LATCHED)
    free = occupancy_message(Cells(np.zeros((60, 60), np.int8), 0.05, -1.0, -1.7), 0, '')
    wrong = OccupancyGrid(data=[0, 0])

    def where():
        places.publish(received[-1] if received else _odometry())

    def waits():
        where()
        return len(received) > 20

    harness.spin_until(waits)
    assert max(map(speed, received)) == 0.0
    assert reason(reference) == 'no keep_out/map yet: the controller publishes it'

    def rejects():
        where()
        maps.publish(wrong)
        return diagnostic(reference, 'rejected_inputs')

    harness.spin_until(rejects)
    count = diagnostic(reference, 'rejected_inputs')

    def drives():
        where()
        maps.publish(free)
        return speed(received[-1]) > 0.2

    harness.spin_until(drives)
    goals = harness.connected_publisher(PoseStamped, 'goal_pose')
    goal, thing = PoseStamped(), Place()
    goal.pose.position.x, goal.pose.position.y = 1.0, -1.45  # outside of the arena
    suspected = harness.connected_publisher(PoseArray, 'map_changes/suspected', LATCHED)
    thing.position.x, thing.position.y = 1.0, -0.3
    for frame in ('elsewhere', 'odom'):
        goal.header.frame_id = frame
        goals.publish(goal)
        suspected.publish(PoseArray(header=goal.header, poses=[thing]))
        harness.spin_until(lambda: diagnostic(reference, 'rejected_inputs') > count + 1)

    def leads_there():
        where()
        maps.publish(free)
        points = reference._source.planned.plan.points
        return np.hypot(*(points - [1.0, -1.45]).T).min() < 0.15

    harness.spin_until(leads_there)
    assert reference._source.planned.plan._contradiction == (1.0, -0.3)
    assert diagnostic(reference, 'rejected_inputs') == count + 2
    goal.pose.position.x = 50.0
    goals.publish(goal)

    def is_named():
        where()
        maps.publish(free)
        return 'no way to the goal at (50.00, -1.45) m is known' in ' '.join(reference.warnings())

    harness.spin_until(is_named)
    reference._planned._nowhere = NOWHERE_TIME
    event = 1.0, 'warning', 'reference_generator', reference.warnings()[-1]
    assert cause_of(event, stops=False).name == 'Boxed in'


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
