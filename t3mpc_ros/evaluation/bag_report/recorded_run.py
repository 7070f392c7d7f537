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
"""Data of a recorded run: motions, commands and control terms on one time axis."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.bag.columns import CDR_LAYOUTS, TopicColumns, read_columns
from t3mpc_ros.bag.errors import DataError
from t3mpc_ros.bag.reader import BagReader, missing_sample_ratio
from t3mpc_ros.bag.recording_metadata import lost_spans
from t3mpc_ros.control.controller import WHEELS
from t3mpc_ros.evaluation.bag_report import diagnostic_history
from t3mpc_ros.evaluation.bag_report.motion_continuity import (
    DISPLACED,
    DISPLACED_TURN,
    MIN_JUMPS,
    MIXED_SHARE,
    MIXED_STEP,
    alternate,
    continuity_notes,
    gaps,
    other_units,
    pose_jumps,
)
from t3mpc_ros.evaluation.process_replay.controller_replay import recompute_scalars
from t3mpc_ros.evaluation.topic_roles import (
    COMMAND,
    JOURNAL,
    KINDS,
    NAMES,
    ODOMETRY,
    REFERENCE,
    SCALARS,
    SIGNALS,
    TRUTH,
    ReportOptions,
    TopicChoice,
    choose_topics,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, Array, BodyTwist
from t3mpc_ros.parameters.table import ParameterError

_ODOMETRY_FIELDS = {
    'x': 'pose.pose.position.x',
    'y': 'pose.pose.position.y',
    'about x': 'pose.pose.orientation.x',
    'about y': 'pose.pose.orientation.y',
    'z': 'pose.pose.orientation.z',
    'w': 'pose.pose.orientation.w',
    'linear': 'twist.twist.linear.x',
    'angular': 'twist.twist.angular.z',
    'lateral': 'twist.twist.linear.y',
}
SIGNAL_NAMES = ('mode', 'signal of the right wheel', 'signal of the left wheel')
"""Numbers of the topic of signals."""
_TWIST_FIELDS = {'linear': 'linear.x', 'angular': 'angular.z'}
SWITCH_WINDOW = 0.25
"""Largest time from a change of the signals to the step of the reference, s."""
JUMP = 10.0
"""Jump (s) of the stamps against the receive times that indicates a changed clock."""
MIN_APART, MIN_OVERLAP = 0.1, 5.0
"""Least difference of two clocks that counts, and least time in which motions are compared, s."""
CORRECTED = 0.5
"""Distance of the odometry from its reference with corrected stamps, as a share of that with its
own, below which these are of another clock. With stamps 1 s off it is 0.08, 0.2 s off 0.31."""
POSE_WINDOW = 0.2
"""Least time over which the pose of an odometry without a twist is differentiated, s."""
MOST = 0.98
"""Share of finite messages above which a verdict does not mention the others."""


class Channel(NamedTuple):
    """One of the two quantities that represent a motion."""

    name: str
    """Key in :attr:`Run.motions`."""
    title: str
    short: str
    unit: str


BY_WHEEL = (
    Channel('right', 'right wheel', 'right', 'rad/s'),
    Channel('left', 'left wheel', 'left', 'rad/s'),
)
BY_BODY = (
    Channel('linear', 'forward speed', 'forward', 'm/s'),
    Channel('angular', 'turn rate', 'turning', 'rad/s'),
)
"""Channels of a robot without known wheel geometry."""


@dataclass(frozen=True)
class Series:
    """One quantity over time: ``values[name]`` over ``time``, in seconds and SI units."""

    time: Array
    values: Mapping[str, Array]

    def __getitem__(self, name: str) -> Array:
        return self.values[name]

    def __len__(self) -> int:
        return int(self.time.size)

    def held(self, name: str, time: Array) -> Array:
        """Return the last value up to each time, before the first one that; shape (n,)."""
        rows = np.searchsorted(self.time, time, 'right') - 1
        return self.values[name][np.maximum(rows, 0)]

    def between(self, low: float, high: float) -> 'Series':
        """Return the samples from ``low`` to ``high``, s."""
        part = slice(*np.searchsorted(self.time, [low, np.nextafter(high, np.inf)]).tolist())
        return Series(self.time[part], {name: each[part] for name, each in self.values.items()})


def moves(command: Series) -> NDArray[np.bool_]:
    """Return which commands are other than zero, shape (n,)."""
    moving: NDArray[np.bool_] = (command['linear'] != 0.0) | (command['angular'] != 0.0)
    return moving


@dataclass(frozen=True)
class Timing:
    """Regularity of one topic."""

    count: int
    period: float
    """Median interval between receive times, s."""
    jitter: float
    """99th percentile of the deviation of an interval from the median, s."""
    missing: float
    """Share of samples missing at the median rate of the stamps, outside of gaps."""


@dataclass(frozen=True)
class Run:
    """A recorded run, ready for metrics and figures; times in seconds since its start."""

    duration: float
    topics: Mapping[str, str]
    """Full name by relative name, of topics with at least one message."""
    absent: tuple[str, ...]
    """Relative names that are missing in the bag or have no message."""
    namespaces: tuple[str, ...]
    """The namespace shown, then the others in the bag."""
    ours: bool
    """Whether the bag holds more than any robot's: a reference, or control terms."""
    geometry: WheelGeometry | None
    """None without wheel geometry."""
    channels: tuple[Channel, Channel]
    """Channels of the motions: wheels with known geometry, else linear and angular speed."""
    motions: Mapping[str, Series]
    """``reference``, ``odom``, ``ground_truth/odom``, ``cmd_vel``: linear, angular (m/s, rad/s),
    right, left (rad/s) where the wheels are known, and of odometry x, y (m), yaw (rad) and
    lateral (m/s)."""
    numbers: Mapping[str, Series]
    """Scalar topics by relative name and the signals by :data:`SIGNAL_NAMES`, as ``value``."""
    receipts: Mapping[str, Array]
    """Receive times by relative name, by the recorder's clock."""
    timing: Mapping[str, Timing]
    switches: Array
    lead: float
    """Median lead (s) of the reference stamps over their receive times."""
    complaints: tuple[diagnostic_history.DiagnosticEvent, ...]
    """From diagnostics: first time, level, node, text."""
    changes: tuple[diagnostic_history.DiagnosticEvent, ...]
    """Likewise, each time that a node got worse."""
    links: tuple[diagnostic_history.LinkHistory, ...]
    oddities: tuple[str, ...]
    """Sentences on what is unusual in the bag, and what was done about it."""
    remarks: tuple[str, ...]
    """Sentences on where the data come from."""
    reports: Array = field(default_factory=lambda: np.empty(0))
    """Receive times of diagnostics."""
    lost: tuple[tuple[float, float], ...] = ()
    """Start and end of each part of the recording that a recovery could not read."""
    doubts: tuple[str, ...] = ()
    """Those of the oddities that concern the numbers of the messages."""
    damage: Mapping[str, str] = field(default_factory=dict)
    """Oddities because of which the numbers cannot be trusted, in short, and their remedies."""
    untrusted: tuple[str, ...] = ()
    """Relative names of topics of which nothing that is measured is valid."""
    world: str = ''
    """Name of the simulated world; empty if unknown."""
    follows_path: bool = False
    """Whether the controller follows the poses of the reference, not its speeds."""
    map_changes: tuple[diagnostic_history.RecordedChange, ...] = ()
    behind: float = 0.0
    """By how much the stamps of the odometry are behind those of the reference, if both are of
    different clocks, s; else 0."""
    publishers: Mapping[str, bool] = field(default_factory=dict)
    """Sentences on motions with several publishers, and whether several are seen to publish."""
    other_clock: bool = False
    """Whether the stamps are of another clock than the receive times, as with simulated time."""
    parameters: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    """Recorded parameters by node."""

    @property
    def measured(self) -> str:
        """Relative name of the motion that errors refer to: ground truth where recorded."""
        return next((name for name in (TRUTH, ODOMETRY) if name in self.motions), '')

    @property
    def motion(self) -> Series | None:
        """The measured motion; None without one, or where nothing of it is valid."""
        return None if self.measured in self.untrusted else self.motions.get(self.measured)


