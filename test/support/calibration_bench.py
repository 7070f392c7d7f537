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
"""A person who calibrates the robot of an emulator: answers the wizard from the true motion."""

from collections import deque
import math
import re

import numpy as np

from t3mpc_ros.robot.calibration import MARKS

HAND_RATE = 3.0  # rad/s


class Person:
    """Answers the questions of the wizard, with errors of the assumed size; turns the robot."""

    def __init__(self, bench, seed=1):
        self.bench = bench
        self.random = np.random.default_rng(seed)
        self.lines = []
        self.answers = {}  # answers by a part of the question, in place of the true ones
        self.moves = True
        self._mark = self.plant.pose
        self._turned = 0.0
        self._hand = deque()
        measure = self.plant._imu.measure
        self.plant._imu.measure = lambda filtered, dt, jump: measure(
            filtered + np.array([[0.0, self._hand_rate(dt)], [0.0, 0.0], [0.0, 0.0]]), dt, jump
        )
        bench.each = self._watch
        self._yaw = self.plant.pose.yaw

    @property
    def plant(self):
        return self.bench.emulator.plant

    @property
    def transcript(self):
        return '\n'.join(self.lines)

    def show(self, line):
        self.lines.append(line)

    def ask(self, question):
        answer = self._answer(question)
        self.lines.append(f'{question}{answer}')
        return answer + '\n'

    def _answer(self, question):
        for part, answers in self.answers.items():
            if part in question and answers:
                answer = answers.pop(0)
                return answer() if callable(answer) else answer
        if 'Move now?' in question:
            self._mark_robot()
            return 'yes' if self.moves else 'no'
        if 'Between both marks' in question:
            x, y, _ = self.plant.pose
            way = math.hypot(x - self._mark.x, y - self._mark.y)
            return f'{way + self._error(MARKS.distance):.4f}'
        if 'Degrees from the mark' in question:
            beyond = math.degrees(self._turned + self._error(MARKS.angle))
            return f'{(beyond + 180.0) % 360.0 - 180.0:.2f}'
        if 'Enter to begin' in question:
            self._mark_robot()
            if 'by hand' in self.lines[-1]:
                self._turn_by_hand(10.0 * math.tau)
            return ''
        if found := re.search(r'put the board at ([\d.]+) m', question):
            distance = float(found[1])
            self.plant._distances[:] = distance + MARKS.range * self.random.standard_normal()
            self.bench.wait(0.2)  # as a person; the sensors measure every 48 ms at least
            return ''
        if 'Voltage of the meter' in question:
            self.plant._battery.charge = 1.0 if 'first' in question else 0.1
            self.bench.wait(0.1)
            volts = self.plant._battery.voltage + MARKS.voltage * self.random.standard_normal()
            return f'{volts:.2f}'
        if 'Store' in question:
            return 'yes'
        raise AssertionError(f'the question must be known: got {question}\n{self.transcript}')

    def _error(self, mark):
        return math.sqrt(2.0) * mark * self.random.standard_normal()

    def _mark_robot(self):
        self._mark = self.plant.pose
        self._turned = 0.0

    def _watch(self, bench):
        """Count the true turns of the robot."""
        yaw = self.plant.pose.yaw
        self._turned += (yaw - self._yaw + math.pi) % math.tau - math.pi
        self._yaw = yaw

    def _turn_by_hand(self, angle):
        """Begin a turn six seconds from now: the link needs a second, the rest four."""
        self._hand_from = self.plant.elapsed + 6.0
        self._hand = deque([angle])

    def _hand_rate(self, dt):
        """Return the yaw rate of the hand: a smooth start and end."""
        if not self._hand or self.plant.elapsed < self._hand_from:
            return 0.0
        duration = 1.5 * self._hand[0] / HAND_RATE
        phase = (self.plant.elapsed - self._hand_from) / duration
        if phase >= 1.0:
            self._hand.clear()
            return 0.0
        rate = HAND_RATE * 4.0 * phase * (1.0 - phase)
        self._turned += rate * dt
        return rate
