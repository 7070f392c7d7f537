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
"""Odometry and restarts: a suspended host, a stalled line, resets of robot and dongle."""

import math

import pytest
from support.emulator_bench import MS, RobotBench, cable_bench
from support.long_tests import few_of

from t3mpc_ros.radio.link.standstill_reasons import ANSWERS_AGAIN

CYCLE_NS = 20 * MS


def a_moving_robot(**given):
    """Return a bench whose robot drives a curve; two events of its clock never coincide."""
    bench = RobotBench(flat={'robot_clock_error': 0.003}, **given)
    bench.connect()
    bench.drive(6.0, 4.5)
    bench.run(1.0)
    return bench


def resets(bench):
    quality = bench.link.quality(bench.now_ns)
    return quality.robot_resets, quality.dongle_resets


@pytest.mark.parametrize('seconds, publishes', few_of([(1.2, True), (2.0, False)]))
def test_no_distance_is_lost_while_the_host_is_suspended(seconds, publishes):
    """The result that waited looked like a restart of robot and dongle: 1568 microsteps were lost.

    SIGSTOP of 1.2 s and 2 s, in 2 of 7 phases of the cycle. test_link_faults.py has all of them.
    """
    for phase in (0.0, 0.35):
        bench = a_moving_robot()
        if not publishes:
            bench.release_controls()
        bench.run(phase * CYCLE_NS / 1e9 + 1e-6)
        bench.suspend(seconds)
        bench.run(0.5)
        bench.run_to_rest()
        assert bench.counted_pulses == bench.plant.pulses, phase
        assert min(bench.plant.pulses) > 500
        assert resets(bench) == (0, 0)
        assert bench.link.quality(bench.now_ns).sessions == 1


def test_a_suspended_host_blames_neither_radio_nor_robot():
    """It asked whether the robot is on, in range, on channel 82; over the cable, too."""
    for make in (RobotBench, lambda: cable_bench(kind=RobotBench)):
        bench = make()
        bench.connect()
        bench.drive(6.0, 4.5)
        bench.run(1.0)
        bench.release_controls()
        bench.suspend(2.0)
        assert bench.robot.reason(bench.now_ns) == (
            'this program was not executed for 2.0 s: was it suspended?'
        )
        bench.run(0.1)
        assert bench.robot.reason(bench.now_ns) == ANSWERS_AGAIN
        bench.drive(6.0, 4.5)
        bench.run(0.1)
        assert bench.robot.reason(bench.now_ns) == ''


def test_slow_cycles_are_no_suspension():
    """At eight cycles a second, the robot is asked two times while a command is followed."""
    bench = RobotBench(parameters={'link.cycle_rate': 8.0, 'max_stopping_time': 2.0})
    bench.connect()
    bench.run(2.5)
    found = set()
    bench.each = lambda: found.add(bench.robot.reason(bench.now_ns))
    bench.run(3.0)
    assert found == {'no command yet'}


def test_a_suspended_host_repeats_no_command():
    """It wakes up with the result of an old cycle: the robot follows new commands only."""
    bench = a_moving_robot()
    followed = len(bench.followed)
    bench.suspend(2.0)
    bench.release_controls()
    bench.run(1.0)
    late = bench.followed[followed + 1 :]  # one may have been under way
    assert not [command for _, command in late if command.left or command.right]


@pytest.mark.parametrize('phase', few_of([0.0, 0.3, 0.6, 0.9]))
def test_a_restart_in_motion_is_named_with_what_is_unknown(phase):
    """The odometry was silently short by 6 to 8 mm, and by what the robot rolled without power."""
    bench = a_moving_robot()
    bench.run(phase * CYCLE_NS / 1e9 + 1e-6)
    bench.inject('robot_reset', 0.3)
    bench.release_controls()
    bench.run(3.0, lambda: bench.link.robot_resets == 1)
    bench.run(0.5)
    text = bench.robot.restart(bench.now_ns)
    assert 'restarted in motion (reset button or opened port): up to 0.' in text
    state, true = bench.states[-1], bench.plant.pose
    pose = state.odometry.pose
    error = math.hypot(pose.x - true.x, pose.y - true.y)
    spread = math.sqrt(state.covariance[0, 0] + state.covariance[1, 1])
    print(f'phase {phase}: {1e3 * error:.1f} mm, standard deviation {1e3 * spread:.1f} mm')
    assert 0.003 < error < bench.robot.unknown_travel
    assert error < 2.0 * spread
    bench.run(10.0)
    assert bench.robot.restart(bench.now_ns) == ''
