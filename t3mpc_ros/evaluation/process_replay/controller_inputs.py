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
"""Recorded inputs of a controller, in the order of its journal."""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
import math
from pathlib import Path
import tempfile
import zlib

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.bag.columns import TopicColumns, read_columns
from t3mpc_ros.bag.controller_input_journal import COMMAND_EVENTS, Event, parameters_from_json
from t3mpc_ros.bag.reader import BagReader, open_bag
from t3mpc_ros.bag.recording_metadata import message_loss_notes
from t3mpc_ros.control.controller import SCALAR_NAMES, ControllerParameters
from t3mpc_ros.evaluation import topic_roles
from t3mpc_ros.evaluation.topic_roles import COMMAND, JOURNAL, ODOMETRY, REFERENCE
from t3mpc_ros.geometry.types import NANOSECONDS, Array, StateArray
from t3mpc_ros.model_file import load_model
from t3mpc_ros.parameters.command_line import parse_assignments
from t3mpc_ros.parameters.table import ParameterError

Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]
CONTROLLER = 'controller'
SPEEDS = ('cmd_vel.linear.x', 'cmd_vel.angular.z')
FIELDS = (*SPEEDS, *SCALAR_NAMES)
"""Compared fields, as columns."""
SCALAR_RATE = 20.0
"""Rate of the scalars if the controller published none, or if its parameters are unknown, Hz."""
BEFORE: Mapping[str, object] = {'wheel.deadband_velocity': 0.0}
"""Parameters that bags of earlier versions lack, with the values at which they change nothing,
where the default is another one."""
STEP = int(Event.STEP)  # an enumeration is slower to compare


class ReplayError(RuntimeError):
    """The bag cannot be replayed or compared; the text gives the reason."""


@dataclass(frozen=True)
class ConsumedMessages:
    """Recorded messages by event, as row numbers."""

    odometry: Integers
    """Message of each step; -1 at other events, and where it is missing in the bag, shape (n,)."""
    begin: Integers
    """First reference passed since the previous event, shape (n,)."""
    end: Integers
    """One past the last of them."""
    broken: Flags
    """Whether something is lost between the previous event and this one, shape (n,)."""
    restarts: Flags
    """Whether this is a reset that makes the past irrelevant, shape (n,)."""
    lost: Mapping[str, int]
    """What is lost, and how often."""


@dataclass(frozen=True)
class ControllerSession:
    """Events from one start of the controller node to the next, one row each."""

    first: int
    """Index of its first row over all sessions."""
    rows: Integers
    """The journal, shape (n, 5).

    Columns: :data:`~t3mpc_ros.bag.controller_input_journal.JOURNAL_COLUMNS`.
    """
    taken: ConsumedMessages
    exact: Flags
    """Whether all inputs are in the bag, so that the output must be equal, shape (n,)."""
    parameters: Mapping[int, ControllerParameters]
    """Parameters by revision."""
    start: int
    """Initial revision."""
    model: Mapping[str, Array] | None

    @property
    def events(self) -> Integers:
        """Event kinds, shape (n,)."""
        return self.rows[:, 1]


@dataclass(frozen=True)
class ControllerInputs:
    """Inputs of a recorded controller and its outputs."""

    bag: Path
    odometry: TopicColumns
    references: TopicColumns
    sessions: tuple[ControllerSession, ...]
    time: Array
    """Time of each row, s since the first message of the bag, shape (n,)."""
    recorded: Mapping[str, Array]
    """Recorded outputs by :data:`FIELDS`, NaN where missing, shape (n,) each."""
    commands_ns: Integers
    """Receive time of the command of each row, 0 without one, shape (n,)."""
    start_ns: int
    notes: tuple[str, ...] = ()
    """Remarks for the user."""

    @property
    def events(self) -> Integers:
        """Event kind of each row, shape (n,)."""
        return np.concatenate([session.events for session in self.sessions])

    @property
    def exact(self) -> Flags:
        """Whether the inputs of each row are complete, shape (n,)."""
        return np.concatenate([session.exact for session in self.sessions])

    @property
    def commanding(self) -> Flags:
        """Whether a command was sent at each row, shape (n,)."""
        return np.isin(self.events, COMMAND_EVENTS)


def load_inputs(
    bag: Path, namespace: str | None = None, model: Mapping[str, Array] | None = None
) -> ControllerInputs:
    """Return inputs and outputs of a bag's controller; ``model`` replaces the recorded one."""
    with open_bag(bag) as recording:
        return inputs_of(recording, namespace, model)


