# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The paper's controller put together for two wheels: Fig. 1, equations (64)-(82)."""

from collections.abc import Mapping
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.estimate import EstimateSettings, SpeedEstimator
from t3mpc_ros.control.law import (
    TERMS,
    Certificate,
    CertificateReading,
    LawSettings,
    law_terms,
    ultimate_bound,
)
from t3mpc_ros.fuzzy.adaptation import AdaptationSettings
from t3mpc_ros.fuzzy.estimator import FuzzyEstimator
from t3mpc_ros.fuzzy.sets import FuzzySettings
from t3mpc_ros.mpc.predictive import PredictiveSettings, PredictiveTerm
from t3mpc_ros.settings import Settings, nested, setting

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CompositionSettings(Settings):
    """Everything the law is made of; each part can be left out."""

    rate: float = setting(100.0, 'control steps a second', unit='Hz', low=5.0, high=1000.0)
    use_fuzzy: bool = setting(
        True, 'whether the fuzzy estimate g is learnt and cancelled (NT3FS)', live=True
    )
    switch_jump: float = setting(
        0.3,
        'step of a wheel reference, beyond its own slope, that is taken as a switch',
        unit='rad/s',
        low=0.01,
        high=100.0,
    )
    switch_rate: float = setting(
        20.0,
        'rate at which the reference that is really followed closes up after a switch',
        unit='1/s',
        low=0.5,
        high=100.0,
        live=True,
    )
    switch_acceleration: float = setting(
        28.0,
        'largest acceleration spent on that, a little below what the robot can do',
        unit='rad/s²',
        low=0.1,
        high=1000.0,
        live=True,
    )
    handover: float = setting(
        0.2,
        'how strongly a lasting v_p teaches the fuzzy systems, which then take it over: they '
        'learn from delta - handover v_p; 0 is (77)-(78) as printed',
        unit='s',
        low=0.0,
        high=10.0,
        live=True,
    )
    law: LawSettings = nested(LawSettings)
    estimate: EstimateSettings = nested(EstimateSettings)
    fuzzy: FuzzySettings = nested(FuzzySettings)
    adaptation: AdaptationSettings = nested(AdaptationSettings)
    predictive: PredictiveSettings = nested(PredictiveSettings)

    @property
    def compensated_bound(self) -> float:
        """omega-bar + v_p-bar of (80)-(82), rad/s²: what the compensator must outweigh."""
        predictive = self.predictive.v_max if self.predictive.enabled else 0.0
        return self.law.error_bound + predictive


