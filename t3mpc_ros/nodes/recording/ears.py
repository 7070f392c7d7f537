# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that are emptied now and then, instead of one callback for each message.

rclpy's executor builds a wait set anew, with every entity of the node, for each message that it
delivers; at 2000 messages a second that alone is more than a core. So the executor never finds
these subscriptions ready (their callback group says no), and a timer takes all that has come
through the call the executor itself uses, ``subscription.handle.take_message(type, raw)``, until
there is no more (rclpy 7.1, ``Executor._take_subscription``). Lateness costs no accuracy: the
stamps of receipt and of publication come with each message, made by the middleware.

The middleware says nothing of what falls out of its queue when it is emptied too late (a reader
with KEEP_LAST replaces its oldest samples, which DDS does not call lost). The publisher's sequence
numbers tell. Losses on the way are asked for through the message-lost event, polled like the rest.
"""

from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import (
    QoSSubscriptionEventType,
    SubscriptionEventCallbacks,
    UnsupportedEventTypeError,
)
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from t3mpc_ros.nodes.plumbing import graph
from t3mpc_ros.record.writing.message import Message

_RECEIVED = attrgetter('received_ns')


class Unattended(CallbackGroup):
    """A callback group whose entities the executor leaves alone."""

    def can_execute(self, entity: object) -> bool:
        """Return False: the executor does not even wait for the entity."""
        return False

    def beginning_execution(self, entity: object) -> bool:
        """Return False: the executor may not run the entity."""
        return False

    def ending_execution(self, entity: object) -> None:
        """Nothing has been executed."""


@dataclass
class Ear:
    """How one topic is listened to."""

    kind: str
    quality: QoSProfile
    subscription: Subscription
    lost_event: Any
    """Handle of the message-lost event, None where the middleware has none."""
    sequence: int | None = None
    """Number that the publisher gave the last message."""


class Ears:
    """The subscriptions of a recorder.

    Parameters
    ----------
    node
        Whose they are.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = Unattended()
        self._ears: dict[str, Ear] = {}
        self._lost: dict[str, int] = {}

    @property
    def lost(self) -> dict[str, int]:
        """Messages of each topic that the middleware has lost, as of :meth:`count_lost`."""
        return dict(self._lost)

    def ear(self, topic: str) -> Ear | None:
        """Return how ``topic`` is listened to, None when it is not."""
        return self._ears.get(topic)

    def kind(self, topic: str) -> str:
        """Return the type in which ``topic`` is listened to."""
        return self._ears[topic].kind

    def listen(self, topic: str, kind: str, profile: QoSProfile) -> None:
        """Listen to ``topic``, in a new way if it was listened to before.

        Raises
        ------
        ImportError
            The type is not installed.
        RCLError
            This process knows the topic with another type.
        """
        message = graph.message_class(kind)
        self.stop(topic)
        subscription = self._node.create_subscription(
            message,
            topic,
            _never_called,
            profile,
            callback_group=self._group,
            # Offers that do not fit are looked for in the graph, and the profile is changed.
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            raw=True,
        )
        self._ears[topic] = Ear(kind, profile, subscription, _lost_event(subscription))

    def stop(self, topic: str) -> None:
        """Listen to ``topic`` no longer; what has come and was not taken is lost."""
        if ear := self._ears.pop(topic, None):
            self._count_lost(topic, ear)
            if ear.lost_event is not None:
                ear.lost_event.destroy_when_not_in_use()
            self._node.destroy_subscription(ear.subscription)

    def close(self) -> None:
        """Listen to nothing any longer."""
        for topic in list(self._ears):
            self.stop(topic)

    def take(self) -> list[Message]:
        """Return all that has come since the last time, in order of receipt."""
        found: list[Message] = []
        for topic, ear in self._ears.items():
            subscription = ear.subscription
            handle, kind = subscription.handle, subscription.msg_type
            before = len(found)
            with handle:
                while (item := handle.take_message(kind, True)) is not None:
                    data, info = item
                    sequence = info['publication_sequence_number']
                    if len(found) == before:
                        first = sequence
                    found.append(
                        Message(
                            topic,
                            info['received_timestamp'],
                            max(0, info['source_timestamp']),  # a stranger may say anything
                            data,
                        )
                    )
            if (count := len(found) - before) == 0:
                continue
            if count >= ear.quality.depth:
                self._lose(topic, self._fallen_out(ear, first))
            ear.sequence = sequence
        found.sort(key=_RECEIVED)
        return found

    def count_lost(self) -> None:
        """Ask the middleware what it has lost since the last time."""
        for topic, ear in self._ears.items():
            self._count_lost(topic, ear)

    def _count_lost(self, topic: str, ear: Ear) -> None:
        if ear.lost_event is not None:
            with ear.lost_event:
                self._lose(topic, ear.lost_event.take_event().total_count_change)

    def _lose(self, topic: str, count: int) -> None:
        if count > 0:
            self._lost[topic] = self._lost.get(topic, 0) + count

    @staticmethod
    def _fallen_out(ear: Ear, first: int | None) -> int:
        """Return how many messages a full queue has lost; 1 where nobody can tell."""
        if ear.sequence is None or first is None or ear.subscription.get_publisher_count() != 1:
            return 1  # each publisher counts for itself, and does not say which one it is
        return max(0, first - ear.sequence - 1)


def _lost_event(subscription: Subscription) -> Any:
    try:
        with subscription.handle:
            return rclpy_implementation.EventHandle(
                subscription.handle, QoSSubscriptionEventType.RCL_SUBSCRIPTION_MESSAGE_LOST
            )
    except UnsupportedEventTypeError:
        return None


def _never_called(data: bytes) -> None:
    """Stand where rclpy wants a callback."""
