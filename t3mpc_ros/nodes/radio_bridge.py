# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros radio_bridge``: connects the real robot to ROS over the radio link."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
import os
from pathlib import Path
import select
import threading
from typing import Any

from geometry_msgs.msg import Twist, TwistStamped

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.common import conversions, introspection, qos
from t3mpc_ros.nodes.common.base_node import ERROR, OK, WARN, BaseNode
from t3mpc_ros.nodes.common.diagnostics import complaints, measures
from t3mpc_ros.nodes.common.robot_publishers import (
    RobotDescription,
    RobotPublishers,
    RobotTopicParameters,
)
from t3mpc_ros.nodes.common.robot_services import RobotServices
from t3mpc_ros.nodes.common.sensor_messages import count_variance
from t3mpc_ros.parameters.table import group, parameter
from t3mpc_ros.radio.link.port_actions import Close, LinkState, Open, Wait, Write
from t3mpc_ros.radio.link.statistics import DiagnosticLevel, LinkQuality
from t3mpc_ros.radio.link.telemetry import MICROSTEPS, STEPS_PER_REV
from t3mpc_ros.radio.protocol.authentication import read_key
from t3mpc_ros.radio.radio_robot import RadioRobot, RadioRobotParameters
from t3mpc_ros.radio.serial_port import PortError, SerialPort
from t3mpc_ros.robot.interface import RobotCommand, RobotState
from t3mpc_ros.robot.sensor_conversions import (
    BatteryParameters,
    ImuParameters,
    RangeSensorParameters,
)


@dataclass(frozen=True)
class RadioBridgeParameters(RobotTopicParameters, RadioRobotParameters):
    """The real robot, over the radio, as a node."""

    port: str = parameter(
        '/dev/t3mpc_dongle',
        'serial port of the dongle; the udev rule of the package gives it this name, otherwise '
        'one of /dev/serial/by-id',
    )
    key_file: str = parameter(
        '', 'file with the key of the robot (32 hexadecimal digits, yours alone); empty = open'
    )
    imu: ImuParameters = group(ImuParameters)
    range_sensor: RangeSensorParameters = group(RangeSensorParameters)
    battery: BatteryParameters = group(BatteryParameters)


SHUTDOWN_TIMEOUT = 2.0
"""s that the robot is given to come to rest, and its drives to be taken out, at the end."""


