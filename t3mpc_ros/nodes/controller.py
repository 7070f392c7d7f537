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
"""``ros2 run t3mpc_ros controller``: tracks ``reference`` with ``odom``, publishes ``cmd_vel``."""

from array import array
from collections.abc import Mapping
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any
import zlib

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Range
from std_msgs.msg import Float64, Int64MultiArray, String
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.bag.controller_input_journal import Journal, parameters_to_json
from t3mpc_ros.control.controller import (
    SCALAR_NAMES,
    Controller,
    Status,
    StepperControllerParameters,
)
from t3mpc_ros.control.odometry_monitor import NAMES, OdometryMonitor
from t3mpc_ros.control.watchdog import TRIALS, Reason, StopHistory
from t3mpc_ros.geometry.obstacles import Obstacles, OccupancyGrid
from t3mpc_ros.geometry.types import NANOSECONDS, RANGE_SENSORS, STANDSTILL, BodyTwist
from t3mpc_ros.model_file import ModelError, find_model, load_model, save_model
from t3mpc_ros.nodes import ros_messages, topic_endpoints
from t3mpc_ros.nodes.base_node import (
    ADAPT_PERIOD,
    ERROR,
    OK,
    WARN,
    BaseNode,
    publish_and_wait_for_acked,
)
from t3mpc_ros.nodes.ros_messages import FrameParameters, age_problem, message_age_ns
from t3mpc_ros.parameters.table import ParameterError, group, parameter

INITIAL_INPUT_TIME_NS = 10 * NANOSECONDS
"""Time from the first input for which inputs are republished on ``~/initial_inputs/*``."""
MAP_PERIOD = 0.25
"""Time between two maps of the keep-out, s."""
WATCHDOG_PERIOD, SHORTEST_WATCHDOG_PERIOD = 0.05, 0.01
"""Time between two checks of the odometry, s; one period of a controller that drives through gaps,
but no less than the second."""
GAP_PERIODS = 2.0
"""Silence of the odometry that is a gap, in periods."""


@dataclass(frozen=True)
class ControllerNodeParameters(StepperControllerParameters):
    """Parameters of the controller node."""

    enable_stamped_cmd_vel: bool = parameter(
        False, 'publish cmd_vel as TwistStamped instead of Twist'
    )
    detect_cmd_vel_type: bool = parameter(
        True,
        'publish cmd_vel with the type that its subscribers expect, Twist or TwistStamped, if '
        'none expects that of enable_stamped_cmd_vel',
    )
    frame_id: str = parameter('base_link', 'frame of a stamped command')
    frames: FrameParameters = group(FrameParameters, inline=True)
    terms_rate: float = parameter(
        20.0,
        'rate of the scalar topics (~/error, ~/estimate, ~/terms, ~/lyapunov, ~/skill), which '
        'are published only while they have subscribers; 0 = none',
        'Hz',
        (0.0, 1000.0),
    )
    model: str = parameter(
        '',
        'model file to load at start, or servo: the model of the package for the simulated robot '
        'with drive.kind velocity; empty = start without learnt weights',
    )
    model_output: str = parameter('controller_model.npz', 'file that ~/save_model writes')
    map_output: str = parameter(
        'keep_out_map.yaml',
        'file that ~/save_map writes, for map_server; the image is beside it, as PGM',
    )


class InitialInputs:
    """Republishes the first messages of an input on a transient-local topic.

    A recorder that discovers the controller late receives them and can replay the run from its
    beginning, while the input itself is volatile.
    """

    def __init__(self, node: BaseNode[ControllerNodeParameters], name: str) -> None:
        self._node = node
        self._publisher = node.create_publisher(
            Odometry, f'~/initial_inputs/{name}', topic_endpoints.INITIAL_INPUTS
        )
        self._remaining = topic_endpoints.INITIAL_INPUTS.depth
        self._end_ns: int | None = None

    def republish(self, message: bytes) -> None:
        """Publish a message received within the first 10 s, as long as all of them are kept."""
        if not self._remaining:
            return
        now_ns = self._node.steady_ns()
        if self._end_ns is None:
            self._end_ns = now_ns + INITIAL_INPUT_TIME_NS
        if now_ns >= self._end_ns:
            self._remaining = 0
            return
        self._remaining -= 1
        self._publisher.publish(message)


