# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The paper's controller put together for two wheels: Fig. 1, equations (64)-(82)."""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import NamedTuple

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
    update_certificate,
)
from t3mpc_ros.control.switches import SwitchSettings
from t3mpc_ros.fuzzy.adaptation import AdaptationSettings, adapt
from t3mpc_ros.fuzzy.estimator import FuzzyEstimator, estimate
from t3mpc_ros.fuzzy.sets import FuzzySettings
from t3mpc_ros.kernels import kernel
from t3mpc_ros.mpc.predictive import PredictiveSettings, PredictiveTerm
from t3mpc_ros.mpc.response import signals_in
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


class Gains(NamedTuple):
    """What :func:`compose` is told of the settings: plain numbers, for kernels."""

    use_fuzzy: bool
    adapted: bool
    handover: float
    gain: float
    bound: float
    smoothing: float
    window: float
    gamma: float
    radius: float
    leakage: float
    dead_zone: float
    step_limit: float


@kernel
def gains_in(told: Array) -> Gains:
    """Return the numbers of a row by name."""
    return Gains(
        told[0] != 0.0,
        told[1] != 0.0,
        told[2],
        told[3],
        told[4],
        told[5],
        told[6],
        told[7],
        told[8],
        told[9],
        told[10],
        told[11],
    )


@kernel
def compose(
    speeds: Array,
    wanted: Array,
    wanted_rate: Array,
    rows: Array,
    dt: float,
    frozen: bool,
    gains_told: Array,
    centres: Array,
    pull: Array,
    sharpness: Array,
    shares: Array,
    grades: Array,
    firings: Array,
    phi: Array,
    coefficients: Array,
    work: Array,
    terms: Array,
    command: Array,
    remembered: Array,
) -> bool:
    """Write terms and command of the law, adapt, and renew the certificate.

    Returns False, and changes nothing, when a speed is not finite.

    speeds ... wanted_rate : as in :func:`t3mpc_ros.control.law.law_terms`
    rows           : :class:`t3mpc_ros.mpc.response.Signals` of the predictive term
    dt             : s since the last step
    frozen         : whether a limit cut the last command
    gains_told     : the numbers of :class:`Gains`
    centres ... coefficients : as in :func:`t3mpc_ros.fuzzy.estimator.estimate`
    work           : shape (2, n), overwritten: g, and what the coefficients learn from
    terms, command : overwritten
    remembered     : as in :func:`t3mpc_ros.control.law.update_certificate`
    """
    gains, predictive = gains_in(gains_told), signals_in(rows)
    guess, blame = work[0], work[1]
    guess[:] = 0.0
    if gains.use_fuzzy and not estimate(
        speeds, centres, pull, sharpness, shares, grades, firings, phi, coefficients, guess
    ):
        return False
    law_terms(
        speeds,
        wanted,
        wanted_rate,
        guess,
        predictive.v,
        gains.gain,
        gains.bound,
        gains.smoothing,
        terms,
        command,
    )
    if gains.adapted and not frozen:
        # What is left of a jump that was announced is nobody's fault, and teaches nothing.
        for i in range(blame.size):
            blame[i] = predictive.unforeseen[i] - gains.handover * predictive.v[i]
        adapt(
            coefficients,
            phi,
            blame,
            dt,
            gains.gamma,
            gains.radius,
            gains.leakage,
            gains.dead_zone,
            gains.step_limit,
        )
    update_certificate(
        predictive.errors, gains.gain, gains.bound, gains.smoothing, dt, gains.window, remembered
    )
    return True


