# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Twin validation: runs all tests and writes page, figures and tables."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from t3mpc_ros.evaluation.plotting import write_pictures
from t3mpc_ros.evaluation.reporting import (
    EMPTY_CELL,
    Block,
    Heading,
    Paragraph,
    Picture,
    Table,
    html_page,
)
from t3mpc_ros.evaluation.twin_validation import component_tests, courses, slip_drift
from t3mpc_ros.evaluation.twin_validation.component_tests import GYRO_SHEET, sharp_deviation
from t3mpc_ros.evaluation.twin_validation.slip_drift import NO_SLIP, holds_from
from t3mpc_ros.evaluation.twin_validation.validation_figures import VALIDATION_FIGURES, Evidence
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters

PAGE = 'twin.html'
TITLE = 'The digital twin, put to the test'


class ValidationSize(NamedTuple):
    """Size of the validation."""

    seeds: int
    strengths: int
    """Of each of the two kinds of slip, the strongest."""
    standing: float
    """s for which the gyro stands"""
    patrol: float
    """s of driving through the room until the distance sensors die"""


FULL = ValidationSize(seeds=8, strengths=3, standing=600.0, patrol=60.0)
QUICK = ValidationSize(seeds=1, strengths=1, standing=60.0, patrol=14.0)


def write_validation(
    output: Path, seed: int, amount: ValidationSize, *, progress: bool = False
) -> str:
    """Write page and figures, and return the tables and the path of the page as text.

    Raises
    ------
    OSError
        The output cannot be written.
    """
    evidence = run_validation(seed, amount, progress=progress)
    tables = [slip_drift.drift_table(evidence.drifts), bench_table(evidence)]
    pictures = write_pictures(VALIDATION_FIGURES, evidence, output)
    origin = f'seeds {seed} to {seed + amount.seeds - 1}; simulation only'
    if amount == QUICK:
        origin = f'a quick look, {origin}'
    findings = _findings(evidence)
    blocks: list[Block] = [Paragraph(origin, 'quiet'), *map(Paragraph, findings), *tables]
    for drawing in VALIDATION_FIGURES[:-1]:
        picture = Picture(drawing.title, pictures[drawing.stem], drawing.caption)
        blocks += [Heading(drawing.title), picture]
    (output / PAGE).write_text(html_page(TITLE, blocks), encoding='utf-8')
    texts = [table.markdown() for table in tables]
    return '\n\n'.join([*texts, '\n'.join(findings), str(output / PAGE)])


def run_validation(seed: int, amount: ValidationSize, *, progress: bool = False) -> Evidence:
    """Return all measurements."""
    parameters = DigitalTwinParameters.from_dict({'seed': seed, 'world': 'room'})
    seeds = range(seed, seed + amount.seeds)
    kinds = [
        [slip for slip in slip_drift.SLIPS if slip.fault == kind][-amount.strengths :]
        for kind in dict.fromkeys(slip.fault for slip in slip_drift.SLIPS)
    ]
    slips = [slip_drift.NO_SLIP, *(slip for kind in kinds for slip in kind)]
    shown = slip_drift.SLIPS[1]
    fastest, motor = 140.0, parameters.motor
    torque = [
        component_tests.torque_curve(motor, volts, current, fastest)
        for current in (motor.phase_current, motor.rated_current)
        for volts in (9.0, 12.0, 24.0)
    ]
    limit = component_tests.breaking_acceleration(parameters)
    ramps = tuple(component_tests.ramp(parameters, part * limit, 10.0) for part in (0.5, 1.5))
    near = np.linspace(0.0, 1.0, 401)
    places = np.concatenate([np.arange(0.0, 0.1, 0.001), np.arange(0.1, 1.0, 0.005)])
    readings = component_tests.sharp_readings(parameters.range_sensor, places, seed)
    rate = parameters.rate
    rates = component_tests.stationary_gyro(parameters.imu, amount.standing, rate, seed)
    low_pass = [component_tests.low_pass_response(number) for number in range(7)]
    found = slip_drift.measure_drifts(seeds, slips, progress=progress)
    squares = tuple(
        slip_drift.drive_course(name, shown, seed) for name in ('square ccw', 'square cw')
    )
    turns = slip_drift.drive_course('10 turns', shown, seed)
    slip_events = slip_drift.slip_events('10 turns', shown, seed)
    patrol = courses.patrol(parameters, amount.patrol, 30.0)
    return Evidence(
        parameters=parameters,
        torque=torque,
        needed=component_tests.needed_torque(parameters),
        ramps=(ramps[0], ramps[1]),
        sharp=np.column_stack([near, component_tests.sharp_curve(near)]),
        readings=np.column_stack([places, readings]),
        low_pass=low_pass,
        allan=component_tests.allan_deviation(rates, rate),
        squares=(squares[0], squares[1]),
        slip_shown=shown.name,
        turns=turns,
        slip_events=slip_events,
        drifts=found,
        patrol=patrol,
    )