def inputs_of(
    recording: BagReader, namespace: str | None = None, model: Mapping[str, Array] | None = None
) -> ControllerInputs:
    """Return inputs and recorded outputs of an open bag, see :func:`load_inputs`."""
    bag = recording.folder
    notes = message_loss_notes(recording.metadata_records)
    choice = topic_roles.choose_topics(recording, topic_roles.ReportOptions(namespace=namespace))
    notes += choice.notes
    prefix = choice.namespaces[0]
    names = {REFERENCE, ODOMETRY, COMMAND, *topic_roles.SCALARS}
    topics = {name: full for name, full in choice.topics.items() if name in names}
    if missing := [name for name in (REFERENCE, ODOMETRY, COMMAND) if name not in topics]:
        raise ReplayError(
            f'{bag}: these topics are not in the bag: {", ".join(missing)}; a run of the '
            'controller of this package, with its journal, is needed. t3mpc bag report and t3mpc '
            'tune --robot BAG take a bag of any robot'
        )
    recorded_topics = {name for name, topic in recording.topics.items() if topic.message_count}
    topics[JOURNAL] = f'{prefix}/{JOURNAL}'
    if topics[JOURNAL] not in recorded_topics:
        raise ReplayError(
            f'{bag}: there is no journal of the controller ({topics[JOURNAL]}), which defines '
            'the order of its inputs: record it, as the recorder does by default; t3mpc bag '
            'report needs none'
        )
    revisions = _revisions(recording, f'{prefix}/{CONTROLLER}/parameters')
    default = None if revisions else recorded_parameters(recording, prefix, notes)
    initial = {
        name: full
        for name in (REFERENCE, ODOMETRY)
        if (full := f'{prefix}/{topic_roles.INITIAL_INPUTS}{name}') in recorded_topics
    }
    columns = read_columns(recording, [*topics.values(), *initial.values()])
    by_name = {name: columns[full] for name, full in topics.items()}
    for name, full in initial.items():
        by_name[name] = with_initial_inputs(by_name[name], columns[full])
    reader = _SessionReader(recording, by_name, revisions, default, model, notes)
    rows, published, received = _journal(by_name[JOURNAL])
    bounds = [0, *(np.flatnonzero(np.diff(rows[:, 0]) < 0) + 1).tolist(), len(rows)]
    sessions = tuple(
        reader.session(rows[first:last], received[first:last], first)
        for first, last in pairwise(bounds)
    )
    sent = by_name[COMMAND]
    commands = commands_of(rows, published, sent.published_ns)
    time = (published - recording.start_ns) / NANOSECONDS
    without = np.flatnonzero(np.isin(rows[:, 1], COMMAND_EVENTS) & (commands < 0))
    if without.size:
        notes.append(
            f'{without.size} commands of the controller, from {time[without[0]]:.3f} s to '
            f'{time[without[-1]]:.3f} s, are not in the bag and not compared'
        )
    return ControllerInputs(
        bag=bag,
        odometry=by_name[ODOMETRY],
        references=by_name[REFERENCE],
        sessions=sessions,
        time=time,
        recorded=_recorded_outputs(by_name, rows[:, 1], published, commands),
        commands_ns=np.where(commands >= 0, sent.received_ns[commands], 0),
        start_ns=recording.start_ns,
        notes=tuple(notes),
    )


def controller_record(recording: BagReader, namespace: str) -> Mapping[str, str]:
    """Return the recorded parameters of the controller node as text; empty if there are none."""
    records = recording.metadata_records
    return records.get(f'{namespace}/{CONTROLLER}', records.get(CONTROLLER, {}))


def recorded_parameters(
    recording: BagReader, namespace: str, notes: list[str]
) -> ControllerParameters:
    """Return the controller's parameters as recorded."""
    table = controller_record(recording, namespace)
    if not table:
        raise ReplayError(f"{recording.folder}: the controller's settings are not in the bag")
    known = {name: text for name, text in table.items() if name in _names()}
    values = parse_assignments(ControllerParameters, (f'{k}={v}' for k, v in known.items()))
    absent = [row.name for row in ControllerParameters.specs() if row.name not in known]
    if absent:
        notes.append(f'not in the bag, taken at their defaults: {", ".join(absent)}')
    return _parameters(recording, values)


