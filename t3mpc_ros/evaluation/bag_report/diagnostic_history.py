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
"""Diagnostics over time: conditions of every node, radio links, changes of the map."""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.bag.reader import BagReader
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE
from t3mpc_ros.geometry.types import Array

SHARES = ('lost_share', 'round_trip_median_ms', 'round_trip_p99_ms', 'telemetry_age_s')
"""Keys of gauges, see ``radio_bridge``."""
COUNTED = {
    'cycles': 'cycles',
    'cycles_lost': 'cycles lost',
    'robot_resets': 'resets of the robot board',
    'dongle_resets': 'resets of the dongle',
    'port_failures': 'port failures',
    'sessions': 'sessions begun after the first report',
    'crc_errors': 'wrong checksums',
    'frame_errors': 'malformed frames',
}
"""Counters that a report shows, with their names."""
COUNTERS = (*COUNTED, 'commands', 'commands_refused')
"""Keys of counters, which only grow."""
LINK_KEYS = ('cycles', 'cycles_lost', 'lost_share', 'round_trip_median_ms', 'round_trip_p99_ms')
"""A status with at least two of these keys describes a link."""


@dataclass(frozen=True)
class LinkHistory:
    """Metrics of one link over time."""

    name: str
    time: Array
    """Receive time, s."""
    values: Mapping[str, Array]
    """Arrays by key, NaN where a value is missing; keys of :data:`SHARES` and :data:`COUNTERS`."""

    def answered(self) -> Array:
        """Return the share of answered cycles since the previous report, shape (n,)."""
        cycles, lost = self.values.get('cycles'), self.values.get('cycles_lost')
        if cycles is None or lost is None:
            share = self.values.get('lost_share')
            return np.full(self.time.size, math.nan) if share is None else 1.0 - share
        made, failed = (np.diff(table, prepend=math.nan) for table in (cycles, lost))
        with np.errstate(invalid='ignore', divide='ignore'):
            known = (made > 0.0) & (failed >= 0.0) & (np.diff(self._starts(), prepend=0) == 0)
            return np.where(known, 1.0 - failed / made, math.nan)

    def grown(self, key: str) -> float:
        """Return the increase of a counter in the recording, over restarts; NaN if unknown."""
        table = self.values.get(key)
        if table is None or not np.isfinite(table).any():
            return math.nan
        rows = np.flatnonzero(np.isfinite(table))
        known = table[rows]
        restarted = np.diff(self._starts()[rows]) > 0
        return float(np.where(restarted, known[1:], np.diff(known)).sum())

    def total_answered(self) -> float:
        """Return the share of answered cycles of the recording; NaN if unknown."""
        made, failed = self.grown('cycles'), self.grown('cycles_lost')
        if made > 0.0 and math.isfinite(failed):
            return 1.0 - failed / made
        return _over(np.nanmean, self.answered())

    def over(self, measure: Callable[[Array], Any], key: str, unit: float = 1.0) -> float:
        """Return a measure over the reports of a gauge in some SI unit; NaN if unknown."""
        return unit * _over(measure, self.values.get(key, np.full(1, math.nan)))

    def _starts(self) -> NDArray[np.intp]:
        """Return how often the bridge was started anew up to each report, shape (n,).

        All its counters begin at zero then. The one that falls tells it of those that do not.
        """
        fell = np.zeros(self.time.size, dtype=bool)
        for table in (self.values[key] for key in COUNTERS if key in self.values):
            rows = np.flatnonzero(np.isfinite(table))
            fell[rows[1:]] |= np.diff(table[rows]) < 0.0
        return np.cumsum(fell)


def _over(measure: Callable[[Array], Any], values: Array) -> float:
    return float(measure(values)) if np.isfinite(values).any() else math.nan


# -- conditions -----------------------------------------------------------------------------------


_LEVELS = {0: 'ok', 1: 'warning', 2: 'error', 3: 'stale'}
STANDSTILL = 'standstill'
"""Key of the reason of a robot that stands: no other warning hides it."""

