# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Runs in several processes, here or on other machines.

Worker processes import the main module again: a script that uses more than one worker guards its
work by ``if __name__ == '__main__':``.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, as_completed
import multiprocessing
import os
from typing import Any, Protocol, Self, TypeVar

from t3mpc_ros.evaluation.baselines.feed_forward import FeedForward, FeedForwardParameters
from t3mpc_ros.evaluation.cases import NOMINAL, PLANTS
from t3mpc_ros.evaluation.loop import Method, run
from t3mpc_ros.evaluation.method import MethodSpec
from t3mpc_ros.evaluation.reporting import progress_bar
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.stop_signal import end_with_parent

T = TypeVar('T')


class Named(Protocol):
    """What a job is done with."""

    @property
    def name(self) -> str:
        """Name in tables and errors."""
        ...


J = TypeVar('J', bound=tuple[Any, Named])
Job = tuple[Scenario, Method]


class JobError(RuntimeError):
    """A run that failed; the text names method and scenario."""


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
                self._workers, multiprocessing.get_context('spawn'), _start_worker, (os.getpid(),)
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None and self._pool is not self._workers:
            self._pool.shutdown(cancel_futures=True)
        self._pool = None

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
                try:
                    begun[self._pool.submit(task, job)] = index, job
                except BrokenExecutor as error:  # a process was lost meanwhile
                    raise _job_error(job, error) from error
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
    *,
    progress: bool = False,
) -> list[T]:
    """Return ``task`` of every job in their order; ``workers`` as for :class:`WorkerPool`."""
    found: dict[int, T] = {}
    with WorkerPool(workers) as pool, progress_bar(len(jobs), show=progress) as bar:
        for index, result in pool.map(task, jobs):
            found[index] = result
            bar.update()
    return [found[index] for index in range(len(jobs))]


def _job_error(job: tuple[Any, Named], error: BaseException) -> JobError:
    scenario, method = job
    return JobError(f'{method.name} on {scenario} failed: {error!r}')


def _start_worker(parent: int) -> None:
    """Prepare a worker process, which ends with its parent, also if that is killed."""
    end_with_parent(parent)
    warm_up()


def warm_up() -> None:
    """Load, or compile, every kernel of the loop itself, in both drives."""
    for robot in PLANTS:
        scenario = Scenario(robot, NOMINAL, 1, 0.05)
        run(scenario, MethodSpec('warm up', FeedForward, FeedForwardParameters()))
