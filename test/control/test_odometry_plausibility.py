# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Plausibility of odometry: clock, rate, gain and sign of the response."""

import math

import pytest

from t3mpc_ros.control.watchdog import InputMonitor
from t3mpc_ros.geometry.types import NANOSECONDS, BodyTwist


def monitor(rate=100.0, real_rate=100.0, offset=0.01, gains=(1.0, 1.0), seconds=10.0, lag=3):
    """Return a monitor after some seconds of a sinusoidal run."""
    made = InputMonitor(rate)
    commands = []
    for step in range(round(seconds * real_rate)):
        t = step / real_rate
        commands.append(BodyTwist(0.2 * math.sin(t), math.cos(2.0 * t)))
        old = commands[max(0, step - lag)]
        measured = BodyTwist(gains[0] * old.linear, gains[1] * old.angular)
        stamp_ns = round(t * NANOSECONDS)
        made.update(stamp_ns, stamp_ns + round(offset * NANOSECONDS), measured, commands[-1])
    return made


@pytest.mark.parametrize('rate', [20.0, 50.0, 100.0])
@pytest.mark.parametrize('offset', [0.0, 0.1])
def test_a_robot_that_fits_gives_no_warning(rate, offset):
    found = monitor(rate, rate, offset, (0.95, 1.1), seconds=30.0)
    assert found.warnings(simulated_time=False) == []
    assert found.gain(0) == pytest.approx(0.95, abs=0.05)
    assert found.rate == pytest.approx(rate, rel=0.01)


@pytest.mark.parametrize(
    'values, words',
    [
        ({'offset': 1.0}, 'odom is stamped 1 s behind the clock'),
        ({'offset': -1.0}, 'odom is stamped 1 s ahead of the clock'),
        ({'real_rate': 50.0}, 'odom has 50 Hz, but rate is 100 Hz'),
        ({'gains': (0.5, 1.0)}, 'the linear velocity in odom is 0.5'),
        ({'gains': (1.0, 2.0)}, 'the angular velocity in odom is 2'),
        ({'gains': (1.0, -1.0)}, 'the angular velocity in odom is with the opposite sign, -1.00'),
    ],
)
def test_what_does_not_fit_is_named(values, words):
    (warning,) = monitor(**values).warnings(simulated_time=False)
    assert warning.startswith(words)


def test_simulated_time_may_run_ahead_of_the_messages():
    assert monitor(offset=1.0).warnings(simulated_time=True) == []


def test_without_excitation_the_gain_is_unknown():
    made = InputMonitor(100.0)
    for step in range(1000):
        made.update(step * 10_000_000, step * 10_000_000, BodyTwist(0.0, 0.0), None)
    assert made.gain(0) is made.gain(1) is None
    assert made.warnings(simulated_time=False) == []
