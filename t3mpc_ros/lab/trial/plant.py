# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The simulated robot without all that a closed loop does not need: one kernel call a period."""

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.robot.drive import Plant
from t3mpc_ros.robot.loads import Disturbance, SpeedNoise, generators
from t3mpc_ros.robot.simulated import SimulatedRobotSettings
from t3mpc_ros.settings import SettingError

Array = NDArray[np.float64]

DRAWN = ('noise.variance', 'disturbance.walk_rate')
"""Live settings of the robot that are fixed here, because they shape numbers drawn beforehand."""


class FastPlant:
    """The physics of :class:`~t3mpc_ros.robot.simulated.SimulatedRobot`, bit for bit.

    It has the same plant, the same random numbers and the same time grid from 0 s on. What is
    left out: the guard, so commands must be within what the guard would pass; odometry; reports.

    Parameters
    ----------
    settings
        The robot, its drive of either kind.
    steps
        How many control periods it will run at most: the random numbers of all are drawn now.

    Raises
    ------
    ValueError
        Fewer than one step.
    """

    def __init__(self, settings: SimulatedRobotSettings, steps: int) -> None:
        if steps < 1:
            raise ValueError(f'steps must be at least 1: got {steps}')
        for_disturbance, for_noise = generators(settings.seed)
        self._settings = settings
        self._substeps = settings.substeps
        self._plant = Plant(settings.drive, settings.step)
        self._disturbance = Disturbance(settings.disturbance, for_disturbance)
        self._disturbance.draw(0.0)  # as the robot does when its grid starts
        first = self._disturbance.walk.copy()
        later = self._disturbance.draw_ahead(self._substeps * self._plant.step, steps - 1)
        self._walks: Array = np.vstack([first, later])
        self._noise = SpeedNoise(settings.noise, for_noise).draw_ahead(steps + 1)
        self._steps = steps
        self.steps_done = 0
        """Control periods run so far."""
        self.speeds: Array = np.zeros(2)
        """True chi, rad/s, right wheel first, shape (2,); overwritten by each step."""
        self.measured: Array = self._noise[0].copy()
        """chi with its noise, rad/s, shape (2,); overwritten by each step."""
        self._load()

    @property
    def plant(self) -> Plant:
        """Pose, wheel angles and wheel speeds, for who needs more than :attr:`speeds`."""
        return self._plant

    def configure(self, settings: SimulatedRobotSettings) -> None:
        """Go on with other settings from the next period on, a heavier load say.

        Raises
        ------
        SettingError
            A setting differs that is fixed: those of the robot, and :data:`DRAWN`.
        """
        before, after = self._settings.flat(), settings.flat()
        for row in SimulatedRobotSettings.rows():
            fixed = not row.live or row.name in DRAWN
            if fixed and before[row.name] != after[row.name]:
                raise SettingError(
                    f'{row.name} is fixed while the plant runs '
                    f'(it is {before[row.name]}): got {after[row.name]}'
                )
        self._settings = settings
        self._load()

    def step(self, right: float, left: float) -> None:
        """Run one control period under one command, and measure at its end.

        Parameters
        ----------
        right, left
            Torques (N m) with a torque drive, wheel speeds (rad/s) with a velocity drive.

        Raises
        ------
        ValueError
            There are no random numbers left.
        """
        done = self.steps_done
        if done == self._steps:
            raise ValueError(f'steps must be at least {done + 1} to go on: got {self._steps}')
        self._disturbance.walk[:] = self._walks[done]
        self._plant.run((right, left), False, self._disturbance, self._substeps)
        self.speeds[0], self.speeds[1] = self._plant.wheels
        self.steps_done = done + 1
        np.add(self.speeds, self._noise[done + 1], out=self.measured)

    def _load(self) -> None:
        settings = self._settings
        self._disturbance.settings = settings.disturbance
        self._plant.load(
            settings.drive,
            (settings.body, settings.true_body),
            settings.geometry,
            settings.friction,
            settings.friction_factor,
        )
