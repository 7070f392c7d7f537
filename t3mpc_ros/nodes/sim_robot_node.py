# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros sim_robot``: the simulated robot behind the robot's own topics."""

from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from t3mpc_ros.motion.pace import Pace, RealTimeFactor, SimulatedTime
from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.nodes.plumbing import convert, graph, quality
from t3mpc_ros.nodes.plumbing.package_node import ERROR, NO_TIME, OK, WARN, PackageNode
from t3mpc_ros.nodes.robot.condition import complaints, measures
from t3mpc_ros.nodes.robot.sensors import count_variance
from t3mpc_ros.nodes.robot.services import RobotServices
from t3mpc_ros.nodes.robot.topics import Facts, RobotTopics
from t3mpc_ros.nodes.tables import SimRobotNodeSettings
from t3mpc_ros.robot.backend import RobotCommand, RobotState
from t3mpc_ros.robot.twin.robot import Inside, TwinRobot, make_robot
from t3mpc_ros.settings import SettingError

SHORTEST_TICK, LONGEST_TICK = 0.001, 0.05
"""s; the machine wakes up neither more often, nor less often, than this."""

KEPT_UP = 0.9
"""Share of the asked-for speed from which on nobody needs to hear that it is not reached."""


def _facts(settings: SimRobotNodeSettings) -> Facts:
    """Return what the robot of these settings is like."""
    rate, variance = settings.rate, settings.noise.variance
    if settings.drive.kind != 'stepper':
        return Facts(rate, settings.geometry, variance, None, settings.world_frame)
    variance += count_variance(settings.motor.microstep, 1.0 / rate)
    sensors = settings.imu, settings.sharp, settings.battery
    return Facts(rate, settings.geometry, variance, sensors, settings.world_frame)


