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
"""Adaptive fuzzy control with a type-1 or an interval type-2 system."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from t3mpc_ros.control.control_law import compensator
from t3mpc_ros.evaluation.baselines.baseline_controller import NominalModel, Observation
from t3mpc_ros.evaluation.baselines.feedback_control import FeedbackBaseline, FeedbackParameters
from t3mpc_ros.fuzzy.estimator import AdaptationParameters, FuzzyEstimator, gamma_for
from t3mpc_ros.fuzzy.inference import FuzzyParameters
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import Parameters, parameter


@dataclass(frozen=True)
class AdaptiveType1Parameters(FeedbackParameters):
    """Gains and sets of the type-1 controller; the sets cover -10 to 10 rad/s."""

    gain: float = parameter(30.0, 'feedback K on the error', '1/s', (0.5, 100.0))
    normalised_gain: float = parameter(
        100.0,
        'adaptation gain gamma |Phi|², averaged over the inputs: the error obeys '
        's² + K s + gamma |Phi|² = 0',
        '1/s²',
        (0.1, 5000.0),
    )
    dead_zone: float = parameter(
        0.01,
        'error from which on coefficients adapt; a smaller one counts as noise',
        'rad/s',
        (0.0, 2.0),
    )
    error_bound: float = parameter(
        0.5,
        'bound of what the fuzzy system cannot explain, outweighed by the robust term; 0 leaves '
        'the term out',
        'rad/s²',
        (0.0, 30.0),
    )
    smoothing: float = parameter(
        0.5, 'width of the robust term, epsilon in tanh(e/epsilon)', 'rad/s', (0.01, 10.0)
    )
    sets: int = parameter(7, 'Gaussian sets per input', bounds=(2, 9))
    spread: float = parameter(
        0.6, 'width of the sets as a fraction of their spacing', bounds=(0.2, 3.0)
    )
    centre_exponent: float = parameter(
        2.0, 'how much closer together the centres are in the middle', bounds=(0.2, 5.0)
    )

    def fuzzy(self) -> FuzzyParameters:
        """Return the shape of the fuzzy system, type-1; the fuzzifier is a singleton."""
        return FuzzyParameters(
            kind='type1',
            sets=self.sets,
            spread=self.spread,
            centre_exponent=self.centre_exponent,
            input_fuzziness=0.0,
        )


@dataclass(frozen=True)
class AdaptiveIntervalType2Parameters(AdaptiveType1Parameters):
    """Gains and sets of the interval type-2 controller."""

    footprint_of_uncertainty: float = parameter(
        0.23,
        'uncertainty of the sets: widths are (1 - footprint) and (1 + footprint) times the middle',
        bounds=(0.0, 0.9),
    )

    def fuzzy(self) -> FuzzyParameters:
        """Return the shape of the fuzzy system, interval type-2; the fuzzifier is a singleton."""
        return replace(
            super().fuzzy(),
            kind='interval_type2',
            footprint_of_uncertainty=self.footprint_of_uncertainty,
        )


@lru_cache(maxsize=64)
def _unit_gamma(fuzzy: FuzzyParameters) -> float:
    """Return the gamma whose normalised gain is 1 1/s²; many runs share one shape."""
    return gamma_for(fuzzy, 1.0)


class _Adaptive(FeedbackBaseline[AdaptiveType1Parameters]):
    r"""The law both share: u = r' + v(h) - g(chi|alpha) - K e - bound tanh(e/epsilon).

    The coefficients learn by alpha' = gamma Phi e from the error that their own estimate has
    caused, that is with the basis of the step before:

    .. math:: \alpha_{k+1} = \alpha_k + \gamma T \Phi_k e_{k+1}.

    With an exact alpha* and no robust term, V = e²/2 + |alpha* - alpha|²/(2 gamma) then changes by
    -(e_k² - 2(1 - KT) e_k e_(k+1) + (1 - gamma |Phi|² T²) e_(k+1)²)/2, which is negative for any
    errors while gamma |Phi|² T < K (2 - KT): not only in continuous time. The step limit of the
    adaptation is put there.
    """

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        table = self.parameters
        fuzzy = table.fuzzy()
        steps = table.gain * nominal_model.period
        self.fuzzy = FuzzyEstimator(
            fuzzy,
            AdaptationParameters(
                gamma=table.normalised_gain * _unit_gamma(fuzzy),
                dead_zone=table.dead_zone,
                step_limit=max(0.001, table.gain * min(1.0, 2.0 - steps)),
            ),
        )
        self.error: Array = np.zeros(2)
        """e, the error that is learnt from, rad/s, shape (2,)."""
        self._limited = False

    def feedback(self, observation: Observation, feedforward: Array, error: Array) -> Array:
        """Return u, rad/s², shape (2,)."""
        table, self.error = self.parameters, error
        if not self._limited:
            self.fuzzy.adapt(error, self._period)
        estimate = self.fuzzy.evaluate(observation.speeds)
        robust = [compensator(e, table.error_bound, table.smoothing) for e in error.tolist()]
        return np.asarray(feedforward - estimate - table.gain * error + robust)

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Take note of the u that was applied; adaptation pauses while the drive is limited."""
        super().applied(acceleration, limited=limited)
        self._limited = limited

    def get_weights(self) -> dict[str, Array]:
        """Return the coefficients."""
        return {'coefficients': self.fuzzy.coefficients}

    def set_weights(self, weights: Mapping[str, Array]) -> None:
        """Begin with other coefficients."""
        self.fuzzy.coefficients = weights['coefficients']


class AdaptiveType1(_Adaptive):
    """Adaptive control with a type-1 fuzzy system (Wang 1993), see :class:`_Adaptive`."""

    parameters_type = AdaptiveType1Parameters


class AdaptiveIntervalType2(_Adaptive):
    """Adaptive control with an interval type-2 fuzzy system (Liang and Mendel 2000).

    See :class:`_Adaptive`.
    """

    parameters_type = AdaptiveIntervalType2Parameters
