# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Base class of the nodes: parameters, diagnostics at 1 Hz, shutdown hook."""

from collections.abc import Mapping
from typing import Any, Generic, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher

from t3mpc_ros.nodes.common import parameter_declaration, qos
from t3mpc_ros.parameters.table import Parameters

S = TypeVar('S', bound=Parameters)

OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR

NO_CLOCK = 'the simulated clock has not been heard yet'


class BaseNode(Node, Generic[S]):
    """A node whose parameters are one table of settings, and that says how it is at 1 Hz.

    A subclass overrides :meth:`configure` (live settings have changed), :meth:`health` (what to
    say in ``/diagnostics``) and :meth:`finish` (last words before the process ends).
    """

    def __init__(self, name: str, table: type[S], **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self.exit_code = 0
        """Set to something else to end the process."""
        self.done = False
        """Set to end the process with this exit code."""
        self.parameters: S = parameter_declaration.declare_parameters(self, table, self._on_change)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', qos.DIAGNOSTICS)
        # Wall time, so that the node reports even while the simulated clock stands still.
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._report, clock=self._steady)

    def now_ns(self) -> int:
        """Return the node's time: of the machine, or simulated if ``use_sim_time`` is set."""
        return int(self.get_clock().now().nanoseconds)

    def clock_received(self) -> bool:
        """Whether the node's time means anything: a simulated clock not yet heard says 0."""
        return self.now_ns() != 0

    def steady_ns(self) -> int:
        """Return a time that only ever runs forward, for measuring silence."""
        return int(self._steady.now().nanoseconds)

    def every(self, seconds: float, callback: Any) -> None:
        """Call ``callback`` every so many seconds of the machine's time."""
        self.create_timer(seconds, callback, clock=self._steady)

    def configure(self, parameters: S) -> None:
        """Take over changed live settings."""

    def produce_diagnostics(self) -> tuple[bytes, str, Mapping[str, object]]:
        """Return level, message and values for ``/diagnostics``."""
        return OK, 'running', {}

    def finish(self) -> None:
        """Say the last words: the robot must stand still after this."""

    def _on_change(self, parameters: S) -> None:
        self.parameters = parameters
        self.configure(parameters)

    def _report(self) -> None:
        level, message, values = self.produce_diagnostics()
        status = DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name().lstrip('/'),
            message=message,
            hardware_id='t3mpc_ros',
            values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)


def publish_and_wait_for_acked(publisher: Publisher, message: Any) -> None:
    """Publish ``message`` and wait, at most 0.2 s, until reliable subscribers have it."""
    publisher.publish(message)
    publisher.wait_for_all_acked(Duration(nanoseconds=200_000_000))


def _text(value: object) -> str:
    return f'{value:.6g}' if isinstance(value, float) else str(value)
