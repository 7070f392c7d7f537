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
"""The fuzzy system alone: ``fuzzy``."""

from collections.abc import Mapping, Sequence
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from t3mpc_ros.evaluation.api.one_sentence_errors import one_sentence
from t3mpc_ros.evaluation.api.own_reference import numbers
from t3mpc_ros.fuzzy.inference import FuzzyParameters, FuzzyTables, build_sets, evaluate_basis
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.script_error import ScriptError


class FuzzySystem:
    """A fuzzy system with one output; the rules are all combinations of the sets of its inputs.

    ``y = coefficients · basis(inputs)``, equations (16)-(33) with E7 and E8. The inputs of the
    package are wheel speeds; here they have any unit.

    Parameters
    ----------
    inputs
        Names of the inputs.
    parameters
        Kind and number of the sets.
    """

    def __init__(self, inputs: Sequence[str], parameters: FuzzyParameters) -> None:
        self.inputs = tuple(inputs)
        """Names of the inputs."""
        self.parameters = parameters
        """Kind, number and place of the sets."""
        self.sets = build_sets(parameters, len(self.inputs))
        """Tables of the sets; centres have the shape (inputs, sets)."""
        self._tables = FuzzyTables.of(self.sets, 1)
        self.coefficients: Array = self._tables.coefficients[0]
        """Coefficients of the output, shape (2 · rules · slices,), zeros at first."""

    @property
    def rules(self) -> int:
        """Number of rules."""
        return self.sets.rules

    @one_sentence
    def add_rule(self, antecedent: Sequence[tuple[str, int]], consequent: float) -> None:
        """Set the consequent of the rules that hold ``antecedent``: (input, set from 0) pairs.

        An input that is not named may be in any of its sets.
        """
        count = self.parameters.sets
        chosen: list[Any] = [slice(None)] * len(self.inputs)
        for name, index in antecedent:
            if name not in self.inputs:
                raise ScriptError(f'input must be one of {", ".join(self.inputs)}: got {name!r}')
            if isinstance(index, bool) or not (isinstance(index, int) and 0 <= index < count):
                raise ScriptError(f'set must be from 0 to {count - 1}: got {index!r}')
            chosen[self.inputs.index(name)] = index
        # (32): all lower levels come first, and the set of the last input changes fastest.
        by_rule = self.coefficients.reshape(2, *(count,) * len(self.inputs), -1)
        by_rule[:, *chosen] = float(numbers('consequent', consequent, '()'))

    @one_sentence
    def basis(self, inputs: Any) -> Array:
        """Return the basis at a mapping of names to numbers, at an array, or at each of its rows.

        The entries of each add up to one.
        """
        points = self._points(inputs)
        found = np.empty((len(points), self.sets.size))
        for k, point in enumerate(points):
            evaluate_basis(point, self._tables)
            found[k] = self._tables.phi
        return found if not isinstance(inputs, Mapping) and np.ndim(inputs) == 2 else found[0]

    @one_sentence
    def evaluate(self, inputs: Any) -> Any:
        """Return the output: a number for a mapping or one array, shape (n,) for rows."""
        found = self.basis(inputs) @ self.coefficients
        return float(found) if np.ndim(found) == 0 else found

    @one_sentence
    def fit(self, inputs: ArrayLike, outputs: ArrayLike, *, ridge: float = 1e-6) -> 'FuzzySystem':
        """Fit the coefficients to samples by least squares, and return the system itself.

        Parameters
        ----------
        inputs, outputs
            Shapes (n, inputs) and (n,).
        ridge
            Weight of the squared coefficients, which determines those that no sample does.
        """
        if not (isinstance(ridge, int | float) and 0.0 <= ridge < math.inf):
            raise ScriptError(f'ridge must be at least 0: got {ridge!r}')
        points = self._points(inputs)
        wanted = numbers('outputs', outputs, '(n,)')
        if wanted.shape != (len(points),):
            raise ScriptError(
                f'outputs must have the shape ({len(points)},), one for each row of inputs: got '
                f'{wanted.shape}'
            )
        phi = self.basis(points).reshape(len(points), -1)
        # By the matrix of the samples: there are often fewer of them than coefficients.
        gram = phi @ phi.T + ridge * np.eye(len(points))
        self.coefficients[:] = phi.T @ np.linalg.solve(gram, wanted)
        return self

    def _points(self, inputs: Any) -> Array:
        count = len(self.inputs)
        if isinstance(inputs, Mapping):
            if {*inputs} != {*self.inputs}:
                raise ScriptError(
                    f'inputs must be {", ".join(self.inputs)}: got {", ".join(map(str, inputs))}'
                )
            inputs = [inputs[name] for name in self.inputs]
        found = numbers('inputs', inputs, f'({count},) or (n, {count})')
        if found.ndim not in (1, 2) or found.shape[-1] != count:
            raise ScriptError(
                f'inputs must have the shape ({count},) or (n, {count}): got {found.shape}'
            )
        return np.ascontiguousarray(found.reshape(-1, count))


@one_sentence
def fuzzy(
    *inputs: str,
    kind: str = 'type3',
    sets: int = 7,
    centres: tuple[float, float] = (-1.0, 1.0),
    spread: float = 0.6,
    slices: int = 4,
    input_fuzziness: float = 0.0,
) -> FuzzySystem:
    """Return a fuzzy system of type 3, interval type 2 or type 1 with Gaussian sets.

    Parameters
    ----------
    *inputs
        Names of the inputs; by default one, ``x``.
    kind
        ``'type3'``, ``'interval_type2'`` or ``'type1'``.
    sets
        Sets of each input, evenly spaced.
    centres
        Centre of the first and of the last set.
    spread
        Width σ of the sets over the distance of their centres; the grade at x of a set with
        centre o is exp(-((x - o)/σ)²), so σ is √2 times a standard deviation.
    slices
        Slices of type-3 sets.
    input_fuzziness
        Width of the Gaussian that stands for an uncertain input, √2 times its standard deviation;
        0: the input is a number.

    Raises
    ------
    ScriptError
        An argument is out of range.
    """
    names = inputs or ('x',)
    if not all(isinstance(name, str) for name in names) or len({*names}) < len(names):
        raise ScriptError(f'inputs must be names, each once: got {str(list(names))[1:-1]}')
    try:
        low, high = (float(centre) for centre in centres)
    except (TypeError, ValueError):
        raise ScriptError(f'centres must be two numbers: got {centres!r}') from None
    parameters = FuzzyParameters.from_dict(
        {
            'kind': kind,
            'sets': sets,
            'centre_low': low,
            'centre_high': high,
            'centre_exponent': 1.0,
            'spread': spread,
            'slices': slices,
            'input_fuzziness': input_fuzziness,
        }
    )
    return FuzzySystem(names, parameters)
