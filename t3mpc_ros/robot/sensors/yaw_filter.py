# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The arithmetic of odometry with a gyro: how it is fused, watched and calibrated.

State of the filter: x, y (m), heading (rad), the gyro's bias (rad/s) and its error of scale in
units of the tolerance; :mod:`t3mpc_ros.robot.sensors.fusion` says what the filter does and why.
"""

import math

import numpy as np
import numpy.typing as npt

from t3mpc_ros.kernels import kernel
from t3mpc_ros.robot.odometry import add_noise, follow_arc, wrapped

Array = npt.NDArray[np.float64]

# What the filter remembers besides pose and covariance; rates in rad/s, times in s.
(
    BIAS, CALIBRATED,
    FIRST_POLE, SECOND_POLE, LAST_RATE, LAST_DT,
    DISAGREEMENT, DISAGREES_FOR, SLIPPING,
    STANDS_FOR, PUSHED, COUNT, TIME, SUM, SQUARES,
    SUSPECT, SUSPECT_VARIANCE,
) = range(17)  # fmt: skip
MEMORY = 17
"""How many these are."""
STILL_RATE = 1e-4
"""rad/s, far below the gyro's noise: what is left of a turn in its filter is over."""
FEWEST_SAMPLES = 20
"""Fewer tell no spread."""


@kernel
def delayed_rate(memory: Array, rate: float, dt: float, delay: float) -> float:
    """Return the rate (rad/s) that a gyro of this ``delay`` (s) shows at the end of ``dt``.

    ``rate`` is the mean over ``dt``. Within it the rate is taken to change evenly, by what the
    means tell: taken as constant, it would be wrong by half a period's change. The two poles
    have half the delay each and are integrated exactly.
    """
    slope = 0.0
    if memory[LAST_DT] > 0.0:
        slope = 2.0 * (rate - memory[LAST_RATE]) / (dt + memory[LAST_DT])
    else:  # the first call: as if it had always been so
        memory[FIRST_POLE] = memory[SECOND_POLE] = rate
    memory[LAST_RATE], memory[LAST_DT] = rate, dt
    pole, start = 0.5 * delay, rate - 0.5 * slope * dt
    decay = math.exp(-dt / pole)
    first = memory[FIRST_POLE] - (start - slope * pole)
    second = memory[SECOND_POLE] - (start - 2.0 * slope * pole)
    memory[FIRST_POLE] = start + slope * (dt - pole) + first * decay
    memory[SECOND_POLE] = start + slope * (dt - 2.0 * pole) + (second + first * dt / pole) * decay
    return float(memory[SECOND_POLE])


@kernel
def watch_slip(memory: Array, excess: float, dt: float, limit: float, time: float) -> bool:
    """Decide whether gyro and steps disagree now; ``memory`` tells whether for long enough.

    excess : gyro less steps; limit : for its smoothed size, half of it ends a slip, rad/s
    time : after which it is slip, s
    """
    smoothing = time / 3.0
    memory[DISAGREEMENT] += (excess - memory[DISAGREEMENT]) * dt / (smoothing + dt)
    if memory[SLIPPING] > 0.0:
        limit *= 0.5
    if abs(memory[DISAGREEMENT]) <= limit:
        memory[DISAGREES_FOR] = memory[SLIPPING] = 0.0
        return False
    memory[DISAGREES_FOR] += dt
    if memory[DISAGREES_FOR] >= time:
        memory[SLIPPING] = 1.0
    return True


@kernel
def carry(
    matrix: Array,
    across: tuple[float, float],
    fused: tuple[float, float, float],
    dt: float,
    turn: float,
) -> None:
    """Let errors of heading, bias and scale move the pose: ``matrix`` <- F ``matrix`` F'.

    matrix : shape (5, 5), of (x, y, heading, bias, scale); changed in place
    across : d(x, y) by the heading; fused : d(pose) by the turn that the gyro tells
    dt : s, effect of the bias on that turn; turn : rad, effect of the scale
    """
    for column in range(5):
        told = dt * matrix[3, column] + turn * matrix[4, column]
        matrix[0, column] += across[0] * matrix[2, column] - fused[0] * told
        matrix[1, column] += across[1] * matrix[2, column] - fused[1] * told
        matrix[2, column] -= fused[2] * told
    for row in range(5):
        told = dt * matrix[row, 3] + turn * matrix[row, 4]
        matrix[row, 0] += across[0] * matrix[row, 2] - fused[0] * told
        matrix[row, 1] += across[1] * matrix[row, 2] - fused[1] * told
        matrix[row, 2] -= fused[2] * told