def load_run(recording: BagReader, wanted: ReportOptions | None = None) -> Run:
    """Return the run in ``recording``; of the fullest namespace unless one is given."""
    wanted = wanted or ReportOptions()
    choice = choose_topics(recording, wanted)
    topics = choice.topics
    notes = [*choice.notes]
    oddities, damage = _oddities_of_bag(recording, choice)
    records = recording.metadata_records
    geometry = geometry_of(records, wanted, choice.ours, notes)
    columns = _columns(recording, topics.values())
    raw, receipts, doubts, untrusted = {}, dict[str, Array](), list[str](), []
    for name, topic in topics.items():
        raw[name], receipts[name], found = _read(
            recording, name, topic, columns.get(topic), oddities, doubts
        )
        if found:
            damage |= found
            untrusted.append(name)
            oddities += [f'{text}.' for text in found]
    oddities += doubts
    raw = {name: table for name, table in raw.items() if table['stamp'].size}
    clock = _Clock(raw, oddities)
    scalars = _recomputed_scalars(recording, choice, notes)
    motions, numbers = _on_one_axis({**raw, **scalars}, clock, geometry)
    without_twist = _differentiate_poses(motions, topics, geometry)
    doubts += without_twist
    oddities += without_twist
    oddities += _oddities_of_motions(topics, raw, motions)
    complaints, changes, links, reports = diagnostic_history.read_diagnostics(
        recording, choice.namespaces[0]
    )
    expected = NAMES if choice.ours else (REFERENCE, ODOMETRY, COMMAND)
    return Run(
        duration=recording.duration,
        topics=topics,
        absent=tuple(name for name in expected if name not in {*topics, *scalars}),
        namespaces=choice.namespaces,
        ours=choice.ours,
        geometry=geometry,
        channels=BY_BODY if geometry is None else BY_WHEEL,
        motions=motions,
        numbers=numbers,
        receipts={name: receipts[name] for name in raw},
        timing={
            name: _timing(table)
            for name, table in raw.items()
            if table['stamp'].size > 2 and name != SIGNALS  # sent on change only
        },
        switches=_switches(numbers, motions.get(REFERENCE)),
        lead=clock.lead,
        complaints=tuple(complaints),
        changes=tuple(changes),
        links=tuple(links),
        reports=reports,
        lost=tuple(
            ((low - recording.start_ns) / NANOSECONDS, (high - recording.start_ns) / NANOSECONDS)
            for low, high in lost_spans(records)
        ),
        oddities=tuple(dict.fromkeys(oddities)),
        remarks=tuple(notes),
        doubts=tuple(doubts),
        damage=damage,
        untrusted=tuple(untrusted),
        world=records.get('sim_robot', {}).get('world', ''),
        map_changes=diagnostic_history.read_map_changes(
            recording, choice.namespaces[0], clock.local
        ),
        behind=_behind(raw, motions),
        publishers=_publishers(recording, topics, motions, complaints),
        other_clock=clock.other,
        parameters=records,
        follows_path=records.get('controller', {}).get('pose.enabled', '').lower() == 'true',
    )


