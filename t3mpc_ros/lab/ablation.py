# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What each part of the controller is worth in the paper's setting, with numbers."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math
import sys

import numpy as np

from t3mpc_ros.chaos.reference import ReferenceSettings
from t3mpc_ros.control.composition import CompositionSettings
from t3mpc_ros.control.controller import Controller, ControllerSettings
from t3mpc_ros.lab.closed_loop import LoopRecord, run_torque, run_velocity
from t3mpc_ros.robot.simulated import SimulatedRobot, SimulatedRobotSettings

VARIANTS: dict[str, dict[str, object]] = {
    'full': {},
    'without NT3FS': {'use_fuzzy': False},
    'without compensator': {'law.compensator': False},
    'without MPC': {'predictive.enabled': False},
    'feedback and feed-forward only': {
        'use_fuzzy': False,
        'law.compensator': False,
        'predictive.enabled': False,
    },
}
"""Parts left out, as changes of the settings."""

# Two-sided 95 % quantiles of Student's t for 1 to 30 degrees of freedom.
_STUDENT = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228,
    2.201, 2.179, 2.160, 2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086,
    2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class VariantResult:
    """Tracking of one variant over several seeds."""

    name: str
    noise_variance: float
    rmse: tuple[float, ...]
    """One per seed, rad/s, both wheels, first 3 s left out."""
    settled: tuple[float, ...]
    """The same without 1 s after each switch."""
    chatter: tuple[float, ...]
    """Total variation of u per second, rad/s³."""
    largest_error: float
    """rad/s, over all seeds and times after 3 s."""
    finite: bool
    """Whether every number of every run is finite."""

    def record(self) -> dict[str, object]:
        """Return the result as plain data."""
        return {
            'variant': self.name,
            'noise_variance': self.noise_variance,
            'rmse_mean': mean(self.rmse),
            'rmse_ci95': interval(self.rmse),
            'rmse': list(self.rmse),
            'settled_mean': mean(self.settled),
            'settled_ci95': interval(self.settled),
            'chatter_mean': mean(self.chatter),
            'largest_error': self.largest_error,
            'finite': self.finite,
            'seeds': len(self.rmse),
        }


def mean(values: Sequence[float]) -> float:
    """Return the mean."""
    return float(np.mean(values))


def interval(values: Sequence[float]) -> float:
    """Return half the width of the 95 % confidence interval of the mean (Student's t)."""
    n = len(values)
    if n < 2:
        return math.inf
    quantile = _STUDENT[n - 2] if n - 2 < len(_STUDENT) else 1.96
    return float(quantile * np.std(values, ddof=1) / math.sqrt(n))


def paper_settings(
    noise_variance: float, seed: int
) -> tuple[ReferenceSettings, SimulatedRobotSettings]:
    """Return reference and robot of the paper's simulation: torque drive, noise, four switches.

    Friction and disturbance are the robot's defaults: the paper folds them into the unknown part.
    """
    reference = ReferenceSettings.from_flat({'seed': seed})
    robot = SimulatedRobotSettings.from_flat(
        {'drive.kind': 'torque', 'noise.variance': noise_variance, 'seed': seed}
    )
    return reference, robot


def law_settings(noise_variance: float, changes: dict[str, object]) -> CompositionSettings:
    """Return the law's defaults for a torque drive and known noise, with some parts changed.

    Torques are not limited as a stepper's acceleration is: switches are closed up faster.
    """
    fitting = {
        'estimate.noise_variance': noise_variance,
        'switch_rate': 30.0,
        'switch_acceleration': 100.0,
    }
    return CompositionSettings.from_flat(fitting | changes)


def paper_setting(
    *,
    seeds: int = 5,
    duration: float = 60.0,
    noise_variance: float = 0.04,
    drive: str = 'torque',
    progress: bool = False,
) -> list[VariantResult]:
    """Return each variant's tracking in the paper's setting, over ``seeds`` seeds from 1.

    ``drive`` is ``'torque'`` as in the paper, or ``'velocity'`` as the nodes close the loop.
    """
    results = []
    for name, changes in _with_progress(seeds, progress):
        rmse, settled, chatter, largest, finite = [], [], [], 0.0, True
        for seed in range(1, seeds + 1):
            run = _run(drive, noise_variance, changes, seed, duration)
            rmse.append(run.rmse())
            settled.append(run.rmse(cut=1.0))
            chatter.append(run.chatter())
            largest = max(largest, float(np.max(np.abs(run.error[run.time >= 3.0]), initial=0.0)))
            finite &= all(
                bool(np.isfinite(values).all())
                for values in (run.speeds, run.command, run.terms, run.wanted)
            )
        results.append(
            VariantResult(
                name,
                noise_variance,
                tuple(rmse),
                tuple(settled),
                tuple(chatter),
                largest,
                finite,
            )
        )
    return results


def _run(
    drive: str, noise_variance: float, changes: dict[str, object], seed: int, duration: float
) -> LoopRecord:
    reference, robot = paper_settings(noise_variance, seed)
    if drive == 'torque':
        return run_torque(law_settings(noise_variance, changes), reference, robot, duration)
    told = {'estimate.noise_variance': noise_variance} | changes
    stepper = robot.changed({'drive.kind': 'velocity'})
    return run_velocity(ControllerSettings.from_flat(told), reference, stepper, duration)


def table(results: Sequence[VariantResult]) -> str:
    """Return the results as a table in Markdown: mean ± half the 95 % interval over seeds."""
    full = next((result for result in results if result.name == 'full'), None)
    lines = [
        '| controller | RMSE (rad/s) | without 1 s after each switch | more than full, same seeds '
        '| largest error (rad/s) | variation of u (rad/s³) |',
        '|---|---|---|---|---|---|',
    ]
    for result in results:
        more = '' if full is None or result is full else _spread(difference(result, full), '+')
        lines.append(
            f'| {result.name} | {_spread(result.rmse)} | {_spread(result.settled)} | {more} '
            f'| {result.largest_error:.2f} | {mean(result.chatter):.0f} |'
        )
    return '\n'.join(lines)


def difference(result: VariantResult, base: VariantResult) -> tuple[float, ...]:
    """Return how much more RMSE ``result`` has than ``base``, seed by seed, rad/s."""
    return tuple(a - b for a, b in zip(result.rmse, base.rmse, strict=True))


def _spread(values: Sequence[float], sign: str = '') -> str:
    return f'{mean(values):{sign}.4f} ± {interval(values):.4f}'


def warm_up() -> None:
    """Compile every kernel of a closed loop, of both drives, into the cache."""
    reference, robot = paper_settings(0.04, 1)
    run_torque(law_settings(0.04, {}), reference, robot, 0.2)
    Controller(ControllerSettings()).warm_up()
    SimulatedRobot(SimulatedRobotSettings()).warm_up()


def _with_progress(seeds: int, progress: bool) -> Iterator[tuple[str, dict[str, object]]]:
    for index, (name, changes) in enumerate(VARIANTS.items()):
        if progress:
            print(
                f'  {index + 1} of {len(VARIANTS)}: {name}, {seeds} seeds',
                file=sys.stderr,
                flush=True,
            )
        yield name, changes
