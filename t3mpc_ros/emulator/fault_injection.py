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
"""Fault injection by name: faults of the serial line, the radio channel and both boards."""

from collections.abc import Callable
import difflib
import math
import random
from typing import NamedTuple

from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.radio.protocol.frames import VERSION


class FaultKind(NamedTuple):
    """A kind of fault with its default value and duration."""

    name: str
    value: float  # default value; NaN: the fault takes no value
    high: float  # upper bound of the value; the lower bound is 0
    text: str  # effect of the fault and meaning of its value
    duration: float = math.inf  # default duration, s


_NO_VALUE = math.nan
_INSTANT = 1e-3  # s
FAULT_KINDS = (
    FaultKind('drop_bytes', 0.002, 1.0, 'share of bytes on the serial line that are lost'),
    FaultKind('flip_bits', 0.002, 1.0, 'share of bytes on the serial line with one bit inverted'),
    FaultKind('duplicate_bytes', 0.002, 1.0, 'share of bytes on the serial line sent twice'),
    FaultKind('insert_bytes', 0.002, 1.0, 'random bytes on the serial line per byte sent'),
    FaultKind('split', 0.5, 1.0, 'share of writes that arrive in two parts, 2 ms apart'),
    FaultKind('delay', 0.02, 60.0, 'delay of all data on the serial line, s'),
    FaultKind('stall', _NO_VALUE, 0.0, 'the serial line holds all data until the fault ends'),
    FaultKind('reorder', 0.1, 1.0, 'share of frames on the serial line sent after the next one'),
    FaultKind('silence', _NO_VALUE, 0.0, 'all data on the serial line are lost, both ways'),
    FaultKind('wrong_version', 0.1, 1.0, 'share of radio payloads of another protocol version'),
    FaultKind('loss', 0.1, 1.0, 'share of lost radio packets, each way'),
    FaultKind('loss_down', 0.1, 1.0, 'share of lost radio packets to the robot'),
    FaultKind('loss_up', 0.1, 1.0, 'share of lost acknowledgements from the robot'),
    FaultKind('jam', _NO_VALUE, 0.0, 'all radio packets are lost'),
    FaultKind('radio_dead', _NO_VALUE, 0.0, 'the radio chip of the dongle does not respond'),
    FaultKind('dongle_reset', _NO_VALUE, 0.0, 'the dongle reboots (1.5 s)', _INSTANT),
    FaultKind('robot_reset', _NO_VALUE, 0.0, 'the robot board loses power, then reboots', 0.5),
    FaultKind('imu_absent', _NO_VALUE, 0.0, 'the IMU of the robot does not respond'),
    FaultKind('battery_wire', _NO_VALUE, 0.0, 'the wire that measures the battery is broken'),
    FaultKind('button', _NO_VALUE, 0.0, 'the emergency stop button of the robot is pressed'),
    FaultKind('close_port', _NO_VALUE, 0.0, 'the dongle is unplugged, then plugged in again', 1.0),
    FaultKind('move_link', _NO_VALUE, 0.0, 'the dongle changes its device name', _INSTANT),
)
_KIND_OF_NAME = {kind.name: kind for kind in FAULT_KINDS}


class FaultError(ValueError):
    """Invalid fault; the text names the field, the bound and the value."""


class Fault(NamedTuple):
    """A fault with start, duration and value."""

    name: str
    at: float  # start, s
    duration: float = math.nan  # s; NaN: the default of the kind
    value: float = math.nan  # NaN: the default of the kind


def parse_fault(text: str) -> Fault:
    """Return the fault written as ``name:at[:for[:value]]``, times in s: ``loss:5:inf:0.3``."""
    name, *numbers = text.split(':')
    if not 1 <= len(numbers) <= 3:
        raise FaultError(f'fault must be name:at[:for[:value]]: got {text!r}')
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        raise FaultError(f'fault must have numbers after its name: got {text!r}') from None
    return check_fault(Fault(name, *values))


def check_fault(fault: Fault) -> Fault:
    """Return the fault with the defaults of its kind filled in, or raise FaultError."""
    name, at, duration, value = fault
    kind = _KIND_OF_NAME.get(name)
    if kind is None:
        near = difflib.get_close_matches(name, _KIND_OF_NAME, n=1)
        hint = f'did you mean {near[0]}?' if near else f'known are {", ".join(_KIND_OF_NAME)}'
        raise FaultError(f'fault {name!r} does not exist; {hint}')
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
    """Interval in which a fault is active."""

    start_ns: int
    end_ns: float
    value: float


class FaultInjection:
    """Schedule of faults: which are active now, and when a random fault occurs.

    Each kind of fault has its own generator, so faults do not change the random sequence of
    others. ``now_ns`` returns the virtual time.
    """

    def __init__(self, now_ns: Callable[[], int], seed: int) -> None:
        self._now_ns = now_ns
        self._intervals: dict[str, list[FaultInterval]] = {kind.name: [] for kind in FAULT_KINDS}
        self.generators = {kind.name: random.Random(f'{kind.name} {seed}') for kind in FAULT_KINDS}

    def add(self, fault: Fault, start_ns: int) -> FaultInterval:
        """Add a fault at ``start_ns`` plus its own start; return its interval."""
        fault = check_fault(fault)
        begin = start_ns + round(fault.at * NANOSECONDS)
        end = begin + fault.duration * NANOSECONDS
        interval = FaultInterval(begin, end, fault.value)
        self._intervals[fault.name].append(interval)
        return interval

    def clear(self, name: str) -> None:
        """Remove all faults of a kind."""
        self._intervals[name].clear()

    def interval(self, name: str) -> FaultInterval | None:
        """Return the interval of the active fault of a kind that began last; None: none."""
        intervals = self._intervals[name]
        if not intervals:
            return None
        now = self._now_ns()
        active = [interval for interval in intervals if interval.start_ns <= now < interval.end_ns]
        return max(active) if active else None

    def active(self, name: str) -> bool:
        """Return whether a fault of a kind is active now."""
        return self.interval(name) is not None

    def value(self, name: str) -> float:
        """Return the value of the active fault of a kind; 0 if none is active."""
        interval = self.interval(name)
        return interval.value if interval is not None else 0.0

    def combined_probability(self, *names: str) -> float:
        """Return the probability that at least one of several independent faults occurs."""
        none_occurs = 1.0
        for name in names:
            none_occurs *= 1.0 - self.value(name)
        return 1.0 - none_occurs

    def occurs(self, name: str) -> bool:
        """Decide at random, with the value of the fault as probability, whether it occurs."""
        probability = self.value(name)
        return probability > 0.0 and self.generators[name].random() < probability

    def corrupt(self, payload: bytes) -> bytes:
        """Return a radio payload; with another protocol version if ``wrong_version`` occurs."""
        if not payload or not self.occurs('wrong_version'):
            return payload
        versions = [number for number in range(16) if number != VERSION]
        version = self.generators['wrong_version'].choice(versions)
        return bytes([version << 4 | payload[0] & 0x0F]) + payload[1:]
