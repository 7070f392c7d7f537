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
"""Transaction layer: one frame in flight to the dongle, and its reply or timeout."""

from typing import NamedTuple

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.radio.link.statistics import LinkStatistics
from t3mpc_ros.radio.link.telemetry import CommandTiming
from t3mpc_ros.radio.protocol import codec, frames
from t3mpc_ros.radio.protocol.clock_sync import BYTE_NS, forward_delay_ns
from t3mpc_ros.radio.protocol.framing import FrameCounts, FrameDecoder, encode_frame

_REPLY_TIMEOUT_NS = 50_000_000
"""Timeout of a reply; a transaction takes 10.3 ms at most, an FTDI chip up to 16 ms each way."""
_CLOCK_TOLERANCE_US, _CLOCK_TOLERANCE_SHARE = 20_000, 50
"""Accepted difference of the clocks of dongle and host: this time, plus a 50th of what elapsed."""
_MAX_CLOCK_STEP_US = 5_000
"""Accepted step back between the clocks in a RESULT and in the PONG that follows."""
_WRAP = 1 << 32


class TransactionResult(NamedTuple):
    """Result of a request to the dongle."""

    request: frames.Ping | frames.Configure | frames.Downlink
    """The request; for a transaction, its first payload."""
    reply: frames.FromDongle | None  # reply of the dongle; None after a timeout
    uplink: frames.Uplink | None  # answer of the robot; None if missing or malformed
    sent_ns: int
    returned_ns: int
    timing: CommandTiming | None
    """Sample for the clock model; None if the first packet was retransmitted or unanswered."""
    dongle_restarted: bool
    foreign_version: int = 0
    """Version of the protocol of an answer that this host cannot read; 0 if there is none."""

    @property
    def round_trip(self) -> float:
        """Time from writing the request to its reply, s."""
        return (self.returned_ns - self.sent_ns) / NANOSECONDS


class _PendingRequest(NamedTuple):
    request: frames.Ping | frames.Configure | frames.Downlink
    frame: frames.ToDongle
    sent_ns: int
    deadline_ns: int
    wire_bytes: int


