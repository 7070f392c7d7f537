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
"""Estimate of the dead time, and detection of a disturbed response."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.signal import lfilter
from support.long_tests import few_of

from t3mpc_ros.control.dead_time_estimator import (
    GRID_SIZE,
    GRID_STEP,
    IDENTIFIED_DEVIATION,
    MAX_DEAD_TIME,
    MIN_NOISE_VARIANCE,
    PRIOR_DEVIATION,
    USED_DIFFERENCE,
    DeadTimeEstimator,
)
from t3mpc_ros.control.speed_kalman_filter import SpeedFilterParameters
from t3mpc_ros.evaluation.loop import NodeMethod
from t3mpc_ros.evaluation.loop import run as run_loop
from t3mpc_ros.evaluation.scenario import Scenario

PERIOD = 0.01
SUBSTEPS = 20
"""Substeps of the simulated robot in a control period."""
LAG = 0.003
NOISE_VARIANCE = 0.04


@dataclass
class Drive:
    """Commands of a run and the measured response, one row for each control period."""

    command: np.ndarray
    measured: np.ndarray


def smooth_commands(duration: float, seed: int, rate: float = 4.0) -> np.ndarray:
    """Return wheel speeds (rad/s) whose rate of change has an RMS of ``rate`` (rad/s²)."""
    rng = np.random.default_rng(seed)
    time = PERIOD * np.arange(round(duration / PERIOD))[:, None, None]
    pulsation = rng.uniform(0.5, 6.0, size=(6, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, size=(6, 2))
    amplitude = rate * np.sqrt(2.0 / 6.0) / pulsation
    return np.sum(amplitude * np.sin(pulsation * time + phase), axis=1)


def simulate(
    command: np.ndarray,
    dead_time: float | np.ndarray,
    seed: int,
    *,
    lag: float = LAG,
    noise_variance: float = NOISE_VARIANCE,
) -> Drive:
    """Return the response to commands that arrive ``dead_time`` late; the newest one counts.

    The measured speeds are means over a period, as those from counters of steps.
    """
    count = len(command)
    step = PERIOD / SUBSTEPS
    arrival = np.round((PERIOD * np.arange(count) + dead_time) / step).astype(int)
    newest = np.full(count * SUBSTEPS, -1)
    inside = arrival < newest.size
    np.maximum.at(newest, arrival[inside], np.flatnonzero(inside))
    newest = np.maximum.accumulate(newest)
    active = np.where(newest[:, None] >= 0, command[newest], 0.0)
    decay = np.exp(-step / lag)
    speeds = lfilter([1.0 - decay], [1.0, -decay], active, axis=0)
    mean = speeds.reshape(count, SUBSTEPS, 2).mean(axis=1)
    measured = np.vstack([np.zeros((1, 2)), mean[:-1]])
    noise = np.random.default_rng(1000 + seed).normal(size=measured.shape)
    return Drive(command, measured + np.sqrt(noise_variance) * noise)


def run(
    drive: Drive,
    *,
    configured: float = 0.01,
    lag: float = LAG,
    noise_variance: float = NOISE_VARIANCE,
    rows: np.ndarray | None = None,
    **kind: bool,
) -> tuple[DeadTimeEstimator, np.ndarray]:
    """Return the estimator after a run, and rows of estimate, deviation, disturbance, use."""
    parameters = SpeedFilterParameters(
        lag=lag, dead_time=configured, noise_variance=noise_variance
    )
    estimator = DeadTimeEstimator(parameters, PERIOD, **kind)
    rows = np.arange(len(drive.command)) if rows is None else rows
    record = np.zeros((len(rows), 4))
    record[0, [0, 3]] = configured
    for k in range(1, len(rows)):
        dt = PERIOD * (rows[k] - rows[k - 1])
        disturbed = estimator.step(drive.measured[rows[k]], drive.command[rows[k - 1]], dt)
        record[k] = (
            *(estimator.dead_time, estimator.standard_deviation),
            *(disturbed, estimator.dead_time_in_use),
        )
    assert np.all((record[:, 0] >= 0.0) & (record[:, 0] <= MAX_DEAD_TIME))
    return estimator, record


def at(seconds: float) -> int:
    return round(seconds / PERIOD)


@pytest.mark.compiled
@pytest.mark.parametrize('dead_time', few_of([0.0375, 0.12, 0.01, 0.03, 0.06], 2))
def test_the_dead_time_is_found_within_its_deviation(dead_time):
    errors = []
    for seed in range(4):
        drive = simulate(smooth_commands(45.0, seed), dead_time, seed)
        estimator, record = run(drive)
        assert estimator.standard_deviation <= IDENTIFIED_DEVIATION
        assert abs(record[at(2.0), 0] - dead_time) < 0.008
        assert np.abs(record[at(30.0) :, 0] - dead_time).max() < 0.0025
        assert not record[:, 2].any()
        for seconds in (5.0, 20.0, 44.0):
            row = record[at(seconds)]
            errors.append((row[0] - dead_time) / row[1])
    assert np.sqrt(np.mean(np.square(errors))) < 1.7
    assert abs(np.mean(errors)) < 1.0
    # The deviation is that of the noise: it neither hides the error nor exaggerates it.
    assert np.sqrt(np.mean(np.square(errors))) > 0.4


@pytest.mark.compiled
def test_dead_time_and_lag_are_identified_as_a_sum():
    command = smooth_commands(30.0, 3)
    drive = simulate(command, 0.03, 3, lag=0.02)
    sums = [run(drive, lag=lag)[0].dead_time + lag for lag in (0.015, 0.02, 0.03)]
    np.testing.assert_allclose(sums, 0.05, atol=0.002)


@pytest.mark.compiled
def test_evidence_is_that_of_the_deviations_between():
    """2 log of the likelihood ratio is the square of the number of standard deviations."""
    for seed in range(3):
        estimator, record = run(simulate(smooth_commands(10.0, seed), 0.03, seed))
        found, deviation = record[-1, :2]
        for other in (found - 0.008, found + 0.012):
            expected = ((other - found) / deviation) ** 2
            assert estimator.evidence_against(other) == pytest.approx(expected, rel=0.15)
        assert estimator.evidence_against(found) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize('configured', [0.0, 0.01])
def test_a_response_before_its_lag_has_passed_shows_early(configured):
    """A lag of 20 ms that the robot has not: its best dead time is below 0, where no grid is.

    It was not seen before the deviation from 10 ms was clear, for up to six seconds.
    """
    shown, none = [], []
    for seed in range(6):
        command = smooth_commands(3.0, seed)
        drive = simulate(command, 0.005, seed, lag=0.0005)
        shown.append(run(drive, lag=0.02, configured=configured)[0].evidence_against(configured))
        drive = simulate(command, configured, seed, lag=0.02)
        none.append(run(drive, lag=0.02, configured=configured)[0].evidence_against(configured))
    assert np.median(shown) > 8.0
    assert max(none) < 4.0


def test_a_drive_without_dead_time_is_identified():
    """The costs bend down at the end of the grid, so the deviation stayed that of the prior."""
    _, record = run(simulate(smooth_commands(10.0, 1), 0.0, 1))
    assert record[at(5.0) :, 3].max() == 0.0


def test_the_estimate_is_invariant_to_the_scale_of_the_speeds():
    drive = simulate(smooth_commands(10.0, 5), 0.04, 5)
    scaled = Drive(10.0 * drive.command, 10.0 * drive.measured)
    _, record = run(drive)
    _, record_scaled = run(scaled, noise_variance=100.0 * NOISE_VARIANCE)
    np.testing.assert_allclose(record_scaled, record, rtol=1e-6, atol=1e-9)


@pytest.mark.compiled
@pytest.mark.parametrize('speed', [0.0, 3.0])
def test_constant_commands_identify_nothing(speed):
    command = np.full((at(20.0), 2), speed)
    drive = simulate(command, 0.05, 7)
    estimator = DeadTimeEstimator(SpeedFilterParameters(lag=LAG), PERIOD)
    estimator.reset(command[0])
    for k in range(at(1.0), len(command)):
        estimator.step(drive.measured[k], command[k - 1], PERIOD)
    assert not estimator.estimate.disturbed
    assert estimator.standard_deviation > 0.6 * PRIOR_DEVIATION
    assert abs(estimator.dead_time - 0.01) < 1e-9


@pytest.mark.compiled
@pytest.mark.parametrize('assumed, variance', [(0.0, 0.04), (0.04, 0.2)])
def test_more_noise_than_assumed_is_learnt(assumed, variance):
    """All was disturbed then, but for some blocks whose estimate was adopted as certain."""
    others = []
    for seed in range(6):
        drive = simulate(smooth_commands(30.0, seed, 2.0), 0.01, seed, noise_variance=variance)
        estimator, record = run(drive, noise_variance=assumed)
        learnt = estimator.estimate.noise_ratio * max(assumed, MIN_NOISE_VARIANCE)
        assert learnt == pytest.approx(variance, rel=0.15)
        assert not record[at(10.0) :, 2].any()
        others.append(np.mean(record[:, 3] != 0.01))
    assert np.mean(others) < 0.1


@pytest.mark.compiled
def test_noise_is_learnt_as_fast_after_an_exact_standstill():
    """Nothing changes while the robot stands; the median was ever smaller, and 0 after 6 min."""
    drive = simulate(smooth_commands(20.0, 1, 2.0), 0.01, 1)
    still = np.zeros((at(400.0), 2))
    command, measured = (np.vstack([still, each]) for each in (drive.command, drive.measured))
    estimator, record = run(Drive(command, measured), noise_variance=0.0)
    assert estimator.estimate.noise_ratio * MIN_NOISE_VARIANCE == pytest.approx(0.04, rel=0.15)
    assert record[at(402.0) :, 2].mean() < 0.1


@pytest.mark.compiled
@pytest.mark.parametrize('duration', [1.0, 3.0])
def test_late_commands_leave_no_trace(duration):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        count = at(30.0 + duration + 20.0)
        dead_time = np.full(count, 0.01)
        late = slice(at(30.0), at(30.0 + duration))
        dead_time[late] += rng.uniform(0.02, 0.12, size=late.stop - late.start)
        _, record = run(simulate(smooth_commands(count * PERIOD, 40 + seed), dead_time, seed))
        disturbed = record[:, 2].astype(bool)
        assert not disturbed[: at(30.0)].any()
        assert disturbed[at(30.0) : at(31.0)].any()
        assert disturbed[at(31.0) : late.stop + 1].mean() > 0.9 or duration <= 1.0
        assert not disturbed[late.stop + at(3.0) :].any()
        before = record[at(30.0), 0]
        assert np.abs(record[late.start : late.stop + at(5.0), 0] - before).max() < 0.003
        assert (record[late.start : late.stop + at(5.0), 3] == 0.01).all()
        assert abs(record[-1, 0] - 0.01) < 0.002


@pytest.mark.compiled
def test_commands_late_for_longer_are_soon_forgotten():
    """Late at random times for 6 s they are a dead time of 60 ms, and may be taken for it."""
    for seed in range(4):
        dead_time = np.full(at(56.0), 0.01)
        dead_time[at(30.0) : at(36.0)] += np.random.default_rng(seed).uniform(0.02, 0.12, at(6.0))
        _, record = run(simulate(smooth_commands(56.0, 40 + seed), dead_time, seed))
        assert record[:, 0].max() < 0.075
        assert np.abs(record[at(42.0) :, 0] - 0.01).max() < 0.006
        assert abs(record[-1, 0] - 0.01) < 0.002


@pytest.mark.compiled
@pytest.mark.parametrize('change', few_of([0.035, 0.02, 0.05], 2))
@pytest.mark.parametrize('sign', [1, -1])
def test_a_change_is_adopted_within_8_s(change, sign):
    """It once took 16 to 63 s, or for ever where it was 20 ms."""
    count = at(60.0)
    first, second = (0.01, 0.01 + change)[::sign]
    dead_time = np.where(np.arange(count) < at(30.0), first, second)
    for seed in range(2):
        drive = simulate(smooth_commands(60.0, 60 + seed), dead_time, seed)
        _, record = run(drive, configured=first)
        assert np.abs(record[at(20.0) : at(30.0), 0] - first).max() < 0.004
        assert np.abs(record[at(37.0) :, 0] - second).max() < 0.006
        assert abs(record[-1, 0] - second) < 0.002
        assert not record[at(39.0) :, 2].any()


@pytest.mark.compiled
def test_gaps_in_the_odometry_are_no_disturbance():
    """The robot keeps its command while a message is lost, and the model does, too."""
    drive = simulate(smooth_commands(40.0, 70), 0.0, 70)
    kept = np.random.default_rng(70).random(len(drive.command)) > 0.2
    rows = np.flatnonzero(kept)
    held = rows[np.maximum(np.cumsum(kept) - 1, 0)]
    drive = simulate(drive.command[held], 0.035, 70)
    estimator, record = run(drive, rows=rows)
    assert not record[:, 2].any()
    assert abs(estimator.dead_time - 0.035) < 0.002


def test_a_dead_time_beyond_the_grid_stays_at_its_end():
    drive = simulate(smooth_commands(40.0, 90), MAX_DEAD_TIME + 0.03, 90)
    estimator, _ = run(drive, configured=0.14)
    assert MAX_DEAD_TIME - 0.01 < estimator.dead_time <= MAX_DEAD_TIME


def test_a_reset_keeps_the_estimate_and_ends_the_disturbance():
    drive = simulate(smooth_commands(20.0, 95), 0.04, 95)
    estimator, _ = run(drive)
    for k in range(50):
        estimator.step(drive.measured[k] + 5.0 * (-1.0) ** k, drive.command[k], PERIOD)
    assert estimator.estimate.disturbed
    before = estimator.dead_time, estimator.standard_deviation, estimator.estimate.noise_ratio
    estimator.reset(np.zeros(2))
    assert not estimator.estimate.disturbed
    after = estimator.dead_time, estimator.standard_deviation, estimator.estimate.noise_ratio
    assert after == before


@pytest.mark.compiled
def test_speeds_at_the_stamp_need_the_other_model():
    """The mean over a period is half a period older than the speed at its end."""
    command = smooth_commands(40.0, 97)
    decay = np.exp(-PERIOD / 0.02)
    response = lfilter([0.0, 1.0 - decay], [1.0, -decay], command, axis=0)
    response = np.vstack([np.zeros((3, 2)), response[:-3]])  # three periods of dead time
    noise = np.random.default_rng(97).normal(scale=0.2, size=response.shape)
    drive = Drive(command, response + noise)
    errors = [
        run(drive, lag=0.02, mean_speeds=mean_speeds)[0].dead_time - 0.03
        for mean_speeds in (False, True)
    ]
    np.testing.assert_allclose(errors, [0.0, -0.5 * PERIOD], atol=0.002)


@pytest.mark.compiled
@pytest.mark.slow
def test_the_stepper_twin_with_an_unknown_dead_time():
    duration = 12.0
    scenario = Scenario('twin', 'unknown dead time 60 ms', 7, duration)
    record = run_loop(scenario, NodeMethod('full', {}))
    drive = Drive(record['sent'], record['measured'])
    estimator, trace = run(drive, rows=np.arange(at(record.start), at(duration)))
    assert estimator.standard_deviation <= IDENTIFIED_DEVIATION
    # The motors respond some milliseconds later than the lag of the model.
    assert 0.058 < estimator.dead_time < 0.066
    assert not trace[:, 2].any()


SERVO_LAG = 0.02
FRICTION = np.array([[3.1, 1.3], [1.3, 3.1]])
"""Accelerations (rad/s²) by the Coulomb friction of each wheel of the paper's robot."""


