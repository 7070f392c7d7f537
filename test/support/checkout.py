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
"""Copies and examples of the package, an environment without the variables of the user's setup."""

import importlib.util
import os
from pathlib import Path
import re
import shutil

ROOT = Path(__file__).resolve().parents[2]
SETUP = (ROOT / 'setup.py').read_text()
EXECUTABLES = {
    't3mpc',
    *re.findall(r"    '(\w+)',", re.search(r'^NODES = \(.*?^\)', SETUP, re.M | re.S)[0]),
}
"""What ``setup.py`` installs."""
# Variables of the user's ROS, workspace and pip, removed for the tests.
FOREIGN = ('PYTHONPATH', 'AMENT_PREFIX_PATH', 'COLCON_', 'PIP_', 'UV_', 'T3MPC_')


def clean_environment(**extra):
    """Return the environment of this process without the variables of the user's setup."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(FOREIGN)}
    return kept | {key: str(value) for key, value in extra.items()}


def copy_package(destination, *without):
    """Copy the package without some folders and the files that version control ignores."""
    ignored = [line.rstrip('/') for line in (ROOT / '.gitignore').read_text().split()]
    shutil.copytree(ROOT, destination, ignore=shutil.ignore_patterns('.git', *ignored, *without))
    return destination


def load_example(name):
    """Return a program of ``examples/`` as a module, with its main part not run."""
    spec = importlib.util.spec_from_file_location(f'example_{name}', ROOT / f'examples/{name}.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
