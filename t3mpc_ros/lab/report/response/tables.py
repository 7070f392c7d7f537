# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How a robot answers, moves and is reached, as rows of words and numbers."""

from collections.abc import Mapping
import math

from t3mpc_ros.lab.report.link.history import LinkFigures
from t3mpc_ros.lab.report.merit import in_words
from t3mpc_ros.lab.report.recorded import Run
from t3mpc_ros.lab.report.response.measures import Fit, journey, roughness
from t3mpc_ros.lab.report.topics import COMMAND

Table = tuple[list[str], list[list[str]]]
"""Head and rows."""


def answer_table(run: Run, fits: Mapping[str, Fit]) -> Table:
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
        gain = in_words(fit.gain) if fit.clear else '–'
        rows.append([each.title, *numbers, gain, in_words(100.0 * max(fit.explained, 0.0))])
    return head, rows


def roughness_table(run: Run) -> Table:
    """Return how hard command and motion change."""
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
            rows.append([words, each.title, *map(in_words, numbers), unit])
    return head, rows


def journey_table(run: Run) -> Table:
    """Return way, turning, stops and pace; no row when they are not known."""
    found = journey(run)
    if found is None:
        return ['quantity', 'value'], []
    longest = max((end - start for start, end in found.stops), default=0.0)
    stood = sum(end - start for start, end in found.stops)
    where = ', '.join(f'{start:.1f} to {end:.1f}' for start, end in found.stops[:5])
    more = f', and {len(found.stops) - 5} more' if len(found.stops) > 5 else ''
    mean = found.distance / found.moving if found.moving > 0.0 else 0.0
    rows = [
        ['way, forwards and backwards', f'{in_words(found.distance)} m'],
        ['turning, both ways', f'{in_words(found.turned)} rad'],
        ['speed while moving, mean and largest', f'{mean:.3f} and {found.fastest:.3f} m/s'],
        ['time moving', f'{found.moving:.1f} s'],
        ['stops', f'{len(found.stops)}, {stood:.1f} s in all, the longest {longest:.1f} s'],
    ]
    if found.stops:
        rows.append(['stood at', f'{where}{more} s'])
    if COMMAND in run.motions:
        rows.append(['of that told to move', f'{found.disobeyed:.1f} s'])
    return ['quantity', 'value'], rows


def link_table(links: Mapping[str, LinkFigures]) -> Table:
    """Return how well each link worked, one column each."""
    each = list(links.values())
    rows = [
        ['cycles', *(_whole(one.cycles) for one in each)],
        ['lost', *(_whole(one.lost) for one in each)],
        ['answered', *(f'{in_words(100.0 * one.answered)} %' for one in each)],
        ['round trip, median', *(f'{in_words(1e3 * one.round_trip)} ms' for one in each)],
        ['round trip, worst 99 %', *(f'{in_words(1e3 * one.round_trip_99)} ms' for one in each)],
        ['oldest measurement', *(f'{in_words(one.oldest)} s' for one in each)],
        ["resets of the robot's board", *(_whole(one.resets) for one in each)],
        ['resets of the dongle', *(_whole(one.dongle_resets) for one in each)],
        ['failures of the port', *(_whole(one.port_failures) for one in each)],
        ['sessions begun after the first report', *(_whole(one.sessions) for one in each)],
        ['frames damaged between dongle and host', *(_whole(one.damaged) for one in each)],
    ]
    return ['quantity', *links], rows if each else []


def _whole(value: float) -> str:
    return f'{value:.0f}' if math.isfinite(value) else '–'
