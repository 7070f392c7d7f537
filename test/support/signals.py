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
"""Signals as a terminal leaves them."""

from contextlib import contextmanager
import signal

NUMBERS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP


def attend():
    """Attend to the signals that end a process, also where the caller ignores some.

    ``nohup`` ignores SIGHUP and the shell, for what runs in the background, SIGINT; children
    inherit that, and neither a shell nor this package changes it.
    """
    for number in NUMBERS:
        signal.signal(number, signal.SIG_DFL)


@contextmanager
def attended():
    """Attend to ignored signals in this process and those that it starts meanwhile."""
    ignored = [number for number in NUMBERS if signal.getsignal(number) == signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, signal.SIG_DFL)
    try:
        yield
    finally:
        for number in ignored:
            signal.signal(number, signal.SIG_IGN)
