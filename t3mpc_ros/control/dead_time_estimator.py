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
from typing import Any, NamedTuple

import numpy as np

from t3mpc_ros.control.speed_kalman_filter import SpeedFilterParameters
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import TypedKernel, contiguous, kernel

MAX_DEAD_TIME = 0.15  # largest dead time of the grid, s
GRID_STEP = 0.005  # distance of two dead times of the grid, s
GRID_SIZE = 31

PRIOR_DEVIATION = 0.03  # standard deviation of the configured dead time, s
IDENTIFIED_DEVIATION = 0.005
"""Standard deviation at and below which the dead time is identified, s."""
USED_DIFFERENCE, USED_EVIDENCE = 0.004, 7.0
"""Difference (s), and likelihood ratio, 2 log, up to which the configured dead time is kept: so
much the estimate is off if the drive responds otherwise than the lag describes."""
MIN_DEVIATION = 0.0005
"""Standard deviation at which older data is forgotten as newer data is accepted, s."""
UNCERTAINTY_FACTOR = 2.0
"""Factor of the standard deviation in the tests, for errors that are not noise."""
TOLERANCE = 0.004  # standard deviation of the dead time within a run that is no disturbance, s
RATE_TOLERANCE = 0.02
"""Model error of fast changes: a ramp limit of the robot and its oscillation add to the delay, s.

It is the same for all measurements of one change, so it must not be averaged out."""

FRICTION_WIDTH = 0.3
"""Filtered wheel speed at which the Coulomb friction of the model has 76 % of its value, rad/s."""
FRICTION_DEVIATION = 0.3
"""Prior standard deviation of the speed that friction takes from a wheel, rad/s."""
FRICTION_WALK = 0.01  # standard deviation of its change in a second, rad/s
SERVO_VARIANCE = 0.04
"""Least variance of the speeds of a servo, (rad/s)². Disturbances move it for many periods, so as
white noise they count for more than their size."""

OFFSET_TIME = 1.0
"""Time constant of the offset between measurement and model, which is no delay, s."""
RATE_HOLD_TIME = 0.1  # time constant with which the drive settles after an acceleration, s
WINDOW_TIME = 0.15  # time constant of the window of the disturbance test, s
CLEAR_TIME = 0.3  # time without evidence after which a disturbance has ended, s
BLOCK_TIME, BLOCK_MAX_TIME = 0.25, 2.0
"""Duration of a block with enough information, and of any block, s."""
BLOCK_DEVIATION = 0.012  # standard deviation from one block that has enough information, s
ADOPTION_TIME = 15.0  # driving time after which a changed response is adopted, s
CHANGE_TIME, CHANGE_FIT = 3.5, 1.1
"""The same (s) where one dead time explains it as well, up to this factor of the squared errors,
as the estimate explains what is accepted: late commands of a busy machine have no such time."""
RETURN_TIME, RETURN_DIFFERENCE = 1.5, 0.008
"""The same (s) for a return to within some difference (s) of the configured dead time."""
SUPPORT = 1.0
"""Likelihood ratio, 2 log, by which a block must prefer what the blocks before it show."""
DRIFT_BOUND, SERVO_DRIFT_BOUND, DRIFT_MEMORY = 2.0, 4.0, 0.25
"""Likelihood ratio, 2 log, of the recent data above which the estimate may be about to drift, the
same of a servo, whose disturbances are no white noise, and the factor by which accepted data is
then forgotten with each block."""

