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
"""The verdict on a recorded run: what happened in it, and whether its numbers measure something.

One sentence, the same in the terminal, on the page and in the report. What happened comes first,
in this order: a recording that cannot be trusted, several publishers of a topic, different clocks,
nothing to judge, a stop, a blocked wheel, a gap, frozen odometry, a condition of the robot, a
jump, a machine too slow, an error that is too large.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import Literal, NamedTuple

import numpy as np

from t3mpc_ros.evaluation.bag_report.diagnostic_history import (
    END_PROGRAMS,
    OVERLOADED,
    Cause,
    cause_of,
)
from t3mpc_ros.evaluation.bag_report.incidents import Incidents, driving
from t3mpc_ros.evaluation.bag_report.recorded_run import Run
from t3mpc_ros.evaluation.bag_report.tracking_errors import (
    format_pair,
    path_distance,
    settled_rmse,
)
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.result_output import format_number
from t3mpc_ros.evaluation.run_record import ON_PATH, counted_from
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters

MAX_STOPPED = 0.01
"""Largest share of the drive in which the robot of a valid run stands although it is to move."""
MAX_MISSING = 0.02
"""Largest share of missing odometry."""
MAX_ERROR = 0.25
"""Largest RMSE, settled, as a share of the root mean square of the reference."""
MIN_COUNTED = 0.5
"""Least share of the drive after its start in which errors count."""
MIN_SECONDS = 1.0
"""Least time in which errors count, s."""
CALMER = 0.9
"""Error without the time after stalls, as a share of that with it, below which both are stated."""
NEVER = 0.95
"""Share of the drive in which a robot stands that never moved."""
MIN_ON_PATH = 0.02
"""Least share of the drive on the path for a robot that follows it at all. Detours around
obstacles, looking around and the way back are no errors; the path itself goes on meanwhile."""
MOSTLY = 0.5
"""Share of the drive on the path below which the verdict says so."""

ENDED = {ODOMETRY: 'the robot', REFERENCE: 'the reference generator'}
"""What publishes a topic."""
SINGLE_PUBLISHER = 'Stop all publishers but one, or give each robot a namespace.'


@dataclass(frozen=True)
class Verdict:
    """What happened in a run, and whether its numbers measure the controller."""

    sentence: str
    label: str
    """The same in a few words."""
    kind: Literal['good', 'open', 'bad']
    """Whether the run is good, cannot be judged or was disturbed, or is no valid measurement."""
    remedy: str = ''
    """What a reader does about it, in one sentence; empty if there is nothing to do."""
    details: tuple[str, ...] = ()
    """What else happened, in sentences."""
    sound: bool = True
    """Whether nothing speaks against the numbers."""
    slow: bool = False
    """Whether the machine was too slow, which explains what is wrong if anything is."""
    damaged: bool = False
    """Whether the recording itself cannot be trusted."""
    on_path: float | None = None
    """Share of the drive within :data:`ON_PATH` of the reference; None unless the controller
    follows a path."""

    def reasons(self) -> list[str]:
        """Return the sentences after the first one."""
        return [*([self.remedy] if self.remedy else []), *self.details]

    def text(self) -> str:
        """Return all sentences in one line."""
        return ' '.join([self.sentence, *self.reasons()])


class _Finding(NamedTuple):
    text: str
    """A sentence without its full stop."""
    label: str = ''
    """In a few words; empty: as the text."""
    remedy: str = ''
    spoils: bool = False
    """Whether the numbers are no valid measurement."""
    tail: str | None = None
    """What was measured nevertheless; None: the settled error of the run."""


def judge(
    run: Run, incidents: Incidents, *, counted: float, missing: float, latency_99: float
) -> Verdict:
    """Return the verdict on a run.

    ``counted`` is the time in which errors count, s; ``missing`` the share of odometry,
    ``latency_99`` the 99th percentile from odometry to command, s; NaN if unknown.
    """
    findings = [_Finding(text, '', remedy, spoils=True) for text, remedy in run.damage.items()]
    if several := run.publishers:
        text, spoils = ', '.join(several), any(several.values())
        findings.append(_Finding(text, 'Several publishers', SINGLE_PUBLISHER, spoils))
    if run.behind:
        where = 'behind' if run.behind > 0.0 else 'ahead of'
        said = _Finding(
            f'the stamps of {ODOMETRY} are {duration_text(abs(run.behind))} {where} those of '
            f'{REFERENCE}: they are of different clocks, so tracking cannot be judged',
            'Stamps of different clocks',
            f'Set the clocks of the computers, or stamp {ODOMETRY} by that of the controller.',
            spoils=True,
        )
        return _verdict(run, [*findings, said], '', judged=False)
    lacking = [name for name in (REFERENCE, COMMAND) if name not in run.motions]
    lacking += [] if run.measured else [ODOMETRY]
    if run.measured in run.untrusted:
        return _verdict(run, findings, '', judged=not lacking)
    if lacking:
        said = _Finding(
            _without(run, incidents, lacking), 'Data missing: tracking cannot be judged'
        )
        if run.measured:
            findings += [*_interruptions(run, incidents), *_jumps(incidents)]
        return _verdict(run, [*findings, said], said.text, judged=False)
    first, last = driving(run)
    if not first < last:
        findings.append(_never_driven(run))
        return _verdict(run, findings, 'every command was zero')
    findings += _interruptions(run, incidents)
    slow = [*_slow_machine(run, incidents)]
    loss = []
    if missing > MAX_MISSING:
        text = f'{100.0 * missing:.1f} % of {ODOMETRY} is missing'
        loss.append(_Finding(text, 'Data missing', spoils=True))
    else:
        loss += [
            _Finding(f'{100.0 * share:.1f} % of {name} is missing or not finite', 'Data missing')
            for name, share in _missing_shares(run).items()
            if share > MAX_MISSING
        ]
    findings += [*_jumps(incidents), *_lost_parts(run), *slow, *loss]
    late = _late(run, latency_99)
    on_path = None
    if run.follows_path:
        error, reached, on_path = _path_finding(run)
    else:
        error, reached = _error_finding(run, counted, last - counted_from(first, last))
    if error is not None:
        findings.append(error)
    return _verdict(run, findings, reached, slow=bool(slow or late), on_path=on_path, detail=late)


def _verdict(
    run: Run,
    findings: Sequence[_Finding],
    reached: str,
    *,
    judged: bool = True,
    slow: bool = False,
    on_path: float | None = None,
    detail: str = '',
) -> Verdict:
    """Return the verdict of what happened, most important first, with what was ``reached``."""
    spoilt = any(each.spoils for each in findings)
    stood = '' if on_path is not None else ', and the robot never stood'
    good = Verdict(
        f'Good run: {reached}{stood}.',
        'Good run',
        'good',
        details=(*run.doubts, *([detail] if detail else [])),
        sound=judged and not spoilt,
        slow=slow,
        damaged=bool(run.damage),
        on_path=on_path,
    )
    if not findings:
        return good
    first, *others = findings
    tail = reached if first.tail is None else first.tail
    text = first.text if tail in first.text else f'{first.text}; {tail}'
    further = (each.text.removesuffix(f': {reached}') for each in others)
    more = (f'{_capital(each)}.' for each in further if each not in text)
    return replace(
        good,
        sentence=f'{_capital(text)}.',
        label=_capital(first.label or first.text),
        kind='bad' if spoilt else 'open',
        remedy=first.remedy,
        details=(*more, *good.details),
    )


def _capital(text: str) -> str:
    return f'{text[0].upper()}{text[1:]}'


def duration_text(seconds: float) -> str:
    """Return a duration in a suitable unit."""
    for unit, size in (('days', 86_400.0), ('h', 3600.0), ('min', 60.0)):
        if seconds >= 5.0 * size:
            return f'{seconds / size:.1f} {unit}'
    return f'{seconds:.1f} s' if seconds >= 1.0 else f'{seconds:.2f} s'


# -- the recording --------------------------------------------------------------------------------


def _without(run: Run, incidents: Incidents, lacking: Sequence[str]) -> str:
    """Return what the robot did, and why its tracking cannot be judged."""
    text = f'the bag holds no {" and no ".join(lacking)}, so tracking cannot be judged'
    motion = run.motion
    if motion is None or len(motion) < 2:
        return text
    steps = np.diff(motion.time)
    steps = np.where(steps < 1.0, steps, 0.0)  # not over gaps
    for start, end, _ in incidents.frozen:  # it did not move so far
        steps = np.where((start < motion.time[1:]) & (motion.time[1:] <= end), 0.0, steps)
    way = float(np.sum(np.abs(motion['linear'][1:]) * steps))
    span = float(motion.time[-1] - motion.time[0])
    return f'the robot drove {format_number(way)} m in {duration_text(span)}; {text}'


def _never_driven(run: Run) -> _Finding:
    command = run.motions[COMMAND]
    causes = [cause for each in run.changes if (cause := cause_of(each))]
    cause = min(causes, key=lambda each: each.source, default=Cause(''))
    why = f' ({cause.name})' if cause.known else ''
    text = f'the robot was never driven{why}: every command was zero'
    if command.time.size and (command['linear'].any() or command['angular'].any()):
        text = f'the robot was never driven{why}: a single command was other than zero'
    return _Finding(text, 'Never driven', cause.remedy, spoils=True, tail='')


# -- what interrupted the run ---------------------------------------------------------------------


def _interruptions(run: Run, incidents: Incidents) -> Iterator[_Finding]:
    """Yield stops, blocked wheels, gaps, frozen odometry, and conditions of the robot."""
    if incidents.stops:
        yield _stop_finding(run, incidents)
    for start, end, title in incidents.blocked:
        yield _Finding(
            f'the {title} stood from {start:.1f} s on for {duration_text(end - start)} although '
            'it was commanded to turn',
            f'{title} blocked at {start:.1f} s',
            'Free the wheel; else see its motor and its driver.',
            spoils=True,
        )
    if incidents.gaps:
        start, end, name = max(incidents.gaps, key=lambda each: each[1] - each[0])
        text = f'no {name} for {duration_text(end - start)} from {start:.1f} s on'
        if (count := len({(low, high) for low, high, _ in incidents.gaps})) > 1:
            text += f', the longest of {count} gaps'
        yield _Finding(text, f'Data missing from {start:.1f} s on', spoils=True)
    for start, end, name in incidents.ended:
        text = f'{name} ends at {start:.1f} s, {duration_text(end - start)} before the commands do'
        remedy = f'See why {ENDED[name]} fell silent, or the recorder no longer received it.'
        # A robot may be driven on by hand where its reference ends.
        spoils = name == ODOMETRY
        yield _Finding(text, f'No {name} from {start:.1f} s on', remedy, spoils)
    if incidents.frozen:
        start, _, text = max(incidents.frozen, key=lambda each: each[1] - each[0])
        remedy = 'See the driver of the robot: it repeats its last message.'
        yield _Finding(text, f'Odometry frozen at {start:.1f} s', remedy, spoils=True)
    seen = set()
    for event in run.complaints:
        cause = cause_of(event, stops=False)
        if cause is None or cause.name in seen or cause.name == OVERLOADED:
            continue
        seen.add(cause.name)
        node, text = event[2], event[3]
        yield _Finding(
            f'{cause.name} from {event[0]:.1f} s on ({node}: {text})',
            f'{cause.name} from {event[0]:.1f} s on',
            cause.remedy,
        )


def _stop_finding(run: Run, incidents: Incidents) -> _Finding:
    """Return the longest stop, of all of them, and what was measured until the first one."""
    stops, stopped = incidents.stops, incidents.stopped
    main = max(stops, key=lambda each: each.length)
    first, last = driving(run)
    last = max(last, stops[-1].end)
    label = f'{main.cause.name or "Stopped"} at {main.start:.1f} s'
    if len(stops) == 1 and first < last and main.length >= NEVER * (last - first):
        why = f'{main.cause.name}: ' if main.cause.known else ''
        text = f'{why}the robot never moved, although it was to for {duration_text(main.length)}'
        return _Finding(text, 'Never moved', main.cause.remedy, spoils=True, tail='')
    stood = f'the robot stood for {duration_text(main.length)}'
    text = f'{main.cause.name} at {main.start:.1f} s, {stood}'
    if not main.cause.known:
        text = f'{stood} from {main.start:.1f} s on'
    if len(stops) > 1:
        text += f', the longest of {len(stops)} stops of {duration_text(stopped)} in all'
    if not main.cause.known:
        text += f' ({main.cause.text})'
    spoils = not first < last or stopped > MAX_STOPPED * (last - first)
    tail = None
    if REFERENCE in run.motions and not run.follows_path:
        ended = stops[0].end >= last - 1.0
        tail = _rmse_text(run, settled_rmse(run, until=stops[0].start if ended else math.inf))
        tail = f'until then {tail}' if ended else f'while it drove {tail}'
    return _Finding(text, label, main.cause.remedy, spoils, tail)


def _slow_machine(run: Run, incidents: Incidents) -> Iterator[_Finding]:
    """Yield stalls of the machine and its overload."""
    if stalls := incidents.stalls:
        start, end = max(stalls, key=lambda each: each[1] - each[0])
        times = 'once, for' if len(stalls) == 1 else f'{len(stalls)} times, the longest'
        after = 'it' if len(stalls) == 1 else 'them'
        tail = None
        if REFERENCE in run.motions and not run.follows_path:
            whole, calm = settled_rmse(run), settled_rmse(run, spared=stalls)
            tail = _rmse_text(run, whole)
            if max(calm) < CALMER * max(whole):
                units = [each.unit for each in run.channels]
                tail += f', without the 1 s after {after} {format_pair(calm, units)}'
        yield _Finding(
            f'the machine stalled {times} {1e3 * (end - start):.0f} ms at {start:.1f} s: errors '
            f"after {after} are not the controller's",
            f'Machine stalled {len(stalls)} times' if len(stalls) > 1 else 'Machine stalled',
            END_PROGRAMS,
            tail=tail,
        )
    for when, _, node, text in run.complaints:
        cause = cause_of((when, 'warning', node, text), stops=False)
        if cause is not None and cause.name == OVERLOADED:
            yield _Finding(
                f'{OVERLOADED} from {when:.1f} s on ({node}: {text}): errors since then may not '
                "be the controller's",
                'Machine too slow',
                END_PROGRAMS,
            )
            return


def _late(run: Run, latency_99: float) -> str:
    """Return a sentence if commands come later than the next odometry; else ''."""
    timing = run.timing.get(ODOMETRY)
    if timing is None or not latency_99 > timing.period > 0.0:
        return ''
    return (
        f'The machine was slow: 99 % of the commands came within {1e3 * latency_99:.1f} ms of '
        f'their odometry, whose period is {1e3 * timing.period:.1f} ms.'
    )


def _missing_shares(run: Run) -> dict[str, float]:
    """Return the missing share of what our nodes send regularly, by relative name.

    Our controller sends a command to each odometry.
    """
    found = {}
    command, odometry, reference = (run.timing.get(n) for n in (COMMAND, ODOMETRY, REFERENCE))
    if command and odometry and not run.other_clock:
        same = abs(command.period - odometry.period) < 0.2 * odometry.period
        found[COMMAND] = command.missing - odometry.missing if same else 0.0
    if reference is not None:
        found[REFERENCE] = reference.missing
    return found if run.ours else {}


def _lost_parts(run: Run) -> Iterator[_Finding]:
    if run.lost:
        size = sum(high - low for low, high in run.lost)
        parts = f'{len(run.lost)} damaged parts of {duration_text(size)} in all'
        parts = parts if len(run.lost) > 1 else f'a damaged part of {duration_text(size)}'
        yield _Finding(f'the messages of {parts} are lost in the recovered bag', 'Data missing')


def _jumps(incidents: Incidents) -> Iterator[_Finding]:
    if jumps := incidents.jumps:
        largest = max(jumps, key=lambda each: each.distance)
        text = (
            f'the position of {largest.name} jumps by {largest.distance:.4g} m at '
            f'{largest.time:.1f} s'
        )
        text += f', the largest of {len(jumps)} jumps' if len(jumps) > 1 else ''
        yield _Finding(text, f'Jump of the position at {largest.time:.1f} s')
    if carried := incidents.carried:
        largest_of = max(carried, key=lambda each: each.motion.distance + each.motion.turn)
        more = f', the largest of {len(carried)} such motions' if len(carried) > 1 else ''
        yield _Finding(
            f'{largest_of.text}{more}', f'Carried or slipped at {largest_of.time:.1f} s'
        )


# -- what was reached -----------------------------------------------------------------------------


def _rmse_text(run: Run, pair: tuple[float, float]) -> str:
    """Return a settled error as text, with what it is to be compared with if it is too large."""
    if not any(map(math.isfinite, pair)):
        return 'no settled motion was measured'
    worst = max(pair)
    text = f'settled RMSE {format_pair(pair, [each.unit for each in run.channels])}'
    if worst > MAX_ERROR * _reference_size(run):
        text += f' on a reference of {_reference_size(run):.2g} {run.channels[0].unit}'
    if worst > MAX_RATIO * known_rmse(run.parameters):
        text += (
            f', {worst / KNOWN_RMSE:.0f} times the {KNOWN_RMSE:g} rad/s that the digital twin is '
            'known to reach under these conditions'
        )
    return text


def _reference_size(run: Run) -> float:
    reference = run.motions[REFERENCE]
    return max(rms(reference[each.name]) for each in run.channels)


def _error_finding(run: Run, counted: float, length: float) -> tuple[_Finding | None, str]:
    """Return what speaks against the errors of the speeds, if anything, and what they are."""
    pair = settled_rmse(run)
    reached = _rmse_text(run, pair)
    worst = max(pair)
    if not math.isfinite(worst):
        return _Finding(reached, 'No valid measurement', spoils=True), reached
    if worst > MAX_ERROR * _reference_size(run):
        text = f'the robot did not follow its reference: {reached}'
        return _Finding(text, 'Did not follow its reference', spoils=True), reached
    if worst > MAX_RATIO * known_rmse(run.parameters):
        text = f'poor run: {reached}'
        return _Finding(text, 'Poor run', spoils=True), reached
    if counted < max(MIN_COUNTED * length, MIN_SECONDS):
        text = f'only {counted:.1f} of {length:.1f} s count: {reached}'
        return _Finding(text, 'No valid measurement', spoils=True), reached
    return None, reached


def _path_finding(run: Run) -> tuple[_Finding | None, str, float]:
    """Return what speaks against the path of a patrol, if anything, and how well it was driven.

    Last the share of the drive in which the robot is within :data:`ON_PATH` of its path.
    """
    distance = path_distance(run)
    within = f'within {1e3 * ON_PATH:g} mm of its path for'
    if distance is None:
        text = 'the robot did not follow its path: the bag holds no positions of both'
        return _Finding(text, 'Did not follow its path', spoils=True), 'the path is not known', 0.0
    share = float(np.mean(distance['value'] <= ON_PATH))
    error = f'path error {1e3 * rms(distance["value"]):.1f} mm (RMS)'
    percent = f'{100.0 * share:.0f} % of the drive'
    if share < MIN_ON_PATH:
        text = f'the robot did not follow its path: {within} only {percent}, {error}'
        return _Finding(text, 'Did not follow its path', spoils=True), error, share
    detours = run.parameters.get('controller', {}).get('keep_out.enabled') == 'True'
    rest = '; the rest were detours around obstacles and the ways back'
    reached = f'{within} {percent}, {error}{rest if detours and share <= 0.995 else ""}'
    if share < MOSTLY:
        return _Finding(f'mostly off its path: {reached}', 'Mostly off its path'), reached, share
    return None, reached, share


# -- known result ---------------------------------------------------------------------------------

MAX_RATIO = 3.0
"""A settled RMSE of more than so many times the known one is not that of a good run. Single seeds
change it by a quarter (docs/results.md), a busy machine that loses no sample by less than 2 times
(0.0215 rad/s in bench/frozen/demo.mcap); one that stalls, by 9 times."""


KNOWN_RMSE = 0.012
"""What the digital twin reaches, settled, the larger one of both wheels, rad/s. README.md: 60 s of
scripts/demo, noise variance 0.04 (rad/s)²."""
KNOWN_PARAMETERS: Mapping[str, Mapping[str, str]] = {
    'sim_robot': {'drive.kind': 'stepper', 'world': ''},
    'reference_generator': {'source': 'signals', 'output': 'wheels'},
}
"""Its recorded parameters by node. Those of the twin that are not named must have their defaults,
but for :data:`FREE`."""
MAX_NOISE = 0.04
"""Largest variance of its measured wheel speeds, (rad/s)²."""
FREE = ('seed', 'noise.variance', 'drive.kind', 'world')
"""Parameters of the twin that may differ from their defaults, or are named."""


def known_rmse(records: Mapping[str, Mapping[str, str]]) -> float:
    """Return :data:`KNOWN_RMSE`, or infinity for other recorded parameters, by node."""
    twin = records.get('sim_robot', {})
    defaults = {  # as a recorder writes them
        name: str(list(value)) if isinstance(value, tuple) else str(value)
        for name, value in DigitalTwinParameters().to_dict().items()
    }
    for name, value in twin.items():
        if name in defaults and name not in FREE and value != defaults[name]:
            return math.inf
    try:
        if float(twin.get('noise.variance', '0')) > MAX_NOISE:
            return math.inf
    except ValueError:
        return math.inf
    same = all(
        records.get(node, {}).get(name) == value
        for node, values in KNOWN_PARAMETERS.items()
        for name, value in values.items()
    )
    return KNOWN_RMSE if same else math.inf
