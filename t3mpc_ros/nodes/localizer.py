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
"""``ros2 run t3mpc_ros localizer``: publishes the pose on a map, and map to odom."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import geometry_msgs.msg
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
import numpy as np
from sensor_msgs.msg import LaserScan, Range
from std_srvs.srv import Empty
from visualization_msgs.msg import Marker, MarkerArray

from t3mpc_ros.geometry.types import NANOSECONDS, RANGE_SENSORS, Array, Pose, State
from t3mpc_ros.localization.change_detection import Change, ChangeKind
from t3mpc_ros.localization.distance_field import (
    LocalizationMap,
    MapError,
    load_grid,
    map_of_grid,
    map_of_world,
)
from t3mpc_ros.localization.localizer import (
    LONGEST_SILENCE,
    Localization,
    Localizer,
    LocalizerParameters,
    PoseCorrection,
    transformed,
    warm_up,
)
from t3mpc_ros.localization.range_model import NAMES, Beams, beams_of_scan
from t3mpc_ros.nodes import ros_messages, topic_endpoints
from t3mpc_ros.nodes.base_node import NO_CLOCK, OK, WARN, BaseNode, MatchingSubscription
from t3mpc_ros.nodes.ros_messages import FrameParameters
from t3mpc_ros.parameters.table import ParameterError, group, parameter
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters
from t3mpc_ros.simulation.world import WorldError, load_world

TRANSFORM_PERIOD = 0.1
"""Time between two transforms of a robot at rest, s."""
CLOUD_PERIOD = 0.5
"""Time between two clouds of particles, s."""
CHANGES_PERIOD = 0.5
"""Least time between two messages of the changes, s."""
KEPT = Localization.LOCALIZED, Localization.OFF_MAP
"""States whose pose is kept on another map: one that grows has the place that was off it."""
LEAST_NORM = 0.5
"""Norm of a quaternion below which it is no rotation: a message with zeros has no yaw."""
MARKER_HEIGHT = 0.3
"""m"""
COLOURS = {
    ChangeKind.NEW: (0.85, 0.33, 0.1),
    ChangeKind.MISSING: (0.2, 0.45, 0.9),
    ChangeKind.MOVING: (0.6, 0.2, 0.75),
}
"""Red, green and blue of markers, 0 to 1."""


@dataclass(frozen=True)
class LocalizerNodeParameters(LocalizerParameters):
    """Parameters of the localizer node."""

    world: str = parameter(
        '', 'map: name of a bundled world, or path of a YAML file of one; empty: another source'
    )
    yaml_filename: str = parameter(
        '',
        'map: YAML file of map_server with its image as PGM; empty, as world: the topic map',
        source='nav2_map_server',
    )
    scan_topic: str = parameter(
        '', 'topic of a LaserScan in place of range/*; empty: the range sensors', source=NAMES
    )
    max_beams: int = parameter(
        60, 'number of beams of a scan that are used', bounds=(1, 2000), source=NAMES
    )
    laser_min_range: float = parameter(
        -1.0,
        'smallest distance of the scan; -1: that of the message',
        'm',
        (-1.0, 1e3),
        source=NAMES,
    )
    laser_max_range: float = parameter(
        -1.0,
        'largest distance of the scan; -1: that of the message',
        'm',
        (-1.0, 1e3),
        source=NAMES,
    )
    laser_pose: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0),
        'x (m), y (m) and yaw (rad) of the laser in the frame of the robot',
        bounds=(-10.0, 10.0),
    )
    global_frame_id: str = parameter('map', 'frame of the map', source=NAMES)
    odom_frame_id: str = parameter('odom', 'frame of the odometry', source=NAMES)
    base_frame_id: str = parameter('base_link', 'frame of the robot', source=NAMES)
    frames: FrameParameters = group(FrameParameters, inline=True)
    tf_broadcast: bool = parameter(
        True,
        'publish the transform from global_frame_id to odom_frame_id, if tf2_ros is installed',
        source=NAMES,
    )
    transform_tolerance: float = parameter(
        1.0, 'how far in the future that transform is stamped', 's', (0.0, 10.0), source=NAMES
    )
    range_sensor: RangeSensorParameters = group(RangeSensorParameters)

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for two maps, or an incomplete pose of the laser."""
        super().check_consistency()
        if self.world and self.yaml_filename:
            raise ParameterError(f'yaml_filename must be empty with world {self.world}: got both')
        if len(self.laser_pose) != 3:
            raise ParameterError(
                f'laser_pose must be x, y, yaw: got {len(self.laser_pose)} numbers'
            )


