# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a bag says of a run: motions, commands and terms over one time.

Topics are known by their names relative to a namespace; any of them may be absent, empty, or
hold numbers that are not finite.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.motion.kinematics import Geometry, wheels_from_body
from t3mpc_ros.motion.words import BodyTwist
from t3mpc_ros.record.reader import Recording, missing_share
from t3mpc_ros.settings import SettingError

Array = NDArray[np.float64]

WHEELS = ('right', 'left')
TERMS = ('fuzzy', 'feedback', 'feedforward', 'compensator', 'predictive')
TRUTH, ODOMETRY, REFERENCE, COMMAND = 'ground_truth/odom', 'odom', 'reference', 'cmd_vel'
SIGNALS = ('reference/mode', 'reference/signal/right', 'reference/signal/left')
NUMBERS = (
    *SIGNALS,
    *(f'controller/{name}/{w}' for name in ('error', 'estimate', 'skill') for w in WHEELS),
    *(f'controller/terms/{name}/{w}' for name in (*TERMS, 'applied') for w in WHEELS),
    'controller/lyapunov/value',
    'controller/lyapunov/margin',
)
NAMES = (REFERENCE, ODOMETRY, TRUTH, COMMAND, 'reference/signals', *NUMBERS)

_ODOMETRY_FIELDS = {
    'x': 'pose.pose.position.x',
    'y': 'pose.pose.position.y',
    'z': 'pose.pose.orientation.z',
    'w': 'pose.pose.orientation.w',
    'linear': 'twist.twist.linear.x',
    'angular': 'twist.twist.angular.z',
}


@dataclass(frozen=True)
class Series:
    """One quantity over time: ``values[name]`` beside ``time``, both in seconds and SI units."""

    time: Array
    values: Mapping[str, Array]

    def __getitem__(self, name: str) -> Array:
        return self.values[name]

    def __len__(self) -> int:
        return int(self.time.size)


@dataclass(frozen=True)
class Timing:
    """How regularly one topic came."""

    count: int
    period: float
    """Median (s) of the times between receipts."""
    jitter: float
    """99th percentile (s) of how far one such time is from the median."""
    missing: float
    """Share of samples missing at the median rate of the stamps, see :func:`missing_share`."""


@dataclass(frozen=True)
class Run:
    """A recorded run, ready to be measured and drawn; times in seconds since its start."""

    duration: float
    topics: Mapping[str, str]
    """Full name by relative name, of those with at least one message."""
    absent: tuple[str, ...]
    """Relative names that are not in the bag, or have no message."""
    namespaces: tuple[str, ...]
    """The namespace shown, then others that the bag holds."""
    geometry: Geometry
    motions: Mapping[str, Series]
    """``reference``, ``odom``, ``ground_truth/odom``, ``cmd_vel``: linear, angular (m/s, rad/s),
    right, left (rad/s), and but for the command x, y (m), heading (rad)."""
    numbers: Mapping[str, Series]
    """Plain numbers by relative name, as ``value``."""
    receipts: Mapping[str, Array]
    """Times of receipt by relative name, by the recorder's clock."""
    timing: Mapping[str, Timing]
    switches: Array
    """When the reference switched."""
    lead: float
    """Median (s) of how far ahead of their receipt the stamps of the reference are."""
    complaints: tuple[tuple[float, str, str, str], ...]
    """From diagnostics: when first, level, who, what."""
    notes: tuple[str, ...]

    @property
    def measured(self) -> str:
        """Relative name of the motion that errors are taken from: truth where there is one."""
        return next((name for name in (TRUTH, ODOMETRY) if name in self.motions), '')


