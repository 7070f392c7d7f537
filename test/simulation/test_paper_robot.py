# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The simulated robot as a whole: time, stops, determinism, convergence."""

import math

import numpy as np
import pytest

from t3mpc_ros.geometry.timing import SampleScheduler
from t3mpc_ros.geometry.types import Pose, WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.interface import RobotCommand, RobotInterface, RobotState
from t3mpc_ros.simulation.plant.paper_plant import PaperRobot, PaperRobotParameters

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


def end_by_silence(machine: PaperRobot, now_ns: int, generator: np.random.Generator) -> None:
    pass


def end_by_estop(machine: PaperRobot, now_ns: int, generator: np.random.Generator) -> None:
    machine.latch_estop('test', now_ns + int(generator.uniform(0.0, 250.0) * MS))


def end_by_stop(machine: PaperRobot, now_ns: int, generator: np.random.Generator) -> None:
    machine.stop('test', now_ns)


def end_by_zero(machine: PaperRobot, now_ns: int, generator: np.random.Generator) -> None:
    machine.apply(command(0.0, 0.0, now_ns), now_ns)


def end_by_nonsense(machine: PaperRobot, now_ns: int, generator: np.random.Generator) -> None:
    machine.apply(command(math.nan, 1.0, now_ns), now_ns)


@pytest.mark.parametrize(
    'end', [end_by_silence, end_by_estop, end_by_stop, end_by_zero, end_by_nonsense]
)
def test_from_ten_radians_a_second_the_wheels_rest_half_a_second_after_the_last_command(end):
    generator = np.random.default_rng(11)
    for seed in range(15):
        machine = robot(seed=seed)
        now = 0
        machine.advance(now)
        for _ in range(int(generator.integers(1, 8))):
            # Anything up to full speed and full reversal, at any instant.
            wheels = generator.uniform(-10.0, 10.0, 2)
            if generator.uniform() < 0.5:
                wheels = 10.0 * np.sign(wheels)
            machine.apply(command(*wheels, now), now)
            last = now
            now += int(generator.uniform(0.0, 240.0) * MS)
        end(machine, last, generator)
        after = machine.advance(last + 500 * MS)
        assert after.stamp_ns > last + 485 * MS
        assert not after.status.moving, (seed, after)
        assert max(map(abs, after.true_wheels)) < 0.1
        assert after.commanded == (0.0, 0.0)


def test_silence_stops_the_robot_and_says_so():
    machine = robot()
    machine.apply(command(10.0, 10.0, 0), 0)
    before = machine.advance(250 * MS)
    assert before.true_wheels.right > 5.0
    assert before.reason == ''
    after = machine.advance(260 * MS)
    assert after.status.timed_out
    assert 'no command for 0.25 s' in after.reason
    assert machine.advance(300 * MS).true_wheels.right < before.true_wheels.right


def test_an_emergency_stop_holds_against_commands_until_it_is_released():
    machine = robot()
    now = 0
    for _ in range(40):
        machine.apply(command(10.0, 10.0, now), now)
        now += PERIOD
        machine.advance(now)
    machine.latch_estop('button', now)
    for _ in range(100):
        assert 'button' in machine.apply(command(10.0, 10.0, now), now)
        now += PERIOD
        state = machine.advance(now)
    assert state.status.estop
    assert not state.status.enabled
    assert not state.status.moving
    assert 'button' in state.reason
    assert machine.release_estop(now) == ''
    assert machine.release_estop(now) != ''
    for _ in range(30):
        now += PERIOD
        state = machine.advance(now)
    assert not state.status.moving
    assert machine.apply(command(10.0, 10.0, now), now) == ''
    assert machine.advance(now + 200 * MS).status.moving


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
def test_a_command_that_is_not_finite_never_moves_the_robot(bad):
    machine = robot(disturbance__bound=0.0)
    for now in range(0, 500 * MS, PERIOD):
        assert 'not finite' in machine.apply(command(bad, 5.0, now), now)
        assert 'not finite' in machine.apply(command(5.0, bad, now), now)
        state = machine.advance(now + PERIOD)
    assert state.truth.pose == (0.0, 0.0, 0.0)
    assert state.true_wheels == (0.0, 0.0)
    assert 'not finite' in state.reason


