# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The battery: charge and energy balance, sag, collapse."""

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


def test_open_circuit_voltage_rises_with_charge_between_the_ends_of_a_cell():
    charges = np.linspace(0.0, 1.0, 501)
    voltages = [open_circuit_voltage(charge) for charge in charges]
    assert np.all(np.diff(voltages) > 0.0)
    assert voltages[0] == 2.5
    assert voltages[-1] == 4.2
    assert open_circuit_voltage(0.5, 3) == pytest.approx(3 * open_circuit_voltage(0.5))


@pytest.mark.parametrize(
    ('charge', 'volts'), [(0.0955, 3.3231), (0.2915, 3.5737), (0.4573, 3.7017), (0.8342, 4.0637)]
)
def test_open_circuit_voltage_is_that_of_a_measured_cell(charge, volts):
    """Molicel INR21700-P42A at C/32, as Sunil et al. (2025) publish it."""
    assert open_circuit_voltage(charge) == pytest.approx(volts, abs=0.02)


@pytest.mark.parametrize('power', [0.0, 1.0, 12.0, 60.0, 150.0])
def test_voltage_solves_the_circuit(power):
    """The cell gives E I; the motors take P, the idle load V I_idle, the resistance R I²."""
    cell = battery(charge=0.7)
    inside = open_circuit_voltage(0.7, 3)
    reading = cell.draw(power, 0.01)
    volts, current = reading.voltage, reading.current
    assert volts == pytest.approx(inside - 0.15 * current, rel=1e-12)
    assert volts * (current - 0.3) == pytest.approx(power, rel=1e-9, abs=1e-9)
    assert inside * current == pytest.approx(power + 0.3 * volts + 0.15 * current**2, rel=1e-9)
    # Of the two solutions the one with the smaller current.
    assert volts > 0.5 * inside


def test_energy_is_what_lies_under_the_curve():
    """Delivered, idle and lost in the resistance: together the integral of E over the charge."""
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


def test_charge_is_the_integral_of_the_current_to_the_last_coulomb():
    cell, generator = battery(charge=0.4), np.random.default_rng(2)
    drawn = 0.0
    while cell.charge > 0.0:
        dt = generator.uniform(0.1, 10.0)
        drawn += cell.draw(generator.uniform(0.0, 20.0), dt).current * dt
        assert cell.charge == pytest.approx(0.4 - drawn / FULL, abs=1e-12)
    assert drawn == pytest.approx(0.4 * FULL, rel=1e-12)


def test_voltage_falls_steadily_under_a_steady_load():
    cell = battery()
    voltages = [cell.draw(15.0, 5.0).voltage for _ in range(900)]
    assert cell.charge < 0.15
    assert np.all(np.diff(voltages) < 0.0)


def test_an_empty_battery_gives_nothing_and_stays_so():
    cell = battery(charge=0.001)
    for _ in range(100):
        cell.draw(10.0, 1.0)
    assert cell.draw(10.0, 1.0) == (0.0, 0.0, 0.0)
    assert cell.draw(0.0, 1.0) == (0.0, 0.0, 0.0)
    assert cell.low
    assert cell.collapsed
    assert battery(charge=0.0).collapsed


def test_more_power_than_the_battery_has_collapses_it_with_finite_numbers():
    """Beyond E²/4R the quadratic has no solution."""
    loaded = open_circuit_voltage(1.0, 3) - 0.15 * 0.3
    limit = loaded**2 / (4.0 * 0.15)
    changes = {'brown_out': 1.0}  # so that the limit itself is what collapses it
    below = battery(**changes)
    assert below.draw(0.999 * limit, 1e-6).voltage > 0.5 * loaded
    assert not below.collapsed
    for power in (1.001 * limit, 10.0 * limit, 1e12):
        cell = battery(**changes)
        reading = cell.draw(power, 1e-6)
        assert all(map(math.isfinite, reading))
        assert reading.voltage == pytest.approx(0.5 * loaded)
        assert cell.collapsed


def test_a_small_battery_cannot_even_feed_the_board():
    cell = battery(resistance=10.0, idle_current=2.0)
    assert cell.collapsed
    assert all(map(math.isfinite, cell.draw(5.0, 0.1)))


def test_collapse_and_warning_come_at_their_voltages_and_go_a_hysteresis_later():
    cell = battery(charge=0.3, resistance=1.0, idle_current=0.0)
    inside = open_circuit_voltage(0.3, 3)

    def at(volts: float) -> None:
        """Draw what brings the terminals to ``volts``."""
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


def test_power_fed_back_is_no_charge():
    cell = battery(charge=0.5)
    assert cell.draw(-20.0, 1.0) == battery(charge=0.5).draw(0.0, 1.0)


def test_voltage_is_known_before_anything_is_drawn():
    assert battery().voltage == pytest.approx(3 * 4.2 - 0.15 * 0.3)
    assert battery().charge == 1.0


@pytest.mark.parametrize(
    ('power', 'dt'), [(math.nan, 0.1), (math.inf, 0.1), (1.0, -0.1), (1.0, math.nan)]
)
def test_numbers_that_cannot_be_are_refused_and_change_nothing(power, dt):
    cell = battery(charge=0.5)
    with pytest.raises(ValueError, match='must be finite'):
        cell.draw(power, dt)
    assert cell.charge == 0.5


@pytest.mark.parametrize(
    ('changes', 'name'),
    [({'brown_out': 11.0}, 'low_voltage'), ({'low_voltage': 12.5}, 'low_voltage')],
)
def test_settings_that_do_not_fit_are_refused_by_name(changes, name):
    with pytest.raises(ParameterError, match=f'^{name} '):
        SimulatedBatteryParameters.from_dict(changes)


def test_a_sagging_cell_shows_in_the_voltage_and_takes_the_board_down():
    """Taken from the motors alone, a sag was seen by no reading, no warning and no board."""
    battery = SimulatedBattery(SimulatedBatteryParameters())
    healthy = battery.draw(5.0, 0.01).voltage
    assert battery.draw(5.0, 0.01, sag=2.0).voltage == pytest.approx(healthy - 2.0, abs=0.05)
    assert not battery.collapsed
    assert battery.draw(5.0, 0.01, sag=20.0).voltage == 0.0
    assert battery.collapsed
    assert battery.draw(5.0, 0.01).voltage == pytest.approx(healthy, abs=0.01)
    assert not battery.collapsed
