# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The main figures of a run as numbers, and as one line of text."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np

from t3mpc_ros.lab.report.measures import (
    SETTLING,
    ErrorStatistics,
    latencies,
    settled,
    statistics,
    tracking_error,
    variation,
)
from t3mpc_ros.lab.report.recorded import COMMAND, ODOMETRY, REFERENCE, WHEELS, Run


@dataclass(frozen=True)
class WheelFigures:
    """How well one wheel followed; NaN where the bag does not tell."""

    overall: ErrorStatistics
    settled: ErrorStatistics
    """Without the second after the start and each switch."""
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
        overall = f'{in_words(right.overall.rmse)}/{in_words(left.overall.rmse)}'
        calm = f'{in_words(right.settled.rmse)}/{in_words(left.settled.rmse)}'
        chatter = f'{in_words(right.chatter)}/{in_words(left.chatter)}'
        missing = in_words(100.0 * self.missing.get(ODOMETRY, math.nan))
        return (
            f'{self.duration:.1f} s, {self.switches} switches; RMSE right/left {overall} rad/s, '
            f'beyond {SETTLING:g} s after a switch {calm} rad/s; command varies by {chatter} '
            f'rad/s²; loop {in_words(1e3 * self.latency)} ms, 99 % below '
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
    """Return overall and settled statistics by wheel."""
    error = tracking_error(run, measured)
    if error is None:
        nothing = statistics(np.empty(0))
        return dict.fromkeys(WHEELS, (nothing, nothing))
    calm = settled(error.time, run.switches)
    return {wheel: (statistics(error[wheel]), statistics(error[wheel][calm])) for wheel in WHEELS}


def in_words(value: float) -> str:
    """Return three significant digits, a dash for what is not known."""
    if not math.isfinite(value):
        return '–'
    return f'{value:.0f}' if abs(value) >= 99.95 else f'{value:#.3g}'
