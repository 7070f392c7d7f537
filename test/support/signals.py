# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Signals as a terminal leaves them."""

from contextlib import contextmanager
import signal


def attend():
    """Attend to the signals that end a process, also where the caller ignores some.

    ``nohup`` ignores SIGHUP and the shell, for what runs in the background, SIGINT; children
    inherit that, and neither a shell nor this package changes it.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@contextmanager
def hangup_attended():
    """Have SIGHUP end this process and those that it starts meanwhile."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)
