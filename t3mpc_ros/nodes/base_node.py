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
"""Base class of the nodes: ROS parameters from a parameter class, diagnostics, shutdown hook."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
import difflib
import inspect
from itertools import islice
import platform
import sys
import time
from typing import Any, ClassVar, Generic, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from std_srvs.srv import SetBool

from t3mpc_ros.nodes import topic_endpoints
from t3mpc_ros.parameters.table import ParameterError, Parameters, ParameterSpec, nearest_hint

P = TypeVar('P', bound=Parameters)

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR

NO_CLOCK = 'no message on /clock yet'

COMMON_TOPICS = ('/rosout', '/parameter_events', '/diagnostics')
"""Topics that every node publishes."""

DIAGNOSTICS_PERIOD = 1.0
"""Period of ``/diagnostics``, s."""
ADAPT_PERIOD = 0.5
"""Time between two comparisons of subscriptions with the offers of publishers, s."""

TYPO_SIMILARITY = 0.8
"""Similarity (difflib) from which a foreign name looks like a misspelt one of this node."""

ACK_TIMEOUT = Duration(nanoseconds=200_000_000)
"""Maximum wait of :func:`publish_and_wait_for_acked`."""

_TYPES = {bool: 'BOOL', int: 'INTEGER', float: 'DOUBLE', str: 'STRING'}

_NO_PUBLISHER_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)
_NO_SUBSCRIPTION_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)

_RCLPY_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides')
"""Parameters (or their first name part) that rclpy declares for every node."""


def _with_info(
    callback: Callable[[Any, dict[str, Any]], None], sequence: topic_endpoints.PublicationSequence
) -> Callable[..., None]:
    """Return a callback that gets a message and its information, whichever executor calls it.

    The events executor of rclpy 7.1 passes both as one tuple, the others as two arguments.
    """

    def called(*received: Any) -> None:
        message, info = received if len(received) == 2 else received[0]
        sequence.add(info['publication_sequence_number'])
        callback(message, info)

    # rclpy passes the information to callbacks of two arguments.
    called.__signature__ = inspect.signature(lambda message, info: None)
    return called


class MatchingSubscription:
    """A subscription that requests what all publishers of its topic offer.

    Robots on micro-ROS and TurtleBot 4 publish best effort, which a reliable subscription does
    not receive. The request is weakened when such a publisher appears. A QoS that the user
    overrides is kept. ``raw`` messages stay serialized.

    The callback gets each message and its information. Without one no executor waits for them,
    and the node takes them with :meth:`take_waiting`: to be woken costs more than a step of the
    controller, so a node with two streams waits for one of them.
    """

    def __init__(
        self,
        node: Node,
        message: type,
        topic: str,
        callback: Callable[[Any, dict[str, Any]], None] | None,
        profile: QoSProfile,
        *,
        raw: bool = False,
    ) -> None:
        self._node = node
        self.sequence = topic_endpoints.PublicationSequence()
        called = (
            _with_info(callback, self.sequence) if callback else topic_endpoints.unused_callback
        )
        self._arguments = message, topic, called
        self._group = None if callback else topic_endpoints.PolledCallbackGroup()
        self._raw = raw
        self._overridden = (
            topic_endpoints.overriding_options(node, topic, 'subscription') is not None
        )
        self.subscription: Subscription = self._subscribe(profile)
        """The present subscription."""

    def _subscribe(self, profile: QoSProfile) -> Subscription:
        return self._node.create_subscription(
            *self._arguments, profile, callback_group=self._group, raw=self._raw
        )

    def adapt(self) -> None:
        """Subscribe again if a publisher does not offer what is requested."""
        if self._overridden:
            return
        present = self.subscription
        name = present.topic_name
        offers = [info.qos_profile for info in self._node.get_publishers_info_by_topic(name)]
        if topic_endpoints.compatible_with_all(present.qos_profile, offers):
            return
        profile = copy(present.qos_profile)
        profile.reliability = topic_endpoints.adapt_request_to_offers(offers).reliability
        if profile.reliability == present.qos_profile.reliability:
            return  # the mismatch is another one, which the diagnostics name
        self._node.destroy_subscription(present)
        self.subscription = self._subscribe(profile)
        self._node.get_logger().info(f'{name} is published best effort')

    def take_waiting(self) -> list[Any]:
        """Return the messages that wait in the queue.

        The executor takes one message of a subscription per cycle: a queue that has filled while
        it was busy would otherwise stay full, and every message would wait as long.
        """
        taken = topic_endpoints.take_with_info(self.subscription)
        for _, info in taken:
            self.sequence.add(info['publication_sequence_number'])
        return [message for message, _ in taken]


class BaseNode(Node, Generic[P]):
    """A node that declares the parameters of one parameter class and publishes diagnostics.

    Subclasses override :meth:`on_parameters_changed` (dynamic parameters were set),
    :meth:`produce_diagnostics` (status for ``/diagnostics`` at 1 Hz) and :meth:`on_shutdown`.
    """

    parameter_class: ClassVar[type[Parameters]] = Parameters
    configuration_errors: ClassVar[tuple[type[Exception], ...]] = ()
    """Errors of :meth:`make` that name what the user has to change, beside ParameterError."""
    conflict_errors: ClassVar[tuple[type[Exception], ...]] = ()
    """Those of them that another process causes: the exit code is 1, not 2."""
    single_publisher_topics: ClassVar[tuple[str, ...]] = ('cmd_vel',)
    """Topics whose publishers the diagnostics name if there are several."""

    @classmethod
    def make(cls, **options: Any) -> 'list[BaseNode[Any]]':
        """Return the nodes of a process of this executable, made with options of rclpy.

        ``cli_args`` is the command line: it tells an option for this node from a file for many.
        """
        return [cls(**options)]

    def __init__(self, name: str, siblings: frozenset[str] = frozenset(), **options: Any) -> None:
        """``siblings`` are the parameter names of the other nodes of the process."""
        super().__init__(name, **options)
        self._siblings = siblings
        self.hardware_id = platform.node() or 'none'
        """Device that the diagnostics are about: this computer, unless the node drives another."""
        self.exit_code = 0
        """Exit code of the process; a value other than 0 ends the process."""
        self.start_warnings: list[str] = []
        """Warnings about the start of the process, repeated in the diagnostics."""
        self.exit_requested = False
        """Set to True to end the process with :attr:`exit_code`."""
        self.parameters: P = self._declare_parameters(options.get('cli_args') or ())
        self.add_on_set_parameters_callback(self._validate)
        self.add_post_set_parameters_callback(self._apply)
        self._diagnostics = self.create_publisher(
            DiagnosticArray, '/diagnostics', topic_endpoints.DIAGNOSTICS
        )
        # Steady time: diagnostics continue while the simulated clock is paused.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_steady_timer(DIAGNOSTICS_PERIOD, self._publish_diagnostics)
        self._matching: list[MatchingSubscription] = []
        self.create_steady_timer(ADAPT_PERIOD, self._adapt_subscriptions)
        self._unused_overrides: list[str] | None = None

    def now_ns(self) -> int:
        """Return the node's time, ns: system time, or simulated time with ``use_sim_time``."""
        return int(self.get_clock().now().nanoseconds)

    def clock_started(self) -> bool:
        """Return whether the node's time is valid: simulated time is 0 before the first clock."""
        return self.now_ns() != 0

    def steady_ns(self) -> int:
        """Return monotonic time, ns, for timeouts: that of the clock of the steady timers."""
        return time.monotonic_ns()

    def create_steady_timer(self, period: float, callback: Callable[[], None]) -> Any:
        """Return a timer that calls ``callback`` every ``period`` seconds of steady time."""
        return self.create_timer(period, callback, clock=self._steady)

    def create_publisher(
        self, msg_type: type, topic: str, *args: Any, **options: Any
    ) -> Publisher:
        """Return a publisher with the QoS overrides of the user.

        The event callbacks of rclpy are left out: an executor with a wait set examines all of them
        in every cycle, which takes longer than a control step. Diagnostics name QoS mismatches.
        """
        options.setdefault('event_callbacks', _NO_PUBLISHER_EVENTS)
        return super().create_publisher(
            msg_type, topic, *self._with_overrides(topic, 'publisher', args, options), **options
        )

    def create_subscription(
        self, msg_type: type, topic: str, callback: Callable[..., None], *args: Any, **options: Any
    ) -> Subscription:
        """Return a subscription with the QoS overrides of the user, without event callbacks."""
        options.setdefault('event_callbacks', _NO_SUBSCRIPTION_EVENTS)
        return super().create_subscription(
            msg_type,
            topic,
            callback,
            *self._with_overrides(topic, 'subscription', args, options),
            **options,
        )

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """The subscriptions that an executor waits for."""
        for each in super().subscriptions:
            if not isinstance(each.callback_group, topic_endpoints.PolledCallbackGroup):
                yield each

    def create_matching_subscription(
        self,
        msg_type: type,
        topic: str,
        callback: Callable[[Any, dict[str, Any]], None] | None,
        profile: QoSProfile,
        *,
        raw: bool = False,
    ) -> MatchingSubscription:
        """Return a subscription whose request follows the offers of the publishers.

        Without a callback the node takes the messages itself.
        """
        made = MatchingSubscription(self, msg_type, topic, callback, profile, raw=raw)
        self._matching.append(made)
        return made

    def remove_matching_subscription(self, made: MatchingSubscription) -> None:
        """Destroy a subscription of :meth:`create_matching_subscription`."""
        self._matching.remove(made)
        self.destroy_subscription(made.subscription)

    def import_tf2(self, effect: str = '') -> Any:
        """Return tf2_ros; None without it, of which the ``effect`` is logged once."""
        try:
            import tf2_ros
        except ImportError:
            if effect:
                self.get_logger().info(f'tf2_ros is not installed: {effect}', once=True)
            return None
        return tf2_ros

    def offer(self, kind: type, name: str, action: Callable[..., tuple[str, str]]) -> None:
        """Offer a service of type Trigger or SetBool.

        ``action``, which gets the value of a SetBool, returns why it failed, and what it did.
        """

        def answer(request: Any, response: Any) -> Any:
            problem, done = action(request.data) if kind is SetBool else action()
            response.success, response.message = not problem, problem or done
            return response

        self.create_service(kind, name, answer)

    def _with_overrides(
        self,
        topic: str,
        kind: topic_endpoints.Kind,
        args: tuple[Any, ...],
        options: dict[str, Any],
    ) -> tuple[Any, ...]:
        """Return the positional arguments, with a copy of the profile that rclpy may change."""
        overriding = topic_endpoints.overriding_options(self, topic, kind)
        if overriding is None or 'qos_overriding_options' in options:
            return args
        options['qos_overriding_options'] = overriding
        profile, *rest = args
        return QoSProfile(depth=profile) if isinstance(profile, int) else copy(profile), *rest

    def _adapt_subscriptions(self) -> None:
        for subscription in self._matching:
            subscription.adapt()

    def _declare_parameters(self, words: Sequence[str]) -> P:
        """Return the parameters; ParameterError for a name meant for this node that it lacks."""
        from t3mpc_ros.nodes.arguments import Origin, parameter_origins  # once per process

        # rclpy has no public access to the overrides: automatic declaration fails on an empty list
        # and does not accept a descriptor afterwards.
        overrides = {
            name: () if given.value is None else given.value
            for name, given in self._parameter_overrides.items()
        }
        kind: type[P] = self.parameter_class
        own = accepted_names(kind)
        values = kind.from_dict({name: overrides[name] for name in overrides if name in own})
        origins = parameter_origins(words, self.get_fully_qualified_name())
        for name in overrides:
            if name in own or name.split('.')[0] in _RCLPY_PARAMETERS:
                continue
            origin = origins.get(name, Origin.SECTION)
            if origin is Origin.OPTION and name in self.names_of_siblings(values):
                continue
            self._handle_unknown(name, shared=origin is Origin.SHARED)
        declare_parameters(self, values)
        return values

    def names_of_siblings(self, parameters: P) -> frozenset[str]:
        """Return the parameter names of the other nodes of the process."""
        return self._siblings

    def _handle_unknown(self, name: str, *, shared: bool) -> None:
        """Reject a name meant for this node; warn of one for all nodes that resembles its own."""
        own = [spec.name for spec in self.parameter_class.specs()]
        node = self.get_name()
        if not shared:
            owners = _owners(name)
            verb = 'has' if len(owners) == 1 else 'have'
            raise ParameterError(
                f'{node} has no parameter {name}'
                + (f' ({", ".join(owners)} {verb})' if owners else '')
                + f'{nearest_hint(name, own)} (`ros2 param list /{node}` lists them)'
            )
        near = difflib.get_close_matches(name, own, n=1, cutoff=TYPO_SIMILARITY)
        if near and not _owners(name):
            text = f'{name} in a section for all nodes is ignored; did you mean {near[0]}?'
            self.get_logger().warning(text)
            self.start_warnings.append(text)

    def on_parameters_changed(self, parameters: P) -> None:
        """Apply changed dynamic parameters."""

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return level, message and values for ``/diagnostics``."""
        return OK, 'running', {}

    def on_shutdown(self) -> None:
        """Stop the robot, publish final messages, close files."""

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set all parameters or none; unlike that of rclpy, the reason names an unknown one."""
        for each in parameter_list:
            if not self.has_parameter(each.name):
                known = [spec.name for spec in self.parameter_class.specs()]
                reason = f'{self.get_name()} has no parameter {each.name}'
                reason += nearest_hint(each.name, known)
                return SetParametersResult(successful=False, reason=reason)
        return super().set_parameters_atomically(parameter_list)

    def _validate(self, requested: list[Parameter]) -> SetParametersResult:
        try:
            self._with_changes(requested)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, accepted: list[Parameter]) -> None:
        if (new := self._with_changes(accepted)) != self.parameters:
            self.parameters = new
            self.on_parameters_changed(new)

    def _with_changes(self, changes: list[Parameter]) -> P:
        """Return the parameters with changes; those that rclpy declares are left out."""
        known = self.parameters.to_dict()
        return self.parameters.with_values(
            {each.name: each.value for each in changes if each.name in known}
        )

    def _publish_diagnostics(self) -> None:
        level, message, values = self.produce_diagnostics()
        if found := [text for text in self._graph_warnings() if text not in message]:
            texts = found if level == OK else [message, *found]
            level, message = max(level, WARN), '; '.join(texts)
        status = DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name().lstrip('/'),
            message=message,
            hardware_id=self.hardware_id,
            values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def warnings(self) -> list[str]:
        """Return warnings for the diagnostics beside :meth:`produce_diagnostics`."""
        return []

    def _graph_warnings(self) -> list[str]:
        """Return what prevents this node and the others from working together."""
        if self._unused_overrides is None:  # all endpoints exist by now
            self._unused_overrides = topic_endpoints.unused_overrides(self)
            for name in self._unused_overrides:
                self.get_logger().warning(f'{name} has no effect: this node has no such endpoint')
        found = [
            *self.start_warnings,
            *self._publishers_problems(),
            *self.warnings(),
            topic_endpoints.qos_problem(
                self, (each.subscription for each in self._matching), 'subscription'
            ),
            topic_endpoints.qos_problem(self, islice(self._public_publishers(), 20), 'publisher'),
        ]
        if self.get_clock().ros_time_is_active and not self.clock_started():
            found.append(f'use_sim_time is set: {NO_CLOCK}')
        return [text for text in found if text]

    def _publishers_problems(self) -> Iterator[str]:
        """Yield which topics have several publishers: their messages contradict each other."""
        several = {
            each.subscription.topic_name: each.sequence.has_several_publishers()
            for each in self._matching
        }
        used = {each.topic_name for each in (*self.subscriptions, *self.publishers)}
        for topic in map(self.resolve_topic_name, self.single_publisher_topics):
            if topic in used or topic in several:
                yield topic_endpoints.publishers_problem(
                    self, topic, alive=several.get(topic, False)
                )

    def _public_publishers(self) -> Iterator[Publisher]:
        """Return the publishers of topics that other nodes use."""
        own = self.get_fully_qualified_name() + '/'
        for publisher in self.publishers:
            name = publisher.topic_name
            if name not in COMMON_TOPICS and not name.startswith(own):
                yield publisher


