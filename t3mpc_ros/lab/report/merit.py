# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The main figures of a run as numbers, and as one line of text."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np

from t3mpc_ros.lab.report.link.history import LinkFigures, link_figures
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
from t3mpc_ros.lab.report.recorded import Channel, Run
from t3mpc_ros.lab.report.response.measures import Fit, responses
from t3mpc_ros.lab.report.topics import COMMAND, ODOMETRY, REFERENCE

UNMEASURED = 'not measured'
"""Said where there is nothing to count, which a number would hide."""


@dataclass(frozen=True)
class WheelFigures:
    """How well one channel followed; NaN where the bag does not tell."""

    overall: ErrorStatistics
    """While the robot was being driven, but for the second in which it caught up."""
    settled: ErrorStatistics
    """Also without the time about each switch."""
    chatter: float
    """Total variation of the commanded speed per second."""
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
    """Of ``right`` and ``left``, or of ``linear`` and ``angular`` where wheels are not known."""
    channels: tuple[Channel, Channel]
    """Names and units of these."""
    responses: Mapping[str, Fit]
    """How the robot answers its commands, by channel, where that can be told."""
    links: Mapping[str, LinkFigures]
    """How well the radio worked, by the name of what told."""
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
        right, left = (self.wheels[each.name] for each in self.channels)
        overall, calm = (
            f'{both(one.rmse, other.rmse, self.channels)} in {one.seconds:.1f} s'
            if one.count
            else UNMEASURED
            for one, other in ((right.overall, left.overall), (right.settled, left.settled))
        )
        chatter = both(right.chatter, left.chatter, self.channels, '²')
        titles = '/'.join(each.short for each in self.channels)
        answers = [
            f'{each.short} {1e3 * (fit.dead_time + fit.lag):.0f} ms'
            for each in self.channels
            if (fit := self.responses.get(each.name)) and fit.clear
        ]
        answer = f'answers after {", ".join(answers)}; ' if answers else ''
        for name, link in self.links.items():
            answer += f'{name}: {in_words(100.0 * link.answered)} % of cycles answered; '
        missing = in_words(100.0 * self.missing.get(ODOMETRY, math.nan))
        return (
            f'{self.duration:.1f} s, {self.switches} switches; RMSE {titles} while driven '
            f'{overall}, settled {calm}; command varies by {chatter}; {answer}'
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
        for wheel, *_ in run.channels
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
        channels=run.channels,
        responses=responses(run),
        links={link.name: link_figures(link) for link in run.links},
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
        return dict.fromkeys((each.name for each in run.channels), (nothing, nothing))
    moving = driven(error.time, run)
    calm = moving & settled(error.time, run.switches, foreseen(run))
    period = float(np.median(np.diff(error.time))) if len(error) > 1 else math.nan
    return {
        wheel: (
            statistics(error[wheel][moving], period),
            statistics(error[wheel][calm], period),
        )
        for wheel, *_ in run.channels
    }


def both(one: float, other: float, channels: tuple[Channel, Channel], power: str = '') -> str:
    """Return numbers of both channels with their units, which may differ."""
    units = [each.unit + power for each in channels]
    if units[0] == units[1]:
        return f'{in_words(one)}/{in_words(other)} {units[0]}'
    return f'{in_words(one)} {units[0]}/{in_words(other)} {units[1]}'


def in_words(value: float) -> str:
    """Return three significant digits, a dash for what is not known."""
    if not math.isfinite(value):
        return '–'
    return f'{value:.0f}' if abs(value) >= 99.95 else f'{value:#.3g}'
