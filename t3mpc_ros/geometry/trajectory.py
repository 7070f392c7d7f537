# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Reference trajectory: buffers stamped samples, interpolates between them, and detects jumps."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import NANOSECONDS, BodyTwist, State
from t3mpc_ros.kernels import kernel

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]


class TrajectoryPoint(NamedTuple):
    """Reference at one instant."""

    twist: BodyTwist
    rate: BodyTwist
    """Time derivative of the twist (m/s², rad/s²); zero between two samples with a jump."""


class Jump(NamedTuple):
    """A discontinuity of the reference."""

    stamp_ns: int
    """First instant after the jump."""
    change: BodyTwist
    """Twist after the jump minus the extrapolated twist before it."""


class ReferenceTrajectory:
    """Interpolates a reference between stamped samples, and detects its jumps.

    Samples may lie in the future: when the reference is stamped ahead by a lead time, its value
    at the present time does not depend on when its messages arrive.

    Parameters
    ----------
    jump
        Body accelerations (m/s², rad/s²) above which two successive samples are a jump: the value
        then steps at the later sample, and the rate in between is zero.
    capacity
        Maximum number of samples.
    """

    def __init__(self, jump: BodyTwist, capacity: int = 512) -> None:
        self.jump: Array = np.array(jump, dtype=np.float64)
        """These accelerations, shape (2,)."""
        self._capacity = capacity
        # Twice as long as needed: every ``capacity`` samples the newest ones move to the front.
        self.stamps: Stamps = np.zeros(2 * capacity, dtype=np.int64)
        """Stamps (ns) of the samples, from :attr:`first` to before :attr:`end`."""
        self.samples: Array = np.zeros((2 * capacity, 4))
        """Twist of each sample and its slope from the one before, see :func:`write_sample`."""
        self.clear()

    def clear(self) -> None:
        """Remove every sample."""
        self.first = self.end = 0
        self.newest_ns: int | None = None
        """Stamp of the newest sample, None without samples."""
        self._jumps: list[Jump] = []

    def add(self, sample: State) -> bool:
        """Add ``sample``; return False, and change nothing, when it is not finite.

        A stamp that is not after the newest one means that the source has restarted: the samples
        from that stamp on are removed first.
        """
        if not sample.is_finite():
            return False
        stamp_ns = sample.stamp_ns
        if self.newest_ns is not None and stamp_ns <= self.newest_ns:
            self._remove_from(stamp_ns)
        if self.end == len(self.stamps):
            self._move_to_front()
        if self.end - self.first == self._capacity:
            self.first += 1
        last = self.end
        self.newest_ns, self.end = stamp_ns, last + 1
        twist = sample.twist
        if write_sample(
            self.stamps,
            self.samples,
            self.first,
            last,
            stamp_ns,
            twist.linear,
            twist.angular,
            self.jump,
        ):
            self._add_jump(last)
        return True

    @property
    def capacity(self) -> int:
        """Maximum number of samples."""
        return self._capacity

    @property
    def has_jumps(self) -> bool:
        """Whether :meth:`pop_jumps` returns any."""
        return bool(self._jumps)

    def pop_jumps(self) -> list[Jump]:
        """Return the jumps added since the last call, oldest first."""
        jumps, self._jumps = self._jumps, []
        return jumps

    def at(self, now_ns: int) -> TrajectoryPoint | None:
        """Return the reference at ``now_ns``; None when no two samples enclose it.

        At the last sample the rate is zero; later values are unknown.
        """
        known, *numbers = interpolate(
            self.stamps, self.samples, self.first, self.end, self.jump, now_ns
        )
        if not known:
            return None
        return TrajectoryPoint(BodyTwist(*numbers[:2]), BodyTwist(*numbers[2:]))

    def _remove_from(self, stamp_ns: int) -> None:
        """Remove the samples and the jumps from a stamp on."""
        before = np.searchsorted(self.stamps[self.first : self.end], stamp_ns)
        self.end = self.first + int(before)
        self._jumps = [jump for jump in self._jumps if jump.stamp_ns < stamp_ns]

    def _move_to_front(self) -> None:
        count = self.end - self.first
        self.stamps[:count] = self.stamps[self.first : self.end]
        self.samples[:count] = self.samples[self.first : self.end]
        self.first, self.end = 0, count

    def _add_jump(self, last: int) -> None:
        """Add the jump between the sample at ``last`` and the one before."""
        span = int(self.stamps[last] - self.stamps[last - 1]) / NANOSECONDS
        rate, slope = self.samples[last, 2:].tolist(), [0.0, 0.0]
        if last - 1 > self.first and not is_jump(self.samples, last - 1, self.jump):
            slope = self.samples[last - 1, 2:].tolist()
        change = BodyTwist(span * (rate[0] - slope[0]), span * (rate[1] - slope[1]))
        self._jumps.append(Jump(int(self.stamps[last]), change))


@kernel
def is_jump(samples: Array, index: int, jump: Array) -> bool:
    """Return whether the slope up to a sample is that of a jump."""
    beyond: bool = abs(samples[index, 2]) > jump[0] or abs(samples[index, 3]) > jump[1]
    return beyond


@kernel
def write_sample(
    stamps: Stamps,
    samples: Array,
    first: int,
    last: int,
    stamp_ns: int,
    linear: float,
    angular: float,
    jump: Array,
) -> bool:
    """Write a sample at ``last``, with its slope; return whether it is a jump.

    stamps  : ns, ascending from ``first`` on
    samples : shape (n, 4): linear, angular (m/s, rad/s), and their slopes from the sample before
    jump    : shape (2,), slopes above which it is a jump (m/s², rad/s²)
    """
    stamps[last] = stamp_ns
    samples[last, 0] = linear
    samples[last, 1] = angular
    if last == first:
        return False
    span = (stamp_ns - stamps[last - 1]) / NANOSECONDS
    samples[last, 2] = (linear - samples[last - 1, 0]) / span
    samples[last, 3] = (angular - samples[last - 1, 1]) / span
    return is_jump(samples, last, jump)


@kernel
def interpolate(
    stamps: Stamps,
    samples: Array,
    first: int,
    end: int,
    jump: Array,
    now_ns: int,
) -> tuple[bool, float, float, float, float]:
    """Return whether the twist at ``now_ns`` is known, the twist, and its rate.

    stamps, samples, jump : as in :func:`write_sample`
    first, end            : range of the samples
    """
    if first == end or now_ns < stamps[first] or now_ns > stamps[end - 1]:
        return False, 0.0, 0.0, 0.0, 0.0
    low, high = first, end  # bisection for the first stamp after now_ns
    while low < high:
        middle = (low + high) // 2
        if stamps[middle] <= now_ns:
            low = middle + 1
        else:
            high = middle
    linear, angular = samples[low - 1, 0], samples[low - 1, 1]
    if low == end or is_jump(samples, low, jump):
        return True, linear, angular, 0.0, 0.0
    elapsed = (now_ns - stamps[low - 1]) / NANOSECONDS
    linear_rate, angular_rate = samples[low, 2], samples[low, 3]
    return (
        True,
        linear + linear_rate * elapsed,
        angular + angular_rate * elapsed,
        linear_rate,
        angular_rate,
    )
