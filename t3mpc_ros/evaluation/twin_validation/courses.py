# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Courses of the digital twin, UMBmark square, turns and patrol, and its yaw drift under slip.

Squares and turns follow Borenstein and Feng (Measurement and Correction of Systematic Odometry
Errors in Mobile Robots, IEEE Trans. Robotics and Automation 12(6), 1996, doi:10.1109/70.544770):
each leg ends at a wheel angle, measured by the step counters. Odometry therefore has no influence
on the drive, and the same slip acts on every odometry. The robot rests before the start, for the
gyro bias, and at the end.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import yaml

from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.reporting import EMPTY_CELL, Table, progress_bar
from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.robot.interface import RANGE_SENSORS, ZERO_WHEEL_SPEEDS, RobotState
from t3mpc_ros.robot.wheel_odometry import WheelOdometry
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters
from t3mpc_ros.simulation.fault_injection import FaultEvent
from t3mpc_ros.simulation.world import load_world

Array = npt.NDArray[np.float64]

SIDE = 4.0
"""m, of the square of UMBmark."""
STANDING = 1.5
"""s that the robot stands before the first leg and after the last one."""
PAUSE = 0.3
"""s between two legs; too short for the gyro's bias to be measured again."""
TOP_SPEED = 8.0
"""rad/s of a wheel on a leg: 0.28 m/s, or a turn of the robot in 1.7 s."""
DECELERATION_ANGLE = 0.4
"""Part of the command limiter's acceleration with which a leg is brought to its end."""


class Slip(NamedTuple):
    """Slip events of one fault at random times, independent of the motion."""

    name: str
    fault: str
    """``slippery`` or ``wheel_blocked``; which wheel is held is drawn each time."""
    grip: float
    """Part of the tyres' grip that is left during a slip event; 1 when a wheel is held."""
    pause: float
    """s from the end of a slip event to the next one, on average (exponential)"""
    length: float
    """s a slip event lasts: on average (exponential) for grip, always for a held wheel"""

    def slip_events(self, generator: np.random.Generator, until: float) -> tuple[FaultEvent, ...]:
        """Return the slip events that start within ``until`` seconds after the robot has stood."""
        events = []
        at = STANDING + generator.exponential(self.pause)
        while at < STANDING + until:
            length, side = generator.exponential(self.length), int(generator.integers(2))
            if self.fault == 'wheel_blocked':
                event = FaultEvent(at, self.fault, ('right', 'left')[side], self.length)
            else:
                event = FaultEvent(at, self.fault, self.grip, max(length, 0.02))
            events.append(event)
            at = event.until + generator.exponential(self.pause)
        return tuple(events)


@dataclass(frozen=True, eq=False)
class Course:
    """Record of a drive, one row per period; yaw angles are unwrapped."""

    name: str
    time: Array
    """s, shape (n,)"""
    truth: Array
    """x, y (m), yaw (rad) of the body, shape (n, 3)"""
    odometry: Array
    """What the robot reported, shape (n, 3)."""
    steps: Array
    """Pose from the step counters alone, shape (n, 3)."""
    slid: tuple[float, float]
    """m each tyre has slid, right first"""
    lost_steps: tuple[int, int]
    """Full steps the rotors are behind at the end."""
    detected: float
    """s during which the robot reported a mismatch of gyro and steps"""


@dataclass(frozen=True, eq=False)
class Patrol:
    """A drive by the distance sensors, until they fail and after."""

    course: Course
    ranges: Array
    """m, readings of the sensors, shape (n, 8), REP 117; NaN: not measured"""
    blind_from: float
    """s; from then on no sensor is measured"""
    hit_at: float
    """s at which it first touched a wall after that; NaN if it did not"""
    touched_before: bool
    """Whether it touched one before."""
    max_contact_force: float
    """N"""


