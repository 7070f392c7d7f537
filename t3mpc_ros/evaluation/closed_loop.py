# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Closed loop of plant and controller without ROS; runs scenarios, in several processes if asked.

Worker processes import the main module again: a script that uses more than one worker guards its
work by ``if __name__ == '__main__':``.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
import math
import multiprocessing
from typing import Any, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.actuation import VelocityActuation
from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.control.dead_time_estimator import DeadTimeEstimator
from t3mpc_ros.evaluation.baselines.baseline_controller import (
    BaselineController,
    NominalModel,
    Observation,
)
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.reporting import progress_bar
from t3mpc_ros.evaluation.scenario import (
    DRIVES,
    PRETRAINING_DURATION,
    PRETRAINING_NOISE,
    PRETRAINING_SEEDS,
    RATE,
    SampledReference,
    Scenario,
    counted_rows,
    switch_times,
)
from t3mpc_ros.evaluation.simulated_links import PeriodicLinks
from t3mpc_ros.parameters.table import Parameters
from t3mpc_ros.simulation.plant.dynamics import wheel_inertia
from t3mpc_ros.simulation.plant.paper_plant import DisturbedPlant

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LoopRecord:
    """Record of one run, one row per control period, right wheel first.

    Row k holds what was known and decided at ``time[k]``, and the state of the robot then. From
    a row on at which the method answered with a number that is not finite, or the robot has such
    a speed, all is NaN but time, reference and mode: the run ended there.
    """

    time: Array
    """s, shape (n,)"""
    reference: Array
    """r, rad/s, shape (n, 2)"""
    measured: Array
    """chi with its noise, rad/s, shape (n, 2)"""
    speeds: Array
    """True chi, rad/s, shape (n, 2)"""
    estimated: Array
    """Estimated chi, rad/s, shape (n, 2)"""
    unexplained: Array
    """Estimated acceleration that chi' = u does not explain, rad/s², shape (n, 2)"""
    command: Array
    """u as the drive's limits let it through, rad/s², shape (n, 2)"""
    sent: Array
    """Command to the robot, shape (n, 2): torques (N m) or wheel speeds (rad/s)"""
    effort: Array
    """Acceleration asked of the robot, rad/s², shape (n, 2): u with the torque drive, the rate of
    change of the commanded wheel speeds with the velocity drive"""
    limited: NDArray[np.bool_]
    """Whether a limit changed u, shape (n,)"""
    terms: Array
    """Terms of u, rows as in ``TERM_NAMES``, rad/s², shape (n, 5, 2); zeros for a method that
    has none. The fuzzy estimate is the first one negated."""
    modes: NDArray[np.int64]
    """Active switching mode, shape (n,)"""
    switches: Array
    """Instants of the switches, also of those after the end that preview reaches, s."""

    @classmethod
    def empty(cls, steps: int) -> Self:
        """Return a record of ``steps`` rows of zeros, to be filled."""
        arrays: dict[str, Any] = {each.name: np.zeros((steps, 2)) for each in fields(cls)}
        arrays |= {
            'time': np.zeros(steps),
            'limited': np.zeros(steps, dtype=np.bool_),
            'terms': np.zeros((steps, len(TERM_NAMES), 2)),
            'modes': np.zeros(steps, dtype=np.int64),
            'switches': np.zeros(0),
        }
        return cls(**arrays)

    @property
    def error(self) -> Array:
        """True tracking error chi - r, rad/s, shape (n, 2)."""
        return self.speeds - self.reference

    @property
    def finite(self) -> bool:
        """Whether the run went to its end: every number is finite."""
        return bool(np.isfinite(self.speeds).all() and np.isfinite(self.command).all())

    def rmse(self, after: float = 3.0, *, cut: float = 0.0) -> float:
        """Return the tracking RMSE over both wheels, rad/s; NaN when the run broke off."""
        return rms(self.error[self._counted(after, cut)])

    def largest_error(self, after: float) -> float:
        """Return the largest tracking error of a wheel from ``after`` (s) on, rad/s."""
        return float(np.max(np.abs(self.error[self._counted(after, 0.0)])))

    def chatter(self) -> float:
        """Return the total variation of the effort per second and wheel, rad/s³."""
        if self.time.size < 2:
            raise ValueError(f'a record must have at least 2 rows: got {self.time.size}')
        return total_variation(self.time, self.effort)

    def _counted(self, after: float, cut: float) -> NDArray[np.bool_]:
        return counted_rows(self.time, self.switches, after, (0.4 * cut, 0.6 * cut))


