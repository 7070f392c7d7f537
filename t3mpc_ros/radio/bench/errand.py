# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Something to be done at a port, as a function of time and bytes: one question after another.

A script is a generator: it yields what to ask, or for how long to rest, and is sent what came of
it. It reads like the talk it leads, and whoever holds the port, or a test in virtual time, carries
it on. An interruption is raised where the script stands, so that it can put things back.
"""

from collections.abc import Callable, Generator
from contextlib import suppress
from typing import Generic, NamedTuple, Protocol, TypeVar

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.radio.codec import encode
from t3mpc_ros.radio.frames import (
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
from t3mpc_ros.radio.link import words
from t3mpc_ros.radio.link.words import Close, Deed, Open, Wait, Write
from t3mpc_ros.radio.splitter import Splitter, to_wire

Question = Ping | Configure | Transmit | Key
Reply = FromDongle | FromBoard

_LOOK = 0.1
"""s for the answer to a PING."""
_LOOKS = 50
"""Five seconds: a board that opening its port has reset takes 1.5 s, with a slow boot loader 2."""
_BYTE = 0xFF


class ErrandError(Exception):
    """It cannot be done; the text says why and what to do."""


class InterruptedErrand(Exception):
    """Somebody wants it to end: put things back and leave."""


class Ask(NamedTuple):
    """Send a frame and wait for its answer; its number is given here."""

    frame: Question
    patience: float
    """s"""


class Rest(NamedTuple):
    """Do nothing for so many seconds."""

    seconds: float


class Heard(NamedTuple):
    """What came of a question or a rest."""

    reply: Reply | None
    """None: silence."""
    sent_ns: int
    returned_ns: int

    @property
    def round_trip(self) -> float:
        """From the frame written to its answer, s."""
        return (self.returned_ns - self.sent_ns) / NANOSECONDS


Value = TypeVar('Value')
Talk = Generator[Ask | Rest, Heard, Value]
"""A script; what it returns is the result of the errand."""


class Task(Protocol):
    """What can be carried out at a port."""

    @property
    def done(self) -> bool:
        """Whether there is nothing left to do."""

    def step(self, now_ns: int, received: bytes = b'') -> list[Deed]:
        """Return what to do now; the last deed says until when there is nothing more."""

    def opened(self, now_ns: int) -> None:
        """Take notice that the port is open."""

    def failed(self, text: str, absent: bool, now_ns: int) -> None:
        """Take notice that the port cannot be opened or used."""

    def interrupt(self, now_ns: int) -> None:
        """Come to an end, and leave things as they were found."""


class Errand(Generic[Value]):
    """Carries a script on.

    Parameters
    ----------
    script
        Its value becomes :attr:`result`; of what it raises, ErrandError becomes :attr:`error`.
    decode
        Reads the frames of the board that is talked to.
    """

    def __init__(self, script: Talk[Value], decode: Callable[[bytes], Reply]) -> None:
        self._script = script
        self._decode = decode
        self._splitter = Splitter()
        self._deeds: list[Deed] = [Open()]
        self._asked: Question | None = None
        self._sent_ns = self._until_ns = 0
        self._id = 0
        self._open = self._interrupted = False
        self.done = False
        """Whether there is nothing left to do."""
        self.error = ''
        """Why it could not be done; empty if it could."""
        self.result: Value | None = None
        """What the script returned."""

    def opened(self, now_ns: int) -> None:
        """Begin."""
        self._open = True
        self._go_on(lambda: next(self._script), now_ns)

    def failed(self, text: str, absent: bool, now_ns: int) -> None:
        """End: the port cannot be opened or used."""
        self._open = False
        # Whatever the script wants to put back, there is nobody to tell.
        with suppress(ErrandError, InterruptedErrand, StopIteration):
            while True:
                self._script.throw(ErrandError(text))
        self._end(text)

    def interrupt(self, now_ns: int) -> None:
        """Let the script put things back; a second time changes nothing."""
        if self.done or self._interrupted:
            return
        self._interrupted = True
        if self._open:
            self._go_on(lambda: self._script.throw(InterruptedErrand()), now_ns)
        else:
            self._end('interrupted')

    def step(self, now_ns: int, received: bytes = b'') -> list[Deed]:
        """Return what to do now; the last deed says until when there is nothing more to do."""
        for data in self._splitter.feed(received):
            try:
                reply = self._decode(data)
            except FrameError:
                continue  # of another kind of board, or damaged beyond its CRC
            if self._asked is not None and _answers(reply, self._asked):
                self._tell(reply, now_ns)
        if self._open and not self.done and now_ns >= self._until_ns:
            self._tell(None, now_ns)
        deeds, self._deeds = self._deeds, []
        return [*deeds, Wait(max(self._until_ns, now_ns))]

    def _tell(self, reply: Reply | None, now_ns: int) -> None:
        heard = Heard(reply, self._sent_ns, now_ns)
        self._go_on(lambda: self._script.send(heard), now_ns)

    def _go_on(self, move: Callable[[], Ask | Rest], now_ns: int) -> None:
        self._asked = None
        self._sent_ns = now_ns
        try:
            wish = move()
        except StopIteration as end:
            self.result = end.value
            self._end('')
        except InterruptedErrand:
            self._end('interrupted')
        except ErrandError as error:
            self._end(str(error))
        else:
            seconds = wish.seconds if isinstance(wish, Rest) else wish.patience
            self._until_ns = now_ns + round(seconds * NANOSECONDS)
            if isinstance(wish, Ask):
                self._id = self._id + 1 & _BYTE
                self._asked = wish.frame._replace(id=self._id)
                # The zero ends whatever the board may have of a frame that was cut off.
                self._deeds.append(Write(b'\0' + to_wire(encode(self._asked))))

    def _end(self, error: str) -> None:
        if not self.done:
            self.done, self.error = True, error
            self._deeds.append(Close())


def _answers(reply: Reply, asked: Question) -> bool:
    if isinstance(reply, Refusal):
        return True  # it has no number, but nothing else is on its way
    kinds = {Ping: Pong, Configure: Configured, Transmit: Result, Key: KeyState}
    if not isinstance(reply, kinds[type(asked)]) or reply.id != asked.id:
        return False
    return not isinstance(asked, Ping) or getattr(reply, 'echo', b'') == asked.echo


def look(nobody: str) -> Talk[Pong]:
    """Wait for a board to start; return what it says of itself, or raise ErrandError."""
    for _ in range(_LOOKS):
        heard = yield Ask(Ping(0, b'look'), _LOOK)
        if isinstance(heard.reply, Pong):
            return heard.reply
    raise ErrandError(nobody)


def look_for_dongle() -> Talk[Pong]:
    """Wait for a dongle with a working radio, or raise ErrandError."""
    pong = yield from look(words.NO_DONGLE)
    heard = yield Ask(Configure(0), _LOOK)
    if isinstance(heard.reply, Refusal):
        raise ErrandError(
            'this is the USB of the robot: the one of the dongle is wanted; '
            'ls -l /dev/serial/by-id names both'
        )
    if not pong.chip_ok:
        raise ErrandError(words.NO_CHIP)
    return pong


def set_radio(frame: Configure) -> Talk[None]:
    """Set the radio of the dongle, or raise ErrandError."""
    for _ in range(3):
        heard = yield Ask(frame, _LOOK)
        reply = heard.reply
        if isinstance(reply, Configured) and reply[1:-1] == frame[1:]:
            if not reply.chip_ok:
                raise ErrandError(words.NO_CHIP)
            return
    raise ErrandError(words.NOT_SET)


def ask_radio() -> Talk[Configure]:
    """Return how the radio of the dongle is set, or raise ErrandError."""
    for _ in range(3):
        heard = yield Ask(Configure(0), _LOOK)
        if isinstance(heard.reply, Configured):
            return Configure(*heard.reply[:-1])
    raise ErrandError(words.FELL_SILENT)
