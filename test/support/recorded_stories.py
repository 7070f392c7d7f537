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
"""Recorded runs with a known story: what happened in them is what their reports must say first.

A robot with a period of 10 ms follows a reference of 20 s with a settled RMSE of 0.0100 rad/s in
both wheels, until something happens.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
import math

import numpy as np

from support.bag_messages import START, TYPES, diagnostics, serialised_odometry, serialised_twist
from support.robot_bags import write_with_records

DURATION, LEAD = 20.0, 0.4
RADIUS, SEPARATION = 0.035, 0.147
ERROR = 0.01 * math.sqrt(2.0)  # amplitude of the error of the wheels, rad/s
BRAKING = 0.1  # time from the begin of a stop to standstill, s
SLIP_STOP = (
    'gyro and steps disagree: a wheel slips, is blocked, or has lost steps; stop commanding '
    'motion for 0.5 s to resume'
)
SKIPPED = 'processor overloaded: samples were skipped'
TWO_PUBLISHERS = '/cmd_vel has 2 publishers: /controller, /other; stop all but one'
KILLED = 'one that was killed leaves this list within 20 s'
TWIN = {
    'sim_robot': {
        'wheel_radius': str(RADIUS), 'wheel_separation': str(SEPARATION), 'world': '',
        'drive.kind': 'stepper', 'noise.variance': '0.04', 'seed': '7',
    },
    'reference_generator': {'source': 'signals', 'output': 'wheels'},
    'controller': {'pose.enabled': 'False'},
}  # fmt: skip


@dataclass
class Story:
    """A run, and what its report says first."""

    sentence: str  # a regular expression
    kind: str  # kind of the verdict: good, open or bad
    records: dict = field(default_factory=lambda: TWIN)
    stands: tuple = ()  # spans in which the robot stands, s
    blocked: tuple = ()  # spans in which its right wheel stands, s
    lost: float = 0.0  # error that it has besides, rad/s
    reports: tuple = ()
    """Time, node, level and text of diagnostics; they are repeated each second until the next."""
    late: Callable = lambda t: 0.0  # by how much messages of an instant are received late, s
    kept: Callable = lambda t, topic: True  # which messages are recorded
    moved: Callable = lambda t: 0.0  # by how much the position is shifted, m
    set_at: float = math.inf
    """Time at which odometry and path begin anew where the robot is, ground truth does not, s."""
    path: bool = False  # whether the reference is a path with poses
    detour: tuple = ()  # span in which the robot makes a detour of 0.3 m, s
    rests: float = math.inf  # time from which the reference rests, s
    names: dict = field(default_factory=dict)  # other names of topics
    second_robot: bool = False
    second_controller: bool = False
    twist: bool = True  # whether the odometry has one
    frozen: float = math.inf
    """Time from which the odometry repeats its last message with a new stamp, s."""
    switches: tuple = ()  # times at which the reference switches, s
    rate: float = 50.0
    """Of the messages of a topic, Hz; that of the robot is 100, which a stall is seen by."""
    apart: int = 0  # time from a stamp of the reference to one of the odometry, ns

    def rows(self):
        """Return rows of receipt (s), topic and message."""
        rows, pose, place, origin = [], np.zeros(3), np.zeros(3), None
        for k in range(round(DURATION * self.rate)):
            t = k / self.rate
            wanted = self._reference(t)
            speed = self._motion(t)
            pose = _moved(pose, speed, 1.0 / self.rate)
            place = _moved(place, wanted, 1.0 / self.rate)
            received = t + self.late(t)
            shown = pose + (self.moved(t), 0.0, 0.0)
            if self.detour and self.detour[0] <= t < self.detour[1]:
                shown = shown + (0.0, 0.3, 0.0)
            stamp = START + round(t * 1e9)
            measured = stamp + self.apart
            if origin is None and t >= self.set_at:
                origin = place = pose
            target = _seen_from(origin, place) if self.path else (0.0, 0.0, 0.0)
            ahead = serialised_odometry(stamp, wanted, target)
            motion = serialised_odometry(measured, speed, shown)
            if t < self.frozen:
                last = speed if self.twist else (0.0, 0.0), _seen_from(origin, shown)
            odometry = serialised_odometry(measured, *last)
            rows += [
                (max(received - LEAD, 0.0), '/reference', ahead),
                (received + 2e-4, '/odom', odometry),
                (received + 3e-4, '/ground_truth/odom', motion),
                (received + 1e-3, '/cmd_vel', serialised_twist(self._command(t))),
            ]
            if self.second_robot and k % 2:
                other = serialised_odometry(stamp + 5_000_000, (0.1, 0.0), (5.0, 0.001 * k, 0.0))
                rows.append((received + 6e-3, '/odom', other))
            if self.second_controller:
                rows.append((received + 6e-3, '/cmd_vel', serialised_twist((0.0, 0.1))))
        for mode, t in enumerate((0.0, *self.switches) if self.switches else ()):
            rows.append((max(t - LEAD, 1e-4), '/reference/signals', _signals(mode)))
        for second in range(1, round(DURATION)):
            newest = {}
            for when, node, level, text in self.reports:
                if when <= second + 0.5:
                    newest[node] = level, text
            rows += [
                (second + 0.5, '/diagnostics', diagnostics(START, node, *now))
                for node, now in newest.items()
            ]
        return [
            (t, self.names.get(topic, topic), message)
            for t, topic, message in sorted(rows, key=lambda row: row[0])
            if self.names.get(topic, topic) and self.kept(t, topic)
        ]

    def write(self, folder):
        """Write the bag and return its folder."""
        return write_with_records(folder, self.rows(), self.records)

    def _reference(self, t):
        if t >= self.rests:
            return 0.0, 0.0
        mode = sum(switch <= t + 1e-9 for switch in self.switches)
        return 0.18 - 0.08 * (mode % 2) + 0.04 * math.sin(1.3 * t), 0.5 * math.sin(0.7 * t)

    def _command(self, t):
        return self._reference(t)

    def _motion(self, t):
        v, w = self._reference(t)
        right, left = (v + 0.5 * SEPARATION * w) / RADIUS, (v - 0.5 * SEPARATION * w) / RADIUS
        error = ERROR * math.sin(9.0 * t) + self.lost
        right, left = right + error, left + error
        for start, end in self.stands:
            if start <= t < end:
                share = max(0.0, 1.0 - (t - start) / BRAKING)
                right, left = share * right, share * left
        if any(start <= t < end for start, end in self.blocked):
            right = 0.0
        return 0.5 * RADIUS * (right + left), RADIUS * (right - left) / SEPARATION


def _signals(mode):
    layout = TYPES['std_msgs/msg/MultiArrayLayout'](dim=[], data_offset=0)
    values = np.array([mode, mode % 4, (mode + 1) % 4], dtype=np.int32)
    return TYPES['std_msgs/msg/Int32MultiArray'](layout, values)


def _moved(pose, twist, seconds):
    x, y, yaw = pose
    v, w = seconds * twist[0], seconds * twist[1]
    return np.array([x + v * math.cos(yaw), y + v * math.sin(yaw), yaw + w])


def _seen_from(origin, pose):
    """Return a pose in the frame of another one; as it is without one."""
    if origin is None:
        return pose
    x, y, yaw = pose - origin
    c, s = math.cos(origin[2]), math.sin(origin[2])
    return np.array([c * x + s * y, c * y - s * x, yaw])


def stalled(*stalls):
    """Return by how much messages are late on a machine that pauses at times for durations (s)."""

    def late(t):
        return max([start + length - t for start, length in stalls if 0.0 <= t - start < length],
                   default=0.0)  # fmt: skip

    return late


SETTLED = r'settled RMSE 0\.0(09\d\d|10\d) / 0\.0(09\d\d|10\d) rad/s'
OTHER_ROBOT = {'/odom': '/wheels/odometry', '/cmd_vel': '/base/cmd_vel', '/reference': '',
               '/ground_truth/odom': ''}  # fmt: skip
PATROL = {**TWIN, 'controller': {'pose.enabled': 'True', 'keep_out.enabled': 'True'}}
OK, WARNING, ERROR_LEVEL = 0, 1, 2

STORIES = {
    'good': Story(rf'Good run: {SETTLED}, and the robot never stood\.', 'good'),
    'e-stop': Story(
        rf'E-stop at 12\.[01] s, the robot stood for 7\.[4-9] s; until then {SETTLED}\.', 'bad',
        stands=((12.0, 99.0),),
        reports=(
            (0.0, 'sim_robot', OK, 'following commands'),
            (12.0, 'sim_robot', ERROR_LEVEL, 'emergency stop: requested by service e_stop'),
            (12.0, 'controller', WARNING, 'the robot does not follow commands'),
        ),
    ),
    'stands without a reason': Story(
        rf'The robot stood for [78]\.\d s from 12\.[01] s on \(the nodes reported no reason\); '
        rf'until then {SETTLED}\.', 'bad', stands=((12.0, 99.0),),
        reports=(
            (0.0, 'sim_robot', WARNING, 'no command yet'),
            (2.0, 'sim_robot', OK, 'following commands'),
        ),
    ),
    'never moves after it waited for commands': Story(
        r'The robot never moved, although it was to for 19\.\d s\.', 'bad', stands=((-9.0, 99.0),),
        reports=(
            (0.0, 'sim_robot', WARNING, 'no command yet'),
            (2.0, 'sim_robot', OK, 'following commands'),
        ),
    ),
    'a second controller begins': Story(
        r'The robot stood for 2\.\d s from 12\.[01] s on \(other: stopped: no reference yet, '
        rf'although the bag holds reference of that time\); while it drove {SETTLED}\.', 'bad',
        stands=((12.0, 14.0),),
        reports=((12.0, 'other', ERROR_LEVEL, 'stopped: no reference yet'),),
    ),
    'blocked wheel': Story(
        r'The right wheel stood from 1[12]\.\d s on for [56]\.\d s although it was commanded to '
        r'turn; settled RMSE .*\.', 'bad', blocked=((12.0, 18.0),),
    ),
    'slip stop': Story(
        rf'Slip stop: a wheel slips, is blocked, or has lost steps at 9\.[01] s, the robot stood '
        rf'for 3\.[09] s; while it drove {SETTLED}\.', 'bad', stands=((9.0, 12.0),),
        reports=(
            (0.0, 'sim_robot', OK, 'following commands'),
            (9.0, 'sim_robot', WARNING, f'{SLIP_STOP}; {SKIPPED}'),
            (9.0, 'controller', WARNING, 'the robot does not follow commands'),
            (12.0, 'sim_robot', OK, 'following commands'),
            (12.0, 'controller', OK, 'tracking'),
        ),
    ),
    'low battery': Story(
        rf'Battery low from 8\.5 s on \(sim_robot: the battery is low: 10\.1 V\); {SETTLED}\.',
        'open', reports=(
            (0.0, 'sim_robot', OK, 'following commands'),
            (8.0, 'sim_robot', WARNING, 'the battery is low: 10.1 V'),
        ),
    ),
    'stalls': Story(
        r'The machine stalled 3 times, the longest (8[0-9]) ms at 1[12]\.\d s: errors after them '
        rf"are not the controller's; {SETTLED}(, without the 1 s after them .*)?\.", 'open',
        rate=100.0, late=stalled((6.0, 0.066), (12.0, 0.074), (15.0, 0.066)),
    ),
    'commands lost': Story(
        rf'2\d\.\d % of cmd_vel is missing or not finite; {SETTLED}\.', 'open', rate=100.0,
        kept=lambda t, topic: topic != '/cmd_vel' or round(997.0 * t) % 10 > 2,
    ),
    'reference lost': Story(
        rf'[3-5]\.\d % of reference is missing or not finite; {SETTLED}\.', 'open', rate=100.0,
        kept=lambda t, topic: topic != '/reference' or round(997.0 * t) % 20 > 0,
    ),
    'patrol': Story(
        r'Good run: within 50 mm of its path for 8\d % of the drive, path error 1\d\d\.\d mm '
        r'\(RMS\); the rest were detours around obstacles and the ways back\.', 'good',
        records=PATROL, path=True, detour=(8.0, 11.0),
    ),
    'boxed in': Story(
        r'Boxed in from 14\.5 s on \(reference_generator: the robot is boxed in: .* or set the '
        r'robot down elsewhere\); within 50 mm of its path for 100 % of the drive, path error '
        r'\d\.\d mm \(RMS\)\.', 'open', records=PATROL, path=True, rests=6.0,
        reports=(
            (0.0, 'reference_generator', OK, 'running'),
            (
                14.0, 'reference_generator', WARNING,
                'the robot is boxed in: for 20 s and more no way that keeps plan.distance '
                '(0.195 m) from obstacles has led on; clear a passage of 0.39 m, or set the robot '
                'down elsewhere',
            ),
        ),
    ),
    'path without keep-out': Story(
        r'Good run: within 50 mm of its path for 8\d % of the drive, path error 1\d\d\.\d mm '
        r'\(RMS\)\.', 'good',
        records={**TWIN, 'controller': {'pose.enabled': 'True'}}, path=True, detour=(8.0, 11.0),
    ),
    'odometry set': Story(
        r'The position of odom jumps by 1\.\d+ m at 12\.0 s; within 50 mm of its path for 100 % '
        r'of the drive, path error \d\.\d mm \(RMS\)\.', 'open',
        records=PATROL, path=True, set_at=12.0,
    ),
    'localizer wrong': Story(
        r'The position of odom jumps by 1\.\d+ m at 12\.0 s; within 50 mm of its path for 6\d % '
        r'of the drive, path error \d+\.\d mm \(RMS\); .*', 'open',
        records={**PATROL, 'localizer': {}}, path=True, set_at=12.0,
    ),
    'other robot': Story(
        r'The robot drove 3\.[56]\d m in 20\.0 s; the bag holds no reference, so tracking cannot '
        r'be judged\.', 'open', records={}, names=OTHER_ROBOT,
    ),
    'gap': Story(
        rf'No (odom|ground_truth/odom) for 4\.0 s from 10\.0 s on, the longest of \d gaps; '
        rf'{SETTLED}\.', 'bad',
        kept=lambda t, topic: topic == '/reference' or not 10.0 < t < 14.0,
    ),
    'no twist': Story(
        r'Good run: settled RMSE 0\.0[0-4]\d+ / 0\.0[0-4]\d+ rad/s, and the robot never stood\.',
        'good', twist=False, names={'/ground_truth/odom': ''},
    ),
    'no twist, ten times a second': Story(
        r'The robot drove 3\.[56]\d m in 19\.9 s; the bag holds no reference, so tracking cannot '
        r'be judged\.', 'open', records={}, names=OTHER_ROBOT, twist=False, rate=10.0,
    ),
    'clock behind': Story(
        r'The stamps of odom are 1\.0 s behind those of reference: they are of different clocks, '
        r'so tracking cannot be judged\.', 'bad', apart=-1_000_000_000,
    ),
    'clock ahead': Story(
        r'The stamps of odom are 5\.0 s ahead of those of reference: they are of different '
        r'clocks, so tracking cannot be judged\.', 'bad', apart=5_000_000_000,
    ),
    'slow transport': Story(
        rf'Good run: {SETTLED}, and the robot never stood\.', 'good', late=lambda t: 0.3,
    ),
    'odometry ends': Story(
        rf'Odom ends at 12\.0 s, 8\.0 s before the commands do; {SETTLED}\.', 'bad',
        kept=lambda t, topic: topic != '/odom' or t <= 12.0,
    ),
    'reference ends': Story(
        rf'Reference ends at 14\.6 s, 5\.4 s before the commands do; {SETTLED}\.', 'open',
        kept=lambda t, topic: topic != '/reference' or t <= 14.6,
    ),
    'jump': Story(
        rf'The position of (odom|ground_truth/odom) jumps by 3\.00\d m at 8\.0 s, the largest of '
        rf'2 jumps; {SETTLED}\.', 'open', moved=lambda t: 3.0 * (t >= 8.0),
        reports=((5.0, 'sim_robot', WARNING, SKIPPED),),
    ),
    'odometry frozen': Story(
        r'Odom stays the same from 12\.0 s on for 8\.0 s, although its twist amounts to 1\.\d+ '
        rf'm; {SETTLED}\.', 'bad', frozen=12.0,
    ),
    'odometry frozen without a reference': Story(
        r'Odom stays the same from 12\.0 s on for 8\.0 s, although its twist amounts to 1\.\d+ m; '
        r'the robot drove 2\.[12]\d m in 20\.0 s; the bag holds no reference, so tracking cannot '
        r'be judged\.', 'bad', frozen=12.0, names={'/reference': '', '/ground_truth/odom': ''},
    ),
    'carried': Story(
        r'The pose of (odom|ground_truth/odom) moves by 1(\.\d+)? m at 8\.\d s, which its twist '
        r'does not say: the robot was carried or slipped, or its pose was set; '
        rf'{SETTLED}\.', 'open',
        moved=lambda t: min(max(0.5 * (t - 8.0), 0.0), 1.0),
    ),
    'two robots': Story(
        r'The position of /odom jumps between its messages: several robots publish it, or its '
        r'pose disagrees with its twist; nothing measured from it is valid\.', 'bad',
        second_robot=True, names={'/ground_truth/odom': ''},
    ),
    'two controllers': Story(
        rf'/cmd_vel holds the commands of two publishers in turn; {SETTLED}\.', 'bad',
        second_controller=True,
    ),
    'two controllers that agree': Story(
        rf'/cmd_vel has 2 publishers; {SETTLED}\.', 'bad', reports=(
            (3.0, 'sim_robot', WARNING, f'{TWO_PUBLISHERS}; {KILLED}'),
            (5.0, 'sim_robot', WARNING, f'{SKIPPED}; {TWO_PUBLISHERS}'),
        ),
    ),
    'a controller that was killed': Story(
        rf'Good run: {SETTLED}, and the robot never stood\.', 'good',
        reports=((3.0, 'controller', WARNING, f'{TWO_PUBLISHERS}; {KILLED}'),),
    ),
}  # fmt: skip
"""By name."""

SIGNALS_STORY = Story('', 'bad', stands=((8.0, 9.5),), switches=(6.0, 11.0, 15.5), apart=3_000_000)
"""One with a stop, and switches between stamps of the odometry and those of the reference."""
