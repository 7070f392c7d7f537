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
"""HTML report of a recorded run."""

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
import math
from pathlib import Path

import numpy as np

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.bag.reader import BagReader, open_bag
from t3mpc_ros.bag.recording_metadata import LOSS_CAUSES, UNDISCOVERED, message_losses
from t3mpc_ros.evaluation.bag_report import incidents
from t3mpc_ros.evaluation.bag_report.diagnostic_history import COUNTED, LinkHistory
from t3mpc_ros.evaluation.bag_report.metrics import (
    LINK_NUMBERS,
    UNMEASURED,
    ReportMetrics,
    compute_metrics,
)
from t3mpc_ros.evaluation.bag_report.patrol_section import map_change_blocks, patrol_blocks
from t3mpc_ros.evaluation.bag_report.recorded_run import Run, load_run
from t3mpc_ros.evaluation.bag_report.report_charts import LABELS, SECTIONS, Section, undetermined
from t3mpc_ros.evaluation.bag_report.tracking_errors import errors_of
from t3mpc_ros.evaluation.bag_report.verdict import Verdict
from t3mpc_ros.evaluation.drive_response import ResponseFit
from t3mpc_ros.evaluation.html_page import (
    Block,
    Contents,
    Details,
    Group,
    Heading,
    Items,
    Paragraph,
    Tiles,
    Timeline,
    VerdictBox,
    html_page,
)
from t3mpc_ros.evaluation.result_output import EMPTY_CELL, Table, format_number
from t3mpc_ros.evaluation.run_record import ROBOT_WINDOW, START, counted_from, spans_of
from t3mpc_ros.evaluation.topic_roles import (
    COMMAND,
    ODOMETRY,
    REFERENCE,
    SCALARS,
    TRUTH,
    ReportOptions,
    bag_display_name,
)
from t3mpc_ros.geometry.types import NANOSECONDS

SPEEDS, FLOOR, FURTHER = SECTIONS[:2], SECTIONS[2:4], SECTIONS[4:]
"""Sections before the events and tables, that of what the robot follows first, and the others."""
MAX_EVENTS = 300
INVALID = 'not valid'
"""Mark of a topic of which nothing that is measured is valid."""


def response_table(run: Run, fits: Mapping[str, ResponseFit]) -> Table:
    """Return delay, lag and gain of each channel."""
    head = ['speed', 'dead time / ms', 'lag / ms', 'sum / ms', 'gain', 'explained / %']
    rows = []
    for each in run.channels:
        fit = fits.get(each.name)
        if fit is None:
            rows.append([each.title, *[EMPTY_CELL] * 5])
            continue
        times = fit.dead_time, fit.lag, fit.delay
        numbers = [f'{1e3 * value:.0f}' for value in times] if fit.clear else [EMPTY_CELL] * 3
        gain = format_number(fit.gain) if fit.clear else EMPTY_CELL
        rows.append([each.title, *numbers, gain, format_number(100.0 * max(fit.explained, 0.0))])
    return Table('', head, rows)


def link_table(links: Sequence[LinkHistory]) -> Table:
    """Return the metrics of each link, one column each."""
    rows = [
        [title, *(f'{format_number(value(each))} {unit}' for each in links)]
        for title, unit, value in LINK_NUMBERS
    ]
    for key, text in COUNTED.items():
        rows.append([text, *(_whole(each.grown(key)) for each in links)])
    return Table('', ['quantity', *(each.name for each in links)], rows if links else [])


def _whole(value: float) -> str:
    return f'{value:.0f}' if math.isfinite(value) else EMPTY_CELL


def write_report(
    folder: Path | str, output: Path | str | None = None, wanted: ReportOptions | None = None
) -> ReportMetrics:
    """Write ``report.html`` beside the bag or to ``output``; return the summary metrics."""
    folder = Path(folder)
    output = folder.parent if output is None else Path(output)
    with open_bag(folder) as recording:
        run = load_run(recording, wanted)
        figures = compute_metrics(run, output / 'report.html', recording.message_count)
        page = _page(recording, run, figures)
        write_atomically(figures.report, page)
    return figures


