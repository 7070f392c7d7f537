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
"""Controllers side by side over seeds and cases: ``compare`` and its result."""

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any

import numpy as np

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.evaluation import comparison
from t3mpc_ros.evaluation.api.one_sentence_errors import one_sentence
from t3mpc_ros.evaluation.api.own_robot import NoiseLaw
from t3mpc_ros.evaluation.api.result_tables import Columns, ShownAsTables, drawn, writable
from t3mpc_ros.evaluation.api.script_inputs import as_controllers, check_method, own_scenario
from t3mpc_ros.evaluation.cases import NOMINAL, LinkFaults
from t3mpc_ros.evaluation.confidence_intervals import Difference
from t3mpc_ros.evaluation.experiment import ResultTable, print_report
from t3mpc_ros.evaluation.result_output import Table, columns_of
from t3mpc_ros.evaluation.run_record import METRICS, SETTLED, Metric
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.parameters.table import find_names
from t3mpc_ros.parameters.version_and_commit import machine, provenance
from t3mpc_ros.script_error import ScriptError
from t3mpc_ros.simulation.fault_schedule import FaultSchedule


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(ShownAsTables):
    """Result of a comparison: the metrics of every run, and what is made of them."""

    plan: comparison.ComparisonPlan
    results: ResultTable
    """One row for each run: controller, case, seed and metrics by name."""

    @one_sentence
    def table(self, case: str | None = None) -> str:
        """Return the metrics of a case in Markdown: means over the seeds with 95 % intervals.

        Differences are paired by seed, with the verdict ``better``, ``worse`` or
        ``inconclusive``. An interval is that of its difference alone; the verdict is stricter, by
        Holm's correction for all comparisons of the table, so that at most one table in twenty has
        a wrong one: an interval that leaves zero out may be inconclusive. Without a case: of all
        of them, one below the other.
        """
        return '\n\n'.join(table.markdown() for table in self._tables(case))

    def _summary(self) -> str:
        plan, count = self.plan, len(self.results)
        names, cases = ', '.join(plan.methods), ', '.join(plan.cases)
        return f'{names}; {cases}; {len(plan.seeds)} seeds, {count} runs'

    def _columns(self) -> Columns:
        return columns_of(self.rows())

    def _tables(self, chosen: str | None = None) -> list[Table]:
        known = self.plan.cases
        cases = known if chosen is None else find_names('case', [chosen], known)
        return [comparison.case_table(self.plan, self.results, case) for case in cases]

    def _paper_columns(self, table: Table) -> Sequence[str]:
        heading = comparison.judged_metrics(table.title.partition(':')[0])[0].heading
        first = (f'{heading},', f'{heading} −')
        return [head for head in table.head if head.startswith(first) or head == 'verdict'][:3]

    @one_sentence
    def plot(self, path: str | os.PathLike[str] | None = None, *, case: str = '') -> Any:
        """Return a Matplotlib figure of every seed, and the mean, of the metric that decides.

        By default that of the first case; written to ``path``, a .png, .pdf or .svg, if given.
        """
        (chosen,) = find_names('case', [case or self.plan.cases[0]], self.plan.cases)
        return drawn(lambda _: comparison.draw_seeds(self.plan, self.results, chosen), path)

    @one_sentence
    def values(self, controller: Any, metric: str = SETTLED.name, case: str = '') -> list[float]:
        """Return a metric of a controller, one number for each seed."""
        chosen = self._chosen(controller, case)
        return self.results.values(find_metric(metric).name, **chosen)

    @one_sentence
    def difference(
        self, controller: Any, metric: str = SETTLED.name, case: str = ''
    ) -> Difference | None:
        """Return the paired difference of a metric from the first controller, with its interval.

        None for the first controller itself.
        """
        chosen = self._chosen(controller, case)
        of = chosen['case'], chosen['controller'], find_metric(metric)
        return comparison.difference(self.plan, self.results, *of)

    def _chosen(self, controller: Any, case: str) -> dict[str, str]:
        """Return the names of a controller, given as to :func:`compare`, and of a case."""
        (given,) = as_controllers([controller])
        (name,) = find_names('controller', [given.name], self.plan.methods)
        (chosen,) = find_names('case', [case or self.plan.cases[0]], self.plan.cases)
        return {'controller': name, 'case': chosen}

    def rows(self) -> list[dict[str, Any]]:
        """Return one row for each run: controller, case, seed, setting, metrics, provenance."""
        origin = provenance() | machine()
        return [row | origin for row in self.results]

    @one_sentence
    def to_html(self, path: str | os.PathLike[str]) -> Path:
        """Write tables and figures as one page and return the path."""
        target = writable(path, '.html')
        write_atomically(target, comparison.page(self.plan, self.results))
        return target


