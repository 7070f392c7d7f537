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
"""Plausibility of odometry: clock, rate, gaps, jumps, gain and sign of the response."""

import math
import re

import numpy as np
import pytest
from support.long_tests import few_of

from t3mpc_ros.control.odometry_monitor import MANY_JUMPS, RECENT, Gaps, OdometryMonitor
from t3mpc_ros.control.odometry_repair import StampFilter
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import (
    NANOSECONDS,
    ORIGIN,
    STANDSTILL,
    BodyTwist,
    Pose,
    State,
    has_jumped,
)

GEOMETRY = WheelGeometry(wheel_radius=0.05, wheel_separation=0.3)


class Drive:
    """A robot with dead time, lag, gains and noise, and a monitor of its odometry."""

    def __init__(self, rate=100.0, seed=1, gains=(1.0, 1.0), dead_time=0.03, lag=0.05, **more):
        self.monitor = OdometryMonitor(rate)
        self._random = np.random.default_rng(seed)
        self._gains, self._delay = gains, round(dead_time * 1000)
        self._period = round(1000 / more.pop('real_rate', rate))
        self._offset = more.pop('offset', 0.01)
        self.noise, self.limit, self.ticks = 0.0, math.inf, 0.0
        self.loss = self.jitter = 0.0
        vars(self).update(more)
        self._phases = self._random.uniform(0.0, 2.0 * math.pi, (2, 4))
        self._sent, self._time, self._last, self._command = [], 0, 0, None
        # Nothing happens between these instants, and the lag is exact for any step, ms.
        self._step = 1 if self.jitter else math.gcd(self._period, self._delay, 10)
        self._share = -math.expm1(-0.001 * self._step / lag)
        self.speed, self.pose = [0.0, 0.0], [0.0, 0.0, 0.0]
        self.stopped = self.silent = False

    def wanted(self, seconds):
        """Return the twist to command: four frequencies below 0.7 Hz, as a chaotic reference."""
        angles = 2.0 * math.pi * np.array([0.07, 0.19, 0.31, 0.55]) * seconds + self._phases
        linear, angular = np.sin(angles) @ [0.05, 0.06, 0.04, 0.02]
        return BodyTwist(float(linear), float(6.0 * angular))

    def run(self, seconds, **changes):
        """Drive for a time; return the warnings at its end."""
        vars(self).update(changes)
        seconds_of_step = 0.001 * self._step
        for _ in range(round(1000 * seconds / self._step)):
            self._time += self._step
            given = self._sent[0][1] if self._sent else (0.0, 0.0)
            while self._sent and self._sent[0][0] <= self._time - self._delay:
                given = self._sent.pop(0)[1]
                self._given = given
            given = getattr(self, '_given', (0.0, 0.0))
            for axis in (0, 1):
                goal = 0.0 if self.stopped else self._gains[axis] * given[axis]
                if self.ticks:
                    goal = math.trunc(goal / self.ticks) * self.ticks
                goal = max(-self.limit, min(self.limit, goal))
                self.speed[axis] += self._share * (goal - self.speed[axis])
            self.pose[2] += seconds_of_step * self.speed[1]
            self.pose[0] += seconds_of_step * self.speed[0] * math.cos(self.pose[2])
            self.pose[1] += seconds_of_step * self.speed[0] * math.sin(self.pose[2])
            spread = self.jitter * self._period
            due = self._time - self._last >= self._period + self._random.uniform(-spread, spread)
            if due:
                self._last = self._time
                if not self.silent and self._random.random() >= self.loss:
                    self._report()
        return self.warnings()

    def _report(self):
        noise = self.noise * self._random.standard_normal(2)
        twist = BodyTwist(*(np.array(self.speed) + noise * (1.0, 6.0)).tolist())
        stamp = self._time * 1_000_000
        now = stamp + round(self._offset * NANOSECONDS)
        self.monitor.update(State(stamp, Pose(*self.pose), twist), now, self._command)
        self._command = self.wanted(self._time / 1000.0)
        self._sent.append((self._time, self._command))

    def warnings(self, simulated=False):
        return self.monitor.warnings(
            simulated_time=simulated, tolerated_gap=0.1, geometry=GEOMETRY
        )