@pytest.mark.parametrize('bad', [math.nan, math.inf])
def test_a_torque_that_is_not_finite_brakes(bad):
    machine = robot(drive__kind='torque')
    for _ in range(100):
        state = machine.step_torque(0.02, 0.02)
    assert state.true_wheels.right > 5.0
    for _ in range(100):
        state = machine.step_torque(bad, 0.02)
    assert not state.status.moving
    assert 'not finite' in state.reason
    machine.latch_estop('button', state.stamp_ns)
    for _ in range(20):
        state = machine.step_torque(0.02, 0.02)
    assert not state.status.moving
    assert state.status.estop


def test_a_torque_that_nobody_renews_is_let_go_by_the_watchdog():
    machine = robot(drive__kind='torque')
    machine.step_torque(0.02, 0.02)
    assert machine.advance(250 * MS).status.moving
    after = machine.advance(600 * MS)
    assert after.status.timed_out
    assert not after.status.moving


def test_no_finite_command_makes_a_state_that_is_not_finite():
    generator = np.random.default_rng(12)
    extremes = [0.0, 1e-308, 1.0, 1e3, 1e150, 1.7e308]
    for kind in ('velocity', 'torque'):
        machine = robot(
            drive__kind=kind,
            drive__torque_limit=100.0,
            wheel__max_velocity=200.0,
            linear__x__max_velocity=5.0,
            angular__z__max_velocity=50.0,
            friction__viscous=0.0,
            friction__coulomb=0.0,
            body__com_offset=0.1,
        )
        step = machine.step_torque if kind == 'torque' else None
        for _ in range(1000):
            pair = generator.choice(extremes, 2) * generator.choice([-1.0, 1.0], 2)
            state = step(*pair) if step else machine.step(WheelSpeeds(*pair))
            assert np.all(np.isfinite(numbers(state)))
            assert max(map(abs, state.true_wheels)) <= machine.parameters.drive.speed_ceiling


# -- time -----------------------------------------------------------------------------------------


def test_states_lie_on_the_grid_and_are_never_later_than_asked():
    machine = robot()
    start = 1_700_000_000_123_456_789
    assert machine.advance(start).stamp_ns == start
    assert machine.advance(start + PERIOD - 1).stamp_ns == start
    assert machine.advance(start + PERIOD).stamp_ns == start + PERIOD
    assert machine.advance(start + 57 * MS).stamp_ns == start + 50 * MS
    assert machine.advance(start + 57 * MS).odometry.stamp_ns == start + 50 * MS


@pytest.mark.parametrize('rate', [100.0, 60.0, 128.0, 333.0])
def test_asked_along_any_grid_of_its_rate_each_state_comes_once(rate):
    """A grid that rounds its period to whole nanoseconds falls behind one that rounds stamps.

    At 60 Hz the robot was then one sample behind from the second one on.
    """
    machine, pace = robot(rate=rate), SampleScheduler(rate)
    start = 1_700_000_000_000_000_000
    stamps = []
    for now in range(start, start + 2_000 * MS, 7 * MS):
        stamps += [(machine.advance(due).stamp_ns, due) for due in pace.due(now)]
    assert all(stamp == due for stamp, due in stamps)
    assert len(stamps) > 1.9 * rate


def test_states_asked_for_late_are_still_there_one_by_one():
    """A command that arrives before a late timer moves the robot on; no sample is lost by it.

    At first the late questions were taken for a clock that had gone back, and stopped the robot.
    """
    machine, prompt = robot(), robot()
    machine.advance(0)
    prompt.advance(0)
    machine.apply(command(5.0, 4.0, 35 * MS), 35 * MS)
    late = [machine.advance(tick * PERIOD) for tick in range(1, 6)]
    early = [prompt.advance(tick * PERIOD) for tick in range(1, 4)]
    prompt.apply(command(5.0, 4.0, 35 * MS), 35 * MS)
    early += [prompt.advance(tick * PERIOD) for tick in range(4, 6)]
    assert [state.stamp_ns for state in late] == [tick * PERIOD for tick in range(1, 6)]
    assert list(map(numbers, late)) == list(map(numbers, early))


def test_a_command_acts_from_the_integration_step_in_which_it_arrives():
    moved = []
    for arrival_us in (0, 400, 3000, 6500):
        machine = robot(drive__dead_time=0.0, disturbance__bound=0.0)
        machine.advance(0)
        now = arrival_us * 1000
        machine.apply(command(10.0, 10.0, now), now)
        moved.append(machine.advance(PERIOD).true_wheels.right)
    assert moved[0] == moved[1]
    assert moved[0] > moved[2] > moved[3] > 0.0


