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
"""Tools for a graph without a ROS installation: topics, parameters, services, e-stop.

Words and output are those of ``ros2 topic``, ``ros2 param`` and ``ros2 service call``.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
import math
import os
import time
from typing import Any

import numpy as np
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
)
from rclpy.client import Client
from rclpy.exceptions import NameValidationException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.validate_topic_name import validate_topic_name
from std_srvs.srv import SetBool
import yaml

from t3mpc_ros.nodes import topic_endpoints
from t3mpc_ros.nodes.node_main import isolation, own_context
from t3mpc_ros.nodes.remote_parameters import (
    parameter_message,
    parameter_row,
    plain_value,
    refusal,
    type_text,
)
from t3mpc_ros.nodes.ros_messages import message_class

QUIET = 3.5
"""Time without a change of the graph after which a list of it is as good as complete, s: a lost
message of discovery is repeated after 3 s."""
DISCOVERY = 6.0
"""Longest wait for that, and for something that is asked for by name, s."""
REPLY = 5.0
"""Longest wait for the answer of a service, s."""
E_STOP = 'e_stop'
UNKNOWN = 'NODE_NAME_UNKNOWN'
"""In the name of a node that is not known yet."""

_WORDS = {'bool': 'Boolean', 'int': 'Integer', 'float': 'Double', 'str': 'String'}
"""Words of ``ros2 param`` for the types of parameters."""


class GraphError(RuntimeError):
    """Something asked of the graph that it does not have, or an answer that did not come."""


class Graph:
    """A node, spun by nothing else, that examines the graph; ``stop`` ends every wait."""

    def __init__(self, node: Node, stop: Callable[[], bool] = lambda: False) -> None:
        self._node = node
        self._stop = stop
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)

    def discover(self, meanwhile: Callable[[], None] = lambda: None) -> None:
        """Wait until there are nodes, and nothing was discovered for :data:`QUIET`.

        After a fixed time some were missing, or all. ``meanwhile`` is called again and again.
        """
        begin = since = time.monotonic()
        known = self._contents()

        def settled() -> bool:
            nonlocal known, since
            meanwhile()
            now, contents = time.monotonic(), self._contents()
            if contents != known:
                known, since = contents, now
            return now - (since if self._others() else begin + DISCOVERY - QUIET) >= QUIET

        self._spin_until(settled, DISCOVERY + QUIET)

    def _contents(self) -> object:
        """Return what is known of the graph."""
        node, ends = self._node, []
        for name, _ in node.get_topic_names_and_types():
            ends.append((name, node.count_publishers(name), node.count_subscribers(name)))
        return self._others(), [*self.services()], ends

    def _others(self) -> set[str]:
        """Return the full names of the other nodes."""
        names = {
            topic_endpoints.full_name(where, name)
            for name, where in self._node.get_node_names_and_namespaces()
        }
        return names - {self._node.get_fully_qualified_name()}

    def close(self) -> None:
        """End the executor."""
        self._executor.remove_node(self._node)
        self._executor.shutdown()

    def _spin_until(self, done: Callable[[], bool], seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while not self._stop() and time.monotonic() < deadline:
            if done():
                return True
            self._executor.spin_once(timeout_sec=0.05)
        return done()

    # -- topics -----------------------------------------------------------------------------------

    def topics(self) -> Mapping[str, Sequence[str]]:
        """Return the types of each topic, without those of this node alone.

        GraphError if there is no other node.
        """
        self.nodes()
        own = {'/rosout', '/parameter_events'}
        found = dict(self._node.get_topic_names_and_types())
        return {
            name: kinds
            for name, kinds in sorted(found.items())
            if name not in own or self._node.count_publishers(name) > 1
        }

    def _resolved(self, topic: str) -> str:
        """Return the full name of a topic; NameValidationException if it cannot be one."""
        validate_topic_name(topic)
        return self._node.resolve_topic_name(topic)

    def topic_text(self, topic: str) -> str:
        """Return types, publishers and subscriptions of a topic, a node a line, with their QoS.

        GraphError if neither is there.
        """
        name = self._resolved(topic)
        node = self._node
        self.discover()
        ends: dict[str, Sequence[TopicEndpointInfo]] = {}

        def named() -> bool:
            ends['publishers'] = node.get_publishers_info_by_topic(name)
            ends['subscriptions'] = node.get_subscriptions_info_by_topic(name)
            return not any(UNKNOWN in each.node_name for found in ends.values() for each in found)

        self._spin_until(named, DISCOVERY)  # the name of a node follows what it publishes
        kinds = sorted({info.topic_type for found in ends.values() for info in found})
        if not kinds:
            raise GraphError(f'nothing publishes or receives {name} (t3mpc topic list)')
        lines = [f'type: {", ".join(kinds)}']
        for word, found in ends.items():
            lines.append(f'{word}: {len(found)}')
            lines += sorted(f'  {_end_text(info)}' for info in found)
        return '\n'.join(lines)

    def messages(self, topic: str) -> Iterator[Any]:
        """Yield the messages of a topic from now on, and None about twenty times a second.

        The request matches the offers of the publishers. GraphError if nothing publishes the
        topic, or its type is not installed or not unique.
        """
        name = self._resolved(topic)
        self._spin_until(lambda: self._node.count_publishers(name) > 0, DISCOVERY)
        offers = self._node.get_publishers_info_by_topic(name)
        kinds = sorted({info.topic_type for info in offers})
        if len(kinds) != 1:
            known = f'its types are {", ".join(kinds)}' if kinds else 'nothing publishes it'
            raise GraphError(f'no messages of {name}: {known} (t3mpc topic list)')
        try:
            kind = message_class(kinds[0])
        except ImportError as error:
            raise GraphError(f'the type of {name} is not installed: {error}') from None
        waiting: deque[Any] = deque()
        profile = topic_endpoints.adapt_request_to_offers([info.qos_profile for info in offers])
        subscription = self._node.create_subscription(
            kind, name, lambda message: waiting.append(message), profile
        )
        try:
            while not self._stop():
                self._executor.spin_once(timeout_sec=0.05)
                while waiting:
                    yield waiting.popleft()
                yield None
        finally:
            self._node.destroy_subscription(subscription)

    # -- parameters -------------------------------------------------------------------------------

    def nodes(self) -> Sequence[str]:
        """Return the full names of the other nodes; GraphError if there is none."""
        self.discover()
        if not self._others():
            domain = os.environ.get('ROS_DOMAIN_ID', '0')
            server = os.environ.get('ROS_DISCOVERY_SERVER', '')
            reason = isolation(os.environ) or (
                f'is ROS_DOMAIN_ID, {domain} here, that of the nodes, '
                + f'does ROS_DISCOVERY_SERVER, {server} here, run, ' * bool(server)
                + 'and is the network up?'
            )
            raise GraphError(f'no node was discovered within {DISCOVERY:g} s: {reason}')
        return sorted(self._others())

    def parameter_names(self, node: str) -> Sequence[str]:
        """Return the names of the parameters of a node, sorted."""
        answer = self.call(f'{node}/list_parameters', ListParameters, ListParameters.Request())
        return sorted(answer.result.names)

    def parameter_text(self, node: str, name: str) -> str:
        """Return a value with its type, as ros2 param does; errors as of :meth:`call`."""
        value = self._parameter(node, name)
        *many, kind = type_text(value.type).split(' of ')
        return f'{_WORDS[kind]} {"values are" if many else "value is"}: {plain_value(value)}'

    def parameter_description(self, node: str, name: str) -> str:
        """Return what a parameter is: text, type, unit, range or choices, whether dynamic."""
        value = self._parameter(node, name)
        request = DescribeParameters.Request(names=[name])
        answer = self.call(f'{node}/describe_parameters', DescribeParameters, request)
        row = parameter_row(answer.descriptors[0], value)
        lines = [f'{name}: {row["text"]}', f'  type: {row["type"]}', f'  value: {row["value"]}']
        bounds = {'unit': row['unit'], 'least': row['low'], 'largest': row['high']}
        lines += [f'  {word}: {each}' for word, each in bounds.items() if each not in ('', None)]
        if row['choices']:
            lines.append(f'  one of: {", ".join(row["choices"])}')
        lines.append(f'  can be set while the node runs: {"yes" if row["dynamic"] else "no"}')
        return '\n'.join(lines)

    def set_parameter(self, node: str, name: str, value: object) -> str:
        """Set a parameter; return the reason of a refusal, or nothing.

        ValueError if the value cannot be one of its type; errors as of :meth:`call`.
        """
        message = parameter_message(name, self._parameter(node, name).type, value)
        request = SetParameters.Request(parameters=[message])
        return refusal(self.call(f'{node}/set_parameters', SetParameters, request))

    def _parameter(self, node: str, name: str) -> ParameterValue:
        request = GetParameters.Request(names=[name])
        values = self.call(f'{node}/get_parameters', GetParameters, request).values
        if not values or type_text(values[0].type) == 'unset':
            raise GraphError(f'{node} has no parameter {name} (t3mpc param list {node})')
        return values[0]

    # -- services ---------------------------------------------------------------------------------

    def services(self) -> Mapping[str, Sequence[str]]:
        """Return the types of each service."""
        return dict(sorted(self._node.get_service_names_and_types()))

    def call(self, name: str, kind: type, request: Any) -> Any:
        """Return the answer of a service; GraphError if no node offers it, or none comes."""
        client = self._node.create_client(kind, name)
        try:
            if not self._spin_until(client.service_is_ready, DISCOVERY):
                raise GraphError(f'no node offers the service {client.srv_name}')
            future = client.call_async(request)
            if not self._spin_until(future.done, REPLY):
                raise GraphError(f'no answer of {client.srv_name} within {REPLY:g} s')
            return future.result()
        finally:
            self._node.destroy_client(client)

    def call_by_name(self, name: str, values: Mapping[str, object]) -> Any:
        """Return the answer of a service whose type the graph knows; fields by name.

        GraphError also if its type is not installed, or a field does not fit.
        """
        full = self._node.resolve_service_name(name)
        self._spin_until(lambda: full in self.services(), DISCOVERY)
        kinds = self.services().get(full)
        if not kinds:
            raise GraphError(f'no node offers the service {full}')
        try:
            kind: Any = message_class(kinds[0])
        except ImportError:
            raise GraphError(f'the type of {full} is not installed: {kinds[0]}') from None
        request = kind.Request(check_fields=True)
        for field, value in values.items():
            if field not in request.get_fields_and_field_types():
                known = ', '.join(request.get_fields_and_field_types()) or 'none'
                raise GraphError(f'{kinds[0]} has no field {field}; its fields: {known}')
            try:
                setattr(request, field, value)
            except AssertionError as error:
                raise GraphError(f'{field} of {kinds[0]}: {error}') from None
        return self.call(full, kind, request)

    def stop_robots(self) -> Mapping[str, str]:
        """Latch the e-stop of every robot in reach; return the problem of each, or nothing.

        Each is asked as soon as it is discovered.
        """
        clients: dict[str, Client] = {}
        sent: dict[str, Future] = {}

        def ask() -> None:
            for name in self._e_stops():
                if name not in clients:
                    clients[name] = self._node.create_client(SetBool, name)
            for name, client in clients.items():
                if name not in sent and client.service_is_ready():
                    sent[name] = client.call_async(SetBool.Request(data=True))

        self.discover(ask)

        def answered() -> bool:
            ask()
            return sent.keys() == clients.keys() and all(each.done() for each in sent.values())

        self._spin_until(answered, REPLY)
        problems = {}
        for name, client in clients.items():
            answer = sent[name].result() if name in sent and sent[name].done() else None
            problems[name] = (
                f'no answer within {REPLY:g} s'
                if answer is None
                else ''
                if answer.success
                else answer.message
            )
            self._node.destroy_client(client)
        return problems

    def _e_stops(self) -> Sequence[str]:
        return [
            name
            for name, kinds in self.services().items()
            if name.rpartition('/')[2] == E_STOP and 'std_srvs/srv/SetBool' in kinds
        ]


@contextmanager
def graph(stop: Callable[[], bool] = lambda: False) -> Iterator[Graph]:
    """Return a graph in a context of its own, which ends with the ``with`` block.

    GraphError in place of the text of several lines on a name that cannot be.
    """
    options = {'start_parameter_services': False, 'enable_rosout': False}
    with own_context(lambda: Node('t3mpc', **options)) as node, closing(Graph(node, stop)) as made:
        try:
            yield made
        except NameValidationException as error:
            raise GraphError(' '.join(str(error).split()).rstrip('^ ')) from None


def _end_text(info: TopicEndpointInfo) -> str:
    """Return a publisher or subscription: its node, and what it offers or requests."""
    profile = info.qos_profile
    policies = (profile.reliability, profile.durability)
    words = ', '.join(each.short_key.replace('_', ' ') for each in policies)
    return f'{topic_endpoints.node_of(info)} ({info.topic_type}; {words})'


def plain(message: Any) -> Any:
    """Return a message as dictionaries, lists and numbers, fields in their order."""
    if hasattr(message, 'get_fields_and_field_types'):
        names = message.get_fields_and_field_types()
        return {name: plain(getattr(message, name)) for name in names}
    if isinstance(message, bytes):
        return int.from_bytes(message, 'little')
    if isinstance(message, np.generic):  # of an array, a covariance say
        return message.item()
    if isinstance(message, bool | int | float | str):
        return message
    return [plain(each) for each in message]


def message_text(message: Any, field: str = '') -> str:
    """Return a message, or one of its fields (``pose.pose.position``), as YAML."""
    for name in field.split('.') if field else ():
        known = getattr(message, 'get_fields_and_field_types', dict)()
        if name not in known:
            raise GraphError(f'no field {name}; its fields: {", ".join(known) or "none"}')
        message = getattr(message, name)
    shown = plain(message)
    if not isinstance(shown, dict | list):
        return f'{shown}\n'
    text: str = yaml.safe_dump(shown, sort_keys=False, allow_unicode=True)
    return text


def rate_text(times: Sequence[float]) -> str:
    """Return rate, least and largest period and their deviation of arrivals, s; '' of one."""
    if len(times) < 2:
        return ''
    periods = np.diff(times)
    mean = float(periods.mean())
    rate = 1.0 / mean if mean > 0.0 else math.inf
    return (
        f'average rate: {rate:.3f}\n'
        f'\tmin: {periods.min():.3f}s max: {periods.max():.3f}s '
        f'std dev: {periods.std():.5f}s window: {len(times)}'
    )