def _on_one_axis(
    tables: Mapping[str, Mapping[str, Array]], clock: '_Clock', geometry: WheelGeometry | None
) -> tuple[dict[str, Series], dict[str, Series]]:
    """Return the motions by relative name, and the numbers; see :class:`Run`."""
    motions: dict[str, Series] = {}
    numbers: dict[str, Series] = {}
    for name, table in tables.items():
        if name == SIGNALS:
            time = clock.local(table['received']) + clock.lead  # for which they were sent
            numbers |= {key: Series(time, {'value': table[key]}) for key in SIGNAL_NAMES}
        elif name in SCALARS:
            numbers[name] = Series(clock.local(table['received']), {'value': table['value']})
        elif name == COMMAND or 'x' not in table:
            motions[name] = _motion(clock.local(table['received']), table, geometry)
        else:
            motions[name] = _motion(table['stamp'] - clock.origin, table, geometry)
    return motions, numbers


def _differentiate_poses(
    motions: dict[str, Series], topics: Mapping[str, str], geometry: WheelGeometry | None
) -> list[str]:
    """Replace the speeds of a motion without a twist by those of its pose; return sentences."""
    found = []
    for name in motions:
        if name in (ODOMETRY, TRUTH) and _lacks_twist(motions[name]):
            motions[name] = _differentiated(motions[name], geometry)
            text = f'The twist of {topics[name]} is zero while its pose moves'
            found.append(f'{text}: its speeds are those of the pose.')
    return found


