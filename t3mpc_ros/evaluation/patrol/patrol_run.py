# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A patrol on the digital twin without ROS: path, pose loop, keep-out, range sensors, faults.

The loop has the timing of the nodes: the reference is stamped ahead by its lead, each report of
the robot leads to one command, which arrives after the dead time of the link or is lost.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
import math
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.portrait import PortraitParameters, PortraitPath
from t3mpc_ros.chaos.pose_reference import PathClock, WaitParameters
from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.control.controller import Controller, StepperControllerParameters
from t3mpc_ros.control.keep_out import Activity
from t3mpc_ros.evaluation.patrol.path_trackers import PathTracker
from t3mpc_ros.geometry.path_timing import MotionLimits, PathTiming
from t3mpc_ros.geometry.types import (
    NANOSECONDS,
    ORIGIN,
    STANDSTILL,
    BodyTwist,
    Pose,
    State,
    wrap_angle,
)
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters
from t3mpc_ros.simulation.world import load_world

Array = NDArray[np.float64]

LEAD = 0.4
"""Lead of the reference over the odometry, s."""
INITIAL_STANDSTILL = 1.5
"""Standstill before the run, s; odometry uses the gyro only after it."""
SETTLING = 2.0
"""Time after the robot has reached its path again that still counts as avoidance, s."""
ACTIVITIES = tuple(Activity)
"""Meaning of :attr:`PatrolRecord.activity`."""
RATE = 100.0
"""Periods per second, Hz."""


@dataclass(frozen=True)
class PatrolScenario:
    """World, robot and localisation of a patrol."""

    seed: int = 1
    """Seed of the robot, of its noise and of the unknown boxes."""
    duration: float = 600.0
    """s"""
    known_world: str = ''
    """World that the keep-out knows: a name or a file; empty: nothing."""
    world: str = ''
    """World in which the robot drives: a name or a file; empty: that which it knows."""
    localised: bool = True
    """Whether the pose of the robot is given with noise; else it is that of its odometry."""
    position_noise: float = 0.003
    """Standard deviation of a given position in each coordinate, m."""
    yaw_noise: float = 0.005
    """That of a given yaw, rad."""
    command_loss: float = 0.1
    """Share of commands that are lost."""
    limits: MotionLimits = field(default_factory=MotionLimits)
    """Limits of the path."""
    wait: WaitParameters = WaitParameters(distance=0.0)
    """Where and how long the path waits for the robot; by default never."""
    keep_out: bool = True
    """Whether the keep-out is used."""
    robot: Mapping[str, object] = field(default_factory=dict)
    """Further parameters of the robot by name."""
    controller: Mapping[str, object] = field(default_factory=dict)
    """Further parameters of the controller by name."""


@dataclass(frozen=True, slots=True)
class PatrolRecord:
    """One patrol, a row for each period; poses are x, y (m), yaw (rad), twists m/s and rad/s."""

    time: Array
    """s since the end of the initial standstill, shape (n,)"""
    reference: Array
    """Pose of the reference, shape (n, 3)"""
    reference_twist: Array
    """Shape (n, 2)"""
    truth: Array
    """True pose, shape (n, 3)"""
    pose: Array
    """Pose that the controller got, shape (n, 3)"""
    command: Array
    """Twist that the controller commanded, shape (n, 2)"""
    twist: Array
    """True twist, shape (n, 2)"""
    ranges: Array
    """Readings of the range sensors, m, as in :attr:`RobotState.ranges`, shape (n, 8)"""
    contact_force: Array
    """Largest contact force so far, N, shape (n,)"""
    activity: NDArray[np.int64]
    """Index into :data:`ACTIVITIES`, shape (n,)"""
    avoiding: NDArray[np.bool_]
    """Whether the keep-out changed the command or the robot was on its way back, shape (n,)"""
    cells: NDArray[np.int8]
    """Map of the keep-out at the end, see :mod:`t3mpc_ros.control.free_space_map`."""

    @property
    def error(self) -> Array:
        """Distance of the true position from that of the reference, m, shape (n,)."""
        error: Array = np.hypot(*(self.truth - self.reference)[:, :2].T)
        return error

    @property
    def outside_avoidance(self) -> NDArray[np.bool_]:
        """Rows that are no avoidance and follow its end by :data:`SETTLING` s, shape (n,)."""
        last = np.maximum.accumulate(np.where(self.avoiding, np.arange(self.time.size), -(10**9)))
        outside: NDArray[np.bool_] = np.arange(self.time.size) - last > SETTLING * RATE
        return outside

    @property
    def contacts(self) -> int:
        """Number of periods in which the largest contact force grew: 0 without any contact."""
        return int((np.diff(self.contact_force, prepend=0.0) > 0.0).sum())


def portrait_points(
    seed: int, limits: MotionLimits, parameters: PortraitParameters | None = None
) -> Iterator[Array]:
    """Yield the points (m) of the chaotic path of a seed, about 1 m at a time."""
    path = PortraitPath(
        ReferenceParameters(), parameters or PortraitParameters(), limits.linear, seed
    )
    while True:
        yield path.advance(1.0)


