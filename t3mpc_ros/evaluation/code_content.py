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
"""Content of functions and classes: their source, and what of a user's own code they use.

A run is known by it. The name of a class of a notebook is not enough, nor is its source if it uses
a constant above it or a module beside it: the rows that a file has of a controller would be taken
for those of the edited one.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
import inspect
from types import CodeType, FunctionType, ModuleType
from typing import Any

from t3mpc_ros.evaluation.own_modules import is_own, own_text

DATA = (bool, int, float, complex, str, list, tuple, dict)
"""Kinds of data that a function may use by a name; arrays, too."""


def code_content(code: Any, content_of: Callable[[Any], object]) -> list[object]:
    """Return name and source of a function or class, and of all of one's own that it uses.

    ``content_of`` returns the content of data. Code of libraries counts by its name.
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
