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
"""Monitor of the odometry: gaps, late messages, jumps, rate, clock, and gain of the response."""

from collections import deque
import math
from statistics import median
from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import NANOSECONDS, Array, BodyTwist, State, difference, has_jumped

MAX_DELAY, MAX_LEAD = 0.3, 0.01
"""Offset of odometry stamps from the node's clock beyond which the clocks differ, s: a message
takes time, and clocks that are synchronised differ by less than the latter."""
MAX_AGE_BEYOND_RESPONSE = 0.02
"""Offset beyond the response time from which the clocks differ, s: a message cannot be on its way
for longer than a command, the response of the robot and the message together."""
MAX_SIMULATED_OFFSET = 5.0
"""The same with simulated time, which may pass many times faster than messages travel, s."""
NO_STAMP = 1e8  # offset of a stamp that is no time of today, s: three years
RATE_TOLERANCE = 0.2  # relative difference between measured and set rate that is reported

GAP, GAP_OF_THREE = 1.7, 3.5
"""Interval from which a message is missing, in periods: with a jitter of 30 % none reaches it, and
that of three: a stamp that is late, between one and the next that are not, is no gap."""
RECENT = 10.0  # time for which gaps and jumps are reported, s
MANY_JUMPS = 3
"""Jumps of the pose in that time from which they are: a localisation makes one now and then."""
MANY_MISSING = 0.02  # share of missing messages that is reported
LATE = 0.1  # delay beyond the median from which a message is late, s

FILTER_TIME = 0.2  # time constant of each of the three stages of the filter, s
ROW_INTERVAL = 0.5  # time between two rows of the fit, s
SETTLING_TIME = 1.5  # time after an interruption until the filter has forgotten it, s
CONFIRMATION_TIME = 1.0
"""Time for which a row waits: an interruption is often noticed late, as the robot has stopped."""
MEMORY = 1.0 - 1.0 / 240.0  # forgetting factor of a row: 120 s
CORRELATION = 2.7
"""Variance of a mean of rows over that of independent ones: (1 + r) / (1 - r), r = 0.46."""
MAX_STEP = 0.25  # longest time between two messages that is no interruption, s
PRIOR = 1.0, 0.2, 0.03, 0.3
"""Standard deviation before any row of g - 1, T (s), κ (s²), and of o over the scale."""
KNOWN = 0.2  # standard deviation from which a gain counts as unknown
MIN_ROWS = 20  # rows from which the noise is known

SCALES = 0.05, 0.3  # velocities that count as small, m/s and rad/s
STANDING = 0.05  # measured velocity of a standing robot, in the scales
MEDIAN_EVERY = 5  # messages between two medians: one of a hundred numbers costs 5 µs
STANDING_TIME = 0.3
"""Time for which a robot stands against its command before it counts as stopped, s."""
GAIN_TOLERANCE = 0.03  # deviation of a gain from 1 that is reported, once it is certain
CERTAIN = 4.0  # standard deviations from which a deviation is certain
SIGN_MEMORY = 0.998  # forgetting factor of the sign of the response, per step: 5 s at 100 Hz
SIGN_EXCITATION = 300.0  # sum of squared commands, in the scales, from which the sign is known
OPPOSITE = -0.3  # quotient of velocities below which the robot moves the other way


class Gain(NamedTuple):
    """A gain with its standard deviation."""

    value: float
    deviation: float
    falls: bool  # whether it is clearly smaller for large commands: the robot is at a limit