def umbmark(
    parameters: DigitalTwinParameters,
    clockwise: bool,
    slip_events: Iterable[FaultEvent] = (),
    side: float = SIDE,
) -> Course:
    """Return the course of a square of ``side`` metres, back to where it started.

    Raises
    ------
    RuntimeError
        The robot does not get to the end of a leg.
    """
    geometry = parameters.geometry
    along = side / geometry.wheel_radius
    corner = 0.5 * math.pi * geometry.half_separation / geometry.wheel_radius
    corner *= -1.0 if clockwise else 1.0
    legs = [(along, along), (corner, -corner)] * 4
    return _driven('square cw' if clockwise else 'square ccw', parameters, legs, slip_events)


def spin(
    parameters: DigitalTwinParameters, turns: int, slip_events: Iterable[FaultEvent] = ()
) -> Course:
    """Return the course of turns on the spot, counter-clockwise, with a stop after each."""
    geometry = parameters.geometry
    turn = 2.0 * math.pi * geometry.half_separation / geometry.wheel_radius
    return _driven(f'{turns} turns', parameters, [(turn, -turn)] * turns, slip_events)


def yaw_drift(course: Course, by_steps: bool = False) -> float:
    """Return the yaw error (rad) at the end, not wrapped.

    That of the robot's odometry, or that of the step counters alone.
    """
    estimate = course.steps if by_steps else course.odometry
    return float(estimate[-1, 2] - course.truth[-1, 2])


def place_error(course: Course, by_steps: bool = False) -> float:
    """Return the position error (m) at the end."""
    estimate = course.steps if by_steps else course.odometry
    return math.dist(estimate[-1, :2].tolist(), course.truth[-1, :2].tolist())


def gyro_limit(parameters: DigitalTwinParameters, course: Course) -> float:
    """Return the bound (rad) of the yaw error of this gyro alone at the end of a course.

    Its error of scale at the largest, three standard deviations of what its bias wanders from
    one standstill to the other, sigma t^1.5 / sqrt 3, and of what its noise leaves in the bias
    that is measured within the last second before the start.
    """
    imu = parameters.imu
    turned = abs(course.truth[-1, 2] - course.truth[0, 2])
    moving = float(course.time[-1] - course.time[0]) - 2.0 * STANDING
    wandered = imu.gyro_drift * moving**1.5 / math.sqrt(3.0)
    unsure = imu.gyro_noise * moving / math.sqrt(2.0)
    scale = imu.gyro_scale_error * float(turned)
    return scale + 3.0 * math.radians(math.hypot(wandered, unsure))


def patrol(parameters: DigitalTwinParameters, blind_from: float, longest: float) -> Patrol:
    """Return a drive through the world of ``parameters`` that turns away from obstacles.

    It turns to the freer side when something is nearer than 0.3 m in front or 0.15 m beside it,
    until that is 0.4 or 0.2 m away. From ``blind_from`` (s) on no sensor answers, and it drives
    straight on, until it has been at a wall for a second, or for ``longest`` seconds. The wheels
    turn at 6 rad/s.
    """
    speed = 6.0
    log = _Log('patrol', parameters, [FaultEvent(blind_from, 'ranges_dead', True)])
    world, radius = load_world(parameters.world), parameters.bumper.radius
    ranges = []
    turn, hit_at, touched_before = 0.0, math.nan, False
    while log.elapsed < blind_from + longest and not log.elapsed > hit_at + 1.0:
        turn = _turn_away(log.state.ranges, turn)
        wheels = WheelSpeeds(speed, speed)
        if turn != 0.0:
            wheels = WheelSpeeds(0.5 * speed * turn, -0.5 * speed * turn)
        log.step(wheels if log.elapsed >= STANDING else ZERO_WHEEL_SPEEDS)
        ranges.append(log.state.ranges or (math.nan,) * len(RANGE_SENSORS))
        touches = not world.is_free(*log.place, radius)
        if touches and log.elapsed < blind_from:
            touched_before = True
        elif touches and math.isnan(hit_at):
            hit_at = log.elapsed
    push = log.robot.diagnostics.max_contact_force
    return Patrol(log.course(), np.array(ranges), blind_from, hit_at, touched_before, push)


