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
"""What is wrong with stamps and twist of the odometry, and what is used in their place."""

from collections import deque
from collections.abc import Sequence
import math
from statistics import median

import numpy as np

from t3mpc_ros.geometry.types import (
    JUMP,
    NANOSECONDS,
    STANDSTILL,
    UNKNOWN_TWIST,
    BodyTwist,
    Pose,
    State,
    has_moved,
    motion_between,
)

STAMP_SHARE = 0.05
"""Share by which a regular time follows each stamp: the mean of jitter over 0.4 s."""
STAMP_FIRST, STAMP_SETTLING, STAMP_GAP = 15, 60, 20.5
"""Intervals whose median is the first period, messages until the times are regular, and the
interval, in periods, from which they begin anew: any number of messages may be missing. So many
intervals of several periods in succession are those of another rate, too."""
STAMP_LATE = 0.3
"""Part of a period beyond half of it by which a stamp may be late before a message is missing."""
STAMP_MOTION, STAMP_ARM = 0.05, 0.1
"""Speed (m/s) from which the motion between two messages tells its duration, and the distance (m)
from the middle of the robot by which a turn counts."""
STAMP_MEMORY, STAMP_ROWS = 0.998, 100
"""Forgetting factor of a comparison (5 s at 100 Hz), and the number that is needed."""
JITTER, STAMPS_WORSE = 0.0004, (4.0, 2.0)
"""Jitter of the intervals (s, rms) that counts; how many times as far as the regular times stamps
must be from what the motion says (mean squares) to be replaced, and to stay it."""


def _duration(last: State, new: State) -> float:
    """Return the time which the motion between two messages took, ns; 0 where it says little."""
    if not (last.is_finite() and new.is_finite()):
        return 0.0
    speed = 0.5 * (last.twist.linear + new.twist.linear)
    arm_speed = 0.5 * STAMP_ARM * (last.twist.angular + new.twist.angular)
    square = speed**2 + arm_speed**2
    if not square > STAMP_MOTION**2:
        return 0.0
    ahead, _, turn = motion_between(last.pose, new.pose)
    return NANOSECONDS * (ahead * speed + STAMP_ARM * turn * arm_speed) / square


class StampFilter:
    """Regular times in place of stamps that jitter, where the motion of the robot says so.

    A message that is stamped when it is handled, not when it was measured, is some milliseconds
    late, each by another time. How far the pose went, at the speed of the twist, tells the true
    interval: that of a robot which measures at irregular times is that of its stamps.
    """

    def __init__(self) -> None:
        self.jitters = False
        """Whether the stamps are replaced."""
        self.jitter = 0.0  # root mean square of what is wrong with an interval, s
        self.periods: int | None = None
        """Periods since the message before; None where the stamps tell it, as they are used."""
        self._rows = self._stamps = self._times = self._apart = 0.0
        self._last: State | None = None
        self._origin_ns = self._returned = self._settling = self._longer = 0
        self._intervals: list[float] = []
        self._regular = self._period = 0.0
        """Regular time of the last message since the origin, and the interval, ns."""

    def time(self, odometry: State) -> int:
        """Return the time of an odometry, ns."""
        last, stamp = self._last, odometry.stamp_ns
        self._last, self.periods = odometry, None
        interval = 0.0 if last is None else float(stamp - last.stamp_ns)
        periods = (stamp - self._origin_ns - self._regular) / self._period if self._period else 1.0
        other = periods > STAMP_GAP or self._longer == STAMP_FIRST
        if last is None or interval <= 0.0 or other:
            self._longer = 0
            self._origin_ns = self._returned = stamp
            self._regular = self._period = 0.0
            self._intervals, self._settling = [], STAMP_SETTLING
            return stamp
        if not self._period:
            self._intervals.append(interval)
            self._returned, self._regular = stamp, float(stamp - self._origin_ns)
            if len(self._intervals) == STAMP_FIRST:
                self._period = median(self._intervals)
            return stamp
        took = _duration(last, odometry)
        number = round(took / self._period)
        if number < 1 or abs(number - periods) > 0.5 + STAMP_LATE:
            # Messages may be missing; one that is late is not.
            number = max(round(periods - STAMP_LATE), int(periods > STAMP_LATE))
        self._longer = self._longer + 1 if number > 1 else 0
        before = self._regular
        predicted = before + number * self._period
        error = stamp - self._origin_ns - predicted
        self._regular = predicted + STAMP_SHARE * error
        self._period += STAMP_SHARE**2 / (2.0 - STAMP_SHARE) * error
        self._settling -= 1
        if self._settling < 0 and took and number == 1:
            self._compare(took, interval, self._regular - before)
        if not self.jitters:
            self._returned = max(stamp, self._returned + 1)
            return self._returned
        self.periods = number
        time = self._origin_ns + round(self._regular)
        self._returned = max(time, self._returned + round(0.1 * self._period))
        return self._returned

    def _compare(self, took: float, by_stamps: float, by_times: float) -> None:
        """Compare both intervals with the time which the motion took, ns."""
        kept = STAMP_MEMORY
        self._rows = kept * self._rows + 1.0
        self._stamps = kept * self._stamps + (took - by_stamps) ** 2
        self._times = kept * self._times + (took - by_times) ** 2
        self._apart = kept * self._apart + (by_stamps - by_times) ** 2
        self.jitter = math.sqrt(self._apart / self._rows) / NANOSECONDS
        worse = self._stamps > STAMPS_WORSE[self.jitters] * self._times
        self.jitters = bool(worse and self.jitter > JITTER and self._rows > STAMP_ROWS)

    def problem(self) -> str:
        """Return what is wrong with the stamps, and the remedy; '' if nothing is."""
        if not self.jitters:
            return ''
        return (
            f'the stamps of odom jitter: their intervals are {1000.0 * self.jitter:.1f} ms (rms) '
            'off what its poses say, regular times are used in their place: stamp odom with the '
            'time of its measurement'
        )


