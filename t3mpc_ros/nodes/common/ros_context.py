# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Start of ROS in a process: also where its folder for logs cannot be written."""

from collections.abc import MutableMapping, Sequence
import os
from pathlib import Path
import tempfile


def init_ros(arguments: Sequence[str]) -> None:
    """Initialise rclpy with the arguments of a command line, without its signal handlers."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    provide_log_directory(os.environ)
    rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)


def provide_log_directory(environment: MutableMapping[str, str]) -> None:
    """Set ``ROS_LOG_DIR`` to a temporary folder where ROS could not write its logs.

    ROS writes them below ``ROS_HOME`` or ``~/.ros``; in a read-only home folder, as of a service
    or a container, no node would start. A folder that the user has chosen is not replaced.
    """
    if environment.get('ROS_LOG_DIR'):
        return
    base = environment.get('ROS_HOME') or str(Path(environment.get('HOME', os.devnull), '.ros'))
    try:
        Path(base, 'log').mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=Path(base, 'log')):
            pass
    except OSError:
        folder = Path(tempfile.gettempdir(), f't3mpc_ros-{os.getuid()}', 'log')
        environment['ROS_LOG_DIR'] = str(folder)
