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
"""The paper's robot: its plant behind a delayed link, as a simulated robot."""

import math

from t3mpc_ros.geometry.kinematics import twist_from_wheels
from t3mpc_ros.geometry.types import Pose, State, WheelSpeeds, check_pose
from t3mpc_ros.robot import interface
from t3mpc_ros.robot.wheel_odometry import WheelOdometry
from t3mpc_ros.simulation.fixed_step_robot import FixedStepRobot
from t3mpc_ros.simulation.plant.paper_plant import PaperPlant, PaperRobotParameters


class PaperRobot(FixedStepRobot[PaperRobotParameters]):
    """Simulated robot with the paper's plant, without sensors, faults and world."""

    def __init__(self, parameters: PaperRobotParameters) -> None:
        if parameters.drive.kind == 'stepper':
            raise ValueError(
                'drive.kind must be velocity or torque here: stepper is for DigitalTwin'
            )
        super().__init__(parameters)
        self._odometry = WheelOdometry(parameters.odometry, parameters.geometry)
        self._plant = PaperPlant(parameters)
        self._measured = interface.ZERO_WHEEL_SPEEDS
        self._torque = (0.0, 0.0)
        self._limited_command = self._limiter.advance(0, 0.0)
        self._measured_at = 0  # integration steps at the last measurement
        self._apply_parameters()
        self._reports.append(self._make_state(0))

    def apply(self, command: interface.RobotCommand, now_ns: int) -> str:
        """Follow ``command`` from now on, or return why it is rejected."""
        if self._parameters.drive.kind == 'torque':
            raise ValueError('drive.kind must be velocity to take wheel speeds: got torque')
        return super().apply(command, now_ns)

    def step_torque(self, right: float, left: float) -> interface.RobotState:
        """Apply torques (N m) for one control period and return the state at its end.

        Torques that are not finite brake the wheels, as an emergency stop does.
        """
        if self._parameters.drive.kind != 'torque':
            raise ValueError('drive.kind must be torque to take torques: got velocity')
        # The limiter decides only whether the torque may act.
        finite = math.isfinite(right) and math.isfinite(left)
        wheels = interface.ZERO_WHEEL_SPEEDS if finite else WheelSpeeds(math.nan, math.nan)
        now_ns = self._run_to(self._reached_ns)
        self._limiter.accept(interface.RobotCommand(wheels, now_ns), now_ns)
        self._torque = (float(right), float(left))
        return self._advance_period()

    def set_pose(self, pose: Pose) -> None:
        """Move the robot to ``pose``; wheel speeds and odometry are unchanged."""
        check_pose(pose)
        self._plant.pose = pose
        self._refresh_state()

    def warm_up(self) -> None:
        """Compile every kernel of a step, on a separate robot."""
        robot = PaperRobot(self._parameters)
        if self._parameters.drive.kind == 'torque':
            robot.step_torque(0.0, 0.0)
        else:
            robot.step(interface.ZERO_WHEEL_SPEEDS)

    # -- simulation step --------------------------------------------------------------------------

    def _apply_parameters(self) -> None:
        parameters = self._parameters
        self._limiter.parameters = parameters.limiter
        self._odometry.parameters = parameters.odometry
        self._plant.configure(parameters)

    def _integrate(self, count: int) -> None:
        """Run ``count`` steps under one command."""
        self._limited_command = self._limiter.advance(self._reached_ns, count * self._plant.step)
        braking = bool(self._limited_command.reason)
        torque_mode = self._parameters.drive.kind == 'torque' and not braking
        command = self._torque if torque_mode else self._limited_command.wheels
        self._plant.run(command, count, braking=braking)

    def _measure(self) -> None:
        dt = (self._plant.steps_done - self._measured_at) * self._plant.step
        self._measured_at = self._plant.steps_done
        before, now = self._measured, self._plant.measure(dt)
        mean = WheelSpeeds(0.5 * (before.right + now.right), 0.5 * (before.left + now.left))
        self._odometry.update_from_speeds(mean, dt, self._parameters.noise.variance)
        self._measured = now

    def _make_state(self, stamp_ns: int) -> interface.RobotState:
        geometry, limiter, plant = self._parameters.geometry, self._limiter, self._plant
        status = interface.RobotStatus(
            enabled=not limiter.estop,
            moving=self._moving(),
            estop=limiter.estop,
            timed_out=limiter.timed_out,
            limited=self._limited_command.limited,
        )
        return interface.RobotState(
            stamp_ns=stamp_ns,
            wheels=self._measured,
            angles=interface.WheelAngles(*plant.angles),
            odometry=State(
                stamp_ns, self._odometry.pose, twist_from_wheels(self._measured, geometry)
            ),
            covariance=self._odometry.covariance,
            commanded=self._limited_command.wheels,
            status=status,
            reason=limiter.reason,
            true_wheels=plant.wheels,
            truth=State(stamp_ns, plant.pose, twist_from_wheels(plant.wheels, geometry)),
        )

    def _moving(self) -> bool:
        return max(map(abs, self._plant.wheels)) > self._parameters.standstill_speed

    def _reset_odometry(self) -> None:
        self._odometry.reset()
