# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
r"""Rotors, tyres and body in one set of equations.

The wheels turn with chi (rotor, rad/s); the ground passes below them with psi, the wheel speeds
that would make the body move as it does, (1) inverted. A tyre that rolls has chi = psi; one that
slides pushes with all the grip there is:

.. math:: \bar\theta_b \dot\psi + \bar\eta \psi = R F + Q, \qquad
          I_i \dot\chi_i = \tau_i - f(\chi_i) - \tau_{d,i} - R F_i, \qquad |F_i| \le \mu N_i

with theta_bar_b the matrix (11) without the wheels' own inertia and Q what a wall does. Where
both tyres roll, the sum of the two is (10). Not modelled: sliding sideways, and load that shifts
between the wheels when the robot accelerates.
"""

import math

import numpy as np
import numpy.typing as npt

from t3mpc_ros.kernels import kernel
from t3mpc_ros.robot.arena.contact import contact_force
from t3mpc_ros.robot.drive import approach
from t3mpc_ros.robot.loads import disturbance_torque, friction_torque
from t3mpc_ros.robot.sensors.mpu6050 import low_pass
from t3mpc_ros.robot.stepper.motor import pull_out_torque, rotor_torque

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

ROLLS = 0
"""Mode of a tyre; +1 and -1 say that it slides, and which way it pushes the body."""


@kernel
def motion_rates(
    now: Array,
    modes: Integers,
    torque: Array,
    body: Array,
    tyres: Array,
    bumper: Array,
    segments: Array,
    circles: Array,
    slope: Array,
    pushed: Array,
) -> None:
    """Write the rates of change of the state, and the forces of tyres and wall.

    now : shape (9,), x, y (m), P, theta_R, theta_L (rad), chi and psi (rad/s, right first)
    modes : shape (2,), see ROLLS
    torque : shape (2,), motor less friction and disturbance, N m
    body : shape (6,), see ``chassis.body_vector``
    tyres : shape (4,), inertia of each wheel (kg m²), most force of each tyre (N)
    bumper, segments, circles : see contact_force; no segments and circles = no wall is near
    slope : shape (9,), written
    pushed : shape (3,), written: R F of both tyres (N m), force of the wall along the heading (N)
    """
    radius, turn = body[0], body[1]
    right, left = now[7], now[8]
    along, angular = 0.5 * radius * (right + left), turn * (right - left)
    cosine, sine = math.cos(now[2]), math.sin(now[2])
    wall = 0.0
    if segments.shape[0] + circles.shape[0] > 0:
        push_x, push_y = contact_force(
            now[0], now[1], along * cosine, along * sine, bumper, segments, circles
        )
        wall = push_x * cosine + push_y * sine
    pull = body[4] * angular
    outer_right = 0.5 * radius * wall - pull * left
    outer_left = 0.5 * radius * wall + pull * right
    grip_right = radius * tyres[2] * modes[0]
    grip_left = radius * tyres[3] * modes[1]
    own_right, own_left = body[2], body[2]
    drive_right, drive_left = outer_right + grip_right, outer_left + grip_left
    if modes[0] == ROLLS:
        own_right += tyres[0]
        drive_right = outer_right + torque[0]
    if modes[1] == ROLLS:
        own_left += tyres[1]
        drive_left = outer_left + torque[1]
    beside = body[3]
    determinant = own_right * own_left - beside * beside
    rate_right = (own_left * drive_right - beside * drive_left) / determinant
    rate_left = (own_right * drive_left - beside * drive_right) / determinant
    slope[0] = along * cosine
    slope[1] = along * sine
    slope[2] = angular
    slope[3] = now[5]
    slope[4] = now[6]
    slope[5] = rate_right if modes[0] == ROLLS else (torque[0] - grip_right) / tyres[0]
    slope[6] = rate_left if modes[1] == ROLLS else (torque[1] - grip_left) / tyres[1]
    slope[7] = rate_right
    slope[8] = rate_left
    pushed[0] = body[2] * rate_right + beside * rate_left - outer_right
    pushed[1] = beside * rate_right + body[2] * rate_left - outer_left
    pushed[2] = wall


