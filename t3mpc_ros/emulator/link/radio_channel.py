# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Radio channel between two nRF24L01+ transceivers, packet by packet, with data-sheet timing.

Product specification 1.0: 7.4 (retransmission), 7.5 (acknowledgement with payload), 6.1.7 (timing).
"""

from collections.abc import Callable
import random
from typing import NamedTuple

from t3mpc_ros.emulator.event_queue import EventQueue
from t3mpc_ros.emulator.fault_injection import FaultInjection

SETTLE_US = 130.0
"""From standby to the air."""
_BITS_PER_US = (0.25, 1.0, 2.0)
_OVERHEAD = 1 + 5 + 2
"""Bytes of preamble, address and CRC."""
_CONTROL_BITS = 9
_DELAY_UNIT_US = 250.0

ExchangeCallback = Callable[[bool, int, bytes], None]
"""Told whether a packet was acknowledged, after how many retransmissions, with what payload."""


class RadioParameters(NamedTuple):
    """How a chip is set, as a CFG frame says it."""

    channel: int = 82
    rate: int = 1
    power: int = 3
    retry_delay: int = 1
    retries: int = 4
    address: bytes = b'T3MPC'

    def air_us(self, size: int) -> float:
        """Return how long a payload of ``size`` bytes is in the air."""
        return (8 * (_OVERHEAD + size) + _CONTROL_BITS) / _BITS_PER_US[self.rate]

    @property
    def delay_us(self) -> float:
        """From the end of a packet to the start of the next try."""
        return _DELAY_UNIT_US * (self.retry_delay + 1)

    def hears(self, other: 'RadioParameters') -> bool:
        """Decide whether chips set like this and like ``other`` can hear each other."""
        return (self.channel, self.rate, self.address) == (
            other.channel,
            other.rate,
            other.address,
        )


class RadioChannel:
    """Carries packets from the dongle to the robot, and acknowledgements back.

    Parameters
    ----------
    agenda
        Where what happens later is noted.
    robot
        How the robot's chip is set.
    receive
        Brings the robot to this instant and returns whether it listens.
    deliver
        Hands the robot a payload that it has received now.
    faults
        Of the radio.
    dice
        Used for nothing else: two numbers for each try, whatever is set.
    """

    def __init__(
        self,
        events: EventQueue,
        robot: RadioParameters,
        receive: Callable[[], bool],
        deliver: Callable[[bytes], None],
        faults: FaultInjection,
        dice: random.Random,
    ) -> None:
        self._events = events
        self._robot = robot
        self._receive = receive
        self._deliver = deliver
        self._faults = faults
        self._dice = dice
        self._waiting: bytes | None = None
        self._fetched = False

    def load(self, payload: bytes) -> None:
        """Replace what the next packet fetches: the robot empties its FIFO first."""
        self._waiting, self._fetched = payload, False

    def clear(self) -> None:
        """Forget what waits, as a chip without power does."""
        self._waiting = None

    def send(self, payload: bytes, parameters: RadioParameters, done: ExchangeCallback) -> None:
        """Send a packet, and again if nobody acknowledges it, and tell what became of it."""
        _Exchange(self, payload, parameters, done).begin()

    def _hear(self, payload: bytes, parameters: RadioParameters, again: bool) -> bytes | None:
        """Return the payload of the robot's acknowledgement; None if it has heard nothing.

        A packet that comes again (same number and CRC) is acknowledged and dropped. What was
        fetched stays in the FIFO until a new packet says that it has arrived.
        """
        listens = self._receive() and parameters.hears(self._robot)
        lost = self._dice.random() < self._faults.share('loss', 'loss_down')
        if not listens or lost or self._faults.active('jam'):
            return None
        if not again and self._fetched:
            self._waiting = None
        answer = self._waiting or b''
        self._fetched = True
        if not again:
            self._deliver(self._faults.corrupt(payload, 'wrong_version'))
        return self._faults.corrupt(answer, 'wrong_version')

    def _returns(self) -> bool:
        lost = self._dice.random() < self._faults.share('loss', 'loss_up')
        return not lost and not self._faults.active('jam')


class _Exchange:
    """One packet on its way, try after try."""

    def __init__(
        self,
        channel: RadioChannel,
        payload: bytes,
        parameters: RadioParameters,
        done: ExchangeCallback,
    ) -> None:
        self._channel = channel
        self._payload = payload
        self._parameters = parameters
        self._done = done
        self._heard = False
        self._tries = 0

    def begin(self) -> None:
        arrives = SETTLE_US + self._parameters.air_us(len(self._payload))
        self._channel._events.after_us(arrives, self._arrive)

    def _arrive(self) -> None:
        parameters, events = self._parameters, self._channel._events
        answer = self._channel._hear(self._payload, parameters, self._heard)
        returns = self._channel._returns()
        delay = parameters.delay_us
        if answer is not None:
            self._heard = True
            takes = SETTLE_US + parameters.air_us(len(answer))
            # An acknowledgement that is longer than the delay is cut off by the next try.
            if returns and takes <= delay:
                retries = self._tries
                events.after_us(takes, lambda: self._done(True, retries, answer))
                return
        if self._tries < parameters.retries:
            self._tries += 1
            events.after_us(delay + parameters.air_us(len(self._payload)), self._arrive)
        else:
            events.after_us(delay, lambda: self._done(False, self._tries, b''))
