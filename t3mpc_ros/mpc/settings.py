# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What can be chosen about the predictive term, and what kernels are told of it."""

from dataclasses import dataclass
import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.kernels import kernel
from t3mpc_ros.settings import SettingError, Settings, nested, setting

Array = NDArray[np.float64]


@dataclass(frozen=True)
class NominalLoop(Settings):
    """The error dynamics the machine is trained on before it meets the robot.

    delta' = -K (delta + noise) + a + w,   lag a' = v_p(t - dead_time) - a.
    """

    feedback_gain: float = setting(
        8.0,
        'feedback K; the controller puts its own in its place',
        unit='1/s',
        low=0.1,
        high=100.0,
    )
    lag: float = setting(
        0.02, 'time constant from v_p to acceleration', unit='s', low=1e-3, high=1.0
    )
    dead_time: float = setting(0.01, 'delay before v_p acts', unit='s', low=0.0, high=1.0)


@dataclass(frozen=True)
class Excitation(Settings):
    """The simulated run, and how the machine learns from it beforehand."""

    duration: float = setting(240.0, 'length of the run', unit='s', low=10.0, high=3600.0)
    move: float = setting(
        0.5, 'largest v_p of the random levels, as a share of its scale', low=0.01, high=2.0
    )
    move_hold: float = setting(
        0.3, 'mean time a level of v_p lasts', unit='s', low=0.01, high=100.0
    )
    disturbance: float = setting(
        2.0, 'standard deviation of the disturbance w', unit='rad/s²', low=0.0, high=1000.0
    )
    disturbance_hold: float = setting(
        2.0,
        'mean time a level of w lasts: the machine expects disturbances to last as long',
        unit='s',
        low=0.01,
        high=1000.0,
    )
    noise: float = setting(
        0.15, 'standard deviation of the measured error', unit='rad/s', low=0.0, high=10.0
    )
    epochs: int = setting(2, 'passes of CD-1 (43) over the run', low=0, high=100)
    contrast_rate: float = setting(0.002, 'gamma of (43) during the run', low=0.0, high=1.0)
    ridge: float = setting(
        1e-6, 'ridge penalty, as a share of the mean square of the features', low=1e-12, high=1.0
    )


@dataclass(frozen=True)
class PredictiveSettings(Settings):
    """Horizon, bounds, machine, learning and fading of the predictive term."""

    enabled: bool = setting(
        True, 'whether v_p is applied; when not, the machine still learns', live=True
    )
    every: int = setting(
        5, 'control periods per predictive period T; n_p T should reach 3/K', low=1, high=100
    )
    average: int = setting(
        5, 'newest errors averaged to one sample, at most every', low=1, high=100
    )
    horizon: int = setting(10, 'n_p', low=1, high=50)
    control_horizon: int = setting(5, 'n_c: later moves are zero', low=1, high=50)
    error_weight: float = setting(1.0, 'mu of (60)', unit='s²/rad²', low=0.0, high=1e6, live=True)
    move_weight: float = setting(
        0.029, 'pi of (60)', unit='s⁴/rad²', low=1e-9, high=1e6, live=True
    )
    v_max: float = setting(
        10.0, 'bound of v_p, v_p-bar of (80)', unit='rad/s²', low=0.0, high=1e4, live=True
    )
    dv_max: float = setting(
        4.0, 'bound of its change in a period T', unit='rad/s²', low=0.0, high=1e4, live=True
    )
    dither: float = setting(
        0.0,
        'largest random level added to v_p, a new one each period: switch it on while a bag is '
        'recorded that the predictor is to learn from, because feedback alone moves v_p too '
        'little to show what it does',
        unit='rad/s²',
        low=0.0,
        high=1e3,
        live=True,
    )
    probe: float = setting(
        1.0, 'dv of the step response (48), (51)', unit='rad/s²', low=1e-3, high=1e3
    )
    delta_lags: int = setting(4, 'past errors the machine sees, tau of (35)', low=1, high=50)
    move_lags: int = setting(4, 'past v_p it sees; these must cover the dead time', low=1, high=50)
    hidden: int = setting(12, 'hidden units, at least as many as lags', low=2, high=200)
    spread: float = setting(1.0, 'length of each row of the first X_v', low=1e-3, high=2.0)
    delta_scale: float = setting(
        3.0, 'error that counts as 1 in the machine', unit='rad/s', low=1e-3, high=1e3
    )
    move_scale: float = setting(
        20.0, 'v_p that counts as 1 in the machine', unit='rad/s²', low=1e-3, high=1e4
    )
    learning: bool = setting(True, 'whether the machine learns while it runs', live=True)
    learner: str = setting(
        'recursive',
        'output layer by recursive least squares, or by the normalised gradient (44)',
        choices=('recursive', 'gradient'),
    )
    memory: float = setting(20.0, 'time constant of forgetting', unit='s', low=0.1, high=1e4)
    trust: float = setting(
        30.0, 'experience that the pre-training is worth', unit='s', low=0.01, high=1e5
    )
    output_rate: float = setting(0.05, 'gamma of (44), normalised', low=0.0, high=1.0)
    contrast_rate: float = setting(1e-4, 'gamma of (43) while running', low=0.0, high=1.0)
    offset_gain: float = setting(
        0.0032, 'share of the latest miss that the offset e takes in', low=0.0, high=1.0
    )
    noise: float = setting(
        0.05,
        'standard deviation of a sampled error that is mere noise',
        unit='rad/s',
        low=1e-9,
        high=10.0,
    )
    skill_memory: float = setting(5.0, 'time constant of the skill', unit='s', low=0.1, high=1e4)
    fade_low: float = setting(-1.0, 'skill at which v_p is out', low=-100.0, high=1.0)
    fade_high: float = setting(
        0.0,
        'skill from which v_p has its whole bound; 0 is as good as persistence',
        low=-100.0,
        high=1.0,
    )
    gain_low: float = setting(
        0.2, 'step response over the nominal one at which v_p is out', low=-1.0, high=1.0
    )
    gain_high: float = setting(0.5, 'and from which it has its whole bound', low=-1.0, high=1.0)
    seed: int = setting(1, 'seed of the first weights and of the simulated run', low=0)
    nominal: NominalLoop = nested(NominalLoop)
    excitation: Excitation = nested(Excitation)

    def check_together(self) -> None:
        """Raise when settings that are each in range do not fit together."""
        for low, high in (
            ('control_horizon', 'horizon'),
            ('average', 'every'),
        ):
            small, large = getattr(self, low), getattr(self, high)
            if small > large:
                raise SettingError(f'{low} must be at most {high} = {large}: got {small}')
        if self.hidden < self.delta_lags + self.move_lags:
            raise SettingError(
                f'hidden must be at least delta_lags + move_lags = '
                f'{self.delta_lags + self.move_lags}: got {self.hidden}'
            )
        for low, high in (('fade_low', 'fade_high'), ('gain_low', 'gain_high')):
            if not getattr(self, low) < getattr(self, high):
                raise SettingError(
                    f'{low} must be below {high} = {getattr(self, high)}: got {getattr(self, low)}'
                )


