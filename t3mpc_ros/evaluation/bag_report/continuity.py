# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Gaps of a recording, jumps of the pose, and messages out of order."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MIN_GAP = 2.0
"""Least time without a message that is a gap, s."""
GAP_PERIODS = 20.0
"""Least gap, in median intervals of the messages."""
POSE_JUMP = 1.0
"""Least displacement between two messages, m, beyond that by the speed, which is a jump."""
SPEED_MARGIN = 3.0
"""Displacement that counts as explained by the speed, in multiples of speed times interval."""
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


def within_gaps(time: Array, series: Array) -> NDArray[np.bool_]:
    """Return which of ``time`` lie in a gap of the sorted ``series``, shape (n,)."""
    inside = np.zeros(time.size, dtype=np.bool_)
    for low, high in gaps(series):
        inside |= (time > low) & (time < high)
    return inside


def continuity_notes(
    topic: str, received: Array, stamps: Array, positions: Array, speeds: Array
) -> list[str]:
    """Return sentences on gaps, jumps of the pose and disorder of an odometry topic.

    Parameters
    ----------
    topic
        Name of the topic.
    received, stamps
        Receive times and stamps in the order of the bag, s, shape (n,).
    positions
        x and y, m, shape (n, 2).
    speeds
        Forward speed, m/s, shape (n,).
    """
    notes = [
        f'No message of {topic} for {high - low:.1f} s from {low:.1f} s on.'
        for low, high in gaps(np.sort(received))
    ]
    away = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    fastest = np.maximum(np.abs(speeds[1:]), np.abs(speeds[:-1]))
    explained = SPEED_MARGIN * fastest * np.abs(np.diff(stamps))
    notes = _shortened(notes, 'gaps')
    jumps = [
        f'The position of {topic} jumps by {away[k]:.4g} m at {received[k + 1]:.1f} s.'
        for k in np.flatnonzero(away > POSE_JUMP + explained).tolist()
    ]
    notes += _shortened(jumps, 'jumps of the position')
    if back := int(np.count_nonzero(np.diff(received) < 0.0)):
        notes.append(f'{back} messages of {topic} are in the bag before earlier ones.')
    return notes


def _shortened(notes: list[str], what: str) -> list[str]:
    if len(notes) > _MAX_LISTED:
        return [*notes[:_MAX_LISTED], f'There are {len(notes) - _MAX_LISTED} more {what}.']
    return notes
