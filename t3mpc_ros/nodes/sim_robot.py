# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros sim_robot``: the simulated robot with the topics and services of the real one."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from t3mpc_ros.geometry.timing import RealTimeFactor, SampleScheduler, SimulatedTime
from t3mpc_ros.geometry.types import NANOSECONDS, Pose
from t3mpc_ros.nodes.common import conversions, introspection, qos
from t3mpc_ros.nodes.common.base_node import ERROR, NO_CLOCK, OK, WARN, BaseNode
from t3mpc_ros.nodes.common.diagnostics import complaints, measures
from t3mpc_ros.nodes.common.robot_publishers import (
    RobotDescription,
    RobotPublishers,
    RobotTopicParameters,
)
from t3mpc_ros.nodes.common.robot_services import RobotServices
from t3mpc_ros.nodes.common.sensor_messages import count_variance
from t3mpc_ros.parameters.table import ParameterError, parameter
from t3mpc_ros.robot.interface import RobotCommand, RobotState
from t3mpc_ros.simulation.digital_twin import (
    DigitalTwin,
    DigitalTwinParameters,
    TwinDiagnostics,
    make_robot,
)
from t3mpc_ros.simulation.fault_injection import active_faults


@dataclass(frozen=True)
class SimRobotNodeParameters(RobotTopicParameters, DigitalTwinParameters):
    """The simulated robot as a node."""

    world_frame: str = parameter('odom', 'frame of ground_truth/odom')
    publish_clock: bool = parameter(
        False, 'make the time, and publish it as /clock, instead of following the machine'
    )
    speed: float = parameter(
        1.0,
        'simulated seconds per second; 0 = time stands, and ~/step moves it. Other than 1 with '
        'publish_clock only',
        low=0.0,
        high=100.0,
        dynamic=True,
    )
    step_time: float = parameter(
        0.01,
        'time that ~/step lets pass: whole periods, at least one',
        unit='s',
        low=0.001,
        # Streams are made up for, and queues hold, no more than this at once.
        high=0.5,
        dynamic=True,
    )
    start_x: float = parameter(
        0.0, 'where the robot stands at first, and ~/set_pose puts it', unit='m', dynamic=True
    )
    start_y: float = parameter(
        0.0, 'where the robot stands at first, and ~/set_pose puts it', unit='m', dynamic=True
    )
    start_heading: float = parameter(
        0.0, 'where it looks at first, and ~/set_pose points it', unit='rad', dynamic=True
    )

    @property
    def start(self) -> Pose:
        """Where the robot stands at first, in the world."""
        return Pose(self.start_x, self.start_y, self.start_heading)

    @property
    def step_periods(self) -> int:
        """How many periods ``~/step`` lets pass."""
        return max(1, round(self.step_time * self.rate))

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for a drive that takes no velocities, or has not the parts.

        And for a time of its own that nobody would hear of.
        """
        super().check_consistency()
        kind = self.drive.kind
        if kind == 'torque':
            raise ParameterError(
                'drive.kind must be stepper or velocity, because cmd_vel is a velocity: '
                'got torque, which is for the lab'
            )
        if kind == 'velocity':
            faults = {
                'faults': active_faults(self.faults),
                'faults.schedule': self.faults.schedule,
            }
            for name, value in {'world': self.world, **faults}.items():
                if value:
                    raise ParameterError(
                        f'drive.kind must be stepper for {name} to have an effect: '
                        f'got velocity with {value if isinstance(value, str) else value[0]}'
                    )
        if self.speed != 1.0 and not self.publish_clock:
            raise ParameterError(
                'publish_clock must be true at start for a speed other than 1, or nobody hears '
                f'what time it is: got speed {self.speed:g} without it'
            )


MIN_TIMER_PERIOD, MAX_TIMER_PERIOD = 0.001, 0.05
"""s; the machine wakes up neither more often, nor less often, than this."""

MIN_SPEED_SHARE = 0.9
"""Share of the asked-for speed from which on nobody needs to hear that it is not reached."""


def _robot_description(parameters: SimRobotNodeParameters) -> RobotDescription:
    """Return what the robot of these settings is like."""
    rate, variance = parameters.rate, parameters.noise.variance
    if parameters.drive.kind != 'stepper':
        return RobotDescription(rate, parameters.geometry, variance, None, parameters.world_frame)
    variance += count_variance(parameters.motor.microstep, 1.0 / rate)
    sensors = parameters.imu, parameters.range_sensor, parameters.battery
    return RobotDescription(rate, parameters.geometry, variance, sensors, parameters.world_frame)


class SimRobotNode(BaseNode[SimRobotNodeParameters]):
    """Moves the simulated robot on an exact grid of time and publishes what it measures.

    Time is that of the node, or with ``publish_clock`` the robot's own, which may pass faster,
    slower, or step by step.
    """

    def __init__(self, **given: Any) -> None:
        super().__init__('sim_robot', SimRobotNodeParameters, **given)
        parameters = self.parameters
        self._robot = make_robot(parameters)
        if problem := self._place():
            raise ParameterError(f'start_x and start_y: {problem}')
        self._robot.warm_up()  # compile now, never inside a step
        self._pace = SampleScheduler(parameters.rate, slack=0.2 / parameters.rate)
        self._own_time = (
            SimulatedTime(parameters.rate, parameters.speed) if parameters.publish_clock else None
        )
        self._factor = RealTimeFactor()
        self._state: RobotState | None = None
        self._commands = self._refused = 0
        self._said = ''
        self._problem = ''
        self._topics = RobotPublishers(self, parameters, _robot_description(parameters))
        if parameters.publish_clock:
            self._clock_topic = self.create_publisher(Clock, '/clock', qos.LATEST)
        self._type = TwistStamped if parameters.stamped else Twist
        self.create_subscription(self._type, 'cmd_vel', self._on_command, qos.LATEST)
        RobotServices(self, self._robot, self._robot_now_ns)
        self.create_service(Trigger, '~/set_pose', self._on_set_pose)
        self.create_service(Trigger, '~/step', self._on_step)
        self._ticks = self.create_timer(self._tick_period(), self._on_tick, clock=self._steady)

    def configure(self, parameters: SimRobotNodeParameters) -> None:
        """Hand live settings on to the robot."""
        self._robot.configure(parameters)
        self._topics.configure(parameters, _robot_description(parameters))
        if self._own_time is not None and parameters.speed != self._own_time.real_time_factor:
            self._own_time.set_real_time_factor(parameters.speed, self.steady_ns())
            self._factor.restart()
            self._ticks.timer_period_ns = round(self._tick_period() * NANOSECONDS)
            self._ticks.reset()

    def _tick_period(self) -> float:
        samples = self.parameters.rate * self.parameters.speed
        return (
            min(max(1.0 / samples, MIN_TIMER_PERIOD), MAX_TIMER_PERIOD)
            if samples
            else MAX_TIMER_PERIOD
        )

    def _on_command(self, message: Twist | TwistStamped) -> None:
        self._commands += 1
        now_ns = self._robot_now_ns()
        twist, stamp_ns = conversions.twist_and_stamp(message, now_ns)
        command = RobotCommand.from_twist(twist, self.parameters.geometry, stamp_ns)
        if problem := self._robot.apply(command, now_ns):
            self._refused += 1
            if problem != self._problem:
                # Texts that hold an age differ every time.
                self.get_logger().warning(f'cmd_vel refused: {problem}', throttle_duration_sec=1.0)
        self._problem = problem

    def _on_tick(self) -> None:
        if self._own_time is None:
            if not self.clock_received():
                return
            stamps = self._pace.due(self._robot_now_ns())
        else:
            stamps = self._own_time.due(self.steady_ns())
            if not stamps and self._own_time.real_time_factor == 0.0:
                # For those who come while time stands: they would not know that it is known.
                self._publish_clock()
        self._advance(stamps)
        if self._state is not None:
            self._factor.update(self._state.stamp_ns, self.steady_ns())

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
            self._clock_topic.publish(Clock(clock=conversions.time_from_ns(self._state.stamp_ns)))

    def _robot_now_ns(self) -> int:
        # The publisher of the simulated clock cannot wait for it.
        if self._own_time is None:
            return self.now_ns()
        return self._own_time.now_ns(self.steady_ns())

    def _place(self) -> str:
        """Put the robot where the settings say, or return why it cannot stand there."""
        try:
            self._robot.set_pose(self.parameters.start)
        except ValueError as error:
            return str(error)
        return ''

    def _on_set_pose(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        problem = self._place()
        pose = self.parameters.start
        response.success = not problem
        response.message = problem or (
            f'the robot is at x {pose.x:g} m, y {pose.y:g} m, yaw {pose.yaw:g} rad '
            '(set start_x, start_y, start_heading)'
        )
        return response

    def _on_step(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        time = self._own_time
        if time is None:
            response.message = 'publish_clock must be true at start to go step by step: got false'
        elif time.real_time_factor != 0.0:
            response.message = f'speed must be 0 to go step by step: got {time.real_time_factor:g}'
        else:
            self._advance(time.step(self.parameters.step_periods))
            response.success = True
            response.message = f'it is {self._robot_now_ns() / NANOSECONDS:.9f} s'
        return response

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
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
            return ERROR, NO_CLOCK, values
        values |= measures(state, inside)
        if state.status.estop:
            return ERROR, state.reason, values
        if other := introspection.mismatched_type(self, 'cmd_vel', self._type, subscribers=False):
            return WARN, f'cmd_vel is published as {other} by another node: set stamped', values
        if slow := self._too_slow():
            return WARN, f'the machine is too slow: {slow}', values
        if found := complaints(state, inside):
            return WARN, '; '.join(found), values
        return OK, 'following commands', values

    def _inside(self) -> TwinDiagnostics | None:
        return self._robot.diagnostics if isinstance(self._robot, DigitalTwin) else None

    def _too_slow(self) -> str:
        if self._pace.skipped:
            return 'samples were given up'
        time, factor = self._own_time, self._factor.value
        if time is not None and factor is not None and factor < MIN_SPEED_SHARE * time.real_time_factor:
            return f'{factor:.3g} instead of {time.real_time_factor:g} simulated seconds per second'
        return ''

    def finish(self) -> None:
        """Stop the robot."""
        self._robot.stop('the robot is switched off', self._robot_now_ns())


def make() -> list[SimRobotNode]:
    """Return the nodes of this process."""
    return [SimRobotNode()]
