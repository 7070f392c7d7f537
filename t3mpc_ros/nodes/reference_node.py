# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``ros2 run t3mpc_ros reference``: publishes the switching chaotic reference."""

from collections.abc import Mapping
import secrets
from typing import Any

from nav_msgs.msg import Odometry, Path
from rclpy.duration import Duration
from std_msgs.msg import Int32MultiArray
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.chaos.reference import ChaoticReference
from t3mpc_ros.motion import Motion
from t3mpc_ros.motion.kinematics import advance_pose
from t3mpc_ros.motion.pace import Pace
from t3mpc_ros.motion.words import NANOSECONDS, ORIGIN, STANDSTILL
from t3mpc_ros.nodes.plumbing import convert, quality
from t3mpc_ros.nodes.plumbing.package_node import NO_TIME, OK, WARN, PackageNode
from t3mpc_ros.nodes.tables import ReferenceNodeSettings
from t3mpc_ros.settings.fingerprint import KEY, SALT_BYTES, fingerprint

PATH_STEP = 0.1
"""Seconds between the poses of ``reference/path``."""
SEED_BITS = 128


class ReferenceNode(PackageNode[ReferenceNodeSettings]):
    """Publishes the wanted motion on an exact grid of time, stamped ahead by the lead time."""

    def __init__(self, **given: Any) -> None:
        super().__init__('reference', ReferenceNodeSettings, **given)
        settings = self.settings
        # Never a parameter, a log line or a diagnosis when it is secret: who knows it knows where
        # the robot will go. The fingerprint is in the diagnostics, where the recorder finds it.
        self._seed = _draw() if settings.secret_seed else settings.seed
        self._fingerprint = fingerprint(self._seed, secrets.token_bytes(SALT_BYTES))
        self._generator = ChaoticReference(settings, settings.geometry)
        self._generator.advance()  # compile now, never inside a step
        self._generator.reset(self._seed)
        self._pace = Pace(settings.rate, slack=0.2 / settings.rate)
        self._lead_ns = round(settings.lead * NANOSECONDS)
        self._paused = False
        self._pose = ORIGIN
        self._path = Path()
        self._path.header.frame_id = settings.frame_id
        self._message = Odometry(child_frame_id=settings.child_frame_id)
        self._message.header.frame_id = settings.frame_id
        self._reference = self.create_publisher(Odometry, 'reference', quality.INPUT)
        self._trail = self.create_publisher(Path, 'reference/path', quality.LATCHED)
        self._signals = self.create_publisher(Int32MultiArray, '~/signals', quality.LATCHED)
        self._shown: tuple[int, ...] = ()
        self.create_service(Trigger, '~/reseed', self._on_reseed)
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.every(1.0 / settings.rate, self._on_tick)
        self.every(1.0, self._publish_path)

    def _on_tick(self) -> None:
        if not self.knows_time():
            return
        for stamp_ns in self._pace.due(self.now_ns()):
            self._publish(stamp_ns + self._lead_ns)

    def _publish(self, stamp_ns: int) -> None:
        twist = STANDSTILL
        if not self._paused:
            sample = self._generator.advance()
            twist = sample.twist
            self._show((sample.mode, *sample.selected))
            if sample.index % max(1, round(PATH_STEP * self.settings.rate)) == 0:
                self._remember(Motion(stamp_ns, self._pose, twist))
        motion = Motion(stamp_ns, self._pose, twist)
        self._reference.publish(convert.fill_odometry(self._message, motion))
        self._pose = advance_pose(self._pose, twist, 1.0 / self.settings.rate)

    def _show(self, signals: tuple[int, ...]) -> None:
        if signals != self._shown:
            self._shown = signals
            self._signals.publish(Int32MultiArray(data=list(signals)))

    def _remember(self, motion: Motion) -> None:
        if self.settings.path_points:
            self._path.poses.append(convert.pose_stamped(motion, self.settings.frame_id))
            del self._path.poses[: -self.settings.path_points]

    def _publish_path(self) -> None:
        if self._path.poses:
            self._path.header.stamp = self.get_clock().now().to_msg()
            self._trail.publish(self._path)

    def _on_reseed(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._seed = _draw() if self.settings.secret_seed else self._seed + 1
        self._fingerprint = fingerprint(self._seed, secrets.token_bytes(SALT_BYTES))
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

    def health(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return whether samples had to be given up, and where the run stands."""
        values = {
            'lateness_s': self._pace.lateness(self.now_ns()),
            'skipped_samples': self._pace.skipped,
            'mode': self._shown[0] if self._shown else 'none',
            KEY: self._fingerprint,
        }
        if not self.knows_time():
            return WARN, NO_TIME, values
        if self._pace.skipped:
            return WARN, 'the machine is too slow: samples were given up', values
        return OK, 'paused' if self._paused else 'running', values

    def finish(self) -> None:
        """Wait until everybody has the last sample."""
        self._reference.wait_for_all_acked(Duration(nanoseconds=200_000_000))


def _draw() -> int:
    """Return a seed from the operating system that cannot be guessed."""
    return secrets.randbits(SEED_BITS)


def make() -> list[ReferenceNode]:
    """Return the nodes of this process."""
    return [ReferenceNode()]
