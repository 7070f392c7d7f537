# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
r"""Drive of a robot, identified from a bag with commands and odometry, and parameters for it.

The model of both wheels is that of the speed filter, with a gain and an offset of each wheel:

.. math:: y(t) = k\,\chi(t - \tau) + o + \nu, \qquad \chi' = (c - \chi)/\lambda

with the commanded wheel speed c, which holds until the next command, the dead time tau and the lag
lambda. Commands count from their receipt by the recorder, measured speeds at the stamps of the
odometry; y is the speed at the stamp or its mean over the period before, whichever fits better.
The least squares of y give tau and lambda. Errors that last for some time, such as friction, are
no white noise: the covariance is that of Newey and West (1987, doi 10.2307/1913610).
"""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.control.controller import WHEELS, ControllerParameters, StepperControllerParameters
from t3mpc_ros.control.dead_time_estimator import (
    IDENTIFIED_DEVIATION,
    MIN_DEVIATION,
    MIN_NOISE_VARIANCE,
)
from t3mpc_ros.evaluation.bag_report.response import busiest, fit_response
from t3mpc_ros.evaluation.bag_report.run_data import Run, Series, load_run
from t3mpc_ros.evaluation.topic_roles import (
    COMMAND,
    ODOMETRY,
    ReportOptions,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.yaml_files import parameter_file

Array = NDArray[np.float64]

MIN_DURATION = 10.0
"""Least time without a gap, s."""
MAX_DURATION = 120.0
"""Time that is used of a longer recording, the one in which the command varies most, s."""
MIN_VARIATION = 0.1
"""Least standard deviation of the commanded wheel speeds, rad/s."""
MIN_EXPLAINED = 0.5
"""Least share of the variance of the measured speeds that the command explains."""
MAX_RELATIVE_DEVIATION = 0.2
"""Largest standard deviation of a lag, relative to it; of a small lag it is
:data:`IDENTIFIED_DEVIATION`, of the dead time that or half of a period of the odometry."""
MODEL_DEVIATION = 0.025
"""Standard deviation of a lag, relative to it, because no drive is an exact first-order lag."""
MIN_LAG = 1e-3
"""Lag below which a drive responds at once, s."""
CORRELATION_TIME = 0.5
"""Time over which the errors of the model are correlated at most, s."""
ITERATIONS = 60
DEAD_TIME, LAG = 0, 1
"""First entries of the parameters of the fit."""


class IdentificationError(RuntimeError):
    """The bag does not determine the drive; the text names the bound and the value."""


class Estimate(NamedTuple):
    """An estimated number."""

    value: float
    deviation: float
    """Standard deviation."""


@dataclass(frozen=True)
class IdentifiedDrive:
    """Drive identified from a bag."""

    dead_time: Estimate
    """From the receipt of a command by the recorder to the stamp of the odometry, s."""
    lag: Estimate
    """s"""
    noise_variance: Estimate
    """Variance of the measured wheel speeds, (rad/s)²."""
    mean_speeds: bool
    """Whether a measured speed is the mean over the period before its stamp."""
    explained: float
    """Share of the variance of the measured speeds that the model explains."""
    duration: float
    """Time used, s."""
    rate: float
    """Rate of the odometry, Hz."""
    geometry: WheelGeometry


def identify_bag(folder: Path, options: ReportOptions) -> tuple[IdentifiedDrive, str]:
    """Return the drive of the robot in a bag, and the composition of its controller.

    The composition is the recorded one; ``paper`` without, because a bag does not show whether
    the yaw of the odometry comes from a gyro.

    Raises
    ------
    IdentificationError
        The bag does not determine the drive.
    ReportError
        The bag holds no topic of a robot, or an option does not fit it.
    BagError
        The bag cannot be read.
    """
    with open_bag(folder) as recording:
        run = load_run(recording, options)
        records = recording.metadata_records
    composition = _recorded_composition(records)
    return identify_drive(run), composition


def _recorded_composition(records: Mapping[str, Mapping[str, str]]) -> str:
    for title, table in records.items():
        if title.rpartition('/')[2] in ('controller', 'composed'):
            for key, value in table.items():
                if key.rpartition('.')[2] == 'composition' and value in ('body', 'paper'):
                    return value
    return 'paper'


def identify_drive(run: Run) -> IdentifiedDrive:
    """Return the drive of the robot in a recorded run."""
    for name in (COMMAND, ODOMETRY):
        if name not in run.motions or len(run.motions[name]) < 3:
            raise IdentificationError(f'the bag must hold {COMMAND} and {ODOMETRY}: no {name}')
    if run.geometry is None:
        raise IdentificationError(
            'the wheel speeds need the wheel radius and separation, which the bag does not hold: '
            'give --wheel-radius and --track'
        )
    command, motion = run.motions[COMMAND], run.motions[ODOMETRY]
    start, end = max((busiest(command, motion, name, MAX_DURATION) for name in WHEELS), key=_span)
    if end - start < MIN_DURATION:
        raise IdentificationError(
            f'commands and odometry must overlap for at least {MIN_DURATION:g} s without a gap: '
            f'got {max(end - start, 0.0):.1f} s'
        )
    period = float(np.median(np.diff(motion.time)))
    held = np.stack([_held(command, name, motion.time) for name in WHEELS], axis=1)
    used = (motion.time >= start) & (motion.time <= end)
    variation = float(np.sqrt(held[used].var(axis=0).mean()))
    if not variation >= MIN_VARIATION:
        raise IdentificationError(
            f'the commanded wheel speeds must vary by at least {MIN_VARIATION:g} rad/s (standard '
            f'deviation): got {variation:.3g} rad/s'
        )
    coarse = [fit_response(command, motion, name) for name in WHEELS]
    sound = [fit for fit in coarse if fit is not None and fit.clear]
    explained = max((fit.explained for fit in coarse if fit is not None), default=0.0)
    if not sound or explained < MIN_EXPLAINED:
        raise IdentificationError(
            f'the commands must explain at least {100 * MIN_EXPLAINED:g} % of the measured wheel '
            f'speeds: got {100 * max(explained, 0.0):.0f} %'
        )
    delay = float(np.mean([fit.dead_time + fit.lag for fit in sound]))
    settled = used & (motion.time >= start + min(5.0 * delay, 0.3 * (end - start)))
    fits = [
        _fit(_Response(command, motion, settled, period if mean else 0.0), delay)
        for mean in (True, False)
    ]
    return _identified(fits, period, end - start, run.geometry)


def _span(times: tuple[float, float]) -> float:
    return times[1] - times[0]


def _held(command: Series, name: str, time: Array) -> Array:
    rows = np.maximum(np.searchsorted(command.time, time, 'right') - 1, 0)
    held: Array = command[name][rows]
    return held


class _Response:
    """Response of the model at the measured stamps, in ``rows`` of ``motion``.

    ``window`` is the time before a stamp over which the measured speed is the mean, s; 0: the
    speed at it.
    """

    def __init__(
        self, command: Series, motion: Series, rows: NDArray[np.bool_], window: float
    ) -> None:
        self._switches = command.time
        self._commands = np.stack([command[name] for name in WHEELS])
        self._time = motion.time[rows]
        self.measured: Array = np.stack([motion[name][rows] for name in WHEELS])
        self.window = window
        steps = np.diff(command.time)
        covered = np.cumsum(self._commands[:, :-1] * steps, axis=1)
        self._integral = np.concatenate([np.zeros((2, 1)), covered], axis=1)

    @property
    def size(self) -> int:
        """Number of measured speeds, both wheels."""
        return int(self.measured.size)

    @property
    def lags(self) -> int:
        """Number of samples in CORRELATION_TIME."""
        return max(1, round(CORRELATION_TIME / float(np.median(np.diff(self._time)))))

    def undelayed(self, dead_time: float, lag: float) -> Array:
        """Return chi(t - tau), or its mean over the window, rad/s, shape (2, n)."""
        at_switches = np.empty_like(self._commands)
        for commands, speeds in zip(self._commands, at_switches, strict=True):
            _follow(self._switches, commands, lag, speeds)
        late = self._time - dead_time
        speeds, covered = self._at(late, lag, at_switches)
        if self.window == 0.0:
            return speeds
        before, covered_before = self._at(late - self.window, lag, at_switches)
        # Of chi' = (c - chi)/lag: the integral of chi is that of c less the change of chi.
        mean: Array = (covered - covered_before - lag * (speeds - before)) / self.window
        return mean

    def _at(self, time: Array, lag: float, at_switches: Array) -> tuple[Array, Array]:
        """Return chi and the integral of the command (rad) at times, shape (2, n)."""
        rows = np.clip(np.searchsorted(self._switches, time, 'right') - 1, 0, None)
        elapsed = np.maximum(time - self._switches[rows], 0.0)
        commands = self._commands[:, rows]
        speeds = commands + (at_switches[:, rows] - commands) * np.exp(-elapsed / lag)
        return speeds, self._integral[:, rows] + commands * elapsed

    def residuals(self, times: Array) -> tuple[Array, Array]:
        """Return the errors (rad/s, shape (2, n)) of the best gains and offsets, and the gains.

        times : tau and lambda, s
        """
        found = self.undelayed(float(times[DEAD_TIME]), float(times[LAG]))
        centred = found - found.mean(axis=1, keepdims=True)
        measured = self.measured - self.measured.mean(axis=1, keepdims=True)
        energy = np.maximum((centred**2).sum(axis=1), 1e-12)
        gains: Array = (centred * measured).sum(axis=1) / energy
        return measured - gains[:, np.newaxis] * centred, gains


@kernel
def _follow(time: Array, commands: Array, lag: float, speeds: Array) -> None:
    """Write the response without dead time to commands that hold until the next one.

    time, commands, speeds : shape (n,)
    """
    speeds[0] = commands[0]
    for k in range(1, time.size):
        decay = math.exp(-(time[k] - time[k - 1]) / lag)
        speeds[k] = commands[k - 1] + (speeds[k - 1] - commands[k - 1]) * decay


class _Fit(NamedTuple):
    """Fit of the model."""

    times: Array
    """tau and lambda, s."""
    covariance: Array
    """s², shape (2, 2)"""
    residuals: Array
    """rad/s, shape (2, n)"""
    response: _Response

    @property
    def cost(self) -> float:
        """Sum of squared errors, (rad/s)²."""
        return float((self.residuals**2).sum())


def _fit(response: _Response, delay: float) -> _Fit:
    """Return the least-squares fit; ``delay`` is roughly the sum of dead time and lag, s."""
    shift = 0.5 * response.window
    total = max(delay - shift, 2.0 * MIN_LAG)
    starts = [
        np.array([(1.0 - share) * total, max(share * total, MIN_LAG)])
        for share in (0.05, 0.25, 0.5, 0.75, 0.95)
    ]
    times = min(starts, key=lambda one: float((response.residuals(one)[0] ** 2).sum()))
    errors, _ = response.residuals(times)
    damping = 1e-3
    for _ in range(ITERATIONS):
        slopes = _slopes(response, times).reshape(2, -1)
        normal, gradient = slopes @ slopes.T, slopes @ errors.ravel()
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient)
        tried = times + step
        tried[DEAD_TIME] = max(tried[DEAD_TIME], -response.window)
        tried[LAG] = max(tried[LAG], 0.25 * MIN_LAG)
        new, _ = response.residuals(tried)
        if (new**2).sum() < (errors**2).sum():
            moved = float(np.abs(tried - times).max())
            times, errors, damping = tried, new, 0.2 * damping
            if moved < 1e-7:
                break
        else:
            damping *= 10.0
            if damping > 1e8:
                break
    return _Fit(times, _covariance(_slopes(response, times), errors, response), errors, response)