def _oddities_of_bag(
    recording: BagReader, choice: TopicChoice
) -> tuple[list[str], dict[str, str]]:
    """Return sentences on the bag as a whole, and damage in short with its remedy."""
    found, damage = [], {}
    if recording.incomplete_files:
        listed = ', '.join(recording.incomplete_files)
        found.append(
            f'Truncated or unfinished files, not read: {listed} (t3mpc bag recover writes their '
            'messages to a new bag).'
        )
        text = 'files of the bag are truncated or unfinished, and were not read'
        damage[text] = '`t3mpc bag recover` writes their messages to a new bag.'
    if recording.storage == 'ROS 1':
        found.append('This is a bag of ROS 1: it holds no quality of service.')
    if len(choice.namespaces) > 1:
        others = ', '.join(space or '/' for space in choice.namespaces[1:])
        found.append(
            f'The bag also holds topics of {others}: another robot, or a part of this one in '
            'another namespace (--namespace chooses).'
        )
    space = choice.namespaces[0]
    for name in (ODOMETRY, TRUTH, REFERENCE, COMMAND):
        topic = recording.topics.get(f'{space}/{name}')
        if topic is None or topic.name in choice.topics.values() or not topic.message_count:
            continue
        if topic.type_name not in KINDS[name]:
            wanted = ' or '.join(KINDS[name])
            found.append(f'{topic.name} is {topic.type_name}, not {wanted}: it is not used.')
    for topic_name in choice.topics.values():
        count = len(recording.topics[topic_name].offered_qos_profiles)
        if count > 1:
            found.append(f'{topic_name} has {count} publishers.')
    return found, damage


def _publishers(
    recording: BagReader,
    topics: Mapping[str, str],
    motions: Mapping[str, Series],
    complaints: Iterable[diagnostic_history.DiagnosticEvent],
) -> dict[str, bool]:
    """Return the topics of motions with several publishers; see :attr:`Run.publishers`.

    That several publish is seen by a node which receives both, or from commands that alternate
    and are more than one to a message of odometry: a controller may alternate as well.
    """
    found: dict[str, bool] = {}
    for name in motions:
        count = len(recording.topics[topics[name]].offered_qos_profiles)
        seen = [
            text.partition(f'{topics[name]} has ')[2].split(' ')[0]
            for *_, text in complaints
            if f'{topics[name]} has ' in text
            and 'stop all but one' in text
            and 'one that was killed' not in text
        ]
        if seen or count > 1:
            found[f'{topics[name]} has {max(seen, default=str(count))} publishers'] = bool(seen)
    command, odometry = motions.get(COMMAND), motions.get(ODOMETRY)
    if found or command is None or len(command) <= 1.5 * len(odometry or ()):
        return found
    if alternate(np.column_stack([command['linear'], command['angular']])):
        found[f'{topics[COMMAND]} holds the commands of two publishers in turn'] = True
    return found


