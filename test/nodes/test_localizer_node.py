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
"""Localizer node: its pose and transform, maps, scans, given poses, and what it rejects."""

import math

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
import numpy as np
import pytest
from sensor_msgs.msg import LaserScan, Range
from std_msgs.msg import Header
from std_srvs.srv import Empty
from support.ros_graph import LATCHED, diagnostic, diagnostic_level, odometry, reason
from visualization_msgs.msg import MarkerArray

from t3mpc_ros.geometry.types import NANOSECONDS, RANGE_SENSORS
from t3mpc_ros.localization.distance_field import MapError
from t3mpc_ros.localization.localizer import Localization
from t3mpc_ros.nodes import ros_messages
from t3mpc_ros.nodes.base_node import WARN
from t3mpc_ros.nodes.localizer import LocalizerNode
from t3mpc_ros.parameters.table import ParameterError

pytestmark = pytest.mark.ros

AHEAD = 0.05
"""Distance by which the robot starts ahead of where it is said to start, m."""
START = {
    'set_initial_pose': True,
    'initial_pose__x': 1.0,
    'initial_pose__y': -0.2,
}


class Robot:
    """A robot that drives along x towards the wall of the room at x = 2 m, with exact ranges."""

    def __init__(self, harness, scan=''):
        self.harness = harness
        self.travel, self.stamp_ns = 0.0, NANOSECONDS
        self.scan = scan
        self.publishers = {'odom': harness.connected_publisher(type(odometry(0)), 'odom')}
        if scan:
            self.publishers['scan'] = harness.connected_publisher(LaserScan, scan)
            return
        for name in RANGE_SENSORS:
            self.publishers[name] = harness.connected_publisher(Range, f'range/{name}')

    def step(self, node, travel=0.03, wall=2.0, period=0.1, side=math.inf, **readings):
        """Publish ranges, then the odometry after some more travel; wait until it is used.

        wall : x of what the sensors see ahead, m; period : since the last step, s; side : reading
        of the sensors on the right, m; readings : other fields of their messages
        """
        distance = wall - (1.0 + AHEAD + self.travel) - (0.0 if self.scan else 0.1)
        if self.scan:
            message = LaserScan(angle_min=-0.2, angle_increment=0.2, range_min=0.05)
            message.range_max = 3.0
            message.ranges = [distance / math.cos(0.2), distance, distance / math.cos(0.2)]
            for name, value in readings.items():
                setattr(message, name, value)
            self.publishers['scan'].publish(message)
        else:
            for name in RANGE_SENSORS:
                ahead = name.startswith('front') and distance < 0.8
                other = side if name.startswith('right') else math.inf
                self.publishers[name].publish(
                    Range(range=distance if ahead else other, **readings)
                )
        self.travel += travel
        self.stamp_ns += round(period * NANOSECONDS)
        message = odometry(self.stamp_ns)
        message.pose.pose.position.x = self.travel
        self.publishers['odom'].publish(message)
        self.harness.spin_until(lambda: node._odometry_ns >= self.stamp_ns)


@pytest.mark.parametrize('scan', ['', 'scan'])
def test_the_pose_is_that_of_the_readings(harness, scan):
    node = harness.add(LocalizerNode, world='room', scan_topic=scan, **START)
    poses = harness.subscribe(PoseWithCovarianceStamped, 'pose')
    frames = harness.subscribe(TransformStamped, 'map_to_odom')
    filtered = harness.subscribe(Odometry, 'odometry/filtered')
    robot = Robot(harness, scan)
    for _ in range(20):
        robot.step(node)
    for _ in range(15):  # the corrected pose approaches that of the filter
        robot.step(node, travel=0.0)
    harness.spin_until(lambda: poses and frames and diagnostic(node, 'updates') > 5)
    harness.spin_until(lambda: len(poses) >= diagnostic(node, 'updates'))
    found = poses[-1]
    assert found.header.frame_id == 'map'
    # Of the last update, less than update_min_d before the robot stopped.
    steps = (ros_messages.ns_from_time(found.header.stamp) - NANOSECONDS) / (0.1 * NANOSECONDS)
    travel = min(0.03 * steps, robot.travel)
    assert robot.travel - travel < 0.05
    assert found.pose.pose.position.x == pytest.approx(1.0 + AHEAD + travel, abs=0.03)
    assert found.pose.covariance[0] < 0.04**2
    place = filtered[-1].pose.pose.position
    assert filtered[-1].header.frame_id == 'map'
    assert place.x == pytest.approx(1.0 + AHEAD + robot.travel, abs=0.04)
    origin = frames[-1].transform.translation
    assert origin.x == pytest.approx(1.0 + AHEAD, abs=0.03)
    assert (frames[-1].header.frame_id, frames[-1].child_frame_id) == ('map', 'odom')
    assert reason(node) == Localization.LOCALIZED.value