DiagnosticEvent = tuple[float, str, str, str]
"""Time of the first message, level, node, text."""
MAX_CHANGES = 1000
"""Changes of the state of nodes that are kept."""


def read_diagnostics(
    recording: BagReader, namespace: str
) -> tuple[list[DiagnosticEvent], list[DiagnosticEvent], list[LinkHistory], Array]:
    """Return what the nodes report, in ``/diagnostics`` and in that of the namespace.

    Each distinct warning or error with its first time; each state of a node that follows another
    one of it, but not that it was well from the start; the radio links; the times of all reports.
    """
    found: dict[tuple[str, str, str], float] = {}
    changes: list[DiagnosticEvent] = []
    times: list[float] = []
    state: dict[str, tuple[int, str]] = {}
    rows: dict[str, list[tuple[float, dict[str, float]]]] = {}
    for topic in sorted({'/diagnostics', f'{namespace}/diagnostics'} & set(recording.topics)):
        if not recording.topics[topic].type_name.endswith('DiagnosticArray'):
            continue
        for received, message in recording.messages(topic):
            times.append(received)
            for status in message.status:
                level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
                word, text = _LEVELS.get(level, str(level)), _text(status)
                if level:
                    found.setdefault((word, status.name, text), received)
                now = level, text if level else ''
                if state.get(status.name, (0, '')) != now:
                    changes.append((received, word, status.name, text))
                state[status.name] = now
                if numbers := _numbers(status):
                    rows.setdefault(status.name, []).append((received, numbers))
    links = []
    for name, entries in rows.items():
        keys = [k for k in (*SHARES, *COUNTERS) if any(k in numbers for _, numbers in entries)]
        values = {
            key: np.array([numbers.get(key, math.nan) for _, numbers in entries]) for key in keys
        }
        links.append(LinkHistory(name, np.array([when for when, _ in entries]), values))
    complaints = sorted(found.items(), key=lambda item: item[1])
    described = [(when, *key) for key, when in complaints]
    return described, sorted(changes)[:MAX_CHANGES], links, np.array(times)


def _text(status: Any) -> str:
    """Return what a node reports, beginning with why its robot stands."""
    reason = next((each.value for each in status.values if each.key == STANDSTILL), '')
    text: str = status.message
    return text if reason in text else f'{reason}; {text}'


def _numbers(status: Any) -> dict[str, float]:
    """Return the link values of a status; empty when the status describes something else."""
    values = {entry.key: entry.value for entry in status.values}
    if sum(key in values for key in LINK_KEYS) < 2:
        return {}
    numbers = {}
    for key in (*SHARES, *COUNTERS):
        try:
            value = float(values[key])
        except (KeyError, ValueError):
            continue  # not a number or missing: unknown
        numbers[key] = value if math.isfinite(value) else math.nan
    return numbers


# -- why a robot stands ---------------------------------------------------------------------------


ROBOT, CONTROLLER, MACHINE = 0, 1, 2
"""Sources of causes in the order of their report: the later ones often follow from the others."""
_SOURCES = {
    'sim_robot': ROBOT,
    'radio_bridge': ROBOT,
    'controller': CONTROLLER,
    'reference_generator': MACHINE,
    'recorder': MACHINE,
    'player': MACHINE,
}
"""By node; every other node is one of the robot's."""
REASON_WINDOW = 1.5
"""Diagnostics come once a second: those of a stop are at most this far from its start, s."""
REASON_LEAD = 0.5
"""Diagnostics of a cause are at most this far before the stop, s, or still hold then."""
OVER = 3.0
"""Time for which a robot may stand on after the cause of it is over, s."""


class Cause(NamedTuple):
    """Why a robot stands or is disturbed."""

    name: str
    """What happened, in a few words; empty if nothing is known."""
    remedy: str = ''
    """What a reader does about it, as a sentence; empty if there is nothing to do."""
    text: str = ''
    """What the nodes said."""
    source: int = MACHINE
    lacks: str = ''
    """Relative name of the topic that is said not to be received."""

    @property
    def known(self) -> bool:
        """Whether a node gave a reason."""
        return bool(self.name)


