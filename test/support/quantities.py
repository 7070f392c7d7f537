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
"""Finds the quantities of a page, numbers with a unit, and what each is compared with.

A quantity is the default or a bound of a *parameter* that its paragraph names, the value of an
*expression* that ``docs/numbers.yaml`` gives for it, in a row of a table that the command of a
*record* has printed, or in a table that a *test* reads from the page. It is *stated* if it is
listed there with a reason why nothing of the repository has it, as a figure of a data sheet.

    PYTHONPATH=.:test .venv/bin/python -m support.quantities [PAGE ...]

counts the quantities of all pages, and lists those of some pages that are neither.
"""

from collections import Counter
from collections.abc import Iterator
import csv
from functools import cache
import inspect
import math
from pathlib import Path
import pkgutil
import re
import sys
from typing import Any, NamedTuple

import yaml

from support.checkout import ROOT
from t3mpc_ros.evaluation.cases import CASES
from t3mpc_ros.evaluation.confidence_intervals import interval, mean

DOCS = ROOT / 'docs'
LEDGER = DOCS / 'numbers.yaml'
sys.path.append(str(DOCS))  # the drawings are a source of quantities
GENERATED = {'nodes.md', 'api.md', 'equations.md', 'results_tables.md', 'radio_session.md'}
"""Pages that a program writes, or whose numbers are those of equations."""

SCALE = {
    unit: size
    for size, units in (
        (1.0, 's Hz m m/s m/s² rad rad/s rad/s² V A Ω W N Nm kg dBm B bytes bits baud'),
        (1.0, 'cores times seeds steps microsteps'),
        (1e3, 'kHz km kΩ kB kB/s kbit/s'),
        (1e6, 'MHz MB MB/s MB/h Mbit/s'),
        (1e9, 'GB GB/h'),
        (1e-2, 'cm %'),
        (1e-3, 'ms mm mm/s mrad mV mA mW g'),
        (1e-6, 'µs µm µF'),
        (1e-9, 'nF'),
        (60.0, 'min'),
        (3600.0, 'h'),
        (math.pi / 180.0, '° °/s'),
    )
    for unit in units.split()
} | {'': 1.0}
"""Units, and their size in SI."""
_UNIT = '|'.join(re.escape(unit) for unit in sorted(SCALE, key=len, reverse=True) if unit)
_NUMBER = r'\d+(?: \d{3})*(?:\.\d+)?'
_JOIN = r'(?:, | to | and | or | and again | / | × | ± | to |×|–)'
_QUANTITY = re.compile(
    rf'(?<![\w.`/^–-])((?:[-+−±]?{_NUMBER}{_JOIN})*[-+−±]?{_NUMBER})[ \u202f-]?({_UNIT})(?![\w/²])'
)
_NAME = re.compile(r'`(\.?[a-z_][\w.]*)`')


class Quantity(NamedTuple):
    """A number with its unit, and where it stands."""

    section: str
    block: str  # paragraph, item of a list, or row of a table
    text: str  # as ``numbers.yaml`` names it: ``0.25 s``
    number: str
    unit: str

    @property
    def value(self) -> float:
        """Value in SI."""
        return float(self.number.replace(' ', '').replace('−', '-')) * SCALE[self.unit]

    def shows(self, value: float) -> bool:
        """Return whether a value, rounded to the digits shown, is this quantity."""
        digits = len(self.number.partition('.')[2])
        half = 0.5 * 10.0**-digits * SCALE[self.unit]
        return abs(abs(self.value) - abs(value)) <= half * (1.0 + 1e-6)


