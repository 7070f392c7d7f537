# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Carries a task out at a real port on the wall clock, until it is done or interrupted."""

from collections.abc import Callable
import select
import time

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.radio.bench.errand import Task
from t3mpc_ros.radio.host.port import Port, PortError
from t3mpc_ros.radio.link.words import Close, Deed, Open, Wait, Write

_LOOK = 0.05
"""s: an interruption is heard so soon."""
GOODBYE_NS = 3 * NANOSECONDS
"""What a task gets for putting things back, a robot for coming to rest."""


def carry_out(
    task: Task, path: str, interrupted: Callable[[], bool], device: str = 'the dongle'
) -> None:
    """Do the task at the port ``path`` of a device; ``interrupted`` is asked 20 times a second."""
    courier = _Courier(task, path, device)
    until_ns: int | None = None
    try:
        received = b''
        while not task.done:
            now_ns = time.monotonic_ns()
            if interrupted() and until_ns is None:
                until_ns = now_ns + GOODBYE_NS
                task.interrupt(now_ns)
            if until_ns is not None and now_ns > until_ns:
                return
            received = courier.listen(courier.do(task.step(now_ns, received)))
        courier.do(task.step(time.monotonic_ns()))
    finally:
        courier.close()


class _Courier:
    def __init__(self, task: Task, path: str, device: str) -> None:
        self._task = task
        self._path = path
        self._device = device
        self._port: Port | None = None

    def do(self, deeds: list[Deed]) -> int:
        """Do the deeds; return when the task wants to be asked again."""
        wake_ns = time.monotonic_ns()
        for deed in deeds:
            try:
                if isinstance(deed, Wait):
                    wake_ns = deed.until_ns
                elif isinstance(deed, Open):
                    self._port = Port(self._path, self._device)
                    self._task.opened(time.monotonic_ns())
                    return time.monotonic_ns()
                elif isinstance(deed, Write) and self._port is not None:
                    self._port.write(deed.data)
                elif isinstance(deed, Close):
                    self.close()
            except PortError as error:
                self._lose(error)
                return time.monotonic_ns()
        return wake_ns

    def listen(self, until_ns: int) -> bytes:
        """Return what arrives before then."""
        wait = min(max((until_ns - time.monotonic_ns()) / NANOSECONDS, 0.0), _LOOK)
        if self._port is None:
            time.sleep(wait)
            return b''
        try:
            ready, _, _ = select.select([self._port], [], [], wait)
            return self._port.read() if ready else b''
        except PortError as error:
            self._lose(error)
            return b''

    def close(self) -> None:
        """Close the port, if it is open."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def _lose(self, error: PortError) -> None:
        self._port = None
        self._task.failed(str(error), error.absent, time.monotonic_ns())
