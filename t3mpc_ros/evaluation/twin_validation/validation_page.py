# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Twin validation: runs all tests and writes page, figures and tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.patches import Circle
import numpy as np
import numpy.typing as npt

from t3mpc_ros.evaluation.bag_report.topic_roles import REFERENCE, TRUTH
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.plotting import (
    COLOURS,
    draw_world,
    legend_above,
    new_figure,
    write_pictures,
)
from t3mpc_ros.evaluation.reporting import (
    EMPTY_CELL,
    Block,
    Contents,
    Heading,
    Paragraph,
    Picture,
    Table,
    html_page,
)
from t3mpc_ros.evaluation.twin_validation import component_tests, courses
from t3mpc_ros.evaluation.twin_validation.component_tests import (
    GYRO_SHEET,
    SHARP_SHEET,
    Allan,
    LowPass,
    Ramp,
    TorqueCurve,
    sharp_deviation,
)
from t3mpc_ros.evaluation.twin_validation.courses import (
    NO_SLIP,
    PART,
    Course,
    Drift,
    Patrol,
    holds_from,
    select_drifts,
)
from t3mpc_ros.robot.description import sensor_mounts
from t3mpc_ros.simulation.digital_twin import DigitalTwinParameters
from t3mpc_ros.simulation.fault_injection import FaultEvent
from t3mpc_ros.simulation.world import load_world

Array = npt.NDArray[np.float64]

TRUE, WANTED = COLOURS[TRUTH], COLOURS[REFERENCE]
STEPS, FUSED, SHEET = '#ea580c', '#15803d', '#be123c'
FAINT = '#9ca3af'
_MARKS = ('o', 's', '^')


def squares(courses: Sequence[Course]) -> Any:
    """Return the squares as driven and by odometry."""
    figure = new_figure(3.6)
    axes = figure.subplots(1, 2)
    for axis, course in zip(axes, courses, strict=True):
        draw_square(axis, course)
        axis.set(title=course.name, xlabel='x / m')
    axes[0].set_ylabel('y / m')
    legend_above(figure, axes[0], columns=3)
    return figure


def draw_square(axis: Any, course: Course) -> None:
    """Draw true path and odometry."""
    for path, colour, width, style, label in (
        (course.steps, STEPS, 1.3, '-', 'odometry, steps alone'),
        (course.truth, TRUE, 2.4, '-', 'where it was'),
        (course.odometry, WANTED, 1.0, '--', 'odometry with gyro'),
    ):
        axis.plot(*path[:, :2].T, color=colour, lw=width, ls=style, label=label)
        axis.plot(*path[-1, :2], 'o', color=colour, ms=4)
    axis.set_aspect('equal', adjustable='datalim')


def turns(course: Course, slip_events: Sequence[FaultEvent], slip: str) -> Any:
    """Return the yaw errors while the robot turns on the spot."""
    figure = new_figure(3.0)
    axis = figure.subplots()
    for number, slip_event in enumerate(slip_events):
        if slip_event.at < course.time[-1]:
            label = slip if number == 0 else None
            axis.axvspan(
                slip_event.at, min(slip_event.until, course.time[-1]), color='#fde68a', lw=0.0,
                         label=label)  # fmt: skip
    for estimate, colour, label in (
        (course.steps, STEPS, 'steps alone'),
        (course.odometry, FUSED, 'with gyro'),
    ):
        wrong = np.degrees(estimate[:, 2] - course.truth[:, 2])
        axis.plot(course.time, wrong, color=colour, lw=1.5, label=label)
    axis.set(xlabel='time / s', ylabel='yaw error / deg')
    axis.margins(x=0.01)
    legend_above(figure, axis, columns=3)
    return figure