def publish_and_wait_for_acked(publisher: Publisher, message: Any) -> None:
    """Publish ``message`` and wait, at most 0.2 s, for the acknowledgements of subscribers."""
    publisher.publish(message)
    publisher.wait_for_all_acked(ACK_TIMEOUT)


def declare_parameters(node: Node, parameters: Parameters) -> None:
    """Declare every specification of ``parameters`` with its value.

    A ROS parameter has description, unit and range; those that are not dynamic are read-only.
    """
    values = parameters.to_dict()
    for spec in parameters.specs():
        value = values[spec.name]
        node.declare_parameter(
            spec.name,
            list(value) if spec.many else value,
            parameter_descriptor(spec),
            ignore_override=True,
        )


def parameter_descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """Return the descriptor of one parameter, as ``ros2 param describe`` shows it."""
    unit = f' [{spec.unit}]' if spec.unit else ''
    source = '' if spec.source == 'assumed' else f' ({spec.source})'
    descriptor = ParameterDescriptor(
        name=spec.name,
        type=Parameter.Type[_TYPES[spec.kind] + ('_ARRAY' if spec.many else '')].value,
        description=f'{spec.text}{unit}{source}',
        additional_constraints=spec.bounds_text(),
        read_only=not spec.dynamic,
    )
    if spec.many or (spec.low is None and spec.high is None):
        return descriptor
    if spec.kind is float:
        largest = sys.float_info.max
        low = -largest if spec.low is None else spec.low
        high = largest if spec.high is None else spec.high
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    elif spec.kind is int:
        low = -(2**63) if spec.low is None else int(spec.low)
        high = 2**63 - 1 if spec.high is None else int(spec.high)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    return descriptor


def accepted_names(table: type[Parameters]) -> frozenset[str]:
    """Return the names that a table accepts, former ones too."""
    return frozenset(spec.name for spec in table.specs()) | table.class_constants().keys()


def _owners(name: str) -> list[str]:
    """Return the nodes of the package that have a parameter."""
    from t3mpc_ros.nodes.registry import NODES, parameter_class

    found = []
    for node in NODES:
        # Only recorder and player need the bag libraries.
        with suppress(ModuleNotFoundError):
            if name in accepted_names(parameter_class(node)):
                found.append(node)
    return found


def _text(value: object) -> str:
    return f'{value:.6g}' if isinstance(value, float) else str(value)
