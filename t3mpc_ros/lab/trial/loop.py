# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The closed loop without ROS and without a clock: one run, or many in several processes.

What a program starts in other processes imports its main module again, so a script that uses
more than one worker has its work behind ``if __name__ == '__main__':``.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
import math
import multiprocessing
from types import TracebackType
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.control.drive import Drive
from t3mpc_ros.lab.rivals.rival import Knowledge, Rival, View
from t3mpc_ros.lab.trial.plant import FastPlant
from t3mpc_ros.lab.trial.record import LoopRecord
from t3mpc_ros.lab.trial.scenario import (
    DRIVES,
    PRACTICE,
    PRACTICE_DURATION,
    PRACTICE_NOISE,
    RATE,
    Scenario,
)
from t3mpc_ros.robot.dynamics import wheel_inertia
from t3mpc_ros.settings import Settings

Array = NDArray[np.float64]
T = TypeVar('T')


@dataclass(frozen=True, slots=True)
class MethodSpec:
    """A method to be compared, as plain data that can be sent to another process.

    Calling it makes the method: ``spec(knowledge)``.
    """

    name: str
    rival_type: type[Rival]
    settings: Settings
    practised: bool = False
    """Whether it comes with what it learnt in :data:`PRACTICE`, if it is one that learns."""

    def __post_init__(self) -> None:
        wanted = self.rival_type.settings_type
        if not isinstance(self.settings, wanted):
            raise ValueError(
                f'settings of {self.name} must be {wanted.__name__}: '
                f'got {type(self.settings).__name__}'
            )

    def __call__(self, knowledge: Knowledge) -> Rival:
        """Return a new controller that knows of no runs before, but of its practice."""
        controller = self.rival_type(self.settings, knowledge)
        if self.practised and controller.learnt():
            controller.restore(practise(self.rival_type, self.settings, knowledge.drive))
        return controller


@lru_cache(maxsize=32)
def practise(rival_type: type[Rival], settings: Settings, drive: str) -> Mapping[str, Array]:
    """Return what a method learns in the runs of :data:`PRACTICE`, one after the other."""
    learnt: Mapping[str, Array] = {}
    for seed in PRACTICE:
        scenario = Scenario(drive, PRACTICE_NOISE, 'nominal', seed, PRACTICE_DURATION)
        controller = rival_type(settings, scenario.knowledge())
        if learnt:
            controller.restore(learnt)
        run(scenario, lambda _, controller=controller: controller)  # type: ignore[misc]
        learnt = controller.learnt()
    return learnt


Job = tuple[Scenario, MethodSpec]


class JobError(RuntimeError):
    """A run that failed; the text names method and scenario."""


def drive_for(scenario: Scenario) -> Drive:
    """Return the estimator and drive seam that every method has in a scenario."""
    geometry = scenario.knowledge().robot.geometry
    return Drive(scenario.estimate(), scenario.limits, geometry, scenario.drive, 1.0 / RATE)


