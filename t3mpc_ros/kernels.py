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
"""Decorator for compiled functions, and the folder that holds the compiled code."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import update_wrapper
import hashlib
from importlib import import_module
import os
from pathlib import Path
import re
import shutil
import tempfile
from typing import Any, Generic, ParamSpec, Self, TypeVar, cast

import numba
from numba import config
from numba.extending import overload
import numpy as np
from numpy.typing import NDArray

P = ParamSpec('P')
R = TypeVar('R')

PACKAGE_DIRECTORY = Path(__file__).resolve().parent


def cache_directory(environment: Mapping[str, str], sources: Path = PACKAGE_DIRECTORY) -> Path:
    """Return a writable folder for the kernels compiled from the present sources.

    The compiler's own cache checks only the file that contains a kernel: a cached kernel would
    keep calling an outdated version of a kernel in another file. The name of the folder therefore
    contains a fingerprint of every source file with a kernel.
    """
    return writable_directory(environment, source_fingerprint(sources))


def writable_directory(environment: Mapping[str, str], leaf: str) -> Path:
    """Return a writable folder named ``leaf`` for compiled code; OSError names all that are not.

    It is below ``T3MPC_CACHE_DIR``, ``XDG_CACHE_HOME``, ``HOME`` or the temporary folder, the
    first that is set and writable. An installed package is often read-only, so nothing is written
    beside the sources.
    """
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
        'no writable folder for compiled code; set T3MPC_CACHE_DIR to one. Tried: '
        + ', '.join(tried)
    )


def remove_compiled(environment: Mapping[str, str]) -> list[Path]:
    """Remove what this package has compiled, of every version; return the folders.

    Where ``T3MPC_CACHE_DIR`` is set, only what is there: other installations use the others.
    """
    removed = []
    bases = list(_base_directories(environment))
    for base in bases[:1] if environment.get('T3MPC_CACHE_DIR') else bases:
        for folder in sorted(base.glob('*')):
            if folder.is_dir() and re.fullmatch('(firmware-)?[0-9a-f]{16}', folder.name):
                shutil.rmtree(folder)
                removed.append(folder)
        with suppress(OSError):  # not there, or it has other files
            base.rmdir()
    return removed


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


# Set in numba.config, not in the environment: programs that this process starts do not inherit
# it, and it counts after an import of numba, too. Kernels are as fast with few optimisations, and
# are compiled in three quarters of the time.
config.OPT = type(config.OPT)(1)
config.LOOP_VECTORIZE = config.SLP_VECTORIZE = 0


class KernelLocator:
    """Where the compiler caches a kernel: by the name of its module, not by the path of the file.

    Equal sources share the compiled code wherever they are: clones, workspaces, installations.
    The compiler asks the classes of its setting ``NUMBA_CACHE_LOCATOR_CLASSES`` in turn.
    """

    def __init__(self, function: Callable[..., object]) -> None:
        self._folder = Path(config.CACHE_DIR, *function.__module__.split('.'))
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Callable[..., object], file: str) -> 'KernelLocator | None':
        """Return the locator of a kernel of this package; None for any other function."""
        return cls(function) if Path(file).is_relative_to(PACKAGE_DIRECTORY) else None

    def ensure_cache_path(self) -> None:
        """Make the folder."""
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Return what changes with the sources: the fingerprint in the name of the folder."""
        return Path(config.CACHE_DIR).name

    def get_disambiguator(self) -> str:
        """Return what tells functions of one name apart: the line."""
        return str(self._line)


_LOCATORS = (
    'UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator,IPythonCacheLocator,'
    'ZipCacheLocator'
)
"""What the compiler asks by default."""
# Before the first kernel is made: numba reads the folder when it decorates.
if not config.CACHE_DIR:
    config.CACHE_DIR = str(cache_directory(os.environ))
    others = config.CACHE_LOCATOR_CLASSES or _LOCATORS
    config.CACHE_LOCATOR_CLASSES = f'{__name__}.{KernelLocator.__name__},{others}'

