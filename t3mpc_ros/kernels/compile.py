# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The compiler behind the ``kernel`` decorator."""

from collections.abc import Callable
import os
from typing import ParamSpec, TypeVar, cast

import numba
import numba.core.config

from t3mpc_ros.kernels.cache import cache_directory

P = ParamSpec('P')
R = TypeVar('R')

# Set once, before any kernel is made: numba asks for the folder when it decorates.
if not numba.core.config.CACHE_DIR:
    numba.core.config.CACHE_DIR = str(cache_directory(os.environ))


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Return ``function`` compiled to machine code on its first call, and kept on disk.

    A kernel takes arrays and numbers only. Division by zero gives inf or NaN as in IEEE 754
    instead of an exception: arguments are checked once, above the kernel. Constants that may
    change are passed as arguments, because the cache does not notice a changed global.
    """
    return cast(
        'Callable[P, R]',
        numba.njit(cache=True, nogil=True, error_model='numpy', fastmath=False)(function),
    )