def run(
    scenario: Scenario, method: Callable[[Knowledge], Rival], *, drive: Drive | None = None
) -> LoopRecord:
    """Return what happened when a new ``method`` followed the reference of a scenario.

    Each period k: measure, estimate, show the method its :class:`View`, send what it answers.
    The robot stands at the start, and the estimator begins with what is measured then. With a
    torque drive, u is cut where its torque would be beyond what the motors have, so that
    estimator and method are told the u that acts. Equal arguments give equal runs, bit for bit.

    Parameters
    ----------
    scenario
        Drive, noise, case and seed.
    method
        Makes the controller from what it is told, a :class:`MethodSpec` say.
    drive
        A drive seam in place of :func:`drive_for`, of the same kind; it is reset first.

    Raises
    ------
    ValueError
        The dead time is not a whole number of periods, or longer than the reference reaches; or
        the method answers with anything but two numbers.
    """
    knowledge = scenario.knowledge()
    controller = method(knowledge)
    seam = drive_for(scenario) if drive is None else drive
    plant = FastPlant(scenario.robot(), scenario.steps)
    seam.reset(plant.measured)
    changed_robot, change_step = scenario.changed_robot(), scenario.change_step
    inertia = wheel_inertia(knowledge.robot.body, knowledge.robot.geometry)
    torque_drive = scenario.drive == 'torque'
    diagonal, beside = inertia[0].tolist()
    torque_limit = knowledge.robot.drive.torque_limit if torque_drive else math.inf
    period = knowledge.period
    record = _prepare(scenario)
    now, following, rows = _shown(scenario, seam.dead_time, controller.preview)
    terms: object = getattr(controller, 'terms', None)
    has_terms = isinstance(terms, np.ndarray) and terms.shape == record.terms.shape[1:]
    view = View(seam.ahead, seam.unexplained, now[0], following[0], seam.command, None)

    last: Array = np.zeros(2)
    for k in range(scenario.steps):
        if k == change_step and changed_robot is not None:
            plant.configure(changed_robot)
        seam.observe(plant.measured, period)
        record.measured[k] = plant.measured
        record.speeds[k] = plant.speeds
        record.estimated[k] = seam.speeds
        record.unexplained[k] = seam.unexplained
        view.speeds = seam.ahead
        view.unexplained = seam.unexplained
        view.wanted = now[k]
        view.wanted_next = following[k]
        view.command = seam.command
        if rows:
            view.future = now[k : k + rows]
        asked = controller.step(view)
        if k == 0 and np.shape(asked) != (2,):
            raise ValueError(f'a method must answer with shape (2,): got {np.shape(asked)}')
        right, left = asked.tolist()
        if not (math.isfinite(right) and math.isfinite(left)):
            _break_off(record, k)
            break
        cut = torque_limit < max(
            abs(diagonal * right + beside * left), abs(beside * right + diagonal * left)
        )
        if cut:
            torque = np.clip(inertia @ asked, -torque_limit, torque_limit)
            asked = np.asarray(np.linalg.solve(inertia, torque), dtype=np.float64)
        command = record.command[k]
        command[:] = seam.send(asked)
        limited = seam.limited or cut
        record.limited[k] = limited
        controller.applied(command, limited=limited)
        if has_terms:
            record.terms[k] = controller.terms  # type: ignore[attr-defined]
        sent = record.sent[k]
        if torque_drive:
            np.dot(inertia, command, out=sent)
            record.effort[k] = command
        else:
            sent[:] = seam.command
            record.effort[k] = (seam.command - last) / period
            last[:] = seam.command
        right, left = sent.tolist()
        plant.step(right, left)
    return record


def _prepare(scenario: Scenario) -> LoopRecord:
    """Return a record with all that is known before the run."""
    record, reference = LoopRecord.empty(scenario.steps), scenario.reference()
    record.time[:] = reference.time[: scenario.steps]
    record.wanted[:] = reference.wanted[: scenario.steps]
    record.modes[:] = reference.modes[: scenario.steps]
    return record


def _shown(scenario: Scenario, dead_time: float, preview: bool) -> tuple[Array, Array, int]:
    """Return ``View.wanted`` and ``View.wanted_next`` of each period, and how long ``future`` is.

    With preview they are rows of the reference after the dead time, and go on beyond the run.
    Without, r is extrapolated over the dead time by the slope it has now: a switch is seen when
    it happens, and not before. These are copies that can be written to, because compiled
    functions take an array that cannot for another type.
    """
    late = round(dead_time * RATE)
    if not math.isclose(dead_time * RATE, late, abs_tol=1e-6):
        raise ValueError(f'dead time must be whole periods of {1.0 / RATE:g} s: got {dead_time} s')
    reference, steps = scenario.reference(), scenario.steps
    rows = max(2, round(scenario.lead * RATE))
    if steps + late + rows > reference.time.size:
        raise ValueError(
            f'dead time must be at most {(reference.time.size - steps - rows) / RATE:g} s, '
            f'as far as the reference reaches: got {dead_time} s'
        )
    if preview:
        return reference.wanted[late:].copy(), reference.wanted[late + 1 :].copy(), rows
    wanted, slope = reference.wanted[:steps], reference.rate[:steps] / RATE
    return wanted + late * slope, wanted + (late + 1) * slope, 0


