# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Stop signal: SIGINT, SIGTERM and SIGHUP as a flag that a program polls."""

import signal
from types import FrameType
from typing import Self

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopSignal:
    """Becomes true when the process is asked to end; in a ``with`` block, instead of ending it."""

    def __init__(self) -> None:
        self._asked = False

    def __call__(self) -> bool:
        """Return whether it has been asked."""
        return self._asked

    def __enter__(self) -> Self:
        self._before = [signal.signal(number, self._take) for number in SIGNALS]
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in zip(SIGNALS, self._before, strict=True):
            signal.signal(number, handler)

    def _take(self, number: int, frame: FrameType | None) -> None:
        self._asked = True
