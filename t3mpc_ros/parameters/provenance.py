# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Version and commit of the running package, for bags and reports."""

import contextlib
import os
from pathlib import Path
import platform
import subprocess

from t3mpc_ros.version import VERSION

PACKAGE_DIRECTORY = Path(__file__).resolve().parents[1]


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
