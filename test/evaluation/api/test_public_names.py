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
"""The scripting interface: its names, and what an import costs; docs/api.md has the signatures."""

import itertools
import json
import subprocess
import sys

import pytest

import t3mpc_ros as t3
from t3mpc_ros.missing_library import EXTRAS, REQUIREMENTS

HEAVY = ('numba', 'numpy', 'matplotlib', 'rclpy', 'mcap', 'rosbags', 'pyarrow', 'distributed')


def test_every_public_name_exists_and_is_listed():
    assert {*t3.__all__} <= {*dir(t3)}
    assert all(hasattr(t3, name) for name in t3.__all__)


def test_the_import_loads_no_library():
    """``import t3mpc_ros`` took a second when it imported what a script may never use."""
    code = (
        f'import json, sys, t3mpc_ros; print(json.dumps([m for m in {HEAVY} if m in sys.modules]))'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []


STUDIES = ('paper.reproduce', 'tuning.tune_methods', 'comparison', 'patrol.patrol_comparison')


@pytest.mark.long
def test_the_extra_of_comparisons_is_enough_for_them():
    """``t3mpc paper`` needed the libraries for bags, which its extra does not install."""
    there = {*EXTRAS['compare']} | {*REQUIREMENTS} - {*itertools.chain(*EXTRAS.values())}
    others = {*REQUIREMENTS} - there - {'PIL'}  # matplotlib needs that one
    code = f'import sys; sys.modules.update(dict.fromkeys({others}))\n'
    code += '\n'.join(f'import t3mpc_ros.evaluation.{name}' for name in STUDIES)
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_generator_and_fuzzy_system_are_functions_in_any_order():
    """Both are packages, too: importing a module of one must not replace the function."""
    import t3mpc_ros.chaos.system_equations
    import t3mpc_ros.fuzzy.inference

    assert t3mpc_ros.chaos is t3.chaos is sys.modules['t3mpc_ros.chaos']
    assert t3.chaos(tspan=(0.0, 0.1)).y.shape == (11, 4)
    assert t3.fuzzy('x', sets=3).rules == t3mpc_ros.fuzzy('x', sets=3).rules == 3


def test_an_unknown_name_is_an_attribute_error():
    assert not hasattr(t3, 'no_such_name')
