# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Two nRF24L01+ and the air between them, packet by packet, with the times of the data sheet.

Product specification 1.0: 7.4 (retransmission), 7.5 (acknowledgement with payload), 6.1.7 (times).
"""

from collections.abc import Callable
import random
from typing import NamedTuple

from t3mpc_ros.emulator.agenda import Agenda
from t3mpc_ros.emulator.faults import Faults

SETTLE_US = 130.0
"""From standby to the air."""
_BITS_PER_US = (0.25, 1.0, 2.0)
_OVERHEAD = 1 + 5 + 2
"""Bytes of preamble, address and CRC."""
_CONTROL_BITS = 9
_DELAY_UNIT_US = 250.0

Done = Callable[[bool, int, bytes], None]
"""Told whether a packet was acknowledged, after how many retransmissions, with what payload."""


class RadioSettings(NamedTuple):
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

    def hears(self, other: 'RadioSettings') -> bool:
        """Decide whether chips set like this and like ``other`` can hear each other."""
        return (self.channel, self.rate, self.address) == (
            other.channel,
            other.rate,
            other.address,
        )


class Ether:
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
        agenda: Agenda,
        robot: RadioSettings,
        receive: Callable[[], bool],
        deliver: Callable[[bytes], None],
        faults: Faults,
        dice: random.Random,
    ) -> None:
        self._agenda = agenda
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

    def send(self, payload: bytes, settings: RadioSettings, done: Done) -> None:
        """Send a packet, and again if nobody acknowledges it, and tell what became of it."""
        _Flight(self, payload, settings, done).begin()

    def _hear(self, payload: bytes, settings: RadioSettings, again: bool) -> bytes | None:
        """Return the payload of the robot's acknowledgement; None if it has heard nothing.

        A packet that comes again (same number and CRC) is acknowledged and dropped. What was
        fetched stays in the FIFO until a new packet says that it has arrived.
        """
        listens = self._receive() and settings.hears(self._robot)
        lost = self._dice.random() < self._faults.share('loss', 'loss_down')
        if not listens or lost or self._faults.active('jam'):
            return None
        if not again and self._fetched:
            self._waiting = None
        answer = self._waiting or b''
        self._fetched = True
        if not again:
            self._deliver(self._faults.mangled(payload, 'wrong_version'))
        return self._faults.mangled(answer, 'wrong_version')

    def _returns(self) -> bool:
        lost = self._dice.random() < self._faults.share('loss', 'loss_up')
        return not lost and not self._faults.active('jam')


class _Flight:
    """One packet on its way, try after try."""

    def __init__(self, ether: Ether, payload: bytes, settings: RadioSettings, done: Done) -> None:
        self._ether = ether
        self._payload = payload
        self._settings = settings
        self._done = done
        self._heard = False
        self._tries = 0

    def begin(self) -> None:
        arrives = SETTLE_US + self._settings.air_us(len(self._payload))
        self._ether._agenda.after_us(arrives, self._arrive)

    def _arrive(self) -> None:
        settings, agenda = self._settings, self._ether._agenda
        answer = self._ether._hear(self._payload, settings, self._heard)
        returns = self._ether._returns()
        delay = settings.delay_us
        if answer is not None:
            self._heard = True
            takes = SETTLE_US + settings.air_us(len(answer))
            # An acknowledgement that is longer than the delay is cut off by the next try.
            if returns and takes <= delay:
                retries = self._tries
                agenda.after_us(takes, lambda: self._done(True, retries, answer))
                return
        if self._tries < settings.retries:
            self._tries += 1
            agenda.after_us(delay + settings.air_us(len(self._payload)), self._arrive)
        else:
            agenda.after_us(delay, lambda: self._done(False, self._tries, b''))