NOISE_QUANTILE = 5.0  # bound of the chi-square test, as a quantile of the normal distribution
RATIO_BOUND = 18.0
"""Likelihood ratio, 2 log, above which a better dead time is evidence of a disturbance."""
QUIET_EVIDENCE = 0.7  # fraction of the bounds below which the response may be undisturbed again
BLOCK_BOUND = 9.0  # likelihood ratio, 2 log, of a block that contradicts the estimate
RECENT_DEVIATION = 0.007  # standard deviation of an estimate from the recent data alone, s
DRIVING_INFORMATION = 1000.0
"""Information per second from which time counts as driving, 1/s³: 0.5 rad/s² by default."""
CLIP = 16.0  # squared errors are limited to this multiple of their variance
NOISE_PRIOR_RATIO = 1.5
"""Prior of the variance of the innovation, as a multiple of the noise variance."""
NOISE_PRIOR_COUNT = 100.0  # weight of that prior, in measured speeds
MIN_NOISE_VARIANCE = 0.01
"""Least variance of measured speeds, (rad/s)², also where they are configured as exact: counts of
16 microsteps have 0.006 at 100 Hz."""
NOISE_MAX_COUNT = 4000.0
"""Number of measured speeds in the estimate of the variance of the innovation."""

WHITE_MEDIAN = 0.954
"""Median of the change between two samples of white noise, in its standard deviation."""
CHANGE_STEP = 0.01  # relative step by which the median of the changes follows each of them
LOUD = 2.0
"""Factor of the variance of the innovation above which noise, by the change of the error from one
measurement to the next, is larger than assumed: a wrong dead time or load changes it slowly."""

UNKNOWN = np.full(2, math.nan)  # speeds that nothing measures

NOISY_POSE = 4.0
"""Variance of the innovation by the pose, over the noise variance, from which it says nothing, as
that of a pose which is rounded."""

EVIDENCE = np.dtype(
    (
        np.record,
        [
            ('costs', 'f8', GRID_SIZE),  # of each dead time of the grid: errors² / their variance
            ('linear', 'f8', GRID_SIZE),  # the same of the mean of both wheels
            ('by_pose', 'f8', GRID_SIZE),  # the same of both wheels, by the pose
            ('poses', 'f8'),  # number of speeds by the pose
            ('duration', 'f8'),  # s
            ('count', 'f8'),  # number of speeds
            ('information', 'f8'),  # Fisher information, 1/s²
            ('nis', 'f8'),  # normalised innovation squared
        ],
    )
)
"""Sums over some data."""
ESTIMATE = np.dtype(
    (
        np.record,
        [
            ('dead_time', 'f8'),  # s
            ('deviation', 'f8'),  # s
            ('configured', 'f8'),  # s
            ('noise_ratio', 'f8'),  # variance of the innovation / noise variance
            ('noise_count', 'f8'),  # weight of that ratio, in measured speeds
            # Median change of the error from one measurement to the next, not below that of the
            # assumed noise, rad/s.
            ('change', 'f8'),
            ('last_error', 'f8', 2),  # of the dead time in question, rad/s
            ('rate', 'f8'),  # change of the speeds, held for a while, rad/s²
            ('disturbed', '?'),
            ('quiet_time', 'f8'),  # without evidence of a disturbance, s
            ('block_disturbed', '?'),
            ('support', 'f8'),  # likelihood ratio of the recent data
            ('response', 'f8', 2),  # filtered command, rad/s
            ('offset', 'f8', (2, GRID_SIZE)),  # of wheel and dead time of the grid, rad/s
            ('error', 'f8', (2, GRID_SIZE)),  # rad/s
            ('pose_offset', 'f8', (2, GRID_SIZE)),  # the same of the speeds by the pose
            ('pose_error', 'f8', (2, GRID_SIZE)),
            ('filtered', 'f8', 2),  # measured speeds behind the lag, rad/s
            ('mean_sign', 'f8', 2),  # mean of tanh(filtered / FRICTION_WIDTH)
            ('friction', 'f8', (2, 2, GRID_SIZE)),  # share of the wheel j in the error of i, rad/s
            ('covariance', 'f8', 3),  # of these shares: right, mixed, left, (rad/s)²
            ('window', EVIDENCE),  # newest data, forgotten exponentially
            ('block', EVIDENCE),  # data that is not assessed yet
            ('pending', EVIDENCE),  # the last block that fits
            ('accepted', EVIDENCE),  # what the estimate follows from
            ('recent', EVIDENCE),  # the last blocks, whether they fit or not
            ('rejected', EVIDENCE),  # blocks since the last one that fits
        ],
    )
)
"""State of the estimator, but for the history of the response."""


