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

    def clear(self) -> None:
        """Forget every sample."""
        self._samples.clear()
        self._stamps.clear()

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
        self._stamps.append(sample.stamp_ns)
        self._samples.append(sample)
        return True

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
        before, after = self._samples[index - 1], self._samples[index]
        span = (after.stamp_ns - before.stamp_ns) / NANOSECONDS
        rate = BodyTwist(
            (after.twist.linear - before.twist.linear) / span,
            (after.twist.angular - before.twist.angular) / span,
        )
        if abs(rate.linear) > self._jump.linear or abs(rate.angular) > self._jump.angular:
            return TrackPoint(before.twist, BodyTwist(0.0, 0.0))
        elapsed = (now_ns - before.stamp_ns) / NANOSECONDS
        twist = BodyTwist(
            before.twist.linear + rate.linear * elapsed,
            before.twist.angular + rate.angular * elapsed,
        )
        return TrackPoint(twist, rate)
