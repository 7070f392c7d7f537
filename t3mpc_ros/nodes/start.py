# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The executables: each takes over the signals first, and only then imports what is slow.

Importing ROS and the compiler takes a second or two. A Ctrl-C in that time has to end the
program as quietly as one that comes later, so nothing heavy stands at the top of this file.
"""

import importlib
import signal
import sys
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
            raise SystemExit(0)


def _main(name: str) -> int:
    request = StopRequest()
    request.install()
    process = importlib.import_module('t3mpc_ros.nodes.plumbing.process')
    module = importlib.import_module(f't3mpc_ros.nodes.{name}_node')
    return process.run(name, module.make, request, sys.argv)


def reference() -> int:
    """Run the fractional hyperchaotic reference generator."""
    return _main('reference')


def controller() -> int:
    """Run the NT3FS-BM-MPC controller."""
    return _main('controller')


def sim_robot() -> int:
    """Run the simulated robot."""
    return _main('sim_robot')


def recorder() -> int:
    """Run the MCAP recorder."""
    return _main('recorder')


def all_in_one() -> int:
    """Run all four in one process."""
    return _main('all_in_one')