ROBOTS = [
    {},
    {'rate': 20.0, 'lag': 0.15, 'dead_time': 0.1},
    {'rate': 50.0, 'lag': 0.1, 'dead_time': 0.15, 'noise': 0.01},
    {'rate': 30.0, 'ticks': 0.01},
    {'rate': 200.0, 'lag': 0.02, 'dead_time': 0.005, 'noise': 0.02},
    {'rate': 50.0, 'jitter': 0.3, 'noise': 0.005},
    {'rate': 100.0, 'gains': (1.02, 0.98)},
]
"""Robots that fit, however slow, noisy or coarse."""


@pytest.mark.parametrize('robot', few_of(ROBOTS, step=4), ids=str)
@pytest.mark.parametrize('seed', few_of([1, 2]))
def test_a_robot_that_fits_gives_no_warning(robot, seed):
    drive = Drive(seed=seed, **robot)
    for _ in range(6):
        assert drive.run(10.0) == []
    for axis, true in enumerate(robot.get('gains', (1.0, 1.0))):
        gain = drive.monitor.gain(axis)
        assert abs(gain.value - true) < max(0.012, 4.0 * gain.deviation)


GEOMETRIES = [
    ((0.95, 0.95), {'wheel_radius': 0.0475}),
    ((1.05, 1.05), {'wheel_radius': 0.0525}),
    ((1.0, 0.95), {'wheel_separation': 0.3158}),
    ((1.0, 1.05), {'wheel_separation': 0.2857}),
    ((1.05, 1.0), {'wheel_radius': 0.0525, 'wheel_separation': 0.315}),
]
NOMINAL = [each for each in ROBOTS if 'gains' not in each]
EACH_ONCE = [
    *((NOMINAL[0], *geometry) for geometry in GEOMETRIES),
    *((robot, *geometry) for robot, geometry in zip(NOMINAL[1:], GEOMETRIES, strict=True)),
]
OTHERS = [(r, *g) for r in NOMINAL for g in GEOMETRIES if (r, *g) not in EACH_ONCE]


@pytest.mark.parametrize(('robot', 'gains', 'values'), few_of([*EACH_ONCE, *OTHERS], 3))
def test_a_geometry_wrong_by_5_percent_is_named_within_a_minute(robot, gains, values):
    """20 % were silent."""
    (warning,) = Drive(**robot, gains=gains).run(60.0)
    found = dict(re.findall(r'(wheel_\w+) from [\d.]+ to ([\d.]+) m', warning))
    assert {name: float(value) for name, value in found.items()} == pytest.approx(
        values, rel=0.025
    )


@pytest.mark.parametrize(
    'robot, words',
    [
        ({'offset': 1.0}, 'odom is stamped 1 s behind the clock'),
        ({'offset': -1.0}, 'odom is stamped 1 s ahead of the clock'),
        ({'offset': 1.8e9}, 'odom is stamped 1.8e+09 s behind the clock of this node: its driver'),
        ({'real_rate': 50.0}, 'odom has 50 Hz, but rate is 100 Hz'),
        ({'gains': (0.5, 1.0)}, 'the linear velocity in odom is 0.50'),
        ({'gains': (1.0, 2.0)}, 'the angular velocity in odom is 2.0'),
        ({'gains': (1.0, -1.0)}, 'the angular velocity in odom has the opposite sign'),
        ({'loss': 0.3}, 'odom had '),
    ],
)
def test_what_does_not_fit_is_named(robot, words):
    drive = Drive(**robot)
    (warning,) = drive.run(30.0)
    assert warning.startswith(words)
    if robot.get('offset') == 1.0:  # simulated time may run ahead of the messages
        assert drive.warnings(simulated=True) == []


