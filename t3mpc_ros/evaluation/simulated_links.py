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

from dataclasses import dataclass
import math

from t3mpc_ros.parameters.yaml_files import EntryError, check_list, check_number
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