class Drive(NamedTuple):
    """Constants of :func:`update_dead_time`."""

    lag: float  # s
    period: float  # s
    noise_variance: float  # (rad/s)²
    mean_speeds: bool
    """Whether the measured speeds are means over a period, as those from counters of steps or
    encoder pulses, or the speeds at the stamp."""
    friction: bool
    """Whether friction and disturbances move the wheels, as with a servo; a stepper motor follows
    exactly."""


class ResponseHistory(NamedTuple):
    """Response without dead time, newest first, changed in place."""

    age: Array  # s, shape (n,)
    undelayed: Array  # rad/s, shape (2, n)


class DeadTimeEstimator:
    """Estimates the dead time of a velocity drive from sent and measured wheel speeds.

    The estimate is a function of the calls in their order. ``period`` is the nominal time between
    steps, s; the lag, the variance of the measured speeds, and the dead time, which is the prior,
    are ``parameters``. Other arguments as of :class:`Drive`.
    """

    def __init__(
        self,
        parameters: SpeedFilterParameters,
        period: float,
        *,
        mean_speeds: bool = True,
        friction: bool = False,
    ) -> None:
        self._configured = parameters.dead_time
        self.lateness = 0.0
        """Part of the estimate that is no dead time, s: commands are held longer than a period."""
        least = SERVO_VARIANCE if friction else MIN_NOISE_VARIANCE
        variance = max(parameters.noise_variance, least)
        self._drive = Drive(parameters.lag, period, variance, mean_speeds, friction)
        size = math.ceil(1.25 * MAX_DEAD_TIME / period) + 2
        self._history = ResponseHistory(np.zeros(size), np.zeros((2, size)))
        self._state = np.zeros(1, ESTIMATE)
        estimate, prior = self.estimate, min(parameters.dead_time, MAX_DEAD_TIME)
        estimate.dead_time, estimate.deviation = prior, PRIOR_DEVIATION
        estimate.configured = prior
        estimate.noise_ratio, estimate.noise_count = NOISE_PRIOR_RATIO, NOISE_PRIOR_COUNT
        grid = GRID_STEP * np.arange(GRID_SIZE)
        estimate.accepted.costs = NOISE_PRIOR_RATIO * ((grid - prior) / PRIOR_DEVIATION) ** 2
        estimate.covariance = FRICTION_DEVIATION**2, 0.0, FRICTION_DEVIATION**2
        self._update, self._evidence = TypedKernel(update_dead_time), TypedKernel(evidence_against)
        self._contradictions = TypedKernel(contradictions)
        self.evidence_against(prior)  # compiles it, which no step has to
        self._contradictions(self._state, prior, prior)
        self.reset(np.zeros(2))

    @property
    def estimate(self) -> Any:
        """State, a record of :data:`ESTIMATE`."""
        return self._state[0]

    @property
    def dead_time(self) -> float:
        """Estimate, from 0 to :data:`MAX_DEAD_TIME`, s."""
        return float(self._state['dead_time'][0])

    @property
    def dead_time_in_use(self) -> float:
        """The configured dead time, or the estimate where it clearly differs, s."""
        dead_time: float = self._state['dead_time'].item() - self.lateness
        least = max(USED_DIFFERENCE, math.sqrt(USED_EVIDENCE) * self._state['deviation'].item())
        # Neither is enough: the costs of a few blocks, or at the end of the grid, are no parabola.
        if abs(dead_time - self._configured) <= least:
            return self._configured
        clear = self.evidence_against(self._configured + self.lateness) > USED_EVIDENCE
        return dead_time if clear else self._configured

    @property
    def standard_deviation(self) -> float:
        """Standard deviation of the estimate from the noise, s."""
        return float(self._state['deviation'][0])

    @property
    def noise_variance(self) -> float:
        """Noise of the measured speeds by the median of its changes, (rad/s)²."""
        return (float(self._state['change'][0]) / WHITE_MEDIAN) ** 2

    def evidence_against(self, dead_time: float) -> float:
        """Return 2 log of the likelihood ratio of the best dead time and another one, s.

        The best one may be below 0, where the parabola of the smallest dead times has its minimum.
        """
        return self._evidence(self._state, dead_time)

    def contradictions(self, dead_time: float, other: float) -> tuple[float, float]:
        """Return 2 log of the likelihood ratio of another dead time and one, s, by two signals.

        They are the mean speed and the pose; the times are without :attr:`lateness`. Where these
        contradict what both wheels say, the yaw rate is late, or the twist is wrong otherwise.
        """
        late = self.lateness
        return self._contradictions(self._state, dead_time + late, other + late)

    def reset(self, speeds: Array) -> None:
        """Restart at measured wheel speeds (rad/s) with equal commands; the estimate is kept.

        Data that is not accepted yet is discarded, and a disturbance has ended.
        """
        for name in (
            *('offset', 'error', 'pose_offset', 'pose_error', 'last_error'),
            *('window', 'block', 'pending'),
            *('rate', 'disturbed', 'quiet_time', 'block_disturbed'),
        ):
            self._state[name] = 0
        estimate, history = self.estimate, self._history
        history.age[:] = self._drive.period * np.arange(history.age.size)
        history.undelayed[:] = speeds[:, np.newaxis]
        estimate.response = estimate.filtered = speeds
        estimate.mean_sign = np.tanh(speeds / FRICTION_WIDTH)

    def step(self, measured: Array, command: Array, dt: float, by_pose: Array = UNKNOWN) -> bool:
        """Update the estimate with one measurement; return whether the response is disturbed.

        ``command`` was sent at the previous step, ``dt`` s ago, after the limits, and the robot
        keeps it; ``measured`` is NaN where there is no measurement. ``by_pose``, for
        :meth:`contradictions`, are the same speeds by the change of the pose, NaN where it says
        nothing. After a gap that stops the robot, call :meth:`reset` instead.
        """
        speeds = contiguous(measured), contiguous(by_pose)
        return self._update(
            self._state, self._history, self._drive, *speeds, contiguous(command), dt
        )


