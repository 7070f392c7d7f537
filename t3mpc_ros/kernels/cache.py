# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Where compiled kernels are kept: always writable, never stale."""

from collections.abc import Iterator, Mapping
import hashlib
import os
from pathlib import Path
import tempfile

PACKAGE = Path(__file__).resolve().parent.parent


def cache_directory(environment: Mapping[str, str], sources: Path = PACKAGE) -> Path:
    """Return a writable folder for the kernels compiled from these very sources.

    The compiler's own cache looks only at the file a kernel stands in, so a kernel kept from
    yesterday would go on calling yesterday's version of a kernel in another file. The folder's
    name therefore carries a fingerprint of every source file that holds a kernel.

    Parameters
    ----------
    environment
        ``T3MPC_CACHE_DIR`` wins, then ``XDG_CACHE_HOME``, then ``HOME``, then the temporary
        folder; the first one that can be written to is taken. An installed package is often
        read-only, so nothing is written beside the sources.
    sources
        The folder whose ``*.py`` files with kernels are fingerprinted.

    Raises
    ------
    OSError
        No candidate can be written to; the message names them all.
    """
    leaf = fingerprint(sources)
    tried = []
    for base in _candidates(environment):
        folder = base / leaf
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError as error:
            tried.append(f'{folder} ({error.strerror})')
    raise OSError(
        'no writable folder for compiled kernels; set T3MPC_CACHE_DIR to one. Tried: '
        + ', '.join(tried)
    )


def fingerprint(sources: Path) -> str:
    """Return 16 hexadecimal digits that change with any file below ``sources`` with a kernel."""
    digest = hashlib.sha256()
    for path in sorted(sources.rglob('*.py')):
        content = path.read_bytes()
        if b'@kernel' in content or path.parent.name == 'kernels':
            digest.update(str(path.relative_to(sources)).encode())
            digest.update(content)
    return digest.hexdigest()[:16]


def _candidates(environment: Mapping[str, str]) -> Iterator[Path]:
    if chosen := environment.get('T3MPC_CACHE_DIR'):
        yield Path(chosen)
    if base := environment.get('XDG_CACHE_HOME'):
        yield Path(base) / 't3mpc_ros'
    if home := environment.get('HOME'):
        yield Path(home) / '.cache' / 't3mpc_ros'
    yield Path(tempfile.gettempdir()) / f't3mpc_ros-{os.getuid()}'
