# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The page ``docs/api.md``: signatures and docstrings of the scripting interface, in Markdown."""

import ast
from collections.abc import Iterator, Mapping
import inspect
from pathlib import Path
import re
import sys
import textwrap
from typing import Any

import t3mpc_ros

MARK = '<!-- generated from here on: python -m t3mpc_ros.scripting.api_page docs/api.md -->'
"""First line of the generated part."""
SECTIONS = {
    'Functions': ('simulate', 'compare', 'sweep', 'read_bag', 'chaos', 'fuzzy'),
    'What a function takes': (
        'Controller',
        'Waypoints',
        'Robot',
        'OdePlant',
        'StateSpace',
        'NoiseLaw',
        'LinkFaults',
        'FaultSchedule',
        'FaultEvent',
    ),
    'What a controller gets': ('Observation', 'NominalModel'),
    'What a function returns': (
        'RunResult',
        'Comparison',
        'Sweep',
        'BagColumns',
        'ChaosSolution',
        'FuzzySystem',
    ),
    'Errors': ('ScriptError',),
}
"""Public names in the order of the page."""
WIDTH = 110


def api_section() -> str:
    """Return the generated end of ``docs/api.md``: every public name with its docstring."""
    lines = [MARK]
    for title, names in SECTIONS.items():
        lines += ['', f'## {title}']
        for name in names:
            found = getattr(t3mpc_ros, name)
            lines += ['', f'### `{name}`', '']
            lines += _function(name, found) if name.islower() else _class(name, found)
    return '\n'.join(lines) + '\n'


def with_api(page: str) -> str:
    """Return ``docs/api.md`` with the present interface behind its mark."""
    return page[: page.index(MARK)] + api_section()


def _function(name: str, function: Any) -> list[str]:
    target = function if inspect.isfunction(function) else function._function
    return [*_signature(f't3.{name}', target), '', *_markdown(inspect.getdoc(target) or '')]


def _class(name: str, kind: type) -> list[str]:
    """Return a class: its call if scripts make it, else its attributes and methods."""
    lines = []
    made = name in SECTIONS['What a function takes']
    if made:
        lines += [*_signature(f't3.{name}', kind), '']
    lines += _markdown(inspect.getdoc(kind) or '')
    documented = [*_attributes(kind), *([] if made else _properties(kind))]
    members = [f'- `{each}`: {_plain(text)}' for each, text in documented]
    if members:
        lines += ['', *members]
    for each, member in vars(kind).items():
        text = inspect.getdoc(member)
        if made or each.startswith('_') or not inspect.isfunction(member) or not text:
            continue
        shown, *rest = _markdown(text)
        lines += ['', f'**`{_call(each, member)}`** {shown}', *rest]
    return lines


def _signature(name: str, target: Any) -> list[str]:
    """Return the call in a block, with one argument a line when it is long."""
    parameters = list(inspect.signature(target).parameters.values())
    types = _types(target)
    texts = [_annotated(each, types) for each in parameters if each.name != 'self']
    if any(each.kind is each.KEYWORD_ONLY for each in parameters) and not any(
        each.kind is each.VAR_POSITIONAL for each in parameters
    ):
        first = next(i for i, each in enumerate(parameters) if each.kind is each.KEYWORD_ONLY)
        texts.insert(first, '*')
    line = f'{name}({", ".join(texts)})'
    if len(line) > WIDTH:
        line = '\n'.join([f'{name}(', *(f'    {text},' for text in texts), ')'])
    return ['```text', *line.splitlines(), '```']


def _call(name: str, function: Any) -> str:
    parameters = inspect.signature(function).parameters.values()
    texts = [_defaulted(each) for each in parameters if each.name != 'self']
    return f'{name}({", ".join(texts)})'


def _types(target: Any) -> dict[str, str]:
    """Return the types of arguments as the source has them: short, and equal in every Python."""
    tree = _tree(target)
    if isinstance(tree, ast.FunctionDef):
        arguments = tree.args.args + tree.args.kwonlyargs
        given = {each.arg: each.annotation for each in arguments}
    else:
        items = [item for item in tree.body if isinstance(item, ast.AnnAssign)]
        given = {
            item.target.id: item.annotation for item in items if isinstance(item.target, ast.Name)
        }
    texts = {name: ast.unparse(type_) for name, type_ in given.items() if type_ is not None}
    return {name: text for name, text in texts.items() if text != 'Any'}


def _tree(target: Any) -> ast.FunctionDef | ast.ClassDef:
    """Return the definition of a function or a class."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(target)))).body[0]
    assert isinstance(tree, ast.FunctionDef | ast.ClassDef)
    return tree


def _annotated(parameter: inspect.Parameter, types: Mapping[str, str]) -> str:
    star = '*' if parameter.kind is parameter.VAR_POSITIONAL else ''
    text = f'{star}{parameter.name}'
    if parameter.name in types:
        text += f': {types[parameter.name]}'
    if parameter.default is parameter.empty:
        return text
    return f'{text} = {_default(parameter)}'


def _defaulted(parameter: inspect.Parameter) -> str:
    if parameter.default is parameter.empty:
        return parameter.name
    return f'{parameter.name}={_default(parameter)}'


def _default(parameter: inspect.Parameter) -> str:
    text = repr(parameter.default)
    return '…' if text.startswith('<') else text


def _attributes(kind: type) -> Iterator[tuple[str, str]]:
    """Yield name and docstring of the documented attributes of a class."""
    tree = _tree(kind)
    assert isinstance(tree, ast.ClassDef)
    for item, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name) and documented:
            assert isinstance(after, ast.Expr)
            assert isinstance(after.value, ast.Constant)
            if not item.target.id.startswith('_'):
                yield item.target.id, str(after.value.value)


def _properties(kind: type) -> Iterator[tuple[str, str]]:
    """Yield name and docstring of the properties of a class."""
    for name, member in vars(kind).items():
        if isinstance(member, property) and not name.startswith('_') and member.__doc__:
            yield name, member.__doc__


def _markdown(docstring: str) -> list[str]:
    """Return a NumPy docstring in Markdown."""
    lines: list[str] = []
    words = docstring.splitlines()
    listed = False
    i = 0
    while i < len(words):
        line = words[i]
        if i + 1 < len(words) and set(words[i + 1]) == {'-'}:
            lines += [f'*{line}*', '']
            listed = True
            i += 2
            continue
        if listed and line and not line.startswith(' '):
            entry = []
            while i + 1 < len(words) and words[i + 1].startswith('    '):
                i += 1
                entry.append(words[i].strip())
            lines.append(f'- `{line}`: {_plain(" ".join(entry))}')
        else:
            lines.append(_plain(line))
        i += 1
    return lines


def _plain(text: str) -> str:
    """Return text with its RST marks as those of Markdown."""
    text = ' '.join(text.split())
    text = re.sub(r':\w+:`([^`]+)`', r'`\1`', text)
    return re.sub(r'``([^`]+)``', r'`\1`', text)


if __name__ == '__main__':
    page = Path(sys.argv[1])
    page.write_text(with_api(page.read_text(encoding='utf-8')), encoding='utf-8')
