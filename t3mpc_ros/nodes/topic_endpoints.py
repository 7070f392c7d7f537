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
"""Publishers and subscriptions: QoS profiles and overrides, polling, lost messages, mismatches."""

from collections.abc import Iterable, Sequence
from copy import copy
from typing import Any, Literal

from rclpy.callback_groups import CallbackGroup
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from t3mpc_ros.nodes import ros_messages
from t3mpc_ros.parameters.table import ParameterError

RCLError: type[Exception] = rclpy_implementation.RCLError
"""Error of rclpy, among others for a topic that this process uses with another type."""


def _profile(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


STREAM = _profile(100)
"""Odometry, reference and sensors: every sample counts; one second of them is queued."""

INITIAL_INPUTS = _profile(1000, DurabilityPolicy.TRANSIENT_LOCAL)
"""First inputs of the controller, 10 s at 100 Hz, for a recorder that discovers it late."""

COMMAND = _profile(50)
"""Published commands, queued until a recorder has received each of them."""

LATEST = _profile(1)
"""Commands received by a robot, and /clock: only the latest message counts."""

SCALARS = _profile(20)
"""Scalars for plot tools, joint states and slow sensors."""

LATCHED = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
"""Topics whose last message late subscribers receive."""

JOURNAL = _profile(1000, DurabilityPolicy.TRANSIENT_LOCAL)
"""Journal of the controller, with the last 10 s for a recorder that discovers it late."""

PARAMETER_REVISIONS = _profile(20, DurabilityPolicy.TRANSIENT_LOCAL)
"""Revisions of the controller's parameters, to which the journal refers."""

DIAGNOSTICS = _profile(10)
"""Diagnostics."""

RECORDER = _profile(1000)
"""Subscriptions of the recorder, with a queue for times when the disk is busy."""

RECORDER_LATCHED = _profile(RECORDER.depth, DurabilityPolicy.TRANSIENT_LOCAL)
"""Subscriptions of the recorder to topics with transient-local publishers."""


def is_transient_local(profile: QoSProfile) -> bool:
    """Return whether late subscribers receive earlier messages."""
    return bool(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)


def compatible_with_all(subscription: QoSProfile, publishers: Sequence[QoSProfile]) -> bool:
    """Return whether the offers of all publishers satisfy the request of a subscription."""
    return all(
        qos_check_compatible(offered, subscription)[0] != QoSCompatibility.ERROR
        for offered in publishers
    )


def adapt_request_to_offers(publishers: Sequence[QoSProfile]) -> QoSProfile:
    """Return the strictest request for the recorder that all offers satisfy."""
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
    return QoSProfile(
        depth=RECORDER.depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


Kind = Literal['publisher', 'subscription']

UNLIMITED = 2**63 - 1
"""RMW_DURATION_INFINITE, ns."""

PREFIX = 'qos_overrides.'


def overriding_options(node: Node, topic: str, kind: Kind) -> QoSOverridingOptions | None:
    """Return the policies of an endpoint that the user overrides, None without any.

    Parameters are declared for these policies only, as ``qos_overrides.<topic>.<kind>.<policy>``.
    ParameterError for an override with an unknown policy or value.
    """
    prefix = f'{PREFIX}{node.resolve_topic_name(topic)}.{kind}.'
    overrides = node._parameter_overrides  # rclpy has no public access to them
    given = [name for name in overrides if name.startswith(prefix)]
    kinds = [
        _policy_kind(name, name.removeprefix(prefix), overrides[name].value) for name in given
    ]
    return QoSOverridingOptions(kinds) if kinds else None


def _policy_kind(parameter: str, policy: str, value: object) -> QoSPolicyKind:
    known = [kind.name.lower() for kind in QoSPolicyKind if kind is not QoSPolicyKind.INVALID]
    if policy not in known:
        raise ParameterError(f'{parameter} must end with one of {", ".join(known)}: got {policy}')
    choices = {
        'reliability': ReliabilityPolicy,
        'durability': DurabilityPolicy,
        'history': HistoryPolicy,
    }
    if policy in choices:
        names = [choice.lower() for choice in choices[policy].__members__ if choice != 'UNKNOWN']
        if value not in names:
            raise ParameterError(f'{parameter} must be one of {", ".join(names)}: got {value!r}')
    return QoSPolicyKind[policy.upper()]


def unused_overrides(node: Node) -> list[str]:
    """Return the QoS overrides that match no publisher and no subscription of the node."""
    return [
        name
        for name in node._parameter_overrides
        if name.startswith(PREFIX) and not node.has_parameter(name)
    ]


class PolledCallbackGroup(CallbackGroup):
    """A callback group whose entities no executor waits for.

    The events executor asks no callback group: a node leaves them out of its subscriptions.
    """

    def can_execute(self, entity: object) -> bool:
        """Return False: the executor does not wait for the entity."""
        return False

    def beginning_execution(self, entity: object) -> bool:
        """Return False: the executor does not run the entity."""
        return False

    def ending_execution(self, entity: object) -> None:
        """Do nothing: no entity is executed."""


def unused_callback(message: object) -> None:
    """Fill the mandatory callback argument of rclpy in a :class:`PolledCallbackGroup`."""


def take_with_info(subscription: Subscription) -> list[tuple[Any, dict[str, Any]]]:
    """Return the messages that wait, each with its information, as the time of its publication."""
    messages: list[tuple[Any, dict[str, Any]]] = []
    handle = subscription.handle
    with handle:
        while len(messages) < subscription.qos_profile.depth:
            if (item := handle.take_message(subscription.msg_type, subscription.raw)) is None:
                break
            messages.append(item)
    return messages


LEASE = 20.0
"""Time after which a node that was killed leaves the graph, s: the default of Fast DDS."""


class PublicationSequence:
    """Decides from the sequence numbers of a topic whether several publishers are alive.

    Each publisher counts its own messages, and rclpy does not identify the publisher of a message.
    The number falls once when a publisher is replaced, and again and again while two publish.
    """

    def __init__(self) -> None:
        self._last = 0
        self._falls = 0

    def add(self, number: int | None) -> None:
        """Add the sequence number of a message; None where the middleware has none."""
        if number is not None:
            self._falls += number <= self._last
            self._last = number

    def has_several_publishers(self) -> bool:
        """Return whether several published since the last call."""
        falls, self._falls = self._falls, 0
        return falls > 1


def publishers_problem(node: Node, topic: str, *, alive: bool) -> str:
    """Return the publishers of a topic if there are several, or nothing.

    alive : whether several are known to publish
    """
    names = sorted(map(node_of, node.get_publishers_info_by_topic(topic)))
    if len(names) < 2:
        return ''
    text = f'{topic} has {len(names)} publishers: {", ".join(names)}; stop all but one'
    return text if alive else f'{text}; one that was killed leaves this list within {LEASE:g} s'


def qos_problem(node: Node, endpoints: Iterable[Any], kind: Kind) -> str:
    """Return the first QoS mismatch between endpoints of a node and their peers, or nothing."""
    for endpoint in endpoints:
        name, own = endpoint.topic_name, endpoint.qos_profile
        if kind == 'publisher':
            peers = node.get_subscriptions_info_by_topic(name)
            pairs = [(own, peer.qos_profile) for peer in peers]
        else:
            peers = node.get_publishers_info_by_topic(name)
            pairs = [(peer.qos_profile, own) for peer in peers]
        for peer, (offered, requested) in zip(peers, pairs, strict=True):
            result, reason = qos_check_compatible(_comparable(offered), _comparable(requested))
            if result == QoSCompatibility.ERROR:
                return _mismatch(name, peer, reason)
    return ''


def _comparable(profile: QoSProfile) -> QoSProfile:
    """Return a profile with 0, as in a default profile, for the infinite times of the graph."""
    result = copy(profile)
    for name in ('deadline', 'lifespan', 'liveliness_lease_duration'):
        if getattr(profile, name).nanoseconds == UNLIMITED:
            setattr(result, name, Duration())
    return result


def _mismatch(topic: str, peer: TopicEndpointInfo, reason: str) -> str:
    policies = reason.removeprefix('ERROR: ').strip('; ').replace('; ERROR:', ',')
    return f'no message passes between {node_of(peer)} and this node on {topic}: {policies}'


def full_name(namespace: str, name: str) -> str:
    """Return the full name of a node."""
    return f'{namespace.rstrip("/")}/{name}'


def node_of(info: TopicEndpointInfo) -> str:
    """Return the full name of the node of an endpoint."""
    return full_name(info.node_namespace, info.node_name)


RECORDERS = ('recorder', 'rosbag2_recorder')
"""Nodes that subscribe to a topic with the type that they find or expect."""


def command_types(node: Node, topic: str) -> set[str]:
    """Return the message types that the robots on a command topic expect."""
    peers: list[TopicEndpointInfo] = node.get_subscriptions_info_by_topic(topic)
    return {peer.topic_type for peer in peers if peer.node_name not in RECORDERS}


def command_type_problem(node: Node, message: type, *, publish: bool) -> str:
    """Return why a node and its peers use ``cmd_vel`` with different types; empty if equal.

    ROS 2 connects endpoints of equal type only and reports nothing when the types differ.
    """
    name = node.resolve_topic_name('cmd_vel')
    peers: list[TopicEndpointInfo] = (
        node.get_subscriptions_info_by_topic(name)
        if publish
        else node.get_publishers_info_by_topic(name)
    )
    expected = ros_messages.type_name(message)
    other = next((peer.topic_type for peer in peers if peer.topic_type != expected), '')
    if not other:
        return ''
    action = 'expects' if publish else 'publishes'
    return f'another node {action} {other} on cmd_vel: set enable_stamped_cmd_vel'
