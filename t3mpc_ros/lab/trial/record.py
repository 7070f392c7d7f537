# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a run of the closed loop leaves behind, and the numbers it is judged by."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.law import TERMS

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LoopRecord:
    """What happened in one run, one row a control period, right wheel first.

    Row k holds what was known and decided at ``time[k]``, and the state of the robot then. From
    a row on at which the method answered with a number that is not finite, all is NaN but time,
    reference and mode: the run ended there.
    """

    time: Array
    """s, shape (n,)"""
    wanted: Array
    """r, rad/s, shape (n, 2)"""
    measured: Array
    """chi with its noise, rad/s, shape (n, 2)"""
    speeds: Array
    """True chi, rad/s, shape (n, 2)"""
    estimated: Array
    """Estimated chi, rad/s, shape (n, 2)"""
    unexplained: Array
    """Estimated acceleration that chi' = u does not explain, rad/s², shape (n, 2)"""
    command: Array
    """u as the drive's limits let it through, rad/s², shape (n, 2)"""
    sent: Array
    """What the robot was told, shape (n, 2): torques (N m) or wheel speeds (rad/s)"""
    effort: Array
    """Acceleration asked of the robot, rad/s², shape (n, 2): u with the torque drive, the rate of
    change of the commanded wheel speeds with the velocity drive"""
    limited: NDArray[np.bool_]
    """Whether a limit changed u, shape (n,)"""
    terms: Array
    """Terms of u, rows as in ``law.TERMS``, rad/s², shape (n, 5, 2); zeros for a method that
    has none. The fuzzy estimate is the first one negated."""
    modes: NDArray[np.int64]
    """Active switching mode, shape (n,)"""

    @classmethod
    def empty(cls, steps: int) -> Self:
        """Return a record of ``steps`` rows of zeros, to be filled."""
        return cls(
            time=np.zeros(steps),
            wanted=np.zeros((steps, 2)),
            measured=np.zeros((steps, 2)),
            speeds=np.zeros((steps, 2)),
            estimated=np.zeros((steps, 2)),
            unexplained=np.zeros((steps, 2)),
            command=np.zeros((steps, 2)),
            sent=np.zeros((steps, 2)),
            effort=np.zeros((steps, 2)),
            limited=np.zeros(steps, dtype=np.bool_),
            terms=np.zeros((steps, len(TERMS), 2)),
            modes=np.zeros(steps, dtype=np.int64),
        )

    @property
    def error(self) -> Array:
        """True tracking error chi - r, rad/s, shape (n, 2)."""
        return self.speeds - self.wanted

    @property
    def finite(self) -> bool:
        """Whether the run went to its end: every number is finite."""
        return bool(np.isfinite(self.speeds).all() and np.isfinite(self.command).all())

    def rmse(self, after: float = 3.0, *, cut: float = 0.0) -> float:
        """Return the tracking RMSE over both wheels, rad/s; NaN when the run broke off.

        Parameters
        ----------
        after
            Seconds left out at the start, while the reference grows.
        cut
            Seconds left out at each switch: 40 % of them before it, where methods with preview
            have already left the old reference, the rest after it.

        Raises
        ------
        ValueError
            Nothing is left to be counted.
        """
        return float(np.sqrt(np.mean(self.error[self._counted(after, cut)] ** 2)))

    def largest_error(self, after: float = 3.0, *, cut: float = 0.0) -> float:
        """Return the largest tracking error of a wheel, rad/s; arguments as :meth:`rmse`."""
        return float(np.max(np.abs(self.error[self._counted(after, cut)])))

    def chatter(self) -> float:
        """Return the total variation of the effort per second and wheel, rad/s³.

        Raises
        ------
        ValueError
            The record has fewer than two rows.
        """
        if self.time.size < 2:
            raise ValueError(f'a record must have at least 2 rows: got {self.time.size}')
        span = self.time[-1] - self.time[0]
        return float(np.abs(np.diff(self.effort, axis=0)).sum() / (2.0 * span))

    def _counted(self, after: float, cut: float) -> NDArray[np.bool_]:
        counted: NDArray[np.bool_] = self.time >= after
        for switch in self.time[1:][np.diff(self.modes) != 0]:
            counted &= (self.time < switch - 0.4 * cut) | (self.time >= switch + 0.6 * cut)
        if not counted.any():
            end = self.time[-1] if self.time.size else 0.0
            raise ValueError(
                f'after and cut must leave rows of a run that ends at {end:g} s: '
                f'got {after:g} s and {cut:g} s'
            )
        return counted
