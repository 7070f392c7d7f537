# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros sim_robot``: the simulated robot behind the robot's own topics."""

from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.motion import Pose
from t3mpc_ros.motion.pace import Pace
from t3mpc_ros.nodes.plumbing import convert, graph, quality
from t3mpc_ros.nodes.plumbing.package_node import ERROR, NO_TIME, OK, WARN, PackageNode
from t3mpc_ros.nodes.tables import SimRobotNodeSettings
from t3mpc_ros.robot.backend import RobotCommand, RobotState
from t3mpc_ros.robot.simulated import SimulatedRobot


class SimRobotNode(PackageNode[SimRobotNodeSettings]):
    """Moves the simulated robot on an exact grid of time and publishes what it measures."""

    def __init__(self, **given: Any) -> None:
        super().__init__('sim_robot', SimRobotNodeSettings, **given)
        settings = self.settings
        self._robot = SimulatedRobot(settings)
        self._robot.warm_up()  # compile now, never inside a step
        self._pace = Pace(settings.rate, slack=0.2 / settings.rate)
        self._state: RobotState | None = None
        self._steps = 0
        self._refused = 0
        self._said = ''
        self._problem = ''
        self._odometry = self._message(settings.odom_frame)
        self._truth = self._message(settings.odom_frame)
        self._odom = self.create_publisher(Odometry, 'odom', quality.STREAM)
        self._true_odom = self.create_publisher(Odometry, 'ground_truth/odom', quality.STREAM)
        self._joints = self.create_publisher(JointState, 'joint_states', quality.SCALARS)
        self._ticker = (
            self.create_publisher(Clock, '/clock', quality.NEWEST)
            if settings.publish_clock
            else None
        )
        self._broadcaster = self._transforms() if settings.publish_tf else None
        self._type = TwistStamped if settings.stamped else Twist
        self.create_subscription(self._type, 'cmd_vel', self._on_command, quality.NEWEST)
        self.create_service(Trigger, 'reset_odometry', self._on_reset_odometry)
        self.create_service(SetBool, 'e_stop', self._on_e_stop)
        self.create_service(Trigger, '~/set_pose', self._on_set_pose)
        self.every(1.0 / settings.rate, self._on_tick)

    def configure(self, settings: SimRobotNodeSettings) -> None:
        """Hand live settings on to the robot."""
        self._robot.configure(settings)

    def _on_command(self, message: Twist | TwistStamped) -> None:
        now_ns = self._robot_now_ns()
        twist, stamp_ns = convert.command(message, now_ns)
        command = RobotCommand.from_twist(twist, self.settings.geometry, stamp_ns)
        if problem := self._robot.apply(command, now_ns):
            self._refused += 1
            if problem != self._problem:
                # Texts that hold an age differ every time.
                self.get_logger().warning(f'cmd_vel refused: {problem}', throttle_duration_sec=1.0)
        self._problem = problem

    def _on_tick(self) -> None:
        if self._ticker is None and not self.knows_time():
            return
        for stamp_ns in self._pace.due(self._robot_now_ns()):
            self._publish(self._robot.advance(stamp_ns))

    def _robot_now_ns(self) -> int:
        # The publisher of the simulated clock cannot wait for it.
        if self._ticker is None:
            return self.now_ns()
        return self.steady_ns()

    def _publish(self, state: RobotState) -> None:
        self._state = state
        if self._ticker is not None:
            self._ticker.publish(Clock(clock=convert.time_from_ns(state.stamp_ns)))
        covariance = convert.planar_covariance(state.covariance)
        self._odometry.pose.covariance = covariance
        self._odom.publish(convert.fill_odometry(self._odometry, state.odometry))
        if state.truth is not None:
            self._true_odom.publish(convert.fill_odometry(self._truth, state.truth))
        if self._broadcaster is not None:
            frames = self.settings.odom_frame, self.settings.base_frame
            self._broadcaster.sendTransform(convert.transform(state.odometry, *frames))
        if self.settings.joint_rate and self._steps % self._every_step() == 0:
            names = self.settings.right_joint, self.settings.left_joint
            self._joints.publish(
                convert.wheel_joints(names, state.angles, state.wheels, state.stamp_ns)
            )
        self._steps += 1
        if state.reason != self._said:
            self._said = state.reason
            self.get_logger().info(state.reason or 'following commands')

    def _every_step(self) -> int:
        return max(1, round(self.settings.rate / self.settings.joint_rate))

    def _message(self, frame: str) -> Odometry:
        message = Odometry(child_frame_id=self.settings.base_frame)
        message.header.frame_id = frame
        return message

    def _transforms(self) -> Any:
        try:
            from tf2_ros import TransformBroadcaster
        except ImportError:
            self.get_logger().info('tf2_ros is not installed: no transform is published')
            return None
        return TransformBroadcaster(self)

    def _on_reset_odometry(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        problem = self._robot.reset_odometry(self._robot_now_ns())
        response.success = not problem
        response.message = problem or 'odometry starts at the origin'
        return response

    def _on_e_stop(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        problem = ''
        if request.data:
            self._robot.latch_estop('asked for by service e_stop', self._robot_now_ns())
        else:
            problem = self._robot.release_estop(self._robot_now_ns())
        response.success = not problem
        response.message = problem or ('latched' if request.data else 'released')
        return response

    def _on_set_pose(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        settings = self.settings
        pose = Pose(settings.start_x, settings.start_y, settings.start_heading)
        self._robot.set_pose(pose)
        response.success = True
        response.message = (
            f'the robot is at x {pose.x:g} m, y {pose.y:g} m, heading {pose.heading:g} rad '
            '(set start_x, start_y, start_heading)'
        )
        return response

    def health(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether the robot follows commands, and if not why not."""
        state = self._state
        values: dict[str, object] = {
            'lateness_s': self._pace.lateness(self._robot_now_ns()),
            'skipped_samples': self._pace.skipped,
            'commands_refused': self._refused,
        }
        if state is not None:
            values |= state.status._asdict()
        if state is None or state.status.estop:
            return ERROR, state.reason if state else NO_TIME, values
        if other := graph.other_types(self, 'cmd_vel', self._type, subscribers=False):
            return WARN, f'cmd_vel is published as {other} by another node: set stamped', values
        if self._pace.skipped:
            return WARN, 'the machine is too slow: samples were given up', values
        return (WARN, state.reason, values) if state.reason else (OK, 'following commands', values)

    def finish(self) -> None:
        """Stop the robot."""
        self._robot.stop('the robot is switched off', self._robot_now_ns())


def make() -> list[SimRobotNode]:
    """Return the nodes of this process."""
    return [SimRobotNode()]
