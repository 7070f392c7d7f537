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
r"""Open-loop estimation error of each kind of fuzzy system, equation (86).

The paper removes the controller and runs :math:`\hat\chi' = g(U|\alpha)` beside the robot. Two
terms are missing in print (E18): a robot at rest gives nothing to estimate, so a known input
drives it, the u of (30); and without output error nothing ties :math:`\hat\chi` to :math:`\chi`,
so that V of (74) has no decreasing term. This module runs the series-parallel form

.. math:: \hat\chi' = g(\chi|\alpha) + u + a\,(\chi - \hat\chi), \qquad
          \alpha' = \gamma\Phi\,(\chi - \hat\chi)

which is the error system (72)-(73) of the law with :math:`\hat\chi` in place of r and a in place
of K, adapted by (77)-(78); V of (74) decreases by the same argument.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from t3mpc_ros.evaluation.confidence_intervals import interval, mean, rms
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.result_output import progress_bar
from t3mpc_ros.fuzzy.estimator import AdaptationParameters, FuzzyEstimator, gamma_for
from t3mpc_ros.fuzzy.inference import FuzzyParameters
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.simulation.paper_robot import PaperRobot
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

KINDS = ('type3', 'interval_type2', 'type1')
"""Fuzzy systems compared; sets, centres, widths and adaptation rate are equal."""
NO_FUZZY_SYSTEM = 'no fuzzy system'
"""Name of the estimator with g = 0: what output error alone is worth."""
VARIANCES = (0.0, 0.04, 0.07, 0.1)
"""Noise of the measured wheel speeds, (rad/s)²: the paper's range."""
NORMALISED_GAIN = 40.0
"""Mean of gamma |Phi|² for every kind (1/s²): that of the controller's defaults."""
OUTPUT_ERROR_GAIN = 8.0
"""The gain a (1/s): the controller's K."""
SETTLE = 10.0
"""Time at the start that is excluded, s: all kinds start without adaptation."""


@dataclass(frozen=True, slots=True)
class OpenLoopRun:
    """A robot driven by a known torque, one row a period, right wheel first."""

    period: float
    """s"""
    push: Array
    """u, known; its torque is theta_bar u. rad/s², shape (n, 2)"""
    speeds: Array
    """True chi, rad/s, shape (n, 2)"""
    measured: Array
    """chi with its noise, rad/s, shape (n, 2)"""

    @property
    def target(self) -> Array:
        """Target of g, chi' - u of (30) over each period, rad/s², shape (n - 1, 2)."""
        return np.diff(self.speeds, axis=0) / self.period - self.push[:-1]


def excitation(time: Array, seed: int) -> Array:
    """Return a bounded push u (rad/s²) of both wheels, shape (n, 2), at ``time`` (s).

    The derivative of five sines of 2 rad/s with random frequencies of 0.03 to 0.4 Hz, evenly
    spread in their logarithm, and random phases: without friction the wheels would turn at
    3 rad/s rms, as the chaotic reference makes them, and never beyond 10 rad/s from their mean.
    """
    generator = np.random.default_rng((seed, 86))
    rates = 2.0 * np.pi * np.exp(generator.uniform(math.log(0.03), math.log(0.4), (2, 5)))
    phases = generator.uniform(0.0, 2.0 * np.pi, (2, 5))
    angles = time[:, np.newaxis, np.newaxis] * rates + phases
    push: Array = np.sum(2.0 * rates * np.cos(angles), axis=-1)
    return push


def torque_robot(variance: float, seed: int) -> PaperRobotParameters:
    """Return the robot of the paper's simulation: torque drive, noise of this variance.

    Friction and disturbance are the robot's defaults: the paper folds them into the unknown part.
    """
    return PaperRobotParameters.from_dict(
        {'drive.kind': 'torque', 'noise.variance': variance, 'seed': seed}
    )


