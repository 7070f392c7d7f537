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
"""One direction of the serial line: transmission time and faults."""

from collections.abc import Callable

from t3mpc_ros.emulator.event_queue import EventQueue
from t3mpc_ros.emulator.fault_injection import FaultInjection
from t3mpc_ros.geometry.types import NANOSECONDS

BYTE_NS = 20_000  # ten bits at 500 000 baud
_SPLIT_NS = 2_000_000


class SerialLine:
    """Delivers blocks of data to the other end, in order and at the baud rate.

    A block is delivered as a whole when its last byte arrives. ``byte_ns`` is the transmission
    time of a byte, 0 if the baud rate is simulated elsewhere.
    """

    def __init__(
        self,
        events: EventQueue,
        faults: FaultInjection,
        deliver: Callable[[bytes], None],
        byte_ns: int = BYTE_NS,
    ) -> None:
        self._events = events
        self._faults = faults
        self._deliver = deliver
        self._byte_ns = byte_ns
        self._busy_until_ns = 0
        self._held = b''  # frame that the ``reorder`` fault sends after the next one
        self._generation = 0

    def clear(self) -> None:
        """Discard all data in transit."""
        self._generation += 1
        self._held = b''
        self._busy_until_ns = 0

    def send(self, data: bytes) -> None:
        """Send a block of data now."""
        faults = self._faults
        data = self._corrupt(data)
        if not data or faults.active('silence'):
            return
        if self._held:
            data, self._held = data + self._held, b''
        elif faults.occurs('reorder'):
            self._held = data
            return
        if len(data) > 1 and faults.occurs('split'):
            at = faults.generators['split'].randrange(1, len(data))
            self._transmit(data[:at], 0)
            self._transmit(data[at:], _SPLIT_NS)
        else:
            self._transmit(data, 0)

    def _transmit(self, data: bytes, later_ns: int) -> None:
        now = self._events.now_ns
        start = now + later_ns + round(self._faults.value('delay') * NANOSECONDS)
        stall = self._faults.interval('stall')
        if stall is not None:
            start = max(start, round(min(stall.end_ns, now + 1e15)))
        end = max(start, self._busy_until_ns) + self._byte_ns * len(data)
        self._busy_until_ns = end
        generation = self._generation

        def deliver() -> None:
            if generation == self._generation:
                self._deliver(data)

        self._events.schedule(end, deliver)

    def _corrupt(self, data: bytes) -> bytes:
        faults = self._faults
        names = ('drop_bytes', 'flip_bits', 'duplicate_bytes', 'insert_bytes')
        if all(faults.value(name) <= 0.0 for name in names):
            return data
        corrupted = bytearray()
        for value in data:
            byte = value
            if faults.occurs('insert_bytes'):
                corrupted.append(faults.generators['insert_bytes'].randrange(256))
            if faults.occurs('flip_bits'):
                byte ^= 1 << faults.generators['flip_bits'].randrange(8)
            if not faults.occurs('drop_bytes'):
                corrupted.append(byte)
            if faults.occurs('duplicate_bytes'):
                corrupted.append(byte)
        return bytes(corrupted)