class TransactionLayer:
    """Numbers and encodes requests, and matches replies with them."""

    def __init__(self, statistics: LinkStatistics) -> None:
        self._statistics = statistics
        self._decoder = FrameDecoder()
        self._pending: _PendingRequest | None = None
        self._id = 0
        self._dongle: tuple[int, int, int] | None = None
        """Dongle clock (us) in its last reply, and when that was requested and read (host, ns)."""
        self.timeouts = 0
        """Number of requests without a reply since the last one, without those dropped as busy."""
        self.over_cable = False  # whether the robot itself replies, without a radio between

    @property
    def frame_counts(self) -> FrameCounts:
        """Counters of the received frames."""
        return self._decoder.counts

    @property
    def deadline_ns(self) -> int | None:
        """End of the reply timeout; None if no request is in flight."""
        return None if self._pending is None else self._pending.deadline_ns

    def reset(self) -> None:
        """Drop the request in flight, because the port was opened or closed."""
        self._decoder.reset()
        self._pending = None
        self._dongle = None
        self.timeouts = 0

    def ping(self, timeout_ns: int, now_ns: int) -> bytes:
        """Return the bytes of a PING with its own timeout."""
        self._id = self._id + 1 & 0xFF
        frame = frames.Ping(self._id, (now_ns // 1000 & 0xFFFFFFFF).to_bytes(4, 'little'))
        # The zero ends a partial frame that the dongle may have received.
        return b'\0' + self._send(frame, frame, timeout_ns, now_ns)

    def configure(self, frame: frames.Configure, now_ns: int) -> bytes:
        """Return the bytes of a CFG."""
        self._id = self._id + 1 & 0xFF
        frame = frame._replace(id=self._id)
        return self._send(frame, frame, _REPLY_TIMEOUT_NS, now_ns)

    def transact(
        self, first: frames.Downlink, second: frames.Poll, gap: int, now_ns: int
    ) -> bytes:
        """Return the bytes of a TX."""
        self._id = self._id + 1 & 0xFF
        frame = frames.Transmit(self._id, gap, codec.encode(first), codec.encode(second))
        return self._send(first, frame, _REPLY_TIMEOUT_NS, now_ns)

    def feed(self, data: bytes, now_ns: int) -> list[TransactionResult]:
        """Return the result of the request in flight; replies to older ones are ignored."""
        results = []
        for frame in self._decoder.feed(data):
            try:
                reply = codec.decode_from_dongle(frame)
            except frames.FrameError:
                self._statistics.malformed += 1
                continue
            pending = self._pending
            if pending is not None and frames.is_reply(reply, pending.frame):
                self._pending = None
                # A dongle whose radio chip is dead is busy between two timeouts.
                if not isinstance(reply, frames.Refusal) or reply.code != frames.DONGLE_BUSY:
                    self.timeouts = 0
                results.append(self._result(pending, reply, now_ns))
        return results

    def expire(self, now_ns: int) -> TransactionResult | None:
        """Return the request in flight if its timeout has expired."""
        pending = self._pending
        if pending is None or now_ns < pending.deadline_ns:
            return None
        self._pending = None
        self.timeouts += 1
        return TransactionResult(pending.request, None, None, pending.sent_ns, now_ns, None, False)

    def _send(
        self,
        request: frames.Ping | frames.Configure | frames.Downlink,
        frame: frames.ToDongle,
        timeout_ns: int,
        now_ns: int,
    ) -> bytes:
        wire = encode_frame(codec.encode(frame))
        self._pending = _PendingRequest(request, frame, now_ns, now_ns + timeout_ns, len(wire))
        return wire

    def _result(
        self, pending: _PendingRequest, reply: frames.FromDongle, now_ns: int
    ) -> TransactionResult:
        uplink, timing, restarted, foreign_version = None, None, False, 0
        if isinstance(reply, frames.Pong):
            restarted = self._detect_restart(reply.time_us, pending.sent_ns, now_ns)
        elif isinstance(reply, frames.Result):
            restarted = self._detect_restart(reply.dongle_us, pending.sent_ns, now_ns)
            first = codec.decode_exchange_status(reply.first)
            second = codec.decode_exchange_status(reply.second)
            for status in (first, second):
                if status.acknowledged or status.failed:
                    self._statistics.add_exchange(status.retransmissions)
            if reply.payload:
                try:
                    uplink = codec.decode_uplink(reply.payload)
                except frames.FrameError as error:
                    self._statistics.malformed += 1
                    if error.kind is frames.FrameErrorKind.VERSION:
                        foreign_version = reply.payload[0] >> 4
            prompt = not first.retransmissions and second.has_payload
            sent = pending.frame
            command = isinstance(pending.request, frames.Command)
            if command and isinstance(sent, frames.Transmit) and prompt:
                delay = pending.wire_bytes * BYTE_NS
                if not self.over_cable:
                    delay = forward_delay_ns(pending.wire_bytes, len(sent.first))
                timing = CommandTiming(pending.sent_ns, delay)
        return TransactionResult(
            pending.request,
            reply,
            uplink,
            pending.sent_ns,
            now_ns,
            timing,
            restarted,
            foreign_version,
        )

    def _detect_restart(self, dongle_us: int, sent_ns: int, now_ns: int) -> bool:
        """Return whether the dongle clock has restarted since the last reply.

        The dongle wrote each reply between the request and the reading of that reply, which may
        be long for a suspended host. That bounds the time that elapsed for the dongle.
        """
        before, self._dongle = self._dongle, (dongle_us, sent_ns, now_ns)
        if before is None:
            return False
        before_us, before_sent_ns, before_read_ns = before
        longest_us = (now_ns - before_sent_ns) // 1000
        tolerance_us = _CLOCK_TOLERANCE_US + longest_us // _CLOCK_TOLERANCE_SHARE
        shortest_us = (sent_ns - before_read_ns) // 1000 - tolerance_us
        shortest_us = max(shortest_us, -_MAX_CLOCK_STEP_US)
        # The shortest elapsed time that fits the clock, which wraps.
        elapsed_us = shortest_us + (dongle_us - before_us - shortest_us) % _WRAP
        return elapsed_us > longest_us + tolerance_us
