# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Whether the messages of a topic are one motion: gaps, jumps, repetitions, several robots."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Table = dict[str, Array]

MIN_GAP = 2.0
"""Least time without a message that is a gap, s."""
GAP_PERIODS = 20.0
"""Least gap, in median intervals of the messages."""
POSE_JUMP = 1.0
"""Least displacement between two messages, m, beyond that by the speed, which is a jump."""
SPEED_MARGIN = 3.0
"""Displacement that counts as explained by the speed, in multiples of speed times interval."""
MIXED_STEP = 0.05
"""Like :data:`POSE_JUMP` where many messages show it: two robots near each other, m."""
MIXED_SHARE = 0.1
"""Share of such messages from which on the topic is searched for several robots."""
MIN_TRACK = 5
"""Messages that make a robot: fewer are outliers."""
RATE_CHANGE = 4.0
"""Ratio of two rates of a topic that is a change of its rate."""
RATE_BLOCK = 20
"""Messages over which a rate is determined."""
RATE_SHARE = 0.05
"""Share of the time for which a rate must last: messages sent at once are no rate."""
_MAX_LISTED = 5
_MAX_TRACKS = 8


def gaps(time: Array) -> list[tuple[float, float]]:
    """Return start and end of each gap between sorted times, s."""
    steps = np.diff(time)
    if not steps.size:
        return []
    least = max(MIN_GAP, GAP_PERIODS * float(np.median(steps)))
    return [(float(time[k]), float(time[k + 1])) for k in np.flatnonzero(steps > least).tolist()]


def parts(*times: Array) -> list[tuple[float, float]]:
    """Return start and end of each part in which none of the sorted series has a gap, s."""
    start = max(float(time[0]) for time in times)
    end = min(float(time[-1]) for time in times)
    found = []
    for low, high in sorted(gap for time in times for gap in gaps(time)):
        if low > start:
            found.append((start, min(low, end)))
        start = max(start, high)
    found.append((start, end))
    return [(low, high) for low, high in found if high > low]


def within_gaps(time: Array, series: Array) -> NDArray[np.bool_]:
    """Return which of ``time`` lie in a gap of the sorted ``series``, shape (n,)."""
    inside = np.zeros(time.size, dtype=np.bool_)
    for low, high in gaps(series):
        inside |= (time > low) & (time < high)
    return inside


def pose_jumps(stamps: Array, positions: Array, speeds: Array, least: float) -> Integers:
    """Return the rows whose position is farther from that before than the speed explains.

    Parameters
    ----------
    stamps
        s, shape (n,).
    positions
        m, shape (n, 2).
    speeds
        Forward speeds, m/s, shape (n,).
    least
        Displacement beyond the explained one that is a jump, m.
    """
    away = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    fastest = np.maximum(np.abs(speeds[1:]), np.abs(speeds[:-1]))
    explained = SPEED_MARGIN * fastest * np.abs(np.diff(stamps))
    return np.flatnonzero(away > least + explained) + 1


def continuity_notes(
    topic: str, received: Array, stamps: Array, positions: Array, speeds: Array
) -> list[str]:
    """Return sentences on gaps, jumps of the pose and disorder of an odometry topic.

    Times (s), positions (m, shape (n, 2)) and forward speeds (m/s) are in the order of the bag.
    """
    notes = shortened(
        [
            f'No message of {topic} for {high - low:.1f} s from {low:.1f} s on.'
            for low, high in gaps(np.sort(received))
        ],
        'gaps',
    )
    away = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    jumps = [
        f'The position of {topic} jumps by {away[k - 1]:.4g} m at {received[k]:.1f} s.'
        for k in pose_jumps(stamps, positions, speeds, POSE_JUMP).tolist()
    ]
    notes += shortened(jumps, 'jumps of the position')
    if back := int(np.count_nonzero(np.diff(received) < 0.0)):
        notes.append(f'{back} messages of {topic} are in the bag before earlier ones.')
    return notes


def shortened(notes: list[str], what: str) -> list[str]:
    """Return at most five sentences and the number of the others."""
    if len(notes) > _MAX_LISTED:
        return [*notes[:_MAX_LISTED], f'There are {len(notes) - _MAX_LISTED} more {what}.']
    return notes


class OneRobot(NamedTuple):
    """The messages of one robot in a topic of odometry."""

    table: Table
    mixed: bool
    """Whether the topic holds several robots, of which this is the one with most messages."""