class Learning(NamedTuple):
    """How a machine learns and is scored while it runs: plain numbers, for kernels."""

    recursive: bool
    """Whether by least squares (:func:`recall`) or else by the normalised gradient (44)."""
    contrast_rate: float
    """gamma of (43)."""
    output_rate: float
    """gamma of (44), normalised."""
    keep: float
    """lambda of :func:`recall`, per predictive period, as the next two."""
    smooth: float
    skill_keep: float
    offset_gain: float
    """Share of the latest miss that the offset e takes in."""
    noise: float
    """Standard deviation of an error that is mere noise (rad/s)."""

    @classmethod
    def of(cls, settings: PredictiveSettings, span: float) -> Self:
        """Return what the settings mean for a predictive period of ``span`` s."""
        return cls(
            recursive=settings.learner == 'recursive',
            contrast_rate=settings.contrast_rate,
            output_rate=settings.output_rate,
            keep=math.exp(-span / settings.memory),
            smooth=math.exp(-span / 2.0),
            skill_keep=math.exp(-span / settings.skill_memory),
            offset_gain=settings.offset_gain,
            noise=settings.noise,
        )


@kernel
def learning_in(told: Array) -> Learning:
    """Return the numbers of a row, as plain calls from Python hand them on best, by name."""
    return Learning(told[0] != 0.0, told[1], told[2], told[3], told[4], told[5], told[6], told[7])


class Rules(NamedTuple):
    """How v_p is made of what the machine foresees: plain numbers, for kernels."""

    enabled: bool
    learning: bool
    dithered: bool
    calm: float
    """Rest of a jump (rad/s) from which on the machine learns nothing: what is left of a large
    one is mostly how the robot's limits spoilt its decay."""
    probe: float
    error_weight: float
    move_weight: float
    v_max: float
    dv_max: float
    fade_low: float
    fade_high: float
    gain_low: float
    gain_high: float

    @classmethod
    def of(cls, settings: PredictiveSettings) -> Self:
        """Return what the settings say."""
        return cls(
            settings.enabled,
            settings.learning,
            settings.enabled and settings.dither > 0.0,
            0.1 * settings.delta_scale,
            settings.probe,
            settings.error_weight,
            settings.move_weight,
            settings.v_max,
            settings.dv_max,
            settings.fade_low,
            settings.fade_high,
            settings.gain_low,
            settings.gain_high,
        )


@kernel
def rules_in(told: Array) -> Rules:
    """Return the numbers of a row by name, see :func:`learning_in`."""
    return Rules(
        told[0] != 0.0,
        told[1] != 0.0,
        told[2] != 0.0,
        told[3],
        told[4],
        told[5],
        told[6],
        told[7],
        told[8],
        told[9],
        told[10],
        told[11],
        told[12],
    )
