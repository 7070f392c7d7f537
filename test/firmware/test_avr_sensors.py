# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The way round: step pulses of the real program turn the twin, whose sensors it reads in turn.

Pulses -> motors, body and world of the twin -> registers of the MPU6050 and voltages of the Sharps
-> the robot's program -> radio -> the host, which reckons where the robot is.
"""

from contextlib import ExitStack
import math

import numpy as np
import pytest
from support.avr_bench import on_avr
from support.avr_boards import missing_tools
from support.emulator_bench import RobotBench

from t3mpc_ros.robot.interface import RANGE_SENSORS
from t3mpc_ros.robot.slip_monitor import SLIP_STOP_REASON

pytestmark = pytest.mark.skipif(bool(missing_tools()), reason=f'not installed: {missing_tools()}')

RADIUS, TRACK = 0.035, 0.147


@pytest.fixture
def build():
    """Return what makes a bench of the bridge's host and both real programs."""
    with ExitStack() as stack:
        yield lambda **given: stack.enter_context(on_avr(RobotBench, **given))


def watched(bench, seconds):
    """Let time pass; return times (s) and true headings (rad), each millisecond."""
    times, yaws = [], []
    for _ in range(round(1000 * seconds)):
        bench.run(0.001)
        times.append(bench.now_ns / 1e9)
        yaws.append(bench.plant.pose.yaw)
    return np.array(times), np.unwrap(yaws)


def test_gyro_rate_and_delay(build):
    """Within the 3 % of the data sheet, and as late as its filter and the two buses make it."""
    bench = build(flat={'twin.imu.gyro_offset': 0.0})
    bench.connect()
    bench.run(0.2)
    bench.states.clear()
    times, yaws = [], []
    for right in (4.0, -4.0, 4.0):
        bench.drive(right, -right)
        for column, part in zip((times, yaws), watched(bench, 0.5), strict=True):
            column.append(part)
    times, yaws = np.concatenate(times), np.unwrap(np.concatenate(yaws))
    stamps = np.array([state.stamp_ns / 1e9 for state in bench.states])
    told = np.array([state.imu.angular for state in bench.states])
    use = stamps > times[0] + 0.05
    stamps, told = stamps[use], told[use]
    # The twin moves on every 5 ms.
    true = np.convolve(np.gradient(yaws, times), np.full(5, 0.2), 'same')
    assert np.abs(true).max() > 0.9 * 2 * 4.0 * RADIUS / TRACK

    def misfit(delay):
        """Root mean square of the difference to what the body did that long before, rad/s."""
        return float(np.sqrt(np.mean((told - np.interp(stamps - delay, times, true)) ** 2)))

    delays = np.arange(0.0, 0.04, 0.0005)
    best = min(delays, key=misfit)
    print(f'\ngyro: {1e3 * best:.1f} ms late, {misfit(best):.3f} rad/s off (rms)')
    # 4.8 ms of the filter; the twin looks at pulses, and the program at the sensor, now and then.
    assert 0.004 <= best <= 0.016
    plateau = np.abs(told) > 0.9 * 2 * 4.0 * RADIUS / TRACK
    body = np.interp(stamps - best, times, true)
    ratio = np.abs(told[plateau]).mean() / np.abs(body[plateau]).mean()
    assert ratio == pytest.approx(1.0, abs=0.03)


def test_gyro_odometry_agrees_with_the_true_pose(build):
    bench = build(flat={'twin.imu.gyro_offset': 0.0})
    bench.connect()
    bench.run(0.2)
    for right, left in ((6.0, 6.0), (2.0, 6.0), (5.0, 3.0)):
        bench.drive(right, left)
        bench.run(0.6)
    bench.drive(0.0, 0.0)
    bench.run(0.6)
    true, told = bench.plant.pose, bench.states[-1].odometry.pose
    print(f'\ntrue {true}\ntold {told}')
    assert math.hypot(true.x, true.y) > 0.15
    assert math.hypot(told.x - true.x, told.y - true.y) < 0.005
    assert told.yaw == pytest.approx(true.yaw, abs=0.03)
    assert not bench.states[-1].status.slipping


def test_ranges_agree_with_the_distance_to_a_wall(build):
    """Backwards to the end of the corridor; both sides keep their distance."""
    bench = build(flat={'twin.world': 'corridor'})
    bench.connect()
    bench.run(0.2)
    rear = [RANGE_SENSORS.index(name) for name in ('rear_left', 'rear_right')]
    seen = []

    def look():
        told, true = bench.states[-1].ranges, bench.emulator.distances
        seen.append((told[rear[0]], true[rear[0]]))
        for sensor, metres in enumerate(told):
            if math.isfinite(metres):
                # 2 % of the formula, half a step of the code, one of the converter, 20 ms of way.
                step = 0.0049 * (true[sensor] + 0.0257) ** 2 / 0.282
                limit = 0.02 * true[sensor] + 0.0025 + step + 0.02 * 0.28
                assert abs(metres - true[sensor]) <= limit, RANGE_SENSORS[sensor]
            else:
                assert not 0.11 < true[sensor] < 0.78, RANGE_SENSORS[sensor]

    bench.drive(-8.0, -8.0)
    for _ in range(13):
        bench.run(0.1)
        look()
    bench.drive(0.0, 0.0)
    bench.run(0.5)
    look()
    told = [metres for metres, _ in seen]
    print('\nrear left told', [f'{metres:.3f}' for metres in told])
    finite = [metres for metres in told if math.isfinite(metres)]
    assert finite[0] > 0.45
    assert finite[-1] < 0.2
    assert all(after <= before for before, after in zip(finite, finite[1:], strict=False))


@pytest.mark.parametrize('blocked, sign', [('right', 1.0), ('left', -1.0)])
def test_a_blocked_wheel_is_detected_and_stops_the_robot(build, blocked, sign):
    """Steps say straight on; the body turns about the wheel that stands."""
    bench = build(
        flat={'twin.faults.wheel_blocked': blocked},
        parameters={'slip_stop': 0.5, 'odometry.standstill_time': 0.5},
    )
    bench.connect()
    bench.run(1.2)  # the gyro's bias is known from now on
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


def test_low_battery_and_imu_fault_are_reported(build):
    bench = build(flat={'twin.faults.gyro_dead': True, 'twin.faults.supply_sag': 2.5})
    bench.connect()
    bench.run(1.1)
    state = bench.states[-1]
    assert state.imu is None
    assert state.status.imu_fault
    assert state.status.low_battery
    assert state.battery.voltage == pytest.approx(bench.plant.battery / 1000.0, abs=0.04)
