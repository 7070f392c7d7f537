# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Rules of a session at the robot, for scripted robots."""

from t3mpc_ros.radio.protocol import authentication
from t3mpc_ros.radio.protocol.frames import Command, CommandFlag, Hello, RefusalReason


class CommandVerifier:
    """Robot end of a session; its methods return why a frame is refused, NONE for a valid one."""

    def __init__(self, key: bytes = b'') -> None:
        self._key = key
        self.session = 0
        self._session_key = b''
        self._host_nonce = b''
        self.nonce = bytes(authentication.NONCE_SIZE) if key else b''
        """Nonce of the robot for INFO: zeros before the first HELLO; empty without a key."""
        self._last = (0, 0)

    def begin_session(self, hello: Hello, fresh_nonce: bytes) -> RefusalReason:
        """Start the session of a HELLO; return the reason for a refusal.

        ``fresh_nonce`` (8 unpredictable bytes) becomes the robot nonce, unless this HELLO repeats
        the last one because its answer was lost; then nothing changes.
        """
        if bool(self._key) != bool(hello.tag):
            return RefusalReason.SIGNED if hello.tag else RefusalReason.UNSIGNED
        if self._key:
            if hello.tag != authentication.hello_tag(self._key, hello):
                return RefusalReason.TAG
            if hello.nonce == self._host_nonce:
                return RefusalReason.NONE
            self._session_key = authentication.session_key(self._key, hello.nonce, fresh_nonce)
            self._host_nonce, self.nonce = hello.nonce, fresh_nonce
            self._last = (0, hello.host_us)
        self.session = hello.session
        return RefusalReason.NONE

    def verify(self, frame: authentication.SignedFrame) -> RefusalReason:
        """Return the reason for refusing a frame; a valid one invalidates itself and older ones.

        A CMD with ESTOP is always valid; its other fields count only if :meth:`accept` accepts it.
        """
        why = self.accept(frame)
        estop = isinstance(frame, Command) and frame.flags & CommandFlag.ESTOP
        return RefusalReason.NONE if estop else why

    def accept(self, frame: authentication.SignedFrame) -> RefusalReason:
        """Return why a frame is not part of the session; a valid one advances the replay counter.

        This includes a validly signed ESTOP, so that an ESTOP repeated for hours keeps the epoch.
        An ESTOP with a bad tag does not change the counter.
        """
        if not self.session or frame.session != self.session:
            return RefusalReason.SESSION
        if not self._key:
            return RefusalReason.SIGNED if frame.tag else RefusalReason.NONE
        if not frame.tag:
            return RefusalReason.UNSIGNED
        epoch, last = self._last
        if frame.host_us < last:
            epoch += 1
        expected = authentication.frame_tag(frame, self._session_key, epoch)
        if frame.host_us == last or expected != frame.tag:
            return RefusalReason.TAG
        self._last = (epoch, frame.host_us)
        return RefusalReason.NONE
