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
"""``ros2 run t3mpc_ros reference_generator``: publishes the reference, chaotic or given."""

from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
import secrets
import struct
from typing import Any, ClassVar

from geometry_msgs.msg import PoseArray, PoseStamped, Twist, TwistStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
import numpy as np
from rclpy.time import Time
from sensor_msgs.msg import BatteryState
from std_msgs.msg import Int32MultiArray
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.chaos.path_replanning import NOWHERE_TIME, PlannedPath
from t3mpc_ros.chaos.pose_reference import (
    GivenPathSource,
    PathClock,
    PathReferenceParameters,
    PathSource,
    PauseRamp,
    PortraitSource,
    TwistSource,
)
from t3mpc_ros.chaos.reference import ChaoticReference, ReferenceSample
from t3mpc_ros.chaos.salted_seed_hash import FINGERPRINT_KEY, SALT_BYTES, fingerprint_seed
from t3mpc_ros.geometry.kinematics import WheelGeometry, advance_pose, points_from_frame
from t3mpc_ros.geometry.path_file import load_path
from t3mpc_ros.geometry.polyline import PathError, check_points
from t3mpc_ros.geometry.sample_scheduler import SampleScheduler
from t3mpc_ros.geometry.trajectory import REFERENCE_SAMPLES
from t3mpc_ros.geometry.types import (
    NANOSECONDS,
    ORIGIN,
    STANDSTILL,
    Array,
    BodyTwist,
    Pose,
    State,
    difference,
    has_jumped,
)
from t3mpc_ros.nodes import ros_messages, topic_endpoints
from t3mpc_ros.nodes.base_node import (
    ACK_TIMEOUT,
    NO_CLOCK,
    OK,
    WARN,
    BaseNode,
    MatchingSubscription,
)
from t3mpc_ros.nodes.ros_messages import FrameParameters
from t3mpc_ros.parameters.table import ParameterError, group, parameter

PATH_PERIOD = 0.1
"""Time between the poses of ``reference/path``, s."""
BATTERY_TIMEOUT = 30.0
"""Time without a voltage of the battery that is reported, s: some robots send one every 10 s."""
REFUSAL_SHOWN_NS = 30 * NANOSECONDS
"""Time for which the diagnostics say why an input was refused, unless one is taken before."""
SEED_BITS = 128
"""Length of a secret seed."""
FRAMES_THAT_JUMP = 'map', 'earth'
"""Frames in which a pose may jump, as when a localisation finds the robot elsewhere (REP 105)."""
AFTER_JUMP = {
    'portrait': 'another path begins where the robot is',
    'twist': 'the reference goes on where the robot is',
    'topic': 'its path has ended: send it again, in the new odom',
    'file': 'its path has ended: start reference_generator again to drive it',
}
"""What the sources do when the odometry is set."""