MOVED, TURNED = 0.01, 0.05
"""Change of the pose (m, rad) with a twist of zero after which the odometry has no twist."""
FIT_FILTER, FIT_ROW, FIT_MEMORY = 0.1, 0.2, 10.0
"""Time constant of both stages of the filter of twist and pose, time between two comparisons, and
their memory, s."""
FIT_SETTLING, FIT_ROWS = 0.6, 8
"""Time after which the filter has forgotten an interruption (s); comparisons that are needed."""
REVERSED_ROWS, REVERSED = 3, 0.05
"""Comparisons after which a velocity of the other sign is one, and the part of their difference
(mean squares) that it may leave: one that is late by less than them leaves a third."""
FIT_GAP = 5.0
"""Interval between two messages, as a multiple of the one before the comparison, that is a gap."""
FIT_MOTION = 0.02, 0.1
"""Velocity by the pose (m/s, rad/s), either of them, of a robot that moves."""
FIT_SPIN, FIT_SPIN_BEYOND = 2.0, (0.05, 0.5)
"""Twist, as a multiple of the rate of the pose, and excess (m/s, rad/s) of wheels that spin."""
FIT_NOISE = 0.0005, 0.005  # least noise of a comparison, m/s and rad/s
FIT_PRIOR = (10.0, 0.1, 0.003), (10.0, 0.1, 0.05, 1.0)
"""Standard deviation before any comparison of factor less 1, lag (s) and offset of each velocity;
of the angular one also that of its share of the linear one, rad/m: wheels of unequal radii."""
FIT_VARIANCE = 2.0  # variance of a fit over that with independent comparisons
ALONE, OFFSETS = 1.5, 2.0
"""Square that a factor alone leaves, over that of the whole fit, up to which it is used; standard
deviations before any comparison up to which an offset that leaves no more is as likely."""
TWIST_CERTAIN, LATE_CERTAIN = 4.0, 4.0
"""Standard deviations of a deviation between twist and pose that counts."""
TWIST_TOLERANCE, OFFSET_TOLERANCE = 0.05, 0.004
"""Deviation of the factor of the linear velocity from 1, and its offset (m/s), that count."""
ANGULAR_FACTORS = 0.5, 2.0
"""Factors of the angular velocity beyond which no wheels, gyro or slip explain them."""
SHARE_TOLERANCE, TURN_CERTAIN = 0.1, 6.0
"""Share of the way in the angular velocity that is said, rad/m; standard deviations of a factor of
it: the noise of the wheels is in it, too."""
LATE, LATE_PERIODS = 0.005, 0.6
"""Time by which the linear velocity is behind the pose that counts: s, and share of the interval
of the messages, as the mean over two of them is half of it late."""
EARLY_STEP, EARLY_STEPS, EARLY_ROWS, EARLY = 0.1, 4, 4, 0.3
"""Delays with which the twist is compared, too (s, and their number); comparisons that are needed;
and square that one of them leaves, over that of none, from which the pose is late, not the twist
wrong: that of a camera or a filter."""
HISTORY = 401  # messages whose twist is kept for the delays, at the largest rate of 1000 Hz
LAG_EVIDENCE, ONE_EVIDENCE, FIRST_DRIVE = 2.0, 10.0, 2.0
"""Logarithm of the ratio of likelihoods from which the twist is late rather than the robot, or one
velocity alone, and time of driving (s) in which the comparisons for that must have come."""
REPEATS_SHARE, REPEATS_MEMORY, REPEATS_ROWS = 0.2, 0.98, 20
"""Share by which the usual number of repetitions of a twist follows each one, forgetting factor of
what is known of its changes, and how many must follow equal numbers of repetitions: 1 s at 20 Hz.
"""
REPEATS_ROUND, REPEATS_APART, REPEATS_BEHIND = 1.5, 0.35, -2.0
"""Least mean of the fourth power of a change over that of its square: a twist that is rounded has
1, noise 3; least square between pose and old twist over that of the change: noise has a half, a
motion that changes with the twist none; and standard deviations the pose may be behind it."""
UNLIKE, ROUGH = (0.1, 0.6), 0.3
"""Share of the velocity that factor, lag and offset do not explain from which they are no true
description of a twist that is certainly wrong, and from which it is wrong without them; the same
share of its changes from one message to the next."""
POSE_NOISE = 0.005, 0.05
"""Noise of differences of the pose (m/s, rad/s) which the twist may not undercut: it is that of
wheels with 0.04 (rad/s)²."""
SIDEWAYS = 0.2
"""Share of the way by which a pose may go aside: the cosine of such an angle is tolerable."""
OBEYED = 0.2
"""Square of the difference between twist and commands, over that between twist and pose, up to
which it is the pose that is wrong: it drifts."""
RADIUS_FACTORS, ASIDE = (0.8, 1.25), 0.1
"""Factors of the twist of wheels that obey and have another radius than is set, where the pose is
right; and the square by which a pose that drifts goes aside, over that of the difference."""
FAR, FAR_BEYOND, FAR_UNCHANGED = 5.0, (1.0, 5.0), 4.0
"""A twist (m/s, rad/s) contradicts the change of the pose from this multiple of it and this excess
on: 0.001 m/s in millimetres, 0.1 rad/s in degrees are found, wheels that slip are not. Where the
pose stays the same, the excess is so many times larger."""
UNITS_COUNT, UNITS_MOST, UNITS_MOTION = 10, 100, (0.02, 0.15)
"""Messages that contradict, more than others, from which the units are wrong; the most that
count; and the velocities by the pose (m/s, rad/s) of a message that counts as another one."""

