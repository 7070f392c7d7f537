# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of the robot state: warnings and key values."""

from collections.abc import Mapping

from t3mpc_ros.robot.interface import RobotState
from t3mpc_ros.robot.slip_monitor import SLIP_STOP_REASON
from t3mpc_ros.simulation.digital_twin import TwinDiagnostics


def complaints(state: RobotState, inside: TwinDiagnostics | None) -> tuple[str, ...]:
    """Return what a user should know of, most important first; empty when all is well.

    ``inside`` is what only a simulation knows.
    """
    status = state.status
    found = [state.reason] if state.reason else []
    if status.slipping and state.reason != SLIP_STOP_REASON:
        found.append('a wheel slips, is blocked, or has lost steps')
    if status.imu_fault:
        found.append('the inertial sensor does not answer')
    if status.low_battery:
        volts = f': {state.battery.voltage:.1f} V' if state.battery else ''
        found.append(f'the battery is low{volts}')
    if inside is not None and inside.faults:
        found.append(f'faults: {", ".join(inside.faults)}')
    if state.lost_steps is not None and any(state.lost_steps):
        right, left = state.lost_steps
        found.append(f'steps lost: {right} right, {left} left')
    return tuple(found)


def measures(state: RobotState, inside: TwinDiagnostics | None) -> Mapping[str, object]:
    """Return the status, and what else is known in numbers."""
    values: dict[str, object] = {**state.status._asdict()}
    if state.battery is not None:
        values['battery_v'] = state.battery.voltage
    if state.lost_steps is not None:
        values['lost_steps_right'], values['lost_steps_left'] = state.lost_steps
    if inside is not None:
        values |= {
            'slid_right_m': inside.slid[0],
            'slid_left_m': inside.slid[1],
            'gyro_bias_rad_s': inside.gyro_bias,
            'gyro_bias_learnt_rad_s': inside.estimated_bias,
            'faults': ', '.join(inside.faults) or 'none',
        }
    return values
