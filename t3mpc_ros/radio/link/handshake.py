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
"""Session with the robot (number, key, frames) and the handshake that starts it.

HELLO, INFO, then the board parameters are written and read back. The session number is random, so
a robot that restarted or follows another host is detected.
"""

from collections import deque
from collections.abc import Callable

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.radio.link import standstill_reasons as reasons
from t3mpc_ros.radio.link.actions_and_states import LinkState
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.transaction import TransactionResult
from t3mpc_ros.radio.protocol import authentication, frames

Entropy = Callable[[int], bytes]  # returns a number of unpredictable bytes

_BYTE, _WORD = 0xFF, 0xFFFFFFFF
_RETRY_NS = NANOSECONDS // 10
_REJECTED_RETRY_NS = NANOSECONDS
"""Retry period after a rejection, whose cause may be repaired meanwhile."""
BOOTS_ID = [parameter.name for parameter in frames.BOARD_PARAMETERS].index('boots')
_BOOTS_READS = 4
"""Additional reads of the count of starts: of two robots with one address, both answer in turn."""
_MAX_ATTEMPTS = 50  # attempts for one parameter before a new HELLO
_RESULT_TEXTS = {
    frames.UNKNOWN: 'does not support it',
    frames.OUT_OF_RANGE: 'allows {low} to {high}',
    frames.READ_ONLY: 'has it read-only',
    frames.BUSY: 'is busy',
}


