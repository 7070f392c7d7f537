# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The parts of a controller, made ready for compiled stretches and told of them afterwards."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.drive import Drive
from t3mpc_ros.control.freshness import Following, Freshness, FreshnessSettings
from t3mpc_ros.control.march.stretch import (
    AGAINST,
    COMMAND,
    CROSSINGS,
    FAILED,
    FROZEN,
    LAST_NS,
    LIMITED,
    NUMBERS,
    PHASE,
    REFERENCES,
    SAMPLES,
    SEEN_NS,
    TOLD,
    TRACK_END,
    TRACK_FIRST,
    WAITING,
    Bounds,
    march,
)
from t3mpc_ros.control.pursuit import Pursuit
from t3mpc_ros.motion.sequence import Motions
from t3mpc_ros.motion.track import Track

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

NEVER = int(np.iinfo(np.int64).max)


class Parts(NamedTuple):
    """Whatever of a controller changes in a plain step, and what it is told."""

    track: Track
    pursuit: Pursuit
    drive: Drive
    freshness: Freshness
    following: Following
    seen: tuple[Array, Array, Array, Array]
    """Speeds, wanted, begin and finish of :func:`t3mpc_ros.control.pursuit.look`."""
    looking: tuple[float, float, bool, float, float]
    """What it is told of the settings."""

    @property
    def are_plain(self) -> bool:
        """Whether a plain step can come next, as far as these parts can say."""
        following, drive = self.following, self.drive
        newest = following.newest
        return (
            self.track.end > self.track.first
            and not self.freshness.held
            and self.freshness.reference_seen[0] is not None
            and following.holds
            and newest is not None
            # A replay may have told of other commands.
            and newest == tuple(drive.command.tolist())
            and not self.pursuit.law.predictive.dithered
        )


class PlainSteps:
    """Goes on from where a controller is, as long as its steps are plain.

    Parameters
    ----------
    parts
        Of the controller; they are behind until :meth:`finish`.
    settings
        How old inputs may be.
    measured, references
        Odometry and wanted motions.
    handed
        How many of the latter were handed over.
    last_ns
        Stamp of the last odometry.
    dead_ns
        From it to the instant at which its command acts.
    due_ns
        When the next jump of the reference, announced already, is due; NEVER without one.
    """

    def __init__(
        self,
        parts: Parts,
        settings: FreshnessSettings,
        measured: Motions,
        references: Motions,
        handed: int,
        last_ns: int,
        dead_ns: int,
        due_ns: int,
    ) -> None:
        self._parts = parts
        track, plan, law = parts.track, parts.pursuit.plan, parts.pursuit.law
        seen_ns, waiting = parts.freshness.reference_seen
        told, against = parts.following.counts
        state: Stamps = np.zeros(NUMBERS, dtype=np.int64)
        state[TRACK_FIRST], state[TRACK_END] = track.first, track.end
        state[CROSSINGS] = plan.count
        state[PHASE], state[SAMPLES] = law.predictive.phase, law.predictive.samples
        state[LAST_NS], state[SEEN_NS], state[WAITING] = last_ns, seen_ns or 0, waiting
        state[FROZEN], state[AGAINST], state[TOLD] = law.frozen, against, told
        state[REFERENCES] = handed
        self._state = state
        bounds = Bounds(
            settings.odometry_timeout,
            settings.reference_timeout,
            settings.speed_bound,
            settings.error_bound,
            settings.following_bound,
            parts.following.window,
            dead_ns,
            due_ns,
        )
        # Plain tuples, which a call takes to pieces much faster than named ones.
        self._told = (
            (measured.stamps_ns, measured.twists, measured.finite),
            (references.stamps_ns, references.twists, references.finite),
            tuple(bounds),
            (track.stamps, track.samples, track.jump, track.capacity),
            parts.looking,
            parts.seen,
            parts.drive.estimator.tables,
            plan.tables,
            law.predictive.tables,
            law.tables,
            parts.drive.tables,
        )

    @property
    def handed(self) -> int:
        """Up to where references are handed over."""
        return int(self._state[REFERENCES])

    @property
    def last_ns(self) -> int:
        """Stamp of the odometry of the last step."""
        return int(self._state[LAST_NS])

    def run(self, rows: Stamps, first: int, until: int, answers: Array) -> int:
        """Return how many steps from ``first`` to before ``until`` were done, see :func:`march`.

        Raises
        ------
        ValueError
            The estimate or the law has come to numbers that are not finite.
        """
        taken = march(rows, first, until, self._state, *self._told, answers)
        if self._state[FAILED]:
            raise ValueError('speeds, errors and accelerations must be finite: got inf or nan')
        return taken

    def finish(self, answers: Array) -> None:
        """Tell the parts what has become of them, and the rows of all steps that were done."""
        parts, state = self._parts, self._state.tolist()
        track, plan, law = parts.track, parts.pursuit.plan, parts.pursuit.law
        track.went_on(state[TRACK_FIRST], state[TRACK_END])
        parts.freshness.went_on(state[LAST_NS], state[SEEN_NS], waiting=bool(state[WAITING]))
        if len(answers):
            plan.count = state[CROSSINGS]
            law.predictive.went_on(state[PHASE], state[SAMPLES])
            law.frozen = bool(state[FROZEN])
            parts.following.went_on(answers[:, COMMAND : COMMAND + 2], state[AGAINST])
            parts.drive.limited = bool(answers[-1, LIMITED])
