# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Decorator for compiled functions, and the folder that holds the compiled code."""

from collections.abc import Callable, Iterator, Mapping, Sequence
import hashlib
import os
from pathlib import Path
import tempfile
from typing import Any, ParamSpec, TypeVar, cast

import numba
from numba.core import caching, config
from numba.core.registry import CPUDispatcher
from numba.core.types.misc import unliteral

P = ParamSpec('P')
R = TypeVar('R')

PACKAGE_DIRECTORY = Path(__file__).resolve().parent


def cache_directory(environment: Mapping[str, str], sources: Path = PACKAGE_DIRECTORY) -> Path:
    """Return a writable folder for the kernels compiled from the present sources.

    The compiler's own cache checks only the file that contains a kernel: a cached kernel would
    keep calling an outdated version of a kernel in another file. The name of the folder therefore
    contains a fingerprint of every source file with a kernel.

    Parameters
    ----------
    environment
        The folder is below ``T3MPC_CACHE_DIR``, ``XDG_CACHE_HOME``, ``HOME`` or the temporary
        folder: the first of them that is set and writable. An installed package is often
        read-only, so nothing is written beside the sources.
    sources
        The folder whose ``*.py`` files are fingerprinted.

    Raises
    ------
    OSError
        No candidate is writable; the message names them all.
    """
    leaf = source_fingerprint(sources)
    tried = []
    for base in _base_directories(environment):
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


def source_fingerprint(sources: Path) -> str:
    """Return 16 hexadecimal digits that change with any file below ``sources`` with a kernel.

    They change with the compiler, too: several environments share a folder.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(sources.rglob('*.py')):
        content = path.read_bytes()
        if b'@kernel' in content or path.name == 'kernels.py':
            digest.update(str(path.relative_to(sources)).encode())
            digest.update(content)
    return digest.hexdigest()[:16]


def _base_directories(environment: Mapping[str, str]) -> Iterator[Path]:
    if chosen := environment.get('T3MPC_CACHE_DIR'):
        yield Path(chosen)
    if base := environment.get('XDG_CACHE_HOME'):
        yield Path(base) / 't3mpc_ros'
    if home := environment.get('HOME'):
        yield Path(home) / '.cache' / 't3mpc_ros'
    yield Path(tempfile.gettempdir()) / f't3mpc_ros-{os.getuid()}'


_Locators: Any = caching.CacheImpl._locator_classes
"""What the compiler asks in turn; the first is for ``CACHE_DIR``, with a name that varies."""


class KernelLocator(_Locators[0]):  # type: ignore[misc]
    """Where the compiler caches a kernel: by the name of its module, not by the path of the file.

    Equal sources share the compiled code wherever they are: clones, workspaces, installations.
    """

    def __init__(self, function: Callable[..., object], file: str) -> None:
        super().__init__(function, file)
        self._cache_path = str(Path(config.CACHE_DIR, *function.__module__.split('.')))

    @classmethod
    def from_function(cls, function: Callable[..., object], file: str) -> 'KernelLocator | None':
        """Return the locator of a kernel of this package; None for any other function."""
        if not Path(file).is_relative_to(PACKAGE_DIRECTORY):
            return None
        return cast('KernelLocator | None', super().from_function(function, file))

    def get_source_stamp(self) -> str:
        """Return what changes with the sources: the fingerprint in the name of the folder."""
        return Path(config.CACHE_DIR).name


# Set before the first kernel is made: numba reads the settings when it decorates.
if not config.CACHE_DIR:
    config.CACHE_DIR = str(cache_directory(os.environ))
    _Locators.insert(0, KernelLocator)


class _Kernel(CPUDispatcher):  # type: ignore[misc]
    """Compiled function without a second version for constant arguments of a calling kernel."""

    def get_call_template(
        self, args: Sequence[object], kws: Mapping[str, object]
    ) -> tuple[Any, ...]:
        """Return how a kernel calls this one, with the type of a constant, not its value."""
        plain = tuple(map(unliteral, args))
        template: tuple[Any, ...] = super().get_call_template(
            plain, {name: unliteral(kind) for name, kind in kws.items()}
        )
        return template


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Return ``function``, compiled to machine code on its first call and cached on disk.

    A kernel takes arrays, numbers and named tuples of both only. Division by zero gives inf or
    NaN as in IEEE 754 instead of an exception; arguments are validated before the kernel is
    called. Constants that may change are passed as arguments, because the cache does not detect
    a changed global.
    """
    options = {'nopython': True, 'nogil': True, 'error_model': 'numpy'}
    compiled = _Kernel(py_func=function, targetoptions=options)
    compiled.enable_caching()
    return cast('Callable[P, R]', compiled)
