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
"""Authentication of commands: SipHash-2-4 tags and session keys.

The nRF24 has no protection of its own. With a 16-byte key at both ends, HELLO is signed under that
key, both ends add a nonce, and every CMD, PARAM_SET and ACTION is signed under the session key.
``host_us`` is signed and strictly increasing, and so serves as a counter; the number of its wraps
since HELLO (the epoch) is signed too, but not sent. Frames from the robot are not signed:
docs/radio.md lists what a forger of them can do.

SipHash-2-4: J.-P. Aumasson, D. J. Bernstein, SipHash: a fast short-input PRF, INDOCRYPT 2012,
DOI 10.1007/978-3-642-34931-7_28. Checked against the 64 published vectors of its 8-byte output.
"""

import os
from pathlib import Path
import stat
from typing import TypeVar

from t3mpc_ros.radio.protocol import frames
from t3mpc_ros.radio.protocol.codec import encode

KEY_SIZE = 16  # bytes
TAG_SIZE = 8  # bytes
NONCE_SIZE = 8  # bytes

SignedFrame = frames.Command | frames.ParamSet | frames.Action
"""Frames that change the robot, signed under the session key."""

_USE_HELLO, _USE_SESSION_KEY, _USE_CHECK = b'\x01', b'\x02', b'\x04'
"""Uses of the long-term key, before what is hashed: no output of one use is valid in another.

3 is the generation of nonces in the robot.
"""

AnySignedFrame = TypeVar('AnySignedFrame', frames.Command, frames.ParamSet, frames.Action)
_EMPTY_TAG = bytes(TAG_SIZE)


class KeyFileError(ValueError):
    """A key file that is unreadable, unprotected or invalid; the text contains the remedy."""


def read_key(path: Path) -> bytes:
    """Return the key in a file of 32 hexadecimal digits that only its owner can read.

    A leading ``~`` is the home folder: a shell does not expand it in ``key_file:=~/key``.
    KeyFileError, whose text never quotes it: unreadable, readable by others, or no key.
    """
    try:
        path = path.expanduser()
        # Not blocking: a FIFO would wait for its writer.
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), 'rb') as source:
            # Mode of the open file: the path may lead to another file meanwhile.
            status = os.fstat(source.fileno())
            regular, mode = stat.S_ISREG(status.st_mode), stat.S_IMODE(status.st_mode)
            content = source.read(1024) if regular else b''
    except OSError as error:
        raise KeyFileError(f'key file {path} cannot be read: {error.strerror}') from error
    except RuntimeError as error:  # a home folder that is not known
        raise KeyFileError(f'key file {path} cannot be read: {error}') from error
    if not regular:
        raise KeyFileError(f'key file {path} must be a regular file')
    if mode & 0o077:
        raise KeyFileError(
            f'key file {path} must be closed to all but its owner: got mode {mode:04o}; '
            f'chmod 600 {path}'
        )
    try:
        key = bytes.fromhex(content.decode('ascii'))
    except ValueError:  # includes UnicodeDecodeError, whose text would show the content
        raise KeyFileError(f'key file {path} must hold hexadecimal digits only') from None
    if len(key) != KEY_SIZE:
        raise KeyFileError(
            f'key file {path} must hold {2 * KEY_SIZE} hexadecimal digits: got {2 * len(key)}'
        )
    if not any(key):
        raise KeyFileError(
            f'key file {path} holds zeros only, which is no key; t3mpc robot key create makes one'
        )
    return key


def key_check(key: bytes) -> int:
    """Return a check value of 32 bits for comparing two keys.

    It allows a candidate key to be tested offline: the key must be random, not a passphrase.
    """
    return int.from_bytes(siphash(key, _USE_CHECK + b't3mpc')[:4], 'little')


def session_key(key: bytes, host_nonce: bytes, robot_nonce: bytes) -> bytes:
    """Return the key (16 bytes) of a session from the long-term key and both nonces."""
    for name, nonce in (('host_nonce', host_nonce), ('robot_nonce', robot_nonce)):
        if len(nonce) != NONCE_SIZE:
            raise ValueError(f'{name} must be {NONCE_SIZE} bytes long: got {len(nonce)}')
    nonces = _USE_SESSION_KEY + host_nonce + robot_nonce
    return siphash(key, nonces + b'\x00') + siphash(key, nonces + b'\x01')


