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
"""Means over seeds with Student's confidence intervals, paired differences, and their text."""

from collections.abc import Hashable, Mapping, Sequence
from functools import lru_cache
import math
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Values = Sequence[float] | NDArray[np.float64]
Key = TypeVar('Key', bound=Hashable)


class Difference(NamedTuple):
    """How much one method differs from another on the same seeds."""

    mean: float
    half: float
    """Half the width of the confidence interval of the mean."""

    @property
    def sign(self) -> int:
        """1 above zero, -1 below it, 0 where the interval leaves this open."""
        return (self.mean > self.half) - (self.mean < -self.half)

    def p_value(self, n: int) -> float:
        """Return the p-value of Student's test that the mean of ``n`` differences is zero.

        The interval is that of 95 %; 1 for fewer than two differences, or if it is not finite.
        """
        if n < 2 or not math.isfinite(self.mean + self.half):
            return 1.0
        if self.half == 0.0:
            return 1.0 if self.mean == 0.0 else 0.0
        t = abs(self.mean) / self.half * student_quantile(n - 1)
        return 1.0 - _within(math.atan(t / math.sqrt(n - 1)), n - 1)


def mean(values: Values) -> float:
    """Return the mean."""
    if len(values) == 0:
        raise ValueError('values must not be empty')
    return float(np.mean(values))


def rms(values: ArrayLike) -> float:
    """Return the root mean square of all numbers."""
    return float(np.sqrt(np.mean(np.square(values))))


def interval(values: Values, confidence: float = 0.95) -> float:
    """Return half the width of the confidence interval of the mean, by Student's t.

    It is infinite for fewer than two values: one value has no standard deviation.
    """
    n = len(values)
    if n < 2:
        return math.inf
    return float(student_quantile(n - 1, confidence) * np.std(values, ddof=1) / math.sqrt(n))


def paired(a: Values, b: Values) -> Difference:
    """Return how much larger ``a`` is than ``b``, value by value.

    What both have from a seed, an easy reference say, drops out of the difference. NaN, of a run
    that diverged, is larger than every number; where both diverged, the difference is NaN.
    """
    if len(a) != len(b):
        raise ValueError(f'paired values must be equally many: got {len(a)} and {len(b)}')
    first, second = (np.where(np.isnan(each), np.inf, each) for each in (a, b))
    with np.errstate(invalid='ignore'):
        differences = first - second
        return Difference(mean(differences), interval(differences))


def holm(p_values: Mapping[Key, float], level: float = 0.05) -> set[Key]:
    """Return which of several hypotheses are rejected, at most one in 1/level tables wrongly.

    The smallest of m p-values must be at most level/m, the next one level/(m - 1), and so on up to
    the first that is not (Holm 1979).
    """
    rejected: set[Key] = set()
    ordered = sorted(p_values.items(), key=lambda item: item[1])
    for rank, (key, p) in enumerate(ordered):
        if p > level / (len(ordered) - rank):
            break
        rejected.add(key)
    return rejected


def format_interval(middle: float, ci95: float, sign: str = '', digits: int = 3) -> str:
    """Return a mean ± half its 95 % interval; a single seed has no interval."""
    if not math.isfinite(middle):
        return 'diverged'
    text = f'{middle:{sign}.{digits}f}'
    return f'{text} ± {ci95:.{digits}f}' if math.isfinite(ci95) else text


@lru_cache(maxsize=1024)
def student_quantile(degrees: int, confidence: float = 0.95) -> float:
    r"""Return the t that Student's variable exceeds in size with probability 1 - confidence.

    With t = sqrt(n) tan(theta) the probability A of being within is a finite sum (Abramowitz and
    Stegun 1964, 26.7.3 and 26.7.4), and

    .. math:: \frac{dA}{d\theta} = \frac{2\,\Gamma((n + 1)/2)}{\sqrt{\pi}\,\Gamma(n/2)}
              \cos^{n-1}\theta

    falls with theta: A is concave, so Newton's steps from zero rise to the root and never
    pass it.
    """
    if degrees < 1:
        raise ValueError(f'degrees must be at least 1: got {degrees}')
    if not 0.0 < confidence < 1.0:
        raise ValueError(f'confidence must be above 0 and below 1: got {confidence}')
    log_slope = math.lgamma(0.5 * (degrees + 1)) - math.lgamma(0.5 * degrees)
    slope = 2.0 / math.sqrt(math.pi) * math.exp(log_slope)
    theta = 0.0
    while True:
        missing = confidence - _within(theta, degrees)
        change = missing / (slope * math.cos(theta) ** (degrees - 1))
        theta += change
        # Below rounding a step may go either way.
        if change <= 1e-15 * theta:
            return math.sqrt(degrees) * math.tan(theta)


def _within(theta: float, degrees: int) -> float:
    """Return A(t | n) for t = sqrt(n) tan(theta)."""
    square = math.cos(theta) ** 2
    odd = degrees % 2
    term = math.cos(theta) if odd else 1.0
    total = 0.0
    for order in range(1 + odd, degrees, 2):
        total += term
        term *= square * order / (order + 1)
    total *= math.sin(theta)
    return 2.0 / math.pi * (theta + total) if odd else total
