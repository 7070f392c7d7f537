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
"""Link statistics: counters, loss rate, round trips, and the resulting level."""

import math

from t3mpc_ros.radio.link.statistics import CableErrors, DiagnosticLevel, LinkStatistics, Loss
from t3mpc_ros.radio.protocol.frames import Pong
from t3mpc_ros.radio.protocol.framing import FrameCounts

NOTHING = FrameCounts(0, 0, 0)


def after(*trips):
    statistics = LinkStatistics(0.02, 0.2)
    for trip in trips:
        statistics.add_cycle(trip)
    return statistics


def test_quality_before_the_first_cycle():
    quality = LinkStatistics(0.02, 0.2).quality(math.inf, NOTHING)
    assert quality.level is DiagnosticLevel.ERROR
    assert quality.text == 'no telemetry for inf s'
    assert math.isnan(quality.lost_share)
    assert math.isnan(quality.round_trip_median)
    assert math.isnan(quality.round_trip_p99)


def test_losses_and_round_trips_of_the_last_ten_seconds():
    trips = [0.001 * (1 + at % 100) for at in range(1000)]
    statistics = after(*[Loss.RADIO] * 700, *trips)
    quality = statistics.quality(0.0, NOTHING)
    assert (quality.cycles, quality.lost) == (1700, 700)
    assert quality.lost_share == 0.0
    assert abs(quality.round_trip_median - 0.050) < 0.002
    assert abs(quality.round_trip_p99 - 0.099) < 0.0015


def test_more_than_one_loss_in_twenty_is_a_warning():
    cycle = [0.005] * 19 + [Loss.RADIO]
    assert after(*cycle * 10).quality(0.0, NOTHING).level is DiagnosticLevel.OK
    worse = after(*cycle * 10, Loss.RADIO).quality(0.0, NOTHING)
    assert worse.level is DiagnosticLevel.WARN
    assert worse.text.startswith('5.5 % of the cycles are lost on the radio')


def test_a_few_cycles_are_not_judged():
    assert after(Loss.RADIO, 0.005).quality(0.0, NOTHING).level is DiagnosticLevel.OK


def test_slow_round_trips_are_a_warning_with_their_usual_cause():
    assert after(*[0.009] * 100).quality(0.0, NOTHING).level is DiagnosticLevel.OK
    slow = after(*[0.005] * 97, *[0.016] * 3).quality(0.0, NOTHING)
    assert slow.level is DiagnosticLevel.WARN
    assert slow.text == 'round trips up to 16.0 ms: is the port in low-latency mode?'


def test_telemetry_older_than_the_ttl_is_an_error():
    statistics = after(*[0.005] * 100)
    assert statistics.quality(0.2, NOTHING).level is DiagnosticLevel.OK
    lost = statistics.quality(0.25, NOTHING)
    assert lost.level is DiagnosticLevel.ERROR
    assert lost.text == 'no telemetry for 0.25 s'


def test_retransmissions_are_counted_by_number():
    statistics = LinkStatistics(0.02, 0.2)
    for tries in (0, 0, 3, 15):
        statistics.add_exchange(tries)
    counted = statistics.quality(0.0, NOTHING).retransmissions
    assert counted == (2, 0, 0, 1, *[0] * 11, 1)


def test_the_hop_that_lost_most_is_named():
    for worst, text in (
        (Loss.NO_REPLY, 'at the dongle: no reply'),
        (Loss.RADIO, 'on the radio'),
        (Loss.ROBOT, 'at the robot'),
    ):
        statistics = after(*[0.005] * 60, *Loss, *[worst] * 3)
        quality = statistics.quality(0.0, NOTHING)
        assert f'are lost {text}' in quality.text
        assert quality.losses == {hop: 1 + 3 * (hop is worst) for hop in Loss}
        assert quality.lost == 6


def test_damaged_frames_tell_the_cable_from_the_dongle():
    statistics = after(*[0.005] * 60)
    statistics.add_pong(a_pong(65_530, 1, 0), False)
    statistics.count_host_errors(FrameCounts(100, 4, 3))
    for _ in range(5):
        statistics.add_cycle(Loss.NO_REPLY)
    statistics.add_pong(a_pong(4, 2, 0), False)  # its counters have 16 bits
    statistics.count_host_errors(FrameCounts(100, 6, 4))
    statistics.add_cycle(Loss.NO_REPLY)
    quality = statistics.quality(0.0, NOTHING)
    assert quality.cable_errors == CableErrors(10, 65_542)
    assert 'on the cable: 10 damaged frames at the host, 65542 at the dongle' in quality.text
    statistics.add_pong(a_pong(5, 0, 0), True)
    assert statistics.quality(0.0, NOTHING).cable_errors.dongle == 65_547


def a_pong(*counts):
    return Pong(0, bytes(4), 0, 2, 2, 1, 1, *counts, 0, 0, 82, b'T3MPC', 0)


def test_a_silence_is_blamed_on_the_hop_of_its_own_cycles():
    assert not LinkStatistics(0.02, 0.2).lost_before_radio()
    assert not after(Loss.NO_REPLY, 0.005).lost_before_radio()
    assert after(0.005, Loss.NO_REPLY, Loss.NO_REPLY, Loss.RADIO).lost_before_radio()
    assert not after(0.005, Loss.NO_REPLY, Loss.RADIO, Loss.RADIO).lost_before_radio()


def test_losses_that_a_restart_explains_are_not_judged():
    """A robot that had restarted was warned of as a bad radio for ten seconds."""
    statistics = after(*[0.005] * 90, *[Loss.RADIO] * 10)
    assert 'on the radio' in statistics.quality(0.0, NOTHING).text
    statistics.explain_losses()
    quality = statistics.quality(0.0, NOTHING)
    assert (quality.text, quality.lost, quality.lost_share) == ('', 10, 0.0)
    for _ in range(6):
        statistics.add_cycle(Loss.RADIO)
    assert '6.2 % of the cycles are lost on the radio' in statistics.quality(0.0, NOTHING).text
