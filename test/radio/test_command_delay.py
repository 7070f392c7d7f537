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
"""Delay of a command over the radio, the basis of ``speed_filter.dead_time``."""

import itertools
import random

import numpy as np
import pytest
from support.emulator_bench import MS, RobotBench
from support.long_tests import few_of

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.robot.interface import RobotCommand

DEAD_TIME = 0.02  # dead time that demo and launch file of the real robot configure, s


class Controlled(RobotBench):
    """A controller that answers each state after milliseconds, with late wake-ups."""

    def __init__(self, thinking_ns, lateness_ns, **given):
        super().__init__(**given)
        self._thinking_ns, self._lateness_ns = thinking_ns, lateness_ns
        self._dice = random.Random(8)
        self._due = []
        self.answers = {}
        """Sample time of the state that each command answers, by its left speed in mrad/s."""

    def _step(self, received):
        self.now_ns += self._dice.randrange(self._lateness_ns + 1)
        super()._step(received)
        for state in self.states:
            # Slow enough to avoid ramp delays, and unique.
            number = 2000 + len(self.answers) % 2000
            self.answers[number] = state.stamp_ns
            thinking = round(self._thinking_ns * self._dice.uniform(0.5, 1.5))
            self._due.append((self.now_ns + thinking, number / 1000.0))
        self.states.clear()
        if self._due:
            self.wake_ns = min(self.wake_ns, self._due[0][0])

    def _command(self):
        while self._due and self._due[0][0] <= self.now_ns:
            _, speed = self._due.pop(0)
            self.robot.apply(RobotCommand(WheelSpeeds(speed, speed), self.now_ns), self.now_ns)


CASES = [*itertools.product((1.0, 3.0, 8.0), (0.0, 0.3, 1.0), (0.0, 0.1))]
EXTREMES = [(1.0, 0.0, 0.0), (8.0, 1.0, 0.1)]


@pytest.mark.parametrize(
    'thinking, lateness, loss', few_of([*EXTREMES, *(c for c in CASES if c not in EXTREMES)])
)
@pytest.mark.slow
def test_a_command_is_executed_one_cycle_after_its_state(thinking, lateness, loss):
    """Regression: the limiter had a period of its own, independent of the link cycle.

    A late thread let the two drift: each command waited for the cycle after the next, 39 ms
    instead of 19, for as long as the phase lasted.
    """
    bench = Controlled(round(thinking * MS), round(lateness * MS))
    bench.connect()
    bench.inject('loss', 100.0, loss)
    bench.run(5.0)
    found = [
        (now_ns - bench.answers[command.left]) / 1e9
        for now_ns, command in bench.followed[50:]
        if command.left in bench.answers
    ]
    assert len(found) > 180
    middle, late = np.median(found), np.quantile(found, 0.95)
    print(f'\n{1e3 * middle:.1f} ms, {1e3 * late:.1f} ms (95 %) after the sample')
    assert middle == pytest.approx(DEAD_TIME, abs=0.0015)
    assert late <= DEAD_TIME + 0.003