def servo(
    dead_time: float,
    seed: int,
    *,
    friction: float = 1.0,
    lag: float = SERVO_LAG,
    noise_variance: float = NOISE_VARIANCE,
    duration: float = 30.0,
) -> Drive:
    """Return the response of servos with ``friction`` times the friction; speeds at the stamp."""
    command = smooth_commands(duration, seed)
    step, late = PERIOD / 5, round(dead_time / PERIOD)
    speeds = np.zeros((len(command), 2))
    for k in range(1, len(command)):
        chi = speeds[k - 1]
        active = command[k - 1 - late] if k > late else np.zeros(2)
        for _ in range(5):
            load = friction * FRICTION @ np.tanh(chi / 0.2)
            chi = chi + step * ((active - chi) / lag - load)
        speeds[k] = chi
    noise = np.random.default_rng(2000 + seed).normal(size=speeds.shape)
    return Drive(command, speeds + np.sqrt(noise_variance) * noise)


def run_servo(
    drive: Drive, *, friction: bool = True, noise_variance: float = NOISE_VARIANCE
) -> np.ndarray:
    """Return estimate and dead time in use (s) of each row; 10 ms are configured."""
    model = {'lag': SERVO_LAG, 'mean_speeds': False, 'friction': friction}
    return run(drive, noise_variance=noise_variance, **model)[1][:, [0, 3]]


