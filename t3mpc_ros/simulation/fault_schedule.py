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
"""Fault schedules: which faults begin and end at what time, from a YAML file."""

from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import count
import math
import os
from pathlib import Path

from t3mpc_ros.parameters import yaml_loader
from t3mpc_ros.parameters.table import (
    ParameterError,
    Value,
    nearest_hint,
)
from t3mpc_ros.script_error import ScriptError
from t3mpc_ros.simulation.fault_injection import FAULTS, FaultParameters

SCHEDULES_FOLDER = Path(__file__).resolve().parent / 'schedules'
"""Folder of the bundled schedules."""
MIN_DURATION = 0.02
"""s; a shorter fault could fall between two states of a robot that reports at 50 Hz."""
_MAX_TIME = 1e6
"""s; eleven days, within which a float resolves nanoseconds."""
_ROUNDING = 0.5e-9
"""s; stamps are whole nanoseconds, but the float 0.2 + 0.1 is more than 0.3."""


class ScheduleError(ScriptError):
    """An invalid schedule; the text contains file, entry, bound and value."""


@dataclass(frozen=True)
class FaultEvent:
    """One entry of a schedule: a value of a fault for a time interval.

    Raises
    ------
    ScheduleError
        The fault does not exist, or value or time is out of range.
    """

    at: float
    """s since the start of the robot"""
    fault: str
    value: Value
    duration: float = math.inf
    """s; the key ``for`` in a file"""

    def __post_init__(self) -> None:
        try:
            object.__setattr__(
                self, 'at', yaml_loader.check_number(self.at, 'at', 0.0, _MAX_TIME, 's')
            )
            if self.duration != math.inf:
                duration = yaml_loader.check_number(
                    self.duration, 'for', MIN_DURATION, _MAX_TIME, 's'
                )
                object.__setattr__(self, 'duration', duration)
        except yaml_loader.EntryError as error:
            raise ScheduleError(str(error)) from None
        if not isinstance(self.fault, str) or self.fault not in FAULTS:
            raise ScheduleError(
                f'fault must be one of {", ".join(FAULTS)}: '
                f'got {yaml_loader.shortened(self.fault)}{nearest_hint(str(self.fault), FAULTS)}'
            )
        try:
            object.__setattr__(self, 'value', FAULTS[self.fault].check(self.value))
        except ParameterError as error:
            raise ScheduleError(f'value: {error}') from None

    @property
    def until(self) -> float:
        """End of the event, s since the start; infinite if it persists."""
        return self.at + self.duration


class FaultSchedule:
    """Decides which faults are active at a time.

    An event is active from its start up to, but not including, its end. Of several events of one
    fault the one with the latest start applies; when it ends, the next one that is still active
    applies, and finally the dynamic value. Of two with the same start the later in the list
    applies.

    Parameters
    ----------
    events
        In any order.
    name
        Name of the schedule, for messages.
    """

    def __init__(self, events: Iterable[FaultEvent] = (), name: str = '') -> None:
        self.events = tuple(events)
        self.name = name
        # Stable: events with the same start keep the order of the list.
        spans = ((event.at - _ROUNDING, event.until - _ROUNDING, event) for event in self.events)
        self._spans = sorted(spans, key=lambda span: span[0])
        times = {time for start, end, _ in self._spans for time in (start, end)}
        self._changes = sorted(times - {math.inf})
        # The last result is valid in [since, until) for one dynamic table; there is none yet.
        self._since, self._until = math.inf, -math.inf
        self._scripted: dict[str, Value] = {}
        self._dynamic: FaultParameters | None = None
        self._result = FaultParameters()

    def at(self, elapsed: float, dynamic: FaultParameters) -> FaultParameters:
        """Return the faults that are active ``elapsed`` seconds after the start of the robot.

        Faults without an active event are as in ``dynamic``. The result depends on the arguments
        alone, not on earlier calls.

        Raises
        ------
        ValueError
            ``elapsed`` is not a number, or infinite.
        """
        if not self._since <= elapsed < self._until:
            self._evaluate(elapsed)
        if dynamic is not self._dynamic and dynamic != self._dynamic:
            self._result = dynamic.with_values(self._scripted) if self._scripted else dynamic
            self._dynamic = dynamic
        return self._result

    def _evaluate(self, elapsed: float) -> None:
        if not math.isfinite(elapsed):
            raise ValueError(f'elapsed must be finite: got {elapsed}')
        after = bisect_right(self._changes, elapsed)
        self._since = self._changes[after - 1] if after > 0 else -math.inf
        self._until = self._changes[after] if after < len(self._changes) else math.inf
        self._scripted = {
            event.fault: event.value for start, end, event in self._spans if start <= elapsed < end
        }
        self._dynamic = None


def load_schedule(name_or_path: str | Path) -> FaultSchedule:
    """Return the schedule of a YAML file, or the bundled one of that name; '' has no events.

    A text is a path if it ends in ``.yaml`` or ``.yml`` or contains a path separator.
    """
    name = os.fspath(name_or_path)
    if not name:
        return FaultSchedule()
    path = Path(os.path.expanduser(name))  # of an unknown user, too
    by_path = (
        isinstance(name_or_path, Path) or path.suffix in ('.yaml', '.yml') or path.name != name
    )
    if not by_path:
        bundled = sorted(file.stem for file in SCHEDULES_FOLDER.glob('*.yaml'))
        if name not in bundled:
            raise ScheduleError(
                f'schedule must be one of {", ".join(bundled)}, or a file that ends in .yaml: '
                f'got {name}{nearest_hint(str(name), bundled)}'
            )
        path = SCHEDULES_FOLDER / f'{name}.yaml'
    with yaml_loader.file_errors(name, ScheduleError):
        content = yaml_loader.read_yaml(path)
        if isinstance(content, dict):
            content = yaml_loader.check_entry(content, 'the schedule', ('events',))['events']
        return FaultSchedule(
            map(_event, count(), yaml_loader.check_list(content, 'events')), path.stem
        )


def _event(index: int, content: object) -> FaultEvent:
    where = f'events[{index}]'
    entry = yaml_loader.check_entry(content, where, ('at', 'fault', 'value'), ('for',))
    try:
        return FaultEvent(entry['at'], entry['fault'], entry['value'], entry.get('for', math.inf))
    except ScheduleError as error:
        raise yaml_loader.EntryError(f'{where}.{error}') from None