UNITS_MEMORY, UNITS_NOISE = 0.95, (0.3, 1.5)
"""Forgetting factor of the noise of the twist, which is its change from one message to the next;
noise (m/s, rad/s; root mean square) that contradicts a pose which has a FAR-th of it: wheels that
spin have none, and at rest nothing else shows units."""


class VelocityFit:
    """What a velocity of the twist is beside the change of the pose, by least squares.

    twist = factor * rate - lag * change of the rate + offset + share * rate of the way
    """

    def __init__(self, prior: tuple[float, ...], least_noise: float) -> None:
        self._precision = np.array(prior) ** -2.0
        self._normal = np.zeros((len(prior), len(prior)))
        self._product = np.zeros(len(prior))
        self._square = 0.0
        self.difference = 0.0  # sum of the squared differences of twist and rate
        self._least = least_noise**2
        self.unexplained = least_noise**2  # mean square of what the fit does not explain
        self._rough = [0.0, 0.0]
        self.rows = 0.0
        self.values = [1.0] + [0.0] * (len(prior) - 1)
        """Factor, lag (s), offset, share."""
        self.deviations = [math.inf] * len(prior)

    def add(self, row: list[float], twist: float, rough: list[float]) -> None:
        """Add a comparison; ``rough``: squared noise of twist and rate of the pose."""
        kept, each = 1.0 - FIT_ROW / FIT_MEMORY, np.array(row)
        self.rows = kept * self.rows + 1.0
        self._normal = kept * self._normal + each[:, np.newaxis] * each
        self._product = kept * self._product + twist * each
        self._square = kept * self._square + twist**2
        self.difference = kept * self.difference + (twist - row[0]) ** 2
        self._rough = [kept * old + new for old, new in zip(self._rough, rough, strict=True)]
        if self.rows < FIT_ROWS:
            if self.is_reversed:
                self.values[0], self.deviations[0] = -1.0, 0.0
            return
        # It is 1 times the rate where nothing is known.
        rest = self._product - self._normal[:, 0]
        inverse = np.linalg.inv(self._normal + np.diag(self.unexplained * self._precision))
        values = inverse @ rest
        square = self.difference - 2.0 * values @ rest + values @ self._normal @ values
        self.unexplained = max(float(square) / (self.rows - values.size), self._least)
        self.deviations = np.sqrt(FIT_VARIANCE * self.unexplained * inverse.diagonal()).tolist()
        values[0] += 1.0
        self.values = values.tolist()
        # A factor alone is known much better, where it explains the twist as well.
        motion, product = float(self._normal[0, 0]), float(self._product[0])
        if not motion:
            return
        rest_alone = (self._square - product**2 / motion) / (self.rows - 1.0)
        if rest_alone < ALONE * self.unexplained and not self._is_offset:
            self.values[0] = product / motion
            self.deviations[0] = math.sqrt(FIT_VARIANCE * max(rest_alone, self._least) / motion)

    def evidence_of_lag(self, time: float) -> float:
        """Return the log likelihood ratio of a twist late by a time (s) to one that fits."""
        square = float(self._normal[1, 1])
        product = float(self._product[1] - self._normal[0, 1])
        return time * (product - 0.5 * time * square) / (FIT_VARIANCE * self.unexplained)

    @property
    def left_by_factor(self) -> float:
        """Sum of the squares of the rate that a factor of the twist leaves."""
        left = self._normal[0, 0] - self._product[0] ** 2 / max(self._square, 1e-12)
        return float(left)

    @property
    def _is_offset(self) -> bool:
        """Whether an offset alone, as that of a gyro, explains the twist as well."""
        offset = float(self._product[2] - self._normal[0, 2]) / self.rows
        rest = (self.difference - self.rows * offset**2) / (self.rows - 1.0)
        return (
            abs(offset) < OFFSETS * self._precision[2] ** -0.5 and rest < ALONE * self.unexplained
        )

    def is_certain(self, index: int, times: float) -> bool:
        """Whether a value is not the one of a twist that fits."""
        return abs(self.values[index] - (index == 0)) > times * self.deviations[index]

    @property
    def is_reversed(self) -> bool:
        """Whether the twist is the negative of the rate of the pose, from few comparisons."""
        left = self.difference + 4.0 * float(self._product[0])
        return round(self.rows) >= REVERSED_ROWS and left < REVERSED * self.difference

    @property
    def motion(self) -> float:
        """Mean square of the rate of the pose."""
        return float(self._normal[0, 0]) / max(self.rows, 1.0)

    @property
    def roughness(self) -> float:
        """Mean square of the noise of the twist."""
        return self._rough[0] / max(self.rows, 1.0)

    def prefers_pose(self, least: float) -> bool:
        """Whether the noise of the rate of the pose is less than what is wrong with the twist."""
        twist, pose = self._rough
        return pose < twist + self.difference + self.rows * least**2


class HeldTwist:
    """Whether the twist is that of a slower stream: messages repeat it to the last digit.

    So they do on a robot at constant speed, or whose twist is rounded; then its changes are small
    beside those of the pose, or all the same, or come at any time.
    """

    def __init__(self) -> None:
        self.repeats = 0.0  # usual number of repetitions
        self._repeats = self._regular = 0
        self._sums = [[0.0] * 6 for _ in range(2)]

    def update(self, last: list[float], new: list[float]) -> None:
        """Add a message: velocities (m/s, rad/s) by the pose, and by the twist."""
        if new[2:4] == last[2:4]:
            self._repeats += 1
            return
        repeats, self._repeats = self._repeats, 0
        if not repeats and not self._regular:
            return
        usual = abs(repeats - self.repeats) <= 1.0
        self._regular = self._regular + 1 if usual else self._regular // 2
        self.repeats += REPEATS_SHARE * (repeats - self.repeats)
        for i, sums in enumerate(self._sums):
            change = new[i + 2] - last[i + 2]
            ahead = change * (new[i] + last[i] - new[i + 2] - last[i + 2])
            apart = last[i] - last[i + 2]
            each = 1.0, change**2, change**4, apart**2, ahead, ahead**2
            sums[:] = (REPEATS_MEMORY * old + add for old, add in zip(sums, each, strict=True))

    def is_late(self, interval: float) -> bool:
        """Whether it is late by what counts; ``interval``: that of the messages, s."""
        late = self.late(interval) > max(LATE, LATE_PERIODS * interval)
        return (late and self._regular >= REPEATS_ROWS) and any(
            rows * fourth > REPEATS_ROUND * square**2
            and apart > REPEATS_APART * square
            and ahead > REPEATS_BEHIND * math.sqrt(aheads)
            for rows, square, fourth, apart, ahead, aheads in self._sums
        )

    def late(self, interval: float) -> float:
        """Return the mean time by which it is late, s."""
        return 0.5 * self.repeats * interval


