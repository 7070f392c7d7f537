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
"""Input shaper: what it cancels, what it preserves, and its timing."""

import math

import numpy as np
import pytest

from t3mpc_ros.control.input_shaper import InputShaper, InputShaperParameters
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia

PERIOD = 0.01
PARAMETERS = InputShaperParameters()


def shaped(function, steps, parameters=PARAMETERS, gaps=()):
    """Return the shaped reference at the times k PERIOD of a function of time, shape (n, 2)."""
    shaper = InputShaper(parameters, PERIOD)
    lead = shaper.lead_ns / 1e9
    shaper.reset(function(0.0))
    result, elapsed = [], PERIOD
    for k in range(steps):
        if k in gaps:
            elapsed += PERIOD
            result.append(np.full(2, math.nan))
            continue
        shaper.step(function(k * PERIOD + lead), elapsed)
        elapsed = PERIOD
        result.append(shaper.reference.copy())
    return np.array(result)


def test_default_frequencies_are_those_of_the_default_robot():
    """sqrt(k/J)/(2 pi) of straight motion and turning, from motor and body."""
    robot = DigitalTwinParameters()
    motor = robot.motor
    stiffness = motor.teeth * motor.torque_constant * motor.phase_current
    inertia = wheel_inertia(robot.body, robot.geometry) + np.eye(2) * motor.rotor_inertia
    straight, turning = inertia[0, 0] + inertia[0, 1], inertia[0, 0] - inertia[0, 1]
    assert PARAMETERS.straight_frequency == pytest.approx(
        math.sqrt(stiffness / straight) / (2.0 * math.pi), rel=0.01
    )
    assert PARAMETERS.turning_frequency == pytest.approx(
        math.sqrt(stiffness / turning) / (2.0 * math.pi), rel=0.01
    )


@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.slow
def test_the_frequency_of_a_mode_is_cancelled(sign):
    frequency = PARAMETERS.straight_frequency if sign > 0.0 else PARAMETERS.turning_frequency

    def sine(time):
        value = math.sin(2.0 * math.pi * frequency * time)
        return np.array([value, sign * value])

    assert np.max(np.abs(shaped(sine, 300)[50:])) < 0.15
    other = PARAMETERS.turning_frequency if sign > 0.0 else PARAMETERS.straight_frequency
    assert abs(math.cos(0.5 * math.pi * other / frequency)) > 0.1


def test_another_frequency_is_cancelled_after_it_was_found():
    shaper = InputShaper(InputShaperParameters(6.0, 4.0), PERIOD)
    shaper.retune(PARAMETERS)
    lead, values = shaper.lead_ns / 1e9, []
    for k in range(300):
        value = math.sin(2.0 * math.pi * PARAMETERS.turning_frequency * (k * PERIOD + lead))
        shaper.step(np.array([value, -value]), PERIOD)
        values.append(shaper.reference.copy())
    assert np.max(np.abs(values[50:])) < 0.15


def test_an_oscillator_rests_after_a_shaped_ramp():
    """Undamped rotor on its field: the ring after a ramp is below a tenth of the unshaped one."""
    omega = 2.0 * math.pi * PARAMETERS.straight_frequency

    def ramp(time):
        return np.full(2, 30.0 * min(max(time - 0.5, 0.0), 0.1))

    rings = []
    for commands in (shaped(ramp, 150)[:, 0], np.array([ramp(k * PERIOD)[0] for k in range(150)])):
        speed = rate = 0.0
        substeps, ring = 50, []
        for before, after in zip(commands, commands[1:], strict=False):
            for j in range(substeps):
                command = before + (after - before) * (j + 0.5) / substeps
                rate += omega**2 * (command - speed) * PERIOD / substeps
                speed += rate * PERIOD / substeps
            ring.append(speed - commands[-1])
        rings.append(np.max(np.abs(ring[90:])))
    assert rings[0] < 0.1 * rings[1]


