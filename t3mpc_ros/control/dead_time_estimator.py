# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Estimate of the dead time of a velocity drive, and detection of a disturbed response.

The commanded wheel speeds c, filtered by the known lag, chi' = (c - chi)/lag, reach the
measurement tau seconds late: m(t) = chi(t - tau) + offset + noise. For each tau of a grid the
squared errors of this model are summed, divided by their variance; a parabola through the
smallest sum gives the maximum-likelihood estimate, and its curvature the Fisher information,
sum (dchi/dt)^2/variance. The prior is a parabola around the configured dead time.

Coulomb friction, by which a servo is slower than commanded, changes with the direction of motion
and would count as a delay. If there may be friction, every dead time of the grid is therefore
fitted together with the friction of both wheels, by recursive least squares.

For smooth commands only dead time + lag is identifiable: a lag that is wrong by some
milliseconds moves the estimate by as much in the other direction, and their sum, which the
preview of the reference needs, is unchanged. Between two periods the response is interpolated
linearly, which is exact for a small lag and speeds that are means over a period. A response of
the motors that is slower than the lag is part of the estimate.

Data is accepted in blocks, one block late, so that data from shortly before a disturbance is
discarded with it:

- The *disturbance* test compares the normalised innovation squared in a sliding window with its
  chi-square bound, and the likelihood of the estimate with that of the best other dead time.
- A block that contradicts the estimate is kept apart, with those after it. If newer data fits
  the estimate again, they are discarded, so commands that were late for some seconds do not
  change the estimate. If they last for :data:`ADOPTION_TIME` of driving, they replace it.
"""

import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.speed_filter import SpeedFilterParameters
from t3mpc_ros.kernels import kernel

Array = NDArray[np.float64]

MAX_DEAD_TIME = 0.15
"""Largest dead time of the grid, s."""
GRID_STEP = 0.005
"""Distance of two dead times of the grid, s."""
GRID_SIZE = 31

PRIOR_DEVIATION = 0.03
"""Standard deviation of the configured dead time, s."""
IDENTIFIED_DEVIATION = 0.005
"""Standard deviation at and below which the dead time is identified, s."""
USED_DIFFERENCE, USED_DEVIATIONS = 0.004, 3.0
"""Difference (s), and its multiple of the standard deviation, up to which the configured dead time
is kept: so much the estimate is off if the drive responds otherwise than the lag describes."""
MIN_DEVIATION = 0.0005
"""Standard deviation at which older data is forgotten as newer data is accepted, s."""
UNCERTAINTY_FACTOR = 2.0
"""Factor of the standard deviation in the tests, for errors that are not noise."""
TOLERANCE = 0.004
"""Standard deviation of the dead time within a run that is no disturbance, s."""
RATE_TOLERANCE = 0.02
"""Model error of fast changes: a ramp limit of the robot and its oscillation add to the delay, s.

