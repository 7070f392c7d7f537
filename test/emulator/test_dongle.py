# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The emulated dongle, line and air alone: frames in, frames out, and when."""

import pytest

from t3mpc_ros.emulator.event_queue import EventQueue
from t3mpc_ros.emulator.fault_injection import (
    FAULT_KINDS,
    Fault,
    FaultError,
    FaultInjection,
    check_fault,
    parse_fault,
)
from t3mpc_ros.emulator.link.dongle import Dongle
from t3mpc_ros.emulator.link.radio_channel import RadioChannel, RadioParameters
from t3mpc_ros.emulator.link.serial_line import BYTE_NS, SerialLine
from t3mpc_ros.radio.protocol.codec import decode_from_dongle, encode
from t3mpc_ros.radio.protocol.frames import Configure, Configured, Ping, Refusal, Result, Transmit
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame

MS = 1_000_000


class Scripted:
    """Dice that fall as they are told; then nothing is lost."""

    def __init__(self, *values):
        self.values = list(values)

    def random(self):
        return self.values.pop(0) if self.values else 1.0


class Station:
    """A dongle, and a robot that only notes what it hears."""

    def __init__(self, *rng):
        self.events = EventQueue(0)
        self.faults = FaultInjection(lambda: self.events.now_ns, 1)
        self.heard = []
        self.replies = []
        self.robot = RadioParameters()
        self.channel = RadioChannel(
            self.events, self.robot, lambda: True, self._hear, self.faults, Scripted(*rng)
        )
        self.chip_ok = True
        self.dongle = Dongle(self.events, self.channel, lambda: self.chip_ok, self._reply)
        self.splitter = FrameDecoder()

    def _hear(self, payload):
        self.heard.append((self.events.now_ns / 1000, payload))

    def _reply(self, data):
        for frame in self.splitter.feed(data):
            self.replies.append((self.events.now_ns / 1000, decode_from_dongle(frame)))

    def write(self, frame):
        data = frame if isinstance(frame, bytes) else encode(frame)
        self.dongle.feed(encode_frame(data))

    def run(self, us):
        self.events.run_to(self.events.now_ns + us * 1000)

    def answer(self):
        ((at, frame),) = self.replies
        self.replies.clear()
        return at, frame


CMD, POLL = bytes(14), b'poll'


def test_exchange_timing_is_that_of_the_data_sheet():
    station = Station()
    station.channel.load(bytes(32))
    station.write(Transmit(9, 6, CMD))
    station.run(10_000)
    ((heard, payload),) = station.heard
    at, result = station.answer()
    # Preamble 1, address 5, control 9 bits, payload, CRC 2, at 1 Mbit/s, after 130 us each.
    assert heard == pytest.approx(140 + 130 + 185)
    assert payload == CMD
    assert at == pytest.approx(140 + 774 + 330)
    assert result[:3] == (9, 0x03, 0x08)
    assert result.payload == bytes(32)


def test_the_second_packet_follows_the_first_reply_after_the_gap():
    station = Station()
    station.channel.load(bytes(32))
    station.write(Transmit(9, 6, CMD, POLL))
    station.run(2000)
    station.channel.load(b'new')
    station.run(10_000)
    (first, _), (second, payload) = station.heard
    assert payload == POLL
    assert second - first == pytest.approx(130 + 329 + 1700 + 130 + 105)
    assert station.answer()[1][1:3] == (0x03, 0x03)


def test_a_reply_is_fetched_once_then_acknowledgements_are_empty():
    station = Station()
    station.channel.load(b'once')
    station.write(Transmit(9, 6, CMD, POLL))
    station.run(10_000)
    result = station.answer()[1]
    assert result[1:3] == (0x03, 0x01)
    assert result.payload == b'once'


def test_a_retransmitted_packet_is_delivered_once():
    station = Station(1.0, 0.0, 1.0, 0.0, 1.0, 1.0)
    station.faults.add(Fault('loss', 0.0, value=0.5), 0)
    station.channel.load(b'state')
    station.write(Transmit(9, 6, CMD))
    station.run(10_000)
    assert len(station.heard) == 1
    at, result = station.answer()
    assert result[1] == 0x23
    assert result.payload == b'state'
    # Each failed try costs the packet and the delay of 500 us.
    assert at == pytest.approx(140 + 130 + 3 * 185 + 2 * 500 + 130 + 113 + 330, abs=1)


def test_without_receiver_four_retries_and_the_poll_is_skipped():
    station = Station()
    station.faults.add(Fault('jam', 0.0), 0)
    station.write(Transmit(9, 6, CMD, POLL))
    station.run(10_000)
    at, result = station.answer()
    assert result == Result(9, 0x44, 0x08, result.dongle_us, b'')
    assert at == pytest.approx(140 + 130 + 5 * 685 + 330)
    assert not station.heard


@pytest.mark.parametrize(
    'changed', [{'channel': 83}, {'rate': 2}, {'address': b'other'}, {'retry_delay': 0}]
)
def test_a_radio_with_another_configuration_gets_no_reply(changed):
    """The last one is: 250 us are too short for an acknowledgement of 32 bytes."""
    station = Station()
    station.channel.load(bytes(32))
    parameters = RadioParameters()._replace(**changed)
    station.write(Configure(1, *parameters))
    assert station.answer()[1] == Configured(1, *parameters, 1)
    station.write(Transmit(9, 6, CMD))
    station.run(20_000)
    assert station.answer()[1][1] == 0x44
    assert len(station.heard) == ('retry_delay' in changed)


