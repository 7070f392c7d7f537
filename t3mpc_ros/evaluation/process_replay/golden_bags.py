# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Golden bags: short closed-loop runs whose commands must replay bit-equal."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import math
from pathlib import Path
import tempfile

import numpy as np

from t3mpc_ros.evaluation.process_replay.controller_bag import ControllerBag, RecordedController
from t3mpc_ros.evaluation.scenario import RATE
from t3mpc_ros.evaluation.twin_closed_loop import LEAD, chaotic_course, loop_controller, loop_robot
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import NANOSECONDS, ORIGIN, BodyTwist, State, WheelSpeeds
from t3mpc_ros.robot.interface import RobotCommand
from t3mpc_ros.simulation.digital_twin import DigitalTwin
from t3mpc_ros.simulation.fault_injection import FaultEvent, FaultSchedule

START_NS = 1_700_000_000 * NANOSECONDS
RECEIPT_DELAY = 500_000
"""ns from the stamp of an odometry message to its arrival at the controller."""
WATCHDOG_PERIOD = 0.05
"""s between two checks of the odometry watchdog."""


@dataclass(frozen=True)
class GoldenScenario:
    """One golden run."""

    seed: int
    """Seed of reference and robot."""
    stretches: tuple[tuple[float, float], ...]
    """Intervals in which the reference is followed, s; it switches every 12 s and between them."""
    deeds: Mapping[float, tuple[str, object]]
    """By time (s): ``enable`` (bool), ``reset`` (None), ``configure`` (changes)."""
    faults: tuple[FaultEvent, ...] = ()
    quiet_reference: tuple[float, float] = (math.inf, math.inf)
    """Interval without reference, s."""
    quiet_odometry: tuple[float, float] = (math.inf, math.inf)
    """Interval without odometry, s."""
    bad_odometry: tuple[float, ...] = ()
    """Times of odometry messages that are not finite, s."""
    parameters: Mapping[str, object] = field(default_factory=dict)
    """Parameters of the controller other than those of :func:`loop_controller`."""


GOLDEN_SCENARIOS: Mapping[str, GoldenScenario] = {
    'switches': GoldenScenario(2, ((9.5, 14.0), (22.5, 27.4)), {}),
    'stops': GoldenScenario(
        4,
        ((3.0, 12.4),),
        {
            1.5: ('enable', False),
            2.0: ('enable', True),
            6.5: ('reset', None),
        },
        quiet_reference=(3.0, 3.7),
        quiet_odometry=(4.5, 5.0),
        bad_odometry=(5.8, 5.81),
    ),
    'changes': GoldenScenario(
        6,
        ((8.0, 17.4),),
        {
            1.5: ('configure', {'law.gain': 20.0}),
            2.5: ('configure', {'law.compensator': False, 'adaptation.gamma': 300.0}),
            3.5: ('configure', {'use_fuzzy': False}),
            4.5: ('configure', {'linear.x.max_velocity': 0.15, 'use_fuzzy': True}),
            5.5: (
                'configure',
                {'jump_transition.preview': False, 'predictive.move_weight': 0.01},
            ),
        },
        (
            FaultEvent(2.0, 'load_change', 0.5, 3.0),
            FaultEvent(4.0, 'slippery', 0.3, 1.5),
            FaultEvent(6.0, 'command_delay', 0.03, 1.0),
            FaultEvent(7.5, 'brown_out', True, 0.1),
        ),
        parameters={'composition': 'paper'},
    ),
}
"""Golden runs by the name of their file."""


