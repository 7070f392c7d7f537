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
"""Hardware in the loop: the real firmware drives the digital twin and reads its sensors.

Step pulses -> motors, body and world of the twin -> registers of the MPU6050 and voltages of the
range sensors -> robot firmware -> radio -> host with odometry.
"""

from contextlib import ExitStack
import math

import numpy as np
import pytest
from support.avr_bench import on_avr
from support.emulator_bench import RobotBench
from support.missing_tools import AVR, needing

from t3mpc_ros.robot.command_limiter import SLIP_STOP_REASON

pytestmark = needing(*AVR)

RADIUS, TRACK = 0.035, 0.147


@pytest.fixture
def build():
    """Return a factory of benches with the host of the bridge and both boards in simavr."""
    with ExitStack() as stack:
        yield lambda **given: stack.enter_context(on_avr(RobotBench, **given))


def run_recorded(bench, seconds):
    """Run for a time; return time (s) and true yaw (rad) at each millisecond."""
    times, yaws = [], []
    for _ in range(round(1000 * seconds)):
        bench.run(0.001)
        times.append(bench.now_ns / 1e9)
        yaws.append(bench.plant.pose.yaw)
    return np.array(times), np.unwrap(yaws)


@pytest.mark.long
def test_gyro_rate_and_delay(build):
    """Scale within the 3 % of the data sheet; delay of the filter and of both buses."""
    bench = build(flat={'twin.imu.gyro_offset': 0.0})
    bench.connect()
    bench.run(0.2)
    bench.states.clear()
    times, yaws = [], []
    for right in (4.0, -4.0, 4.0):
        bench.drive(right, -right)
        for column, part in zip((times, yaws), run_recorded(bench, 0.5), strict=True):
            column.append(part)
    times, yaws = np.concatenate(times), np.unwrap(np.concatenate(yaws))
    stamps = np.array([state.stamp_ns / 1e9 for state in bench.states])
    measured = np.array([state.imu.angular for state in bench.states])
    use = stamps > times[0] + 0.05
    stamps, measured = stamps[use], measured[use]
    # The period of the twin is 5 ms.
    true = np.convolve(np.gradient(yaws, times), np.full(5, 0.2), 'same')
    assert np.abs(true).max() > 0.9 * 2 * 4.0 * RADIUS / TRACK

    def misfit(delay):
        """Return the RMS difference to the true rate ``delay`` earlier, rad/s."""
        return float(np.sqrt(np.mean((measured - np.interp(stamps - delay, times, true)) ** 2)))

    delays = np.arange(0.0, 0.04, 0.0005)
    best = min(delays, key=misfit)
    print(f'\ngyro: {1e3 * best:.1f} ms late, {misfit(best):.3f} rad/s off (rms)')
    # 4.8 ms of the filter, plus the sampling periods of twin and firmware.
    assert 0.004 <= best <= 0.016
    plateau = np.abs(measured) > 0.9 * 2 * 4.0 * RADIUS / TRACK
    body = np.interp(stamps - best, times, true)
    ratio = np.abs(measured[plateau]).mean() / np.abs(body[plateau]).mean()
    assert ratio == pytest.approx(1.0, abs=0.03)


@pytest.mark.long
def test_gyro_odometry_agrees_with_the_true_pose(build):
    bench = build(flat={'twin.imu.gyro_offset': 0.0})
    bench.connect()
    bench.run(0.2)
    for right, left in ((6.0, 6.0), (2.0, 6.0), (5.0, 3.0)):
        bench.drive(right, left)
        bench.run(0.6)
    bench.drive(0.0, 0.0)
    bench.run(0.6)
    true, measured = bench.plant.pose, bench.states[-1].odometry.pose
    print(f'\ntrue {true}\nmeasured {measured}')
    assert math.hypot(true.x, true.y) > 0.15
    assert math.hypot(measured.x - true.x, measured.y - true.y) < 0.005
    assert measured.yaw == pytest.approx(true.yaw, abs=0.03)
    assert not bench.states[-1].status.slipping


@pytest.mark.long
@pytest.mark.parametrize('blocked, sign', [('right', 1.0), ('left', -1.0)])
def test_a_blocked_wheel_is_detected_and_stops_the_robot(build, blocked, sign):
    """The steps are those of straight motion; the body turns about the blocked wheel."""
    bench = build(
        flat={'twin.faults.wheel_blocked': blocked},
        parameters={'slip_stop': 0.5},
    )
    bench.connect()
    bench.run(2.2)  # gyro bias calibrated
    assert bench.robot._odometry.calibrated
    bench.drive(-sign * 5.0, -sign * 5.0)
    bench.run(0.45)
    state = bench.states[-1]
    steps = state.wheels.right - state.wheels.left
    print(f'\ngyro {state.imu.angular:.2f} rad/s, steps {steps * RADIUS / TRACK:.2f} rad/s')
    assert abs(steps) < 0.1
    assert abs(state.imu.angular) > 0.5
    assert state.status.slipping
    bench.run(0.6)
    assert bench.robot.reason(bench.now_ns) == SLIP_STOP_REASON
    bench.run(0.5)
    assert bench.board.speeds == (0, 0)