def total_variation(time: Array, signal: Array) -> float:
    """Return the total variation of a signal, shape (n, 2), per second and wheel."""
    span = time[-1] - time[0]
    return float(np.abs(np.diff(signal, axis=0)).sum() / (2.0 * span))


T = TypeVar('T')


class NamedMethod(Protocol):
    """A method of any loop."""

    @property
    def name(self) -> str:
        """Name in tables and errors."""
        ...


J = TypeVar('J', bound=tuple[Any, NamedMethod])


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


@lru_cache(maxsize=32)
def pretrain(
    controller_type: type[BaselineController], parameters: Parameters, drive: str
) -> Mapping[str, Array]:
    """Return the weights of a method after the runs of :data:`PRETRAINING_SEEDS` in sequence."""
    weights: Mapping[str, Array] = {}
    for seed in PRETRAINING_SEEDS:
        scenario = Scenario(drive, PRETRAINING_NOISE, 'nominal', seed, PRETRAINING_DURATION)
        controller = controller_type(parameters, scenario.nominal_model())
        if weights:
            controller.set_weights(weights)
        run(scenario, lambda _, controller=controller: controller)  # type: ignore[misc]
        weights = controller.get_weights()
    return weights


Job = tuple[Scenario, MethodSpec]


class JobError(RuntimeError):
    """A run that failed; the text names method and scenario."""


def drive_for(scenario: Scenario) -> VelocityActuation:
    """Return the estimator and drive seam that every method has in a scenario."""
    geometry = scenario.nominal_model().robot.geometry
    return VelocityActuation(
        scenario.estimate(), scenario.limits, geometry, scenario.drive, 1.0 / RATE
    )