@kernel
def update_dead_time(
    state: Any,
    history: ResponseHistory,
    drive: Drive,
    measured: Array,
    by_pose: Array,
    command: Array,
    dt: float,
) -> bool:
    """Do :meth:`DeadTimeEstimator.step`; ``state`` has the type ESTIMATE and shape (1,)."""
    estimate = state[0]
    follow_command(estimate, history, drive, command, dt)
    if math.isnan(measured[0]):
        return bool(estimate.disturbed)
    measure_errors(estimate.error, estimate.offset, history, measured, dt)
    has_pose = not math.isnan(by_pose[0])
    if has_pose:
        measure_errors(estimate.pose_error, estimate.pose_offset, history, by_pose, dt)
    spread = remove_friction(estimate, drive, measured, dt) if drive.friction else 0.0
    add_evidence(estimate, drive.noise_variance + spread, dt, has_pose)
    detect_disturbance(estimate, dt)
    block = estimate.block
    duration = block.duration + 0.5 * drive.period
    enough = block.information * BLOCK_DEVIATION**2 >= estimate.noise_ratio
    enough |= estimate.block_disturbed or duration >= BLOCK_MAX_TIME
    enough |= estimate.deviation > IDENTIFIED_DEVIATION
    if enough and duration >= BLOCK_TIME:
        assess_block(estimate, SERVO_DRIFT_BOUND if drive.friction else DRIFT_BOUND)
    return bool(estimate.disturbed)


@kernel
def evidence_against(state: Any, dead_time: float) -> float:
    """Do :meth:`DeadTimeEstimator.evidence_against`; ``state`` as of :func:`update_dead_time`."""
    estimate = state[0]
    costs = estimate.accepted.costs
    slope, curvature = parabola(costs, 1)
    _, least, _ = minimum(costs)
    if slope > curvature > 0.0:
        least = costs[1] - 0.5 * slope**2 / curvature
    return float((cost_at(costs, dead_time) - least) / estimate.noise_ratio)


