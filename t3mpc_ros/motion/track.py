# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A short memory of stamped motions that answers for any instant in between."""

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

from t3mpc_ros.motion.words import NANOSECONDS, BodyTwist, Motion


@dataclass(frozen=True, slots=True)
class TrackPoint:
    """What is wanted at one instant."""

    twist: BodyTwist
    rate: BodyTwist
    """Time derivative of the twist (m/s², rad/s²); a switch counts as rate zero."""


@dataclass(frozen=True, slots=True)
class Jump:
    """A sudden change of what is wanted."""

    stamp_ns: int
    """First instant of the new motion."""
    change: BodyTwist
    """New twist minus the old one carried on by its slope."""


class Track:
    """Interpolates a wanted motion between stamped samples, and sees its jumps.

    Samples may lie in the future: a reference stamped ahead by a lead time makes the value at
    *now* independent of when its messages arrived.

    Parameters
    ----------
    jump
        Body accelerations (m/s², rad/s²) beyond which two neighbouring samples are taken as a
        switch: the value then steps at the later sample, and the rate is zero in between.
    capacity
        Most samples kept.
    """

    def __init__(self, jump: BodyTwist, capacity: int = 512) -> None:
        self._jump = jump
        self._samples: deque[Motion] = deque(maxlen=capacity)
        self._stamps: deque[int] = deque(maxlen=capacity)
        self._jumps: deque[Jump] = deque(maxlen=capacity)

    def clear(self) -> None:
        """Forget every sample."""
        self._samples.clear()
        self._stamps.clear()
        self._jumps.clear()

    def add(self, sample: Motion) -> bool:
        """Keep ``sample``; return False, and keep nothing, when it is not finite.

        A stamp that does not come after the newest one means that the source has started
        again: the samples from that stamp on are dropped first.
        """
        if not sample.is_finite():
            return False
        while self._stamps and self._stamps[-1] >= sample.stamp_ns:
            self._stamps.pop()
            self._samples.pop()
        while self._jumps and self._jumps[-1].stamp_ns >= sample.stamp_ns:
            self._jumps.pop()
        self._stamps.append(sample.stamp_ns)
        self._samples.append(sample)
        self._note_jump()
        return True

    def take_jumps(self) -> list[Jump]:
        """Return the jumps added since the last call, oldest first."""
        jumps = list(self._jumps)
        self._jumps.clear()
        return jumps

    def _note_jump(self) -> None:
        """Remember it when the last sample lies a jump away from the one before."""
        last = len(self._samples) - 1
        if last < 1 or not self._sudden(rate := self._rate(last)):
            return
        span = (self._stamps[-1] - self._stamps[-2]) / NANOSECONDS
        slope = BodyTwist(0.0, 0.0)
        if last > 1 and not self._sudden(before := self._rate(last - 1)):
            slope = before
        change = BodyTwist(
            span * (rate.linear - slope.linear), span * (rate.angular - slope.angular)
        )
        self._jumps.append(Jump(self._stamps[-1], change))

    def _rate(self, index: int) -> BodyTwist:
        """Return the rate of change from the sample before ``index`` to it."""
        before, after = self._samples[index - 1], self._samples[index]
        span = (after.stamp_ns - before.stamp_ns) / NANOSECONDS
        return BodyTwist(
            (after.twist.linear - before.twist.linear) / span,
            (after.twist.angular - before.twist.angular) / span,
        )

    def _sudden(self, rate: BodyTwist) -> bool:
        return abs(rate.linear) > self._jump.linear or abs(rate.angular) > self._jump.angular

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest sample, None when there is none."""
        return self._stamps[-1] if self._stamps else None

    def at(self, now_ns: int) -> TrackPoint | None:
        """Return the motion wanted at ``now_ns``; None when no two samples enclose it.

        The last sample itself is answered with rate zero; anything later is not known.
        """
        if not self._stamps or now_ns < self._stamps[0] or now_ns > self._stamps[-1]:
            return None
        index = bisect_right(self._stamps, now_ns)
        if index == len(self._stamps):
            return TrackPoint(self._samples[-1].twist, BodyTwist(0.0, 0.0))
        before, rate = self._samples[index - 1], self._rate(index)
        if self._sudden(rate):
            return TrackPoint(before.twist, BodyTwist(0.0, 0.0))
        elapsed = (now_ns - before.stamp_ns) / NANOSECONDS
        twist = BodyTwist(
            before.twist.linear + rate.linear * elapsed,
            before.twist.angular + rate.angular * elapsed,
        )
        return TrackPoint(twist, rate)
