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
r"""Changes of the surroundings: readings that contradict the map, as events.

Each reading is compared with what the map lets a sensor read from the pose and from poses beside
it, as far as the pose is uncertain: only what contradicts all of them counts. The logarithm of
the ratio of its likelihoods, by the beam model, with a thing at its end and with the map as it is,
is evidence for a *new* thing there; of one that ends behind a wall of the map, that the wall is
*missing*. Rays that pass over a place where something was seen are evidence against it, readings
that fit are evidence against what is missing. Evidence is added up in cells (occupancy grids of
log-odds; Moravec and Elfes, ICRA 1985, doi 10.1109/ROBOT.1985.1087316), cells that are near each
other are a place, and a place becomes an event when readings from several views support it. What
was seen and is seen to be gone is *moving*.
"""

from dataclasses import dataclass, field
import enum
import math
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.geometry.types import NANOSECONDS, Array, Pose, has_moved
from t3mpc_ros.kernels import TypedKernel, kernel
from t3mpc_ros.localization.distance_field import DistanceField, distance_at, trace_ray
from t3mpc_ros.localization.range_model import Beams, RangeModel, hit_likelihood, other_likelihood
from t3mpc_ros.parameters.table import Parameters, parameter

CELL = 0.05
"""Side of a cell, m."""
TOO_NEAR = 0.07
"""Distance that stands for a reading that is too near, m: they are from 0.036 m on."""
LARGEST = 1.5
"""Largest evidence of one reading: its error is in part that of the pose and repeats."""
CELL_LIMIT = 6.0
"""Largest evidence of a cell: an event has two or more."""
PASSED = 0.7
"""Evidence of a ray that passes over a cell against a thing there."""
UNSEEN_NEAR = 0.08
"""Distance from the face of a sensor from which on a ray shows that nothing is there, m."""
VIEW_DISTANCE, VIEW_ANGLE = 0.1, 0.3
"""Motion of the robot (m, rad) from which on its view is another one."""
AGAIN_TIME, AGAIN_DISTANCE = 60.0, 1.0
"""Time (s) and distance (m) within which a thing that moves is the same one."""


class ChangeKind(enum.Enum):
    """What contradicts the map."""

    NEW = 'new thing'
    MISSING = 'missing thing'
    MOVING = 'moving thing'


@dataclass(frozen=True)
class ChangeParameters(Parameters):
    """How much must contradict the map, and for how long it is remembered."""

    enabled: bool = parameter(True, 'whether readings that contradict the map become events')
    clearance: float = parameter(
        0.1,
        'least distance of a new thing from what the map has; a map of that error',
        'm',
        (0.0, 1.0),
    )
    min_confidence: float = parameter(
        0.95, 'confidence from which on a change is an event', bounds=(0.5, 0.9999)
    )
    min_views: int = parameter(
        3, 'least number of views, 0.1 m or 0.3 rad apart, of an event', bounds=(1, 100)
    )
    memory: float = parameter(
        60.0,
        'time without a further reading after which what is no event yet is forgotten',
        's',
        (1.0, 1e6),
    )
    min_duration: ClassVar[float] = 2.0
    """Least time from the first to the last reading of an event, s: longer than a slip lasts
    before it is noticed, assumed."""
    prior: ClassVar[float] = 5.0
    """Logarithm of the odds against a change at a place before it is seen, assumed."""
    deviations: ClassVar[float] = 3.0
    """Standard deviations of pose and reading that contradict nothing, assumed."""
    reach: ClassVar[float] = 0.2
    """Largest distance of a reading from others of the same place, m, assumed."""


