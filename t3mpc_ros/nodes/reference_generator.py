# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros reference_generator``: publishes the switching fractional-order chaotic reference."""

from collections.abc import Mapping
from dataclasses import dataclass
import secrets
from typing import Any

from nav_msgs.msg import Odometry, Path
from rclpy.duration import Duration
from std_msgs.msg import Int32MultiArray
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceParameters
from t3mpc_ros.chaos.seed_fingerprint import FINGERPRINT_KEY, SALT_BYTES, fingerprint_seed
from t3mpc_ros.geometry.kinematics import WheelGeometry, advance_pose
from t3mpc_ros.geometry.timing import SampleScheduler
from t3mpc_ros.geometry.types import NANOSECONDS, ORIGIN, STANDSTILL, State
from t3mpc_ros.nodes.common import conversions, qos
from t3mpc_ros.nodes.common.base_node import NO_CLOCK, OK, WARN, BaseNode
from t3mpc_ros.parameters.table import ParameterError, group, parameter


@dataclass(frozen=True)
class ReferenceNodeParameters(ReferenceParameters):
    """The reference generator as a node."""

    lead: float = parameter(
        0.4,
        'how far ahead of now the reference is stamped, so that its value now never depends on '
        'when a message arrives',
        unit='s',
        low=0.0,
        high=10.0,
    )
    secret_seed: bool = parameter(
        False,
        'draw the seed from the operating system, so that nobody can know beforehand where the '
        'robot will go; it is told nowhere, only a fingerprint of it is',
    )
    frame_id: str = parameter('odom', 'frame of the reference pose')
    child_frame_id: str = parameter('base_link', 'frame of the reference twist')
    path_points: int = parameter(
        600, 'most poses in reference/path (one every 0.1 s); 0 = no path', low=0, high=100_000
    )
    geometry: WheelGeometry = group(WheelGeometry, inline=True)

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for a secret seed beside one that all can read."""
        super().check_consistency()
        if self.secret_seed and self.seed:
            raise ParameterError(f'seed must be 0 with secret_seed: got {self.seed}')


PATH_PERIOD = 0.1
"""Seconds between the poses of ``reference/path``."""
SEED_BITS = 128


class ReferenceGeneratorNode(BaseNode[ReferenceNodeParameters]):
    """Publishes the wanted motion on an exact grid of time, stamped ahead by the lead time."""

    def __init__(self, **given: Any) -> None:
        super().__init__('reference', ReferenceNodeParameters, **given)
        parameters = self.parameters
        # Never a parameter, a log line or a diagnosis when it is secret: who knows it knows where
        # the robot will go. The fingerprint is in the diagnostics, where the recorder finds it.
        self._seed = _random_seed() if parameters.secret_seed else parameters.seed
        self._fingerprint = fingerprint_seed(self._seed, secrets.token_bytes(SALT_BYTES))
        self._generator = ChaoticReference(parameters, parameters.geometry)
        self._generator.advance()  # compile now, never inside a step
        self._generator.reset(self._seed)
        self._pace = SampleScheduler(parameters.rate, slack=0.2 / parameters.rate)
        self._lead_ns = round(parameters.lead * NANOSECONDS)
        self._paused = False
        self._pose = ORIGIN
        self._path = Path()
        self._path.header.frame_id = parameters.frame_id
        self._message = Odometry(child_frame_id=parameters.child_frame_id)
        self._message.header.frame_id = parameters.frame_id
        self._reference = self.create_publisher(Odometry, 'reference', qos.CONTROLLER_INPUT)
        self._trail = self.create_publisher(Path, 'reference/path', qos.LATCHED)
        self._signals = self.create_publisher(Int32MultiArray, '~/signals', qos.LATCHED)
        self._shown: tuple[int, ...] = ()
        self.create_service(Trigger, '~/reseed', self._on_reseed)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.every(1.0 / parameters.rate, self._on_tick)
        self.every(1.0, self._publish_path)

    def _on_tick(self) -> None:
        if not self.clock_received():
            return
        for stamp_ns in self._pace.due(self.now_ns()):
            self._publish(stamp_ns + self._lead_ns)

    def _publish(self, stamp_ns: int) -> None:
        twist = STANDSTILL
        if not self._paused:
            sample = self._generator.advance()
            twist = sample.twist
            self._show((sample.mode, *sample.selected))
            if sample.index % max(1, round(PATH_PERIOD * self.parameters.rate)) == 0:
                self._remember(State(stamp_ns, self._pose, twist))
        motion = State(stamp_ns, self._pose, twist)
        self._reference.publish(conversions.fill_odometry(self._message, motion))
        self._pose = advance_pose(self._pose, twist, 1.0 / self.parameters.rate)

    def _show(self, signals: tuple[int, ...]) -> None:
        if signals != self._shown:
            self._shown = signals
            self._signals.publish(Int32MultiArray(data=list(signals)))

    def _remember(self, motion: State) -> None:
        if self.parameters.path_points:
            self._path.poses.append(conversions.pose_stamped(motion, self.parameters.frame_id))
            del self._path.poses[: -self.parameters.path_points]

    def _publish_path(self) -> None:
        if self._path.poses:
            self._path.header.stamp = self.get_clock().now().to_msg()
            self._trail.publish(self._path)

    def _on_reseed(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._seed = _random_seed() if self.parameters.secret_seed else self._seed + 1
        self._fingerprint = fingerprint_seed(self._seed, secrets.token_bytes(SALT_BYTES))
        self._generator.reset(self._seed)
        response.success = True
        response.message = 'the reference starts anew with another seed'
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = request.data
        response.success = True
        response.message = (
            'the reference stands still' if request.data else 'the reference goes on'
        )
        return response

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether samples had to be given up, and where the run stands."""
        values = {
            'lateness_s': self._pace.lateness(self.now_ns()),
            'skipped_samples': self._pace.skipped,
            'mode': self._shown[0] if self._shown else 'none',
            FINGERPRINT_KEY: self._fingerprint,
        }
        if not self.clock_received():
            return WARN, NO_CLOCK, values
        if self._pace.skipped:
            return WARN, 'the machine is too slow: samples were given up', values
        return OK, 'paused' if self._paused else 'running', values

    def finish(self) -> None:
        """Wait until everybody has the last sample."""
        self._reference.wait_for_all_acked(Duration(nanoseconds=200_000_000))


def _random_seed() -> int:
    """Return a seed from the operating system that cannot be guessed."""
    return secrets.randbits(SEED_BITS)


def make() -> list[ReferenceGeneratorNode]:
    """Return the nodes of this process."""
    return [ReferenceGeneratorNode()]
