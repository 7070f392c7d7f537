# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The main figures of a run as numbers, and as one line of text."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np

from t3mpc_ros.lab.report.measures import (
    ErrorStatistics,
    driven,
    foreseen,
    latencies,
    settled,
    statistics,
    tracking_error,
    variation,
)
from t3mpc_ros.lab.report.recorded import COMMAND, ODOMETRY, REFERENCE, WHEELS, Run

UNMEASURED = 'not measured'
"""Said where there is nothing to count, which a number would hide."""


@dataclass(frozen=True)
class WheelFigures:
    """How well one wheel followed; NaN where the bag does not tell."""

    overall: ErrorStatistics
    """While the robot was being driven, but for the second in which it caught up."""
    settled: ErrorStatistics
    """Also without the time about each switch."""
    chatter: float
    """Total variation of the commanded speed per second, rad/s²."""
    demand: float
    """The same of the reference: what following it exactly would take."""


@dataclass(frozen=True)
class ReportFigures:
    """The main figures of a run; NaN where the bag does not tell."""

    report: Path
    pictures: tuple[Path, ...]
    duration: float
    messages: int
    switches: int
    measured: str
    """Where errors are taken from: ``ground_truth/odom``, else ``odom``, else empty."""
    wheels: Mapping[str, WheelFigures]
    """Of ``right`` and ``left``."""
    latency: float
    """Median time (s) from the receipt of odometry to that of the command."""
    latency_99: float
    """Its 99th percentile (s)."""
    missing: Mapping[str, float]
    """Share of missing samples by relative topic name."""
    absent: tuple[str, ...]
    """Topics the report had to do without."""

    def summary(self) -> str:
        """Return the figures in one line."""
        right, left = (self.wheels[wheel] for wheel in WHEELS)
        overall, calm = (
            f'{in_words(one.rmse)}/{in_words(other.rmse)} rad/s in {one.seconds:.1f} s'
            if one.count
            else UNMEASURED
            for one, other in ((right.overall, left.overall), (right.settled, left.settled))
        )
        chatter = f'{in_words(right.chatter)}/{in_words(left.chatter)}'
        missing = in_words(100.0 * self.missing.get(ODOMETRY, math.nan))
        return (
            f'{self.duration:.1f} s, {self.switches} switches; RMSE right/left while driven '
            f'{overall}, settled {calm}; command varies by {chatter} rad/s²; '
            f'loop {in_words(1e3 * self.latency)} ms, 99 % below '
            f'{in_words(1e3 * self.latency_99)} ms; {missing} % of odom missing: {self.report}'
        )


def figures_of(run: Run, report: Path, pictures: tuple[Path, ...], messages: int) -> ReportFigures:
    """Return the main figures of ``run``."""
    errors = errors_of(run, run.measured)
    command, reference = run.motions.get(COMMAND), run.motions.get(REFERENCE)
    wheels = {
        wheel: WheelFigures(
            *errors[wheel],
            math.nan if command is None else variation(command, wheel),
            math.nan if reference is None else variation(reference, wheel),
        )
        for wheel in WHEELS
    }
    delay = latencies(run)
    delays = np.array([math.nan]) if delay is None else delay['value']
    return ReportFigures(
        report=report,
        pictures=pictures,
        duration=run.duration,
        messages=messages,
        switches=run.switches.size,
        measured=run.measured,
        wheels=wheels,
        latency=float(np.percentile(delays, 50.0)),
        latency_99=float(np.percentile(delays, 99.0)),
        missing={name: timing.missing for name, timing in run.timing.items()},
        absent=run.absent,
    )


def errors_of(run: Run, measured: str) -> dict[str, tuple[ErrorStatistics, ErrorStatistics]]:
    """Return the statistics while driven, and those where settled, by wheel."""
    error = tracking_error(run, measured)
    if error is None:
        nothing = statistics(np.empty(0))
        return dict.fromkeys(WHEELS, (nothing, nothing))
    moving = driven(error.time, run)
    calm = moving & settled(error.time, run.switches, foreseen(run))
    period = float(np.median(np.diff(error.time))) if len(error) > 1 else math.nan
    return {
        wheel: (
            statistics(error[wheel][moving], period),
            statistics(error[wheel][calm], period),
        )
        for wheel in WHEELS
    }


def in_words(value: float) -> str:
    """Return three significant digits, a dash for what is not known."""
    if not math.isfinite(value):
        return '–'
    return f'{value:.0f}' if abs(value) >= 99.95 else f'{value:#.3g}'
