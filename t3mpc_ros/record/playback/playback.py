# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is due now, and when to ask again: playing, pausing, stepping, seeking, at any rate.

Nothing here reads a clock: ``now_ns`` is a time that only runs forward. Places in the bag are
nanoseconds on a line on which laps follow each other; place and time are bound by one anchor and
the rate as an exact fraction, so nothing adds up over hours.
"""

from collections.abc import Callable, Iterator
import math
from typing import NamedTuple

from t3mpc_ros.motion.words import NANOSECONDS
from t3mpc_ros.record.playback.bag import Stored
from t3mpc_ros.record.playback.tape import Planned, lap_length


class Emission(NamedTuple):
    """Something to publish now."""

    due_ns: int
    """When it should have been published, on the caller's clock."""
    stamp_ns: int
    """What time it is in the bag."""
    message: Stored | None
    """None: only the time is to be told."""


class Playback:
    """Plays the span from ``begin_ns`` to ``end_ns`` of a bag.

    Parameters
    ----------
    plan
        Returns what is played from a time in the bag on, see :meth:`Tape.plan`; what has a
        ``close`` is closed when it is no longer needed.
    begin_ns, end_ns
        The span to play.
    origin_ns
        From where a refused :meth:`seek` counts seconds; ``begin_ns`` when not given.
    rate
        Seconds of the bag in a second.
    clock_rate
        How often the time is told, in Hz of the caller's clock; 0 = only with messages.
    """

    def __init__(
        self,
        plan: Callable[[int], Iterator[Planned]],
        begin_ns: int,
        end_ns: int,
        *,
        origin_ns: int | None = None,
        rate: float = 1.0,
        loop: bool = False,
        paused: bool = False,
        clock_rate: float = 0.0,
    ) -> None:
        self._plan = plan
        self._begin_ns, self._end_ns = begin_ns, max(begin_ns, end_ns)
        self._origin_ns = begin_ns if origin_ns is None else origin_ns
        self._lap_ns = lap_length(begin_ns, end_ns) if loop else 0
        self._tick_ns = round(NANOSECONDS / clock_rate) if clock_rate else 0
        self._next_tick_ns: int | None = None
        self._ratio = _ratio(rate)
        self.rate = rate
        self.paused = paused
        self.finished = False
        self._steps = 0
        self._stream = plan(begin_ns)
        self._head: Planned | None = None
        self._primed = False
        self._anchor_ns: int | None = None
        """When the place below was, or will be; None until time is told again."""
        self._place = 0

    # -- what to publish --------------------------------------------------------------------------

    def due(self, now_ns: int, most: int = 20) -> tuple[list[Emission], int | None]:
        """Return what is to be published now, at most so much, and when to ask again.

        Messages come in order; late ones come at once, none is left out. The time to ask again is
        None when nothing will happen unless another method is called. After a start or a seek
        the first call only waits for the first message to be read, so that reading does not make
        it late.

        Raises
        ------
        RecordError
            The bag cannot be read on.
        """
        if not self._primed:
            self._advance()
            self._primed = True
            return [], now_ns
        if self._anchor_ns is None:
            self._anchor_ns = now_ns
        out: list[Emission] = []
        while len(out) < most and (head := self._head) is not None:
            due_ns = self._due_ns(head, now_ns)
            if due_ns is None or due_ns > now_ns:
                break
            out.append(Emission(due_ns, head.stamp_ns, head.message))
            if self.paused and not head.restored:
                self._steps -= 1
                self._place = max(self._place, head.at_ns)
            self._advance()
        if self._head is None and not self.finished:
            self.finished = True
            self._place, self._anchor_ns = self._place_at(now_ns), now_ns
        wake_ns = None if self._head is None else self._due_ns(self._head, now_ns)
        if wake_ns is None or wake_ns > now_ns:
            wake_ns = self._tick(now_ns, out, wake_ns)
        return out, wake_ns

    def _due_ns(self, planned: Planned, now_ns: int) -> int | None:
        """Return when a message is due; None while that depends on somebody's asking."""
        if self.paused:
            told_at_once = planned.restored and planned.at_ns <= self._place
            return now_ns if told_at_once or self._steps else None
        anchor_ns = now_ns if self._anchor_ns is None else self._anchor_ns
        numerator, denominator = self._ratio
        ahead_ns = -((self._place - planned.at_ns) * denominator // numerator)  # rounded up
        return anchor_ns + max(0, ahead_ns)

    def _tick(self, now_ns: int, out: list[Emission], wake_ns: int | None) -> int | None:
        if not self._tick_ns or self.finished:
            return wake_ns
        if self._next_tick_ns is None:
            self._next_tick_ns = now_ns
        if self._next_tick_ns <= now_ns:
            out.append(Emission(self._next_tick_ns, self.stamp_ns(now_ns), None))
            # Missed ones are not made up for: there is only one time now.
            self._next_tick_ns += self._tick_ns * ((now_ns - self._next_tick_ns) // self._tick_ns)
            self._next_tick_ns += self._tick_ns
        return self._next_tick_ns if wake_ns is None else min(wake_ns, self._next_tick_ns)

    def _advance(self) -> None:
        self._head = next(self._stream, None)

    # -- where it is ------------------------------------------------------------------------------

    def stamp_ns(self, now_ns: int) -> int:
        """Return what time it is in the bag."""
        place = self._place_at(now_ns)
        if self._lap_ns:
            return self._begin_ns + place % self._lap_ns
        return min(self._begin_ns + place, self._end_ns)

    def laps(self, now_ns: int) -> int:
        """Return how many times the span has been played to its end, when it is a loop."""
        return self._place_at(now_ns) // self._lap_ns if self._lap_ns else 0

    def left_ns(self, now_ns: int) -> int:
        """Return how much longer the rest of the span takes, on the caller's clock."""
        numerator, denominator = self._ratio
        return (self._end_ns - self.stamp_ns(now_ns)) * denominator // numerator

    def _place_at(self, now_ns: int) -> int:
        if self.paused or self.finished or self._anchor_ns is None:
            return self._place
        numerator, denominator = self._ratio
        return self._place + max(0, now_ns - self._anchor_ns) * numerator // denominator

    # -- what a user asks for ---------------------------------------------------------------------

    def pause(self, now_ns: int) -> None:
        """Let time stand; what was due and has not been returned yet waits, too."""
        self._bind(now_ns)
        self.paused = True

    def resume(self, now_ns: int) -> None:
        """Let time go on; steps that were not taken yet are forgotten."""
        self._bind(now_ns)
        self.paused = False
        self._steps = 0

    def set_rate(self, now_ns: int, rate: float) -> None:
        """Play at another rate from now on.

        Raises
        ------
        ValueError
            The rate is not a positive number.
        """
        ratio = _ratio(rate)
        self._bind(now_ns)
        self.rate, self._ratio = rate, ratio

    def seek(self, now_ns: int, stamp_ns: int) -> str:
        """Go on at a time in the bag, with what latched topics held then; or say why not."""
        if not self._begin_ns <= stamp_ns <= self._end_ns:
            begin, end, asked = (
                (each - self._origin_ns) / NANOSECONDS
                for each in (self._begin_ns, self._end_ns, stamp_ns)
            )
            return f'the place must be from {begin:.3f} to {end:.3f} s: got {asked:.3f} s'
        self.close()
        self._stream = self._plan(stamp_ns)
        self._head, self._primed, self.finished = None, False, False
        self._place, self._anchor_ns, self._steps = stamp_ns - self._begin_ns, None, 0
        return ''

    def step(self, now_ns: int, count: int = 1) -> str:
        """Play the next ``count`` messages at once, then stand again; or say why not."""
        if not self.paused:
            return 'it must be paused to go step by step'
        if self.finished:
            return 'there is no next message'
        if count < 1:
            return f'the number of steps must be from 1: got {count}'
        self._steps += count
        return ''

    def close(self) -> None:
        """Let go of what is being read."""
        close = getattr(self._stream, 'close', None)
        if close is not None:
            close()

    def _bind(self, now_ns: int) -> None:
        """Make now the anchor, wherever that is."""
        place = self._place_at(now_ns)
        if self._anchor_ns is not None:
            self._anchor_ns = now_ns
        self._place = place


def _ratio(rate: float) -> tuple[int, int]:
    if not (math.isfinite(rate) and rate > 0.0):
        raise ValueError(f'rate must be a positive number: got {rate}')
    return float(rate).as_integer_ratio()