@pytest.mark.parametrize(
    'offset, response, words',
    [
        (0.2, 0.1, 'odom is stamped 0.2 s behind the clock of this node, but shows the response'),
        (0.2, 0.19, ''),  # as long as a command and the message may be on their way
        (0.2, None, ''),
        (-0.03, 0.1, 'odom is stamped 0.03 s ahead of the clock'),
        (-0.005, 0.1, ''),
    ],
)
def test_no_message_travels_longer_than_the_robot_responds(offset, response, words):
    """Stamps 0.2 s behind the clock made an error of 0.8 rad/s, and nothing was said."""
    drive = Drive(offset=offset)
    drive.run(3.0)
    found = drive.monitor.warnings(
        simulated_time=False, tolerated_gap=0.1, geometry=GEOMETRY, response_time=response
    )
    assert bool(found) == bool(words)
    assert all(each.startswith(words) for each in found)


def test_a_number_that_is_not_finite_blinds_no_check():
    """After one NaN, no sign and no gain was ever known again."""
    drive = Drive(gains=(1.0, -1.0))
    drive.run(5.0)
    stamp = drive._time * 1_000_000 + 1
    wrong = State(stamp, Pose(*drive.pose), BodyTwist(math.nan, math.nan))
    drive.monitor.update(wrong, stamp, BodyTwist(0.1, 0.1))
    assert any('opposite sign' in each for each in drive.run(30.0))


def test_a_robot_at_its_limit_is_no_wrong_geometry():
    (warning,) = [each for each in Drive(limit=0.08).run(60.0) if 'linear' in each]
    assert 'the limits of the robot are below those here' in warning
    assert 'wheel_radius' not in warning


def test_a_stopped_robot_gets_no_advice_about_its_geometry():
    """During an emergency stop the velocity was "0.61 times the command: check geometry"."""
    drive = Drive()
    drive.run(20.0)
    for _ in range(20):
        assert drive.run(0.5, stopped=True) == []
    drive.run(5.0, stopped=False)
    assert drive.monitor.gain(0).value == pytest.approx(1.0, abs=0.01), 'nothing was learnt'


def test_a_robot_that_is_said_not_to_follow_gets_no_advice():
    drive = Drive(gains=(0.8, 1.0))
    assert drive.run(60.0) != []
    state = State(drive._time * 1_000_000 + 1, Pose(*drive.pose), BodyTwist(0.1, 0.1))
    drive.monitor.update(state, state.stamp_ns, BodyTwist(0.1, 0.1), following=False)
    assert drive.warnings() == []


def test_gaps_are_counted_with_the_longest_and_the_last():
    drive = Drive(rate=50.0)
    drive.run(10.0)
    drive.run(0.5, silent=True)
    (warning,) = drive.run(2.0, silent=False)
    gaps = drive.monitor.gaps
    assert (gaps.number, gaps.missing) == (1, 25)
    assert gaps.longest == pytest.approx(0.52, abs=0.021)
    assert gaps.age == pytest.approx(2.0, abs=0.05)
    assert 'had 1 gaps in the last 10 s, the longest 0.52 s, the last 2.0 s ago: 5 %' in (
        warning.replace('%', ' %').replace('  ', ' ')
    )
    drive.run(0.021, silent=True)
    assert drive.run(11.0, silent=False) == []  # a single message is counted only
    assert gaps.number == 2
    assert drive.monitor.jumps == 0


@pytest.mark.parametrize('silence', [9.0, 3600.0])
def test_no_more_than_all_messages_of_a_time_are_missing(silence):
    """After a clock had been set by an hour, 35995 % were missing."""
    gaps = Gaps(100.0)
    stamps = [10_000_000 * k for k in range(1000)]
    begin = stamps[-1] + round(silence * 1e9)
    for stamp in [*stamps, *(begin + 10_000_000 * k for k in range(400))]:
        gaps.update(stamp)
    share = float(re.search(r'([\d.]+)%', gaps.warning(0.1)).group(1))
    assert share == pytest.approx(10.0 * min(silence, 6.0), abs=1.0)
    assert ('a clock was set' in gaps.warning(0.1)) == (silence > 10.0)