def blocks_of(text: str) -> Iterator[tuple[str, str]]:
    """Yield section and text of each block, without code, links and generated tables."""
    text = re.sub(
        r'<!-- (?:begin of )?(\w[^>]*?)(?:: [^>]*)? -->\n.*?<!-- end of \1 -->\n',
        '\n\n',
        text,
        flags=re.DOTALL,
    )
    text = re.sub(r'```.*?```', '', text, flags=re.DOTALL)
    text = re.sub(r'\]\([^)]*\)|<!--.*?-->|^    .*$', ']', text, flags=re.MULTILINE)
    section, block = '', ''
    for line in [*text.splitlines(), '']:
        if (
            not line.strip()
            or line.startswith(('|', '#', '- ', '* '))
            or re.match(r'\d+\. ', line)
        ):
            if block:
                yield section, block
            block = ''
        if line.startswith('#'):
            section = line.lstrip('# ')
        else:
            block = f'{block} {line.strip()}'.strip()


def quantities(text: str) -> Iterator[Quantity]:
    """Yield the quantities of a page, each of a list (``1, 2 and 5 mm``) by itself."""
    for section, block in blocks_of(text):
        for found in _QUANTITY.finditer(block):
            numbers, unit = found.groups()
            for number in re.findall(rf'[-−]?{_NUMBER}', numbers):
                yield Quantity(section, block, f'{number} {unit}', number, unit)


@cache
def parameters() -> dict[str, list[list[tuple[str, str]]]]:
    """Return numbers and units of default and range of each parameter, node by node."""
    found: dict[str, list[list[tuple[str, str]]]] = {}
    for line in (DOCS / 'nodes.md').read_text(encoding='utf-8').splitlines():
        cells = line.split(' | ')
        if len(cells) >= 5 and (name := re.match(r'\| `([\w.]+)`$', cells[0])):
            pairs = [
                (number, unit)
                for cell in cells[1:3]
                for number, unit in re.findall(rf'(-?[\d.]+(?:e[-+]?\d+)?) ?({_UNIT})?', cell)
            ]
            found.setdefault(name[1], []).append(pairs)
    return found


def values_of(name: str) -> list[float]:
    """Return the default and the bounds of the parameters with a name, or that end with it."""
    end = name if name.startswith('.') else f'.{name}'
    return [
        float(number) * SCALE[unit]
        for full, nodes in parameters().items()
        if full == name or full.endswith(end)
        for pairs in nodes
        for number, unit in pairs
        if number.strip('.')
    ]


def of_parameter(quantity: Quantity) -> bool:
    """Return whether it is a value of a parameter that its block names."""
    return any(
        quantity.shows(value)
        for name in _NAME.findall(quantity.block)
        for value in values_of(name)
    )


_NEXT = (
    re.compile(rf'`(\.?[a-z_][\w.]*)` \(({_NUMBER}) ?({_UNIT})[,)]'),
    re.compile(rf'({_NUMBER}) ?({_UNIT}) \(`(\.?[a-z_][\w.]*)`\)'),
)


def stated_defaults(text: str) -> Iterator[tuple[str, Quantity]]:
    """Yield what a page gives as the value of a parameter: ```name` (2 s)``, ``2 s (`name`)``."""
    for section, block in blocks_of(text):
        for found in _NEXT[0].finditer(block):
            name, number, unit = found.groups()
            yield name, Quantity(section, block, f'{number} {unit}', number, unit)
        for found in _NEXT[1].finditer(block):
            number, unit, name = found.groups()
            yield name, Quantity(section, block, f'{number} {unit}', number, unit)


_WORD = re.compile(r"'[^']*'|\$[a-z][\w.]*|(?<!\.)\b[A-Z][A-Z\d_]{3,}|\b[a-z]\w*\.[\w.]+")


def evaluated(expression: object) -> float:
    """Return the value of an expression of names.

    They are dotted names of the package, ``$parameters``, constants of the firmware or the live
    page, and :data:`FUNCTIONS` of what was measured.
    """
    names: dict[str, object] = dict(FUNCTIONS)

    def named(found: re.Match[str]) -> str:
        text = found[0]
        key = f'_{len(names)}'
        if text[0] == "'":
            return text
        if text[0] == '$':
            names[key] = default_of(text[1:])
        else:
            names[key] = constants()[text] if text[0].isupper() else value_of(text)
        return key

    text = _WORD.sub(named, str(expression))
    return float(eval(text, {'__builtins__': {}}, names))


