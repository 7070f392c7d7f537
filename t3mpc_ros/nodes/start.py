# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The executables: each takes over the signals first, and only then imports what is slow.

Importing ROS and the compiler takes a second or two. A Ctrl-C in that time has to end the
program as quietly as one that comes later, so nothing heavy stands at the top of this file.
"""

import importlib
import sys

from t3mpc_ros.nodes.plumbing.stop_request import StopRequest


def _main(name: str, room: str = '') -> int:
    request = StopRequest()
    request.install()
    process = importlib.import_module('t3mpc_ros.nodes.plumbing.process')
    module = importlib.import_module(f't3mpc_ros.nodes.{room}{name}_node')
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


def radio_bridge() -> int:
    """Run the bridge to the real robot."""
    return _main('radio_bridge')


def recorder() -> int:
    """Run the MCAP recorder."""
    return _main('recorder')


def replayer() -> int:
    """Run the player of bags."""
    return _main('replayer', 'replaying.')


def all_in_one() -> int:
    """Run all four in one process."""
    return _main('all_in_one')
