# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Input watchdog and response monitor: whether the robot may move, and why not."""

from collections import deque
from dataclasses import dataclass
import enum

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.parameters.table import Parameters, parameter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WatchdogParameters(Parameters):
    """How old the inputs may be."""

    reference_timeout: float = parameter(
        0.15,
        'oldest reference that is still followed, in time of the odometry stamps',
        unit='s',
        low=0.01,
        high=5.0,
    )
    odometry_timeout: float = parameter(
        0.2,
        'longest gap in the odometry before the robot is stopped',
        unit='s',
        low=0.02,
        high=5.0,
    )
    speed_bound: float = parameter(
        40.0, 'measured wheel speed beyond which the state is diverging', unit='rad/s', low=1.0,
        high=1000.0,
    )  # fmt: skip
    error_bound: float = parameter(
        25.0, 'tracking error beyond which the state is diverging', unit='rad/s', low=0.5,
        high=1000.0,
    )  # fmt: skip
    hold_time: float = parameter(
        0.5,
        'how long the robot stays stopped after a diverging state',
        unit='s',
        low=0.0,
        high=60.0,
    )

    response_bound: float = parameter(
        1.5,
        'how far a measured wheel speed may lie outside the commands of following_window before '
        'the robot counts as not following; 0 = it always follows',
        unit='rad/s',
        low=0.0,
        high=100.0,
    )
    response_window: float = parameter(
        0.15,
        'how long a command may take to be seen in the odometry',
        unit='s',
        low=0.01,
        high=2.0,
    )
    response_timeout: float = parameter(
        0.1,
        'for how long it must, or must no longer, lie outside',
        unit='s',
        low=0.0,
        high=5.0,
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
    NOT_FOLLOWING = 'the robot does not do what it is told'

    def __init__(self, text: str) -> None:
        self.moves = text in ('tracking', 'the robot does not do what it is told')
        """Whether the robot may move."""


class InputWatchdog:
    """Decides step by step whether what the controller knows is good enough to move on.

    Only stamps count, never a clock: the decision is a function of the messages, in the order in
    which they came. The one exception is silence, which no message can tell: see :meth:`silent`.
    """

    def __init__(self, parameters: WatchdogParameters) -> None:
        self._parameters = parameters
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
        if elapsed < 0.0 or elapsed > self._parameters.odometry_timeout:
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
        if age > self._parameters.reference_timeout:
            return Reason.REFERENCE_STALE
        if not known:
            return Reason.NO_REFERENCE
        if speed > self._parameters.speed_bound or error > self._parameters.error_bound:
            self._held_until_ns = stamp_ns + round(self._parameters.hold_time * NANOSECONDS)
        if self._held_until_ns is not None and stamp_ns <= self._held_until_ns:
            return Reason.DIVERGING
        self._held_until_ns = None
        return Reason.TRACKING

    @property
    def held(self) -> bool:
        """Whether the robot is stopped by request or after a diverging state."""
        return not self.enabled or self._held_until_ns is not None

    @property
    def reference_seen(self) -> tuple[int | None, bool]:
        """At which odometry stamp the last reference counted (ns), and whether one waits."""
        return self._reference_seen_ns, self._reference_waiting

    def went_on(self, stamp_ns: int, seen_ns: int, *, waiting: bool) -> None:
        """Take note of odometry at which all was well, and of :attr:`reference_seen`."""
        self._odometry_ns = stamp_ns
        self._reference_seen_ns, self._reference_waiting = seen_ns, waiting

    def silent(self, last_heard_ns: int | None, now_ns: int) -> bool:
        """Whether the odometry has gone silent, both times from one and the same clock."""
        if last_heard_ns is None:
            return True
        return now_ns - last_heard_ns > self._parameters.odometry_timeout * NANOSECONDS


EVIDENCE_WEIGHT = 20
"""So much more a sample counts, for trust in the robot, that one that stands could not give."""


class ResponseMonitor:
    """Decides whether the robot does what it is told: else its errors say nothing of the law.

    A robot that hears nothing, restarts, or whose wheel is held, is no plant to learn from. Its
    wheel speeds lie outside everything that was commanded lately, however late a command acts.
    Commands near zero prove nothing: a robot that stands obeys them too.
    """

    def __init__(self, parameters: WatchdogParameters, period: float) -> None:
        self._parameters = parameters
        self._commands: deque[tuple[float, float]] = deque(
            maxlen=max(1, round(parameters.response_window / period))
        )
        self._patience = max(1, round(parameters.response_timeout / period))
        self._against = 0
        self.holds = True
        """Whether the robot follows."""

    def reset(self) -> None:
        """Trust the robot again, and forget what it was told."""
        self._commands.clear()
        self._against = 0
        self.holds = True

    @property
    def newest(self) -> tuple[float, float] | None:
        """What was commanded last, rad/s; None when that is forgotten."""
        return self._commands[-1] if self._commands else None

    @property
    def window(self) -> int:
        """How many commands are remembered at most."""
        return self._commands.maxlen or 0

    @property
    def counts(self) -> tuple[int, int]:
        """How many commands are remembered, and how much speaks against what holds."""
        return len(self._commands), self._against

    def went_on(self, commands: Array, against: int) -> None:
        """Take note of commands (rad/s, shape (n, 2)) that the robot was seen to follow."""
        self._commands.extend(map(tuple, commands[-self.window :].tolist()))
        self._against = against

    def told(self, right: float, left: float) -> None:
        """Note what is commanded now, rad/s."""
        self._commands.append((right, left))

    def heard(self, right: float, left: float) -> bool:
        """Decide whether the robot follows, from its measured wheel speeds (rad/s)."""
        bound, commands = self._parameters.response_bound, self._commands
        if bound == 0.0 or len(commands) < (commands.maxlen or 0):
            return self.holds
        newest = commands[-1]
        if self.holds and max(abs(right - newest[0]), abs(left - newest[1])) <= bound:
            # So close to one of the commands it cannot lie further outside all of them.
            self._against = 0
            return True
        outside = asleep = 0.0
        for measured, given in zip((right, left), zip(*commands, strict=True), strict=True):
            lowest, highest = min(given), max(given)
            outside = max(outside, measured - highest, lowest - measured)
            asleep = max(asleep, -highest, lowest)
        if (outside > bound) != self.holds:
            self._against = 0
        elif self.holds or asleep > bound:
            self._against += EVIDENCE_WEIGHT
        else:
            self._against += 1  # one that hears nothing would do the same
        if self._against >= EVIDENCE_WEIGHT * self._patience:
            self.holds, self._against = not self.holds, 0
        return self.holds
