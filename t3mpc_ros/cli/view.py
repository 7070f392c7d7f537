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
"""``t3mpc view``: a robot, or a recorded run, on a page in a browser of this machine."""

import argparse
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
import sys
import time
from typing import TYPE_CHECKING, Any
import webbrowser

from t3mpc_ros.cli.shared_options import new_folder
from t3mpc_ros.parameters.command_line import bounded_int
from t3mpc_ros.stop_signal import StopSignal

if TYPE_CHECKING:
    from t3mpc_ros.nodes.viewer import ViewNode
    from t3mpc_ros.view.live_data import LiveRun
    from t3mpc_ros.view.server import PageServer

DEFAULT_PORT = 8765
PAGE_AT = 'live page at '
"""Begin of the line that names the address of the page."""


def add_parser(commands: Any) -> None:
    """Add the subcommand ``view``."""
    parser = commands.add_parser(
        'view',
        help='page of a running robot or a bag: floor, signals, parameters, e-stop',
        description='Serves a page on this machine only. The robot is found in the ROS graph of '
        'this shell (ROS_DOMAIN_ID).',
    )
    parser.add_argument('--bag', type=Path, help='show this recording instead of a live robot')
    parser.add_argument('--namespace', default='', help='namespace of the robot (default: none)')
    text = f'TCP port on 127.0.0.1, 0: any free one (default {DEFAULT_PORT})'
    parser.add_argument('--port', type=bounded_int(0, 65535), default=DEFAULT_PORT, help=text)
    parser.add_argument('--read-only', action='store_true', help='show only, take no commands')
    text = 'folder for what the page records (default: runs)'
    parser.add_argument('--runs', type=new_folder, default=Path('runs'), help=text)
    parser.add_argument('--headless', action='store_true', help='open no browser')
    parser.set_defaults(run=_view)


def _view(options: argparse.Namespace) -> None:
    # Imported only when it is used: `t3mpc --help` stays fast.
    from t3mpc_ros.view.live_data import LiveRun
    from t3mpc_ros.view.server import PageServer

    with StopSignal() as stop:
        if options.bag is not None:
            from t3mpc_ros.cli.bag_on_live_page import recorded_run

            print(f'reading {options.bag}', file=sys.stderr, flush=True)
            shown = recorded_run(options.bag, options.namespace or None)
            with PageServer(shown, None, options.port, time.monotonic) as server:
                _announce(server, options)
                while not stop():
                    time.sleep(0.1)
            return
        from t3mpc_ros.nodes.node_main import check_environment

        check_environment()
        from t3mpc_ros.nodes.viewer import view_node  # takes a second

        run = LiveRun()
        with view_node(run, options.namespace) as node:
            page: AbstractContextManager[PageServer] = (
                PageServer(run, None, options.port, time.monotonic)
                if options.read_only
                else _commanded_page(run, node, options)
            )
            with page as server:
                _announce(server, options)
                node.spin(stop)


@contextmanager
def _commanded_page(
    run: 'LiveRun', node: 'ViewNode', options: argparse.Namespace
) -> 'Iterator[PageServer]':
    """Yield a page whose commands the node executes, but for those of the recorder."""
    from t3mpc_ros.cli.live_page_recording import RunRecorder
    from t3mpc_ros.view.server import PageServer

    def command(name: str, arguments: Mapping[str, Any], asked: float) -> str:
        if name != 'record':
            done: str = node.command(name, arguments, asked)
            return done
        if late := run.refusal(name, arguments.get('on'), asked, time.monotonic()):
            raise RuntimeError(late)
        return recorder.switch(arguments.get('on'))

    def show_report(file: Path) -> None:
        server.report = file

    recorder = RunRecorder(options.runs, options.namespace, run, show_report)
    try:
        with PageServer(run, command, options.port, time.monotonic) as server:
            yield server
    finally:
        recorder.close()


def _announce(server: 'PageServer', options: argparse.Namespace) -> None:
    print(f'{PAGE_AT}{server.url} (stop with Ctrl-C)', flush=True)
    if not options.headless:
        webbrowser.open(server.url)
