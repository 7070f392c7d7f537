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
"""What interrupted a recorded run: stops of the robot, stalls of the machine, gaps, jumps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.bag_report.diagnostic_history import (
    REASON_WINDOW,
    SLIP,
    Cause,
    cause_between,
)
from t3mpc_ros.evaluation.bag_report.motion_continuity import (
    DISPLACED,
    DISPLACED_TURN,
    DISPLACED_WINDOW,
    GAP_PERIODS,
    MIN_GAP,
    Displacement,
    displacements,
    gaps,
    pose_jumps,
)
from t3mpc_ros.evaluation.bag_report.recorded_run import Run, Series, moves
from t3mpc_ros.evaluation.run_record import spans_of
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE, TRUTH
from t3mpc_ros.geometry.types import Array

Span = tuple[float, float]

WINDOW = 0.2
"""Least smoothing width of speeds, s."""
STILL = {'linear': 0.01, 'angular': 0.05}
"""Smoothed speeds (m/s, rad/s) below which the robot is at standstill."""
HOLD = 3.0
"""Speeds up to which a standstill lasts, in multiples of :data:`STILL`: those of noise."""
DEMANDED = 2.0
"""Speed of a reference or command that asks for motion, in multiples of :data:`STILL`."""
UNDER_WAY = 5.0
"""Speed of a robot that has not come to a standstill yet, in multiples of :data:`STILL`."""
PAUSE = 0.5
"""Least duration of a standstill, s."""
COMMAND_TIMEOUT = 0.5
"""Time without a command after which the robot stands, s."""
MAX_PAUSE = 0.2
"""Longest time between the messages of a topic that is received, s."""
BRAKING = 0.5
"""Longest time from the begin of a stop to standstill, s; as ``max_stopping_time``."""
STALL_PERIODS = 5.0
"""Length of a pause of the loop that is a stall of the machine, in periods of the odometry. The
watchdog stops the robot after 20 of them; a busy but sufficient machine is 1 to 3 periods late."""
WHEEL_STILL, WHEEL_DEMANDED = 0.2, 0.8
"""Smoothed speed of a wheel that stands, and least command to one that is to turn, rad/s."""
BLOCKED_TIME = 1.0
"""Least duration of a standstill of one wheel, s: longer than a slow drive crosses zero."""
FROZEN_TIME = 1.0
"""Least time in which no number of an odometry changes although its robot moves, s."""
LASTING = 10.0
"""Time from which on a pose that moves otherwise than its twist is no event, s."""
MOST_SENT = 0.8
"""Share of the commands of a pause, and of three times as long after it, that a late loop has."""
MIN_STALL = 0.02
"""Least length of a stall, s: receipts of fast robots jitter by as much."""


class Stop(NamedTuple):
    """A time in which the robot stood, although it was to move."""

    start: float
    end: float
    cause: Cause

    @property
    def length(self) -> float:
        """Duration, s."""
        return self.end - self.start


class Jump(NamedTuple):
    """A displacement of a robot that its speed does not explain."""

    time: float
    name: str
    """Relative name of the topic."""
    distance: float
    """m"""


class Carried(NamedTuple):
    """A motion of a robot that another measurement does not explain."""

    time: float
    name: str
    """Relative name of the topic."""
    against: str
    """What says otherwise."""
    motion: Displacement

    @property
    def text(self) -> str:
        """What happened, without a full stop."""
        _, duration, distance, turn = self.motion
        if duration > LASTING:
            return (
                f'the pose of {self.name} moves otherwise than {self.against} says from '
                f'{self.time:.1f} s on for {duration:.0f} s: see signs, units and frames'
            )
        how = f'moves by {distance:.3g} m' if distance > 0.5 * turn else f'turns by {turn:.3g} rad'
        return (
            f'the pose of {self.name} {how} at {self.time:.1f} s, which {self.against} does not '
            'say: the robot was carried or slipped, or its pose was set'
        )


@dataclass(frozen=True)
class Incidents:
    """What interrupted a run, each in order of time, s."""

    stops: tuple[Stop, ...] = ()
    stalls: tuple[Span, ...] = ()
    """Pauses of the loop."""
    gaps: tuple[tuple[float, float, str], ...] = ()
    """Start, end, and relative name of the topic."""
    ended: tuple[tuple[float, float, str], ...] = ()
    """Likewise, of each odometry and reference that ends before the drive does."""
    blocked: tuple[tuple[float, float, str], ...] = ()
    """Start and end of each time in which one wheel stood although it was commanded to turn, while
    the other one turned, and which."""
    frozen: tuple[tuple[float, float, str], ...] = ()
    """Start and end of each time in which an odometry stayed the same although it should not, and
    what happened."""
    jumps: tuple[Jump, ...] = ()
    carried: tuple[Carried, ...] = ()
    slips: tuple[Span, ...] = ()
    """Times in which the robot reported that a wheel slips."""

    @property
    def stopped(self) -> float:
        """Time in which the robot stood although it was to move, s."""
        return sum((stop.length for stop in self.stops), 0.0)

    def events(self) -> list[tuple[float, str, str]]:
        """Return time (s), kind and text of all of them."""
        slips = 'a wheel slips, is blocked, or has lost steps'
        found = [
            *((e.start, 'stop', f'for {e.length:.2f} s: {e.cause.text}') for e in self.stops),
            *(
                (low, 'stall', f'of the machine: the loop pauses for {1e3 * (high - low):.0f} ms')
                for low, high in self.stalls
            ),
            *(
                (low, 'gap', f'no {name} for {high - low:.1f} s')
                for low, high, name in (*self.gaps, *self.ended)
            ),
            *(
                (
                    low,
                    'stop',
                    f'of the {title}, for {high - low:.2f} s, although commanded to turn',
                )
                for low, high, title in self.blocked
            ),
            *(
                (e.time, 'jump', f'of the position of {e.name}, by {e.distance:.4g} m')
                for e in self.jumps
            ),
            *((start, 'gap', text) for start, _, text in self.frozen),
            *((each.time, 'jump', each.text) for each in self.carried),
            *((low, 'slip', f'for {high - low:.1f} s {slips}') for low, high in self.slips),
        ]
        return sorted(found)


def find_incidents(run: Run) -> Incidents:
    """Return what interrupted a run."""
    first, last = driving(run)
    torn = [(*gap, name) for name, each in run.motions.items() for gap in gaps(each.time)]
    frozen, jumps = find_frozen(run), find_jumps(run)
    return Incidents(
        find_stops(run),
        tuple(span for span in find_stalls(run) if first <= span[0] and span[1] <= last),
        tuple(sorted(torn)),
        find_ends(run),
        find_blocked_wheels(run),
        frozen,
        jumps,
        find_carried(run, frozen, jumps),
        find_slips(run),
    )


def driving(run: Run) -> Span:
    """Return start and end of the drive, s: the first and the last command other than zero.

    Before, the controller does not follow the reference yet; afterwards it has stopped while the
    reference, stamped ahead, continues. (inf, -inf) when every command is zero; (-inf, inf) when
    the bag has no commands.
    """
    command = run.motions.get(COMMAND)
    if command is None:
        return -math.inf, math.inf
    moving = command.time[moves(command)]
    return (float(moving[0]), float(moving[-1])) if moving.size else (math.inf, -math.inf)


def find_ends(run: Run) -> tuple[tuple[float, float, str], ...]:
    """Return the odometry and the reference that end before the drive does; see Incidents."""
    _, last = driving(run)
    found = []
    for name in (ODOMETRY, REFERENCE):
        motion = run.motions.get(name)
        if motion is not None and len(motion) > 1 and name in run.receipts:
            end = float((motion.time if run.other_clock else run.receipts[name])[-1])
            least = MIN_GAP + GAP_PERIODS * float(np.median(np.diff(motion.time)))
            if least < last - end < math.inf:
                found.append((end, last, name))
    return tuple(sorted(found))


def smooth(series: Series, *names: str) -> Series:
    """Return smoothed quantities at evenly spaced times; none of a series that is too short.

    Parabolas are fitted to windows of :data:`WINDOW` or of eight samples, whichever is longer.
    NaN across gaps longer than a window.
    """
    nothing = Series(np.empty(0), dict.fromkeys(names, np.empty(0)))
    if len(series) < 3:
        return nothing
    width = max(WINDOW, 8.0 * float(np.median(np.diff(series.time))))
    half = 10
    step = 0.5 * width / half
    count = int((series.time[-1] - series.time[0]) / step) + 1
    if not 2 * half + 1 <= count <= 20_000_000:
        return nothing
    grid = series.time[0] + step * np.arange(count)
    offsets = step * np.arange(-half, half + 1.0)
    design = np.stack([np.ones_like(offsets), offsets, 0.5 * offsets**2], axis=1)
    weights = np.linalg.pinv(design)[0]
    time = grid[half : count - half]
    following = np.clip(np.searchsorted(series.time, time, 'right'), 1, len(series) - 1)
    torn = np.diff(series.time)[following - 1] > width
    values = {}
    for name in names:
        fitted = np.correlate(np.interp(grid, series.time, series[name]), weights, 'valid')
        values[name] = np.where(torn, np.nan, fitted)
    return Series(time, values)


def still_rows(speeds: Series, factor: float = 1.0) -> NDArray[np.bool_]:
    """Return where all smoothed speeds are known and below ``factor`` times :data:`STILL`."""
    below = [np.abs(speeds[name]) < factor * least for name, least in STILL.items()]
    return np.asarray(np.all(below, axis=0))


def exceeds(speeds: Series | Mapping[str, Array], factor: float) -> NDArray[np.bool_]:
    """Return where a speed exceeds ``factor`` times :data:`STILL`."""
    above = [np.abs(speeds[name]) > factor * least for name, least in STILL.items()]
    return np.asarray(np.any(above, axis=0))


def find_slips(run: Run) -> tuple[Span, ...]:
    """Return start and end of each time in which diagnostics say that a wheel slips, s."""
    begun: dict[str, float] = {}
    found = []
    for time, _, node, text in run.changes:
        if SLIP in text:
            begun.setdefault(node, time)
        elif node in begun:
            found.append((begun.pop(node), time))
    end = max((float(each.time[-1]) for each in run.motions.values()), default=0.0)
    found += [(start, max(start, end)) for start in begun.values()]
    return tuple(sorted(found))


def standstills(motion: Series) -> list[Span]:
    """Return start and end of each time in which a robot stood, however short, s."""
    smoothed = smooth(motion, *STILL)
    time, still = smoothed.time, still_rows(smoothed)
    found = []
    for each in spans_of(still_rows(smoothed, HOLD)):
        if np.mean(still[each]) >= 0.5:
            # A robot that creeps before and after it does not stand.
            balance = np.cumsum(np.where(still[each], 1, -1))
            first = int(np.argmin(np.concatenate([[0], balance[:-1]])))
            end = first + int(np.argmax(balance[first:]))
            low, high = float(time[each][first]), float(time[each][end])
            middle = 0.5 * (low + high)
            found.append((_edge(motion, low, -1, middle), _edge(motion, high, 0, middle)))
    return merged(found)


def _edge(motion: Series, at: float, which: int, middle: float) -> float:
    """Return the last (-1) or first (0) sample of a moving robot about an end of a standstill, s.

    Smoothing blurs the ends of a standstill: those of the samples are sharper. ``at`` itself where
    the robot does not move within half of :data:`BRAKING`.
    """
    near = motion.between(at - 0.5 * BRAKING, at + 0.5 * BRAKING)
    fast = exceeds(near, UNDER_WAY)
    fast &= near.time < middle if which else near.time > middle
    return float(near.time[fast][which]) if fast.any() else at


def merged(spans: Sequence[Span], nearer: float = 0.0) -> list[Span]:
    """Return spans in order, joined where they overlap or are nearer than so many seconds."""
    found: list[Span] = []
    for low, high in sorted(spans):
        if found and low <= found[-1][1] + nearer:
            found[-1] = found[-1][0], max(found[-1][1], high)
        else:
            found.append((low, high))
    return found


def find_stops(run: Run) -> tuple[Stop, ...]:
    """Return the times in which the robot stood although it was to move.

    What counts is the motion: the robot stands for :data:`PAUSE`, while the reference asks for
    motion, or the command where there is no reference; or for less, where the commands are those
    of a stop. After the last command to move it counts only if the nodes gave a
    reason, and only up to the end of the reference: a drive that is over is no stop.
    """
    motion, command = run.motion, run.motions.get(COMMAND)
    first, last = driving(run)
    if motion is None or len(motion) < 3 or not (first < last or command is None):
        return ()
    demand, end = _demand(run)
    if demand is None:
        return ()
    commanded = [] if command is None else _commanded_stops(command.between(first, last))
    found = []
    for low, high in standstills(motion):
        start, stop = max(low, first), min(high, end)
        start = max(_begin_of_stop(motion, command or demand, low), first)
        by_command = [each for each in commanded if each[0] <= stop and low <= each[1] + BRAKING]
        if by_command and demand is not command:
            start = max(min(start, by_command[0][0]), low - BRAKING, first)
        elif stop - start < PAUSE:
            continue
        asked = asks_for_motion(demand, np.linspace(start, stop, 50))
        if not (start < stop and np.mean(asked) >= 0.5):
            continue
        cause = _reported_cause(run, start, stop)
        if start >= last - PAUSE and not cause.known:
            continue
        found.append(Stop(start, stop, cause))
    return tuple(found)


def _demand(run: Run) -> tuple[Series | None, float]:
    """Return the reference, or the command where there is none, and when it ends, s."""
    reference, command = run.motions.get(REFERENCE), run.motions.get(COMMAND)
    if reference is None or len(reference) < 2:
        return command, math.inf if command is None else float(command.time[-1])
    end = float(reference.time[-1])
    # It is stamped ahead: the robot cannot follow what is left when the generator ends.
    return reference, min(end, end - run.lead) if REFERENCE in run.receipts else end


def _reported_cause(run: Run, start: float, stop: float) -> Cause:
    """Return why the robot stood, by the nodes that report and the topics that went on."""
    reported = np.any((run.reports > start) & (run.reports < stop + REASON_WINDOW))
    present = _present(run, start - BRAKING, stop)
    return cause_between(run.changes, start, stop, present=present, reported=bool(reported))


def _present(run: Run, start: float, end: float) -> list[str]:
    """Return the topics that were received from one time to another without a pause."""
    found = []
    for name in (REFERENCE, ODOMETRY, COMMAND):
        if name in run.motions:
            time = run.motions[name].time - (run.lead if name == REFERENCE else 0.0)
            inside = time[(time > start) & (time < end)]
            if np.max(np.diff([start, *inside.tolist(), end])) < MAX_PAUSE:
                found.append(name)
    return found


def _begin_of_stop(motion: Series, asked: Series, standstill: float) -> float:
    """Return when a robot that stands from ``standstill`` on last moved as it was asked to, s.

    At most :data:`BRAKING` before; the standstill itself for a robot that did not.
    """
    near = motion.between(standstill - BRAKING, standstill)
    apart = {name: near[name] - asked.held(name, near.time) for name in STILL}
    following = near.time[~exceeds(apart, UNDER_WAY) & exceeds(near, UNDER_WAY)]
    return float(following[-1]) if following.size else standstill


def _commanded_stops(command: Series) -> list[Span]:
    """Return when the commands of a drive were zero, or missing for :data:`COMMAND_TIMEOUT`."""
    time, moving = command.time, moves(command)
    waits = np.where(moving[:-1], COMMAND_TIMEOUT, 0.0)
    rows = np.flatnonzero(np.diff(time) > waits).tolist()
    return merged([(float(time[k] + waits[k]), float(time[k + 1])) for k in rows], 1e-9)


def asks_for_motion(demand: Series, time: Array) -> NDArray[np.bool_]:
    """Return at which times a reference or command asks for motion, shape (n,)."""
    held = {name: demand.held(name, time) for name in STILL}
    asked: NDArray[np.bool_] = exceeds(held, DEMANDED) & (time >= demand.time[0])
    return asked


def find_blocked_wheels(run: Run) -> tuple[tuple[float, float, str], ...]:
    """Return when one wheel stood although it was commanded to turn; see :class:`Incidents`."""
    motion, command = run.motion, run.motions.get(COMMAND)
    if motion is None or command is None or run.geometry is None:
        return ()
    found = []
    speeds = smooth(motion, *(each.name for each in run.channels))
    time = speeds.time
    for channel, other in (run.channels, run.channels[::-1]):
        still = np.abs(speeds[channel.name]) < WHEEL_STILL
        still &= np.abs(command.held(channel.name, time)) > WHEEL_DEMANDED
        still &= (time >= command.time[0]) & (np.abs(speeds[other.name]) > WHEEL_STILL)
        found += [
            (float(time[each][0]), float(time[each][-1]), channel.title)
            for each in spans_of(still)
            if time[each][-1] - time[each][0] >= BLOCKED_TIME
        ]
    return tuple(sorted(found))


def find_stalls(run: Run) -> list[Span]:
    """Return the pauses of the loop that are longer than :data:`STALL_PERIODS` periods.

    A pause is between two receipts of odometry without a command in between, between two commands
    of our controller although odometry comes, or from odometry to its command. Commands that
    go on are those of a machine that does, and so is the reference of a robot behind a radio:
    there, a packet was lost. Commands that are missing, and do not come late, were lost; so were
    messages that a recovery could not read.
    """
    odometry, timing = run.receipts.get(ODOMETRY), run.timing.get(ODOMETRY)
    if odometry is None or timing is None or not timing.period > 0.0 or run.other_clock:
        return []
    least = max(STALL_PERIODS * timing.period, MIN_STALL)
    found = _pauses(odometry, least)
    commands = run.receipts.get(COMMAND) if run.ours else None
    if commands is not None and commands.size > 2:
        least = max(least, STALL_PERIODS * float(np.median(np.diff(commands))))
        found += [
            pause
            for pause in _pauses(commands, least)
            if _received(odometry, *pause) and _come_late(commands, odometry, *pause)
        ]
    going_on = [COMMAND, REFERENCE] if run.links or not run.ours else [COMMAND]
    others = [run.receipts[name] for name in going_on if name in run.receipts]
    found = [span for span in found if not any(_received(each, *span) for each in others)]
    if commands is not None:
        waits = np.column_stack(prompted_commands(odometry, commands))
        length = waits[:, 1] - waits[:, 0]
        found += map(tuple, waits[(length > least) & (length < MIN_GAP)].tolist())
    unread = [(low - least, high + least) for low, high in run.lost]
    return merged(
        [
            (start, end)
            for start, end in found
            if not any(low < end and start < high for low, high in unread)
        ],
        -1e-6,
    )


def prompted_commands(
    odometry: Array, commands: Array, *, first: bool = True
) -> tuple[Array, Array]:
    """Return the newest odometry at each command, and the command, by receipt (s).

    ``first`` selects the first command after each message: further ones do not wait for it.
    """
    index = np.searchsorted(odometry, commands, 'right') - 1
    counted = index >= 0
    if first:
        counted &= np.diff(index, prepend=-1) > 0
    return odometry[index[counted]], commands[counted]


def _come_late(commands: Array, odometry: Array, low: float, high: float) -> bool:
    """Return whether the commands of a pause follow it: else they, and not the time, are lost."""
    end = high + 3.0 * (high - low)
    sent, due = (np.count_nonzero((low <= t) & (t < end)) for t in (commands, odometry))
    return bool(sent > MOST_SENT * due)


def _pauses(times: Array, least: float) -> list[Span]:
    """Return the spans between two times that are longer than ``least``, s, and no gaps."""
    steps = np.diff(times)
    rows = np.flatnonzero((steps > least) & (steps < MIN_GAP)).tolist()
    return [(float(times[k]), float(times[k + 1])) for k in rows]


def _received(times: Array, low: float, high: float) -> bool:
    """Return whether messages came well within a span."""
    edge = 0.2 * (high - low)
    return bool(np.any((times > low + edge) & (times < high - edge)))


def _poses_measured(run: Run) -> dict[str, Series]:
    """Return ground truth and odometry where they hold poses that can be trusted."""
    return {
        name: motion
        for name in (TRUTH, ODOMETRY)
        if (motion := run.motions.get(name)) is not None
        and 'x' in motion.values
        and name not in run.untrusted
    }


def find_jumps(run: Run) -> tuple[Jump, ...]:
    """Return where the position of a robot jumps, but for one that cannot be trusted."""
    found = []
    for name, motion in _poses_measured(run).items():
        places = np.stack([motion['x'], motion['y']], axis=1)
        found += [
            Jump(float(motion.time[k]), name, away)
            for k, away in pose_jumps(motion.time, places, motion['linear'])
        ]
    return tuple(sorted(found))


def find_frozen(run: Run) -> tuple[tuple[float, float, str], ...]:
    """Return when an odometry stayed the same although its twist, or ground truth, moved on."""
    found = []
    truth = run.motions.get(TRUTH)
    for name, motion in _poses_measured(run).items():
        keys = ('x', 'y', 'yaw', *STILL)
        same = np.all([np.diff(motion[key]) == 0.0 for key in keys], axis=0)
        for rows in spans_of(same):
            start, end = float(motion.time[rows.start]), float(motion.time[rows.stop])
            if end - start < FROZEN_TIME:
                continue
            has_pose = any(np.ptp(motion[key]) for key in ('x', 'y', 'yaw'))
            span = end - start if has_pose else 0.0
            apart = [span * abs(float(motion[key][rows.start])) for key in STILL]
            against = 'its twist amounts to'
            if not _is_far(*apart) and name == ODOMETRY and truth is not None:
                x, y, yaw = np.abs(_poses(truth, motion.time[rows]) - _poses(truth, start)).T
                apart, against = [np.hypot(x, y).max(), yaw.max()], f'{TRUTH} moves by'
            if _is_far(*apart):
                far, turned = apart
                way = f'{far:.3g} m' if far > DISPLACED else f'{turned:.3g} rad'
                text = f'{name} stays the same from {start:.1f} s on for {end - start:.1f} s'
                found.append((start, end, f'{text}, although {against} {way}'))
    return tuple(sorted(found))


def _is_far(distance: float, turn: float) -> bool:
    return distance > DISPLACED or turn > DISPLACED_TURN


def find_carried(
    run: Run, frozen: Sequence[tuple[float, float, str]], jumps: Sequence[Jump]
) -> tuple[Carried, ...]:
    """Return where a pose moves otherwise than its twist says, or ground truth than odometry.

    The localizer of this package corrects the odometry by the map: then it counts for nothing.
    """
    motions = {
        name: each
        for name, each in _poses_measured(run).items()
        if len(each) > 2
        and np.ptp(each['yaw'])  # else it has no pose
        and not (name == ODOMETRY and 'localizer' in run.parameters)
    }
    pairs = [
        (name, 'its twist', each.time, _poses(each, each.time), _moves_by_twist(each))
        for name, each in motions.items()
        if each['linear'].any() and each['angular'].any()  # else there is no twist
    ]
    if len(motions) > 1:
        truth = motions[TRUTH]
        odometry = motions[ODOMETRY].between(float(truth.time[0]), float(truth.time[-1]))
        time, moves = odometry.time, _moves_by_pose(odometry)
        pairs.append((TRUTH, ODOMETRY, time, _poses(truth, time), moves))
    times, found = [jump.time for jump in jumps], []
    for name, against, time, poses, moves in pairs:
        for each in displacements(time, poses, moves):
            low, high = each.start - DISPLACED_WINDOW, each.start + each.duration
            still = any(start <= each.start and low <= end for start, end, _ in frozen)
            # One event is reported once.
            if not still and not any(low <= when <= high for when in times):
                times.append(each.start)
                found.append(Carried(each.start, name, against, each))
    return tuple(sorted(found))


def _poses(motion: Series, time: Array | float) -> Array:
    """Return x, y (m) and yaw (rad) at some times, shape (n, 3)."""
    axes = motion['x'], motion['y'], np.unwrap(motion['yaw'])
    return np.column_stack([np.interp(time, motion.time, each) for each in axes])


def _moves_by_twist(motion: Series) -> Array:
    """Return how far a robot should move ahead, to the left and turn until its next message."""
    lateral = motion.values.get('lateral', np.zeros(len(motion)))
    twists = np.column_stack([motion['linear'], lateral, motion['angular']])
    moves: Array = 0.5 * (twists[1:] + twists[:-1]) * np.diff(motion.time)[:, np.newaxis]
    return moves


def _moves_by_pose(motion: Series) -> Array:
    """Return how far a robot moves ahead, to the left and turns until its next message."""
    poses = _poses(motion, motion.time)
    x, y, turn = np.diff(poses, axis=0).T
    middle = 0.5 * (poses[1:, 2] + poses[:-1, 2])
    c, s = np.cos(middle), np.sin(middle)
    return np.column_stack([c * x + s * y, c * y - s * x, turn])