def _turn_away(ranges: Sequence[float], turn: float) -> float:
    """Return 1 for a left turn, -1 for right, 0 for straight on; ``turn`` is the current one."""
    if not ranges:
        return 0.0
    by_name = dict(zip(RANGE_SENSORS, ranges, strict=True))
    ahead = min(by_name['front_left'], by_name['front_right'])
    left = min(by_name['left_front'], by_name['left_back'])
    right = min(by_name['right_front'], by_name['right_back'])
    if turn != 0.0:
        behind = right if turn > 0.0 else left
        return turn if ahead < 0.4 or behind < 0.2 else 0.0
    if ahead < 0.3:
        return 1.0 if left >= right else -1.0
    if min(left, right) < 0.15:
        return 1.0 if right < left else -1.0
    return 0.0


class _Log:
    """A robot driven under a schedule of faults, with its record."""

    def __init__(
        self, name: str, parameters: DigitalTwinParameters, slip_events: Iterable[FaultEvent]
    ) -> None:
        self.robot = _troubled(parameters, tuple(slip_events))
        self.state: RobotState = self.robot.advance(0)
        self._name = name
        self._parameters = parameters
        self._reckoning = WheelOdometry(parameters.odometry, parameters.geometry)
        self._rows: list[tuple[float, ...]] = []
        self._detected = 0

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return self.state.stamp_ns / NANOSECONDS

    @property
    def place(self) -> tuple[float, float]:
        """Position of the robot, m."""
        truth = self.state.truth
        return (0.0, 0.0) if truth is None else (truth.pose.x, truth.pose.y)

    def step(self, wheels: WheelSpeeds) -> None:
        """Drive for one period."""
        before = self.state.angles
        self.state = state = self.robot.step(wheels)
        now = state.angles
        self._reckoning.update(now.right - before.right, now.left - before.left)
        truth = (0.0, 0.0, 0.0) if state.truth is None else state.truth.pose
        self._rows.append((self.elapsed, *truth, *state.odometry.pose, *self._reckoning.pose))
        self._detected += state.status.slipping

    def stand(self, seconds: float) -> None:
        """Keep the robot at rest."""
        for _ in range(round(seconds * self._parameters.rate)):
            self.step(ZERO_WHEEL_SPEEDS)

    def course(self) -> Course:
        """Return the record so far."""
        rows = np.array(self._rows)
        for yaw in (3, 6, 9):
            rows[:, yaw] = np.unwrap(rows[:, yaw])
        inside = self.robot.diagnostics
        return Course(
            name=self._name,
            time=rows[:, 0],
            truth=rows[:, 1:4],
            odometry=rows[:, 4:7],
            steps=rows[:, 7:10],
            slid=inside.slid,
            lost_steps=self.state.lost_steps or (0, 0),
            detected=self._detected / self._parameters.rate,
        )


def _troubled(parameters: DigitalTwinParameters, slip_events: Sequence[FaultEvent]) -> DigitalTwin:
    """Return a robot with ``slip_events`` in place of its fault schedule, if there are any."""
    if not slip_events:
        return DigitalTwin(parameters)
    entries = []
    for slip_event in slip_events:
        entry = {'at': slip_event.at, 'fault': slip_event.fault, 'value': slip_event.value}
        entries.append(
            entry | ({'for': slip_event.duration} if slip_event.duration < math.inf else {})
        )
    with TemporaryDirectory() as folder:
        path = Path(folder) / 'spells.yaml'
        path.write_text(yaml.safe_dump({'events': entries}), encoding='utf-8')
        return DigitalTwin(parameters.with_values({'faults.schedule': str(path)}))