class ControllerNode(BaseNode[ControllerNodeParameters]):
    """Runs one control step per odometry message and publishes the command."""

    parameter_class = ControllerNodeParameters
    configuration_errors = (ModelError,)
    single_publisher_topics = ('cmd_vel', 'reference', 'odom')

    def __init__(self, **options: Any) -> None:
        super().__init__('controller', **options)
        self.get_logger().info('initialising (the first start compiles the kernels, about 30 s)')
        self._controller = Controller(
            self.parameters, _obstacles(self.parameters), _saved_map(self.parameters)
        )
        self._controller.warm_up()  # compile and pre-train here, not within a step
        self._journal = Journal()
        self._journal_publisher = self.create_publisher(
            Int64MultiArray, '~/journal', topic_endpoints.JOURNAL
        )
        self._journal_message = Int64MultiArray(data=self._journal.row)
        self._revision_publisher = self.create_publisher(
            String, '~/parameters', topic_endpoints.PARAMETER_REVISIONS
        )
        self._publish_parameters()
        self._load_model()
        self._last_odometry_ns: int | None = None
        self._received_ns = self._stamp_ns = 0
        self._odometry_monitor = OdometryMonitor(self.parameters.rate)
        self._last_command: BodyTwist | None = None
        self._steps = 0
        self._rejected_references = 0
        self._rejected_odometry = 0
        self._rejected_ranges = 0
        self._reported_ignored = 0
        self._odometry_problem = ''
        self._logged_reason = self._controller.status.reason
        self._stops = StopHistory()
        self._command_type = TwistStamped if self.parameters.enable_stamped_cmd_vel else Twist
        self._command_publisher = self.create_publisher(
            self._command_type, 'cmd_vel', topic_endpoints.COMMAND
        )
        self._scalar_publishers = {
            name: self.create_publisher(Float64, f'~/{name}', topic_endpoints.SCALARS)
            for name in (SCALAR_NAMES if self.parameters.terms_rate else ())
        }
        self._frame_id = self.parameters.frames.prefixed(
            self.parameters.frame_id, self.get_namespace()
        )
        self._initial_reference = InitialInputs(self, 'reference')
        self._initial_odometry = InitialInputs(self, 'odom')
        self._references = self.create_matching_subscription(
            Odometry, 'reference', None, topic_endpoints.STREAM, raw=True
        )
        self._odometry = self.create_matching_subscription(
            Odometry, 'odom', self._on_odometry, topic_endpoints.STREAM, raw=True
        )
        # Like references, ranges are taken before a step: a wait of the executor costs more than
        # a step, and they come 160 times a second.
        self._ranges = (
            [
                self.create_matching_subscription(
                    Range, f'range/{name}', None, topic_endpoints.SCALARS
                )
                for name in RANGE_SENSORS
            ]
            if self.parameters.keep_out.enabled
            else []
        )
        if self.parameters.keep_out.enabled:
            self._map_publisher = self.create_publisher(
                OccupancyGridMessage, 'keep_out/map', topic_endpoints.LATCHED
            )
            self.create_steady_timer(MAP_PERIOD, self._publish_map)
            self.offer(Trigger, '~/save_map', self._save_map)
        self.offer(SetBool, '~/enable', self._enable)
        self.offer(Trigger, '~/reset', self._reset)
        self.offer(Trigger, '~/save_model', self._save_model)
        period = WATCHDOG_PERIOD
        if self._controller.drives_through_gaps:
            period = min(max(1.0 / self.parameters.rate, SHORTEST_WATCHDOG_PERIOD), period)
        self.create_steady_timer(period, self._on_watchdog)
        if self.parameters.detect_cmd_vel_type:
            self.create_steady_timer(ADAPT_PERIOD, self._adapt_command_type)

    def _load_model(self) -> None:
        if not self.parameters.model:
            return
        path = find_model(self.parameters.model)
        try:
            self._controller.set_weights(load_model(path))
        except ValueError as error:
            raise ModelError(f'{path} does not fit the parameters: {error}') from error
        self._publish_journal(self._journal.model(zlib.crc32(path.read_bytes())))

    def on_parameters_changed(self, parameters: ControllerNodeParameters) -> None:
        """Apply dynamic parameters to the controller and record them in the journal."""
        self._controller.configure(parameters)
        row = self._journal.configure()
        self._publish_parameters()
        self._publish_journal(row)

    def _publish_parameters(self) -> None:
        text = parameters_to_json(self._journal.revision, self.parameters.to_dict())
        self._revision_publisher.publish(String(data=text))

    def _publish_journal(self, row: 'array[int]') -> None:
        """Publish a row of the journal, after the command to keep the latency of the latter."""
        self._journal_message.data = row
        self._journal_publisher.publish(self._journal_message)

    def _take_references(self) -> None:
        for message in self._references.take_waiting():
            state = ros_messages.state_from_odometry(message)
            self._journal.count_reference(state.stamp_ns)
            if not self._controller.add_reference(state):
                self._rejected_references += 1
            self._initial_reference.republish(message)

    def _take_ranges(self) -> None:
        for sensor, subscription in enumerate(self._ranges):
            for message in subscription.take_waiting():
                stamp_ns = ros_messages.ns_from_time(message.header.stamp) or None
                if self._controller.add_range(sensor, message.range, stamp_ns):
                    self._publish_journal(self._journal.range(sensor, message.range))
                else:
                    self._rejected_ranges += 1

    def _on_odometry(self, message: bytes, info: dict[str, Any]) -> None:
        # Without a step, the watchdog stops the robot and the journal has no row.
        timeout = self.parameters.watchdog.odometry_timeout
        self._odometry_problem = age_problem(message_age_ns(info), timeout)
        if self._odometry_problem:
            self._rejected_odometry += 1 + len(self._odometry.take_waiting())
            return
        self._take_references()
        self._take_ranges()
        measured = ros_messages.state_from_odometry(message)
        if not self._steps:
            self._odometry_frame = ros_messages.frame_from_serialized(message)
        command, status = self._controller.step(measured)
        now_ns = self.now_ns()
        if self._controller.odometry_used or self._last_odometry_ns is None:
            self._last_odometry_ns = self.steady_ns()
            # Stamps are ahead of their receipt by a constant, but for the time on the way.
            self._received_ns, self._stamp_ns = now_ns, measured.stamp_ns
        self._publish_command(command, status.stamp_ns)
        # Poses alone are differentiated, which says little about a gain.
        known = None if self._controller.odometry_twist.replaced else self._last_command
        outside = self._controller.wheel_monitor.outside
        following = status.reason is Reason.TRACKING and not outside
        if not self._controller.doubts_odometry:
            periods = self._controller.stamp_filter.periods
            self._odometry_monitor.update(
                measured, now_ns, known, following=following, periods=periods
            )
        self._last_command = command if status.reason.moves else None
        self._publish_journal(self._journal.step(measured.stamp_ns))
        self._initial_odometry.republish(message)
        self._steps += 1
        if self._scalar_publishers:
            self._publish_scalars(status)
        self._log_reason(status)

    def _publish_map(self) -> None:
        keep_out = self._controller.keep_out
        if keep_out is not None and self._steps and self._map_publisher.get_subscription_count():
            grid = keep_out.map.occupancy()
            message = ros_messages.occupancy_message(grid, self.now_ns(), self._odometry_frame)
            self._map_publisher.publish(message)

    def _adapt_command_type(self) -> None:
        """Publish the other type if it is the only one that a subscriber expects."""
        other = Twist if self._command_type is TwistStamped else TwistStamped
        topic = self.resolve_topic_name('cmd_vel')
        expected = topic_endpoints.command_types(self, topic)
        if expected != {ros_messages.type_name(other)}:
            return
        # A participant has one type for a topic: the old publisher goes first.
        self.destroy_publisher(self._command_publisher)
        try:
            self._command_publisher = self.create_publisher(
                other, 'cmd_vel', topic_endpoints.COMMAND
            )
        except topic_endpoints.RCLError:  # this process uses the topic with the old type
            self._command_publisher = self.create_publisher(
                self._command_type, 'cmd_vel', topic_endpoints.COMMAND
            )
            return
        self._command_type = other
        self.get_logger().info(f'the robot expects {ros_messages.type_name(other)}')

    def _on_watchdog(self) -> None:
        self._take_references()
        self._take_ranges()
        if self._last_odometry_ns is None:
            return
        if self._controller.check_odometry(self._last_odometry_ns, self.steady_ns()):
            self._publish_command(STANDSTILL, self.now_ns())
            self._publish_journal(self._journal.odometry_timeout(self._controller.status.stamp_ns))
            self._log_reason(self._controller.status)
        elif self._controller.drives_through_gaps:
            self._drive_through_gap()

    def _drive_through_gap(self) -> None:
        silence_ns = self.now_ns() - self._received_ns
        if silence_ns < GAP_PERIODS * NANOSECONDS / self.parameters.rate:
            return
        stamp_ns = self._stamp_ns + silence_ns
        if (found := self._controller.step_without_odometry(stamp_ns)) is not None:
            self._last_command, status = found
            self._publish_command(self._last_command, stamp_ns)
            self._publish_journal(self._journal.step_without_odometry(stamp_ns))
            self._log_reason(status)

    def _publish_command(self, command: BodyTwist, stamp_ns: int) -> None:
        self._command_publisher.publish(self._command_message(command, stamp_ns))

    def _command_message(self, command: BodyTwist, stamp_ns: int) -> Twist | TwistStamped:
        if self._command_type is TwistStamped:
            return ros_messages.stamped_twist(command, stamp_ns, self._frame_id)
        return ros_messages.twist_from_body(command)

    def _log_reason(self, status: Status) -> None:
        self._stops.update(status.reason, self.steady_ns())
        if status.reason is not self._logged_reason:
            self._logged_reason = status.reason
            self.get_logger().info(status.reason.value)

    def _publish_scalars(self, status: Status) -> None:
        if self._steps % max(1, round(self.parameters.rate / self.parameters.terms_rate)):
            return
        for name, value in zip(SCALAR_NAMES, status.scalars, strict=True):
            publisher = self._scalar_publishers[name]
            # The error is NaN while there is no reference.
            if math.isfinite(value) and publisher.get_subscription_count():
                publisher.publish(Float64(data=value))

    def _enable(self, on: bool) -> tuple[str, str]:
        self._controller.enable(on)
        self._publish_journal(self._journal.enable(on))
        return '', 'the robot may move' if on else 'the robot is stopped'

    def _reset(self) -> tuple[str, str]:
        self._controller.reset()
        self._publish_journal(self._journal.reset())
        return '', 'learnt weights of this run are discarded'

    def _save_model(self) -> tuple[str, str]:
        path = Path(self.parameters.model_output)
        try:
            save_model(path, self._controller.get_weights(), self.parameters.to_dict())
        except ModelError as error:
            return str(error), ''
        return '', f'saved {path.resolve()}'

    def _save_map(self) -> tuple[str, str]:
        from t3mpc_ros.geometry.occupancy_map_file import MapError, save_map

        assert self._controller.keep_out is not None
        path = Path(self.parameters.map_output)
        try:
            save_map(path, self._controller.keep_out.map.occupancy())
        except MapError as error:
            return str(error), ''
        return '', f'saved {path.resolve()}'

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether the controller tracks the reference, or the reason of the stop."""
        status = self._controller.status
        values: dict[str, object] = {
            'reason': status.reason.value,
            'steps': self._steps,
            'limited': status.limited,
            'certificate_margin': status.certificate.margin,
            'certificate_holds': status.certificate.holds,
            'ultimate_bound_rad_s': self._controller.law.ultimate_bound,
            'gain_1_s': self._controller.gain,
            'dead_time_s': self._controller.dead_time.dead_time,
            'dead_time_std_s': self._controller.dead_time.standard_deviation,
            'disturbed': self._controller.disturbed,
            'body_authority': self._controller.body.authority,
            'body_yaw_error_rad': self._controller.body.yaw_error,
            'skill_right': float(status.skill[0]),
            'skill_left': float(status.skill[1]),
            'gyro_bias_rad_s': self._controller.body.gyro_bias,
            'odometry_has_twist': not self._controller.odometry_twist.missing,
            'odometry_ignored': self._controller.ignored_odometry,
            'pauses': self._controller.drive_monitor.pauses,
            **self._stop_values(),
            'references_rejected': self._rejected_references,
            'odometry_rejected': self._rejected_odometry,
            **self._input_values(),
        }
        if self.parameters.pose.enabled:
            values['path_error_m'] = self._controller.pose_controller.error.distance
            values['rejoining'] = self._controller.pose_controller.rejoining
        if self._controller.keep_out is not None:
            values['keep_out'] = self._controller.keep_out.activity.value
            values['ranges_rejected'] = self._rejected_ranges
            for name, fault in self._controller.keep_out.ranges.faults().items():
                values[f'range_{name}'] = fault.value
        if self._odometry_problem:
            return ERROR, f'stopped: odom {self._odometry_problem}', values
        waiting = self._steps == 0
        if status.reason in (Reason.PAUSED, Reason.NOT_FOLLOWING):
            lasts = self._controller.drive_monitor.pauses >= TRIALS
            return ERROR if lasts else WARN, status.reason.value, values
        stopped = f'stopped: {status.reason.value}'
        if not status.reason.moves and not waiting:
            return ERROR, stopped, values
        if problem := topic_endpoints.command_type_problem(self, self._command_type, publish=True):
            return WARN, problem, values
        if waiting:
            return WARN, stopped, values
        keep_out = self._controller.keep_out
        if keep_out is not None and keep_out.activity.stuck:
            return WARN, keep_out.activity.value, values
        if self._rejected_references:
            return WARN, 'reference messages with non-finite values were ignored', values
        return OK, status.reason.value, values

    def _stop_values(self) -> dict[str, object]:
        """Return the number of stops since the first motion, and the newest one."""
        stops, now_ns = self._stops, self.steady_ns()
        if stops.last is None:
            return {'stops': 0}
        return {
            'stops': stops.number,
            'last_stop': stops.last.value,
            'last_stop_duration_s': stops.duration(now_ns),
            'last_stop_age_s': stops.age(now_ns),
        }

    def _input_values(self) -> dict[str, object]:
        """Return the gaps and jumps of the odometry, and the gains of the response."""
        monitor = self._odometry_monitor
        gaps = monitor.gaps
        values: dict[str, object] = {
            'odometry_rate_hz': gaps.rate,
            'odometry_gaps': gaps.number,
            'odometry_missing': gaps.missing,
            'odometry_gap_longest_s': gaps.longest,
            'odometry_gap_age_s': gaps.age,
            'odometry_late': monitor.late,
            'odometry_jumps': monitor.jumps,
            'odometry_restarts': gaps.restarts,
        }
        for axis, name in enumerate(NAMES):
            if (gain := monitor.gain(axis)) is not None:
                values[f'{name}_gain'] = gain.value
                values[f'{name}_gain_std'] = gain.deviation
        return values

    def warnings(self) -> list[str]:
        """Return what does not fit in the odometry or in its response to the commands."""
        simulated = self.get_clock().ros_time_is_active
        found = self._odometry_monitor.warnings(
            simulated_time=simulated,
            tolerated_gap=0.5 * self.parameters.watchdog.odometry_timeout,
            geometry=self.parameters.geometry,
            response_time=self._controller.response_time,
        )
        ignored = self._controller.ignored_odometry
        if ignored > self._reported_ignored:
            found.append(
                f'{ignored - self._reported_ignored} messages of odom were ignored: repeated, '
                'overtaken by later ones, or one stamp was further from the others than '
                f'watchdog.odometry_timeout ({self.parameters.watchdog.odometry_timeout:g} s); '
                'one publisher only, with increasing stamps'
            )
        self._reported_ignored = ignored
        if stopped := self._stops.unreported(self.steady_ns()):
            found.insert(0, stopped)
        return found + self._controller.problems()

    def on_shutdown(self) -> None:
        """Publish a zero command and the last row of the journal."""
        stop = self._command_message(STANDSTILL, self.now_ns())
        publish_and_wait_for_acked(self._command_publisher, stop)
        self._journal_message.data = self._journal.finish()
        publish_and_wait_for_acked(self._journal_publisher, self._journal_message)


def _obstacles(parameters: ControllerNodeParameters) -> Obstacles:
    """Return the obstacles that the keep-out knows."""
    if not parameters.keep_out.world:
        return Obstacles()
    from t3mpc_ros.simulation.world import WorldError, load_world

    try:
        return load_world(parameters.keep_out.world).obstacles
    except WorldError as error:
        raise ParameterError(f'keep_out.world: {error}') from error


def _saved_map(parameters: ControllerNodeParameters) -> OccupancyGrid | None:
    """Return the map with which the keep-out begins, if there is one."""
    if not parameters.keep_out.yaml_filename:
        return None
    from t3mpc_ros.geometry.occupancy_map_file import MapError, load_map

    try:
        return load_map(parameters.keep_out.yaml_filename)
    except MapError as error:
        raise ParameterError(f'keep_out.yaml_filename: {error}') from error
