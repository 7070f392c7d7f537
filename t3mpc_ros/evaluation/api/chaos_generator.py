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
from t3mpc_ros.chaos.system import QuadraticSystem, hyperchaotic_system
from t3mpc_ros.evaluation.api.references import numbers
from t3mpc_ros.evaluation.api.script_error import ScriptError, one_sentence
from t3mpc_ros.evaluation.api.table_files import write_csv
from t3mpc_ros.geometry.types import Array, read_only


@dataclass(frozen=True, eq=False)
class ChaosSolution:
    """Solution of a fractional-order system."""

    t: Array
    """Times, s, shape (n,)."""
    y: Array
    """States, shape (n, d)."""
    system: QuadraticSystem
    """What was solved."""

    @one_sentence
    def plot(self, path: str | os.PathLike[str] | None = None, *, plane: bool = False) -> Any:
        """Return a Matplotlib figure; write it to ``path`` (.png) if one is given.

        Each state over time, or with ``plane`` the second state over the first.
        """
        from t3mpc_ros.evaluation.api.figures import drawn, lines_figure, plane_figure

        names = [f'y{i + 1}' for i in range(self.system.size)]
        if plane and len(names) > 1:
            return drawn(
                lambda: plane_figure(self.y[:, 0], self.y[:, 1], (names[0], names[1])), path
            )
        lines = {name: self.y[:, i] for i, name in enumerate(names)}
        return drawn(lambda: lines_figure(self.t, lines), path)

    @one_sentence
    def to_csv(self, path: str | os.PathLike[str]) -> Path:
        """Write time and states as CSV and return the path."""
        states = {f'y{i + 1}': self.y[:, i] for i in range(self.system.size)}
        return write_csv(path, {'t': self.t, **states})


@one_sentence
def chaos(
    alpha: float | Sequence[float] = 0.98,
    *,
    tspan: tuple[float, float] = (0.0, 60.0),
    dt: float = 0.001,
    y0: ArrayLike | None = None,
    every: int = 10,
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
        Step of the solver, s.
    y0
        State at the first time, shape (d,); by default that of the reference generator, and ones
        for another system.
    every
        Steps between two rows of the result.
    system
        Another system with quadratic terms, which has its own orders.

    Raises
    ------
    ScriptError
        An argument is out of range, or the solution is not finite.
    """
    try:
        begin, end = (float(time) for time in tspan)
    except (TypeError, ValueError):
        raise ScriptError(f'tspan must be two times in s: got {tspan!r}') from None
    if not (math.isfinite(begin) and begin < end < math.inf):
        raise ScriptError(f'tspan must ascend: got {tspan!r}')
    if not (isinstance(dt, int | float) and 0.0 < dt <= end - begin):
        raise ScriptError(f'dt must be above 0 s and at most the span: got {dt!r}')
    if isinstance(every, bool) or not (isinstance(every, int) and every >= 1):
        raise ScriptError(f'every must be a whole number, at least 1: got {every!r}')
    if system is None:
        orders = numbers('alpha', alpha, '() or (4,)')
        if orders.shape not in ((), (1,), (4,)):
            raise ScriptError(f'alpha must be one order or four: got {orders.tolist()}')
        chosen = hyperchaotic_system(orders=tuple(np.broadcast_to(orders, 4).tolist()))
        start = np.array(ReferenceParameters().initial)
    else:
        chosen, start = system, np.ones(system.size)
    initial = start if y0 is None else numbers('y0', y0, f'({chosen.size},)')
    solver = FractionalSolver(chosen, dt, initial)
    count = round((end - begin) / (dt * every))
    states = np.empty((count + 1, chosen.size))
    states[0] = solver.state
    for k in range(1, count + 1):
        states[k] = solver.advance(every)
    times: Array = begin + dt * every * np.arange(count + 1, dtype=np.float64)
    return ChaosSolution(read_only(times), read_only(states), chosen)
