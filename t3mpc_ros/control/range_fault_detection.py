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
"""Which range sensors can be relied on: they report in time, plausibly, and see that they move."""

from collections import deque
import enum
import math

from t3mpc_ros.geometry.types import (
    NANOSECONDS,
    ORIGIN,
    RANGE_SENSORS,
    Array,
    Pose,
    has_moved,
    wrap_angle,
)

LOOKS_ALONG = 0.7
"""Cosine of the direction of a sensor from which on it looks along the motion of the robot."""
BEYOND_RANGE = 1.05  # finite readings above this multiple of the range of a sensor are impossible
REPEATS = 8
"""Equal readings in a row from which on a sensor may be frozen: 0.3 s of a Sharp sensor."""
FROZEN_MOTION, FROZEN_TURN = 0.08, 0.8
"""Motion along its beam (m), or turn (rad), during which a sensor must not read one distance. Its
noise of 10 mV changes a reading beyond 0.25 m even of a robot that stands, but not a nearer one of
a robot that drives along a wall: that moves no face along its beam."""
STEADY, STEADY_TURN, ON_THE_SPOT = 0.06, 2.0, 0.05
"""Band (m) that readings must leave while the robot turns on the spot by such an angle (rad), and
distance (m) up to which it does so: six times the noise of 10 mm of a cable before a sensor. Of
walls that a robot of 0.22 m has room to turn between, those of a square change a reading by 0.07 m
within half of that angle; who walks around it in step with its 1.2 rad/s runs."""
SUSPECT = 0.9
"""Share of a turn from which on a sensor that reads one distance is compared with the others: two
of its readings before the whole turn at 2 rad/s."""
MISSES, MISSES_APART, MISSES_WITHIN = 4, 0.3, 120.0
"""Number of surfaces, so far (m) from the one before, that a sensor has not seen and the map has,
without having seen anything in between, and within such a time (s): it sees nothing at all. One
may be old. The same number, so far from each other, of those that any sensor has missed while none
has seen anything: none does."""
NOTHING_SEEN = 3.0
"""Way (m) without a reading of anything after which it is in doubt whether any sensor sees:
without their supply Sharp sensors read "nothing in range"."""
BRAKES = 0.4  # share of the time-out after which the robot brakes
LEAP = 0.1
"""Change of the pose (m) within a step that is no motion: the robot was carried, or found."""


class RangeFault(enum.Enum):
    """Why a sensor cannot be relied on."""

    SILENT = 'silent'
    LATE = 'late: stamps of another time than those of odom'
    REPEATED = 'repeated: no newer stamps'
    IMPOSSIBLE = 'impossible: not a number, negative or beyond its range'
    FROZEN = 'frozen: one distance while the robot moves'
    BLIND = (
        'blind: nothing in range where something was seen before; it works again when it sees '
        'anything, a hand before it say'
    )