@pytest.mark.compiled
@pytest.mark.parametrize('friction', few_of([4.0, 0.0, 1.0, 3.0], 2))
@pytest.mark.parametrize('dead_time', few_of([0.03, 0.06]))
@pytest.mark.slow
def test_dead_time_of_a_servo_is_found_with_friction(dead_time, friction):
    for seed in range(2):
        record = run_servo(servo(dead_time, seed, friction=friction))
        assert np.abs(record[at(10.0) :] - dead_time).max() < 0.006
        assert np.abs(record[at(25.0) :] - dead_time).max() < 0.004


@pytest.mark.compiled
@pytest.mark.parametrize('friction', few_of([4.0, 0.0, 1.0, 3.0]))
@pytest.mark.parametrize('noise_variance', few_of([0.04, 0.0, 0.1]))
@pytest.mark.slow
def test_friction_is_not_taken_for_dead_time(friction, noise_variance):
    """With offsets alone, friction of 12 rad/s² was a delay of some 30 ms for many seconds."""
    for seed in range(2):
        drive = servo(0.01, seed, friction=friction, noise_variance=noise_variance)
        record = run_servo(drive, noise_variance=noise_variance)
        np.testing.assert_array_equal(record[:, 1], 0.01)


@pytest.mark.compiled
@pytest.mark.slow
def test_the_friction_model_halves_the_error_by_friction():
    errors = {True: [], False: []}
    for seed in range(2):
        drive = servo(0.01, seed, friction=4.0)
        for model in errors:
            record = run_servo(drive, friction=model)
            errors[model].append(np.abs(record[at(20.0) :, 0] - 0.01).mean())
    assert np.mean(errors[True]) < 0.5 * np.mean(errors[False])