class LocalizerNode(BaseNode[LocalizerNodeParameters]):
    """Publishes the pose on a map by odometry and ranges each time the robot has moved."""

    parameter_class = LocalizerNodeParameters
    configuration_errors = (MapError, WorldError)

    def __init__(self, **options: Any) -> None:
        super().__init__('localizer', **options)
        parameters, namespace = self.parameters, self.get_namespace()
        warm_up(parameters)
        self._mounts = sensor_mounts(parameters.range_sensor)
        self._localizer: Localizer | None = None
        self._map_problem = 'no map yet: set world or yaml_filename, or publish map'
        self._rejected = 0
        self._rejection = ''
        """Why the last reading was rejected; '' of one that was used."""
        self._updates = 0
        self._shown_changes: tuple[Change, ...] = ()
        self._odometry_ns = 0
        self._odometry_used_ns = self.steady_ns()
        self._map_frame = parameters.frames.prefixed(parameters.global_frame_id, namespace)
        self._odometry_frame = parameters.frames.prefixed(parameters.odom_frame_id, namespace)
        self._pose = self.create_publisher(
            PoseWithCovarianceStamped, 'pose', topic_endpoints.LATCHED
        )
        self._frame = self.create_publisher(
            TransformStamped, 'map_to_odom', topic_endpoints.LATCHED
        )
        self._filtered = self.create_publisher(
            Odometry, 'odometry/filtered', topic_endpoints.STREAM
        )
        base = parameters.frames.prefixed(parameters.base_frame_id, namespace)
        self._serialized = ros_messages.SerializedOdometry(self._map_frame, base)
        self._correction = PoseCorrection()
        self._cloud = self.create_publisher(PoseArray, 'particlecloud', topic_endpoints.SCALARS)
        self._changes = self.create_publisher(
            DiagnosticArray, 'map_changes', topic_endpoints.LATCHED
        )
        self._markers = self.create_publisher(
            MarkerArray, 'map_changes/markers', topic_endpoints.LATCHED
        )
        self._suspected = self.create_publisher(
            PoseArray, 'map_changes/suspected', topic_endpoints.LATCHED
        )
        self._shown_suspected = np.empty((0, 2))
        self._broadcaster = None
        if parameters.tf_broadcast and (
            tf2_ros := self.import_tf2('map_to_odom is published alone')
        ):
            self._broadcaster = tf2_ros.TransformBroadcaster(self)
        self._scan: MatchingSubscription | None = None
        self._ranges: list[MatchingSubscription] = []
        if parameters.scan_topic:
            self._scan = self.create_matching_subscription(
                LaserScan, parameters.scan_topic, None, topic_endpoints.SCALARS
            )
        else:
            self._ranges = [
                self.create_matching_subscription(
                    Range, f'range/{name}', None, topic_endpoints.SCALARS
                )
                for name in RANGE_SENSORS
            ]
        if parameters.world:
            self._use_map(map_of_world(load_world(parameters.world)))
        elif parameters.yaml_filename:
            self._use_map(load_grid(parameters.yaml_filename))
        else:
            self.create_matching_subscription(
                OccupancyGrid, 'map', self._on_map, topic_endpoints.LATCHED
            )
        self._odometry = self.create_matching_subscription(
            Odometry, 'odom', self._on_odometry, topic_endpoints.STREAM, raw=True
        )
        self.create_matching_subscription(
            PoseWithCovarianceStamped,
            'initialpose',
            self._on_initial_pose,
            topic_endpoints.COMMAND,
        )
        self.create_service(
            Empty, 'reinitialize_global_localization', self._reinitialize_global_localization
        )
        self.create_steady_timer(TRANSFORM_PERIOD, self._publish_transform)
        self.create_steady_timer(CLOUD_PERIOD, self._publish_cloud)
        self.create_steady_timer(CHANGES_PERIOD, self._publish_changes)

    def _use_map(self, known: LocalizationMap) -> None:
        """Begin on a map; MapError: the robot fits nowhere."""
        limits = self.parameters.range_sensor.minimum, self.parameters.range_sensor.maximum
        self._localizer = Localizer(self.parameters, known, self._mounts, limits)
        self._map_problem = ''

    def _on_map(self, message: OccupancyGrid, info: dict[str, Any]) -> None:
        """Begin on another map: from the last pose, where it was known."""
        before = self._localizer
        try:
            frame = message.header.frame_id
            # Robots of a fleet may share a map, in the frame without their prefixes.
            if frame != self.parameters.global_frame_id and (
                problem := self._frame_problem(frame)
            ):
                raise MapError(problem)
            grid = ros_messages.grid_from_occupancy(message)
            self._use_map(map_of_grid(grid.cells, grid.resolution, (grid.x, grid.y, 0.0)))
        except ValueError as error:  # a MapError among them
            self._rejected += 1
            self._map_problem = '' if before else f'map is rejected: {error}'
            self.get_logger().warning(f'map is rejected: {error}')
            return
        assert self._localizer is not None
        if before is not None and before.state in KEPT:
            assert before.result is not None
            self._localizer.set_pose(before.result.pose, before.result.covariance)

    def _on_odometry(self, message: bytes, info: dict[str, Any]) -> None:
        for each in (message, *self._odometry.take_waiting()):
            state = ros_messages.state_from_odometry(each)
            if self._localizer is None:
                self._take_readings()
                continue
            # Readings belong to the pose before this one, during which they arrived.
            self._take_readings()
            self._odometry_ns = state.stamp_ns
            if state.is_finite():
                self._odometry_used_ns = self.steady_ns()
            self._publish_filtered(state)  # first: a controller waits for it
            if self._localizer.add_odometry(state.stamp_ns, state.pose):
                self._updates += 1
                self._publish_pose()
                self._publish_transform()

    def _publish_filtered(self, state: State) -> None:
        """Publish the odometry with its pose on the map, by what was known before it."""
        if self._localizer is None or not state.is_finite():
            return
        pose = self._correction.step(state.stamp_ns, state.pose, self._localizer)
        if pose is not None:
            self._filtered.publish(self._serialized.with_state(state._replace(pose=pose)))

    def _take_readings(self) -> None:
        localizer = self._localizer
        for sensor, subscription in enumerate(self._ranges):
            for message in subscription.take_waiting():
                if localizer is not None:
                    self._count(localizer.add_range(sensor, message.range, _stamp_ns(message)))
        if self._scan is not None:
            for message in self._scan.take_waiting()[-1:]:
                if localizer is not None:
                    self._add_scan(localizer, message)

    def _add_scan(self, localizer: Localizer, message: LaserScan) -> None:
        try:
            beams = self._beams(message)
        except ValueError as error:
            self._count(str(error))
            self.get_logger().warning(f'scan is rejected: {error}', throttle_duration_sec=1.0)
            return
        self._count(localizer.add_scan(beams, _stamp_ns(message)))

    def _count(self, problem: str) -> None:
        self._rejected += 1 if problem else 0
        self._rejection = problem

    def _beams(self, message: LaserScan) -> Beams:
        """Return beams of a scan in the frame of the robot, or raise ValueError."""
        parameters = self.parameters
        least, most = parameters.laser_min_range, parameters.laser_max_range
        limits = (
            message.range_min if least < 0.0 else least,
            message.range_max if most < 0.0 else most,
        )
        reading = np.array(message.ranges, dtype=np.float64)
        beams = beams_of_scan(
            reading, message.angle_min, message.angle_increment, limits, parameters.max_beams
        )
        mount = Pose(*parameters.laser_pose)
        return beams._replace(origin=transformed(mount, beams.origin))

    def _on_initial_pose(self, message: PoseWithCovarianceStamped, info: dict[str, Any]) -> None:
        pose, turn = message.pose.pose.position, message.pose.pose.orientation
        rotation = turn.x, turn.y, turn.z, turn.w
        place = Pose(pose.x, pose.y, ros_messages.yaw_from_quaternion(*rotation))
        rows = np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
        covariance = rows[np.ix_((0, 1, 5), (0, 1, 5))]
        covariance = 0.5 * (covariance + covariance.T)
        problem = self._map_problem or self._frame_problem(message.header.frame_id)
        if not problem and math.hypot(*rotation) < LEAST_NORM:
            problem = f'the norm of its quaternion must be 1: got {math.hypot(*rotation):g}'
        if not problem and self._localizer is not None:
            problem = self._localizer.pose_problem(place, covariance)
        if self._localizer is None or problem:
            self._rejected += 1
            self.get_logger().warning(f'initialpose is ignored: {problem}')
            return
        self._localizer.set_pose(place, covariance)

    def _frame_problem(self, frame: str) -> str:
        own = self._map_frame
        return '' if frame.lstrip('/') in ('', own) else f'its frame must be {own}: got {frame}'

    def _reinitialize_global_localization(
        self, request: Empty.Request, response: Empty.Response
    ) -> Empty.Response:
        if self._localizer is not None:
            self._localizer.scatter()
        return response

    def _publish_pose(self) -> None:
        assert self._localizer is not None
        result = self._localizer.result
        assert result is not None
        message = PoseWithCovarianceStamped(
            header=ros_messages.header(result.stamp_ns, self._map_frame)
        )
        message.pose.pose.position.x = result.pose.x
        message.pose.pose.position.y = result.pose.y
        message.pose.pose.orientation = ros_messages.quaternion_from_yaw(result.pose.yaw)
        message.pose.covariance = ros_messages.planar_covariance(
            result.covariance.tolist(), ros_messages.MIN_VARIANCE
        )
        self._serialized.set_pose_covariance(message.pose.covariance)
        self._pose.publish(message)

    def _publish_transform(self) -> None:
        if self._localizer is None or self._localizer.result is None:
            return
        message = ros_messages.transform(
            self._odometry_ns + round(self.parameters.transform_tolerance * NANOSECONDS),
            self._localizer.result.odometry_frame,
            self._map_frame,
            self._odometry_frame,
        )
        self._frame.publish(message)
        if self._broadcaster is not None:
            self._broadcaster.sendTransform(message)

    def _publish_cloud(self) -> None:
        if self._localizer is None or not self._cloud.get_subscription_count():
            return
        poses = self._localizer.filter.poses
        self._cloud.publish(self._pose_array(poses))

    def _pose_array(self, poses: Array) -> PoseArray:
        """Return poses on the map, shape (n, 3), as a message."""
        message = PoseArray(header=ros_messages.header(self._odometry_ns, self._map_frame))
        for x, y, yaw in poses.tolist():
            pose = geometry_msgs.msg.Pose(orientation=ros_messages.quaternion_from_yaw(yaw))
            pose.position.x, pose.position.y = x, y
            message.poses.append(pose)
        return message

    def _publish_changes(self) -> None:
        """Publish all changes, and what may be one, if one of them is other than it was."""
        if self._localizer is None:
            return
        changes, suspected = self._localizer.changes.changes, self._localizer.changes.suspected
        if not np.array_equal(suspected, self._shown_suspected):
            self._shown_suspected = suspected
            poses = np.column_stack([suspected, np.zeros(len(suspected))])
            self._suspected.publish(self._pose_array(poses))
        if changes == self._shown_changes:
            return
        self._shown_changes = changes
        header = ros_messages.header(self._odometry_ns, self._map_frame)
        self._changes.publish(
            DiagnosticArray(header=header, status=[change_status(each) for each in changes])
        )
        markers = [change_marker(each, self._map_frame) for each in changes]
        self._markers.publish(MarkerArray(markers=markers))

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether the place is known; a warning if the robot is lost, or inputs lack."""
        values: dict[str, object] = {'updates': self._updates, 'rejected_inputs': self._rejected}
        if not self.clock_started():
            return WARN, NO_CLOCK, values
        localizer = self._localizer
        if localizer is None:
            return WARN, self._map_problem, values
        values |= {
            'particles': len(localizer.filter.poses),
            'share': localizer.share,
            'agreement': localizer.agreement,
            'silence_s': localizer.silence,
        }
        if changes := localizer.changes.changes:
            values |= {'map_changes': len(changes), 'newest_map_change': changes[-1].text}
        if localizer.result is not None:
            x, y, yaw = np.sqrt(np.diag(localizer.result.covariance)).tolist()
            values |= {'x_std_m': x, 'y_std_m': y, 'yaw_std_rad': yaw}
        state, texts = localizer.state, [localizer.state.value]
        known = state is Localization.LOCALIZED
        silence = (self.steady_ns() - self._odometry_used_ns) / NANOSECONDS
        if silence > LONGEST_SILENCE:
            texts.append(
                f'no odometry that is finite on {self.resolve_topic_name("odom")} '
                f'for {silence:.0f} s: the pose is an old one; check its publisher'
            )
        elif localizer.silent:
            topic = self.parameters.scan_topic or 'range/*'
            reason = f' ({self._rejection})' if self._rejection else ''
            texts.append(
                f'no reading of {topic} is used{reason}: the pose is by odometry alone; check '
                'that the sensors publish there, with stamps of the clock of odom'
            )
        elif known and (doubtful := ', '.join(map(str, localizer.doubtful))):
            values['doubtful_sensors'] = doubtful
            texts.append(
                f'range sensor {doubtful} contradicts the map and is not used: look at it'
            )
        return OK if known and len(texts) == 1 else WARN, '; '.join(texts), values


def _stamp_ns(message: Range | LaserScan) -> int | None:
    """Return the stamp of a reading, None of one without."""
    return ros_messages.ns_from_time(message.header.stamp) or None


def change_status(change: Change) -> DiagnosticStatus:
    """Return a change with its numbers; a warning while it is there."""
    values = {
        'kind': change.kind.name.lower(),
        'present': change.present,
        'withdrawn': change.withdrawn,
        'x_m': f'{change.x:.3f}',
        'y_m': f'{change.y:.3f}',
        'size_m': f'{change.size:.3f}',
        'confidence': f'{change.confidence:.3f}',
        'first_seen_s': f'{change.first_ns / NANOSECONDS:.3f}',
        'found_s': f'{change.found_ns / NANOSECONDS:.3f}',
        'last_seen_s': f'{change.last_ns / NANOSECONDS:.3f}',
    }
    return DiagnosticStatus(
        level=WARN if change.present else OK,
        name=f'change {change.number}',
        message=change.text,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )


def change_marker(change: Change, frame: str) -> Marker:
    """Return a change as a cylinder at its place, stamped as first seen; pale: it is not there."""
    marker = Marker(ns='map_changes', id=change.number, type=Marker.CYLINDER, text=change.text)
    marker.header = ros_messages.header(change.first_ns, frame)
    marker.pose.position.x, marker.pose.position.y = change.x, change.y
    marker.pose.position.z = 0.5 * MARKER_HEIGHT
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = change.size
    marker.scale.z = MARKER_HEIGHT
    marker.color.r, marker.color.g, marker.color.b = COLOURS[change.kind]
    marker.color.a = change.confidence if change.present else 0.25
    return marker