class Change(NamedTuple):
    """An event: something contradicts the map."""

    number: int
    """From 1 on, in the order in which they were found."""
    kind: ChangeKind
    x: float
    """Centre of what was seen of it, m."""
    y: float
    """Centre of what was seen of it, m."""
    size: float
    """Largest extent of what was seen of it, m."""
    confidence: float
    """Probability of a change by the readings, 0 to 1; of one that ended the largest one."""
    first_ns: int
    """Stamp of the first reading."""
    last_ns: int
    """Stamp of the last reading."""
    found_ns: int
    """Stamp at which it became an event."""
    present: bool
    """Whether it is there, as far as is known."""
    withdrawn: bool = False
    """Whether it was never there: the robot was lost, as it turned out."""

    @property
    def text(self) -> str:
        """What, how large, where and how certain, in words."""
        gone = '' if self.present else ', gone'
        state = ', withdrawn: the robot was lost' if self.withdrawn else gone
        return (
            f'{self.kind.value}{state}: {self.size:.2f} m at x {self.x:.2f} m, y {self.y:.2f} m, '
            f'confidence {self.confidence:.2f}'
        )


@dataclass(eq=False)
class Place:
    """Cells near each other with evidence of the same kind."""

    missing: bool
    first_ns: int
    last_ns: int
    cells: dict[tuple[int, int], float] = field(default_factory=dict)
    """Evidence of each."""
    views: int = 0
    seen_from: Pose | None = None
    """Pose of the robot in the last view."""
    event: int | None = None
    """Index of its event."""

    @property
    def evidence(self) -> float:
        """Logarithm of the ratio of the likelihoods, with and without the change."""
        return sum(self.cells.values())

    @property
    def centres(self) -> Array:
        """Of its cells, m, shape (n, 2)."""
        return CELL * (np.array(list(self.cells)) + 0.5)


Cell = tuple[int, int]