class Pattern(NamedTuple):
    """A text of diagnostics and the cause that it stands for."""

    text: str
    """What the diagnostics contain."""
    name: str
    remedy: str
    lacks: str = ''
    """Relative name of the topic that it says is not received."""
    stops: bool = True
    """Whether it stops the robot; else it is a condition under which it drives on."""


SLIP = 'a wheel slips'
"""Part of the reports of a robot whose gyro and steps disagree."""
_CHARGE = 'Charge the battery.'
_SILENT = 'See why the controller fell silent.'
OVERLOADED = 'The machine was overloaded'
END_PROGRAMS = 'End other programs, or use a faster machine, and repeat the run.'
PATTERNS = (
    Pattern('emergency stop was released', 'Waiting after an e-stop', 'Command it again.'),
    Pattern(
        'emergency stop',
        'E-stop',
        'When the way is clear, release it with the service e_stop; the robot then waits for a '
        'new command.',
    ),
    Pattern(
        'gyro and steps disagree',
        'Slip stop: a wheel slips, is blocked, or has lost steps',
        'Free the wheels, then command no motion for 0.5 s.',
    ),
    Pattern('brown-out', 'Brown-out: the board restarted', _CHARGE),
    Pattern('below its cut-off', 'Battery below its cut-off', _CHARGE),
    Pattern(
        'robot does not answer',
        'The robot did not answer',
        'See that it is on, in range and on the same channel.',
    ),
    Pattern(
        'no command reached the robot',
        'No command reached the robot',
        'Move the dongle nearer to it, or change the channel.',
    ),
    Pattern('dongle', 'The dongle did not answer', 'See its cable and its port.'),
    Pattern('the last command has expired', 'No command', _SILENT, COMMAND),
    Pattern('no command', 'No command', _SILENT, COMMAND),
    Pattern('disabled by request', 'Controller disabled', 'Enable it with ~/enable.'),
    Pattern(
        'reference is stale', 'Reference too old', 'See why the reference generator fell silent.'
    ),
    Pattern('no reference yet', 'No reference', 'Start a reference generator.', REFERENCE),
    Pattern(
        'odom is too old',
        'Odometry too old',
        'See the processor, the network and the clocks of the computers.',
    ),
    Pattern(
        'odom is from the future', 'Odometry from the future', 'Set the clocks of the computers.'
    ),
    Pattern('no odometry', 'No odometry', 'See why the robot fell silent.', ODOMETRY),
    Pattern(
        'odometry is not finite',
        'Odometry is not finite',
        'A number in odom is NaN or infinite, or its quaternion is all zeros.',
    ),
    Pattern('state is diverging', 'The state diverged', 'See the wheels and the parameters.'),
    Pattern('odometry has restarted', 'Odometry restarted', 'See why the robot restarted.'),
    Pattern(
        'does not follow commands',
        'The robot did not follow its commands',
        'See its drives and its supply.',
    ),
    Pattern('battery is low', 'Battery low', _CHARGE, stops=False),
    Pattern(
        'inertial sensor does not answer', 'Inertial sensor silent', 'See its wiring.', stops=False
    ),
    Pattern(
        'the robot is boxed in',
        'Boxed in',
        'With nothing around the robot, see the readings of its range sensors.',
        stops=False,
    ),
    Pattern(SLIP, 'A wheel slipped', 'See the floor, the tyres and the load.', stops=False),
    Pattern('processor overloaded', OVERLOADED, END_PROGRAMS, stops=False),
    Pattern('real-time factor', OVERLOADED, END_PROGRAMS, stops=False),
)
"""Of two that a text contains the earlier one is meant."""


def cause_of(event: DiagnosticEvent, *, stops: bool = True) -> Cause | None:
    """Return the cause that a warning or error stands for.

    With ``stops`` that of a standstill: an unknown warning is none, an unknown error is one.
    """
    _, level, node, text = event
    found = next((each for each in PATTERNS if each.text in text and level != 'ok'), None)
    source = _SOURCES.get(node.split(':')[0].rpartition('/')[2].strip(), ROBOT)
    if found and found.name == OVERLOADED:
        source = MACHINE
    if found is not None and found.stops == stops:
        return Cause(found.name, found.remedy, f'{node}: {text}', source, found.lacks)
    if found is None and stops and level == 'error' and source != MACHINE:
        first = text.split('; ')[0]  # what follows is about something else
        return Cause(f'{node}: {first}', '', f'{node}: {text}', source)
    return None


