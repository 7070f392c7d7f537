# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Inference of the non-singleton type-3 fuzzy system, equations (16)-(33) with E7 and E8.

Arrays over sets have shape (n, M, lambda, 2, 2): input, set, slice, level, bound; arrays over
rules (r, lambda, 2, 2). On the last two axes 0 is lower and 1 is upper, as in
:mod:`t3mpc_ros.fuzzy.sets`, which builds the tables.
"""

import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.fuzzy.sets import FuzzySets
from t3mpc_ros.kernels import kernel

Array = NDArray[np.float64]


class FuzzyTables(NamedTuple):
    """Sets, work space and coefficients of a fuzzy system, for kernels."""

    centres: Array
    """Tables of :class:`FuzzySets`, as the next three."""
    nonsingleton_gain: Array
    sharpness: Array
    shares: Array
    grades: Array
    """Work space, shape (n, M, lambda, 2, 2)."""
    firings: Array
    """Work space, shape (r, lambda, 2, 2)."""
    phi: Array
    """Basis Phi of the last evaluation, shape (2 r lambda,)."""
    coefficients: Array
    """alpha, shape (m, 2 r lambda), rad/s²."""

    @classmethod
    def of(cls, sets: FuzzySets, outputs: int) -> Self:
        """Return the tables of fuzzy sets with zero coefficients."""
        return cls(
            # Copies: an array that cannot be written to is another type for compiled functions.
            sets.centres.copy(),
            sets.nonsingleton_gain.copy(),
            sets.sharpness.copy(),
            sets.shares.copy(),
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

    inputs : shape (n,), U, rad/s
    centres : shape (n, M), o, rad/s
    nonsingleton_gain : shape (n, M, lambda, 2, 2), the last fraction
    maxima : shape as nonsingleton_gain, overwritten, x*, rad/s
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
    at the lower one, with the lower width those of (22) and (23).

    E7: the exponent of a Gaussian is squared; the printed one is linear, and grades exceed one on
    one side of the centre.

    maxima, sharpness : shape (n, M, lambda, 2, 2), x* (rad/s) and 1/beta (s/rad)
    centres : shape (n, M), rad/s
    squares : shape as maxima, overwritten; may be maxima itself
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

    squares : shape (n, M, lambda, 2, 2), exponents from :func:`square_distances`, overwritten
        with the relative grades
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

    A rule (28) combines one set of each input. Upper grades give (24) at the upper level of a
    slice and (25) at the lower one, lower grades (26) and (27).

    grades : shape (n, M, lambda, 2, 2)
    firings : shape (r, lambda, 2, 2) with r = M**n, overwritten; the last input's set changes
        fastest from rule to rule
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
    r"""Write the basis, equation (33) with E8.

    .. math:: \Phi = \frac{\varsigma_j}{\sum_j(\underline\varsigma_j + \bar\varsigma_j)}
                     \frac{\bar\Omega^l + \underline\Omega^l}
                          {\sum_l(\bar\Omega^l + \underline\Omega^l)}

    E8: with the printed factor 0.5 / (sum of upper levels) the basis adds up to less than one,
    which biases the output towards zero; with the sum of all levels it is a convex combination.
    The sums are over the rules, where the printed (33) repeats rule one.

    firings : shape (r, lambda, 2, 2), up to a factor common to the rules
    shares : shape (lambda, 2), levels over the sum of all levels
    phi : shape (2 r lambda,), overwritten, in the order of (32): lower levels first, element
        l lambda + j is rule l, slice j; then the same for the upper levels, (32)'s last block
        running to rule r
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
    """Write the basis Phi of the inputs in one call: (16)-(27), (33) with E7 and E8.

    Exponentials are computed per input and set, not per rule. For any finite inputs the basis is
    not negative and adds up to one; ``grades`` and ``firings`` are relative to the largest.

    inputs : shape (n,), U, rad/s, finite
    tables : work space and phi are overwritten
    """
    fuzzify(inputs, tables.centres, tables.nonsingleton_gain, tables.grades)
    square_distances(tables.grades, tables.centres, tables.sharpness, tables.grades)
    relative_memberships(tables.grades)
    firing_strengths(tables.grades, tables.firings)
    basis(tables.firings, tables.shares, tables.phi)


@kernel
def combine(coefficients: Array, phi: Array, outputs: Array) -> None:
    r"""Write the outputs :math:`g = \alpha^T\Phi`, equation (31).

    coefficients : shape (m, 2 r lambda), alpha, rad/s²
    phi : shape (2 r lambda,)
    outputs : shape (m,), overwritten, g, rad/s²
    """
    for z in range(outputs.size):
        total = 0.0
        for k in range(phi.size):
            total += coefficients[z, k] * phi[k]
        outputs[z] = total


def compute_basis(inputs: Array, sets: FuzzySets) -> Array:
    """Return the basis Phi of one input vector, shape (2 r lambda,), equation (33) with E8.

    For experiments and figures: it allocates memory, which a control step must not.

    Raises
    ------
    ValueError
        The inputs are not ``sets.inputs`` finite numbers.
    """
    values = np.ascontiguousarray(inputs, dtype=np.float64)
    if values.shape != (sets.inputs,) or not np.isfinite(values).all():
        raise ValueError(f'inputs must be {sets.inputs} finite numbers: got {inputs}')
    tables = FuzzyTables.of(sets, 1)
    evaluate_basis(values, tables)
    return tables.phi