def sign_hello(key: bytes, session: int, seq: int, host_us: int, nonce: bytes) -> frames.Hello:
    """Return a HELLO signed under the long-term key."""
    hello = frames.Hello(session, seq, host_us, nonce)
    return hello._replace(tag=hello_tag(key, hello))


def hello_tag(key: bytes, hello: frames.Hello) -> bytes:
    """Return the tag of a HELLO under the long-term key; the tag in the frame is ignored."""
    return siphash(key, _USE_HELLO + encode(hello._replace(tag=_EMPTY_TAG))[:-TAG_SIZE])


def frame_tag(frame: SignedFrame, key: bytes, epoch: int) -> bytes:
    """Return the tag of a frame under a session key; the tag in the frame is ignored."""
    body = encode(frame._replace(tag=_EMPTY_TAG))[:-TAG_SIZE]
    return siphash(key, body + epoch.to_bytes(4, 'little'))


class Signer:
    """Host end of a session from the ``host_us`` of its HELLO on: signs, counts the epoch."""

    def __init__(self, key: bytes, host_us: int) -> None:
        self._key = key
        self._last = host_us
        self.epoch = 0  # number of wraps of host_us since HELLO

    def sign(self, frame: AnySignedFrame) -> AnySignedFrame:
        """Return the frame with its tag.

        A lower ``host_us`` than before counts as a wrap: frames are signed in order of
        time, each within 71 minutes of the one before. ValueError: ``host_us`` equals that
        of the frame before; the robot would reject it as a replay.
        """
        if frame.host_us == self._last:
            raise ValueError(f'host_us must increase: got {frame.host_us} twice')
        if frame.host_us < self._last:
            self.epoch += 1
        self._last = frame.host_us
        return frame._replace(tag=frame_tag(frame, self._key, self.epoch))


# -- SipHash-2-4 ----------------------------------------------------------------------------------

_MASK_64 = 0xFFFFFFFFFFFFFFFF


def siphash(key: bytes, message: bytes) -> bytes:
    """Return the 8 bytes (little endian) of SipHash-2-4 of ``message`` under ``key``."""
    if len(key) != KEY_SIZE:
        raise ValueError(f'key must be {KEY_SIZE} bytes long: got {len(key)}')
    low, high = int.from_bytes(key[:8], 'little'), int.from_bytes(key[8:], 'little')
    # The nothing-up-my-sleeve number of the paper: "somepseudorandomlygeneratedbytes".
    state = (
        low ^ 0x736F6D6570736575,
        high ^ 0x646F72616E646F6D,
        low ^ 0x6C7967656E657261,
        high ^ 0x7465646279746573,
    )
    whole = len(message) - len(message) % 8
    last = (len(message) & 0xFF) << 56 | int.from_bytes(message[whole:], 'little')
    words = [int.from_bytes(message[at : at + 8], 'little') for at in range(0, whole, 8)]
    for word in (*words, last):
        a, b, c, d = _sip_rounds(state[0], state[1], state[2], state[3] ^ word, 2)
        state = a ^ word, b, c, d
    a, b, c, d = _sip_rounds(state[0], state[1], state[2] ^ 0xFF, state[3], 4)
    return (a ^ b ^ c ^ d).to_bytes(TAG_SIZE, 'little')


def _sip_rounds(a: int, b: int, c: int, d: int, count: int) -> tuple[int, int, int, int]:
    """Return the state (v0..v3) after ``count`` SipRounds."""
    for _ in range(count):
        a = (a + b) & _MASK_64
        b = (b << 13 & _MASK_64 | b >> 51) ^ a
        a = a << 32 & _MASK_64 | a >> 32
        c = (c + d) & _MASK_64
        d = (d << 16 & _MASK_64 | d >> 48) ^ c
        a = (a + d) & _MASK_64
        d = (d << 21 & _MASK_64 | d >> 43) ^ a
        c = (c + b) & _MASK_64
        b = (b << 17 & _MASK_64 | b >> 47) ^ c
        c = c << 32 & _MASK_64 | c >> 32
    return a, b, c, d
