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
"""Serial line of the emulator: transmission time, order and faults."""

import pytest

from t3mpc_ros.emulator.event_queue import EventQueue
from t3mpc_ros.emulator.fault_injection import FaultInjection, parse_fault
from t3mpc_ros.emulator.serial_line import BYTE_NS, SerialLine

MS = 1_000_000


class Wire:
    """A serial line with faults, and the blocks that it delivers."""

    def __init__(self, *faults, seed=1):
        self.events = EventQueue(0)
        self.faults = FaultInjection(lambda: self.events.now_ns, seed)
        for fault in faults:
            self.faults.add(parse_fault(fault), 0)
        self.received = []
        self.line = SerialLine(self.events, self.faults, self._deliver)

    def _deliver(self, data):
        self.received.append((self.events.now_ns, data))

    def send(self, *blocks, period_ns=MS):
        for block in blocks:
            self.line.send(block)
            self.events.run_to(self.events.now_ns + period_ns)
        self.events.run_to(self.events.now_ns + 10_000 * MS)
        return [data for _, data in self.received]


def test_blocks_are_sent_in_order_at_20_us_per_byte():
    wire = Wire()
    wire.send(bytes(10), bytes(5), period_ns=0)
    assert [at for at, _ in wire.received] == [10 * BYTE_NS, 15 * BYTE_NS]


@pytest.mark.parametrize(
    'fault, smallest, largest, same',
    [
        ('drop_bytes:0:inf:0.1', 850, 950, False),
        ('duplicate_bytes:0:inf:0.1', 1050, 1150, False),
        ('insert_bytes:0:inf:0.1', 1050, 1150, False),
        ('flip_bits:0:inf:0.1', 1000, 1000, False),
        ('split:0:inf:1', 1000, 1000, True),
        ('delay:0:inf:0.5', 1000, 1000, True),
        ('silence:0', 0, 0, False),
        ('reorder:0:inf:0.5', 1000, 1000, False),
    ],
)
def test_effect_of_each_line_fault(fault, smallest, largest, same):
    wire = Wire(fault)
    blocks = [bytes([index]) * 10 for index in range(100)]
    data = b''.join(wire.send(*blocks))
    assert smallest <= len(data) <= largest
    assert (data == b''.join(blocks)) == same


def test_a_stalled_line_delivers_everything_at_its_end():
    wire = Wire('stall:0:1')
    assert wire.send(b'a', b'b', b'c') == [b'a', b'b', b'c']
    assert [at for at, _ in wire.received] == [1000 * MS + n * BYTE_NS for n in (1, 2, 3)]


def test_a_delayed_line_keeps_its_order():
    wire = Wire('delay:0:0.01:0.5')
    assert wire.send(b'a', b'b', period_ns=20 * MS) == [b'a', b'b']
    assert wire.received[0][0] == 500 * MS + BYTE_NS


def test_reordered_frames_swap_in_pairs():
    wire = Wire('reorder:0:inf:1')
    assert wire.send(b'a', b'b', b'c', b'd') == [b'ba', b'dc']


def test_random_sequences_of_faults_are_independent():
    blocks = [bytes([index]) * 10 for index in range(50)]
    alone = Wire('flip_bits:0:inf:0.05').send(*blocks)
    both = Wire('flip_bits:0:inf:0.05', 'delay:0:inf:0.1').send(*blocks)
    assert alone == both
    assert Wire('flip_bits:0:inf:0.05', seed=2).send(*blocks) != alone
