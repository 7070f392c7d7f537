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
"""Whether the messages of a topic are one motion: gaps, jumps, several robots."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from t3mpc_ros.control.odometry_repair import FAR_BEYOND, TwistUnits
from t3mpc_ros.evaluation.run_record import spans_of
from t3mpc_ros.geometry.types import NANOSECONDS, Array, BodyTwist, Pose, State, motion_between

MIN_GAP = 2.0
"""Least time without a message that is a gap, s."""
GAP_PERIODS = 20.0
"""Least gap, in median intervals of the messages."""
POSE_JUMP = 1.0
"""Least displacement between two messages, m, beyond that by the speed, which is a jump."""
REST_JUMP, REST_SPEED, REST_INTERVAL = 0.1, 0.01, 0.25
"""The same of a robot at rest, m: with less than this speed, m/s, at both ends of a time without a
message of at most the last one, s."""
SPEED_MARGIN = 3.0
"""Displacement that counts as explained by the speed, in multiples of speed times interval."""
MIXED_STEP = 0.05
"""Like :data:`POSE_JUMP` where many messages show it: two robots near each other, m."""
MIXED_SHARE = 0.1
"""Share of such messages from which on a topic holds several robots."""
MIN_JUMPS = 10
"""Jumps up to which they are outliers, whatever their share."""
DISPLACED, DISPLACED_TURN, DISPLACED_SHARE = 0.25, 0.8, 0.25
"""Least displacement (m) and turn (rad) within the next time that the motion does not explain, and
what is added to both as a share of the motion. Noise of 0.2 rad/s at the wheels, odometry of 5 Hz
and speeds of 5 m/s reach an eighth of it."""
DISPLACED_WINDOW, DISPLACED_TIME, DISPLACED_STEP = 2.0, 0.5, 0.5
"""That time; for how long it must be seen, as an outlier is not; and the longest interval between
two messages over which a twist is integrated, s."""
DISPLACED_APART = 5.0
"""Least time between two of them, else they are one, s."""
ALTERNATING = 3.0
"""How many times nearer a command of two publishers in turn is to the last but one than to the
last."""
_MAX_LISTED = 5


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


def pose_jumps(
    stamps: Array, positions: Array, speeds: Array, least: float = POSE_JUMP
) -> list[tuple[int, float]]:
    """Return row and distance (m) of each position farther from that before than it can be driven.

    By more than ``least`` metres, or :data:`REST_JUMP` at rest if that is less; stamps (s),
    positions (m, shape (n, 2)), forward speeds (m/s).
    """
    away = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    fastest = np.maximum(np.abs(speeds[1:]), np.abs(speeds[:-1]))
    intervals = np.abs(np.diff(stamps))
    rests = (fastest < REST_SPEED) & (intervals <= REST_INTERVAL)
    allowed = np.where(rests, min(least, REST_JUMP), least)
    rows = np.flatnonzero(away > allowed + SPEED_MARGIN * fastest * intervals)
    return list(zip((rows + 1).tolist(), away[rows].tolist(), strict=True))


class Displacement(NamedTuple):
    """A motion of a pose that is not the one that was measured otherwise."""

    start: float
    """When it is seen, s."""
    duration: float
    """s"""
    distance: float
    """m"""
    turn: float
    """rad"""


def displacements(time: Array, poses: Array, moves: Array) -> list[Displacement]:
    """Return where poses move otherwise than they should, within :data:`DISPLACED_WINDOW`.

    Poses x, y (m), yaw (rad), shape (n, 3), at rising times (s); what each should move until the
    next one, ahead and to the left (m), and turn (rad), shape (n - 1, 3).
    """
    yaw = np.unwrap(poses[:, 2])
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    ahead, left, turn = moves.T
    c, s = np.cos(middle), np.sin(middle)
    should = np.column_stack([c * ahead - s * left, s * ahead + c * left, turn])
    beyond = np.diff(np.column_stack([poses[:, :2], yaw]), axis=0) - should
    beyond[np.diff(time) > DISPLACED_STEP] = 0.0
    ways = np.column_stack([np.hypot(ahead, left), np.abs(turn)])
    total, way = (np.cumsum(np.pad(each, ((1, 0), (0, 0))), axis=0) for each in (beyond, ways))
    first = np.searchsorted(time, time - DISPLACED_WINDOW)
    apart, driven = np.abs(total - total[first]), way - way[first]
    far = np.hypot(apart[:, 0], apart[:, 1]) > DISPLACED + DISPLACED_SHARE * driven[:, 0]
    far |= apart[:, 2] > DISPLACED_TURN + DISPLACED_SHARE * driven[:, 1]
    spans: list[tuple[int, int]] = []
    for rows in spans_of(far):
        low, high = rows.start, rows.stop - 1
        if spans and time[low] - time[spans[-1][1]] < DISPLACED_APART:
            low = spans.pop()[0]
        if time[high] - time[low] >= DISPLACED_TIME:
            spans.append((low, high))
    found = []
    for low, high in spans:
        x, y, turned = (total[high] - total[first[low]]).tolist()
        duration = max(float(time[high] - time[low]) - DISPLACED_WINDOW, 0.0)
        found.append(Displacement(float(time[low]), duration, float(np.hypot(x, y)), abs(turned)))
    return found


def alternate(commands: Array) -> bool:
    """Return whether most commands, shape (n, 2), are those of two publishers in turn."""
    step, two = (np.sum(np.abs(commands[k:] - commands[:-k]), axis=1) for k in (1, 2))
    rows = step[1:] > ALTERNATING * two
    return bool(np.count_nonzero(rows) > max(MIN_JUMPS, 0.5 * rows.size))


def continuity_notes(
    topic: str, received: Array, stamps: Array, positions: Array, speeds: Array
) -> list[str]:
    """Return sentences on gaps and jumps of an odometry topic, whose data are as in the bag."""
    silent = [
        f'No message of {topic} for {high - low:.1f} s from {low:.1f} s on.'
        for low, high in gaps(np.sort(received))
    ]
    jumps = [
        f'The position of {topic} jumps by {away:.4g} m at {received[k]:.1f} s.'
        for k, away in pose_jumps(stamps, positions, speeds)
    ]
    found = []
    for notes, what in ((silent, 'gaps'), (jumps, 'jumps of the position')):
        more = len(notes) - _MAX_LISTED
        found += notes[:_MAX_LISTED] + ([f'There are {more} more {what}.'] if more > 0 else [])
    return found


def other_units(stamps: Array, poses: Array, twists: Array) -> str:
    """Return a twist that shows that those of an odometry are in other units; '' if none does."""
    units = TwistUnits()
    if not np.any(np.abs(twists) > FAR_BEYOND):  # no message can contradict its pose
        return ''
    rows = zip(np.round(stamps * NANOSECONDS).tolist(), poses.tolist(), twists.tolist(),
               strict=True)  # fmt: skip
    states = (State(int(stamp), Pose(*pose), BodyTwist(*twist)) for stamp, pose, twist in rows)
    for last, new in pairwise(states):
        if new.stamp_ns > last.stamp_ns:
            units.update(last, new, motion_between(last.pose, new.pose))
        if units.wrong:
            return units.example
    return ''
