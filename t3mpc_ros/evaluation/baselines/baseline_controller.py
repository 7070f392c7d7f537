# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Interface of the compared controllers: nominal model, observation, step.

All methods share the state estimate, the actuation and its limits
(:mod:`t3mpc_ros.control.actuation`); they differ in how they choose an acceleration. The plant
that a method controls is one equation for either drive, exact at the control periods T,

    chi_(k+1) = chi_k + T (u_k + d_k).

It contains no dead time: ``Observation.speeds`` is the estimate for the instant at which u_k
takes effect, and the actuation converts u_k into the wheel speed command of the lagging servo.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.parameters.table import Parameters
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class NominalModel:
    """What a method is told about the robot beforehand; nothing of it is the truth of a case."""

    drive: str
    """``'torque'`` or ``'velocity'``."""
    period: float
    """Control period T, s."""
    lag: float
    """First-order lag of the velocity drive, s."""
    acceleration: float
    """Largest rate of change of a wheel speed command, rad/s²; infinite for the torque drive."""
    robot: PaperRobotParameters
    """The nominal robot: geometry, body, friction. Factors, disturbance and noise are not told."""

    @property
    def share(self) -> float:
        """1 - exp(-T/lag): how much of a step of the command the servo has followed after T."""
        return 1.0 - math.exp(-self.period / self.lag)

    def acceleration_for(self, command: Array, speeds: Array) -> Array:
        """Return the u (rad/s²) that a wheel speed command (rad/s) means at these speeds.

        Only for the velocity drive: command = speeds + T u / (1 - exp(-T/lag)).
        """
        u: Array = (command - speeds) * (self.share / self.period)
        return u


@dataclass(slots=True)
class Observation:
    """What a method sees at a step; right wheel first, arrays are only lent.

    Every time is counted from the instant at which the answer begins to act.
    """

    speeds: Array
    """Estimated chi at that instant, rad/s, shape (2,)."""
    unexplained: Array
    """Estimated acceleration d that chi' = u does not explain, rad/s², shape (2,)."""
    reference: Array
    """r at that instant, rad/s, shape (2,); extrapolated by its slope without preview."""
    next_reference: Array
    """r one period later, shape (2,), alike; ``(wanted_next - wanted) / T`` feeds forward."""
    command: Array
    """The wheel speeds last commanded, rad/s, shape (2,); unused with the torque drive."""
    future: Array | None
    """r at that instant and each period after it, shape (n, 2), n >= 2: what preview gives.
    None for a method without preview."""


class BaselineController(ABC):
    """A controller in a comparison; a new one is made for each run.

    Parameters
    ----------
    settings
        What can be tuned, an instance of :attr:`settings_type`.
    knowledge
        What is known of the robot.
    """

    parameters_type: ClassVar[type[Parameters]]
    preview: ClassVar[bool] = False
    """Whether it reads :attr:`View.future`."""

    @abstractmethod
    def __init__(self, parameters: Parameters, nominal_model: NominalModel) -> None: ...

    @abstractmethod
    def step(self, observation: Observation) -> Array:
        """Return u, the wanted wheel accelerations, rad/s², shape (2,)."""

    def applied(self, acceleration: Array, *, limited: bool) -> None:  # noqa: B027
        """Take note of the u that the drive's limits let through (anti-windup)."""

    def get_weights(self) -> dict[str, Array]:
        """Return what was learnt so far, by name; nothing for a method that does not learn."""
        return {}

    def set_weights(self, weights: Mapping[str, Array]) -> None:  # noqa: B027
        """Begin with what :meth:`get_weights` returned after another run."""