def test_slopes_and_limits_are_preserved():
    """Straight lines pass unchanged, without delay; no speed or slope exceeds the input's."""
    none = InputShaperParameters(straight_frequency=0.0, turning_frequency=0.0)
    assert InputShaper(none, PERIOD).lead_ns == 0
    line = shaped(lambda t: np.array([3.0 * t, 1.0 - 2.0 * t]), 100)
    times = PERIOD * np.arange(100)
    expected = np.stack([3.0 * times, 1.0 - 2.0 * times], axis=1)
    np.testing.assert_allclose(line[20:], expected[20:], atol=1e-12)
    generator = np.random.default_rng(3)
    knots = np.cumsum(generator.uniform(-0.3, 0.3, (400, 2)), axis=0)

    def walk(time):
        return np.array([np.interp(time / PERIOD, np.arange(400), knots[:, i]) for i in range(2)])

    result = shaped(walk, 300)[10:]
    mean, half = result @ [0.5, 0.5], result @ [0.5, -0.5]
    assert np.max(np.abs(np.diff(mean))) <= np.max(np.abs(np.diff(knots @ [0.5, 0.5]))) + 1e-12
    assert np.max(np.abs(np.diff(half))) <= np.max(np.abs(np.diff(knots @ [0.5, -0.5]))) + 1e-12


def test_a_lost_step_is_bridged():
    def smooth(time):
        return np.array([math.sin(2.0 * time), math.cos(3.0 * time)])

    whole, bridged = shaped(smooth, 200), shaped(smooth, 200, gaps=(80, 81, 120))
    known = ~np.isnan(bridged[:, 0])
    np.testing.assert_allclose(bridged[known], whole[known], atol=2e-3)


@pytest.mark.parametrize('interval', [0.6, 0.77, 1.2, 1.45])
@pytest.mark.parametrize('jitter', [0.0, 0.2])
def test_steps_of_any_interval_are_shaped_alike(interval, jitter):
    """Intervals were rounded to whole periods: at 80 Hz for 100 Hz the error was four times."""

    def smooth(time):
        return np.array([math.sin(8.0 * time), math.cos(6.0 * time)])

    shaper, random = InputShaper(PARAMETERS, PERIOD), np.random.default_rng(1)
    lead, time, found, times = shaper.lead_ns / 1e9, 0.0, [], []
    for _ in range(150):
        elapsed = PERIOD * max(interval + jitter * random.uniform(-1.0, 1.0), 0.6)
        time += elapsed
        shaper.step(smooth(time + lead), elapsed)
        found.append([*shaper.reference, *shaper.rate])
        times.append(time)
    exact = [0.25 / PARAMETERS.straight_frequency, 0.25 / PARAMETERS.turning_frequency]
    wheels = np.array([[1.0, 1.0], [1.0, -1.0]])
    for (right, left, *rate), now in list(zip(found, times, strict=True))[30:]:
        parts = [
            [
                0.5 * share @ (smooth(at + d) + smooth(at - d))
                for share, d in zip(0.5 * wheels, exact, strict=True)
            ]
            for at in (now, now + PERIOD)
        ]
        reference, later = (wheels @ part for part in parts)
        np.testing.assert_allclose((right, left), reference, atol=3e-3)
        np.testing.assert_allclose(rate, (later - reference) / PERIOD, atol=0.15)


@pytest.mark.parametrize('speeds', [(3.0, 3.0), (2.0, -1.0)])
def test_a_start_in_motion_is_no_step(speeds):
    """The controller is enabled while the robot drives a curve: the curve goes on.

    Started with the wheels exchanged, the shaper would have turned the robot the other way first.
    """
    shaper = InputShaper(PARAMETERS, PERIOD)
    shaper.reset(np.array(speeds))
    for _ in range(30):
        shaper.step(np.array(speeds), PERIOD)
        np.testing.assert_allclose(shaper.reference, speeds, atol=1e-12)
        np.testing.assert_allclose(shaper.rate, 0.0, atol=1e-9)