@kernel
def contradictions(state: Any, dead_time: float, other: float) -> tuple[float, float]:
    """Do :meth:`DeadTimeEstimator.contradictions`; ``state`` as of :func:`update_dead_time`."""
    accepted = state[0].accepted
    linear = cost_at(accepted.linear, dead_time) - cost_at(accepted.linear, other)
    by_pose = cost_at(accepted.by_pose, dead_time) - cost_at(accepted.by_pose, other)
    _, least, _ = minimum(accepted.by_pose)
    noise_ratio = max(least / max(accepted.poses, 1.0), 1.0)
    if noise_ratio > NOISY_POSE:
        by_pose = 0.0
    return float(linear / state[0].noise_ratio), float(by_pose / noise_ratio)


@kernel
def follow_command(
    estimate: Any, history: ResponseHistory, drive: Drive, command: Array, dt: float
) -> None:
    """Add the response without dead time to the history; a gap is divided into periods."""
    age, undelayed = history
    parts = max(1, round(dt / drive.period))
    decay = math.exp(-dt / parts / drive.lag)
    mean_decay = drive.lag * parts / dt * (1.0 - decay) if drive.mean_speeds else decay
    for _ in range(parts):
        for j in range(age.size - 1, 0, -1):
            age[j] = age[j - 1] + dt / parts
            for i in range(2):
                undelayed[i, j] = undelayed[i, j - 1]
        age[0] = 0.0
        for i in range(2):
            difference = estimate.response[i] - command[i]
            undelayed[i, 0] = command[i] + mean_decay * difference
            estimate.response[i] = command[i] + decay * difference


@kernel
def measure_errors(
    errors: Array, offsets: Array, history: ResponseHistory, measured: Array, dt: float
) -> None:
    """Set the error of each dead time of the grid.

    Each has its own offset, so that a constant load counts as no delay.
    """
    age, undelayed = history
    j = 0
    share = min(1.0, dt / OFFSET_TIME)
    for g in range(GRID_SIZE):
        late = g * GRID_STEP
        while j < age.size - 2 and age[j + 1] < late:
            j += 1
        weight = min(1.0, (late - age[j]) / (age[j + 1] - age[j]))
        for i in range(2):
            newer, older = undelayed[i, j], undelayed[i, j + 1]
            error = measured[i] - newer - weight * (older - newer) - offsets[i, g]
            errors[i, g] = error
            offsets[i, g] += share * error


@kernel
def remove_friction(estimate: Any, drive: Drive, measured: Array, dt: float) -> float:
    """Remove the friction from the errors; return the variance ((rad/s)²) that this adds.

    Coulomb friction of the two wheels, which the body couples, takes a speed of
    A tanh(chi/width) from them, with the offset's mean removed. Each dead time of the grid has
    its own A, by recursive least squares: dead times are compared by what friction cannot
    explain. The regressor and hence the covariance are the same for all.
    """
    filtered, mean, covariance = estimate.filtered, estimate.mean_sign, estimate.covariance
    shares, errors = estimate.friction, estimate.error
    share = min(1.0, dt / OFFSET_TIME)
    right = math.tanh(filtered[0] / FRICTION_WIDTH) - mean[0]
    left = math.tanh(filtered[1] / FRICTION_WIDTH) - mean[1]
    mean[0] += share * right
    mean[1] += share * left
    # Friction acts through the lag of the drive, so the speed is filtered alike. It is that
    # before this measurement, whose noise is in the errors.
    for i in range(2):
        filtered[i] += (1.0 - math.exp(-dt / drive.lag)) * (measured[i] - filtered[i])
    own, mixed, other = covariance
    gain_right = own * right + mixed * left
    gain_left = mixed * right + other * left
    spread = right * gain_right + left * gain_left
    total = drive.noise_variance + spread
    for g in range(GRID_SIZE):
        for i in range(2):
            errors[i, g] -= shares[i, 0, g] * right + shares[i, 1, g] * left
            shares[i, 0, g] += gain_right / total * errors[i, g]
            shares[i, 1, g] += gain_left / total * errors[i, g]
    walk, limit = FRICTION_WALK**2 * dt, FRICTION_DEVIATION**2
    covariance[0] = min(own - gain_right * gain_right / total + walk, limit)
    covariance[1] = mixed - gain_right * gain_left / total
    covariance[2] = min(other - gain_left * gain_left / total + walk, limit)
    return float(spread)


