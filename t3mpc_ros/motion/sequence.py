# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Many stamped motions as arrays: an object is made of one only when it is asked for."""

from collections.abc import Iterator
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.motion.words import BodyTwist, Motion, Pose

Array = NDArray[np.float64]


class Motions:
    """A sequence of :class:`Motion`.

    Parameters
    ----------
    stamps_ns
        Shape (n,).
    poses
        x, y (m) and heading (rad), shape (n, 3).
    twists
        Forward (m/s) and turning speed (rad/s), shape (n, 2).

    Raises
    ------
    ValueError
        The shapes do not fit together.
    """

    def __init__(self, stamps_ns: NDArray[np.int64], poses: Array, twists: Array) -> None:
        count = len(stamps_ns)
        if np.shape(poses) != (count, 3) or np.shape(twists) != (count, 2):
            raise ValueError(
                f'poses must be ({count}, 3) and twists ({count}, 2): got {np.shape(poses)} and '
                f'{np.shape(twists)}'
            )
        self.stamps_ns = np.ascontiguousarray(stamps_ns, dtype=np.int64)
        self.poses: Array = np.ascontiguousarray(poses, dtype=np.float64)
        self.twists: Array = np.ascontiguousarray(twists, dtype=np.float64)
        numbers = np.concatenate([self.poses, self.twists], axis=1)
        self.finite: NDArray[np.bool_] = np.all(np.isfinite(numbers), axis=1)
        """Whether every number of each is finite, as ``Motion.is_finite`` says, shape (n,)."""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, k: int) -> Motion:
        return Motion(
            int(self.stamps_ns[k]),
            Pose(*self.poses[k].tolist()),
            BodyTwist(*self.twists[k].tolist()),
        )

    def __iter__(self) -> Iterator[Motion]:
        # As the named tuples make themselves, without a call of Python for each.
        make = tuple.__new__
        poses = map(make, repeat(Pose), self.poses.tolist())
        twists = map(make, repeat(BodyTwist), self.twists.tolist())
        table = zip(self.stamps_ns.tolist(), poses, twists, strict=True)
        return map(make, repeat(Motion), table)