@kernel
def take_hold(state: Array, modes: Integers, body: Array, tyres: Array) -> None:
    """Let body and wheel go on with one speed, their momentum kept, where a tyre now rolls.

    A tyre whose chi and psi are equal already is left as it is.
    """
    right = body[2] * state[7] + body[3] * state[8]
    left = body[3] * state[7] + body[2] * state[8]
    own_right, own_left = body[2], body[2]
    if modes[0] == ROLLS:
        right += tyres[0] * state[5]
        own_right += tyres[0]
    if modes[1] == ROLLS:
        left += tyres[1] * state[6]
        own_left += tyres[1]
    determinant = own_right * own_left - body[3] * body[3]
    state[7] = (own_left * right - body[3] * left) / determinant
    state[8] = (own_right * left - body[3] * right) / determinant
    if modes[0] == ROLLS:
        state[5] = state[7]
    if modes[1] == ROLLS:
        state[6] = state[8]


@kernel
def slid_out(state: Array, modes: Integers) -> bool:
    """Return whether a tyre slid to its end, chi - psi changing sign; it rolls from now on."""
    changed = False
    for wheel in range(2):
        if modes[wheel] != ROLLS and modes[wheel] * (state[5 + wheel] - state[7 + wheel]) <= 0.0:
            modes[wheel] = ROLLS
            changed = True
    return changed


@kernel
def let_go(modes: Integers, pushed: Array, body: Array, tyres: Array) -> bool:
    """Return whether a rolling tyre was asked for more than its grip; it slides from now on."""
    changed = False
    for wheel in range(2):
        if modes[wheel] == ROLLS and abs(pushed[wheel]) > body[0] * tyres[2 + wheel]:
            modes[wheel] = 1 if pushed[wheel] > 0.0 else -1
            changed = True
    return changed


@kernel
def mean_pulses(start: float, end: float) -> float:
    """Return the mean of floor(phase) while the phase (pulses) goes evenly from start to end.

    The integral of floor is n (n - 1)/2 + n (p - n) with n = floor(p).
    """
    whole_start, whole_end = math.floor(start), math.floor(end)
    if whole_start == whole_end:
        return float(whole_start)
    below_start = whole_start * (start - 0.5 * (whole_start + 1))
    below_end = whole_end * (end - 0.5 * (whole_end + 1))
    return float((below_end - below_start) / (end - start))


@kernel
def mean_rate(rate: float, target: float, reached: float) -> float:
    """Return the mean of a rate that goes evenly to its target within ``reached`` of a step.

    reached : share of the step after which the target is kept; more than 1 if it is not reached
    """
    if reached >= 1.0:
        return rate + 0.5 * (target - rate) / reached
    return target - 0.5 * reached * (target - rate)


