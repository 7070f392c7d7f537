# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros reference_generator``: publishes the chaotic reference."""

from collections.abc import Mapping
from dataclasses import dataclass
import secrets
from typing import Any

from nav_msgs.msg import Odometry, Path
from std_msgs.msg import Int32MultiArray
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceParameters
from t3mpc_ros.chaos.seed_fingerprint import FINGERPRINT_KEY, SALT_BYTES, fingerprint_seed
from t3mpc_ros.geometry.kinematics import WheelGeometry, advance_pose
from t3mpc_ros.geometry.timing import SampleScheduler
from t3mpc_ros.geometry.types import NANOSECONDS, ORIGIN, STANDSTILL, State
from t3mpc_ros.nodes.common import conversions, qos
from t3mpc_ros.nodes.common.base_node import ACK_TIMEOUT, NO_CLOCK, OK, WARN, BaseNode
from t3mpc_ros.nodes.common.frame_prefix import FrameParameters
from t3mpc_ros.parameters.table import ParameterError, group, parameter

CONFIGURATION_ERRORS: tuple[type[Exception], ...] = ()
"""Errors of :func:`make` other than :class:`ParameterError`."""

PATH_PERIOD = 0.1
"""Time between the poses of ``reference/path``, s."""
SEED_BITS = 128
"""Length of a secret seed."""


@dataclass(frozen=True)
class ReferenceGeneratorParameters(ReferenceParameters):
    """Parameters of the reference generator node."""

    lead: float = parameter(
        0.4,
        'lead time: how far in the future the reference is stamped, so that its value at the '
        'present time does not depend on message delays',
        unit='s',
        low=0.0,
        high=10.0,
    )
    secret_seed: bool = parameter(
        False,
        'draw the seed from the operating system, so that the path of the robot is not '
        'predictable; only a fingerprint of the seed is published',
    )
    frame_id: str = parameter('odom', 'frame of the reference pose')
    child_frame_id: str = parameter('base_link', 'frame of the reference twist')
    frames: FrameParameters = group(FrameParameters, inline=True)
    path_points: int = parameter(
        600,
        'maximum number of poses in reference/path (one every 0.1 s); 0 = no path',
        low=0,
        high=100_000,
    )
    geometry: WheelGeometry = group(WheelGeometry, inline=True)

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` if both a secret and a public seed are set."""
        super().check_consistency()
        if self.secret_seed and self.seed:
            raise ParameterError(f'seed must be 0 with secret_seed: got {self.seed}')


class ReferenceGeneratorNode(BaseNode[ReferenceGeneratorParameters]):
    """Publishes the reference on an exact time grid, stamped ahead by the lead time."""

    def __init__(self, **options: Any) -> None:
        super().__init__('reference_generator', ReferenceGeneratorParameters, **options)
        parameters = self.parameters
        # A secret seed is never a parameter value, log text or diagnostic value: it determines
        # the path of the robot. The diagnostics hold its fingerprint, which the recorder stores.
        self._seed = _random_seed() if parameters.secret_seed else parameters.seed
        self._fingerprint = fingerprint_seed(self._seed, secrets.token_bytes(SALT_BYTES))
        self._generator = ChaoticReference(parameters, parameters.geometry)
        self._generator.advance()  # compile here, not within a step
        self._generator.reset(self._seed)
        self._scheduler = SampleScheduler(parameters.rate, slack=0.2 / parameters.rate)
        self._lead_ns = round(parameters.lead * NANOSECONDS)
        self._paused = False
        self._pose = ORIGIN
        self._path = Path()
        frame, child = (
            parameters.frames.prefixed(name, self.get_namespace())
            for name in (parameters.frame_id, parameters.child_frame_id)
        )
        self._path.header.frame_id = frame
        message = Odometry(child_frame_id=child)
        message.header.frame_id = frame
        self._serialized = conversions.SerializedOdometry(message)
        self._reference_publisher = self.create_publisher(Odometry, 'reference', qos.STREAM)
        self._path_publisher = self.create_publisher(Path, 'reference/path', qos.LATCHED)
        self._signals_publisher = self.create_publisher(
            Int32MultiArray, 'reference/signals', qos.LATCHED
        )
        self._signals: tuple[int, ...] = ()
        self.create_service(Trigger, '~/reseed', self._on_reseed)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.create_steady_timer(1.0 / parameters.rate, self._on_timer)
        self.create_steady_timer(1.0, self._publish_path)

    def _on_timer(self) -> None:
        if not self.clock_started():
            return
        for stamp_ns in self._scheduler.due(self.now_ns()):
            self._publish(stamp_ns + self._lead_ns)

    def _publish(self, stamp_ns: int) -> None:
        twist = STANDSTILL
        if not self._paused:
            sample = self._generator.advance()
            twist = sample.twist
            self._publish_signals((sample.mode, *sample.selected))
            if sample.index % max(1, round(PATH_PERIOD * self.parameters.rate)) == 0:
                self._append_to_path(State(stamp_ns, self._pose, twist))
        state = State(stamp_ns, self._pose, twist)
        self._reference_publisher.publish(self._serialized.with_state(state))
        self._pose = advance_pose(self._pose, twist, 1.0 / self.parameters.rate)

    def _publish_signals(self, signals: tuple[int, ...]) -> None:
        """Publish the mode and the numbers of its two signals when they change."""
        if signals != self._signals:
            self._signals = signals
            self._signals_publisher.publish(Int32MultiArray(data=list(signals)))

    def _append_to_path(self, state: State) -> None:
        if self.parameters.path_points:
            self._path.poses.append(conversions.pose_stamped(state, self._path.header.frame_id))
            del self._path.poses[: -self.parameters.path_points]

    def _publish_path(self) -> None:
        if self._path.poses:
            self._path.header.stamp = self.get_clock().now().to_msg()
            self._path_publisher.publish(self._path)

    def _on_reseed(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._seed = _random_seed() if self.parameters.secret_seed else self._seed + 1
        self._fingerprint = fingerprint_seed(self._seed, secrets.token_bytes(SALT_BYTES))
        self._generator.reset(self._seed)
        response.success = True
        response.message = 'the reference restarts with another seed'
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = request.data
        response.success = True
        response.message = 'reference paused' if request.data else 'reference resumed'
        return response

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return the state of the reference; a warning if samples were skipped."""
        values = {
            'lateness_s': self._scheduler.lateness(self.now_ns()),
            'skipped_samples': self._scheduler.skipped,
            'mode': self._signals[0] if self._signals else 'none',
            FINGERPRINT_KEY: self._fingerprint,
        }
        if not self.clock_started():
            return WARN, NO_CLOCK, values
        if self._scheduler.skipped:
            return WARN, 'processor overloaded: samples were skipped', values
        return OK, 'paused' if self._paused else 'running', values

    def on_shutdown(self) -> None:
        """Wait until all subscribers have the last sample."""
        self._reference_publisher.wait_for_all_acked(ACK_TIMEOUT)


def _random_seed() -> int:
    """Return a seed from the operating system's random number generator."""
    return secrets.randbits(SEED_BITS)


def make() -> list[ReferenceGeneratorNode]:
    """Return the nodes of this process."""
    return [ReferenceGeneratorNode()]
