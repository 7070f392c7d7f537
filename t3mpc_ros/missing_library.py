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
"""What to install when a library is missing."""

import sys

REQUIREMENTS = {
    'numpy': 'numpy>=1.26,<3',
    'numba': 'numba>=0.68,<1',
    'mcap': 'mcap>=1.5,<2',
    'zstandard': 'zstandard>=0.22,<1',
    'lz4': 'lz4>=4.3,<5',
    'rosbags': 'rosbags>=0.11,<1',
    'yaml': 'PyYAML>=6.0,<7',
    'serial': 'pyserial>=3.5,<4',
    'matplotlib': 'matplotlib>=3.8,<4',
    'PIL': 'pillow>=10.1,<14',
    'cma': 'cma>=4.0,<5',
    'daqp': 'daqp>=0.11,<1',
    'jinja2': 'jinja2>=3.1,<4',
    'tqdm': 'tqdm>=4.66,<5',
    'shtab': 'shtab>=1.7,<2',
    'casadi': 'casadi>=3.6,<4',
    'pyarrow': 'pyarrow>=15,<30',
    'distributed': 'distributed>=2024.5,<2028',
    'gymnasium': 'gymnasium>=1.0,<2',
}
"""Requirement of each imported library, as in the requirements files."""


EXTRAS = {
    'bags': ('mcap', 'zstandard', 'lz4', 'rosbags', 'PIL', 'jinja2'),
    'ros': ('serial',),
    'compare': ('casadi', 'pyarrow', 'cma', 'jinja2'),
    'cluster': ('distributed', 'pyarrow'),
    'gym': ('gymnasium',),
}
"""Libraries that a simulation does without, by the extra of the package that installs them."""


def remedy(error: ModuleNotFoundError) -> str:
    """Return one line that names a missing library and the remedy; empty for other modules."""
    library = (error.name or '').partition('.')[0]
    if requirement := REQUIREMENTS.get(library):
        command = f'{sys.executable} -m pip install "{requirement}"'
        extra = next((name for name, parts in EXTRAS.items() if library in parts), '')
        also = f', or the package with its extra [{extra}]' if extra else ''
        return f'the library {library} is missing: {command}{also}'
    if library in ('rclpy', 'rcl_interfaces') or library.endswith('_msgs'):
        return (
            f'the ROS 2 package {library} is missing: source the setup file of ROS 2 Jazzy, start '
            'through scripts/run, or install the package by pip with its extra [ros]'
        )
    return ''
