# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""HTML report of a recorded run."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
import math
from pathlib import Path

from t3mpc_ros.bag.reader import BagReader, open_bag
from t3mpc_ros.bag.recording.split_writer import message_loss_notes
from t3mpc_ros.evaluation.bag_report.link_history import LinkMetrics
from t3mpc_ros.evaluation.bag_report.metrics import (
    SETTLING,
    UNMEASURED,
    ErrorStatistics,
    ReportMetrics,
    compute_metrics,
    driving,
    errors_of,
    format_channels,
    format_number,
    preview_before_switch,
)
from t3mpc_ros.evaluation.bag_report.report_figures import PACKAGE_FIGURES, REPORT_FIGURES
from t3mpc_ros.evaluation.bag_report.response import ResponseFit, motion_summary, roughness
from t3mpc_ros.evaluation.bag_report.run_data import Channel, Run, load_run
from t3mpc_ros.evaluation.bag_report.topic_roles import (
    COMMAND,
    ODOMETRY,
    REFERENCE,
    TRUTH,
    ReportOptions,
    bag_display_name,
)
from t3mpc_ros.evaluation.plotting import LABELS, png_of
from t3mpc_ros.geometry.types import NANOSECONDS

TableRows = tuple[list[str], list[list[str]]]
"""Header cells and rows."""


def response_table(run: Run, fits: Mapping[str, ResponseFit]) -> TableRows:
    """Return delay, lag and gain of each channel."""
    head = ['speed', 'dead time / ms', 'lag / ms', 'sum / ms', 'gain', 'explained / %']
    rows = []
    for each in run.channels:
        fit = fits.get(each.name)
        if fit is None:
            rows.append([each.title, *['–'] * 5])
            continue
        times = fit.dead_time, fit.lag, fit.dead_time + fit.lag
        numbers = [f'{1e3 * value:.0f}' for value in times] if fit.clear else ['–'] * 3
        gain = format_number(fit.gain) if fit.clear else '–'
        rows.append([each.title, *numbers, gain, format_number(100.0 * max(fit.explained, 0.0))])
    return head, rows


def roughness_table(run: Run) -> TableRows:
    """Return acceleration and jerk of command and motion."""
    head = ['of', 'speed', 'acceleration RMS', '99 % below', 'jerk RMS', '99 % below', 'unit']
    rows = []
    for words, name in (('command', COMMAND), ('robot', run.measured)):
        series = run.motions.get(name)
        if series is None:
            continue
        for each in run.channels:
            found = roughness(series, each.name, held=name == COMMAND)
            numbers = found.acceleration, found.acceleration_99, found.jerk, found.jerk_99
            unit = f'{each.unit}², {each.unit}³'
            rows.append([words, each.title, *map(format_number, numbers), unit])
    return head, rows


def motion_table(run: Run) -> TableRows:
    """Return path length, turning, stops and speeds; no row when they are unknown."""
    found = motion_summary(run)
    if found is None:
        return ['quantity', 'value'], []
    longest = max((end - start for start, end in found.stops), default=0.0)
    stood = sum(end - start for start, end in found.stops)
    where = ', '.join(f'{start:.1f} to {end:.1f}' for start, end in found.stops[:5])
    more = f', and {len(found.stops) - 5} more' if len(found.stops) > 5 else ''
    mean = found.distance / found.moving if found.moving > 0.0 else 0.0
    rows = [
        ['path length, forwards and backwards', f'{format_number(found.distance)} m'],
        ['turning, both ways', f'{format_number(found.turned)} rad'],
        ['speed while moving, mean and largest', f'{mean:.3f} and {found.fastest:.3f} m/s'],
        ['time moving', f'{found.moving:.1f} s'],
        ['stops', f'{len(found.stops)}, {stood:.1f} s in all, the longest {longest:.1f} s'],
    ]
    if found.stops:
        rows.append(['standstill at', f'{where}{more} s'])
    if COMMAND in run.motions:
        rows.append(['of that, motion was commanded', f'{found.disobeyed:.1f} s'])
    return ['quantity', 'value'], rows


