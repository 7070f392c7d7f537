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
"""Preview of a baseline: the jumps of a known future, crossed by the ramp of the controller."""

import numpy as np

from t3mpc_ros.control.jump_transition import JumpTransition, JumpTransitionParameters
from t3mpc_ros.evaluation.baselines import baseline_controller
from t3mpc_ros.geometry.types import NANOSECONDS, Array


class PlannedReference:
    """Reachable reference ``ahead`` periods after the answer begins to act.

    It announces the jumps of the known future to a :class:`JumpTransition`, and goes on along it
    through periods without an observation. ``lag`` (s) is that of the servo by which the ramps
    are early; 0 where the reference is ahead of it already.
    """

    def __init__(
        self,
        parameters: JumpTransitionParameters,
        nominal_model: baseline_controller.NominalModel,
        lag: float,
        ahead: int = 0,
    ) -> None:
        self._period = nominal_model.period
        self._period_ns = round(self._period * NANOSECONDS)
        self._ahead = ahead
        self._transition = JumpTransition(parameters, lag, self._period, nominal_model.motor_limit)
        self._steps = 0
        """Control periods since the first observation."""
        self._effect = 0
        """Period in which the last answer began to act."""
        self._announced = 0
        """Period up to which jumps are announced."""
        self._future: Array = np.zeros((0, 2))
        self.reachable, self.rate = self._transition.reachable, self._transition.rate
        """rbar (rad/s), and its derivative (rad/s²) until one period later; shape (2,)."""

    def step(self, observation: baseline_controller.Observation) -> None:
        """Update :attr:`reachable` and :attr:`rate`."""
        future, ahead, elapsed = observation.future, self._ahead, observation.elapsed
        if future is None or len(future) < ahead + 3:
            rows = 0 if future is None else len(future)
            raise ValueError(f'future must have at least {ahead + 3} rows: got {rows}')
        if self._future.size > 0:
            # Periods without an observation: the ramps go on, along the future known before them.
            for missed in range(1, min(elapsed, len(self._future) - ahead - 1)):
                self._cross(self._effect + missed, self._future[ahead + missed :])
            self._steps += elapsed
        effect = self._steps + observation.late
        if self._future.size == 0:
            self._announced = effect + 1
        last = effect + len(future) - 2
        for instant in range(max(self._announced, effect) + 1, last + 1):
            if found := baseline_controller.future_jump(future, instant - effect, self._period):
                self._transition.announce(instant * self._period_ns, *found)
        self._announced = max(self._announced, last)
        self._effect, self._future = effect, future.copy()
        self._cross(effect, future[ahead:])

    def _cross(self, effect: int, future: Array) -> None:
        """Update the reachable reference for the rows from ``future[0]`` to ``future[1]``."""
        self._transition.step((effect + self._ahead) * self._period_ns, future[0], future[1])