def _oddities_of_motions(
    topics: Mapping[str, str],
    raw: Mapping[str, Mapping[str, Array]],
    motions: Mapping[str, Series],
) -> list[str]:
    """Return sentences on motions that are constant, or of one message."""
    found = []
    for name, table in raw.items():
        if name not in (ODOMETRY, TRUTH, COMMAND, REFERENCE):
            continue
        count = table['stamp'].size
        if count == 1:
            found.append(f'{topics[name]} has a single message: nothing follows from it.')
        elif not moves(motions[name]).any():
            found.append(
                f'Every speed of {topics[name]} is zero in all {count} messages: the robot stood, '
                'or it is not connected.'
            )
    return found


def _recomputed_scalars(
    recording: BagReader, choice: TopicChoice, notes: list[str]
) -> dict[str, dict[str, Array]]:
    """Return the scalars of the controller if the bag holds its journal instead of them."""
    namespace = choice.namespaces[0]
    journal = recording.topics.get(f'{namespace}/{JOURNAL}')
    if journal is None or not journal.message_count or SCALARS & choice.topics.keys():
        return {}
    try:
        found, inputs = recompute_scalars(recording, namespace)
    except (RuntimeError, ValueError) as error:
        notes.append(
            f'The terms of the controller cannot be recomputed from its journal: {error}.'
        )
        return {}
    text = 'The terms of the controller were recomputed from its journal'
    inexact = np.flatnonzero(~inputs.exact)
    if inexact.size:
        text += (
            f'; from {inputs.time[inexact[0]]:.1f} s on they are approximate, because inputs of '
            'the controller are missing'
        )
    notes.append(f'{text}.')
    return {name: table for name, table in found.items() if table['value'].size}


class _Clock:
    """Maps receive times and stamps onto one time axis.

    Messages without a header are placed by their receive time. With simulated time, the odometry,
    which has both times, relates the two clocks.
    """

    def __init__(self, raw: Mapping[str, Mapping[str, Array]], notes: list[str]) -> None:
        self.origin = 0.0
        self.other = False
        """Whether the stamps are of another clock than the receive times."""
        self._received, self._offset = np.zeros(1), np.zeros(1)
        table = raw.get(ODOMETRY) or raw.get(TRUTH)
        if table:
            offset = table['stamp'] - table['received']
            if abs(float(np.median(offset))) > 1.0 or np.ptp(offset) > JUMP:
                self.other = True
                self._received, self._offset = table['received'], offset
                self.origin = float(table['stamp'].min())
                notes.append(
                    'The stamps are of another clock than the receive times (simulated time?); '
                    'messages without a stamp were placed by means of the odometry.'
                )
        self.lead = 0.0
        if REFERENCE in raw:
            ahead = raw[REFERENCE]['stamp'] - self.origin - self.local(raw[REFERENCE]['received'])
            self.lead = max(0.0, float(np.median(ahead)))

    def local(self, received: Array) -> Array:
        """Return the stamp time of a receive time."""
        return received + np.interp(received, self._received, self._offset) - self.origin


def _behind(raw: Mapping[str, Mapping[str, Array]], motions: Mapping[str, Series]) -> float:
    """Return how far stamps of odometry are behind the reference; see :attr:`Run.behind`.

    They are as far before their receipt, which a slow transport is as well; but then the robot
    follows at the time of the stamps, and not far better by so much later.
    """
    odometry, reference = motions.get(ODOMETRY), motions.get(REFERENCE)
    if odometry is None or reference is None:
        return 0.0
    apart = float(np.median(raw[ODOMETRY]['received'] - raw[ODOMETRY]['stamp']))
    if abs(apart) < MIN_APART:
        return 0.0
    stamped, corrected = (_distance(odometry, reference, by) for by in (0.0, apart))
    return apart if corrected < CORRECTED * stamped else 0.0


