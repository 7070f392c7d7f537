# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc view``: the live page of a robot, in a browser of this machine."""

import argparse
from collections.abc import Mapping
from typing import Any
import webbrowser

from t3mpc_ros.parameters.command_line import bounded_int
from t3mpc_ros.stop_signal import StopSignal
from t3mpc_ros.view.live_run import LiveRun
from t3mpc_ros.view.server import DEFAULT_PORT, Command, CommandError, PageServer

PAGE_AT = 'live page at '
"""Begin of the line that names the address of the page."""


def add_parser(commands: Any) -> None:
    """Add the subcommand ``view``."""
    parser = commands.add_parser(
        'view',
        help='live page of a running robot: floor, signals, parameters, e-stop',
        description='Serves a page on this machine only. The robot is found in the ROS graph of '
        'this shell (ROS_DOMAIN_ID).',
    )
    parser.add_argument('--namespace', default='', help='namespace of the robot (default: none)')
    parser.add_argument(
        '--port',
        type=bounded_int(0, 65535),
        default=DEFAULT_PORT,
        help=f'TCP port on 127.0.0.1, 0: any free one (default {DEFAULT_PORT})',
    )
    parser.add_argument('--read-only', action='store_true', help='show only, take no commands')
    parser.add_argument('--headless', action='store_true', help='open no browser')
    parser.set_defaults(run=_view)


def _view(options: argparse.Namespace) -> int:
    from t3mpc_ros.nodes.viewer import CommandFailedError, view_node  # takes a second

    run = LiveRun()
    with StopSignal() as stop, view_node(run, options.namespace) as node:

        def execute(name: str, arguments: Mapping[str, Any]) -> str:
            try:
                done: str = node.command(name, arguments)
            except CommandFailedError as error:
                raise CommandError(str(error)) from None
            return done

        command: Command | None = None if options.read_only else execute
        with PageServer(run, command, options.port) as server:
            print(f'{PAGE_AT}{server.url} (stop with Ctrl-C)', flush=True)
            if not options.headless:
                webbrowser.open(server.url)
            node.spin(stop)
    return 0