class ChangeDetector:
    """Events on a map; equal calls give equal events.

    known : the map
    model : of the range readings
    """

    def __init__(
        self, parameters: ChangeParameters, known: DistanceField, model: RangeModel
    ) -> None:
        self.parameters = parameters
        self._field, self._model = known, model
        self._compare = TypedKernel(compare_beams)
        self._places: list[Place] = []
        self._owners: dict[bool, dict[Cell, Place]] = {False: {}, True: {}}
        """Place of each cell, by whether something is missing there."""
        self._changes: list[Change] = []

    @property
    def changes(self) -> tuple[Change, ...]:
        """The events, in the order in which they were found."""
        return tuple(self._changes)

    @property
    def suspected(self) -> Array:
        """Where a reading contradicts the map, and there is no event yet, m, shape (n, 2)."""
        places = (each for each in self._places if each.event is None)
        centres = [each.centres.mean(axis=0) for each in places if each.evidence >= LARGEST]
        return np.array(centres).reshape(-1, 2)

    def forget(self) -> None:
        """Forget what is no event yet: the robot was not where it took itself to be."""
        for place in [each for each in self._places if each.event is None]:
            self._remove(place)

    def add(self, stamp_ns: int, pose: Pose, covariance: Array, beams: Beams) -> bool:
        """Compare beams with the map; return whether an event began, ended or was seen again.

        stamp_ns : of the pose
        pose, covariance : of x, y (m), yaw (rad), shape (3, 3)
        beams : readings with the beams that they were taken along, in the frame of the robot
        """
        limit_ns = round(self.parameters.memory * NANOSECONDS)
        for place in list(self._places):
            if place.event is None and stamp_ns - place.last_ns > limit_ns:
                self._remove(place)
        changed = False
        touched: dict[Place, None] = {}
        for row in self._evidence(pose, covariance, beams):
            changed |= self._pass(row)
            for missing, evidence, cell in row.cells():
                if evidence > 0.0:
                    touched[self._support(missing, cell, evidence, stamp_ns)] = None
                elif evidence < 0.0:
                    changed |= self._oppose(missing, around(cell), -evidence)
        for place in touched:
            # Not what another beam of the same readings has ended, or merged with its neighbour.
            if place in self._places:
                changed |= self._seen(place, stamp_ns, pose)
        return changed

    def withdraw(self, since_ns: int) -> None:
        """End the events that were found since a stamp: the robot was not where it took itself."""
        for place in list(self._places):
            if place.event is not None and self._changes[place.event].found_ns >= since_ns:
                self._remove(place)
                event = self._changes[place.event]
                self._changes[place.event] = event._replace(present=False, withdrawn=True)

    def explained(
        self, pose: Pose, covariance: Array, beams: Beams, before_ns: float = math.inf
    ) -> NDArray[np.bool_]:
        """Return which beams contradict the map where it has changed: they do not tell the pose.

        That is where an event is that was found before a stamp, and at the one place besides where
        a change is most likely, if it is more likely than not: a robot that is not where it takes
        itself to be contradicts the map at many places.
        """
        likely = {
            each
            for each in self._places
            if each.event is not None and self._changes[each.event].found_ns < before_ns
        }
        others = (each for each in self._places if each.event is None)
        best = max(others, key=lambda place: place.evidence, default=None)
        if best is not None and best.evidence > self.parameters.prior:
            likely.add(best)
        found = np.zeros(beams.reading.size, dtype=np.bool_)
        if likely:
            for index, row in enumerate(self._evidence(pose, covariance, beams)):
                found[index] = any(
                    evidence > 0.0
                    and any(self._owners[missing].get(each) in likely for each in around(cell))
                    for missing, evidence, cell in row.cells()
                )
        return found

    def _evidence(self, pose: Pose, covariance: Array, beams: Beams) -> 'list[BeamEvidence]':
        found = np.zeros((beams.reading.size, len(BeamEvidence._fields)))
        deviations = self.parameters.deviations * np.sqrt(
            [0.5 * (covariance[0, 0] + covariance[1, 1]), covariance[2, 2]]
        )
        self._compare(
            np.array(pose),
            deviations,
            self._field,
            beams,
            self._model,
            self.parameters.clearance,
            self.parameters.deviations,
            found,
        )
        return [*map(BeamEvidence._make, found.tolist())]

    def _pass(self, row: 'BeamEvidence') -> bool:
        """Lower the evidence of new things over which a ray passes; return whether one ended."""
        if not self._owners[False]:
            return False
        cosine, sine = math.cos(row.direction), math.sin(row.direction)
        count = int(max(row.free - UNSEEN_NEAR, 0.0) / (0.5 * CELL))
        over = {
            (
                math.floor((row.x + along * cosine) / CELL),
                math.floor((row.y + along * sine) / CELL),
            )
            for along in (UNSEEN_NEAR + 0.5 * CELL * k for k in range(count))
        }
        return self._oppose(False, sorted(over), PASSED)

    def _oppose(self, missing: bool, cells: 'list[Cell]', evidence: float) -> bool:
        """Lower the evidence of cells; return whether an event ended."""
        ended = False
        for cell in cells:
            place = self._owners[missing].get(cell)
            if place is None:
                continue
            place.cells[cell] -= evidence
            if place.cells[cell] <= 0.0:
                del place.cells[cell], self._owners[missing][cell]
                if not place.cells:
                    ended |= self._end(place)
        return ended

    def _end(self, place: Place) -> bool:
        """Remove a place without evidence; return whether it was an event."""
        self._places.remove(place)
        if place.event is None:
            return False
        event = self._changes[place.event]
        kind = ChangeKind.MOVING if event.kind is ChangeKind.NEW else event.kind
        self._changes[place.event] = event._replace(kind=kind, present=False)
        return True

    def _remove(self, place: Place) -> None:
        for cell in place.cells:
            del self._owners[place.missing][cell]
        self._places.remove(place)

    def _support(self, missing: bool, cell: Cell, evidence: float, stamp_ns: int) -> Place:
        """Add evidence to a cell; return its place, the nearest one, or a new one."""
        owners = self._owners[missing]
        near: list[Place] = []
        for offset in NEAR:
            place = owners.get((cell[0] + offset[0], cell[1] + offset[1]))
            if place is not None and place not in near:
                near.append(place)
        if near:
            place = near[0]
            for other in near[1:]:
                place = self._merged(place, other)
        else:
            place = Place(missing, stamp_ns, stamp_ns)
            self._places.append(place)
        place.cells[cell] = min(place.cells.get(cell, 0.0) + evidence, CELL_LIMIT)
        owners[cell] = place
        return place

    def _merged(self, place: Place, other: Place) -> Place:
        """Return one place of two, or the first if both are events."""
        if place.event is not None and other.event is not None:
            return place
        if other.event is not None:
            place, other = other, place
        for cell in other.cells:
            self._owners[place.missing][cell] = place
        place.cells |= other.cells
        place.first_ns = min(place.first_ns, other.first_ns)
        place.views += other.views
        self._places.remove(other)
        return place

    def _seen(self, place: Place, stamp_ns: int, pose: Pose) -> bool:
        """Update a place that has new evidence, and its event; return whether there is one."""
        place.last_ns = stamp_ns
        if has_moved(place.seen_from, pose, VIEW_DISTANCE, VIEW_ANGLE):
            place.views += 1
            place.seen_from = pose
        confidence = 1.0 / (1.0 + math.exp(self.parameters.prior - place.evidence))
        centres = place.centres
        x, y = centres.mean(axis=0).tolist()
        if place.event is None:
            if (
                confidence < self.parameters.min_confidence
                or place.views < self.parameters.min_views
                or stamp_ns - place.first_ns < self.parameters.min_duration * NANOSECONDS
            ):
                return False
            place.event = self._event_at(place, x, y, stamp_ns)
        event = self._changes[place.event]
        apart = centres[:, None] - centres[None, :]
        size = float(np.hypot(apart[..., 0], apart[..., 1]).max()) + CELL
        self._changes[place.event] = event._replace(
            x=x,
            y=y,
            size=max(size, event.size),
            confidence=max(confidence, event.confidence),
            last_ns=stamp_ns,
            present=True,
            withdrawn=False,
        )
        return True

    def _event_at(self, place: Place, x: float, y: float, stamp_ns: int) -> int:
        """Return the index of the event of a place: one that ended nearby, or a new one."""
        for event in reversed(self._changes):
            away = math.hypot(event.x - x, event.y - y)
            if event.present or (event.kind is ChangeKind.MISSING) is not place.missing:
                continue
            again = (
                away <= self.parameters.reach + 0.5 * event.size
                if place.missing
                else away <= AGAIN_DISTANCE
                and stamp_ns - event.last_ns <= AGAIN_TIME * NANOSECONDS
            )
            if again:
                return event.number - 1
        kind = ChangeKind.MISSING if place.missing else ChangeKind.NEW
        number, first_ns = len(self._changes) + 1, place.first_ns
        self._changes.append(
            Change(number, kind, x, y, 0.0, 0.0, first_ns, stamp_ns, stamp_ns, present=True)
        )
        return number - 1


