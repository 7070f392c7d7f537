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
"""The real firmware of the robot in simavr, driven over its USB, beside the radio."""

import pytest
from support.avr_bench import on_avr
from support.avr_boards import ROBOT
from support.emulator_bench import Bench, CablePort
from support.missing_tools import AVR, needing

from t3mpc_ros.radio.link.actions_and_states import LinkState

pytestmark = [needing(*AVR), pytest.mark.slow]

KEY = bytes(range(16))


class CableBench(Bench):
    """A bench at the USB port of the robot board."""

    def __init__(self, emulator, **given):
        super().__init__(emulator=CablePort(emulator), **given)


@pytest.mark.long
def test_the_board_drives_over_the_cable_in_time():
    """A signed CMD, a POLL and their RESULT, 50 times a second, while the wheels turn."""
    with on_avr(CableBench, key=KEY) as bench:
        bench.connect()
        bench.drive(7.0, 6.0)
        bench.run(0.3)
        boards, ram = bench.emulator.boards, bench.board.ram
        ram.put('longest_us', 0, 2)
        begun, busy = boards.now_us, boards.call('busy_cycles', ROBOT)
        bench.run(1.0)
        assert bench.link.reason(bench.now_ns) == ''
        load = (boards.call('busy_cycles', ROBOT) - busy) / 16 / (boards.now_us - begun)
        longest_us = ram.get('longest_us', 2)
        quality = bench.link.quality(bench.now_ns)
        print(
            f'\nload {load:.1%}, longest pass {longest_us} us, round trip '
            f'{1e3 * quality.round_trip_median:.1f} ms (99 %: {1e3 * quality.round_trip_p99:.1f})'
        )
        assert bench.link.over_cable
        assert (quality.robot_resets, quality.sessions) == (0, 1)
        assert quality.lost <= 1  # in one of some hundred phases an answer misses its packet
        assert load < 0.95
        assert longest_us < 2000
        bench.kill()  # nothing moves on an old command
        bench.run(0.6)
        assert bench.board.speeds == (0, 0)
        assert bench.link.state is LinkState.RUN
