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
"""The whole state of an object as a table of leaves, to compare a used one with a new one."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
import copy
import ctypes
import dataclasses
import enum
import functools
import importlib
import inspect
import itertools
import operator
import pkgutil
import random
import re
import struct
import types
from typing import Any, NamedTuple

import numpy as np

from t3mpc_ros.kernels import Kernel, Structure, TypedKernel

SINGLY = 300  # most elements of an array that are named one by one
OPAQUE = (
    types.FunctionType,
    types.BuiltinFunctionType,
    types.MethodType,
    types.ModuleType,
    Kernel,
    TypedKernel,
    type,
)


PLAIN = {type(None), bool, int, str, bytes}


def leaves(thing: Any, path: str = '', above: tuple[int, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield path and value of all that is reachable, private names and arrays included."""
    if type(thing) in PLAIN or isinstance(thing, (enum.Enum, np.integer)):
        yield path, thing
    elif isinstance(thing, float):
        yield path, struct.pack('<d', thing).hex() if thing != thing or thing == 0.0 else thing
    elif isinstance(thing, np.ndarray) and not thing.dtype.names:
        yield path, _Copy(thing)
    elif isinstance(thing, np.random.Generator):
        yield path, repr(thing.bit_generator.state)
    elif isinstance(thing, random.Random):
        yield path, thing.getstate()
    elif isinstance(thing, OPAQUE) or type(thing).__module__.startswith('numba'):
        yield path, type(thing).__name__
    elif isinstance(thing, (ctypes.Array, ctypes.Structure)):
        yield path, bytes(thing)
    elif id(thing) in above:
        yield path, 'above'
    else:
        parts = dict(_parts(thing))
        sized = f' of {len(parts)}' if hasattr(thing, '__len__') else ''
        yield path, type(thing).__name__ + sized
        for name, part in parts.items():
            yield from leaves(part, f'{path}{name}', (*above, id(thing)))


class _Copy:
    """Copy of an array, equal to another one if every bit is."""

    def __init__(self, array: np.ndarray) -> None:
        self._kind, self._bytes = (array.dtype, array.shape), array.tobytes()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Copy) and (self._kind, self._bytes) == (
            other._kind,
            other._bytes,
        )

    __hash__ = None  # type: ignore[assignment]

    def unlike(self, other: object) -> list[str]:
        """Return the rows in which two copies differ, or '' for the whole."""
        kind, shape = self._kind
        if not isinstance(other, _Copy) or self._kind != other._kind or not shape:
            return ['']
        mine, its = (
            np.frombuffer(each._bytes, np.uint8).reshape(*shape, kind.itemsize)
            for each in (self, other)
        )
        found = np.argwhere((mine != its).any(axis=-1)).tolist()
        if len(found) > SINGLY:
            return ['']
        return [''.join(f'[{k}]' for k in index) for index in found]