class ComposedLaw:
    """Computes the wheel accelerations that make two wheels follow a reference.

    The plant it expects is (64)-(65): chi' = g*(chi) + u + omega for each wheel, g* unknown.
    It holds the estimator of state, the fuzzy estimates of the dynamics and the predictive term,
    and knows neither poses nor clocks: speeds in, accelerations out, per period. What the drive
    makes of the acceleration comes back through :meth:`applied`, because estimates must use the
    acceleration that was really applied.

    **Switches.** Assumption 3 of the paper, a reference that the robot can follow, fails at a
    switch, where r jumps. There the law follows rbar = r + h instead, with h so that rbar does
    not jump, h' = -switch_rate h, and no faster than ``switch_acceleration``. Everything of
    (66)-(84) then holds for delta-bar = chi - rbar, nothing takes the jump for an estimation
    error and learns from it, and delta = delta-bar + h is as small as before once h is gone.

    **Handover.** The adaptation and the offset-free predictive term both integrate; left alone
    they may share a lasting disturbance in any way, even against each other. The fuzzy systems
    therefore learn from delta-bar - handover v_p. A v_p that opposes what they have not learnt,
    v_p = -(g* - g), adds -handover (g* - g)² to (76): it can only help the proof.

    Parameters
    ----------
    settings
        The parts and their gains.
    drive
        ``'velocity'`` when the robot integrates the command itself and is told wheel speeds,
        ``'torque'`` when the acceleration is applied directly, as in the paper's simulations.
    """

    def __init__(self, settings: CompositionSettings, drive: str = 'velocity') -> None:
        self._settings = settings
        self._period = 1.0 / settings.rate
        self._drive = drive
        self._estimator = SpeedEstimator(settings.estimate, drive, self._period)
        self.fuzzy = FuzzyEstimator(settings.fuzzy, settings.adaptation, outputs=2)
        self.predictive = PredictiveTerm(
            settings.predictive, self._period, settings.law.gain, outputs=2
        )
        self._certificate = Certificate()
        self.terms: Array = np.zeros((len(TERMS), 2))
        """The law's terms of the last step, rows as in ``law.TERMS``, rad/s²."""
        self.command: Array = np.zeros(2)
        """Their sum u, rad/s²."""
        self.reset(np.zeros(2))

    def warm_up(self) -> None:
        """Compile every kernel and pre-train the predictor now, never inside a step."""
        self.fuzzy.warm_up()
        self.predictive.warm_up()
        zero = np.zeros(2)
        law_terms(zero, zero, zero, zero, zero, 1.0, 1.0, 1.0, self.terms, self.command)
        self.terms[:] = 0.0
        self.command[:] = 0.0

    def configure(self, settings: CompositionSettings) -> None:
        """Use other live settings from the next step on; what was learnt is kept."""
        self._settings = settings
        self.fuzzy.configure(settings.adaptation)
        self.predictive.configure(settings.predictive, settings.law.gain)

    def learnt(self) -> dict[str, Array]:
        """Return everything learnt, by name, to be saved: coefficients and predictor weights."""
        weights = self.predictive.weights()
        return {'fuzzy.coefficients': self.fuzzy.coefficients.copy()} | {
            f'predictive.{name}': value for name, value in weights.items()
        }

    def restore(self, learnt: Mapping[str, Array]) -> None:
        """Use what :meth:`learnt` returned.

        Raises
        ------
        ValueError
            A name is missing or unknown, a shape does not fit these settings, or a number is not
            finite; nothing is changed then but the fuzzy coefficients.
        """
        weights = {
            name.removeprefix('predictive.'): value
            for name, value in learnt.items()
            if name.startswith('predictive.')
        }
        if 'fuzzy.coefficients' not in learnt:
            raise ValueError('fuzzy.coefficients are missing')
        self.fuzzy.coefficients = learnt['fuzzy.coefficients']
        self.predictive.set_weights(weights)

    def reset(self, speeds: Array) -> None:
        """Start again from measured wheel speeds (rad/s); what was learnt is kept."""
        self._estimator.reset(speeds)
        self.predictive.reset()
        self._certificate.reset()
        self._applied: Array | None = None
        self._wanted: Array | None = None
        self._wanted_rate: Array = np.zeros(2)
        self._closing_rate: Array = np.zeros(2)
        self.closing: Array = np.zeros(2)
        """h, what is left of the last jumps of the reference, rad/s, shape (2,)."""
        self._frozen = False
        self.reading = CertificateReading(0.0, 0.0, 0.0)

    @property
    def speeds(self) -> Array:
        """Estimated wheel speeds, rad/s, shape (2,)."""
        return self._estimator.speeds

    @property
    def ball(self) -> float:
        """Radius (rad/s) of the ball that E14 promises the error ends in."""
        law = self._settings.law
        return ultimate_bound(law.gain, self._bound(), law.smoothing)

    def step(self, measured: Array, wanted: Array, wanted_rate: Array, dt: float) -> Array:
        """Return the wheel accelerations u (rad/s²) of (66)-(67), shape (2,).

        Parameters
        ----------
        measured
            Measured wheel speeds chi, rad/s, shape (2,).
        wanted, wanted_rate
            Reference r (rad/s) and its time derivative (rad/s²) without the jumps, shape (2,).
        dt
            Seconds since the last step.
        """
        settings = self._settings
        if self._applied is not None:
            self._estimator.predict(self._applied, dt)
        speeds = self._estimator.correct(measured)
        closing_rate = self._close(speeds, wanted, wanted_rate, dt)
        followed = wanted + self.closing
        errors = speeds - followed

        estimate = np.zeros(2)
        if settings.use_fuzzy:
            estimate = self.fuzzy.evaluate(speeds)
        predictive = self.predictive.step(errors)
        if settings.use_fuzzy and not self._frozen:
            self.fuzzy.adapt(errors - settings.handover * predictive, dt)
        law_terms(
            speeds,
            followed,
            wanted_rate + closing_rate,
            estimate,
            predictive,
            settings.law.gain,
            self._bound(),
            settings.law.smoothing,
            self.terms,
            self.command,
        )
        self.reading = self._certificate.update(errors, settings.law, self._bound(), dt)
        return self.command

    def applied(self, acceleration: Array, command: Array, *, limited: bool) -> None:
        """Take note of what the drive made of the last command.

        Parameters
        ----------
        acceleration
            Wheel accelerations really applied, rad/s², shape (2,).
        command
            Wheel speeds really commanded, rad/s, shape (2,); unused with a torque drive.
        limited
            Whether a limit cut the command: the error is then not the estimate's fault, so
            adaptation pauses, and the predictor is told that less of v_p arrived.
        """
        self._applied = command if self._drive == 'velocity' else acceleration
        self._frozen = limited
        if limited:
            wanted = self.terms[4]
            self.predictive.notify_applied(wanted + (acceleration - self.command))

    def _bound(self) -> float:
        return self._settings.compensated_bound if self._settings.law.compensator else 0.0

    def _close(self, speeds: Array, wanted: Array, wanted_rate: Array, dt: float) -> Array:
        """Renew h, and return its rate of change until the next step (rad/s²)."""
        settings = self._settings
        if self._wanted is None:
            self.closing = speeds - wanted  # start from where the robot is
        else:
            self.closing = self.closing + dt * self._closing_rate
            jump = wanted - (self._wanted + 0.5 * dt * (self._wanted_rate + wanted_rate))
            if np.max(np.abs(jump)) > settings.switch_jump:
                self.closing = self.closing - jump
        self._wanted = wanted.copy()
        self._wanted_rate = wanted_rate.copy()
        # One step of the exponential, so that h never overshoots zero however large the rate.
        share = (1.0 - math.exp(-settings.switch_rate * dt)) / dt
        most = settings.switch_acceleration
        self._closing_rate = np.clip(-share * self.closing, -most, most)
        return self._closing_rate
