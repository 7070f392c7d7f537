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
"""Generates the end of ``docs/api.md``: every name of ``import t3mpc_ros`` with its docstring.

.venv/bin/python docs/api_page.py
"""

import inspect
from itertools import groupby
from pathlib import Path
import re
import textwrap

import griffe

import t3mpc_ros

PAGE = Path(__file__).with_name('api.md')
MARK = '<!-- generated from here on: .venv/bin/python docs/api_page.py -->'
FUNCTIONS, TAKEN, RETURNED = 'Functions', 'What a function takes', 'What a function returns'
ENVIRONMENT = ('TrackingEnv', 'vector_of', 'accelerations_of')
"""Names of ``t3mpc_ros.gym``."""
SECTIONS = {
    FUNCTIONS: ('simulate', 'compare', 'sweep', 'read_bag', 'chaos', 'fuzzy'),
    TAKEN: (
        *('Controller', 'Waypoints', 'Robot', 'OdePlant', 'StateSpace', 'NoiseLaw'),
        *('LinkFaults', 'FaultSchedule', 'FaultEvent'),
    ),
    'What a controller gets': ('Observation', 'NominalModel'),
    RETURNED: ('RunResult', 'Comparison', 'Sweep', 'BagColumns', 'ChaosSolution', 'FuzzySystem'),
    'Errors': ('ScriptError',),
}
"""Public names in the order of the page."""


def with_api(page):
    """Return ``docs/api.md`` with the present interface behind its mark."""
    package = griffe.load(
        't3mpc_ros', search_paths=[PAGE.parents[1]], docstring_parser='numpy', resolve_aliases=True
    )
    lines = [MARK]
    for title, names in SECTIONS.items():
        lines += ['', f'## {title}']
        for name in names:
            documented = package[f'{t3mpc_ros._MODULE[name]}.{name}']
            public = getattr(t3mpc_ros, name)
            lines += ['', f'### `{name}`', '']
            if title in (FUNCTIONS, TAKEN):
                lines += ['```text', *_call(f't3.{name}', public), '```', '']
            lines += _markdown(documented)
            if title != FUNCTIONS:
                lines += _members(documented, public, made=title == TAKEN)
    lines += ['', '## Environment of Gymnasium, from `t3mpc_ros.gym`']
    for name in ENVIRONMENT:
        documented = package[f'gym.{name}']
        lines += ['', f'### `{name}`', '', *_markdown(documented)]
    return page[: page.index(MARK)] + '\n'.join(lines) + '\n'


def _call(name, function):
    """Return a call with its defaults, without types, in lines."""
    found = inspect.signature(function)
    empty = inspect.Parameter.empty
    plain = [each.replace(annotation=empty) for each in found.parameters.values()]
    text = str(inspect.Signature([each for each in plain if each.name != 'self']))
    # Tuples stay in one line.
    text = re.sub(r', (?=[\d\'])', ',\u00a0', text.replace('<factory>', '…'))
    lines = textwrap.wrap(f'{name}{text}', 100, subsequent_indent='    ')
    return [line.replace('\u00a0', ' ') for line in lines]


def _members(documented, kind, *, made):
    """Return attributes, and the methods of a class that scripts do not make themselves."""
    lines = []
    for name, member in documented.attributes.items():
        if member.docstring and name[0] != '_' and not (made and 'property' in member.labels):
            shown = _typed(name, member.annotation) if made else name
            lines.append(f'- `{shown}`: {_plain(member.docstring.value)}')
    lines = ['', *lines] if lines else []
    for name, member in documented.functions.items():
        if member.docstring and name[0] != '_' and not made:
            (call,) = _call(name, getattr(kind, name))
            first, *rest = _markdown(member)
            lines += ['', f'**`{call}`** {first}', *rest]
    return lines


def _markdown(documented):
    """Return the docstring of a class or function in Markdown."""
    lines = []
    for section in documented.docstring.parsed:
        if section.kind is griffe.DocstringSectionKind.text:
            lines += ['', *_code(section.value).splitlines()]
            continue
        lines += ['', f'*{section.kind.value.capitalize()}*', '']
        for text, items in groupby(section.value, lambda item: item.description):
            names = [_entry(item) for item in items]
            if len(names) > 1:
                names = [name.partition(':')[0] for name in names]
            lines.append(f'- {", ".join(f"`{name}`" for name in names)}: {_plain(text)}')
    return lines[1:]


def _entry(item):
    """Return the name of an argument with its type, or of an exception."""
    return _typed(item.name, item.annotation) if hasattr(item, 'name') else str(item.annotation)


def _typed(name, annotation):
    return name if annotation is None or str(annotation) == 'Any' else f'{name}: {annotation}'


def _plain(text):
    return _code(' '.join(text.split()))


def _code(text):
    """Return text with its RST marks as those of Markdown."""
    return re.sub(r'``([^`]+)``', r'`\1`', re.sub(r':\w+:`([^`]+)`', r'`\1`', text))


if __name__ == '__main__':
    PAGE.write_text(with_api(PAGE.read_text(encoding='utf-8')), encoding='utf-8')
