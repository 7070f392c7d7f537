# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fault injection: faults set as parameters or scheduled in a YAML file."""

from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
import difflib
import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from t3mpc_ros.parameters.table import ParameterError, Parameters, ParameterSpec, Value, parameter

SCHEDULES_FOLDER = Path(__file__).resolve().parent / 'schedules'
"""Where the schedules lie that have a name."""

MIN_DURATION = 0.02
"""s; a fault that lasts less may fall between two questions of a robot that reports at 50 Hz."""

_MAX_TIME = 1e6
"""s; eleven days, of which a float still tells every nanosecond."""
_ROUNDING = 0.5e-9
"""s; stamps are whole nanoseconds, but 0.1 s after 0.2 s a float is late for 0.3 s."""


@dataclass(frozen=True)
class FaultParameters(Parameters):
    """What goes wrong with the robot now; at its default a fault is none."""

    command_delay: float = parameter(
        0.0,
        'every command reaches the board this much later',
        unit='s',
        low=0.0,
        high=2.0,
        dynamic=True,
    )
    command_jitter: float = parameter(
        0.0,
        'each command is late by up to this much more, evenly spread, and may be overtaken',
        unit='s',
        low=0.0,
        high=2.0,
        dynamic=True,
    )
    command_loss: float = parameter(
        0.0, 'share of the commands that never arrive', low=0.0, high=1.0, dynamic=True
    )
    gyro_bias_jump: float = parameter(
        0.0,
        'added to what the gyro tells; an MPU6050 may be off by 0.35 rad/s (20 deg/s)',
        unit='rad/s',
        low=-10.0,
        high=10.0,
        dynamic=True,
    )
    gyro_dead: bool = parameter(False, 'the inertial sensor does not answer', dynamic=True)
    ranges_dead: bool = parameter(False, 'no distance sensor is measured', dynamic=True)
    wheel_blocked: str = parameter(
        'none',
        'which wheel is held fast',
        choices=('none', 'right', 'left', 'both'),
        dynamic=True,
    )
    load_change: float = parameter(
        0.0,
        'mass added to the body that nobody told the controller of; below 0: taken away',
        unit='kg',
        low=-1.0,
        high=5.0,
        dynamic=True,
    )
    slippery: float = parameter(
        1.0, 'factor of the grip of the tyres, everywhere', low=0.0, high=1.0, dynamic=True
    )
    supply_sag: float = parameter(
        0.0, 'taken from the voltage of the battery', unit='V', low=0.0, high=20.0, dynamic=True
    )
    brown_out: bool = parameter(
        False, 'the board restarts at the instant at which this becomes true', dynamic=True
    )
    schedule: str = parameter(
        '',
        'schedule of faults to play: the name of a shipped one, or a YAML file, which must end in '
        '.yaml; empty: none',
    )


class Fault(NamedTuple):
    """One fault that can be set and scheduled."""

    name: str
    text: str
    """What it does, in one line."""


_ROWS: Mapping[str, ParameterSpec] = {
    row.name: row for row in FaultParameters.specs() if row.dynamic
}
FAULTS = tuple(Fault(row.name, row.text) for row in _ROWS.values())
"""Every fault there is: the live rows of :class:`FaultParameters`, in their order."""


def active_faults(parameters: FaultParameters) -> tuple[str, ...]:
    """Return what is wrong in words, ``command_delay 0.1 s`` say; empty when nothing is."""
    texts = []
    for name, row in _ROWS.items():
        value = getattr(parameters, name)
        if value == row.default:
            continue
        if isinstance(value, bool):
            texts.append(name)
        else:
            number = f'{value:g}' if isinstance(value, float) else str(value)
            texts.append(f'{name} {number} {row.unit}'.rstrip())
    return tuple(texts)


class ScheduleError(ValueError):
    """A schedule that cannot be played; the text names file, entry, bound and value."""