@kernel
def add_evidence(estimate: Any, noise_variance: float, dt: float, has_pose: bool) -> None:
    """Add the errors, divided by their variance ((rad/s)²), to the window and the block.

    After an acceleration the drive oscillates: the rate is held.
    """
    errors = estimate.error
    g = min(int(estimate.dead_time / GRID_STEP), GRID_SIZE - 2)
    weight = estimate.dead_time / GRID_STEP - g
    rate = estimate.rate * math.exp(-dt / RATE_HOLD_TIME)
    squared_slope = 0.0
    for i in range(2):
        slope = (errors[i, g + 1] - errors[i, g]) / GRID_STEP
        squared_slope += slope**2
        rate = max(rate, abs(slope))
    estimate.rate = rate
    variance = noise_variance + (RATE_TOLERANCE * rate) ** 2
    innovation_variance = noise_variance + estimate_uncertainty(estimate) * rate**2
    clip = CLIP * estimate.noise_ratio
    nis = 0.0
    for i in range(2):
        error = errors[i, g] + weight * (errors[i, g + 1] - errors[i, g])
        nis += min(error**2 / innovation_variance, clip)
        larger = abs(error - estimate.last_error[i]) > estimate.change
        estimate.change *= 1.0 + CHANGE_STEP if larger else 1.0 / (1.0 + CHANGE_STEP)
        estimate.last_error[i] = error
    estimate.change = max(estimate.change, WHITE_MEDIAN * math.sqrt(noise_variance))
    noise = (estimate.change / WHITE_MEDIAN) ** 2 / noise_variance
    if noise > LOUD * estimate.noise_ratio:
        # All blocks would be disturbed, and the few others make an estimate that seems certain.
        estimate.noise_ratio, estimate.noise_count = noise, NOISE_PRIOR_COUNT
        set_estimate(estimate)
    scale(estimate.window, math.exp(-dt / WINDOW_TIME))
    in_window, in_block = estimate.window.costs, estimate.block.costs
    for g in range(GRID_SIZE):
        cost = 0.0
        for i in range(2):
            cost += min(errors[i, g] ** 2 / variance, clip)
        in_window[g] += cost
        in_block[g] += cost
        mean = 0.5 * (errors[0, g] + errors[1, g])
        estimate.block.linear[g] += min(2.0 * mean**2 / variance, clip)
        if has_pose:
            for i in range(2):
                estimate.block.by_pose[g] += min(estimate.pose_error[i, g] ** 2 / variance, clip)
    estimate.block.poses += 2.0 * has_pose
    for data in (estimate.window, estimate.block):
        data.duration += dt
        data.count += 2.0
        data.information += squared_slope / variance
        data.nis += nis


@kernel
def detect_disturbance(estimate: Any, dt: float) -> None:
    """Set whether the response is disturbed, by the data of the window.

    The mean of an exponential window has the variance of a mean of (1 + forget)/(1 - forget)
    equal weights; bound of Wilson and Hilferty.
    """
    window = estimate.window
    forget = math.exp(-dt / WINDOW_TIME)
    spread = (1.0 - forget) / (1.0 + forget) / 9.0
    bound = (1.0 - spread + NOISE_QUANTILE * math.sqrt(spread)) ** 3
    mean = window.nis / window.count / estimate.noise_ratio
    ratio = max(estimate.support, likelihood_ratio(estimate, window))
    evidence = max(mean / bound, ratio / RATIO_BOUND)
    if window.duration > 0.6 * WINDOW_TIME and evidence > 1.0:
        estimate.disturbed = True
    if estimate.disturbed:
        estimate.block_disturbed = True
        estimate.quiet_time = 0.0 if evidence > QUIET_EVIDENCE else estimate.quiet_time + dt
        if estimate.quiet_time >= CLEAR_TIME:
            estimate.disturbed, estimate.quiet_time = False, 0.0


