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
"""The chaotic generator alone: ``chaos``."""

from collections.abc import Sequence
from dataclasses import dataclass
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.chaos.solver import FractionalSolver
from t3mpc_ros.chaos.system_equations import QuadraticSystem, hyperchaotic_system
from t3mpc_ros.evaluation.api.one_sentence_errors import one_sentence
from t3mpc_ros.evaluation.api.own_reference import numbers
from t3mpc_ros.evaluation.api.result_tables import drawn, writable
from t3mpc_ros.evaluation.result_output import write_columns
from t3mpc_ros.geometry.types import Array, read_only
from t3mpc_ros.script_error import ScriptError

LONGEST_STEP, HALVINGS = 0.001, 7
"""Step that is halved until the solution does not depend on it, s, and how often."""
ROW = 0.01
"""Time between two rows, s."""
MIN_RTOL = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class ChaosSolution:
    """Solution of a fractional-order system."""

    t: Array
    """Times, s, shape (n,)."""
    y: Array
    """States, shape (n, d)."""
    system: QuadraticSystem
    """What was solved."""
    dt: float
    """Step of the solver, s."""

    def __repr__(self) -> str:
        end = f'{len(self.t)} rows to {self.t[-1]:g} s'
        return f'<{type(self).__name__}: {self.system.size} states, {end}, step {self.dt:g} s>'

    @one_sentence
    def plot(self, path: str | os.PathLike[str] | None = None, *, plane: bool = False) -> Any:
        """Return a Matplotlib figure; write it to ``path`` (.png, .pdf, .svg) if one is given.

        Each state over time, or with ``plane`` the second state over the first.
        """
        names = [f'y{i + 1}' for i in range(self.system.size)]
        if plane and len(names) > 1:
            return drawn(lambda figures: figures.plane_figure(*self.y.T[:2], names[:2]), path)
        lines = {name: self.y[:, i] for i, name in enumerate(names)}
        return drawn(lambda figures: figures.lines_figure(self.t, lines), path)

    @one_sentence
    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write time and states as CSV and return the path."""
        states = {f'y{i + 1}': self.y[:, i] for i in range(self.system.size)}
        target = writable(path, '.csv')
        write_columns(target, {'t': self.t, **states})
        return target


@one_sentence
def chaos(
    alpha: float | Sequence[float] = 0.98,
    *,
    tspan: tuple[float, float] = (0.0, 60.0),
    dt: float | None = None,
    y0: ArrayLike | None = None,
    every: int | None = None,
    rtol: float = 1e-3,
    system: QuadraticSystem | None = None,
) -> ChaosSolution:
    """Return the solution of the hyperchaotic system (85) with E6, or of another system.

    Caputo derivatives from ``tspan[0]`` on. The solver has constant cost and memory per step, see
    :mod:`t3mpc_ros.chaos.solver`.

    Parameters
    ----------
    alpha
        Order of the derivatives, in (0, 1]; one for all states, or one each.
    tspan
        First and last time, s.
    dt
        Step of the solver, s; None: it follows from ``rtol``. The generator of the reference has
        1 ms, with which the solution at 1 s is off by up to 3 %.
    y0
        State at the first time, shape (d,); by default that of the reference generator, and ones
        for another system.
    every
        Steps between two rows of the result; by default there is a row every 10 ms.
    rtol
        Without ``dt``: the longest step 1 ms / 2^k is taken with which half of it changes the
        states of the first second by at most this share of their largest one. Later errors of a
        chaotic system grow, whatever the step, by its largest Lyapunov exponent.
    system
        Another system with quadratic terms, which has its own orders.

    Raises
    ------
    ScriptError
        An argument is out of range, or the solution is not finite.
    """
    begin, end = _span(tspan)
    _check_steps(dt, every, rtol, end - begin)
    chosen, start = _system(alpha, system)
    initial = start if y0 is None else numbers('y0', y0, f'({chosen.size},)')
    if initial.shape != (chosen.size,):
        raise ScriptError(f'y0 must have the shape ({chosen.size},): got {initial.shape}')
    step = dt or _step_of(chosen, initial, end - begin, rtol)
    rows = every or max(1, round(ROW / step))
    states = _solve(chosen, initial, step, rows, end - begin)
    times: Array = begin + step * rows * np.arange(len(states), dtype=np.float64)
    return ChaosSolution(read_only(times), read_only(states), chosen, step)


def _span(tspan: tuple[float, float]) -> tuple[float, float]:
    """Return first and last time, s, or raise ScriptError."""
    try:
        begin, end = (float(time) for time in tspan)
    except (TypeError, ValueError):
        raise ScriptError(f'tspan must be two times in s: got {tspan!r}') from None
    if not (math.isfinite(begin) and begin < end < math.inf):
        raise ScriptError(f'tspan must ascend: got {tspan!r}')
    return begin, end


def _check_steps(dt: float | None, every: int | None, rtol: float, span: float) -> None:
    """Raise ScriptError for a step, a number of steps or a tolerance that is out of range."""
    known = isinstance(dt, int | float) and not isinstance(dt, bool)
    if dt is not None and not (known and 0.0 < dt <= span):
        raise ScriptError(f'dt must be above 0 s and at most the span: got {dt!r}')
    if every is not None and (isinstance(every, bool) or not isinstance(every, int) or every < 1):
        raise ScriptError(f'every must be a whole number, at least 1: got {every!r}')
    if not (isinstance(rtol, int | float) and MIN_RTOL <= rtol <= 1.0):
        raise ScriptError(f'rtol must be from {MIN_RTOL:g} to 1: got {rtol!r}')


def _system(
    alpha: float | Sequence[float], system: QuadraticSystem | None
) -> tuple[QuadraticSystem, Array]:
    """Return what is solved and its default initial state, or raise ScriptError."""
    if isinstance(system, QuadraticSystem):
        return system, np.ones(system.size)
    if system is not None:
        raise ScriptError(f'system must be a QuadraticSystem: got {system!r}')
    orders = numbers('alpha', alpha, '() or (4,)')
    if orders.shape not in ((), (1,), (4,)):
        raise ScriptError(f'alpha must be one order or four: got {orders.tolist()}')
    if not (np.all(orders > 0.0) and np.all(orders <= 1.0)):
        raise ScriptError(f'alpha must be above 0 and at most 1: got {alpha!r}')
    chosen = hyperchaotic_system(orders=tuple(np.broadcast_to(orders, 4).tolist()))
    return chosen, np.array(ReferenceParameters().initial)


def _solve(system: QuadraticSystem, initial: Array, dt: float, every: int, span: float) -> Array:
    solver = FractionalSolver(system, dt, initial)
    states = np.empty((round(span / (dt * every)) + 1, system.size))
    states[0] = solver.state
    for k in range(1, len(states)):
        states[k] = solver.advance(every)
    return states


def _step_of(system: QuadraticSystem, initial: Array, span: float, rtol: float) -> float:
    """Return the longest step with which the first second is within ``rtol`` of half the step."""
    first = min(span, 1.0)
    dt = min(LONGEST_STEP, first)
    every = max(1, round(min(ROW, first) / dt))
    coarse, change = _solve(system, initial, dt, every, first), math.inf
    for _ in range(HALVINGS):
        fine = _solve(system, initial, 0.5 * dt, 2 * every, first)
        change = float(np.max(np.abs(fine - coarse)) / max(np.max(np.abs(fine)), 1e-300))
        if change <= rtol:
            return dt
        dt, every, coarse = 0.5 * dt, 2 * every, fine
    raise ScriptError(
        f'rtol must be at least {change:.2g} for this system with steps of {dt:.2g} s: '
        f'got {rtol:g}'
    )