def run(
    scenario: Scenario,
    method: Callable[[NominalModel], BaselineController],
    *,
    drive: VelocityActuation | None = None,
) -> LoopRecord:
    """Return the record of a new ``method`` tracking the reference of a scenario.

    Each period k: measure, estimate, show the method its :class:`Observation`, send its answer.
    The robot stands at the start, and the estimator begins with what is measured then. With a
    torque drive, u is cut where its torque would be beyond what the motors have, so that
    estimator and method get the limited u. Equal arguments give equal runs, bit for bit.

    Parameters
    ----------
    method
        Makes the controller from the nominal model, for example a :class:`MethodSpec`.
    drive
        A drive seam in place of :func:`drive_for`, of the same kind; it is reset first.
    """
    nominal_model = scenario.nominal_model()
    controller = method(nominal_model)
    seam = drive_for(scenario) if drive is None else drive
    robot = scenario.robot()
    plant = scenario.plant()
    measured_now = np.array(plant.measure(0.0))
    seam.reset(measured_now)
    changed_robot, change_step = scenario.changed_robot(), scenario.change_step
    inertia = wheel_inertia(nominal_model.robot.body, nominal_model.robot.geometry)
    torque_drive = scenario.drive == 'torque'
    diagonal, beside = inertia[0].tolist()
    torque_limit = nominal_model.robot.drive.torque_limit if torque_drive else math.inf
    period = nominal_model.period
    record = _prepare(scenario)
    rows = max(2, round(scenario.lead * RATE))
    reference = observed_reference(
        scenario.reference(), scenario.steps, rows, seam.dead_time, preview=controller.preview
    )
    loop = MethodLoop(controller, seam, period, reference)
    terms: object = getattr(controller, 'terms', None)
    has_terms = isinstance(terms, np.ndarray) and terms.shape == record.terms.shape[1:]

    last: Array = np.zeros(2)
    links = PeriodicLinks(scenario.links, scenario.seed, scenario.steps, RATE)
    for k in range(scenario.steps):
        if k == change_step and changed_robot is not None:
            plant.configure(changed_robot)
        record.measured[k] = measured_now
        record.speeds[k] = speeds = plant.wheels
        if not (math.isfinite(speeds[0]) and math.isfinite(speeds[1])):
            _break_off(record, k)
            return record
        if k > 0:  # unless a measurement arrives, all that it decides stays as it is
            for kept in (record.command, record.sent, record.limited):
                kept[k] = kept[k - 1]
        for j, measured in links.measured(k, measured_now):
            asked = loop.step(j, measured)
            if k == 0 and not (isinstance(asked, np.ndarray) and asked.shape == (2,)):
                what = f'shape {asked.shape}' if isinstance(asked, np.ndarray) else repr(asked)
                raise ValueError(
                    f'step() of {type(controller).__name__} must return a numpy array of shape '
                    f'(2,), the accelerations of the right and the left wheel: got {what}'
                )
            right, left = asked.tolist()
            if not (math.isfinite(right) and math.isfinite(left)):
                _break_off(record, k)
                return record
            cut = torque_limit < max(
                abs(diagonal * right + beside * left), abs(beside * right + diagonal * left)
            )
            if cut:
                torque = np.clip(inertia @ asked, -torque_limit, torque_limit)
                asked = np.asarray(np.linalg.solve(inertia, torque), dtype=np.float64)
            command = record.command[k]
            command[:] = loop.send(asked, cut=cut)
            record.limited[k] = seam.limited or cut
            if has_terms:
                record.terms[k] = controller.terms  # type: ignore[attr-defined]
            sent = record.sent[k]
            if torque_drive:
                np.dot(inertia, command, out=sent)
            else:
                sent[:] = seam.command
            links.send(k, j, sent)
        record.estimated[k] = seam.speeds
        record.unexplained[k] = seam.disturbance
        if torque_drive:
            record.effort[k] = record.command[k]
        else:
            record.effort[k] = (record.sent[k] - last) / period
            last[:] = record.sent[k]
        right, left = links.command(k).tolist()
        plant.run((right, left), robot.substeps)
        measured_now = np.array(plant.measure(robot.substeps * robot.step))
    return record


def _prepare(scenario: Scenario) -> LoopRecord:
    """Return a record with all that is known before the run."""
    reference = scenario.reference()
    switches = switch_times(reference.time, reference.modes)
    record = replace(LoopRecord.empty(scenario.steps), switches=switches)
    record.time[:] = reference.time[: scenario.steps]
    record.reference[:] = reference.speeds[: scenario.steps]
    record.modes[:] = reference.modes[: scenario.steps]
    return record


class ObservedReference(NamedTuple):
    """Reference as a method observes it in each period.

    With preview of ``rows`` periods these are rows of the reference after the dead time, and go on
    beyond the run. Without, r is extrapolated over the dead time by the slope it has now: a switch
    is seen when it happens, and not before.
    """

    speeds: Array
    """r, rad/s, shape (n, 2)."""
    slope: Array
    """Its change in a period, rad/s, shape (n, 2)."""
    rows: int
    """Rows that preview gives; 0 without preview."""
    late: int
    """Configured dead time, in periods."""
    latest: int
    """Largest dead time for which it is known, in periods."""

    def at(self, k: int, late: int) -> tuple[Array, Array, Array | None]:
        """Return r ``late`` periods after period ``k``, one period later, and the preview."""
        if self.rows:
            row = k + late
            return self.speeds[row], self.speeds[row + 1], self.speeds[row : row + self.rows]
        now = self.speeds[k] + late * self.slope[k]
        return now, self.speeds[k] + (late + 1) * self.slope[k], None