def write_golden(folder: Path, progress: Callable[[str], None] = print) -> list[Path]:
    """Write the golden bags to ``folder`` with the current controller, and return their paths.

    Raises
    ------
    OSError
        A file cannot be written.
    BagError
        A bag cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, recipe in GOLDEN_SCENARIOS.items():
        path = folder / f'{name}.mcap'
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            run_golden_scenario(recipe, Path(scratch)).replace(path)
        progress(f'{path}: {path.stat().st_size} bytes')
        written.append(path)
    return written


def run_golden_scenario(recipe: GoldenScenario, folder: Path) -> Path:
    """Return the bag file of a run in ``folder``; equal recipes give equal messages."""
    parameters = loop_controller().with_values(recipe.parameters)
    robot = DigitalTwin(loop_robot(seed=recipe.seed), FaultSchedule(recipe.faults))
    whole = chaotic_course(recipe.stretches[-1][1], recipe.seed)
    course = np.concatenate(
        [whole[round(begin * RATE) : round(end * RATE)] for begin, end in recipe.stretches]
    )
    lead = round(LEAD * RATE)
    geometry = parameters.geometry
    with ControllerBag(folder, parameters) as tape:
        loop = _Loop(recipe, RecordedController(parameters, tape, START_NS, every=10))
        for k in range(lead):
            loop.reference(k, 0, course[k].tolist(), geometry)
        for k in range(len(course) - lead):
            loop.reference(k + lead, k, course[k + lead].tolist(), geometry)
            state = robot.advance(_stamp(k))
            wheels, stamp_ns = loop.step(k, state.odometry)
            robot.apply(RobotCommand(wheels, stamp_ns), state.stamp_ns)
        loop.finish()
        return tape.path


class _Loop:
    """Executes a recipe in virtual time."""

    def __init__(self, recipe: GoldenScenario, taped: RecordedController) -> None:
        self._recipe, self._taped = recipe, taped
        self._deeds = dict(recipe.deeds)
        self._heard = 0.0
        self._watched = 0.0
        self._now_ns = START_NS
        self._wheels = WheelSpeeds(0.0, 0.0)
        self._told_ns = 0

    def reference(self, k: int, now: int, wheels: list[float], geometry: WheelGeometry) -> None:
        """Pass sample ``k`` of the reference at period ``now``."""
        begin, end = self._recipe.quiet_reference
        if not begin <= now / RATE < end:
            twist = twist_from_wheels(WheelSpeeds(*wheels), geometry)
            self._taped.add_reference(self._later(now), State(START_NS + _stamp(k), ORIGIN, twist))

    def step(self, k: int, odometry: State) -> tuple[WheelSpeeds, int]:
        """Return the newest command and the stamp of its odometry."""
        now, recipe = k / RATE, self._recipe
        for when in [when for when in self._deeds if when <= now]:
            self._do(k, *self._deeds.pop(when))
        begin, end = recipe.quiet_odometry
        if begin <= now < end:
            self._watch(k, now)
            return self._wheels, self._told_ns
        if now in recipe.bad_odometry:
            odometry = State(odometry.stamp_ns, odometry.pose, BodyTwist(math.nan, 0.0))
        stamp_ns = START_NS + odometry.stamp_ns
        twist, _ = self._taped.step(
            self._later(k) + RECEIPT_DELAY, State(stamp_ns, odometry.pose, odometry.twist)
        )
        self._heard, self._told_ns = now, odometry.stamp_ns
        self._wheels = wheels_from_twist(twist, self._taped.controller.parameters.geometry)
        return self._wheels, self._told_ns

    def finish(self) -> None:
        """End the run."""
        self._taped.finish(self._now_ns + NANOSECONDS // 100)

    def _watch(self, k: int, now: float) -> None:
        """Check for missing odometry, as the node does periodically."""
        timeout = self._taped.controller.parameters.watchdog.odometry_timeout
        if now - self._heard > timeout and now - self._watched > WATCHDOG_PERIOD - 1e-9:
            self._watched = now
            self._taped.silent(self._later(k))
            self._wheels = WheelSpeeds(0.0, 0.0)

    def _do(self, k: int, deed: str, how: object) -> None:
        now_ns = self._later(k)
        if deed == 'enable':
            self._taped.enable(now_ns, bool(how))
        elif deed == 'reset':
            self._taped.reset(now_ns)
        elif isinstance(how, Mapping):
            self._taped.configure(now_ns, how)

    def _later(self, k: int) -> int:
        """Return the time of period ``k``, slightly later with each call."""
        self._now_ns = max(START_NS + _stamp(k), self._now_ns + 1000)
        return self._now_ns


def _stamp(k: int) -> int:
    return round(k * NANOSECONDS / RATE)
