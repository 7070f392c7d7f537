# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Dongle firmware: one TX frame is one radio transaction is one RESULT frame.

The dongle never repeats a command by itself: a dead host is silence, and silence stops the robot.
"""

from collections.abc import Callable

from t3mpc_ros.emulator.event_queue import MICROSECOND, EventQueue
from t3mpc_ros.emulator.link.radio_channel import RadioChannel, RadioParameters
from t3mpc_ros.radio.protocol.codec import decode_to_dongle, encode
from t3mpc_ros.radio.protocol.frames import (
    VERSION,
    Configure,
    Configured,
    FrameError,
    FromDongle,
    Ping,
    Pong,
    Refusal,
    Result,
    Transmit,
)
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame

MAJOR, MINOR = 1, 0
DECODE_US = 140.0
"""From the last byte of a frame to the radio."""
WAKE_US = 200.0
"""The gap is longer by this."""
ENCODE_US = 330.0
"""From the end of the last exchange to the first byte of its result."""
GAP_UNIT_US = 250.0
EXCHANGE_LIMIT_US = 150_000.0
"""Longer than any exchange the chip can be set to (15 retries at 250 kbit/s): it has died."""
_UNKNOWN, _MALFORMED, _BUSY = 1, 2, 3
_ACKNOWLEDGED, _PAYLOAD, _GIVEN_UP, _SKIPPED = 1, 2, 4, 8
_WORD, _HALF = 0xFFFFFFFF, 0xFFFF


class Dongle:
    """The firmware of the dongle.

    Parameters
    ----------
    agenda
        Where what happens later is noted.
    ether
        Its radio; it is told how it is set.
    chip_ok
        Whether the radio chip answers now.
    reply
        Takes the bytes of a frame for the host.
    """

    def __init__(
        self,
        events: EventQueue,
        channel: RadioChannel,
        chip_ok: Callable[[], bool],
        reply: Callable[[bytes], None],
    ) -> None:
        self._events = events
        self._channel = channel
        self._chip_ok = chip_ok
        self._reply = reply
        self._transactions = 0
        self.boot(1)

    def boot(self, reset_cause: int, delay_ns: int = 0) -> None:
        """Start anew; for ``delay_ns`` the boot loader hears nothing."""
        self._reset_cause = reset_cause
        self._started_ns = self._events.now_ns + delay_ns
        self._splitter = FrameDecoder()
        self._radio = RadioParameters()
        self._stop()

    def feed(self, data: bytes) -> None:
        """Take bytes from the host that have arrived now."""
        if self._events.now_ns < self._started_ns:
            return
        for data_of_frame in self._splitter.feed(data):
            self._take(data_of_frame)

    @property
    def _time_us(self) -> int:
        return (self._events.now_ns - self._started_ns) // MICROSECOND & _WORD

    def _take(self, data: bytes) -> None:
        if data[0] not in (1, 2, 3):
            self._answer(Refusal(_UNKNOWN, data[0]))
            return
        try:
            frame = decode_to_dongle(data)
        except FrameError:
            self._answer(Refusal(_MALFORMED, data[0]))
            return
        if isinstance(frame, Ping):
            self._tell_state(frame)
        elif isinstance(frame, Transmit):
            self._transact(frame)
        else:
            self._configure(frame)

    def _answer(self, frame: FromDongle) -> None:
        self._reply(encode_frame(encode(frame)))

    def _tell_state(self, ping: Ping) -> None:
        counts = self._splitter.counts
        pong = Pong(
            ping.id,
            ping.echo,
            self._time_us,
            VERSION,
            MAJOR,
            MINOR,
            int(self._chip_ok()),
            counts.crc_errors & _HALF,
            counts.frame_errors & _HALF,
            0,
            self._reset_cause,
        )
        self._answer(pong)

    def _configure(self, frame: Configure) -> None:
        if frame.address:
            if self._frame is not None:
                self._answer(Refusal(_BUSY, frame.id))
                return
            self._radio = RadioParameters(*frame[1:])
        self._answer(Configured(frame.id, *self._radio, int(self._chip_ok())))

    # -- transaction ------------------------------------------------------------------------------

    def _stop(self) -> None:
        self._transactions += 1
        self._frame: Transmit | None = None
        self._statuses: list[int] = []
        self._payload = b''

    def _transact(self, frame: Transmit) -> None:
        if self._frame is not None:
            self._answer(Refusal(_BUSY, frame.id))
            return
        self._stop()
        self._frame = frame
        self._later(DECODE_US, lambda: self._send(frame.first))

    def _later(self, delay_us: float, deed: Callable[[], None]) -> None:
        """Do it unless the transaction has ended by then, with a reset say."""
        number = self._transactions
        self._events.after_us(delay_us, lambda: deed() if self._transactions == number else None)

    def _send(self, payload: bytes) -> None:
        number, exchange = self._transactions, len(self._statuses)

        def done(acknowledged: bool, retransmissions: int, answer: bytes) -> None:
            current = self._transactions == number and len(self._statuses) == exchange
            if current and self._chip_ok():
                self._finish(acknowledged, retransmissions, answer)

        def give_up() -> None:
            if len(self._statuses) == exchange:
                self._finish(False, 0, b'')

        self._later(EXCHANGE_LIMIT_US, give_up)
        if self._chip_ok():
            self._channel.send(payload, self._radio, done)

    def _finish(self, acknowledged: bool, retransmissions: int, answer: bytes) -> None:
        """Take the end of an exchange."""
        frame = self._frame
        if frame is None:
            return
        status = retransmissions << 4 | (_ACKNOWLEDGED if acknowledged else _GIVEN_UP)
        if answer:
            status |= _PAYLOAD
            self._payload = answer
        self._statuses.append(status)
        if len(self._statuses) == 1:
            if acknowledged and frame.second:
                gap = frame.gap * GAP_UNIT_US + WAKE_US
                self._later(gap, lambda: self._send(frame.second))
                return
            self._statuses.append(_SKIPPED)
        self._later(ENCODE_US, self._report)

    def _report(self) -> None:
        frame = self._frame
        if frame is None:
            return
        first, second = self._statuses
        result = Result(frame.id, first, second, self._time_us, self._payload)
        self._stop()
        self._answer(result)
