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
"""Drive of a robot, identified from a bag with commands and odometry.

The model, and the fit of dead time and lag, are those of
:mod:`~t3mpc_ros.evaluation.drive_response`; measured speeds are those at the stamps or the means
over the period before, whichever fits better.
"""

from dataclasses import asdict, dataclass, replace
import math
from pathlib import Path

import numpy as np

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.control import dead_time_estimator
from t3mpc_ros.control.controller import WHEELS, ControllerParameters, StepperControllerParameters
from t3mpc_ros.evaluation.bag_report.recorded_run import Run, Series, load_run
from t3mpc_ros.evaluation.drive_response import (
    DEAD_TIME,
    LAG,
    MIN_LAG,
    WheelData,
    WheelFit,
    busiest,
    fit_response,
    fit_wheels,
)
from t3mpc_ros.evaluation.topic_roles import COMMAND, KINDS, ODOMETRY, ReportOptions
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.yaml_loader import parameter_file
from t3mpc_ros.robot.calibration import Estimate

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


class IdentificationError(RuntimeError):
    """The bag does not determine the drive; the text names the bound and the value."""


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
    oddities: tuple[str, ...] = ()
    """Sentences on what is unusual in the bag, as in its report."""


def identify_bag(folder: Path, options: ReportOptions) -> tuple[IdentifiedDrive, str]:
    """Return the drive of the robot in a bag, and the composition of its controller.

    The composition is the recorded one; ``paper`` without, because a bag does not show whether
    the yaw of the odometry comes from a gyro.
    """
    with open_bag(folder) as recording:
        run = load_run(recording, options)
        records = recording.metadata_records
    recorded = [
        value
        for title, table in records.items()
        if title.rpartition('/')[2] in ('controller', 'composed')
        for key, value in table.items()
        if key.rpartition('.')[2] == 'composition' and value in ('body', 'paper')
    ]
    return identify_drive(run), next(iter(recorded), 'paper')


def identify_drive(run: Run) -> IdentifiedDrive:
    """Return the drive of the robot in a recorded run."""
    for name in (COMMAND, ODOMETRY):
        if name not in run.motions or len(run.motions[name]) < 3:
            raise IdentificationError(
                f'the bag must hold {COMMAND} and {ODOMETRY}: no {name}, a topic of '
                f'{" or ".join(KINDS[name])} with at least 3 messages'
            )
    if ODOMETRY in run.untrusted:
        raise IdentificationError('. '.join(text for item in run.damage.items() for text in item))
    if run.geometry is None:
        raise IdentificationError(
            'the wheel speeds need the wheel radius and separation, which the bag does not hold: '
            'give --wheel-radius and --track'
        )
    command, motion = run.motions[COMMAND], run.motions[ODOMETRY]
    spans = [busiest(command, motion, name, MAX_DURATION) for name in WHEELS]
    start, end = max(spans, key=np.ptp)
    if end - start < MIN_DURATION:
        raise IdentificationError(
            f'commands and odometry must overlap for at least {MIN_DURATION:g} s without a gap: '
            f'got {max(end - start, 0.0):.1f} s'
        )
    period = float(np.median(np.diff(motion.time)))
    used = (motion.time >= start) & (motion.time <= end)
    commanded = np.stack([command.held(name, motion.time[used]) for name in WHEELS])
    variation = float(np.sqrt(commanded.var(axis=1).mean()))
    if not variation >= MIN_VARIATION:
        raise IdentificationError(
            f'the commanded wheel speeds must vary by at least {MIN_VARIATION:g} rad/s (standard '
            f'deviation): got {variation:.3g} rad/s'
        )
    delay = _rough_delay(command, motion)
    settled = used & (motion.time >= start + min(5.0 * delay, 0.3 * (end - start)))
    data = WheelData(
        command.time,
        np.stack([command[name] for name in WHEELS]),
        motion.time[settled],
        np.stack([motion[name][settled] for name in WHEELS]),
        window=period,
    )
    fits = [fit_wheels(each, delay) for each in (data, data._replace(window=0.0))]
    drive = _identified(fits, period, end - start, run.geometry)
    return replace(drive, oddities=run.oddities)


def _rough_delay(command: Series, motion: Series) -> float:
    """Return dead time and lag together, s, of the wheels whose responses are clear."""
    coarse = [fit_response(command, motion, name) for name in WHEELS]
    sound = [fit for fit in coarse if fit is not None and fit.explains]
    explained = max((fit.explained for fit in coarse if fit is not None), default=0.0)
    if not sound or explained < MIN_EXPLAINED:
        raise IdentificationError(
            f'the commands must explain at least {100 * MIN_EXPLAINED:g} % of the measured wheel '
            f'speeds: got {100 * max(explained, 0.0):.0f} %'
        )
    return float(np.mean([fit.dead_time + fit.lag for fit in sound]))