class ResponseGain:
    r"""The static gain from one commanded velocity to the measured one.

    Command c and measurement m pass the same low-pass filter, whose states are also its first two
    derivatives. Whatever the dynamics of the robot are, they are for slow signals

    .. math:: m = g\,c - T\,\dot c + \kappa\,\ddot c + o\,\operatorname{sgn} c

    with the sum T of dead time and lag, and an offset o of friction or of commands that the robot
    cuts to steps. A fit by least squares separates the gain g from them: a mere quotient of
    velocities would take 5 % for a lag of 0.1 s.

    scale : velocity that counts as small, m/s or rad/s
    """

    def __init__(self, scale: float) -> None:
        self._scale = scale
        self._normal = np.zeros((4, 4))
        self._product = np.zeros(4)
        self._square = 0.0
        self._rows = 0.0
        self._pending: deque[tuple[float, Array, float]] = deque()
        self._states: list[list[float]] | None = None
        self._since = self._until_row = self._time = 0.0

    def interrupt(self) -> None:
        """Forget what is not confirmed: the robot does not follow, or messages are missing."""
        self._states = None
        self._pending.clear()

    def update(self, elapsed: float, command: float, measured: float) -> None:
        """Add the measurement at the end of a time (s) with a constant command."""
        if not 0.0 < elapsed <= MAX_STEP:
            self.interrupt()
            return
        given = command, measured, math.copysign(self._scale, command) if command else 0.0
        if self._states is None:
            self._states = [[value] * 3 for value in given]
            self._since, self._until_row, self._time = 0.0, 0.0, 0.0
        self._time += elapsed
        share = -math.expm1(-elapsed / FILTER_TIME)
        for states, value in zip(self._states, given, strict=True):
            states[0] += share * (value - states[0])
            states[1] += share * (states[0] - states[1])
            states[2] += share * (states[1] - states[2])
        self._until_row -= elapsed
        if self._time < SETTLING_TIME or self._until_row > 0.0:
            return
        self._until_row = ROW_INTERVAL
        (first, second, third), found, sign = self._states
        slope = (second - third) / FILTER_TIME
        bend = (first - 2.0 * second + third) / FILTER_TIME**2
        self._pending.append((self._time, np.array([third, -slope, bend, sign[2]]), found[2]))
        while self._pending and self._pending[0][0] <= self._time - CONFIRMATION_TIME:
            _, row, value = self._pending.popleft()
            self._normal = MEMORY * self._normal + np.outer(row, row)
            self._product = MEMORY * self._product + value * row
            self._square = MEMORY * self._square + value * value
            self._rows = MEMORY * self._rows + 1.0

    def gain(self) -> Gain | None:
        """Return the gain; None while it is unknown."""
        if self._rows < MIN_ROWS:
            return None
        prior = np.array([1.0, 0.0, 0.0, 0.0])
        precision = np.array(PRIOR) ** -2.0
        noise = (1e-3 * self._scale) ** 2
        for _ in range(3):
            matrix = self._normal + np.diag(noise * precision)
            fit = np.linalg.solve(matrix, self._product + noise * precision * prior)
            rest = self._square - 2.0 * fit @ self._product + fit @ self._normal @ fit
            noise = max(float(rest) / (self._rows - 4.0), (1e-3 * self._scale) ** 2)
        deviations = np.sqrt(CORRELATION * noise * np.diag(np.linalg.inv(matrix)))
        if deviations[0] > KNOWN:
            return None
        falls = fit[3] > 4.0 * deviations[3] and fit[3] > 0.1
        return Gain(float(fit[0]), float(deviations[0]), bool(falls))


class Gaps:
    """Messages that are missing in a stream: how many, how long, and when."""

    def __init__(self, rate: float) -> None:
        self._intervals: deque[float] = deque(maxlen=max(5, round(rate)))
        self._period = 1.0 / rate
        self._since_median = 0  # number of intervals
        self._last_ns: int | None = None
        self._recent: deque[tuple[int, float, int]] = deque()
        self.number = 0
        self.missing = 0
        self.longest = 0.0  # longest gap, s
        self.restarts = 0  # stamps that were older than the one before

    def update(self, stamp_ns: int, periods: int | None = None) -> float | None:
        """Add a message; return the time since the one before, s, None at a restart.

        ``periods`` since the one before, where the motion tells them: then stamps jitter.
        """
        last, self._last_ns = self._last_ns, stamp_ns
        if last is None:
            return None
        elapsed = (stamp_ns - last) / NANOSECONDS
        if elapsed <= 0.0:
            self.restarts += elapsed < 0.0
            self._recent.clear()
            return None
        self._intervals.append(elapsed)
        self._since_median += 1
        if self._since_median >= MEDIAN_EVERY or elapsed > GAP * self._period:
            self._period, self._since_median = median(self._intervals), 0
        if periods is not None:
            self._add(stamp_ns, elapsed, periods - 1)
        elif len(self._intervals) >= 5:
            before, gap = self._intervals[-3], self._intervals[-2]
            if gap > GAP * self._period and before + gap + elapsed > GAP_OF_THREE * self._period:
                self._add(last, gap, max(1, round(gap / self._period) - 1))
        while self._recent and stamp_ns - self._recent[0][0] > RECENT * NANOSECONDS:
            self._recent.popleft()
        return elapsed

    def _add(self, end_ns: int, gap: float, missing: int) -> None:
        if missing > 0:
            self.number += 1
            self.missing += missing
            self.longest = max(self.longest, gap)
            self._recent.append((end_ns, gap, missing))
        elif missing < 0 and self._recent:  # the message before was only late
            self.number -= 1
            self.missing -= self._recent.pop()[2]

    @property
    def rate(self) -> float:
        """Measured rate, Hz; 0 while it is unknown."""
        full = len(self._intervals) == self._intervals.maxlen
        return 1.0 / median(self._intervals) if full else 0.0

    @property
    def age(self) -> float:
        """Time since the end of the last gap, s; infinite without a recent one."""
        return self._since(self._recent[-1][0]) if self._recent else math.inf

    def warning(self, tolerated: float) -> str:
        """Return the gaps of the last 10 s if many messages are missing, or for so long (s)."""
        longest = max((gap for _, gap, _ in self._recent), default=0.0)
        share = self._missing_share()
        if longest <= tolerated and share <= MANY_MISSING:
            return ''
        clock = 'whether a clock was set, ' if longest > RECENT else ''
        return (
            f'odom had {len(self._recent)} gaps in the last {RECENT:g} s, the longest '
            f'{longest:.2g} s, the last {self.age:.1f} s ago: {share:.0%} of its messages '
            f'are missing; check {clock}the network, the processor of the robot, and the QoS'
        )

    def _missing_share(self) -> float:
        """Return which share of the messages of the last 10 s is missing: a gap may be older."""
        lost = 0.0
        for end_ns, gap, missing in self._recent:
            lost += missing * min(1.0, (RECENT - self._since(end_ns)) / gap)
        return lost * self._period / RECENT

    def _since(self, stamp_ns: int) -> float:
        return ((self._last_ns or stamp_ns) - stamp_ns) / NANOSECONDS