@cache
def recorded_lines(name: str) -> list[str]:
    """Return the lines of a record that ``bench/record.py`` has written, without emphasis."""
    path = DOCS / 'measured' / f'{name}.txt'
    text = (path if path.exists() else DOCS / f'{name}.md').read_text(encoding='utf-8')
    return [plain(line) for line in text.splitlines()]


def plain(line: str) -> str:
    """Return a line without emphasis."""
    return ' '.join(line.replace('*', '').split())


def record(name: str, row: str, column: str | int = 0, number: int = 0, table: str = '') -> float:
    """Return a number of the first recorded line that begins with a name, after a title.

    A row of a table has columns, by their heading or their place after the name.
    """
    lines = recorded_lines(name)
    begin = next(n for n, line in enumerate(lines) if table in line)
    lines = lines[begin:]
    named = [n for n, line in enumerate(lines) if line.startswith(f'| {row} |')]
    at = min(
        named or [n for n, line in enumerate(lines) if line.removeprefix('| ').startswith(row)]
    )
    cell = lines[at].removeprefix('| ').removeprefix(row)
    if lines[at].startswith('|'):
        cells = lines[at].strip('| ').split(' | ')
        if isinstance(column, str):
            top = max(n for n in range(at) if lines[n].startswith('|---'))
            column = lines[top - 1].strip('| ').split(' | ').index(column) - 1
        cell = cells[1 + column]
    return float(re.findall(r'[-+−]?\d+(?:\.\d+)?', cell)[number].replace('−', '-'))


@cache
def result_rows() -> list[dict[str, str]]:
    """Return the rows of ``docs/results_runs.csv``."""
    with (DOCS / 'results_runs.csv').open(encoding='utf-8') as file:
        return list(csv.DictReader(file))


@cache
def runs(robot: str, case: str, method: str, metric: str = 'overall') -> tuple[float, ...]:
    """Return a metric of the runs of ``docs/results_runs.csv``, in the order of their seeds."""
    found = {
        int(row['seed']): float(row[metric])
        for row in result_rows()
        if (row['robot'], row['case'], row['controller']) == (robot, case, method)
    }
    assert len(found) == 6, (robot, case, method)
    return tuple(found[seed] for seed in sorted(found))


def case(name: str, parameter: str) -> float:
    """Return a parameter of the robot in a case of the comparisons."""
    value = CASES[name].changes[parameter]
    assert isinstance(value, float), (name, parameter)
    return value


def trials(name: str, column: str, begins: str = '') -> list[float]:
    """Return the values of a column of ``docs/measured/NAME.csv``, of rows that begin so."""
    with (DOCS / 'measured' / f'{name}.csv').open(encoding='utf-8') as file:
        rows = list(csv.reader(file))
    at = rows[0].index(column)
    return [float(row[at]) for row in rows[1:] if row[0].startswith(begins) and row[at]]


_VALUE = re.compile(rf'({_NUMBER}) ?({_UNIT})')


def value_with_unit(text: str) -> float:
    """Return the value of ``30 kΩ`` in SI."""
    found = _VALUE.search(text)
    assert found, text
    return float(found[1].replace(' ', '')) * SCALE[found[2]]


def sheet(name: str) -> float:
    """Return a value that ``docs/numbers.yaml`` declares from a data sheet."""
    (text,) = [values[name] for values in ledger()[SHEETS].values() if name in values]
    return value_with_unit(text)


def component(name: str) -> float:
    """Return the value of a component of the schematics."""
    text = (DOCS / 'schematic.py').read_text(encoding='utf-8')
    found = re.search(rf"'[^']*\b{name}\b[^']*?(?:\\n| )({_NUMBER} ?(?:{_UNIT}))", text)
    assert found, name
    return value_with_unit(found[1])


SHEETS = 'data sheets'
"""Entry of ``docs/numbers.yaml`` with the values of data sheets, by their source."""
CONFIDENCE = inspect.signature(interval).parameters['confidence'].default

