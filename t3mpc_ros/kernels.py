# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Decorator for compiled functions, and the folder that holds the compiled code."""

from collections.abc import Callable, Iterator, Mapping, Sequence
import hashlib
from importlib import import_module
import os
from pathlib import Path
import tempfile
from typing import Any, Generic, ParamSpec, Self, TypeVar, cast

import numba
from numba.core import caching, config
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult, Flags, compile_extra
from numba.core.dispatcher import _FunctionCompiler  # type: ignore[attr-defined]
from numba.core.registry import CPUDispatcher
from numba.core.types.misc import unliteral
from numba.core.typing import make_concrete_template
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
    return writable_directory(environment, source_fingerprint(sources))


def writable_directory(environment: Mapping[str, str], leaf: str) -> Path:
    """Return a writable folder named ``leaf`` for compiled code: see :func:`cache_directory`.

    Raises
    ------
    OSError
        No candidate is writable; the message names them all.
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


# Kernels are as fast with few optimisations, and are compiled in three quarters of the time.
config.OPT = type(config.OPT)(1)
config.LOOP_VECTORIZE = config.SLP_VECTORIZE = 0

# Set before the first kernel is made: numba reads the settings when it decorates.
if not config.CACHE_DIR:
    config.CACHE_DIR = str(cache_directory(os.environ))
    _Locators.insert(0, KernelLocator)


class _Flags(Flags):  # type: ignore[misc]
    """Flags that do not change: the compiler compares them for every operation of a kernel."""

    __slots__ = ()
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    def copy(self) -> Self:
        """Return the same object."""
        return self


OPTIONS = {
    'nopython': True,
    'nogil': True,
    'error_model': 'numpy',
    'no_cfunc_wrapper': True,
    '_nrt': False,
}
"""Without ``_nrt``, the compiler's run-time library, arrays are not allocated or counted."""
KERNEL_FLAGS: Flags = CPUDispatcher.targetdescr.options.parse_as_flags(_Flags(), OPTIONS)
PART_FLAGS = _Flags(KERNEL_FLAGS)
PART_FLAGS.no_cpython_wrapper = PART_FLAGS.no_compile = True


class _PartLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code of a kernel for those that call it: optimised and made executable as part of them."""

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _KernelCompiler(_FunctionCompiler):  # type: ignore[misc]
    """Compiles a kernel that Python calls."""

    def _customize_flags(self, flags: Flags) -> Flags:
        return KERNEL_FLAGS


class _Kernel(CPUDispatcher):  # type: ignore[misc]
    """Compiled function.

    A kernel that others call is compiled as part of each of them, by itself only when Python
    calls it, and without a second version for constant arguments.
    """

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function, targetoptions=OPTIONS)
        self._compiler = _KernelCompiler(function, self.targetdescr, OPTIONS, {}, Compiler)
        self._parts: dict[tuple[object, ...], CompileResult] = {}

    def get_call_template(
        self, args: Sequence[object], kws: Mapping[str, object]
    ) -> tuple[Any, ...]:
        """Return how a kernel calls this one, with the type of a constant, not its value."""
        signature, folded = self._compiler.fold_argument_types(
            tuple(map(unliteral, args)), {name: unliteral(kind) for name, kind in kws.items()}
        )
        types = tuple(folded)
        if types not in self._parts:
            self._parts[types] = self._compile_part(types)
        signatures = [part.signature for part in self._parts.values()]
        return make_concrete_template(self.__name__, self, signatures), signature, types, {}

    def _compile_part(self, types: tuple[object, ...]) -> CompileResult:
        target = self.targetctx
        library = _PartLibrary(target.codegen(), self.__qualname__)
        part = compile_extra(
            self.typingctx, target, self.py_func, types, None, PART_FLAGS, {}, library
        )
        part = part._replace(entry_point=object())  # what get_overload identifies it by
        target.insert_user_function(part.entry_point, part.fndesc, [library])
        return part

    def get_overload(self, sig: Sequence[object]) -> object:
        """Return what identifies the code for these arguments in the kernel that is compiled."""
        return self._parts[tuple(sig)].entry_point


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Return ``function``, compiled to machine code on its first call and cached on disk.

    A kernel takes arrays, numbers and named tuples of both only, and allocates no array. Division
    by zero gives inf or NaN as in IEEE 754 instead of an exception; arguments are validated
    before the kernel is called. Constants that may change are passed as arguments, because the
    cache does not detect a changed global.

    With ``NUMBA_DISABLE_JIT=1`` it is ``function`` itself, for debuggers and for the measurement
    of coverage: a hundred times slower, and a plain number divided by zero is an error there.
    """
    if config.DISABLE_JIT:
        return function
    compiled = _Kernel(function)
    compiled.enable_caching()
    return cast('Callable[P, R]', compiled)


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
        compiled = cast('_Kernel', self._function)
        # The first call may have an integer where later ones have a float.
        hints = compiled.py_func.__annotations__.values()
        types = tuple(
            numba.float64 if hint is float else numba.typeof(argument)
            for hint, argument in zip(hints, arguments, strict=False)
        )
        code: Callable[P, R] = compiled.compile(types)
        self._code = code
        return code


def contiguous(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``values`` as a :class:`TypedKernel` needs them; itself, if it is so."""
    return np.ascontiguousarray(values, dtype=np.float64)


def _typed_kernel(module: str, name: str) -> TypedKernel[..., object]:
    return TypedKernel(getattr(import_module(module), name))
