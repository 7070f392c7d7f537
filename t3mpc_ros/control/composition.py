# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The paper's controller put together for two wheels: Fig. 1, equations (64)-(82)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.estimate import EstimateSettings
from t3mpc_ros.control.law import (
    TERMS,
    Certificate,
    CertificateReading,
    LawSettings,
    law_terms,
    ultimate_bound,
)
from t3mpc_ros.control.switches import SwitchSettings
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
    handover: float = setting(
        0.025,
        'how strongly a lasting v_p teaches the fuzzy systems, which then take it over: they '
        'learn from delta - handover v_p; 0 is (77)-(78) as printed',
        unit='s',
        low=0.0,
        high=10.0,
        live=True,
    )
    law: LawSettings = nested(LawSettings)
    switches: SwitchSettings = nested(SwitchSettings)
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
    :class:`t3mpc_ros.control.drive.Drive` makes that plant of a robot, and tells by
    :meth:`applied` what its limits made of u, because estimates must use the acceleration that
    was really applied. The law knows neither poses nor clocks: speeds in, accelerations out.

    **Handover.** The adaptation and the offset-free predictive term both integrate; left alone
    they may share a lasting disturbance in any way, even against each other. The fuzzy systems
    therefore learn from delta - handover v_p. A v_p that opposes what they have not learnt,
    v_p = -(g* - g), adds -handover (g* - g)² to (76): it can only help the proof.

    Parameters
    ----------
    settings
        The parts and their gains.
    """

    def __init__(self, settings: CompositionSettings) -> None:
        self._settings = settings
        self._period = 1.0 / settings.rate
        self.fuzzy = FuzzyEstimator(settings.fuzzy, settings.adaptation, outputs=2)
        self.predictive = PredictiveTerm(
            settings.predictive, self._period, settings.law.gain, outputs=2
        )
        self._certificate = Certificate()
        self._none: Array = np.zeros(2)
        self.terms: Array = np.zeros((len(TERMS), 2))
        """The law's terms of the last step, rows as in ``law.TERMS``, rad/s²."""
        self.command: Array = np.zeros(2)
        """Their sum u, rad/s²."""
        self.reset()

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

    def reset(self) -> None:
        """Start a new run; what was learnt is kept."""
        self.predictive.reset()
        self._certificate.reset()
        self._frozen = False
        self.reading = CertificateReading(0.0, 0.0, 0.0)

    @property
    def ball(self) -> float:
        """Radius (rad/s) of the ball that E14 promises the error ends in."""
        law = self._settings.law
        return ultimate_bound(law.gain, self._bound(), law.smoothing)

    def step(
        self,
        speeds: Array,
        wanted: Array,
        wanted_rate: Array,
        dt: float,
        known_change: Array | None = None,
    ) -> Array:
        """Return the wheel accelerations u (rad/s²) of (66)-(67), shape (2,).

        Parameters
        ----------
        speeds
            Wheel speeds chi (estimated, for the instant at which u begins to act), rad/s, (2,).
        wanted, wanted_rate
            Reference r (rad/s) at that instant and its time derivative until the next step
            (rad/s²), shape (2,): a reference that the wheels can follow.
        dt
            Seconds since the last step.
        known_change
            Jumps of the error still to come, see :meth:`PredictiveTerm.step`.
        """
        settings = self._settings
        errors = speeds - wanted
        estimate = self.fuzzy.evaluate(speeds) if settings.use_fuzzy else self._none
        # What is left of a jump that was announced is nobody's fault, and teaches nothing.
        blame = errors - self.predictive.known_error
        predictive = self.predictive.step(errors, known_change)
        if settings.use_fuzzy and not self._frozen:
            self.fuzzy.adapt(blame - settings.handover * predictive, dt)
        law_terms(
            speeds,
            wanted,
            wanted_rate,
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

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Take note of what the drive made of the last command.

        Parameters
        ----------
        acceleration
            Wheel accelerations really applied, rad/s², shape (2,).
        limited
            Whether a limit cut the command: the error is then not the estimate's fault, so
            adaptation pauses, and the predictor is told that less of v_p arrived.
        """
        self._frozen = limited
        if limited:
            wanted = self.terms[4]
            self.predictive.notify_applied(wanted + (acceleration - self.command))

    def _bound(self) -> float:
        return self._settings.compensated_bound if self._settings.law.compensator else 0.0
