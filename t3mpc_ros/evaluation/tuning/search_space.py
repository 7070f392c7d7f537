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
r"""Tunable methods: their initial parameters and the search ranges as a unit cube.

A search works in the unit cube. A parameter x in [a, b] and its coordinate p in [0, 1] are

.. math:: x = a\,(b/a)^p \quad\text{(logarithmic)}, \qquad x = a + p\,(b - a) \quad\text{(linear)}

so that equal steps are equal factors for gains and weights, whose order of magnitude is unknown.
An integer has an interval of equal length around each value: a and b are extended by one half.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np

from t3mpc_ros.evaluation.baselines.baseline_controller import BaselineController
from t3mpc_ros.evaluation.loop import Method, MethodSpec, NodeMethod
from t3mpc_ros.evaluation.scenario import PLANT_OF
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.parameters.table import ParameterError, Parameters, nearest_hint, short_name

Values = dict[str, int | float]
"""Tuned parameters by their dotted names."""


@dataclass(frozen=True, slots=True)
class SearchRange:
    """Where one parameter is searched: bounds, both included, in the unit of the parameter.

    With ``log`` equal steps are equal factors; ``low`` must then be above 0.
    """

    name: str
    low: float
    high: float
    log: bool = True


class SearchSpace:
    """The tuned parameters of one table, as the unit cube; coordinates are in order of ``ranges``.

    ParameterError: a name that the table does not have, or has no number for; a range that is
    empty, or goes beyond the parameter's own bounds.
    """

    def __init__(self, table: type[Parameters], ranges: Sequence[SearchRange]) -> None:
        specs = {spec.name: spec for spec in table.specs()}
        self.ranges = tuple(ranges)
        for each in self.ranges:
            if each.name not in specs:
                hint = nearest_hint(each.name, specs)
                raise ParameterError(f'{table.__name__} has no parameter {each.name}{hint}')
            spec = specs[each.name]
            if spec.many or spec.kind not in (int, float):
                raise ParameterError(f'{each.name} cannot be tuned: it must be one number')
            if not each.low < each.high or (each.log and each.low <= 0.0):
                raise ParameterError(f'{each.name} cannot be tuned: its range is {each}')
            for bound in (each.low, each.high):
                spec.check(spec.kind(bound))
        self._whole = [specs[each.name].kind is int for each in self.ranges]
        self._ends: list[tuple[float, float]] = []
        """What p = 0 and p = 1 stand for, before exp where the range is logarithmic."""
        for each, whole in zip(self.ranges, self._whole, strict=True):
            low, high = (each.low - 0.5, each.high + 0.5) if whole else (each.low, each.high)
            ends = (math.log(low), math.log(high)) if each.log else (float(low), float(high))
            self._ends.append(ends)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tuned parameters, in the order of the coordinates."""
        return tuple(each.name for each in self.ranges)

    def values(self, point: Array) -> Values:
        """Return the parameters at a point of the unit cube, exactly within their ranges."""
        result: Values = {}
        for each, whole, (low, high), p in zip(
            self.ranges, self._whole, self._ends, point.tolist(), strict=True
        ):
            x = low + p * (high - low)
            if each.log:
                x = math.exp(x)
            # Rounding may leave the last digit of an end outside.
            x = min(max(x, each.low), each.high)
            result[each.name] = round(x) if whole else x
        return result

    def of(self, parameters: Parameters) -> Values:
        """Return the tuned parameters of a table as they are."""
        values = parameters.to_dict()
        return {name: values[name] for name in self.names}  # type: ignore[misc]

    def point(self, parameters: Parameters) -> Array:
        """Return the point of the unit cube of a table, which must lie in the ranges, (n,)."""
        values = self.of(parameters)
        result = np.empty(len(self.ranges))
        for i, (each, (low, high)) in enumerate(zip(self.ranges, self._ends, strict=True)):
            x = values[each.name]
            if not each.low <= x <= each.high:
                raise ParameterError(
                    f'{each.name} must be in its range from {each.low:g} to {each.high:g}: '
                    f'got {x:g}'
                )
            result[i] = ((math.log(x) if each.log else x) - low) / (high - low)
        return np.clip(result, 0.0, 1.0)


@dataclass(frozen=True)
class MethodDefinition:
    """One line of the table of methods."""

    name: str
    """As it stands in tables and figures, for example ``'linear MPC'``."""
    controller_type: type[BaselineController]
    start: Mapping[str, Parameters]
    """By drive, or the twin, the parameters that its maker would choose: tuning begins there."""
    ranges: tuple[SearchRange, ...]
    """What is tuned, in either drive. All else stays as in ``start``."""
    table: type[Parameters] | None = None
    """Table of the controller of the node, whose method this is then."""

    def __post_init__(self) -> None:
        for drive, parameters in self.start.items():
            try:
                self.space.point(parameters)
            except ParameterError as error:
                raise ParameterError(f'{self.name}, {drive}: {error}') from error

    @property
    def space(self) -> SearchSpace:
        """What is searched."""
        return SearchSpace(self.table or self.controller_type.parameters_type, self.ranges)

    def compared(self, parameters: Parameters, drive: str) -> Method:
        """Return the method with parameters; on the paper's plant after its pre-training."""
        if self.table is None:
            trained = drive in PLANT_OF
            return MethodSpec(self.name, self.controller_type, parameters, pretrained=trained)
        values = parameters.to_dict()
        return NodeMethod(self.name, {name: values[name] for name in self.space.names})

    @property
    def short(self) -> str:
        """The name for command lines and files."""
        return short_name(self.name)