class RadioBridgeNode(BaseNode[RadioBridgeParameters]):
    """Carries commands to the robot and its measurements back, and says why it does not move."""

    def __init__(self, **given: Any) -> None:
        super().__init__('radio_bridge', RadioBridgeParameters, **given)
        parameters = self.parameters
        key = read_key(Path(parameters.key_file)) if parameters.key_file else b''
        self._lock = threading.Lock()
        self._robot = RadioRobot(parameters, key)
        self._port: SerialPort | None = None
        self._commands = self._refused = 0
        self._problem = ''
        self._said = 'starting'
        self._topics = RobotPublishers(self, parameters, _robot_description(parameters))
        self._type = TwistStamped if parameters.stamped else Twist
        self.create_subscription(self._type, 'cmd_vel', self._on_command, qos.LATEST)
        RobotServices(self, self._robot, self.steady_ns, self._lock)
        self._waker, self._wake = os.pipe()
        self._courier = threading.Thread(target=self._carry, name='radio', daemon=True)
        self._courier.start()
        if not key:
            self.get_logger().warning('no key_file: anyone with such a radio can drive the robot')

    def configure(self, parameters: RadioBridgeParameters) -> None:
        """Hand live settings on to the robot."""
        with self._lock:
            self._robot.configure(parameters)
        self._topics.configure(parameters, _robot_description(parameters))

    # -- from ROS ---------------------------------------------------------------------------------

    def _on_command(self, message: Twist | TwistStamped) -> None:
        self._commands += 1
        now_ns, steady_ns = self.now_ns(), self.steady_ns()
        twist, stamp_ns = conversions.twist_and_stamp(message, now_ns)
        # The link knows the steady clock only: what counts is how old the command is.
        command = RobotCommand.from_twist(
            twist, self.parameters.geometry, steady_ns - (now_ns - stamp_ns)
        )
        with self._lock:
            problem = self._robot.apply(command, steady_ns)
        if problem:
            self._refused += 1
            if problem != self._problem:
                self.get_logger().warning(f'cmd_vel refused: {problem}', throttle_duration_sec=1.0)
        self._problem = problem

    # -- the port's thread ------------------------------------------------------------------------

    def _carry(self) -> None:
        try:
            received = b''
            while True:
                with self._lock:
                    deeds = self._robot.step(self.steady_ns(), received)
                    states = self._robot.take_states()
                    done = self._robot.link.state is LinkState.DONE
                    reason = self._robot.reason(self.steady_ns())
                self._say(reason)
                until_ns = self.steady_ns()
                for deed in deeds:
                    if isinstance(deed, Wait):
                        until_ns = deed.until_ns
                    else:
                        self._do(deed)
                if any(isinstance(deed, Open) for deed in deeds):
                    until_ns = self.steady_ns()  # it knows by now whether the port is open
                for state in states:
                    self._tell(state)
                if done:
                    return
                received = self._listen(until_ns)
        except Exception as error:  # a dead thread must not look like a robot that stands
            self.get_logger().error(f'the link has failed: {type(error).__name__}: {error}')
            self.exit_code = 1
        finally:
            if self._port is not None:
                self._port.close()

    def _do(self, deed: Open | Write | Close) -> None:
        try:
            if isinstance(deed, Open):
                self._port = SerialPort(self.parameters.port)
                with self._lock:
                    self._robot.link.port_opened(self.steady_ns())
            elif isinstance(deed, Write) and self._port is not None:
                self._port.write(deed.data)
            elif isinstance(deed, Close) and self._port is not None:
                self._port.close()
                self._port = None
        except PortError as error:
            self._lose(error)

    def _listen(self, until_ns: int) -> bytes:
        """Return what arrives before the link wants to be asked again."""
        wait = max(0.0, (until_ns - self.steady_ns()) / NANOSECONDS)
        try:
            sources = [self._waker] if self._port is None else [self._waker, self._port]
            ready, _, _ = select.select(sources, [], [], min(wait, 0.5))
            if self._waker in ready:
                os.read(self._waker, 64)
            return self._port.read() if self._port is not None and self._port in ready else b''
        except PortError as error:
            self._lose(error)
            return b''

    def _lose(self, error: PortError) -> None:
        self._port = None
        with self._lock:
            self._robot.link.port_failed(str(error), error.absent, self.steady_ns())

    def _tell(self, state: RobotState) -> None:
        """Publish a state with stamps of ROS's clock instead of the link's."""
        stamp_ns = state.stamp_ns + self.now_ns() - self.steady_ns()
        motion = state.odometry._replace(stamp_ns=stamp_ns)
        self._topics.publish(state._replace(stamp_ns=stamp_ns, odometry=motion))

    def _say(self, reason: str) -> None:
        if reason != self._said:
            self._said = reason
            self.get_logger().info(reason or 'following commands')

    # -- how it is --------------------------------------------------------------------------------

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether the robot follows commands, how well the link works, and if not why."""
        now_ns = self.steady_ns()
        with self._lock:
            state, link = self._robot.advance(now_ns), self._robot.link
            well = self._robot.quality(now_ns)
            phase, signed = link.state, link.authenticated
        values: dict[str, object] = {
            'port': self.parameters.port,
            'link': phase.value,
            'authenticated': signed,
            'commands': self._commands,
            'commands_refused': self._refused,
            **_link_values(well),
            **measures(state, None),
        }
        if phase is not LinkState.RUN or state.status.estop:
            return ERROR, state.reason or phase.value, values
        if well.level is DiagnosticLevel.ERROR:
            return ERROR, well.text, values
        if other := introspection.mismatched_type(self, 'cmd_vel', self._type, subscribers=False):
            return WARN, f'cmd_vel is published as {other} by another node: set stamped', values
        found = [*complaints(state, None), *([well.text] if well.text else [])]
        if found:
            return WARN, '; '.join(found), values
        open_link = '' if signed else ', unauthenticated'
        return OK, f'following commands{open_link}', values

    def finish(self) -> None:
        """Stop the robot: standstill three times, then its drives are taken out."""
        with self._lock:
            self._robot.shut_down()
        os.write(self._wake, b'.')
        self._courier.join(SHUTDOWN_TIMEOUT)


def _robot_description(parameters: RadioBridgeParameters) -> RobotDescription:
    """Return what the robot of these settings is like."""
    rate = parameters.link.cycle_rate
    variance = count_variance(math.tau / (STEPS_PER_REV * MICROSTEPS), 1.0 / rate)
    sensors = parameters.imu, parameters.range_sensor, parameters.battery
    return RobotDescription(rate, parameters.geometry, variance, sensors)


def _link_values(well: LinkQuality) -> Mapping[str, object]:
    """Return the link in numbers."""
    return {
        'cycles': well.cycles,
        'cycles_lost': well.lost,
        'lost_share': well.lost_share,
        'round_trip_median_ms': 1e3 * well.round_trip_median,
        'round_trip_p99_ms': 1e3 * well.round_trip_p99,
        'telemetry_age_s': well.age,
        'robot_resets': well.robot_resets,
        'dongle_resets': well.dongle_resets,
        'sessions': well.sessions,
        'port_failures': well.port_failures,
        'crc_errors': well.host.crc_errors,
        'frame_errors': well.host.frame_errors,
    }


def make() -> list[RadioBridgeNode]:
    """Return the nodes of this process."""
    return [RadioBridgeNode()]
