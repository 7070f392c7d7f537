# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Transaction layer: one frame in flight to the dongle, and its reply or timeout."""

from typing import NamedTuple

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.radio.link.statistics import LinkStatistics
from t3mpc_ros.radio.link.telemetry import CommandTiming
from t3mpc_ros.radio.protocol.clock_sync import forward_delay_ns, wrapped_difference
from t3mpc_ros.radio.protocol.codec import (
    decode_exchange_status,
    decode_from_dongle,
    decode_uplink,
    encode,
)
from t3mpc_ros.radio.protocol.frames import (
    Command,
    Configure,
    Configured,
    Downlink,
    FrameError,
    FromDongle,
    Ping,
    Poll,
    Pong,
    Refusal,
    Result,
    Transmit,
    Uplink,
)
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame

_REPLY_TIMEOUT_NS = 50_000_000
"""For an answer; the longest transaction takes 10.3 ms, an FTDI at its default 16 ms each way."""
_MAX_CLOCK_ERROR_US = 1_000_000
"""By which the dongle's clock may differ from the host's between two results."""


class TransactionResult(NamedTuple):
    """What became of a frame."""

    asked: Ping | Configure | Downlink
    """Of a transaction the first payload."""
    reply: FromDongle | None
    """None: silence."""
    uplink: Uplink | None
    """The robot's answer; None if there is none, or none that makes sense."""
    sent_ns: int
    returned_ns: int
    sending: CommandTiming | None
    """For the clock model; None where the first packet was not answered at the first try."""
    dongle_restarted: bool

    @property
    def round_trip(self) -> float:
        """From the frame written to its answer, s."""
        return (self.returned_ns - self.sent_ns) / NANOSECONDS


class _PendingRequest(NamedTuple):
    asked: Ping | Configure | Downlink
    id: int
    sent_ns: int
    deadline_ns: int
    wire_bytes: int
    payload_bytes: int


class TransactionLayer:
    """Numbers and wraps frames, and matches answers with them.

    Parameters
    ----------
    statistics
        Counts exchanges and what makes no sense.
    """

    def __init__(self, statistics: LinkStatistics) -> None:
        self._statistics = statistics
        self._splitter = FrameDecoder()
        self._flight: _PendingRequest | None = None
        self._id = 0
        self._dongle: tuple[int, int] | None = None
        """Its clock (us) and ours (ns) at its last answer."""
        self._silent = 0

    @property
    def splitter(self) -> FrameDecoder:
        """Cuts what comes in."""
        return self._splitter

    @property
    def silent(self) -> int:
        """Frames in a row that the dongle has not answered."""
        return self._silent

    @property
    def deadline_ns(self) -> int | None:
        """Until when an answer is waited for; None: nothing is on its way."""
        return None if self._flight is None else self._flight.deadline_ns

    def reset(self) -> None:
        """Forget what was on its way: the port was opened or closed."""
        self._splitter.forget()
        self._flight = None
        self._dongle = None
        self._silent = 0

    def ping(self, patience_ns: int, now_ns: int) -> bytes:
        """Return the bytes of a PING."""
        self._id = self._id + 1 & 0xFF
        frame = Ping(self._id, (now_ns // 1000 & 0xFFFFFFFF).to_bytes(4, 'little'))
        # The zero ends whatever the dongle may have of a frame that was cut off.
        return b'\0' + self._launch(frame, encode(frame), 0, patience_ns, now_ns)

    def configure(self, frame: Configure, now_ns: int) -> bytes:
        """Return the bytes of a CFG."""
        self._id = self._id + 1 & 0xFF
        frame = frame._replace(id=self._id)
        return self._launch(frame, encode(frame), 0, _REPLY_TIMEOUT_NS, now_ns)

    def transact(self, first: Downlink, second: Poll, gap: int, now_ns: int) -> bytes:
        """Return the bytes of a TX."""
        self._id = self._id + 1 & 0xFF
        payload = encode(first)
        frame = encode(Transmit(self._id, gap, payload, encode(second)))
        return self._launch(first, frame, len(payload), _REPLY_TIMEOUT_NS, now_ns)

    def feed(self, data: bytes, now_ns: int) -> list[TransactionResult]:
        """Return what ``data`` tells of the frame on its way; of older ones nothing is told."""
        heard = []
        for frame in self._splitter.feed(data):
            try:
                reply = decode_from_dongle(frame)
            except FrameError:
                self._statistics.malformed += 1
                continue
            flight = self._flight
            if flight is not None and _answers(reply, flight):
                self._flight = None
                self._silent = 0
                heard.append(self._explain(flight, reply, now_ns))
        return heard

    def expire(self, now_ns: int) -> TransactionResult | None:
        """Return the frame whose answer is no longer waited for."""
        flight = self._flight
        if flight is None or now_ns < flight.deadline_ns:
            return None
        self._flight = None
        self._silent += 1
        return TransactionResult(flight.asked, None, None, flight.sent_ns, now_ns, None, False)

    def _launch(
        self,
        asked: Ping | Configure | Downlink,
        frame: bytes,
        payload_bytes: int,
        patience_ns: int,
        now_ns: int,
    ) -> bytes:
        wire = encode_frame(frame)
        self._flight = _PendingRequest(
            asked, self._id, now_ns, now_ns + patience_ns, len(wire), payload_bytes
        )
        return wire

    def _explain(
        self, flight: _PendingRequest, reply: FromDongle, now_ns: int
    ) -> TransactionResult:
        uplink, sending, restarted = None, None, False
        if isinstance(reply, Pong):
            restarted = self._has_restarted(reply.time_us, now_ns)
        elif isinstance(reply, Result):
            restarted = self._has_restarted(reply.dongle_us, now_ns)
            first, second = (
                decode_exchange_status(reply.first),
                decode_exchange_status(reply.second),
            )
            for one in (first, second):
                if one.acknowledged or one.given_up:
                    self._statistics.add_exchange(one.retransmissions)
            if reply.payload:
                try:
                    uplink = decode_uplink(reply.payload)
                except FrameError:
                    self._statistics.malformed += 1
            if isinstance(flight.asked, Command) and not first.retransmissions and second.answered:
                travel = forward_delay_ns(flight.wire_bytes, flight.payload_bytes)
                sending = CommandTiming(flight.sent_ns, travel)
        return TransactionResult(
            flight.asked, reply, uplink, flight.sent_ns, now_ns, sending, restarted
        )

    def _has_restarted(self, dongle_us: int, now_ns: int) -> bool:
        before, self._dongle = self._dongle, (dongle_us, now_ns)
        if before is None:
            return False
        passed_us = (now_ns - before[1]) // 1000
        slip = wrapped_difference((before[0] + passed_us) % (1 << 32), dongle_us)
        return abs(slip) > _MAX_CLOCK_ERROR_US + passed_us // 50


def _answers(reply: FromDongle, flight: _PendingRequest) -> bool:
    """Return whether a reply belongs to the frame on its way."""
    if isinstance(reply, Refusal):
        return True  # it has no number, but nothing else is on its way
    if isinstance(reply, Pong):
        return isinstance(flight.asked, Ping) and reply.echo == flight.asked.echo
    if isinstance(reply, Configured):
        return isinstance(flight.asked, Configure) and reply.id == flight.id
    return not isinstance(flight.asked, Ping | Configure) and reply.id == flight.id
