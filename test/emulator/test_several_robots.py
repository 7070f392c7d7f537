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
"""Several robots and dongles in range of each other: separate, disturbed, and with one address."""

from itertools import product
import math

import pytest
from support.emulator_bench import MS, START_NS, STEP, Bench, check_followed
from support.long_tests import few_of

from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters
from t3mpc_ros.emulator.nrf24_radio import Medium, RadioParameters, Transmission
from t3mpc_ros.radio.link.actions_and_states import LinkState
from t3mpc_ros.radio.link.link_parameters import LinkParameters

KEYS = bytes(range(16)), bytes(range(16, 32))


def benches(*addresses, channels=(82, 82), keys=(b'', b''), seed=1):
    """Return a bench for each address, all in range of each other."""
    medium = Medium(START_NS, seed)
    made = []
    for number, address in enumerate(addresses):
        settings = {'address': address, 'channel': channels[number]}
        emulator = Emulator(
            EmulatorParameters.from_dict({**settings, 'robot_clock_error': 0.002 * number}),
            keys[number],
            seed + number,
            medium=medium,
        )
        link = LinkParameters.from_dict(settings)
        made.append(Bench(key=keys[number], link=link, seed=seed + number, emulator=emulator))
    return made


def run(made, seconds):
    """Advance all benches together; each host acts at most 1 ms late."""
    end_ns = made[0].now_ns + round(seconds * 1e9)
    while made[0].now_ns < end_ns:
        for bench in made:
            bench.run(MS / 1e9)


def drive_side_by_side(channels, apart):
    """Return the share of lost cycles of two robots whose hosts start ``apart`` s."""
    made = benches('54334d5043', 'c1a7b20d3e', channels=channels)
    made[0].run(apart)
    made[1].now_ns = made[1].wake_ns = made[0].now_ns
    for bench, speed in zip(made, (4.0, -3.0), strict=True):
        bench.drive(speed, speed)
    run(made, 1.5)
    for bench, speed in zip(made, (4.0, -3.0), strict=True):
        check_followed(bench)
        quality = bench.link.quality(bench.now_ns)
        assert (quality.robot_resets, quality.collisions) == (0, 0)
        if not quality.lost:
            assert bench.plant.wheels.right == pytest.approx(speed, abs=0.3)
    print(f'channels {channels}, {apart} s apart: {quality.lost_share:.1%} lost')
    return quality.lost_share


def test_two_robots_of_different_addresses_drive_side_by_side():
    """On one channel it depends on the phases of their cycles, which drift.

    If they coincide, all retransmissions collide, too, because the retry delays are equal.
    """
    assert drive_side_by_side((82, 90), 0.0) == 0.0
    lost = [drive_side_by_side((82, 82), apart) for apart in (0.0, 0.008)]
    assert min(lost) == 0.0
    assert 0.2 < max(lost) < 0.9


@pytest.mark.parametrize('seed, uptime_difference', few_of([*product(range(1, 6), (0.002, 1.0))]))
def test_two_robots_with_one_address_are_named_and_stand(seed, uptime_difference):
    """Both would follow every command: nothing moves while both answer.

    Switched on together their clocks are equal, but not how often they have started.
    """
    made = benches('54334d5043', '54334d5043', seed=seed)
    host, other = made
    other.kill()  # its robot is on, its dongle is not used
    other.emulator.inject('robot_reset', uptime_difference)
    host.emulator.run_to(host.now_ns + MS + round(uptime_difference * 1e9))
    for bench in made:
        bench.now_ns = bench.wake_ns = host.emulator.now_ns
    host.drive(5.0, 5.0)
    run(made, 1.5)
    host_reason = host.link.reason(host.now_ns)
    assert host_reason == (
        'two robots answer on address 54334d5043, channel 82: give each an address of its own, '
        't3mpc robot setup --address'
    )
    assert host.link.quality(host.now_ns).collisions > 0
    for bench in made:
        assert bench.board.speeds == (0, 0)
        travelled = max(map(abs, bench.plant.pulses)) * STEP * 0.035
        print(f'seed {seed}: {1e3 * travelled:.1f} mm before the collision was seen')
        assert travelled < 0.01
    other.emulator.inject('robot_reset', math.inf)
    host.run(7.0, lambda: host.link.state is LinkState.RUN and not host.link.reason(host.now_ns))
    host.run(0.6)
    assert host.plant.wheels.right == pytest.approx(5.0, abs=0.3)


@pytest.mark.parametrize('seed', few_of(range(1, 6)))
def test_a_second_robot_with_another_key_is_named_too(seed):
    """It refuses HELLO, so its states are of no session."""
    made = benches('54334d5043', '54334d5043', keys=KEYS, seed=seed)
    host, other = made
    other.kill()
    host.drive(5.0, 5.0)
    run(made, 1.5)
    assert 'two robots answer on address' in host.link.reason(host.now_ns)
    assert other.plant.pulses == (0, 0)
    assert host.board.speeds == (0, 0)


def test_packets_that_overlap_at_one_frequency_are_disturbed():
    medium = Medium()
    first = medium.transmit(82, 130.0, 300.0)
    assert not medium.is_disturbed(first)
    medium.transmit(90, 130.0, 300.0)
    medium.transmit(82, 430.0, 300.0)
    assert not medium.is_disturbed(first)
    late = medium.transmit(82, 429.0, 300.0)
    assert medium.is_disturbed(first)
    assert medium.is_disturbed(late)
    medium.events.run_to(10 * MS)
    assert not medium.is_disturbed(medium.transmit(82, 0.0, 300.0))
    assert not Transmission(82, 0, 5).overlaps(Transmission(82, 5, 9))


def test_of_simultaneous_answers_one_or_none_is_received():
    medium = Medium(seed=3)
    received = [medium.strongest([b'a', b'b']) for _ in range(400)]
    assert {received.count(each) // 50 for each in (b'a', b'b')} <= {1, 2}
    assert 150 < received.count(None) < 250
    assert medium.strongest([]) is None
    assert medium.strongest([b'a']) == b'a'
    assert RadioParameters().matches(RadioParameters())
