# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros controller``: subscribes to ``reference`` and ``odom``, publishes ``cmd_vel``."""

from array import array
from collections.abc import Mapping
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any
import zlib

from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.publisher import Publisher
from std_msgs.msg import Float64, Int64MultiArray, String
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.bag.run.journal import Journal, parameters_to_json
from t3mpc_ros.bag.run.model_file import ModelError, load_model, save_model
from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.control.controller import Controller, ControllerParameters, Status
from t3mpc_ros.control.speed_filter import SpeedFilterParameters
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.geometry.types import STANDSTILL, BodyTwist
from t3mpc_ros.nodes.common import conversions, introspection, qos
from t3mpc_ros.nodes.common.base_node import ERROR, OK, WARN, BaseNode, publish_and_wait_for_acked
from t3mpc_ros.parameters.table import group, parameter


@dataclass(frozen=True)
class ControllerNodeParameters(ControllerParameters):
    """The controller as a node."""

    # A stepper's rotor follows its field at once; the lag of 0.02 s is that of the servo.
    speed_filter: SpeedFilterParameters = group(SpeedFilterParameters, lag=0.003)
    stamped: bool = parameter(False, 'publish cmd_vel as TwistStamped instead of Twist')
    frame_id: str = parameter('base_link', 'frame of a stamped command')
    terms_rate: float = parameter(
        20.0,
        'how often the plain numbers (~/error, ~/estimate, ~/terms, ~/lyapunov, ~/skill) are '
        'published; 0 turns them off',
        unit='Hz',
        low=0.0,
        high=1000.0,
    )
    model: str = parameter('', 'model file to start from; empty = learn from nothing')
    model_output: str = parameter('controller_model.npz', 'file that ~/save_model writes')


WHEELS = ('right', 'left')


