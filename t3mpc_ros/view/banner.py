# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The banner of the live page: in words, what the robot does and why."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

Condition = Literal['normal', 'warning', 'stopped']

LOST = 1.5
"""Time without odometry after which the connection counts as lost, s."""
ESTOP = 'emergency stop'
"""Begin of the reason of a robot whose e-stop is latched."""


class NodeReport(NamedTuple):
    """Newest report of a node about itself, from its log or its diagnostics."""

    text: str
    condition: Condition = 'normal'


PAUSED = NodeReport('paused')
"""Report of a reference generator that was paused."""


class Banner(NamedTuple):
    """One line in large letters, and the reason for it."""

    kind: Literal['good', 'warning', 'stopped', 'lost']
    headline: str
    detail: str


def banner(reports: Mapping[str, NodeReport], odometry_age: float | None) -> Banner:
    """Return what a person has to know first.

    Parameters
    ----------
    reports
        Newest report of each node of the loop.
    odometry_age
        Time since the last odometry, s; None before the first one.
    """
    worse = {name: each for name, each in reports.items() if each.condition != 'normal'}
    stops = {name: each for name, each in worse.items() if each.condition == 'stopped'}
    detail = '; '.join(f'{name}: {each.text}' for name, each in (stops or worse).items())
    if odometry_age is None:
        return Banner('lost', 'Waiting for a robot', detail or 'no odometry on the graph yet')
    if odometry_age > LOST:
        return Banner('lost', 'Connection lost', f'no odometry for {odometry_age:.0f} s')
    if any(each.text.startswith(ESTOP) for each in stops.values()):
        return Banner('stopped', 'E-STOP', detail)
    if reports.get('reference_generator') == PAUSED:
        return Banner('warning', 'Reference paused', detail)
    if stops:
        return Banner('stopped', 'Stopped', detail)
    if worse:
        return Banner('warning', 'Driving, with a warning', detail)
    if 'controller' in reports:
        return Banner('good', 'Tracking the reference', '')
    return Banner('good', 'Following commands' if reports else 'Receiving odometry', '')