def _driven(
    name: str,
    parameters: DigitalTwinParameters,
    legs: Iterable[tuple[float, float]],
    slip_events: Iterable[FaultEvent],
) -> Course:
    """Drive legs, each a pair of angles (rad, right first) that the wheels shall turn."""
    log = _Log(name, parameters, slip_events)
    log.stand(STANDING)
    exact = 0.5 * parameters.motor.microstep
    slowing = 2.0 * DECELERATION_ANGLE * parameters.limiter.acceleration
    goal = np.array(log.state.angles)
    for number, leg in enumerate(legs, 1):
        goal += leg
        patience = log.elapsed + 10.0 + 4.0 * max(map(abs, leg)) / TOP_SPEED
        while (far := float(np.abs(goal - log.state.angles).max())) > exact:
            if log.elapsed > patience:
                raise RuntimeError(
                    f'{name}: leg {number} did not end within {patience:.0f} s, the wheels have '
                    f'{far:.3g} rad to go: {log.state.reason or "no reason is known"}'
                )
            # So slow at the end that a command which is two periods late does not overshoot.
            speed = min(TOP_SPEED, math.sqrt(slowing * far), far * parameters.rate / 6.0)
            log.step(_towards(goal - log.state.angles, speed, exact))
        log.stand(PAUSE)
    log.stand(STANDING - PAUSE)
    return log.course()


def _towards(remaining: Array, speed: float, exact: float) -> WheelSpeeds:
    """Return wheel speeds towards what remains (rad, right first); 0 for a wheel at its goal."""
    right, left = (
        math.copysign(speed, angle) if abs(angle) > exact else 0.0 for angle in remaining.tolist()
    )
    return WheelSpeeds(right, left)


PART = 0.2
"""The gyro shall leave no more than this part of the drift that steps alone have."""
LONGEST = 100.0
"""s after which no slip event starts; no course here takes as long."""

NO_SLIP = Slip('no slip', 'slippery', 1.0, 1e9, 0.0)
SLIPS = (
    Slip('grip lost to 20 %', 'slippery', 0.2, 2.0, 0.5),
    Slip('grip lost to 10 %', 'slippery', 0.1, 2.0, 0.5),
    Slip('grip lost to 5 %', 'slippery', 0.05, 2.0, 0.5),
    Slip('wheel held every 30 s', 'wheel_blocked', 1.0, 30.0, 0.2),
    Slip('wheel held every 15 s', 'wheel_blocked', 1.0, 15.0, 0.2),
    Slip('wheel held every 7.5 s', 'wheel_blocked', 1.0, 7.5, 0.2),
)
"""Two kinds of slip, each in three strengths.

With the default grip of 0.6 a slip event leaves 0.12, 0.06 or 0.03: wet floor, oil, ice. To speed
up by 30 rad/s² takes 0.13 straight ahead, and 0.36 on the spot because of the body's inertia.
A wheel that is held, by a cable say, stops its motor, which loses steps until the next halt, and
lets the robot turn about that wheel.
"""

COURSES: dict[str, Callable[..., Course]] = {
    'square ccw': lambda parameters, events: umbmark(parameters, False, events),
    'square cw': lambda parameters, events: umbmark(parameters, True, events),
    '10 turns': lambda parameters, events: spin(parameters, 10, events),
}


class Drift(NamedTuple):
    """Yaw errors of one course."""

    course: str
    slip: str
    seed: int
    steps: float
    """rad, of the steps alone"""
    fused: float
    """rad, with the gyro"""
    limit: float
    """rad that the gyro's own errors may come to, see ``gyro_limit``"""
    steps_place: float
    """m that the end is off by the steps alone"""
    fused_place: float
    """m, with the gyro"""
    slid: float
    """m that the tyres have slid, the mean of both"""
    lost: int
    """Full steps lost by both motors."""
    detected: float
    """s during which the robot reported slip"""

    @property
    def holds(self) -> bool:
        """Whether the gyro leaves at most :data:`PART` of the drift."""
        return abs(self.fused) <= PART * abs(self.steps)