def motions(column: TopicColumns) -> StateArray:
    """Return odometry messages as states."""
    x, y, qx, qy, qz, qw, linear, angular, _ = column.numbers.T
    with np.errstate(over='ignore', invalid='ignore'):
        sine = 2.0 * (qw * qz + qx * qy)
        cosine = 1.0 - 2.0 * (qy * qy + qz * qz)
    # NumPy's arctan2 differs from that of the node in the last bit.
    yaw = np.array([*map(math.atan2, sine.tolist(), cosine.tolist())], dtype=np.float64)
    yaw[~(np.isfinite(sine) & np.isfinite(cosine))] = np.nan
    poses, twists = np.stack([x, y, yaw], axis=1), np.stack([linear, angular], axis=1)
    return StateArray(column.stamps_ns, poses, twists)


Revision = tuple[int, int, Mapping[str, object]]


def _revisions(recording: BagReader, topic: str) -> list[Revision]:
    """Return (receive time, revision, parameters) in order of receipt."""
    if topic not in recording.topics:
        return []
    messages = [
        (each.received_ns, recording.decode(each, number))
        for number, each in enumerate(recording.serialized_messages([topic]), 1)
    ]
    try:
        return [(when, *parameters_from_json(message.data)) for when, message in messages]
    except ValueError as error:
        raise ReplayError(f'{topic}: {error}') from error


def _parameters(recording: BagReader, values: Mapping[str, object]) -> ControllerParameters:
    """Return the controller's own part of the node parameters."""
    names = _names()
    try:
        own = {name: value for name, value in values.items() if name in names}
        return ControllerParameters.from_dict({**BEFORE, **own})
    except ParameterError as error:
        raise ReplayError(
            f'{recording.folder}: the recorded settings cannot be used: {error}'
        ) from error


@cache
def _names() -> frozenset[str]:
    """Return the names of parameters and former parameters of the controller."""
    table = ControllerParameters
    return frozenset((*(row.name for row in table.specs()), *table.class_constants()))


@dataclass
class _SessionReader:
    """Reads the sessions of the controller of one bag, and notes what is lost."""

    recording: BagReader
    columns: Mapping[str, TopicColumns]
    revisions: Sequence[Revision]
    default: ControllerParameters | None
    model: Mapping[str, Array] | None
    notes: list[str]

    def session(self, rows: Integers, received: Integers, first: int) -> ControllerSession:
        """Return the session of these rows of the journal, which were received then."""
        taken = match(rows, self.columns[ODOMETRY].stamps_ns, self.columns[REFERENCE].stamps_ns)
        earlier = 'events of the controller were before the recording'
        lost = {earlier: int(rows[0, 0]), **taken.lost}
        self.notes += [f'{count} {what}' for what, count in lost.items() if count]
        exact = np.zeros(len(rows), dtype=np.bool_)
        sound = rows[0, 0] == 0
        marks = np.flatnonzero(taken.broken | taken.restarts).tolist()
        for k, until in zip([0, *marks], [*marks, len(rows)], strict=True):
            if taken.restarts[k]:
                sound = True
            elif taken.broken[k]:
                sound = False
            exact[k:until] = sound
        exact[(rows[:, 1] == Event.STEP) & (taken.odometry < 0)] = False
        parameters, start = self._parameters_of(rows, received)
        if start not in parameters:
            start = min(parameters)
            self.notes.append('the settings at the start are not in the bag, later ones are used')
            exact[:] = False
        unknown = (rows[:, 1] == Event.CONFIGURE) & ~np.isin(rows[:, 4], list(parameters))
        if unknown.any():
            self.notes.append(
                f'{np.count_nonzero(unknown)} changes of settings are not in the bag'
            )
            exact[np.flatnonzero(unknown)[0] :] = False
        checksums = rows[rows[:, 1] == Event.MODEL, 4]
        model = self.model
        if model is None and checksums.size:
            model = self._model_of(int(checksums[0]))
            if model is None:
                exact[: next(iter(np.flatnonzero(taken.restarts).tolist()), len(rows))] = False
        return ControllerSession(first, rows, taken, exact, parameters, start, model)

    def _parameters_of(
        self, rows: Integers, received: Integers
    ) -> tuple[dict[int, ControllerParameters], int]:
        """Return the parameters of one session by revision, and its initial revision."""
        if self.default is not None:
            return {0: self.default}, 0
        # The initial parameters are published before the first event.
        starts = [i for i, entry in enumerate(self.revisions) if entry[1] == 0]
        before = [i for i in starts if self.revisions[i][0] <= received[-1]]
        begin = before[-1] if before else 0
        end = next((i for i in starts if i > begin), len(self.revisions))
        own = self.revisions[begin:end]
        found = {revision: _parameters(self.recording, values) for _, revision, values in own}
        changes = rows[rows[:, 1] == Event.CONFIGURE, 4]
        start = 0
        if rows[0, 0] > 0:  # in force before the first change in the bag
            start = int(changes[0]) - 1 if changes.size else max(found)
        return found, start

    def _model_of(self, checksum: int) -> Mapping[str, Array] | None:
        """Return the initial model with this checksum; None where it is lost."""
        records = self.recording.metadata_records
        tables: list[Mapping[str, object]] = [self.revisions[0][2]] if self.revisions else [
            table for title, table in records.items() if CONTROLLER in title
        ]  # fmt: skip
        name = str(next((table['model'] for table in tables if 'model' in table), ''))
        files = [item.data for item in self.recording.attachments().values()]
        if name and Path(name).is_file():
            files.append(Path(name).read_bytes())
        for content in files:
            if zlib.crc32(content) == checksum:
                with tempfile.NamedTemporaryFile(suffix='.npz') as file:
                    file.write(content)
                    file.flush()
                    return load_model(Path(file.name))
        self.notes.append(
            f'the initial model {name or "file"} of the controller is not in the bag: '
            'give it by --model'
        )
        return None


