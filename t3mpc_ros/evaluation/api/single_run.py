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
"""One simulated run of a controller: ``simulate`` and its result."""

from collections.abc import Mapping
from dataclasses import dataclass
import os
from typing import Any

import numpy as np

from t3mpc_ros.evaluation.api.one_sentence_errors import one_sentence
from t3mpc_ros.evaluation.api.own_robot import NoiseLaw
from t3mpc_ros.evaluation.api.result_tables import Columns, ShownAsTables, drawn
from t3mpc_ros.evaluation.api.script_inputs import as_controllers, own_scenario
from t3mpc_ros.evaluation.cases import NOMINAL, LinkFaults
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.loop import run
from t3mpc_ros.evaluation.result_output import Table
from t3mpc_ros.evaluation.run_record import METRICS, START, Numbers, Record, measure, some_rows
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import find_names, nearest_hint
from t3mpc_ros.script_error import ScriptError
from t3mpc_ros.simulation.fault_schedule import FaultSchedule

DIVERGED = 'diverged'


@dataclass(frozen=True, eq=False, repr=False)
class RunResult(ShownAsTables):
    """Result of one run.

    ``columns`` holds one array per name, a row for each control period: ``time`` (s);
    ``reference``, ``measured`` and ``speed`` (the true one) of each wheel, as in
    ``reference_right``, rad/s; ``command`` of each wheel: wheel speeds (rad/s) sent to the robot,
    or torques (N m) with a torque drive; on the twin also the true pose ``x``, ``y`` (m) and
    ``yaw`` (rad). The arrays cannot be written: ``run['time'].copy()`` can.
    """

    controller: str
    """Name of the controller."""
    scenario: Scenario
    record: Record
    """Everything that was recorded."""
    columns: Mapping[str, Array]
    metrics: Numbers
    """Numbers of the run by name: those of the comparison, with their units in :meth:`table`."""

    def __getitem__(self, name: str) -> Array:
        """Return a column."""
        if name not in self.columns:
            known = ', '.join(self.columns)
            hint = nearest_hint(str(name), self.columns)
            raise ScriptError(f'column must be one of {known}: got {name!r}{hint}')
        return self.columns[name]

    @property
    def error(self) -> Array:
        """True wheel speeds less the reference, rad/s, shape (n, 2)."""
        return self.record.error

    @one_sentence
    def rmse(self, after: float = START) -> float:
        """Return the RMSE of the true wheel speeds (rad/s), ``after`` s from the start on.

        On the twin the time counts from the end of its standstill of 1.5 s.
        """
        length = float(self.columns['time'][-1]) - self.record.start
        if not 0.0 <= after <= length:
            raise ScriptError(f'after must be from 0 to {length:g} s: got {after:g}')
        begin = after + self.record.start
        return rms(self.error[some_rows(self.columns['time'], np.zeros(0), begin)])

    def table(self) -> str:
        """Return the metrics as a Markdown table."""
        return str(self)

    def _summary(self) -> str:
        settled = self.metrics['settled']
        return f'{self.controller}: {self.scenario}, settled RMSE {settled:.4f} rad/s'

    def _columns(self) -> Columns:
        return self.columns

    def _details(self) -> Mapping[str, str]:
        return {'controller': self.controller, 'scenario': str(self.scenario)}

    def _tables(self, chosen: str | None = None) -> list[Table]:
        known = [metric for metric in METRICS if metric.name in self.metrics]
        if chosen is not None:
            names = find_names('metric', [chosen], [metric.name for metric in known])
            known = [metric for metric in known if metric.name in names]
        rows = [
            (metric.heading, f'{self.metrics[metric.name]:.{metric.digits}f}', metric.unit)
            for metric in known
        ]
        return [Table(f'{self.controller}: {self.scenario}', ('metric', 'value', 'unit'), rows)]

    @one_sentence
    def plot(self, path: str | os.PathLike[str] | None = None) -> Any:
        """Return a Matplotlib figure of speeds and error, which a notebook shows.

        It is written to ``path``, a .png, .pdf or .svg, if one is given.
        """
        return drawn(lambda figures: figures.run_figure(self.controller, self.columns), path)


@one_sentence
def simulate(
    controller: Any = 'full',
    *,
    reference: Any = None,
    plant: Any = 'twin',
    noise: float | NoiseLaw = 0.04,
    faults: LinkFaults | FaultSchedule | str | None = None,
    case: str = NOMINAL,
    seed: int = 1,
    duration: float = 60.0,
) -> RunResult:
    """Return the result of one run of a controller in closed loop.

    Equal arguments give equal results, to the last bit.

    Parameters
    ----------
    controller
        A name of the package, such as ``'full'`` or ``'PI + feed-forward'``; a class with
        ``step(observation)``; a function of the observation; or a :class:`Controller`.
    reference
        None: the chaotic reference of the seed. Wheel speeds (rad/s), right first, 100 rows a
        second, shape (n, 2); a function of the time (s) that returns two of them; a CSV file with
        the columns time,right,left or time,linear,angular; or :class:`Waypoints`. Array and file
        last at least as long as the run.
    plant
        ``'twin'``, ``'servo'``, ``'torque'``; a :class:`Robot`, :class:`OdePlant` or
        :class:`StateSpace`.
    noise
        Variance of the measured wheel speeds, (rad/s)², or a :class:`NoiseLaw`.
    faults
        :class:`LinkFaults`; on the twin also a :class:`FaultSchedule`, the name of a bundled one,
        or a YAML file.
    case
        Name of a case of the comparison: what differs from the nominal robot.
    seed
        Of reference, disturbance and noise.
    duration
        s

    Raises
    ------
    ScriptError
        Wrong use, or a controller or plant that failed; the text says what and where.
    """
    scenario = own_scenario(plant, reference, noise, faults, duration, case=case, seed=seed)
    (given,) = as_controllers([controller])
    method = given.method(scenario.robot)
    record = run(scenario, method)
    if text := divergence(record):
        raise ScriptError(f'the run of {method.name} {text}')
    for values in record.columns.values():
        values.flags.writeable = False
    return RunResult(method.name, scenario, record, _columns(record), measure(record))


def divergence(record: Record) -> str:
    """Return when a run diverged, and from where; '' if it did not."""
    if record.finite:
        return ''
    k = int(np.argmax(~np.isfinite(record.speeds).all(axis=1)))
    last = record.speeds[max(k - 1, 0)]
    return (
        f'{DIVERGED} at {record.time[k]:.2f} s: the wheel speeds before were {last[0]:.4g} '
        f'and {last[1]:.4g} rad/s'
    )


def _columns(record: Record) -> dict[str, Array]:
    found = {'time': record.time}
    for name in ('reference', 'measured', 'speed', 'command'):
        values = record[{'speed': 'speeds', 'command': 'sent'}.get(name, name)]
        found |= {f'{name}_right': values[:, 0], f'{name}_left': values[:, 1]}
    if 'truth' in record.columns:
        found |= {name: record['truth'][:, i] for i, name in enumerate(('x', 'y', 'yaw'))}
    return found