@kernel
def estimate_uncertainty(estimate: Any) -> float:
    """Return the variance (s²) of the dead time that contradicts no estimate.

    Before the dead time is identified, every dead time is possible.
    """
    deviation = UNCERTAINTY_FACTOR * estimate.deviation
    if estimate.deviation > IDENTIFIED_DEVIATION:
        deviation = 0.5 * MAX_DEAD_TIME
    return float(deviation**2 + TOLERANCE**2)


@kernel
def assess_block(estimate: Any, drift_bound: float) -> None:
    """Accept or reject the data of the block, and begin another one."""
    block, recent = estimate.block, estimate.recent
    information = block.information / estimate.noise_ratio
    # Recent data is forgotten as new information arrives, not while the robot stands.
    scale(recent, math.exp(-information * RECENT_DEVIATION**2))
    add(recent, block)
    estimate.support = likelihood_ratio(estimate, recent)
    fits = not estimate.block_disturbed and estimate.support < BLOCK_BOUND
    if fits and likelihood_ratio(estimate, block) < BLOCK_BOUND:
        accept_pending(estimate, estimate.support > drift_bound)
    else:
        reject_block(estimate, information >= DRIVING_INFORMATION * block.duration)
    clear(block)
    estimate.block_disturbed = estimate.disturbed


@kernel
def accept_pending(estimate: Any, drifts: bool) -> None:
    """Accept the block before this one, which is pending in its place."""
    pending = estimate.pending
    if estimate.deviation <= IDENTIFIED_DEVIATION:
        count = estimate.noise_count + pending.count
        total = estimate.noise_ratio * estimate.noise_count + pending.nis
        estimate.noise_ratio = max(total / count, 1.0)
        estimate.noise_count = min(count, NOISE_MAX_COUNT)
    if drifts and estimate.rejected.duration < BLOCK_TIME:
        scale(estimate.accepted, DRIFT_MEMORY)
    add(estimate.accepted, pending)
    clear(pending)
    add(pending, estimate.block)
    # What was rejected long ago is no evidence for a change now.
    scale(estimate.rejected, DRIFT_MEMORY if preference(estimate) < BLOCK_BOUND else 0.0)
    set_estimate(estimate)


@kernel
def preference(estimate: Any) -> float:
    """Return 2 log of the likelihood ratio of the estimate and of what the rejected data shows.

    It is that of the present block; while the robot hardly accelerates, a block fits both.
    """
    rejected = estimate.rejected
    if rejected.count == 0.0:
        return 0.0
    other, _, _ = minimum(rejected.costs)
    costs = estimate.block.costs
    apart = cost_at(costs, other) - cost_at(costs, estimate.dead_time)
    return float(apart / estimate.noise_ratio)


@kernel
def parabola(costs: Array, g: int) -> tuple[float, float]:
    """Return first and second derivative per step of the parabola through g and its neighbours."""
    slope = 0.5 * (costs[g + 1] - costs[g - 1])
    return slope, costs[g + 1] - 2.0 * costs[g] + costs[g - 1]


@kernel
def cost_at(costs: Array, dead_time: float) -> float:
    """Return the cost at a dead time, s: of the parabola through the three nearest of the grid."""
    position = dead_time / GRID_STEP
    g = min(max(int(position + 0.5), 1), GRID_SIZE - 2)
    offset = position - g
    slope, curvature = parabola(costs, g)
    return float(costs[g] + offset * (slope + 0.5 * curvature * offset))