def load_run(recording: Recording, namespace: str | None = None) -> Run:
    """Return the run in ``recording``; of the fullest namespace unless one is named."""
    topics, namespaces = find_topics(recording.topics, namespace)
    topics = {name: t for name, t in topics.items() if recording.topics[t].message_count}
    notes: list[str] = []
    geometry = _geometry(recording.details, notes)
    raw = {name: _read(recording, name, topic, notes) for name, topic in topics.items()}
    raw = {name: table for name, table in raw.items() if table['stamp'].size}
    clock = _Clock(raw, notes)
    motions, numbers = {}, {}
    for name, table in raw.items():
        if name == 'reference/signals':
            for i, signal in enumerate(SIGNALS):
                numbers[signal] = Series(
                    clock.applies(table['received']), {'value': table[f'{i}']}
                )
        elif name in NUMBERS:
            time = clock.applies if name in SIGNALS else clock.local
            numbers[name] = Series(time(table['received']), {'value': table['value']})
        elif name == COMMAND:
            motions[name] = _motion(clock.local(table['received']), table, geometry)
        else:
            motions[name] = _motion(table['stamp'] - clock.origin, table, geometry)
    return Run(
        duration=recording.duration,
        topics=topics,
        absent=_absent(topics),
        namespaces=namespaces,
        geometry=geometry,
        motions=motions,
        numbers=numbers,
        receipts={name: table['received'] for name, table in raw.items()},
        timing={
            name: _timing(table)
            for name, table in raw.items()
            if table['stamp'].size > 2 and name != 'reference/signals'  # sent when it changes
        },
        switches=_switches(numbers, motions.get(REFERENCE)),
        lead=clock.lead,
        complaints=_complaints(recording, namespaces[0]),
        notes=tuple(notes),
    )


