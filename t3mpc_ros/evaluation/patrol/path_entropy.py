# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Permutation entropy and spectral entropy of a series."""

import math

import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.evaluation.patrol.coverage import normalised_entropy

Array = NDArray[np.float64]


def ordinal_shares(series: Array, order: int, delay: int = 1) -> Array:
    """Return how often each order of size of ``order`` values occurs, shape (order!,).

    Of equal values the earlier one counts as the smaller. The patterns are in the lexicographic
    order of the ranks.
    """
    span = (order - 1) * delay
    if not 2 <= order <= 8 or delay < 1:
        raise ValueError(f'order must be 2 to 8 and delay >= 1: got {order}, {delay}')
    if series.ndim != 1 or series.size <= span:
        raise ValueError(f'series must have more than {span} values: got {series.shape}')
    windows = np.stack([series[k * delay : series.size - span + k * delay] for k in range(order)])
    ranks = windows.argsort(axis=0, kind='stable').argsort(axis=0, kind='stable')
    # The number of a permutation in the factorial number system (Lehmer code).
    number = np.zeros(ranks.shape[1], dtype=np.int64)
    for k in range(order):
        smaller = (ranks[k + 1 :] < ranks[k]).sum(axis=0)
        number += smaller * math.factorial(order - 1 - k)
    count: Array = np.bincount(number, minlength=math.factorial(order)) / number.size
    return count


def permutation_entropy(series: Array, order: int = 4, delay: int = 1) -> float:
    """Return the entropy of the ordinal patterns, from 0 (monotone) to 1 (white noise).

    Bandt and Pompe, Phys. Rev. Lett. 88, 2002 (doi 10.1103/PhysRevLett.88.174102), divided by
    ln(order!). From N patterns white noise gives about (order! - 1) / (2 N ln(order!)) less
    than 1.

    Parameters
    ----------
    series
        Uniform samples, shape (n,).
    order
        Values in a pattern.
    delay
        Samples between the values.
    """
    return normalised_entropy(ordinal_shares(series, order, delay))


def spectral_entropy(series: Array, segment: int = 64) -> float:
    r"""Return the entropy of the power spectrum, from 0 (one line) to 1 (all alike).

    Shannon entropy of the shares of power of the frequencies above zero, relative to that of a
    flat spectrum (Inouye et al., Electroencephalogr. Clin. Neurophysiol. 79, 1991,
    doi 10.1016/0013-4694(91)90138-T). The spectrum is Welch's, with Hann windows that do not
    overlap. From K segments with N frequencies white noise gives about

    .. math:: 1 - (\psi(K + 1) - \ln K) / \ln N, \qquad \psi(K + 1) - \ln K \approx 1 / (2 K)

    NaN for a constant series.

    Parameters
    ----------
    series
        Uniform samples, shape (n,), n >= segment.
    segment
        Samples of a segment; there are segment // 2 frequencies.
    """
    if segment < 4 or series.ndim != 1 or series.size < segment:
        raise ValueError(
            f'series must have at least segment >= 4 values: got {series.shape}, {segment}'
        )
    count = series.size // segment
    pieces = series[: count * segment].reshape(count, segment)
    pieces = pieces - series.mean()
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(segment) / segment)
    power = (np.abs(np.fft.rfft(pieces * window, axis=1)) ** 2).mean(axis=0)[1:]
    total = power.sum()
    if total <= 1e-24 * segment**2 * max(1.0, float(np.abs(series).max()) ** 2):
        return math.nan
    return normalised_entropy(power / total)