@kernel
def clear_window(memory: Array) -> None:
    """Start another average of the standing gyro."""
    memory[COUNT] = memory[TIME] = memory[SUM] = memory[SQUARES] = 0.0


@kernel
def learn_bias(
    pose: Array,
    covariance: Array,
    drift: Array,
    memory: Array,
    variance: float,
    spread: float,
    limit: float,
) -> None:
    """Take the window's mean for the bias if nobody moved the robot; correct the pose by it.

    A mean that is not to be expected (5 sigma) waits for a second one that agrees with it: a
    hand does not turn a robot so evenly. It is then a jump that may have come at any time since
    the last standstill, which is what ``drift``, grown to its size, stands for.

    covariance : shape (5, 5); drift, memory : see :func:`fuse`
    variance : of the mean, by the noise alone, above 0, (rad/s)²
    spread : largest standard deviation of the samples; limit : largest bias, rad/s
    """
    count = memory[COUNT]
    surprise = memory[SUM] / count
    scatter = max(memory[SQUARES] - surprise * memory[SUM], 0.0) / (count - 1.0)
    clear_window(memory)
    if scatter > spread * spread or abs(memory[BIAS] + surprise) > limit:
        memory[SUSPECT_VARIANCE] = 0.0
        return
    variance = max(variance, scatter / count)
    if memory[CALIBRATED] > 0.0 and surprise**2 > 25.0 * (covariance[3, 3] + variance):
        alone = memory[SUSPECT_VARIANCE] == 0.0
        apart = (surprise - memory[SUSPECT]) ** 2
        if alone or apart > 25.0 * (memory[SUSPECT_VARIANCE] + variance):
            memory[SUSPECT], memory[SUSPECT_VARIANCE] = surprise, variance
            return
        factor = surprise * surprise / drift[3, 3]
        for row in range(4):
            for column in range(4):
                covariance[row, column] += factor * drift[row, column]
    memory[SUSPECT_VARIANCE] = 0.0
    memory[CALIBRATED] = 1.0
    drift[:] = 0.0

    total = covariance[3, 3] + variance
    for row in range(3):
        pose[row] += covariance[row, 3] / total * surprise
    pose[2] = wrapped(pose[2])
    memory[BIAS] += covariance[3, 3] / total * surprise
    beside = (covariance[0, 3], covariance[1, 3], covariance[2, 3], covariance[3, 3])
    for row in range(4):
        for column in range(4):
            covariance[row, column] -= beside[row] * beside[column] / total