def _distance(odometry: Series, reference: Series, by: float) -> float:
    """Return the RMS distance of two motions, the first one later by ``by`` s, as a share."""
    part = odometry.between(float(reference.time[0]) - by, float(reference.time[-1]) - by)
    if not len(part) or part.time[-1] - part.time[0] < MIN_OVERLAP:
        return math.inf
    squares = 0.0
    for name in ('linear', 'angular'):
        wanted = np.interp(part.time + by, reference.time, reference[name])
        size = float(np.mean(wanted**2))
        squares += float(np.mean((part[name] - wanted) ** 2)) / size if size else 0.0
    return math.sqrt(squares)


def _columns(recording: BagReader, topics: Iterable[str]) -> Mapping[str, TopicColumns]:
    """Return the topics that can be read at once; none where a message has another layout."""
    simple = [
        topic
        for topic in topics
        if recording.topics[topic].type_name in CDR_LAYOUTS
        and recording.topics[topic].message_count
    ]
    try:
        return read_columns(recording, simple)
    except DataError:
        return {}  # of another encoding: each message is decoded


def _read(
    recording: BagReader,
    name: str,
    topic: str,
    column: TopicColumns | None,
    notes: list[str],
    doubts: list[str],
) -> tuple[dict[str, Array], Array, dict[str, str]]:
    """Return the arrays of one topic, and why nothing of it is valid, if so, with the remedy.

    Rows that are not finite are left out, but for the receive times between both.
    """
    kind = recording.topics[topic].type_name
    fields = _fields(name, kind)
    if column is None:
        table = recording.series(topic, fields)
    else:
        stamps = column.stamps_ns if CDR_LAYOUTS[kind].stamped else column.received_ns
        instants = {'received': column.received_ns, 'stamp': stamps}
        table = {key: (each - recording.start_ns) / NANOSECONDS for key, each in instants.items()}
        table |= dict(zip(fields, column.numbers.T, strict=True))
    received = table['received']
    sound = np.all([np.isfinite(values) for values in table.values()], axis=0)
    if not sound.all():
        text = f'{np.count_nonzero(~sound)} messages of {topic} hold a number that is not finite'
        (notes if np.mean(sound) > MOST else doubts).append(f'{text}; they are excluded.')
    table = {key: values[sound] for key, values in table.items()}
    if fields is not _ODOMETRY_FIELDS:
        return table, received, {}
    return table, received, _damage_of_odometry(name, topic, table, notes, doubts)


def _fields(name: str, kind: str) -> dict[str, str]:
    """Return the fields of the messages of a type that a relative name needs, by key."""
    if kind.endswith(('/Twist', '/TwistStamped')):
        inner = 'twist.' if kind.endswith('Stamped') else ''
        return {key: inner + field for key, field in _TWIST_FIELDS.items()}
    if name == SIGNALS:
        return {signal: f'data[{i}]' for i, signal in enumerate(SIGNAL_NAMES)}
    return {'value': 'data'} if name in SCALARS else _ODOMETRY_FIELDS


def _damage_of_odometry(
    name: str, topic: str, table: dict[str, Array], notes: list[str], doubts: list[str]
) -> dict[str, str]:
    """Return why nothing of an odometry is valid, if so, with the remedy; mend its stamps."""
    times = table['received'], table['stamp']
    places = np.stack([table['x'], table['y']], axis=1)
    notes += continuity_notes(topic, *times, places, table['linear'])
    jumps = pose_jumps(table['stamp'], places, table['linear'], MIXED_STEP)
    often = len(jumps) > max(MIN_JUMPS, MIXED_SHARE * len(places))
    _mend_stamps(table, topic, notes, doubts)
    turned = [table.pop(key) for key in ('about x', 'about y')] + [table['z'], table['w']]
    blind = np.count_nonzero(~np.any(turned, axis=0))
    if often:
        text = (
            f'The position of {topic} jumps between its messages: several robots publish it, '
            'or its pose disagrees with its twist; nothing measured from it is valid'
        )
        return {text: 'Give each robot a namespace, or correct the units in its driver.'}
    if name == REFERENCE:
        return {}
    if blind:
        doubts.append(
            f'{blind} of {places.shape[0]} quaternions of {topic} are zero: its direction is '
            'not known there.'
        )
        return {}
    poses = np.column_stack([places, _yaw(table)])
    twists = np.column_stack([table['linear'], table['angular']])
    if example := other_units(table['stamp'], poses, twists):
        text = (
            f'The twist of {topic} cannot be in m/s and rad/s: {example}; nothing '
            'measured from it is valid'
        )
        return {text: 'Correct the units in its driver, or see why wheels spin.'}
    return {}