def cause_between(
    changes: Sequence[DiagnosticEvent],
    start: float,
    end: float,
    *,
    present: Collection[str] = (),
    reported: bool = False,
) -> Cause:
    """Return the cause of a standstill from ``start`` to ``end``, s.

    From what the nodes reported about its start, and from what still applied then; unless the node
    was well again while the robot stood on, or lacked a topic that was ``present``. ``reported``:
    whether the bag holds diagnostics of that time.
    """
    until = max(math.nextafter(start, end), min(end, start + 10.0)) + REASON_WINDOW
    near = [each for each in changes if start - REASON_LEAD <= each[0] <= until]
    active: dict[str, DiagnosticEvent] = {}
    for each in changes:
        if each[0] < start - REASON_LEAD:
            active[each[2]] = each
    events = [each for each in [*near, *active.values()] if not _was_over(each, changes, end)]
    found = [cause for each in events if (cause := cause_of(each))]
    known = [each for each in found if each.lacks not in present]
    if known:
        return min(known, key=lambda each: each.source)  # of equal ones the first
    texts = [f'{each.text}, although the bag holds {each.lacks} of that time' for each in found]
    texts += [f'{node}: {text}' for _, level, node, text in near if level != 'ok' and not texts]
    words = '; '.join(dict.fromkeys(texts[:2]))
    none = 'the nodes reported no reason'
    none = none if reported else 'the bag holds no diagnostics of that time'
    return Cause('', text=words or none)


def _was_over(event: DiagnosticEvent, changes: Sequence[DiagnosticEvent], end: float) -> bool:
    """Return whether the next state of a node has no cause, long before a standstill ends."""
    later = (each for each in changes if each[2] == event[2] and each[0] > event[0])
    following = next(later, None)
    return following is not None and following[0] < end - OVER and cause_of(following) is None


# -- changes of the map ---------------------------------------------------------------------------


MAP_CHANGES = 'map_changes'
CHANGE_NUMBERS = ('x_m', 'y_m', 'size_m', 'confidence', 'first_seen_s', 'found_s', 'last_seen_s')


class RecordedChange(NamedTuple):
    """What contradicted the map, as last published."""

    kind: str
    state: str
    """there, gone or withdrawn"""
    x: float
    """m"""
    y: float
    """m"""
    size: float
    """m"""
    confidence: float
    found: float
    """Time of the first message with it, s."""
    seen_before: float
    """Time for which it was seen before that, s."""
    seen_for: float
    """Time from the first to the last sight, s."""


def read_map_changes(
    recording: BagReader, namespace: str, local: Callable[[Array], Array]
) -> tuple[RecordedChange, ...]:
    """Return the changes in a bag; ``local`` maps receive times to times of the run, s."""
    topic = recording.topics.get(f'{namespace}/{MAP_CHANGES}')
    if topic is None or not topic.type_name.endswith('DiagnosticArray'):
        return ()
    found: dict[str, RecordedChange] = {}
    for received, message in recording.messages(topic.name):
        for status in message.status:
            values = {each.key: each.value for each in status.values}
            before = found.get(status.name)
            with suppress(KeyError, ValueError):  # of another publisher
                x, y, size, confidence, first, event, last = (
                    float(values[key]) for key in CHANGE_NUMBERS
                )
                gone = 'withdrawn' if values.get('withdrawn') == 'True' else 'gone'
                found[status.name] = RecordedChange(
                    values['kind'], 'there' if values['present'] == 'True' else gone,
                    x, y, size, confidence,
                    before.found if before else float(local(np.array([received]))[0]),
                    event - first, last - first,
                )  # fmt: skip
    return tuple(found.values())
