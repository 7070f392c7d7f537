# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc view``: a robot, or a recorded run, on a page in a browser of this machine."""

import argparse
from collections.abc import Mapping, Sequence
import math
from pathlib import Path
import sys
import time
from typing import Any
import webbrowser

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.parameters.command_line import bounded_int
from t3mpc_ros.stop_signal import StopSignal
from t3mpc_ros.view.live_data import LiveData
from t3mpc_ros.view.live_run import LiveRun
from t3mpc_ros.view.server import DEFAULT_PORT, Command, CommandError, PageServer

Array = NDArray[np.float64]

STEP = 0.019
"""Least time between two samples of a recorded run that are shown, s."""
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
    with StopSignal() as stop:
        if options.bag is not None:
            print(f'reading {options.bag}', file=sys.stderr, flush=True)
            with PageServer(_recorded(options.bag), None, options.port) as server:
                _announce(server, options)
                while not stop():
                    time.sleep(0.1)
            return 0
        from t3mpc_ros.nodes.viewer import CommandFailedError, view_node  # takes a second

        run = LiveRun()
        with view_node(run, options.namespace) as node:

            def execute(name: str, arguments: Mapping[str, Any]) -> str:
                try:
                    done: str = node.command(name, arguments)
                except CommandFailedError as error:
                    raise CommandError(str(error)) from None
                return done

            command: Command | None = None if options.read_only else execute
            with PageServer(run, command, options.port) as server:
                _announce(server, options)
                node.spin(stop)
    return 0


def _announce(server: PageServer, options: argparse.Namespace) -> None:
    print(f'{PAGE_AT}{server.url} (stop with Ctrl-C)', flush=True)
    if not options.headless:
        webbrowser.open(server.url)


def _recorded(bag: Path) -> LiveData:
    """Return a recorded run as the page shows it."""
    from t3mpc_ros.bag.reader import open_bag
    from t3mpc_ros.control.control_law import TERM_NAMES
    from t3mpc_ros.evaluation.bag_report.metrics import compute_metrics
    from t3mpc_ros.evaluation.bag_report.run_data import load_run
    from t3mpc_ros.evaluation.bag_report.topic_roles import bag_display_name
    from t3mpc_ros.simulation.world import world_outline

    data = LiveData(math.inf)
    with open_bag(bag) as recording:
        run = load_run(recording)
        verdict = compute_metrics(run, Path(), (), recording.message_count).verdict
        world = recording.metadata_records.get('sim_robot', {}).get('world', '')
    if run.geometry is None:
        raise ValueError(
            f'{bag} has no parameters of a robot: its wheel radius and separation are not known '
            '(t3mpc bag report takes them as options)'
        )
    motion = ('right', 'left', 'x', 'y', 'yaw')
    for stream, topic, names in (
        ('odometry', 'odom', motion),
        ('truth', 'ground_truth/odom', motion),
        ('reference', 'reference', motion),
        ('command', 'cmd_vel', motion[:2]),
    ):
        if topic in run.motions:
            series = run.motions[topic]
            _add_columns(data, stream, series.time, [series[name] for name in names])
    terms = [
        run.numbers.get(f'controller/terms/{term}/{wheel}')
        for term in TERM_NAMES
        for wheel in ('right', 'left')
    ]
    if first := terms[0]:
        columns = [
            np.interp(first.time, each.time, each['value'])
            if each
            else np.full(len(first), np.nan)
            for each in terms
        ]
        _add_columns(data, 'terms', first.time, columns)
    for time_of_switch in run.switches.tolist():
        data.report(time_of_switch, 'switch', 'switch of the reference')
    for when, _, node, text in run.complaints:
        data.report(when, 'note', f'{node}: {text}')
    data.set('terms', list(TERM_NAMES))
    data.set(
        'robot',
        {
            'wheel_radius': run.geometry.wheel_radius,
            'wheel_separation': 2.0 * run.geometry.half_separation,
        },
    )
    data.set('world', world_outline(world))
    good = verdict is not None and verdict.sound
    data.set(
        'banner',
        {
            'kind': 'good' if good else 'warning',
            'headline': f'Recording {bag_display_name(bag)}, {run.duration:.1f} s',
            'detail': '' if verdict is None else verdict.text(),
        },
    )
    data.set('recording', {'duration': run.duration})
    return data


def _add_columns(data: LiveData, stream: str, time: Array, columns: Sequence[Array]) -> None:
    """Add a stream, every sample that is at least :data:`STEP` after the last one."""
    last = -math.inf
    for row, at in enumerate(time.tolist()):
        if at - last >= STEP:
            last = at
            data.add(stream, at, [column[row] for column in columns])
