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
"""Parameters of tests of which a check runs a few, and ``scripts/check --long`` the others."""

import pytest


def few_of(values, count=1, step=0):
    """Return the values, or tuples of them, most marked as long.

    The first ``count`` are not; with a ``step`` each ``step``-th of them is not.
    """
    values = [*values]
    few = range(0, len(values), step) if step else range(count)
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    return [
        value if index in few else pytest.param(*rows[index], marks=pytest.mark.long)
        for index, value in enumerate(values)
    ]
