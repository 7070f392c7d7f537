# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a controller answers: to one message, and to many as rows of numbers."""

import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.freshness import Reason
from t3mpc_ros.control.law import BOUND, RATE, VALUE, CertificateReading
from t3mpc_ros.control.law import TERMS as NAMES
from t3mpc_ros.control.march.stretch import (
    APPLIED,
    ERROR,
    LIMITED,
    SKILL,
    TERMS,
    TWIST,
    WATCHED,
    WIDTH,
)
from t3mpc_ros.motion import BodyTwist

Array = NDArray[np.float64]


class Status(NamedTuple):
    """What the controller decided at one step, and why; arrays are right wheel first."""

    stamp_ns: int
    reason: Reason
    error: Array
    """delta = chi - r, rad/s; NaN while no reference is known."""
    terms: Array
    """Shape (5, 2), rows as in ``law.TERMS``, rad/s²."""
    applied: Array
    """Wheel accelerations after the limits, rad/s²."""
    watched: Array
    """What the certificate remembers, see :func:`t3mpc_ros.control.law.update_certificate`."""
    skill: Array
    limited: bool

    @property
    def estimate(self) -> Array:
        """G of the fuzzy systems, rad/s², shape (2,)."""
        estimate: Array = 0.0 - self.terms[0]
        return estimate

    @property
    def certificate(self) -> CertificateReading:
        """What the run-time certificate says."""
        return CertificateReading.of(self.watched)


class Answers(NamedTuple):
    """Twist and status of each step, NaN where there is none."""

    numbers: Array
    """Shape (n, WIDTH), columns as in :mod:`t3mpc_ros.control.march.stretch`."""
    reasons: NDArray[np.object_]
    """:class:`Reason` of each, None where there is none, shape (n,)."""

    @classmethod
    def empty(cls, count: int) -> Self:
        """Return rows for so many steps."""
        return cls(np.full((count, WIDTH), math.nan), np.full(count, None, dtype=np.object_))

    def part(self, begin: int, end: int) -> 'Answers':
        """Return some of the rows: what is written to them is written here."""
        return Answers(self.numbers[begin:end], self.reasons[begin:end])

    def note(self, row: int, twist: BodyTwist, status: Status) -> None:
        """Write the answer of :meth:`Controller.step` into a row."""
        self.numbers[row] = (
            *twist,
            *status.error.tolist(),
            *status.skill.tolist(),
            *status.applied.tolist(),
            *status.terms.ravel().tolist(),
            *status.watched.tolist(),
            math.nan,
            math.nan,
            float(status.limited),
        )
        self.reasons[row] = status.reason

    def follows(self, begin: int, end: int) -> None:
        """Write that the robot was let move in some rows."""
        self.reasons[begin:end] = Reason.TRACKING

    @property
    def twists(self) -> Array:
        """The commands, m/s and rad/s, shape (n, 2)."""
        return self.numbers[:, TWIST : TWIST + 2]

    @property
    def pairs(self) -> dict[str, Array]:
        """What is said of both wheels by name, shape (n, 2): as in :class:`Status`."""
        numbers = self.numbers
        found = {
            'error': numbers[:, ERROR : ERROR + 2],
            'skill': numbers[:, SKILL : SKILL + 2],
            'applied': numbers[:, APPLIED : APPLIED + 2],
            'estimate': 0.0 - numbers[:, TERMS : TERMS + 2],
        }
        for k, name in enumerate(NAMES):
            found[name] = numbers[:, TERMS + 2 * k : TERMS + 2 * k + 2]
        return found

    @property
    def certificate(self) -> Array:
        """Value and margin of the certificate, see :class:`CertificateReading`, shape (n, 2)."""
        watched = self.numbers[:, WATCHED:]
        return np.stack([watched[:, VALUE], watched[:, BOUND] - watched[:, RATE]], axis=1)

    @property
    def limited(self) -> NDArray[np.bool_]:
        """Whether a limit cut the command, shape (n,)."""
        return np.equal(self.numbers[:, LIMITED], 1.0)