def _slopes(response: _Response, times: Array) -> Array:
    """Return the derivatives of the errors by tau and lambda, shape (2, 2, n)."""
    found = np.empty((2, *response.measured.shape))
    for i in (DEAD_TIME, LAG):
        high, low = times.copy(), times.copy()
        change = max(1e-4, 0.02 * times[i])
        high[i] += change
        low[i] = max(low[i] - change, 0.1 * MIN_LAG) if i == LAG else low[i] - change
        difference = response.residuals(high)[0] - response.residuals(low)[0]
        found[i] = difference / (high[i] - low[i])
    return found


def _covariance(slopes: Array, errors: Array, response: _Response) -> Array:
    """Return the covariance of tau and lambda for errors correlated over CORRELATION_TIME."""
    flat = slopes.reshape(2, -1)
    inverse = np.linalg.pinv(flat @ flat.T)
    scores = (slopes * errors).sum(axis=1)  # both wheels together: their errors are correlated
    spread = scores @ scores.T
    lags = response.lags
    for k in range(1, lags + 1):
        product = scores[:, k:] @ scores[:, :-k].T
        spread += (1.0 - k / (lags + 1.0)) * (product + product.T)
    white = float((errors**2).sum()) / (errors.size - 6)
    robust: Array = inverse @ spread @ inverse
    for i in (DEAD_TIME, LAG):
        # By chance the correlation may appear negative: never less than with white noise.
        robust[i, i] = max(robust[i, i], white * inverse[i, i])
    return robust