@one_sentence
def compare(
    controllers: Any,
    *,
    seeds: Iterable[int] = comparison.QUICK_SEEDS,
    cases: Sequence[str] = (NOMINAL,),
    reference: Any = None,
    plant: Any = 'twin',
    noise: float | NoiseLaw = 0.04,
    faults: LinkFaults | FaultSchedule | str | None = None,
    duration: float = 60.0,
    executor: Executor | int | None = None,
    progress: bool = False,
) -> Comparison:
    """Return the comparison of controllers, all on the same references, noise and disturbances.

    Differences are those from the first controller, paired by seed.

    Parameters
    ----------
    controllers
        One or more of what :func:`simulate` takes as a controller.
    seeds
        Whole numbers, such as ``range(201, 207)``; no default one was used to tune a controller of
        the package.
    cases
        Names of cases: what differs from the nominal robot.
    reference, plant, noise, faults, duration
        As for :func:`simulate`.
    executor
        None: a process for each processor; a number of processes, 1 for this one; or an
        :class:`concurrent.futures.Executor` or a Dask client.
    progress
        Whether a line on standard error shows progress and the time left.

    Raises
    ------
    ScriptError
        As for :func:`simulate`.
    """
    scenario = own_scenario(plant, reference, noise, faults, duration)
    plan = make_plan(controllers, seeds, cases, scenario)
    return Comparison(
        plan, comparison.run_plan(plan, executor, print_report if progress else None)
    )


def make_plan(
    controllers: Any, seeds: Iterable[int], cases: str | Sequence[str], scenario: Scenario
) -> comparison.ComparisonPlan:
    """Return what is compared with the first of some controllers."""
    methods = [each.method(scenario.robot) for each in as_controllers(controllers)]
    chosen = chosen_cases(cases, scenario)
    for method in methods:
        check_method(method, scenario, chosen)
    names = [method.name for method in methods]
    check_names(names)
    return comparison.ComparisonPlan(
        scenario,
        chosen,
        dict(zip(names, methods, strict=True)),
        checked_seeds(seeds),
        next(iter(names), ''),
    )


def check_names(names: Sequence[str]) -> None:
    """Raise :class:`ScriptError` if two controllers have one name: a table would mix them."""
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise ScriptError(
            f'controllers must have different names, see Controller(name=…): got {repeated[0]} '
            'more than once'
        )


def chosen_cases(cases: str | Sequence[str], scenario: Scenario) -> tuple[str, ...]:
    """Return the full names of one or more cases of a robot."""
    return find_names('case', [cases] if isinstance(cases, str) else cases, scenario.known_cases)


def checked_seeds(seeds: Any) -> tuple[int, ...]:
    """Return seeds as a tuple, or raise :class:`ScriptError`."""
    try:
        found = tuple(int(s) if isinstance(s, np.integer) else s for s in seeds)
    except TypeError:
        raise ScriptError(
            f'seeds must be a list of them, such as [1] or range(1, 6): got {seeds!r}'
        ) from None
    for seed in found:
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise ScriptError(f'seeds must be whole numbers of at least 0: got {seed!r}')
    if not found or len({*found}) < len(found):
        raise ScriptError(f'seeds must be one or more, each once: got {list(found)}')
    return found


def find_metric(name: str) -> Metric:
    """Return the metric of a name, or of the heading that it has in tables."""
    known = {metric.name: metric for metric in METRICS}
    headings = {metric.heading: metric for metric in METRICS}
    if name in headings:
        return headings[name]
    (found,) = find_names('metric', [name], known)
    return known[found]
