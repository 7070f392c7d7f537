# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Whether the robot may move: freshness of what the controller is told, and when it stops."""

from dataclasses import dataclass
import enum

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.settings import Settings, setting


@dataclass(frozen=True)
class FreshnessSettings(Settings):
    """How old the inputs may be."""

    reference_timeout: float = setting(
        0.15,
        'oldest reference that is still followed, in time of the odometry stamps',
        unit='s',
        low=0.01,
        high=5.0,
    )
    odometry_timeout: float = setting(
        0.2,
        'longest gap in the odometry before the robot is stopped',
        unit='s',
        low=0.02,
        high=5.0,
    )
    speed_bound: float = setting(
        40.0, 'measured wheel speed beyond which the state is diverging', unit='rad/s', low=1.0,
        high=1000.0,
    )  # fmt: skip
    error_bound: float = setting(
        25.0, 'tracking error beyond which the state is diverging', unit='rad/s', low=0.5,
        high=1000.0,
    )  # fmt: skip
    hold: float = setting(
        0.5,
        'how long the robot stays stopped after a diverging state',
        unit='s',
        low=0.0,
        high=60.0,
    )


class Reason(enum.Enum):
    """Why the robot is stopped, or that it is not."""

    TRACKING = 'tracking'
    DISABLED = 'disabled by request'
    NO_ODOMETRY = 'no odometry'
    ODOMETRY_BAD = 'odometry is not finite'
    ODOMETRY_RESTARTED = 'odometry has restarted'
    NO_REFERENCE = 'no reference yet'
    REFERENCE_STALE = 'reference is stale'
    DIVERGING = 'state is diverging'

    @property
    def moves(self) -> bool:
        """Whether the robot may move."""
        return self is Reason.TRACKING


class Freshness:
    """Decides step by step whether what the controller knows is good enough to move on.

    Only stamps count, never a clock: the decision is a function of the messages, in the order in
    which they came. The one exception is silence, which no message can tell: see :meth:`silent`.
    """

    def __init__(self, settings: FreshnessSettings) -> None:
        self._settings = settings
        self.enabled = True
        self.reset()

    def reset(self) -> None:
        """Forget every stamp; the robot has to earn its motion anew."""
        self._odometry_ns: int | None = None
        self._reference_seen_ns: int | None = None
        self._reference_waiting = False
        self._held_until_ns: int | None = None

    def reference_arrived(self) -> None:
        """Note that a usable reference came; it counts from the next odometry stamp on."""
        self._reference_waiting = True

    def elapsed(self, stamp_ns: int) -> float | None:
        """Return seconds since the last odometry; None when there is nothing to go on from.

        A first message, a stamp that goes backwards and a gap longer than the time-out all give
        None: whatever was integrated before must not be used further.
        """
        last, self._odometry_ns = self._odometry_ns, stamp_ns
        if last is None:
            return None
        elapsed = (stamp_ns - last) / NANOSECONDS
        if elapsed < 0.0 or elapsed > self._settings.odometry_timeout:
            if elapsed < 0.0:
                self._reference_seen_ns = None
                self._held_until_ns = None
            return None
        return elapsed

    def decide(
        self, stamp_ns: int, *, finite: bool, known: bool, speed: float, error: float
    ) -> Reason:
        """Return whether the robot may move at this odometry stamp, or why not.

        Parameters
        ----------
        stamp_ns
            Stamp of the odometry.
        finite
            Whether every number of it is finite.
        known
            Whether the reference is known for this stamp.
        speed, error
            Largest magnitude of measured wheel speed and tracking error, rad/s.
        """
        if self._reference_waiting:
            self._reference_waiting = False
            self._reference_seen_ns = stamp_ns
        if not self.enabled:
            return Reason.DISABLED
        if not finite:
            return Reason.ODOMETRY_BAD
        if self._reference_seen_ns is None:
            return Reason.NO_REFERENCE
        age = (stamp_ns - self._reference_seen_ns) / NANOSECONDS
        if age > self._settings.reference_timeout:
            return Reason.REFERENCE_STALE
        if not known:
            return Reason.NO_REFERENCE
        if speed > self._settings.speed_bound or error > self._settings.error_bound:
            self._held_until_ns = stamp_ns + round(self._settings.hold * NANOSECONDS)
        if self._held_until_ns is not None and stamp_ns <= self._held_until_ns:
            return Reason.DIVERGING
        self._held_until_ns = None
        return Reason.TRACKING

    def silent(self, last_heard_ns: int | None, now_ns: int) -> bool:
        """Whether the odometry has gone silent, both times from one and the same clock."""
        if last_heard_ns is None:
            return True
        return now_ns - last_heard_ns > self._settings.odometry_timeout * NANOSECONDS
