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
"""HTML page that compares recorded runs: which has the smaller error, charts overlaid, tables."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path

import numpy as np

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recording_metadata import is_loss_record
from t3mpc_ros.evaluation.bag_report import report_charts
from t3mpc_ros.evaluation.bag_report.incidents import driving
from t3mpc_ros.evaluation.bag_report.metrics import (
    CHANNEL_NUMBERS,
    PATH_NUMBERS,
    RUN_NUMBERS,
    SPEED_ERRORS,
    ReportMetrics,
    compute_metrics,
)
from t3mpc_ros.evaluation.bag_report.recorded_run import Channel, Run, Series, load_run
from t3mpc_ros.evaluation.bag_report.report_page import verdict_box
from t3mpc_ros.evaluation.bag_report.tracking_errors import (
    counted,
    path_distance,
    tracking_error,
)
from t3mpc_ros.evaluation.confidence_intervals import Difference, interval, rms
from t3mpc_ros.evaluation.html_page import (
    Block,
    Chart,
    Contents,
    Curve,
    Group,
    Heading,
    Items,
    Paragraph,
    Plane,
    VerdictBox,
    html_page,
)
from t3mpc_ros.evaluation.result_output import EMPTY_CELL, Table, format_number
from t3mpc_ros.evaluation.topic_roles import (
    COMMAND,
    REFERENCE,
    ReportError,
    ReportOptions,
    bag_display_name,
)

PAGE = 'comparison.html'
BLOCK = 5.0
"""Time over which errors are averaged to one value of the confidence interval, s: far longer than
the error is correlated."""
SAME_REFERENCE = 0.05
"""Largest difference of two equal references, as a share of their root mean square."""
MIN_SHIFT, MAX_SHIFT = 0.01, 2.0
"""Resolution, and largest difference, of the places of the first commands in one reference, s."""
MAX_SAMPLES = 2000
"""Samples of a reference that are compared."""
GROUP = 3
"""Blocks of a group of charts: heading, charts, and what their time is."""
MAX_RUNS = len(report_charts.TERM_COLOURS)
DISTANCE = Channel('distance', 'distance from the path', 'distance', 'm')
"""What is compared of two robots that follow poses."""
VERDICTS = {-1: 'smaller error', 0: 'inconclusive', 1: 'larger error'}
"""By the sign of a difference."""


@dataclass(frozen=True)
class ComparedRun:
    """A run of a comparison, with its metrics."""

    label: str
    run: Run
    metrics: ReportMetrics
    start: float
    """Time that the charts count from, s: that of its first command to move, or the place of the
    first run's in a reference that both have."""
    parameters: Mapping[str, str]


def block_errors(run: Run, name: str) -> list[float]:
    """Return the mean squared settled error of each :data:`BLOCK` seconds of one channel."""
    if name == DISTANCE.name:
        away = path_distance(run)
        error = None if away is None else Series(away.time, {name: away['value']})
    else:
        error = tracking_error(run, run.measured)
    if error is None or len(error) < 2:
        return []
    known = np.isfinite(error[name])
    if name != DISTANCE.name:
        known &= counted(error.time, run)[1]
    squares = error[name][known] ** 2
    size = max(1, round(BLOCK / float(np.median(np.diff(error.time)))))
    count = squares.size // size
    means: list[float] = squares[: count * size].reshape(count, size).mean(axis=1).tolist()
    return means


def error_differences(first: Run, other: Run) -> dict[Channel, Difference]:
    """Return how the mean squared settled error, or path error, of ``other`` differs, by channel.

    An interval is infinite for less than two blocks of :data:`BLOCK`.
    """
    found = {}
    for channel in (DISTANCE,) if first.follows_path else other.channels:
        a, b = block_errors(first, channel.name), block_errors(other, channel.name)
        # Independent intervals, with the fewer degrees of freedom in each.
        half = math.hypot(interval(a), interval(b))
        difference = float(np.mean(b) - np.mean(a)) if a and b else math.nan
        found[channel] = Difference(difference, half)
    return found