REACH_CELLS = round(ChangeParameters.reach / CELL)
NEAR = tuple(
    sorted(
        (
            (column, row)
            for column in range(-REACH_CELLS, REACH_CELLS + 1)
            for row in range(-REACH_CELLS, REACH_CELLS + 1)
            if math.hypot(column, row) <= REACH_CELLS
        ),
        key=lambda cell: math.hypot(*cell),
    )
)
"""Offsets of the cells within reach, the nearest first."""


def around(cell: Cell) -> list[Cell]:
    """Return a cell and its neighbours."""
    return [(cell[0] + i, cell[1] + k) for i in (-1, 0, 1) for k in (-1, 0, 1)]


class BeamEvidence(NamedTuple):
    """What one beam says."""

    new: float
    """Evidence for a thing at its end that the map lacks; 0: none."""
    end_x: float
    """Of its end, m."""
    end_y: float
    missing: float
    """Evidence that its wall is missing; below 0: that it is there."""
    wall_x: float
    """Where the map has its wall, m."""
    wall_y: float
    x: float
    """Of the face of the sensor, m."""
    y: float
    direction: float
    """rad"""
    free: float
    """Distance up to which it shows that nothing is there, m."""

    def cells(self) -> tuple[tuple[bool, float, Cell], tuple[bool, float, Cell]]:
        """Return whether something is missing, the evidence for it, and where, of each kind."""
        return (
            (False, self.new, (math.floor(self.end_x / CELL), math.floor(self.end_y / CELL))),
            (True, self.missing, (math.floor(self.wall_x / CELL), math.floor(self.wall_y / CELL))),
        )


