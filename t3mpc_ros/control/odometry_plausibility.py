# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Plausibility of odometry and its response to commands: clock, rate, gain and sign.

The results are for diagnostics only; they change no command.
"""

from collections import deque
from statistics import median

from t3mpc_ros.geometry.types import NANOSECONDS, BodyTwist

MAX_DELAY, MAX_LEAD = 0.3, 0.05
"""Offset of odometry stamps from the node's clock beyond which the clocks differ, s."""
MAX_SIMULATED_OFFSET = 5.0
"""The same with simulated time, which may pass many times faster than messages travel, s."""
RATE_TOLERANCE = 0.2
"""Relative difference between measured and set rate that is reported."""
GAIN_RANGE = 0.7, 1.4
"""Range of a plausible gain from the commanded to the measured velocity."""
MEMORY = 0.998
"""Forgetting factor of the gain, per step: 5 s at 100 Hz."""
MIN_EXCITATION = 300.0
"""Sum of squared commands, relative to the scales below, from which the gain is known."""
SCALES = 0.05, 0.3
"""Commands that count as excitation, m/s and rad/s."""


class InputMonitor:
    """Collects stamps of the odometry, and measured velocities with their commands.

    Parameters
    ----------
    rate
        Set rate, Hz.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        window = max(5, round(rate))
        self._offsets: deque[float] = deque(maxlen=window)
        self._intervals: deque[float] = deque(maxlen=window)
        self._last_ns: int | None = None
        self._power = [0.0, 0.0]
        self._product = [0.0, 0.0]

    def update(
        self, stamp_ns: int, now_ns: int, measured: BodyTwist, command: BodyTwist | None
    ) -> None:
        """Add one odometry message and the command before it; None after a standstill command."""
        if self._last_ns is not None and stamp_ns > self._last_ns:
            self._intervals.append((stamp_ns - self._last_ns) / NANOSECONDS)
        self._last_ns = stamp_ns
        self._offsets.append((now_ns - stamp_ns) / NANOSECONDS)
        if command is None:
            return
        for i, (given, found) in enumerate(zip(command, measured, strict=True)):
            self._power[i] = MEMORY * self._power[i] + given * given
            self._product[i] = MEMORY * self._product[i] + given * found

    @property
    def offset(self) -> float:
        """Median time by which the stamps are behind the node's clock, s."""
        return median(self._offsets) if self._offsets else 0.0

    @property
    def rate(self) -> float:
        """Measured rate, Hz; 0 while it is unknown."""
        full = len(self._intervals) == self._intervals.maxlen
        return 1.0 / median(self._intervals) if full else 0.0

    def gain(self, axis: int) -> float | None:
        """Return the gain of the linear (0) or angular (1) velocity, None while unknown."""
        if self._power[axis] < MIN_EXCITATION * SCALES[axis] ** 2:
            return None
        return self._product[axis] / self._power[axis]

    def warnings(self, *, simulated_time: bool) -> list[str]:
        """Return what does not fit, with the likely cause."""
        found = []
        offset = self.offset
        late, early = (
            (MAX_SIMULATED_OFFSET, MAX_SIMULATED_OFFSET)
            if simulated_time
            else (MAX_DELAY, MAX_LEAD)
        )
        if not -early <= offset <= late:
            side = 'behind' if offset > 0.0 else 'ahead of'
            found.append(
                f'odom is stamped {abs(offset):.3g} s {side} the clock of this node: synchronise '
                'the clocks, or set use_sim_time alike'
            )
        rate = self.rate
        if rate and abs(rate / self._rate - 1.0) > RATE_TOLERANCE:
            found.append(f'odom has {rate:.3g} Hz, but rate is {self._rate:g} Hz')
        for axis, name in enumerate(('linear', 'angular')):
            gain = self.gain(axis)
            if gain is None or GAIN_RANGE[0] <= gain <= GAIN_RANGE[1]:
                continue
            sign = 'with the opposite sign, ' if gain < 0.0 else ''
            found.append(
                f'the {name} velocity in odom is {sign}{gain:.2f} times the command: check '
                'geometry, direction and limits of the robot'
            )
        return found