class OdometryMonitor:
    """Collects stamps of the odometry, and measured velocities with their commands.

    The results are for diagnostics only; they change no command. ``rate``: set rate, Hz.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self.gaps = Gaps(rate)
        self._offsets: deque[float] = deque(maxlen=max(5, round(rate)))
        self._typical, self._since_median = 0.0, 0
        """Median of them, and messages since it was computed."""
        self.late = 0  # messages that took much longer than the others
        self.jumps = 0  # changes of the pose that no motion explains
        self._jumps_ns: deque[int] = deque(maxlen=1000)  # stamps of those in the last 10 s
        self._jump = 0.0, 0.0  # distance (m) and turn (rad) of the last one
        self._last: State | None = None
        self._standing = 0.0
        self._follows = False
        self._responses = [ResponseGain(scale) for scale in SCALES]
        self._power = [0.0, 0.0]
        self._product = [0.0, 0.0]

    def update(
        self,
        odometry: State,
        now_ns: int,
        command: BodyTwist | None,
        *,
        following: bool = True,
        periods: int | None = None,
    ) -> None:
        """Add one odometry message and the command before it; None after a standstill command.

        ``following``: whether the robot follows commands, as far as is known; ``periods`` since
        the message before, where stamps jitter.
        """
        elapsed = self.gaps.update(odometry.stamp_ns, periods)
        offset = (now_ns - odometry.stamp_ns) / NANOSECONDS
        self.late += len(self._offsets) > 5 and offset > self._typical + LATE
        self._offsets.append(offset)
        self._since_median += 1
        if self._since_median == MEDIAN_EVERY:
            self._typical, self._since_median = median(self._offsets), 0
        if not odometry.is_finite():
            self._interrupt()
            return
        if elapsed is not None and self._last is not None:
            self._add_jump(self._last, odometry)
        self._last = odometry
        self._follows = False
        if command is None or elapsed is None:
            self._interrupt()
            return
        for i, (given, found) in enumerate(zip(command, odometry.twist, strict=True)):
            self._power[i] = SIGN_MEMORY * self._power[i] + given * given
            self._product[i] = SIGN_MEMORY * self._product[i] + given * found
        self._watch_standstill(elapsed, command, odometry.twist)
        self._follows = following and self._standing <= STANDING_TIME
        if not self._follows:
            self._interrupt()
            return
        for response, given, found in zip(self._responses, command, odometry.twist, strict=True):
            response.update(elapsed, given, found)

    def _add_jump(self, last: State, new: State) -> None:
        if has_jumped(last, new):
            self.jumps += 1
            self._jumps_ns.append(new.stamp_ns)
            self._jump = difference(last.pose, new.pose)
        while self._jumps_ns and new.stamp_ns - self._jumps_ns[0] > RECENT * NANOSECONDS:
            self._jumps_ns.popleft()

    def _interrupt(self) -> None:
        for response in self._responses:
            response.interrupt()

    def _watch_standstill(self, elapsed: float, command: BodyTwist, measured: BodyTwist) -> None:
        found = max(abs(value) / scale for value, scale in zip(measured, SCALES, strict=True))
        given = max(abs(value) / scale for value, scale in zip(command, SCALES, strict=True))
        if found > STANDING or given < 3.0 * STANDING:
            self._standing = 0.0
        else:
            self._standing += elapsed

    @property
    def offset(self) -> float:
        """Median time by which the stamps are behind the node's clock, s."""
        return median(self._offsets) if self._offsets else 0.0

    def gain(self, axis: int) -> Gain | None:
        """Return the gain of the linear (0) or angular (1) velocity, None while unknown."""
        return self._responses[axis].gain()

    def warnings(
        self,
        *,
        simulated_time: bool,
        tolerated_gap: float,
        geometry: WheelGeometry,
        response_time: float | None = None,
    ) -> list[str]:
        """Return what does not fit, with the likely cause.

        ``tolerated_gap`` (s) is not reported; ``geometry`` is what the robot is assumed to have;
        ``response_time``: most time from a command to its effect in a message, s, None: unknown.
        """
        found = []
        offset = self.offset
        late, early = (
            (MAX_SIMULATED_OFFSET, MAX_SIMULATED_OFFSET)
            if simulated_time
            else (MAX_DELAY, MAX_LEAD)
        )
        if not -early <= offset <= late:
            side = 'behind' if offset > 0.0 else 'ahead of'
            remedy = 'synchronise the clocks, or set use_sim_time alike'
            if offset > NO_STAMP:
                remedy = 'its driver sets no header.stamp, or use_sim_time differs'
            found.append(
                f'odom is stamped {abs(offset):.3g} s {side} the clock of this node: {remedy}'
            )
        elif (
            not simulated_time
            and response_time is not None
            and offset > response_time + MAX_AGE_BEYOND_RESPONSE
        ):
            found.append(
                f'odom is stamped {offset:.3g} s behind the clock of this node, but shows the '
                f'response of the robot within {response_time:.3g} s of a command: synchronise '
                'the clocks'
            )
        rate = self.gaps.rate
        if rate and abs(rate / self._rate - 1.0) > RATE_TOLERANCE:
            found.append(f'odom has {rate:.3g} Hz, but rate is {self._rate:g} Hz')
        if gaps := self.gaps.warning(tolerated_gap):
            found.append(gaps)
        if len(self._jumps_ns) >= MANY_JUMPS:
            found.append(
                f'the pose in odom has jumped {len(self._jumps_ns)} times in the last {RECENT:g} '
                f's, the last time by {self._jump[0]:.4g} m and {self._jump[1]:.3g} rad: look for '
                'a second publisher, other units than metres and radians, a localisation that '
                'alternates between two places'
            )
        opposite = [
            power > SIGN_EXCITATION * scale**2 and product < OPPOSITE * power
            for power, product, scale in zip(self._power, self._product, SCALES, strict=True)
        ]
        for axis, name in enumerate(NAMES):
            if opposite[axis]:
                found.append(
                    f'the {name} velocity in odom has the opposite sign of the command: check the '
                    'wiring and the sides of motors and encoders'
                )
        if not any(opposite) and self._follows:
            found += self._gain_warnings(geometry)
        return found

    def _gain_warnings(self, geometry: WheelGeometry) -> list[str]:
        gains = [self.gain(axis) for axis in (0, 1)]
        linear, angular = gains
        both = _common(linear, angular) if linear and angular else None
        if both is not None and _is_wrong(both):
            texts = [f'the velocities in odom are {_text(both)}']
            factors = both.value, 1.0
        else:
            wrong = [gain if gain is not None and _is_wrong(gain) else None for gain in gains]
            texts = [
                f'the {name} velocity in odom is {_text(gain)}'
                for name, gain in zip(NAMES, wrong, strict=True)
                if gain is not None
            ]
            # A wrong radius changes both, a wrong separation the angular velocity only.
            radius, turn = (1.0 if gain is None else gain.value for gain in wrong)
            factors = radius, radius / turn
        if not texts:
            return []
        text = ' and '.join(texts)
        if any(gain is not None and gain.falls and _is_wrong(gain) for gain in gains):
            return [f'{text}, less at high speed: the limits of the robot are below those here']
        own = geometry.wheel_radius, 2.0 * geometry.half_separation
        changes = [
            f'{name} from {value:.4g} to {factor * value:.4g} m'
            for name, value, factor in zip(GEOMETRY, own, factors, strict=True)
            if abs(factor - 1.0) > 0.005
        ]
        return [f'{text}: set {", ".join(changes)}, in the driver of the robot and here']


NAMES = 'linear', 'angular'
GEOMETRY = 'wheel_radius', 'wheel_separation'


def _is_wrong(gain: Gain) -> bool:
    deviation = abs(gain.value - 1.0)
    return deviation > max(GAIN_TOLERANCE, CERTAIN * gain.deviation)


def _common(linear: Gain, angular: Gain) -> Gain | None:
    """Return the gain of both velocities, as of a wrong radius, if that explains them best."""
    difference = abs(linear.value - angular.value)
    spread = CERTAIN * math.hypot(linear.deviation, angular.deviation)
    if difference > min(abs(linear.value - 1.0), max(GAIN_TOLERANCE, spread)):
        return None
    weights = [gain.deviation**-2.0 for gain in (linear, angular)]
    value = (weights[0] * linear.value + weights[1] * angular.value) / sum(weights)
    return Gain(value, sum(weights) ** -0.5, linear.falls or angular.falls)


def _text(gain: Gain) -> str:
    return f'{gain.value:.3f} (standard deviation {gain.deviation:.2g}) times the command'