def jittering_gaps(kept, *, jitter=0.005, speed=0.2):
    """Return the gaps of regular messages of 100 Hz, of which some arrive with false stamps."""
    gaps, stamps = Gaps(100.0), StampFilter()
    generator = np.random.default_rng(5)
    for k in np.flatnonzero(kept).tolist():
        stamp = round((10.0 + 0.01 * k + generator.uniform(-jitter, jitter)) * NANOSECONDS)
        twist = BodyTwist(speed + 0.005 * generator.standard_normal(), 0.0)
        stamps.time(State(stamp, Pose(0.01 * speed * k, 0.0, 0.0), twist))
        gaps.update(stamp, stamps.periods)
    return gaps


@pytest.mark.parametrize('speed', [0.0, 0.2])
@pytest.mark.parametrize('jitter', [0.003, 0.005])
def test_a_late_stamp_before_an_early_one_is_no_gap(jitter, speed):
    """Of a robot that loses no message "3 % of its messages are missing" was said."""
    assert jittering_gaps(np.ones(2000), jitter=jitter, speed=speed).warning(0.1) == ''


@pytest.mark.parametrize('jitter', [0.0, 0.003, 0.005])
@pytest.mark.parametrize('lost', ['5 %', '20 %', 'bursts'])
def test_lost_messages_are_counted_where_stamps_jitter(lost, jitter):
    generator, numbers = np.random.default_rng(3), np.arange(3000)
    if lost == 'bursts':
        kept = numbers % 50 >= 10
    else:
        kept = generator.random(3000) >= 0.01 * float(lost[:-2])
    gaps = jittering_gaps(kept, jitter=jitter)
    share = float(re.search(r'([\d.]+)%', gaps.warning(0.1)).group(1))
    assert share == pytest.approx(100.0 - 100.0 * kept[2000:].mean(), abs=2.5)


def test_jumps_late_messages_and_restarts_are_counted():
    drive = Drive()
    drive.run(5.0)
    drive.pose[0] += 0.5
    drive.run(1.0)
    drive.pose[2] += 1.0
    drive.run(1.0)
    assert drive.monitor.jumps == 2
    drive.run(0.1, _offset=0.2)
    drive.run(0.1, _offset=0.01)
    assert drive.monitor.late == pytest.approx(10, abs=2)
    drive._time -= 3000
    drive._last -= 3000
    drive.run(1.0)
    assert drive.monitor.gaps.restarts == 1


def test_a_pose_that_jumps_again_and_again_is_named():
    """A pose in mm, or of two localisations, was counted and never named."""
    drive = Drive()
    for jumps in range(1, 5):
        drive.run(1.0)
        drive.pose[0] += 0.5
        assert ('has jumped' in ' '.join(drive.run(0.1))) == (jumps >= MANY_JUMPS)
    (text,) = drive.run(0.1)
    assert f'4 times in the last {RECENT:g} s, the last time by 0.499' in text
    assert drive.run(RECENT) == []
    assert drive.monitor.jumps == 4


@pytest.mark.parametrize('period', [0.01, 0.2])
def test_without_a_twist_a_turn_on_the_spot_is_no_jump(period):
    """A robot of 5 Hz gave up its path as it turned: its pose had "jumped by 0.00 m"."""

    def jumps(pose, seconds=period):
        new = State(round(seconds * NANOSECONDS), pose, STANDSTILL)
        return has_jumped(State(0, ORIGIN, STANDSTILL), new)

    assert not jumps(Pose(0.35 * period, 0.0, 4.0 * period))
    assert jumps(Pose(0.4, 0.0, 0.0))
    assert jumps(Pose(0.0, 0.0, 2.6))
    assert jumps(Pose(0.4, 0.0, 0.0), seconds=30.0)  # a driver that was started again


def test_a_robot_that_only_stands_and_noise_say_nothing():
    """With commands of zero the prior remains, and no warning."""
    made, random = OdometryMonitor(100.0), np.random.default_rng(3)
    for step in range(3000):
        twist = BodyTwist(*(0.01 * random.standard_normal(2)).tolist())
        state = State(step * 10_000_000, Pose(0.0, 0.0, 0.0), twist)
        made.update(state, state.stamp_ns, BodyTwist(0.0, 0.0))
        if step % 100 == 0:
            assert made.warnings(simulated_time=False, tolerated_gap=0.1, geometry=GEOMETRY) == []
    assert made.gain(0) is made.gain(1) is None