def observed_reference(
    sampled: SampledReference, steps: int, rows: int, dead_time: float, *, preview: bool
) -> ObservedReference:
    """Return what a method observes of a reference over a run of ``steps`` periods.

    The arrays can be written to, because compiled functions take one that cannot for another type.
    """
    late = round(dead_time * RATE)
    if not math.isclose(dead_time * RATE, late, abs_tol=1e-6):
        raise ValueError(f'dead time must be whole periods of {1.0 / RATE:g} s: got {dead_time} s')
    if steps + late + rows > sampled.time.size:
        raise ValueError(
            f'dead time must be at most {(sampled.time.size - steps - rows) / RATE:g} s, '
            f'as far as the reference reaches: got {dead_time} s'
        )
    latest = sampled.time.size - steps - rows
    rate = sampled.rate / RATE
    return ObservedReference(sampled.speeds.copy(), rate, rows if preview else 0, late, latest)


DEAD_TIME_HYSTERESIS = 0.75
"""Difference of estimate and dead time in use, in periods, at which the latter changes."""


class MethodLoop:
    """A method between the state estimate and the limits that all methods share.

    The estimator of ``actuation`` was reset to the first measurement. A method that estimates the
    dead time gets the state estimate and the reference for the estimated one, in whole periods.
    """

    def __init__(
        self,
        controller: BaselineController,
        actuation: VelocityActuation,
        period: float,
        reference: ObservedReference,
    ) -> None:
        self._controller, self._actuation, self._period = controller, actuation, period
        self._reference = reference
        self._observed = -1
        """Period of the last measurement."""
        self._late = reference.late
        self._dead_time: DeadTimeEstimator | None = None
        if controller.estimate_dead_time and actuation.takes_speeds:
            known = actuation.speed_filter.parameters
            self._dead_time = DeadTimeEstimator(known, period, mean_speeds=False, friction=True)

    def step(self, k: int, measured: Array) -> Array:
        """Return the answer (rad/s²) to the speeds (rad/s) measured in period ``k``."""
        elapsed = k - self._observed if self._observed >= 0 else 1
        actuation = self._actuation
        if self._dead_time is not None:
            self._update_dead_time(self._dead_time, measured, elapsed * self._period)
        self._observed = k
        actuation.observe(measured, elapsed * self._period)
        now, following, future = self._reference.at(k, self._late)
        return self._controller.step(
            Observation(
                actuation.predicted,
                actuation.disturbance,
                now,
                following,
                actuation.command,
                future,
                elapsed,
                self._late,
            )
        )

    def _update_dead_time(self, estimator: DeadTimeEstimator, measured: Array, dt: float) -> None:
        """Update the dead time in use with a measurement (rad/s), ``dt`` s after the last one."""
        if self._observed < 0:
            estimator.reset(measured)
            return
        estimator.step(measured, self._actuation.command, dt)
        periods = min(estimator.dead_time_in_use / self._period, float(self._reference.latest))
        if abs(periods - self._late) > DEAD_TIME_HYSTERESIS:
            self._late = round(periods)
            self._actuation.set_dead_time(self._late * self._period)

    def send(self, asked: Array, *, cut: bool = False) -> Array:
        """Return the acceleration (rad/s²) that the limits let through of an answer.

        ``cut``: it has been limited before.
        """
        applied = self._actuation.send_acceleration(asked)
        self._controller.applied(applied, limited=self._actuation.limited or cut)
        return applied


def _break_off(record: LoopRecord, k: int) -> None:
    """Mark rows from ``k`` on as never run."""
    kept = 'time', 'reference', 'modes', 'limited', 'switches'
    for each in fields(record):
        if each.name not in kept:
            getattr(record, each.name)[k:] = math.nan


def warm_up() -> None:
    """Load, or compile, every kernel of the loop itself, in both drives."""
    for drive in DRIVES:
        scenario = Scenario(drive, 0.0, 'nominal', 1)
        seam = drive_for(scenario)
        seam.observe(np.zeros(2), 1.0 / RATE)
        seam.send_acceleration(np.zeros(2))
        seam.observe(np.zeros(2), 1.0 / RATE)
        DisturbedPlant(scenario.robot()).run((0.0, 0.0), 1)


