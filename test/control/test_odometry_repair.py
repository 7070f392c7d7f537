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
"""The twist of the odometry beside the change of its pose: what is found, replaced, and left."""

import math

import numpy as np
import pytest

from t3mpc_ros.control.odometry_repair import JITTER, OdometryTwist, StampFilter
from t3mpc_ros.geometry.kinematics import advance_pose
from t3mpc_ros.geometry.types import NANOSECONDS, STANDSTILL, BodyTwist, Pose, State

MS = 1_000_000


def test_a_message_that_is_not_finite_keeps_the_twist_missing():
    """One bad message once made the controller look for a twist again, for a centimetre."""
    twist = OdometryTwist()
    found = []
    for k in range(30):
        at = Pose(math.nan if k == 20 else 0.002 * k, 0.0, 0.0)
        measured = twist.measured(State(k * 10 * MS, at, STANDSTILL), restart=k == 0)
        found.append(measured.twist.linear)
    assert found[:6] == [0.0] * 6
    assert found[20] == 0.0
    assert found[7:20] + found[21:] == pytest.approx([0.2] * 22)


@pytest.mark.parametrize('hold', [1, 3, 5])
def test_poses_that_are_held_are_differentiated_over_the_hold(hold):
    """Speeds were zero and five times the true one by turns: *free the wheels*."""
    twist, found = OdometryTwist(), []
    for k in range(400):
        way = 0.002 * (min(k, 300) // hold * hold)
        state = State(k * 10 * MS, Pose(way, 0.0, 0.0), STANDSTILL)
        found.append(twist.measured(state, restart=k == 0).twist)
    assert np.array(found[50:300]) == pytest.approx(np.array([[0.2, 0.0]] * 250))
    assert found[300 + 2 * hold :] == [STANDSTILL] * (100 - 2 * hold)
    assert twist.lateness == pytest.approx(0.01 * (hold - 1), abs=1e-4)
    assert ('each of which lasts for' in twist.problem()) == (hold > 1)


START, ASIDE, FAR = Pose(0.0, 0.0, 0.0), Pose(0.02, 0.0, 0.0), Pose(0.5, 0.2, 0.0)


@pytest.mark.parametrize(
    ('poses', 'restart'),
    [
        ([place] * 5 + [START] * 5, None)  # it was set at rest
        for place in (ASIDE, FAR, Pose(0.0, 0.0, 2.9))
    ]
    + [([FAR] * 5 + [START] * 5, 5)]  # or in a gap
    + [([START] * 5 + [Pose(0.0105, 0.0, 0.0)] + [Pose(0.001, 0.0, 0.0)] * 5, None)],  # far off
)
def test_a_pose_that_is_set_is_no_twist_that_is_missing(poses, restart):
    """After ``reset_odometry`` 'odom has no twist' was said, and 'state is diverging'."""
    twist = OdometryTwist()
    for k, pose in enumerate(poses):
        state = State(k * 10 * MS, pose, STANDSTILL)
        assert twist.measured(state, restart=k in (0, restart)) == state
    assert not twist.problem()


# -- a twist that does not fit to the pose --------------------------------------------------------


def twists_of(
    motion, *, factors=(1.0, 1.0), noise=0.0, seconds=20.0, seed=1, moved=lambda k, pose: pose
):
    """Return twist monitor and used twists of a drive; ``motion``: twist by time (s)."""
    generator, twist, used = np.random.default_rng(seed), OdometryTwist(), []
    x = y = yaw = 0.0
    before = np.zeros(2)
    for k in range(round(100 * seconds)):
        true = np.array(motion(0.01 * k))
        linear, angular = 0.5 * (before + true) * (0.01 if k else 0.0)
        middle = yaw + 0.5 * angular
        x, y = x + linear * math.cos(middle), y + linear * math.sin(middle)
        yaw, before = yaw + angular, true
        measured = true * factors + noise * generator.standard_normal(2)
        state = State(k * 10 * MS, moved(k, Pose(x, y, yaw)), BodyTwist(*measured.tolist()))
        used.append(twist.measured(state, restart=k == 0).twist)
    return twist, np.array(used)


def winding(time):
    return 0.15 + 0.1 * math.sin(1.3 * time), 1.2 * math.sin(0.9 * time)


DRIVES = {
    'winding': winding,
    'straight': lambda time: (0.2, 0.0),
    'on the spot': lambda time: (0.0, 1.0),
    'to and fro': lambda time: (0.2 * math.sin(2.0 * time), 0.0),
}


@pytest.mark.parametrize('factor', [0.5, 0.94, 1.06])
@pytest.mark.parametrize('drive', ['winding', 'to and fro'])
def test_a_twist_of_another_scale_is_divided_by_it(drive, factor):
    """A twist 10 % too large made the settled error 1.5 times that of a simple method."""
    twist, used = twists_of(DRIVES[drive], factors=(factor, factor), noise=0.005)
    assert f'{factor:.2f}'[:3] in twist.problem()
    true = np.array([DRIVES[drive](0.01 * k) for k in range(len(used))])
    assert np.abs(used[500:] - true[500:]).mean() < 0.01
    assert np.abs(used[:150] / factor - true[:150]).mean() < 0.01  # before it is known


@pytest.mark.parametrize('drive', list(DRIVES))
@pytest.mark.parametrize('seed', range(2))
def test_a_twist_that_fits_is_used_as_it_is(drive, seed):
    twist, _ = twists_of(DRIVES[drive], noise=0.02, seed=seed, seconds=30.0)
    assert not twist.replaced
    assert twist.problem() == ''


def _corrected(k, pose):
    ahead = 0.02 * math.sin(0.5 * math.tau * k / 100.0)
    there = ahead * math.cos(pose.yaw), ahead * math.sin(pose.yaw)
    return Pose(pose.x + there[0], pose.y + there[1], pose.yaw)


MOVED = {
    'by up to a fifth of the way, forward and back': _corrected,
    'by a jump': lambda k, pose: pose._replace(x=pose.x + (k >= 600)),
    'by a jump, twice a second': lambda k, pose: pose._replace(x=pose.x + 0.15 * (k // 50)),
    # In the frame of its pose the robot then goes aside: 1.058, and six times the error.
    'by its yaw': lambda k, pose: pose._replace(yaw=pose.yaw - 0.5 * (k >= 600)),
    'by half a turn': lambda k, pose: pose._replace(yaw=pose.yaw + 1.5 * (k >= 600)),
}


@pytest.mark.parametrize('moved', MOVED)
@pytest.mark.parametrize('drive', ['winding', 'straight'])
def test_a_pose_that_a_localisation_moves_is_no_factor(drive, moved):
    twist, _ = twists_of(DRIVES[drive], noise=0.005, moved=MOVED[moved], seconds=30.0)
    assert not twist.replaced


def test_a_factor_of_the_yaw_rate_alone_is_left():
    """Gyro and wheels differ on a robot whose geometry is wrong: the body correction learns it."""
    for drive in ('winding', 'on the spot'):
        twist, _ = twists_of(DRIVES[drive], factors=(1.0, 1.1))
        assert not twist.replaced


@pytest.mark.parametrize('step', [-0.09, 0.09])
@pytest.mark.parametrize('speed', [0.01, 0.03])
def test_a_slow_robot_whose_pose_is_set_has_no_factor(speed, step):
    """Its speed was taken for up to thirteen times what it was, in the state *tracking*."""
    _, used = twists_of(
        lambda time: (speed, 0.0),
        seconds=60.0,
        moved=lambda k, pose: Pose(pose.x + step * (k >= 600), pose.y, pose.yaw),
    )
    assert (used[:, 0] == speed).all()


@pytest.mark.parametrize(
    ('drive', 'factors'),
    [
        ('winding', (1000.0, 1.0)),
        ('winding', (1.0, 57.3)),
        ('to and fro', (1000.0, 57.3)),
        ('to and fro', (100.0, 100.0)),
    ],
)
def test_a_twist_in_other_units_is_replaced_by_the_pose(drive, factors):
    """The robot jerked: *diverging* and *tracking* took turns, and nothing told why."""
    twist, used = twists_of(DRIVES[drive], factors=factors, noise=0.005)
    assert 'cannot be in m/s and rad/s' in twist.problem()
    true = np.array([DRIVES[drive](0.01 * k) for k in range(len(used))])
    assert np.abs(used[300:] - true[300:]).max() < 0.03


@pytest.mark.parametrize(('factors', 'noise'), [((1.0, 57.3), 3.9), ((1000.0, 1.0), 5.0)])
def test_units_are_found_at_rest_by_the_noise(factors, noise):
    """A robot was commanded at 9 rad/s from rest, then stopped, up to nine times in a row."""
    twist, used = twists_of(
        lambda time: (0.0, 0.0),
        seconds=0.5,
        factors=factors,
        noise=noise * np.array(factors) / max(factors),
    )
    assert 'cannot be in m/s and rad/s' in twist.problem()
    assert (used[25:] == 0.0).all()


@pytest.mark.parametrize('noise', [(0.05, 0.6), (0.15, 0.75)])
def test_a_noisy_twist_is_in_its_units(noise):
    twist, _ = twists_of(lambda time: (0.0, 0.0), noise=np.array(noise))
    assert not twist.replaced


def test_a_twist_in_degrees_is_not_believed_on_the_straight():
    """There it agrees with the pose: the robot stopped as soon as it turned, again and again."""

    def drive(time):
        return 0.2, 1.0 if time % 6.0 < 2.0 else 0.0

    _, used = twists_of(drive, factors=(1.0, 57.3), seconds=30.0)
    assert np.abs(used[20:, 1]).max() < 1.1


@pytest.mark.parametrize('rate', [4, 20])
def test_a_fast_robot_with_a_slow_camera_has_its_own_twist(rate):
    """The pose is that of the last picture; in the next one it has moved far."""
    held = []

    def seen(k, pose):
        if k % rate == 0:
            held[:] = [pose]
        return held[0]

    twist, used = twists_of(lambda time: (2.0, 3.0 * math.sin(time)), moved=seen, noise=0.05)
    assert not twist.replaced
    assert np.abs(used[:, 0] - 2.0).max() < 0.3


def straight(count, factor, restart=(), missing=lambda k: False):
    """Return twist monitor and used speeds at 0.2 m/s, with ``factor(k)`` times the twist."""
    twist, found = OdometryTwist(), []
    for k in range(count):
        if not missing(k):
            state = State(k * 10 * MS, Pose(0.002 * k, 0.0, 0.0), BodyTwist(0.2 * factor(k), 0.0))
            found.append(twist.measured(state, restart=k == 0 or k in restart).twist.linear)
    return twist, found


def test_a_twist_in_other_units_is_not_used_after_a_gap():
    """The first message after each gap had its twist of 200 m/s: the robot stopped for 0.5 s."""
    _, found = straight(100, lambda k: 1000.0, restart=(50,))
    assert found[50] == 0.0
    assert found[51:] == pytest.approx([0.2] * 49)


def test_a_twist_that_is_repaired_is_used_again():
    twist, found = straight(2000, lambda k: 1000.0 if k < 500 else 1.0)
    assert found[12:] == pytest.approx([0.2] * len(found[12:]))
    assert not twist.replaced
    twist, found = straight(9000, lambda k: 1.2 if k < 1500 else 1.0)
    assert [found[1000], found[-1]] == pytest.approx([0.2, 0.2])
    assert not twist.replaced


def test_messages_that_are_missing_are_not_compared():
    """Across a gap twist and pose say nothing of each other."""
    twist, _ = straight(2000, lambda k: 1.0, range(0, 2000, 20), lambda k: k % 20 >= 2)
    assert not twist.replaced


def turning(time):
    return 0.1 + 0.08 * math.sin(2.5 * time), 0.7 + 0.5 * math.sin(0.9 * time)


def seen_late(steps):
    """Return what shows, of a robot, the pose of so many messages ago."""
    poses = []

    def moved(k, pose, generator):
        poses.append(pose)
        return poses[max(k - steps, 0)]

    return moved


def delayed(steps):
    def changed(k, pose, history):
        return history[max(k - steps, 0)]

    return changed


WRONG = {
    'offset': (lambda k, pose, h: (h[k][0] + 0.01, h[k][1] + 0.05), 'velocity is +0.0'),
    'one velocity too large': (
        lambda k, pose, h: (1.1 * h[k][0], h[k][1]),
        'linear velocity is 1.',
    ),
    'one period late': (delayed(1), 's behind'),
    '50 ms late': (delayed(5), '0.05'),
    'of every fifth message': (lambda k, pose, h: h[k - k % 5], 's behind'),
    'of the world': (
        lambda k, pose, h: (h[k][0] * math.cos(pose.yaw), h[k][1]),
        'does not follow',
    ),
    'no yaw rate': (lambda k, pose, h: (h[k][0], 0.0), 'angular velocity is'),
    'reversed': (lambda k, pose, h: (-h[k][0], -h[k][1]), 'linear velocity is -'),
}


def contradicted(
    changed,
    *,
    seed=1,
    seconds=20.0,
    noise=(0.005, 0.06),
    moved=None,
    motion=turning,
    watch=None,
    command=None,
):
    """Return twist monitor and the errors of the used twists, of a drive with a false twist."""
    generator, twist, errors = np.random.default_rng(seed), OdometryTwist(), []
    pose, history = START, []
    for k in range(round(100 * seconds)):
        history.append(motion(0.01 * k))
        pose = advance_pose(pose, BodyTwist(*history[-1]), 0.01)
        given = np.array(changed(k, pose, history))
        given = given + noise * generator.standard_normal(2) * (given != 0.0)
        seen = pose if moved is None else moved(k, pose, generator)
        used = twist.measured(
            State(k * 10 * MS, seen, BodyTwist(*given.tolist())),
            restart=k == 0,
            command=command and BodyTwist(*command(0.01 * k)),
        ).twist
        errors.append(np.array(used) - history[-1])
        if watch:
            watch(twist)
    return twist, np.array(errors)


@pytest.mark.parametrize('fault', WRONG)
@pytest.mark.parametrize('seed', range(3))
def test_a_twist_that_the_pose_contradicts_is_replaced(fault, seed):
    """Dead time and gains were learnt from it: up to 107 times the error of a simple method."""
    changed, text = WRONG[fault]
    twist, errors = contradicted(changed, seed=seed)
    assert text in twist.problem()
    assert twist.problem().startswith('the twist in odom is wrong: its ')
    assert np.abs(errors[-500:]).max(axis=0) == pytest.approx([0.0, 0.0], abs=0.01)


DRIFTS = {
    'ahead': lambda k: (0.0002 * k, 0.0),
    'to the left': lambda k: (0.0, 0.0002 * k),
    'backwards from 8 s on': lambda k: (-0.0002 * max(k - 800, 0), 0.0),
    'fast': lambda k: (0.0005 * k, 0.0),
    'to and fro': lambda k: (0.05 * math.sin(0.01 * k), 0.05 * math.cos(0.007 * k)),
}


@pytest.mark.parametrize('drift', DRIFTS)
@pytest.mark.parametrize('late', [0.0, 0.02])
def test_a_pose_that_drifts_replaces_no_twist_that_obeys(drift, late):
    """The twist was replaced by it: 2 cm/s had up to 13 times the settled error."""

    def moved(k, pose, generator):
        x, y = DRIFTS[drift](k)
        return pose._replace(x=pose.x + x, y=pose.y + y)

    replaced, said = [], set()

    def watch(twist):
        replaced.append(twist.replaced)
        said.add(twist.problem()[:48])

    contradicted(
        lambda k, pose, history: history[k],
        moved=moved,
        watch=watch,
        command=lambda time: turning(time - late),
    )
    assert not any(replaced)
    assert 'the pose in odom moves otherwise than its twist ' in said


@pytest.mark.parametrize('fault', WRONG)
def test_a_twist_that_does_not_obey_is_replaced(fault):
    changed, text = WRONG[fault]
    twist, errors = contradicted(changed, command=turning)
    assert text in twist.problem()
    assert np.abs(errors[-500:]).max(axis=0) == pytest.approx([0.0, 0.0], abs=0.01)


@pytest.mark.parametrize(
    ('changed', 'text'),
    [
        (lambda k, pose, h: (h[k][0], 1.2 * h[k][1]), 'is 1.20 times the change of its yaw'),
        (lambda k, pose, h: (h[k][0], h[k][1] - 0.3 * h[k][0]), 'has -0.30 rad per metre'),
        (lambda k, pose, h: h[k], ''),
    ],
)
def test_another_turn_than_that_of_the_yaw_is_named_and_used(changed, text):
    """Nothing was said of a yaw rate that was 20 % too large, or of a right wheel 5 % too fast."""
    twist, errors = contradicted(changed, noise=(0.002, 0.02), command=turning)
    assert text in twist.turn_problem()
    assert bool(text) == bool(twist.turn_problem())
    assert not twist.problem()
    assert not twist.replaced


@pytest.mark.parametrize('factor', [0.85, 1.2])
def test_wheels_of_another_radius_drive_by_the_pose(factor):
    """They obey, and their twist is what was commanded: the pose says how fast the robot is."""

    def driven(time):
        return tuple(factor * each for each in turning(time))

    twist, errors = contradicted(
        lambda k, pose, history: turning(0.01 * k), motion=driven, command=turning
    )
    said = float(twist.problem().split('is ')[1].split(' ')[0])
    assert said == pytest.approx(1.0 / factor, rel=0.01)
    assert np.abs(errors[-500:]).mean(axis=0) == pytest.approx([0.0, 0.0], abs=0.06)


def blank(is_blank, change=lambda given: given):
    return lambda k, pose, history: (0.0, 0.0) if is_blank(k) else change(history[k])


BLANKS = {
    'every second': lambda k: k % 2,
    'two of three': lambda k: k % 3,
    'nine of ten': lambda k: k % 10,
    'one in ten, at random': lambda k: np.random.default_rng(k).random() < 0.1,
}


@pytest.mark.parametrize('which', BLANKS)
@pytest.mark.parametrize('seed', range(2))
def test_a_message_without_a_twist_gets_one_by_its_pose(which, seed):
    """One in two was found after seconds: 1.29 times the error of simple methods, now 1.01."""
    twist, errors = contradicted(blank(BLANKS[which]), seed=seed, seconds=3.0)
    assert twist.problem().startswith('odom has no twist in some of its messages')
    limit = 5.0 * np.array([0.005, 0.06]) + (0.02, 0.06)
    assert (np.abs(errors[120:]) < limit).all()


@pytest.mark.parametrize('speed', [0.004, 0.02, 0.05, 0.2])
def test_wheels_with_coarse_counters_stand_between_two_steps(speed):
    """Each step of a counter, 1 mm, is a twist of 0.1 m/s for a message; the pose moves in it.

    The fit left out the messages between: the twist was said to be twice the change of the pose.
    """
    twist, ways = OdometryTwist(), [round(speed * 0.01 * k, 3) for k in range(1000)]
    for k, (last, way) in enumerate(zip([0.0, *ways], ways, strict=False)):
        given = BodyTwist((way - last) / 0.01, 0.0)
        used = twist.measured(State(k * 10 * MS, Pose(way, 0.0, 0.0), given), restart=k == 0)
        assert used.twist == given
    assert twist.problem() == ''


def test_a_robot_that_stops_and_goes_has_no_twist_as_it_stands():
    twist, way = OdometryTwist(), 0.0
    for k in range(1000):
        given = BodyTwist(0.2 if k % 20 < 13 else 0.0, 0.0)
        way += 0.01 * given.linear
        used = twist.measured(State(k * 10 * MS, Pose(way, 0.0, 0.0), given), restart=k == 0)
        assert used.twist == given
    assert twist.problem() == ''


def test_messages_without_a_twist_are_forgotten_after_a_while():
    twist, _ = contradicted(blank(lambda k: k % 2 and k < 200), seconds=6.9)
    assert twist.problem() != ''
    twist, _ = contradicted(blank(lambda k: k % 2 and k < 200), seconds=7.1)
    assert twist.problem() == ''


REVERSED = {
    'both': (lambda k, pose, h: (-h[k][0], -h[k][1]), 'linear velocity is -1.000'),
    'linear': (lambda k, pose, h: (-h[k][0], h[k][1]), 'linear velocity is -1.000'),
    'angular': (lambda k, pose, h: (h[k][0], -h[k][1]), 'angular velocity is -1.000'),
}


@pytest.mark.parametrize('which', REVERSED)
@pytest.mark.parametrize('seed', range(3))
def test_a_twist_of_the_other_sign_is_found_soon(which, seed):
    """The robot drove anywhere for up to 3 s more: fourteen times the error of simple methods."""
    changed, text = REVERSED[which]
    twist, errors = contradicted(changed, seed=seed, seconds=1.5)
    assert text in twist.problem()
    assert np.abs(errors[-20:]).max(axis=0)[int(which == 'angular')] < 0.01


@pytest.mark.parametrize('late', [5, 15, 30])
@pytest.mark.parametrize('swing', [2.0, 4.0])
def test_a_late_pose_of_a_robot_that_swings_is_not_reversed(late, swing):
    """Whenever it turns back, the signs are opposite for as long as the pose is late."""
    twist, _ = contradicted(
        delayed(0),
        seconds=6.0,
        moved=seen_late(late),
        motion=lambda time: (0.2 * math.sin(swing * time), math.sin(swing * time)),
    )
    assert ' is -' not in twist.problem()


def held(number, noise=(0.005, 0.06), seed=1):
    """Return a twist of every so many messages, to the last digit, with its noise."""
    generator, kept = np.random.default_rng(seed), []

    def changed(k, pose, history):
        if k % number == 0:
            kept[:] = (history[k] + noise * generator.standard_normal(2)).tolist()
        return tuple(kept)

    return changed


@pytest.mark.parametrize('number', [3, 5])
@pytest.mark.parametrize('seed', range(3))
def test_a_twist_of_a_slower_stream_is_found_soon(number, seed):
    """One of 20 Hz was used for 7 to 12 s, with 4.4 times the error."""
    twist, errors = contradicted(held(number, seed=seed), seconds=2.5, noise=(0.0, 0.0))
    assert f'its velocities are held for 0.0{number} s' in twist.problem()
    assert np.abs(errors[-20:]).max() < 0.01


def rounded(k, pose, history):
    return round(history[k][0], 2), round(history[k][1], 1)


def cut(k, pose, history):
    return math.floor(100.0 * history[k][0]) / 100.0, math.floor(20.0 * history[k][1]) / 20.0


def stepwise(time):
    return turning(math.floor(20.0 * time + 0.01) / 20.0)


def ramps(time):
    return 0.2 * (1.0 - abs(time % 2.0 - 1.0)), 0.5


REPEATED = {
    'constant speed': (delayed(0), lambda time: (0.2, 0.3)),
    'commands of 20 Hz that act at once': (delayed(0), stepwise),
    'rounded': (rounded, turning),
    'cut off': (cut, turning),
    'rounded, while it speeds up': (rounded, ramps),
    'cut off, while it speeds up': (cut, ramps),
    'at rest': (delayed(0), lambda time: (0.0, 0.0)),
}


@pytest.mark.parametrize('late', [0, 5])
@pytest.mark.parametrize('repeated', REPEATED)
def test_a_twist_that_is_equal_for_another_reason_is_not_held(repeated, late):
    changed, motion = REPEATED[repeated]
    for seconds in (2.0, 5.0, 9.0):
        twist, _ = contradicted(
            changed, seconds=seconds, noise=(0.0, 0.0), motion=motion, moved=seen_late(late)
        )
        assert 'are held' not in twist.problem()


SEEN = {
    'as it is': lambda k, pose, generator: pose,
    '100 ms later': lambda k, pose, generator: pose,
    '300 ms later': lambda k, pose, generator: pose,
    'noise': lambda k, pose, generator: Pose(
        *(np.array(pose) + generator.standard_normal(3) * (0.005, 0.005, 0.01)).tolist()
    ),
    'ten times a second': None,
    'corrected twice a second': lambda k, pose, generator: Pose(
        pose.x + 0.008 * (k // 50 % 2), pose.y - 0.01 * (k // 50 % 3), pose.yaw + 0.02 * (k // 100)
    ),
    'of a gyro with 3 % and a bias': lambda k, pose, generator: pose._replace(
        yaw=1.03 * pose.yaw + 0.0005 * k
    ),
}


@pytest.mark.parametrize('seen', SEEN)
@pytest.mark.parametrize('seed', range(3))
def test_a_pose_that_is_late_or_rough_replaces_no_twist(seen, seed):
    """Of the two the earlier and the smoother one is used, and gyros are left to the body."""
    poses, change = [], SEEN[seen]

    def moved(k, pose, generator):
        poses.append(pose)
        if change is None:
            return poses[k - k % 10]
        late = int(seen.split()[0]) // 10 if seen.endswith('later') else 0
        return change(k, poses[max(k - late, 0)], generator)

    twist, _ = contradicted(delayed(0), seed=seed, seconds=30.0, moved=moved)
    assert not twist.replaced
    assert twist.pose_is_late == seen.endswith('later')
    assert ('s later what its twist says' in twist.problem()) == twist.pose_is_late


@pytest.mark.parametrize('factors', [(1.1, 1.1), (1.2, 1.0)])
@pytest.mark.parametrize('seed', range(3))
def test_a_twist_too_large_at_the_start_makes_no_pose_late(factors, seed):
    """It is what the pose says a little later; the text named the pose in the first seconds."""
    texts = set()
    contradicted(
        lambda k, pose, history: tuple(np.multiply(history[k], factors)),
        motion=lambda time: (0.1 * math.exp(time - 4.0), 0.2 * math.exp(time - 4.0)),
        watch=lambda twist: texts.add(twist.problem()),
        seconds=5.0,
        seed=seed,
    )
    assert not [text for text in texts if 'later' in text]


def test_a_factor_of_a_straight_way_is_not_that_of_the_turns():
    """The yaw rate was divided by it in the first turn: three times the settled error."""
    twist, errors = contradicted(
        lambda k, pose, history: (1.2 * history[k][0], history[k][1]),
        noise=(0.001, 0.01),
        motion=lambda time: (0.2 + 0.1 * math.sin(time), 2.0 * (time > 8.0)),
        seconds=9.0,
    )
    assert np.abs(errors[500:]).max(axis=0) == pytest.approx([0.0, 0.0], abs=0.05)


@pytest.mark.parametrize('seed', range(3))
def test_a_yaw_rate_that_is_late_is_replaced(seed):
    """It was taken for the dead time of the robot: ten times the error."""

    def changed(k, pose, history):
        return history[k][0], history[max(k - 5, 0)][1]

    twist, errors = contradicted(changed, seed=seed)
    assert twist.problem().startswith('the twist in odom is wrong: its angular velocity is 0.0')
    assert np.sqrt(np.mean(errors[1000:, 1] ** 2)) < 0.1


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('late', [0, 3, 8])
def test_a_dead_time_waits_for_the_pose(late, seed):
    """A twist that is late was a longer dead time of the robot for two to four seconds."""
    waits = []
    contradicted(
        delayed(late),
        seed=seed,
        watch=lambda twist: waits.append(twist.may_be_late(0.01 * (late or 3))),
    )
    assert all(waits[:100])  # nothing is known yet
    if late:
        first = waits.index(False)  # as the pose is used from here on
        assert first > 150
    else:
        assert not any(waits[400:])


def test_a_dead_time_does_not_wait_for_a_pose_that_says_nothing():
    twist, waits = OdometryTwist(), []
    for k in range(400):
        twist.measured(State(k * 10 * MS, START, BodyTwist(0.1, 0.0)), restart=k == 0)
        waits.append(twist.may_be_late(0.05))
    assert [waits[150], waits[250]] == [True, False]


@pytest.mark.parametrize('rate', [20, 200, 500, 1000])
def test_a_late_pose_is_found_at_every_rate(rate):
    """From 320 Hz on its twist was replaced: twists of earlier times were kept by their number."""
    twist, poses, steps = OdometryTwist(), [START], round(0.3 * rate)
    for k in range(10 * rate):
        used = BodyTwist(*winding(k / rate))
        poses.append(advance_pose(poses[-1], used, 1.0 / rate))
        stamp_ns = round(k * NANOSECONDS / rate)
        twist.measured(State(stamp_ns, poses[max(k - steps, 0)], used), restart=k == 0)
    assert twist.pose_is_late
    assert not twist.replaced


def test_a_twist_that_was_wrong_is_used_again():
    """After ten seconds of driving in which it fits."""
    twist, errors = contradicted(
        lambda k, pose, h: (h[k][0] + 0.02 * (k < 1000), h[k][1]), seconds=60.0
    )
    assert np.abs(errors[500:1000]).max() < 0.01
    assert not twist.replaced


def stamped(stamps, true=None, *, speed=lambda time: 0.2, noise=0.002, seed=1):
    """Return a filter, and the times (s) it gave to messages with these stamps (s).

    true : times at which they were measured, s; None: those of the stamps
    """
    generator, filtered, times, x = np.random.default_rng(seed), StampFilter(), [], 0.0
    true = stamps if true is None else true
    true = true.tolist()
    for k, (stamp, time) in enumerate(zip(stamps.tolist(), true, strict=True)):
        if k:
            x += speed(0.5 * (time + true[k - 1])) * (time - true[k - 1])
        twist = BodyTwist(speed(time) + noise * generator.normal(), 0.0)
        state = State(round(stamp * NANOSECONDS), Pose(x, 0.0, 0.0), twist)
        times.append(filtered.time(state))
    assert (np.diff(times) > 0).all()
    return filtered, np.array(times) / NANOSECONDS


@pytest.mark.parametrize('rate', [20.0, 60.0, 100.0])
@pytest.mark.parametrize('lost', [0.0, 0.2])
def test_regular_stamps_are_the_times_to_the_last_bit(rate, lost):
    generator = np.random.default_rng(3)
    true = 1.7e9 + np.arange(2000) / rate
    stamps = true[(generator.random(2000) >= lost) & (abs(np.arange(2000) - 1000) > 100)]
    filtered, times = stamped(stamps)
    assert filtered.problem() == ''
    assert (times == np.round(stamps * NANOSECONDS) / NANOSECONDS).all()


LATER = {
    'by up to 6 ms': lambda generator, n: generator.uniform(0.0, 0.006, n),
    'exponentially, by 2 ms in the mean': lambda generator, n: generator.exponential(0.002, n),
    'by 7 ms, one in ten': lambda generator, n: 0.007 * (generator.random(n) < 0.1),
}


@pytest.mark.parametrize('later', LATER)
@pytest.mark.parametrize('lost', [0.0, 0.1])
def test_stamps_that_jitter_give_regular_times(later, lost):
    """Jitter of 3 ms made the settled error 3.4 times that of a simple method, and no name."""
    generator = np.random.default_rng(5)
    kept = generator.random(3000) >= lost
    true = (10.0 + 0.01 * np.arange(3000))[kept]
    late = LATER[later](generator, 3000)[kept]
    ordered = np.maximum.accumulate(true + late) == true + late  # the others are ignored
    true, late = true[ordered], late[ordered]
    filtered, times = stamped(true + late, true, speed=lambda time: 0.2 + 0.1 * math.sin(time))
    assert filtered.problem().startswith('the stamps of odom jitter')
    settled = slice(500, None)
    wrong = (times - true - np.mean(late))[settled]
    assert np.std(wrong) < (0.55 if later.startswith('exp') else 0.35) * np.std(late[settled])
    assert abs(np.mean(wrong)) < 0.3 * np.std(late)
    assert filtered.jitter > JITTER


def test_a_robot_that_measures_irregularly_keeps_its_stamps():
    generator = np.random.default_rng(7)
    stamps = 10.0 + 0.01 * np.arange(3000) + generator.uniform(-0.004, 0.004, 3000)
    filtered, times = stamped(stamps)
    assert filtered.problem() == ''
    assert times == pytest.approx(stamps, abs=1e-9)


def test_stamps_are_used_again_when_they_no_longer_jitter():
    """And while the robot stands, nothing is known of them."""
    generator = np.random.default_rng(9)
    true = 10.0 + 0.01 * np.arange(6000)
    late = generator.uniform(0.0, 0.006, 6000) * (np.arange(6000) < 2000)
    filtered, times = stamped(true + late, true)
    assert filtered.problem() == ''
    assert times[4500:] == pytest.approx(true[4500:], abs=1e-9)
    standing, times = stamped((true + late)[:2000], true[:2000], speed=lambda time: 0.0)
    assert standing.problem() == ''
    assert times == pytest.approx((true + late)[:2000], abs=1e-9)


def test_a_period_that_changes_is_followed():
    steps = np.where(np.arange(4000) < 2000, 0.01, 0.0125)
    stamps = 10.0 + np.cumsum(steps)
    filtered, times = stamped(stamps)
    assert filtered.problem() == ''
    assert times == pytest.approx(stamps, abs=1e-9)


def test_a_lower_rate_is_followed_where_stamps_jitter():
    """Every second message counted as missing, for ever."""
    generator = np.random.default_rng(3)
    true = 10.0 + np.cumsum(np.where(np.arange(4000) < 2000, 0.01, 0.02))
    late = generator.uniform(0.0, 0.004, 4000)
    filtered, times = stamped(true + late, true, speed=lambda time: 0.2 + 0.1 * math.sin(time))
    assert filtered.jitters
    assert filtered.periods == 1
    assert np.std((times - true)[3000:]) < 0.4 * np.std(late)