def drift(found: Sequence[Drift]) -> Any:
    """Return the yaw errors at the end as bars, and one against the other."""
    figure = new_figure(6.0)
    courses = list(dict.fromkeys(item.course for item in found))
    slips = list(dict.fromkeys(item.slip for item in found))
    grid = figure.add_gridspec(2, len(courses), height_ratios=(1.0, 1.1))
    panels = grid[0, :].subgridspec(1, len(courses)).subplots(sharex=True, sharey=True)
    below = figure.add_subplot(grid[1, :])
    rows = np.arange(len(slips))
    for axis, course in zip(panels, courses, strict=True):
        groups = [select_drifts(found, course, slip) for slip in slips]
        steps = [math.degrees(rms([item.steps for item in each])) for each in groups]
        fused = [math.degrees(rms([item.fused for item in each])) for each in groups]
        axis.barh(rows - 0.2, steps, 0.4, color=STEPS, label='steps alone')
        axis.barh(rows + 0.2, fused, 0.4, color=FUSED, label='with gyro')
        axis.set_title(course)
        axis.set_xscale('log')
        axis.set_xlabel('rms error / deg')
        axis.set_axisbelow(True)
        axis.grid(False, axis='y')
    panels[0].set_yticks(rows, slips)
    panels[0].invert_yaxis()
    legend_above(figure, panels[0], columns=2)
    for course, mark in zip(courses, _MARKS, strict=False):
        members = [item for item in found if item.course == course and item.slip != NO_SLIP.name]
        wrong = np.degrees(np.abs([(item.steps, item.fused) for item in members]))
        below.plot(*wrong.T, mark, ms=4, alpha=0.7, mew=0.0, label=course)
    edge = np.array((0.1, 1000.0))
    below.plot(edge, PART * edge, color=WANTED, lw=1.0, ls='--', label='a fifth')
    below.set(xscale='log', yscale='log', xlim=(0.1, 1000.0), ylim=(0.005, 50.0))
    below.set(xlabel='yaw error of the steps alone / deg', ylabel='with gyro / deg')
    below.legend(loc='lower right', ncols=2, framealpha=0.9, frameon=True, edgecolor='white')
    return figure