def test_small_differences_keep_the_configured_dead_time():
    estimator = DeadTimeEstimator(SpeedFilterParameters(lag=LAG, dead_time=0.03), PERIOD)
    for difference, deviation, used in (
        (0.9 * USED_DIFFERENCE, 1e-4, 0.03),
        (1.1 * USED_DIFFERENCE, 1e-4, 0.03 + 1.1 * USED_DIFFERENCE),
        (0.02, 0.008, 0.03),
        (0.02, 0.006, 0.05),
    ):
        shown(estimator, 0.03 + difference, deviation)
        assert estimator.dead_time_in_use == pytest.approx(used, abs=1e-12)


def test_an_estimate_of_no_dead_time_is_as_certain_as_others():
    """Exact robots (5 of 60) were said to have no dead time: the curve at 0 had the deviation."""
    estimator = DeadTimeEstimator(SpeedFilterParameters(lag=LAG, dead_time=0.01), PERIOD)
    shown(estimator, 0.0, 0.005)
    estimator.estimate.deviation = 0.0025
    assert estimator.dead_time_in_use == 0.01
    shown(estimator, 0.0, 0.003)
    assert estimator.dead_time_in_use == 0.0
    estimator.estimate.deviation = 0.0127  # a robot that stood, one block: no parabola
    assert estimator.dead_time_in_use == 0.01


