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
"""``ros2 run t3mpc_ros sim_robot``: simulated robot with topics and services of the real one."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from t3mpc_ros.geometry.sample_scheduler import RealTimeFactor, SampleScheduler, SimulatedTime
from t3mpc_ros.geometry.types import NANOSECONDS, Pose
from t3mpc_ros.nodes import ros_messages, topic_endpoints
from t3mpc_ros.nodes.base_node import ERROR, NO_CLOCK, OK, WARN
from t3mpc_ros.nodes.robot_messages import (
    FOLLOWING,
    RobotDescription,
    RobotTopicParameters,
    count_variance,
    state_values,
    state_warnings,
)
from t3mpc_ros.nodes.robot_node import RobotNode
from t3mpc_ros.parameters.table import ParameterError, Parameters, group, parameter
from t3mpc_ros.robot.interface import RobotState
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters, make_robot
from t3mpc_ros.simulation.fault_injection import active_faults
from t3mpc_ros.simulation.fault_schedule import ScheduleError
from t3mpc_ros.simulation.world import WorldError

MIN_TIMER_PERIOD, MAX_TIMER_PERIOD = 0.001, 0.05
"""Limits of the timer period, s."""

MIN_REAL_TIME_SHARE = 0.9
"""Share of the set real-time factor below which the diagnostics warn."""


@dataclass(frozen=True)
class InitialPoseParameters(Parameters):
    """Pose in the world at start, and after ``~/set_pose``."""

    x: float = parameter(0.0, 'x of the robot at start and after ~/set_pose', 'm', dynamic=True)
    y: float = parameter(0.0, 'y of the robot at start and after ~/set_pose', 'm', dynamic=True)
    yaw: float = parameter(
        0.0, 'yaw of the robot at start and after ~/set_pose', 'rad', dynamic=True
    )


@dataclass(frozen=True)
class SimRobotParameters(RobotTopicParameters, DigitalTwinParameters):
    """Parameters of the simulated robot node."""

    world_frame: str = parameter('map', 'frame of ground_truth/odom')
    enable_map_tf: bool = parameter(
        False,
        'publish the transform from world_frame to odom_frame_id that puts the robot at its true '
        'pose, if tf2_ros is installed; false where a localisation does',
    )
    publish_clock: bool = parameter(
        False, 'generate simulated time and publish it on /clock, instead of using the node clock'
    )
    real_time_factor: float = parameter(
        1.0,
        'simulated seconds per second; 0 = paused, ~/step advances the time. Values other than 1 '
        'need publish_clock',
        bounds=(0.0, 100.0),
        dynamic=True,
    )
    # Subscription queues hold the messages of at most the highest step time.
    step_time: float = parameter(
        0.01,
        'simulated time that ~/step advances: whole periods, at least one',
        's',
        (0.001, 0.5),
        dynamic=True,
    )
    initial_pose: InitialPoseParameters = group(InitialPoseParameters)

    @property
    def pose(self) -> Pose:
        """Initial pose in the world."""
        return Pose(self.initial_pose.x, self.initial_pose.y, self.initial_pose.yaw)

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for a drive that the node or the settings cannot use.

        Also for a real-time factor other than 1 without ``publish_clock``.
        """
        super().check_consistency()
        kind = self.drive.kind
        if kind == 'torque':
            raise ParameterError(
                'drive.kind must be stepper or velocity, because cmd_vel is a velocity: '
                'got torque, which only the evaluation uses'
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
        if self.real_time_factor != 1.0 and not self.publish_clock:
            raise ParameterError(
                'publish_clock must be true at start for a real_time_factor other than 1: got '
                f'real_time_factor {self.real_time_factor:g} with publish_clock false'
            )


class SimRobotNode(RobotNode[SimRobotParameters]):
    """Advances the simulated robot on an exact time grid and publishes its measurements.

    The time is that of the node, or with ``publish_clock`` simulated time with a real-time factor
    or single steps.
    """

    parameter_class = SimRobotParameters
    configuration_errors = (WorldError, ScheduleError)

    def __init__(self, **options: Any) -> None:
        super().__init__('sim_robot', **options)
        parameters = self.parameters
        self.hardware_id = f'simulated robot {parameters.seed}'
        self.get_logger().info('initialising (the first start compiles the kernels, about 15 s)')
        robot = make_robot(parameters)
        try:
            robot.set_pose(parameters.pose)
        except ValueError as error:
            raise ParameterError(f'initial_pose.x and initial_pose.y: {error}') from error
        robot.warm_up()  # compile here, not within a step
        self._scheduler = SampleScheduler(parameters.rate, slack=0.2 / parameters.rate)
        self._simulated_time = (
            SimulatedTime(parameters.rate, parameters.real_time_factor)
            if parameters.publish_clock
            else None
        )
        self._real_time_factor = RealTimeFactor()
        self._state: RobotState | None = None
        self.connect(robot)
        if parameters.publish_clock:
            self._clock_publisher = self.create_publisher(Clock, '/clock', topic_endpoints.LATEST)
        self.offer(Trigger, '~/set_pose', self._set_pose)
        self.offer(Trigger, '~/step', self._step)
        self._timer = self.create_steady_timer(self._timer_period(), self._on_timer)

    def on_parameters_changed(self, parameters: SimRobotParameters) -> None:
        """Apply dynamic parameters to the robot, its messages and the simulated time."""
        super().on_parameters_changed(parameters)
        time, factor = self._simulated_time, parameters.real_time_factor
        if time is not None and factor != time.real_time_factor:
            time.set_real_time_factor(factor, self.steady_ns())
            self._real_time_factor.restart()
            self._timer.timer_period_ns = round(self._timer_period() * NANOSECONDS)
            self._timer.reset()

    def now_ns(self) -> int:
        """Return the node's time, ns: the publisher of /clock does not wait for its messages."""
        if self._simulated_time is None:
            return super().now_ns()
        return self._simulated_time.now_ns(self.steady_ns())

    def has_simulated_time(self) -> bool:
        """Return whether the time of the robot is no measure for the age of a message."""
        return self._simulated_time is not None or self.get_clock().ros_time_is_active

    def describe(self, parameters: SimRobotParameters) -> RobotDescription:
        """Return the properties of the simulated robot."""
        rate, variance = parameters.rate, parameters.noise.variance
        if parameters.drive.kind == 'stepper':
            variance += count_variance(parameters.motor.microstep, 1.0 / rate)
            sensors = parameters.imu, parameters.range_sensor, parameters.battery
        else:
            sensors = None
        return RobotDescription(
            rate,
            parameters.geometry,
            variance,
            sensors,
            parameters.world_frame,
            parameters.enable_map_tf,
        )

    def _timer_period(self) -> float:
        rate = self.parameters.rate * self.parameters.real_time_factor
        return (
            min(max(1.0 / rate, MIN_TIMER_PERIOD), MAX_TIMER_PERIOD) if rate else MAX_TIMER_PERIOD
        )

    def _on_timer(self) -> None:
        if self._simulated_time is None:
            if not self.clock_started():
                return
            stamps = self._scheduler.due(self.now_ns())
        else:
            stamps = self._simulated_time.due(self.steady_ns())
            if not stamps and self._simulated_time.real_time_factor == 0.0:
                # Late subscribers need the paused time, too.
                self._publish_clock()
        self._advance(stamps)
        if self._state is not None:
            self._real_time_factor.update(self._state.stamp_ns, self.steady_ns())

    def _advance(self, stamps: list[int]) -> None:
        for stamp_ns in stamps:
            self._state = state = self._robot.advance(stamp_ns)
            if self._simulated_time is not None:
                self._publish_clock()
            self.publish_state(state)
            self._log_reason(state.reason)

    def _publish_clock(self) -> None:
        if self._state is not None:
            stamp = ros_messages.time_from_ns(self._state.stamp_ns)
            self._clock_publisher.publish(Clock(clock=stamp))

    def _set_pose(self) -> tuple[str, str]:
        """Set the true pose to the initial pose."""
        pose = self.parameters.pose
        try:
            self._robot.set_pose(pose)
        except ValueError as error:
            return str(error), ''
        return '', (
            f'the robot is at x {pose.x:g} m, y {pose.y:g} m, yaw {pose.yaw:g} rad '
            '(parameters initial_pose.x, initial_pose.y, initial_pose.yaw)'
        )

    def _step(self) -> tuple[str, str]:
        time = self._simulated_time
        if time is None:
            return 'publish_clock must be true at start for single steps: got false', ''
        if (factor := time.real_time_factor) != 0.0:
            return f'real_time_factor must be 0 for single steps: got {factor:g}', ''
        periods = max(1, round(self.parameters.step_time * self.parameters.rate))
        self._advance(time.step(periods))
        return '', f'simulated time {self.now_ns() / NANOSECONDS:.9f} s'

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether the robot follows commands, or the reason of its standstill."""
        state, robot = self._state, self._robot
        twin = robot.diagnostics if isinstance(robot, DigitalTwin) else None
        values = dict(self._command_values())
        if self._simulated_time is None:
            values['lateness_s'] = self._scheduler.lateness(self.now_ns())
            values['skipped_samples'] = self._scheduler.skipped
        if self._real_time_factor.value is not None:
            values['real_time_factor'] = self._real_time_factor.value
        if state is None:
            if not self.clock_started():
                return ERROR, NO_CLOCK, values
            return WARN, 'starting', values
        values |= state_values(state, twin)
        if state.status.estop:
            return ERROR, state.reason, values
        found = [*state_warnings(state, twin, self._command_problem), *self._host_warnings()]
        return (WARN, '; '.join(found), values) if found else (OK, FOLLOWING, values)

    def _host_warnings(self) -> Iterator[str]:
        """Yield what is wrong outside of the robot now: it never hides why the robot stands."""
        if problem := self._command_type_problem():
            yield problem
        if overload := self._overload():
            yield f'processor overloaded: {overload}'

    def _overload(self) -> str:
        """Return how the processor is overloaded since the last report; '' if it is not."""
        if self._scheduler.newly_skipped():
            return 'samples were skipped'
        time, factor = self._simulated_time, self._real_time_factor.value
        if (
            time is not None
            and factor is not None
            and factor < MIN_REAL_TIME_SHARE * time.real_time_factor
        ):
            return f'real-time factor {factor:.3g} instead of {time.real_time_factor:g}'
        return ''

    def on_shutdown(self) -> None:
        """Stop the robot."""
        self._robot.stop('the node is shut down', self.now_ns())
