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
"""Stops, stalls, blocked wheels and jumps of a run are found, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
from support.report_run import RUN

from t3mpc_ros.evaluation.bag_report.incidents import (
    STALL_PERIODS,
    find_blocked_wheels,
    find_incidents,
    find_slips,
    find_stalls,
    find_stops,
)
from t3mpc_ros.evaluation.bag_report.recorded_run import Series, Timing
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE, TRUTH
from t3mpc_ros.geometry.kinematics import WheelGeometry

TIME = 0.01 * np.arange(4000)
GEOMETRY = WheelGeometry()
BRAKING = 0.1
ESTOP = 'error', 'robot', 'emergency stop: a'


def motion(right, left, turned=0.0):
    """Return the motion of wheel speeds, rad/s, of a robot that is turned besides, rad."""
    linear = 0.5 * GEOMETRY.wheel_radius * (right + left)
    angular = GEOMETRY.wheel_radius * (right - left) / GEOMETRY.wheel_separation
    yaw = 0.01 * np.cumsum(angular) + turned
    x, y = (0.01 * np.cumsum(linear * each(yaw)) for each in (np.cos, np.sin))
    values = {'linear': linear, 'angular': angular, 'right': right, 'left': left}
    return Series(TIME, values | {'x': x, 'y': y, 'yaw': yaw})


def carried_in(run):
    return find_incidents(run).carried


def moved(series, **changes):
    """Return a motion with other values."""
    return replace(series, values={**series.values, **changes})


def wheels(rng):
    """Return speeds of a reference that never stands still for long."""
    phase = rng.uniform(0.0, 6.0, 4)
    right = 4.0 + 2.0 * np.sin(0.9 * TIME + phase[0]) + np.sin(2.3 * TIME + phase[1])
    return right, 4.0 + 2.0 * np.sin(0.7 * TIME + phase[2]) + np.sin(1.9 * TIME + phase[3])


def run_of(wanted, moved, commanded=None, **changes):
    motions = {
        REFERENCE: motion(*wanted),
        ODOMETRY: motion(*moved),
        COMMAND: motion(*(wanted if commanded is None else commanded)),
    }
    whole = {
        'motions': motions, 'receipts': dict.fromkeys(motions, TIME), 'switches': np.empty(0),
        'links': (), 'lead': 0.0, 'timing': {ODOMETRY: Timing(TIME.size, 0.01, 0.0, 0.0)},
    }  # fmt: skip
    return replace(RUN, **(whole | changes))


def standing(speeds, spans):
    """Return the speeds of a robot that brakes and then stands in spans."""
    share = np.ones(TIME.size)
    for start, end in spans:
        share *= np.where((start <= TIME) & (end > TIME),
                          np.clip(1.0 - (TIME - start) / BRAKING, 0.0, 1.0), 1.0)  # fmt: skip
    return [share * each for each in speeds]


@pytest.mark.parametrize('seed', range(6))
def test_each_stop_is_found_with_its_begin_and_end(seed):
    """Also by odometry with the noise of the paper, 0.2 rad/s at each wheel."""
    noise = 0.2 * (seed % 2)
    rng = np.random.default_rng(seed)
    starts = np.cumsum(rng.uniform(4.0, 9.0, rng.integers(0, 5)))
    spans = [(t, t + rng.uniform(0.8, 3.0)) for t in starts.tolist()]
    wanted = wheels(rng)
    speeds = [each + noise * rng.normal(size=TIME.size) for each in standing(wanted, spans)]
    found = find_stops(run_of(wanted, speeds))
    assert len(found) == len(spans)
    for stop, (start, end) in zip(found, spans, strict=True):
        assert stop.start == pytest.approx(start, abs=0.08)
        assert stop.end == pytest.approx(end, abs=0.08)


@pytest.mark.parametrize('delay', [0.0, 0.3])
def test_a_robot_that_stands_because_it_is_to_is_not_stopped(delay):
    """The reference pauses, and the robot with it, though later."""
    rng = np.random.default_rng(3)
    wanted = standing(wheels(rng), [(10.0, 13.0), (20.0, 20.6)])
    late = round(delay / 0.01)
    moved = [np.concatenate([np.full(late, each[0]), each])[: TIME.size] for each in wanted]
    assert find_stops(run_of(wanted, moved)) == ()
    # Without a reference, likewise by the command.
    run = run_of(wanted, moved)
    motions = {name: each for name, each in run.motions.items() if name != REFERENCE}
    assert find_stops(replace(run, motions=motions)) == ()


def test_a_robot_that_creeps_before_it_stands_does_not_stand_yet():
    wanted = wheels(np.random.default_rng(3))
    share = np.where(TIME < 20.0, 1.0, 0.0) * np.clip((20.0 - TIME) / 4.0, 0.1, 1.0)
    (stop,) = find_stops(run_of(wanted, [share * each for each in wanted]))
    assert stop.start == pytest.approx(20.0, abs=0.3)


def test_a_drive_that_is_over_is_no_stop_unless_a_node_says_why():
    wanted = wheels(np.random.default_rng(4))
    moved = standing(wanted, [(30.0, 99.0)])
    run = run_of(wanted, moved, commanded=moved)
    assert find_stops(run) == ()
    (stop,) = find_stops(replace(run, changes=((30.4, *ESTOP),)))
    assert stop.cause.name == 'E-stop'
    assert (stop.start, stop.end) == pytest.approx((30.0, TIME[-1]), abs=0.15)
    # The reference is stamped ahead: what is left of it when its generator ends is no demand.
    assert find_stops(replace(run, changes=((30.4, *ESTOP),), lead=9.8)) == ()


def test_a_short_stop_counts_where_it_was_commanded():
    wanted = wheels(np.random.default_rng(5))
    moved = standing(wanted, [(10.0, 10.4)])
    zero = [np.where((TIME >= 10.0) & (TIME < 10.4), 0.0, each) for each in wanted]
    assert find_stops(run_of(wanted, moved)) == ()
    (stop,) = find_stops(run_of(wanted, moved, commanded=zero))
    assert (stop.start, stop.end) == pytest.approx((10.0, 10.4), abs=0.05)
    # A command of zero that the robot has no time to follow is none.
    assert find_stops(run_of(wanted, wanted, commanded=zero)) == ()


@pytest.mark.parametrize('seed', range(4))
def test_stalls_are_counted_and_jitter_is_none(seed):
    rng = np.random.default_rng(seed)
    received = TIME + rng.uniform(0.0, 0.02, TIME.size)  # up to two periods late
    received.sort()
    rows = np.sort(rng.choice(np.arange(50, 3800, 200), rng.integers(0, 6), replace=False))
    lengths = rng.uniform(0.08, 1.5, rows.size)
    stalls = []
    for row, length in zip(rows.tolist(), lengths.tolist(), strict=True):
        start = received[row]
        late = (received > start) & (received < start + length)
        received[late] = start + length
        stalls.append((start, start + length))
    run = run_of(wheels(rng), wheels(rng), receipts={
        ODOMETRY: received, COMMAND: received + 0.001, REFERENCE: TIME,
    })  # fmt: skip
    found = find_stalls(run)
    assert [start for start, _ in found] == pytest.approx([start for start, _ in stalls])
    for (_, end), (_, expected) in zip(found, stalls, strict=True):
        assert expected - 1e-9 <= end <= expected + 0.03
    assert all(end - start > STALL_PERIODS * 0.01 for start, end in found)
    # Simulated time relates to no time of the machine.
    assert find_stalls(replace(run, other_clock=True)) == []


def test_a_lost_packet_is_no_stall():
    """Odometry pauses, and the commands with it; the reference of the host goes on."""
    kept = ~((TIME > 10.0) & (TIME < 10.3))
    receipts = {ODOMETRY: TIME[kept], COMMAND: TIME[kept] + 0.001, REFERENCE: TIME}
    speeds = wheels(np.random.default_rng(1))
    run = run_of(speeds, speeds, receipts=receipts)
    assert find_stalls(run) == [pytest.approx((10.0, 10.3), abs=2e-3)]
    assert find_stalls(replace(run, links=RUN.links)) == []
    silent = {**receipts, REFERENCE: TIME[kept]}
    assert find_stalls(replace(run, links=RUN.links, receipts=silent))
    # Nor does a controller stall that misses some samples: its commands pause.
    late = np.where((TIME > 20.0) & (TIME < 20.1), TIME + 0.2, TIME + 0.001)
    slow = {ODOMETRY: TIME, COMMAND: np.sort(late), REFERENCE: TIME}
    assert find_stalls(replace(run, receipts=slow))


def test_lost_commands_and_damaged_parts_are_no_stall():
    speeds = wheels(np.random.default_rng(1))
    some = np.random.default_rng(2).uniform(size=TIME.size) > 0.3
    receipts = {ODOMETRY: TIME, COMMAND: TIME[some] + 0.001, REFERENCE: TIME}
    run = run_of(speeds, speeds, receipts=receipts)
    assert np.diff(TIME[some]).max() > STALL_PERIODS * 0.01
    assert find_stalls(run) == []
    kept = ~((TIME > 10.0) & (TIME < 10.3))
    torn = replace(run, receipts=dict.fromkeys(receipts, TIME[kept]))
    assert find_stalls(torn) == [pytest.approx((10.0, 10.3), abs=2e-3)]
    assert find_stalls(replace(torn, lost=((10.01, 10.29),))) == []


@pytest.mark.parametrize('wheel', ['right', 'left'])
def test_a_blocked_wheel_is_named(wheel):
    wanted = wheels(np.random.default_rng(2))
    moved = [each.copy() for each in wanted]
    moved[wheel == 'left'][(TIME > 12.0) & (TIME < 15.0)] = 0.0
    ((start, end, name),) = find_blocked_wheels(run_of(wanted, moved))
    assert (start, end) == pytest.approx((12.0, 15.0), abs=0.15)
    assert name == f'{wheel} wheel'
    both = standing(wanted, [(12.0, 15.0)])
    assert find_blocked_wheels(run_of(wanted, both)) == (), 'that is a stop'
    assert find_blocked_wheels(run_of(wanted, wanted)) == ()


def test_a_slip_lasts_until_its_node_says_otherwise():
    speeds = wheels(np.random.default_rng(5))
    changes = (
        (4.0, 'warning', 'robot', 'a wheel slips, is blocked, or has lost steps'),
        (5.0, 'warning', 'robot', 'the battery is low; a wheel slips, is blocked'),
        (5.5, 'ok', 'controller', ''),
        (6.0, 'ok', 'robot', ''),
        (8.0, 'warning', 'robot', 'a wheel slips'),
    )
    run = replace(run_of(speeds, speeds), changes=changes)
    end = max(series.time[-1] for series in run.motions.values())
    assert find_slips(run) == ((4.0, 6.0), (8.0, end))


@pytest.mark.parametrize('seconds', [0.01, 0.5, 2.0, 5.0])
@pytest.mark.parametrize('name', [ODOMETRY, TRUTH])
def test_a_robot_that_is_carried_or_turned_is_found(name, seconds):
    speeds = wheels(np.random.default_rng(6))
    run = run_of(speeds, speeds)
    drive = run.motions[ODOMETRY]
    share = np.clip((TIME - 12.0) / seconds, 0.0, 1.0)
    motions = {**run.motions, TRUTH: drive}
    carried = moved(drive, x=drive['x'] + 0.9 * share), 'moves by 0.9'
    turned = motion(*speeds, 1.6 * share), 'turns by 1.'
    for shown, text in (carried, turned) if seconds < 5.0 else (carried,):
        (found,) = carried_in(replace(run, motions={**motions, name: shown}))
        assert (found.name, found.against) == (name, 'its twist')
        assert 12.0 <= found.time <= 12.02 + 0.8 * seconds
        assert text in found.text
    # What both measure is the motion of the robot; what odometry does not see is not.
    lifted = {part: drive[part] + 0.6 * share for part in 'xy'}
    still = {'linear': 0.0 * TIME, 'angular': 0.0 * TIME}
    both = {**motions, TRUTH: moved(drive, **lifted, **still), ODOMETRY: moved(drive, **still)}
    if 0.01 < seconds < 5.0:  # less is a jump of a robot at rest
        (found,) = carried_in(replace(run, motions=both))
        assert (found.name, found.against) == (TRUTH, ODOMETRY)
    same = {**both, ODOMETRY: both[TRUTH]}
    assert carried_in(replace(run, motions=same)) == ()


def test_noise_outliers_strafing_and_the_localizer_carry_nothing():
    rng = np.random.default_rng(7)
    speeds = [2.0 * each for each in wheels(rng)]
    noisy = [each + rng.normal(0.0, 0.4, TIME.size) for each in speeds]
    run = run_of(speeds, speeds)
    drive, lateral = run.motions[ODOMETRY], 0.4 * np.sin(0.5 * TIME)
    pose = {part: drive[part] + rng.normal(0.0, 0.03, TIME.size) for part in ('x', 'y', 'yaw')}
    outliers = {'x': drive['x'] + 0.9 * (rng.uniform(size=TIME.size) < 0.01)}
    sideways = {
        'x': drive['x'] - 0.01 * np.cumsum(lateral * np.sin(drive['yaw'])),
        'y': drive['y'] + 0.01 * np.cumsum(lateral * np.cos(drive['yaw'])),
        'lateral': lateral,
    }
    no_pose = dict.fromkeys(('x', 'y', 'yaw'), 0.0 * TIME)
    slow = Series(TIME[::30], {key: each[::30] for key, each in drive.values.items()})
    for shown in (
        moved(motion(*noisy), **pose), moved(drive, **outliers), moved(drive, **sideways),
        moved(drive, **no_pose), moved(drive, yaw=0.0 * TIME), slow,
    ):  # fmt: skip
        assert carried_in(replace(run, motions={**run.motions, ODOMETRY: shown})) == ()
    corrected = {**run.motions, ODOMETRY: moved(drive, x=drive['x'] + 0.9 * (TIME > 9.0))}
    assert carried_in(replace(run, motions=corrected))
    assert not carried_in(replace(run, motions=corrected, parameters={'localizer': {}}))


@pytest.mark.parametrize('twist', [0.0, 1.0])
def test_odometry_that_stays_the_same_in_a_drive_is_frozen(twist):
    speeds = wheels(np.random.default_rng(6))
    run = run_of(speeds, speeds)
    drive = run.motions[ODOMETRY]
    row = np.where(TIME < 20.0, np.arange(TIME.size), 2000)
    values = {key: each[row] for key, each in drive.values.items()}
    still = {key: np.where(TIME < 20.0, values[key], twist * values[key])
             for key in ('linear', 'angular')}  # fmt: skip
    frozen = moved(drive, **(values | still))
    found = find_incidents(replace(run, motions={**run.motions, ODOMETRY: frozen, TRUTH: drive}))
    ((start, end, text),) = found.frozen
    assert (start, end) == pytest.approx((20.0, TIME[-1]), abs=0.02)
    assert ('its twist amounts to' if twist else 'ground_truth/odom moves by') in text
    assert found.carried == ()
    # A robot that stands does not, and neither does one seen by a camera with noise of 3 mm.
    seen = np.random.default_rng(1).normal(0.0, 0.003, TIME.size)
    rest = moved(drive, **{key: np.zeros(TIME.size) for key in drive.values})
    both = {ODOMETRY: rest, TRUTH: moved(rest, x=seen, yaw=3.0 * seen)}
    assert find_incidents(replace(run, motions=both)).frozen == ()
    # Nor does odometry without a pose at a constant speed.
    constant = {key: np.full(TIME.size, 0.2 * (key in still)) for key in drive.values}
    both = {ODOMETRY: moved(drive, **constant)}
    assert find_incidents(replace(run, motions=both)).frozen == ()
    # Nor does a slow stream that is repeated.
    again = np.arange(TIME.size) // 40 * 40
    held = moved(drive, **{key: each[again] for key, each in drive.values.items()})
    assert find_incidents(replace(run, motions={**run.motions, ODOMETRY: held})).frozen == ()


def test_a_twist_of_the_opposite_sign_is_no_event():
    speeds = wheels(np.random.default_rng(8))
    run = run_of(speeds, speeds)
    wrong = moved(run.motions[ODOMETRY], linear=-run.motions[ODOMETRY]['linear'])
    (found,) = carried_in(replace(run, motions={ODOMETRY: wrong}))
    assert 'see signs, units and frames' in found.text


def test_nothing_happens_in_a_run_without_an_incident():
    speeds = wheels(np.random.default_rng(9))
    found = find_incidents(run_of(speeds, speeds))
    assert found.events() == []
    assert found.stopped == 0.0
    for gone in (REFERENCE, ODOMETRY, COMMAND):
        run = run_of(speeds, speeds)
        few = {name: each for name, each in run.motions.items() if name != gone}
        assert find_incidents(replace(run, motions=few)).events() == []
        one = {**run.motions, gone: Series(TIME[:1], {
            name: each[:1] for name, each in run.motions[gone].values.items()})}  # fmt: skip
        find_incidents(replace(run, motions=one))
