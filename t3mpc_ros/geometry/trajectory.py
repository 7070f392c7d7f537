# Copyright 2026 The t3mpc_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Reference trajectory: buffers stamped samples, interpolates between them, and detects jumps."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import NANOSECONDS, Array, BodyTwist, State
from t3mpc_ros.kernels import TypedKernel, kernel

Stamps = NDArray[np.int64]

REFERENCE_SAMPLES = 2048
"""Number of the newest samples of the reference that are kept: ten seconds at 200 Hz."""


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


class TrajectorySamples(NamedTuple):
    """Samples of a trajectory, for kernels."""

    stamps: Stamps
    """ns, ascending, shape (n,)."""
    samples: Array
    """Linear, angular (m/s, rad/s), and their slopes from the sample before, shape (n, 4)."""
    bounds: Stamps
    """Index of the first sample and of the one after the last, shape (2,)."""
    jump: Array
    """Slopes above which a sample is a jump (m/s², rad/s²), shape (2,)."""


class ReferenceTrajectory:
    """Interpolates a reference between stamped samples, and detects its jumps.

    Samples may lie in the future: when the reference is stamped ahead by a lead time, its
    value at the present time does not depend on when its messages arrive. Above the body
    accelerations ``jump`` (m/s², rad/s²) two successive samples are a jump: the value then
    steps at the later sample, and the rate in between is zero.
    """

    def __init__(self, jump: BodyTwist, capacity: int = REFERENCE_SAMPLES) -> None:
        self.capacity = capacity
        """Maximum number of samples."""
        self._write_sample = TypedKernel(write_sample)
        # Twice as long as needed: every ``capacity`` samples the newest ones move to the front.
        self.buffer = TrajectorySamples(
            np.zeros(2 * capacity, dtype=np.int64),
            np.zeros((2 * capacity, 4)),
            np.zeros(2, dtype=np.int64),
            np.array(jump, dtype=np.float64),
        )
        """The samples."""
        self.clear()

    def set_jump(self, jump: BodyTwist) -> None:
        """Use other body accelerations (m/s², rad/s²) above which two samples are a jump."""
        self.buffer.jump[:] = jump

    def clear(self) -> None:
        """Remove every sample."""
        self.buffer.bounds[:] = 0
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
        stamps, _, bounds, _ = self.buffer
        first, last = bounds.tolist()
        if last == len(stamps):
            self._move_to_front()
            first, last = bounds.tolist()
        if last - first == self.capacity:
            first += 1
        bounds[:] = first, last + 1
        self.newest_ns = stamp_ns
        twist = sample.twist
        if self._write_sample(self.buffer, stamp_ns, twist.linear, twist.angular):
            self._add_jump(last)
        return True

    def holds(self, sample: State) -> bool:
        """Whether the same twist is already known at the stamp of a sample."""
        if self.newest_ns is None or sample.stamp_ns > self.newest_ns:
            return False
        stamps, samples, bounds, _ = self.buffer
        first, end = bounds.tolist()
        i = first + int(np.searchsorted(stamps[first:end], sample.stamp_ns))
        return bool(stamps[i] == sample.stamp_ns) and sample.twist == tuple(
            samples[i, :2].tolist()
        )

    def pop_jumps(self) -> list[Jump]:
        """Return the jumps added since the last call, oldest first."""
        jumps, self._jumps = self._jumps, []
        return jumps

    def at(self, now_ns: int) -> TrajectoryPoint | None:
        """Return the reference at ``now_ns``; None when no two samples enclose it.

        At the last sample the rate is zero; later values are unknown.
        """
        known, *numbers = interpolate(self.buffer, now_ns)
        if not known:
            return None
        return TrajectoryPoint(BodyTwist(*numbers[:2]), BodyTwist(*numbers[2:]))

    def _remove_from(self, stamp_ns: int) -> None:
        """Remove the samples and the jumps from a stamp on."""
        stamps, _, bounds, _ = self.buffer
        before = np.searchsorted(stamps[bounds[0] : bounds[1]], stamp_ns)
        bounds[1] = bounds[0] + int(before)
        self._jumps = [jump for jump in self._jumps if jump.stamp_ns < stamp_ns]

    def _move_to_front(self) -> None:
        stamps, samples, bounds, _ = self.buffer
        first, end = bounds.tolist()
        stamps[: end - first] = stamps[first:end]
        samples[: end - first] = samples[first:end]
        bounds[:] = 0, end - first

    def _add_jump(self, last: int) -> None:
        """Add the jump between the sample at ``last`` and the one before."""
        stamps, samples, bounds, limit = self.buffer
        span = int(stamps[last] - stamps[last - 1]) / NANOSECONDS
        rate, slope = samples[last, 2:].tolist(), [0.0, 0.0]
        if last - 1 > bounds[0] and not is_jump(samples, last - 1, limit):
            slope = samples[last - 1, 2:].tolist()
        change = BodyTwist(span * (rate[0] - slope[0]), span * (rate[1] - slope[1]))
        self._jumps.append(Jump(int(stamps[last]), change))


@kernel
def is_jump(samples: Array, index: int, jump: Array) -> bool:
    """Return whether the slope up to a sample is that of a jump."""
    beyond: bool = abs(samples[index, 2]) > jump[0] or abs(samples[index, 3]) > jump[1]
    return beyond


@kernel
def write_sample(buffer: TrajectorySamples, stamp_ns: int, linear: float, angular: float) -> bool:
    """Write the last sample, with its slope; return whether it is a jump."""
    stamps, samples = buffer.stamps, buffer.samples
    first, last = buffer.bounds[0], buffer.bounds[1] - 1
    stamps[last] = stamp_ns
    samples[last, 0] = linear
    samples[last, 1] = angular
    if last == first:
        return False
    span = (stamp_ns - stamps[last - 1]) / NANOSECONDS
    samples[last, 2] = (linear - samples[last - 1, 0]) / span
    samples[last, 3] = (angular - samples[last - 1, 1]) / span
    return is_jump(samples, last, buffer.jump)


@kernel
def interpolate(buffer: TrajectorySamples, now_ns: int) -> tuple[bool, float, float, float, float]:
    """Return whether the twist at ``now_ns`` is known, the twist, and its rate."""
    stamps, samples, jump = buffer.stamps, buffer.samples, buffer.jump
    first, end = buffer.bounds[0], buffer.bounds[1]
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