def link_table(links: Mapping[str, LinkMetrics]) -> TableRows:
    """Return the metrics of each link, one column each."""
    each = list(links.values())
    rows = [
        ['cycles', *(_whole(one.cycles) for one in each)],
        ['lost', *(_whole(one.lost) for one in each)],
        ['answered', *(f'{format_number(100.0 * one.answered)} %' for one in each)],
        ['round trip, median', *(f'{format_number(1e3 * one.round_trip)} ms' for one in each)],
        [
            'round trip, worst 99 %',
            *(f'{format_number(1e3 * one.round_trip_99)} ms' for one in each),
        ],
        ['oldest measurement', *(f'{format_number(one.oldest)} s' for one in each)],
        ["resets of the robot's board", *(_whole(one.resets) for one in each)],
        ['resets of the dongle', *(_whole(one.dongle_resets) for one in each)],
        ['failures of the port', *(_whole(one.port_failures) for one in each)],
        ['sessions begun after the first report', *(_whole(one.sessions) for one in each)],
        ['frames damaged between dongle and host', *(_whole(one.damaged) for one in each)],
    ]
    return ['quantity', *links], rows if each else []


def _whole(value: float) -> str:
    return f'{value:.0f}' if math.isfinite(value) else '–'


def write_report(
    folder: Path | str, output: Path | str | None = None, wanted: ReportOptions | None = None
) -> ReportMetrics:
    """Write ``report.html`` and its pictures, and return the summary metrics of a bag.

    Parameters
    ----------
    folder
        The bag.
    output
        Folder of ``report.html`` and ``figures/*.png``; beside the bag by default.
    wanted
        Namespace, topics and wheel geometry; by default found in the bag.

    Raises
    ------
    BagError
        The bag is missing or cannot be read.
    ReportError
        The bag holds nothing to report, or a given topic cannot be used.
    OSError
        The output cannot be written.
    """
    folder = Path(folder)
    output = folder.parent if output is None else Path(output)
    with open_bag(folder) as recording:
        run = load_run(recording, wanted)
        pictures = {item.stem: png_of(item.draw, run) for item in REPORT_FIGURES}
        (output / 'figures').mkdir(parents=True, exist_ok=True)
        paths = []
        for stem, png in pictures.items():
            if png is not None:
                paths.append(output / 'figures' / f'{stem}.png')
                paths[-1].write_bytes(png)
        figures = compute_metrics(
            run, output / 'report.html', tuple(paths), recording.message_count
        )
        figures.report.write_text(_page(recording, run, figures, pictures), encoding='utf-8')
    return figures


_CSS = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 60rem; padding: 1.2rem 1rem 4rem; color: #1f2937;
  background: #fff; font: 1rem/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.1rem; margin: 2.4rem 0 .4rem; }
