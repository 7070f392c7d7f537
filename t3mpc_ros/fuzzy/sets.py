# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Gaussian fuzzy sets of type 3, and of type 2 and 1 as special cases, as tables.

At each slice level a type-3 set is an interval type-2 set: one centre, two widths (Fig. 4). The
kinds of fuzzy system differ only in the numbers of these tables, and share one inference, so a
comparison of the kinds differs in nothing else.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.parameters.table import ParameterError, Parameters, parameter

Array = NDArray[np.float64]

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
        'with footprint_of_uncertainty',
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


@dataclass(frozen=True, eq=False)
class FuzzySets:
    """Tables of the inference, validated and read-only.

    n inputs, M sets per input, lambda slices. The rules are all M**n combinations; the set of the
    last input changes fastest.

    Raises
    ------
    ValueError
        A table has the wrong shape or a value out of range.
    """

    centres: Array
    """Centres o, shape (n, M), rad/s."""
    widths: Array
    """Widths beta, shape (n, M, lambda, 2, 2), rad/s; the last two axes are the level
    (lower, upper) and the bound (lower, upper width)."""
    levels: Array
    """Slice levels, shape (lambda, 2): lower and upper level of each slice, in (0, 1]. The paper
    has the lower one strictly below; when they are equal, the slice is one level."""
    input_fuzziness: float
    """beta_U, rad/s."""
    nonsingleton_gain: Array = field(init=False)
    """beta_U² / (beta² + beta_U²), the weight of the centre in (16)-(19); shape as widths."""
    sharpness: Array = field(init=False)
    """1/beta, s/rad, shape as widths."""
    shares: Array = field(init=False)
    """Levels over their sum, shape (lambda, 2). E8: the sum runs over lower *and* upper levels,
    so that the shares add up to one and the output lies in the hull of the coefficients."""

    def __post_init__(self) -> None:
        centres, widths, levels = (
            np.array(table, dtype=np.float64, order='C')
            for table in (self.centres, self.widths, self.levels)
        )
        fuzziness = float(self.input_fuzziness)
        _check_tables(centres, widths, levels, fuzziness)
        tables = {
            'centres': centres,
            'widths': widths,
            'levels': levels,
            'nonsingleton_gain': fuzziness**2 / (widths**2 + fuzziness**2),
            'sharpness': 1.0 / widths,
            'shares': levels / levels.sum(),
        }
        for name, table in tables.items():
            table.setflags(write=False)
            object.__setattr__(self, name, table)
        object.__setattr__(self, 'input_fuzziness', fuzziness)

    @property
    def inputs(self) -> int:
        """Number of inputs, n."""
        return int(self.centres.shape[0])

    @property
    def rules(self) -> int:
        """Number of rules, r = M**n."""
        return int(self.centres.shape[1] ** self.centres.shape[0])

    @property
    def slices(self) -> int:
        """Number of slices, lambda."""
        return int(self.levels.shape[0])

    @property
    def size(self) -> int:
        """Number of coefficients per output, 2 r lambda (32)."""
        return 2 * self.rules * self.slices


def _check_tables(centres: Array, widths: Array, levels: Array, fuzziness: float) -> None:
    if centres.ndim != 2 or centres.size == 0:
        raise ValueError(f'centres must have shape (inputs, sets): got {centres.shape}')
    if levels.ndim != 2 or levels.shape[0] == 0 or levels.shape[1] != 2:
        raise ValueError(f'levels must have shape (slices, 2): got {levels.shape}')
    shape = (*centres.shape, levels.shape[0], 2, 2)
    if widths.shape != shape:
        raise ValueError(f'widths must have shape {shape}: got {widths.shape}')
    if not np.isfinite(centres).all():
        raise ValueError(f'centres must be finite: got {centres.tolist()}')
    if not (np.isfinite(widths).all() and (widths > 0.0).all()):
        raise ValueError(f'widths must be positive and finite: got {widths.min():g} at least')
    excess = (widths[..., LOWER] - widths[..., UPPER]).max()
    if excess > 0.0:
        raise ValueError(f'widths must not be larger below than above: got {excess:g} rad/s more')
    low, high = levels[:, LOWER], levels[:, UPPER]
    if not ((low > 0.0) & (low <= high) & (high <= 1.0)).all():
        raise ValueError(f'levels must be 0 < lower <= upper <= 1: got {levels.tolist()}')
    if not (np.isfinite(fuzziness) and fuzziness >= 0.0):
        raise ValueError(f'input_fuzziness must be at least 0 rad/s: got {fuzziness}')
    inputs, sets = centres.shape
    _check_size(inputs, sets, levels.shape[0])


def _check_size(inputs: int, sets: int, slices: int) -> None:
    size = 2 * sets**inputs * slices
    if size > MAX_COEFFICIENTS:
        raise ValueError(
            f'inputs must give at most {MAX_COEFFICIENTS} coefficients: got {inputs} inputs '
            f'of {sets} sets with {slices} slices, {size} in total'
        )


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
    """Return the tables for ``inputs`` equal inputs.

    Raises
    ------
    ValueError
        There is no input, or there are too many combinations of sets.
    """
    if inputs < 1:
        raise ValueError(f'inputs must be at least 1: got {inputs}')
    if parameters.kind == 'type3':
        levels = slice_levels(parameters.slices)
    else:
        levels = np.ones((1, 2))  # one slice at level one: all secondary grades are one
    _check_size(inputs, parameters.sets, len(levels))
    each = np.stack([type3_widths(width, levels) for width in parameters.widths.tolist()])
    if parameters.kind == 'interval_type2':
        each = each * np.array(
            [1.0 - parameters.footprint_of_uncertainty, 1.0 + parameters.footprint_of_uncertainty]
        )
    return FuzzySets(
        centres=np.tile(parameters.centres, (inputs, 1)),
        widths=np.broadcast_to(each, (inputs, *each.shape)),
        levels=levels,
        input_fuzziness=parameters.input_fuzziness,
    )
