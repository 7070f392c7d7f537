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
"""Radio of nRF24L01+ transceivers, packet by packet, with data-sheet timing.

Each dongle and its robot have a channel; the medium joins those of several. A packet reaches every
robot of its frequency, rate and address. Packets that overlap at one frequency are all lost.

nRF24L01+ product specification 1.0: 7.4 (retransmission), 7.5 (acknowledgement with payload),
6.1.7 (timing).
"""

from collections.abc import Callable, Sequence
import random
from typing import NamedTuple

from t3mpc_ros.emulator.event_queue import MICROSECOND, EventQueue
from t3mpc_ros.emulator.fault_injection import FaultInjection

SETTLE_US = 130.0  # transmitter settling time, standby to first bit
_BITS_PER_US = (0.25, 1.0, 2.0)
_OVERHEAD = 1 + 5 + 2  # bytes of preamble, address and CRC
_CONTROL_BITS = 9
_DELAY_UNIT_US = 250.0
_CAPTURE_SHARE = 0.5
"""Share of simultaneous acknowledgements of which one is received, the stronger one; assumed."""
_LONGEST_NS = 2_000_000  # no packet is longer

ExchangeCallback = Callable[[bool, int, bytes], None]
"""Called with: acknowledged, number of retransmissions, payload of the acknowledgement."""


class RadioParameters(NamedTuple):
    """Configuration of a transceiver, with the fields of a CFG frame."""

    channel: int = 82
    rate: int = 1
    power: int = 3
    retry_delay: int = 1
    retries: int = 4
    address: bytes = b'T3MPC'

    def air_us(self, size: int) -> float:
        """Return the on-air time of a payload of ``size`` bytes."""
        return (8 * (_OVERHEAD + size) + _CONTROL_BITS) / _BITS_PER_US[self.rate]

    @property
    def retry_delay_us(self) -> float:
        """Delay from the end of a packet to the start of its retransmission."""
        return _DELAY_UNIT_US * (self.retry_delay + 1)

    def matches(self, other: 'RadioParameters') -> bool:
        """Return whether two transceivers receive each other."""
        own = self.channel, self.rate, self.address
        return own == (other.channel, other.rate, other.address)


class Transmission(NamedTuple):
    """A packet in the air."""

    frequency: int
    start_ns: int
    end_ns: int

    def overlaps(self, other: 'Transmission') -> bool:
        """Return whether both are in the air at one time, at one frequency."""
        return (
            self.frequency == other.frequency
            and self.start_ns < other.end_ns
            and other.start_ns < self.end_ns
        )


class Medium:
    """What transceivers in range share: time, which all advance together, and who transmits."""

    def __init__(self, now_ns: int = 0, seed: int = 1) -> None:
        self.events = EventQueue(now_ns)
        self.channels: list[RadioChannel] = []  # of all robots
        self._generator = random.Random(f'capture {seed}')
        self._transmissions: list[Transmission] = []

    def transmit(self, frequency: int, delay_us: float, air_us: float) -> Transmission:
        """Note a transmission that begins ``delay_us`` from now."""
        now_ns = self.events.now_ns
        start_ns = now_ns + round(delay_us * MICROSECOND)
        new = Transmission(frequency, start_ns, start_ns + round(air_us * MICROSECOND))
        self._transmissions = [
            each for each in self._transmissions if each.end_ns > now_ns - _LONGEST_NS
        ]
        self._transmissions.append(new)
        return new

    def is_disturbed(self, transmission: Transmission) -> bool:
        """Return whether another transmission overlaps one that has ended."""
        return any(
            other is not transmission and other.overlaps(transmission)
            for other in self._transmissions
        )

    def strongest(self, replies: Sequence[bytes]) -> bytes | None:
        """Return the acknowledgement that is received of simultaneous ones; None if none is."""
        if len(replies) < 2:
            return replies[0] if replies else None
        if self._generator.random() >= _CAPTURE_SHARE:
            return None
        return self._generator.choice(replies)