class ControllerNode(BaseNode[ControllerNodeParameters]):
    """Publishes the controller's command each time the robot reports its motion."""

    def __init__(self, **given: Any) -> None:
        super().__init__('controller', ControllerNodeParameters, **given)
        self.get_logger().info('preparing (the first start compiles, for half a minute)')
        self._controller = Controller(self.parameters)
        self._controller.warm_up()  # compile and pre-train now, never inside a step
        self._journal = Journal()
        self._rows = self.create_publisher(Int64MultiArray, '~/journal', qos.JOURNAL)
        self._row = Int64MultiArray(data=self._journal.row)
        self._revisions = self.create_publisher(String, '~/settings', qos.PARAMETER_REVISIONS)
        self._tell_settings()
        self._load_model()
        self._heard_ns: int | None = None
        self._steps = 0
        self._refused = 0
        self._said = self._controller.status.reason
        self._type = TwistStamped if self.parameters.stamped else Twist
        self._command = self.create_publisher(self._type, 'cmd_vel', qos.COMMAND)
        self._numbers = self._number_publishers() if self.parameters.terms_rate else {}
        self.create_subscription(Odometry, 'reference', self._on_reference, qos.STREAM)
        self.create_subscription(Odometry, 'odom', self._on_odometry, qos.STREAM)
        self.create_service(SetBool, '~/enable', self._on_enable)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(Trigger, '~/save_model', self._on_save_model)
        self.every(0.05, self._on_watch)

    def _load_model(self) -> None:
        path = self.parameters.model
        if not path:
            return
        try:
            self._controller.law.set_weights(load_model(Path(path)))
        except ValueError as error:
            raise ModelError(f'{path} does not fit these settings: {error}') from error
        self._note(self._journal.model(zlib.crc32(Path(path).read_bytes())))

    def configure(self, parameters: ControllerNodeParameters) -> None:
        """Hand live settings on to the controller."""
        self._controller.configure(parameters)
        row = self._journal.configure()
        self._tell_settings()
        self._note(row)

    def _tell_settings(self) -> None:
        text = parameters_to_json(self._journal.revision, self.parameters.to_dict())
        self._revisions.publish(String(data=text))

    def _note(self, row: 'array[int]') -> None:
        """Publish a row of the journal: after the command, which cannot wait."""
        self._row.data = row
        self._rows.publish(self._row)

    def _on_reference(self, message: Odometry) -> None:
        motion = conversions.state_from_odometry(message)
        self._journal.reference(motion.stamp_ns)
        if not self._controller.add_reference(motion):
            self._refused += 1

    def _on_odometry(self, message: Odometry) -> None:
        self._heard_ns = self.steady_ns()
        measured = conversions.state_from_odometry(message)
        command, status = self._controller.step(measured)
        self._publish(command, status.stamp_ns)
        self._note(self._journal.step(measured.stamp_ns))
        self._steps += 1
        if self._numbers and self._steps % self._every_step() == 0:
            self._publish_numbers(status)
        self._tell(status)

    def _on_watch(self) -> None:
        if self._heard_ns is None:
            return
        if self._controller.check_odometry(self._heard_ns, self.steady_ns()):
            self._publish(STANDSTILL, self.now_ns())
            self._note(self._journal.silent(self._controller.status.stamp_ns))
            self._tell(self._controller.status)

    def _publish(self, command: BodyTwist, stamp_ns: int) -> None:
        if self.parameters.stamped:
            message = conversions.stamped_twist(command, stamp_ns, self.parameters.frame_id)
        else:
            message = conversions.twist_from_body(command)
        self._command.publish(message)

    def _tell(self, status: Status) -> None:
        if status.reason is not self._said:
            self._said = status.reason
            self.get_logger().info(status.reason.value)

    def _every_step(self) -> int:
        return max(1, round(self.parameters.rate / self.parameters.terms_rate))

    def _number_publishers(self) -> dict[str, Publisher]:
        wheels = [
            f'{name}/{wheel}'
            for name in (
                'error',
                'estimate',
                'skill',
                'terms/applied',
                *map('terms/{}'.format, TERM_NAMES),
            )
            for wheel in WHEELS
        ]
        names = [*wheels, 'lyapunov/value', 'lyapunov/margin']
        return {name: self.create_publisher(Float64, f'~/{name}', qos.SCALARS) for name in names}

    def _publish_numbers(self, status: Status) -> None:
        for i, wheel in enumerate(WHEELS):
            self._number(f'error/{wheel}', status.error[i])
            self._number(f'estimate/{wheel}', status.estimate[i])
            self._number(f'skill/{wheel}', status.skill[i])
            self._number(f'terms/applied/{wheel}', status.applied[i])
            for row, term in enumerate(TERM_NAMES):
                self._number(f'terms/{term}/{wheel}', status.terms[row, i])
        self._number('lyapunov/value', status.certificate.value)
        self._number('lyapunov/margin', status.certificate.margin)

    def _number(self, name: str, value: float) -> None:
        if math.isfinite(value):  # an error without a reference is no number to plot
            self._numbers[name].publish(Float64(data=float(value)))

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._controller.enable(request.data)
        self._note(self._journal.enable(request.data))
        response.success = True
        response.message = 'the robot may move' if request.data else 'the robot is stopped'
        return response

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._controller.reset()
        self._note(self._journal.reset())
        response.success = True
        response.message = 'everything learnt in this run is forgotten'
        return response

    def _on_save_model(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        path = Path(self.parameters.model_output)
        try:
            save_model(path, self._controller.law.get_weights(), self.parameters.to_dict())
        except ModelError as error:
            response.success = False
            response.message = str(error)
        else:
            response.success = True
            response.message = f'saved {path.resolve()}'
        return response

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether the robot may move, and if not why not."""
        status = self._controller.status
        values = {
            'reason': status.reason.value,
            'steps': self._steps,
            'limited': status.limited,
            'certificate_margin': status.certificate.margin,
            'certificate_holds': status.certificate.holds,
            'ultimate_bound_rad_s': self._controller.law.ultimate_bound,
            'skill_right': float(status.skill[0]),
            'skill_left': float(status.skill[1]),
            'references_refused': self._refused,
        }
        waiting = self._steps == 0
        stopped = f'stopped: {status.reason.value}'
        if not status.reason.moves and not waiting:
            return ERROR, stopped, values
        if other := introspection.mismatched_type(self, 'cmd_vel', self._type, subscribers=True):
            return WARN, f'cmd_vel is taken as {other} by another node: set stamped', values
        if waiting:
            return WARN, stopped, values
        if status.reason is Reason.NOT_FOLLOWING:
            return WARN, status.reason.value, values
        if self._refused:
            return WARN, 'references that are not finite were ignored', values
        return OK, status.reason.value, values

    def finish(self) -> None:
        """Stop the robot."""
        publish_and_wait_for_acked(self._command, self._stop_message())
        self._row.data = self._journal.finish()
        publish_and_wait_for_acked(self._rows, self._row)

    def _stop_message(self) -> Twist | TwistStamped:
        if self.parameters.stamped:
            return conversions.stamped_twist(STANDSTILL, self.now_ns(), self.parameters.frame_id)
        return conversions.twist_from_body(STANDSTILL)


def make() -> list[ControllerNode]:
    """Return the nodes of this process."""
    return [ControllerNode()]