@kernel
def reject_block(estimate: Any, driving: bool) -> None:
    """Keep the block apart; adopt what is rejected if it persists while the robot is driving."""
    rejected, block = estimate.rejected, estimate.block
    clear(estimate.pending)
    preferred = preference(estimate)
    if preferred > BLOCK_BOUND:
        clear(rejected)
        return
    if rejected.count > 0.0 and preferred > -SUPPORT:
        return
    if driving or preferred <= -SUPPORT:
        add(rejected, block)
    else:
        for g in range(GRID_SIZE):
            rejected.costs[g] += block.costs[g]
            rejected.linear[g] += block.linear[g]
            rejected.by_pose[g] += block.by_pose[g]
        rejected.poses += block.poses
    other, least, _ = minimum(rejected.costs)
    returns = abs(other - estimate.configured) < RETURN_DIFFERENCE
    if rejected.duration < (RETURN_TIME if returns else CHANGE_TIME):
        return
    consistent = least <= CHANGE_FIT * estimate.noise_ratio * rejected.count
    consistent = consistent and likelihood_ratio(estimate, rejected) > BLOCK_BOUND
    if consistent or rejected.duration >= ADOPTION_TIME:
        estimate.noise_ratio = max(least / rejected.count, 1.0)
        estimate.noise_count = NOISE_PRIOR_COUNT
        clear(estimate.accepted)
        add(estimate.accepted, rejected)
        for data in (estimate.window, estimate.recent, rejected):
            clear(data)
        estimate.support = 0.0
        set_estimate(estimate)


@kernel
def scale(data: Any, factor: float) -> None:
    """Weight all sums by a factor."""
    for g in range(GRID_SIZE):
        data.costs[g] *= factor
        data.linear[g] *= factor
        data.by_pose[g] *= factor
    data.poses *= factor
    data.duration *= factor
    data.count *= factor
    data.information *= factor
    data.nis *= factor


@kernel
def add(data: Any, other: Any) -> None:
    """Add the sums over other data."""
    for g in range(GRID_SIZE):
        data.costs[g] += other.costs[g]
        data.linear[g] += other.linear[g]
        data.by_pose[g] += other.by_pose[g]
    data.poses += other.poses
    data.duration += other.duration
    data.count += other.count
    data.information += other.information
    data.nis += other.nis


@kernel
def clear(data: Any) -> None:
    """Set all sums to zero, even those that are not finite."""
    for g in range(GRID_SIZE):
        data.costs[g] = data.linear[g] = data.by_pose[g] = 0.0
    data.poses = 0.0
    data.duration = data.count = data.information = data.nis = 0.0


@kernel
def set_estimate(estimate: Any) -> None:
    """Set the estimate from the accepted data, of which the oldest is forgotten."""
    accepted, ratio = estimate.accepted, estimate.noise_ratio
    costs = accepted.costs
    dead_time, least, curvature = minimum(costs)
    # While the likelihood is wider than the grid step, its variance is that over the grid.
    total = first = second = 0.0
    for g in range(GRID_SIZE):
        costs[g] -= least
        weight = math.exp(-0.5 * costs[g] / ratio)
        total += weight
        first += weight * g * GRID_STEP
        second += weight * (g * GRID_STEP) ** 2
    variance = second / total - (first / total) ** 2
    if variance < GRID_STEP**2:
        variance = 2.0 * ratio / curvature
        if variance > GRID_STEP**2:  # at the end of the grid the costs may bend down
            variance = (0.5 * GRID_STEP) ** 2
    if variance < MIN_DEVIATION**2:
        scale(accepted, variance / MIN_DEVIATION**2)
        variance = MIN_DEVIATION**2
    estimate.dead_time = dead_time
    estimate.deviation = min(math.sqrt(variance), PRIOR_DEVIATION)


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
    slope, curvature = parabola(costs, g)
    curvature = max(curvature, 1e-12)
    offset = min(max(-slope / curvature, -1.0), 1.0)
    least = costs[g] + offset * (slope + 0.5 * curvature * offset)
    return (g + offset) * GRID_STEP, least, curvature / GRID_STEP**2


@kernel
def likelihood_ratio(estimate: Any, data: Any) -> float:
    """Return 2 log of the likelihood ratio of the best dead time of some data and the estimate.

    The uncertainty of the estimate, which is no contradiction, reduces it.
    """
    _, least, _ = minimum(data.costs)
    excess = cost_at(data.costs, estimate.dead_time) - least
    uncertainty = estimate_uncertainty(estimate)
    return float(excess / (estimate.noise_ratio + data.information * uncertainty))
