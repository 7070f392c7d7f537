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
"""Non-singleton type-3 fuzzy system: sets, and their inference (16)-(33) with E7 and E8.

At each slice level a type-3 set is an interval type-2 set: one centre, two widths (Fig. 4). Type 2
and type 1 are special cases, which differ only in the numbers of the tables, so a comparison of
the kinds differs in nothing else.

Arrays over sets have shape (n, M, lambda, 2, 2): input, set, slice, level, bound; arrays over
rules (r, lambda, 2, 2). On the last two axes 0 is lower and 1 is upper.
"""

from dataclasses import dataclass
import math
from typing import NamedTuple, Self

import numpy as np

from t3mpc_ros.geometry.types import Array
from t3mpc_ros.kernels import kernel
from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

LOWER, UPPER = 0, 1
"""Indices on the last two axes of the tables: lower and upper level, lower and upper width."""

MAX_COEFFICIENTS = 100_000
"""Maximum number of coefficients per output: M**n grows fast with the number of inputs n."""


@dataclass(frozen=True)
class FuzzyParameters(Parameters):
    """Fuzzy sets of the inputs, the same for every input."""

    kind: str = parameter(
        'type3',
        'type of the sets; type1 and interval_type2 are single slices at level one, the latter '
        'with a footprint of uncertainty',
        choices=('type3', 'interval_type2', 'type1'),
        source='paper: NT3FS, compared with the others',
    )
    sets: int = parameter(7, 'Gaussian sets per input, M', bounds=(1, 15))
    centre_low: float = parameter(-10.0, 'centre of the first set', 'rad/s', (-1000.0, 1000.0))
    centre_high: float = parameter(
        10.0,
        'centre of the last set; the others are evenly spaced between',
        'rad/s',
        (-1000.0, 1000.0),
    )
    centre_exponent: float = parameter(
        2.0,
        'exponent of the centre positions in [-1, 1]: above 1 the centres are denser in the '
        'middle, where Coulomb friction changes its sign; 1: evenly spaced',
        bounds=(0.2, 5.0),
    )
    spread: float = parameter(
        0.6,
        'width sigma of the sets as a fraction of the centre spacing, in exp(-((x - o)/sigma)²); '
        'at 0.6 adjacent sets cross at grade one half (the spacing of a single set is the range)',
        bounds=(0.05, 10.0),
    )
    slices: int = parameter(4, 'number of slices lambda of the type-3 sets', bounds=(1, 32))
    footprint_of_uncertainty: float = parameter(
        0.23,
        'interval_type2 only: widths are (1 - f) sigma and (1 + f) sigma; 0.23 is the mean of the '
        'type-3 default, weighted by level',
        bounds=(0.0, 0.95),
    )
    input_fuzziness: float = parameter(
        0.283,
        'fuzziness of the inputs beta_U, in exp(-((x - U)/beta_U)²): sqrt(2) times the standard '
        'deviation of the noise (0.2 rad/s); 0: singleton fuzzifier',
        'rad/s',
        (0.0, 100.0),
        source='paper: noise variance 0.04',
    )

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` unless the centres ascend."""
        if self.centre_high <= self.centre_low:
            raise ParameterError(
                f'centre_high must be above centre_low ({self.centre_low:g} rad/s): '
                f'got {self.centre_high:g}'
            )

    @property
    def centres(self) -> Array:
        """Centres o of the sets, ascending, rad/s, shape (M,)."""
        middle = 0.5 * (self.centre_low + self.centre_high)
        if self.sets == 1:
            return np.array([middle])
        places = np.linspace(-1.0, 1.0, self.sets)
        crowded = np.sign(places) * np.abs(places) ** self.centre_exponent
        return middle + 0.5 * (self.centre_high - self.centre_low) * crowded

    @property
    def widths(self) -> Array:
        """Widths sigma of the sets at level one, rad/s, shape (M,), from the local spacing."""
        if self.sets == 1:
            return np.array([self.spread * (self.centre_high - self.centre_low)])
        return self.spread * np.gradient(self.centres)


class FuzzySets(NamedTuple):
    """Tables of n inputs with M sets each and lambda slices; the rules are all combinations."""

    centres: Array  # o, shape (n, M), rad/s
    widths: Array  # beta, shape (n, M, lambda, 2, 2), rad/s
    levels: Array
    """Lower and upper level of each slice, in (0, 1], shape (lambda, 2). The paper has the lower
    one strictly below; when they are equal, the slice is one level."""
    input_fuzziness: float  # beta_U, rad/s

    @property
    def nonsingleton_gain(self) -> Array:
        """beta_U² / (beta² + beta_U²), the weight of the centre in (16)-(19); shape as widths."""
        gain: Array = self.input_fuzziness**2 / (self.widths**2 + self.input_fuzziness**2)
        return gain

    @property
    def shares(self) -> Array:
        """Levels over their sum, shape (lambda, 2).

        E8: the sum runs over lower *and* upper levels, so that the shares add up to one and the
        output lies in the hull of the coefficients.
        """
        shares: Array = self.levels / self.levels.sum()
        return shares

    @property
    def rules(self) -> int:
        """Number of rules, r = M**n."""
        return int(self.centres.shape[1] ** self.centres.shape[0])

    @property
    def slices(self) -> int:
        """Number of slices, lambda."""
        return len(self.levels)

    @property
    def size(self) -> int:
        """Number of coefficients per output, 2 r lambda (32)."""
        return 2 * self.rules * self.slices


def slice_levels(slices: int) -> Array:
    """Return the lower and upper level of each slice, shape (slices, 2).

    Lower and upper levels are evenly spaced and alternate: with four slices the lower levels are
    1/8, 3/8, 5/8, 7/8 and the upper ones 2/8, 4/8, 6/8, 8/8.
    """
    return np.arange(1, 2 * slices + 1, dtype=np.float64).reshape(slices, 2) / (2 * slices)


def type3_widths(width: float, levels: Array) -> Array:
    r"""Return the widths of a type-3 Gaussian at each level, rad/s, shape (slices, 2, 2).

    .. math:: \bar\beta(\varsigma) = \sigma\varsigma^{-1/2}, \qquad
              \underline\beta(\varsigma) = \sigma\varsigma^{+1/2}

    The grade exp(-((x - o)/sigma)²) to the power of the level is a Gaussian of the first width, to
    the inverse of the level one of the second. At level one both are sigma, which is type-1; the
    footprint increases as the level decreases.
    """
    root = np.sqrt(levels)
    return np.stack([width * root, width / root], axis=-1)


def build_sets(parameters: FuzzyParameters, inputs: int = 2) -> FuzzySets:
    """Return the tables for ``inputs`` equal inputs."""
    if inputs < 1:
        raise ValueError(f'inputs must be at least 1: got {inputs}')
    if parameters.kind == 'type3':
        levels = slice_levels(parameters.slices)
    else:
        levels = np.ones((1, 2))  # one slice at level one: all secondary grades are one
    size = 2 * parameters.sets**inputs * len(levels)
    if size > MAX_COEFFICIENTS:
        raise ValueError(
            f'inputs must give at most {MAX_COEFFICIENTS} coefficients: got {inputs} inputs '
            f'of {parameters.sets} sets with {len(levels)} slices, {size} in total'
        )
    each = np.stack([type3_widths(width, levels) for width in parameters.widths.tolist()])
    if parameters.kind == 'interval_type2':
        each = each * np.array(
            [1.0 - parameters.footprint_of_uncertainty, 1.0 + parameters.footprint_of_uncertainty]
        )
    return FuzzySets(
        centres=np.tile(parameters.centres, (inputs, 1)),
        widths=np.tile(each, (inputs, 1, 1, 1, 1)),
        levels=levels,
        input_fuzziness=parameters.input_fuzziness,
    )


class FuzzyTables(NamedTuple):
    """Sets, work space and coefficients of a fuzzy system, for kernels."""

    centres: Array  # tables of :class:`FuzzySets`, as the next three
    nonsingleton_gain: Array
    sharpness: Array
    shares: Array
    grades: Array  # work space, shape (n, M, lambda, 2, 2)
    firings: Array  # work space, shape (r, lambda, 2, 2)
    phi: Array  # basis Phi of the last evaluation, shape (2 r lambda,)
    coefficients: Array  # alpha, shape (m, 2 r lambda), rad/s²

    @classmethod
    def of(cls, sets: FuzzySets, outputs: int) -> Self:
        """Return the tables of fuzzy sets with zero coefficients."""
        return cls(
            sets.centres,
            sets.nonsingleton_gain,
            1.0 / sets.widths,
            sets.shares,
            np.zeros(sets.widths.shape),
            np.zeros((sets.rules, sets.slices, 2, 2)),
            np.zeros(sets.size),
            np.zeros((outputs, sets.size)),
        )


@kernel
def fuzzify(inputs: Array, centres: Array, nonsingleton_gain: Array, maxima: Array) -> None:
    r"""Write the maximum x* of the product of fuzzy input and set, equations (16)-(19).

    .. math:: x^* = \frac{U\beta^2 + o\beta_U^2}{\beta^2 + \beta_U^2}
                  = U + (o - U)\frac{\beta_U^2}{\beta^2 + \beta_U^2}

    The product is that of the input's Gaussian about U and the set's Gaussian about o. The second
    form is exactly U when the input is not fuzzy. With the upper width it is (16) at the upper
    level of a slice and (17) at the lower one, with the lower width (18) and (19).
    """
    for i in range(centres.shape[0]):
        # Above 1e9 rad/s the nearest rule has all of the weight, so the limit does not change the
        # result; it keeps squares finite for any finite input.
        value = min(max(inputs[i], -1e9), 1e9)
        for h in range(centres.shape[1]):
            offset = centres[i, h] - value
            for j in range(nonsingleton_gain.shape[2]):
                for level in range(2):
                    for bound in range(2):
                        maxima[i, h, j, level, bound] = (
                            value + offset * nonsingleton_gain[i, h, j, level, bound]
                        )


@kernel
def square_distances(maxima: Array, centres: Array, sharpness: Array, squares: Array) -> None:
    r"""Write the exponents :math:`((x^* - o)/\beta)^2` of the memberships (20)-(23) with E7.

    With the upper width these are the exponents of (20) at the upper level of a slice and of (21)
    at the lower one, with the lower width those of (22) and (23). ``squares`` may be ``maxima``.

    E7: the exponent of a Gaussian is squared; the printed one is linear, and grades exceed one on
    one side of the centre.
    """
    for i in range(centres.shape[0]):
        for h in range(centres.shape[1]):
            centre = centres[i, h]
            for j in range(maxima.shape[2]):
                for level in range(2):
                    for bound in range(2):
                        apart = maxima[i, h, j, level, bound] - centre
                        apart *= sharpness[i, h, j, level, bound]
                        squares[i, h, j, level, bound] = apart * apart


@kernel
def relative_memberships(squares: Array) -> None:
    """Replace exponents by grades whose products are firing strengths relative to the largest.

    (33) divides each firing strength by their sum over the rules, so a factor common to all rules
    of a slice and level cancels. Removing the largest one before the exponential makes it exactly
    one: the sum cannot underflow, however far the inputs are from all centres. The ratio of lower
    and upper bound is kept in the grades of the first input.
    """
    for j in range(squares.shape[2]):
        for level in range(2):
            lower = _subtract_nearest(squares, j, level, 0)
            upper = _subtract_nearest(squares, j, level, 1)
            # The difference first: rounding must not lose a small square beside a large sum.
            strongest = min(lower, upper)
            for h in range(squares.shape[1]):
                squares[0, h, j, level, 0] += lower - strongest
                squares[0, h, j, level, 1] += upper - strongest
    flat = squares.reshape(-1)
    for k in range(flat.size):
        flat[k] = math.exp(-flat[k])


@kernel
def _subtract_nearest(squares: Array, j: int, level: int, bound: int) -> float:
    """Subtract each input's smallest square; return the sum of the subtracted squares."""
    total = 0.0
    for i in range(squares.shape[0]):
        nearest = squares[i, 0, j, level, bound]
        for h in range(1, squares.shape[1]):
            nearest = min(nearest, squares[i, h, j, level, bound])
        for h in range(squares.shape[1]):
            squares[i, h, j, level, bound] -= nearest
        total += nearest
    return total


@kernel
def firing_strengths(grades: Array, firings: Array) -> None:
    r"""Write the firing strengths of the rules, :math:`\Omega^l = \prod_i \zeta_i`, (24)-(27).

    A rule (28) combines one set of each input; the last input's set changes fastest from rule to
    rule. Upper grades give (24) at the upper level of a slice and (25) at the lower one, lower
    grades (26) and (27).
    """
    inputs, sets = grades.shape[0], grades.shape[1]
    # Slices, levels and bounds are contiguous in memory and have the same computation.
    each = grades.reshape((inputs, sets, -1))
    products = firings.reshape((firings.shape[0], -1))
    products[0] = 1.0
    count = 1
    for i in range(inputs):
        # Each product is expanded into M products. In descending order none is overwritten before
        # its use, because the indices of its products are not below its own.
        for rule in range(count - 1, -1, -1):
            for h in range(sets - 1, -1, -1):
                for k in range(products.shape[1]):
                    products[rule * sets + h, k] = products[rule, k] * each[i, h, k]
        count *= sets


@kernel
def basis(firings: Array, shares: Array, phi: Array) -> None:
    r"""Write the basis, equation (33) with E8, in the order of (32).

    .. math:: \Phi = \frac{\varsigma_j}{\sum_j(\underline\varsigma_j + \bar\varsigma_j)}
                     \frac{\bar\Omega^l + \underline\Omega^l}
                          {\sum_l(\bar\Omega^l + \underline\Omega^l)}

    E8: with the printed factor 0.5 / (sum of upper levels) the basis adds up to less than one,
    which biases the output towards zero; with the sum of all levels it is a convex combination.
    The sums are over the rules, where the printed (33) repeats rule one. Lower levels come first:
    element l lambda + j is rule l, slice j; then the same for the upper levels.
    """
    rules, slices = firings.shape[0], firings.shape[1]
    block = rules * slices
    for j in range(slices):
        low = high = 0.0
        for rule in range(rules):
            low += firings[rule, j, 0, 0] + firings[rule, j, 0, 1]
            high += firings[rule, j, 1, 0] + firings[rule, j, 1, 1]
        low, high = shares[j, 0] / low, shares[j, 1] / high
        for rule in range(rules):
            place = rule * slices + j
            phi[place] = low * (firings[rule, j, 0, 0] + firings[rule, j, 0, 1])
            phi[block + place] = high * (firings[rule, j, 1, 0] + firings[rule, j, 1, 1])


@kernel
def evaluate_basis(inputs: Array, tables: FuzzyTables) -> None:
    """Write the basis Phi of finite inputs (rad/s) in one call: (16)-(27), (33) with E7 and E8.

    Exponentials are computed per input and set, not per rule. For any finite inputs the basis is
    not negative and adds up to one; ``grades`` and ``firings`` are relative to the largest.
    """
    fuzzify(inputs, tables.centres, tables.nonsingleton_gain, tables.grades)
    square_distances(tables.grades, tables.centres, tables.sharpness, tables.grades)
    relative_memberships(tables.grades)
    firing_strengths(tables.grades, tables.firings)
    basis(tables.firings, tables.shares, tables.phi)


@kernel
def combine(coefficients: Array, phi: Array, outputs: Array) -> None:
    r"""Write the outputs :math:`g = \alpha^T\Phi`, equation (31), rad/s²."""
    for z in range(outputs.size):
        total = 0.0
        for k in range(phi.size):
            total += coefficients[z, k] * phi[k]
        outputs[z] = total


def compute_basis(inputs: Array, sets: FuzzySets) -> Array:
    """Return the basis Phi of one input vector, shape (2 r lambda,), equation (33) with E8.

    For experiments and figures: it allocates memory, which a control step must not.
    """
    values = np.ascontiguousarray(inputs, dtype=np.float64)
    count = len(sets.centres)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f'inputs must be {count} finite numbers: got {inputs}')
    tables = FuzzyTables.of(sets, 1)
    evaluate_basis(values, tables)
    return tables.phi
