# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The figures of the report in order, each with its words and what it needs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from t3mpc_ros.lab.report import figures
from t3mpc_ros.lab.report.link.figure import link
from t3mpc_ros.lab.report.measures import WINDOW
from t3mpc_ros.lab.report.recorded import Run
from t3mpc_ros.lab.report.response.figures import acceleration, response
from t3mpc_ros.lab.report.topics import COMMAND, ODOMETRY, REFERENCE, SIGNALS, TERMS, TRUTH, WHEELS

LINK = 'diagnostics of a radio link'


@dataclass(frozen=True)
class Drawing:
    """A figure with its words."""

    stem: str
    title: str
    caption: str
    draw: Callable[[Run], Any]
    needs: tuple[str, ...]
    """Relative names of the topics it is drawn from."""


DRAWINGS = (
    Drawing(
        'tracking',
        'Speeds and their references (Fig. 11)',
        'Wheel speeds are computed from the body twists by (1). Dashed lines are switches.',
        figures.tracking,
        (REFERENCE, ODOMETRY, TRUTH),
    ),
    Drawing(
        'error',
        'Tracking error over time',
        'Speed minus reference, at the stamps of the measurement: of the whole recording, though '
        'only the time the robot was being driven is counted.',
        figures.error,
        (REFERENCE, ODOMETRY, TRUTH),
    ),
    Drawing(
        'switching',
        'What drives each wheel, and when it switches (Fig. 10)',
        'As announced by the reference node, drawn at the time it applies.',
        figures.switching,
        ('reference/signals', *SIGNALS),
    ),
    Drawing(
        'control',
        'What the robot is told (Fig. 12)',
        'The command is published as a body twist; u is the acceleration that was left after '
        'all limits.',
        figures.control,
        (COMMAND, *(f'controller/terms/applied/{wheel}' for wheel in WHEELS)),
    ),
    Drawing(
        'response',
        'How the robot answers its commands',
        'The fit is the command, delayed, behind a first-order lag and scaled, chosen so that it '
        'explains most of the measured speed. Commands are placed by their receipt, odometry by '
        'its stamps, so the delay is what an observer beside the recorder sees.',
        response,
        (COMMAND, ODOMETRY),
    ),
    Drawing(
        'acceleration',
        'How hard the robot moves',
        'Derivatives of the measured speeds, of parabolas fitted to short windows.',
        acceleration,
        (ODOMETRY, TRUTH),
    ),
    Drawing(
        'terms',
        'What each term of the law adds (Fig. 12)',
        'The terms of (66)-(67) with E12, and the acceleration applied in the end.',
        figures.terms,
        tuple(f'controller/terms/{name}/{w}' for name in (*TERMS, 'applied') for w in WHEELS),
    ),
    Drawing(
        'estimates',
        'Estimates of the unknown dynamics and their targets (Fig. 13)',
        'The target is the measured acceleration of the wheel minus the applied one, both '
        f'smoothed over {WINDOW:g} s by a local straight line; it is left open at switches, where '
        'the applied one jumps between two of its samples.',
        figures.estimates,
        tuple(f'controller/estimate/{wheel}' for wheel in WHEELS),
    ),
    Drawing(
        'portrait',
        'Phase portrait, one speed against the other (Figs. 9 and 14)',
        'Both panels have the same axes.',
        figures.portrait,
        (REFERENCE, ODOMETRY, TRUTH),
    ),
    Drawing(
        'path',
        'Path in the plane',
        'The reference is integrated from where the robot was when it began. Where speeds are '
        'tracked, not places, the paths part.',
        figures.path,
        (ODOMETRY, TRUTH),
    ),
    Drawing(
        'certificate',
        'Run-time certificate and skill of the predictor',
        'The margin is how fast V may change by E14, minus how fast it does: a negative one says '
        'that the disturbance was larger than assumed, or that the reference has just jumped. '
        'Skill is 1 for perfect prediction and 0 for no better than persistence.',
        figures.certificate,
        (
            'controller/lyapunov/value',
            'controller/lyapunov/margin',
            *(f'controller/skill/{wheel}' for wheel in WHEELS),
        ),
    ),
    Drawing(
        'link',
        'The radio link',
        'From the diagnostics of the bridge. A cycle is a command with its question for '
        'telemetry; it is answered when a measurement comes back. Round trips are over the last '
        '500 cycles.',
        link,
        (LINK,),
    ),
    Drawing(
        'timing',
        'Punctuality of the loop',
        'By the times at which the recorder received the messages.',
        figures.timing,
        (ODOMETRY, COMMAND),
    ),
)
"""In the order of the report."""
OWN = ('tracking', 'error', 'switching', 'terms', 'estimates', 'portrait', 'certificate')
"""Stems of those that nobody expects of a robot without this package's nodes."""