def _page(recording: BagReader, run: Run, figures: ReportMetrics) -> str:
    blocks: list[Block] = [
        Paragraph(_origin(recording, run), 'quiet'),
        verdict_box(figures.verdict),
    ]
    unusual, usual = _losses(recording, run)
    carried = [f'{each.text[0].upper()}{each.text[1:]}.' for each in figures.incidents.carried]
    if oddities := [*run.oddities, *carried, *unusual]:
        blocks.append(Items([[each] for each in oddities], title='Unusual in this bag'))
    blocks.append(Contents())
    first, soon = (FLOOR, SPEEDS) if run.follows_path else (SPEEDS, FLOOR)
    together = 'Path, and distance from it' if run.follows_path else ''
    blocks += _sections(run, figures, first, together)
    blocks.append(Tiles(figures.numbers()))
    if remarks := [*_remarks(run), *usual]:
        blocks.append(Items([[each] for each in remarks], 'side'))
    blocks += _sections(run, figures, soon)
    events = _events(run, figures)
    quiet = Paragraph('No switch, no stop, no warning.', 'quiet')
    blocks += [Heading('Events'), Timeline(events) if events else quiet]
    if (run.ours or run.measured) and not run.follows_path:
        blocks += [Heading('Tracking error'), *_errors(run)]
    blocks += _response(run, figures)
    blocks += _sections(run, figures, FURTHER)
    blocks += map_change_blocks(run.map_changes)
    blocks += patrol_blocks(run)
    blocks += [Heading('Timing by topic'), *_timing(run), *_complaints(run)]
    blocks += [Heading('Contents of the bag'), *_contents(recording)]
    return html_page(bag_display_name(recording.folder), blocks)


def verdict_box(verdict: Verdict, subject: str = '') -> VerdictBox:
    """Return the verdict as a page says it first."""
    return VerdictBox(verdict.sentence, verdict.reasons(), verdict.kind, subject)


def _origin(recording: BagReader, run: Run) -> str:
    words = []
    if recording.start_ns:
        when = datetime.fromtimestamp(recording.start_ns / NANOSECONDS, UTC)
        words.append(f'{when:%Y-%m-%d %H:%M:%S} UTC')
    source = recording.metadata_records.get('provenance', {})
    words += [f'{key} {source[key]}' for key in ('version', 'commit') if key in source]
    if run.namespaces[0]:
        words.append(f'namespace {run.namespaces[0]}')
    if run.geometry is not None:
        words.append(
            f'wheels of {run.geometry.wheel_radius:g} m radius, '
            f'{run.geometry.wheel_separation:g} m apart'
        )
    return ' · '.join(words)


def _losses(recording: BagReader, run: Run) -> tuple[list[str], list[str]]:
    """Return sentences on missing messages, by cause: unusual ones and others.

    A recorder discovers publishers after it has started. What it misses meanwhile is nothing
    unusual if it records every motion before the time that counts.
    """
    unusual, usual = [], []
    first, last = incidents.driving(run)
    counted = counted_from(first, last) if first < last else math.inf
    early = all(float(each.time[0]) <= counted for each in run.motions.values())
    for cause, topics in message_losses(recording.metadata_records).items():
        if topics:
            most = max(topics, key=lambda name: topics[name])
            also = (
                f', of {len(topics)} topics, most of {most}' if len(topics) > 1 else f' of {most}'
            )
            sentence = f'{sum(topics.values())} messages{also} are missing: {LOSS_CAUSES[cause]}'
            if cause == UNDISCOVERED and early:
                usual.append(f'{sentence}, before the time that counts.')
            else:
                unusual.append(f'{sentence}.')
    return unusual, usual


def _remarks(run: Run) -> list[str]:
    """Return sentences on where the data come from."""
    notes = list(run.remarks)
    if run.absent:
        scalars = [name for name in run.absent if name in SCALARS]
        names = [name for name in run.absent if name not in SCALARS or len(scalars) < len(SCALARS)]
        if len(names) < len(run.absent):
            names.append(f'controller/* ({len(scalars)} topics)')
        notes.append(f'Not in the bag, or without a message: {", ".join(names)}.')
    return notes


