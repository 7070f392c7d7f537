# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Procedures at a port: request and response scripts, and the runner on the wall clock.

A script is a generator: it yields a request or a pause and receives the response. A runner with a
port, or a test in virtual time, drives it. An interruption is raised at the current yield, so that
the script can restore what it changed.
"""

from collections.abc import Callable, Generator
from contextlib import suppress
import select
import time
from typing import Generic, NamedTuple, Protocol, TypeVar

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.port_actions import Close, Open, PortAction, Wait, Write
from t3mpc_ros.radio.protocol.codec import encode
from t3mpc_ros.radio.protocol.frames import (
    Configure,
    Configured,
    FrameError,
    FromBoard,
    FromDongle,
    Key,
    KeyState,
    Ping,
    Pong,
    Refusal,
    Result,
    Transmit,
)
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame
from t3mpc_ros.radio.serial_port import PortError, SerialPort

RequestFrame = Ping | Configure | Transmit | Key
ReplyFrame = FromDongle | FromBoard

_PING_TIMEOUT = 0.1
"""s for the answer to a PING."""
_MAX_PINGS = 50
"""Five seconds: a board that opening its port has reset takes 1.5 s, with a slow boot loader 2."""
_BYTE = 0xFF


class ProcedureError(Exception):
    """It cannot be done; the text says why and what to do."""


class ProcedureInterrupted(Exception):
    """Somebody wants it to end: put things back and leave."""


class Request(NamedTuple):
    """Send a frame and wait for its answer; its number is given here."""

    frame: RequestFrame
    patience: float
    """s"""


class Pause(NamedTuple):
    """Do nothing for so many seconds."""

    seconds: float


class Response(NamedTuple):
    """What came of a question or a rest."""

    reply: ReplyFrame | None
    """None: silence."""
    sent_ns: int
    returned_ns: int

    @property
    def round_trip(self) -> float:
        """From the frame written to its answer, s."""
        return (self.returned_ns - self.sent_ns) / NANOSECONDS


Value = TypeVar('Value')
Script = Generator[Request | Pause, Response, Value]
"""A script; what it returns is the result of the errand."""


class PortTask(Protocol):
    """What can be carried out at a port."""

    @property
    def done(self) -> bool:
        """Whether there is nothing left to do."""

    def step(self, now_ns: int, received: bytes = b'') -> list[PortAction]:
        """Return what to do now; the last deed says until when there is nothing more."""

    def port_opened(self, now_ns: int) -> None:
        """Take notice that the port is open."""

    def port_failed(self, text: str, absent: bool, now_ns: int) -> None:
        """Take notice that the port cannot be opened or used."""

    def interrupt(self, now_ns: int) -> None:
        """Come to an end, and leave things as they were found."""


class Procedure(Generic[Value]):
    """Carries a script on.

    Parameters
    ----------
    script
        Its value becomes :attr:`result`; of what it raises, ProcedureError becomes :attr:`error`.
    decode
        Reads the frames of the board that is talked to.
    """

    def __init__(self, script: Script[Value], decode: Callable[[bytes], ReplyFrame]) -> None:
        self._script = script
        self._decode = decode
        self._splitter = FrameDecoder()
        self._deeds: list[PortAction] = [Open()]
        self._asked: RequestFrame | None = None
        self._sent_ns = self._until_ns = 0
        self._id = 0
        self._open = self._interrupted = False
        self.done = False
        """Whether there is nothing left to do."""
        self.error = ''
        """Why it could not be done; empty if it could."""
        self.result: Value | None = None
        """What the script returned."""

    def port_opened(self, now_ns: int) -> None:
        """Begin."""
        self._open = True
        self._go_on(lambda: next(self._script), now_ns)

    def port_failed(self, text: str, absent: bool, now_ns: int) -> None:
        """End: the port cannot be opened or used."""
        self._open = False
        # Whatever the script wants to put back, there is nobody to tell.
        with suppress(ProcedureError, ProcedureInterrupted, StopIteration):
            while True:
                self._script.throw(ProcedureError(text))
        self._end(text)

    def interrupt(self, now_ns: int) -> None:
        """Let the script put things back; a second time changes nothing."""
        if self.done or self._interrupted:
            return
        self._interrupted = True
        if self._open:
            self._go_on(lambda: self._script.throw(ProcedureInterrupted()), now_ns)
        else:
            self._end('interrupted')

    def step(self, now_ns: int, received: bytes = b'') -> list[PortAction]:
        """Return what to do now; the last deed says until when there is nothing more to do."""
        for data in self._splitter.feed(received):
            try:
                reply = self._decode(data)
            except FrameError:
                continue  # of another kind of board, or damaged beyond its CRC
            if self._asked is not None and _is_reply_to(reply, self._asked):
                self._tell(reply, now_ns)
        if self._open and not self.done and now_ns >= self._until_ns:
            self._tell(None, now_ns)
        deeds, self._deeds = self._deeds, []
        return [*deeds, Wait(max(self._until_ns, now_ns))]

    def _tell(self, reply: ReplyFrame | None, now_ns: int) -> None:
        heard = Response(reply, self._sent_ns, now_ns)
        self._go_on(lambda: self._script.send(heard), now_ns)

    def _go_on(self, move: Callable[[], Request | Pause], now_ns: int) -> None:
        self._asked = None
        self._sent_ns = now_ns
        try:
            wish = move()
        except StopIteration as end:
            self.result = end.value
            self._end('')
        except ProcedureInterrupted:
            self._end('interrupted')
        except ProcedureError as error:
            self._end(str(error))
        else:
            seconds = wish.seconds if isinstance(wish, Pause) else wish.patience
            self._until_ns = now_ns + round(seconds * NANOSECONDS)
            if isinstance(wish, Request):
                self._id = self._id + 1 & _BYTE
                self._asked = wish.frame._replace(id=self._id)
                # The zero ends whatever the board may have of a frame that was cut off.
                self._deeds.append(Write(b'\0' + encode_frame(encode(self._asked))))

    def _end(self, error: str) -> None:
        if not self.done:
            self.done, self.error = True, error
            self._deeds.append(Close())


def _is_reply_to(reply: ReplyFrame, asked: RequestFrame) -> bool:
    if isinstance(reply, Refusal):
        return True  # it has no number, but nothing else is on its way
    kinds = {Ping: Pong, Configure: Configured, Transmit: Result, Key: KeyState}
    if not isinstance(reply, kinds[type(asked)]) or reply.id != asked.id:
        return False
    return not isinstance(asked, Ping) or getattr(reply, 'echo', b'') == asked.echo


def wait_for_board(nobody: str) -> Script[Pong]:
    """Wait for a board to start; return what it says of itself, or raise ProcedureError."""
    for _ in range(_MAX_PINGS):
        heard = yield Request(Ping(0, b'look'), _PING_TIMEOUT)
        if isinstance(heard.reply, Pong):
            return heard.reply
    raise ProcedureError(nobody)


def wait_for_dongle() -> Script[Pong]:
    """Wait for a dongle with a working radio, or raise ProcedureError."""
    pong = yield from wait_for_board(reasons.NO_DONGLE)
    heard = yield Request(Configure(0), _PING_TIMEOUT)
    if isinstance(heard.reply, Refusal):
        raise ProcedureError(
            'this is the USB of the robot: the one of the dongle is wanted; '
            'ls -l /dev/serial/by-id names both'
        )
    if not pong.chip_ok:
        raise ProcedureError(reasons.NO_CHIP)
    return pong


def configure_radio(frame: Configure) -> Script[None]:
    """Set the radio of the dongle, or raise ProcedureError."""
    for _ in range(3):
        heard = yield Request(frame, _PING_TIMEOUT)
        reply = heard.reply
        if isinstance(reply, Configured) and reply[1:-1] == frame[1:]:
            if not reply.chip_ok:
                raise ProcedureError(reasons.NO_CHIP)
            return
    raise ProcedureError(reasons.RADIO_NOT_CONFIGURED)


def read_radio_setup() -> Script[Configure]:
    """Return how the radio of the dongle is set, or raise ProcedureError."""
    for _ in range(3):
        heard = yield Request(Configure(0), _PING_TIMEOUT)
        if isinstance(heard.reply, Configured):
            return Configure(*heard.reply[:-1])
    raise ProcedureError(reasons.DONGLE_TIMEOUT)


_POLL_PERIOD = 0.05
"""s: an interruption is heard so soon."""
SHUTDOWN_TIMEOUT_NS = 3 * NANOSECONDS
"""What a task gets for putting things back, a robot for coming to rest."""


def run_at_port(
    task: PortTask, path: str, interrupted: Callable[[], bool], device: str = 'the dongle'
) -> None:
    """Do the task at the port ``path`` of a device; ``interrupted`` is asked 20 times a second."""
    courier = _PortRunner(task, path, device)
    until_ns: int | None = None
    try:
        received = b''
        while not task.done:
            now_ns = time.monotonic_ns()
            if interrupted() and until_ns is None:
                until_ns = now_ns + SHUTDOWN_TIMEOUT_NS
                task.interrupt(now_ns)
            if until_ns is not None and now_ns > until_ns:
                return
            received = courier.listen(courier.do(task.step(now_ns, received)))
        courier.do(task.step(time.monotonic_ns()))
    finally:
        courier.close()


class _PortRunner:
    def __init__(self, task: PortTask, path: str, device: str) -> None:
        self._task = task
        self._path = path
        self._device = device
        self._port: SerialPort | None = None

    def do(self, deeds: list[PortAction]) -> int:
        """Do the deeds; return when the task wants to be asked again."""
        wake_ns = time.monotonic_ns()
        for deed in deeds:
            try:
                if isinstance(deed, Wait):
                    wake_ns = deed.until_ns
                elif isinstance(deed, Open):
                    self._port = SerialPort(self._path, self._device)
                    self._task.port_opened(time.monotonic_ns())
                    return time.monotonic_ns()
                elif isinstance(deed, Write) and self._port is not None:
                    self._port.write(deed.data)
                elif isinstance(deed, Close):
                    self.close()
            except PortError as error:
                self._lose(error)
                return time.monotonic_ns()
        return wake_ns

    def listen(self, until_ns: int) -> bytes:
        """Return what arrives before then."""
        wait = min(max((until_ns - time.monotonic_ns()) / NANOSECONDS, 0.0), _POLL_PERIOD)
        if self._port is None:
            time.sleep(wait)
            return b''
        try:
            ready, _, _ = select.select([self._port], [], [], wait)
            return self._port.read() if ready else b''
        except PortError as error:
            self._lose(error)
            return b''

    def close(self) -> None:
        """Close the port, if it is open."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def _lose(self, error: PortError) -> None:
        self._port = None
        self._task.port_failed(str(error), error.absent, time.monotonic_ns())
