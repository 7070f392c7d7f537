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
"""Node of the live page: collects what the graph publishes, and executes the page's commands.

Its subscriptions are polled, not executed: every twentieth of a second it takes the messages that
wait, so that two hundred messages a second cost about as much as twenty. Streams are requested
best effort, which every publisher offers, and decoded from the serialized messages. The executor,
which builds its wait set anew each time, runs only while an answer to a request may come.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, suppress
from functools import partial
import math
from queue import Empty, SimpleQueue
import struct
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point, Pose, PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.duration import Duration
from rclpy.exceptions import InvalidNamespaceException
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Range
from std_msgs.msg import Float64, Int32MultiArray
from std_srvs.srv import SetBool, Trigger

from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.control.controller import WHEELS
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.geometry.kinematics import WheelGeometry, wheels_from_twist
from t3mpc_ros.geometry.polyline import PathError, check_points
from t3mpc_ros.geometry.types import NANOSECONDS, RANGE_SENSORS, State
from t3mpc_ros.nodes import ros_messages
from t3mpc_ros.nodes.node_main import own_context
from t3mpc_ros.nodes.remote_parameters import ParameterWatch, RemoteParameters, plain_value
from t3mpc_ros.nodes.topic_endpoints import (
    PolledCallbackGroup,
    full_name,
    take_with_info,
)
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters
from t3mpc_ros.simulation.world import world_outline

PERIOD = 0.05
"""Time between two polls, s."""
GRAPH_PERIOD = 1.0
"""Time between two looks at the nodes of the graph, s."""
REPLY_TIMEOUT = 3.0
"""Longest wait for the answer of a service, s."""
ROBOTS = ('sim_robot', 'radio_bridge')
"""Nodes that are a robot."""
LOOP_NODES = ('controller', *ROBOTS, 'reference_generator')
"""Nodes whose reports, parameters and services the page shows."""
DEPTH = 100
"""Messages that wait for a poll at most: those of a second, if the machine is busy."""
REFERENCES = 200
"""Number of references whose times are kept: those of a second, and more."""
SAME_CLOCK_NS = 30 * NANOSECONDS
"""Time between publication and stamp up to which both are of the same clock."""
SWITCH_TIMEOUT = 1.0
"""Time after which a switch without a reference that follows it is reported all the same, s."""
CLOCK_NS = 1_000_000_000 * NANOSECONDS
"""Stamps beyond it, of 2001, are of a clock, not of a simulation that began at 0."""
WARN = LoggingSeverity.WARN.value
"""Level of a log message from which on it is an event."""

SERVICES: Mapping[str, tuple[type, str]] = {
    'e_stop': (SetBool, 'e_stop'),
    'reset_odometry': (Trigger, 'reset_odometry'),
    'enable': (SetBool, 'controller/enable'),
    'reset': (Trigger, 'controller/reset'),
    'pause': (SetBool, 'reference_generator/pause'),
    'reseed': (Trigger, 'reference_generator/reseed'),
}
"""Commands that are a service: its type and name."""


PATH = QoSProfile(
    depth=1,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
    lifespan=Duration(seconds=REPLY_TIMEOUT),
)
"""Profile of a path that was drawn, as who follows paths requests; a node that starts later must
not drive along an old one."""


class CommandFailedError(RuntimeError):
    """A command that was not executed; the text says why and what to do."""


class ViewNode(Node):
    """Collects samples, facts and reports of the robot in a namespace, and executes commands.

    ``sink``, a :class:`~t3mpc_ros.view.live_data.LiveRun`, gets them in the thread of
    :meth:`spin`.
    """

    def __init__(self, sink: Any, namespace: str = '') -> None:
        super().__init__(
            'view', namespace=namespace, start_parameter_services=False, enable_rosout=False
        )
        self._sink = sink
        self._group = PolledCallbackGroup()
        self._pending: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._geometry = WheelGeometry()
        self._origin_ns: int | None = None
        self._newest = 0.0
        self._stamp_lead_ns = 0
        """Lead of the clock of the stamps, of a simulation, over that of the publications."""
        self._sent_references: deque[tuple[int, float]] = deque(maxlen=REFERENCES)
        """Times of publication, ns, and stamps, s, of the newest references."""
        self._switches: list[tuple[int, str]] = []
        """Time of publication, ns, and text of each switch whose reference has not come yet."""
        self._remote = ParameterWatch(self, self._is_shown, self._on_parameters)
        self._rows: dict[str, dict[str, Mapping[str, Any]]] = {}
        self._replies_until = -math.inf
        """Steady time until which the answer of a command may come, s."""
        self._signals: tuple[int, ...] = ()
        self._faults, self._slips = 'none', False
        self._map_changes: dict[str, tuple[str, bool]] = {}
        self._ranges = [math.nan] * len(RANGE_SENSORS)
        self._terms = [math.nan] * (len(WHEELS) * len(TERM_NAMES))
        self._command_clients = {
            name: self.create_client(kind, service) for name, (kind, service) in SERVICES.items()
        }
        self._path_publisher = self.create_publisher(Path, 'path', PATH)
        self._goal_publisher = self.create_publisher(PoseStamped, 'goal_pose', PATH)
        self._polled: dict[str, Subscription] = {}
        self._subscribe_all()
        sink.set('namespace', self.get_namespace().strip('/'))
        sink.set('terms', list(TERM_NAMES))
        sink.set('sensors', list(RANGE_SENSORS))
        sink.set('mounts', sensor_mounts(RangeSensorParameters()).tolist())

    # -- loop -------------------------------------------------------------------------------------

    def spin(self, stop: Callable[[], bool]) -> None:
        """Collect and execute until ``stop`` returns True."""
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        now = next_poll = next_look = time.monotonic()
        try:
            while not stop():
                wait = max(0.0, next_poll - now)
                if now < self._replies_until or len(self._rows) < len(self._remote.nodes):
                    executor.spin_once(wait)
                else:
                    self._start_waiting(wait)
                if (now := time.monotonic()) < next_poll:
                    continue
                next_poll = max(next_poll + PERIOD, now)
                if now >= next_look:
                    next_look = now + GRAPH_PERIOD
                    self.look_at_graph()
                    executor.spin_once(0.0)
                self.poll()
                self._sink.tick(now)
        finally:
            executor.remove_node(self)
            executor.shutdown()

    def poll(self) -> None:
        """Take the messages that wait, and start the commands that wait."""
        for subscription in list(self._polled.values()):
            for message, info in take_with_info(subscription):
                subscription.callback(message, int(info['source_timestamp']))
        self._report_switches()
        self._add_collected('ranges', self._ranges)
        self._add_collected('terms', self._terms)
        self._start_waiting(0.0)

    def _start_waiting(self, seconds: float) -> None:
        """Start the commands that wait, the first as soon as it comes within ``seconds``."""
        with suppress(Empty):
            self._pending.get(timeout=seconds)()
            while True:
                self._pending.get_nowait()()

    def _add_collected(self, stream: str, values: list[float]) -> None:
        """Add the newest values of several topics as one sample, and forget them."""
        if not all(map(math.isnan, values)):
            self._sink.add(stream, self._newest, values)
            values[:] = [math.nan] * len(values)

    # -- messages ---------------------------------------------------------------------------------

    def _subscribe_all(self) -> None:
        for topic, stream in (
            ('odom', 'odometry'),
            ('ground_truth/odom', 'truth'),
            ('reference', 'reference'),
        ):
            self._subscribe(Odometry, topic, partial(self._on_state, stream), raw=True)
        for number, name in enumerate(RANGE_SENSORS):
            take = partial(self._on_range, number)
            self._subscribe(Range, f'range/{name}', take, depth=1, raw=True)
        for row, term in enumerate(TERM_NAMES):
            for column, wheel in enumerate(WHEELS):
                take = partial(self._on_term, len(WHEELS) * row + column)
                topic = f'controller/terms/{term}/{wheel}'
                self._subscribe(Float64, topic, take, depth=1, raw=True)
        self._subscribe(Int32MultiArray, 'reference/signals', self._on_signals, latched=True)
        self._subscribe(DiagnosticArray, '/diagnostics', self._on_diagnostics)
        self._subscribe(DiagnosticArray, 'map_changes', self._on_map_changes, latched=True)
        self._subscribe(Log, '/rosout', self._on_log)
        self._subscribe(ParameterEvent, '/parameter_events', self._on_parameter_event)

    def _subscribe(
        self,
        kind: type,
        topic: str,
        take: Callable[[Any, int], None],
        *,
        depth: int = DEPTH,
        raw: bool = False,
        latched: bool = False,
    ) -> None:
        profile = QoSProfile(
            depth=depth,
            reliability=ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        self._polled[topic] = self.create_subscription(
            kind, topic, take, profile, callback_group=self._group, raw=raw
        )

    def _seconds(self, stamp_ns: int) -> float:
        if self._origin_ns is None:
            # A whole second, so that the times of the clock are round where those of the page are.
            self._origin_ns = stamp_ns - stamp_ns % NANOSECONDS
            if stamp_ns > CLOCK_NS:
                self._sink.set('origin', self._origin_ns // NANOSECONDS)
        return (stamp_ns - self._origin_ns) / NANOSECONDS

    def _time(self, sent_ns: int) -> float:
        """Return the time of a message without stamp; some middleware has no time either."""
        if self._origin_ns is None or sent_ns <= 0:
            return self._newest
        return self._seconds(sent_ns + self._stamp_lead_ns)

    def _on_state(self, stream: str, data: bytes, sent_ns: int) -> None:
        try:
            state: State = ros_messages.state_from_odometry(data)
        except struct.error:  # a truncated message
            return
        seconds = self._seconds(state.stamp_ns)
        if stream == 'odometry':
            lead_ns = state.stamp_ns - sent_ns
            # A robot that catches up stamps of the clock sends them late: that is no other clock.
            self._stamp_lead_ns = lead_ns if abs(lead_ns) > SAME_CLOCK_NS else 0
            self._newest = seconds
        elif stream == 'reference':
            self._sent_references.append((sent_ns, seconds))
        wheels = wheels_from_twist(state.twist, self._geometry)
        self._sink.add(stream, seconds, (*wheels, *state.pose))

    def _on_command(self, message: bytes | TwistStamped, sent_ns: int) -> None:
        if self._origin_ns is None:
            return
        try:
            twist = (
                ros_messages.twist_from_serialized(message)
                if isinstance(message, bytes)
                else ros_messages.body_twist(message.twist)
            )
        except struct.error:
            return
        wheels = wheels_from_twist(twist, self._geometry)
        self._sink.add('command', self._time(sent_ns), wheels)

    def _on_range(self, number: int, data: bytes, sent_ns: int) -> None:
        del sent_ns
        with suppress(struct.error):
            distance, reach = ros_messages.range_from_serialized(data)
            # Beyond is infinite, or the reach, as REP 117 allows.
            self._ranges[number] = reach if distance > reach else max(distance, 0.0)
            self._sink.set('reach', round(reach, 3))

    def _on_term(self, number: int, data: bytes, sent_ns: int) -> None:
        del sent_ns
        with suppress(struct.error):
            self._terms[number] = ros_messages.float_from_serialized(data)

    def _on_signals(self, message: Int32MultiArray, sent_ns: int) -> None:
        signals = tuple(message.data)
        if self._signals and signals != self._signals and len(signals) == 3:
            mode, right, left = signals
            text = f'switch to mode {mode}: signals {right} and {left}'
            self._switches.append((sent_ns, text))
        self._signals = signals

    def _report_switches(self) -> None:
        """Report each switch with the stamp of the reference that was sent next, its first one.

        The reference is sent ahead of its time, so the switch is later than its message.
        """
        while self._switches:
            sent_ns, text = self._switches[0]
            later = (time for sent, time in self._sent_references if sent >= sent_ns > 0)
            if (time_of_switch := next(later, None)) is None:
                if sent_ns > 0 and self._newest < self._time(sent_ns) + SWITCH_TIMEOUT:
                    return
                time_of_switch = self._time(sent_ns)
            self._switches.pop(0)
            self._sink.report(time_of_switch, 'switch', text)

    def _on_diagnostics(self, message: DiagnosticArray, sent_ns: int) -> None:
        prefix = self.get_namespace().strip('/')
        for status in message.status:
            namespace, _, name = status.name.rpartition('/')
            if namespace != prefix or name not in LOOP_NODES:
                continue
            level = int.from_bytes(status.level, 'little')
            values = {each.key: each.value for each in status.values}
            condition = _stop_condition(name, status.message) or _CONDITIONS[min(level, 2)]
            if values.get('standstill'):
                condition = 'stopped'
            self._sink.node_report(name, status.message, condition)
            if name in ROBOTS:
                self._on_faults(values.get('faults', 'none'), self._time(sent_ns))
                self._on_slip(values.get('slipping') == 'True', self._time(sent_ns))

    def _on_map_changes(self, message: DiagnosticArray, sent_ns: int) -> None:
        shown = []
        for status in message.status:
            values = {each.key: each.value for each in status.values}
            try:
                place = [float(values[key]) for key in ('x_m', 'y_m', 'size_m')]
            except (KeyError, ValueError):  # of another publisher
                continue
            kind, present = values.get('kind', ''), values.get('present') == 'True'
            shown.append([*place, kind, present])
            if self._map_changes.get(status.name) != (kind, present):
                self._map_changes[status.name] = kind, present
                self._sink.report(self._time(sent_ns), 'change', status.message)
        self._sink.set('map_changes', shown)

    def _on_faults(self, faults: str, seconds: float) -> None:
        if faults != self._faults:
            text = 'faults end' if faults == 'none' else f'fault: {faults}'
            self._sink.report(seconds, 'fault', text)
        self._faults = faults

    def _on_slip(self, slips: bool, seconds: float) -> None:
        if slips and not self._slips:
            text = 'a wheel slips, is blocked, or has lost steps'
            self._sink.report(seconds, 'slip', text)
        self._slips = slips

    def _on_log(self, message: Log, sent_ns: int) -> None:
        prefix = self.get_namespace().strip('/').replace('/', '.')
        namespace, _, name = message.name.rpartition('.')
        if namespace != prefix or name not in LOOP_NODES:
            return
        if condition := _stop_condition(name, message.msg):
            self._sink.node_report(name, message.msg, condition)
        elif message.level >= WARN:
            self._sink.report(self._time(sent_ns), 'note', f'{name}: {message.msg}')

    # -- nodes and parameters ---------------------------------------------------------------------

    def look_at_graph(self) -> None:
        """Find nodes that have come or gone, other robots, and the type of ``cmd_vel``."""
        for remote in self._remote.update():
            self._rows.pop(remote.node_name, None)
            self._sink.set(f'parameters/{remote.node_name}', None)
            self._sink.node_gone(remote.node_name)
        self._sink.set('nodes', sorted(each.node_name for each in self._remote.nodes.values()))
        self._sink.other_robots(
            sorted(
                {
                    namespace
                    for name, namespace in self.get_node_names_and_namespaces()
                    if name in ROBOTS and namespace != self.get_namespace()
                }
            )
        )
        self._subscribe_command()

    def _is_shown(self, name: str, namespace: str) -> bool:
        return namespace == self.get_namespace() and name in LOOP_NODES

    def _subscribe_command(self) -> None:
        topic = self.resolve_topic_name('cmd_vel')
        offered = {info.topic_type for info in self.get_publishers_info_by_topic(topic)}
        for kind in (TwistStamped, Twist):
            if offered == {f'geometry_msgs/msg/{kind.__name__}'}:
                present = self._polled.get('cmd_vel')
                if present is None or present.msg_type is not kind:
                    if present is not None:
                        self.destroy_subscription(present)
                    self._subscribe(kind, 'cmd_vel', self._on_command, raw=kind is Twist)

    def _on_parameters(self, remote: RemoteParameters, rows: Sequence[Mapping[str, Any]]) -> None:
        self._rows[remote.node_name] = {row['name']: row for row in rows}
        self._show_parameters(remote.node_name)

    def _show_parameters(self, name: str) -> None:
        rows = self._rows[name]
        self._sink.set(f'parameters/{name}', [dict(row) for row in rows.values()])
        if 'wheel_radius' in rows and 'wheel_separation' in rows:
            size = {each: rows[each]['value'] for each in ('wheel_radius', 'wheel_separation')}
            self._geometry = WheelGeometry(*size.values())
            self._sink.set('robot', size)
        if name == 'sim_robot' and (world := rows.get('world')):
            self._sink.set('world', world_outline(world['value']))

    def _on_parameter_event(self, message: ParameterEvent, sent_ns: int) -> None:
        namespace, _, name = message.node.rpartition('/')
        rows = self._rows.get(name) if namespace == self.get_namespace().rstrip('/') else None
        for changed in message.changed_parameters if rows else ():
            if rows and changed.name in rows:
                value = plain_value(changed.value)
                rows[changed.name] = {**rows[changed.name], 'value': value}
                text = f'{name}: {changed.name} = {value}'
                self._sink.report(self._time(sent_ns), 'parameter', text)
        if rows:
            self._show_parameters(name)

    # -- commands ---------------------------------------------------------------------------------

    def command(self, name: str, arguments: Mapping[str, Any], asked: float) -> str:
        """Execute a command from another thread while :meth:`spin` runs; return what was done.

        ``asked`` is the steady time of the click, s: what is too late is refused. ``set`` takes
        node, name and value of a parameter; the services in :data:`SERVICES` with a SetBool take
        ``on``. CommandFailedError if it was refused, or without an answer.
        """
        reply: Future[str] = Future()
        self._pending.put(partial(self._start, name, arguments, asked, reply))
        try:
            text = reply.result(REPLY_TIMEOUT)
        except TimeoutError:
            reply.cancel()  # what has waited that long is not executed any more
            raise CommandFailedError(
                f'no answer to {name} within {REPLY_TIMEOUT:g} s: is the node alive?'
            ) from None
        return text

    def _start(
        self, name: str, arguments: Mapping[str, Any], asked: float, reply: 'Future[str]'
    ) -> None:
        if not reply.set_running_or_notify_cancel():
            return
        try:
            self._replies_until = time.monotonic() + REPLY_TIMEOUT
            late = self._sink.refusal(name, arguments.get('on'), asked, time.monotonic())
            if late:
                raise CommandFailedError(late)
            if name == 'set':
                self._set_parameter(arguments, reply)
            elif name == 'path':
                reply.set_result(self._publish_path(arguments.get('points')))
            elif name in self._command_clients:
                self._call_service(name, arguments, reply)
            else:
                known = ', '.join(('set', 'path', *self._command_clients))
                raise CommandFailedError(f'the commands are {known}: got {name}')
        except (CommandFailedError, ValueError) as error:
            reply.set_exception(CommandFailedError(str(error)))

    def _publish_path(self, points: Any) -> str:
        """Publish points (m, in the frame of the odometry) for a reference that drives there.

        A patrol that plans takes one point, its goal; a reference of source ``topic`` any path.
        """
        try:
            places = np.array(points, dtype=np.float64)
            check_points(places)
            if not places.size:
                raise PathError('points must not be empty')
        except (PathError, TypeError, ValueError) as error:
            raise CommandFailedError(f'path needs points, [[x, y], …] in m: {error}') from None
        planned = len(places) == 1 and self._goal_publisher.get_subscription_count()
        if not planned and not self._path_publisher.get_subscription_count():
            raise CommandFailedError(
                'no node follows a path: start reference_generator with source topic; a patrol '
                'with plan.enabled drives to a goal'
            )
        message = Path()
        message.header.stamp = self.get_clock().now().to_msg()
        frames = ros_messages.FrameParameters()
        message.header.frame_id = frames.prefixed('odom', self.get_namespace())
        message.poses = [
            PoseStamped(header=message.header, pose=Pose(position=Point(x=float(x), y=float(y))))
            for x, y in places
        ]
        if planned:
            self._goal_publisher.publish(message.poses[0])
        else:
            self._path_publisher.publish(message)
        text = f'path of {len(places)} points' if len(places) > 1 else 'goal'
        x, y = places[-1]
        text = f'{text} to x {x:.2f} m, y {y:.2f} m'
        if self._sink.is_latched():
            text += ': the robot drives there as soon as the emergency stop is released'
        self._sink.report(self._newest, 'command', text)
        return text

    def _call_service(self, name: str, arguments: Mapping[str, Any], reply: 'Future[str]') -> None:
        client, (kind, service) = self._command_clients[name], SERVICES[name]
        request, words = kind.Request(), name
        if kind is SetBool:
            if not isinstance(on := arguments.get('on'), bool):
                raise CommandFailedError(f'{name} needs on, true or false: got {on!r}')
            request.data, words = on, f'{name} {"on" if on else "off"}'
        if not client.service_is_ready():
            raise CommandFailedError(f'no node offers the service {service}: is it running?')

        def answered(future: Any) -> None:
            answer = future.result()
            if not answer.success:
                reply.set_exception(CommandFailedError(f'{words}: {answer.message}'))
                return
            self._sink.report(self._newest, 'command', f'{words}: {answer.message}')
            reply.set_result(answer.message)

        client.call_async(request).add_done_callback(answered)

    def _set_parameter(self, arguments: Mapping[str, Any], reply: 'Future[str]') -> None:
        node, name = (arguments.get(word) for word in ('node', 'name'))
        remote = self._remote.nodes.get(full_name(self.get_namespace(), str(node)))
        if not isinstance(node, str) or not isinstance(name, str) or remote is None:
            raise CommandFailedError(f'no node {node!r} with parameters is running')

        def answered(problem: str) -> None:
            if problem:
                reply.set_exception(CommandFailedError(problem))
            else:
                reply.set_result(f'{name} is set')

        remote.set(name, arguments.get('value'), answered)


def view_node(sink: Any, namespace: str = '') -> AbstractContextManager[ViewNode]:
    """Return a node in a context of its own, which both end after the ``with`` block.

    ValueError there for a namespace that is not valid in ROS.
    """

    def make() -> ViewNode:
        try:
            return ViewNode(sink, namespace.rstrip('/'))
        except InvalidNamespaceException:
            raise ValueError(
                f'namespace must be letters, digits, _ and / only: got {namespace!r}'
            ) from None

    return own_context(make)


_CONDITIONS = ('normal', 'warning', 'stopped')
_CONTROLLER_CONDITIONS = {
    reason.value: 'normal'
    if reason is Reason.TRACKING
    else 'warning'
    if reason.moves
    else 'stopped'
    for reason in Reason
}


def _stop_condition(name: str, text: str) -> str | None:
    """Return whether a text of a node is a reason to stand; None if it is about something else."""
    if name == 'controller':
        return _CONTROLLER_CONDITIONS.get(text.removeprefix('stopped: '))
    if name in ROBOTS:
        if text.startswith(('emergency stop', 'no command')):
            return 'stopped'
        return 'normal' if text == 'following commands' else None
    return None
