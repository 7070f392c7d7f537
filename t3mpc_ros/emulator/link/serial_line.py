# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One direction of the serial line: transmission time and faults."""

from collections.abc import Callable

from t3mpc_ros.emulator.event_queue import EventQueue
from t3mpc_ros.emulator.fault_injection import FaultInjection
from t3mpc_ros.geometry.types import NANOSECONDS

BYTE_NS = 20_000
"""Ten bits at 500 000 baud."""
_SPLIT_NS = 2_000_000


class SerialLine:
    """Brings pieces of data to the other end: in order, at the pace of the line.

    A piece arrives as a whole when its last byte does.

    Parameters
    ----------
    agenda
        Where arrivals are noted.
    faults
        Of the line.
    arrive
        Takes each piece at its time.
    byte_ns
        Time of a byte; 0 where somebody else keeps the pace of the line.
    """

    def __init__(
        self,
        events: EventQueue,
        faults: FaultInjection,
        arrive: Callable[[bytes], None],
        byte_ns: int = BYTE_NS,
    ) -> None:
        self._events = events
        self._faults = faults
        self._arrive = arrive
        self._byte_ns = byte_ns
        self._busy_ns = 0
        """Until when there are bytes on the line."""
        self._held = b''
        self._generation = 0

    def clear(self) -> None:
        """Lose what is on its way."""
        self._generation += 1
        self._held = b''
        self._busy_ns = 0

    def send(self, data: bytes) -> None:
        """Put a piece of data on the line now."""
        faults = self._faults
        data = self._damaged(data)
        if not data or faults.active('silence'):
            return
        if self._held:
            data, self._held = data + self._held, b''
        elif faults.occurs('reorder'):
            self._held = data
            return
        if len(data) > 1 and faults.occurs('split'):
            at = faults.dice['split'].randrange(1, len(data))
            self._put(data[:at], 0)
            self._put(data[at:], _SPLIT_NS)
        else:
            self._put(data, 0)

    def _put(self, data: bytes, later_ns: int) -> None:
        now = self._events.now_ns
        start = now + later_ns + round(self._faults.value('delay') * NANOSECONDS)
        stall = self._faults.span('stall')
        if stall is not None:
            start = max(start, round(min(stall.end_ns, now + 1e15)))
        end = max(start, self._busy_ns) + self._byte_ns * len(data)
        self._busy_ns = end
        generation = self._generation

        def arrive() -> None:
            if generation == self._generation:
                self._arrive(data)

        self._events.at(end, arrive)

    def _damaged(self, data: bytes) -> bytes:
        faults = self._faults
        shares = {
            name: share
            for name in ('drop_bytes', 'flip_bits', 'duplicate_bytes', 'insert_bytes')
            if (share := faults.value(name)) > 0.0
        }
        if not shares:
            return data
        damaged = bytearray()
        for value in data:
            byte = value
            if faults.occurs('insert_bytes'):
                damaged.append(faults.dice['insert_bytes'].randrange(256))
            if faults.occurs('flip_bits'):
                byte ^= 1 << faults.dice['flip_bits'].randrange(8)
            if not faults.occurs('drop_bytes'):
                damaged.append(byte)
            if faults.occurs('duplicate_bytes'):
                damaged.append(byte)
        return bytes(damaged)
