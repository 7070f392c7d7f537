# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Entry point of the executable ``t3mpc``; the import lets Ctrl-C end it without a traceback."""

import os
import signal

INTERRUPTED = 130
"""Exit code after Ctrl-C."""

signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))


def t3mpc() -> int:
    """Return the exit code of the command line of this process."""
    from t3mpc_ros.cli.main import main

    signal.signal(signal.SIGINT, signal.default_int_handler)
    return main()