@pytest.mark.parametrize('scan', ['', 'scan'])
def test_readings_that_are_not_used_are_named(harness, scan):
    node = harness.add(LocalizerNode, world='room', scan_topic=scan, **START)
    robot = Robot(harness, scan)
    robot.step(node)
    for _ in range(30):
        stamp = ros_messages.time_from_ns(robot.stamp_ns + NANOSECONDS)
        robot.step(node, travel=0.0, header=Header(stamp=stamp))
    assert diagnostic_level(node) == WARN
    assert f'no reading of {scan or "range/*"} is used (it is stamped ' in reason(node)
    assert 's after odom): the pose is by odometry alone' in reason(node)
    assert diagnostic(node, 'rejected_inputs') > 10
    for _ in range(3):
        robot.step(node, travel=0.0)
    assert reason(node) == Localization.LOCALIZED.value


def test_odometry_that_ends_or_is_not_finite_is_named(harness, monkeypatch):
    """The robot drove on, and 'the place is known' was said of where it had been."""
    node = harness.add(LocalizerNode, world='room', **START)
    robot = Robot(harness)
    robot.step(node)
    begin_ns, later = node.steady_ns(), 2.0
    monkeypatch.setattr(node, 'steady_ns', lambda: begin_ns + round(later * NANOSECONDS))
    assert reason(node) == Localization.LOCALIZED.value
    later = 5.0
    robot.step(node, travel=math.nan)
    assert diagnostic_level(node) == WARN
    assert 'no odometry that is finite on /odom for 5 s' in reason(node)
    robot.travel = 0.03
    robot.step(node)
    assert reason(node) == Localization.LOCALIZED.value


def test_an_impossible_scan_is_rejected_with_its_field(harness, logged):
    node = harness.add(LocalizerNode, world='room', scan_topic='scan', **START)
    robot = Robot(harness, 'scan')
    for _ in range(5):
        robot.step(node, range_max=math.nan)
    assert diagnostic(node, 'rejected_inputs') > 0
    text = 'range_max or laser_max_range must be finite and above 0.05 m: got nan'
    assert logged(f'scan is rejected: {text}')
    for _ in range(20):
        robot.step(node)
    assert reason(node) == Localization.LOCALIZED.value


def given_pose(frame='map', x=-0.5, variance=1e-4, w=1.0):
    message = PoseWithCovarianceStamped()
    message.header.frame_id = frame
    message.pose.pose.position.x, message.pose.pose.orientation.w = x, w
    message.pose.covariance[0] = variance
    return message


def test_a_pose_is_given_and_an_impossible_one_is_ignored(harness, logged):
    node = harness.add(LocalizerNode, world='room', **START)
    given = harness.connected_publisher(PoseWithCovarianceStamped, 'initialpose')
    robot = Robot(harness)
    robot.step(node)
    rejected = {
        'its frame must be map: got odom': {'frame': 'odom'},
        'it is not finite': {'x': math.nan},
        'its covariance is not positive semi-definite': {'variance': -1.0},
        'it is 98.1 m from the free floor of the map': {'x': 100.0},
        'the norm of its quaternion must be 1: got 0': {'w': 0.0},
    }
    for change in rejected.values():
        given.publish(given_pose(**change))
    harness.spin_until(lambda: diagnostic(node, 'rejected_inputs') == len(rejected))
    for reason_of_it in rejected:
        assert logged(f'initialpose is ignored: {reason_of_it}')
    assert node._localizer.result.pose.x == pytest.approx(1.0, abs=0.05)
    given.publish(given_pose())
    harness.spin_until(lambda: abs(np.mean(node._localizer.filter.poses[:, 0]) + 0.5) < 0.01)
    assert diagnostic(node, 'rejected_inputs') == len(rejected)


