# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Radio channel between two nRF24L01+ transceivers, packet by packet, with data-sheet timing.

nRF24L01+ product specification 1.0: 7.4 (retransmission), 7.5 (acknowledgement with payload),
6.1.7 (timing).
"""

from collections.abc import Callable
import random
from typing import NamedTuple

from t3mpc_ros.emulator.event_queue import EventQueue
from t3mpc_ros.emulator.fault_injection import FaultInjection

SETTLE_US = 130.0
"""Transmitter settling time, standby to first bit."""
_BITS_PER_US = (0.25, 1.0, 2.0)
_OVERHEAD = 1 + 5 + 2
"""Bytes of preamble, address and CRC."""
_CONTROL_BITS = 9
_DELAY_UNIT_US = 250.0

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
        return (self.channel, self.rate, self.address) == (
            other.channel,
            other.rate,
            other.address,
        )


class RadioChannel:
    """Carries packets from the dongle to the robot, and acknowledgements back.

    ``advance_robot`` advances the robot to now and returns whether its receiver is on;
    ``deliver`` receives each payload that reaches it. Two numbers of its own generator are
    drawn per transmission, whatever the faults.
    """

    def __init__(
        self,
        events: EventQueue,
        robot: RadioParameters,
        advance_robot: Callable[[], bool],
        deliver: Callable[[bytes], None],
        faults: FaultInjection,
        generator: random.Random,
    ) -> None:
        self._events = events
        self.robot = robot
        """Configuration of the robot's transceiver, which follows its settings."""
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
        _Exchange(self, payload, radio, done).begin()

    def _receive(self, payload: bytes, radio: RadioParameters, repeated: bool) -> bytes | None:
        """Return the payload of the robot's acknowledgement; None if it received nothing.

        A repeated packet (same PID and CRC) is acknowledged and dropped. A fetched payload stays
        in the FIFO until a packet with a new PID confirms its reception.
        """
        receives = self._advance_robot() and radio.matches(self.robot)
        lost = self._generator.random() < self._faults.combined_probability('loss', 'loss_down')
        if not receives or lost or self._faults.active('jam'):
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
        self._payload = payload
        self._radio = radio
        self._done = done
        self._received = False
        self._retransmissions = 0

    def begin(self) -> None:
        arrival = SETTLE_US + self._radio.air_us(len(self._payload))
        self._channel._events.schedule_after(arrival, self._arrive)

    def _arrive(self) -> None:
        radio, events = self._radio, self._channel._events
        reply = self._channel._receive(self._payload, radio, self._received)
        acknowledged = self._channel._acknowledgement_arrives()
        delay = radio.retry_delay_us
        if reply is not None:
            self._received = True
            duration = SETTLE_US + radio.air_us(len(reply))
            # The retransmission cuts off an acknowledgement longer than the delay.
            if acknowledged and duration <= delay:
                count = self._retransmissions
                events.schedule_after(duration, lambda: self._done(True, count, reply))
                return
        if self._retransmissions < radio.retries:
            self._retransmissions += 1
            events.schedule_after(delay + radio.air_us(len(self._payload)), self._arrive)
        else:
            events.schedule_after(delay, lambda: self._done(False, self._retransmissions, b''))