class SensorRecord:
    """What is known of one sensor."""

    def __init__(self, mount: tuple[float, float, float]) -> None:
        x, y, direction = mount
        cosine, sine = math.cos(direction), math.sin(direction)
        self._share = cosine, sine, sine * x - cosine * y
        """Motion of its face along its beam by the motion of the robot: forward, left, turn."""
        self.looks = cosine  # 1 ahead, -1 astern
        self.stamp_ns: int | None = None
        self.received_ns: int | None = None  # stamp of the odometry after the last valid reading
        self.pending = False  # whether a valid reading has come since the last odometry
        self.cause = RangeFault.SILENT  # what a sensor without valid readings is
        self.fault: RangeFault | None = None
        self.age = 0.0  # time since the last valid reading, s
        self._reading = math.nan
        self._repeats = 0
        self._along = self._turn = 0.0
        self._low = self._high = math.nan  # band of the readings of a robot that turns, m
        self._spot: Pose | None = None  # where it has been since then
        self._angle = self._least = self._most = 0.0  # and its angle then, and the extremes, rad
        self._steady: float | None = None  # middle of the band that they did not leave, m
        self._misses: deque[int] = deque()  # stamps of the odometry
        self._missed: tuple[float, float] | None = None  # the last surface that it has not seen, m

    def add(self, reading: float) -> None:
        """Add a valid reading."""
        self.pending = True
        if reading != math.inf:
            self._missed = None
            self._misses.clear()
        if self._steady is not None and not abs(reading - self._steady) <= STEADY:
            self._steady = None
        low, high = min(self._low, reading), max(self._high, reading)
        if high - low <= STEADY:
            self._low, self._high = low, high
        else:
            self._low, self._high, self._spot = reading, reading, None
        if reading == self._reading:
            self._repeats += 1
            return
        self._reading, self._repeats, self._along, self._turn = reading, 0, 0.0, 0.0

    @property
    def suspect(self) -> bool:
        """Whether it reads one distance while the robot turns, as it also does in a round room."""
        repeats = self._repeats >= REPEATS and abs(self._turn) > SUSPECT * FROZEN_TURN
        steady = self._most - self._least > SUSPECT * STEADY_TURN
        return self.fault is None and math.isfinite(self._reading) and (repeats or steady)

    def confirm(self) -> None:
        """Another sensor has seen what it reads: the turn counts from now on."""
        self._spot, self._turn = None, 0.0

    def miss(self, surface: tuple[float, float], now_ns: int) -> None:
        """Count a surface (m) that the map has and it does not see."""
        if self._missed is None or math.dist(self._missed, surface) > MISSES_APART:
            self._missed = surface
            self._misses.append(now_ns)

    def move(self, forward: float, left: float, turn: float) -> None:
        """Add a motion of the robot in its frame (m, rad)."""
        ahead, aside, around = self._share
        self._along += ahead * forward + aside * left + around * turn
        self._turn += turn
        self._angle += turn
        self._least, self._most = min(self._least, self._angle), max(self._most, self._angle)

    def update(self, now_ns: int, pose: Pose, timeout: float) -> None:
        """Decide about the sensor at an odometry."""
        if self.pending:
            self.pending, self.received_ns, self.cause = False, now_ns, RangeFault.SILENT
        elapsed = math.inf if self.received_ns is None else now_ns - self.received_ns
        self.age = elapsed / NANOSECONDS
        moved = abs(self._along) > FROZEN_MOTION or abs(self._turn) > FROZEN_TURN
        if has_moved(self._spot, pose, ON_THE_SPOT, math.inf):
            self._spot, self._low, self._high = pose, self._reading, self._reading
            self._angle = self._least = self._most = 0.0
        if self._most - self._least > STEADY_TURN:
            self._steady = 0.5 * (self._low + self._high)
        while self._misses and now_ns - self._misses[0] > MISSES_WITHIN * NANOSECONDS:
            self._misses.popleft()
        self.fault = None
        if self.age > timeout:
            self.fault = self.cause
        elif self._steady is not None or (
            moved and self._repeats >= REPEATS and math.isfinite(self._reading)
        ):
            self.fault = RangeFault.FROZEN
        elif len(self._misses) >= MISSES:
            self.fault = RangeFault.BLIND


