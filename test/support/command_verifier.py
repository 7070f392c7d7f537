# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Rules of a session at the robot: for scripted robots, and an oracle of those in C."""

from t3mpc_ros.radio.protocol.authentication import (
    KEY_SIZE,
    NONCE_SIZE,
    SignedFrame,
    frame_tag,
    hello_tag,
    session_key,
)
from t3mpc_ros.radio.protocol.frames import Command, CommandFlag, Hello, RefusalReason


class CommandVerifier:
    """Robot end of a session: decides which frames are valid.

    Its methods return the reason for a refusal, NONE for a valid frame.

    Parameters
    ----------
    key
        Long-term key; empty for a robot without one.
    locked
        The key is damaged or about to change: no session starts, ESTOP stays valid.
    """

    def __init__(self, key: bytes = b'', locked: bool = False) -> None:
        if key and len(key) != KEY_SIZE:
            raise ValueError(f'key must be {KEY_SIZE} bytes long: got {len(key)}')
        self._key = key
        self._locked = locked
        self._session = 0
        self._session_key = b''
        self._host_nonce = b''
        self._robot_nonce = bytes(NONCE_SIZE) if key or locked else b''
        self._last = (0, 0)

    @property
    def key(self) -> bytes:
        """Long-term key; empty without a usable key."""
        return self._key

    @property
    def locked(self) -> bool:
        """Whether no session can start."""
        return self._locked

    @property
    def session(self) -> int:
        """Current session; 0 before the first HELLO."""
        return self._session

    @property
    def nonce(self) -> bytes:
        """Robot nonce for INFO: zeros before the first HELLO; empty without a key."""
        return self._robot_nonce

    def begin_session(self, hello: Hello, fresh_nonce: bytes) -> RefusalReason:
        """Start the session of a HELLO; return the reason for a refusal.

        ``fresh_nonce`` (8 unpredictable bytes) becomes the robot nonce, unless this HELLO repeats
        the last one because its answer was lost; then nothing changes.
        """
        if self._locked:
            return RefusalReason.KEY
        if bool(self._key) != bool(hello.tag):
            return RefusalReason.SIGNED if hello.tag else RefusalReason.UNSIGNED
        if self._key:
            if hello.tag != hello_tag(self._key, hello):
                return RefusalReason.TAG
            if hello.nonce == self._host_nonce:
                return RefusalReason.NONE
            self._session_key = session_key(self._key, hello.nonce, fresh_nonce)
            self._host_nonce, self._robot_nonce = hello.nonce, fresh_nonce
            self._last = (0, hello.host_us)
        self._session = hello.session
        return RefusalReason.NONE

    def verify(self, frame: SignedFrame) -> RefusalReason:
        """Return the reason for refusing a frame; a valid one invalidates itself and older ones.

        A CMD with ESTOP is always valid; its other fields count only if :meth:`accept` accepts it.
        """
        why = self.accept(frame)
        estop = isinstance(frame, Command) and frame.flags & CommandFlag.ESTOP
        return RefusalReason.NONE if estop else why

    def accept(self, frame: SignedFrame) -> RefusalReason:
        """Return why a frame is not part of the session; a valid one advances the replay counter.

        This includes a validly signed ESTOP, so that an ESTOP repeated for hours keeps the epoch.
        An ESTOP with a bad tag does not change the counter.
        """
        if not self._session or frame.session != self._session:
            return RefusalReason.SESSION
        if not self._key:
            return RefusalReason.SIGNED if frame.tag else RefusalReason.NONE
        if not frame.tag:
            return RefusalReason.UNSIGNED
        epoch, last = self._last
        if frame.host_us < last:
            epoch += 1
        expected = frame_tag(frame, self._session_key, epoch)
        if frame.host_us == last or expected != frame.tag:
            return RefusalReason.TAG
        self._last = (epoch, frame.host_us)
        return RefusalReason.NONE