def _events(run: Run, figures: ReportMetrics) -> list[tuple[float, str, str]]:
    """Return switches, stops, gaps and changes of the state of nodes, in order."""
    found = [(time, 'switch', 'the reference switches') for time in run.switches.tolist()]
    found += figures.incidents.events()
    found += [
        (time, 'note', f'{node}: {text} ({level})')
        for time, level, node, text in run.changes
        if level != 'ok'
    ]
    return sorted(found)[:MAX_EVENTS]


def _errors(run: Run) -> list[Block]:
    rows = []
    for source in (TRUTH, ODOMETRY):
        if source not in run.motions or REFERENCE not in run.motions:
            continue
        lacking = INVALID if source in run.untrusted else UNMEASURED
        for channel, pair in zip(run.channels, errors_of(run, source).values(), strict=True):
            for extent, values in zip(('driven', 'driven, settled'), pair, strict=True):
                numbers = (values.rmse, values.mae, values.largest)
                cells = [format_number(number) if values.count else lacking for number in numbers]
                cells += [f'{values.seconds:.1f}', str(values.count)]
                rows.append([LABELS[source], channel.title, extent, *cells, channel.unit])
    if not rows:
        return [Paragraph('The bag lacks a reference, or odometry to compare with it.')]
    head = ['motion', 'speed', 'extent', 'RMSE', 'MAE', 'max', 'counted / s', 'samples', 'unit']
    return [Table('', head, rows, text=3), Paragraph(extents(run), 'quiet')]


def extents(run: Run) -> str:
    """Return the description of the time in which errors are counted."""
    first, last = incidents.driving(run)
    start = f'its first {START:g} s, of less than {2 * START:g} s the first half'
    if COMMAND not in run.motions:
        extent = (
            f'Driven: the whole reference without {start}; the bag holds no command that would '
            'show when the robot was driven.'
        )
    elif first > last:
        return 'Every command was zero: the robot was not driven, and no error is counted.'
    else:
        extent = (
            f'Driven: from the first command other than zero, at {first:.1f} s, to the last, at '
            f'{last:.1f} s, without {start}, and without each stop, from '
            f'{incidents.BRAKING:g} s before to {ROBOT_WINDOW.after:g} s after it.'
        )
    return (
        f'{extent} Settled: also without the {ROBOT_WINDOW.before:g} s before each switch, in '
        'which a controller may already leave the old reference because the new one is known in '
        f'advance, and without the {ROBOT_WINDOW.after:g} s after it. Errors at switches that the '
        'drive does not contain whole do not count.'
    )


def _response(run: Run, figures: ReportMetrics) -> Iterator[Block]:
    """Yield the tables of response, motion and radio link, with their titles."""
    tables = [
        ('Path and stops', Table('', ['quantity', 'value'], motion_rows(run))),
        ('Radio link', link_table(run.links)),
    ]
    if figures.responses:
        yield Heading('From command to motion')
        yield response_table(run, figures.responses)
        yield Paragraph(
            'Dead time, first-order lag and gain that explain most of the measured speed; their '
            'sum is better determined than either. A dash: no clear response to the command, or '
            'one that the data do not determine.',
            'quiet',
        )
        vague = [fit for fit in figures.responses.values() if fit.explains and not fit.determined]
        if vague:
            yield Paragraph(undetermined(max(vague, key=lambda each: each.longest)))
    for title, table in tables:
        if table.rows:
            yield Heading(title)
            yield table


def _sections(
    run: Run, figures: ReportMetrics, sections: Sequence[Section], title: str = ''
) -> Iterator[Block]:
    """Yield the charts of some sections, side by side below a common title if it is given."""
    for group in [sections] if title else [[each] for each in sections]:
        if charts := [chart for section in group for chart in section.draw(run, figures)]:
            yield Heading(title or group[0].title)
            yield Group(charts, 'div', 'charts')
            for section in group:
                of_path = section.path_caption if run.follows_path else ''
                yield Paragraph(of_path or section.caption, 'quiet')


