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
"""Key of a stored run: a digest of all that determines its numbers, the user's own code among it.

Of functions and classes it has the source, and what of a user's own code they use. The name of a
class of a notebook is not enough, nor is its source if it uses a constant above it or a module
beside it: the rows that a file has of a controller would be taken for those of the edited one.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache
import hashlib
import inspect
import os
from pathlib import Path
import pickle
import sys
import sysconfig
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

from t3mpc_ros.version import PACKAGE_DIRECTORY, VERSION

INSTALLED = {
    *(Path(sysconfig.get_path(name)) for name in ('stdlib', 'purelib', 'platlib')),
    *(Path(sys.base_prefix), Path(sys.prefix), PACKAGE_DIRECTORY),
}
"""Folders of Python, of libraries and of this package."""


def is_own(name: str) -> bool:
    """Return whether neither Python, a library nor this package installs a module."""
    if name in ('__main__', '__mp_main__'):
        return True
    spec = getattr(sys.modules.get(name), '__spec__', None)
    file = getattr(sys.modules.get(name), '__file__', None) or getattr(spec, 'origin', None)
    if file is None or not file.endswith('.py'):
        return False
    return INSTALLED.isdisjoint(Path(file).resolve().parents)


def own_text(module: ModuleType) -> str:
    """Return the text of a module of one's own that has a file, else an empty one."""
    file = getattr(module, '__file__', None)
    if not file or module.__name__ in ('__main__', '__mp_main__'):
        return ''
    with suppress(OSError):
        return Path(file).read_text(encoding='utf-8')
    return ''


DATA = (bool, int, float, complex, str, list, tuple, dict)
"""Kinds of data that a function may use by a name; arrays, too."""


def digest(*parts: Any) -> str:
    """Return a digest of version, sources of this package, and the content of ``parts``.

    Functions and classes of a script count with their source and with what they use, files with
    their content.
    """
    content = VERSION, source_digest(), [content_of(part) for part in parts]
    return hashlib.sha256(repr(content).encode()).hexdigest()[:16]


# Sources that only display, record or select. All others, and the tuned values, make stored runs
# invalid: a needless repetition is better than an outdated result.
_IRRELEVANT_SOURCES = (
    'nodes/', 'bag/', 'radio/', 'emulator/', 'cli/', 'view/', 'page/', 'model_file.py',
    'evaluation/bag_report/', 'evaluation/process_replay/', 'evaluation/comparison',
    'evaluation/html_page.py', 'evaluation/figure_style.py', 'evaluation/result_output.py',
    'evaluation/paper/',
)  # fmt: skip


@cache
def source_digest(package: Path = PACKAGE_DIRECTORY) -> str:
    """Return a digest of every source and data file that can change the numbers of a run."""
    suffixes = ('.py', '.npy', '.npz', '.yaml', '.json', '.csv')
    found = hashlib.sha256()
    for path in sorted(package.rglob('*')):
        name = path.relative_to(package).as_posix()
        if path.suffix in suffixes and not name.startswith(_IRRELEVANT_SOURCES):
            found.update(name.encode() + b'\0' + hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()[:16]


def content_of(value: Any) -> object:
    """Return what a value is, as text and numbers; equal ones have equal content."""
    if isinstance(value, str | os.PathLike):
        return os.fspath(value), _file_digest(value)
    if value is None or isinstance(value, bool | int | float):
        return value
    if isinstance(value, np.ndarray) and value.dtype != object:
        content = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return str(value.dtype), value.shape, content
    if isinstance(value, Mapping):
        return [(str(key), content_of(item)) for key, item in value.items()]
    if isinstance(value, list | tuple):
        return [content_of(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        items = [content_of(getattr(value, item.name)) for item in fields(value)]
        used = getattr(value, 'resolve', None)  # of a file: what it uses of other files
        code = [] if used is None else _code(used())
        return _code(type(value)), items, code
    return _code(value)


def _file_digest(value: str | os.PathLike[str]) -> str:
    """Return a digest of a file, such as a world or a model; '' if it is none.

    A word without suffix and folder is a name, whatever files there are where the program runs.
    """
    path = Path(os.path.expanduser(value))
    if isinstance(value, str) and not path.suffix and path.name == value:
        return ''
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ''
    except OSError:
        return ''


def _code(value: Any) -> object:
    """Return the source of a function or class, or of the class of an object and its state."""
    if hasattr(value, '__qualname__'):
        return code_content(value)
    code = code_content(type(value))
    try:
        return *code, hashlib.sha256(pickle.dumps(value)).hexdigest()
    except (pickle.PicklingError, AttributeError, TypeError):
        return code


def code_content(code: Any) -> list[object]:
    """Return name and source of a function or class, and of all of one's own that it uses.

    Code of libraries counts by its name.
    """
    found: list[object] = []
    seen: set[int] = set()
    pending: list[tuple[str, Any]] = [(code.__qualname__, code)]
    while pending:
        name, each = pending.pop(0)
        if not isinstance(each, FunctionType | type | ModuleType):
            if isinstance(each, DATA) or hasattr(each, '__array__'):
                found.append((name, content_of(each)))
        elif id(each) not in seen:
            seen.add(id(each))
            own = is_own(each.__name__ if isinstance(each, ModuleType) else each.__module__)
            if own and isinstance(each, ModuleType):
                # Its text has what its parts are; what they use of other modules follows.
                found.append((name, own_text(each)))
                pending += [(n, part) for n, part in vars(each).items() if callable(part)]
            else:
                found.append((name, _source(each) if own or each is code else ''))
                pending += _used(each) if own else ()
    return found


def _used(code: Any) -> Iterator[tuple[str, Any]]:
    """Yield what a class inherits, and what its functions, or a function, read from outside."""
    if isinstance(code, type):
        yield from ((base.__qualname__, base) for base in code.__mro__[1:])
        yield from ((name, value) for name, value in vars(code).items() if name[:2] != '__')
    for function in _functions(code):
        names = {name for part in _parts(function.__code__) for name in part.co_names}
        known = function.__globals__
        yield from ((name, known[name]) for name in sorted(names) if name in known)
        yield from _closure(function).items()
        yield from ((function.__qualname__, value) for value in function.__defaults__ or ())
        yield from (function.__kwdefaults__ or {}).items()


def _closure(function: FunctionType) -> dict[str, Any]:
    """Return the values of enclosing functions that a function reads."""
    found = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # not assigned yet, as __class__ in a class that is being made
            found[name] = cell.cell_contents
    return found


def _functions(code: Any) -> Iterator[FunctionType]:
    """Yield a function, or those of a class: methods of each kind and properties."""
    for each in vars(code).values() if isinstance(code, type) else (code,):
        for part in (each, getattr(each, '__func__', None), getattr(each, 'fget', None)):
            if isinstance(part, FunctionType):
                yield part


def _parts(code: CodeType) -> Iterator[CodeType]:
    """Yield the code of a function and of the functions in it."""
    yield code
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield from _parts(each)


@cache  # reading takes milliseconds, and an experiment has thousands of runs
def _source(code: Any) -> object:
    """Return the source of a function or class; of one that has none, what is compiled."""
    try:
        return inspect.getsource(code)
    except (OSError, TypeError):
        pass
    return [
        (part.co_name, part.co_code, [x for x in part.co_consts if not isinstance(x, CodeType)])
        for function in _functions(code)
        for part in _parts(function.__code__)
    ]