@kernel
def fuse(
    pose: Array,
    covariance: Array,
    drift: Array,
    memory: Array,
    values: Array,
    right: float,
    left: float,
    gyro: float,
    dt: float,
    jitter: float,
) -> None:
    """Move pose and covariance by two wheel angles and the gyro's rate at the end of ``dt``.

    With the variances V of the two paths and N of the gyro's turn, and h = 1 / 2b, the gyro's
    excess over the steps moves the paths by ``K excess dt``, ``K = V (h, -h) / (h² sum V + N)``.

    pose : shape (3,), m, m, rad; covariance : shape (5, 5); both changed in place
    drift : shape (5, 5), what a random walk of the bias by 1 rad/s/√s would have added to
        the covariance since the bias was last measured
    memory : shape (MEMORY,); values : shape (14,), see ``FusedOdometry.settings``
    right, left : rad; gyro : rad/s, NaN without one; dt : s; jitter : rad², of each angle
    """
    radius, half, per_metre, inflation = values[0], values[1], values[2], values[3]
    noise, tolerance, walk, delay, hold = values[4], values[5], values[6], values[7], values[8]
    limit, slip_time, window, spread = values[9], values[10], values[11], values[12]
    heard = not math.isnan(gyro)
    run_right, run_left, share = radius * right, radius * left, 0.5 / half
    delayed = delayed_rate(memory, share * (run_right - run_left) / dt, dt, delay)
    still = right == 0.0 and left == 0.0 and abs(delayed) < STILL_RATE
    memory[STANDS_FOR] = memory[STANDS_FOR] + dt if still else 0.0

    # How uncertain the paths are, and how far the gyro may correct them.
    told = turn = noise_turn = gain_right = gain_left = 0.0
    constant = radius * radius * jitter
    path_right, path_left, rough = abs(run_right), abs(run_left), per_metre
    if heard and memory[CALIBRATED] > 0.0:
        rate = gyro - memory[BIAS]
        excess, brief = rate - delayed, min(dt, hold)
        disagrees = watch_slip(
            memory, excess, brief, limit + 3.0 * tolerance * abs(rate), slip_time
        )
        # A hand that pushes back and forth passes through zero: it is heard to the end.
        memory[PUSHED] = max(memory[PUSHED] - dt, 0.0)
        if memory[STANDS_FOR] > slip_time and abs(memory[DISAGREEMENT]) > 3.0 * spread:
            memory[PUSHED] = window
        pushed = still and memory[PUSHED] > 0.0
        if disagrees or pushed:  # the path that the steps know nothing of is one as well
            rough *= inflation
            path_right += half * abs(excess) * dt
            path_left += half * abs(excess) * dt
        elif right == 0.0 and left == 0.0 and not still:
            # The gyro still shows the end of the turn: hear it to the end.
            path_right = path_left = half * abs(delayed) * dt
        noise_right, noise_left = rough * path_right + constant, rough * path_left + constant
        noise_steps = share * share * (noise_right + noise_left)
        if noise_steps > 0.0:
            # One sample stands for all of dt, though its noise does not average out over it.
            noise_turn = noise * noise * dt * max(1.0, 0.5 * dt / delay)
            noise_turn += noise_steps * max(0.0, dt / hold - 1.0)
            gain_right = share * noise_right / (noise_steps + noise_turn)
            gain_left = -share * noise_left / (noise_steps + noise_turn)
        told, turn = excess * dt, tolerance * rate * dt
    else:
        memory[DISAGREEMENT] = memory[DISAGREES_FOR] = memory[SLIPPING] = 0.0
        memory[PUSHED] = 0.0
        noise_right, noise_left = rough * path_right + constant, rough * path_left + constant

    across_x, across_y, right_x, right_y, left_x, left_y, bend = follow_arc(
        pose, run_right + gain_right * told, run_left + gain_left * told, half
    )
    fused = (
        right_x * gain_right + left_x * gain_left,
        right_y * gain_right + left_y * gain_left,
        bend * (gain_right - gain_left),
    )
    carry(covariance, (across_x, across_y), fused, dt, turn)
    carry(drift, (across_x, across_y), fused, dt, 0.0)
    mine, yours, bent = share * fused[0], share * fused[1], share * fused[2]
    add_noise(covariance, noise_right, right_x - mine, right_y - yours, bend - bent)
    add_noise(covariance, noise_left, left_x + mine, left_y + yours, bent - bend)
    add_noise(covariance, noise_turn, fused[0], fused[1], fused[2])
    covariance[3, 3] += walk * walk * dt
    drift[3, 3] += dt

    if not (still and heard):
        clear_window(memory)
        memory[SUSPECT_VARIANCE] = 0.0
    else:
        deviation = gyro - memory[BIAS]
        memory[COUNT] += 1.0
        memory[TIME] += dt
        memory[SUM] += deviation
        memory[SQUARES] += deviation * deviation
        if memory[TIME] >= window and memory[COUNT] >= FEWEST_SAMPLES:
            single = max(1.0 / memory[TIME], 0.5 / (delay * memory[COUNT]))
            learn_bias(pose, covariance, drift, memory, noise * noise * single, spread, values[13])
    for row in range(1, 5):  # rounding must not tear it apart over hours
        for column in range(row):
            mean = 0.5 * (covariance[row, column] + covariance[column, row])
            covariance[row, column] = covariance[column, row] = mean
