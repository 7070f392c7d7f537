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
"""Version and commit of the running package, for bags and reports."""

import contextlib
import os
from pathlib import Path
import platform
import subprocess

from t3mpc_ros.version import PACKAGE_DIRECTORY, VERSION


def provenance(package: Path = PACKAGE_DIRECTORY) -> dict[str, str]:
    """Return version, commit and Python version.

    The commit is that of the checkout that contains the package, with the suffix ``-dirty`` when
    files differ from it; ``unknown`` when the package is not in a checkout of its own.
    """
    return {
        'version': VERSION,
        'commit': _commit(package),
        'python': platform.python_version(),
    }


def machine() -> dict[str, str]:
    """Return processor and operating system, without the name of the machine."""
    processor = platform.machine()
    with contextlib.suppress(OSError):
        for line in Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines():
            name, _, value = line.partition(':')
            if name.strip() == 'model name':
                processor = value.strip()
                break
    cores = os.cpu_count() or 1
    return {'machine': f'{processor}, {cores} processors, {platform.system()}'}


def _commit(package: Path) -> str:
    root = package.parent
    if not (root / '.git').exists():  # the package may be installed inside another checkout
        return 'unknown'
    try:
        result = subprocess.run(
            ['git', '-C', str(root), 'describe', '--always', '--dirty', '--abbrev=40', '--match='],
            capture_output=True,
            text=True,
            timeout=5.0,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return 'unknown'
    return result.stdout.strip() or 'unknown'
