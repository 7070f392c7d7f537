# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Matches recorded messages with the events of the controller journal."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.bag.columns import TopicColumns
from t3mpc_ros.bag.run.journal import COMMAND_EVENTS, Event
from t3mpc_ros.geometry.types import NANOSECONDS

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]


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
    lost_odometry: int
    lost_references: int
    lost_events: int


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
    return TopicColumns(**merged, integers=received.integers)


def match(rows: Integers, odometry_ns: Integers, reference_ns: Integers) -> ConsumedMessages:
    """Return the messages that the controller processed, by its journal.

    ``rows`` is the journal of one session of the controller, shape (n, 5), see
    :mod:`t3mpc_ros.bag.run.journal`; stamps of the messages are in order of receipt.
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
        int(np.count_nonzero(missing)),
        int(lost.sum()),
        int(gaps.sum()),
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


def rows_of(published: Integers, scalars: Integers, steps: Flags) -> Integers:
    """Return the journal row that each scalar follows, -1 without one, shape (m,).

    ``published`` and ``scalars`` are publication times, ns; only ``steps`` precede scalars.
    """
    rows = np.searchsorted(published, scalars, side='right') - 1
    rows[(rows >= 0) & ~steps[rows]] = -1
    return np.asarray(rows, dtype=np.int64)


def _in_turn(wanted: Integers, recorded: Integers) -> Integers:
    """Return the position of each stamp in the recording, in order; -1 where it is missing."""
    if not wanted.size or not recorded.size:
        return np.full(wanted.size, -1, dtype=np.int64)
    for first in np.flatnonzero(recorded == wanted[0]).tolist():
        if np.array_equal(recorded[first : first + wanted.size], wanted):
            return np.arange(first, first + wanted.size)
    places: dict[int, list[int]] = {}
    for place, stamp in enumerate(recorded.tolist()):
        places.setdefault(stamp, []).append(place)
    found = np.full(wanted.size, -1, dtype=np.int64)
    now = 0
    for k, stamp in enumerate(wanted.tolist()):
        row = next((each for each in places.get(stamp, ()) if each >= now), None)
        if row is not None:
            found[k], now = row, row + 1
    return found


def _reference_ranges(
    handed: Integers, newest: Integers, recorded: Integers
) -> tuple[Integers, Integers, Integers, Flags]:
    """Return the range of references passed before each row, and the lost ones.

    ``newest`` is the stamp of the last of them, 0 where the row does not hold it. The last result
    is whether some references before a row are passed after it for that reason.
    """
    end = np.zeros(len(handed), dtype=np.int64)
    stamped = (newest != 0) & (handed > 0)
    for last in np.flatnonzero(recorded == newest[stamped][-1]).tolist() if stamped.any() else ():
        shift = last + 1 - int(handed[stamped][-1])
        if handed[stamped][0] + shift <= 0:
            continue
        if np.array_equal(recorded[handed[stamped] + shift - 1], newest[stamped]):
            # References before a row without a stamp are passed all the same.
            end = np.where(handed > 0, np.maximum(handed + shift, 0), max(shift, 0))
            end = np.minimum(end, recorded.size)
            begin = np.concatenate([[max(shift, 0)], end[:-1]])
            lost = np.zeros(len(handed), dtype=np.int64)
            lost[np.flatnonzero(handed > 0)[0]] = max(-shift, 0)
            return begin, end, lost, np.zeros(len(handed), dtype=np.bool_)
    return _reference_ranges_with_gaps(handed, newest, recorded)


def _reference_ranges_with_gaps(
    handed: Integers, newest: Integers, recorded: Integers
) -> tuple[Integers, Integers, Integers, Flags]:
    """Return the same where references were lost, or received by the recorder only."""
    places: dict[int, list[int]] = {}
    for row, stamp in enumerate(recorded.tolist()):
        places.setdefault(stamp, []).append(row)
    begin, end, lost = np.zeros((3, len(handed)), dtype=np.int64)
    late = np.zeros(len(handed), dtype=np.bool_)
    counted, now = 0, 0
    guessed: list[int] = []
    for k, (count, stamp) in enumerate(zip(handed.tolist(), newest.tolist(), strict=True)):
        new = count - counted
        begin[k] = end[k] = now
        if stamp == 0:  # a row without a stamp: no loss is known
            begin[k], end[k] = (
                (end[guessed[-1]] if guessed else now),
                min(now + new, len(recorded)),
            )
            guessed.append(k)
            continue
        if now + new <= len(recorded) and recorded[now + new - 1] == stamp:
            begin[k], end[k] = (end[guessed[-1]] if guessed else now), now + new
        else:
            # Those before rows without a stamp are unknown: all precede this one.
            for guess in guessed:
                late[guess] = end[guess] > begin[guess]
                begin[guess] = end[guess] = now
            last = min((row for row in places.get(stamp, ()) if row >= now), default=now - 1)
            lost[k] = new - min(new, last + 1 - now)
            begin[k], end[k] = max(now, last + 1 - new), last + 1
        counted, now = count, int(end[k])
        guessed.clear()
    return begin, end, lost, late
