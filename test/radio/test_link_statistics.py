# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Link statistics: counters, loss rate, round trips, and the resulting level."""

import math

from t3mpc_ros.radio.link.statistics import DiagnosticLevel, LinkStatistics
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
    statistics = after(*[None] * 700, *trips)
    quality = statistics.quality(0.0, NOTHING)
    assert (quality.cycles, quality.lost) == (1700, 700)
    assert quality.lost_share == 0.0
    assert abs(quality.round_trip_median - 0.050) < 0.002
    assert abs(quality.round_trip_p99 - 0.099) < 0.0015


def test_more_than_one_loss_in_twenty_is_a_warning():
    cycle = [0.005] * 19 + [None]
    assert after(*cycle * 10).quality(0.0, NOTHING).level is DiagnosticLevel.OK
    worse = after(*cycle * 10, None).quality(0.0, NOTHING)
    assert worse.level is DiagnosticLevel.WARN
    assert worse.text == '5.5 % of the cycles are lost'


def test_a_few_cycles_are_not_judged():
    assert after(None, 0.005).quality(0.0, NOTHING).level is DiagnosticLevel.OK


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
