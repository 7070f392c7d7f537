# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Message types by name, and the topic types that other nodes in the graph use."""

import importlib

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

RCLError: type[Exception] = rclpy_implementation.RCLError
"""Error of rclpy, among others for a topic that this process uses with another type."""


def type_name(message: type) -> str:
    """Return ``package/msg/Type`` of a message class."""
    package = message.__module__.split('.', maxsplit=1)[0]
    return f'{package}/msg/{message.__name__}'


def message_class(name: str) -> type:
    """Return the class of ``package/msg/Type``.

    Raises
    ------
    ImportError
        The package is not installed, or has no such message.
    """
    package, _, message = name.split('/')
    try:
        found: type = getattr(importlib.import_module(f'{package}.msg'), message)
    except AttributeError as error:
        raise ImportError(f'{package} has no message {message}') from error
    return found


RECORDERS = ('recorder', 'rosbag2_recorder')
"""Nodes that subscribe to a topic with the type that they find or expect."""


def command_types(node: Node, topic: str) -> set[str]:
    """Return the message types that the robots on a command topic expect."""
    peers: list[TopicEndpointInfo] = node.get_subscriptions_info_by_topic(topic)
    return {peer.topic_type for peer in peers if peer.node_name not in RECORDERS}


def command_type_problem(node: Node, message: type, *, publish: bool) -> str:
    """Return why a node and its peers use ``cmd_vel`` with different types; empty if equal.

    ROS 2 connects endpoints of equal type only and reports nothing when the types differ.

    Parameters
    ----------
    node
        The node that publishes or subscribes to ``cmd_vel``.
    message
        Its message class.
    publish
        Whether it publishes; its peers then subscribe.
    """
    name = node.resolve_topic_name('cmd_vel')
    peers: list[TopicEndpointInfo] = (
        node.get_subscriptions_info_by_topic(name)
        if publish
        else node.get_publishers_info_by_topic(name)
    )
    expected = type_name(message)
    other = next((peer.topic_type for peer in peers if peer.topic_type != expected), '')
    if not other:
        return ''
    action = 'expects' if publish else 'publishes'
    return f'another node {action} {other} on cmd_vel: set enable_stamped_cmd_vel'