@dataclass(frozen=True)
class ReferenceGeneratorParameters(PathReferenceParameters):
    """Parameters of the reference generator node."""

    lead: float = parameter(
        0.4,
        'lead time: how far in the future the reference is stamped, so that its value at the '
        'present time does not depend on message delays',
        's',
        (0.0, 10.0),
    )
    secret_seed: bool = parameter(
        False,
        'draw the seed from the operating system, so that the path of the robot is not '
        'predictable; only a fingerprint of the seed is published. Source portrait does so '
        'whenever seed is 0',
    )
    frame_id: str = parameter('odom', 'frame of the reference pose')
    child_frame_id: str = parameter('base_link', 'frame of the reference twist')
    frames: FrameParameters = group(FrameParameters, inline=True)
    path_points: ClassVar[int] = 600
    """Maximum number of poses in reference/path."""
    enable_stamped_target_twist: bool = parameter(
        False, 'source twist: subscribe to target_twist as TwistStamped instead of Twist'
    )
    geometry: WheelGeometry = group(WheelGeometry, inline=True)

    @property
    def draws_seed(self) -> bool:
        """Whether the seed comes from the operating system."""
        return self.secret_seed or (self.source == 'portrait' and self.seed == 0)

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for two seeds, or more samples than controllers keep."""
        super().check_consistency()
        if self.lead * self.rate > 0.95 * REFERENCE_SAMPLES:
            raise ParameterError(
                f'lead must be at most {0.95 * REFERENCE_SAMPLES / self.rate:.3g} s at a rate of '
                f'{self.rate:g} Hz, because a controller keeps {REFERENCE_SAMPLES} samples of the '
                f'reference: got {self.lead:g} s'
            )
        if self.secret_seed and self.seed:
            raise ParameterError(f'seed must be 0 with secret_seed: got {self.seed}')


class ReferenceGeneratorNode(BaseNode[ReferenceGeneratorParameters]):
    """Publishes the reference on an exact time grid, stamped ahead by the lead time."""

    parameter_class = ReferenceGeneratorParameters
    configuration_errors = (PathError,)

    def __init__(self, **options: Any) -> None:
        super().__init__('reference_generator', **options)
        parameters = self.parameters
        # A secret seed is never a parameter value, log text or diagnostic value: it determines
        # the path of the robot. The diagnostics hold its fingerprint, which the recorder stores.
        self._seed = _random_seed() if parameters.draws_seed else parameters.seed
        self._fingerprint = fingerprint_seed(self._seed, secrets.token_bytes(SALT_BYTES))
        self._points = load_path(parameters.path_file) if parameters.path_file else None
        self._source: PathSource | None = None
        """Source of the pose, once the robot has reported where it is."""
        # A patrol is to cover its room: a portrait that waited would leave out much of it.
        # A planned one waits: what stands in its way is on the map, and it goes around it.
        on_the_way = parameters.source != 'portrait' or parameters.plan.enabled
        self._make_path_clock = partial(PathClock, parameters.wait, on_the_way=on_the_way)
        self._path_clock = self._make_path_clock()
        self._last: State | None = None
        """Last message of odom."""
        self._jumps = 0
        """How often it was set."""
        self._restated = True
        """Whether the reference of the present was published since."""
        self._ended = ''
        """How that ended a path that was under way."""
        self._rejected = 0
        self._refused: dict[str, tuple[int, str]] = {}
        """When (ns) the last message of an input was refused, and why, by topic."""
        self._mapped = not parameters.plan.enabled
        """Whether the path needs no map, or has one."""
        if parameters.source == 'signals':
            self._generator = ChaoticReference(parameters, parameters.geometry)
            self._generator.advance()  # compile here, not within a step
            self._generator.reset(self._seed)
            self._sample: ReferenceSample | None = None
            self._ramp = PauseRamp(parameters.motion, parameters.geometry, 1.0 / parameters.rate)
        else:
            source = self._make_source(ORIGIN)
            if isinstance(source, GivenPathSource) and not source.under_way:
                # Load what a path needs here: the first one held up the reference for a second.
                source.append(np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.3]]))
            source.advance()
            self._subscribe()
        self._scheduler = SampleScheduler(parameters.rate, slack=0.2 / parameters.rate)
        self._lead_ns = round(parameters.lead * NANOSECONDS)
        self._paused = False
        self._pose = ORIGIN
        self._samples = 0
        self._path = Path()
        frame, child = (
            parameters.frames.prefixed(name, self.get_namespace())
            for name in (parameters.frame_id, parameters.child_frame_id)
        )
        self._path.header.frame_id = frame
        """Path driven so far, in the frame of the reference."""
        self._may_jump = parameters.frame_id.rpartition('/')[2] in FRAMES_THAT_JUMP
        self._serialized = ros_messages.SerializedOdometry(frame, child)
        self._reference_publisher = self.create_publisher(
            Odometry, 'reference', topic_endpoints.STREAM
        )
        self._path_publisher = self.create_publisher(
            Path, 'reference/path', topic_endpoints.LATCHED
        )
        self._signals_publisher = self.create_publisher(
            Int32MultiArray, 'reference/signals', topic_endpoints.LATCHED
        )
        self._signals: tuple[int, ...] = ()
        self.offer(Trigger, '~/reseed', self._reseed)
        self.offer(SetBool, '~/pause', self._pause)
        self.create_steady_timer(1.0 / parameters.rate, self._on_timer)
        self.create_steady_timer(1.0, self._publish_path)

    def _make_source(self, start: Pose) -> PathSource:
        """Return the source of the parameters for a robot at rest."""
        parameters, geometry = self.parameters, self.parameters.geometry
        if parameters.source == 'portrait':
            return PortraitSource(parameters, geometry, start, self._seed, self._next_seed)
        if parameters.source == 'twist':
            return TwistSource(parameters, start)
        return GivenPathSource(parameters, geometry, start, self._points, parameters.repeat)

    def _subscribe(self) -> None:
        """Subscribe to the pose at which the robot starts, and to what it shall follow."""
        parameters = self.parameters
        # Taken before a sample: the executor need not wake for it.
        self._odometry = self.create_matching_subscription(
            Odometry, 'odom', None, topic_endpoints.STREAM, raw=True
        )
        if parameters.source == 'topic':
            # A volatile subscription receives from every publisher, but not what a latched one has
            # published before; only a transient-local one does, and only from those.
            self.create_matching_subscription(
                Path, 'path', self._on_path, topic_endpoints.LATEST, raw=True
            )
            if topic_endpoints.overriding_options(self, 'path', 'subscription') is None:
                MatchingSubscription(
                    self, Path, 'path', self._on_path, topic_endpoints.LATCHED, raw=True
                )
            self._path_stamps: deque[int] = deque(maxlen=8)
            self._transforms = self._make_transform_buffer()
        elif parameters.plan.enabled:
            self.create_matching_subscription(
                OccupancyGrid, 'keep_out/map', self._on_map, topic_endpoints.LATCHED
            )
            self.create_matching_subscription(
                PoseStamped, 'goal_pose', self._on_goal, topic_endpoints.COMMAND
            )
            self.create_matching_subscription(
                PoseArray, 'map_changes/suspected', self._on_suspected, topic_endpoints.LATCHED
            )
            if parameters.plan.charging.min_voltage > 0.0:
                self.create_matching_subscription(
                    BatteryState, 'battery_state', self._on_battery, topic_endpoints.SCALARS
                )
            self._transforms = self._make_transform_buffer()
        elif parameters.source == 'twist':
            kind = TwistStamped if parameters.enable_stamped_target_twist else Twist
            self.create_matching_subscription(
                kind, 'target_twist', self._on_twist, topic_endpoints.COMMAND
            )

    @property
    def _planned(self) -> PlannedPath | None:
        """Plan of a patrol, once the robot has reported where it is."""
        return self._source.planned if isinstance(self._source, PortraitSource) else None

    def _take_odometry(self) -> None:
        """Make the source where the robot is, once it has reported that; then wait for it."""
        for message in self._odometry.take_waiting()[-1:]:
            state = ros_messages.state_from_odometry(message)
            if not state.is_finite():
                continue
            if self._source is None:
                self._source = self._make_source(state.pose)
                self._pose = state.pose
            elif self._last and not self._may_jump and has_jumped(self._last, state):
                self._begin_again(self._last.pose, state.pose)
            self._last = state
            self._path_clock.observe(state.stamp_ns, state.pose)
            if self._planned is not None:
                self._planned.observe(state.pose)

    def _begin_again(self, last: Pose, pose: Pose) -> None:
        """Begin at rest at a pose that the odometry was set to, from the last one.

        The robot has not moved: one that rests is to rest, and a path in the frame of before leads
        elsewhere now.
        """
        source = self.parameters.source
        distance, angle = difference(last, pose)
        text = f'odom has jumped by {distance:.4g} m and {angle:.3g} rad: {AFTER_JUMP[source]}'
        if isinstance(self._source, GivenPathSource) and self._source.under_way:
            self._ended = text
        self.get_logger().warning(text, throttle_duration_sec=5.0)
        self._jumps += 1
        self._points = None
        if source == 'portrait':
            self._next_seed()
            self._mapped = not self.parameters.plan.enabled
        self._source, self._pose = self._make_source(pose), pose
        self._path_clock = self._make_path_clock()
        self._path.poses.clear()
        self._restated = False

    def _make_transform_buffer(self) -> Any:
        """Return the transforms known to tf2, None without tf2_ros."""
        if (tf2_ros := self.import_tf2()) is None:
            return None
        buffer = tf2_ros.Buffer()
        self._transform_listener = tf2_ros.TransformListener(buffer, self)
        return buffer

    def _on_path(self, message: bytes, info: dict[str, Any]) -> None:
        stamp = int(info['source_timestamp'])
        if stamp and stamp in self._path_stamps:
            return  # both subscriptions receive it
        self._path_stamps.append(stamp)
        with self._input('path', PathError, struct.error):
            points = self._own_points(
                ros_messages.frame_from_serialized(message), ros_messages.points_from_path(message)
            )
            self._ended = ''
            if not isinstance(self._source, GivenPathSource):
                self._points = points  # the robot has not reported where it is
            elif self.parameters.path_mode == 'append':
                self._source.append(points)
            else:
                self._source.replace(points)

    @contextmanager
    def _input(self, topic: str, *refusals: type[Exception]) -> Iterator[None]:
        """Take a message in the ``with`` block, which raises a refusal for one to ignore."""
        try:
            yield
            self._refused.pop(topic, None)
        except refusals as error:
            self._rejected += 1
            self._refused[topic] = self.steady_ns(), f'the last {topic} is ignored: {error}'
            self.get_logger().warning(f'{topic} is ignored: {error}')

    def _own_points(self, frame: str, points: Array) -> Array:
        """Return points of a frame, shape (n, 2), in that of the reference, or raise PathError."""
        check_points(points)
        if len(points):
            points = points_from_frame(self._frame_pose(frame), points)
            check_points(points)
        return points

    def _frame_pose(self, frame: str) -> Pose:
        """Return the pose of a frame in that of the reference, or raise PathError."""
        own = self._path.header.frame_id
        if frame.lstrip('/') in ('', own):
            return ORIGIN
        if self._transforms is not None and self._transforms.can_transform(own, frame, Time()):
            return ros_messages.pose_from_transform(
                self._transforms.lookup_transform(own, frame, Time()).transform
            )
        raise PathError(f'its frame is {frame}, and no transform from it to {own} is known')

    def _on_map(self, message: OccupancyGrid, info: dict[str, Any]) -> None:
        grid = None
        with self._input('keep_out/map', ValueError):
            grid = ros_messages.grid_from_occupancy(message)
        if grid is not None and self._planned is not None:
            self._mapped = True
            self._planned.set_map(grid)

    def _on_goal(self, message: PoseStamped, info: dict[str, Any]) -> None:
        place = np.array([[message.pose.position.x, message.pose.position.y]])
        with self._input('goal_pose', PathError):
            x, y = self._own_points(message.header.frame_id, place)[0].tolist()
            if self._planned is None:
                raise PathError('no odom yet: send it again when the robot has reported its pose')
            if self._planned.charging:
                raise PathError('the battery is charged first: send it again after that')
            self._planned.go_to((x, y))

    def _on_suspected(self, message: PoseArray, info: dict[str, Any]) -> None:
        with self._input('map_changes/suspected', PathError):
            points = ros_messages.points_from_poses(message.poses)
            places = self._own_points(message.header.frame_id, points)
            if self._planned is not None:
                self._planned.look_at(places)

    def _on_battery(self, message: BatteryState, info: dict[str, Any]) -> None:
        if self._planned is not None and not self._planned.observe_battery(message.voltage):
            self._rejected += 1

    def _on_twist(self, message: Twist | TwistStamped, info: dict[str, Any]) -> None:
        twist = message.twist if isinstance(message, TwistStamped) else message
        if isinstance(self._source, TwistSource) and not self._source.set_target(
            BodyTwist(twist.linear.x, twist.angular.z)
        ):
            self._rejected += 1

    def _next_seed(self) -> int:
        """Return another seed, and replace the fingerprint."""
        self._seed = _random_seed() if self.parameters.draws_seed else self._seed + 1
        self._fingerprint = fingerprint_seed(self._seed, secrets.token_bytes(SALT_BYTES))
        return self._seed

    def _on_timer(self) -> None:
        if not self.clock_started():
            return
        if self.parameters.source != 'signals':
            self._take_odometry()
            if self._source is None:
                return
        for stamp_ns in self._scheduler.due(self.now_ns()):
            if not self._restated:  # in place of what was published ahead, which leads elsewhere
                self._restated = True
                self._publish(stamp_ns)
            self._publish(stamp_ns + self._lead_ns)

    def _publish(self, stamp_ns: int) -> None:
        """Publish a sample, and keep some as the path driven so far."""
        twist, count = STANDSTILL, None
        if self._source is not None:
            rate = 0.0 if self._paused else self._path_clock.rate
            self._pose, twist = self._source.advance(rate)
            self._path_clock.add_reference(stamp_ns, self._pose)
            self._samples = count = self._samples + 1
        else:
            if self._ramp.share == 1.0 and not self._paused:
                self._sample = sample = self._generator.advance()
                count = sample.index
                self._publish_signals((sample.mode, *sample.selected))
            if self._sample is not None:
                twist = self._ramp.step(self._sample.twist, paused=self._paused)
        state = State(stamp_ns, self._pose, twist)
        self._reference_publisher.publish(self._serialized.with_state(state))
        if count is not None and count % max(1, round(PATH_PERIOD * self.parameters.rate)) == 0:
            self._path.poses.append(ros_messages.pose_stamped(state, self._path.header.frame_id))
            del self._path.poses[: -self.parameters.path_points]
        if self._source is None:
            self._pose = advance_pose(self._pose, twist, 1.0 / self.parameters.rate)

    def _publish_signals(self, signals: tuple[int, ...]) -> None:
        """Publish the mode and the numbers of its two signals when they change."""
        if signals != self._signals:
            self._signals = signals
            self._signals_publisher.publish(Int32MultiArray(data=list(signals)))

    def _publish_path(self) -> None:
        if self._path.poses:
            self._path.header.stamp = self.get_clock().now().to_msg()
            self._path_publisher.publish(self._path)

    def _reseed(self) -> tuple[str, str]:
        if self.parameters.source not in ('signals', 'portrait'):
            return f'source {self.parameters.source} has no seed', ''
        seed = self._next_seed()
        if isinstance(self._source, PortraitSource):
            self._source.reseed(seed)
            return '', 'the path continues with another seed'
        if self.parameters.source == 'signals':
            self._generator.reset(seed)
        return '', 'the reference restarts with another seed'

    def _pause(self, on: bool) -> tuple[str, str]:
        self._paused = on
        return '', 'reference paused' if on else self._ended or 'reference resumed'

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return the state of the reference; a warning if samples were skipped since the last."""
        values: dict[str, object] = {
            'lateness_s': self._scheduler.lateness(self.now_ns()),
            'skipped_samples': self._scheduler.skipped,
            'mode': self._signals[0] if self._signals else 'none',
            FINGERPRINT_KEY: self._fingerprint,
        }
        if not self.clock_started():
            return WARN, NO_CLOCK, values
        if self.parameters.source != 'signals':
            values['rejected_inputs'] = self._rejected
            values['odometry_jumps'] = self._jumps
            values['path_rate'] = self._path_clock.rate
            if isinstance(self._source, GivenPathSource):
                values['path_under_way'] = self._source.under_way
            if self._source is None:
                return WARN, 'no odom yet: the path begins where the robot is', values
            if not self._mapped:
                return WARN, 'no keep_out/map yet: the controller publishes it', values
            if self._ended:
                return WARN, self._ended, values
        if self._scheduler.newly_skipped():
            return WARN, 'processor overloaded: samples were skipped', values
        if self._planned is not None and self._planned.charging:
            there = self._planned.at_charging_place
            return OK, f'{"at" if there else "on the way to"} the charging place', values
        if self._path_clock.rate == 0.0:
            return OK, 'waiting for the robot', values
        return OK, 'paused' if self._paused else 'running', values

    def warnings(self) -> list[str]:
        """Return what was refused last, goals without a way, and a battery that is not known."""
        planned, charging = self._planned, self.parameters.plan.charging
        since_ns = self.steady_ns() - REFUSAL_SHOWN_NS
        found = [text for at_ns, text in self._refused.values() if at_ns > since_ns]
        if planned is None:
            return found
        if goal := planned.plan.unreachable_goal:
            name = 'charging place' if planned.charging else 'goal'
            found.append(
                f'no way to the {name} at ({goal[0]:.2f}, {goal[1]:.2f}) m is known: it is '
                'outside of the map or behind what is in it; the robot drives on and looks again'
            )
        if planned.boxed_in:
            distance = self.parameters.plan.distance
            found.append(
                f'the robot is boxed in: for {NOWHERE_TIME:.0f} s and more no way that keeps '
                f'plan.distance ({distance:g} m) from obstacles has led on; clear a passage of '
                f'{2.0 * distance:.2g} m, or set the robot down elsewhere'
            )
        if charging.min_voltage and (silence := planned.battery_silence) >= BATTERY_TIMEOUT:
            effect = 'does not leave' if planned.charging else 'does not go to'
            found.append(
                f'no voltage in battery_state for {silence:.0f} s: the robot {effect} the '
                'charging place'
            )
        return found

    def on_shutdown(self) -> None:
        """Wait until all subscribers have the last sample."""
        self._reference_publisher.wait_for_all_acked(ACK_TIMEOUT)


def _random_seed() -> int:
    """Return a seed from the operating system's random number generator."""
    return secrets.randbits(SEED_BITS)
