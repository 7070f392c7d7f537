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
"""Procedures at a port: request and response scripts, and the runner on the wall clock.

A script is a generator: it yields a request or a pause and receives the response. A runner with a
port, or a test in virtual time, drives it. An interruption is raised at the current yield, so that
the script can restore what it changed.
"""

from collections.abc import Callable, Generator
from contextlib import suppress
import select
import time
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.actions_and_states import Close, Open, PortAction, Wait, Write
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import decode_from_board, decode_from_dongle, encode
from t3mpc_ros.radio.protocol.framing import FrameDecoder, encode_frame
from t3mpc_ros.radio.serial_port import PortError, SerialPort

RequestFrame = frames.ToDongle | frames.ToBoard
ReplyFrame = frames.FromDongle | frames.FromBoard

NO_BOARD = 'no robot board answers on this port: is it the USB port of the robot?'
WRONG_BOARD = (
    'this is the dongle: key, settings and calibration of the robot are read and written over '
    'the USB port of the robot board; ls -l /dev/serial/by-id lists both'
)
OLD_FIRMWARE = 'the firmware of the robot does not know this request: make -C firmware flash'
_PING_TIMEOUT = 0.1  # timeout of a PING, s
_MAX_PINGS = 50  # five seconds; a board that was reset by opening its port starts within 2 s
_REPLY_TIMEOUT = 0.3
_MAX_ATTEMPTS = 5
_BYTE = 0xFF
_POLL_PERIOD = 0.05  # period at which the runner polls for an interruption, s
SHUTDOWN_TIMEOUT_NS = 3 * NANOSECONDS
"""Time for restoring a configuration or stopping the robot after an interruption."""


class ProcedureError(Exception):
    """A failed procedure; the text contains the reason and the remedy."""


class ProcedureInterrupted(Exception):
    """Raised in a script to end it; it restores what it changed."""


class Request(NamedTuple):
    """Send a frame, whose id the procedure sets, and wait for its reply."""

    frame: RequestFrame
    timeout: float  # s


class Pause(NamedTuple):
    """Wait for a number of seconds."""

    seconds: float


class Response(NamedTuple):
    """Result of a request or a pause."""

    reply: ReplyFrame | None  # none after a timeout or a pause
    sent_ns: int
    returned_ns: int

    @property
    def round_trip(self) -> float:
        """Time from writing the request to its reply, s."""
        return (self.returned_ns - self.sent_ns) / NANOSECONDS


Value = TypeVar('Value')
Reply = TypeVar('Reply', frames.KeyState, frames.RecordPart, frames.Samples)
Script = Generator[Request | Pause, Response, Value]
"""A script; its return value is the result of the procedure."""


class Board(NamedTuple):
    """A kind of board on a port."""

    name: str
    decode: Callable[[bytes], ReplyFrame]


DONGLE = Board('the dongle', decode_from_dongle)
ROBOT_BOARD = Board("the robot's board", decode_from_board)


class _PortTask(Protocol):
    """What :func:`run_at_port` runs: a procedure or a manoeuvre."""

    @property
    def done(self) -> bool: ...
    def step(self, now_ns: int, received: bytes = b'') -> list[PortAction]: ...
    def port_opened(self, now_ns: int) -> None: ...
    def port_failed(self, text: str, absent: bool, now_ns: int) -> None: ...
    def interrupt(self, now_ns: int) -> None: ...