@kernel
def compare_beams(
    pose: Array,
    deviations: Array,
    field: DistanceField,
    beams: Beams,
    model: RangeModel,
    clearance: float,
    tolerance: float,
    found: Array,
) -> None:
    """Write the :class:`BeamEvidence` of each beam, shape (n, 10).

    pose : x, y (m), yaw (rad), shape (3,)
    deviations : how far the robot may be from there, in each direction (m) and in yaw (rad)
    clearance : least distance of a new thing from what the map has, m
    tolerance : standard deviations of a reading that contradict nothing
    """
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    for i in range(beams.reading.size):
        ahead, left = beams.origin[i, 0], beams.origin[i, 1]
        least, most = beams.limits[i, 0], beams.limits[i, 1]
        x, y = pose[0] + cosine * ahead - sine * left, pose[1] + sine * ahead + cosine * left
        direction = pose[2] + beams.origin[i, 2]
        along_x, along_y = math.cos(direction), math.sin(direction)
        reading = beams.reading[i]
        wall = trace_ray(field, x, y, direction, 2.0 * most)
        near = far = wall
        for k in range(4):
            shift = (-1.0, 1.0, 0.0, 0.0)[k] * deviations[0]
            turn = (0.0, 0.0, -1.0, 1.0)[k] * deviations[1]
            beside = trace_ray(
                field, x - shift * along_y, y + shift * along_x, direction + turn, 2.0 * most
            )
            near, far = min(near, beside), max(far, beside)
        end = min(reading, most)
        if reading <= least:
            end = TOO_NEAR
        spread = tolerance * math.sqrt(model.sigma_hit**2 + (model.sigma_hit_growth * end**2) ** 2)
        error = spread + deviations[0]
        hit = model.z_hit * hit_likelihood(reading, end, least, most, model)
        as_new = math.log(hit + other_likelihood(reading, end, least, most, model))
        found[i, 6], found[i, 7], found[i, 8] = x, y, direction
        found[i, 9] = 0.0 if reading <= least else end - error
        end_x, end_y = x + end * along_x, y + end * along_y
        found[i, 1], found[i, 2] = end_x, end_y
        found[i, 4], found[i, 5] = x + wall * along_x, y + wall * along_y
        is_new = reading < most and end < near - error
        if is_new and distance_at(field, end_x, end_y) > max(clearance, error):
            hit = model.z_hit * hit_likelihood(reading, near, least, most, model)
            as_known = math.log(hit + other_likelihood(reading, near, least, most, model))
            found[i, 0] = min(max(as_new - as_known, 0.0), LARGEST)
        if not math.isfinite(wall):
            found[i, 4] = found[i, 5] = 0.0
        elif far < found[i, 9]:
            hit = model.z_hit * hit_likelihood(reading, far, least, most, model)
            as_known = math.log(hit + other_likelihood(reading, far, least, most, model))
            found[i, 3] = min(max(as_new - as_known, 0.0), LARGEST)
        elif reading < most and near - error <= end <= far + error:
            found[i, 3] = -LARGEST
