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
"""Parameter tables: frozen dataclasses whose fields carry default, unit, range and description.

A module declares its parameters as a subclass of :class:`Parameters`. ROS parameters, YAML files,
the documentation and recorded bags all use that one table. Tables nest: a field made with
:func:`group` holds another table, whose parameters get dotted names (``law.gain``). A value that
nobody has a reason to set is a class variable beside them, a constant.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from decimal import ROUND_CEILING, ROUND_FLOOR, Context
import difflib
from functools import partial
import math
import re
from typing import Any, ClassVar, NamedTuple, Self, get_args, get_origin, get_type_hints

Value = (
    bool
    | int
    | float
    | str
    | tuple[bool, ...]
    | tuple[int, ...]
    | tuple[float, ...]
    | tuple[str, ...]
)


class ParameterError(ValueError):
    """An invalid parameter; the text contains its name, the bound and the value."""


def at_least(bound: float, digits: int = 3) -> str:
    """Return a computed lower bound as text, rounded up so that the bound named is accepted."""
    return f'{float(Context(digits, ROUND_CEILING).create_decimal(repr(float(bound)))):g}'


def at_most(bound: float, digits: int = 3) -> str:
    """Return a computed upper bound as text, rounded down so that the bound named is accepted."""
    return f'{float(Context(digits, ROUND_FLOOR).create_decimal(repr(float(bound)))):g}'


def nearest_name(name: str, known: Iterable[str]) -> str:
    """Return the known name that is nearest to an unknown one, '' without one.

    The last part of a dotted name is enough: ``rate`` is near to ``play.rate``.
    """
    names = list(known)
    by_leaf = {each.rpartition('.')[2]: each for each in reversed(names)}
    if name in by_leaf:
        return by_leaf[name]
    near = difflib.get_close_matches(name, [*names, *by_leaf], n=1)
    return by_leaf.get(near[0], near[0]) if near else ''


def nearest_hint(name: str, known: Iterable[str]) -> str:
    """Return a hint at the known name that is nearest to an unknown one, '' without one."""
    near = nearest_name(name, known)
    return f'; did you mean {near}?' if near else ''


def number_hint(value: object) -> str:
    """Return a hint for a number that YAML reads as text, such as ``1e-3``; otherwise ''."""
    try:
        number = isinstance(value, str) and math.isfinite(float(value))
    except ValueError:
        return ''
    return ', which YAML reads as text; write -0.9 or 1.0e-3' if number else ''


def short_name(name: str) -> str:
    """Return ``name`` in lower case with one hyphen for whatever is no letter or digit."""
    return re.sub(r'[^a-z0-9]+', '-', name.lower()).strip('-')


def find_names(kind: str, names: Sequence[str], known: Iterable[str]) -> tuple[str, ...]:
    """Return the named entries of ``known`` in its order; case and punctuation are ignored.

    Unless they tell two entries apart: ``mass +30 %`` and ``mass -30 %`` must be written in full.
    """
    known = tuple(known)
    wanted = set()
    for name in names:
        short = short_name(str(name))
        found = [name] if name in known else [each for each in known if short_name(each) == short]
        if len(found) != 1:
            by_short_name = {short_name(each): each for each in known}
            near = difflib.get_close_matches(short, by_short_name, n=1)
            hint = f'; did you mean {by_short_name[near[0]]}?' if near else ''
            between = '; ' if any(',' in each for each in known) else ', '
            raise ValueError(f'{kind} must be one of {between.join(known)}: got {name}{hint}')
        wanted |= {*found}
    return tuple(name for name in known if name in wanted)


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """Name, type, default, range and description of one parameter."""

    name: str
    """ROS name."""
    kind: type
    """Element type: ``bool``, ``int``, ``float`` or ``str``."""
    many: bool
    """Whether the value is a tuple of ``kind``."""
    default: Value
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    dynamic: bool
    """Whether it may change while a node runs; otherwise it is read-only."""
    text: str
    source: str
    """Origin of the default: ``assumed`` unless a paper or data sheet gives it."""

    def check(self, value: object) -> Value:
        """Return ``value`` converted to the parameter's type, or raise :class:`ParameterError`."""
        if self.many:
            if isinstance(value, str) or not hasattr(value, '__iter__'):
                raise ParameterError(
                    f'{self.name} must be a list of {self.kind.__name__}: got {value!r}'
                )
            return tuple(self._check_one(item) for item in value)  # type: ignore[return-value]
        return self._check_one(value)

    def default_text(self) -> str:
        """Return the default with its unit, empty for an empty text or list."""
        many = isinstance(self.default, tuple)
        text = ', '.join(map(str, self.default)) if many else str(self.default)  # type: ignore[arg-type]
        return f'{text} {self.unit}'.rstrip() if text else ''

    def bounds_text(self) -> str:
        """Return the range as text, empty when every value of the type is valid."""
        if self.choices:
            return 'one of ' + ', '.join(self.choices)
        unit = f' {self.unit}' if self.unit else ''
        if self.low is not None and self.high is not None:
            return f'from {self.low:g} to {self.high:g}{unit}'
        if self.low is not None:
            return f'at least {self.low:g}{unit}'
        if self.high is not None:
            return f'at most {self.high:g}{unit}'
        return ''

    def _check_one(self, value: object) -> bool | int | float | str:
        if self.kind is float and isinstance(value, int) and not isinstance(value, bool):
            try:
                value = float(value)
            except OverflowError:
                raise ParameterError(f'{self.name} must be {self.bounds_text()}') from None
        if type(value) is not self.kind:
            hint = number_hint(value) if self.kind is float else ''
            raise ParameterError(
                f'{self.name} must be {_TYPE_NAMES[self.kind]}: got {value!r}{hint}'
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise ParameterError(f'{self.name} must be finite: got {value}')
        if self.choices and value not in self.choices:
            raise ParameterError(f'{self.name} must be {self.bounds_text()}: got {value!r}')
        if isinstance(value, int | float) and not (
            (self.low is None or value >= self.low) and (self.high is None or value <= self.high)
        ):
            raise ParameterError(f'{self.name} must be {self.bounds_text()}: got {value:g}')
        assert isinstance(value, bool | int | float | str)
        return value


_TYPE_NAMES = {bool: 'true or false', int: 'a whole number', float: 'a number', str: 'a text'}


def parameter(
    default: Value,
    text: str,
    unit: str = '',
    bounds: tuple[float | None, float | None] = (None, None),
    *,
    name: str = '',
    choices: tuple[str, ...] = (),
    dynamic: bool = False,
    source: str = 'assumed',
) -> Any:
    """Return a dataclass field that is one parameter of its table.

    ``name`` is the ROS name within the table, which may contain dots; without it the attribute
    gives the name, after the table's ``prefix``. Lower and upper bound are inclusive, None is
    none; for a tuple they apply to each element.
    """
    details = {
        'unit': unit,
        'low': bounds[0],
        'high': bounds[1],
        'choices': choices,
        'dynamic': dynamic,
        'text': text,
        'source': source,
    }
    return field(default=default, metadata={'spec': details, 'name': name})


def with_default(table: type['Parameters'], attribute: str, default: Value) -> Any:
    """Return the field of a parameter of a base table, with another default."""
    inherited = next(each for each in fields(table) if each.name == attribute)
    return field(default=default, metadata=inherited.metadata)


def group(
    table: type['Parameters'],
    *,
    inline: bool = False,
    fixed: tuple[str, ...] = (),
    **defaults: Value,
) -> Any:
    """Return a dataclass field that holds another table, with some of its defaults replaced.

    Its parameters are named ``<attribute>.<name>``; with ``inline`` they have no prefix. Those
    named ``fixed`` are constants in this group: it has them with their defaults alone.
    """
    return field(
        default_factory=partial(table, **defaults), metadata={'inline': inline, 'fixed': fixed}
    )


@dataclass(frozen=True)
class Parameters:
    """Base of every table: validates itself, and converts from and to values by ROS name.

    Subclasses are frozen dataclasses; :meth:`check_consistency` checks relations between
    parameters.
    """

    prefix = ''

    def __post_init__(self) -> None:
        for entry in _entries(type(self)):
            if len(entry.path) == 1:
                name = entry.path[0]
                object.__setattr__(self, name, entry.spec.check(getattr(self, name)))
        self.check_consistency()

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` when values that are each in range contradict."""

    @classmethod
    def specs(cls) -> tuple[ParameterSpec, ...]:
        """Return every parameter, groups included, in order of declaration.

        ParameterError if two have the same name, or one name is a prefix of another.
        """
        return tuple(entry.spec for entry in _entries(cls))

    @classmethod
    def class_constants(cls) -> dict[str, Value]:
        """Return the class variables by ROS name, groups included.

        They were parameters once: older files and bags may hold them, with this value alone.
        """
        return _constants(cls).copy()

    @classmethod
    def from_dict(cls, values: Mapping[str, object]) -> Self:
        """Return the table with ``values`` (by ROS name) in place of the defaults."""
        return cls().with_values(values)

    def with_values(self, values: Mapping[str, object]) -> Self:
        """Return a copy with some values replaced, validated as a whole.

        ParameterError for an unknown name (with the nearest known one), a wrong type, a value out
        of range, another value of a constant, or values that contradict.
        """
        known = {entry.spec.name: entry for entry in _entries(type(self))}
        checked: dict[tuple[str, ...], Value] = {}
        for name, value in values.items():
            if name in known:
                # Before the group checks itself, so that the error contains the full name.
                checked[known[name].path] = known[name].spec.check(value)
            elif (constant := _constants(type(self)).get(name)) is None:
                raise ParameterError(f'there is no parameter {name}{nearest_hint(name, known)}')
            elif (tuple(value) if isinstance(value, list) else value) != constant:
                raise ParameterError(
                    f'{name} is no longer a parameter, it is always {constant}: got {value}'
                )
        return self._replace(checked)

    def check_read_only(self, after: Self) -> None:
        """Raise :class:`ParameterError` when a read-only value differs in ``after``."""
        old, new = self.to_dict(), after.to_dict()
        for spec in self.specs():
            if not spec.dynamic and old[spec.name] != new[spec.name]:
                raise ParameterError(
                    f'{spec.name} is read-only (it is {old[spec.name]}): got {new[spec.name]}'
                )

    def to_dict(self) -> dict[str, Value]:
        """Return every value by ROS name."""
        return {entry.spec.name: entry.value_of(self) for entry in _entries(type(self))}

    def _replace(self, values: Mapping[tuple[str, ...], Value]) -> Self:
        """Return a copy with the values at some attribute paths replaced."""
        updates: dict[str, Any] = {}
        groups: dict[str, dict[tuple[str, ...], Value]] = {}
        for (head, *rest), value in values.items():
            if rest:
                groups.setdefault(head, {})[tuple(rest)] = value
            else:
                updates[head] = value
        for head, inner in groups.items():
            updates[head] = getattr(self, head)._replace(inner)
        return replace(self, **updates)


class _Entry(NamedTuple):
    """One parameter of a table, and where its value is."""

    spec: ParameterSpec
    path: tuple[str, ...]
    """Attributes from the table to the value."""

    def value_of(self, table: Parameters) -> Value:
        owner: Any = table
        for name in self.path:
            owner = getattr(owner, name)
        value: Value = owner
        return value


_tables: dict[object, tuple[_Entry, ...]] = {}
"""Parameters of each table, collected when it is first used."""


def _entries(table: type[Parameters]) -> tuple[_Entry, ...]:
    """Return the parameters of a table, or raise when their names clash."""
    if table not in _tables:
        entries = tuple(_declared(table))
        _check_names(table.__name__, [entry.spec.name for entry in entries])
        _tables[table] = entries
    return _tables[table]


_constant_tables: dict[object, dict[str, Value]] = {}
"""Constants of each table, collected when they are first asked for."""


def _constants(table: type[Parameters]) -> dict[str, Value]:
    if table not in _constant_tables:
        _constant_tables[table] = dict(_declared_constants(table))
    return _constant_tables[table]


def _declared_constants(table: type[Parameters]) -> Iterator[tuple[str, Value]]:
    groups = {item.name: item for item in fields(table)}
    for name, hint in get_type_hints(table).items():
        if get_origin(hint) is ClassVar:
            value = getattr(table, name)
            nested = isinstance(value, Parameters)
            held = (value.to_dict() | value.class_constants()).items() if nested else [('', value)]
        elif isinstance(hint, type) and issubclass(hint, Parameters):
            defaults = groups[name].default_factory().to_dict()  # type: ignore[operator]
            fixed = ((key, defaults[key]) for key in groups[name].metadata['fixed'])
            held = (*fixed, *_constants(hint).items())
        else:
            continue
        inline = name in groups and groups[name].metadata.get('inline')
        for inner, constant in held:
            yield '.'.join(part for part in ('' if inline else name, inner) if part), constant


def _check_names(table: str, names: list[str]) -> None:
    for position, name in enumerate(names):
        if name in names[:position]:
            raise ParameterError(f'{table} has two parameters {name}')
        parts = name.split('.')
        for count in range(1, len(parts)):
            prefix = '.'.join(parts[:count])
            if prefix in names:
                raise ParameterError(f'{table} has the parameters {prefix} and {name}')


def _declared(table: type[Parameters]) -> Iterator[_Entry]:
    hints = get_type_hints(table)
    for item in fields(table):
        hint = hints[item.name]
        if 'spec' in item.metadata:
            many = get_origin(hint) is tuple
            kind = get_args(hint)[0] if many else hint
            name = item.metadata['name'] or table.prefix + item.name
            default: Any = item.default
            spec = ParameterSpec(name, kind, many, default, **item.metadata['spec'])
            yield _Entry(spec, (item.name,))
        elif isinstance(hint, type) and issubclass(hint, Parameters):
            prefix = '' if item.metadata.get('inline') else f'{item.name}.'
            defaults = item.default_factory()  # type: ignore[operator]
            for entry in _entries(hint):
                if entry.spec.name in item.metadata['fixed']:
                    continue
                spec = replace(
                    entry.spec,
                    name=prefix + entry.spec.name,
                    default=entry.value_of(defaults),
                )
                yield _Entry(spec, (item.name, *entry.path))
