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
"""Time from the last valid command to rest: host of the bridge and emulator in virtual time."""

import math
import re

import pytest
from support.emulator_bench import RobotBench
from support.long_tests import few_of

from t3mpc_ros.emulator.emulator import StopTimeMonitor
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.radio.link.actions_and_states import LinkState

SPEED = 10.0  # both wheels at their maximum, rad/s
REST = 0.45  # maximum time to rest, s


def driving(seconds=1.5, **given):
    """Return a bench whose robot has driven at full speed for a time."""
    bench = RobotBench(**given)
    bench.connect()
    bench.drive(SPEED, SPEED)
    bench.run(seconds)
    assert bench.plant.wheels.right == pytest.approx(SPEED, abs=0.5)
    return bench


def run_and_observe(bench, seconds):
    """Run for a time; return the time (s) of the last motor pulse, 0 without any.

    After it the rotors settle at their field, for a tenth of a second and within half a step.
    """
    start_ns, moved = bench.now_ns, 0.0
    while bench.now_ns < start_ns + seconds * NANOSECONDS:
        bench.run(0.004)
        if bench.board.speeds != (0, 0):
            moved = (bench.now_ns - start_ns) / NANOSECONDS
    return moved


def test_a_report_of_a_stop_names_its_time_and_speeds():
    bench = RobotBench()
    bench.connect()
    watch = StopTimeMonitor(bench.emulator)
    bench.drive(8.0, 5.0)
    bench.run(1.5)
    assert watch.poll() == ''
    bench.inject('loss_down', math.inf, 1.0)
    bench.run(1.0)
    text = r'wheels at rest (0\.\d{3}) s after the last command \(right 8, left 5 rad/s\)'
    time = float(re.fullmatch(text, watch.poll())[1])
    assert 0.1 < time <= REST
    assert watch.poll() == ''


@pytest.mark.parametrize('late', few_of(range(0, 20, 4), 2))
def test_a_silent_robot_is_sent_standstill(late):
    """The robot followed unobserved commands for 2.2 s, until the next handshake."""
    bench = driving(1.5 + 1e-3 * late)
    way = bench.plant.pose.x
    bench.inject('loss_up', math.inf, 1.0)
    rest = run_and_observe(bench, 1.5)
    print(f'\nat rest after {rest:.3f} s and {bench.plant.pose.x - way:.3f} m')
    assert rest <= REST
    assert bench.link.state is LinkState.RUN
    assert 'does not answer' in bench.robot.reason(bench.now_ns)
    assert bench.followed[-1][1].left == bench.followed[-1][1].right == 0
    bench.emulator.end_fault('loss_up')
    bench.run(0.5)
    assert bench.robot.reason(bench.now_ns) == ''
    assert bench.plant.wheels.right == pytest.approx(SPEED, abs=0.5)


@pytest.mark.parametrize('alive', few_of([0.2, 0.24, 0.26, 0.0, 0.1, 0.3], 3))
def test_a_host_that_dies_after_its_publisher_keeps_the_limit(alive):
    """A command of the radio outlived the cmd_vel that it was made from by its own 0.2 s."""
    bench = driving()
    bench.release_controls()
    bench.run(alive)
    bench.kill()
    rest = alive + run_and_observe(bench, 1.0)
    print(f'\nat rest {rest:.3f} s after the last cmd_vel')
    assert rest <= REST


@pytest.mark.parametrize('publisher', [False, True])
@pytest.mark.parametrize('duration', few_of([0.15, 0.3, 1.0, 0.1, 0.2, 0.5, 5.0], 3))
def test_a_suspended_host_moves_the_robot_on_new_commands_only(duration, publisher):
    """The ramp went on from the speed before the suspension, and the robot started again."""
    bench = driving()
    if not publisher:
        bench.release_controls()
    bench.killed = True
    moved = run_and_observe(bench, duration)
    bench.killed = False
    bench.wake_ns = bench.now_ns
    way = bench.plant.pose.x
    after = run_and_observe(bench, 1.0)
    if publisher:
        assert bench.robot.reason(bench.now_ns) == ''
        return
    rest = duration + after if after else moved
    way = bench.plant.pose.x - way
    print(f'\n{duration} s: at rest after {rest:.3f} s, {way:.4f} m after the suspension')
    assert rest <= REST
