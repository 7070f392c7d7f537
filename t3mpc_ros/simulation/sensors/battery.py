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
"""Simulated Li-ion battery: open-circuit voltage, sag under load, brown-out."""

from bisect import bisect_right
from dataclasses import dataclass
import math
from typing import ClassVar

from t3mpc_ros.parameters.table import ParameterError, parameter
from t3mpc_ros.robot.interface import BatteryReading
from t3mpc_ros.robot.sensor_parameters import BatteryParameters

# Charge (1) and open-circuit voltage (V) of a Li-ion (NMC) cell: rounded from the discharges at
# C/32 and C/20 of Molicel P42A and Samsung 40T cells in Sunil et al. (IEEE Transactions on
# Instrumentation and Measurement, 2025); the two agree within 0.03 V from 10 % on.
_CHARGES = (0.0, 0.02, 0.05, 0.1, 0.15, 0.3, 0.45, 0.84, 0.95, 1.0)
_VOLTAGES = (2.5, 2.95, 3.18, 3.33, 3.43, 3.58, 3.70, 4.065, 4.11, 4.2)
_SECONDS_PER_HOUR = 3600.0


@dataclass(frozen=True)
class SimulatedBatteryParameters(BatteryParameters):
    """Resistance, idle load, thresholds and initial charge of the simulated battery."""

    resistance: float = parameter(
        0.15, 'resistance of cells and wires', 'ohm', (1e-3, 10.0), dynamic=True
    )
    idle_current: ClassVar[float] = 0.3
    """Current besides the motors, A: eight range sensors at 30 mA (Sharp E4-A00201EN), and 60 mA
    of the board, assumed."""
    low_voltage: float = parameter(
        10.2, 'voltage below which the robot reports a low battery', 'V', (0.0, 60.0), dynamic=True
    )
    brown_out: float = parameter(
        8.0, 'voltage below which motor drivers and board fail', 'V', (0.0, 60.0), dynamic=True
    )
    hysteresis: ClassVar[float] = 0.3
    """Voltage above either threshold at which its condition ends, V, assumed."""
    charge: float = parameter(1.0, 'initial charge, 0 to 1', bounds=(0.0, 1.0))

    def check_consistency(self) -> None:
        """Raise ParameterError when the low-battery report would be late, or would never end."""
        if self.low_voltage < self.brown_out:
            raise ParameterError(
                f'low_voltage must be at least brown_out ({self.brown_out:g} V): '
                f'got {self.low_voltage:g}'
            )
        full = self.cells * _VOLTAGES[-1]
        if self.low_voltage + self.hysteresis >= full:
            raise ParameterError(
                f'low_voltage with hysteresis must be less than the voltage of a full battery '
                f'({full:g} V): got {self.low_voltage + self.hysteresis:g}'
            )


def open_circuit_voltage(charge: float, cells: int = 1) -> float:
    """Return the voltage (V) of ``cells`` in series without load, at a charge from 0 to 1."""
    last = len(_CHARGES) - 2
    index = min(max(bisect_right(_CHARGES, charge) - 1, 0), last)
    below, above = _CHARGES[index], _CHARGES[index + 1]
    share = (charge - below) / (above - below)
    return cells * (_VOLTAGES[index] + share * (_VOLTAGES[index + 1] - _VOLTAGES[index]))


class SimulatedBattery:
    """Charge and terminal voltage under load.

    Parameters are replaceable at run time; the charge is kept.
    """

    def __init__(self, parameters: SimulatedBatteryParameters) -> None:
        self.parameters = parameters
        self.charge = parameters.charge  # remaining charge, 0 to 1
        self.voltage = 0.0  # terminal voltage under the load of the last draw, V
        self.low = False  # whether the battery should be charged
        self.collapsed = False
        """Whether the voltage is, or within the hysteresis was, too low for drivers and board."""
        self.draw(0.0, 0.0)

    def draw(
        self, power: float, dt: float, sag: float = 0.0, charger: float = 0.0
    ) -> BatteryReading:
        r"""Return voltage, current and charge after ``dt`` seconds of ``power`` (W) to the motors.

        With E the open-circuit voltage less ``sag`` (V, a fault of the cells) and the voltage
        drop of the idle current, the terminal voltage solves

        .. math:: V = E - R P / V, \qquad V = E/2 + \sqrt{E^2/4 - R P}.

        More than E²/4R cannot be drawn: the voltage is then E/2, and the battery collapses. An
        empty battery is disconnected by its protection: no voltage, no current. Regenerated
        (negative) power is dissipated in the drivers.

        A ``charger`` adds so many A to the cells, less when they reach the voltage of a full
        battery; the reading's current is then negative.
        """
        if not (math.isfinite(power + sag) and 0.0 <= dt < math.inf):
            raise ValueError(
                'power and sag must be finite, dt finite and at least 0 s: '
                f'got {power} W, {sag} V, {dt} s'
            )
        parameters = self.parameters
        beyond = self.charge <= 0.0
        volts = current = 0.0
        if not beyond:
            inner, idle = parameters.resistance, parameters.idle_current
            open_circuit = open_circuit_voltage(self.charge, parameters.cells) - sag
            half = 0.5 * (open_circuit - inner * idle)
            left = half * half - inner * max(power, 0.0)
            beyond = left < 0.0 or half <= 0.0
            volts = half + math.sqrt(max(left, 0.0)) if half > 0.0 else 0.0
            current = max(open_circuit - volts, 0.0) / inner
            full = parameters.capacity * _SECONDS_PER_HOUR
            if current * dt < self.charge * full:
                self.charge -= current * dt / full
            else:
                # Empty within the step: the current is the mean over the step.
                current = self.charge * full / dt
                self.charge = 0.0
        if charger > 0.0:
            full_volts = parameters.cells * _VOLTAGES[-1]
            open_circuit = open_circuit_voltage(self.charge, parameters.cells)
            charger = min(charger, max(full_volts - open_circuit, 0.0) / parameters.resistance)
            full = parameters.capacity * _SECONDS_PER_HOUR
            self.charge = min(self.charge + charger * dt / full, 1.0)
            current -= charger
            volts = min(volts + charger * parameters.resistance, full_volts)
        self.voltage = volts
        back = parameters.hysteresis
        self.low = volts < parameters.low_voltage + (back if self.low else 0.0)
        self.collapsed = beyond or volts < parameters.brown_out + (back if self.collapsed else 0.0)
        return BatteryReading(volts, current, self.charge)
