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
"""The closed loop of a driver and a robot, without ROS, with the timing of the nodes; its drivers.

Each report of the robot carries its stamp to the driver; the command computed from it leaves at
once, carries that stamp back, and the robot follows it when it has arrived. Reports may be late
or lost on their way; what happens to a command on its way is a matter of the robot.

A method is plain data that makes a driver for each run. One that answers accelerations sits
between the state estimate and the limits of :mod:`t3mpc_ros.control.velocity_actuation`, which are
the same for all methods; the controller of the node has its own.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
import math
from typing import Any, NamedTuple, Protocol

import numpy as np

from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.control.controller import Controller, ControllerParameters
from t3mpc_ros.control.dead_time_estimator import DeadTimeEstimator
from t3mpc_ros.control.velocity_actuation import VelocityActuation
from t3mpc_ros.control.watchdog import Reason
from t3mpc_ros.evaluation.baselines.baseline_controller import (
    BaselineController,
    NominalModel,
    Observation,
)
from t3mpc_ros.evaluation.cases import NO_FAULTS, NOMINAL, LinkFaults
from t3mpc_ros.evaluation.run_record import RATE, Record, broken_off, stamp_of, switch_times
from t3mpc_ros.evaluation.scenario import (
    LEAD,
    PLANT_OF,
    PRETRAINING_DURATION,
    PRETRAINING_NOISE,
    PRETRAINING_SEEDS,
    SampledReference,
    Scenario,
)
from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels, wheels_from_twist
from t3mpc_ros.geometry.types import (
    NANOSECONDS,
    ORIGIN,
    RANGE_SENSORS,
    Array,
    State,
    WheelSpeeds,
    wrap_angle,
)
from t3mpc_ros.parameters.table import Parameters
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand, RobotState
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia
from t3mpc_ros.simulation.plant_adapter import Signals, SimulatedRobot

Loop = Generator[RobotState, RobotCommand, Record]
"""Closed loop that yields reports and takes commands."""
DIVERGED_SPEED = 1e4
"""Wheel speed from which on a run has diverged, rad/s: fifty times what a robot may have."""
_NO_RANGES = (math.nan,) * len(RANGE_SENSORS)


class Driver(Protocol):
    """What closes the loop: the controller of the node, a method, a law for a path."""

    @property
    def reason(self) -> str:
        """Why it stops the robot; empty where it drives."""

    @property
    def signals(self) -> Signals:
        """What it decided last, beside the command."""

    def begin(self, k: int, *, enabled: bool) -> None:
        """Begin period k: take the reference that becomes known in it; drive, or stop."""

    def step(self, state: RobotState) -> RobotCommand:
        """Return the command that follows from a report of the robot."""


class Method(Protocol):
    """What makes a driver for each run."""

    @property
    def name(self) -> str:
        """Name in tables and errors."""

    def driver(self, scenario: Scenario) -> Driver:
        """Return a new driver."""


class ComparedMethod(Method, Protocol):
    """A method that states what it knows."""

    def knowledge(self, scenario: Scenario) -> str:
        """Return what it knows of robot and reference, for tables."""


def run(scenario: Scenario, method: Method) -> Record:
    """Return the record of a new driver of a method and the robot of a scenario.

    Equal arguments give equal records, bit for bit.
    """
    known, rows = scenario.steps + round(LEAD * RATE), len(scenario.reference().speeds)
    if rows < known:
        raise ValueError(f'reference must have at least {known} rows: got {rows}')
    driver = method.driver(scenario)
    return with_scenario(run_loop(scenario_reports(scenario, driver), driver), scenario)


def scenario_reports(scenario: Scenario, driver: Driver) -> Loop:
    """Return the loop of a driver and the robot of a scenario, see :func:`reports_of`."""
    return reports_of(
        scenario.simulation(),
        driver,
        scenario.steps,
        start=scenario.kind.start,
        pauses=scenario.own.pauses,
        links=scenario.links,
        seed=scenario.seed,
    )


def with_scenario(record: Record, scenario: Scenario) -> Record:
    """Return the record of a loop with what its metrics need of its scenario."""
    reference, steps = scenario.reference(), scenario.steps
    columns = {
        **record.columns,
        'reference': reference.speeds[:steps],
        'mode': reference.modes[:steps],
    }
    return replace(
        record,
        columns=columns,
        drive=scenario.kind.drive,
        switches=switch_times(reference.time, reference.modes),
        settling=scenario.kind.settling,
        fault_span=scenario.fault_span,
        geometry=scenario.true_robot().geometry,
    )


def run_loop(loop: Loop, driver: Driver) -> Record:
    """Return the record of a loop whose every report goes to its driver."""
    try:
        report = next(loop)
        while True:
            report = loop.send(driver.step(report))
    except StopIteration as end:
        record: Record = end.value
        return record


def reports_of(
    robot: SimulatedRobot,
    driver: Driver,
    periods: int,
    *,
    start: float = 0.0,
    pauses: Sequence[tuple[float, float]] = (),
    links: LinkFaults = NO_FAULTS,
    seed: int = 0,
    latency_ns: int = 0,
) -> Loop:
    """Yield each report that arrives at the driver, take the command, and return the record.

    Equal arguments and commands give equal records, bit for bit. Robot and driver are new; the
    columns of the reference are the caller's. The driver is disabled until ``start``, and in the
    ``pauses`` (s) of a person. ``links`` and their ``seed`` are those of the reports;
    ``latency_ns`` is from the arrival of a report to the departure of the command.
    """
    reports = ReportLink(links, seed, periods / RATE)
    paused = [(0.0, start), *pauses]
    columns: dict[str, list[Any]] = {'time': []}
    robot_reasons, driver_reasons = [], []
    sent: tuple[float, float] = (0.0, 0.0)
    ended = -1
    for k in range(periods):
        now = stamp_of(k) / NANOSECONDS
        driver.begin(k, enabled=not any(begin <= now < end for begin, end in paused))
        state = robot.advance(stamp_of(k))
        whole = all(abs(speed) < DIVERGED_SPEED for speed in state.true_wheels or state.wheels)
        if whole:
            reports.send(state)
            for arrival_ns, report in reports.arrived(stamp_of(k + 1) - 1):
                command = yield report
                sent = command.wheels
                whole = whole and all(map(math.isfinite, sent))
                if whole:
                    robot.apply(command, arrival_ns + latency_ns)
        row = {'time': now, 'sent': sent, **_of_state(state), **robot.signals, **driver.signals}
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
        robot_reasons.append(state.reason)
        driver_reasons.append(driver.reason)
        if not whole:
            ended = k
            break
    record = Record(
        {name: np.array(values) for name, values in columns.items()},
        start=start,
        robot_reasons=tuple(robot_reasons),
        driver_reasons=tuple(driver_reasons),
    )
    return record if ended < 0 else broken_off(record, ended, periods)


class ReportLink:
    """Reports of a robot on their way to the driver; they arrive in order but for the swapped.

    Equal seeds draw equal numbers, whatever is sent; ``duration`` is that of the run, s.
    """

    def __init__(self, faults: LinkFaults, seed: int, duration: float) -> None:
        self._faults = faults
        self._begin, self._end = faults.span(duration)
        self._generator = np.random.default_rng((seed, 3))
        self._queue: deque[tuple[int, RobotState]] = deque()
        self._sent = 0
        self._overtaken: RobotState | None = None

    def send(self, state: RobotState) -> None:
        """Send a report; one that is not late arrives after those before it all the same."""
        # Two numbers for each report, so that a change of loss does not shift delays.
        lost, late = self._generator.random(2).tolist()
        arrival, delay = state.stamp_ns, 0.0
        if self._begin <= state.stamp_ns / NANOSECONDS < self._end:
            if lost < self._faults.odometry_loss:
                return
            least, most = self._faults.odometry_delay
            delay = least + (most - least) * late
            self._sent += 1
            if self._sent % self._faults.odometry_kept:
                return
            swapped = self._faults.odometry_swapped
            if swapped and self._overtaken is None and self._sent % swapped == 0:
                self._overtaken = state
                return
        arrival += round(delay * NANOSECONDS)
        arrival = max(arrival, self._queue[-1][0] if self._queue else 0)
        self._queue.extend([(arrival, state)] * self._faults.odometry_repeated)
        if self._overtaken is not None:
            self._queue.append((arrival, self._overtaken))
            self._overtaken = None

    def arrived(self, now_ns: int) -> Iterator[tuple[int, RobotState]]:
        """Yield (arrival, report) of what has arrived by ``now_ns``."""
        while self._queue and self._queue[0][0] <= now_ns:
            yield self._queue.popleft()


def _of_state(state: RobotState) -> Signals:
    """Return the columns that a report fills."""
    found: dict[str, Any] = {
        'measured': state.wheels,
        'speeds': state.true_wheels or state.wheels,
        'commanded': state.commanded,
        'odometry': state.odometry.pose,
        'flags': state.status,
    }
    if state.truth is not None:
        found['truth'], found['twist'] = state.truth.pose, state.truth.twist
        found['ranges'] = state.ranges or _NO_RANGES
    if state.lost_steps is not None:
        found['lost_steps'] = state.lost_steps
    return found


# -- drivers, and methods that make them ----------------------------------------------------------


class NodeDriver:
    """The controller of the node, with the reference :data:`LEAD` ahead.

    ``geometry`` is that of the robot which the controller assumes; ``course`` has the reference
    wheel speeds (rad/s) of each period, shape (n, 2), up to the lead beyond the run.
    """

    def __init__(self, controller: Controller, geometry: WheelGeometry, course: Array) -> None:
        if controller.parameters.rate != RATE:
            raise ValueError(
                f'rate of the controller must be {RATE:g} Hz: got {controller.parameters.rate:g}'
            )
        self._controller, self._geometry, self._course = controller, geometry, course
        self._known = 0
        """Periods whose reference the controller has."""
        self._enabled = True
        self.reason = ''
        self.signals: Signals = {}

    def begin(self, k: int, *, enabled: bool) -> None:
        """Give the controller the reference up to its lead; enable or disable it."""
        for j in range(self._known, min(k + round(LEAD * RATE) + 1, len(self._course))):
            twist = twist_from_wheels(WheelSpeeds(*self._course[j].tolist()), self._geometry)
            self._controller.add_reference(State(stamp_of(j), ORIGIN, twist))
            self._known = j + 1
        if enabled is not self._enabled:  # a call, as of the service, also ends pauses
            self._enabled = enabled
            self._controller.enable(enabled)

    def step(self, state: RobotState) -> RobotCommand:
        """Return the command that follows from a report of the robot."""
        twist, status = self._controller.step(state.odometry)
        self.reason = '' if status.reason.moves else status.reason.value
        return RobotCommand(wheels_from_twist(twist, self._geometry), status.stamp_ns)


class ObservedReference:
    """Reference of a run of ``steps`` periods as a method observes it in each of them.

    With preview of ``rows`` periods these are rows of the reference after the dead time (s), and
    go on beyond the run. Without, r is extrapolated over the dead time by the slope it has now: a
    switch is seen when it happens, and not before.
    """

    def __init__(
        self, sampled: SampledReference, steps: int, rows: int, dead_time: float, *, preview: bool
    ) -> None:
        self.late = round(dead_time * RATE)
        """Configured dead time, in periods."""
        self.latest = sampled.time.size - steps - rows
        """Largest dead time for which the reference is known, in periods."""
        if not math.isclose(dead_time * RATE, self.late, abs_tol=1e-6):
            raise ValueError(
                f'dead time must be whole periods of {1.0 / RATE:g} s: got {dead_time} s'
            )
        if self.late > self.latest:
            raise ValueError(
                f'dead time must be at most {self.latest / RATE:g} s, as far as the reference '
                f'reaches: got {dead_time} s'
            )
        # Compiled functions take an array that cannot be written to for another type.
        self._speeds, self._slope = sampled.speeds.copy(), sampled.rate / RATE
        self._rows = rows if preview else 0

    def at(self, k: int, late: int) -> tuple[Array, Array, Array | None]:
        """Return r ``late`` periods after period ``k``, one period later, and the preview."""
        if self._rows:
            row, speeds = k + late, self._speeds
            return speeds[row], speeds[row + 1], speeds[row : row + self._rows]
        now = self._speeds[k] + late * self._slope[k]
        return now, self._speeds[k] + (late + 1) * self._slope[k], None


DEAD_TIME_HYSTERESIS = 0.75
"""Difference of estimate and dead time in use, in periods, at which the latter changes."""


class MethodDriver:
    """Drives a robot with a method, behind the state estimate and the limits of all methods.

    It has no watchdog: a lost report is bridged by the estimator, as in the controller. With a
    torque drive, u is cut where its torque would be beyond what the motors have, so that estimator
    and method get the limited u. A method that estimates the dead time gets state estimate and
    reference for the estimated one, in whole periods.
    """

    def __init__(
        self, method: Callable[[NominalModel], BaselineController], scenario: Scenario
    ) -> None:
        self._method, self._scenario = method, scenario
        self._model = scenario.nominal_model()
        robot = self._model.robot
        self._actuation = VelocityActuation(
            scenario.estimate(),
            scenario.limits,
            robot.geometry,
            self._model.drive,
            self._model.period,
        )
        self._inertia: Array = wheel_inertia(robot.body, robot.geometry)
        self._torque_limit = robot.drive.torque_limit
        self._enabled = True
        self.reason = ''
        self._start()

    def _start(self) -> None:
        """Begin anew with the next report."""
        self._controller: BaselineController | None = None
        self._dead_time: DeadTimeEstimator | None = None
        self._observed = -1
        """Period of the last report."""
        self._observed_ns = 0
        """Its stamp, ns."""
        self._yaw = 0.0
        """Its yaw, rad."""
        self._yaw_rate = math.nan
        """Mean yaw rate of the odometry up to it, rad/s."""
        self._acceleration = np.zeros(2)
        self._limited = False
        self._sent = ZERO_WHEEL_SPEEDS
        self._elapsed = 1
        self.unchanged = RobotCommand(ZERO_WHEEL_SPEEDS, 0)
        """Command after a report that the method does not get."""

    @property
    def signals(self) -> Signals:
        """Estimates, limited u and terms of the last step."""
        seam, terms = self._actuation, getattr(self._controller, 'terms', None)
        if not (isinstance(terms, np.ndarray) and terms.shape == (len(TERM_NAMES), 2)):
            terms = np.zeros((len(TERM_NAMES), 2))
        return {
            'estimated': seam.speeds.copy(),
            'unexplained': seam.disturbance.copy(),
            'acceleration': self._acceleration.copy(),
            'limited': self._limited,
            'terms': terms.copy(),
        }

    def begin(self, k: int, *, enabled: bool) -> None:
        """Drive, or stop and forget; the scenario has the reference."""
        if not enabled:
            self._start()
        self._enabled = enabled
        self.reason = '' if enabled else Reason.DISABLED.value

    def step(self, state: RobotState) -> RobotCommand:
        """Return the command that follows from a report; NaN if the answer is not finite."""
        observation = self.observe(state)
        if observation is None or self._controller is None:
            return self.unchanged
        return self.command_for(self._controller.step(observation))

    def observe(self, state: RobotState) -> Observation | None:
        """Return what the method gets for a report; None: the command is :attr:`unchanged`."""
        if not self._enabled:
            self.unchanged = RobotCommand(ZERO_WHEEL_SPEEDS, state.stamp_ns)
            return None
        k = round(state.stamp_ns * RATE / NANOSECONDS)
        elapsed = k - self._observed if self._observed >= 0 else 1
        if elapsed <= 0:  # repeated, or overtaken by a later one
            self.unchanged = RobotCommand(self._sent, self._observed_ns)
            return None
        self._yaw_rate = math.nan
        if self._observed >= 0:
            turned = wrap_angle(state.odometry.pose.yaw - self._yaw)
            self._yaw_rate = turned / (elapsed * self._model.period)
        measured = self._measured(state)
        if self._controller is None:
            self._actuation.reset(measured)
            self._controller = self._new_controller(measured)
        elif self._dead_time is not None:
            self._update_dead_time(self._dead_time, measured, elapsed)
        self._observed, self._observed_ns = k, state.stamp_ns
        self._yaw = state.odometry.pose.yaw
        self._elapsed, seam = elapsed, self._actuation
        seam.observe(measured, elapsed * self._model.period)
        now, following, future = self._reference.at(k, self._late)
        return Observation(
            seam.predicted,
            seam.disturbance,
            now,
            following,
            seam.command,
            future,
            elapsed,
            self._late,
            self._yaw_rate,
        )

    def command_for(self, acceleration: Array) -> RobotCommand:
        """Return the command that an acceleration (rad/s²), chosen for the observation, makes."""
        asked, cut = self._limited_torque(acceleration)
        if not np.isfinite(asked).all():
            return RobotCommand(WheelSpeeds(math.nan, math.nan), self._observed_ns)
        elapsed = self._elapsed * self._model.period
        self._acceleration = self._actuation.send_acceleration(asked, elapsed)
        self._limited = self._actuation.limited or cut
        if self._controller is not None:
            self._controller.applied(self._acceleration, limited=self._limited)
        sent = self._actuation.command
        if self._model.drive == 'torque':
            sent = np.dot(self._believed_inertia, self._acceleration)
        self._sent = WheelSpeeds(*sent.tolist())
        return RobotCommand(self._sent, self._observed_ns)

    def _new_controller(self, measured: Array) -> BaselineController:
        controller, seam = self._method(self._model), self._actuation
        self._reference = ObservedReference(
            self._scenario.reference(),
            self._scenario.steps,
            self._scenario.kind.preview_rows(seam.dead_time),
            seam.dead_time,
            preview=controller.preview,
        )
        self._late = self._reference.late
        self._believed_inertia = controller.inertia_error * self._inertia
        if controller.estimate_dead_time and seam.takes_speeds:
            filtered, friction = seam.speed_filter.parameters, self._model.robot.friction
            # The pulses of a stepper ramp over a period, half a period late on average.
            self._dead_time = DeadTimeEstimator(
                replace(filtered, lag=max(filtered.lag, 0.5 * self._model.period)),
                self._model.period,
                mean_speeds=self._scenario.kind.mean_speeds,
                friction=max(friction.viscous, friction.coulomb) > 0.0,
            )
            self._dead_time.reset(measured)
        return controller

    def _measured(self, state: RobotState) -> Array:
        """Return the measured wheel speeds, rad/s, shape (2,).

        With the gyro, their difference is that of the yaw rate of the odometry's pose.
        """
        if not self._scenario.uses_gyro or self._observed < 0:
            return np.array(state.wheels)
        geometry = self._model.robot.geometry
        mean = 0.5 * (state.wheels.right + state.wheels.left)
        half = self._yaw_rate * geometry.half_separation / geometry.wheel_radius
        return np.array([mean + half, mean - half])

    def _update_dead_time(
        self, estimator: DeadTimeEstimator, measured: Array, elapsed: int
    ) -> None:
        """Update the dead time in use with measured speeds, ``elapsed`` periods after the last."""
        period = self._model.period
        estimator.step(measured, self._actuation.command, elapsed * period)
        periods = min(estimator.dead_time_in_use / period, float(self._reference.latest))
        if abs(periods - self._late) > DEAD_TIME_HYSTERESIS:
            self._late = round(periods)
            self._actuation.set_dead_time(self._late * period)

    def _limited_torque(self, asked: Array) -> tuple[Array, bool]:
        """Return accelerations that a torque drive can give, and whether they were cut."""
        if self._model.drive != 'torque':
            return asked, False
        inertia = self._believed_inertia
        (diagonal, beside), (right, left) = inertia[0].tolist(), asked.tolist()
        limit = self._torque_limit
        if not limit < max(
            abs(diagonal * right + beside * left), abs(beside * right + diagonal * left)
        ):
            return asked, False
        torque = np.clip(inertia @ asked, -limit, limit)
        return np.asarray(np.linalg.solve(inertia, torque), dtype=np.float64), True


# -- methods ------------------------------------------------------------------------------------

SEPARATOR = '; '
"""Between the parts of what a method knows."""


@dataclass(frozen=True, slots=True)
class MethodSpec:
    """A method to be compared, as plain data that can be sent to another process.

    Calling it makes the method: ``spec(knowledge)``.
    """

    name: str
    controller_type: type[BaselineController]
    parameters: Parameters
    pretrained: bool = False
    """Whether a method with adaptation starts from the weights of :func:`pretrain`."""
    baseline: bool = True
    """Whether it is a baseline, not a stage of the proposed controller."""

    def __post_init__(self) -> None:
        expected = self.controller_type.parameters_type
        if not isinstance(self.parameters, expected):
            raise ValueError(
                f'parameters of {self.name} must be {expected.__name__}: '
                f'got {type(self.parameters).__name__}'
            )

    def __call__(self, nominal_model: NominalModel) -> BaselineController:
        """Return a new controller, with pretrained weights if so specified."""
        controller = self.controller_type(self.parameters, nominal_model)
        if self.pretrained and controller.get_weights():
            controller.set_weights(
                pretrain(self.controller_type, self.parameters, nominal_model.drive)
            )
        return controller

    def knowledge(self, scenario: Scenario) -> str:
        """Return what it knows, as its controller states."""
        controller = self.controller_type(self.parameters, scenario.nominal_model())
        known = controller.knowledge
        if scenario.uses_gyro and 'wheel speeds' in known:
            known.append('their difference by the gyro')
        if self.pretrained and controller.get_weights():
            known.append(f'weights of {len(PRETRAINING_SEEDS)} runs')
        return SEPARATOR.join(dict.fromkeys(known))

    @property
    def preview(self) -> bool:
        """Whether it has preview."""
        chosen = self.parameters.to_dict().get('jump_transition.preview')
        return self.controller_type.preview if chosen is None else chosen is True

    def driver(self, scenario: Scenario) -> MethodDriver:
        """Return a new driver for a run."""
        return MethodDriver(self, scenario)


@lru_cache(maxsize=32)
def pretrain(
    controller_type: type[BaselineController], parameters: Parameters, drive: str
) -> Mapping[str, Array]:
    """Return the weights of a method after the runs of :data:`PRETRAINING_SEEDS` in sequence."""
    weights: Mapping[str, Array] = {}
    for seed in PRETRAINING_SEEDS:
        scenario = Scenario(
            PLANT_OF[drive], NOMINAL, seed, PRETRAINING_DURATION, PRETRAINING_NOISE
        )
        method = MadeMethod(controller_type(parameters, scenario.nominal_model()))
        if weights:
            method.controller.set_weights(weights)
        run(scenario, method)
        weights = method.controller.get_weights()
    return weights


class MadeMethod(NamedTuple):
    """A controller that is made already, for one run; its weights can be read after it."""

    controller: BaselineController
    name: str = 'made'

    def driver(self, scenario: Scenario) -> MethodDriver:
        """Return a driver with the controller."""
        return MethodDriver(lambda _: self.controller, scenario)


@dataclass(frozen=True, slots=True)
class NodeMethod:
    """The controller of the node, with changes of its parameters for the robot."""

    name: str
    changes: Mapping[str, object]

    def knowledge(self, scenario: Scenario) -> str:
        """Return what it knows."""
        parameters = self.parameters_for(scenario)
        known = [f'reference {"ahead" if parameters.jump_transition.preview else "now"}']
        known += ['wheel speeds', 'yaw rate of the gyro and tolerance of its scale']
        if parameters.estimate_dead_time:
            known.append('estimate of the dead time')
        if any(parameters.command_shaper.delays):
            known.append('frequencies of the rotors')
        return SEPARATOR.join(known)

    def parameters_for(self, scenario: Scenario) -> ControllerParameters:
        """Return its parameters in a run."""
        return scenario.kind.controller_parameters(scenario).with_values(self.changes)

    def driver(self, scenario: Scenario) -> NodeDriver:
        """Return a new driver for a run."""
        controller = Controller(self.parameters_for(scenario))
        controller.warm_up()
        geometry = scenario.true_robot().geometry
        return NodeDriver(controller, geometry, scenario.reference().speeds)
