# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Session with the robot (number, key, frames) and the handshake that starts it.

HELLO, INFO, then the board parameters are written and read back. The session number is random, so
a robot that restarted or follows another host is detected.
"""

from collections import deque
from collections.abc import Callable

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.port_actions import LinkState
from t3mpc_ros.radio.link.transaction import TransactionResult
from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.authentication import (
    NONCE_SIZE,
    AnySignedFrame,
    Signer,
    session_key,
    sign_hello,
)
from t3mpc_ros.radio.protocol.frames import (
    BOARD_PARAMETERS,
    VERSION,
    Action,
    Command,
    Downlink,
    Hello,
    Info,
    Param,
    ParamGet,
    ParamSet,
    Poll,
)

Entropy = Callable[[int], bytes]
"""Returns that many bytes nobody can foresee."""

_BYTE, _WORD = 0xFF, 0xFFFFFFFF
_RETRY_NS = NANOSECONDS // 10
_REJECTED_RETRY_NS = NANOSECONDS
"""What was refused will be again: another try now and then, for it may have been set right."""
_MAX_ATTEMPTS = 50
"""Of one parameter, before the robot is greeted anew."""
_RESULT_TEXTS = {
    frames.UNKNOWN: 'does not know it',
    frames.OUT_OF_RANGE: 'allows {low} to {high}',
    frames.READ_ONLY: 'does not let it be changed',
    frames.BUSY: 'is busy',
}


class Session:
    """Makes the frames of one session, signed if there is a key.

    Parameters
    ----------
    key
        The long-term key; empty on an open link.
    entropy
        For the number and the nonce.
    before
        Number of the session before: this one gets another.
    now_ns
        By the host's steady clock.
    """

    def __init__(self, key: bytes, entropy: Entropy, before: int, now_ns: int) -> None:
        self._key = key
        drawn = entropy(1)[0]
        self._number = 1 + ((before + drawn % 254) % 255 if before else drawn % 255)
        self._last_us = now_ns // 1000
        self._seq = 0
        self._request = 0
        self._signer: Signer | None = None
        # The same at every try, so that the robot knows a repeated one.
        self._nonce = entropy(NONCE_SIZE) if key else b''
        self._hello_us = self._last_us & _WORD

    @property
    def number(self) -> int:
        """1 to 255."""
        return self._number

    def hello(self, now_ns: int) -> Hello:
        """Return the frame that starts this session, stamped anew at every try.

        It is the first the robot learns of the host's clock: with the stamp of an earlier try, a
        command as old as that would pass for a prompt one.
        """
        self._hello_us = host_us = self._stamp(now_ns)
        if not self._key:
            return Hello(self._number, 0, host_us)
        return sign_hello(self._key, self._number, 0, host_us, self._nonce)

    def accept(self, info: Info) -> str:
        """Begin the session if the robot is in it; return what is wrong if not."""
        if info.protocol != VERSION:
            return f'the robot must speak protocol {VERSION}: it speaks {info.protocol}'
        if self._key and not info.nonce:
            return reasons.ROBOT_KEY_MISSING
        if info.nonce and not self._key:
            return reasons.HOST_KEY_MISSING
        if info.session != self._number:
            return reasons.KEY_MISMATCH if self._key else reasons.HELLO_REJECTED
        if self._key:
            key = session_key(self._key, self._nonce, info.nonce)
            self._signer = Signer(key, self._hello_us)
        return ''

    def command(self, flags: int, ttl: int, left: int, right: int, now_ns: int) -> Command:
        """Return the next CMD."""
        self._seq = self._seq + 1 & _BYTE
        frame = Command(self._number, self._seq, flags, ttl, left, right, self._stamp(now_ns))
        return self._signed(frame)

    def set(self, number: int, value: int, now_ns: int) -> ParamSet:
        """Return a PARAM_SET."""
        frame = ParamSet(self._number, self._next_request(), number, value)
        if self._signer is None:
            return frame
        return self._signed(frame._replace(host_us=self._stamp(now_ns)))

    def get(self, number: int) -> ParamGet:
        """Return a PARAM_GET."""
        return ParamGet(self._number, self._next_request(), number)

    def action(self, verb: int, now_ns: int) -> Action:
        """Return an ACTION."""
        frame = Action(self._number, self._next_request(), verb)
        if self._signer is None:
            return frame
        return self._signed(frame._replace(host_us=self._stamp(now_ns)))

    def poll(self, what: int) -> Poll:
        """Return a POLL."""
        return Poll(self._number, self._seq, what)

    def _signed(self, frame: AnySignedFrame) -> AnySignedFrame:
        return frame if self._signer is None else self._signer.sign(frame)

    def _next_request(self) -> int:
        # Apart from the commands: the robot would take those for old after 128 lost requests.
        self._request = self._request + 1 & _BYTE
        return self._request

    def _stamp(self, now_ns: int) -> int:
        # Strictly increasing even if the clock stands: it is the counter of what is signed.
        self._last_us = max(self._last_us + 1, now_ns // 1000)
        return self._last_us & _WORD


class Handshake:
    """Leads from HELLO to RUN.

    Parameters
    ----------
    session
        To be begun.
    settings
        Its robot parameters are written.
    why
        Why the robot has to be greeted; said until there is something newer to say.
    """

    def __init__(self, session: Session, parameters: LinkParameters, why: str) -> None:
        self._session = session
        self._wanted = parameters.robot.on_wire()
        self._channel = parameters.channel
        self._state = LinkState.HELLO
        self._why = why
        self._todo: deque[tuple[int, int | None]] = deque()
        self._tries = 0
        self._info: Info | None = None
        self._board_parameters: dict[int, int] = {}

    @property
    def state(self) -> LinkState:
        """HELLO, INFO or PARAMS; RUN when there is nothing left to do."""
        return self._state

    @property
    def why(self) -> str:
        """What is being waited for, or what is wrong."""
        return self._why

    @property
    def info(self) -> Info | None:
        """Who the robot is, once the session has begun."""
        return self._info

    @property
    def parameters(self) -> dict[int, int]:
        """What was read back, by id."""
        return self._board_parameters

    def next(self, now_ns: int) -> tuple[Downlink, int]:
        """Return what to send now, and what to POLL after it."""
        if self._state is LinkState.HELLO:
            return self._session.hello(now_ns), frames.INFO
        if self._state is LinkState.INFO:
            return self._session.poll(frames.INFO), frames.INFO
        number, value = self._todo[0]
        if value is None:
            return self._session.get(number), frames.STATE
        return self._session.set(number, value, now_ns), frames.STATE

    def hear(self, heard: TransactionResult) -> int:
        """Take the answer and return how long (ns) to wait before the next step."""
        if self._state is LinkState.PARAMS:
            return self._hear_parameter(heard)
        if isinstance(heard.uplink, Info):
            return self._meet(heard.uplink)
        if heard.uplink is None:
            self._state = LinkState.HELLO
            self._why = reasons.robot_absent(self._channel)
            return _RETRY_NS
        self._state = LinkState.INFO
        return 0

    def _meet(self, info: Info) -> int:
        problem = self._session.accept(info)
        if problem:
            self._state, self._why = LinkState.HELLO, problem
            return _RETRY_NS
        self._info = info
        self._state = LinkState.PARAMS
        self._list(info.parameters)
        return 0

    def _list(self, count: int) -> None:
        """Note what is to be written and read; a robot of an older make has fewer parameters."""
        self._todo.clear()
        self._todo.extend((number, self._wanted[number]) for number in self._wanted)
        self._todo.extend((number, None) for number in range(min(count, len(BOARD_PARAMETERS))))

    def _hear_parameter(self, heard: TransactionResult) -> int:
        number, wanted = self._todo[0]
        answer = heard.uplink
        asked_seq = getattr(heard.asked, 'seq', None)
        if not isinstance(answer, Param) or (answer.id, answer.seq) != (number, asked_seq):
            self._tries += 1
            if self._tries >= _MAX_ATTEMPTS:
                self._tries, self._state, self._why = (
                    0,
                    LinkState.HELLO,
                    reasons.robot_absent(self._channel),
                )
            return 0 if heard.uplink is not None else _RETRY_NS // 5
        self._tries = 0
        name = BOARD_PARAMETERS[number].name
        if answer.rc != frames.OK:
            told = _RESULT_TEXTS[answer.rc].format(low=answer.low, high=answer.high)
            what = f'{name} = {wanted}' if isinstance(heard.asked, ParamSet) else name
            self._why = f'parameter {what} was refused: the robot {told}'
            return _RETRY_NS if answer.rc == frames.BUSY else _REJECTED_RETRY_NS
        self._board_parameters[number] = answer.value
        expected = self._wanted.get(number, answer.value)
        if answer.value != expected:
            self._why = f'parameter {name} must be {expected}: the robot keeps {answer.value}'
            self._list(self._info.parameters if self._info else 0)
            return _REJECTED_RETRY_NS
        self._todo.popleft()
        if not self._todo:
            self._state = LinkState.RUN
        return 0
