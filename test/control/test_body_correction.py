# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Body correction: learns what the gyro shows, and nothing where there is nothing to learn."""

import math

import numpy as np
import pytest

from t3mpc_ros.control.body_correction import BodyCorrection, BodyCorrectionParameters
from t3mpc_ros.geometry.kinematics import WheelGeometry

PERIOD = 0.01
GEOMETRY = WheelGeometry()
TURN = GEOMETRY.wheel_radius / GEOMETRY.half_separation
DELAY = 0.025
"""A command acts from two periods later on, for one period: 2.5 periods before its middle."""


class Body:
    """A robot whose body turns by ``response`` of the wheel speeds of one delay before."""

    def __init__(self, response, noise=0.0, seed=1, **changes):
        self.correction = BodyCorrection(
            BodyCorrectionParameters.from_dict(changes),
            GEOMETRY.wheel_radius,
            GEOMETRY.half_separation,
            PERIOD,
        )
        self.response = response
        self.noise = noise
        self.generator = np.random.default_rng(seed)
        self.yaw = self.reference_yaw = 0.0
        self.sent = [np.zeros(2)] * 3
        self.k = 0

    def reference(self, k):
        t = k * PERIOD
        mean, half = 3.0 * math.sin(0.9 * t) + 1.0, 2.5 * math.sin(1.3 * t + 0.4)
        return np.array([mean + half, mean - half])

    def run(self, seconds, learn=True):
        """Return the errors of w, rad/s, shape (n,)."""
        errors = []
        for _ in range(round(seconds / PERIOD)):
            right, left = self.sent[-3]
            turn = self.response(right, left)
            self.yaw += PERIOD * TURN * (turn + self.generator.normal(0.0, self.noise))
            now = self.reference(self.k)
            before = self.reference(self.k - 1)
            wanted = 0.25 * (now[0] - now[1] + before[0] - before[1])
            errors.append(turn - wanted)
            ahead = self.reference(self.k + 2)
            change = self.correction.step(
                math.remainder(self.yaw, 2.0 * math.pi),
                PERIOD,
                now,
                ahead,
                self.sent[-1],
                DELAY,
                learn=learn,
            )
            self.sent.append(ahead + np.array([change, -change]))
            self.k += 1
        return np.array(errors)


def exact(right, left):
    return 0.5 * (right - left)


def miscalibrated(right, left):
    """Wheel radii +2 and -1 %, separation +3 %."""
    return 0.5 * (1.02 * right - 0.99 * left) / 1.03


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.compiled
def test_wrong_radii_and_separation_are_learnt():
    body = Body(miscalibrated, noise=0.02)
    before = rms(Body(miscalibrated, noise=0.02, enabled=True, learning_rate=0.0).run(40.0)[2000:])
    after = rms(body.run(40.0)[2000:])
    assert body.correction.authority == 1.0
    assert after < 0.35 * before


@pytest.mark.compiled
@pytest.mark.slow
def test_a_robot_that_is_exact_is_left_alone():
    """Noise of the gyro must not turn a good robot into a worse one."""
    for seed in range(3):
        body = Body(exact, noise=0.03, seed=seed)
        body.run(60.0)
        assert body.correction.authority == 0.0
        np.testing.assert_array_equal(body.sent[-1], body.reference(body.k + 1))


@pytest.mark.compiled
def test_the_map_decreases_the_lyapunov_function():
    """V = |alpha* - alpha|²/2 never increases without noise if the map can be represented."""
    body = Body(exact)
    fuzzy = body.correction.fuzzy
    generator = np.random.default_rng(4)
    ideal = generator.normal(0.0, 0.05, fuzzy.coefficients.shape)
    body.response = lambda right, left: (
        exact(right, left) + float(ideal[0] @ basis(body, right, left))
    )
    values = []
    for _ in range(300):
        body.run(0.1)
        values.append(float(np.sum((ideal - fuzzy.coefficients) ** 2)))
    assert np.max(np.diff(values)) < 1e-4 * values[0]
    points = [basis(body, *body.reference(body.k - 20 * j)) for j in range(50)]
    left = rms([float((ideal - fuzzy.coefficients)[0] @ phi) for phi in points])
    assert left < 0.25 * rms([float(ideal[0] @ phi) for phi in points])


def basis(body, right, left):
    """Return Phi without a change of the work space of the correction."""
    fuzzy = body.correction.fuzzy
    kept = fuzzy.basis
    fuzzy.evaluate(np.array([right, left]))
    phi = fuzzy.basis
    fuzzy.tables[6][:] = kept
    return phi


@pytest.mark.compiled
def test_yaw_error_from_a_push_is_removed():
    body = Body(miscalibrated, noise=0.01, yaw_gain=1.0, max_yaw_correction=0.1)
    body.run(20.0)
    body.yaw += 0.2
    body.run(6.0)
    assert abs(body.correction.yaw_error) < 0.03


@pytest.mark.compiled
def test_a_yaw_that_is_never_measured_changes_nothing():
    """A robot without yaw in its odometry: its "error" is as large as the command itself."""
    body = Body(lambda right, left: 0.0)
    body.run(30.0)
    assert body.correction.authority == 0.0


@pytest.mark.compiled
@pytest.mark.parametrize(('of_map', 'of_yaw'), [(0.0, 0.0), (0.1, 0.0), (0.0, 0.1), (0.1, 0.2)])
def test_the_corrections_are_bounded(of_map, of_yaw):
    body = Body(
        lambda right, left: 1.15 * exact(right, left),
        max_correction=of_map,
        max_yaw_correction=of_yaw,
    )
    body.run(30.0)
    corrections = [
        abs(0.5 * (sent[0] - sent[1]) - 0.5 * np.subtract(*body.reference(k + 2)))
        for k, sent in enumerate(body.sent[3:])
    ]
    assert 0.3 * (of_map + of_yaw) <= max(corrections) <= of_map + of_yaw + 1e-12


@pytest.mark.compiled
def test_a_rollback_restores_map_and_authority():
    body = Body(miscalibrated)
    body.run(20.0)
    snapshot, authority = body.correction.snapshot(), body.correction.authority
    body.response = lambda right, left: 0.9 * exact(right, left)
    body.run(10.0)
    body.correction.rollback(snapshot)
    np.testing.assert_array_equal(body.correction.fuzzy.coefficients, snapshot[0])
    assert body.correction.authority == authority


@pytest.mark.compiled
def test_nothing_is_learnt_while_disturbed():
    body = Body(miscalibrated)
    body.run(5.0)
    coefficients = body.correction.fuzzy.coefficients
    body.run(5.0, learn=False)
    np.testing.assert_array_equal(body.correction.fuzzy.coefficients, coefficients)


@pytest.mark.compiled
def test_a_slide_of_the_tyres_is_hardly_learnt():
    """It once stayed in the map: a third of a second on ice turned the robot for seconds."""
    body = Body(miscalibrated, noise=0.01)
    body.run(30.0)
    before = body.correction.fuzzy.coefficients.copy()
    body.response = lambda right, left: miscalibrated(right, left) + 0.8
    points = [body.reference(body.k + j) for j in range(30)]
    body.run(0.3)
    changed = body.correction.fuzzy.coefficients - before
    # 0.08 rad/s at 2/s for 0.3 s; without a limit it was 0.38.
    assert max(abs(float(changed[0] @ basis(body, *point))) for point in points) < 0.08
    assert body.correction.authority > 0.9