class Session:
    """Builds the frames of one session, signed with a key; ``before`` is the last number, or 0."""

    def __init__(self, key: bytes, entropy: Entropy, before: int, now_ns: int) -> None:
        self._key = key
        drawn = entropy(1)[0]
        self.number = 1 + ((before + drawn % 254) % 255 if before else drawn % 255)
        """Session number, 1 to 255."""
        self._last_us = now_ns // 1000
        self._seq = 0
        self._request = 0
        self._signer: authentication.Signer | None = None
        # Constant over all attempts, so that the robot recognises a repeated HELLO.
        self._nonce = entropy(authentication.NONCE_SIZE) if key else b''
        self._hello_us = self._last_us & _WORD
        self.echo_us: int | None = None
        """Robot time of the newest STATE; None before the first: the robot refuses every CMD."""

    def hello(self, now_ns: int) -> frames.Hello:
        """Return the HELLO of this session."""
        if not self._key:
            return frames.Hello(self.number, 0)
        self._hello_us = self._stamp(now_ns)
        return authentication.sign_hello(self._key, self.number, 0, self._hello_us, self._nonce)

    def accept(self, info: frames.Info) -> str:
        """Start the session with the INFO of the robot; return the problem if there is one."""
        if info.protocol != frames.VERSION:
            return reasons.robot_version(info.protocol)
        if info.settings in reasons.SETTINGS:
            return reasons.SETTINGS[info.settings]
        if self._key and not info.nonce:
            return reasons.ROBOT_KEY_MISSING
        if info.nonce and not self._key:
            return reasons.HOST_KEY_MISSING
        if info.session != self.number:
            return reasons.refused('HELLO', info.refusal)
        if self._key:
            key = authentication.session_key(self._key, self._nonce, info.nonce)
            self._signer = authentication.Signer(key, self._hello_us)
        return ''

    def command(self, flags: int, ttl: int, left: int, right: int, now_ns: int) -> frames.Command:
        """Return the next CMD; without an echo it can only be an emergency stop."""
        self._seq = self._seq + 1 & _BYTE
        echo_us = 0 if self.echo_us is None else self.echo_us
        frame = frames.Command(self.number, self._seq, flags, ttl, left, right, echo_us)
        return self._sign(frame, now_ns)

    def set(self, number: int, value: int, now_ns: int) -> frames.ParamSet:
        """Return a PARAM_SET."""
        return self._sign(
            frames.ParamSet(self.number, self._next_request(), number, value), now_ns
        )

    def get(self, number: int) -> frames.ParamGet:
        """Return a PARAM_GET."""
        return frames.ParamGet(self.number, self._next_request(), number)

    def poll(self, what: int) -> frames.Poll:
        """Return a POLL."""
        return frames.Poll(self.number, self._seq, what)

    def _sign(
        self, frame: authentication.AnySignedFrame, now_ns: int
    ) -> authentication.AnySignedFrame:
        if self._signer is None:
            return frame
        return self._signer.sign(frame._replace(host_us=self._stamp(now_ns)))

    def _next_request(self) -> int:
        # Separate from commands, which the robot would reject as old after 128 lost requests.
        self._request = self._request + 1 & _BYTE
        return self._request

    def _stamp(self, now_ns: int) -> int:
        # Strictly increasing even if the clock is not: it is the counter of signed frames.
        self._last_us = max(self._last_us + 1, now_ns // 1000)
        return self._last_us & _WORD


class Handshake:
    """Handshake from HELLO to RUN.

    ``reason`` for it is reported until there is a newer one; ``absent`` and ``no_reply`` are those
    for a robot, and for the board at the port, that does not answer.
    """

    def __init__(
        self, session: Session, parameters: LinkParameters, reason: str, absent: str, no_reply: str
    ) -> None:
        self._session = session
        self._targets = parameters.robot.to_wire()
        self._absent, self._no_reply = absent, no_reply
        self.state = LinkState.HELLO  # HELLO, INFO or PARAMS; RUN when the handshake is complete
        self.reason = reason  # reason why the handshake is not complete
        self._pending: deque[tuple[int, int | None]] = deque()
        self._attempts = 0
        self.info: frames.Info | None = None  # identity of the robot, once the session has started
        self.board_parameters: dict[int, int] = {}  # board parameters as read back, by id

    def next_request(self, now_ns: int) -> tuple[frames.Downlink, int]:
        """Return the payload to send now, and the frame to POLL after it."""
        if self.state is LinkState.HELLO:
            return self._session.hello(now_ns), frames.INFO
        if self.state is LinkState.INFO:
            return self._session.poll(frames.INFO), frames.INFO
        number, value = self._pending[0]
        if value is None:
            return self._session.get(number), frames.STATE
        return self._session.set(number, value, now_ns), frames.STATE

    def handle(self, result: TransactionResult) -> int:
        """Process a result; return the delay before the next request, ns."""
        if self.state is LinkState.PARAMS:
            return self._handle_parameter(result)
        if isinstance(result.uplink, frames.Info):
            return self._handle_info(result.uplink)
        if result.uplink is None:
            self.state = LinkState.HELLO
            self.reason = self._no_reply if result.reply is None else self._absent
            if result.foreign_version:
                self.reason = reasons.robot_version(result.foreign_version)
            return _RETRY_NS
        self.state = LinkState.INFO
        return 0

    def _handle_info(self, info: frames.Info) -> int:
        problem = self._session.accept(info)
        if problem:
            self.state, self.reason = LinkState.HELLO, problem
            return _RETRY_NS
        self.info = info
        self.state, self.reason = LinkState.PARAMS, LinkState.PARAMS.value
        self._queue_parameters(info.parameters)
        return 0

    def _queue_parameters(self, count: int) -> None:
        """Queue all writes and reads; older firmware has fewer parameters."""
        reads = range(min(count, len(frames.BOARD_PARAMETERS)))
        self._pending = deque([*self._targets.items(), *((number, None) for number in reads)])
        if count > BOOTS_ID:
            self._pending.extend([(BOOTS_ID, None)] * _BOOTS_READS)

    def _handle_parameter(self, result: TransactionResult) -> int:
        number, target = self._pending[0]
        answer = result.uplink
        expected = number, getattr(result.request, 'seq', None)
        if not isinstance(answer, frames.Param) or (answer.id, answer.seq) != expected:
            self._attempts += 1
            if self._attempts >= _MAX_ATTEMPTS:
                self._attempts, self.state = 0, LinkState.HELLO
                self.reason = self._absent
            return 0 if result.uplink is not None else _RETRY_NS // 5
        self._attempts = 0
        name = frames.BOARD_PARAMETERS[number].name
        if answer.rc != frames.OK:
            text = _RESULT_TEXTS[answer.rc].format(low=answer.low, high=answer.high)
            what = f'{name} = {target}' if isinstance(result.request, frames.ParamSet) else name
            self.reason = f'parameter {what} was refused: the robot {text}'
            return _RETRY_NS if answer.rc == frames.BUSY else _REJECTED_RETRY_NS
        self.board_parameters[number] = answer.value
        wanted = self._targets.get(number, answer.value)
        if answer.value != wanted:
            self.reason = f'parameter {name} must be {wanted}: the robot keeps {answer.value}'
            self._queue_parameters(self.info.parameters if self.info else 0)
            return _REJECTED_RETRY_NS
        self._pending.popleft()
        if not self._pending:
            self.state = LinkState.RUN
        return 0