def shown(estimator, dead_time, deviation):
    """Make the data of an estimator show a dead time (s) with a standard deviation (s)."""
    estimate = estimator.estimate
    estimate.dead_time, estimate.deviation = dead_time, deviation
    grid = GRID_STEP * np.arange(GRID_SIZE)
    estimate.accepted.costs = estimate.noise_ratio * ((grid - dead_time) / deviation) ** 2


@pytest.mark.parametrize('seed', range(4))
def test_the_mean_speed_tells_late_turns_from_a_dead_time(seed):
    """A yaw rate that alone was 50 ms late was the dead time of the robot for some seconds."""
    mean, half = smooth_commands(4.0, seed, rate=1.0)[:, :1], smooth_commands(4.0, 9 + seed)[:, :1]
    command = np.hstack([mean + half, mean - half])
    prompt, late = (simulate(command, each, seed).measured for each in (0.01, 0.06))
    turns = 0.5 * (late[:, :1] - late[:, 1:])
    turns_late = 0.5 * prompt.sum(axis=1, keepdims=True) + turns * [1.0, -1.0]
    evidence = []
    for measured in (late, turns_late):
        estimator, _ = run(Drive(command, measured))
        assert estimator.dead_time > 0.02  # by both wheels
        evidence.append(estimator.contradictions(estimator.dead_time, 0.01)[0])
    assert evidence[0] < 0.0
    assert evidence[1] > 4.0