class SimRobotNode(PackageNode[SimRobotNodeSettings]):
    """Moves the simulated robot on an exact grid of time and publishes what it measures.

    Time is that of the node, or with ``publish_clock`` the robot's own, which may pass faster,
    slower, or step by step.
    """

    def __init__(self, **given: Any) -> None:
        super().__init__('sim_robot', SimRobotNodeSettings, **given)
        settings = self.settings
        self._robot = make_robot(settings)
        if problem := self._place():
            raise SettingError(f'start_x and start_y: {problem}')
        self._robot.warm_up()  # compile now, never inside a step
        self._pace = Pace(settings.rate, slack=0.2 / settings.rate)
        self._own_time = (
            SimulatedTime(settings.rate, settings.speed) if settings.publish_clock else None
        )
        self._factor = RealTimeFactor()
        self._state: RobotState | None = None
        self._commands = self._refused = 0
        self._said = ''
        self._problem = ''
        self._topics = RobotTopics(self, settings, _facts(settings))
        if settings.publish_clock:
            self._clock_topic = self.create_publisher(Clock, '/clock', quality.NEWEST)
        self._type = TwistStamped if settings.stamped else Twist
        self.create_subscription(self._type, 'cmd_vel', self._on_command, quality.NEWEST)
        RobotServices(self, self._robot, self._robot_now_ns)
        self.create_service(Trigger, '~/set_pose', self._on_set_pose)
        self.create_service(Trigger, '~/step', self._on_step)
        self._ticks = self.create_timer(self._tick_period(), self._on_tick, clock=self._steady)

    def configure(self, settings: SimRobotNodeSettings) -> None:
        """Hand live settings on to the robot."""
        self._robot.configure(settings)
        self._topics.configure(settings, _facts(settings))
        if self._own_time is not None and settings.speed != self._own_time.speed:
            self._own_time.change_speed(settings.speed, self.steady_ns())
            self._factor.restart()
            self._ticks.timer_period_ns = round(self._tick_period() * NANOSECONDS)
            self._ticks.reset()

    def _tick_period(self) -> float:
        samples = self.settings.rate * self.settings.speed
        return min(max(1.0 / samples, SHORTEST_TICK), LONGEST_TICK) if samples else LONGEST_TICK

    def _on_command(self, message: Twist | TwistStamped) -> None:
        self._commands += 1
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
        if self._own_time is None:
            if not self.knows_time():
                return
            stamps = self._pace.due(self._robot_now_ns())
        else:
            stamps = self._own_time.due(self.steady_ns())
            if not stamps and self._own_time.speed == 0.0:
                # For those who come while time stands: they would not know that it is known.
                self._publish_clock()
        self._advance(stamps)
        if self._state is not None:
            self._factor.note(self._state.stamp_ns, self.steady_ns())

    def _advance(self, stamps: list[int]) -> None:
        for stamp_ns in stamps:
            self._state = state = self._robot.advance(stamp_ns)
            if self._own_time is not None:
                self._publish_clock()
            self._topics.publish(state)
            if state.reason != self._said:
                self._said = state.reason
                self.get_logger().info(state.reason or 'following commands')

    def _publish_clock(self) -> None:
        if self._state is not None:
            self._clock_topic.publish(Clock(clock=convert.time_from_ns(self._state.stamp_ns)))

    def _robot_now_ns(self) -> int:
        # The publisher of the simulated clock cannot wait for it.
        if self._own_time is None:
            return self.now_ns()
        return self._own_time.now_ns(self.steady_ns())

    def _place(self) -> str:
        """Put the robot where the settings say, or return why it cannot stand there."""
        try:
            self._robot.set_pose(self.settings.start)
        except ValueError as error:
            return str(error)
        return ''

    def _on_set_pose(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        problem = self._place()
        pose = self.settings.start
        response.success = not problem
        response.message = problem or (
            f'the robot is at x {pose.x:g} m, y {pose.y:g} m, heading {pose.heading:g} rad '
            '(set start_x, start_y, start_heading)'
        )
        return response

    def _on_step(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        time = self._own_time
        if time is None:
            response.message = 'publish_clock must be true at start to go step by step: got false'
        elif time.speed != 0.0:
            response.message = f'speed must be 0 to go step by step: got {time.speed:g}'
        else:
            self._advance(time.step(self.settings.step_periods))
            response.success = True
            response.message = f'it is {self._robot_now_ns() / NANOSECONDS:.9f} s'
        return response

    def health(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether the robot follows commands and is well, and if not why not."""
        state, inside = self._state, self._inside()
        values: dict[str, object] = {
            'commands': self._commands,
            'commands_refused': self._refused,
        }
        if self._own_time is None:
            values['lateness_s'] = self._pace.lateness(self._robot_now_ns())
            values['skipped_samples'] = self._pace.skipped
        if self._factor.value is not None:
            values['real_time_factor'] = self._factor.value
        if state is None:
            return ERROR, NO_TIME, values
        values |= measures(state, inside)
        if state.status.estop:
            return ERROR, state.reason, values
        if other := graph.other_types(self, 'cmd_vel', self._type, subscribers=False):
            return WARN, f'cmd_vel is published as {other} by another node: set stamped', values
        if slow := self._too_slow():
            return WARN, f'the machine is too slow: {slow}', values
        if found := complaints(state, inside):
            return WARN, '; '.join(found), values
        return OK, 'following commands', values

    def _inside(self) -> Inside | None:
        return self._robot.inside if isinstance(self._robot, TwinRobot) else None

    def _too_slow(self) -> str:
        if self._pace.skipped:
            return 'samples were given up'
        time, factor = self._own_time, self._factor.value
        if time is not None and factor is not None and factor < KEPT_UP * time.speed:
            return f'{factor:.3g} instead of {time.speed:g} simulated seconds per second'
        return ''

    def finish(self) -> None:
        """Stop the robot."""
        self._robot.stop('the robot is switched off', self._robot_now_ns())


def make() -> list[SimRobotNode]:
    """Return the nodes of this process."""
    return [SimRobotNode()]
