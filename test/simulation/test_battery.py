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
"""Simulated battery: charge and energy balance, sag, collapse."""

import math

import numpy as np
import pytest

from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.simulation.sensors.battery import (
    SimulatedBattery,
    SimulatedBatteryParameters,
    open_circuit_voltage,
)

FULL = 2.2 * 3600.0  # coulombs


def battery(**changes: object) -> SimulatedBattery:
    return SimulatedBattery(SimulatedBatteryParameters.from_dict(changes))


def test_open_circuit_voltage_rises_with_charge():
    charges = np.linspace(0.0, 1.0, 501)
    voltages = [open_circuit_voltage(charge) for charge in charges]
    assert np.all(np.diff(voltages) > 0.0)
    assert voltages[0] == 2.5
    assert voltages[-1] == 4.2
    assert open_circuit_voltage(0.5, 3) == pytest.approx(3 * open_circuit_voltage(0.5))


@pytest.mark.parametrize(
    ('charge', 'volts'), [(0.0955, 3.3231), (0.2915, 3.5737), (0.4573, 3.7017), (0.8342, 4.0637)]
)
def test_open_circuit_voltage_matches_a_measured_cell(charge, volts):
    """Molicel INR21700-P42A at C/32, from Sunil et al. (2025)."""
    assert open_circuit_voltage(charge) == pytest.approx(volts, abs=0.02)


@pytest.mark.parametrize('power', [0.0, 12.0, 150.0])
def test_voltage_solves_the_circuit_equation(power):
    """The power E I of the cells is P + V I_idle + R I²."""
    cell = battery(charge=0.7)
    inside = open_circuit_voltage(0.7, 3)
    reading = cell.draw(power, 0.01)
    volts, current = reading.voltage, reading.current
    assert volts == pytest.approx(inside - 0.15 * current, rel=1e-12)
    assert volts * (current - 0.3) == pytest.approx(power, rel=1e-9, abs=1e-9)
    assert inside * current == pytest.approx(power + 0.3 * volts + 0.15 * current**2, rel=1e-9)
    # The solution with the smaller current.
    assert volts > 0.5 * inside


def test_energy_is_the_integral_of_the_voltage_curve():
    """Motor, idle and resistive energy together are the integral of E over the charge."""
    cell, dt = battery(charge=1.0), 1.0
    generator = np.random.default_rng(1)
    balance, before = 0.0, cell.charge
    while cell.charge > 0.2:
        power = generator.uniform(0.0, 30.0)
        reading = cell.draw(power, dt)
        balance += (power + 0.3 * reading.voltage + 0.15 * reading.current**2) * dt
        assert reading.charge < before
        before = reading.charge
    used = 1.0 - cell.charge
    middles = cell.charge + used * (np.arange(20000) + 0.5) / 20000.0
    mean = np.mean([open_circuit_voltage(charge, 3) for charge in middles])
    expected = FULL * used * mean
    assert balance == pytest.approx(expected, rel=2e-4)


def test_empty_battery_delivers_nothing():
    cell = battery(charge=0.001)
    for _ in range(100):
        cell.draw(10.0, 1.0)
    assert cell.draw(10.0, 1.0) == (0.0, 0.0, 0.0)
    assert cell.draw(0.0, 1.0) == (0.0, 0.0, 0.0)
    assert cell.low
    assert cell.collapsed
    assert battery(charge=0.0).collapsed


def test_excess_power_collapses_the_voltage_with_finite_values():
    """Beyond E²/4R the quadratic has no solution."""
    loaded = open_circuit_voltage(1.0, 3) - 0.15 * 0.3
    limit = loaded**2 / (4.0 * 0.15)
    changes = {'brown_out': 1.0}  # so that only the power limit causes the collapse
    below = battery(**changes)
    assert below.draw(0.999 * limit, 1e-6).voltage > 0.5 * loaded
    assert not below.collapsed
    for power in (1.001 * limit, 10.0 * limit, 1e12):
        cell = battery(**changes)
        reading = cell.draw(power, 1e-6)
        assert all(map(math.isfinite, reading))
        assert reading.voltage == pytest.approx(0.5 * loaded)
        assert cell.collapsed


def test_collapse_and_low_warning_have_hysteresis():
    cell = battery(charge=0.4, resistance=1.0)
    inside = open_circuit_voltage(0.4, 3) - cell.parameters.idle_current

    def at(volts: float) -> None:
        """Draw the power that results in ``volts``."""
        assert cell.draw(volts * (inside - volts), 0.0).voltage == pytest.approx(volts)

    at(10.21)
    assert (cell.low, cell.collapsed) == (False, False)
    at(10.19)
    assert cell.low
    at(8.01)
    assert not cell.collapsed
    at(7.99)
    assert cell.collapsed
    at(8.29)
    assert cell.collapsed
    at(8.31)
    assert (cell.low, cell.collapsed) == (True, False)
    at(10.49)
    assert cell.low
    at(10.51)
    assert not cell.low


def test_regenerated_power_does_not_charge():
    cell = battery(charge=0.5)
    assert cell.draw(-20.0, 1.0) == battery(charge=0.5).draw(0.0, 1.0)


@pytest.mark.parametrize('power', [0.0, 5.0])
def test_a_charger_fills_the_battery_and_no_more(power):
    cell, others = battery(charge=0.0), battery(charge=0.5)
    readings = [cell.draw(power, 10.0, charger=2.0) for _ in range(1500)]
    currents = np.array([reading.current for reading in readings])
    charges = np.array([reading.charge for reading in readings])
    assert currents[1] < 0.0
    assert np.diff(charges)[1:] == pytest.approx(-10.0 * currents[2:] / FULL, abs=1e-12)
    assert charges.max() <= 1.0
    assert charges[-1] > 0.97
    assert max(reading.voltage for reading in readings) <= 12.6
    assert not cell.low
    # The more it draws, the less is left.
    assert others.draw(20.0, 1.0, charger=2.0).voltage < others.draw(0.0, 1.0, charger=2.0).voltage


def test_invalid_input_is_rejected_without_side_effects():
    cell = battery(charge=0.5)
    for power, dt in ((math.nan, 0.1), (math.inf, 0.1), (1.0, -0.1), (1.0, math.nan)):
        with pytest.raises(ValueError, match='must be finite'):
            cell.draw(power, dt)
    assert cell.charge == 0.5


@pytest.mark.parametrize(
    ('changes', 'name'),
    [({'brown_out': 11.0}, 'low_voltage'), ({'low_voltage': 12.5}, 'low_voltage')],
)
def test_inconsistent_parameters_are_rejected_by_name(changes, name):
    with pytest.raises(ParameterError, match=f'^{name} '):
        SimulatedBatteryParameters.from_dict(changes)


def test_cell_sag_lowers_the_voltage_and_causes_collapse():
    """A sag of the motor voltage alone would affect no reading, no warning and no board."""
    battery = SimulatedBattery(SimulatedBatteryParameters())
    healthy = battery.draw(5.0, 0.01).voltage
    assert battery.draw(5.0, 0.01, sag=2.0).voltage == pytest.approx(healthy - 2.0, abs=0.05)
    assert not battery.collapsed
    assert battery.draw(5.0, 0.01, sag=20.0).voltage == 0.0
    assert battery.collapsed
    assert battery.draw(5.0, 0.01).voltage == pytest.approx(healthy, abs=0.01)
    assert not battery.collapsed
