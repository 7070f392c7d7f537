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
"""What the simulated and the real robot have in common as nodes: commands, stops, states."""

from collections.abc import Mapping
import math
import threading
from typing import Any, TypeVar

from geometry_msgs.msg import TransformStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import BatteryState, Imu, JointState, Range
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.geometry.kinematics import frame_between, wheels_from_twist
from t3mpc_ros.geometry.types import RANGE_SENSORS, BodyTwist, Pose
from t3mpc_ros.nodes import robot_messages, ros_messages, topic_endpoints
from t3mpc_ros.nodes.base_node import ADAPT_PERIOD, BaseNode, MatchingSubscription
from t3mpc_ros.nodes.robot_messages import RobotDescription, RobotTopicParameters
from t3mpc_ros.robot.description import fixed_frames
from t3mpc_ros.robot.interface import RobotCommand, RobotInterface, RobotState

TYPE_PATIENCE = 2.0
"""Time for which commands have the other type before a robot adapts, s."""

BATTERY_RATE = 1.0
"""Rate of ``battery_state``, Hz."""

UNCONFIRMED = (
    'not confirmed by the robot: {}. The stop is latched in the node and sent until the robot '
    'answers; cut the power if its wheels turn'
)
"""Answer to an emergency stop that does not reach the robot now."""

P = TypeVar('P', bound=RobotTopicParameters)