def test_nothing_is_queued():
    station = Station()
    station.write(Transmit(9, 6, CMD, POLL))
    station.write(Transmit(10, 6, CMD))
    assert station.answer()[1] == Refusal(3, 10)
    station.write(Configure(11, *RadioParameters()))
    assert station.answer()[1] == Refusal(3, 11)
    station.write(Ping(12, b'ping'))
    assert station.answer()[1].echo == b'ping'
    station.run(20_000)
    assert station.answer()[1].id == 9


def test_a_malformed_frame_is_refused_or_counted():
    station = Station()
    station.write(b'\x05abc')
    assert station.answer()[1] == Refusal(1, 5)
    station.write(b'\x03abc')
    assert station.answer()[1] == Refusal(2, 3)
    station.write(b'\x01\x07\x00\x00')
    assert station.answer()[1] == Refusal(2, 1)
    station.dongle.feed(b'\x04abc\0\x01\0')
    station.write(Ping(1, b'ping'))
    pong = station.answer()[1]
    assert (pong.crc_errors, pong.frame_errors) == (1, 1)


def test_an_exchange_with_a_dead_chip_times_out():
    station = Station()
    station.write(Transmit(9, 6, CMD, POLL))
    station.run(200)
    station.chip_ok = False
    station.run(200_000)
    at, result = station.answer()
    assert result[1:3] == (0x04, 0x08)
    assert at == pytest.approx(140 + 150_000 + 330)


def test_a_booting_dongle_ignores_input_and_ends_its_transaction():
    station = Station()
    station.write(Transmit(9, 6, CMD, POLL))
    station.run(1000)
    station.dongle.boot(2, 1500 * MS)
    station.write(Ping(1, b'ping'))
    station.run(1_400_000)
    station.write(Ping(1, b'ping'))
    assert not station.replies
    station.run(200_000)
    station.write(Ping(2, b'ping'))
    pong = station.answer()[1]
    assert (pong.id, pong.reset_cause) == (2, 2)
    assert pong.time_us == 100_000


# -- line -----------------------------------------------------------------------------------------


class Wire:
    def __init__(self, *faults, seed=1):
        self.events = EventQueue(0)
        self.faults = FaultInjection(lambda: self.events.now_ns, seed)
        for fault in faults:
            self.faults.add(parse_fault(fault), 0)
        self.got = []
        self.line = SerialLine(self.events, self.faults, self._arrive)

    def _arrive(self, data):
        self.got.append((self.events.now_ns, data))

    def send(self, *pieces, every_ns=MS):
        for piece in pieces:
            self.line.send(piece)
            self.events.run_to(self.events.now_ns + every_ns)
        self.events.run_to(self.events.now_ns + 10_000 * MS)
        return [data for _, data in self.got]


def test_blocks_are_sent_in_order_at_20_us_per_byte():
    wire = Wire()
    wire.send(bytes(10), bytes(5), every_ns=0)
    assert [at for at, _ in wire.got] == [10 * BYTE_NS, 15 * BYTE_NS]


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
    pieces = [bytes([index]) * 10 for index in range(100)]
    data = b''.join(wire.send(*pieces))
    assert smallest <= len(data) <= largest
    assert (data == b''.join(pieces)) == same


def test_a_stalled_line_delivers_everything_at_its_end():
    wire = Wire('stall:0:1')
    assert wire.send(b'a', b'b', b'c') == [b'a', b'b', b'c']
    assert [at for at, _ in wire.got] == [1000 * MS + n * BYTE_NS for n in (1, 2, 3)]


def test_a_delayed_line_keeps_its_order():
    wire = Wire('delay:0:0.01:0.5')
    assert wire.send(b'a', b'b', every_ns=20 * MS) == [b'a', b'b']
    assert wire.got[0][0] == 500 * MS + BYTE_NS


def test_reordered_frames_swap_in_pairs():
    wire = Wire('reorder:0:inf:1')
    assert wire.send(b'a', b'b', b'c', b'd') == [b'ba', b'dc']


def test_random_sequences_of_faults_are_independent():
    pieces = [bytes([index]) * 10 for index in range(50)]
    alone = Wire('flip_bits:0:inf:0.05').send(*pieces)
    both = Wire('flip_bits:0:inf:0.05', 'delay:0:inf:0.1').send(*pieces)
    assert alone == both
    assert Wire('flip_bits:0:inf:0.05', seed=2).send(*pieces) != alone


# -- names ----------------------------------------------------------------------------------------


def test_a_fault_is_written_as_name_time_duration_value():
    assert parse_fault('jam:5:1.0') == Fault('jam', 5.0, 1.0, parse_fault('jam:5').value)
    assert parse_fault('loss:5:inf:0.3') == Fault('loss', 5.0, float('inf'), 0.3)
    assert parse_fault('robot_reset:2').duration == 0.5


@pytest.mark.parametrize(
    'text, words',
    [
        ('jamm:5', 'did you mean jam'),
        ('jam', 'name:at'),
        ('jam:1:2:3:4', 'name:at'),
        ('jam:soon', 'numbers'),
        ('jam:-1', 'at least 0 s'),
        ('jam:nan', 'at least 0 s'),
        ('jam:1:0', 'more than 0 s'),
        ('jam:1:1:0.5', 'takes no value'),
        ('loss:1:1:1.5', 'from 0 to 1'),
    ],
)
def test_an_invalid_fault_is_rejected_with_a_reason(text, words):
    with pytest.raises(FaultError, match=words):
        parse_fault(text)


def test_every_fault_has_valid_defaults():
    for kind in FAULT_KINDS:
        fault = check_fault(Fault(kind.name, 0.0))
        assert fault.duration > 0.0