def only_one_robot(
    table: Table, topic: str, frames: Sequence[str], frame_of: Integers, notes: list[str]
) -> OneRobot:
    """Return the messages of one robot, each once, and add what was left out to ``notes``.

    Robots are distinguished by their base frame, else by positions that alternate between
    tracks of which each is continuous.

    Parameters
    ----------
    frames, frame_of
        Base frames of the topic, and the index of that of each message, shape (n,); empty if
        unknown.
    """
    counts = np.bincount(frame_of, minlength=len(frames)) if len(frames) > 1 else np.empty(0)
    mixed = counts.size > 1
    if mixed:
        kept = int(np.argmax(counts))
        listed = ', '.join(f'{name} ({n})' for name, n in zip(frames, counts, strict=True))
        notes.append(
            f'Several robots: the messages of {topic} are of {len(frames)} frames: {listed}; '
            f'those of {frames[kept]} are used.'
        )
        table = {name: column[frame_of == kept] for name, column in table.items()}
    table = _each_once(table, topic, notes)
    track = _tracks(table)
    sizes = np.bincount(track) if track.size else np.empty(0, dtype=np.int64)
    large = [k for k in range(sizes.size) if sizes[k] >= MIN_TRACK]
    if len(large) > 1 and _overlap(track, large):
        kept = max(large, key=lambda k: int(sizes[k]))
        notes.append(
            f'Several robots: the position of {topic} alternates between {len(large)} paths ('
            f'{", ".join(str(sizes[k]) for k in large)} messages), so several robots publish it; '
            'the path with most messages is used.'
        )
        return OneRobot({name: column[track == kept] for name, column in table.items()}, True)
    return OneRobot(table, mixed)


def _each_once(table: Table, topic: str, notes: list[str]) -> Table:
    """Return the rows without those that repeat the row before but for the receive time."""
    columns = [column for name, column in table.items() if name != 'received']
    same = np.all([column[1:] == column[:-1] for column in columns], axis=0)
    again = np.concatenate([np.zeros(min(1, table['stamp'].size), dtype=np.bool_), same])
    if np.unique(table['stamp']).size < 2 or not again.any():
        return table  # without stamps, a robot at standstill repeats itself
    notes.append(f'{np.count_nonzero(again)} messages of {topic} are repetitions; each counts '
                 'once.')  # fmt: skip
    return {name: column[~again] for name, column in table.items()}


def _tracks(table: Table) -> Integers:
    """Return which continuous track each message belongs to, shape (n,); empty if all do."""
    stamps, speeds = table['stamp'], table['linear']
    positions = np.stack([table['x'], table['y']], axis=1)
    none = np.empty(0, dtype=np.int64)
    if stamps.size < 2 * MIN_TRACK:
        return none
    near = pose_jumps(stamps, positions, speeds, MIXED_STEP).size > MIXED_SHARE * stamps.size
    least = MIXED_STEP if near else POSE_JUMP
    if pose_jumps(stamps, positions, speeds, least).size < MIN_TRACK:
        return none
    rows = zip(positions.tolist(), speeds.tolist(), stamps.tolist(), strict=True)
    ends: list[tuple[list[float], float, float]] = []
    found = []
    for row in rows:
        track = _nearest(row, ends, least)
        if track is None:
            if len(ends) == _MAX_TRACKS:
                return none  # noise, no robots
            track = len(ends)
            ends.append(row)
        ends[track] = row
        found.append(track)
    return np.array(found, dtype=np.int64)


def _nearest(
    row: tuple[list[float], float, float],
    ends: Sequence[tuple[list[float], float, float]],
    least: float,
) -> int | None:
    """Return the track that a message continues; None if there is none."""
    (x, y), speed, stamp = row
    best, nearest = None, np.inf
    for track, ((u, v), before, when) in enumerate(ends):
        away = float(np.hypot(x - u, y - v))
        explained = SPEED_MARGIN * max(abs(speed), abs(before)) * abs(stamp - when)
        if away <= least + explained and away < nearest:
            best, nearest = track, away
    return best


def _overlap(track: Integers, large: Sequence[int]) -> bool:
    """Return whether two tracks alternate: one after the other is a jump of one robot."""
    spans = [
        (int(rows[0]), int(rows[-1])) for k in large if (rows := np.flatnonzero(track == k)).size
    ]
    spans.sort()
    return any(after[0] < before[1] for before, after in zip(spans, spans[1:], strict=False))


def rate_notes(topic: str, stamps: Array) -> list[str]:
    """Return a sentence if the rate of a topic changes strongly within the recording."""
    steps = np.diff(np.sort(stamps))
    count = steps.size // RATE_BLOCK
    if count < 2:
        return []
    blocks = steps[: count * RATE_BLOCK].reshape(count, RATE_BLOCK)
    medians = np.median(blocks, axis=1)
    order = np.argsort(medians)
    lasted = np.cumsum(np.minimum(medians * RATE_BLOCK, blocks.sum(axis=1))[order])
    rows = np.searchsorted(lasted, np.array([RATE_SHARE, 1.0 - RATE_SHARE]) * lasted[-1])
    low, high = medians[order][rows].tolist()
    if not 0.0 < RATE_CHANGE * low < high:
        return []
    return [
        f'The rate of {topic} changes between {1.0 / high:.3g} and {1.0 / low:.3g} Hz: there is '
        'no common rate to count missing messages by.'
    ]