def _yaw(table: Mapping[str, Array]) -> Array:
    """Return the yaw (rad) of the poses of a robot in the plane."""
    return 2.0 * np.arctan2(table['z'], table['w'])


def _mend_stamps(table: dict[str, Array], topic: str, notes: list[str], doubts: list[str]) -> None:
    """Replace stamps that are unusable by receive times."""
    received, stamps = table['received'], table['stamp']
    if stamps.size > 2 and np.unique(stamps).size < 0.5 * np.unique(received).size:
        table['stamp'] = received
        doubts.append(
            f'The stamps of {topic} are constant; its messages were placed by receive time.'
        )
        return
    steps, waits = np.diff(stamps), np.diff(received)
    if leaps := np.flatnonzero((steps < -JUMP) | (steps > waits + JUMP)).tolist():
        table['stamp'] = received
        notes.append(
            f'The stamps of {topic} leap by {steps[leaps[0]]:.1f} s at '
            f'{received[leaps[0]]:.1f} s'
            f'{f", the first of {len(leaps)} leaps" if len(leaps) > 1 else ""}: a clock was set; '
            'its messages were placed by receive time.'
        )
    if late := np.count_nonzero((steps < 0.0) & (steps >= -JUMP)):
        notes.append(f'{late} messages of {topic} were out of order; they were sorted.')


def _motion(time: Array, table: Mapping[str, Array], geometry: WheelGeometry | None) -> Series:
    """Return a motion sorted by time; of two samples at one instant the last one."""
    time, back = np.unique(time[::-1], return_index=True)
    order = table['linear'].size - 1 - back
    values = _speeds(table['linear'][order], table['angular'][order], geometry)
    if 'x' in table:
        yaw = _yaw(table)
        values |= {name: table[name][order] for name in ('x', 'y', 'lateral')}
        values['yaw'] = yaw[order]
    return Series(time, values)


def _speeds(linear: Any, angular: Any, geometry: WheelGeometry | None) -> dict[str, Array]:
    """Return speeds (m/s, rad/s) with those of the wheels where these are known."""
    values = {'linear': linear, 'angular': angular}
    if geometry is not None:
        wheels: Any = wheels_from_twist(BodyTwist(linear, angular), geometry)
        values |= {'right': wheels.right, 'left': wheels.left}
    return values


def _lacks_twist(motion: Series) -> bool:
    """Return whether every twist is zero although the pose is elsewhere later."""
    axes = ((motion['x'], DISPLACED), (motion['y'], DISPLACED), (motion['yaw'], DISPLACED_TURN))
    far = (np.ptp(np.unwrap(each)) > most for each, most in axes)
    return not moves(motion).any() and any(far)


def _differentiated(motion: Series, geometry: WheelGeometry | None) -> Series:
    """Return a motion whose speeds are the change of its pose within :data:`POSE_WINDOW`."""
    time, yaw = motion.time, np.unwrap(motion['yaw'])
    half = max(0.5 * POSE_WINDOW, 1.5 * float(np.median(np.diff(time))))
    first = np.searchsorted(time, time - half)
    last = np.searchsorted(time, time + half, 'right') - 1
    elapsed = np.maximum(time[last] - time[first], 1e-9)  # one alone does not move
    x, y, turn = (each[last] - each[first] for each in (motion['x'], motion['y'], yaw))
    middle = 0.5 * (yaw[first] + yaw[last])
    linear = (np.cos(middle) * x + np.sin(middle) * y) / elapsed
    return Series(time, {**motion.values, **_speeds(linear, turn / elapsed, geometry)})


