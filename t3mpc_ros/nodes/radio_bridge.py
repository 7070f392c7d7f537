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
"""``ros2 run t3mpc_ros radio_bridge``: connects the real robot to ROS over the radio link.

A thread of its own serves the serial port: telemetry is read when it arrives and commands are
sent on time, whatever the executor does. All decisions are in :mod:`t3mpc_ros.radio.radio_robot`;
the thread only moves bytes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
import math
import os
from pathlib import Path
import select
import threading
from typing import Any, ClassVar

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.base_node import ERROR, OK, WARN
from t3mpc_ros.nodes.robot_messages import (
    FOLLOWING,
    RobotDescription,
    RobotTopicParameters,
    count_variance,
    state_values,
    state_warnings,
)
from t3mpc_ros.nodes.robot_node import RobotNode
from t3mpc_ros.parameters.table import group, parameter
from t3mpc_ros.radio.link.actions_and_states import Close, LinkState, Open, Wait, Write
from t3mpc_ros.radio.link.standstill_reasons import ROBOT_USB
from t3mpc_ros.radio.link.statistics import DiagnosticLevel, LinkQuality
from t3mpc_ros.radio.link.telemetry import MICROSTEPS, STEPS_PER_REV
from t3mpc_ros.radio.protocol.authentication import KeyFileError, read_key
from t3mpc_ros.radio.radio_robot import RadioRobot, RadioRobotParameters
from t3mpc_ros.radio.serial_port import PortError, SerialPort, find_ports
from t3mpc_ros.robot.interface import RobotState
from t3mpc_ros.robot.sensor_parameters import (
    BatteryParameters,
    ImuParameters,
    RangeSensorParameters,
)

SHUTDOWN_TIMEOUT = 2.0
"""Maximum time to stop the robot and to disable its drives at shutdown, s."""

MAX_WAIT = 0.5
"""Maximum time of one wait for the port, s."""

MAX_WRITE_DELAY_NS = NANOSECONDS // 20
"""Age at which a frame is discarded instead of written: the process was suspended."""


@dataclass(frozen=True)
class RadioBridgeParameters(RobotTopicParameters, RadioRobotParameters):
    """Parameters of the radio bridge node."""

    port: str = parameter(
        '/dev/t3mpc_dongle*',
        'serial port of the dongle, or a pattern: of several ports, the one that answers as a '
        'dongle is used. The only port may be that of the robot board, which then drives over '
        'its cable. The default are the names that the udev rule of the package sets',
    )
    key_file: str = parameter(
        '',
        'file with the key of the robot (32 hexadecimal digits), readable by its owner only; '
        'empty = no authentication',
    )
    imu: ClassVar[ImuParameters] = ImuParameters()
    """The board sets its registers; here for the covariances of imu/data_raw."""
    range_sensor: RangeSensorParameters = group(RangeSensorParameters)
    battery: BatteryParameters = group(BatteryParameters)


class RadioBridgeNode(RobotNode[RadioBridgeParameters]):
    """Sends commands to the robot and publishes its telemetry."""

    parameter_class = RadioBridgeParameters
    configuration_errors = (KeyFileError,)

    def __init__(self, **options: Any) -> None:
        super().__init__('radio_bridge', **options)
        parameters = self.parameters
        key = read_key(Path(parameters.key_file)) if parameters.key_file else b''
        self.hardware_id = parameters.port
        self._port: SerialPort | None = None
        self._path = parameters.port
        self._choice = 0
        """Number of the port to open next, among those of the pattern."""
        self.connect(RadioRobot(parameters, key))
        self._wake_read, self._wake_write = os.pipe()
        self._port_thread = threading.Thread(target=self._serve_port, name='radio', daemon=True)
        self._port_thread.start()
        if not key:
            self.get_logger().warning(
                'no key_file: the link is not authenticated, any such radio can drive the robot'
            )

    def robot_ns(self) -> int:
        """Return the time of the link, ns."""
        return self.steady_ns()

    def describe(self, parameters: RadioBridgeParameters) -> RobotDescription:
        """Return the properties of the real robot."""
        rate = parameters.link.cycle_rate
        variance = count_variance(math.tau / (STEPS_PER_REV * MICROSTEPS), 1.0 / rate)
        sensors = parameters.imu, parameters.range_sensor, parameters.battery
        return RobotDescription(rate, parameters.geometry, variance, sensors)

    # -- thread of the serial port ----------------------------------------------------------------

    def _serve_port(self) -> None:
        try:
            received, reported = b'', ''
            while True:
                with self._lock:
                    # Within the lock: a command of the other thread is not later than this time.
                    step_ns = self.steady_ns()
                    actions = self._robot.step(step_ns, received)
                    states = self._robot.take_states()
                    done = self._robot.link.state is LinkState.DONE
                    reason = self._robot.reason(self.steady_ns())
                    restart = self._robot.restart(step_ns)
                self._log_reason(reason)
                if restart and restart != reported:
                    self.get_logger().warning(restart)
                reported = restart
                if reason == ROBOT_USB and self._port is not None and len(self._ports()) > 1:
                    self._port.close()
                    self._choice += 1
                    self._on_port_error(PortError(reason, absent=True))
                    continue
                until_ns = self.steady_ns()
                for action in actions:
                    if isinstance(action, Wait):
                        until_ns = action.until_ns
                    else:
                        self._execute(action, step_ns)
                if any(isinstance(action, Open) for action in actions):
                    until_ns = self.steady_ns()  # the result of opening the port is known
                for state in states:
                    self._publish(state)
                if done:
                    return
                received = self._read_until(until_ns)
        except Exception as error:  # a silent thread would look like a robot at rest
            self.get_logger().error(f'the radio link failed: {type(error).__name__}: {error}')
            self.exit_code = 1
        finally:
            if self._port is not None:
                self._port.close()

    def _execute(self, action: Open | Write | Close, step_ns: int) -> None:
        try:
            if isinstance(action, Open):
                ports = self._ports()
                self._path = ports[self._choice % len(ports)]
                self._port = SerialPort(self._path)
                with self._lock:
                    # Of several ports, that of a dongle is meant.
                    self._robot.link.port_opened(self.steady_ns(), cable=len(ports) == 1)
            elif isinstance(action, Write) and self._port is not None:
                if self.steady_ns() - step_ns <= MAX_WRITE_DELAY_NS:
                    self._port.write(action.data)
            elif isinstance(action, Close) and self._port is not None:
                self._port.close()
                self._port = None
                self._choice += 1
        except PortError as error:
            self._on_port_error(error)

    def _ports(self) -> list[str]:
        return find_ports(self.parameters.port)

    def _read_until(self, until_ns: int) -> bytes:
        """Return the bytes that arrive before the next step of the link is due."""
        wait = max(0.0, (until_ns - self.steady_ns()) / NANOSECONDS)
        try:
            sources = [self._wake_read] if self._port is None else [self._wake_read, self._port]
            ready, _, _ = select.select(sources, [], [], min(wait, MAX_WAIT))
            if self._wake_read in ready:
                os.read(self._wake_read, 64)
            return self._port.read() if self._port is not None and self._port in ready else b''
        except PortError as error:
            self._on_port_error(error)
            return b''

    def _on_port_error(self, error: PortError) -> None:
        self._port = None
        with self._lock:
            self._robot.link.port_failed(str(error), error.absent, self.steady_ns())

    def _publish(self, state: RobotState) -> None:
        """Publish a state with stamps of the node's clock instead of the steady clock."""
        stamp_ns = state.stamp_ns + self.now_ns() - self.steady_ns()
        odometry = state.odometry._replace(stamp_ns=stamp_ns)
        self.publish_state(state._replace(stamp_ns=stamp_ns, odometry=odometry))

    # -- diagnostics and shutdown -----------------------------------------------------------------

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether the robot follows commands, the reason if not, and the link quality."""
        with self._lock:
            now_ns = self.steady_ns()
            state, link = self._robot.advance(now_ns), self._robot.link
            quality = self._robot.quality(now_ns)
            restart, unknown = self._robot.restart(now_ns), self._robot.unknown_travel
            link_state, authenticated = link.state, link.authenticated
            cable = link.over_cable
        values: dict[str, object] = {
            'port': self._path,
            'link': link_state.value,
            'path': 'cable' if cable else 'radio',
            'authenticated': authenticated,
            **self._command_values(),
            **_link_values(quality),
            'unknown_travel_m': unknown,
            **state_values(state),
        }
        if link_state is not LinkState.RUN or state.status.estop:
            return ERROR, state.reason or link_state.value, values
        if quality.level is DiagnosticLevel.ERROR:
            return ERROR, quality.text, values
        found = [*state_warnings(state, command_problem=self._command_problem)]
        found += filter(None, (restart, self._command_type_problem(), quality.text))
        if found:
            return WARN, '; '.join(found), values
        where, unsigned = ', over the cable' * cable, ', unauthenticated' * (not authenticated)
        return OK, f'{FOLLOWING}{where}{unsigned}', values

    def on_shutdown(self) -> None:
        """Stop the robot: three standstill commands, then disable its drives."""
        with self._lock:
            self._robot.shut_down()
        os.write(self._wake_write, b'.')
        self._port_thread.join(SHUTDOWN_TIMEOUT)
        if not self._port_thread.is_alive():
            os.close(self._wake_read)
            os.close(self._wake_write)


def _link_values(quality: LinkQuality) -> Mapping[str, object]:
    """Return the link statistics by diagnostic key."""
    return {
        'cycles': quality.cycles,
        'cycles_lost': quality.lost,
        'lost_share': quality.lost_share,
        'round_trip_median_ms': 1e3 * quality.round_trip_median,
        'round_trip_p99_ms': 1e3 * quality.round_trip_p99,
        'telemetry_age_s': quality.age,
        'robot_resets': quality.robot_resets,
        'dongle_resets': quality.dongle_resets,
        'sessions': quality.sessions,
        'address_collisions': quality.collisions,
        'port_failures': quality.port_failures,
        **{f'cycles_lost_{hop.name.lower()}': count for hop, count in quality.losses.items()},
        'damaged_frames_host': quality.cable_errors.host,
        'damaged_frames_dongle': quality.cable_errors.dongle,
        'crc_errors': quality.host.crc_errors,
        'frame_errors': quality.host.frame_errors,
    }