OPTIONS = {'nogil': True, 'error_model': 'numpy', 'no_cfunc_wrapper': True, '_nrt': False}
"""Without ``_nrt``, the compiler's run-time library, arrays are not allocated or counted."""
PART_OPTIONS = OPTIONS | {'no_cpython_wrapper': True}


class Kernel(Generic[P, R]):
    """Compiled function.

    A kernel that others call is compiled as part of each of them, and by itself only when Python
    calls it: what converts arguments from Python takes longer to compile than most kernels.
    """

    def __init__(self, function: Callable[P, R]) -> None:
        update_wrapper(self, function)
        self.compiled: Any = numba.njit(cache=True, **OPTIONS)(function)
        part = overload(cast('Any', self), jit_options=PART_OPTIONS, strict=False)
        part(lambda *arguments, **named: function)

    def __call__(self, *arguments: P.args, **named: P.kwargs) -> R:
        """Return what the function returns."""
        return cast('R', self.compiled(*arguments, **named))

    def __reduce__(self) -> str:
        """Return how it is copied and pickled: by its name, without the code."""
        return self.__name__  # type: ignore[attr-defined, no-any-return]


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Return ``function``, compiled to machine code on its first call and cached on disk.

    A kernel takes arrays, numbers, structures and named tuples of them only, and allocates no
    array. Division by zero gives inf or NaN as in IEEE 754 instead of an exception; arguments are
    validated before the kernel is called. Constants that may change are passed as arguments,
    because the cache does not detect a changed global.

    With ``NUMBA_DISABLE_JIT=1`` it is ``function`` itself, for debuggers and for the measurement
    of coverage: a hundred times slower, and a plain number divided by zero is an error there.
    """
    return function if config.DISABLE_JIT else Kernel(function)


class TypedKernel(Generic[P, R]):
    """A kernel that is always called with arguments of the same types.

    A kernel examines its arguments at every call, each array of a named tuple by itself, which
    takes longer than most kernels run. This one examines those of its first call only: later ones
    must have the same types, and arrays the same layout.
    """

    def __init__(self, function: Callable[P, R]) -> None:
        self._function = function
        self._code: Callable[P, R] | None = None

    def __call__(self, *arguments: P.args, **none: P.kwargs) -> R:
        """Return what the kernel returns; all arguments are positional."""
        code = self._code or self._compile(arguments)
        return code(*arguments, **none)

    def __reduce__(self) -> tuple[object, ...]:
        """Return how it is copied and pickled: by the name of the kernel, without the code."""
        return _typed_kernel, (self._function.__module__, self._function.__name__)

    def _compile(self, arguments: Sequence[object]) -> Callable[P, R]:
        if config.DISABLE_JIT:
            return self._function
        # The first call may have an integer where later ones have a float.
        hints = self._function.__annotations__.values()
        types = tuple(
            numba.float64 if hint is float else numba.typeof(argument)
            for hint, argument in zip(hints, arguments, strict=False)
        )
        code: Callable[P, R] = cast('Kernel[P, R]', self._function).compiled.compile(types)
        self._code = code
        return code


class Structure:
    """Named numbers that kernels change in place: a class annotates and explains its fields.

    The object is an element of a NumPy record array: ``state.count += 1.0`` in a kernel is seen
    by every owner of the array. Kernels take the array, because a record by itself takes Python
    several times longer to pass.
    """

    @classmethod
    def new(cls, **values: float) -> Sequence[Self]:
        """Return an array of one structure, whose fields are zero unless given."""
        fields = cls.__annotations__
        if taken := [name for name in fields if hasattr(np.record, name)]:
            raise ValueError(f'names of fields must not be those of NumPy: got {taken}')
        one = np.zeros(1, np.dtype(list(fields.items()))).view(np.recarray)
        for name, value in values.items():
            one[name] = value
        return cast('Sequence[Self]', one)


def contiguous(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``values`` as a :class:`TypedKernel` needs them; itself, if it is so."""
    return np.ascontiguousarray(values, dtype=np.float64)


def _typed_kernel(module: str, name: str) -> TypedKernel[..., object]:
    return TypedKernel(getattr(import_module(module), name))
