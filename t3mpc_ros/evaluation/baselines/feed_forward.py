# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
r"""Pure feed-forward: the sampled reference, as far ahead as the drive is late.

No measurement enters the command. A drive with dead time d and lag tau whose command is held for
a period T is late by d + tau + T/2 on average, so the command is r(t + d + tau + T/2), with the
jumps of r crossed half-way by the ramp of :mod:`t3mpc_ros.control.jump_transition`. With a torque
drive the command is the acceleration u = r' of the same reachable reference; its speed then is
not controlled, and drifts with every disturbance.

What feedback and learning are worth is the difference to this method.
"""

from dataclasses import dataclass

import numpy as np

from t3mpc_ros.control.jump_transition import JumpTransition, JumpTransitionParameters
from t3mpc_ros.evaluation.baselines.baseline_controller import (
    BaselineController,
    NominalModel,
    Observation,
    future_jump,
)
from t3mpc_ros.geometry.types import NANOSECONDS, Array
from t3mpc_ros.parameters.table import Parameters, group, parameter


@dataclass(frozen=True)
class FeedForwardParameters(Parameters):
    """Parameters of pure feed-forward."""

    advance: float = parameter(
        0.0,
        'time beyond the dead time by which the command is ahead of the reference; 0: lag of the '
        'drive and half a period',
        's',
        (0.0, 0.2),
    )
    jump_transition: JumpTransitionParameters = group(JumpTransitionParameters)


class FeedForward(BaselineController):
    """The reachable reference as command, without feedback."""

    parameters_type = FeedForwardParameters
    preview = True

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        super().__init__(parameters, nominal_model)
        table: FeedForwardParameters = self.parameters
        self._torque = nominal_model.drive == 'torque'
        period = nominal_model.period
        self._period_ns = round(period * NANOSECONDS)
        advance = table.advance or nominal_model.lag + 0.5 * period
        self._whole, self._part = divmod(0.0 if self._torque else advance / period, 1.0)
        # Without a lag: the advance already contains that of the drive.
        self._transition = JumpTransition(
            table.jump_transition, 0.0, period, nominal_model.motor_limit
        )
        self._index = 0
        """Period of the last observation, counted from the first one."""
        self._future: Array = np.zeros((0, 2))

    def step(self, observation: Observation) -> Array:
        """Return u, rad/s², shape (2,)."""
        future, ahead = observation.future, int(self._whole)
        if future is None or len(future) < ahead + 3:
            rows = 0 if future is None else len(future)
            raise ValueError(f'future must have at least {ahead + 3} rows: got {rows}')
        started = self._future.size > 0
        elapsed = observation.elapsed if started else 0
        # Periods without an observation: the ramps go on, along the future known before them.
        for missed in range(1, min(elapsed, len(self._future) - ahead - 1)):
            self._cross(self._index + missed, self._future[ahead + missed :])
        self._index += elapsed
        self._future = future.copy()
        for j in range(max(2, len(future) - 1 - elapsed) if started else 2, len(future) - 1):
            self._announce(j)
        self._cross(self._index, self._future[ahead:])
        transition = self._transition
        if self._torque:
            return transition.rate.copy()
        goal = transition.reachable + self._part * self._nominal_model.period * transition.rate
        return self._nominal_model.acceleration_for(goal, observation.speeds)

    def _cross(self, index: int, future: Array) -> None:
        """Update the reachable reference for the rows from ``future[0]`` to ``future[1]``."""
        now_ns = (index + int(self._whole)) * self._period_ns
        self._transition.step(now_ns, future[0], future[1])

    def _announce(self, j: int) -> None:
        """Announce a jump between rows ``j`` - 1 and ``j`` of the future, if there is one."""
        if found := future_jump(self._future, j, self._nominal_model.period):
            self._transition.announce((self._index + j) * self._period_ns, *found)
