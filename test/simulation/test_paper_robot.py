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
"""Simulated robot with the paper's plant: time, stops, determinism, convergence."""

import math

import numpy as np
import pytest

from t3mpc_ros.geometry.sample_scheduler import SampleScheduler
from t3mpc_ros.geometry.types import Pose, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.interface import RobotCommand, RobotState
from t3mpc_ros.simulation.paper_robot import PaperRobot
from t3mpc_ros.simulation.plant.paper_plant import PaperRobotParameters

MS = 1_000_000
PERIOD = 10 * MS


def robot(**changes: object) -> PaperRobot:
    dotted = {name.replace('__', '.'): value for name, value in changes.items()}
    return PaperRobot(PaperRobotParameters.from_dict(dotted))


def command(right: float, left: float, now_ns: int) -> RobotCommand:
    return RobotCommand(WheelSpeeds(right, left), now_ns)


def numbers(state: RobotState) -> tuple:
    return (
        state.stamp_ns,
        *state.wheels,
        *state.angles,
        *state.odometry.pose,
        *state.covariance.ravel().tolist(),
        *state.commanded,
        *state.true_wheels,
        *state.truth.pose,
        *state.truth.twist,
    )


def wander(tick: int) -> WheelSpeeds:
    side = 1.0 if (tick // 200) % 2 else -1.0
    return WheelSpeeds(
        5.0 + 4.0 * math.sin(0.013 * tick), 5.0 + 4.0 * side * math.cos(0.009 * tick)
    )


# -- stops ----------------------------------------------------------------------------------------


ENDS = {
    'silence': lambda robot, now_ns: None,
    'estop': lambda robot, now_ns: robot.latch_estop('test', now_ns + 100 * MS),
    'stop': lambda robot, now_ns: robot.stop('test', now_ns),
    'zero': lambda robot, now_ns: robot.apply(command(0.0, 0.0, now_ns), now_ns),
    'nonsense': lambda robot, now_ns: robot.apply(command(math.nan, 1.0, now_ns), now_ns),
}


@pytest.mark.parametrize('end', ENDS)
def test_wheels_stop_within_half_a_second_from_10_rad_s(end):
    generator = np.random.default_rng(11)
    for seed in range(6):
        simulated = robot(seed=seed)
        now = 0
        simulated.advance(now)
        for _ in range(int(generator.integers(1, 8))):
            # Any speed up to the maximum and any reversal, at any instant.
            wheels = generator.uniform(-10.0, 10.0, 2)
            if generator.uniform() < 0.5:
                wheels = 10.0 * np.sign(wheels)
            simulated.apply(command(*wheels, now), now)
            last = now
            now += int(generator.uniform(0.0, 240.0) * MS)
        ENDS[end](simulated, last)
        after = simulated.advance(last + 500 * MS)
        assert after.stamp_ns > last + 485 * MS
        assert not after.status.moving, (seed, after)
        assert max(map(abs, after.true_wheels)) < 0.1
        assert after.commanded == (0.0, 0.0)


@pytest.mark.parametrize('bad', [math.nan, math.inf])
def test_non_finite_torque_brakes(bad):
    simulated = robot(drive__kind='torque')
    for _ in range(100):
        state = simulated.step_torque(0.02, 0.02)
    assert state.true_wheels.right > 5.0
    for _ in range(100):
        state = simulated.step_torque(bad, 0.02)
    assert not state.status.moving
    assert 'not finite' in state.reason
    simulated.latch_estop('button', state.stamp_ns)
    for _ in range(20):
        state = simulated.step_torque(0.02, 0.02)
    assert not state.status.moving
    assert state.status.estop


def test_torque_command_times_out():
    simulated = robot(drive__kind='torque')
    simulated.step_torque(0.02, 0.02)
    assert simulated.advance(250 * MS).status.moving
    after = simulated.advance(600 * MS)
    assert after.status.timed_out
    assert not after.status.moving


def test_finite_commands_give_finite_states():
    generator = np.random.default_rng(12)
    extremes = [0.0, 1e-308, 1.0, 1e3, 1e150, 1.7e308]
    for kind in ('velocity', 'torque'):
        simulated = robot(
            drive__kind=kind,
            drive__torque_limit=100.0,
            wheel__max_velocity=200.0,
            max_stopping_time=10.0,
            linear__x__max_velocity=5.0,
            angular__z__max_velocity=50.0,
            friction__viscous=0.0,
            friction__coulomb=0.0,
            body__com_offset=0.1,
        )
        step = simulated.step_torque if kind == 'torque' else None
        for _ in range(200):
            pair = generator.choice(extremes, 2) * generator.choice([-1.0, 1.0], 2)
            state = step(*pair) if step else simulated.step(WheelSpeeds(*pair))
            assert np.all(np.isfinite(numbers(state)))
            assert max(map(abs, state.true_wheels)) <= simulated.parameters.drive.speed_ceiling


# -- time -----------------------------------------------------------------------------------------


def test_states_lie_on_the_time_grid_and_not_in_the_future():
    simulated = robot()
    start = 1_700_000_000_123_456_789
    assert simulated.advance(start).stamp_ns == start
    assert simulated.advance(start + PERIOD - 1).stamp_ns == start
    assert simulated.advance(start + PERIOD).stamp_ns == start + PERIOD
    assert simulated.advance(start + 57 * MS).stamp_ns == start + 50 * MS
    assert simulated.advance(start + 57 * MS).odometry.stamp_ns == start + 50 * MS


@pytest.mark.parametrize('rate', [60.0, 333.0])
def test_each_state_is_returned_once_on_a_grid_of_its_rate(rate):
    """A grid that rounds its period to whole nanoseconds lags one that rounds its stamps.

    At 60 Hz the robot was one sample late from the second one on.
    """
    simulated, pace = robot(rate=rate), SampleScheduler(rate)
    start = 1_700_000_000_000_000_000
    stamps = []
    for now in range(start, start + 2_000 * MS, 7 * MS):
        stamps += [(simulated.advance(due).stamp_ns, due) for due in pace.due(now)]
    assert all(stamp == due for stamp, due in stamps)
    assert len(stamps) > 1.9 * rate


def test_late_requests_return_every_state_in_turn():
    """A command that arrives before a late timer advances the robot without losing a sample.

    The late requests were once treated as a backward time jump, which stopped the robot.
    """
    simulated, prompt = robot(), robot()
    simulated.advance(0)
    prompt.advance(0)
    simulated.apply(command(5.0, 4.0, 35 * MS), 35 * MS)
    late = [simulated.advance(tick * PERIOD) for tick in range(1, 6)]
    early = [prompt.advance(tick * PERIOD) for tick in range(1, 4)]
    prompt.apply(command(5.0, 4.0, 35 * MS), 35 * MS)
    early += [prompt.advance(tick * PERIOD) for tick in range(4, 6)]
    assert [state.stamp_ns for state in late] == [tick * PERIOD for tick in range(1, 6)]
    assert list(map(numbers, late)) == list(map(numbers, early))


def test_command_acts_from_its_arrival_step():
    moved = []
    for arrival_us in (0, 400, 3000, 6500):
        simulated = robot(drive__dead_time=0.0, disturbance__bound=0.0)
        simulated.advance(0)
        now = arrival_us * 1000
        simulated.apply(command(10.0, 10.0, now), now)
        moved.append(simulated.advance(PERIOD).true_wheels.right)
    assert moved[0] == moved[1]
    assert moved[0] > moved[2] > moved[3] > 0.0


def test_long_gap_is_simulated_in_part_and_ends_at_standstill():
    simulated = robot()
    simulated.apply(command(10.0, 10.0, 0), 0)
    simulated.advance(100 * MS)
    hour = 3_600_000 * MS
    after = simulated.advance(hour)
    assert after.stamp_ns == hour
    assert not after.status.moving
    assert after.truth.pose.x < 0.35 * 0.5
    assert simulated.apply(command(5.0, 5.0, hour), hour) == ''
    assert simulated.advance(hour + 200 * MS).status.moving


def test_backward_time_jump_stops_and_restarts_the_time_grid():
    simulated = robot()
    for tick in range(100, 130):
        simulated.apply(command(8.0, 8.0, tick * PERIOD), tick * PERIOD)
        before = simulated.advance((tick + 1) * PERIOD)
    state = simulated.advance(3 * MS)
    assert state.stamp_ns == 3 * MS
    assert 'clock jumped back' in state.reason
    assert state.truth.pose.x == pytest.approx(before.truth.pose.x)
    assert not simulated.advance(503 * MS).status.moving
    assert simulated.apply(command(8.0, 8.0, 503 * MS), 503 * MS) == ''
    assert simulated.advance(703 * MS).status.moving


# -- values ---------------------------------------------------------------------------------------


def test_equal_seeds_give_bit_equal_runs():
    runs = []
    for _ in range(2):
        simulated = robot(noise__variance=0.04, seed=5)
        states = [simulated.step(wander(tick)) for tick in range(300)]
        runs.append([*map(numbers, states)])
    assert runs[0] == runs[1]
    other = robot(noise__variance=0.04, seed=6)
    assert [numbers(other.step(wander(tick))) for tick in range(300)] != runs[0]
    # The noise is in the measurement only.
    silent = robot(seed=5)
    for tick, state in enumerate(states):
        exact = silent.step(wander(tick))
        assert state.true_wheels == exact.true_wheels == exact.wheels != state.wheels


def trajectory(substep: float, **changes: object) -> np.ndarray:
    simulated = robot(substep=substep, **changes)
    rows = []
    for tick in range(400):
        if simulated.parameters.drive.kind == 'torque':
            state = simulated.step_torque(
                0.006 + 0.01 * math.sin(0.013 * tick), 0.006 + 0.01 * math.cos(0.009 * tick)
            )
        else:
            state = simulated.step(wander(tick))
        pose = state.truth.pose
        yaw = (math.cos(pose.yaw), math.sin(pose.yaw))
        rows.append([pose.x, pose.y, *yaw, *state.true_wheels])
    return np.array(rows)


@pytest.mark.compiled
def test_torque_drive_converges_with_order_four():
    runs = [trajectory(substep, drive__kind='torque') for substep in (0.002, 0.001, 0.0005)]
    coarse, fine = np.abs(runs[0] - runs[1]).max(), np.abs(runs[1] - runs[2]).max()
    assert math.log2(coarse / fine) == pytest.approx(4.0, abs=0.3)
    assert fine < 1e-8


@pytest.mark.compiled
@pytest.mark.slow
def test_velocity_drive_converges_when_substep_is_halved():
    """Order two where the ramp ends within a step, four where the drive does not limit."""
    ramps = [trajectory(substep) for substep in (0.002, 0.001, 0.0005, 0.00025)]
    changes = [np.abs(b - a).max() for a, b in zip(ramps, ramps[1:], strict=False)]
    assert changes[1] < 1e-3
    assert math.log2(changes[0] / changes[-1]) / 2.0 > 1.5
    free = [trajectory(substep, drive__acceleration=0.0) for substep in (0.002, 0.001, 0.0005)]
    order = math.log2(np.abs(free[1] - free[0]).max() / np.abs(free[2] - free[1]).max())
    assert order == pytest.approx(4.0, abs=0.3)


def test_odometry_without_noise_follows_ground_truth():
    simulated, turned, before = robot(), np.zeros(2), np.zeros(2)
    for tick in range(2000):
        state = simulated.step(wander(tick))
        turned += 0.005 * (before + state.true_wheels)
        before = np.array(state.true_wheels)
    assert np.array(state.angles) == pytest.approx(turned, abs=5e-3)
    assert state.odometry.pose[:2] == pytest.approx(state.truth.pose[:2], abs=2e-3)
    assert state.odometry.twist == state.truth.twist
    run = simulated.parameters.geometry.wheel_radius * np.array(state.angles)
    assert np.trace(state.covariance) > 0.0
    assert run.max() > 2.0


# -- robot interface ------------------------------------------------------------------------------


def test_odometry_reset_is_rejected_while_moving():
    simulated = robot()
    for _ in range(50):
        state = simulated.step(WheelSpeeds(8.0, 8.0))
    assert 'moves' in simulated.reset_odometry(state.stamp_ns)
    assert simulated.state.odometry.pose.x > 0.05
    for _ in range(50):
        state = simulated.step(WheelSpeeds(0.0, 0.0))
    assert simulated.reset_odometry(state.stamp_ns) == ''
    assert simulated.state.odometry.pose == (0.0, 0.0, 0.0)
    assert not simulated.state.covariance.any()
    assert simulated.state.truth.pose.x > 0.05


def test_set_pose_leaves_odometry_unchanged():
    simulated = robot()
    simulated.step(WheelSpeeds(0.0, 0.0))
    simulated.set_pose(Pose(1.0, -2.0, 7.0))
    assert simulated.state.truth.pose[:2] == (1.0, -2.0)
    assert simulated.state.truth.pose.yaw == pytest.approx(7.0 - math.tau)
    assert simulated.state.odometry.pose[:2] == pytest.approx((0.0, 0.0), abs=1e-3)
    with pytest.raises(ValueError, match='finite'):
        simulated.set_pose(Pose(math.nan, 0.0, 0.0))


def test_only_dynamic_parameters_change_while_running():
    simulated = robot()
    for name, value in (('noise.variance', 0.1), ('wheel.max_velocity', 3.0), ('drive.lag', 0.05)):
        simulated.configure(simulated.parameters.with_values({name: value}))
        assert simulated.parameters.to_dict()[name] == value
    before = simulated.parameters
    for name, value in (('rate', 50.0), ('seed', 9), ('wheel_radius', 0.05)):
        with pytest.raises(ParameterError, match=name):
            simulated.configure(before.with_values({name: value}))
    assert simulated.parameters is before


def test_warm_up_leaves_the_robot_unchanged():
    cold, warm = robot(), robot()
    warm.warm_up()
    assert numbers(cold.step(WheelSpeeds(5.0, 4.0))) == numbers(warm.step(WheelSpeeds(5.0, 4.0)))
    robot(drive__kind='torque').warm_up()