class RobotNode(BaseNode[P]):
    """A node that is a robot.

    It executes ``cmd_vel``, offers ``reset_odometry`` and ``e_stop``, which latches until it is
    released, and publishes states. Subclasses call :meth:`connect`.
    """

    def connect(self, robot: RobotInterface) -> None:
        """Create the topics and services of a robot."""
        self._robot = robot
        self._lock = threading.Lock()
        """Guards the robot, which the thread of radio_bridge uses, too."""
        self._received = self._rejected = 0
        self._command_problem = ''
        """Why the last command was rejected; empty if it was accepted."""
        self._logged_reason = ''
        stamped = self.parameters.enable_stamped_cmd_vel
        self._command_type = TwistStamped if stamped else Twist
        self._description = self.describe(self.parameters)
        self._create_publishers()
        self._commands: MatchingSubscription | None = self._subscribe_to_commands()
        if self.parameters.detect_cmd_vel_type:
            self._mismatches = 0
            self.create_steady_timer(ADAPT_PERIOD, self._adapt_command_type)
        self.offer(Trigger, 'reset_odometry', self._reset_odometry)
        self.offer(SetBool, 'e_stop', self._e_stop)

    def describe(self, parameters: P) -> RobotDescription:
        """Return the properties of the robot."""
        raise NotImplementedError

    def robot_ns(self) -> int:
        """Return the time of the robot, ns."""
        return self.now_ns()

    def has_simulated_time(self) -> bool:
        """Return whether the time of the robot is no measure for the age of a message."""
        return False

    def on_parameters_changed(self, parameters: P) -> None:
        """Apply dynamic parameters to the robot and its messages."""
        with self._lock:
            self._robot.configure(parameters)
        self._description = self.describe(parameters)
        self._set_covariances()

    # -- commands ---------------------------------------------------------------------------------

    def _subscribe_to_commands(self) -> MatchingSubscription:
        return self.create_matching_subscription(
            self._command_type, 'cmd_vel', self._on_command, topic_endpoints.LATEST
        )

    def _adapt_command_type(self) -> None:
        """Subscribe to the other type if it is the only one that is published, and remains so.

        The controller adapts its own type within the time.
        """
        if self._commands is None:
            self._subscribe_again()
            return
        other = _other_type(self._command_type)
        peers = self.get_publishers_info_by_topic(self.resolve_topic_name('cmd_vel'))
        differs = {peer.topic_type for peer in peers} == {ros_messages.type_name(other)}
        self._mismatches = self._mismatches + 1 if differs else 0
        if self._mismatches * ADAPT_PERIOD >= TYPE_PATIENCE:
            self._mismatches = 0
            # A participant has one type for a topic, and the executor keeps the old subscription
            # until it has run: the new one follows at the next call.
            self.remove_matching_subscription(self._commands)
            self._commands = None

    def _subscribe_again(self) -> None:
        """Subscribe with the other type, or as before where the process uses the topic with it."""
        self._command_type = other = _other_type(self._command_type)
        try:
            self._commands = self._subscribe_to_commands()
        except topic_endpoints.RCLError:
            self._command_type = _other_type(other)
            self._commands = self._subscribe_to_commands()
            return
        self.get_logger().info(f'cmd_vel is published as {ros_messages.type_name(other)}')

    def _on_command(self, message: Twist | TwistStamped, info: dict[str, Any]) -> None:
        """Execute a command unless it is too old; its stamp becomes one in robot time."""
        # First of all: if the process is suspended from here on, the command ages.
        robot_ns = self.robot_ns()
        age_ns = ros_messages.message_age_ns(info)
        self._received += 1
        problem = ros_messages.age_problem(age_ns, self.parameters.limiter.command_timeout)
        if problem:
            problem = f'command {problem}'
        else:
            now_ns = self.now_ns()
            twist, stamp_ns = ros_messages.twist_and_stamp(message, now_ns)
            age_ns = 0 if self.has_simulated_time() else max(age_ns, 0)
            problem = self._apply_command(twist, robot_ns - max(age_ns, now_ns - stamp_ns))
        if problem:
            self._rejected += 1
            if problem != self._command_problem:
                # Texts with the age of a command differ each time.
                self.get_logger().warning(
                    f'cmd_vel rejected: {problem}', throttle_duration_sec=1.0
                )
        self._command_problem = problem

    def _apply_command(self, twist: BodyTwist, stamp_ns: int) -> str:
        command = RobotCommand(wheels_from_twist(twist, self.parameters.geometry), stamp_ns)
        with self._lock:
            return self._robot.apply(command, self.robot_ns())

    def _reset_odometry(self) -> tuple[str, str]:
        with self._lock:
            return self._robot.reset_odometry(self.robot_ns()), 'odometry reset to the origin'

    def _e_stop(self, on: bool) -> tuple[str, str]:
        with self._lock:
            if not on:
                return self._robot.release_estop(self.robot_ns()), 'emergency stop released'
            silence = self._robot.latch_estop('requested by service e_stop', self.robot_ns())
        return UNCONFIRMED.format(silence) if silence else '', 'emergency stop latched'

    def _log_reason(self, reason: str) -> None:
        if reason != self._logged_reason:
            self._logged_reason = reason
            self.get_logger().info(reason or 'following commands')

    def _command_values(self) -> Mapping[str, object]:
        return {'commands': self._received, 'commands_rejected': self._rejected}

    def _command_type_problem(self) -> str:
        return topic_endpoints.command_type_problem(self, self._command_type, publish=False)

    # -- states -----------------------------------------------------------------------------------

    def _create_publishers(self) -> None:
        parameters, robot = self.parameters, self._description
        self._published = 0
        base = self._frame(parameters.base_frame_id)
        odom = self._frame(parameters.odom_frame_id)
        self._odom = ros_messages.SerializedOdometry(odom, base)
        self._odom_publisher = self.create_publisher(Odometry, 'odom', topic_endpoints.STREAM)
        self._set_covariances()
        if robot.truth_frame:
            self._truth = ros_messages.SerializedOdometry(robot.truth_frame, base)
            self._truth_publisher = self.create_publisher(
                Odometry, 'ground_truth/odom', topic_endpoints.STREAM
            )
        self._joint_publisher = self.create_publisher(
            JointState, 'joint_states', topic_endpoints.SCALARS
        )
        self._broadcaster = None
        if parameters.enable_odom_tf or robot.publishes_map:
            self._broadcaster = self._make_broadcaster('TransformBroadcaster')
        if robot.sensors is None:
            return
        _, range_sensor, battery = robot.sensors
        self._imu_publisher = self.create_publisher(Imu, 'imu/data_raw', topic_endpoints.STREAM)
        self._battery_publisher = self.create_publisher(
            BatteryState, 'battery_state', topic_endpoints.SCALARS
        )
        self._battery_message = robot_messages.battery_message(battery)
        self._ranges = []
        for name in RANGE_SENSORS if parameters.range_rate else ():
            frame = self._frame(parameters.frame_names.range_sensor(name))
            message = robot_messages.range_message(range_sensor, frame)
            publisher = self.create_publisher(Range, f'range/{name}', topic_endpoints.SCALARS)
            self._ranges.append((publisher, message))
        if parameters.enable_static_tf:
            self._publish_fixed_frames()

    def _set_covariances(self) -> None:
        geometry, variance = self._description.geometry, self._description.variance
        self._twist_covariances = {
            slipping: robot_messages.twist_covariance(geometry, math.inf if slipping else variance)
            for slipping in (False, True)
        }
        self._slipping: bool | None = None
        if self._description.sensors is not None:
            frame = self._frame(self.parameters.imu_frame_id)
            self._imu_message = robot_messages.imu_message(self._description.sensors[0], frame)

    def _frame(self, name: str) -> str:
        return self.parameters.prefixed(name, self.get_namespace())

    def publish_state(self, state: RobotState) -> None:
        """Publish one state, each topic at its rate."""
        self._publish_motion(state)
        if self._description.sensors is not None:
            self._publish_sensors(state)
        self._published += 1

    def _publish_motion(self, state: RobotState) -> None:
        self._odom.set_pose_covariance(
            ros_messages.planar_covariance(state.covariance, ros_messages.MIN_VARIANCE)
        )
        if state.status.slipping is not self._slipping:
            self._slipping = state.status.slipping
            self._odom.set_twist_covariance(self._twist_covariances[self._slipping])
        self._odom_publisher.publish(self._odom.with_state(state.odometry))
        if state.truth is not None:
            self._truth_publisher.publish(self._truth.with_state(state.truth))
        if self._broadcaster is not None:
            self._broadcaster.sendTransform(self._transforms(state))
        if self._is_due(self.parameters.joint_rate):
            names = self.parameters.right_wheel_name, self.parameters.left_wheel_name
            self._joint_publisher.publish(
                ros_messages.joint_state(names, state.angles, state.wheels, state.stamp_ns)
            )

    def _transforms(self, state: RobotState) -> list[TransformStamped]:
        stamp_ns, pose, _ = state.odometry
        frame, child = self._odom.frame, self._odom.child
        found = []
        if self.parameters.enable_odom_tf:
            found.append(ros_messages.transform(stamp_ns, pose, frame, child))
        if self._description.publishes_map and state.truth is not None:
            origin = frame_between(state.truth.pose, pose)
            found.append(ros_messages.transform(stamp_ns, origin, self._truth.frame, frame))
        return found

    def _publish_sensors(self, state: RobotState) -> None:
        stamp_ns = state.stamp_ns
        if state.imu is not None:
            self._imu_publisher.publish(
                robot_messages.fill_imu(self._imu_message, state.imu, stamp_ns)
            )
        if self._is_due(self.parameters.range_rate):
            infinity = self.parameters.range_infinity
            for (publisher, message), distance in zip(self._ranges, state.ranges, strict=False):
                if not math.isnan(distance):
                    publisher.publish(
                        robot_messages.fill_range(message, distance, stamp_ns, infinity=infinity)
                    )
        if state.battery is not None and self._is_due(BATTERY_RATE):
            self._battery_publisher.publish(
                robot_messages.fill_battery(self._battery_message, state.battery, stamp_ns)
            )

    def _is_due(self, rate: float) -> bool:
        """Return whether a topic of ``rate`` (Hz) is published with the present state."""
        return rate > 0.0 and self._published % max(1, round(self._description.rate / rate)) == 0

    def _publish_fixed_frames(self) -> None:
        """Publish the transforms of the sensors once; the topic is latched."""
        self._static_broadcaster = self._make_broadcaster('StaticTransformBroadcaster')
        if self._static_broadcaster is None:
            return
        names, stamp_ns = self.parameters.frame_names, self.get_clock().now().nanoseconds
        _, range_sensor, _ = self._description.sensors
        self._static_broadcaster.sendTransform(
            [
                ros_messages.transform(
                    stamp_ns,
                    Pose(frame.x, frame.y, frame.yaw),
                    self._frame(names.base),
                    self._frame(frame.name),
                    frame.z,
                )
                for frame in fixed_frames(names, self._description.geometry, range_sensor)
            ]
        )

    def _make_broadcaster(self, kind: str) -> Any:
        tf2_ros = self.import_tf2('no transform is published')
        return tf2_ros and getattr(tf2_ros, kind)(self)


def _other_type(message: type) -> type[Twist | TwistStamped]:
    return Twist if message is TwistStamped else TwistStamped