class RangeMonitor:
    """Decides which range sensors can be relied on, by the stamps of odometry and readings.

    "Nothing in range" is no distance: a sensor that is frozen there is told from one before a
    large room by what the others have seen (:meth:`miss`). "Too near" is none, either.
    A sensor is lost without a valid reading for the time-out (s), and sees up to ``limit`` m.
    """

    def __init__(self, mounts: Array, timeout: float, limit: float) -> None:
        self._mounts = [(x, y, direction) for x, y, direction in mounts.tolist()]
        self._timeout, self._limit = timeout, limit
        self.reset()

    def reset(self) -> None:
        """Forget all readings."""
        self._sensors = [SensorRecord(mount) for mount in self._mounts]
        self._now_ns: int | None = None
        self.pose: Pose | None = None
        """The pose of the last odometry."""
        self._missed: list[tuple[float, float]] = []
        """Surfaces that were missed since any sensor saw something, m."""
        self._way, self._way_from = 0.0, ORIGIN
        """Way since then (m), in steps beyond the noise of a pose, and the end of the last one."""

    def accept(self, sensor: int, reading: float, stamp_ns: int | None) -> bool:
        """Return whether a reading (m, REP 117) is to be used; one without a stamp has None."""
        record = self._sensors[sensor]
        if stamp_ns is not None and self._now_ns is not None:
            timeout_ns = self._timeout * NANOSECONDS
            if abs(stamp_ns - self._now_ns) > timeout_ns:
                record.cause = RangeFault.LATE
                return False
            if record.stamp_ns is not None and 0 <= record.stamp_ns - stamp_ns <= timeout_ns:
                record.cause = RangeFault.REPEATED
                return False
            record.stamp_ns = stamp_ns
        impossible = math.isfinite(reading) and not 0.0 <= reading <= BEYOND_RANGE * self._limit
        if impossible or math.isnan(reading):
            record.cause = RangeFault.IMPOSSIBLE
            return False
        record.add(reading)
        if reading != math.inf:
            self._missed.clear()
            self._way = 0.0
        return True

    def suspects(self, sensor: int) -> bool:
        """Return whether the next decision may be that a sensor is frozen; see confirm."""
        return self._sensors[sensor].suspect

    def confirm(self, sensor: int) -> None:
        """Note that another sensor has seen what this one reads."""
        self._sensors[sensor].confirm()

    def miss(self, sensor: int, surface: tuple[float, float]) -> None:
        """Note that a sensor reads "nothing in range" where the map has a surface (m)."""
        self._sensors[sensor].miss(surface, self._now_ns or 0)
        if all(math.dist(surface, each) > MISSES_APART for each in self._missed):
            self._missed.append(surface)

    def sees(self, sensor: int, reading: float) -> bool:
        """Return whether a reading says where something is, or that nothing is."""
        fault = self._sensors[sensor].fault
        return fault is not RangeFault.FROZEN and (
            reading != math.inf or fault is not RangeFault.BLIND
        )

    def update(self, now_ns: int, pose: Pose) -> None:
        """Decide about each sensor at an odometry."""
        last, self.pose, self._now_ns = self.pose, pose, now_ns
        if last is not None and math.hypot(pose.x - last.x, pose.y - last.y) < LEAP:
            x, y = pose.x - last.x, pose.y - last.y
            cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
            forward, left = cosine * x + sine * y, cosine * y - sine * x
            for record in self._sensors:
                record.move(forward, left, wrap_angle(pose.yaw - last.yaw))
        step = math.dist(pose[:2], self._way_from[:2])
        if step > LEAP:
            self._way, self._way_from = self._way + min(step, 2.0 * LEAP), pose
        for record in self._sensors:
            record.update(now_ns, pose, self._timeout)
            if len(self._missed) >= MISSES and record.fault is None:
                record.fault = RangeFault.BLIND

    @property
    def lost(self) -> bool:
        """Whether any sensor cannot be relied on, or all are in doubt."""
        return self._way > NOTHING_SEEN or any(record.fault for record in self._sensors)

    def is_blind(self, *, astern: bool) -> bool:
        """Return whether too few sensors are left to drive ahead or astern."""
        looking = self._looking(astern)
        return bool(self._sensors) and all(each.fault for each in looking or self._sensors)

    def waits(self, *, astern: bool) -> bool:
        """Return whether no sensor that looks there has reported for so long that it brakes."""
        looking = [record for record in self._looking(astern) if not record.fault]
        return bool(looking) and min(each.age for each in looking) > BRAKES * self._timeout

    def faults(self) -> dict[str, RangeFault]:
        """Return the faults of the sensors by name."""
        names = RANGE_SENSORS if len(self._sensors) == len(RANGE_SENSORS) else ()
        return {
            names[index] if names else f'sensor {index}': record.fault
            for index, record in enumerate(self._sensors)
            if record.fault is not None
        }

    def problem(self) -> str:
        """Return which sensors are lost, and why; '' if all work."""
        found = self.faults()
        if not found and self._way > NOTHING_SEEN:
            return (
                f'no range sensor has seen anything for {self._way:.0f} m, the robot drives '
                'slowly: look at their supply and cables, unless nothing is near'
            )
        if not found:
            return ''
        if len(found) == len(self._sensors) and len(set(found.values())) == 1:
            return f'all range sensors {next(iter(found.values())).value}'
        texts = (f'{name} {fault.value}' for name, fault in found.items())
        return f'range sensors lost, the robot drives slowly: {", ".join(texts)}'

    def _looking(self, astern: bool) -> list[SensorRecord]:
        sign = -1.0 if astern else 1.0
        return [record for record in self._sensors if sign * record.looks > LOOKS_ALONG]
