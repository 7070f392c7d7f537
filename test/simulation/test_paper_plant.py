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
"""The paper's plant: velocity and torque drive."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.equations import wheel_coriolis

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.robot.command_limiter import ramp_towards
from t3mpc_ros.simulation.paper_robot import PaperRobot
from t3mpc_ros.simulation.plant.disturbances import Disturbance, DisturbanceParameters
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia
from t3mpc_ros.simulation.plant.paper_plant import PaperPlant, PaperRobotParameters, delay_command

IDEAL: dict[str, object] = {
    'friction.viscous': 0.0,
    'friction.coulomb': 0.0,
    'disturbance.bound': 0.0,
    'drive.dead_time': 0.0,
    'drive.acceleration': 0.0,
    'drive.torque_limit': 100.0,
    'wheel.max_acceleration': 1e5,
    'wheel.stop_deceleration': 1e5,
}
"""Lag alone: every limit is far away."""

LAG = 0.02


def robot(**changes: object) -> PaperRobot:
    dotted = {name.replace('__', '.'): value for name, value in changes.items()}
    return PaperRobot(PaperRobotParameters.from_dict(IDEAL | dotted))


def response(simulated: PaperRobot, wheels: WheelSpeeds, count: int) -> np.ndarray:
    return np.array([simulated.step(wheels).true_wheels for _ in range(count)])


def test_ramp_uses_one_factor_and_never_overshoots():
    generator = np.random.default_rng(1)
    for _ in range(200):
        right, left, target_right, target_left = generator.uniform(-10.0, 10.0, 4)
        reach = float(generator.uniform(0.0, 15.0))
        new = np.array(ramp_towards(right, left, target_right, target_left, reach))
        moved, gap = new - [right, left], np.array([target_right - right, target_left - left])
        assert np.abs(moved).max() == pytest.approx(min(reach, np.abs(gap).max()))
        assert moved[0] * gap[1] == pytest.approx(moved[1] * gap[0], abs=1e-9)
        assert np.all(np.abs(moved) <= np.abs(gap) + 1e-12)
    assert ramp_towards(0.0, 0.0, 5.0, -5.0, -1.0) == (5.0, -5.0)


@pytest.mark.parametrize('length', [0, 1, 2, 10])
def test_delay_line_delays_by_exactly_its_length(length):
    commands, cursor = np.zeros((length, 2)), np.zeros(1, dtype=np.int64)
    out = [delay_command(float(n), -float(n), commands, cursor) for n in range(1, 40)]
    expected = [0] * length + list(range(1, 40 - length))
    assert [pair[0] for pair in out] == expected
    assert [-pair[1] for pair in out] == expected


def test_nominal_step_response_is_a_first_order_lag():
    """Turning it is so only without an offset of the centre of mass."""
    times = 0.01 * np.arange(1, 16)
    shape = 1.0 - np.exp(-times / LAG)
    straight = response(robot(), WheelSpeeds(10.0, 10.0), 15)
    assert straight == pytest.approx(np.outer(shape, [10.0, 10.0]), abs=1e-6)
    centred = response(robot(body__com_offset=0.0), WheelSpeeds(10.0, -4.0), 15)
    assert centred == pytest.approx(np.outer(shape, [10.0, -4.0]), abs=1e-6)
    offset = response(robot(body__com_offset=0.05), WheelSpeeds(10.0, -4.0), 15)
    assert np.abs(offset - centred).max() > 0.05


def test_nothing_moves_before_the_dead_time():
    delayed = response(robot(drive__dead_time=0.03), WheelSpeeds(10.0, 10.0), 10)
    prompt = response(robot(), WheelSpeeds(10.0, 10.0), 7)
    assert not delayed[:3].any()
    assert delayed[3:] == pytest.approx(prompt, abs=1e-12)


def test_drive_limits_acceleration_with_one_factor():
    parameters = PaperRobotParameters.from_dict(
        IDEAL
        | {'drive.acceleration': 50.0, 'wheel.max_acceleration': 30.0}
        | {'wheel.stop_deceleration': 50.0, 'body.com_offset': 0.0}
    )
    plant = PaperPlant(parameters)
    wheels = []
    for _ in range(300):
        plant.run((10.0, -5.0), 1)
        wheels.append(plant.wheels)
    assert np.abs(np.diff(wheels, axis=0)).max() <= 50.0 * parameters.step * (1.0 + 1e-9)
    times = parameters.step * np.arange(1, 200)
    ramp = 50.0 * (times - LAG * (1.0 - np.exp(-times / LAG)))
    assert np.array(wheels)[:199, 0] == pytest.approx(ramp, abs=1e-5)
    assert np.array(wheels)[:, 1] == pytest.approx(-0.5 * np.array(wheels)[:, 0], abs=1e-9)
    with pytest.raises(ParameterError, match=r'drive\.acceleration'):
        robot(drive__acceleration=50.0)


def test_heavier_load_slows_the_lag_by_the_inertia_ratio():
    simulated = robot()
    parameters = simulated.parameters
    response(simulated, WheelSpeeds(0.0, 0.0), 3)
    simulated.configure(parameters.with_values({'mass_factor': 3.0}))
    wheels = response(simulated, WheelSpeeds(10.0, 10.0), 15)
    nominal = wheel_inertia(parameters.body, parameters.geometry).sum(axis=0)[0]
    true = wheel_inertia(simulated.parameters.true_body, parameters.geometry).sum(axis=0)[0]
    assert true > 2.0 * nominal
    times = 0.01 * np.arange(1, 16)
    expected = 10.0 * (1.0 - np.exp(-times * nominal / true / LAG))
    assert wheels[:, 0] == pytest.approx(expected, abs=1e-6)
    # And back during the run.
    simulated.configure(parameters)
    gap = 10.0 - wheels[-1, 0]
    lighter = response(simulated, WheelSpeeds(10.0, 10.0), 5)
    assert 10.0 - lighter[:, 0] == pytest.approx(gap * np.exp(-times[:5] / LAG), rel=1e-5)


@pytest.mark.parametrize('factor', [1.0, 5.0])
def test_friction_causes_the_expected_steady_state_error(factor):
    simulated = robot(friction__viscous=2e-4, friction__coulomb=0.004, friction_factor=factor)
    parameters = simulated.parameters
    speed = response(simulated, WheelSpeeds(8.0, 8.0), 100)[-1, 0]
    inertia = wheel_inertia(parameters.body, parameters.geometry).sum(axis=0)[0]
    friction = factor * (0.004 + 2e-4 * speed)
    assert inertia * (8.0 - speed) / LAG == pytest.approx(friction, rel=1e-6)


def test_torque_is_limited_per_wheel():
    simulated = robot(drive__torque_limit=0.01)
    parameters = simulated.parameters
    wheels = response(simulated, WheelSpeeds(10.0, 10.0), 20)
    inertia = wheel_inertia(parameters.body, parameters.geometry).sum(axis=0)[0]
    # 0.01 N m is far below the initial servo torque: constant acceleration.
    times = 0.01 * np.arange(1, 11)
    assert wheels[:10, 0] == pytest.approx(0.01 / inertia * times, rel=1e-9)


def test_torque_drive_matches_an_independent_solver(monkeypatch):
    """(3) and (10) with friction and disturbance, against an independent solver."""
    changes = {'drive__kind': 'torque', 'friction__viscous': 2e-4, 'friction__coulomb': 0.004}
    changes |= {'disturbance__bound': 0.003}
    monkeypatch.setattr(DisturbanceParameters, 'walk_share', 0.0)
    simulated = robot(**changes)
    parameters = simulated.parameters
    geometry, friction = parameters.geometry, parameters.friction
    seed = np.random.SeedSequence(parameters.seed).spawn(2)[0]
    disturbance = Disturbance(parameters.disturbance, np.random.default_rng(seed))
    inverse = np.linalg.inv(wheel_inertia(parameters.body, geometry))
    torque = np.zeros(2)

    def rate(time: float, state: np.ndarray) -> np.ndarray:
        chi = state[3:]
        wheels = WheelSpeeds(*chi)
        linear = geometry.wheel_radius * chi.mean()
        turn = geometry.wheel_radius * (chi[0] - chi[1]) / geometry.wheel_separation
        loss = friction.viscous * chi + friction.coulomb * np.tanh(chi / friction.coulomb_width)
        load = wheel_coriolis(wheels, parameters.body, geometry) @ chi + loss
        push = inverse @ (torque - load - np.array(disturbance.torque(time)))
        return np.array([linear * math.cos(state[2]), linear * math.sin(state[2]), turn, *push])

    state, end = np.zeros(5), None
    for tick in range(80):
        torque = np.array([0.008 + 0.006 * math.sin(0.07 * tick), 0.008 * math.cos(0.03 * tick)])
        end = simulated.step_torque(*torque)
        state = solve_ivp(rate, (0.01 * tick, 0.01 * (tick + 1)), state, rtol=1e-10, atol=1e-12).y[
            :, -1
        ]
    assert end.true_wheels == pytest.approx(state[3:], abs=1e-7)
    assert end.truth.pose[:2] == pytest.approx(state[:2], abs=1e-8)
    turns = math.remainder(end.truth.pose.yaw - state[2], math.tau)
    assert turns == pytest.approx(0.0, abs=1e-8)


def test_each_drive_kind_accepts_only_its_own_commands():
    with pytest.raises(ValueError, match='torque'):
        robot().step_torque(0.0, 0.0)
    with pytest.raises(ValueError, match='velocity'):
        robot(drive__kind='torque').step(WheelSpeeds(0.0, 0.0))


def test_wheel_speed_never_exceeds_the_ceiling():
    simulated = robot(drive__kind='torque', drive__speed_ceiling=12.0)
    for _ in range(200):
        state = simulated.step_torque(0.4, 0.4)
    assert state.true_wheels == (12.0, 12.0)


def test_unstable_substep_is_rejected_with_the_stable_limit():
    with pytest.raises(ParameterError, match='substep must be at most'):
        PaperRobotParameters.from_dict({'friction.coulomb': 5.0})
    with pytest.raises(ParameterError, match='substep'):
        PaperRobotParameters.from_dict({'drive.lag': 0.001, 'mass_factor': 0.1, 'substep': 0.01})