@kernel
def run_coupled(
    state: Array,
    modes: Integers,
    field: Array,
    target_right: float,
    target_left: float,
    reach: float,
    volts: float,
    robot: Array,
    tyres: Array,
    load: Array,
    angular: Array,
    phases: Array,
    walk: Array,
    segments: Array,
    circles: Array,
    filtered: Array,
    first: int,
    count: int,
    tally: Array,
    work: Array,
) -> None:
    """Integrate rotors, tyres and body over ``count`` steps by the classical Runge-Kutta method.

    The field stands still between two pulses and jumps with each: its place is the whole number
    of pulses that the phase has passed. Seen at the stages alone, the jumps would be late by up
    to half a step, an error of first order; so the staircase is replaced, within a step, by the
    straight line that has its mean and its slope. Tyres change between rolling and sliding at the
    end of a step.

    state : shape (9,), see motion_rates; modes : shape (2,); both changed in place
    field : shape (6,), phase (pulses), rate (pulses/s), place of pulse 0 (rad); each right, left
    target_* : pulse rates to reach (pulses/s); reach : most change of a rate (pulses/s²)
    volts : supply; 0 = no power, the rotors turn freely
    robot : shape (22,), see ``chassis.robot_vector``
    tyres, segments, circles : see motion_rates
    load, angular, phases, walk : see disturbance_torque
    filtered : shape (3, 2), the inertial sensor's filter, see low_pass; changed in place
    first : number of the first step since the run began; the time is first times step
    tally : shape (4,), added to: way (m) each tyre slid, work (J) of the fields; largest force (N)
        of a wall
    work : shape (4, 9), overwritten
    """
    body, friction, bumper, motor = robot[0:6], robot[6:9], robot[9:12], robot[12:19]
    microstep, share, step = robot[19], robot[20], robot[21]
    trial, slope, total = work[0], work[1], work[2]
    torque, pushed = work[3, 0:2], work[3, 2:5]
    for index in range(first, first + count):
        rate_right, rate_left = field[2], field[3]
        slip_right, slip_left = state[5] - state[7], state[6] - state[8]
        next_right, next_left = approach(
            rate_right, rate_left, target_right, target_left, reach * step
        )
        widest = max(abs(target_right - rate_right), abs(target_left - rate_left))
        reached = widest / (reach * step)
        mean_right = mean_rate(rate_right, target_right, reached)
        mean_left = mean_rate(rate_left, target_left, reached)
        end_right, end_left = field[0] + step * mean_right, field[1] + step * mean_left
        place_right, place_left = mean_pulses(field[0], end_right), mean_pulses(field[1], end_left)
        peak_right = pull_out_torque(mean_right * microstep, volts, motor)
        peak_left = pull_out_torque(mean_left * microstep, volts, motor)
        time = (index + 0.5) * step
        against_right = disturbance_torque(0, time, load, angular, phases, walk)
        against_left = disturbance_torque(1, time, load, angular, phases, walk)
        slope[:] = 0.0
        total[:] = 0.0
        done = 0.0
        for stage in range(4):
            part = 0.5 if stage in (1, 2) else (1.0 if stage == 3 else 0.0)
            weight = 1.0 / 3.0 if stage in (1, 2) else 1.0 / 6.0
            for item in range(9):
                trial[item] = state[item] + part * step * slope[item]
            since = (part - 0.5) * step
            pull_right = rotor_torque(
                field[4] + microstep * (place_right + since * mean_right) - trial[3],
                microstep * mean_right - trial[5],
                peak_right,
                motor,
            )
            pull_left = rotor_torque(
                field[5] + microstep * (place_left + since * mean_left) - trial[4],
                microstep * mean_left - trial[6],
                peak_left,
                motor,
            )
            done += weight * microstep * (pull_right * mean_right + pull_left * mean_left)
            torque[0] = pull_right - against_right
            torque[1] = pull_left - against_left
            torque[0] -= friction_torque(trial[5], friction[0], friction[1], friction[2])
            torque[1] -= friction_torque(trial[6], friction[0], friction[1], friction[2])
            motion_rates(
                trial, modes, torque, body, tyres, bumper, segments, circles, slope, pushed
            )
            for item in range(9):
                total[item] += weight * slope[item]
        for item in range(9):
            state[item] += step * total[item]
        field[0], field[1] = end_right, end_left
        field[2], field[3] = next_right, next_left
        # The last stage stood at the end of the step: its torques serve to see what the tyres do.
        held = slid_out(state, modes)
        motion_rates(state, modes, torque, body, tyres, bumper, segments, circles, slope, pushed)
        slides = let_go(modes, pushed, body, tyres)
        if held:
            # Only tyres that the grip can hold: on ice no momentum is passed on.
            take_hold(state, modes, body, tyres)
        if held or slides:
            motion_rates(
                state, modes, torque, body, tyres, bumper, segments, circles, slope, pushed
            )
        radius, offset = body[0], body[5]
        speed = 0.5 * radius * (state[7] + state[8])
        turning = body[1] * (state[7] - state[8])
        low_pass(
            filtered,
            turning,
            0.5 * radius * (slope[7] + slope[8]) - offset * turning * turning,
            speed * turning + offset * body[1] * (slope[7] - slope[8]),
            share,
        )
        tally[0] += 0.5 * step * radius * abs(slip_right + state[5] - state[7])
        tally[1] += 0.5 * step * radius * abs(slip_left + state[6] - state[8])
        tally[2] += step * done
        tally[3] = max(tally[3], abs(pushed[2]))
