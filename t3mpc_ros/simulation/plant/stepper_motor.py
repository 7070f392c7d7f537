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
r"""Hybrid stepper motor driven in microsteps: pull-out torque and rotor torque.

The rotor has ``teeth`` = full steps / 4 stable positions per turn. Its torque is
:math:`T(\Omega) \sin(N(\varphi - \theta))`, a spring to the field that fails beyond a quarter of
a tooth pitch: the rotor then falls back by whole pitches, four full steps each, and the steps are
lost. T falls with the field speed because winding impedance and back-EMF reduce the current.
"""

from dataclasses import dataclass
import math
from typing import ClassVar, NamedTuple

from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

_MOTOR = '17HS4401 data sheet'


class StepperMotor(NamedTuple):
    """Constants of a motor, for kernels."""

    teeth: float  # N, stable positions per turn
    torque_constant: float  # N m/A
    resistance: float  # Ohm
    inductance: float  # H
    current: float  # set in the driver, A
    damping: float  # N m s/rad
    damping_width: float  # rad/s


@dataclass(frozen=True)
class StepperMotorParameters(Parameters):
    """Motor, driver and pulse generator of one wheel; both wheels have the same."""

    full_steps: int = parameter(
        200, 'full steps per turn', bounds=(4, 1000), source='paper: 1.8 degrees'
    )
    microsteps: int = parameter(16, 'microsteps per full step', bounds=(1, 256))
    holding_torque: float = parameter(
        0.40,
        'torque at standstill with both phases at rated current',
        'N m',
        (1e-3, 100.0),
        source=_MOTOR,
    )
    rated_current: float = parameter(
        1.7, 'rated current of a phase', 'A', (0.01, 50.0), source=_MOTOR
    )
    resistance: float = parameter(
        1.5, 'resistance of a phase', 'Ohm', (0.01, 1000.0), source=_MOTOR
    )
    inductance: float = parameter(2.8e-3, 'inductance of a phase', 'H', (1e-6, 1.0), source=_MOTOR)
    rotor_inertia: float = parameter(
        5.4e-6, 'inertia of the rotor', 'kg m²', (1e-9, 1.0), source=_MOTOR
    )
    phase_current: float = parameter(
        1.0, 'peak current set in the driver', 'A', (0.01, 50.0), dynamic=True
    )
    damping: ClassVar[float] = 0.01
    """Torque per speed of the rotor against its field, near synchronism, N m s/rad, assumed."""
    damping_width: ClassVar[float] = 2.0
    """Speed relative to the field at which the damping has fallen to a quarter, rad/s, assumed: an
    unlocked rotor is not dragged along."""
    step_rate: ClassVar[float] = 10_000.0
    """Largest pulse rate of a wheel, 1/s: one step for two ticks of a 20 kHz interrupt."""

    @property
    def microstep(self) -> float:
        """Angle (rad) of one pulse."""
        return 2.0 * math.pi / (self.full_steps * self.microsteps)

    @property
    def teeth(self) -> float:
        """Stable positions of the rotor per turn, N."""
        return 0.25 * self.full_steps

    @property
    def torque_constant(self) -> float:
        """Torque per ampere (N m/A) of the field.

        The holding torque is measured with rated current in both phases, a field sqrt(2) times as
        strong as that of microstepping, whose peak is the current of one phase.
        """
        return self.holding_torque / (math.sqrt(2.0) * self.rated_current)

    @property
    def top_speed(self) -> float:
        """Largest wheel speed (rad/s) of the pulse generator."""
        return self.step_rate * self.microstep

    def constants(self) -> StepperMotor:
        """Return the constants of the kernels."""
        return StepperMotor(
            self.teeth,
            self.torque_constant,
            self.resistance,
            self.inductance,
            self.phase_current,
            self.damping,
            self.damping_width,
        )

    def check_consistency(self) -> None:
        """Raise ParameterError when the current exceeds the rating of the motor."""
        if self.phase_current > self.rated_current:
            raise ParameterError(
                'phase_current must be at most rated_current '
                f'({self.rated_current:g} A): got {self.phase_current:g}'
            )


@kernel
def pull_out_torque(field_speed: float, volts: float, motor: StepperMotor) -> float:
    r"""Return the largest torque (N m) at a field speed (rad/s), 0 when the back-EMF is too high.

    At pull-out the current is in phase with the back-EMF, so the supply voltage is

    .. math:: V^2 = (R I + k \Omega)^2 + (N \Omega L I)^2

    with the torque constant k. The current is the smaller of this solution and the current set
    in the driver. Source: Acarnley, Stepping Motors, 4th ed., chapter on pull-out torque.

    volts : supply (V)
    """
    speed = abs(field_speed)
    constant, resistance = motor.torque_constant, motor.resistance
    emf = constant * speed
    if emf >= volts:
        return 0.0
    reactance = motor.teeth * speed * motor.inductance
    impedance = resistance * resistance + reactance * reactance
    drop = resistance * emf
    room = drop * drop + impedance * (volts * volts - emf * emf)
    current = (math.sqrt(room) - drop) / impedance
    return float(constant * min(current, motor.current))


@kernel
def rotor_torque(ahead: float, faster: float, peak: float, motor: StepperMotor) -> float:
    """Return the torque (N m) on a rotor with its field ``ahead`` (rad) and ``faster`` (rad/s).

    peak : the pull-out torque at this speed, 0 without power
    """
    if peak <= 0.0:
        return 0.0
    fade = 1.0 + (faster / motor.damping_width) * (faster / motor.damping_width)
    return float(peak * math.sin(motor.teeth * ahead) + motor.damping * faster / (fade * fade))
