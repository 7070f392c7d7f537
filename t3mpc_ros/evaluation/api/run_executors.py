# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Where the runs of a script are computed: this process, a pool of processes, or a cluster."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
import multiprocessing
import os
import pickle
import sys
from typing import Any

from t3mpc_ros.evaluation.api.script_error import LOST_PROCESS, ScriptError
from t3mpc_ros.evaluation.experiment import Run


def workers_for(executor: Any, runs: Sequence[Run]) -> int | Executor:
    """Return who makes runs: a number of processes, or an executor.

    One run, and runs of an interactive session, which other processes cannot import, are made
    in this process unless an executor is given.

    Raises
    ------
    ScriptError
        It is no executor, or the runs cannot be sent to other processes.
    """
    if isinstance(executor, Executor):
        return executor
    if callable(make := getattr(executor, 'get_executor', None)):  # a Dask client
        found = make(pure=False)
        assert isinstance(found, Executor)
        return found
    if executor is not None and (isinstance(executor, bool) or not isinstance(executor, int)):
        raise ScriptError(
            'executor must be None, a number of processes, a concurrent.futures.Executor or a '
            f'Dask client: got {executor!r}'
        )
    if executor is not None and executor < 1:
        raise ScriptError(f'executor must be at least 1 process: got {executor}')
    if getattr(multiprocessing.process.current_process(), '_inheriting', False):
        # The program of a worker process runs this script again: it would start workers for ever.
        raise SystemExit(f'error: {LOST_PROCESS}')
    if executor == 1 or len(runs) < 2:
        return 1
    count = executor or len(os.sched_getaffinity(0))
    if executor is None and not hasattr(sys.modules['__main__'], '__file__'):
        return 1
    if count > 1:
        _check_picklable(runs[0].job)
    return min(count, len(runs))


@contextmanager
def cluster(address: str, timeout: float = 10.0) -> Iterator[Executor]:
    """Enter the executor of a Dask scheduler at an address, tcp://HOST:PORT.

    Raises
    ------
    ModuleNotFoundError
        dask.distributed is not installed.
    ScriptError
        No scheduler answers within ``timeout`` s.
    """
    import distributed

    try:
        client = distributed.Client(address, timeout=timeout)
    except (OSError, TimeoutError, ValueError) as error:
        raise ScriptError(
            f'no Dask scheduler answers at {address}; start one with "dask scheduler" and '
            f'workers with "dask worker ADDRESS": {error}'
        ) from None
    with client:
        found = client.get_executor(pure=False)
        assert isinstance(found, Executor)
        yield found


def _check_picklable(job: Any) -> None:
    try:
        pickle.dumps(job)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ScriptError(
            'controller, plant and noise must be defined at the top level of a file to be sent to '
            f'other processes; use executor=1 to stay in this one: got {error}'
        ) from None