class TwistFit:
    """Whether the twist of the odometry is what the pose in the same messages says.

    Both come from the same robot at the same time. A factor of both velocities is a wrong radius
    or unit in its driver. Where only the yaw rates differ, gyro or separation of the wheels may be
    wrong, and nothing is decided unless they differ beyond that. Of two signals of which one is
    late the earlier one is right: neither can be of the future.
    """

    def __init__(self) -> None:
        self.factor = 1.0  # of both velocities, in use; 1 unless it is certainly another one
        self.wrong = ''
        """What is wrong with the twist otherwise; '' if nothing is."""
        self.uses_pose = [False, False]
        """Whether a velocity by the pose is the better one, to be used where something is."""
        self.pose_lateness = 0.0
        """Time after which the pose says what the twist has said, s; 0 if that is no better."""
        self.pose_is_behind = False
        """Whether the pose is later than the twist by less than such a delay."""
        self._late = [False, False]  # whether the velocities were at the last comparison
        self._fits = [
            VelocityFit(prior, noise) for prior, noise in zip(FIT_PRIOR, FIT_NOISE, strict=True)
        ]
        self._held = HeldTwist()
        self._shifted = [0.0] * (EARLY_STEPS + 1)
        """Squared differences of the pose from the twist, by delays of the twist, (m/s)²."""
        self._disobeyed = 0.0  # sum of the squared differences of twist and commands, (m/s)²
        self.pose_drifts = False  # whether twist and commands agree, and the pose with neither
        self.driven = 0.0  # time for which the twist has been that of a robot that moves, s
        self._aside = self._interval = 0.0
        self._age = 0.0  # driving time since something was wrong, s
        self.interrupt()

    def interrupt(self) -> None:
        """Forget the newest messages: some are missing."""
        self._stages: list[list[float]] = []
        """Of each velocity both stages of the filter, and their sums since the last comparison."""
        self._last: list[float] = []
        self._from: State | None = None
        self._history: deque[tuple[float, float]] = deque(maxlen=HISTORY)
        """Twists behind both stages of the filter."""
        self._held_for, self._held_way = 0.0, [0.0, 0.0]
        """Time for which the pose has been the same (s), and way by the twist since then."""

    def reject(self) -> None:
        """Take the twist for wrong, until enough comparisons say what is wrong with it."""
        self.wrong, self.factor, self._age = 'the robot follows its commands by', 1.0, 0.0
        self.uses_pose = [True, True]

    def update(
        self, new: State, motion: tuple[float, float, float], command: BodyTwist | None = None
    ) -> None:
        """Compare the twist of a message with the motion since the last one.

        ``command``: what the robot follows now, if it is one that does.
        """
        last, self._from = self._from, new
        if last is None:
            return
        elapsed = (new.stamp_ns - last.stamp_ns) / NANOSECONDS
        if self._held_for or new.pose == last.pose:
            way = [each * (elapsed - self._held_for) for each in new.twist]
            self._held_way = [held + each for held, each in zip(self._held_way, way, strict=True)]
        if new.pose == last.pose:  # the robot stands, or a camera holds it for a while
            self._from, self._held_for = last, elapsed
            if elapsed > FIT_SETTLING:
                self.interrupt()
            return
        # Coarse counters hold it as well: the twist is zero then, and double in other messages.
        twist: Sequence[float] = new.twist
        if self._held_for:
            twist = [each / elapsed for each in self._held_way]
            self._held_for, self._held_way = 0.0, [0.0, 0.0]
        if new.pose.yaw == last.pose.yaw and abs(new.twist.angular) > FIT_MOTION[1]:
            self.interrupt()  # a yaw that is frozen, or coarse, says nothing of the way either
            return
        ahead, left, turn = motion
        asked = ahead / elapsed if command is None else command.linear
        given = [ahead / elapsed, turn / elapsed, *twist, left / elapsed, asked]
        if self._is_gap(given, elapsed):
            self.interrupt()
            return
        if not self._stages:
            self._stages, self._last = [[each, each, 0.0, 0.0] for each in given], given
            self._time = 0.0
            self._begin_row()
            return
        self._filter(given, elapsed)
        rough, last_given = self._rough, self._last
        for i in range(len(rough)):
            rough[i] += 0.5 * (given[i] - last_given[i]) ** 2
        self._held.update(self._last, given)
        self._last = given
        self._time += elapsed
        self._since += elapsed
        self._count += 1
        if self._since < FIT_ROW:
            return
        self._interval = self._since / self._count
        if self._time > FIT_SETTLING:
            self._add_row()
        self._begin_row()
        self.pose_is_behind = self._is_behind()

    def _is_gap(self, given: list[float], elapsed: float) -> bool:
        """Whether a pose was set or messages are missing, by velocities of pose and twist."""
        apart, turned = abs(given[0] - given[2]), abs(given[1] - given[3])
        return (
            elapsed > FIT_GAP * (self._interval or elapsed)
            or apart > FAR_BEYOND[0]
            or turned > FAR_BEYOND[1]
            or apart * elapsed > JUMP[0]
            or turned * elapsed > JUMP[1]
        )

    def _filter(self, given: list[float], elapsed: float) -> None:
        """Pass the velocities through both stages of the filter."""
        share = -math.expm1(-elapsed / FIT_FILTER)
        for stages, each in zip(self._stages, given, strict=True):
            first, second, sum_first, sum_second = stages
            first += share * (each - first)
            second += share * (first - second)
            # Means: a pose that is updated with 10 Hz has a ripple in step with the comparisons.
            stages[:] = first, second, sum_first + elapsed * first, sum_second + elapsed * second
        self._history.append((self._stages[2][1], self._stages[3][1]))

    def _begin_row(self) -> None:
        self._since, self._count = 0.0, 0
        for stages in self._stages:
            stages[2:] = 0.0, 0.0
        self._rough = [0.0] * 4

    def _add_row(self) -> None:
        means = [[each / self._since for each in stages[2:]] for stages in self._stages]
        rates, twists = ([abs(each[1]) for each in part] for part in (means[:2], means[2:4]))
        if all(rates[i] < FIT_MOTION[i] for i in range(2)) or any(
            twists[i] > FIT_SPIN * rates[i] + FIT_SPIN_BEYOND[i] for i in range(2)
        ):  # It stands, or something holds it, and its wheels spin.
            return
        for i, fit in enumerate(self._fits):
            first, rate = means[i]
            row = [rate, (rate - first) / FIT_FILTER, 1.0, means[0][1]][: len(fit.values)]
            rough = [self._rough[i + 2] / self._count, self._rough[i] / self._count]
            fit.add(row, means[i + 2][1], rough)
        kept = 1.0 - FIT_ROW / FIT_MEMORY
        self._aside = kept * self._aside + means[4][1] ** 2
        self._disobeyed = kept * self._disobeyed + (means[2][1] - means[5][1]) ** 2
        self._shift(kept)
        self.pose_lateness = self._find_pose_lateness()
        self._age += FIT_ROW
        known = self._fits[0].rows >= FIT_ROWS or any(fit.is_reversed for fit in self._fits)
        if known or self._held.is_late(self._interval):
            self.uses_pose = [
                fit.prefers_pose(least) for fit, least in zip(self._fits, POSE_NOISE, strict=True)
            ]
            wrong, factor = self._find()
            if wrong or factor != 1.0 or self._age > FIT_MEMORY:
                self.wrong, self.factor, self._age = wrong, factor, 0.0
            if not any(self.uses_pose):
                self.wrong = ''

    def _shift(self, kept: float) -> None:
        """Compare the pose with the twist of earlier times."""
        step = round(EARLY_STEP / self._interval)
        if not 0 < step * EARLY_STEPS < len(self._history):
            return
        for i in range(EARLY_STEPS + 1):
            linear, angular = self._history[-1 - i * step]
            apart = self._stages[0][1] - linear, STAMP_ARM * (self._stages[1][1] - angular)
            self._shifted[i] = kept * self._shifted[i] + apart[0] ** 2 + apart[1] ** 2

    def _find_pose_lateness(self) -> float:
        least = min(self._shifted)
        known = round(self._fits[0].rows) >= EARLY_ROWS and least < EARLY * self._shifted[0]
        return EARLY_STEP * self._shifted.index(least) if known else 0.0

    @property
    def is_compared(self) -> bool:
        """Whether there are enough comparisons for a fit."""
        return all(fit.rows >= FIT_ROWS for fit in self._fits)

    def _is_behind(self) -> bool:
        least = max(LATE, LATE_PERIODS * self._interval)
        return any(
            fit.values[1] < -least and fit.is_certain(1, LATE_CERTAIN) for fit in self._fits
        )

    @property
    def pose_is_scaled(self) -> bool:
        """Whether factors of the twist explain it nearly as well as a late pose.

        While a robot gets faster, what it will do is what it does, times a factor.
        """
        linear, angular = (fit.left_by_factor for fit in self._fits)
        return EARLY * (linear + STAMP_ARM**2 * angular) < min(self._shifted)

    def may_be_late(self, time: float) -> bool:
        """Whether the twist is more likely late by ``time`` (s) than not at all."""
        if round(self._fits[0].rows) < REVERSED_ROWS:
            return self.driven < FIRST_DRIVE
        both = [fit.evidence_of_lag(time) for fit in self._fits]
        return sum(both) > LAG_EVIDENCE or max(both) > ONE_EVIDENCE

    def may_turn_late(self, time: float) -> bool:
        """Whether the comparisons leave it open that the yaw rate is late by ``time``, s."""
        return self._fits[1].evidence_of_lag(time) > -ONE_EVIDENCE

    def _find(self) -> tuple[str, float]:
        """Return what is wrong with the twist, or the factor of both velocities."""
        self.pose_drifts = False
        if self.pose_lateness:
            return '', 1.0
        late, turns_late = self._find_late()
        wrong, common = self._find_linear(late=late)
        wrong = wrong or self._find_angular(late=turns_late)
        if wrong and any(self.uses_pose):
            return wrong, 1.0
        return '', common

    def _find_late(self) -> list[bool]:
        """Return whether each velocity is late, as at the comparison before."""
        behind = [
            fit.values[1] > max(LATE, LATE_PERIODS * self._interval)
            and fit.is_certain(1, LATE_CERTAIN)
            for fit in self._fits
        ]
        # Twice: of many decisions one may be wrong.
        late = [each and before for each, before in zip(behind, self._late, strict=True)]
        self._late = behind
        return late

    def _find_linear(self, *, late: bool) -> tuple[str, float]:
        """Return what is wrong with the linear velocity, or the factor it has in common."""
        linear, interval = self._fits[0], self._interval
        factor, lag, offset = linear.values
        way = max(linear.motion, FIT_MOTION[0] ** 2)
        scaled = abs(factor - 1.0) > TWIST_TOLERANCE and linear.is_certain(0, TWIST_CERTAIN)
        shifted = abs(offset) > OFFSET_TOLERANCE and linear.is_certain(2, TWIST_CERTAIN)
        follows = linear.unexplained < UNLIKE[0] ** 2 * way and linear.roughness < ROUGH**2 * way
        wrong, common = '', 1.0
        self.pose_drifts = (
            (scaled or shifted or late or not follows)
            and self._disobeyed < OBEYED * linear.difference
            and not (scaled and follows and not (shifted or late) and self._is_radius(factor))
        )
        if self._held.is_late(interval):
            mean = self._held.late(interval)
            held = 2.0 * mean + interval
            wrong = f'its velocities are held for {held:.2g} s, {mean:.3f} s behind'
        # After the yaw was set, the robot goes aside by its pose, and its way ahead is shorter.
        elif self._aside > SIDEWAYS**2 * linear.rows * linear.motion or self.pose_drifts:
            pass
        elif linear.unexplained > UNLIKE[1] ** 2 * way or (
            not follows and (scaled or shifted or late)
        ):
            wrong = 'its linear velocity does not follow'
        elif late:
            wrong = f'its linear velocity is {lag:.3f} s behind'
        elif shifted:
            wrong = f'its linear velocity is {offset:+.3f} m/s off'
        elif scaled and factor > 0.0 and self._is_common(factor):
            common = factor
        elif scaled:
            wrong = f'its linear velocity is {factor:.3f} times'
        return wrong, common

    def _find_angular(self, *, late: bool) -> str:
        """Return what is wrong with the angular velocity; '' if nothing is."""
        angular, (least, most) = self._fits[1], ANGULAR_FACTORS
        turns = angular.values[0]
        if late:
            return f'its angular velocity is {angular.values[1]:.3f} s behind'
        if not least < turns < most and angular.is_certain(0, TWIST_CERTAIN):
            return f'its angular velocity is {turns:.3f} times'
        return ''

    def turn_difference(self) -> str:
        """Return by what the angular velocity certainly differs from the change of the yaw."""
        turn = self._fits[1]
        if not self.is_compared or self.pose_lateness or self.pose_is_behind:
            return ''
        found = []
        if abs(turn.values[0] - 1.0) > TWIST_TOLERANCE and turn.is_certain(0, TURN_CERTAIN):
            found.append(f'is {turn.values[0]:.2f} times the change of its yaw')
        if abs(turn.values[3]) > SHARE_TOLERANCE and turn.is_certain(3, TWIST_CERTAIN):
            found.append(f'has {turn.values[3]:+.2f} rad per metre of the way beyond its yaw')
        return ' and '.join(found)

    def _is_radius(self, factor: float) -> bool:
        """Whether a factor may be that of wheels of another radius: they do not go aside."""
        least, most = RADIUS_FACTORS
        return least < factor < most and self._aside < ASIDE * self._fits[0].difference

    def _is_common(self, factor: float) -> bool:
        """Whether the angular velocity has the factor of the linear one, as far as is known."""
        linear, angular = self._fits
        half, uncertain = 0.5 * abs(factor - 1.0), TWIST_CERTAIN * angular.deviations[0]
        known = uncertain < half or self.factor != 1.0 or not self.uses_pose[0]
        return known and abs(angular.values[0] - factor) < half + uncertain


