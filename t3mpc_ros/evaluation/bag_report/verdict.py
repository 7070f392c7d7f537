# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Verdict on a recorded run: whether its numbers measure the controller."""

from dataclasses import dataclass

import numpy as np

from t3mpc_ros.evaluation.bag_report.run_data import Run, Series
from t3mpc_ros.evaluation.bag_report.topic_roles import COMMAND, ODOMETRY, REFERENCE
from t3mpc_ros.evaluation.confidence_intervals import rms

MAX_STOPPED = 0.01
"""Largest share of the drive without a command to move."""
MAX_MISSING = 0.02
"""Largest share of missing odometry."""
MAX_ERROR = 0.25
"""Largest RMSE, settled, as a share of the root mean square of the reference."""
MIN_COUNTED = 0.5
"""Least share of the drive in which errors count."""
MAX_LATENCY = 0.02
"""99th percentile of the time from odometry to command that shows a slow machine, s."""
COMMAND_TIMEOUT = 0.5
"""Time without a command after which the robot stands, s."""
OVERLOAD = ('processor overloaded', 'real-time factor')
"""Texts of diagnostics that say that the machine is too slow."""


@dataclass(frozen=True)
class Verdict:
    """Whether the numbers of a run measure the controller, and why not."""

    problems: tuple[str, ...]
    """Empty for a sound run."""
    stopped: float
    """Time in which the robot was commanded to stand during the drive, s."""

    @property
    def sound(self) -> bool:
        """Whether nothing speaks against the numbers."""
        return not self.problems

    def text(self) -> str:
        """Return the verdict in one sentence."""
        if self.sound:
            return f'sound run: the robot followed the reference, stopped for {self.stopped:.1f} s'
        return f'NO VALID MEASUREMENT: {"; ".join(self.problems)}'


def judge(
    run: Run,
    drive: tuple[float, float],
    rmse: float,
    counted: float,
    missing: float,
    latency_99: float,
) -> Verdict | None:
    """Return the verdict on a run; None without a reference, odometry or commands.

    Parameters
    ----------
    run
        The run.
    drive
        First and last command other than zero, s.
    rmse
        Largest settled RMSE of the wheels, in the unit of the reference; NaN if not measured.
    counted
        Time in which errors count, s.
    missing
        Share of missing odometry; NaN if unknown.
    latency_99
        99th percentile of the time from odometry to command, s; NaN if unknown.
    """
    command, reference = run.motions.get(COMMAND), run.motions.get(REFERENCE)
    if not run.ours or command is None or reference is None or not run.measured:
        return None
    if not drive[0] < drive[1]:
        return Verdict(('the robot was never driven',), 0.0)
    stopped, length = stopped_time(command, *drive), drive[1] - drive[0]
    problems = []
    if stopped > MAX_STOPPED * length:
        problems.append(f'the robot was stopped for {stopped:.1f} of {length:.1f} s')
    if missing > MAX_MISSING:
        problems.append(f'{100.0 * missing:.1f} % of {ODOMETRY} is missing')
    if counted < MIN_COUNTED * length:
        problems.append(f'only {counted:.1f} of {length:.1f} s count')
    size = max(rms(reference[each.name]) for each in run.channels)
    if not np.isfinite(rmse):
        problems.append('no settled motion was measured')
    elif rmse > MAX_ERROR * size:
        unit = run.channels[0].unit
        problems.append(f'settled RMSE {rmse:.2g} {unit} on a reference of {size:.2g} {unit}')
    overloaded = any(text in what for *_, what in run.complaints for text in OVERLOAD)
    if problems and (overloaded or latency_99 > MAX_LATENCY):
        # By itself it does not spoil the numbers.
        problems.insert(0, 'the machine was too slow')
    return Verdict(tuple(problems), stopped)


def stopped_time(command: Series, first: float, last: float) -> float:
    """Return the time from ``first`` to ``last`` in which the command was zero or timed out, s."""
    inside = (command.time >= first) & (command.time <= last)
    time = command.time[inside]
    moving = (command['linear'][inside] != 0.0) | (command['angular'][inside] != 0.0)
    steps = np.diff(time)
    late = np.maximum(steps - COMMAND_TIMEOUT, 0.0)
    return float(np.where(moving[:-1], late, steps).sum())