def _break_off(record: LoopRecord, k: int) -> None:
    """Mark rows from ``k`` on as never run."""
    record.terms[k:] = math.nan
    for values in (
        record.measured,
        record.speeds,
        record.estimated,
        record.unexplained,
        record.command,
        record.sent,
        record.effort,
    ):
        values[k:] = math.nan


def warm_up() -> None:
    """Load, or compile, every kernel of the loop itself, in both drives."""
    for drive in DRIVES:
        scenario = Scenario(drive, 0.0, 'nominal', 1)
        seam = drive_for(scenario)
        seam.observe(np.zeros(2), 1.0 / RATE)
        seam.send(np.zeros(2))
        seam.observe(np.zeros(2), 1.0 / RATE)
        FastPlant(scenario.robot(), 1).step(0.0, 0.0)


class Workers:
    """Processes that run jobs, kept warm from one batch to the next.

    Jobs share nothing, so results do not depend on how many workers there are. One worker is
    this process itself. To be used in a ``with`` statement.

    Parameters
    ----------
    count
        How many, at least 1.

    Raises
    ------
    ValueError
        ``count`` is below 1.
    """

    def __init__(self, count: int) -> None:
        if count < 1:
            raise ValueError(f'workers must be at least 1: got {count}')
        self._count = count
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        if self._count > 1:
            # Spawned, not forked: a fork would copy whatever threads and locks this process has.
            self._pool = ProcessPoolExecutor(
                self._count, multiprocessing.get_context('spawn'), initializer=warm_up
            )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    def run(
        self, jobs: Iterable[Job], measure: Callable[[LoopRecord], T]
    ) -> Iterator[tuple[int, T]]:
        """Yield (index of the job, measure of its record) as the jobs are finished.

        Jobs are taken from ``jobs`` only as workers become free.

        Parameters
        ----------
        jobs
            Scenario and method of each run.
        measure
            Applied in the worker, so that whole records need not travel; a function of a module,
            or ``operator.methodcaller('rmse')``.

        Raises
        ------
        JobError
            A run raised an exception; the jobs not begun are dropped.
        """
        if self._pool is None:
            for index, job in enumerate(jobs):
                try:
                    result = run_job(job, measure)
                except Exception as error:
                    raise _named(job, error) from error
                yield index, result
            return
        waiting = iter(enumerate(jobs))
        begun: dict[Future[T], tuple[int, Job]] = {}
        try:
            while True:
                while len(begun) < 2 * self._count and (entry := next(waiting, None)):
                    begun[self._pool.submit(run_job, entry[1], measure)] = entry
                if not begun:
                    return
                finished, _ = wait(begun, return_when=FIRST_COMPLETED)
                for future in sorted(finished, key=lambda each: begun[each][0]):
                    index, job = begun.pop(future)
                    failure = future.exception()
                    if failure is not None:
                        raise _named(job, failure) from failure
                    yield index, future.result()
        finally:
            for future in begun:
                future.cancel()


def run_many(jobs: Iterable[Job], workers: int | Workers = 1) -> Iterator[tuple[int, LoopRecord]]:
    """Yield (index of the job, its record) as the jobs are finished, see :meth:`Workers.run`."""
    return measure_many(jobs, whole, workers)


def measure_many(
    jobs: Iterable[Job], measure: Callable[[LoopRecord], T], workers: int | Workers = 1
) -> Iterator[tuple[int, T]]:
    """Yield (index of the job, measure of its record) as the jobs are finished.

    ``workers`` is how many processes, for this batch alone, or :class:`Workers` that are running.
    """
    team = nullcontext(workers) if isinstance(workers, Workers) else Workers(workers)
    with team as running:
        yield from running.run(jobs, measure)


def run_job(job: Job, measure: Callable[[LoopRecord], T]) -> T:
    """Return the measure of one job's record."""
    return measure(run(*job))


def whole(record: LoopRecord) -> LoopRecord:
    """Return the record itself: the measure that leaves nothing out."""
    return record


def _named(job: Job, error: BaseException) -> JobError:
    scenario, method = job
    return JobError(f'{method.name} on {scenario} failed: {error!r}')