def _timing(run: Run) -> list[Block]:
    head = ['topic', 'messages', 'rate / Hz', 'jitter / ms', 'missing / %']
    rows: dict[bool, list[list[str]]] = {True: [], False: []}
    for name, timing in run.timing.items():
        rate = format_number(1.0 / timing.period if timing.period > 0.0 else math.nan)
        jitter, missing = format_number(1e3 * timing.jitter), format_number(100.0 * timing.missing)
        topic = run.topics[name] + (f', {INVALID}' if name in run.untrusted else '')
        rows[name in run.motions].append([topic, str(timing.count), rate, jitter, missing])
    motions, scalars = (Table('', head, rows[kind], wrap=True) for kind in (True, False))
    blocks: list[Block] = [motions] if motions.rows else []
    if scalars.rows:
        blocks.append(Details(f'Scalar topics, {len(scalars.rows)} topics', [scalars]))
    if not blocks:
        return [Paragraph('No topic has enough messages.')]
    note = (
        'Rate: from the median time between receipts. Jitter: 99 % of these times are closer to '
        'the median than this. Missing: against that rate, by stamp where there is one.'
    )
    return [*blocks, Paragraph(note, 'quiet')]


def _complaints(run: Run) -> list[Block]:
    if not run.complaints:
        return []
    rows = [[level, who, what, format_number(when)] for when, level, who, what in run.complaints]
    head = ['level', 'node', 'message', 'first at / s']
    return [Heading('Warnings and errors of the nodes'), Table('', head, rows, text=3, wrap=True)]


def _contents(recording: BagReader) -> Iterator[Block]:
    rows = [[t.name, t.type_name, str(t.message_count)] for t in recording.topics.values()]
    table = Table('', ['topic', 'type', 'messages'], rows, text=2, wrap=True)
    yield Details(f'Topics, {len(rows)}', [table]) if rows else Paragraph('No topic.')
    for title, values in sorted(recording.metadata_records.items()):
        table = Table('', ['name', 'value'], list(values.items()), text=2, wrap=True)
        yield Details(f'{title}, {len(values)} values', [table])


def motion_rows(run: Run) -> list[list[str]]:
    """Return path length, turning, speeds and stops as rows; none when there are few samples."""
    motion, command = run.motion, run.motions.get(COMMAND)
    if motion is None:
        return []
    smoothed = incidents.smooth(motion, *incidents.STILL)
    time, linear, angular = smoothed.time, smoothed['linear'], smoothed['angular']
    known = np.isfinite(linear)
    if not known.any():
        return []
    step = float(time[1] - time[0]) if time.size > 1 else 0.0
    still = incidents.still_rows(smoothed)
    spans = [
        each for each in spans_of(still) if (each.stop - each.start) * step >= incidents.PAUSE
    ]
    stops = [(float(time[each][0]), float(time[each][-1])) for each in spans]
    lengths = [end - start for start, end in stops]
    distance = float(np.abs(linear[known]).sum() * step)
    moving = float(np.count_nonzero(known & ~still) * step)
    mean, fastest = distance / moving if moving > 0.0 else 0.0, np.abs(linear[known]).max()
    turned = float(np.abs(angular[known]).sum() * step)
    rows = [
        ['path length, forwards and backwards', f'{format_number(distance)} m'],
        ['turning, both ways', f'{format_number(turned)} rad'],
        ['speed while moving, mean and largest', f'{mean:.3f} and {fastest:.3f} m/s'],
        ['time moving', f'{moving:.1f} s'],
        [
            'standstills',
            f'{len(stops)}, {sum(lengths):.1f} s in all, the longest '
            f'{max(lengths, default=0.0):.1f} s',
        ],
    ]
    if stops:
        where = ', '.join(f'{start:.1f} to {end:.1f}' for start, end in stops[:5])
        more = f', and {len(stops) - 5} more' if len(stops) > 5 else ''
        rows.append(['standstill at', f'{where}{more} s'])
    if command is not None:
        commanded = incidents.asks_for_motion(command, time)
        disobeyed = step * sum(int(np.count_nonzero(commanded[each])) for each in spans)
        rows.append(['of that, motion was commanded', f'{disobeyed:.1f} s'])
    return rows
