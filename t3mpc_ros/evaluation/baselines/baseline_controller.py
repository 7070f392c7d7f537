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
"""Interface of the compared controllers: nominal model, observation, step.

All methods share the state estimate, the actuation and its limits
(:mod:`t3mpc_ros.control.velocity_actuation`); they differ in how they choose an acceleration. The
plant that a method controls is one equation for either drive, exact at the control periods T,

    chi_(k+1) = chi_k + T (u_k + d_k).

It contains no dead time: ``Observation.speeds`` is the estimate for the instant at which u_k
takes effect, and the actuation converts u_k into the wheel speed command of the lagging servo.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from typing import Any, ClassVar

import numpy as np

from t3mpc_ros.control.jump_transition import JumpTransition, JumpTransitionParameters, MotorLimit
from t3mpc_ros.geometry.types import NANOSECONDS, Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import Parameters
from t3mpc_ros.simulation.plant.disturbances import friction_torque
from t3mpc_ros.simulation.plant.dynamics import (
    BodyParameters,
    dynamics_vector,
    wheel_acceleration,
    wheel_inertia,
)
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters


@dataclass(frozen=True, slots=True)
class NominalModel:
    """Nominal model of the robot that every method gets; it contains no true value of a case."""

    drive: str
    """``'torque'`` or ``'velocity'``."""
    period: float
    """Control period T, s."""
    lag: float
    """First-order lag of the velocity drive, s."""
    acceleration: float
    """Largest rate of change of a wheel speed command, rad/s²; infinite for the torque drive."""
    robot: PaperRobotParameters
    """The nominal robot: geometry, body, friction. It lacks factors, disturbance and noise."""

    @property
    def share(self) -> float:
        """1 - exp(-T/lag): step response of the servo after one period T."""
        return 1.0 - math.exp(-self.period / self.lag)

    @property
    def motor_limit(self) -> MotorLimit | None:
        """What the motors of a torque drive have for a jump; None with a velocity drive."""
        if self.drive != 'torque':
            return None
        inertia = wheel_inertia(self.robot.body, self.robot.geometry)
        return MotorLimit(inertia, self.robot.drive.torque_limit)

    def acceleration_for(self, command: Array, speeds: Array) -> Array:
        """Return the u (rad/s²) that a wheel speed command (rad/s) means at these speeds.

        Only for the velocity drive: command = speeds + T u / (1 - exp(-T/lag)).
        """
        return (command - speeds) * (self.share / self.period)


EXACT_INERTIA, FRICTION = 'exact inertia', 'nominal friction'
"""What a method knows of the model, as text."""
JUMP = 0.3
"""A change of r in one period (rad/s), beyond the change before it, that is a jump."""


def announce_jumps(
    transition: JumpTransition, future: Array, effect: int, announced: int, period: float
) -> int:
    """Announce the jumps of a known future that begins in period ``effect``; return up to where.

    Those up to period ``announced`` are announced already. Lost measurements or a longer dead time
    reveal several periods at once. A jump is what exceeds the change before it; after a change
    that exceeds :data:`JUMP` itself nothing is one.
    """
    period_ns, last = round(period * NANOSECONDS), effect + len(future) - 2
    for instant in range(max(announced, effect) + 1, last + 1):
        j = instant - effect
        before = future[j - 1] - future[j - 2] if j > 1 else np.zeros(2)
        jump = future[j] - future[j - 1] - before
        if np.max(np.abs(jump)) > JUMP and np.max(np.abs(before)) <= JUMP:
            slope = (future[j + 1] - future[j]) / period
            transition.announce(instant * period_ns, jump, slope)
    return max(announced, last)


class WheelLoads:
    """What friction and turning do to the nominal wheels, rad/s², with no drive.

    Of another ``body`` if one is given; ``inertia_factor`` is the inertia of the wheels over that
    of the body: a heavier body is moved less by the same friction.
    """

    def __init__(
        self,
        nominal_model: NominalModel,
        body: BodyParameters | None = None,
        inertia_factor: float = 1.0,
    ) -> None:
        robot = nominal_model.robot
        friction = robot.friction
        self._friction: Array = np.array(
            [friction.viscous, friction.coulomb, friction.coulomb_width]
        )
        self._dynamics = dynamics_vector(body or robot.body, robot.geometry)
        self._dynamics[2:4] *= inertia_factor

    def __call__(self, speeds: Array) -> Array:
        """Return the accelerations at wheel speeds (rad/s), shape (2,) or (n, 2) each."""
        found = np.empty((speeds.size // 2, 2))
        _load_accelerations(speeds.reshape(-1, 2), self._friction, self._dynamics, found)
        return found.reshape(speeds.shape)


@kernel
def _load_accelerations(speeds: Array, friction: Array, dynamics: Array, out: Array) -> None:
    """Write (10) without drive into ``out``, shape (n, 2) as ``speeds``.

    friction : shape (3,), viscous (N m s/rad), Coulomb (N m), width (rad/s)
    dynamics : shape (5,), see :func:`t3mpc_ros.simulation.plant.dynamics.dynamics_vector`
    """
    for k in range(out.shape[0]):
        right, left = speeds[k, 0], speeds[k, 1]
        out[k, 0], out[k, 1] = wheel_acceleration(
            right,
            left,
            -friction_torque(right, friction[0], friction[1], friction[2]),
            -friction_torque(left, friction[0], friction[1], friction[2]),
            dynamics,
        )


@dataclass(slots=True)
class Observation:
    """Input of a method at one step; right wheel first, valid until the next step.

    Times count from the instant at which the returned acceleration takes effect.

    Attributes
    ----------
    speeds
        Estimated chi at that instant, rad/s, shape (2,).
    unexplained
        Estimated disturbance acceleration d = chi' - u, rad/s², shape (2,).
    reference
        r at that instant, rad/s, shape (2,); extrapolated by its slope without preview.
    next_reference
        r one period later, shape (2,); ``(next_reference - reference) / T`` feeds forward.
    command
        Last commanded wheel speeds, rad/s, shape (2,); unused with the torque drive.
    future
        Preview: r at that instant and each period after it, shape (n, 2), n >= 2. None for a
        method without preview.
    elapsed
        Control periods since the observation before; more than 1 after lost measurements.
    late
        Control periods until that instant: the dead time in use.
    yaw_rate
        Mean yaw rate of the odometry since the observation before, rad/s; NaN at the first one,
        and for a robot without a pose. On the twin it contains the gyro.
    """

    speeds: Array
    unexplained: Array
    reference: Array
    next_reference: Array
    command: Array
    future: Array | None
    elapsed: int = 1
    late: int = 0
    yaw_rate: float = math.nan


class BaselineController(ABC):
    """Interface of a compared controller; each run creates a new one."""

    parameters_type: ClassVar[type[Parameters]]
    preview: ClassVar[bool] = False
    """Whether it uses :attr:`Observation.future`."""
    measured: ClassVar[str] = 'wheel speeds'
    """What it measures, as text; empty for nothing."""
    known: Sequence[str] = ()
    """What else it knows, each in a few words."""
    estimate_dead_time: bool = False
    """Whether it estimates the dead time of a velocity drive; the configured one otherwise."""
    inertia_error: float = 1.0
    """Inertia by which its accelerations become the torques of a torque drive, over the true
    one."""

    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None:
        if type(parameters) is not self.parameters_type:
            raise ValueError(
                f'parameters must be {self.parameters_type.__name__}: '
                f'got {type(parameters).__name__}'
            )
        self.parameters: Any = parameters
        self._nominal_model = nominal_model

    @property
    def knowledge(self) -> list[str]:
        """What it knows beside noise and limits, which are known to all, each in a few words."""
        found = ['reference ahead' if self.preview else 'reference now']
        if self.measured:
            found.append(self.measured)
        if self.estimate_dead_time:
            found.append('estimate of the dead time')
        if self.inertia_error != 1.0:
            found.append(f'inertia × {self.inertia_error:g}')
        return [*found, *self.known]

    @abstractmethod
    def step(self, observation: Observation) -> Array:
        """Return u, the requested wheel accelerations, rad/s², shape (2,)."""

    def applied(self, acceleration: Array, *, limited: bool) -> None:  # noqa: B027
        """Store the u after the drive's limits (anti-windup)."""

    def get_weights(self) -> dict[str, Array]:
        """Return the adapted weights by name; empty for a method without adaptation."""
        return {}

    def set_weights(self, weights: Mapping[str, Array]) -> None:  # noqa: B027
        """Start from weights that :meth:`get_weights` returned after another run."""


class PlannedReference:
    """Reachable reference ``ahead`` periods after the answer begins to act.

    It announces the jumps of the known future to a :class:`JumpTransition`, and goes on along it
    through periods without an observation. ``lag`` (s) is that of the servo by which the ramps
    are early; 0 where the reference is ahead of it already.
    """

    def __init__(
        self,
        parameters: JumpTransitionParameters,
        nominal_model: NominalModel,
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

    def step(self, observation: Observation) -> None:
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
        self._announced = announce_jumps(
            self._transition, future, effect, self._announced, self._period
        )
        self._effect, self._future = effect, future.copy()
        self._cross(effect, future[ahead:])

    def _cross(self, effect: int, future: Array) -> None:
        """Update the reachable reference for the rows from ``future[0]`` to ``future[1]``."""
        self._transition.step((effect + self._ahead) * self._period_ns, future[0], future[1])
