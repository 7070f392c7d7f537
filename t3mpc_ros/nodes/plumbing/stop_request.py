# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Signals as a flag; imports nothing slow, so that it can be in place before anything else."""

import os
import signal
from types import FrameType


class StopRequest:
    """Whether somebody has asked this process to end."""

    def __init__(self) -> None:
        self.wanted = False
        self.starting = True
        """While True a signal ends the process at once: there is nothing to stop yet."""

    def install(self) -> None:
        """Take over SIGINT and SIGTERM."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.wanted = True
        if self.starting:
            # Raised as an exception it would be lost, with a traceback, where Python happens to
            # be in a __del__; and there is nothing to clean up.
            os._exit(0)