class WorkerPool:
    """Executor that runs jobs, kept warm from one batch to the next.

    Jobs share nothing, so results do not depend on who works. To be used in a ``with`` statement.

    Parameters
    ----------
    workers
        How many processes of this machine; one is this process itself. Or an executor, here or on
        other machines, which the caller ends.
    """

    def __init__(self, workers: int | Executor) -> None:
        if isinstance(workers, int) and workers < 1:
            raise ValueError(f'workers must be at least 1: got {workers}')
        self._workers = workers
        self._pool: Executor | None = None

    def __enter__(self) -> Self:
        if isinstance(self._workers, Executor):
            self._pool = self._workers
        elif self._workers > 1:
            # Spawned, not forked: a fork would copy whatever threads and locks this process has.
            self._pool = ProcessPoolExecutor(
                self._workers, multiprocessing.get_context('spawn'), initializer=warm_up
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None and self._pool is not self._workers:
            self._pool.shutdown(cancel_futures=True)
        self._pool = None

    def run(
        self, jobs: Iterable[Job], measure: Callable[[LoopRecord], T]
    ) -> Iterator[tuple[int, T]]:
        """Yield (index of the job, measure of its record) as the jobs are finished.

        ``measure`` is applied in the worker, so that whole records need not travel: a function of
        a module, or ``operator.methodcaller('rmse')``. For errors see :meth:`map`.
        """
        return self.map(partial(_measured, measure), jobs)

    def map(self, task: Callable[[J], T], jobs: Iterable[J]) -> Iterator[tuple[int, T]]:
        """Yield (index of the job, ``task`` of it) as the jobs are finished.

        ``task`` is a function of a module.

        Raises
        ------
        JobError
            A run raised an exception; the jobs not begun are dropped.
        """
        if self._pool is None:
            for index, job in enumerate(jobs):
                try:
                    result = task(job)
                except Exception as error:
                    raise _job_error(job, error) from error
                yield index, result
            return
        begun: dict[Future[T], tuple[int, J]] = {}
        try:
            for index, job in enumerate(jobs):
                begun[self._pool.submit(task, job)] = index, job
            for future in as_completed(begun):
                index, job = begun.pop(future)
                failure = future.exception()
                if failure is not None:
                    raise _job_error(job, failure) from failure
                yield index, future.result()
        finally:
            for future in begun:
                future.cancel()


def map_jobs(
    task: Callable[[J], T],
    jobs: Sequence[J],
    workers: int | Executor = 1,
    unit: str = 'runs',
    *,
    progress: bool = False,
) -> list[T]:
    """Return ``task`` of every job in their order; ``workers`` as for :class:`WorkerPool`."""
    found: dict[int, T] = {}
    with WorkerPool(workers) as pool, progress_bar(len(jobs), unit, show=progress) as bar:
        for index, result in pool.map(task, jobs):
            found[index] = result
            bar.update()
    return [found[index] for index in range(len(jobs))]


def measure_many(
    jobs: Iterable[Job], measure: Callable[[LoopRecord], T], workers: int | WorkerPool = 1
) -> Iterator[tuple[int, T]]:
    """Yield (index of the job, measure of its record) as the jobs are finished.

    ``workers`` is how many processes, for this batch alone, or a :class:`WorkerPool` that runs.
    """
    team = nullcontext(workers) if isinstance(workers, WorkerPool) else WorkerPool(workers)
    with team as running:
        yield from running.run(jobs, measure)


def _measured(measure: Callable[[LoopRecord], T], job: Job) -> T:
    return measure(run(*job))


def full_record(record: LoopRecord) -> LoopRecord:
    """Return the record itself: the measure that leaves nothing out."""
    return record


def _job_error(job: 'tuple[Any, NamedMethod]', error: BaseException) -> JobError:
    scenario, method = job
    return JobError(f'{method.name} on {scenario} failed: {error!r}')