@dataclass(frozen=True)
class FaultEvent:
    """One entry of a schedule: a fault takes a value for a time.

    Raises
    ------
    ScheduleError
        For a fault that does not exist, or a value or time out of range.
    """

    at: float
    """s since the start of the robot"""
    fault: str
    value: Value
    duration: float = math.inf
    """s; in a file it is called ``for``"""

    def __post_init__(self) -> None:
        object.__setattr__(self, 'at', _seconds('at', self.at, 0.0))
        if self.duration != math.inf:
            object.__setattr__(self, 'duration', _seconds('for', self.duration, MIN_DURATION))
        if not isinstance(self.fault, str) or self.fault not in _ROWS:
            raise ScheduleError(
                f'fault must be one of {", ".join(_ROWS)}: '
                f'got {_shown(self.fault)}{_nearest(self.fault, _ROWS)}'
            )
        row = _ROWS[self.fault]
        try:
            object.__setattr__(self, 'value', row.check(self.value))
        except ParameterError as error:
            advice = _plain_number(self.value) if row.kind is float else ''
            raise ScheduleError(f'value: {error}{advice}') from None
        except OverflowError:  # a whole number that no float can hold
            raise ScheduleError(f'value: {self.fault} must be {row.bounds()}') from None

    @property
    def until(self) -> float:
        """First instant at which the event is over, s since the start; infinite if it stays."""
        return self.at + self.duration


class FaultSchedule:
    """Decides which faults are in force when.

    An event holds from its start up to, and without, its end. Of several events of one fault the
    one that started last holds; when it ends, one that still lasts takes over again, and at last
    the live value. Of two that start together the later in the list holds.

    Parameters
    ----------
    events
        In any order.
    name
        What the schedule is called, for messages.
    """

    def __init__(self, events: Iterable[FaultEvent] = (), name: str = '') -> None:
        self.events = tuple(events)
        self.name = name
        # Stable: events that start together stay in the order of the list.
        spans = ((event.at - _ROUNDING, event.until - _ROUNDING, event) for event in self.events)
        self._spans = sorted(spans, key=lambda span: span[0])
        times = {time for start, end, _ in self._spans for time in (start, end)}
        self._changes = sorted(times - {math.inf})
        # The answer given last holds in [since, until) for one live table; there is none yet.
        self._since, self._until = math.inf, -math.inf
        self._scripted: dict[str, Value] = {}
        self._live: FaultParameters | None = None
        self._result = FaultParameters()

    def at(self, elapsed: float, dynamic: FaultParameters) -> FaultParameters:
        """Return the faults in force ``elapsed`` seconds after the start of the robot.

        What the schedule does not set at that instant is as in ``live``. The answer depends on
        the arguments alone, not on when else the schedule was asked.

        Raises
        ------
        ValueError
            ``elapsed`` is not a number, or infinite.
        """
        if not self._since <= elapsed < self._until:
            self._turn_to(elapsed)
        if dynamic is not self._live and dynamic != self._live:
            self._result = dynamic.with_values(self._scripted) if self._scripted else dynamic
            self._live = dynamic
        return self._result

    def active_names(self, elapsed: float) -> tuple[str, ...]:
        """Return the names of the faults that the schedule sets at ``elapsed`` seconds."""
        scripted = self._scripted_at(elapsed)
        return tuple(name for name in _ROWS if name in scripted)

    def _turn_to(self, elapsed: float) -> None:
        if not math.isfinite(elapsed):
            raise ValueError(f'elapsed must be finite: got {elapsed}')
        after = bisect_right(self._changes, elapsed)
        self._since = self._changes[after - 1] if after > 0 else -math.inf
        self._until = self._changes[after] if after < len(self._changes) else math.inf
        self._scripted = self._scripted_at(elapsed)
        self._live = None

    def _scripted_at(self, elapsed: float) -> dict[str, Value]:
        return {
            event.fault: event.value for start, end, event in self._spans if start <= elapsed < end
        }