p { margin: .3rem 0; }
.quiet { color: #6b7280; font-size: .9rem; }
.verdict { border-radius: .5rem; padding: .5rem 1rem; margin: 1rem 0; font-weight: 600; }
.sound { background: #ecfdf5; }
.unsound { background: #fee2e2; }
.tiles { display: grid; grid-template-columns: repeat(3, 1fr); gap: .6rem; margin: 1.2rem 0;
  padding: 0; list-style: none; }
@media (max-width: 40rem) { .tiles { grid-template-columns: repeat(2, 1fr); } }
.tiles li { border: 1px solid #e5e7eb; border-radius: .5rem; padding: .6rem .8rem; }
.tiles b { display: block; font-size: 1.15rem; font-variant-numeric: tabular-nums; }
.tiles span { color: #6b7280; font-size: .82rem; }
.notes { border-left: 3px solid #d97706; background: #fffbeb; padding: .5rem 1rem;
  margin: 1rem 0; }
.notes ul { margin: .2rem 0; padding-left: 1.1rem; }
figure { margin: .4rem 0 0; }
figure img { display: block; width: 100%; height: auto; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { text-align: right; padding: .25rem .7rem; border-bottom: 1px solid #e5e7eb;
  white-space: nowrap; font-variant-numeric: tabular-nums; }
th { color: #6b7280; font-weight: 600; }
th.text, td.text { text-align: left; }
td.long { white-space: normal; overflow-wrap: anywhere; min-width: 8rem; }
details { margin: .6rem 0; }
summary { cursor: pointer; font-weight: 600; }
"""


def _page(
    recording: BagReader, run: Run, figures: ReportMetrics, pictures: Mapping[str, bytes | None]
) -> str:
    name = bag_display_name(recording.folder)
    parts = [
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f'<title>{escape(name)}</title>\n<style>{_CSS}</style>\n</head>\n<body>',
        f'<h1>{escape(name)}</h1>',
        f'<p class="quiet">{escape(_origin(recording, run))}</p>',
        _verdict(figures),
        _tiles(figures),
        _notes(recording, run),
        *(['<h2>Tracking error</h2>', _error_table(run)] if run.ours or figures.measured else []),
        *_response(run, figures),
        _pictures(run, pictures),
        '<h2>Timing by topic</h2>',
        _timing_table(run),
        _complaint_table(run),
        '<h2>Contents of the bag</h2>',
        _topic_table(recording),
        *(_details(title, table) for title, table in sorted(recording.metadata_records.items())),
        '</body>\n</html>\n',
    ]
    return '\n'.join(part for part in parts if part)


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


def _verdict(figures: ReportMetrics) -> str:
    verdict = figures.verdict
    if verdict is None:
        return ''
    kind = 'sound' if verdict.sound else 'unsound'
    return f'<p class="verdict {kind}">{escape(verdict.text())}</p>'


def _tiles(figures: ReportMetrics) -> str:
    channels = figures.channels
    right, left = (figures.wheels[each.name] for each in channels)
    names = ' / '.join(each.short for each in channels)
    tiles = [
        (f'{figures.duration:.1f} s', f'{figures.messages} messages, {figures.switches} switches')
    ]
    if right.overall.count or REFERENCE not in figures.absent:
        tiles += [
            (
                _rmse(right.overall, left.overall, channels),
                f'error RMSE while the robot was being driven, {names}; '
                f'{right.overall.seconds:.1f} s counted',
            ),
            (
                _rmse(right.settled, left.settled, channels),
                f'RMSE settled, away from switches; {right.settled.seconds:.1f} s counted',
            ),
        ]
    if figures.verdict is not None:
        stopped = f'{figures.verdict.stopped:.1f} s'
        tiles.append((stopped, 'stopped between the first and the last command to move'))
    fits = [figures.responses.get(each.name) for each in channels]
    if any(fit is not None and fit.clear for fit in fits):
        delays = [
            f'{1e3 * (fit.dead_time + fit.lag):.0f}' if fit is not None and fit.clear else '–'
            for fit in fits
        ]
        tiles.append((f'{" / ".join(delays)} ms', f'from command to motion, {names}'))
    for name, link in figures.links.items():
        tiles.append(
            (
                f'{format_number(100.0 * link.answered)} %',
                f'of the cycles answered, {name}; round trip '
                f'{format_number(1e3 * link.round_trip)} ms',
            )
        )
    tiles += [
        (
            format_channels(right.chatter, left.chatter, channels, '²'),
            'variation of the command per second'
            + (
                f'; the reference has {format_number(right.demand)} / {format_number(left.demand)}'
                if REFERENCE not in figures.absent
                else ''
            ),
        ),
        (
            f'{format_number(1e3 * figures.latency)} ms',
            f'odometry to command; 99 % below {format_number(1e3 * figures.latency_99)} ms',
        ),
        (
            f'{format_number(100.0 * figures.missing.get(ODOMETRY, math.nan))} %',
            'of the odometry missing',
        ),
    ]
    items = (f'<li><b>{escape(b)}</b><span>{escape(text)}</span></li>' for b, text in tiles)
    return f'<ul class="tiles">{"".join(items)}</ul>'


def _notes(recording: BagReader, run: Run) -> str:
    notes = [*message_loss_notes(recording.metadata_records), *run.notes]
    if run.absent:
        notes.append(f'Not in the bag, or without a message: {", ".join(run.absent)}.')
    if recording.incomplete_files:
        notes.append(f'Unfinished files, not read: {", ".join(recording.incomplete_files)}.')
    if len(run.namespaces) > 1:
        others = ', '.join(space or '/' for space in run.namespaces[1:])
        notes.append(f'The bag also holds topics of {others}.')
    items = ''.join(f'<li>{escape(note)}</li>' for note in notes)
    return f'<div class="notes"><ul>{items}</ul></div>' if items else ''


def _error_table(run: Run) -> str:
    rows = []
    for source in (TRUTH, ODOMETRY):
        if source not in run.motions or REFERENCE not in run.motions:
            continue
        for channel, pair in zip(run.channels, errors_of(run, source).values(), strict=True):
            for extent, values in zip(('driven', 'settled'), pair, strict=True):
                numbers = (values.rmse, values.mae, values.largest)
                cells = [
                    format_number(number) if values.count else UNMEASURED for number in numbers
                ]
                cells += [f'{values.seconds:.1f}', str(values.count)]
                rows.append([LABELS[source], channel.title, extent, *cells, channel.unit])
    if not rows:
        return '<p>The bag lacks a reference, or odometry to compare with it.</p>'
    head = ['motion', 'speed', 'extent', 'RMSE', 'MAE', 'max', 'counted / s', 'samples', 'unit']
    note = f'<p class="quiet">{escape(_extents(run))}</p>'
    return _html_table(head, rows, text=3, wrap=False) + note


def _extents(run: Run) -> str:
    """Return the description of the time in which errors are counted."""
    first, last = driving(run)
    if COMMAND not in run.motions:
        extent = (
            f'Driven: the whole reference without its first {SETTLING:g} s; the bag holds '
            'no command that would show when the robot was driven.'
        )
    elif first > last:
        return 'Every command was zero: the robot was not driven, and no error is counted.'
    else:
        extent = (
            f'Driven: from the first command other than zero, at {first:.1f} s, to the last, at '
            f'{last:.1f} s. Excluded: standstill before and after, and the '
            f'first {SETTLING:g} s with a command and a reference (transient).'
        )
    before = preview_before_switch(run)
    ahead = (
        f'the {before:.2g} s before each switch, in which a controller may already leave the '
        'old reference because the new one is known in advance, and without '
        if before > 0.0
        else ''
    )
    return f'{extent} Settled: also without {ahead}the {SETTLING:g} s after each switch.'


def _response(run: Run, figures: ReportMetrics) -> list[str]:
    """Return the tables of response, motion and radio link, with their titles."""
    parts = []

    def add(title: str, table: TableRows, text: int, note: str = '') -> None:
        if table[1]:
            parts.append(f'<h2>{escape(title)}</h2>')
            parts.append(_html_table(*table, text=text, wrap=False))
            if note:
                parts.append(f'<p class="quiet">{escape(note)}</p>')

    if figures.responses:
        add(
            'From command to motion',
            response_table(run, figures.responses),
            1,
            'Dead time, first-order lag and gain that explain most of the measured speed; their '
            'sum is better determined than either. A dash: no clear response to the command.',
        )
    add('Acceleration and jerk', roughness_table(run), 2)
    add('Path and stops', motion_table(run), 1)
    add('Radio link', link_table(figures.links), 1)
    return parts


def _pictures(run: Run, pictures: Mapping[str, bytes | None]) -> str:
    parts = []
    for item in REPORT_FIGURES:
        png = pictures[item.stem]
        if png is None and item.stem in PACKAGE_FIGURES and not run.ours:
            continue  # only bags of this package hold them
        if png is None and item.stem == 'link' and not run.links:
            continue
        title = escape(item.title)
        parts.append(f'<h2>{title}</h2>')
        if png is None:
            lacking = [name for name in item.needs if name in run.absent]
            why = (
                f'the bag lacks {", ".join(lacking)}' if lacking else 'there are too few messages'
            )
            parts.append(f'<p class="quiet">Left out: {escape(why)}.</p>')
            continue
        data = base64.b64encode(png).decode()
        parts.append(
            f'<figure><img alt="{title}" src="data:image/png;base64,{data}">'
            f'<figcaption class="quiet">{escape(item.caption)}</figcaption></figure>'
        )
    return '\n'.join(parts)


def _timing_table(run: Run) -> str:
    head = ['topic', 'messages', 'rate / Hz', 'jitter / ms', 'missing / %']
    rows: dict[bool, list[list[str]]] = {True: [], False: []}
    for name, timing in run.timing.items():
        rate = format_number(1.0 / timing.period if timing.period > 0.0 else math.nan)
        jitter, missing = format_number(1e3 * timing.jitter), format_number(100.0 * timing.missing)
        rows[name in run.motions].append(
            [run.topics[name], str(timing.count), rate, jitter, missing]
        )
    note = (
        '<p class="quiet">Rate: from the median time between receipts. Jitter: 99 % of these '
        'times are closer to the median than this. Missing: against that rate, by stamp where '
        'there is one.</p>'
    )
    parts = [_html_table(head, rows[True], text=1)] if rows[True] else []
    if rows[False]:
        summary = f'<summary>Scalar topics, {len(rows[False])} topics</summary>'
        parts.append(f'<details>{summary}{_html_table(head, rows[False], text=1)}</details>')
    return '\n'.join([*parts, note]) if parts else '<p>No topic has enough messages.</p>'


def _complaint_table(run: Run) -> str:
    if not run.complaints:
        return ''
    rows = [[level, who, what, format_number(when)] for when, level, who, what in run.complaints]
    head = ['level', 'node', 'message', 'first at / s']
    return '<h2>Warnings and errors of the nodes</h2>' + _html_table(head, rows, text=3)


def _topic_table(recording: BagReader) -> str:
    rows = [[t.name, t.type_name, str(t.message_count)] for t in recording.topics.values()]
    if not rows:
        return '<p>No topic.</p>'
    summary = f'<summary>Topics, {len(rows)}</summary>'
    return (
        f'<details>{summary}{_html_table(["topic", "type", "messages"], rows, text=2)}</details>'
    )


def _details(title: str, table: Mapping[str, str]) -> str:
    rows = [[key, value] for key, value in table.items()]
    summary = f'<summary>{escape(title)}, {len(rows)} values</summary>'
    return f'<details>{summary}{_html_table(["name", "value"], rows, text=2)}</details>'


def _html_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], text: int, wrap: bool = True
) -> str:
    """Return a table whose first ``text`` columns are text, the others numbers."""
    words = ' class="text long"' if wrap else ' class="text"'
    kinds = [words if i < text else '' for i in range(len(head))]
    top = ''.join(f'<th{k}>{escape(word)}</th>' for k, word in zip(kinds, head, strict=True))
    body = ''.join(
        '<tr>' + ''.join(f'<td{k}>{escape(c)}</td>' for k, c in zip(kinds, row, strict=True))
        + '</tr>\n'
        for row in rows
    )  # fmt: skip
    return f'<div class="wide"><table><tr>{top}</tr>\n{body}</table></div>'


def _rmse(right: ErrorStatistics, left: ErrorStatistics, channels: tuple[Channel, Channel]) -> str:
    return format_channels(right.rmse, left.rmse, channels) if right.count else UNMEASURED
