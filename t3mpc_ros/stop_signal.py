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
"""What ends a process: SIGINT, SIGTERM and SIGHUP as a flag that it polls.

The executables import this module first, and until then a signal ends them with a traceback: it
imports nothing that Python has not loaded.
"""

import os
import signal
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopSignal:
    """True after the first signal; a ``with`` block restores the handlers from before."""

    def __init__(self) -> None:
        self.number = 0
        """Number of the first signal; 0 before."""
        self.exit_at_once = False
        """While True a signal ends the process with code 0: there is nothing to clean up."""

    def __call__(self) -> bool:
        """Return whether a signal was received."""
        return self.number != 0

    def install(self) -> 'StopSignal':
        """Install the handlers; a hangup that is ignored, as after nohup, stays ignored."""
        self._previous = {
            number: signal.signal(number, self._handle)
            for number in SIGNALS
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN
        }
        return self

    __enter__ = install

    def __exit__(self, *error: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.number = self.number or number
        if self.exit_at_once:
            # An exception would be lost, with a traceback, if Python is in a __del__.
            os._exit(0)
