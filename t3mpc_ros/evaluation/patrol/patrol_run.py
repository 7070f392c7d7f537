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
"""A patrol on the digital twin without ROS: path, pose loop, keep-out, range sensors, faults.

The loop has the timing of the nodes: the reference is stamped ahead by its lead, each report of
the robot leads to one command, which arrives after the dead time of the link or is lost.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
import math
from pathlib import Path
import tempfile
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.chaotic_path import PortraitParameters, PortraitPath
from t3mpc_ros.chaos.path_replanning import PlannedPath, PlanParameters
from t3mpc_ros.chaos.pose_reference import PathClock, WaitParameters
from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.chaos.secret_random import SecretRandom
from t3mpc_ros.control.controller import Controller, StepperControllerParameters
from t3mpc_ros.control.keep_out import Activity
from t3mpc_ros.evaluation.loop import reports_of, run_loop
from t3mpc_ros.evaluation.patrol.pure_pursuit import PathTracker
from t3mpc_ros.evaluation.run_record import ON_PATH, RATE, Record, stamp_of
from t3mpc_ros.evaluation.scenario import KINDS, LEAD
from t3mpc_ros.geometry.kinematics import WheelGeometry, wheels_from_twist
from t3mpc_ros.geometry.path_timing import MotionLimits, PathTiming
from t3mpc_ros.geometry.polygon_arena import Arena
from t3mpc_ros.geometry.types import (
    NANOSECONDS,
    ORIGIN,
    STANDSTILL,
    Array,
    BodyTwist,
    Pose,
    State,
    wrap_angle,
)
from t3mpc_ros.localization.distance_field import map_of_world
from t3mpc_ros.localization.localizer import (
    Localization,
    Localizer,
    LocalizerParameters,
    PoseCorrection,
)
from t3mpc_ros.robot.interface import RobotCommand, RobotState
from t3mpc_ros.robot.sensor_mounts import sensor_mounts
from t3mpc_ros.robot.sensor_parameters import RangeSensorParameters
from t3mpc_ros.simulation.digital_twin import DigitalTwin, DigitalTwinParameters
from t3mpc_ros.simulation.plant_adapter import Signals
from t3mpc_ros.simulation.world import MovingDisc, load_world

START = KINDS['twin'].start
"""Standstill before the drive, s."""
SETTLING = 2.0
"""Time after the robot has reached its path again that still counts as avoidance, s."""
ACTIVITIES = tuple(Activity)
"""Meaning of the column ``activity``."""
LIMITS = MotionLimits()
"""Limits of every path that is not planned."""
PLANNED_LIMITS = MotionLimits(linear=0.33, wheel_speed=10.0)
"""Limits of a planned path, as the launch file sets them: it never has to catch up."""
EARLY = 180.0
"""Time before which the robot mainly explores, s."""
COMMAND_LOSS = 0.1
"""Share of commands that are lost."""
POSITION_NOISE, YAW_NOISE = 0.003, 0.005
"""Standard deviation of the given position in each coordinate (m), and of the given yaw (rad)."""
CARRIED_DISTANCE = 1.0
"""Distance by which a robot is carried, within the walls, m."""
MAP_PERIOD = round(0.25 * RATE)
"""Periods between two maps of the keep-out."""
GRIP = 0.25
"""Share of the grip that slippery patches of floor have."""


LOCALIZATIONS = 'given', 'odometry', 'filter'
"""Sources of the pose: the true one with noise; the odometry; a particle filter on the world."""


Visitors = Callable[[float, State], MovingDisc | None]
"""Returns what comes at a time of the twin (s), given the true state of the robot."""


FaultKind = Literal[
    'silent', 'frozen', 'blind', 'nan', 'negative', 'far', 'late', 'repeated', 'disordered'
]
"""``blind``: it reads "nothing in range"; ``late``: stamps are 0.5 s old; ``repeated``: stamps
stay; ``disordered``: every second reading comes after the next one."""


class SensorFault(NamedTuple):
    """A range sensor that fails for a time of the twin."""

    sensor: int
    kind: FaultKind
    begin: float
    """s"""
    end: float = math.inf
    """s"""


LATE = 0.5
"""Age of late readings, s."""
READINGS = {'blind': math.inf, 'nan': math.nan, 'negative': -0.3, 'far': 3.0}
"""What sensors with these faults read, m."""


class FaultyRanges:
    """Range readings on their way to the controller, with the faults of a scenario."""

    def __init__(self, faults: tuple[SensorFault, ...]) -> None:
        self._faults = faults
        self._frozen: dict[int, tuple[float, int]] = {}
        self._waiting: dict[int, tuple[float, int]] = {}

    def received(self, sensor: int, reading: float, stamp_ns: int) -> list[tuple[float, int]]:
        """Return which readings (m) with which stamps arrive instead of one of a sensor."""
        time = stamp_ns / NANOSECONDS
        kinds = (
            each.kind
            for each in self._faults
            if each.sensor == sensor and each.begin <= time < each.end
        )
        if (kind := next(kinds, '')) == '':
            self._frozen[sensor] = reading, stamp_ns
        frozen, frozen_ns = self._frozen.get(sensor, (reading, stamp_ns))
        match kind:
            case '':
                return [(reading, stamp_ns)]
            case 'silent':
                return []
            case 'late':
                return [(reading, stamp_ns - round(LATE * NANOSECONDS))]
            case 'repeated':
                return [(reading, frozen_ns)]
            case 'disordered' if sensor in self._waiting:
                return [(reading, stamp_ns), self._waiting.pop(sensor)]
            case 'disordered':
                self._waiting[sensor] = reading, stamp_ns
                return []
        return [(READINGS.get(kind, frozen), stamp_ns)]


@dataclass(frozen=True)
class PatrolScenario:
    """World and robot of a patrol."""

    seed: int = 1
    """Seed of the robot, of its noise and of the unknown boxes."""
    duration: float = 600.0
    """s"""
    known_world: str = ''
    """World that the keep-out knows: a name or a file; empty: nothing."""
    world: str = ''
    """World in which the robot drives: a name or a file; empty: that which it knows."""
    map: str = ''
    """World that the localisation has as its map: a name or a file; empty: that in which the robot
    drives."""
    keep_out: bool = True
    """Whether the keep-out is used."""
    robot: Mapping[str, object] = field(default_factory=dict)
    """Further parameters of the robot by name."""
    controller: Mapping[str, object] = field(default_factory=dict)
    """Further parameters of the controller by name."""
    faults: tuple[SensorFault, ...] = ()
    """Faults of the range sensors."""
    localization: str = 'given'
    """One of :data:`LOCALIZATIONS`."""
    range_loss: float = 0.0
    """Share of the range readings that are lost."""
    plan: PlanParameters = PlanParameters()
    """Whether and how the path is planned on the map of the keep-out."""
    arena: tuple[float, ...] = PortraitParameters().arena
    """Where places are revisited, m."""
    carried_at: float = math.inf
    """When the robot is carried by 1 m and turned by 90 degrees, s."""

    def __post_init__(self) -> None:
        if self.localization not in LOCALIZATIONS:
            raise ValueError(
                f'localization must be one of {", ".join(LOCALIZATIONS)}: got {self.localization}'
            )


def portrait_points(seed: int, parameters: PortraitParameters) -> Iterator[Array]:
    """Yield the points (m) of the chaotic path of a seed, about 1 m at a time."""
    path = PortraitPath(ReferenceParameters(), parameters, LIMITS.linear, seed)
    while True:
        yield path.advance(1.0)


def path_error(record: Record) -> Array:
    """Return the distance of the true position from that of the reference, m, shape (n,)."""
    error: Array = np.hypot(*(record['truth'] - record['reference_pose'])[:, :2].T)
    return error


def share_on_path(record: Record) -> float:
    """Return the share of the time within 50 mm of the reference, see :func:`explored_after`."""
    late = record['time'] >= explored_after(float(record['time'][-1]))
    return float((path_error(record)[late] < ON_PATH).mean())


def explored_after(duration: float) -> float:
    """Return when the robot has mainly explored, s: at :data:`EARLY`, or half of a short drive."""
    return min(EARLY, 0.5 * duration)


def outside_avoidance(record: Record) -> NDArray[np.bool_]:
    """Return which rows are no avoidance, and follow its end by :data:`SETTLING` s."""
    rows = np.arange(len(record))
    last = np.maximum.accumulate(np.where(record['avoiding'], rows, -(10**9)))
    outside: NDArray[np.bool_] = rows - last > SETTLING * RATE
    return outside


def contact_count(record: Record) -> int:
    """Return in how many periods the largest contact force grew: 0 without any contact."""
    return int((np.diff(record['contact_force'], prepend=0.0) > 0.0).sum())


def run_patrol(
    points: Iterator[Array],
    scenario: PatrolScenario,
    tracker: PathTracker | None = None,
    visitors: Visitors | None = None,
    use_localizer: Callable[[Localizer], None] | None = None,
) -> Record:
    """Return the record of a robot that follows a path; equal arguments give equal runs.

    Its rows begin at the end of the standstill, its time is that since then. ``points`` are pieces
    (m), shape (k, 2), of the path from where the robot starts, at (0, 0) facing x; a path that
    ends leaves the robot at its last point. A ``tracker`` is a law in place of the controller: the
    path is then only recorded as the reference. ``use_localizer`` is called before the drive with
    the localisation, if there is one.
    """
    parameters = DigitalTwinParameters.from_dict(
        {
            'noise.variance': 0.04,
            'world': scenario.world or scenario.known_world,
            'seed': scenario.seed,
            'faults.command_loss': COMMAND_LOSS,
            **scenario.robot,
        }
    )
    carried_ns = stamp_of(round((START + min(scenario.carried_at, 1e6)) * RATE))
    robot = CarriedTwin(parameters, carried_ns)
    driver = PathDriver(points, scenario, parameters.geometry, tracker)
    if use_localizer is not None and driver.localizer is not None:
        use_localizer(driver.localizer)

    def visit(state: RobotState) -> None:
        assert visitors is not None
        assert state.truth is not None
        if found := visitors(state.stamp_ns / NANOSECONDS, state.truth):
            robot.add_obstacle(found)

    if visitors is not None:
        driver.on_state = visit
    rest = round(START * RATE)
    count = round(scenario.duration * RATE)
    loop = reports_of(robot, driver, rest + count, start=START, latency_ns=stamp_of(1) - 1)
    record = run_loop(loop, driver)
    columns = {name: values[rest:] for name, values in record.columns.items()}
    columns['time'] = np.arange(count) / RATE
    return replace(
        record,
        columns=columns,
        start=0.0,
        robot_reasons=record.robot_reasons[rest:],
        driver_reasons=record.driver_reasons[rest:],
    )


class CarriedTwin(DigitalTwin):
    """A twin that somebody carries by 1 m and turns by 90 degrees at an instant (ns)."""

    def __init__(self, parameters: DigitalTwinParameters, instant_ns: int) -> None:
        super().__init__(parameters)
        self._instant_ns = instant_ns

    def advance(self, now_ns: int) -> RobotState:
        """Return the state at an instant."""
        state = super().advance(now_ns)
        if now_ns != self._instant_ns or state.truth is None:
            return state
        x, y, yaw = state.truth.pose
        radius = self._parameters.bumper.radius + 0.02
        places = map_of_world(self._world).free_places(radius)
        apart = np.abs(np.hypot(places[:, 0] - x, places[:, 1] - y) - CARRIED_DISTANCE)
        near = places[apart < 0.02]
        generator = np.random.default_rng((self._parameters.seed, 17))
        there_x, there_y = near[generator.integers(0, len(near))].tolist()
        side = generator.choice([-0.5, 0.5]) * math.pi
        self.set_pose(Pose(there_x, there_y, wrap_angle(yaw + float(side))))
        return state


class PathDriver:
    """The controller of the node on a path, with a localisation; or a law in its place.

    Before the drive the robot is where it was placed, which is known without noise.
    """

    def __init__(
        self,
        points: Iterator[Array],
        scenario: PatrolScenario,
        geometry: WheelGeometry,
        tracker: PathTracker | None,
    ) -> None:
        self._points, self._geometry, self._tracker = points, geometry, tracker
        values = {'pose.enabled': True, 'keep_out.enabled': scenario.keep_out}
        self._controller = Controller(
            StepperControllerParameters.from_dict({**values, **scenario.controller}),
            load_world(scenario.known_world).obstacles,
        )
        self._controller.warm_up()
        limits = PLANNED_LIMITS if scenario.plan.enabled else LIMITS
        self._timing = PathTiming(limits, geometry, 1.0 / RATE, ORIGIN)
        self._plan: PlannedPath | None = None
        if scenario.plan.enabled:
            arena, advance = Arena(scenario.arena), partial(next, points)
            self._plan = PlannedPath(
                scenario.plan, self._timing, 1.0 / RATE, ORIGIN, advance, arena
            )
            self._plan.plan.use_random_numbers(SecretRandom(scenario.seed, 'revisits'))
        self._clock = PathClock(WaitParameters())
        self._generator = np.random.default_rng((scenario.seed, 7))
        self._losses = np.random.default_rng((scenario.seed, 19))
        self._range_loss = scenario.range_loss
        self._localization = scenario.localization
        self.localizer: Localizer | None = None
        if scenario.localization == 'filter':
            sensors = RangeSensorParameters()
            self.localizer = Localizer(
                LocalizerParameters.from_dict({'set_initial_pose': True, 'seed': scenario.seed}),
                map_of_world(load_world(scenario.map or scenario.world or scenario.known_world)),
                sensor_mounts(sensors),
                (sensors.minimum, sensors.maximum),
            )
        self._correction = PoseCorrection()
        self._references: list[tuple[Pose, BodyTwist]] = []
        self._ranges: tuple[float, ...] = ()
        self._k = 0
        self._driving = False
        self._controller.enable(False)
        self._pose, self._twist = ORIGIN, STANDSTILL
        self.reason = ''
        self.on_state: Callable[[RobotState], None] | None = None
        """Called with each report of the robot."""
        self._faulty = FaultyRanges(scenario.faults)

    def begin(self, k: int, *, enabled: bool) -> None:
        """Extend the reference up to its lead."""
        changed = enabled is not self._driving
        self._k, self._driving = k, enabled
        while len(self._references) <= k + round(LEAD * RATE):
            stamp = stamp_of(len(self._references))
            driving = len(self._references) >= round(START * RATE)
            reference = self._next_reference(stamp) if driving else (ORIGIN, STANDSTILL)
            self._references.append(reference)
            self._controller.add_reference(State(stamp, *reference))
        if changed:
            self._controller.enable(enabled)

    def _next_reference(self, stamp_ns: int) -> tuple[Pose, BodyTwist]:
        if self._plan is None:
            return self._timing.advance_along(self._points)
        keep_out = self._controller.keep_out
        if keep_out is not None and self._k % MAP_PERIOD == 0:
            if self.localizer is not None:
                self._plan.look_at(self.localizer.changes.suspected)
            self._plan.set_map(keep_out.map.occupancy())
        reference = self._plan.advance(self._clock.rate)
        self._clock.add_reference(stamp_ns, reference[0])
        return reference

    def step(self, state: RobotState) -> RobotCommand:
        """Return the command that follows from a report of the robot."""
        self._pose = self._localised(state)
        self._clock.observe(state.stamp_ns, self._pose)
        if self._plan is not None and self._driving:
            self._plan.observe(self._pose)
            if state.battery is not None and self._k % round(RATE) == 0:
                self._plan.observe_battery(state.battery.voltage)
        if self.on_state is not None:
            self.on_state(state)
        for sensor, reading in enumerate(state.ranges):
            due = not self._ranges or reading != self._ranges[sensor] or self._k % 4 == 0
            if self._range_loss and self._losses.random() < self._range_loss:
                continue
            if due and not math.isnan(reading):  # as the nodes publish them
                for received in self._faulty.received(sensor, reading, state.stamp_ns):
                    self._controller.add_range(sensor, *received)
                    if self.localizer is not None:
                        self.localizer.add_range(sensor, *received)
        self._ranges = state.ranges
        if self._tracker is None:
            measured = State(state.stamp_ns, self._pose, state.odometry.twist)
            self._twist, status = self._controller.step(measured)
            self.reason = '' if status.reason.moves else status.reason.value
        elif self._driving:
            self._twist = self._tracker.step(self._pose)
        return RobotCommand(wheels_from_twist(self._twist, self._geometry), state.stamp_ns)

    def _localised(self, state: RobotState) -> Pose:
        """Return the pose that the controller receives."""
        noise = self._generator.standard_normal(3).tolist()
        odometry = state.odometry
        if self.localizer is not None:
            # As in the node: the pose of this message is by the correction known so far.
            if odometry.stamp_ns == 0:
                self.localizer.add_odometry(0, odometry.pose)
            pose = self._correction.step(odometry.stamp_ns, odometry.pose, self.localizer)
            self.localizer.add_odometry(odometry.stamp_ns, odometry.pose)
            return pose or ORIGIN
        if self._localization == 'odometry':
            return odometry.pose
        if not self._driving:
            return ORIGIN
        assert state.truth is not None
        x, y, yaw = state.truth.pose
        return Pose(
            x + POSITION_NOISE * noise[0],
            y + POSITION_NOISE * noise[1],
            wrap_angle(yaw + YAW_NOISE * noise[2]),
        )

    @property
    def signals(self) -> Signals:
        """Reference, pose, command and what the keep-out does."""
        keep_out = self._controller.keep_out
        activity = Activity.FREE if keep_out is None else keep_out.activity
        changed = keep_out is not None and keep_out.changed
        pose, twist = self._references[self._k]
        return {
            'reference_pose': pose,
            'reference_twist': twist,
            'pose': self._pose,
            'command': self._twist,
            'activity': ACTIVITIES.index(activity),
            'avoiding': changed or self._controller.pose_controller.rejoining,
            'localized': self.localizer is None or self.localizer.state is Localization.LOCALIZED,
        }


def room_with_boxes(seed: int, size: tuple[float, float], boxes: int) -> str:
    """Return the YAML text of a room around the origin, with boxes drawn from a seed.

    The boxes have sides of 0.2 to 0.5 m. They leave 0.5 m free around the origin and to each
    other, and stand anywhere else, also at a wall. Two patches of floor are slippery.
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
        lines.append(f'  - {{center: [{x:.4f}, {y:.4f}], radius: 0.25, grip: {GRIP}}}')
    return '\n'.join(lines) + '\n'


@contextmanager
def world_file(text: str) -> Iterator[str]:
    """Yield the path of a temporary world file with a text."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'world.yaml'
        path.write_text(text)
        yield str(path)
