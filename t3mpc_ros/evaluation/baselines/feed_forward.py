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
r"""Pure feed-forward: the sampled reference, as far ahead as the drive is late.

No measurement enters the command. A drive with dead time d and lag tau whose command is held for
a period T is late by d + tau + T/2 on average, so the command is r(t + d + tau + T/2), with the
jumps of r crossed half-way by the ramp of :mod:`t3mpc_ros.control.jump_transition`. With a torque
drive the command is the acceleration u = r' of the same reachable reference; its speed then is
not controlled, and drifts with every disturbance.

What feedback and learning are worth is the difference to this method. With the frequencies of a
:mod:`t3mpc_ros.control.input_shaper` the command does not excite the rotors, and with
``estimate_dead_time`` it is ahead by the estimated dead time: what the controller of the node does
on a robot whose body is as assumed. :class:`LmsBodyCorrection` adds the simplest correction of a
body that is not: two gains by least mean squares.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from t3mpc_ros.control.input_shaper import InputShaper, InputShaperParameters
from t3mpc_ros.control.jump_transition import JumpTransitionParameters
from t3mpc_ros.evaluation.baselines.baseline_controller import (
    BaselineController,
    NominalModel,
    Observation,
    PlannedReference,
)
from t3mpc_ros.geometry.types import NANOSECONDS, Array
from t3mpc_ros.parameters.table import Parameters, group, parameter


@dataclass(frozen=True)
class FeedForwardParameters(Parameters):
    """Parameters of feed-forward."""

    advance: float = parameter(
        0.0,
        'time beyond the dead time by which the command is ahead of the reference; 0: lag of the '
        'drive and half a period',
        's',
        (0.0, 0.2),
    )
    estimate_dead_time: bool = parameter(
        False, 'whether the dead time of a velocity drive is estimated, and the estimate used'
    )
    jump_transition: JumpTransitionParameters = group(JumpTransitionParameters)
    command_shaper: InputShaperParameters = group(
        InputShaperParameters, straight_frequency=0.0, turning_frequency=0.0
    )


class FeedForward(BaselineController):
    """The reachable reference as command, without feedback."""

    parameters_type = FeedForwardParameters
    preview = True
    measured = ''

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        table: FeedForwardParameters = self.parameters
        self.estimate_dead_time = table.estimate_dead_time
        self._torque = nominal_model.drive == 'torque'
        self._period = nominal_model.period
        advance = table.advance or nominal_model.lag + 0.5 * self._period
        whole, self._part = divmod(0.0 if self._torque else advance / self._period, 1.0)
        shaper = InputShaper(table.command_shaper, self._period)
        self._shaper = shaper if shaper.lead_ns else None
        self.known = ('frequencies of the rotors',) if self._shaper else ()
        ahead = int(whole) + round(shaper.lead_ns / NANOSECONDS / self._period)
        # Without a lag: the advance already contains that of the drive.
        self._plan = PlannedReference(table.jump_transition, nominal_model, 0.0, ahead)
        self._started = False

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        plan = self._plan
        plan.step(observation)
        if self._torque:
            return plan.rate.copy()
        planned, rate = plan.reachable, plan.rate
        if self._shaper is not None:
            if not self._started:
                self._shaper.reset(planned)
            self._shaper.step(planned, observation.elapsed * self._period)
            planned, rate = self._shaper.reference, self._shaper.rate
        self._started = True
        goal = self._corrected(planned + self._part * self._period * rate, observation)
        return self._nominal_model.acceleration_for(goal, observation.speeds)

    def _corrected(self, goal: Array, observation: Observation) -> Array:
        """Return the wheel speeds to command, rad/s, shape (2,)."""
        return goal


@dataclass(frozen=True)
class LmsBodyCorrectionParameters(FeedForwardParameters):
    """Parameters of feed-forward with a correction of the body."""

    learning_rate: float = parameter(
        0.02, 'mu: step of the gains per squared wheel speed', 's/rad²', (0.0, 10.0)
    )


class LmsBodyCorrection(FeedForward):
    r"""Feed-forward with two gains by least mean squares on the yaw rate of the odometry.

    With w = b omega/R, half the difference of the wheel speeds that the yaw rate is worth, and the
    mean m_c and half the difference w_c of the wheel speeds commanded one dead time before,

    .. math:: e = w - w_c - k_m m_c - k_w w_c, \qquad
              k \leftarrow k + \mu T e\,(m_c, w_c),

    and k_m m + k_w w of the plan is taken from the turn of the command (Widrow and Hoff 1960). It
    has no bound, no certainty and no model of the gyro.
    """

    parameters_type = LmsBodyCorrectionParameters
    measured = 'yaw rate of the gyro'

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        geometry = nominal_model.robot.geometry
        self._wheels_per_turn = geometry.half_separation / geometry.wheel_radius
        self._delay = nominal_model.lag / self._period
        self._commands: deque[Array] = deque(maxlen=64)
        """Mean and half the difference of the commands, newest first."""
        self.gains: Array = np.zeros(2)
        """k_m and k_w."""

    def _corrected(self, goal: Array, observation: Observation) -> Array:
        self._learn(observation)
        wanted = 0.5 * np.array([goal[0] + goal[1], goal[0] - goal[1]])
        correction = float(self.gains @ wanted)
        return np.asarray(goal - np.array([correction, -correction]))

    def _learn(self, observation: Observation) -> None:
        """Update the gains by the turn since the last observation."""
        right, left = observation.command.tolist()
        for _ in range(min(observation.elapsed, 64)):
            self._commands.appendleft(0.5 * np.array([right + left, right - left]))
        # The middle of the last period, one delay earlier; row 0 was sent one period ago.
        row, part = divmod(observation.late + self._delay, 1.0)
        turn = self._wheels_per_turn * observation.yaw_rate
        if observation.elapsed != 1 or row + 2 > len(self._commands) or not np.isfinite(turn):
            return
        sent = (1.0 - part) * self._commands[int(row)] + part * self._commands[int(row) + 1]
        error = turn - sent[1] - self.gains @ sent
        self.gains = self.gains + self.parameters.learning_rate * self._period * error * sent
