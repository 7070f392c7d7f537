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
"""Switching signal sigma(t): which two of the four chaotic signals drive the two outputs."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, pairwise
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.chaos.secret_random import SecretRandom
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter


@dataclass(frozen=True)
class SwitchingParameters(Parameters):
    """Times, modes and transitions of the switching signal."""

    kind: str = parameter(
        'fixed',
        'fixed: at the times listed; random: dwells and next modes drawn from the seed; '
        'memoryless: the first mode, too, and dwells of any length, by a cryptographic generator',
        choices=('fixed', 'random', 'memoryless'),
    )
    modes: tuple[int, ...] = parameter(
        (1, 2, 2, 3, 3, 4, 4, 1),
        'signal numbers in pairs, one pair per mode: the first drives the first output',
        bounds=(1, 4),
    )
    times: tuple[float, ...] = parameter(
        (12.0, 24.0, 36.0, 48.0),
        'switch times of kind fixed, ascending; after the last one switching continues, modes in '
        'turn, with the last dwell time repeated; empty: no switching. The paper switches four '
        'times, at times that it does not state',
        's',
        (0.01, None),
    )
    shortest_dwell: float = parameter(8.0, 'minimum dwell time, kind random', 's', (0.1, 86400.0))
    longest_dwell: float = parameter(16.0, 'maximum dwell time, kind random', 's', (0.1, 86400.0))
    mean_dwell: float = parameter(8.0, 'mean dwell time, kind memoryless', 's', (0.1, 86400.0))
    blend: float = parameter(
        0.0,
        'duration of the smooth transition between two modes; 0: sudden, as in the paper',
        's',
        (0.0, 3600.0),
        source='paper: sudden changes',
    )

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` for an odd pair, unordered times or a long transition."""
        if not self.modes or len(self.modes) % 2:
            raise ParameterError(f'modes must be one or more pairs: got {len(self.modes)} numbers')
        dwells = [after - before for before, after in pairwise((0.0, *self.times))]
        if any(dwell <= 0.0 for dwell in dwells):
            raise ParameterError(f'times must ascend from above 0 s: got {self.times}')
        if self.longest_dwell < self.shortest_dwell:
            raise ParameterError(
                f'longest_dwell must be at least shortest_dwell, {self.shortest_dwell:g} s: '
                f'got {self.longest_dwell:g}'
            )
        # A transition must end within its dwell: only one previous mode is kept.
        least = min(dwells[1:] or dwells, default=math.inf)
        if self.kind == 'random':
            least = self.shortest_dwell
        if self.kind == 'memoryless':
            least = math.inf  # a switch may interrupt a transition
        if self.blend > least:
            raise ParameterError(
                f'blend must be at most the shortest dwell, {least:g} s: got {self.blend:g}'
            )

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """The modes: (signal of the first output, signal of the second), counted from 1."""
        return tuple(zip(self.modes[::2], self.modes[1::2], strict=True))


class SwitchingMode(NamedTuple):
    """Active mode of the switching signal at one instant, with its transition."""

    mode: int
    """Index of the active pair, from 0."""
    previous: int
    """Index of the previous pair; before the first switch that of the active one."""
    blend: float
    """Weight of the active mode in the outputs, from 0 to 1; the previous one has the rest."""
    blend_rate: float
    """Time derivative of the weight (1/s); 0 at a sudden switch, which has none."""
    switches: int
    """Number of switches so far."""
    since: float
    """Start of the active mode (s)."""
    until: float
    """Time of the next switch (s), inf without one."""


class SwitchingSchedule:
    """Switching signal as a function of time, independent of the order of the queries.

    At a switch time itself the new mode is active. Kind *fixed* takes the modes in turn; kind
    *random* draws each dwell uniformly between its bounds and each next mode uniformly among the
    others. Its bounds are public: right after a switch no other one comes. Kind *memoryless* draws
    exponential dwells, so that the time since the last switch says nothing of the next one, the
    first mode as well, and all from :class:`SecretRandom`. With one mode there are no switches.

    Only the current dwell is kept: memory is constant, each switch passed costs one draw, and
    a query about an earlier dwell restarts at time zero. The seed has any length; kind *fixed*
    ignores it.
    """

    def __init__(self, parameters: SwitchingParameters, seed: int = 0) -> None:
        self.pairs = parameters.pairs
        self._parameters = parameters
        self._seed = seed
        self._dwells: Iterator[SwitchingMode]
        self._dwell: SwitchingMode
        self._restart()

    def at(self, time: float) -> SwitchingMode:
        """Return the active mode at ``time`` (s since the start of the run)."""
        if not 0.0 <= time < math.inf:
            raise ValueError(f'time must be finite and not negative: got {time}')
        if time < self._dwell.since:
            self._restart()
        while time >= self._dwell.until:
            self._dwell = next(self._dwells)
        dwell, span = self._dwell, self._parameters.blend
        if dwell.switches == 0 or time - dwell.since >= span:
            return dwell
        share = (time - dwell.since) / span
        return dwell._replace(
            blend=share * share * (3.0 - 2.0 * share),
            blend_rate=6.0 * share * (1.0 - share) / span,
        )

    def _restart(self) -> None:
        self._dwells = self._walk()
        self._dwell = next(self._dwells)

    def _walk(self) -> Iterator[SwitchingMode]:
        """Yield every dwell, its transition completed; the last one may be infinite."""
        generator = np.random.default_rng(self._seed)
        secret = SecretRandom(self._seed, 'switching')
        memoryless = self._parameters.kind == 'memoryless'
        mode = previous = secret.below(len(self.pairs)) if memoryless else 0
        since = 0.0
        for switches in count():
            until = self._end(switches, since, generator)
            if memoryless and len(self.pairs) > 1:
                until = since + secret.exponential(self._parameters.mean_dwell)
            yield SwitchingMode(mode, previous, 1.0, 0.0, switches, since, until)
            previous, since = mode, until
            step = 1
            if self._parameters.kind == 'random':
                step = int(generator.integers(1, len(self.pairs)))
            elif memoryless and len(self.pairs) > 1:
                step = 1 + secret.below(len(self.pairs) - 1)
            mode = (mode + step) % len(self.pairs)

    def _end(self, switches: int, since: float, generator: np.random.Generator) -> float:
        """Return the end (s) of the dwell after ``switches`` switches."""
        if len(self.pairs) == 1:
            return math.inf
        if self._parameters.kind == 'random':
            return since + float(
                generator.uniform(self._parameters.shortest_dwell, self._parameters.longest_dwell)
            )
        times = (0.0, *self._parameters.times)
        if len(times) == 1:
            return math.inf
        beyond = switches - (len(times) - 2)
        # A product, not a running sum: rounding does not accumulate.
        return times[switches + 1] if beyond <= 0 else times[-1] + beyond * (times[-1] - times[-2])
