# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parameters of tests of which a check runs a few, and ``scripts/check --long`` the others."""

import pytest


def few_of(values, count=1):
    """Return the values, or tuples of them, all but the first ``count`` marked as long."""
    few, others = [*values][:count], [*values][count:]
    rows = [value if isinstance(value, tuple) else (value,) for value in others]
    return few + [pytest.param(*row, marks=pytest.mark.long) for row in rows]