def run_patrol(
    points: Iterator[Array],
    scenario: PatrolScenario,
    on_progress: Callable[[float], None] | None = None,
    tracker: PathTracker | None = None,
) -> PatrolRecord:
    """Return the record of a robot that follows a path; equal arguments give equal runs.

    Parameters
    ----------
    points
        Pieces (m), shape (k, 2), of the path from where the robot starts, at (0, 0) facing x; a
        path that ends leaves the robot at its last point.
    scenario
        World, robot and localisation.
    on_progress
        Called each simulated second with the share that is done.
    tracker
        Law in place of the controller; the path is then only recorded as the reference.
    """
    robot_parameters = DigitalTwinParameters.from_dict(
        {
            'noise.variance': 0.04,
            'world': scenario.world or scenario.known_world,
            'seed': scenario.seed,
            'faults.command_loss': scenario.command_loss,
            **scenario.robot,
        }
    )
    controller = Controller(
        StepperControllerParameters.from_dict(
            {
                'pose.enabled': True,
                'keep_out.enabled': scenario.keep_out,
                **scenario.controller,
            }
        ),
        load_world(scenario.known_world).obstacles,
    )
    controller.warm_up()
    robot = DigitalTwin(robot_parameters)
    timing = PathTiming(scenario.limits, robot_parameters.geometry, 1.0 / RATE, ORIGIN)
    clock = PathClock(scenario.wait)
    generator = np.random.default_rng((scenario.seed, 7))
    lead, rest = round(LEAD * RATE), round(INITIAL_STANDSTILL * RATE)
    references: list[tuple[Pose, BodyTwist]] = []
    rows = []
    ranges_before: tuple[float, ...] = ()
    for k in range(rest + round(scenario.duration * RATE)):
        while len(references) <= k + lead:
            references.append(
                (ORIGIN, BodyTwist(0.0, 0.0))
                if len(references) < rest
                else timing.advance_along(points, clock.rate)
            )
            stamp = _stamp(len(references) - 1)
            controller.add_reference(State(stamp, *references[-1]))
            clock.add_reference(stamp, references[-1][0])
        state = robot.advance(_stamp(k))
        assert state.truth is not None
        pose = state.odometry.pose
        noise = generator.standard_normal(3)
        if scenario.localised:
            x, y, yaw = state.truth.pose
            pose = Pose(
                x + scenario.position_noise * float(noise[0]),
                y + scenario.position_noise * float(noise[1]),
                wrap_angle(yaw + scenario.yaw_noise * float(noise[2])),
            )
        if k < rest:
            pose = ORIGIN  # where it is placed, known without noise
        clock.observe(state.stamp_ns, pose)
        controller.enable(k >= rest)
        for sensor, reading in enumerate(state.ranges):
            if not ranges_before or reading != ranges_before[sensor] or k % 4 == 0:
                controller.add_range(sensor, reading)
        ranges_before = state.ranges
        if tracker is None:
            twist, _ = controller.step(State(state.stamp_ns, pose, state.odometry.twist))
        else:
            twist = tracker.step(pose) if k >= rest else STANDSTILL
        robot.apply(
            RobotCommand.from_twist(twist, robot_parameters.geometry, state.stamp_ns),
            _stamp(k + 1) - 1,
        )
        if k < rest:
            continue
        keep_out = controller.keep_out
        changed = keep_out is not None and keep_out.changed
        activity = Activity.FREE if keep_out is None else keep_out.activity
        rows.append(
            (
                (k - rest) / RATE,
                references[k][0],
                references[k][1],
                state.truth.pose,
                pose,
                twist,
                state.truth.twist,
                state.ranges,
                robot.diagnostics.max_contact_force,
                ACTIVITIES.index(activity),
                changed or controller.pose_controller.rejoining,
            )
        )
        if on_progress is not None and k % 100 == 0:
            on_progress((k - rest) / (scenario.duration * RATE))
    columns: list[Any] = [np.array(column) for column in zip(*rows, strict=True)]
    keep_out = controller.keep_out
    columns.append(
        np.zeros((0, 0), dtype=np.int8) if keep_out is None else keep_out.map.grid.cells
    )
    return PatrolRecord(*columns)


def _stamp(k: int) -> int:
    return round(k * NANOSECONDS / RATE)


def room_with_boxes(
    seed: int, size: tuple[float, float] = (4.0, 3.0), boxes: int = 3, grip: float = 0.25
) -> str:
    """Return the YAML text of a room around the origin, with boxes drawn from a seed.

    The boxes have sides of 0.2 to 0.5 m. They leave 0.5 m free around the origin and to each
    other, and stand anywhere else, also at a wall. Two patches of floor have the given grip.
    """
    generator = np.random.default_rng((seed, 11))
    half = 0.5 * np.array(size)
    placed: list[tuple[float, float, float]] = []
    lines = [
        'name: patrolled_room',
        f'walls: [{{points: [[{-half[0]}, {-half[1]}], [{half[0]}, {-half[1]}], '
        f'[{half[0]}, {half[1]}], [{-half[0]}, {half[1]}]], closed: true}}]',
        'boxes:',
    ]
    while len(placed) < boxes:
        length, width = generator.uniform(0.2, 0.5, 2).tolist()
        yaw = float(generator.uniform(0.0, math.pi))
        reach = 0.5 * math.hypot(length, width)
        x, y = generator.uniform(reach - half, half - reach).tolist()
        near = (math.hypot(x - a, y - b) - c for a, b, c in [(0.0, 0.0, 0.0), *placed])
        if min(near) < reach + 0.5:
            continue
        placed.append((x, y, reach))
        lines.append(
            f'  - {{center: [{x:.4f}, {y:.4f}], size: [{length:.4f}, {width:.4f}], '
            f'yaw: {yaw:.4f}}}'
        )
    lines.append('patches:')
    for x, y in generator.uniform(0.3 - half, half - 0.3, (2, 2)).tolist():
        lines.append(f'  - {{center: [{x:.4f}, {y:.4f}], radius: 0.25, grip: {grip}}}')
    return '\n'.join(lines) + '\n'


@contextmanager
def world_file(text: str) -> Iterator[str]:
    """Yield the path of a temporary world file with a text."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'world.yaml'
        path.write_text(text)
        yield str(path)