def _journal(column: TopicColumns) -> tuple[Integers, Integers, Integers]:
    """Return the rows of the journal, and when they were published and received."""
    # A previous session, latched by its publisher: in order of publication.
    order = np.argsort(column.published_ns, kind='stable')
    rows = column.numbers[order]
    order = order[np.concatenate([[True], np.diff(rows[:, 0]) != 0])]  # twice after a restart
    return column.numbers[order], column.published_ns[order], column.received_ns[order]


def _recorded_outputs(
    columns: Mapping[str, TopicColumns], events: Integers, published: Integers, commands: Integers
) -> dict[str, Array]:
    """Return the recorded value of each field by row."""
    recorded = {name: np.full(len(events), np.nan) for name in FIELDS}
    there = commands >= 0
    for i, name in enumerate(SPEEDS):
        recorded[name][there] = columns[COMMAND].numbers[commands[there], i]
    steps = events == Event.STEP
    for name in SCALAR_NAMES:
        column = columns.get(f'{CONTROLLER}/{name}')
        if column is None or not len(column):
            continue
        # A step publishes its scalars after its row.
        rows = np.searchsorted(published, column.published_ns, side='right') - 1
        known = (rows >= 0) & steps[rows]
        recorded[name][rows[known]] = column.numbers[known, 0]
    return recorded


def with_initial_inputs(received: TopicColumns, initial: TopicColumns) -> TopicColumns:
    """Return the messages of an input, completed by those that the recorder discovered too late.

    The controller republishes its first inputs on a transient-local topic. A message with a stamp
    that the plain topic lacks is inserted in front of the first message with a later stamp.
    """
    missing = np.flatnonzero(~np.isin(initial.stamps_ns, received.stamps_ns))
    if not missing.size:
        return received
    # The controller may have been restarted: its history then begins anew, in order of stamps.
    _, first = np.unique(initial.stamps_ns[missing], return_index=True)
    missing = missing[first]
    latest = np.maximum.accumulate(received.stamps_ns)
    places = np.searchsorted(latest, initial.stamps_ns[missing], side='right')
    merged = {
        name: np.insert(getattr(received, name), places, getattr(initial, name)[missing], axis=0)
        for name in ('received_ns', 'published_ns', 'stamps_ns', 'numbers')
    }
    return TopicColumns(**merged)


def match(rows: Integers, odometry_ns: Integers, reference_ns: Integers) -> ConsumedMessages:
    """Return the messages that the controller processed, by its journal.

    ``rows`` is the journal of one session of the controller, shape (n, 5), see
    :mod:`t3mpc_ros.bag.controller_input_journal`; stamps of the messages are in order of receipt.
    """
    number, event, stamp, handed, value = rows.T
    steps = event == Event.STEP
    odometry = np.full(len(rows), -1, dtype=np.int64)
    odometry[steps] = _in_turn(stamp[steps], odometry_ns)
    gaps = np.diff(number, prepend=number[:1] - 1) - 1
    begin, end, lost, late = _reference_ranges(handed, np.where(steps, value, 0), reference_ns)
    missing = steps & (odometry < 0)
    reset = event == Event.RESET
    return ConsumedMessages(
        odometry,
        begin,
        end,
        # Without a reference the robot is at rest, and only the last odometry stamp is state.
        (missing & (handed > 0)) | (gaps > 0) | (lost > 0) | (reset & late),
        reset & ~late,
        {
            'events are missing in the journal of the controller': int(gaps.sum()),
            'odometry messages that the controller processed are not in the bag': int(
                np.count_nonzero(missing)
            ),
            'references that the controller received are not in the bag': int(lost.sum()),
        },
    )


