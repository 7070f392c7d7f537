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
"""The state of an object, for comparisons of a used one with a new one."""

from collections.abc import Mapping, Set
import dataclasses
import enum
from types import GenericAlias, ModuleType

import numpy as np

_PLAIN = (type(None), bool, int, float, complex, str, bytes, bytearray)


def state(thing, origin_ns=0):
    """Return all that an object holds, by the path to it: plain values, as text.

    Times are relative to ``origin_ns``. Functions, threads, locks, files and other objects that
    are not of the package have no state here.
    """
    found = {}
    _walk(thing, '', found, origin_ns, set())
    return found


def differences(used, fresh, kept=(), used_ns=0, fresh_ns=0):
    """Return the paths in which two objects differ, without those that begin with ``kept``."""
    one, other = state(used, used_ns), state(fresh, fresh_ns)
    return {
        path: (one.get(path), other.get(path))
        for path in sorted(one.keys() | other.keys())
        if one.get(path) != other.get(path) and not path.startswith(tuple(kept))
    }


def _walk(thing, path, found, origin_ns, above):
    if isinstance(thing, enum.Enum):
        found[path] = f'{thing!r}'
    elif isinstance(thing, _PLAIN):
        is_time = origin_ns and isinstance(thing, int) and path.rstrip(']').endswith('_ns')
        is_time = is_time and thing > origin_ns // 2  # others are durations
        found[path] = f'now {thing - origin_ns:+d}' if is_time else f'{thing!r}'
    elif isinstance(thing, np.ndarray | np.generic):
        found[path] = f'{thing.dtype} {thing.shape} {thing.tobytes().hex()}'
    elif id(thing) in above or isinstance(thing, type | ModuleType | GenericAlias):
        return
    else:
        _walk_parts(thing, path, found, origin_ns, above | {id(thing)})


def _walk_parts(thing, path, found, origin_ns, above):
    if isinstance(thing, Mapping):
        parts = {f'{path}[{key!r}]': value for key, value in thing.items()}
    elif hasattr(thing, '_asdict'):
        parts = {f'{path}.{name}': value for name, value in thing._asdict().items()}
    elif isinstance(thing, Set):
        found[path] = f'{sorted(map(repr, thing))}'
        return
    elif hasattr(thing, '__len__') and hasattr(thing, '__iter__'):
        parts = {f'{path}[{number}]': value for number, value in enumerate(thing)}
        found[f'{path}.len'] = f'{len(thing)}'
    elif type(thing).__module__.startswith('t3mpc_ros'):
        names = [*getattr(thing, '__dict__', ())]
        if dataclasses.is_dataclass(thing):
            names += [field.name for field in dataclasses.fields(thing) if field.name not in names]
        parts = {f'{path}.{name}'.lstrip('.'): getattr(thing, name) for name in names}
    else:
        return
    for name, value in parts.items():
        _walk(value, name, found, origin_ns, above)