FUNCTIONS = {
    'record': record,
    'runs': runs,
    'case': case,
    'trials': trials,
    'number': float,
    'sheet': sheet,
    'component': component,
    'confidence': CONFIDENCE,
    'mean': mean,
    'interval': interval,
    **{one.__name__: one for one in (min, max, sum, abs, len, math.log, math.radians)},
    'pi': math.pi,
}
"""What an expression may call."""


def value_of(name: str) -> object:
    """Return what a dotted name of the package is; of a field of a dataclass, its default."""
    owner, _, last = name.rpartition('.')
    home = '' if owner.startswith(('drawings', 'bench.')) else 't3mpc_ros.'
    found: object = pkgutil.resolve_name(f'{home}{owner}')
    if isinstance(found, type):
        fields = getattr(found, '__dataclass_fields__', {})
        defaults = {name: field.default for name, field in fields.items()}
        defaults |= getattr(found, '_field_defaults', {})
        if last in defaults:
            return defaults[last]
    return getattr(found, last)


@cache
def constants() -> dict[str, float]:
    """Return the constants of the firmware, and of the live page, that are plain numbers."""
    form = r'(?:#define|const) (\w+) (?:= )?(?:U?INT\d+_C\()?(\d+)u?\)?(?=[\s;])'
    folders = (ROOT / 'firmware' / 'core', ROOT / 't3mpc_ros' / 'view' / 'page')
    files = [file for folder in folders for file in folder.iterdir()]
    texts = [file.read_text('utf-8') for file in files if file.suffix in ('.h', '.c', '.js')]
    return {name: float(value) for text in texts for name, value in re.findall(form, text)}


def default_of(name: str) -> float:
    """Return the default of a parameter, the same in all nodes that have it."""
    (value,) = {float(pairs[0][0]) * SCALE[pairs[0][1]] for pairs in parameters()[name]}
    return value


@cache
def ledger() -> dict[str, dict[str, dict[str, Any]]]:
    """Return ``docs/numbers.yaml``: page, section, then expressions by quantity."""
    content: dict[str, dict[str, dict[str, Any]]] = yaml.safe_load(
        LEDGER.read_text(encoding='utf-8')
    )
    return content


def pages() -> list[Path]:
    """Return the pages whose quantities need a source."""
    written = [page for page in DOCS.glob('*.md') if page.name not in GENERATED]
    return [ROOT / 'README.md', *sorted(written)]


@cache
def sources(page: Path) -> list[tuple[Quantity, str]]:
    """Return each quantity of a page with what has it, ``stated``, or an empty string."""
    return list(_sources(page))


def _sources(page: Path) -> Iterator[tuple[Quantity, str]]:
    known = ledger().get(page.name, {})
    for one in quantities(page.read_text(encoding='utf-8')):
        entries = known.get('*', {}) | known.get(one.section, {})
        given = entries.get(one.text)
        row = one.block.startswith('|')
        if of_parameter(one):
            yield one, 'parameter'
        elif given is not None and one.shows(evaluated(given)):
            yield one, 'expression'
        elif row and 'record' in entries and plain(one.block) in recorded_lines(entries['record']):
            yield one, 'record'
        elif row and 'test' in entries:
            yield one, 'test'
        elif any(one.text in texts for texts in entries.get('stated', {}).values()):
            yield one, 'stated'
        else:
            yield one, ''


def main() -> None:
    """Count the quantities of the pages, and list what is not compared."""
    shown, total = sys.argv[1:], Counter[str]()
    for page in pages():
        found = sources(page)
        count = Counter(kind for _, kind in found)
        total += count
        print(f'{page.name:20} {len(found):4}', dict(count))
        for one, kind in found if page.name in shown else ():
            if not kind:
                at = max(one.block.find(one.text.split()[0]) - 40, 0)
                print(f'  {one.section[:20]:20} {one.text:12} {one.block[at : at + 100]}')
    print(f'{"all":20} {total.total():4}', dict(total))


if __name__ == '__main__':
    main()