It is the same for all measurements of one change, so it must not be averaged out."""

FRICTION_WIDTH = 0.3
"""Filtered wheel speed at which the Coulomb friction of the model has 76 % of its value, rad/s."""
FRICTION_DEVIATION = 0.3
"""Prior standard deviation of the speed that friction takes from a wheel, rad/s."""
FRICTION_WALK = 0.01
"""Standard deviation of its change in a second, rad/s."""
SERVO_VARIANCE = 0.04
"""Least variance of the speeds of a servo, (rad/s)². Disturbances move it for many periods, so as
white noise they count for more than their size."""

OFFSET_TIME = 1.0
"""Time constant of the offset between measurement and model, which is no delay, s."""
RATE_HOLD_TIME = 0.1
"""Time constant with which the drive settles after an acceleration, s."""
WINDOW_TIME = 0.15
"""Time constant of the window of the disturbance test, s."""
CLEAR_TIME = 0.3
"""Time without evidence after which a disturbance has ended, s."""
BLOCK_TIME, BLOCK_MAX_TIME = 0.25, 2.0
"""Duration of a block with enough information, and of any block, s."""
BLOCK_DEVIATION = 0.012
"""Standard deviation from one block that has enough information, s."""
ADOPTION_TIME = 15.0
"""Driving time after which a changed response is adopted, s."""

NOISE_QUANTILE = 5.0
"""Bound of the chi-square test, as a quantile of the normal distribution."""
RATIO_BOUND = 18.0
"""Likelihood ratio, 2 log, above which a better dead time is evidence of a disturbance."""
QUIET_EVIDENCE = 0.7
"""Fraction of the bounds below which the response may be undisturbed again."""
BLOCK_BOUND = 9.0
"""Likelihood ratio, 2 log, of a block that contradicts the estimate."""
RECENT_DEVIATION = 0.007
"""Standard deviation of an estimate from the recent data alone, s."""
DRIVING_INFORMATION = 1000.0
"""Information per second from which time counts as driving, 1/s³: 0.5 rad/s² by default."""
CLIP = 16.0
"""Squared errors are limited to this multiple of their variance."""
NOISE_PRIOR_RATIO = 1.5
"""Prior of the variance of the innovation, as a multiple of the noise variance."""
NOISE_PRIOR_COUNT = 100.0
"""Weight of that prior, in measured speeds."""
MIN_NOISE_VARIANCE = 1e-4
"""Variance of measured speeds that are configured as exact, (rad/s)²."""
NOISE_MAX_COUNT = 4000.0
"""Number of measured speeds in the estimate of the variance of the innovation."""

SCALARS = 0
"""Row of the state: :data:`DEAD_TIME` to :data:`RESPONSE`."""
AGE, UNDELAYED = 1, 2
"""Rows of the history, newest first: age (s), and response without dead time (rad/s), two rows."""
OFFSET, ERROR = 4, 6
"""Two rows each: offsets and errors (rad/s) of each dead time of the grid."""
WINDOW, BLOCK, PENDING, ACCEPTED, RECENT, REJECTED = range(8, 14)
"""Rows of data: the sum of squared errors of each dead time of the grid, then the columns
:data:`DURATION` to :data:`NIS`."""
COEFFICIENTS = 14
"""Four rows: shares of the friction of right and left wheel in the error of the right wheel, and
in that of the left one, of each dead time of the grid, rad/s."""
FRICTION = 18
"""Row of the regressor of friction, columns :data:`FILTERED` to :data:`COVARIANCE`."""
ROWS = 19
FILTERED, MEAN, COVARIANCE = 0, 2, 4
"""Columns: filtered speeds (rad/s) and means of their signs, two each, and the covariance of the
coefficients: right, mixed, left ((rad/s)²)."""
DURATION, COUNT, INFORMATION, NIS = range(GRID_SIZE, GRID_SIZE + 4)
"""Columns: s, number of speeds, Fisher information (1/s²), normalised innovation squared."""
COLUMNS = GRID_SIZE + 4
(
    DEAD_TIME,
    DEVIATION,
    NOISE_RATIO,
    NOISE_COUNT,
    RATE,
    DISTURBED,
    QUIET_TIME,
    BLOCK_DISTURBED,
    SUPPORT,
    RESPONSE,
) = range(10)
"""Columns of the scalars: s, s, variance ratio, its weight, rad/s², flag, s, flag, ratio, and
filtered command (rad/s), two columns."""


class DeadTimeEstimator:
    """Estimates the dead time of a velocity drive from sent and measured wheel speeds.

    The estimate is a function of the calls in their order.

    Parameters
    ----------
    parameters
        Lag of the drive, variance of the measured speeds, and dead time: the prior.
    period
        Nominal time between steps, s.
    mean_speeds
        Whether the measured speeds are means over a period, as those from counters of steps or
        encoder pulses, or the speeds at the stamp.
    friction
        Whether friction and disturbances move the wheels, as with a servo; a stepper motor follows
        exactly.

    Raises
    ------
    ValueError
        The period is not positive.
    """

    def __init__(
        self,
        parameters: SpeedFilterParameters,
        period: float,
        *,
        mean_speeds: bool = True,
        friction: bool = False,
    ) -> None:
        if not period > 0.0:
            raise ValueError(f'period must be positive: got {period} s')
        self._period = period
        self._mean_speeds, self._friction = mean_speeds, friction
        self._lag = parameters.lag
        self._configured = parameters.dead_time
        least = SERVO_VARIANCE if friction else MIN_NOISE_VARIANCE
        self._noise_variance = max(parameters.noise_variance, least)
        history = math.ceil(1.25 * MAX_DEAD_TIME / period) + 2
        self.state: Array = np.zeros((ROWS, max(COLUMNS, history)))
        """All that changes: a copy, written back, continues bit-equal."""
        prior = min(parameters.dead_time, MAX_DEAD_TIME)
        self.state[SCALARS, DEAD_TIME] = prior
        self.state[SCALARS, DEVIATION] = PRIOR_DEVIATION
        self.state[SCALARS, NOISE_RATIO] = NOISE_PRIOR_RATIO
        self.state[SCALARS, NOISE_COUNT] = NOISE_PRIOR_COUNT
        grid = GRID_STEP * np.arange(GRID_SIZE)
        costs = NOISE_PRIOR_RATIO * ((grid - prior) / PRIOR_DEVIATION) ** 2
        self.state[ACCEPTED, :GRID_SIZE] = costs
        self.state[FRICTION, [COVARIANCE, COVARIANCE + 2]] = FRICTION_DEVIATION**2
        self.reset(np.zeros(2))

    @property
    def dead_time(self) -> float:
        """Estimate, from 0 to :data:`MAX_DEAD_TIME`, s."""
        return float(self.state[SCALARS, DEAD_TIME])

    @property
    def dead_time_in_use(self) -> float:
        """The configured dead time, or the estimate where it clearly differs, s."""
        dead_time, deviation = self.state[SCALARS, : DEVIATION + 1].tolist()
        clear = max(USED_DIFFERENCE, USED_DEVIATIONS * deviation)
        return dead_time if abs(dead_time - self._configured) > clear else self._configured

    @property
    def standard_deviation(self) -> float:
        """Standard deviation of the estimate from the noise, s."""
        return float(self.state[SCALARS, DEVIATION])

    @property
    def identified(self) -> bool:
        """Whether the data determines the dead time, within the bounds of the grid."""
        inside = self.dead_time < MAX_DEAD_TIME - 0.5 * GRID_STEP
        return inside and self.standard_deviation <= IDENTIFIED_DEVIATION

    @property
    def disturbed(self) -> bool:
        """Whether the measured speeds do not fit the commands; nothing is learned from them."""
        return bool(self.state[SCALARS, DISTURBED])

    @property
    def noise_ratio(self) -> float:
        """Variance of the innovation as a multiple of the noise variance, at least 1."""
        return float(self.state[SCALARS, NOISE_RATIO])

    def reset(self, speeds: Array) -> None:
        """Restart at measured wheel speeds (rad/s) with equal commands; the estimate is kept.

        Data that is not accepted yet is discarded, and a disturbance has ended.
        """
        state = self.state
        state[OFFSET : ERROR + 2] = 0.0
        state[WINDOW : PENDING + 1] = 0.0
        state[SCALARS, RATE : BLOCK_DISTURBED + 1] = 0.0
        state[AGE] = self._period * np.arange(state.shape[1])
        state[UNDELAYED : UNDELAYED + 2] = speeds[:, np.newaxis]
        state[SCALARS, RESPONSE : RESPONSE + 2] = speeds
        state[FRICTION, FILTERED : FILTERED + 2] = speeds
        state[FRICTION, MEAN : MEAN + 2] = np.tanh(speeds / FRICTION_WIDTH)

    def step(self, measured: Array, command: Array, dt: float) -> bool:
        """Update the estimate with one measurement; return whether the response is disturbed.

        Parameters
        ----------
        measured
            Measured wheel speeds, rad/s, shape (2,), with white noise.
        command
            Wheel speeds (rad/s) sent at the previous step, after the limits, shape (2,); the
            robot keeps them until the next ones arrive.
        dt
            Time since the previous measurement, s, positive. After a gap that stops the robot,
            call :meth:`reset` instead.
        """
        return update_dead_time(
            self.state,
            self._lag,
            self._period,
            self._noise_variance,
            self._mean_speeds,
            self._friction,
            measured,
            command,
            dt,
        )


@kernel
def update_dead_time(
    state: Array,
    lag: float,
    period: float,
    noise_variance: float,
    mean_speeds: bool,
    friction: bool,
    measured: Array,
    command: Array,
    dt: float,
) -> bool:
    """Update the estimate with one measurement; return whether the response is disturbed.

    state : shape (ROWS, at least COLUMNS), rows from SCALARS to REJECTED
    dt    : time since the last measurement, s
    other arguments as in :class:`DeadTimeEstimator`
    """
    # Response without dead time; a gap in the measurements is divided into periods.
    scalars = state[SCALARS]
    size = state.shape[1]
    parts = max(1, round(dt / period))
    decay = math.exp(-dt / parts / lag)
    mean_decay = lag * parts / dt * (1.0 - decay) if mean_speeds else decay
    for _ in range(parts):
        for j in range(size - 1, 0, -1):
            state[AGE, j] = state[AGE, j - 1] + dt / parts
            for i in range(2):
                state[UNDELAYED + i, j] = state[UNDELAYED + i, j - 1]
        state[AGE, 0] = 0.0
        for i in range(2):
            difference = scalars[RESPONSE + i] - command[i]
            state[UNDELAYED + i, 0] = command[i] + mean_decay * difference
            scalars[RESPONSE + i] = command[i] + decay * difference

    # Errors of each dead time of the grid. Each has its own offset, so that a constant load counts
    # as no delay.
    j = 0
    share = min(1.0, dt / OFFSET_TIME)
    for g in range(GRID_SIZE):
        age = g * GRID_STEP
        while j < size - 2 and state[AGE, j + 1] < age:
            j += 1
        weight = min(1.0, (age - state[AGE, j]) / (state[AGE, j + 1] - state[AGE, j]))
        for i in range(2):
            newer, older = state[UNDELAYED + i, j], state[UNDELAYED + i, j + 1]
            error = measured[i] - newer - weight * (older - newer) - state[OFFSET + i, g]
            state[ERROR + i, g] = error
            state[OFFSET + i, g] += share * error
    spread = remove_friction(state, lag, noise_variance, measured, dt) if friction else 0.0

    # Variances. After an acceleration the drive oscillates: the rate is held.
    g = min(int(scalars[DEAD_TIME] / GRID_STEP), GRID_SIZE - 2)
    weight = scalars[DEAD_TIME] / GRID_STEP - g
    rate = scalars[RATE] * math.exp(-dt / RATE_HOLD_TIME)
    squared_slope = 0.0
    for i in range(2):
        slope = (state[ERROR + i, g + 1] - state[ERROR + i, g]) / GRID_STEP
        squared_slope += slope**2
        rate = max(rate, abs(slope))
    scalars[RATE] = rate
    variance = noise_variance + spread + (RATE_TOLERANCE * rate) ** 2
    uncertainty = estimate_uncertainty(scalars)
    innovation_variance = noise_variance + spread + uncertainty * rate**2
    clip = CLIP * scalars[NOISE_RATIO]
    nis = 0.0
    for i in range(2):
        newer, older = state[ERROR + i, g], state[ERROR + i, g + 1]
        nis += min((newer + weight * (older - newer)) ** 2 / innovation_variance, clip)

    forget = math.exp(-dt / WINDOW_TIME)
    for j in range(COLUMNS):
        state[WINDOW, j] *= forget
    for g in range(GRID_SIZE):
        cost = 0.0
        for i in range(2):
            cost += min(state[ERROR + i, g] ** 2 / variance, clip)
        state[WINDOW, g] += cost
        state[BLOCK, g] += cost
    for row in (WINDOW, BLOCK):
        state[row, DURATION] += dt
        state[row, COUNT] += 2.0
        state[row, INFORMATION] += squared_slope / variance
        state[row, NIS] += nis

    # Disturbance test. The mean of an exponential window has the variance of a mean of
    # (1 + forget)/(1 - forget) equal weights; bound of Wilson and Hilferty.
    spread = (1.0 - forget) / (1.0 + forget) / 9.0
    bound = (1.0 - spread + NOISE_QUANTILE * math.sqrt(spread)) ** 3
    mean = state[WINDOW, NIS] / state[WINDOW, COUNT] / scalars[NOISE_RATIO]
    ratio = max(scalars[SUPPORT], likelihood_ratio(state, WINDOW))
    evidence = max(mean / bound, ratio / RATIO_BOUND)
    if state[WINDOW, DURATION] > 0.6 * WINDOW_TIME and evidence > 1.0:
        scalars[DISTURBED] = 1.0
    if scalars[DISTURBED] > 0.0:
        scalars[BLOCK_DISTURBED] = 1.0
        scalars[QUIET_TIME] = 0.0 if evidence > QUIET_EVIDENCE else scalars[QUIET_TIME] + dt
        if scalars[QUIET_TIME] >= CLEAR_TIME:
            scalars[DISTURBED] = scalars[QUIET_TIME] = 0.0
    duration = state[BLOCK, DURATION] + 0.5 * period
    enough = state[BLOCK, INFORMATION] * BLOCK_DEVIATION**2 >= scalars[NOISE_RATIO]
    enough |= scalars[BLOCK_DISTURBED] > 0.0 or duration >= BLOCK_MAX_TIME
    enough |= scalars[DEVIATION] > IDENTIFIED_DEVIATION
    if enough and duration >= BLOCK_TIME:
        assess_block(state)
    return bool(scalars[DISTURBED] > 0.0)


@kernel
def remove_friction(
    state: Array, lag: float, noise_variance: float, measured: Array, dt: float
) -> float:
    """Remove the friction from the errors; return the variance ((rad/s)²) that this adds.

    Coulomb friction of the two wheels, which the body couples, takes a speed of
    A tanh(chi/width) from them, with the offset's mean removed. Each dead time of the grid has
    its own A, by recursive least squares: dead times are compared by what friction cannot
    explain. The regressor and hence the covariance are the same for all.

    state : see :func:`update_dead_time`
    """
    row = state[FRICTION]
    share = min(1.0, dt / OFFSET_TIME)
    right = math.tanh(row[FILTERED] / FRICTION_WIDTH) - row[MEAN]
    left = math.tanh(row[FILTERED + 1] / FRICTION_WIDTH) - row[MEAN + 1]
    row[MEAN] += share * right
    row[MEAN + 1] += share * left
    # Friction acts through the lag of the drive, so the speed is filtered alike. It is that
    # before this measurement, whose noise is in the errors.
    for i in range(2):
        row[FILTERED + i] += (1.0 - math.exp(-dt / lag)) * (measured[i] - row[FILTERED + i])
    own, mixed, other = row[COVARIANCE], row[COVARIANCE + 1], row[COVARIANCE + 2]
    gain_right = own * right + mixed * left
    gain_left = mixed * right + other * left
    spread = right * gain_right + left * gain_left
    total = noise_variance + spread
    for g in range(GRID_SIZE):
        for i in range(2):
            first, second = COEFFICIENTS + 2 * i, COEFFICIENTS + 2 * i + 1
            state[ERROR + i, g] -= state[first, g] * right + state[second, g] * left
            state[first, g] += gain_right / total * state[ERROR + i, g]
            state[second, g] += gain_left / total * state[ERROR + i, g]
    walk, limit = FRICTION_WALK**2 * dt, FRICTION_DEVIATION**2
    row[COVARIANCE] = min(own - gain_right * gain_right / total + walk, limit)
    row[COVARIANCE + 1] = mixed - gain_right * gain_left / total
    row[COVARIANCE + 2] = min(other - gain_left * gain_left / total + walk, limit)
    return float(spread)


@kernel
def estimate_uncertainty(scalars: Array) -> float:
    """Return the variance (s²) of the dead time that contradicts no estimate.

    Before the dead time is identified, every dead time is possible.
    """
    deviation = UNCERTAINTY_FACTOR * scalars[DEVIATION]
    if scalars[DEVIATION] > IDENTIFIED_DEVIATION:
        deviation = 0.5 * MAX_DEAD_TIME
    return float(deviation**2 + TOLERANCE**2)


@kernel
def assess_block(state: Array) -> None:
    """Accept or reject the data of a block; adopt rejected data that persists.

    state : see :func:`update_dead_time`
    """
    scalars = state[SCALARS]
    information = state[BLOCK, INFORMATION] / scalars[NOISE_RATIO]
    # Recent data is forgotten as new information arrives, not while the robot stands.
    keep = math.exp(-information * RECENT_DEVIATION**2)
    for j in range(COLUMNS):
        state[RECENT, j] = keep * state[RECENT, j] + state[BLOCK, j]
    scalars[SUPPORT] = likelihood_ratio(state, RECENT)
    fits = scalars[BLOCK_DISTURBED] == 0.0 and scalars[SUPPORT] < BLOCK_BOUND
    if fits and likelihood_ratio(state, BLOCK) < BLOCK_BOUND:
        if scalars[DEVIATION] <= IDENTIFIED_DEVIATION:
            count = scalars[NOISE_COUNT] + state[PENDING, COUNT]
            total = scalars[NOISE_RATIO] * scalars[NOISE_COUNT] + state[PENDING, NIS]
            scalars[NOISE_RATIO] = max(total / count, 1.0)
            scalars[NOISE_COUNT] = min(count, NOISE_MAX_COUNT)
        for j in range(COLUMNS):
            state[ACCEPTED, j] += state[PENDING, j]
            state[PENDING, j] = state[BLOCK, j]
            state[REJECTED, j] = 0.0
        set_estimate(state)
    else:
        driving = information >= DRIVING_INFORMATION * state[BLOCK, DURATION]
        for j in range(COLUMNS):
            state[PENDING, j] = 0.0
            if j < GRID_SIZE or driving:
                state[REJECTED, j] += state[BLOCK, j]
        if state[REJECTED, DURATION] >= ADOPTION_TIME:
            _, least, _ = minimum(state[REJECTED])
            scalars[NOISE_RATIO] = max(least / state[REJECTED, COUNT], 1.0)
            scalars[NOISE_COUNT] = NOISE_PRIOR_COUNT
            for j in range(COLUMNS):
                state[ACCEPTED, j] = state[REJECTED, j]
                state[WINDOW, j] = state[RECENT, j] = state[REJECTED, j] = 0.0
            scalars[SUPPORT] = 0.0
            set_estimate(state)
    for j in range(COLUMNS):
        state[BLOCK, j] = 0.0
    scalars[BLOCK_DISTURBED] = scalars[DISTURBED]


@kernel
def set_estimate(state: Array) -> None:
    """Set the estimate from the accepted data, of which the oldest is forgotten.

    state : see :func:`update_dead_time`
    """
    scalars, accepted = state[SCALARS], state[ACCEPTED]
    ratio = scalars[NOISE_RATIO]
    dead_time, least, curvature = minimum(accepted)
    # While the likelihood is wider than the grid step, its variance is that over the grid.
    total = first = second = 0.0
    for g in range(GRID_SIZE):
        accepted[g] -= least
        weight = math.exp(-0.5 * accepted[g] / ratio)
        total += weight
        first += weight * g * GRID_STEP
        second += weight * (g * GRID_STEP) ** 2
    variance = second / total - (first / total) ** 2
    if variance < GRID_STEP**2:
        variance = 2.0 * ratio / curvature
    if variance < MIN_DEVIATION**2:
        for j in range(COLUMNS):
            accepted[j] *= variance / MIN_DEVIATION**2
        variance = MIN_DEVIATION**2
    scalars[DEAD_TIME] = dead_time
    scalars[DEVIATION] = min(math.sqrt(variance), PRIOR_DEVIATION)


@kernel
def minimum(costs: Array) -> tuple[float, float, float]:
    """Return dead time (s), cost and second derivative (1/s²) at the minimum of the costs.

    They are those of the parabola through the smallest cost of the grid and its neighbours.
    """
    best = 0
    for g in range(1, GRID_SIZE):
        if costs[g] < costs[best]:
            best = g
    g = min(max(best, 1), GRID_SIZE - 2)
    slope = 0.5 * (costs[g + 1] - costs[g - 1])
    curvature = max(costs[g + 1] - 2.0 * costs[g] + costs[g - 1], 1e-12)
    offset = min(max(-slope / curvature, -1.0), 1.0)
    least = costs[g] + offset * (slope + 0.5 * curvature * offset)
    return (g + offset) * GRID_STEP, least, curvature / GRID_STEP**2


@kernel
def likelihood_ratio(state: Array, row: int) -> float:
    """Return 2 log of the likelihood ratio of the best dead time and the estimate.

    The uncertainty of the estimate, which is no contradiction, reduces it.

    state : see :func:`update_dead_time`
    row   : row of the data
    """
    scalars, costs = state[SCALARS], state[row]
    _, least, _ = minimum(costs)
    position = scalars[DEAD_TIME] / GRID_STEP
    g = min(max(int(position + 0.5), 1), GRID_SIZE - 2)
    offset = position - g
    slope = 0.5 * (costs[g + 1] - costs[g - 1])
    curvature = costs[g + 1] - 2.0 * costs[g] + costs[g - 1]
    cost = costs[g] + offset * (slope + 0.5 * curvature * offset)
    uncertainty = estimate_uncertainty(scalars)
    return float((cost - least) / (scalars[NOISE_RATIO] + costs[INFORMATION] * uncertainty))
