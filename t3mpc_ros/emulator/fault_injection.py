# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Fault injection by name: faults of the serial line, the radio channel and both boards."""

from collections.abc import Callable
import difflib
import math
import random
from typing import NamedTuple

from t3mpc_ros.geometry.types import NANOSECONDS


class FaultKind(NamedTuple):
    """One thing that can go wrong."""

    name: str
    value: float
    """What is meant when none is given; NaN: it takes no value."""
    high: float
    text: str
    """What it does, and what its value is."""
    duration: float = math.inf
    """s it lasts when nothing else is said"""


_NONE = math.nan
_ONCE = 1e-3
FAULT_KINDS = (
    FaultKind('drop_bytes', 0.002, 1.0, 'share of the bytes on the line that vanish'),
    FaultKind(
        'flip_bits', 0.002, 1.0, 'share of the bytes on the line of which one bit turns over'
    ),
    FaultKind('duplicate_bytes', 0.002, 1.0, 'share of the bytes on the line that come twice'),
    FaultKind(
        'insert_bytes', 0.002, 1.0, 'share of the bytes on the line before which one appears'
    ),
    FaultKind('split', 0.5, 1.0, 'share of the pieces of data that come in two parts, 2 ms apart'),
    FaultKind('delay', 0.02, 60.0, 's by which what goes over the line is late'),
    FaultKind('stall', _NONE, 0.0, 'the line stands still; all comes at once when it is over'),
    FaultKind('reorder', 0.1, 1.0, 'share of the frames on the line that the next one overtakes'),
    FaultKind('silence', _NONE, 0.0, 'what either end says over the line is lost'),
    FaultKind('wrong_version', 0.1, 1.0, 'share of the radio payloads of another version'),
    FaultKind('loss', 0.1, 1.0, 'share of the packets that are lost, of each direction'),
    FaultKind('loss_down', 0.1, 1.0, 'the same, to the robot'),
    FaultKind('loss_up', 0.1, 1.0, 'the same, of its acknowledgements'),
    FaultKind('jam', _NONE, 0.0, 'nothing gets through the air'),
    FaultKind('radio_dead', _NONE, 0.0, 'the radio chip of the dongle does not answer'),
    FaultKind('dongle_reset', _NONE, 0.0, 'the dongle starts anew, and takes 1.5 s for it', _ONCE),
    FaultKind('robot_reset', _NONE, 0.0, 'the robot has no power, then starts anew', 0.5),
    FaultKind('imu_absent', _NONE, 0.0, 'the inertial sensor of the robot does not answer'),
    FaultKind('button', _NONE, 0.0, 'the emergency stop of the robot is pressed'),
    FaultKind('close_port', _NONE, 0.0, 'the dongle is pulled out, and plugged in again', 1.0),
    FaultKind('move_link', _NONE, 0.0, 'the dongle comes back under another name', _ONCE),
)
_KIND_OF_NAME = {kind.name: kind for kind in FAULT_KINDS}


class FaultError(ValueError):
    """A fault that cannot be played; the text says what is wrong with it."""


class Fault(NamedTuple):
    """Something that goes wrong for a time."""

    name: str
    at: float
    """s after the start"""
    duration: float = math.nan
    """s; NaN: the usual one"""
    value: float = math.nan
    """NaN: the usual one"""


def parse_fault(text: str) -> Fault:
    """Return the fault that a text like ``jam:5:1.0`` or ``loss:5:inf:0.3`` names.

    The numbers are: when (s), for how long (s), and its value.

    Raises
    ------
    FaultError
        There is no such fault, or a number is none.
    """
    name, *numbers = text.split(':')
    if not 1 <= len(numbers) <= 3:
        raise FaultError(f'fault must be name:at[:for[:value]]: got {text!r}')
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        raise FaultError(f'fault must have numbers behind its name: got {text!r}') from None
    return check_fault(Fault(name, *values))


def check_fault(fault: Fault) -> Fault:
    """Return the fault with its value filled in, or raise FaultError."""
    name, at, duration, value = fault
    kind = _KIND_OF_NAME.get(name)
    if kind is None:
        near = difflib.get_close_matches(name, _KIND_OF_NAME, n=1)
        hint = f'; did you mean {near[0]}?' if near else f'; there are {", ".join(_KIND_OF_NAME)}'
        raise FaultError(f'fault {name!r} does not exist{hint}')
    if not 0.0 <= at < math.inf:
        raise FaultError(f'{name}: at must be at least 0 s and finite: got {at:g}')
    if math.isnan(duration):
        duration = kind.duration
        fault = fault._replace(duration=duration)
    if not duration > 0.0:
        raise FaultError(f'{name}: for must be more than 0 s: got {duration:g}')
    if math.isnan(value):
        return fault._replace(value=kind.value)
    if math.isnan(kind.value):
        raise FaultError(f'{name} takes no value: got {value:g}')
    if not 0.0 <= value <= kind.high:
        raise FaultError(f'{name}: value must be from 0 to {kind.high:g}: got {value:g}')
    return fault


class FaultInterval(NamedTuple):
    """From when to when a fault happens."""

    start_ns: int
    end_ns: float
    value: float


class FaultInjection:
    """Knows what is wrong now, and throws the dice for it.

    Parameters
    ----------
    now_ns
        Tells the time.
    seed
        Each fault has dice of its own: one more does not shift those of the others.
    """

    def __init__(self, now_ns: Callable[[], int], seed: int) -> None:
        self._now_ns = now_ns
        self._spans: dict[str, list[FaultInterval]] = {kind.name: [] for kind in FAULT_KINDS}
        self.dice = {kind.name: random.Random(f'{kind.name} {seed}') for kind in FAULT_KINDS}

    def add(self, fault: Fault, start_ns: int) -> FaultInterval:
        """Let a fault happen from ``start_ns`` plus its own time on; return when."""
        fault = check_fault(fault)
        begin = start_ns + round(fault.at * NANOSECONDS)
        end = begin + fault.duration * NANOSECONDS
        span = FaultInterval(begin, end, fault.value)
        self._spans[fault.name].append(span)
        return span

    def clear(self, name: str) -> None:
        """End all faults of a name."""
        self._spans[name].clear()

    def span(self, name: str) -> FaultInterval | None:
        """Return the fault of that name that began last of those that happen now."""
        spans = self._spans[name]
        if not spans:
            return None
        now = self._now_ns()
        happening = [span for span in spans if span.start_ns <= now < span.end_ns]
        return max(happening) if happening else None

    def active(self, name: str) -> bool:
        """Return whether a fault happens now."""
        return self.span(name) is not None

    def value(self, name: str) -> float:
        """Return the value of a fault, 0 if it does not happen now."""
        span = self.span(name)
        return span.value if span is not None else 0.0

    def share(self, *names: str) -> float:
        """Return the share that is lost by several causes that know nothing of each other."""
        kept = 1.0
        for name in names:
            kept *= 1.0 - self.value(name)
        return 1.0 - kept

    def occurs(self, name: str) -> bool:
        """Throw the dice of a fault."""
        share = self.value(name)
        return share > 0.0 and self.dice[name].random() < share

    def corrupt(self, payload: bytes, name: str) -> bytes:
        """Return a radio payload, of another version if the fault strikes."""
        if not payload or not self.occurs(name):
            return payload
        version = self.dice[name].choice([number for number in range(16) if number != 1])
        return bytes([version << 4 | payload[0] & 0x0F]) + payload[1:]
