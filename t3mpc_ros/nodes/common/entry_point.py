# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Entry points of the executables; signal handlers are installed before slow imports."""

import importlib
import os
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
            # Raised as an exception it would be lost, with a traceback, where Python happens to
            # be in a __del__; and there is nothing to clean up.
            os._exit(0)


def _main(name: str, room: str = '') -> int:
    request = StopRequest()
    request.install()
    process = importlib.import_module('t3mpc_ros.nodes.common.node_process')
    module = importlib.import_module(f't3mpc_ros.nodes.{room or name}')
    return process.run(name, module.make, request, sys.argv)


def reference_generator() -> int:
    """Run the fractional hyperchaotic reference generator."""
    return _main('reference_generator')


def controller() -> int:
    """Run the NT3FS-BM-MPC controller."""
    return _main('controller')


def sim_robot() -> int:
    """Run the simulated robot."""
    return _main('sim_robot')


def radio_bridge() -> int:
    """Run the bridge to the real robot."""
    return _main('radio_bridge')


def recorder() -> int:
    """Run the MCAP recorder."""
    return _main('recorder', 'recorder.node')


def player() -> int:
    """Run the player of bags."""
    return _main('player', 'player.node')


def composed() -> int:
    """Run all four in one process."""
    return _main('composed')
