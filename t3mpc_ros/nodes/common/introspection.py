# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Message types by name, and topic types used by other nodes in the graph."""

import importlib

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

RCLError: type[Exception] = rclpy_implementation.RCLError
"""What rclpy raises, among others, for a topic that this process knows with another type."""


def type_name(message: type) -> str:
    """Return ``package/msg/Type`` of a message class."""
    package = message.__module__.split('.', maxsplit=1)[0]
    return f'{package}/msg/{message.__name__}'


def message_class(name: str) -> type:
    """Return the class of ``package/msg/Type``.

    Raises
    ------
    ImportError
        The package is not installed, or has no such type.
    """
    package, _, kind = name.split('/')
    try:
        found: type = getattr(importlib.import_module(f'{package}.msg'), kind)
    except AttributeError as error:
        raise ImportError(f'{package} has no message {kind}') from error
    return found


def mismatched_type(node: Node, topic: str, ours: type, *, subscribers: bool) -> str:
    """Return the type another node uses on ``topic`` instead of ours; empty when none does.

    ROS 2 connects only equal types and says nothing when they differ.
    """
    name = node.resolve_topic_name(topic)
    infos: list[TopicEndpointInfo] = (
        node.get_subscriptions_info_by_topic(name)
        if subscribers
        else node.get_publishers_info_by_topic(name)
    )
    expected = type_name(ours)
    return next((info.topic_type for info in infos if info.topic_type != expected), '')