def robot(seed: int) -> DigitalTwinParameters:
    """Return the robot that drives the courses: all defaults, but it does not stop for slip."""
    return DigitalTwinParameters.from_dict({'seed': seed, 'slip_stop': 0.0})


def slip_events(name: str, slip: Slip, seed: int) -> tuple[FaultEvent, ...]:
    """Return the slip events of a course; they depend on every argument."""
    numbers = [seed, list(COURSES).index(name), *slip.name.encode()]
    return slip.slip_events(np.random.default_rng(numbers), LONGEST)


def drive_course(name: str, slip: Slip, seed: int) -> Course:
    """Return one of :data:`COURSES` under ``slip``, driven by :func:`robot`."""
    return COURSES[name](robot(seed), slip_events(name, slip, seed))


def measure_drift(
    course: Course, slip: Slip, seed: int, parameters: DigitalTwinParameters
) -> Drift:
    """Return the figures of a course."""
    return Drift(
        course=course.name,
        slip=slip.name,
        seed=seed,
        steps=yaw_drift(course, by_steps=True),
        fused=yaw_drift(course),
        limit=gyro_limit(parameters, course),
        steps_place=place_error(course, by_steps=True),
        fused_place=place_error(course),
        slid=0.5 * sum(course.slid),
        lost=sum(map(abs, course.lost_steps)),
        detected=course.detected,
    )


def measure_drifts(
    seeds: Sequence[int],
    slips: Sequence[Slip],
    courses: Sequence[str] = tuple(COURSES),
    *,
    progress: bool = False,
) -> list[Drift]:
    """Return every course under every slip with every seed."""
    found = []
    runs = [(name, slip, seed) for name in courses for slip in slips for seed in seeds]
    with progress_bar(len(runs), show=progress) as bar:
        for name, slip, seed in runs:
            course = drive_course(name, slip, seed)
            found.append(measure_drift(course, slip, seed, robot(seed)))
            bar.update()
    return found


def select_drifts(found: Iterable[Drift], course: str, slip: str) -> list[Drift]:
    """Return those of one course under one slip."""
    return [drift for drift in found if drift.course == course and drift.slip == slip]


def holds_from(found: Iterable[Drift]) -> float:
    """Return the drift by steps (rad) from which on the gyro always leaves a fifth or less.

    That of the largest drift for which it does not; 0 when it always does.
    """
    return max((abs(drift.steps) for drift in found if not drift.holds), default=0.0)


def drift_table(found: Sequence[Drift]) -> Table:
    """Return a row for each course and slip."""
    rows = []
    for course in dict.fromkeys(drift.course for drift in found):
        for slip in dict.fromkeys(drift.slip for drift in found):
            members = select_drifts(found, course, slip)
            if not members:
                continue
            steps = rms([drift.steps for drift in members])
            fused = rms([drift.fused for drift in members])
            slips = slip != NO_SLIP.name
            rows.append(
                (
                    course,
                    slip,
                    f'{np.degrees(steps):.1f}',
                    f'{np.degrees(fused):.1f}',
                    f'{fused / steps:.3f}' if slips else EMPTY_CELL,
                    f'{sum(d.holds for d in members)} of {len(members)}' if slips else EMPTY_CELL,
                    f'{rms([d.steps_place for d in members]):.2f}',
                    f'{rms([d.fused_place for d in members]):.2f}',
                    f'{np.mean([d.slid for d in members]):.2f}',
                    f'{np.mean([d.lost for d in members]):.0f}',
                )
            )
    return Table(
        'Errors at the end of a course, root mean square over the seeds',
        (
            'course', 'slip', 'yaw by steps / deg', 'with gyro / deg', 'ratio',
            'at most 1/5', 'place by steps / m', 'with gyro / m', 'slid / m', 'lost steps',
        ),
        rows,
    )  # fmt: skip
