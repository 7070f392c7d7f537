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
"""Faults of the links between robot and controller: messages that are lost or late."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.parameters.yaml_files import EntryError, check_list, check_number
from t3mpc_ros.robot.interface import RobotState
from t3mpc_ros.script_error import ScriptError

MAX_DELAY = 10.0
"""Largest delay of a message, s."""


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """Faults of the links between robot and controller."""

    command_loss: float = 0.0
    """Fraction of the commands that is lost."""
    command_delay: tuple[float, float] = (0.0, 0.0)
    """Least and largest additional delay of a command, s; uniform between them. A command that
    arrives after a later one is ignored."""
    odometry_loss: float = 0.0
    """Fraction of the measurements that is lost."""
    odometry_delay: tuple[float, float] = (0.0, 0.0)
    """Least and largest delay of a measurement, s; they arrive in order but for the swapped."""
    begin: float = 0.0
    """Begin of the faults, as a share of the run."""
    lasting: float = math.inf
    """Duration of the faults, s."""
    odometry_swapped: int = 0
    """Of so many measurements each the last arrives after its successor; 0: none."""
    odometry_repeated: int = 1
    """How often each measurement arrives."""
    odometry_kept: int = 1
    """Of so many measurements each only the last is sent: a lower rate than the nodes assume."""

    def __post_init__(self) -> None:
        try:
            self._check()
        except EntryError as error:
            raise ScriptError(str(error)) from None

    def _check(self) -> None:
        for name in ('command_loss', 'odometry_loss', 'begin'):
            check_number(getattr(self, name), name, 0.0, 1.0)
        check_number(self.lasting, 'lasting', 0.0, math.inf, 's')
        for name in ('command_delay', 'odometry_delay'):
            pair = getattr(self, name)
            given = list(pair) if isinstance(pair, tuple) else pair
            least, most = check_list(given, name, 2, 2)
            check_number(least, f'the least {name}', 0.0, MAX_DELAY, 's')
            check_number(most, f'the largest {name}', least, MAX_DELAY, 's')
        for name, least in (('swapped', 0), ('repeated', 1), ('kept', 1)):
            count = getattr(self, f'odometry_{name}')
            if isinstance(count, bool) or not isinstance(count, int) or count < least:
                raise ScriptError(
                    f'odometry_{name} must be a whole number of at least {least}: got {count!r}'
                )

    def span(self, duration: float) -> tuple[float, float]:
        """Return begin and end (s) of the faults in a run of ``duration`` seconds."""
        begin = self.begin * duration
        return begin, begin + self.lasting


NO_FAULTS = LinkFaults()
DROPOUTS = LinkFaults(command_loss=0.1, odometry_loss=0.1)
JITTER = LinkFaults(command_delay=(0.0, 0.02), odometry_delay=(0.0, 0.01))
SWAPPED = LinkFaults(odometry_swapped=20)
REPEATED = LinkFaults(odometry_repeated=2)
HALF_RATE = LinkFaults(odometry_kept=2)
LATER = LinkFaults(command_delay=(0.03, 0.03), begin=0.5)
LATER_AND_BACK = LinkFaults(command_delay=(0.03, 0.03), begin=1.0 / 3.0, lasting=20.0)
OVERLOAD = LinkFaults(
    command_delay=(0.02, 0.12), odometry_delay=(0.02, 0.12), begin=0.5, lasting=4.0
)


class ReportLink:
    """Reports of a robot on their way to the driver; they arrive in order but for the swapped.

    Equal seeds draw equal numbers, whatever is sent; ``duration`` is that of the run, s.
    """

    def __init__(self, faults: LinkFaults, seed: int, duration: float) -> None:
        self._faults = faults
        self._begin, self._end = faults.span(duration)
        self._generator = np.random.default_rng((seed, 3))
        self._queue: deque[tuple[int, RobotState]] = deque()
        self._sent = 0
        self._overtaken: RobotState | None = None

    def send(self, state: RobotState) -> None:
        """Send a report; one that is not late arrives after those before it all the same."""
        # Two numbers for each report, so that a change of loss does not shift delays.
        lost, late = self._generator.random(2).tolist()
        arrival, delay = state.stamp_ns, 0.0
        if self._begin <= state.stamp_ns / NANOSECONDS < self._end:
            if lost < self._faults.odometry_loss:
                return
            least, most = self._faults.odometry_delay
            delay = least + (most - least) * late
            self._sent += 1
            if self._sent % self._faults.odometry_kept:
                return
            swapped = self._faults.odometry_swapped
            if swapped and self._overtaken is None and self._sent % swapped == 0:
                self._overtaken = state
                return
        arrival += round(delay * NANOSECONDS)
        arrival = max(arrival, self._queue[-1][0] if self._queue else 0)
        self._queue.extend([(arrival, state)] * self._faults.odometry_repeated)
        if self._overtaken is not None:
            self._queue.append((arrival, self._overtaken))
            self._overtaken = None

    def arrived(self, now_ns: int) -> Iterator[tuple[int, RobotState]]:
        """Yield (arrival, report) of what has arrived by ``now_ns``."""
        while self._queue and self._queue[0][0] <= now_ns:
            yield self._queue.popleft()