def _identified(
    fits: list[WheelFit], period: float, duration: float, geometry: WheelGeometry
) -> IdentifiedDrive:
    """Return the drive by the better of two models; the other one adds to the uncertainty."""
    best, other = sorted(fits, key=lambda fit: fit.cost)
    noise = _white_variance(best.residuals)
    variance = best.cost / best.data.measured.size
    evidence = (other.cost - best.cost) / max(variance, 1e-12)
    doubt = 1.0 / (1.0 + math.exp(min(0.5 * evidence, 500.0)))
    estimates = []
    for i, what in ((DEAD_TIME, 'dead time'), (LAG, 'lag')):
        difference = float(best.times[i] - other.times[i])
        spread = math.sqrt(max(float(best.covariance[i, i]), 0.0) + doubt * difference**2)
        value = float(best.times[i])
        floor = MODEL_DEVIATION * value if i == LAG else dead_time_estimator.MIN_DEVIATION
        spread = math.hypot(spread, floor)
        rough = MAX_RELATIVE_DEVIATION * value if i == LAG else 0.5 * period
        bound = max(dead_time_estimator.IDENTIFIED_DEVIATION, rough)
        if not spread <= bound:
            raise IdentificationError(
                f'the standard deviation of the {what} must be at most {1e3 * bound:.1f} ms: got '
                f'{1e3 * spread:.1f} ms; record for longer, with faster changes of the command'
            )
        estimates.append(Estimate(max(value, MIN_LAG if i == LAG else 0.0), spread))
    power = float(((best.data.measured.T - best.data.measured.mean(axis=1)) ** 2).sum())
    rate, whole = 1.0 / period, float(round(1.0 / period))
    return IdentifiedDrive(
        dead_time=estimates[DEAD_TIME],
        lag=estimates[LAG],
        noise_variance=noise,
        mean_speeds=best.data.window > 0.0,
        explained=1.0 - best.cost / power,
        duration=duration,
        rate=whole if abs(rate - whole) <= 0.01 * rate else round(rate, 2),
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
    return Estimate(value, math.hypot(relative * value, dead_time_estimator.MIN_NOISE_VARIANCE))


# -- parameter file -------------------------------------------------------------------------------


def fitting_parameters(
    drive: IdentifiedDrive, composition: str, slower: float = 0.0
) -> ControllerParameters:
    """Return the parameters for a drive with a lag ``slower`` by some s; the gain by the rule."""
    parameters = StepperControllerParameters().with_values(
        {
            'rate': drive.rate,
            'wheel_radius': drive.geometry.wheel_radius,
            'wheel_separation': drive.geometry.wheel_separation,
            'composition': composition,
            'mean_speeds': drive.mean_speeds,
            'speed_filter.lag': drive.lag.value + slower,
            'speed_filter.dead_time': drive.dead_time.value,
            'speed_filter.noise_variance': drive.noise_variance.value,
            'law.gain': 0.0,
        }
    )
    return parameters.resolved()


def drive_record(drive: IdentifiedDrive, composition: str) -> dict[str, object]:
    """Return the drive, with standard deviations, and the parameters that fit it as plain data."""
    return {'drive': asdict(drive), 'parameters': fitting_parameters(drive, composition).to_dict()}


def drive_file(drive: IdentifiedDrive, composition: str, source: str) -> str:
    """Return the parameter file (YAML) of the controller for a drive; ``source`` names the bag."""
    values = fitting_parameters(drive, composition).to_dict()
    slower = fitting_parameters(drive, composition, drive.lag.uncertainty).to_dict()

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
        'speed_filter.lag': f'standard deviation {drive.lag.uncertainty:.2g} s',
        'speed_filter.dead_time': f'standard deviation {drive.dead_time.uncertainty:.2g} s',
        'speed_filter.noise_variance': 'standard deviation '
        f'{drive.noise_variance.uncertainty:.2g} (rad/s)²',
        'law.gain': by_lag('law.gain', '1/s'),
        'law.smoothing': by_lag('law.smoothing', 'rad/s'),
    }
    rounded = {
        name: float(f'{value:.5g}') if isinstance(value := values[name], float) else value
        for name in comments
    }
    title = (
        f'Drive identified from {source}: {drive.duration:.1f} s, '
        f'{100 * drive.explained:.1f} % of the wheel speeds explained.'
    )
    title = '\n# '.join([title, *drive.oddities])
    return parameter_file(title, {'/**/controller': rounded}, comments)