def test_asking_in_between_changes_nothing():
    busy, quiet = robot(), robot()
    for machine in (busy, quiet):
        machine.apply(command(5.0, 3.0, 0), 0)
    for now in range(0, 200 * MS, 1_300_000):
        busy.advance(now)
    assert numbers(busy.advance(200 * MS)) == numbers(quiet.advance(200 * MS))


def test_stepping_without_a_clock_is_the_same_as_with_one():
    stepped, timed = robot(), robot()
    for tick in range(100):
        timed.apply(command(*wander(tick), tick * PERIOD), tick * PERIOD)
        assert numbers(stepped.step(wander(tick))) == numbers(timed.advance((tick + 1) * PERIOD))


def test_a_long_gap_is_made_up_for_in_part_and_leaves_the_robot_standing():
    machine = robot()
    machine.apply(command(10.0, 10.0, 0), 0)
    machine.advance(100 * MS)
    hour = 3_600_000 * MS
    after = machine.advance(hour)
    assert after.stamp_ns == hour
    assert not after.status.moving
    assert after.truth.pose.x < 0.35 * 0.5
    assert machine.apply(command(5.0, 5.0, hour), hour) == ''
    assert machine.advance(hour + 200 * MS).status.moving


def test_a_clock_that_goes_back_stops_the_robot_and_starts_a_new_grid():
    machine = robot()
    for tick in range(100, 130):
        machine.apply(command(8.0, 8.0, tick * PERIOD), tick * PERIOD)
        before = machine.advance((tick + 1) * PERIOD)
    state = machine.advance(3 * MS)
    assert state.stamp_ns == 3 * MS
    assert 'clock jumped back' in state.reason
    assert state.truth.pose.x == pytest.approx(before.truth.pose.x)
    assert not machine.advance(503 * MS).status.moving
    assert machine.apply(command(8.0, 8.0, 503 * MS), 503 * MS) == ''
    assert machine.advance(703 * MS).status.moving


# -- numbers --------------------------------------------------------------------------------------


def test_equal_runs_are_equal_bit_for_bit():
    runs = []
    for _ in range(2):
        machine = robot(noise__variance=0.04, seed=5)
        runs.append([numbers(machine.step(wander(tick))) for tick in range(300)])
    assert runs[0] == runs[1]
    other = robot(noise__variance=0.04, seed=6)
    assert [numbers(other.step(wander(tick))) for tick in range(300)] != runs[0]


def test_noise_blurs_the_measurement_and_leaves_the_truth_alone():
    silent, noisy = robot(), robot(noise__variance=0.04)
    deviations = []
    for tick in range(2000):
        exact, blurred = silent.step(wander(tick)), noisy.step(wander(tick))
        assert exact.true_wheels == blurred.true_wheels
        assert exact.wheels == exact.true_wheels
        deviations.append(np.array(blurred.wheels) - blurred.true_wheels)
    assert np.var(deviations) == pytest.approx(0.04, rel=0.06)


def test_a_change_of_disturbance_does_not_shift_the_noise():
    calm, rough = robot(noise__variance=0.04), robot(noise__variance=0.04)
    rough.configure(rough.parameters.with_values({'disturbance.bound': 0.01}))
    for tick in range(50):
        a, b = calm.step(wander(tick)), rough.step(wander(tick))
        noise_a = np.array(a.wheels) - a.true_wheels
        noise_b = np.array(b.wheels) - b.true_wheels
        assert noise_a == pytest.approx(noise_b, abs=1e-12)
        assert a.true_wheels != b.true_wheels


def trajectory(substep: float, **changes: object) -> np.ndarray:
    machine = robot(substep=substep, **changes)
    rows = []
    for tick in range(1000):
        if machine.parameters.drive.kind == 'torque':
            state = machine.step_torque(
                0.006 + 0.01 * math.sin(0.013 * tick), 0.006 + 0.01 * math.cos(0.009 * tick)
            )
        else:
            state = machine.step(wander(tick))
        pose = state.truth.pose
        yaw = (math.cos(pose.yaw), math.sin(pose.yaw))
        rows.append([pose.x, pose.y, *yaw, *state.true_wheels])
    return np.array(rows)


def test_ten_seconds_under_torque_converge_with_order_four():
    runs = [trajectory(substep, drive__kind='torque') for substep in (0.002, 0.001, 0.0005)]
    coarse, fine = np.abs(runs[0] - runs[1]).max(), np.abs(runs[1] - runs[2]).max()
    assert math.log2(coarse / fine) == pytest.approx(4.0, abs=0.3)
    assert fine < 1e-8