def room(patrol: Patrol, parameters: DigitalTwinParameters) -> Any:
    """Return the drive through the room, with range readings and the collision at the end."""
    course = patrol.course
    figure = new_figure(5.0)
    axis = figure.subplots()
    axis.set_axisbelow(True)
    world = load_world(parameters.world)
    draw_world(axis, world)
    faces = sensor_mounts(parameters.range_sensor)
    blind = int(np.searchsorted(course.time, patrol.blind_from))
    moments = np.linspace(blind // 6, blind - 1, 5).astype(int)
    for moment in moments:
        _draw_robot(axis, course.truth[moment], parameters, FAINT)
        _draw_rays(axis, course.truth[moment], faces, patrol.ranges[moment])
    seen, unseen = course.truth[: blind + 1], course.truth[blind:]
    axis.plot(*seen[:, :2].T, color=TRUE, lw=1.6, label='where it was')
    axis.plot(*unseen[:, :2].T, color=SHEET, lw=1.6, label='the same, sensors dead')
    axis.plot(*course.odometry[:, :2].T, color=WANTED, lw=0.9, ls='--', label='odometry')
    _draw_robot(axis, course.truth[-1], parameters, SHEET)
    if math.isfinite(patrol.hit_at):
        hit = course.truth[int(np.searchsorted(course.time, patrol.hit_at))]
        axis.annotate(
            f'{patrol.max_contact_force:.0f} N', hit[:2], (-34.0, 10.0),
            textcoords='offset points',
            color=SHEET, fontsize=8,
        )  # fmt: skip
    axis.plot(*course.truth[0, :2], 'o', color=WANTED, ms=5, label='start')
    around = world.bounding_box
    axis.set_xlim(around.left - 0.4, around.right + 0.4)
    axis.set_ylim(around.bottom - 0.4, around.top + 0.4)
    axis.set_aspect('equal')
    axis.set(xlabel='x / m', ylabel='y / m')
    legend_above(figure, axis, columns=4)
    return figure


def _draw_robot(axis: Any, pose: Array, parameters: DigitalTwinParameters, colour: str) -> None:
    axis.add_patch(
        Circle((pose[0], pose[1]), parameters.bumper.radius, fill=False, color=colour, lw=1.0)
    )
    nose = pose[:2] + _rotation(pose[2]) @ (parameters.bumper.radius, 0.0)
    axis.plot(*zip(pose[:2], nose, strict=True), color=colour, lw=1.0)


def _draw_rays(axis: Any, pose: Array, faces: Array, ranges: Array) -> None:
    """Draw a line as long as each reading; a faint one to 0.8 m without a reading."""
    for face, reading in zip(faces, ranges, strict=True):
        start = pose[:2] + _rotation(pose[2]) @ face[:2]
        length = reading if math.isfinite(reading) else (0.8 if reading > 0.0 else 0.1)
        end = start + length * np.array((math.cos(pose[2] + face[2]), math.sin(pose[2] + face[2])))
        seen = math.isfinite(reading)
        style = {'color': FUSED if seen else '#d1d5db', 'lw': 0.9 if seen else 0.6}
        axis.plot(*zip(start, end, strict=True), zorder=1.5, **style)
        if seen:
            axis.plot(*end, '.', color=FUSED, ms=3)


def _rotation(angle: float) -> Array:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([(cosine, -sine), (sine, cosine)])


VOLTS = ('#a16207', '#0f766e', '#4338ca')


@dataclass(frozen=True, eq=False)
class Evidence:
    """Everything that the figures show."""

    parameters: DigitalTwinParameters
    torque: Sequence[TorqueCurve]
    needed: float
    """N m that a motor must pull in ordinary driving"""
    ramps: tuple[Ramp, Ramp]
    """Within the torque and beyond it."""
    sharp: Array
    """m and V of the sensor, shape (n, 2)"""
    readings: Array
    """True distance (m) and readings of all sensors, shape (n, 9)"""
    low_pass: Sequence[LowPass]
    allan: Allan
    squares: tuple[Course, Course]
    """Counter-clockwise and clockwise."""
    slip_shown: str
    """Slip of the squares."""
    turns: Course
    slip_events: Sequence[FaultEvent]
    """Of the turns."""
    drifts: Sequence[Drift]
    patrol: Patrol


class ValidationFigure(NamedTuple):
    """One figure with its caption."""

    stem: str
    title: str
    caption: str
    draw: Callable[[Evidence], Any]


def torque(evidence: Evidence) -> Any:
    """Return the torque-speed curves, a panel for each current."""
    figure = new_figure(3.3)
    currents = list(dict.fromkeys(curve.current for curve in evidence.torque))
    axes = figure.subplots(1, len(currents), sharey=True, squeeze=False)[0]
    for axis, current in zip(axes, currents, strict=True):
        _torque_panel(axis, evidence, current)
    axes[0].set_ylabel('pull-out torque / N m')
    legend_above(figure, axes[0], columns=3)
    return figure


def _torque_panel(axis: Any, evidence: Evidence, current: float) -> None:
    limiter, motor = evidence.parameters.limiter, evidence.parameters.motor
    axis.axvspan(0.0, limiter.wheel_speed, color='#dbeafe', lw=0.0, label='speeds of the robot')
    axis.axvline(motor.top_speed, color='#60a5fa', lw=1.0, label='fastest pulses')
    axis.axhline(evidence.needed, color=SHEET, lw=1.0, ls=':', label='needed to drive')
    chosen = [curve for curve in evidence.torque if curve.current == current]
    for curve, colour in zip(chosen, VOLTS, strict=True):
        pulls = curve.torque > 0.0
        label = f'{curve.volts:g} V'
        axis.plot(curve.speed[pulls], curve.torque[pulls], color=colour, lw=1.5, label=label)
        at = float(np.interp(curve.ceiling, curve.speed, curve.torque))
        axis.plot(curve.ceiling, at, 'v', color=colour, ms=6, mec='white', mew=0.6)
    axis.plot([], [], 'v', color=FAINT, ms=6, label='V / (2 L I) steps a second')
    axis.set(title=f'{current:g} A', xlabel='wheel speed / rad/s')
    axis.set_xlim(0.0, chosen[0].speed[-1])
    axis.set_ylim(0.0, 1.1 * max(curve.torque[0] for curve in evidence.torque))


def stall(evidence: Evidence) -> Any:
    """Return a ramp within the torque and one beyond it, side by side."""
    figure = new_figure(5.4)
    axes = figure.subplots(3, 2, sharex='col')
    for column, ramp in zip(axes.T, evidence.ramps, strict=True):
        _speeds(column[0], ramp)
        column[0].set_title(_ramp_title(ramp))
        column[1].axhline(1.0, color=SHEET, lw=1.0, ls=':', label='pull-out')
        column[1].plot(ramp.time, ramp.behind, color=COLOURS['value'], lw=1.1)
        if ramp.lost_steps[0] == 0:
            column[1].set_ylim(-1.5, 1.5)
        column[2].plot(ramp.time, ramp.counted_distance, color=STEPS, lw=1.5, label='by the steps')
        column[2].plot(ramp.time, ramp.driven, color=TRUE, lw=1.5, label='true')
        column[2].set_xlabel('time / s')
        column[2].margins(x=0.01)
        column[0].set_ylim(-2.0, 13.0)
        column[2].set_ylim(-0.01, 0.2)
    axes[0, 0].set_ylabel('speed / rad/s')
    axes[1, 0].set_ylabel('rotor behind its\nfield / full steps')
    axes[2, 0].set_ylabel('way / m')
    axes[0, 0].legend(loc='lower center')
    axes[1, 0].legend(loc='lower right')
    axes[2, 0].legend(loc='upper left')
    return figure


def _speeds(axis: Any, ramp: Ramp) -> None:
    axis.plot(ramp.time, ramp.rotor, color=TRUE, lw=0.9, label='rotor')
    axis.plot(ramp.time, ramp.field, color=WANTED, lw=1.3, label='field')


def _ramp_title(ramp: Ramp) -> str:
    lost = ramp.lost_steps[0]
    return f'{ramp.acceleration:.0f} rad/s²: ' + (f'{lost} steps lost' if lost else 'none lost')


def sharp(evidence: Evidence) -> Any:
    """Return output and readings of the distance sensor."""
    figure = new_figure(3.3)
    left, right = figure.subplots(1, 2)
    _sharp_panel(left, evidence)
    true, readings = 100.0 * evidence.readings[:, 0], 100.0 * evidence.readings[:, 1:]
    limits = evidence.parameters.range_sensor
    right.axvspan(100.0 * limits.minimum, 100.0 * limits.maximum, color='#f3f4f6', lw=0.0)
    right.plot((0, 100), (0, 100), color=FAINT, lw=1.0, label='right')
    finite = np.where(np.isfinite(readings), readings, np.nan)
    lines = right.plot(true, finite, '.', color=TRUE, ms=2.0, alpha=0.5, mew=0.0)
    lines[0].set_label('read')
    for value, row, name, beside in (
        (-math.inf, -6.0, 'too near', 13.0),
        (math.inf, 92.0, 'nothing there', 42.0),
    ):
        at = true[(readings == value).any(axis=1)]
        right.plot(at, np.full(at.size, row), '|', color=STEPS, ms=4, mew=1.0)
        right.text(beside, row, name, color=STEPS, va='center', fontsize=8)
    right.set(title='what the board reads', xlabel='true distance / cm', ylabel='read / cm')
    right.set_xlim(0.0, 100.0)
    right.set_ylim(-10.0, 100.0)
    right.legend(loc='upper left', bbox_to_anchor=(0.1, 0.85), markerscale=4)
    return figure


def _sharp_panel(axis: Any, evidence: Evidence) -> None:
    axis.plot(100.0 * evidence.sharp[:, 0], evidence.sharp[:, 1], color=TRUE, lw=1.5, label='twin')
    axis.plot(*np.array(SHARP_SHEET).T, 'o', color=SHEET, ms=4, mfc='white', label='data sheet')
    axis.set(title='voltage', xlabel='distance / cm', ylabel='V')
    axis.set_xlim(0.0, 100.0)
    axis.set_ylim(bottom=0.0)
    axis.legend(loc='upper right')


def gyro(evidence: Evidence) -> Any:
    """Return response, delay and noise of the gyro."""
    figure = new_figure(5.4)
    axes = figure.subplot_mosaic([['gain', 'delay'], ['allan', 'allan']])
    gain, delay, noise = axes['gain'], axes['delay'], axes['allan']
    parameters = evidence.parameters.imu
    for number, response in enumerate(evidence.low_pass):
        own = str(number) == parameters.low_pass
        style = {'color': TRUE if own else FAINT, 'lw': 1.6 if own else 0.9}
        label = f'twin, DLPF_CFG {number}' if own else ('other settings' if number == 0 else None)
        gain.plot(response.frequency, response.gain, label=label, **style)
    cutoffs, delays = np.array(GYRO_SHEET).T
    marks = {'color': SHEET, 'ms': 4.5, 'mfc': 'white', 'label': 'data sheet'}
    gain.plot(cutoffs, np.full(cutoffs.size, -3.01), 'o', **marks)
    gain.set(xscale='log', xlim=(1.0, 600.0), ylim=(-25.0, 2.0))
    gain.set(title='low-pass', xlabel='frequency / Hz', ylabel='gain / dB')
    gain.legend(loc='lower left')
    delay.plot(cutoffs, delays, 'o', **marks)
    found = [(response.cutoff, response.delay) for response in evidence.low_pass]
    delay.plot(*np.array(found).T, 'x', color=TRUE, ms=5, label='twin')
    delay.set(xscale='log', yscale='log')
    delay.set(title='delay', xlabel='frequency at -3 dB / Hz', ylabel='ms')
    delay.legend(loc='upper right')
    span = evidence.allan.span
    noise.plot(span, evidence.allan.deviation, color=TRUE, lw=1.6, label='twin, standing')
    white = parameters.gyro_noise / np.sqrt(2.0 * span)
    walk = parameters.gyro_drift * np.sqrt(span / 3.0)
    shown = f'{parameters.gyro_noise:g} deg/s/√Hz of the data sheet'
    noise.plot(span, white, color=SHEET, lw=1.0, ls='--', label=shown)
    noise.plot(span, walk, color=COLOURS['estimate'], lw=1.0, ls=':', label='wandering bias')
    noise.set(xscale='log', yscale='log', ylim=(0.5 * white[-1], None))
    noise.set(title='Allan deviation', xlabel='averaged over / s', ylabel='deg/s')
    noise.legend(loc='lower center')
    return figure


def overview(evidence: Evidence) -> Any:
    """Return four of the figures in one."""
    figure = new_figure(5.6)
    axes = figure.subplots(2, 2)
    current = evidence.parameters.motor.phase_current
    _torque_panel(axes[0, 0], evidence, current)
    axes[0, 0].set_title(f'pull-out torque / N m, {current:g} A')
    handles, labels = axes[0, 0].get_legend_handles_labels()
    axes[0, 0].legend(handles[3:], labels[3:], fontsize=6.5, loc='upper right')
    beyond = evidence.ramps[1]
    _speeds(axes[0, 1], beyond)
    axes[0, 1].set_ylim(-2.0, 13.0)
    axes[0, 1].set(title=f'stall, {_ramp_title(beyond)}', xlabel='time / s', ylabel='rad/s')
    axes[0, 1].legend(fontsize=6.5, loc='upper right', ncols=2)
    _sharp_panel(axes[1, 0], evidence)
    axes[1, 0].set_title('distance sensor')
    draw_square(axes[1, 1], evidence.squares[0])
    axes[1, 1].set(title=f'square, {evidence.slip_shown}', xlabel='x / m', ylabel='y / m')
    low, high = axes[1, 1].dataLim.intervaly
    axes[1, 1].plot(0.0, high + 0.3 * (high - low), alpha=0.0)  # room for the legend
    axes[1, 1].legend(fontsize=6.5, loc='upper left')
    return figure


VALIDATION_FIGURES = (
    ValidationFigure(
        'torque',
        'What the motors can pull',
        'Pull-out torque against wheel speed. The triangles mark V / (2 L I) full steps a second, '
        'where a current can no longer rise within a step; the shade is where the robot drives, '
        'the line beside it 10 000 pulses a second; the dots what the robot needs to accelerate '
        'as fast as it may.',
        torque,
    ),
    ValidationFigure(
        'stall',
        'A ramp within the torque and one beyond it',
        'On tyres that never slide. Beyond its torque the rotor falls out of its field and turns '
        'no more until the field is slow again; steps are lost by whole tooth pitches, four full '
        'steps each. The step counters know nothing of it.',
        stall,
    ),
    ValidationFigure(
        'sharp',
        'The distance sensor',
        "Sharp GP2Y0A21YK0F against its data sheet's figure 2. Nearer than 6 cm the voltage falls "
        'again, and the board reads a distance that is not there: below 4 cm all of them are '
        'wrong. Eight sensors, noise and all; the shade is the measuring range.',
        sharp,
    ),
    ValidationFigure(
        'gyro',
        'The gyro',
        'MPU6050: low-pass and its delay, measured with a pulse, against the register map; noise '
        'of the standing gyro against the data sheet. No two real poles have both frequency and '
        'delay of the sheet below 40 Hz.',
        gyro,
    ),
    ValidationFigure(
        'squares',
        'A square, both ways round',
        'UMBmark: 4 m sides, driven by counting steps while the wheels slip now and then. The '
        'steps see a perfect square. Dots are where each ends.',
        lambda e: squares(e.squares),
    ),
    ValidationFigure(
        'turns',
        'Ten turns on the spot',
        'What is wrong with both yaw angles. Shaded: spells in which a wheel slips if it is asked '
        'for more than the grip that is left.',
        lambda e: turns(e.turns, e.slip_events, e.slip_shown),
    ),
    ValidationFigure(
        'drift',
        'Yaw errors at the end',
        'Above, root mean square over the seeds; below, each course with slip: under the dashed '
        'line the gyro leaves less than a fifth. It cannot where the steps are hardly wrong, '
        'because of its own errors: bias that wanders, and scale, which a turn one way adds up.',
        lambda e: drift(e.drifts),
    ),
    ValidationFigure(
        'room',
        'Through a room, and into its wall',
        'The robot turns away from what its front sensors see (green: what they read; grey: '
        'nothing there). Then all sensors die, and it drives on.',
        lambda e: room(e.patrol, e.parameters),
    ),
    ValidationFigure(
        'overview',
        'At a glance',
        'What the motors pull (shade: speeds of the robot; line: fastest pulses; dots: needed), a '
        'stall, the distance sensor, a square on a slippery floor.',
        overview,
    ),
)
"""In the order of the page; the last, four of them in one, comes first there."""


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
    """Write page and figures, and return the tables and the path of the page as text."""
    evidence = run_validation(seed, amount, progress=progress)
    tables = [courses.drift_table(evidence.drifts), bench_table(evidence)]
    pictures = write_pictures(VALIDATION_FIGURES, evidence, output)
    origin = f'seeds {seed} to {seed + amount.seeds - 1}; simulation only'
    if amount == QUICK:
        origin = f'a quick look, {origin}'
    findings = _findings(evidence)
    *others, overview_figure = VALIDATION_FIGURES
    overview_picture = pictures[overview_figure.stem]
    blocks: list[Block] = [
        Paragraph(origin, 'quiet'),
        Picture(overview_figure.title, overview_picture, overview_figure.caption),
        Contents(),
        Heading('Findings'),
        *map(Paragraph, findings),
        *tables,
    ]
    for drawing in others:
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
        [slip for slip in courses.SLIPS if slip.fault == kind][-amount.strengths :]
        for kind in dict.fromkeys(slip.fault for slip in courses.SLIPS)
    ]
    slips = [courses.NO_SLIP, *(slip for kind in kinds for slip in kind)]
    shown = courses.SLIPS[1]
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
    found = courses.measure_drifts(seeds, slips, progress=progress)
    squares = tuple(
        courses.drive_course(name, shown, seed) for name in ('square ccw', 'square cw')
    )
    turns = courses.drive_course('10 turns', shown, seed)
    slip_events = courses.slip_events('10 turns', shown, seed)
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