def bench_table(evidence: Evidence) -> Table:
    """Return the component measurements beside the data sheets."""
    parameters, patrol = evidence.parameters, evidence.patrol
    rows = []
    for curve in evidence.torque:
        pull = np.interp(
            (parameters.limiter.wheel_speed, curve.ceiling), curve.speed, curve.torque
        )
        name = f'torque at {curve.volts:g} V, {curve.current:g} A'
        at = f'at {parameters.limiter.wheel_speed:g} rad/s {pull[0]:.3f} N m'
        at += f', at {curve.ceiling:.1f} rad/s {pull[1]:.3f}'
        rows.append((name, at, f'needed {evidence.needed:.3f} N m'))
    for ramp in evidence.ramps:
        wrong = 100.0 * abs(ramp.counted_distance[-1] - ramp.driven[-1])
        found = f'{ramp.lost_steps[0]} and {ramp.lost_steps[1]} steps lost, {wrong:.1f} cm wrong'
        rows.append((f'ramp of {ramp.acceleration:.0f} rad/s²', found, EMPTY_CELL))
    deviation = f'at most {100.0 * sharp_deviation():.1f} % off'
    rows.append(('voltage from 10 to 80 cm', deviation, "data sheet's figure 2"))
    own = int(parameters.imu.low_pass)
    response, (cutoff, delay) = evidence.low_pass[own], GYRO_SHEET[own]
    rows.append(('gyro at -3 dB', f'{response.cutoff:.1f} Hz', f'{cutoff:g} Hz'))
    rows.append(('delay of the gyro', f'{response.delay:.2f} ms', f'{delay:g} ms'))
    brief = evidence.allan.span < 0.3
    density = evidence.allan.deviation[brief] * np.sqrt(2.0 * evidence.allan.span[brief])
    measured = f'{density[-1]:.4f} deg/s/√Hz'
    rows.append(('noise of the gyro', measured, f'{parameters.imu.gyro_noise:g} deg/s/√Hz'))
    rows.append(('hardest push of a wall', f'{patrol.max_contact_force:.0f} N', EMPTY_CELL))
    return Table('Parts', ('what', 'twin', 'to compare'), rows)


def _findings(evidence: Evidence) -> list[str]:
    """Return in sentences the drift from which the gyro leaves at most a fifth."""
    lines = []
    for course in dict.fromkeys(item.course for item in evidence.drifts):
        slipped = [
            item for item in evidence.drifts if item.course == course and item.slip != NO_SLIP.name
        ]
        bound = np.degrees(max(item.limit for item in slipped))
        least = np.degrees(holds_from(slipped))
        kept = sum(item.holds for item in slipped)
        lines.append(
            f'{course}: with slip the gyro leaves at most a fifth of the yaw error in {kept} '
            f'of {len(slipped)} runs, in all where the steps are wrong by more than {least:.1f} '
            f'deg; its own errors may come to {bound:.1f} deg.'
        )
    return lines