class TwistUnits:
    """Whether the twist of the odometry is far beyond the change of its pose, in either velocity.

    So it is in degrees or millimetres per second. It is found while the robot moves, however
    little, or at rest by its noise, before the robot is taken to diverge.
    """

    def __init__(self) -> None:
        self.wrong = False
        self.example = ''
        """Twist and change of the pose in a message in which they contradict each other."""
        self._counts = [0, 0]
        self._before: list[tuple[float, float] | None] = [None, None]
        self._sums = [(0.0, 0.0, 0.0)] * 2
        """Of each velocity: number of changes, squared noise of the twist, and of the pose."""

    def update(self, last: State, new: State, motion: tuple[float, float, float]) -> None:
        """Compare the twist of a message with the motion since the last one."""
        # That of a camera which is slower than the wheels stays the same for a while.
        times = FAR_UNCHANGED if new.pose == last.pose else 1.0
        elapsed = (new.stamp_ns - last.stamp_ns) / NANOSECONDS
        rates = motion[0] / elapsed, motion[2] / elapsed
        for i, (given, rate) in enumerate(zip(new.twist, rates, strict=True)):
            far = abs(given) > FAR * abs(rate) + times * FAR_BEYOND[i]
            if self._is_noisy(i, given, rate) or far:
                self._counts[i] = min(self._counts[i] + 1, UNITS_MOST)
                self.example = (
                    f'{new.twist.linear:.3g} m/s and {new.twist.angular:.3g} rad/s, where its '
                    f'pose says {rates[0]:.3g} and {rates[1]:.3g}'
                )
            elif abs(rate) > UNITS_MOTION[i]:  # degrees are nothing on a robot that goes straight
                self._counts[i] = max(self._counts[i] - 1, 0)
        most = max(self._counts)
        self.wrong = most >= UNITS_COUNT or (self.wrong and most > 0)

    def _is_noisy(self, i: int, given: float, rate: float) -> bool:
        """Whether a velocity of the twist has far more noise than the pose, and than any robot."""
        count, of_twist, of_pose = self._sums[i]
        before = self._before[i] or (given, rate)
        self._before[i] = given, rate
        count = UNITS_MEMORY * count + 1.0
        of_twist = UNITS_MEMORY * of_twist + 0.5 * (given - before[0]) ** 2
        of_pose = UNITS_MEMORY * of_pose + 0.5 * (rate - before[1]) ** 2
        self._sums[i] = count, of_twist, of_pose
        return of_twist > max(UNITS_NOISE[i] ** 2 * count, FAR**2 * of_pose)