class Procedure(Generic[Value]):
    """Runs a script as a function of time and bytes, up to a :attr:`result` or :attr:`error`."""

    def __init__(self, script: Script[Value], decode: Callable[[bytes], ReplyFrame]) -> None:
        self._script = script
        self._decode = decode
        self._decoder = FrameDecoder()
        self._actions: list[PortAction] = [Open()]
        self._request: RequestFrame | None = None
        self._sent_ns = self._until_ns = 0
        self._id = 0
        self._open = self._interrupted = False
        self.done = False
        self.error = ''
        self.result: Value | None = None

    def port_opened(self, now_ns: int) -> None:
        """Start the script."""
        self._open = True
        self._advance(lambda: next(self._script), now_ns)

    def port_failed(self, text: str, absent: bool, now_ns: int) -> None:
        """End with the error ``text``."""
        self._open = False
        # Requests of the script that restore a configuration have no receiver any more.
        with suppress(ProcedureError, ProcedureInterrupted, StopIteration):
            while True:
                self._script.throw(ProcedureError(text))
        self._finish(text)

    def interrupt(self, now_ns: int) -> None:
        """Interrupt the script once, so that it restores what it changed."""
        if self.done or self._interrupted:
            return
        self._interrupted = True
        if self._open:
            self._advance(lambda: self._script.throw(ProcedureInterrupted()), now_ns)
        else:
            self._finish('interrupted')

    def step(self, now_ns: int, received: bytes = b'') -> list[PortAction]:
        """Return the actions to execute now; the last one is the time of the next call."""
        for data in self._decoder.feed(received):
            try:
                reply = self._decode(data)
            except frames.FrameError:
                continue  # from another kind of board, or damaged with a valid CRC
            if self._request is not None and frames.is_reply(reply, self._request):
                self._resume(reply, now_ns)
        if self._open and not self.done and now_ns >= self._until_ns:
            self._resume(None, now_ns)
        actions, self._actions = self._actions, []
        return [*actions, Wait(max(self._until_ns, now_ns))]

    def _resume(self, reply: ReplyFrame | None, now_ns: int) -> None:
        response = Response(reply, self._sent_ns, now_ns)
        self._advance(lambda: self._script.send(response), now_ns)

    def _advance(self, resume: Callable[[], Request | Pause], now_ns: int) -> None:
        self._request = None
        self._sent_ns = now_ns
        try:
            request = resume()
        except StopIteration as end:
            self.result = end.value
            self._finish('')
        except ProcedureInterrupted:
            self._finish('interrupted')
        except ProcedureError as error:
            self._finish(str(error))
        else:
            seconds = request.seconds if isinstance(request, Pause) else request.timeout
            self._until_ns = now_ns + round(seconds * NANOSECONDS)
            if isinstance(request, Request):
                self._id = self._id + 1 & _BYTE
                self._request = request.frame._replace(id=self._id)
                # The zero ends a partial frame that the board may have received.
                self._actions.append(Write(b'\0' + encode_frame(encode(self._request))))

    def _finish(self, error: str) -> None:
        if not self.done:
            self.done, self.error = True, error
            self._actions.append(Close())


def _ask(
    frame: RequestFrame, kind: Any, timeout: float, attempts: int, silent: str
) -> Script[Any]:
    """Return the reply of a kind to a frame that is repeated, or raise ProcedureError(silent)."""
    for _ in range(attempts):
        response = yield Request(frame, timeout)
        if isinstance(response.reply, kind):
            return response.reply
    raise ProcedureError(silent)


def wait_for_board(absent: str = NO_BOARD) -> Script[frames.Pong]:
    """Wait for a board to start; return its PONG, or raise ProcedureError(absent)."""
    return _ask(frames.Ping(0, b'look'), frames.Pong, _PING_TIMEOUT, _MAX_PINGS, absent)


def request_reply(frame: RequestFrame, kind: type[Reply]) -> Script[Reply]:
    """Return the reply of the robot board to a frame, which is sent again after a timeout."""
    silent = 'the board stopped answering: did it restart, is the cable good?'
    kinds = kind, frames.Refusal
    reply = yield from _ask(frame, kinds, _REPLY_TIMEOUT, _MAX_ATTEMPTS, silent)
    if isinstance(reply, kind):
        return reply
    # A robot board refuses this as well; the answer of a dongle is no frame of a robot.
    configuration = yield Request(frames.Configure(0), _REPLY_TIMEOUT)
    is_robot = isinstance(configuration.reply, frames.Refusal)
    raise ProcedureError(OLD_FIRMWARE if is_robot else WRONG_BOARD)


