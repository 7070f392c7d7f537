# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Diagnostics of the robot state: warnings and values."""

from collections.abc import Mapping

from t3mpc_ros.robot.interface import RobotState
from t3mpc_ros.robot.slip_monitor import SLIP_STOP_REASON
from t3mpc_ros.simulation.digital_twin import TwinDiagnostics


def warnings(
    state: RobotState, twin: TwinDiagnostics | None = None, command_problem: str = ''
) -> tuple[str, ...]:
    """Return the warnings about a robot state, most important first.

    Parameters
    ----------
    state
        The state of a simulated or real robot.
    twin
        Quantities that only the digital twin has.
    command_problem
        Why the last command was rejected; empty if it was accepted.
    """
    status = state.status
    found = [state.reason] if state.reason else []
    if command_problem and command_problem != state.reason:
        found.append(f'cmd_vel rejected: {command_problem}')
    if status.slipping and state.reason != SLIP_STOP_REASON:
        found.append('a wheel slips, is blocked, or has lost steps')
    if status.imu_fault:
        found.append('the inertial sensor does not answer')
    if status.low_battery:
        volts = f': {state.battery.voltage:.1f} V' if state.battery else ''
        found.append(f'the battery is low{volts}')
    if twin is not None and twin.faults:
        found.append(f'faults: {", ".join(twin.faults)}')
    if state.lost_steps is not None and any(state.lost_steps):
        right, left = state.lost_steps
        found.append(f'steps lost: {right} right, {left} left')
    return tuple(found)


def values(state: RobotState, twin: TwinDiagnostics | None = None) -> Mapping[str, object]:
    """Return the status and the measured quantities of a robot state by diagnostic key."""
    found: dict[str, object] = {**state.status._asdict()}
    if state.battery is not None:
        found['battery_v'] = state.battery.voltage
    if state.lost_steps is not None:
        found['lost_steps_right'], found['lost_steps_left'] = state.lost_steps
    if twin is not None:
        found |= {
            'slid_right_m': twin.slid[0],
            'slid_left_m': twin.slid[1],
            'gyro_bias_rad_s': twin.gyro_bias,
            'gyro_bias_estimate_rad_s': twin.estimated_bias,
            'faults': ', '.join(twin.faults) or 'none',
        }
    return found