HELD_MOST, HELD_MEMORY = 0.25, 0.97
"""Longest time for which a robot that drives may have one pose (s); share of the longest time of
late that is kept with each other pose."""
BLANKS, BLANK_TIME, BLANKS_MEMORY = 3, 0.1, 5.0
"""Gaps in the twist after which they are filled; the longest that is one, and the time after which
they are forgotten, s."""
BLANK_MOTION = 0.5
"""Share of the way by the twist before a gap that the pose must go in it: it repeats the old pose
where wheels with coarse counters have not moved."""


class TwistBlanks:
    """Messages without a twist among others: it is zero, and the pose moves on as before."""

    def __init__(self) -> None:
        self._count, self._counted_ns = 0, 0
        self._last: State | None = None
        """Last message with a twist."""
        self._blank: State | None = None
        """Last message without, since then."""

    def interrupt(self) -> None:
        """Forget the last messages."""
        self._last = self._blank = None

    @property
    def known(self) -> bool:
        """Whether there are some."""
        return self._count >= BLANKS

    def has(self, odometry: State) -> bool:
        """Whether a message is one of them."""
        last, blank = self._last, self._blank
        if odometry.twist == STANDSTILL:
            self._blank = odometry
            return self.known and last is not None and _goes_on(last, odometry, last.twist)
        if last is not None and blank is not None and _goes_on(last, blank, odometry.twist):
            self._count = min(self._count + 1, BLANKS)
            self._counted_ns = odometry.stamp_ns
        elif odometry.stamp_ns - self._counted_ns > BLANKS_MEMORY * NANOSECONDS:
            self._count = 0
        self._last, self._blank = odometry, None
        return False


