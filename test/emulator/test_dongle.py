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
"""Emulated dongle and radio channel: frames, replies and their timing."""

import pytest

from t3mpc_ros.emulator.dongle import Dongle
from t3mpc_ros.emulator.fault_injection import Fault, FaultInjection
from t3mpc_ros.emulator.nrf24_radio import Medium, RadioChannel, RadioParameters
from t3mpc_ros.radio.protocol.codec import decode_from_dongle, encode
from t3mpc_ros.radio.protocol.frames import Configure, Configured, Ping, Result, Transmit
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame

MS = 1_000_000


class ScriptedGenerator:
    """Random generator with given values; after these, no packet is lost."""

    def __init__(self, *values):
        self.values = list(values)

    def random(self):
        return self.values.pop(0) if self.values else 1.0


class Station:
    """A dongle, and a robot that records the received packets."""

    def __init__(self, *values):
        medium = Medium()
        self.events = medium.events
        self.faults = FaultInjection(lambda: self.events.now_ns, 1)
        self.received = []
        self.replies = []
        self.robot = RadioParameters()
        self.channel = RadioChannel(
            medium,
            self.robot,
            lambda: True,
            self._receive,
            self.faults,
            ScriptedGenerator(*values),
        )
        self.chip_ok = True
        self.dongle = Dongle(self.events, self.channel, lambda: self.chip_ok, self._reply)
        self.decoder = FrameDecoder()

    def _receive(self, payload):
        self.received.append((self.events.now_ns / 1000, payload))

    def _reply(self, data):
        for frame in self.decoder.feed(data):
            self.replies.append((self.events.now_ns / 1000, decode_from_dongle(frame)))

    def write(self, frame):
        data = frame if isinstance(frame, bytes) else encode(frame)
        self.dongle.feed(encode_frame(data))

    def run(self, us):
        self.events.run_to(self.events.now_ns + us * 1000)

    def take_reply(self):
        ((at, frame),) = self.replies
        self.replies.clear()
        return at, frame


CMD, POLL = bytes(14), b'poll'


def test_exchange_timing_is_that_of_the_data_sheet():
    station = Station()
    station.channel.load(bytes(32))
    station.write(Transmit(9, 6, CMD))
    station.run(10_000)
    ((received_us, payload),) = station.received
    at, result = station.take_reply()
    # 130 us, then preamble 1, address 5, control 9 bits, payload and CRC 2 at 1 Mbit/s.
    assert received_us == pytest.approx(140 + 130 + 185)
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
    (first, _), (second, payload) = station.received
    assert payload == POLL
    assert second - first == pytest.approx(130 + 329 + 1700 + 130 + 105)
    assert station.take_reply()[1][1:3] == (0x03, 0x03)


def test_a_reply_is_fetched_once_then_acknowledgements_are_empty():
    station = Station()
    station.channel.load(b'once')
    station.write(Transmit(9, 6, CMD, POLL))
    station.run(10_000)
    result = station.take_reply()[1]
    assert result[1:3] == (0x03, 0x01)
    assert result.payload == b'once'


def test_a_retransmitted_packet_is_delivered_once():
    station = Station(1.0, 0.0, 1.0, 0.0, 1.0, 1.0)
    station.faults.add(Fault('loss', 0.0, value=0.5), 0)
    station.channel.load(b'state')
    station.write(Transmit(9, 6, CMD))
    station.run(10_000)
    assert len(station.received) == 1
    at, result = station.take_reply()
    assert result[1] == 0x23
    assert result.payload == b'state'
    # Each retransmission costs the packet and the delay of 500 us.
    assert at == pytest.approx(140 + 130 + 3 * 185 + 2 * 500 + 130 + 113 + 330, abs=1)


def test_without_receiver_four_retries_and_the_poll_is_skipped():
    station = Station()
    station.faults.add(Fault('jam', 0.0), 0)
    station.write(Transmit(9, 6, CMD, POLL))
    station.run(10_000)
    at, result = station.take_reply()
    assert result == Result(9, 0x44, 0x08, result.dongle_us, b'')
    assert at == pytest.approx(140 + 130 + 5 * 685 + 330)
    assert not station.received


@pytest.mark.parametrize(
    'changed', [{'channel': 83}, {'rate': 2}, {'address': b'other'}, {'retry_delay': 0}]
)
def test_a_radio_with_another_configuration_gets_no_reply(changed):
    """The last one delivers, but 250 us are too short for an acknowledgement of 32 bytes."""
    station = Station()
    station.channel.load(bytes(32))
    parameters = RadioParameters()._replace(**changed)
    station.write(Configure(1, *parameters))
    assert station.take_reply()[1] == Configured(1, *parameters, 1)
    station.write(Transmit(9, 6, CMD))
    station.run(20_000)
    assert station.take_reply()[1][1] == 0x44
    assert len(station.received) == ('retry_delay' in changed)


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
    pong = station.take_reply()[1]
    assert (pong.id, pong.reset_cause) == (2, 2)
    assert pong.time_us == 100_000