def _timing(table: Mapping[str, Array]) -> Timing:
    waits = np.diff(table['received'])
    period = float(np.median(waits))
    # The rate follows from the stamps: receive times jitter.
    stamps = np.unique(table['stamp'][np.isfinite(table['stamp'])])
    steps = np.diff(stamps)
    grid = float(np.median(steps)) if steps.size else 0.0
    # Gaps are reported by themselves: else one of a month would make everything missing.
    closed = np.where(np.isin(stamps[:-1], [low for low, _ in gaps(stamps)]), grid, steps)
    stamps = np.concatenate([[0.0], np.cumsum(closed)])
    missing = missing_sample_ratio(stamps, 1.0 / grid) if grid > 0.0 else math.nan
    jitter = round(float(np.percentile(np.abs(waits - period), 99.0)), 9)  # receipts are in ns
    return Timing(int(table['received'].size), period, jitter, missing)


def _switches(numbers: Mapping[str, Series], reference: Series | None) -> Array:
    """Return the times of the switches, each moved to the jump it caused.

    The mode may be published at a lower rate than the reference, so the stamp of the largest
    step of the reference within a quarter of a second is taken.
    """
    times: set[float] = set()
    for series in (numbers[name] for name in SIGNAL_NAMES if name in numbers):
        times |= set(series.time[1:][np.diff(series['value']) != 0.0].tolist())
    found = set()
    for time in times:
        if reference is not None and len(reference) > 1:
            near = np.flatnonzero(np.abs(reference.time[1:] - time) < SWITCH_WINDOW)
            if near.size:
                step = sum(np.abs(np.diff(reference[wheel]))[near] for wheel in WHEELS)
                time = float(reference.time[1:][near[np.argmax(step)]])
        found.add(time)
    return np.array(sorted(found), dtype=np.float64)


def geometry_of(
    metadata_records: Mapping[str, Mapping[str, str]],
    wanted: ReportOptions,
    ours: bool,
    notes: list[str],
) -> WheelGeometry | None:
    """Return the given geometry, else the recorded parameters, else None.

    The parameters of the robot's node take precedence. A bag of this package without them is
    assumed to be of the default robot.
    """
    order = sorted(
        metadata_records, key=lambda title: title not in ('sim_robot', 'radio_bridge', 'robot')
    )
    given = {'wheel_radius': wanted.wheel_radius, 'wheel_separation': wanted.track}
    values: dict[str, object] = {key: value for key, value in given.items() if value is not None}
    for title in order:
        for key, text in metadata_records[title].items():
            name = key.rpartition('.')[2]
            if name in given and name not in values:
                try:
                    values[name] = float(text)
                except ValueError:
                    notes.append(f'The recorded {key} is not a number: {text!r}.')
    explicit = wanted.wheel_radius is not None or wanted.track is not None
    try:
        geometry = WheelGeometry.from_dict(values)
    except ParameterError as error:
        if explicit:
            raise
        notes.append(f'The recorded geometry cannot be used: {error}.')
        values, geometry = {}, WheelGeometry()
    if len(values) == len(given):
        return geometry
    if not ours:
        notes.append(
            'The bag holds no wheel radius and separation: speeds are those of '
            'the robot, in m/s and rad/s (--wheel-radius and --track give those of the wheels).'
        )
        return None
    notes.append(
        f'The bag holds no wheel geometry; {geometry.wheel_radius:g} m radius '
        f'and {geometry.wheel_separation:g} m apart are assumed.'
    )
    return geometry