def _goes_on(last: State, blank: State, twist: BodyTwist) -> bool:
    """Whether the pose goes on as by the twist of the last message and a like one."""
    seconds = (blank.stamp_ns - last.stamp_ns) / NANOSECONDS
    ahead, _, turn = motion_between(last.pose, blank.pose)
    return 0.0 < seconds <= BLANK_TIME and any(
        before * after > least**2 and way / before > BLANK_MOTION * seconds
        for way, before, after, least in zip(
            (ahead, turn), last.twist, twist, FIT_MOTION, strict=True
        )
    )


LATENESS_SHARE = 0.1  # share by which the lateness of the speeds follows each new pose


class PoseSpeeds:
    """Speeds by the pose, that of a camera for example, which stays the same in some messages."""

    def __init__(self) -> None:
        self.held = 0.0  # longest time of late for which the pose stayed the same, s
        self.lateness = 0.0
        """Time by which the speeds are later than those of a pose that is new each time, s."""
        self.holds = False  # whether it is so as a rule
        self._from: State | None = None
        self.speeds = STANDSTILL

    def update(
        self, new: State, elapsed: float | None, motion: tuple[float, float, float] | None
    ) -> BodyTwist:
        """Return the speeds, by time (s) and motion since the last message; None for the first."""
        last = self._from
        if elapsed is None or motion is None or last is None:
            self._from, self.speeds = new, STANDSTILL
            return STANDSTILL
        time = (new.stamp_ns - last.stamp_ns) / NANOSECONDS
        # Not at single messages: a robot that creeps in steps of its pose has moved meanwhile.
        self.holds = self.lateness > 0.5 * elapsed
        if new.pose == last.pose:
            if not self.holds or time > self.held - 0.5 * elapsed:
                self.speeds = STANDSTILL
            return self.speeds
        if time < HELD_MOST:
            self.held = max(HELD_MEMORY * self.held, time)
            self.lateness += LATENESS_SHARE * (time - elapsed - self.lateness)
        else:  # it stood
            time = self.held
        if not self.holds:
            time = elapsed
        ahead, _, turn = motion
        self._from, self.speeds = new, BodyTwist(ahead / time, turn / time)
        return self.speeds