def wait_for_dongle() -> Script[frames.Pong]:
    """Wait for a dongle with a working radio, or raise ProcedureError."""
    pong = yield from wait_for_board(reasons.NO_DONGLE)
    response = yield Request(frames.Configure(0), _PING_TIMEOUT)
    if isinstance(response.reply, frames.Refusal):
        raise ProcedureError(reasons.ROBOT_USB)
    if not pong.chip_ok:
        raise ProcedureError(reasons.NO_CHIP)
    return pong


def configure_radio(frame: frames.Configure) -> Script[None]:
    """Configure the radio of the dongle, or raise ProcedureError."""
    for _ in range(3):
        response = yield Request(frame, _PING_TIMEOUT)
        reply = response.reply
        if isinstance(reply, frames.Configured) and reply[1:-1] == frame[1:]:
            if not reply.chip_ok:
                raise ProcedureError(reasons.NO_CHIP)
            return
    raise ProcedureError(reasons.RADIO_NOT_CONFIGURED)


def read_radio_setup() -> Script[frames.Configure]:
    """Return the radio configuration of the dongle, or raise ProcedureError."""
    request, silent = frames.Configure(0), reasons.DONGLE_TIMEOUT
    reply = yield from _ask(request, frames.Configured, _PING_TIMEOUT, 3, silent)
    return frames.Configure(*reply[:-1])


def run_script(
    script: Script[Value], path: str, interrupted: Callable[[], bool], board: Board
) -> Value:
    """Return the result of a script at a port; an interruption is a ProcedureError, too."""
    procedure = Procedure(script, board.decode)
    run_at_port(procedure, path, interrupted, board.name)
    if procedure.error or procedure.result is None:
        raise ProcedureError(procedure.error or 'interrupted')
    return procedure.result


def run_at_port(
    task: _PortTask, path: str, interrupted: Callable[[], bool], device: str = DONGLE.name
) -> None:
    """Run a task at the port ``path`` of a device; poll ``interrupted`` 20 times a second."""
    runner = _PortRunner(task, path, device)
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
            received = runner.receive(runner.execute(task.step(now_ns, received)))
        runner.execute(task.step(time.monotonic_ns()))
    finally:
        runner.close()


class _PortRunner:
    def __init__(self, task: _PortTask, path: str, device: str) -> None:
        self._task, self._path, self._device = task, path, device
        self._port: SerialPort | None = None

    def execute(self, actions: list[PortAction]) -> int:
        """Execute the actions; return the time of the next step."""
        wake_ns = time.monotonic_ns()
        try:
            for action in actions:
                if isinstance(action, Wait):
                    wake_ns = action.until_ns
                elif isinstance(action, Open):
                    self._port = SerialPort(self._path, self._device)
                    self._task.port_opened(time.monotonic_ns())
                    return time.monotonic_ns()
                elif isinstance(action, Write) and self._port is not None:
                    self._port.write(action.data)
                elif isinstance(action, Close):
                    self.close()
        except PortError as error:
            self._report_failure(error)
            return time.monotonic_ns()
        return wake_ns

    def receive(self, until_ns: int) -> bytes:
        """Return the bytes received before ``until_ns``."""
        wait = min(max((until_ns - time.monotonic_ns()) / NANOSECONDS, 0.0), _POLL_PERIOD)
        if self._port is None:
            time.sleep(wait)
            return b''
        try:
            ready, _, _ = select.select([self._port], [], [], wait)
            return self._port.read() if ready else b''
        except PortError as error:
            self._report_failure(error)
            return b''

    def close(self) -> None:
        """Close the port if it is open."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def _report_failure(self, error: PortError) -> None:
        self._port = None
        self._task.port_failed(str(error), error.absent, time.monotonic_ns())
