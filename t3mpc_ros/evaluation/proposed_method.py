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
"""The NT3FS-BM-MPC controller behind the interface of the baselines."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from t3mpc_ros.control.control_law import InertiaTermParameters, Nt3fsMpcParameters
from t3mpc_ros.control.controller import SwitchingTracker
from t3mpc_ros.evaluation.baselines.baseline_controller import (
    FRICTION,
    JUMP,
    BaselineController,
    NominalModel,
    Observation,
    WheelLoads,
    announce_jumps,
)
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.geometry.types import NANOSECONDS, Array
from t3mpc_ros.parameters.table import Parameters, group, parameter


@dataclass(frozen=True)
class ProposedParameters(Nt3fsMpcParameters):
    """Parameters of the controller, and options of the comparison."""

    estimate_dead_time: bool = parameter(
        True, 'whether the dead time of a velocity drive is estimated, and the estimate used'
    )
    inertia_error: float = parameter(
        1.0,
        'inertia by which accelerations become the torques of a torque drive, over the true one',
        bounds=(0.1, 10.0),
    )
    inertia: InertiaTermParameters = group(InertiaTermParameters)
    nominal_loads: bool = parameter(
        False,
        'whether what friction and turning do to the nominal robot is cancelled, so that NT3FS '
        'learns the rest',
    )
    random_predictor: bool = parameter(
        False,
        'replace the trained output weights of the predictor by random ones, without learning: '
        'to show what the training is worth',
    )


@lru_cache(maxsize=8)
def _template(parameters: ProposedParameters, nominal_model: NominalModel) -> SwitchingTracker:
    """Return a controller to be copied: teaching its predictor takes a tenth of a second."""
    return SwitchingTracker(parameters, nominal_model.drive, nominal_model.motor_limit)


class ProposedController(BaselineController):
    """The law of :mod:`t3mpc_ros.control`, with its plan across switches."""

    parameters_type = ProposedParameters

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        table: ProposedParameters = self.parameters
        self.preview: bool = table.jump_transition.preview  # type: ignore[misc]
        self._period = nominal_model.period
        self._period_ns = round(nominal_model.period * NANOSECONDS)
        self._tracker = deepcopy(_template(table, nominal_model))
        self._randomize_predictor()
        self.estimate_dead_time = table.estimate_dead_time
        self.inertia_error = table.inertia_error
        self._loads = WheelLoads(nominal_model) if table.nominal_loads else None
        self.known = (FRICTION,) if table.nominal_loads else ()
        self._begun = False
        self._steps = 0
        """Control periods since the first observation."""
        self._announced = 0
        """Instant up to which the jumps of the known future are announced, in periods."""
        self._expected: Array = np.zeros(2)
        self.terms = self._tracker.law.terms
        """The law's terms of the last step, rows as in ``TERM_NAMES``, rad/s², shape (5, 2)."""

    def get_weights(self) -> dict[str, Array]:
        """Return fuzzy coefficients and predictor weights, as a model file keeps them."""
        return self._tracker.law.get_weights()

    def set_weights(self, weights: Mapping[str, Array]) -> None:
        """Begin with another run's; random output weights stay random."""
        self._tracker.law.set_weights(weights)
        self._randomize_predictor()

    def step(self, observation: Observation) -> Array:
        """Return u (rad/s²) of (66)-(67) on the reference with its switches crossed."""
        if self._begun:
            self._steps += observation.elapsed
        effect = self._steps + observation.late
        now_ns, future = effect * self._period_ns, observation.future
        if not self._begun:
            self._begun, self._announced = True, effect
            self._tracker.begin(now_ns, observation.speeds, observation.reference)
        elif future is None:
            # A jump is known when it has happened.
            jump = observation.reference - self._expected
            if np.max(np.abs(jump)) > JUMP:
                slope = (observation.next_reference - observation.reference) / self._period
                self._tracker.transition.announce(now_ns, jump, slope)
        if future is not None:
            self._announced = announce_jumps(
                self._tracker.transition, future, effect, self._announced, self._period
            )
        self._expected = observation.next_reference.copy()
        u = self._tracker.step(
            now_ns,
            observation.speeds,
            observation.reference,
            observation.next_reference,
            self._period,
        )
        if self._loads is None:
            return u
        # Half-way between the measured speeds, which are noisy, and the followed ones.
        error = self._tracker.law.predictive.signals.errors
        return np.asarray(u - self._loads(observation.speeds - 0.5 * error))

    def applied(self, acceleration: Array, *, limited: bool) -> None:
        """Take note of the u that the drive's limits let through."""
        self._tracker.law.set_applied(acceleration, saturated=limited)

    def _randomize_predictor(self) -> None:
        """If so specified, set random output weights with the magnitude of the pretrained ones."""
        predictive, table = self._tracker.law.predictive, self.parameters
        if table.random_predictor:
            drawn = random_output_weights(predictive.get_weights(), table.predictive.seed)
            predictive.set_weights(drawn)


def random_output_weights(weights: Mapping[str, Array], seed: int) -> dict[str, Array]:
    """Return weights with a random output layer of the same size as the fitted one."""
    generator = np.random.default_rng((seed, 7))
    drawn = dict(weights)
    for name in ('output_weights', 'anchor'):
        size = rms(weights[name])
        drawn[name] = generator.normal(scale=size, size=weights[name].shape)
    return drawn