class OdometryTwist:
    """The twist of the odometry, or what the change of its pose says where it cannot be right.

    Some robots publish a pose only. Their twist of zero would be a robot that does not follow.
    """

    def __init__(self) -> None:
        self.missing = False
        """Whether the odometry has no twist: speeds are differences of its pose."""
        self.known = False  # whether it ever had one
        self._fit = TwistFit()
        self._by_pose = PoseSpeeds()
        self._units = TwistUnits()
        self._blanks = TwistBlanks()
        self._anchor: Pose | None = None
        """Pose of the first message with a twist of zero since the last other one."""
        self._last: State | None = None

    @property
    def replaced(self) -> bool:
        """Whether the twist that is used is not the one that was received."""
        fit = self._fit
        if fit.wrong or fit.factor != 1.0:
            return True
        return self.missing or self._units.wrong or self._blanks.known

    @property
    def speeds_by_pose(self) -> BodyTwist:
        """Speeds by the change of the pose since the last message, m/s and rad/s."""
        return self._by_pose.speeds

    @property
    def pose_is_late(self) -> bool:
        """Whether the pose is that of an earlier time than the twist."""
        return self._fit.pose_lateness > 0.0

    @property
    def pose_is_prompt(self) -> bool:
        """Whether the pose is new in each message, of its time and right, as far as is known."""
        fit = self._fit
        late = self._by_pose.holds or self.pose_is_late or fit.pose_is_behind
        return not (late or fit.pose_drifts)

    @property
    def pose_is_proven(self) -> bool:
        """Whether enough comparisons with the twist say that the pose is prompt."""
        return self.pose_is_prompt and self._fit.is_compared

    def may_be_late(self, time: float) -> bool:
        """Whether a twist that is used is more likely late by ``time`` (s) than not at all."""
        return not self.replaced and self._fit.may_be_late(time)

    def may_turn_late(self, time: float) -> bool:
        """Whether the yaw rate that is used may be late by ``time`` (s), or early if negative."""
        return not self.replaced and self._fit.may_turn_late(time)

    def reject(self) -> None:
        """Use the pose: by it the robot follows its commands, by the twist it does not."""
        self._fit.reject()

    @property
    def lateness(self) -> float:
        """Time by which speeds by a held pose are late, s."""
        replaced = self.missing or self._units.wrong
        return self._by_pose.lateness if replaced and self._by_pose.holds else 0.0

    def problem(self) -> str:
        """Return what is wrong with the twist, and the remedy; '' if nothing is."""
        if self.missing:
            by_pose = self._by_pose
            held = f', each of which lasts for {by_pose.held:.2g} s' if by_pose.holds else ''
            return f'odom has no twist: its poses are differentiated{held}; publish the twist'
        if self._units.wrong:
            return (
                f'the twist in odom cannot be in m/s and rad/s: {self._units.example}; its poses '
                'are differentiated: correct the units in the driver of the robot, or see why its '
                'wheels spin'
            )
        if self._blanks.known:
            return (
                'odom has no twist in some of its messages, while its pose moves: the change '
                'of the pose is used in its place, publish the twist in each message'
            )
        if self._fit.wrong:
            return (
                f'the twist in odom is wrong: {self._fit.wrong} the change of its pose, which is '
                'used in its place: correct the velocities in the driver of the robot, or see why '
                'its wheels spin'
            )
        late = self._fit.pose_lateness
        if late and not self._fit.pose_is_scaled:
            return (
                f'the pose in odom says {late:.1f} s later what its twist says, no turn is '
                'corrected by it: stamp the pose with the time of its measurement'
            )
        if self._fit.pose_drifts:
            return (
                'the pose in odom moves otherwise than its twist and the commands, which agree: '
                'the twist is used; see whether the localisation or camera of the pose drifts, or '
                'whether something carries the robot'
            )
        if self._fit.factor == 1.0:
            return ''
        return (
            f'the twist in odom is {self._fit.factor:.3f} times the change of its pose, it is '
            'divided by that: correct radius or units of the wheels in the driver of the robot'
        )

    def turn_problem(self) -> str:
        """Return by what an angular velocity that is used differs from the pose, and the remedy.

        Gyro or wheels may be wrong: which of them, their stated deviations decide.
        """
        turn = '' if self.replaced else self._fit.turn_difference()
        return turn and (
            f'the angular velocity in odom {turn}: correct separation or radii of the wheels in '
            'the driver of the robot, or calibrate its gyro'
        )

    def measured(
        self, odometry: State, *, restart: bool, command: BodyTwist | None = None
    ) -> State:
        """Return an odometry with its twist; a ``restart`` follows no message before it.

        ``command``: the one that the robot follows now, None where it follows none.
        """
        if not odometry.is_finite():
            return odometry
        last, self._last = self._last, odometry
        if last is None or restart or odometry.stamp_ns <= last.stamp_ns:
            last = None
            self._blanks.interrupt()
        motion = None if last is None else motion_between(last.pose, odometry.pose)
        elapsed = None if last is None else (odometry.stamp_ns - last.stamp_ns) / NANOSECONDS
        by_pose = self._by_pose.update(odometry, elapsed, motion)
        if (self._blanks.has(odometry) or self._blanks.known) and last is not None:
            odometry = odometry._replace(twist=BodyTwist(*by_pose))
        if odometry.twist != (0.0, 0.0):
            self._add_twist(last, odometry, motion)
        else:
            self._add_zero(last, odometry)
        if last is None or motion is None or self.missing or self._units.wrong:
            self._fit.interrupt()
        elif self.known:
            self._fit.update(odometry, motion, command)
        return self._repaired(odometry, None if last is None else by_pose)

    def _add_twist(
        self, last: State | None, new: State, motion: tuple[float, float, float] | None
    ) -> None:
        """Note that the odometry has a twist, and for how long it moves; check its units."""
        self.missing, self._anchor, self.known = False, None, True
        if last is None or motion is None:
            return
        elapsed = (new.stamp_ns - last.stamp_ns) / NANOSECONDS
        moves = any(abs(v) > least for v, least in zip(new.twist, FIT_MOTION, strict=True))
        self._fit.driven += moves * elapsed
        self._units.update(last, new, motion)

    def _add_zero(self, last: State | None, new: State) -> None:
        """Decide by the motion of the pose with a twist of zero whether the twist is missing."""
        if last is None or self._anchor is None:
            self._anchor = new.pose
        else:
            elapsed = (new.stamp_ns - last.stamp_ns) / NANOSECONDS
            farthest = (2.0 * elapsed * speed for speed in UNKNOWN_TWIST)
            if has_moved(last.pose, new.pose, *farthest):  # it cannot have driven so far
                # That of the next message: this one may be the only one so far off.
                self._anchor = None
        if self._anchor is not None and not self.pose_is_late:
            self.missing = self.missing or has_moved(self._anchor, new.pose, MOVED, TURNED)

    def _repaired(self, odometry: State, by_pose: BodyTwist | None) -> State:
        """Return an odometry with the twist to use; ``by_pose``: None after a restart."""
        if not self.replaced:
            return odometry
        replaces = [self.missing or self._units.wrong] * 2
        if not any(replaces) and self._fit.wrong:
            replaces = self._fit.uses_pose
        if any(replaces):
            if by_pose is None:  # the pose says nothing of the speed: a restart
                return odometry._replace(twist=STANDSTILL)
            used = zip(replaces, by_pose, odometry.twist, strict=True)
            return odometry._replace(
                twist=BodyTwist(*(speed if by_it else given for by_it, speed, given in used))
            )
        factor = self._fit.factor
        if factor == 1.0:
            return odometry
        linear, angular = odometry.twist
        return odometry._replace(twist=BodyTwist(linear / factor, angular / factor))