def commands_of(rows: Integers, published: Integers, sent: Integers) -> Integers:
    """Return the recorded command of each row of the journal, -1 without one, shape (n,).

    The controller publishes a command and then its journal row: ``published`` and ``sent`` are
    these times by its clock, ns. A process that is killed in between leaves a command without a
    row, which is none of the first row of the next process if that is more than a second later.
    """
    found = np.full(len(rows), -1, dtype=np.int64)
    commanding = np.isin(rows[:, 1], COMMAND_EVENTS)
    last = np.searchsorted(sent, published, side='right') - 1
    before = np.concatenate([[np.iinfo(np.int64).min], published[:-1]])
    begins = np.concatenate([[False], np.diff(rows[:, 0]) < 0])
    before[begins] = np.maximum(before, published - NANOSECONDS)[begins]
    fits = commanding & (last >= 0)
    fits[fits] = sent[last[fits]] > before[fits]
    found[fits] = last[fits]
    if np.count_nonzero(fits) < np.count_nonzero(commanding) == sent.size and not begins.any():
        # Publication times are unknown: without losses the order suffices.
        found[commanding] = np.arange(sent.size)
    return found


def _in_turn(wanted: Integers, recorded: Integers) -> Integers:
    """Return the row of each stamp in the recording, in order; -1 where it is missing."""
    rows_of_stamp = _rows_by_stamp(recorded)
    found = np.full(wanted.size, -1, dtype=np.int64)
    end = 0
    for k, stamp in enumerate(wanted.tolist()):
        rows = rows_of_stamp.get(stamp, [])
        place = bisect_left(rows, end)
        if place < len(rows):
            found[k], end = rows[place], rows[place] + 1
    return found


def _rows_by_stamp(recorded: Integers) -> dict[int, list[int]]:
    rows: dict[int, list[int]] = {}
    for row, stamp in enumerate(recorded.tolist()):
        rows.setdefault(stamp, []).append(row)
    return rows


def _reference_ranges(
    handed: Integers, newest: Integers, recorded: Integers
) -> tuple[Integers, Integers, Integers, Flags]:
    """Return begin and end of the references passed before each row, and how many are lost.

    ``handed`` is their number since the start of the controller, ``newest`` the stamp of the last
    one, 0 where the row does not hold it. By its stamp a row shows the lead of the recording over
    this number; a row without one has that of the rows around it. Where theirs differ, references
    were lost, or only the recorder received them, and it is unknown which of them the row passes:
    they are passed later, as the last result marks.
    """
    rows_of_stamp = _rows_by_stamp(recorded)
    stamped = np.flatnonzero((newest != 0) & (handed > 0))
    leads, end = [0], 0
    for count, stamp in zip(handed[stamped].tolist(), newest[stamped].tolist(), strict=True):
        last = count + leads[-1] - 1
        if not 0 <= last < recorded.size or recorded[last] != stamp:
            rows = rows_of_stamp.get(stamp, [])
            place = bisect_left(rows, end)
            last = rows[place] if place < len(rows) else end - 1
        end = last + 1
        leads.append(end - count)
    # Before the first stamp, nothing was lost if the recording was complete or began earlier.
    lead = np.array([max(leads[1], 0), *leads[1:]] if stamped.size else leads)
    counts, stamped = np.append(0, handed[stamped]), np.append(-1, stamped)
    every = np.arange(len(handed))
    before = np.searchsorted(stamped, every, side='right') - 1
    after = np.minimum(np.searchsorted(stamped, every), lead.size - 1)
    known = lead[before] == lead[after]
    ends = np.where(known, handed, counts[before]) + lead[before]
    ends = np.minimum(ends, recorded.size)
    begins = np.append(lead[0], ends[:-1])
    begins[stamped[1:]] = np.maximum(begins[stamped[1:]], counts[:-1] + lead[1:])
    lost = np.zeros(len(handed), dtype=np.int64)
    lost[stamped[1:]] = np.maximum(-np.diff(lead), 0)
    return begins, ends, lost, ~known & (np.diff(handed, prepend=0) > 0)