def simulate_open_loop(
    parameters: PaperRobotParameters, duration: float, seed: int
) -> OpenLoopRun:
    """Return a run of the robot (10) under the torque theta_bar u, with no controller.

    The robot has a torque drive; theta_bar is the nominal (11). ``seed`` is that of the
    excitation, that of disturbance and noise is in ``parameters``.
    """
    period = 1.0 / parameters.rate
    steps = round(duration / period)
    if steps < 2:
        raise ValueError(f'duration must be at least {2 * period:g} s: got {duration}')
    inertia = wheel_inertia(parameters.body, parameters.geometry)
    # The push is held over a period: its middle is what a held value stands for.
    middles: Array = period * (np.arange(steps, dtype=np.float64) + 0.5)
    push = excitation(middles, seed)
    torques = push @ inertia
    speeds, measured = np.empty((steps, 2)), np.empty((steps, 2))
    robot = PaperRobot(parameters)
    state = robot.state
    for k in range(steps):
        assert state.true_wheels is not None
        speeds[k], measured[k] = state.true_wheels, state.wheels
        state = robot.step_torque(float(torques[k, 0]), float(torques[k, 1]))
    return OpenLoopRun(period, push, speeds, measured)


def estimate(
    run: OpenLoopRun, fuzzy: FuzzyEstimator | None, gain: float = OUTPUT_ERROR_GAIN
) -> tuple[Array, Array]:
    """Return (chi_hat, g) of (86) with E18 along a run, rad/s and rad/s², shape (n, 2) each.

    chi_hat[k] has seen measurements up to k - 1 only: it is a prediction of one period. The fuzzy
    system learns on the way; None is g = 0. ``gain`` is a of the output error, 1/s.
    """
    found = run.measured[0].copy()
    speeds, unknown = np.empty_like(run.measured), np.zeros_like(run.measured)
    for k, measured in enumerate(run.measured):
        speeds[k] = found
        error = measured - found
        if fuzzy is not None:
            unknown[k] = fuzzy.evaluate(measured)
            fuzzy.adapt(error, run.period)
        found = found + run.period * (unknown[k] + run.push[k] + gain * error)
    return speeds, unknown


def estimator(kind: str, noise_variance: float, normalised_gain: float) -> FuzzyEstimator:
    """Return a fuzzy system of one kind without adaptation.

    Whatever the kind, its inputs are as fuzzy as the noise is wide, and gamma |Phi|² is
    ``normalised_gain`` (1/s²) on average: at equal gamma the kinds would learn at different
    speeds, and nothing else would be compared.
    """
    parameters = FuzzyParameters(kind=kind, input_fuzziness=math.sqrt(2.0 * noise_variance))
    return FuzzyEstimator(
        parameters, replace(AdaptationParameters(), gamma=gamma_for(parameters, normalised_gain))
    )


def compare(
    *,
    seeds: Sequence[int] = (1, 2, 3, 4, 5),
    duration: float = 60.0,
    variances: Sequence[float] = VARIANCES,
    normalised_gain: float = NORMALISED_GAIN,
    progress: bool = False,
) -> ResultTable:
    """Return the errors in (86), on equal runs: a row for each kind, noise and seed.

    ``speed`` is the RMSE of chi_hat against the true chi, rad/s, ``unknown`` that of g against
    chi' - u, rad/s², both wheels after :data:`SETTLE`. ``variances`` are those of the measured
    wheel speeds, (rad/s)²; ``normalised_gain`` is the mean of gamma |Phi|² for every kind, 1/s².
    """
    if duration <= SETTLE:
        raise ValueError(f'duration must be more than {SETTLE:g} s: got {duration}')
    rows = []
    with progress_bar(len(variances) * len(seeds), show=progress) as bar:
        for variance in variances:
            for seed in seeds:
                run = simulate_open_loop(torque_robot(variance, seed), duration, seed)
                first = round(SETTLE / run.period)
                for kind in (*KINDS, NO_FUZZY_SYSTEM):
                    none = kind == NO_FUZZY_SYSTEM
                    fuzzy = None if none else estimator(kind, variance, normalised_gain)
                    speeds, unknown = estimate(run, fuzzy)
                    errors = {
                        'speed': rms((speeds - run.speeds)[first:]),
                        'unknown': rms((unknown[:-1] - run.target)[first:]),
                    }
                    rows.append({'kind': kind, 'noise_variance': variance, 'seed': seed, **errors})
                bar.update()
    return ResultTable(rows)


def records(results: ResultTable) -> list[dict[str, object]]:
    """Return each kind at each noise as plain data: numbers of the seeds, mean and interval."""
    found = []
    for (kind, variance), rows in results.groups('kind', 'noise_variance').items():
        record: dict[str, object] = {'kind': kind, 'noise_variance': variance}
        for name in ('speed', 'unknown'):
            values = [row[name] for row in rows]
            record |= {f'{name}_mean': mean(values), f'{name}_ci95': interval(values)}
            record[name] = values
        found.append(record | {'seeds': len(rows)})
    return found
