# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Figures of merit of a recorded run: errors, targets, chatter, delays."""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.lab.report.recorded import Run, Series
from t3mpc_ros.lab.report.topics import COMMAND, ODOMETRY, REFERENCE

Array = NDArray[np.float64]

SETTLING = 1.0
"""Seconds in which the robot catches up: left out after the start of the drive, and after each
switch where it is to have settled; also the longest time left out before a switch."""
WINDOW = 0.2
"""Width (s) over which the target of the estimate is smoothed."""


@dataclass(frozen=True)
class ErrorStatistics:
    """Of the tracking error of one channel, in its unit; NaN without a sample."""

    rmse: float
    mae: float
    largest: float
    count: int
    seconds: float
    """How much time the samples stand for, s."""


def statistics(error: Array, period: float = math.nan) -> ErrorStatistics:
    """Return root mean square, mean and largest of the absolute error.

    Each sample of ``error`` stands for ``period`` seconds.
    """
    size = np.abs(error[np.isfinite(error)])
    if not size.size:
        return ErrorStatistics(math.nan, math.nan, math.nan, 0, 0.0)
    return ErrorStatistics(
        float(np.sqrt(np.mean(size**2))),
        float(size.mean()),
        float(size.max()),
        int(size.size),
        size.size * period,
    )


def tracking_error(run: Run, measured: str) -> Series | None:
    """Return measured less wanted of both channels at the stamps of the ``measured`` motion.

    The reference is interpolated, but over a switch its earlier sample holds; outside the
    reference there is no error. None when either is absent.
    """
    motion, reference = run.motions.get(measured), run.motions.get(REFERENCE)
    if motion is None or reference is None:
        return None
    inside = (motion.time >= reference.time[0]) & (motion.time <= reference.time[-1])
    time = motion.time[inside]
    before = np.clip(np.searchsorted(reference.time, time, 'right') - 1, 0, None)
    following = np.minimum(before + 1, len(reference) - 1)
    held = np.isin(reference.time[following], run.switches)
    errors = {}
    for wheel, *_ in run.channels:
        wanted = np.interp(time, reference.time, reference[wheel])
        wanted = np.where(held, reference[wheel][before], wanted)
        errors[wheel] = motion[wheel][inside] - wanted
    return Series(time, errors)


def driving(run: Run) -> tuple[float, float]:
    """Return from when to when the robot was being driven, s: first and last command but zero.

    Before, the controller did not follow the reference yet; after, it had stopped, though the
    reference is stamped ahead and goes on. A stop in between belongs to the drive. From infinity
    to minus infinity when every command was zero; the other way round when the bag has none.
    """
    command = run.motions.get(COMMAND)
    if command is None:
        return -math.inf, math.inf
    moving = command.time[(command['linear'] != 0.0) | (command['angular'] != 0.0)]
    return (float(moving[0]), float(moving[-1])) if moving.size else (math.inf, -math.inf)


def driven(time: Array, run: Run) -> NDArray[np.bool_]:
    """Return at which of ``time``, the stamps of an error, the robot was being driven (s).

    The first :data:`SETTLING` seconds with a command and a reference are left out: the robot
    has yet to catch up.
    """
    first, last = driving(run)
    since: Array = time - np.maximum(first, time[:1])
    return (since >= SETTLING) & (time <= last)


def foreseen(run: Run) -> float:
    """Return how long before a switch a controller may already be leaving the old reference, s.

    A switch is known as long before as the reference is stamped ahead. No controller needs
    longer for it than :data:`SETTLING`, however far ahead the stamps are.
    """
    return min(run.lead, SETTLING)


def settled(time: Array, switches: Array, before: float) -> NDArray[np.bool_]:
    """Return which of ``time`` are not about a switch, all in seconds.

    About a switch is from ``before`` seconds before it until :data:`SETTLING` seconds after it.
    """
    following = np.searchsorted(switches, time, 'right')
    since: Array = time - np.concatenate([[-math.inf], switches])[following]
    until: Array = np.concatenate([switches, [math.inf]])[following] - time
    return (since >= SETTLING) & (until > before)


def variation(series: Series, name: str) -> float:
    """Return the total variation per second of one quantity: how much it chatters."""
    if len(series) < 2:
        return math.nan
    return float(np.abs(np.diff(series[name])).sum() / (series.time[-1] - series.time[0]))


def latencies(run: Run) -> Series | None:
    """Return for each command how long after the newest odometry it was received (s)."""
    heard, told = run.receipts.get(ODOMETRY), run.receipts.get(COMMAND)
    if heard is None or told is None:
        return None
    index = np.searchsorted(heard, told, 'right') - 1
    told = told[index >= 0]
    return Series(told, {'value': told - heard[index[index >= 0]]}) if told.size else None


def estimation_target(run: Run, wheel: str) -> Series | None:
    r"""Return what the estimate g of one wheel should be: :math:`\dot\chi - u` (64), rad/s².

    The derivative is the slope of a straight line fitted to :data:`WINDOW` seconds of the
    measured wheel speed; the applied u is averaged with the weights that this slope has on the
    derivative, so that both see the same smoothing. It is NaN around switches, where u jumps
    between two of its sparse samples. None when either is absent.
    """
    motion = run.motions.get(run.measured)
    applied = run.numbers.get(f'controller/terms/applied/{wheel}')
    if motion is None or applied is None:
        return None
    step, half = WINDOW / 20, 10
    start = max(motion.time[0], applied.time[0])
    count = int((min(motion.time[-1], applied.time[-1]) - start) / step) + 1
    if count <= 2 * half + 1:
        return None
    grid = start + step * np.arange(count)
    speed = np.interp(grid, motion.time, motion[wheel])
    control = np.interp(grid, applied.time, applied['value'])
    offsets = np.arange(-half, half + 1.0)
    slope = offsets / (step * np.sum(offsets**2))
    # The slope is a weighted mean of the steps from point to point; their weights:
    weights = -step * np.cumsum(slope)[:-1]
    rate = np.correlate(speed, slope, 'valid')
    mean = np.correlate(0.5 * (control[:-1] + control[1:]), weights, 'valid')
    time = grid[half : count - half]
    reach = WINDOW / 2 + float(np.median(np.diff(applied.time)))
    near = np.searchsorted(run.switches, time - reach) < np.searchsorted(
        run.switches, time + reach
    )
    return Series(time, {'value': np.where(near, np.nan, rate - mean)})


def path_of(motion: Series, start: tuple[float, float, float]) -> tuple[Array, Array]:
    """Return x and y (m) of driving the twists of ``motion`` from a pose, by the arcs of (2)."""
    dt = np.diff(motion.time)
    turn = motion['angular'][:-1] * dt
    chord = motion['linear'][:-1] * dt * np.sinc(turn / math.tau)
    heading = start[2] + np.concatenate([[0.0], np.cumsum(turn)[:-1]]) + 0.5 * turn
    x = start[0] + np.concatenate([[0.0], np.cumsum(chord * np.cos(heading))])
    y = start[1] + np.concatenate([[0.0], np.cumsum(chord * np.sin(heading))])
    return x, y