def find_topics(
    names: Iterable[str], namespace: str | None = None
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return full names by relative names, and the namespaces there are, the chosen one first.

    A topic belongs to the longest known name it ends with, so ``/a/ground_truth/odom`` is never
    taken for the ``odom`` of ``/a/ground_truth``. Without ``namespace`` the one with the most
    known topics is chosen.
    """
    found: dict[str, dict[str, str]] = {}
    for full in names:
        known = [name for name in NAMES if full.endswith(f'/{name}')]
        if known:
            name = max(known, key=len)
            found.setdefault(full[: -len(name) - 1], {})[name] = full
    order = sorted(found, key=lambda space: (-len(found[space]), space))
    if namespace is not None:
        chosen = '/' + namespace.strip('/') if namespace.strip('/') else ''
        order = [chosen, *(space for space in order if space != chosen)]
    order = order or ['']
    return found.get(order[0], {}), tuple(order)


class _Clock:
    """Brings times of receipt and stamps onto one axis.

    Messages without a header are placed by their receipt. Where the robot lives in simulated
    time, the odometry, which has both, tells how the clocks lie to each other.
    """

    def __init__(self, raw: Mapping[str, Mapping[str, Array]], notes: list[str]) -> None:
        self.origin = 0.0
        self._received, self._offset = np.zeros(1), np.zeros(1)
        table = raw.get(ODOMETRY) or raw.get(TRUTH)
        if table:
            offset = table['stamp'] - table['received']
            if abs(float(np.median(offset))) > 1.0:
                self._received, self._offset = table['received'], offset
                self.origin = float(table['stamp'].min())
                notes.append(
                    'The stamps are of another clock than the receipts (simulated time?); '
                    'messages without a stamp were placed through the odometry.'
                )
        self.lead = 0.0
        if REFERENCE in raw:
            ahead = raw[REFERENCE]['stamp'] - self.origin - self.local(raw[REFERENCE]['received'])
            self.lead = max(0.0, float(np.median(ahead)))

    def local(self, received: Array) -> Array:
        """Return the time of what was received then."""
        return received + np.interp(received, self._received, self._offset) - self.origin

    def applies(self, received: Array) -> Array:
        """Return the time for which the reference node said something it sent then."""
        return self.local(received) + self.lead


def _read(recording: Recording, name: str, topic: str, notes: list[str]) -> dict[str, Array]:
    """Return the arrays of one topic, without the rows that are not finite."""
    if name == COMMAND:
        inner = 'twist.' if recording.topics[topic].type_name.endswith('Stamped') else ''
        fields = {'linear': f'{inner}linear.x', 'angular': f'{inner}angular.z'}
    elif name == 'reference/signals':
        fields = {f'{i}': f'data[{i}]' for i in range(3)}
    else:
        fields = {'value': 'data'} if name in NUMBERS else _ODOMETRY_FIELDS
    table = recording.series(topic, fields)
    sound = np.all([np.isfinite(column) for column in table.values()], axis=0)
    if not sound.all():
        notes.append(f'{np.count_nonzero(~sound)} messages of {topic} held a number that is not '
                     'finite; they are left out.')  # fmt: skip
    return {key: column[sound] for key, column in table.items()}


def _motion(time: Array, table: Mapping[str, Array], geometry: Geometry) -> Series:
    """Return a motion in order of time; of two at one instant the one that came last."""
    time, back = np.unique(time[::-1], return_index=True)
    order = table['linear'].size - 1 - back
    linear: Any = table['linear'][order]
    angular: Any = table['angular'][order]
    wheels: Any = wheels_from_body(BodyTwist(linear, angular), geometry)
    values = {'linear': linear, 'angular': angular, 'right': wheels.right, 'left': wheels.left}
    if 'x' in table:
        heading = 2.0 * np.arctan2(table['z'], table['w'])
        values |= {'x': table['x'][order], 'y': table['y'][order], 'heading': heading[order]}
    return Series(time, values)


def _timing(table: Mapping[str, Array]) -> Timing:
    gaps = np.diff(table['received'])
    period = float(np.median(gaps))
    # The stamps know the rate better than the receipts, which jitter.
    steps = np.diff(np.unique(table['stamp'][np.isfinite(table['stamp'])]))
    grid = float(np.median(steps)) if steps.size else 0.0
    missing = missing_share(table['stamp'], 1.0 / grid) if grid > 0.0 else math.nan
    jitter = round(float(np.percentile(np.abs(gaps - period), 99.0)), 9)  # receipts are in ns
    return Timing(int(table['received'].size), period, jitter, missing)


def _switches(numbers: Mapping[str, Series], reference: Series | None) -> Array:
    """Return when what drives the reference changed, each moved to the jump it caused.

    The mode may be published at a lower rate than the reference, so the stamp of the largest
    step of the reference within a quarter of a second is taken.
    """
    times: set[float] = set()
    for name in SIGNALS:
        if name in numbers:
            series = numbers[name]
            changed = np.flatnonzero(np.diff(series['value'])) + 1
            times |= set(series.time[changed].tolist())
    found = set()
    for time in times:
        if reference is not None and len(reference) > 1:
            near = np.flatnonzero(np.abs(reference.time[1:] - time) < 0.25)
            if near.size:
                step = sum(np.abs(np.diff(reference[wheel]))[near] for wheel in WHEELS)
                time = float(reference.time[1:][near[np.argmax(step)]])
        found.add(time)
    return np.array(sorted(found), dtype=np.float64)


def _geometry(details: Mapping[str, Mapping[str, str]], notes: list[str]) -> Geometry:
    """Return the lengths the recorded settings give; the robot's own word first."""
    order = sorted(details, key=lambda title: title not in ('sim_robot', 'radio_bridge', 'robot'))
    values: dict[str, object] = {}
    for title in order:
        for key, text in details[title].items():
            name = key.rpartition('.')[2]
            if name in ('wheel_radius', 'wheel_separation') and name not in values:
                try:
                    values[name] = float(text)
                except ValueError:
                    notes.append(f'The recorded {key} is no number: {text!r}.')
    try:
        geometry = Geometry.from_flat(values)
    except SettingError as error:
        notes.append(f'The recorded geometry cannot be used: {error}.')
        values, geometry = {}, Geometry()
    if len(values) < 2:
        notes.append(
            f'The bag does not say how large the wheels are; {geometry.wheel_radius:g} m radius '
            f'and {geometry.wheel_separation:g} m apart are assumed.'
        )
    return geometry


def _absent(topics: Mapping[str, str]) -> tuple[str, ...]:
    names = set(NAMES) - set(topics)
    # One topic announces the signals, or three do; of the three the bag may hold a part.
    names -= (
        set(SIGNALS)
        if names >= set(SIGNALS) or 'reference/signals' in topics
        else {'reference/signals'}
    )
    return tuple(name for name in NAMES if name in names)


def _complaints(recording: Recording, namespace: str) -> tuple[tuple[float, str, str, str], ...]:
    """Return each distinct warning or error of the diagnostics, when it came first."""
    found: dict[tuple[str, str, str], float] = {}
    for topic in {'/diagnostics', f'{namespace}/diagnostics'} & set(recording.topics):
        if not recording.topics[topic].type_name.endswith('DiagnosticArray'):
            continue
        for received, message in recording.messages(topic):
            for status in message.status:
                level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
                if level:
                    word = {1: 'warning', 2: 'error', 3: 'stale'}.get(level, str(level))
                    found.setdefault((word, status.name, status.message), received)
    return tuple((when, *key) for key, when in sorted(found.items(), key=lambda item: item[1]))
