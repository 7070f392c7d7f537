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
"""Finds the quantities of a page, numbers with a unit, and where they come from.

A quantity counts as *checked* if it is the default or a bound of a parameter that its paragraph
names, or the value of an expression, or of a file of results, that ``docs/numbers.yaml`` gives for
its page. Others are *attributed* to what ``numbers.yaml`` names for their section: the program
that measured them, a data sheet, the conditions of a measurement.

    PYTHONPATH=.:test .venv/bin/python -m support.quantities [PAGE ...]

lists the quantities of pages that are not checked, with the section and what they come from.
"""

from collections.abc import Iterator
from functools import cache
import math
from pathlib import Path
import pkgutil
import re
import sys
from typing import NamedTuple

import yaml

from support.checkout import ROOT

DOCS = ROOT / 'docs'
LEDGER = DOCS / 'numbers.yaml'
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
    block: str
    """Paragraph, item of a list, or row of a table."""
    text: str
    """As ``numbers.yaml`` names it: ``0.25 s``."""
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


def evaluated(expression: object) -> float:
    """Return the value of an expression of names.

    They are dotted names of the package, ``$parameters``, and constants of the firmware (``T3_``).
    """
    names: dict[str, object] = {}

    def named(found: re.Match[str]) -> str:
        text = found[0]
        key = f'_{len(names)}'
        if text[0] == '$':
            names[key] = default_of(text[1:])
        else:
            names[key] = (
                firmware()[text] if text[0] == 'T' else pkgutil.resolve_name(f't3mpc_ros.{text}')
            )
        return key

    text = re.sub(r'\$[a-z][\w.]*|\bT3_\w+|\b[a-z]\w*\.[\w.]+', named, str(expression))
    return float(eval(text, {'__builtins__': {}}, names))


@cache
def firmware() -> dict[str, float]:
    """Return the constants of the firmware that are plain numbers."""
    form = r'#define (T3_\w+) +(?:U?INT\d+_C\()?(\d+)u?\)?(?=\s)'
    texts = [file.read_text('utf-8') for file in (ROOT / 'firmware' / 'core').glob('*.h')]
    return {name: float(value) for text in texts for name, value in re.findall(form, text)}


def default_of(name: str) -> float:
    """Return the default of a parameter, the same in all nodes that have it."""
    (value,) = {float(pairs[0][0]) * SCALE[pairs[0][1]] for pairs in parameters()[name]}
    return value


@cache
def ledger() -> dict[str, dict[str, dict[str, object]]]:
    """Return ``docs/numbers.yaml``: page, section, then ``from`` and expressions by quantity."""
    content: dict[str, dict[str, dict[str, object]]] = yaml.safe_load(
        LEDGER.read_text(encoding='utf-8')
    )
    return content


def pages() -> list[Path]:
    """Return the pages whose quantities need a source."""
    written = [page for page in DOCS.glob('*.md') if page.name not in GENERATED]
    return [ROOT / 'README.md', *sorted(written)]


def sources(page: Path) -> Iterator[tuple[Quantity, str]]:
    """Yield each quantity of a page with its source: *checked*, where it is from, or ''."""
    known = ledger().get(page.name, {})
    for one in quantities(page.read_text(encoding='utf-8')):
        entries = known.get(one.section, {})
        given = entries.get(one.text)
        if of_parameter(one) or (given is not None and one.shows(evaluated(given))):
            yield one, 'checked'
        else:
            yield one, '' if given is not None else str(entries.get('from', ''))


def main() -> None:
    """Count the quantities of the pages, and list what is not checked."""
    shown = sys.argv[1:]
    for page in pages():
        found = list(sources(page))
        rest = [(one, source) for one, source in found if source != 'checked']
        without = sum(not source for _, source in rest)
        print(
            f'{page.name:20} {len(found):4}, checked {len(found) - len(rest):4}, without {without}'
        )
        for one, source in rest if page.name in shown else ():
            at = max(one.block.find(one.text.split()[0]) - 40, 0)
            print(
                f'  {one.section[:20]:20} {source[:16]:16} {one.text:12} {one.block[at : at + 80]}'
            )


if __name__ == '__main__':
    main()