def load_schedule(name_or_path: str | Path) -> FaultSchedule:
    """Return the schedule in a YAML file, or the shipped one of that name; '' holds no event.

    A text is a path if it ends in ``.yaml`` or ``.yml`` or contains a separator of folders.

    Raises
    ------
    ScheduleError
        There is no such schedule, or it cannot be played.
    """
    name = os.fspath(name_or_path)
    if not name:
        return FaultSchedule()
    path = Path(name).expanduser()
    by_path = (
        isinstance(name_or_path, Path) or path.suffix in ('.yaml', '.yml') or path.name != name
    )
    if not by_path:
        shipped = sorted(file.stem for file in SCHEDULES_FOLDER.glob('*.yaml'))
        if name not in shipped:
            raise ScheduleError(
                f'schedule must be one of {", ".join(shipped)}, or a file that ends in .yaml: '
                f'got {name}{_nearest(name, shipped)}'
            )
        path = SCHEDULES_FOLDER / f'{name}.yaml'
    try:
        return FaultSchedule(map(_event, *_entries(_read(path))), name=path.stem)
    except ScheduleError as error:
        raise ScheduleError(f'{name}: {error}') from None


def _read(path: Path) -> object:
    try:
        return yaml.load(path.read_text(encoding='utf-8'), Loader=_OnceLoader)
    except OSError as error:
        raise ScheduleError(f'cannot be read: {error.strerror}') from None
    except yaml.MarkedYAMLError as error:
        line = f'line {error.problem_mark.line + 1}: ' if error.problem_mark else ''
        raise ScheduleError(f'is not YAML: {line}{error.problem}') from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ScheduleError(f'is not YAML: {" ".join(str(error).split())}') from None


class _OnceLoader(yaml.SafeLoader):
    """Refuses a key that stands twice: YAML would forget the first, and with it an event."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                problem = f'{key.value} stands twice in one entry; a new entry begins with "- "'
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _entries(content: object) -> tuple[list[str], list[object]]:
    """Return the names of the entries, and the entries."""
    if isinstance(content, dict):
        for key in content:
            if key != 'events':
                raise ScheduleError(f'there must be nothing besides events: got {key}')
        content = content.get('events')
    if not isinstance(content, list):
        raise ScheduleError(f'events must be a list of entries: got {_shown(content)}')
    return [f'events[{index}]' for index in range(len(content))], content


_KEYS = ('at', 'fault', 'value', 'for')


def _event(name: str, entry: object) -> FaultEvent:
    if not isinstance(entry, dict):
        raise ScheduleError(f'{name} must be a mapping of {", ".join(_KEYS)}: got {_shown(entry)}')
    for key in entry:
        if key not in _KEYS:
            near = _nearest(key, _KEYS)
            raise ScheduleError(
                f'{name} must have no more than {", ".join(_KEYS)}: got {key}{near}'
            )
    for key in _KEYS[:3]:
        if key not in entry:
            raise ScheduleError(f'{name}.{key} is missing: got {_shown(entry)}')
    try:
        return FaultEvent(entry['at'], entry['fault'], entry['value'], entry.get('for', math.inf))
    except ScheduleError as error:
        raise ScheduleError(f'{name}.{error}') from None


def _seconds(name: str, value: object, low: float) -> float:
    """Return ``value`` as seconds, or raise :class:`ScheduleError`."""
    bound = f'{name} must be at least {low:g} s'
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ScheduleError(f'{bound}: got {_shown(value)}{_plain_number(value)}')
    if not low <= value <= _MAX_TIME:  # not so for NaN either
        raise ScheduleError(f'{bound} and at most {_MAX_TIME:g}: got {_shown(value)}')
    return float(value)


def _nearest(word: object, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(str(word), list(known), n=1)
    return f'; did you mean {near[0]}?' if near else ''


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f'{text[:77]}...'


def _plain_number(value: object) -> str:
    """Return advice for a number that YAML takes for a text, ``1e-3`` say; else nothing."""
    try:
        number = isinstance(value, str) and math.isfinite(float(value))
    except ValueError:
        return ''
    advice = '; without quotation marks, and with a point as in 1.0e-3, it is a number to YAML'
    return advice if number else ''