@pytest.mark.parametrize(('noise', 'least'), [(0.2, 9.0), (1.0, 0.0)])
def test_the_pose_tells_a_wrong_twist_from_a_dead_time(noise, least):
    """A twist that was repeated for 0.1 s each second was a dead time: four times the error."""
    command = smooth_commands(6.0, 3)
    prompt, late, repeated = (simulate(command, each, 3).measured for each in (0.01, 0.04, 0.01))
    for k in range(1, len(repeated)):
        if 0 < k % 30 <= 20:
            repeated[k] = repeated[k - 1]
    parameters = SpeedFilterParameters(lag=LAG, dead_time=0.01, noise_variance=NOISE_VARIANCE)
    noises = noise * np.random.default_rng(5).normal(size=prompt.shape)
    evidence = []
    for measured, pose in ((late, late + noises), (repeated, prompt + noises)):
        estimator = DeadTimeEstimator(parameters, PERIOD)
        for k in range(1, len(command)):
            estimator.step(measured[k], command[k - 1], PERIOD, pose[k])
        assert estimator.dead_time > 0.03  # by the twist
        evidence.append(estimator.contradictions(estimator.dead_time, 0.01)[1])
    assert evidence[0] <= -least
    assert evidence[1] >= least


def test_without_a_pose_nothing_contradicts():
    command = smooth_commands(2.0, 1)
    estimator, _ = run(simulate(command, 0.04, 1))
    assert estimator.contradictions(0.04, 0.01)[1] == 0.0