@kernel
def note_applied(terms: Array, acceleration: Array, command: Array, rows: Array) -> bool:
    """Write the v_p that was applied where a limit cut u; return False if it is not finite.

    terms, command : of :func:`compose`
    acceleration   : shape (2,), what the limits made of the command, rad/s²
    rows           : :class:`t3mpc_ros.mpc.response.Signals` of the predictive term
    """
    predictive = signals_in(rows)
    for i in range(acceleration.size):
        predictive.applied[i] = terms[4, i] + (acceleration[i] - command[i])
        if not math.isfinite(predictive.applied[i]):
            return False
    return True


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
        self._work: Array = np.zeros((2, 2))
        self.terms: Array = np.zeros((len(TERMS), 2))
        """The law's terms of the last step, rows as in ``law.TERMS``, rad/s²."""
        self.command: Array = np.zeros(2)
        """Their sum u, rad/s²."""
        self.frozen = False
        """Whether a limit cut the last command."""
        self._gains = self._make_gains()
        self.reset()

    def warm_up(self) -> None:
        """Compile every kernel and pre-train the predictor now, never inside a step."""
        self.fuzzy.warm_up()
        self.predictive.warm_up()
        coefficients = self.fuzzy.coefficients
        self.step(np.zeros(2), np.zeros(2), np.zeros(2), self._period)
        self.applied(self.command, limited=True)
        self.fuzzy.reset()
        self.fuzzy.coefficients = coefficients
        self.reset()
        self.terms[:] = 0.0
        self.command[:] = 0.0

    def configure(self, settings: CompositionSettings) -> None:
        """Use other live settings from the next step on; what was learnt is kept."""
        self._settings = settings
        self.fuzzy.configure(settings.adaptation)
        self.predictive.configure(settings.predictive, settings.law.gain)
        self._gains = self._make_gains()

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

    def copies(self) -> tuple[Array, list[Array]]:
        """Return what is learnt as it is now, for :meth:`go_back`: much faster than learnt."""
        return self.fuzzy.coefficients, self.predictive.copies()

    def go_back(self, copies: tuple[Array, list[Array]]) -> None:
        """Use what :meth:`copies` returned, as :meth:`restore` does."""
        coefficients, predictors = copies
        self.fuzzy.coefficients = coefficients
        self.predictive.go_back(predictors)

    def reset(self) -> None:
        """Start a new run; what was learnt is kept."""
        self.predictive.reset()
        self._certificate.reset()
        self.frozen = False

    @property
    def tables(self) -> tuple[Array, ...]:
        """What :func:`compose` reads and writes beside its inputs, in its order."""
        remembered = self._certificate.remembered
        return self._gains, *self.fuzzy.tables, self._work, self.terms, self.command, remembered

    @property
    def watched(self) -> Array:
        """What the certificate remembers, see :func:`update_certificate`."""
        return self._certificate.remembered

    @property
    def reading(self) -> CertificateReading:
        """What the certificate says."""
        return self._certificate.reading

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
        self.predictive.advance(speeds, wanted, known_change)
        if not compose(
            speeds,
            wanted,
            wanted_rate,
            self.predictive.rows,
            dt,
            self.frozen,
            self._gains,
            *self.fuzzy.tables,
            self._work,
            self.terms,
            self.command,
            self._certificate.remembered,
        ):
            raise ValueError(f'speeds must be finite: got {speeds}')
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
        self.frozen = limited
        if limited and not note_applied(
            self.terms, acceleration, self.command, self.predictive.rows
        ):
            raise ValueError(f'acceleration must be finite: got {acceleration}')

    def _make_gains(self) -> Array:
        settings, law, adaptation = self._settings, self._settings.law, self._settings.adaptation
        return np.array(
            Gains(
                use_fuzzy=settings.use_fuzzy,
                adapted=settings.use_fuzzy and adaptation.enabled,
                handover=settings.handover,
                gain=law.gain,
                bound=self._bound(),
                smoothing=law.smoothing,
                window=self._certificate.window,
                gamma=adaptation.gamma,
                radius=self.fuzzy.radius,
                leakage=adaptation.sigma_modification,
                dead_zone=adaptation.dead_zone,
                step_limit=adaptation.step_limit,
            ),
            dtype=np.float64,
        )

    def _bound(self) -> float:
        return self._settings.compensated_bound if self._settings.law.compensator else 0.0
