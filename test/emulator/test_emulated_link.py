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
"""Host link against the emulated dongle and robot: motion, packet loss, stops, recovery."""

from itertools import product
import math
import random

import pytest
from support.emulator_bench import Bench, check_followed
from support.long_tests import few_of

from t3mpc_ros.emulator.fault_injection import FAULT_KINDS
from t3mpc_ros.radio.link.link_parameters import LinkParameters

pytestmark = pytest.mark.slow

KEY = bytes(range(16))


def test_counters_equal_the_pulses_of_the_plant():
    bench = Bench({'robot_clock_error': 0.005})
    assert bench.connect() < 0.2
    for second in range(8):
        bench.drive(5.0 * math.sin(0.7 * second), 6.0 * math.cos(0.4 * second))
        bench.run(1.0)
        assert bench.link.reason(bench.now_ns) == ''
    bench.run_to_rest()
    pulses = bench.plant.pulses
    assert bench.counted_pulses == pulses
    assert bench.board.counters == pulses
    assert min(map(abs, pulses)) > 400
    quality = bench.link.quality(bench.now_ns)
    assert (quality.lost, quality.malformed, quality.sessions) == (0, 0, 1)
    assert quality.cycles >= 450
    assert quality.robot.stale == quality.robot.duplicates == quality.robot.bad_session == 0
    check_followed(bench)


def test_round_trip_time_is_that_of_line_radio_and_gap():
    """26 and 44 bytes at 20 us, 0.77 and 0.69 ms of radio, 1.7 ms of gap, 0.47 ms of firmware."""
    bench = Bench()
    bench.connect()
    bench.drive(3.0, 3.0)
    bench.run(1.0)
    quality = bench.link.quality(bench.now_ns)
    # COBS always adds one byte, so the length is constant.
    assert quality.round_trip_median == pytest.approx(5.04e-3, abs=0.02e-3)
    assert quality.round_trip_p99 == pytest.approx(quality.round_trip_median, abs=1e-6)
    # Sampled when the reply to the CMD of this cycle is loaded, not one cycle before.
    assert 60 <= bench.link.telemetry.raw.age <= 80


# -- stopping -------------------------------------------------------------------------------------


# Silence, jam, button: test_avr_faults.
@pytest.mark.parametrize('fault', ['stall', 'radio_dead', 'dongle_reset', 'close_port'])
def test_wheels_rest_within_045_s_of_the_last_command(fault):
    """For every fault that interrupts the commands."""
    bench = Bench(link=LinkParameters.from_dict({'robot.deceleration': 30.0}))
    bench.connect()
    bench.drive(7.0, 7.0)
    bench.run(1.0)
    assert bench.plant.wheels.right == pytest.approx(7.0, abs=0.3)
    bench.inject(fault, 3.0)
    still_ns = []

    def check_speeds():
        still = bench.board.speeds == (0, 0)
        if still and max(map(abs, bench.plant.wheels)) < 0.2:
            still_ns.append(bench.now_ns)

    bench.each = check_speeds
    bench.run(1.0)
    last_ns = bench.followed[-1][0]
    assert still_ns, 'the wheels did not stop'
    assert still_ns[0] - last_ns <= 0.45e9
    assert still_ns[-1] == bench.now_ns


# -- every fault ----------------------------------------------------------------------------------


# The others: test_avr_faults.
@pytest.mark.parametrize(
    'name', ['battery_wire', 'loss', 'loss_down', 'loss_up', 'move_link', 'wrong_version']
)
def test_the_link_recovers_from_every_fault(name):
    bench = Bench(key=KEY)
    bench.connect()
    bench.drive(4.0, 4.0)
    bench.run(1.0)
    bench.inject(name, 1.5)
    bench.run(1.6)
    bench.run(2.0)
    assert bench.emulator.port_number == (name == 'move_link')
    assert bench.link.reason(bench.now_ns) == ''
    assert bench.plant.wheels.right == pytest.approx(4.0, abs=0.3)
    check_followed(bench)


@pytest.mark.parametrize('seed, keyed', few_of(product(range(8), (True, False))))
def test_no_wrong_or_stale_command_is_executed(seed, keyed):
    """A fault every half second, most of them overlapping."""
    rng = random.Random(seed)
    bench = Bench(
        {'robot_clock_error': rng.uniform(-0.005, 0.005)}, key=KEY if keyed else b'', seed=seed
    )
    bench.connect()
    names = [kind.name for kind in FAULT_KINDS]
    # Commands resume only seconds after these faults.
    slow = ('dongle_reset', 'close_port', 'move_link', 'radio_dead', 'robot_reset', 'button')
    weights = [0.1 if name in slow else 1.0 for name in names]
    for _ in range(30):
        bench.drive(rng.uniform(-9.0, 9.0), rng.uniform(-9.0, 9.0))
        bench.inject(rng.choices(names, weights)[0], rng.uniform(0.02, 0.8))
        bench.run(0.5)
        bench.link.release_estop(bench.now_ns)
    check_followed(bench)
    assert len(bench.followed) > 100
    bench.run(3.0)
    bench.link.release_estop(bench.now_ns)
    bench.run(8.0)
    assert bench.link.reason(bench.now_ns) == ''


# -- telemetry ------------------------------------------------------------------------------------


def test_gyro_ranges_and_battery_are_those_of_the_plant():
    bench = Bench({'twin.world': 'corridor', 'twin.imu.gyro_offset': 0.0})
    bench.connect()
    bench.drive(3.0, -3.0)
    bench.run(3.0)
    telemetry = bench.link.telemetry
    # Rotation on the spot: speed difference 6 rad/s, wheel radius 35 mm, separation 147 mm.
    assert telemetry.imu.angular == pytest.approx(6.0 * 0.035 / 0.147, rel=0.05)
    assert any(math.isfinite(distance) for distance in telemetry.ranges)
    assert 11.0 < bench.link.battery.voltage < 13.0


def test_the_same_seed_gives_the_same_bytes():
    def run():
        bench = Bench({'twin.world': 'room'}, seed=4)
        bench.inject('loss', math.inf, 0.2)
        bench.inject('flip_bits')
        bench.run(0.5)
        bench.drive(4.0, 2.0)
        bench.run(1.0)
        return bench.written, bench.followed, bench.link.telemetry

    assert run() == run()


def test_a_reset_stops_the_pulses_and_the_wheels_coast():
    bench = Bench()
    bench.connect()
    bench.drive(7.0, 7.0)
    bench.run(2.0)
    bench.inject('robot_reset')
    bench.run(0.01)
    assert not bench.emulator.powered
    bench.release_controls()
    bench.run(1.0)
    assert bench.board.speeds == (0, 0)
    assert not bench.board.powered or bench.board.session
    bench.run(1.0)
    assert max(map(abs, bench.plant.wheels)) < 0.2
