# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``bag report BAG``: pictures and figures of any bag with odometry or commands."""

import argparse
from pathlib import Path


def add_report_parser(commands: 'argparse._SubParsersAction[argparse.ArgumentParser]') -> None:
    """Add ``report`` to the commands of ``bag``; ``options.run(options)`` carries it out."""
    parser = commands.add_parser(
        'report',
        help='draw the report of a bag',
        description='Writes report.html and its pictures. The bag may be of any robot: MCAP or '
        'sqlite3, with a topic of odometry (nav_msgs/Odometry), of commands (geometry_msgs/Twist '
        'or TwistStamped), or both; they are found by name, else by type.',
    )
    parser.add_argument('bag', type=Path, metavar='BAG', help='folder of the bag, or its one file')
    parser.add_argument('--output', type=Path, help='folder for the report (default: beside it)')
    parser.add_argument('--namespace', help='whose topics (default: those of most known topics)')
    parser.add_argument('--odom', default='', metavar='TOPIC', help='odometry')
    parser.add_argument('--cmd-vel', default='', metavar='TOPIC', help='commands')
    parser.add_argument(
        '--reference',
        default='',
        metavar='TOPIC',
        help='what the robot was to follow: odometry or a twist',
    )
    parser.add_argument(
        '--wheel-radius',
        type=float,
        metavar='M',
        help='radius of the wheels in m (default: as recorded), to show speeds of wheels',
    )
    parser.add_argument(
        '--track', type=float, metavar='M', help='distance between the wheels in m, likewise'
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Return 0 when the report was written; prints its main figures.

    Raises
    ------
    RecordError
        There is no bag, or it cannot be read.
    ReportError
        There is nothing in it to report, or a topic that was asked for cannot be used.
    OSError
        The output cannot be written.
    ValueError
        One length of the wheels without the other, or one that cannot be.
    """
    from t3mpc_ros.lab.report import Wanted, write_report

    if (options.wheel_radius is None) != (options.track is None):
        raise ValueError('--wheel-radius and --track must be given together')
    wanted = Wanted(
        namespace=options.namespace,
        odom=options.odom,
        cmd_vel=options.cmd_vel,
        reference=options.reference,
        wheel_radius=options.wheel_radius,
        track=options.track,
    )
    output = options.output or options.bag.resolve().parent
    print(write_report(options.bag, output, wanted).summary())
    return 0