def test_a_thing_that_the_map_lacks_is_published(harness):
    node = harness.add(LocalizerNode, world='room', **{**START, 'initial_pose__y': -1.0})
    changes = harness.subscribe(DiagnosticArray, 'map_changes', LATCHED)
    markers = harness.subscribe(MarkerArray, 'map_changes/markers', LATCHED)
    suspected = harness.subscribe(PoseArray, 'map_changes/suspected', LATCHED)
    robot = Robot(harness)
    steps = 0
    while not len(node._localizer.changes.suspected):
        steps += 1
        robot.step(node, wall=1.75, period=0.3, side=0.41)
    harness.spin_until(lambda: suspected)
    (place,) = suspected[0].poses
    assert suspected[0].header.frame_id == 'map'
    assert place.position.x == pytest.approx(1.75, abs=0.15)
    assert place.position.y == pytest.approx(-1.0, abs=0.08)
    for _ in range(steps, 14):
        robot.step(node, wall=1.75, period=0.3, side=0.41)
    harness.spin_until(lambda: changes and markers and not suspected[-1].poses)
    (status,) = changes[-1].status
    values = {each.key: each.value for each in status.values}
    assert changes[-1].header.frame_id == 'map'
    assert [values[key] for key in ('kind', 'present', 'withdrawn')] == ['new', 'True', 'False']
    assert float(values['x_m']) == pytest.approx(1.75, abs=0.15)  # as far as the start is off
    assert float(values['y_m']) == pytest.approx(-1.0, abs=0.08)
    first, found, last = (
        float(values[f'{name}_s']) for name in ('first_seen', 'found', 'last_seen')
    )
    assert 1.0 <= first < found <= last <= robot.stamp_ns / NANOSECONDS
    (marker,) = markers[-1].markers
    assert (marker.id, marker.header.frame_id, marker.text) == (1, 'map', status.message)
    assert marker.pose.position.x == pytest.approx(float(values['x_m']), abs=1e-3)
    assert marker.scale.x == pytest.approx(float(values['size_m']), abs=1e-3)
    assert diagnostic(node, 'map_changes') == 1
    assert diagnostic(node, 'newest_map_change').startswith('new thing: ')


def test_the_service_scatters_the_particles(harness):
    node = harness.add(LocalizerNode, world='room', **START)
    cloud = harness.subscribe(PoseArray, 'particlecloud')
    robot = Robot(harness)
    robot.step(node)
    harness.spin_until(lambda: cloud)
    assert len(cloud[-1].poses) == 500
    harness.call(Empty, 'reinitialize_global_localization')
    robot.step(node)
    assert reason(node) == Localization.SEARCHING.value
    harness.spin_until(lambda: len(cloud[-1].poses) == 5000)


def grid_message(width=60, height=40):
    message = OccupancyGrid()
    message.info.resolution, message.info.width, message.info.height = 0.05, width, height
    message.info.origin.orientation.w = 1.0
    cells = np.zeros((height, width), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    message.data = cells.ravel().tolist()
    return message


def test_a_map_of_a_topic_is_used_and_a_broken_one_is_not(harness):
    node = harness.add(LocalizerNode, **{**START, 'initial_pose__y': 1.0})
    assert 'no map yet' in reason(node)
    robot = Robot(harness)
    maps = harness.connected_publisher(OccupancyGrid, 'map', LATCHED)
    broken = grid_message()
    del broken.data[5:]
    maps.publish(broken)
    harness.spin_until(lambda: 'width x height' in reason(node))
    foreign = grid_message()
    foreign.header.frame_id = 'odom'
    maps.publish(foreign)
    harness.spin_until(lambda: 'its frame must be map: got odom' in reason(node))
    maps.publish(grid_message())
    harness.spin_until(lambda: node._localizer is not None)
    robot.step(node)
    assert node._localizer.result.pose.x == pytest.approx(1.0, abs=0.05)
    # A map that grows, as of SLAM, does not lose the place.
    first = node._localizer
    maps.publish(grid_message(width=80))
    harness.spin_until(lambda: node._localizer is not first)
    robot.step(node)
    assert node._localizer.state is Localization.LOCALIZED


@pytest.mark.parametrize('frame', ['map', 'east/map'])
def test_robots_with_namespaces_may_share_a_map(harness, frame):
    node = harness.add(LocalizerNode, namespace='east', **START)
    shared = grid_message()
    shared.header.frame_id = frame
    harness.connected_publisher(OccupancyGrid, 'east/map', LATCHED).publish(shared)
    harness.spin_until(lambda: node._localizer is not None)
    assert node._map_frame == 'east/map'


def test_wrong_maps_end_the_node(harness, tmp_path):
    with pytest.raises(ParameterError, match='yaml_filename must be empty'):
        harness.add(LocalizerNode, world='room', yaml_filename='map.yaml')
    with pytest.raises(MapError, match='cannot be read'):
        harness.add(LocalizerNode, namespace='a', yaml_filename=str(tmp_path / 'map.yaml'))
    with pytest.raises(ParameterError, match='laser_pose must be'):
        harness.add(LocalizerNode, namespace='b', laser_pose=[0.0, 1.0])
