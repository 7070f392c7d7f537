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

FIRMWARE_MAJOR, FIRMWARE_MINOR = 1, 1
BUILD = 0
"""The emulator is no build of the firmware."""
DECODE_US = 140.0
"""Delay from the last byte of a frame to the start of the exchange."""
WAKE_US = 200.0
"""Wake-up time of the processor, added to the gap."""
ENCODE_US = 330.0
"""Delay from the end of the last exchange to the first byte of the result."""
GAP_UNIT_US = 250.0
EXCHANGE_TIMEOUT_US = 150_000.0
"""Longer than the longest exchange (15 retries at 250 kbit/s): the radio chip has failed."""
_UNKNOWN, _MALFORMED, _BUSY = 1, 2, 3
_ACKNOWLEDGED, _PAYLOAD, _MAX_RETRIES, _SKIPPED = 1, 2, 4, 8
_WORD, _HALF = 0xFFFFFFFF, 0xFFFF


class Dongle:
    """Firmware of the dongle.

    Parameters
    ----------
    events
        Queue in which later actions are scheduled.
    channel
        Radio channel; each packet is sent with the configuration of the dongle.
    chip_ok
        Returns whether the radio chip responds.
    reply
        Receives the bytes of each frame for the host.
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
        """Reboot; for ``delay_ns`` the boot loader ignores all input."""
        self._reset_cause = reset_cause
        self._started_ns = self._events.now_ns + delay_ns
        self._decoder = FrameDecoder()
        self._radio = RadioParameters()
        self._end_transaction()

    def feed(self, data: bytes) -> None:
        """Process bytes from the host that arrive now."""
        if self._events.now_ns < self._started_ns:
            return
        for frame in self._decoder.feed(data):
            self._process(frame)

    @property
    def radio(self) -> RadioParameters:
        """Current configuration of the transceiver."""
        return self._radio

    @property
    def _time_us(self) -> int:
        return (self._events.now_ns - self._started_ns) // MICROSECOND & _WORD

    def _process(self, data: bytes) -> None:
        if data[0] not in (1, 2, 3):
            self._send_frame(Refusal(_UNKNOWN, data[0]))
            return
        try:
            frame = decode_to_dongle(data)
        except FrameError:
            self._send_frame(Refusal(_MALFORMED, data[0]))
            return
        if isinstance(frame, Ping):
            self._send_pong(frame)
        elif isinstance(frame, Transmit):
            self._begin_transaction(frame)
        else:
            self._configure(frame)

    def _send_frame(self, frame: FromDongle) -> None:
        self._reply(encode_frame(encode(frame)))

    def _send_pong(self, ping: Ping) -> None:
        counts = self._decoder.counts
        pong = Pong(
            ping.id,
            ping.echo,
            self._time_us,
            VERSION,
            FIRMWARE_MAJOR,
            FIRMWARE_MINOR,
            int(self._chip_ok()),
            counts.crc_errors & _HALF,
            counts.frame_errors & _HALF,
            0,
            self._reset_cause,
            0,
            self._radio.channel,
            self._radio.address,
            BUILD,
        )
        self._send_frame(pong)

    def _configure(self, frame: Configure) -> None:
        if frame.address:
            if self._frame is not None:
                self._send_frame(Refusal(_BUSY, frame.id))
                return
            self._radio = RadioParameters(*frame[1:])
        self._send_frame(Configured(frame.id, *self._radio, int(self._chip_ok())))

    # -- transaction ------------------------------------------------------------------------------

    def _end_transaction(self) -> None:
        self._transactions += 1
        self._frame: Transmit | None = None
        self._statuses: list[int] = []
        self._payload = b''

    def _begin_transaction(self, frame: Transmit) -> None:
        if self._frame is not None:
            self._send_frame(Refusal(_BUSY, frame.id))
            return
        self._end_transaction()
        self._frame = frame
        self._schedule(DECODE_US, lambda: self._send_payload(frame.first))

    def _schedule(self, delay_us: float, callback: Callable[[], None]) -> None:
        """Schedule a callback that is void once the transaction has ended, by a reset say."""
        number = self._transactions
        self._events.schedule_after(
            delay_us, lambda: callback() if self._transactions == number else None
        )

    def _send_payload(self, payload: bytes) -> None:
        number, exchange = self._transactions, len(self._statuses)

        def done(acknowledged: bool, retransmissions: int, reply: bytes) -> None:
            current = self._transactions == number and len(self._statuses) == exchange
            if current and self._chip_ok():
                self._finish_exchange(acknowledged, retransmissions, reply)

        def time_out() -> None:
            if len(self._statuses) == exchange:
                self._finish_exchange(False, 0, b'')

        self._schedule(EXCHANGE_TIMEOUT_US, time_out)
        if self._chip_ok():
            self._channel.send(payload, self._radio, done)

    def _finish_exchange(self, acknowledged: bool, retransmissions: int, reply: bytes) -> None:
        frame = self._frame
        if frame is None:
            return
        status = retransmissions << 4 | (_ACKNOWLEDGED if acknowledged else _MAX_RETRIES)
        if reply:
            status |= _PAYLOAD
            self._payload = reply
        self._statuses.append(status)
        if len(self._statuses) == 1:
            if acknowledged and frame.second:
                gap = frame.gap * GAP_UNIT_US + WAKE_US
                self._schedule(gap, lambda: self._send_payload(frame.second))
                return
            self._statuses.append(_SKIPPED)
        self._schedule(ENCODE_US, self._send_result)

    def _send_result(self) -> None:
        frame = self._frame
        if frame is None:
            return
        first, second = self._statuses
        result = Result(frame.id, first, second, self._time_us, self._payload)
        self._end_transaction()
        self._send_frame(result)