class RadioChannel:
    """Carries packets from the dongle to the robot, and acknowledgements back.

    ``advance_robot`` advances the robot to now and returns whether its receiver is on;
    ``deliver`` receives each payload that reaches it. Two numbers of its own generator are
    drawn per transmission, whatever the faults.
    """

    def __init__(
        self,
        medium: Medium,
        robot: RadioParameters,
        advance_robot: Callable[[], bool],
        deliver: Callable[[bytes], None],
        faults: FaultInjection,
        generator: random.Random,
    ) -> None:
        self.medium = medium
        medium.channels.append(self)
        self.robot = robot  # configuration of the robot's transceiver, which follows its settings
        self._advance_robot = advance_robot
        self._deliver = deliver
        self._faults = faults
        self._generator = generator
        self._ack_payload: bytes | None = None
        self._fetched = False

    def load(self, payload: bytes) -> None:
        """Replace the acknowledgement payload: the robot flushes its FIFO before each load."""
        self._ack_payload, self._fetched = payload, False

    def clear(self) -> None:
        """Discard the acknowledgement payload, as on loss of power."""
        self._ack_payload = None

    def send(self, payload: bytes, radio: RadioParameters, done: ExchangeCallback) -> None:
        """Send a packet with automatic retransmission; call ``done`` with the outcome."""
        _Exchange(self, payload, radio, done).transmit(SETTLE_US)

    def _receive(
        self, payload: bytes, radio: RadioParameters, repeated: bool, disturbed: bool
    ) -> bytes | None:
        """Return the payload of the robot's acknowledgement; None if it received nothing.

        A repeated packet (same PID and CRC) is acknowledged and dropped. A fetched payload stays
        in the FIFO until a packet with a new PID confirms its reception.
        """
        receives = self._advance_robot() and radio.matches(self.robot)
        lost = self._generator.random() < self._faults.combined_probability('loss', 'loss_down')
        if not receives or lost or disturbed or self._faults.active('jam'):
            return None
        if not repeated and self._fetched:
            self._ack_payload = None
        reply = self._ack_payload or b''
        self._fetched = True
        if not repeated:
            self._deliver(self._faults.corrupt(payload))
        return self._faults.corrupt(reply)

    def _acknowledgement_arrives(self) -> bool:
        lost = self._generator.random() < self._faults.combined_probability('loss', 'loss_up')
        return not lost and not self._faults.active('jam')


class _Exchange:
    """One packet with its retransmissions and its acknowledgement."""

    def __init__(
        self, channel: RadioChannel, payload: bytes, radio: RadioParameters, done: ExchangeCallback
    ) -> None:
        self._channel = channel
        self._medium = channel.medium
        self._payload = payload
        self._radio = radio
        self._done = done
        self._received: set[RadioChannel] = set()  # channels whose robot has received the packet
        self._retransmissions = 0

    def transmit(self, delay_us: float) -> None:
        """Send the packet ``delay_us`` from now."""
        air_us = self._radio.air_us(len(self._payload))
        packet = self._medium.transmit(self._radio.channel, delay_us, air_us)
        self._medium.events.schedule_after(delay_us + air_us, lambda: self._arrive(packet))

    def _arrive(self, packet: 'Transmission') -> None:
        replies = self._receive_everywhere(self._medium.is_disturbed(packet))
        acknowledged = self._channel._acknowledgement_arrives()
        reply = self._medium.strongest(replies)
        if reply is not None and acknowledged:
            air_us = self._radio.air_us(len(reply))
            # The retransmission cuts off an acknowledgement longer than the delay.
            if SETTLE_US + air_us <= self._radio.retry_delay_us:
                answer = self._medium.transmit(self._radio.channel, SETTLE_US, air_us)
                after_us = SETTLE_US + air_us
                self._medium.events.schedule_after(
                    after_us, lambda: self._finish(answer, reply, after_us)
                )
                return
        self._retry(0.0)

    def _receive_everywhere(self, disturbed: bool) -> list[bytes]:
        """Return the acknowledgement of each robot that receives the packet."""
        replies = []
        for channel in self._medium.channels:
            if channel is not self._channel and not self._radio.matches(channel.robot):
                continue
            repeated = channel in self._received
            reply = channel._receive(self._payload, self._radio, repeated, disturbed)
            if reply is not None:
                self._received.add(channel)
                replies.append(reply)
        return replies

    def _finish(self, answer: 'Transmission', reply: bytes, passed_us: float) -> None:
        if self._medium.is_disturbed(answer):
            self._retry(passed_us)
        else:
            self._done(True, self._retransmissions, reply)

    def _retry(self, passed_us: float) -> None:
        """Retransmit after the retry delay, of which this time has passed, or give up."""
        delay_us = self._radio.retry_delay_us - passed_us
        if self._retransmissions < self._radio.retries:
            self._retransmissions += 1
            self.transmit(delay_us)
        else:
            self._medium.events.schedule_after(
                delay_us, lambda: self._done(False, self._retransmissions, b'')
            )