def aligned(first: ComparedRun, other: ComparedRun) -> ComparedRun:
    """Return ``other`` counted from where ``first`` starts in the reference that both follow.

    Nodes discover each other sooner or later: the first command of two runs with one seed comes at
    different places of the reference. A run with another reference is unchanged.
    """
    one, two = (each.run.motions.get(REFERENCE) for each in (first, other))
    same_channels = first.run.channels == other.run.channels
    if one is None or two is None or not same_channels or len(one) < 2:
        return other
    period = max(float(np.median(np.diff(one.time))), MIN_SHIFT)
    # If nothing was lost, both recordings begin at the same place of the reference.
    base = first.start + two.time[0] - one.time[0]
    nearest = base + period * round((other.start - base) / period)
    shifts = period * np.arange(round(MAX_SHIFT / period) + 1)
    starts = nearest + np.column_stack([shifts, -shifts]).ravel()
    moved = [replace(other, start=float(start)) for start in starts]
    apart = [round(reference_difference(first, each)[0], 6) for each in moved]
    best = int(np.argmin(apart))  # among equal ones the nearest
    return moved[best] if apart[best] <= SAME_REFERENCE else other


def reference_difference(first: ComparedRun, other: ComparedRun) -> tuple[float, str]:
    """Return the largest RMS difference of two references of the same channels, and as text.

    The number is a share of the RMS of the first reference; infinite if they do not overlap.
    """
    one, two = (each.run.motions[REFERENCE] for each in (first, other))
    few = slice(None, None, max(1, len(one) // MAX_SAMPLES))
    time = one.time[few] - first.start + other.start
    common = time >= max(1.0 + other.start, two.time[0])
    common &= time <= two.time[-1]
    found = (0.0, '') if common.any() else (math.inf, 'they do not overlap')
    for name, title, _, unit in first.run.channels if common.any() else ():
        wanted = one[name][few][common]
        apart, size = rms(wanted - np.interp(time[common], two.time, two[name])), rms(wanted)
        share = apart / size if size > 0.0 else math.inf if apart > 0.0 else 0.0
        found = max(found, (share, f'{title}: by {format_number(apart)} {unit} RMS'))
    return found


def why_not_comparable(first: ComparedRun, other: ComparedRun) -> str:
    """Return why two errors cannot be compared; empty if they can."""
    for each in (first, other):
        if not each.metrics.verdict.sound:
            return f'{each.label}: {each.metrics.verdict.label}'
    if first.run.channels != other.run.channels:
        return 'the wheels of one robot are unknown'
    if first.run.follows_path != other.run.follows_path:
        return 'the one follows a path, the other one speeds'
    if first.run.measured != other.run.measured:
        return (
            f'the errors of {first.label} are measured by {first.run.measured}, those of '
            f'{other.label} by {other.run.measured}'
        )
    share, text = reference_difference(first, other)
    if share > SAME_REFERENCE:
        return f'the references differ, so the runs had different tasks ({text})'
    return ''


def write_comparison(
    folders: Sequence[Path], output: Path, wanted: ReportOptions | None = None
) -> tuple[Path, str, dict[str, object]]:
    """Compare each bag with the first in ``comparison.html``; return its path and what it says.

    As text the verdicts on the runs, and of each against the first, a line each; as plain data the
    same with the main numbers.
    """
    if not 2 <= len(folders) <= MAX_RUNS:
        raise ReportError(f'a comparison must have 2 to {MAX_RUNS} bags: got {len(folders)}')
    path = output / PAGE
    first, *others = (_load(i, folder, path, wanted) for i, folder in enumerate(folders))
    runs = [first, *(aligned(first, each) for each in others)]
    verdicts = [_verdict(runs[0], each) for each in runs[1:]]
    blocks: list[Block] = [*verdicts]
    for each in runs:
        blocks.append(verdict_box(each.metrics.verdict, each.label))
        if each.run.oddities:
            title = f'Unusual in {each.label}'
            blocks.append(Items([[text] for text in each.run.oddities], title=title))
    charts = list(_charts(runs))
    blocks += [Contents(), *charts[:GROUP], Heading('Numbers'), _metrics_table(runs)]
    blocks += [*charts[GROUP:], *_parameters(runs)]
    title = f'Comparison of {len(runs)} runs'
    write_atomically(path, html_page(title, blocks))
    lines = [f'{each.label}: {each.metrics.verdict.text()}' for each in runs]
    lines += [f'{each.subject}: {each.headline}: {"; ".join(each.reasons)}' for each in verdicts]
    record: dict[str, object] = {
        'report': str(path),
        'runs': {each.label: each.metrics.to_dict() for each in runs},
        'verdicts': [
            {'runs': each.subject, 'verdict': each.headline, 'reasons': list(each.reasons)}
            for each in verdicts
        ],
    }
    return path, '\n'.join(lines), record


def _load(number: int, folder: Path, path: Path, wanted: ReportOptions | None) -> ComparedRun:
    with open_bag(folder) as recording:
        run = load_run(recording, wanted)
        metrics = compute_metrics(run, path, recording.message_count)
        records = recording.metadata_records
    start = driving(run)[0]
    if not math.isfinite(start):
        start = min(float(each.time[0]) for each in run.motions.values())
    parameters = {
        f'{node} {name}': value
        for node, table in records.items()
        if not is_loss_record(node) and node != 'provenance'
        for name, value in table.items()
    }
    label = f'{chr(ord("A") + number)}, {bag_display_name(folder)}'
    return ComparedRun(label, run, metrics, start, parameters)


def _verdict(first: ComparedRun, other: ComparedRun) -> VerdictBox:
    """Return which of two runs has the smaller settled error."""
    subject = f'{other.label} against {first.label}'
    if why := why_not_comparable(first, other):
        return VerdictBox('Not comparable', [f'{why[0].upper()}{why[1:]}.'], 'apart', subject)
    found = error_differences(first.run, other.run)
    signs = {each.sign for each in found.values()} - {0}
    headline, kind = 'Inconclusive', 'apart'
    error = 'path error' if first.run.follows_path else 'settled error'
    if signs == {-1}:
        headline, kind = f'Smaller {error}', 'good'
    elif signs == {1}:
        headline, kind = f'Larger {error}', 'bad'
    return VerdictBox(headline, [_sentence(*each) for each in found.items()], kind, subject)


def _sentence(channel: Channel, difference: Difference) -> str:
    half = format_number(difference.half) if math.isfinite(difference.half) else 'unknown'
    size = f'{difference.mean:+.3g}' if math.isfinite(difference.mean) else 'unknown'
    return (
        f'{channel.title}: mean squared error {size} ± {half} ({channel.unit})², '
        f'{VERDICTS[difference.sign]}.'
    )


def _metrics_table(runs: Sequence[ComparedRun]) -> Table:
    """Return the main numbers of all runs side by side."""
    cells = []
    follow = [each.run.follows_path for each in runs]
    for title, unit, number in (*(PATH_NUMBERS if any(follow) else ()), *RUN_NUMBERS):
        heading = f'{title} / {unit}' if unit else title
        cells.append([heading, *(format_number(number(each.metrics)) for each in runs)])
    for channel in runs[0].run.channels:
        for title, unit, value in CHANNEL_NUMBERS[len(SPEED_ERRORS) if all(follow) else 0 :]:
            numbers = [
                format_number(value(each.metrics, channel.name))
                if channel.name in each.metrics.wheels
                else EMPTY_CELL
                for each in runs
            ]
            heading = f'{title}, {channel.title} / {unit.format(channel.unit)}'
            cells.append([heading, *numbers])
    return Table('', ['quantity', *(each.label for each in runs)], cells, wrap=True)


def _shifted(each: ComparedRun, series: Series) -> Series:
    return Series(series.time - each.start, series.values)


OVERLAID: tuple[tuple[str, str, Callable[[Run], Series | None]], ...] = (
    (
        'Tracking errors',
        'Error',
        lambda run: None if run.follows_path else tracking_error(run, run.measured),
    ),
    ('Speeds', 'Speeds', lambda run: run.motions.get(run.measured)),
    ('Commands', 'Commands', lambda run: run.motions.get(COMMAND)),
)
"""Heading, title of each chart, and what it shows of each run."""


def _charts(runs: Sequence[ComparedRun]) -> Iterator[Block]:
    """Yield the overlaid charts, with the time since the first command to move."""
    first = runs[0]
    channels = [c for c in first.run.channels if all(c in each.run.channels for each in runs)]
    looks = list(zip(runs, report_charts.TERM_COLOURS, report_charts.TERM_DASHES, strict=False))
    reference = first.run.motions.get(REFERENCE)
    for heading, title, pick in OVERLAID:
        found = [
            (each.label, colour, _shifted(each, series), dash)
            for each, colour, dash in looks
            if report_charts.is_long(series := pick(each.run))
        ]
        charts = []
        for channel in channels:
            lines = [
                report_charts.line(label, colour, series, channel.name, dash=dash)
                for label, colour, series, dash in found
            ]
            seen = f'{channel.title.capitalize()} of {len(runs)} runs over each other.'
            if title == 'Error':
                sizes = (each.metrics.wheels[channel.name].settled.rmse for each in runs)
                named = zip(runs, map(format_number, sizes), strict=True)
                text = ', '.join(f'{each.label} {size}' for each, size in named)
                seen = f'Settled RMSE: {text} {channel.unit}.'
            elif report_charts.is_long(reference):
                label, shown = f'reference of {first.label}', _shifted(first, reference)
                lines.append(
                    report_charts.line(label, 'reference', shown, channel.name, dash=(6, 4))
                )
            extent = _settled_extent(runs, channel.name) if title == 'Error' else None
            if lines:
                name = f'{title}, {channel.title}'
                charts.append(Chart(name, channel.unit, lines, seen, extent))
        if charts:
            yield from (Heading(heading), Group(charts, 'div', 'charts'), _TIME)
    curves = [
        Curve(each.label, colour, motion.time - each.start, motion['x'], motion['y'], dash)
        for each, colour, dash in looks
        if report_charts.is_long(motion := each.run.motions.get(each.run.measured))
    ]
    if curves:
        ends = ', '.join(f'{c.label} at {c.x[-1]:.2f}, {c.y[-1]:.2f} m' for c in curves)
        yield from (Heading('Paths'), Plane('Floor', 'm', curves, f'Ends: {ends}.'))


def _settled_extent(runs: Sequence[ComparedRun], name: str) -> tuple[float, float] | None:
    """Return the least and the largest settled error of all runs; None without one."""
    found = []
    for each in runs:
        error = tracking_error(each.run, each.run.measured)
        if error is not None:
            rows = counted(error.time, each.run)[1]
            found.append(report_charts.extent_of(error, rows, [name]))
    known = [each for each in found if each is not None]
    return (min(low for low, _ in known), max(high for _, high in known)) if known else None


_TIME = Paragraph(
    'Time since the first command to move; runs with the reference of the first one are shown at '
    'the same place of it.',
    'quiet',
)


def _parameters(runs: Sequence[ComparedRun]) -> Iterator[Block]:
    """Yield the recorded parameters in which the runs differ."""
    names = sorted({name for each in runs for name in each.parameters})
    rows = []
    for name in names:
        values = [each.parameters.get(name, EMPTY_CELL) for each in runs]
        if len(set(values)) > 1:
            rows.append([name, *values])
    yield Heading('Parameters that differ')
    if rows:
        head = ['parameter', *(each.label for each in runs)]
        yield Table('', head, rows, text=len(head), wrap=True)
    else:
        yield Paragraph('No recorded parameter differs.', 'quiet')