def _parts(thing: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(thing, np.ndarray) and not isinstance(thing, np.recarray):
        yield from ((f'.{name}', thing[name]) for name in thing.dtype.names)
    elif isinstance(thing, Mapping):
        for key in sorted(thing, key=repr):
            yield f'[{key!r}]', thing[key]
    elif isinstance(thing, set | frozenset):
        yield from ((f'{{{item!r}}}', None) for item in sorted(thing, key=repr))
    elif isinstance(thing, np.record):
        yield from ((f'.{name}', getattr(thing, name).item()) for name in thing.dtype.names)
    elif hasattr(thing, '_fields'):
        yield from ((f'.{name}', getattr(thing, name)) for name in thing._fields)
    elif isinstance(thing, list | tuple | deque | np.recarray):
        yield from ((f'[{index}]', item) for index, item in enumerate(thing))
    elif isinstance(thing, types.GeneratorType):
        frame = thing.gi_frame
        yield '.line', frame and frame.f_lineno
        yield from ((f'.{name}', item) for name, item in (frame.f_locals if frame else {}).items())
    else:
        names = [n for kind in type(thing).__mro__ for n in getattr(kind, '__slots__', ())]
        found = {name: getattr(thing, name) for name in names if hasattr(thing, name)}
        found |= getattr(thing, '__dict__', {}) or {'': repr(thing)}
        yield from ((f'.{name}', item) for name, item in found.items())


WORK_SPACE = (
    *('*.grades', '*.firings', '*._drawn', '*._work', '*.work'),
    *('*.lagged_errors', '*.lagged_moves', '*.half_horizon', '*.planned_moves'),
    *('*.lags', '*.mu0', '*.eta1', '*.mu1', '*.rls.total', '*.rls.lower', '*.rls.move'),
    *('*.adaptation_error', '*._friction.basis', '*._state.point', '*._state.output'),
)
"""Arrays that a kernel writes before it reads them, as their docstrings say."""


def state_of(thing: Any, ignored: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return every leaf by its path, but those that match a pattern."""
    ignores = _matcher((*ignored, *WORK_SPACE))
    return {path: value for path, value in leaves(thing) if not ignores(path)}


def changes(first: dict[str, Any], second: dict[str, Any]) -> Iterator[str]:
    """Yield the paths at which two states differ, those of rows of arrays included."""
    if first == second:
        return
    for path in sorted(first.keys() | second.keys()):
        one, other = first.get(path, KeyError), second.get(path, KeyError)
        if one != other:
            rows = one.unlike(other) if isinstance(one, _Copy) else ['']
            yield from (f'{path}{row}' for row in rows)


def matches(path: str, patterns: tuple[str, ...]) -> bool:
    """Return whether a path is, or lies below, one of the patterns (``*`` is any text)."""
    return bool(patterns) and _matcher(patterns)(path)


@functools.cache
def _matcher(patterns: tuple[str, ...]) -> Callable[[str], bool]:
    """Return :func:`matches` of these patterns, which examines each path once."""
    each = '|'.join(re.escape(pattern).replace(r'\*', '.*') for pattern in patterns)
    match = re.compile(rf'({each})([.\[].*)?$').match
    return functools.cache(lambda path: match(path) is not None)


def different(one: Any, other: Any, ignored: tuple[str, ...] = ()) -> list[str]:
    """Return the paths at which two objects differ."""
    return changed(state_of(one, ignored), state_of(other, ignored), ignored)


def changed(
    first: dict[str, Any], second: dict[str, Any], ignored: tuple[str, ...] = ()
) -> list[str]:
    """Return the paths at which two states differ, but those that match a pattern."""
    return [path for path in changes(first, second) if not matches(path, ignored)]


def fingerprint(thing: Any) -> Any:
    """Return what is equal for objects that do not differ, sooner than their leaves by path."""
    kind = type(thing)
    if kind is np.ndarray and not thing.dtype.names:
        return thing.dtype.str, thing.shape, thing.tobytes()
    if isinstance(thing, list | tuple):
        return kind.__name__, [fingerprint(part) for part in thing]
    if kind is dict:
        return [(key, fingerprint(part)) for key, part in thing.items()]
    return tuple(leaves(thing))


def expect_equal(one: Any, other: Any, what: str, ignored: tuple[str, ...] = ()) -> None:
    """Raise an AssertionError that names the paths at which two objects differ."""
    paths = different(one, other, ignored)
    assert not paths, f'{what}: {paths[:20]}'


def carry(
    source: Any, target: Any, paths: tuple[str, ...], path: str = '', memo: Any = None
) -> None:
    """Give a new object what an operation keeps of a used one."""
    memo = {} if memo is None else memo  # what two attributes share, they share afterwards
    if isinstance(source, np.ndarray) and not source.dtype.names:
        _carry_rows(source, target, paths, path)
        return
    for name, part in _parts(source):
        here = f'{path}{name}'
        is_array = isinstance(part, np.ndarray) and not part.dtype.names
        if is_array and not matches(here, paths):
            _carry_rows(part, dict(_parts(target))[name], paths, here)
        elif matches(here, paths):
            _put(target, name, copy.deepcopy(part, memo))
        elif any(pattern.startswith((here, '*')) for pattern in paths):
            carry(part, dict(_parts(target))[name], paths, here, memo)


def _carry_rows(source: np.ndarray, target: np.ndarray, paths: tuple[str, ...], path: str) -> None:
    if any(pattern.startswith((path, '*')) for pattern in paths):
        for index, value in np.ndenumerate(source):
            if matches(path + ''.join(f'[{k}]' for k in index), paths):
                target[index] = value


def _put(target: Any, name: str, value: Any) -> None:
    now = dict(_parts(target))[name]
    if isinstance(now, np.ndarray) and now.shape == np.shape(value) and now.flags.writeable:
        now[...] = value  # views and kernels share its memory
    elif isinstance(target, deque | list):
        target[int(name[1:-1])] = value
    elif isinstance(target, np.record):
        setattr(target, name[1:], value)
    else:
        object.__setattr__(target, name[1:], value)


class Operation(NamedTuple):
    """What makes a used object as good as new."""

    apply: Callable[[Any], object]
    kept: tuple[str, ...] = ()  # paths that keep what they were, as the docstring says
    continued: tuple[str, ...] = ()
    """Paths of random streams and clocks, which go on; and what follows from what is kept."""
    scratch: tuple[str, ...] = ()
    """Paths that are written before they are read again: work space and unused rows."""
    built: Callable[[], Any] | None = None
    """Builds an object that is already as the operation makes one."""


class Stateful(NamedTuple):
    """How to build an object, and to use it."""

    make: Callable[[], Any]
    drive: Callable[[Any, random.Random], object]
    """Use it for a while, in all ways that change it; return what it answers."""
    operations: Mapping[str, Operation]


def check_fresh(entry: Stateful, operation: Operation, seeds: int = 2) -> None:
    """Assert that a used object is as a new one after the operation, but for what is kept.

    The whole state is compared, then all answers to further inputs. An exception that no history
    needs is an error too.
    """
    survivors = (*operation.kept, *operation.continued)
    exceptions = (*survivors, *operation.scratch)
    needed = set()
    for seed in range(seeds):
        used, other = entry.make(), entry.make()
        new = operation.built() if operation.built else entry.make()
        for part in range(seed % 2 + 1):  # each state is entered once or twice
            entry.drive(used, random.Random(f'{seed} {part}'))
        before = state_of(used)
        carry(used, new, survivors if operation.built is None else ())
        for each in (used, other) if operation.built else (used, new, other):
            operation.apply(each)
        if operation.built:
            assert not different(other, new, operation.scratch), 'a new one is not as one built so'
            carry(used, new, survivors)
        after, expected = state_of(used), state_of(new)
        wrong = [p for p in changes(before, after) if matches(p, operation.kept)]
        assert not wrong, f'not kept: {wrong}'
        if exceptions:
            usual = state_of(other)
            unlike = changed(after, usual) + changed(expected, usual)
            needed |= {each for each in exceptions if any(matches(p, (each,)) for p in unlike)}
        wrong = changed(after, expected, operation.scratch)
        assert not wrong, f'state: {wrong[:20]}'
        answers = [entry.drive(each, random.Random(f'next {seed}')) for each in (used, new)]
        expect_equal(*answers, 'answers')
        expect_equal(used, new, 'state after further inputs', operation.scratch)
    idle = {*operation.continued, *operation.scratch} - needed
    assert not idle, f'an exception is not needed: {idle}'


# -- parameters -----------------------------------------------------------------------------------


class Configured(NamedTuple):
    """How to build an object with parameters, and to replace them."""

    parameters: Any
    make: Callable[[Any], Any]
    replace: Callable[[Any, Any], object]
    drive: Callable[[Any, random.Random], object]
    elsewhere: tuple[str, ...] = ()
    """Beginnings of names: the entry of a part, or of the whole, shows the effect."""
    triggers: tuple[str, ...] = ()  # parameters of which the change, not the value, has an effect
    late: tuple[str, ...] = ()  # paths that follow the parameters in the next step
    settle: Callable[[Any], object] = lambda thing: None
    """Renews what is kept on purpose when the parameters change."""


def alternatives(parameters: Any, spec: Any) -> Iterator[Any]:
    """Yield the parameters with other values of one of them, if it is dynamic."""
    now = parameters.to_dict()[spec.name]
    values: tuple[Any, ...] = (not now,) if spec.kind is bool else spec.choices
    if spec.dynamic and spec.kind in (int, float):
        around = (factor * now for factor in (1.25, 0.5, 1.03, 0.97, 4.0))
        values = (*around, spec.low, spec.high, 0.1, 1.0)
    for value in values if spec.dynamic else ():
        try:
            changed = parameters.with_values({spec.name: value})
        except (ValueError, TypeError):
            continue  # beyond its range, or contradicts another one
        if changed != parameters:
            yield changed


def check_configured(entry: Configured) -> None:
    """Assert that each dynamic parameter takes effect, and as if the object were built with it."""
    thing = entry.make(entry.parameters)
    usual = [entry.drive(thing, random.Random(seed)) for seed in (1, 2)]
    wrong, idle = {}, []
    for spec in entry.parameters.specs():
        shown = spec.name.startswith(entry.elsewhere)
        effects = not spec.dynamic or spec.name in entry.triggers
        for changed in alternatives(entry.parameters, spec):
            if effects or spec.name in wrong:
                break
            replaced, built = entry.make(entry.parameters), entry.make(changed)
            entry.replace(replaced, changed)
            for each in (replaced, built):
                entry.settle(each)
            paths = different(replaced, built, entry.late)
            if not shown:
                answers = [entry.drive(each, random.Random(1)) for each in (replaced, built)]
                if operator.ne(*map(fingerprint, answers)):
                    paths += different(*answers) or ['order']
            if paths:
                wrong[spec.name] = paths[:5]
            effects = shown or _takes_effect(entry, changed, usual)
        if not effects:
            idle.append(spec.name)
    assert not wrong, f'as built before: {wrong}'
    assert not idle, f'without effect: {idle}'


def check_all_at_once(entry: Configured) -> None:
    """Assert that an object with all its dynamic parameters replaced is as one built with them."""
    changed = entry.parameters
    for spec in entry.parameters.specs():
        if spec.name not in entry.triggers:
            changed = next(alternatives(changed, spec), changed)
    replaced, built = entry.make(entry.parameters), entry.make(changed)
    entry.replace(replaced, changed)
    for each in (replaced, built):
        entry.settle(each)
    expect_equal(replaced, built, 'state', entry.late)
    answers = [entry.drive(each, random.Random(1)) for each in (replaced, built)]
    expect_equal(*answers, 'answers')


def _takes_effect(entry: Configured, changed: Any, usual: list[list[object]]) -> bool:
    """Return whether parameters that are replaced after some use change what follows."""
    thing = entry.make(entry.parameters)
    entry.drive(thing, random.Random(1))
    entry.replace(thing, changed)
    pairs = itertools.zip_longest(entry.drive(thing, random.Random(2)), usual[1])
    return any(fingerprint(now) != fingerprint(before) for now, before in pairs)


def check_round_trip(entry: Configured) -> None:
    """Assert that parameters that are replaced and restored leave no trace, whatever the state."""
    used = entry.make(entry.parameters)
    entry.drive(used, random.Random(2))
    before, wrong = state_of(used, entry.late), {}
    for spec in entry.parameters.specs():
        for changed in itertools.islice(alternatives(entry.parameters, spec), 1):
            if spec.name not in entry.triggers:
                entry.replace(used, changed)
                entry.replace(used, entry.parameters)
                if paths := [*changes(before, state_of(used, entry.late))]:
                    wrong[spec.name] = paths[:5]
    assert not wrong, f'a trace is left: {wrong}'


# -- which classes there are ----------------------------------------------------------------------


def classes_of(packages: tuple[str, ...]) -> dict[str, type]:
    """Return the classes with a state of their own, by name: not frozen, no tuple, no error.

    A structure is the state of its owner.
    """
    found = {}
    for name in packages:
        package = importlib.import_module(f't3mpc_ros.{name}')
        for info in pkgutil.walk_packages(package.__path__, f'{package.__name__}.'):
            module = importlib.import_module(info.name)
            for kind in vars(module).values():
                if inspect.isclass(kind) and kind.__module__ == info.name and _may_change(kind):
                    found[kind.__name__] = kind
    return found


def _may_change(kind: type) -> bool:
    if issubclass(kind, tuple | BaseException | enum.Enum | Structure) or getattr(
        kind, '_is_protocol', False
    ):
        return False
    return not (dataclasses.is_dataclass(kind) and kind.__dataclass_params__.frozen)
