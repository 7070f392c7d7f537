# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
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
