# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Parameter tables: frozen dataclasses whose fields carry default, unit, range and description."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
import difflib
from functools import partial
import math
from typing import Any, Self, get_args, get_origin, get_type_hints

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
    """A setting that cannot be used; the text names the setting, the bound and the value."""


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One line of the table: everything a person or a program needs to know of a setting."""

    name: str
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
    """Whether it may change while a node runs."""
    text: str
    source: str
    """Where the default comes from: ``assumed`` unless a paper or data sheet gives it."""

    def check(self, value: object) -> Value:
        """Return ``value`` as this row's type, or raise :class:`ParameterError`."""
        if self.many:
            if isinstance(value, str) or not hasattr(value, '__iter__'):
                raise ParameterError(
                    f'{self.name} must be a list of {self.kind.__name__}: got {value!r}'
                )
            return tuple(self._check_one(item) for item in value)  # type: ignore[return-value]
        return self._check_one(value)

    def bounds(self) -> str:
        """Return the range in words, empty when anything of the type goes."""
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
            value = float(value)
        if type(value) is not self.kind:
            raise ParameterError(f'{self.name} must be {_TYPE_NAMES[self.kind]}: got {value!r}')
        if isinstance(value, float) and not math.isfinite(value):
            raise ParameterError(f'{self.name} must be finite: got {value}')
        if self.choices and value not in self.choices:
            raise ParameterError(f'{self.name} must be {self.bounds()}: got {value!r}')
        if isinstance(value, int | float) and not (
            (self.low is None or value >= self.low) and (self.high is None or value <= self.high)
        ):
            raise ParameterError(f'{self.name} must be {self.bounds()}: got {value:g}')
        assert isinstance(value, bool | int | float | str)
        return value


_TYPE_NAMES = {bool: 'true or false', int: 'a whole number', float: 'a number', str: 'a text'}


def parameter(
    default: Value,
    text: str,
    *,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    dynamic: bool = False,
    source: str = 'assumed',
) -> Any:
    """Return a dataclass field that carries its row of the table.

    Bounds are inclusive; those of a tuple hold for each element.
    """
    details = {
        'unit': unit,
        'low': low,
        'high': high,
        'choices': choices,
        'dynamic': dynamic,
        'text': text,
        'source': source,
    }
    return field(default=default, metadata={'row': details})


def group(table: type['Parameters'], **changed: Value) -> Any:
    """Return a dataclass field that holds another table, at its defaults but for ``changed``."""
    return field(default_factory=partial(table, **changed))


@dataclass(frozen=True)
class Parameters:
    """Base of every table: checks itself when made, flattens, and names what it does not know.

    Subclasses are frozen dataclasses; relations between settings go into :meth:`check_together`.
    """

    def __post_init__(self) -> None:
        for row in self._own_rows():
            object.__setattr__(self, row.name, row.check(getattr(self, row.name)))
        self.check_consistency()

    def check_consistency(self) -> None:
        """Raise :class:`ParameterError` when settings that are each in range do not fit together."""

    @classmethod
    def rows(cls) -> tuple[ParameterSpec, ...]:
        """Return every row, nested ones with dotted names, in order of declaration."""
        return tuple(cls._walk(''))

    @classmethod
    def from_dict(cls, values: Mapping[str, object]) -> Self:
        """Return the table with ``values`` (dotted names) in place of the defaults."""
        return cls().with_values(values)

    def with_values(self, values: Mapping[str, object]) -> Self:
        """Return a copy with some rows replaced, checked as a whole.

        Raises
        ------
        ParameterError
            For an unknown name (with the nearest known one), a wrong type, a value out of range,
            or values that do not fit together.
        """
        known = {row.name: row for row in self.rows()}
        for name in values:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f'; did you mean {near[0]}?' if near else ''
                raise ParameterError(f'there is no setting {name}{hint}')
        # Checked here too, so that a nested setting is named in full.
        return self._changed({name: known[name].check(value) for name, value in values.items()})

    def to_dict(self) -> dict[str, Value]:
        """Return every value under its dotted name."""
        result: dict[str, Value] = {}
        for row in self.rows():
            owner: Any = self
            for part in row.name.split('.'):
                owner = getattr(owner, part)
            result[row.name] = owner
        return result

    def _changed(self, values: Mapping[str, Value]) -> Self:
        updates: dict[str, Any] = {}
        deeper: dict[str, dict[str, Value]] = {}
        for name, value in values.items():
            head, _, rest = name.partition('.')
            if rest:
                deeper.setdefault(head, {})[rest] = value
            else:
                updates[head] = value
        for head, inner in deeper.items():
            updates[head] = getattr(self, head)._changed(inner)
        return replace(self, **updates)

    @classmethod
    def _own_rows(cls) -> Iterator[ParameterSpec]:
        hints = get_type_hints(cls)
        for item in fields(cls):
            if 'row' not in item.metadata:
                continue
            hint = hints[item.name]
            many = get_origin(hint) is tuple
            kind = get_args(hint)[0] if many else hint
            default: Any = item.default
            yield ParameterSpec(item.name, kind, many, default, **item.metadata['row'])

    @classmethod
    def _walk(cls, prefix: str) -> Iterator[ParameterSpec]:
        hints = get_type_hints(cls)
        own = {row.name: row for row in cls._own_rows()}
        for item in fields(cls):
            if item.name in own:
                row = own[item.name]
                yield replace(row, name=prefix + row.name)
            elif is_dataclass(hints[item.name]) and issubclass(hints[item.name], Parameters):
                defaults = item.default_factory().to_dict()  # type: ignore[operator]
                for row in hints[item.name]._walk(''):
                    yield replace(
                        row, name=f'{prefix}{item.name}.{row.name}', default=defaults[row.name]
                    )