def _identified(
    fits: list[_Fit], period: float, duration: float, geometry: WheelGeometry
) -> IdentifiedDrive:
    """Return the drive by the better of two models; the other one adds to the uncertainty."""
    best, other = sorted(fits, key=lambda fit: fit.cost)
    noise = _white_variance(best.residuals)
    variance = best.cost / best.response.size
    evidence = (other.cost - best.cost) / max(variance, 1e-12)
    doubt = 1.0 / (1.0 + math.exp(min(0.5 * evidence, 500.0)))
    estimates = []
    for i, what in ((DEAD_TIME, 'dead time'), (LAG, 'lag')):
        difference = float(best.times[i] - other.times[i])
        spread = math.sqrt(max(float(best.covariance[i, i]), 0.0) + doubt * difference**2)
        value = float(best.times[i])
        floor = MODEL_DEVIATION * value if i == LAG else MIN_DEVIATION
        spread = math.hypot(spread, floor)
        rough = MAX_RELATIVE_DEVIATION * value if i == LAG else 0.5 * period
        bound = max(IDENTIFIED_DEVIATION, rough)
        if not spread <= bound:
            raise IdentificationError(
                f'the standard deviation of the {what} must be at most {1e3 * bound:.1f} ms: got '
                f'{1e3 * spread:.1f} ms; record for longer, with faster changes of the command'
            )
        estimates.append(Estimate(max(value, MIN_LAG if i == LAG else 0.0), spread))
    power = float(((best.response.measured.T - best.response.measured.mean(axis=1)) ** 2).sum())
    return IdentifiedDrive(
        dead_time=estimates[DEAD_TIME],
        lag=estimates[LAG],
        noise_variance=noise,
        mean_speeds=best.response.window > 0.0,
        explained=1.0 - best.cost / power,
        duration=duration,
        rate=_rounded_rate(1.0 / period),
        geometry=geometry,
    )