def test_ten_seconds_of_the_velocity_drive_change_little_when_the_substep_is_halved():
    """Order two where the ramp ends within a step, four where the drive does not limit."""
    ramps = [trajectory(substep) for substep in (0.002, 0.001, 0.0005, 0.00025, 0.000125)]
    changes = [np.abs(b - a).max() for a, b in zip(ramps, ramps[1:], strict=False)]
    assert changes[1] < 1e-3
    assert math.log2(changes[0] / changes[-1]) / 3.0 > 1.5
    free = [trajectory(substep, drive__acceleration=0.0) for substep in (0.002, 0.001, 0.0005)]
    order = math.log2(np.abs(free[1] - free[0]).max() / np.abs(free[2] - free[1]).max())
    assert order == pytest.approx(4.0, abs=0.3)


def test_odometry_without_noise_stays_with_the_truth():
    machine = robot()
    for tick in range(2000):
        state = machine.step(wander(tick))
    assert state.odometry.pose[:2] == pytest.approx(state.truth.pose[:2], abs=2e-3)
    assert state.odometry.twist == state.truth.twist
    run = machine.parameters.geometry.wheel_radius * np.array(state.angles)
    assert np.trace(state.covariance) > 0.0
    assert run.max() > 2.0


def test_wheel_angles_are_the_integral_of_the_wheel_speeds():
    machine, total = robot(), np.zeros(2)
    before = np.zeros(2)
    for tick in range(500):
        state = machine.step(wander(tick))
        total += 0.005 * (before + np.array(state.true_wheels))
        before = np.array(state.true_wheels)
    assert np.array(state.angles) == pytest.approx(total, abs=5e-3)


# -- the rest of the seam -------------------------------------------------------------------------


def test_odometry_is_reset_at_rest_and_not_while_moving():
    machine = robot()
    for _ in range(50):
        state = machine.step(WheelSpeeds(8.0, 8.0))
    assert 'moves' in machine.reset_odometry(state.stamp_ns)
    assert machine.state.odometry.pose.x > 0.05
    for _ in range(50):
        state = machine.step(WheelSpeeds(0.0, 0.0))
    assert machine.reset_odometry(state.stamp_ns) == ''
    assert machine.state.odometry.pose == (0.0, 0.0, 0.0)
    assert not machine.state.covariance.any()
    assert machine.state.truth.pose.x > 0.05


def test_the_robot_can_be_put_elsewhere_and_odometry_does_not_notice():
    machine = robot()
    machine.step(WheelSpeeds(0.0, 0.0))
    machine.set_pose(Pose(1.0, -2.0, 7.0))
    assert machine.state.truth.pose[:2] == (1.0, -2.0)
    assert machine.state.truth.pose.yaw == pytest.approx(7.0 - math.tau)
    assert machine.state.odometry.pose[:2] == pytest.approx((0.0, 0.0), abs=1e-3)
    with pytest.raises(ValueError, match='finite'):
        machine.set_pose(Pose(math.nan, 0.0, 0.0))


def test_only_live_settings_change_while_running():
    machine = robot()
    for name, value in (('noise.variance', 0.1), ('wheel.max_velocity', 3.0), ('drive.lag', 0.05)):
        machine.configure(machine.parameters.with_values({name: value}))
        assert machine.parameters.to_dict()[name] == value
    before = machine.parameters
    for name, value in (('rate', 50.0), ('seed', 9), ('wheel_radius', 0.05)):
        with pytest.raises(ParameterError, match=name):
            machine.configure(before.with_values({name: value}))
    assert machine.parameters is before


def test_warming_up_leaves_the_robot_as_it_was():
    cold, warm = robot(), robot()
    warm.warm_up()
    assert numbers(cold.step(WheelSpeeds(5.0, 4.0))) == numbers(warm.step(WheelSpeeds(5.0, 4.0)))
    robot(drive__kind='torque').warm_up()


def test_the_simulated_robot_has_every_part_of_the_seam_itself():
    assert RobotInterface in PaperRobot.__mro__
    for name in ('apply', 'advance', 'stop', 'reset_odometry', 'latch_estop', 'release_estop'):
        assert name in vars(RobotInterface)
        assert getattr(PaperRobot, name) is not getattr(RobotInterface, name)
