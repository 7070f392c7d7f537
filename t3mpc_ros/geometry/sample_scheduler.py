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
"""Sampling at a fixed rate, simulated time, and the real-time factor."""

from t3mpc_ros.geometry.types import NANOSECONDS


class SampleScheduler:
    """Assigns the samples of a fixed-rate grid to irregular timer calls, without losing any.

    A late timer call returns every sample it missed, so a busy machine delays a stream but
    leaves no gaps in it. At most ``burst`` (s) of a delay is made up for; older samples are
    skipped and counted. ``slack`` (s) is the time from the start of the grid to the first
    call: a timer of the same period then finds one sample due in each call although some calls
    are slightly early.
    """

    def __init__(self, rate: float, burst: float = 0.5, slack: float = 0.0) -> None:
        self._period_ns = NANOSECONDS / rate
        self._slack_ns = round(slack * NANOSECONDS)
        self._max_burst = max(1, int(burst * rate))
        self.reset()

    def reset(self) -> None:
        """Start a new grid at the next call."""
        self._start_ns: int | None = None
        self._next = 0
        self.skipped = 0
        """Samples skipped since the start of the grid."""
        self._reported = 0

    def due(self, now_ns: int) -> list[int]:
        """Return the stamps (ns) of all samples due at ``now_ns`` and not returned before.

        The first call starts the grid; a backward jump of the clock starts a new one.
        """
        if self._start_ns is None or now_ns < self._stamp(self._next - 1):
            self.reset()
            self._start_ns = max(now_ns - self._slack_ns, min(now_ns, 0))
        last = int((now_ns - self._start_ns) / self._period_ns)
        if self._stamp(last + 1) <= now_ns:  # the division may have rounded down
            last += 1
        first = max(self._next, last + 1 - self._max_burst)
        self.skipped += first - self._next
        self._next = max(self._next, last + 1)
        return [self._stamp(n) for n in range(first, last + 1)]

    def newly_skipped(self) -> int:
        """Return the number of samples skipped since the last call of this."""
        before, self._reported = self._reported, self.skipped
        return self.skipped - before

    def lateness(self, now_ns: int) -> float:
        """Return the time (s) since the newest returned sample was due."""
        if self._start_ns is None:
            return 0.0
        return (now_ns - self._stamp(self._next - 1)) / NANOSECONDS

    def _stamp(self, n: int) -> int:
        assert self._start_ns is not None
        return self._start_ns + round(n * self._period_ns)


class SimulatedTime:
    """Clock of a simulation, which runs faster or slower than real time, or step by step.

    Samples form an exact grid that always starts at the same instant, and none is skipped: on
    a machine that is too slow, time passes more slowly. The clock never passes the next
    sample, so it never shows a time that has not been simulated. At most ``max_burst`` samples
    are returned at once, so that other callbacks run in between; with ``real_time_factor`` 0
    :meth:`step` advances the clock.
    """

    def __init__(self, rate: float, real_time_factor: float, max_burst: int = 50) -> None:
        self._period_ns = NANOSECONDS / rate
        self._slack_ns = round(0.2 * self._period_ns)
        self._max_burst = max_burst
        self._start_ns = NANOSECONDS  # not 0, which in ROS means that the time is unknown
        self._next = 0
        self._anchor = self._start_ns, 0
        """An instant of simulated time, and the steady clock's time of that instant."""
        self._anchored = False
        self.real_time_factor = real_time_factor
        """Requested number of simulated seconds per second; see :meth:`set_real_time_factor`."""

    def set_real_time_factor(self, factor: float, steady_ns: int) -> None:
        """Change the real-time factor from now on; 0 stops the clock."""
        self._anchor = self.now_ns(steady_ns), steady_ns
        self._anchored = False
        self.real_time_factor = factor

    def now_ns(self, steady_ns: int) -> int:
        """Return the simulated time when the steady clock is at ``steady_ns``."""
        if not self._anchored:
            return self._anchor[0]
        return min(self._unbounded_ns(steady_ns), self._stamp(self._next))

    def due(self, steady_ns: int) -> list[int]:
        """Return the stamps (ns) of the samples due now: the first at once, then each in turn."""
        if self.real_time_factor == 0.0:
            return self.step(0) if self._next == 0 else []
        if not self._anchored:
            # The grid follows the timer: each call of a jittering timer then finds one sample.
            self._anchor = self._stamp(self._next) + self._slack_ns, steady_ns
            self._anchored = True
        passed = int((self._unbounded_ns(steady_ns) - self._start_ns) / self._period_ns)
        last = min(passed, self._next + self._max_burst - 1)
        stamps = [self._stamp(n) for n in range(self._next, last + 1)]
        self._next = max(self._next, last + 1)
        if last < passed:
            self._anchor = self._stamp(last) + self._slack_ns, steady_ns
        return stamps

    def step(self, count: int) -> list[int]:
        """Return the stamps of the next ``count`` samples, and stop the clock at the last one.

        The first sample, at the start of the grid, is returned in addition to ``count``.
        ValueError: the clock is running.
        """
        if self.real_time_factor != 0.0:
            raise ValueError(f'real_time_factor must be 0 to step: got {self.real_time_factor:g}')
        last = max(self._next - 1, 0) + count
        stamps = [self._stamp(n) for n in range(self._next, last + 1)]
        self._next = last + 1
        if stamps:
            self._anchor = stamps[-1], 0
        return stamps

    def _unbounded_ns(self, steady_ns: int) -> int:
        instant, then = self._anchor
        return instant + round((steady_ns - then) * self.real_time_factor)

    def _stamp(self, n: int) -> int:
        return self._start_ns + round(n * self._period_ns)


class RealTimeFactor:
    """Measures the simulated seconds per second, averaged over about one second."""

    def __init__(self) -> None:
        self.value: float | None = None
        """None during the first second."""
        self.restart()

    def restart(self) -> None:
        """Start a new measurement, because the requested factor has changed."""
        self.value = None
        self._since: tuple[int, int] | None = None

    def update(self, simulated_ns: int, steady_ns: int) -> None:
        """Add a pair of simulated time and time of the steady clock."""
        if self._since is None:
            self._since = simulated_ns, steady_ns
        simulated, steady = self._since
        if steady_ns - steady >= NANOSECONDS:
            self.value = (simulated_ns - simulated) / (steady_ns - steady)
            self._since = simulated_ns, steady_ns