def _white_variance(errors: Array) -> Estimate:
    """Return the variance of the white part of errors, shape (2, n), by second differences.

    What changes slowly drops out. With white noise of variance v their variance is 6 v; the
    variance of the estimate follows from their correlation, -2/3 and 1/6.
    """
    second = np.diff(errors, 2, axis=1)
    value = float((second**2).mean()) / 6.0
    relative = math.sqrt(2.0 * (1.0 + 8.0 / 9.0 + 1.0 / 18.0) / second.size)
    return Estimate(value, math.hypot(relative * value, MIN_NOISE_VARIANCE))


def _rounded_rate(rate: float) -> float:
    """Return the rate, a whole number if it is within 1 % of one."""
    whole = float(round(rate))
    return whole if abs(rate - whole) <= 0.01 * rate else round(rate, 2)


def fitting_parameters(drive: IdentifiedDrive, composition: str) -> ControllerParameters:
    """Return the parameters of the controller for a drive, with the gain by the rule."""
    return _resolved(drive, composition, drive.lag.value)


def _resolved(drive: IdentifiedDrive, composition: str, lag: float) -> ControllerParameters:
    parameters = StepperControllerParameters().with_values(
        {
            'rate': drive.rate,
            'wheel_radius': drive.geometry.wheel_radius,
            'wheel_separation': drive.geometry.wheel_separation,
            'composition': composition,
            'mean_speeds': drive.mean_speeds,
            'speed_filter.lag': lag,
            'speed_filter.dead_time': drive.dead_time.value,
            'speed_filter.noise_variance': drive.noise_variance.value,
            'law.gain': 0.0,
        }
    )
    return parameters.resolved()


def drive_file(drive: IdentifiedDrive, composition: str, source: str) -> str:
    """Return the parameter file (YAML) of the controller for a drive; ``source`` names the bag."""
    values = fitting_parameters(drive, composition).to_dict()
    slower = _resolved(drive, composition, drive.lag.value + drive.lag.deviation).to_dict()

    def by_lag(name: str, unit: str) -> str:
        change = abs(float(str(slower[name])) - float(str(values[name])))
        return f'by the lag; standard deviation {change:.2g} {unit}'

    kind = 'means over the period before the stamp' if drive.mean_speeds else 'at the stamp'
    comments = {
        'rate': 'of the odometry',
        'wheel_radius': '',
        'wheel_separation': '',
        'composition': '',
        'mean_speeds': f'measured speeds are {kind}',
        'speed_filter.lag': f'standard deviation {drive.lag.deviation:.2g} s',
        'speed_filter.dead_time': f'standard deviation {drive.dead_time.deviation:.2g} s',
        'speed_filter.noise_variance': 'standard deviation '
        f'{drive.noise_variance.deviation:.2g} (rad/s)²',
        'law.gain': by_lag('law.gain', '1/s'),
        'law.smoothing': by_lag('law.smoothing', 'rad/s'),
    }
    chosen = {name: values[name] for name in comments}
    rounded = {
        name: float(f'{value:.5g}') if isinstance(value, float) else value
        for name, value in chosen.items()
    }
    title = (
        f'Drive identified from {source}: {drive.duration:.1f} s, '
        f'{100 * drive.explained:.1f} % of the wheel speeds explained.'
    )
    return parameter_file(title, {'/**/controller': rounded}, comments)
