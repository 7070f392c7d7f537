# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Stop signal: SIGINT, SIGTERM and SIGHUP as a flag that a program polls."""

import signal
from types import FrameType
from typing import Self

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopSignal:
    """True after the first signal; installs its handlers for the length of a ``with`` block."""

    def __init__(self) -> None:
        self._received = False
        self.number = 0
        """Number of the first signal; 0 before."""

    def __call__(self) -> bool:
        """Return whether a signal was received."""
        return self._received

    def __enter__(self) -> Self:
        self._previous = [signal.signal(number, self._handle) for number in SIGNALS]
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in zip(SIGNALS, self._previous, strict=True):
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self._received = True
        self.number = self.number or number
