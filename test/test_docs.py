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
"""The pages agree with the code: equations, parameters, faults, and links between the pages."""

import ast
from functools import cache, reduce
import importlib
import math
from pathlib import Path
import re

import pytest

from t3mpc_ros.emulator.fault_injection import FAULT_KINDS
from t3mpc_ros.nodes.registry import with_parameters
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.tool.robot_settings import RobotSettings

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / 'docs' / 'equations.md'
FUNCTION = re.compile(r'`((?:t3mpc_ros/[\w/]+|test/support/equations)\.py)::([\w.]+)`')
TEST = re.compile(r'`(test/[\w/]+\.py)::(test_\w+)`')
NUMBER = re.compile(r'\((\d+)\)|(E\d+)')


def _rows():
    """Return the cells of every row of every table; functions and tests are the last cells."""
    rows = []
    for line in PAGE.read_text().splitlines():
        if line.startswith('| ') and 'implemented by' not in line:
            rows.append([cell.strip() for cell in line.strip().strip('|').split('|')])
    return rows


ROWS = _rows()
NUMBERED = [row for row in ROWS if NUMBER.fullmatch(row[0])]


def _named(row):
    """Return the functions of a row as (path, name)."""
    return FUNCTION.findall(row[-2])


FUNCTIONS = sorted({one for row in ROWS for one in _named(row)})
TESTS = sorted({one for row in ROWS for one in TEST.findall(row[-1])})


@cache
def _tree(path):
    return ast.parse((ROOT / path).read_text())


def _module(path):
    return importlib.import_module(_dotted(path))


def _dotted(path):
    return path.removeprefix('test/').removesuffix('.py').replace('/', '.')


def test_every_equation_and_every_correction_has_exactly_one_row():
    expected = [f'({n})' for n in range(1, 87)] + [f'E{n}' for n in range(1, len(NUMBERED) - 85)]
    assert [row[0] for row in NUMBERED] == expected
    assert len(NUMBERED) >= 86 + 14


def test_no_cell_is_empty_and_references_are_well_formed():
    for row in ROWS:
        assert len(row) == (4 if row in NUMBERED else 3), row
        assert all(row), row
        assert row[-2] == ', '.join(f'`{path}::{name}`' for path, name in _named(row))
        assert row[-1] == ', '.join(f'`{path}::{name}`' for path, name in TEST.findall(row[-1]))
        assert _named(row), row
        assert TEST.search(row[-1]), row


def test_every_function_named_exists():
    for path, name in FUNCTIONS:
        assert reduce(getattr, name.split('.'), _module(path)).__doc__, name


def test_the_docstring_contains_the_equation_number():
    """A range such as (16)-(19) does not count for the numbers between its ends."""
    for number, path, name in ((row[0], *each) for row in NUMBERED for each in _named(row)):
        module = _module(path)
        texts = [module.__doc__]
        for part in name.split('.'):
            module = getattr(module, part)
            texts.append(module.__doc__)
        words = rf'(?<![\w]){re.escape(number)}(?!\d)'
        assert any(re.search(words, text) for text in texts if text), f'{path}::{name}'


def test_each_number_is_in_a_docstring_below_module_level():
    for row in NUMBERED:
        own = [reduce(getattr, name.split('.'), _module(path)) for path, name in _named(row)]
        assert any(row[0] in one.__doc__ for one in own), row[0]


@pytest.mark.slow
def test_every_test_named_exists():
    for path, name in TESTS:
        functions = (each for each in _tree(path).body if isinstance(each, ast.FunctionDef))
        assert name in {each.name for each in functions}, path


@pytest.mark.slow
def test_a_test_of_each_row_reaches_a_function_of_that_row():
    """The test's file imports the function's module, or a module that imports it."""
    for row in ROWS:
        reached = set()
        for path, _ in TEST.findall(row[-1]):
            direct = _imported(path)
            reached |= direct.union(*(_imported(file) for file in direct))
        assert reached & {path for path, _ in _named(row)}, row


@cache
def _imported(path):
    found = set()
    pending = [_tree(path)]
    while pending:
        node = pending.pop()
        if not isinstance(node, ast.expr):  # which imports nothing
            pending.extend(ast.iter_child_nodes(node))
        if isinstance(node, ast.ImportFrom):
            source = (node.module or '').replace('.', '/').replace('support/', 'test/support/')
            found |= {f'{source}.py', *(f'{source}/{name.name}.py' for name in node.names)}
    return {file for file in found if (ROOT / file).exists()}


@pytest.mark.slow
def test_the_package_calls_its_functions_on_the_page():
    """What only tests call stands in test/support/equations.py."""
    for path, name in FUNCTIONS:
        # Methods and classes are not checked.
        if path.startswith('t3mpc_ros') and '.' not in name and name[0].islower():
            assert _called(path, name), f'{path}::{name} is not called'


def _called(path, name):
    """Return whether the package uses a function outside itself."""
    for file in sorted(_texts(), key=path.__ne__):  # most are used in their own file
        if name in _texts()[file]:
            imported, parts = _uses(file)
            known = file == path or (_dotted(path), name) in imported
            if known and any(name in read for own, read in parts if (file, own) != (path, name)):
                return True
    return False


@cache
def _texts():
    files = (ROOT / 't3mpc_ros').rglob('*.py')
    return {str(file.relative_to(ROOT)): file.read_text() for file in files}


@cache
def _uses(file):
    """Return what a file imports, and the names that each of its parts reads."""
    imported, parts = set(), []
    for top in _tree(file).body:
        nodes = list(ast.walk(top))
        froms = [node for node in nodes if isinstance(node, ast.ImportFrom)]
        imported |= {(each.module, one.name) for each in froms for one in each.names}
        names = [node for node in nodes if isinstance(node, ast.Name)]
        read = {node.id for node in names if isinstance(node.ctx, ast.Load)}
        parts.append((getattr(top, 'name', None), read))
    return imported, parts


def test_the_page_of_parameters_is_up_to_date():
    page = (ROOT / 'docs' / 'nodes.md').read_text()
    assert page == with_parameters(page), (
        'docs/nodes.md is out of date: run '
        '`.venv/bin/python -m t3mpc_ros.nodes.registry docs/nodes.md`'
    )


def test_every_fault_of_the_emulator_is_documented():
    page = (ROOT / 'docs' / 'emulator.md').read_text()
    rows = dict(re.findall(r'^\| `(\w+)` \| (.*) \| [^|]* \|$', page, re.MULTILINE))
    assert list(rows) == [kind.name for kind in FAULT_KINDS]
    for kind in FAULT_KINDS:
        value = '' if math.isnan(kind.value) else f'{kind.value:g}'
        assert rows[kind.name] == f'{kind.text} | {value}'


def _table(page, head):
    """Return the rows of the table of a page that begins with a line, first cell first."""
    lines = (ROOT / 'docs' / page).read_text().partition(f'\n{head}\n')[2].partition('\n\n')[0]
    return {
        cells[0].strip('` '): [cell.strip() for cell in cells[1:]]
        for cells in (line.strip('|').split('|') for line in lines.splitlines()[1:])
    }


def test_defaults_of_the_robot_in_its_pages():
    """Those of ``t3mpc robot setup``, and of the parameters that a host writes to the board."""
    settings = RobotSettings()
    rows = _table('robot.md', '| option | default | when it differs |')
    shown = {name.strip('-').replace('-', '_'): cells[0] for name, cells in rows.items()}
    assert shown.pop('invert') == 'none'
    assert (settings.invert_left, settings.invert_right) == (False, False)
    assert shown.pop('battery') == 'unwired'
    assert not settings.battery_wired
    assert shown.pop('power') == f'{settings.power} dBm'
    assert {shown.pop('sensors')} == {*settings.sensors}
    assert shown == {name: f'{getattr(settings, name)}'.removesuffix('.0') for name in shown}
    host = LinkParameters().robot
    page = _table('radio.md', '| id | name | unit | default | range |')
    source = (ROOT / 'firmware' / 'core' / 't3_parameters.c').read_text()
    source = source.replace('T3_DEFAULT_MICROSTEPS', str(settings.microsteps))
    board = re.findall(r'\[T3_(\w+)\] = \{(\d+), (\d+), (\d+), (\w+)', source)
    assert [cells[0] for cells in page.values()] == [name.lower() for name, *_ in board]
    for (name, default, low, high, read_only), cells in zip(board, page.values(), strict=True):
        assert cells[2] == default, name
        wanted = 'read-only' if read_only == 'true' else f'{low} to {high}'
        assert cells[3].startswith(wanted) or cells[1] == 'bits', name
        if cells[1].startswith('m'):  # a thousandth of the unit of the host
            assert float(default) == pytest.approx(1e3 * getattr(host, name.lower()))


# -- warnings -------------------------------------------------------------------------------------

SUPPLIES = r'(?i)S1\b[^.]{0,40}\boff|switch S1|red wire'
HAZARDS = {
    'two supplies, by USB': (r'/dev/ttyACM0|--robot-port|over the USB of the robot', SUPPLIES),
    'two supplies, by a programmer': (r'make -C firmware flash |avrdude -c', SUPPLIES),
    'a port that is written to': (r'make -C firmware flash|flash\.py', r'\*\*Name the port\*\*'),
    'wheels that turn': (
        r'robot jog (left|right)|radio_bridge --ros-args|--drive',
        r'(?i)wheels (in the air|off the ground)',
    ),
    'a robot that drives away': (r'calibrate --port \S+$', r'moves only after a `yes`'),
    'a robot that does not stop': (r'on the ground, fenced', r'\*\*do not continue\*\*'),
    'a motor under power': (r'\| motors, ', r'supply off'),
}
"""Steps of a builder, and the warning that stands before them in their section."""
BUILD = ('robot.md', 'calibration.md', 'hardware.md')
EMULATED = r'^## Try it without a robot\n.*?(?=^## )'


def _steps_without_warning(text, step, warning):
    """Return the number of steps, and those before which their section has no warning."""
    sections = re.split(r'^(?=##+ )', re.sub(EMULATED, '', text, flags=re.M | re.S), flags=re.M)
    steps = [(section, each) for section in sections for each in re.finditer(step, section, re.M)]
    return len(steps), [
        each[0] for section, each in steps if not re.search(warning, section[: each.start()])
    ]


@pytest.mark.parametrize('hazard', HAZARDS)
def test_a_warning_stands_before_the_step_that_needs_it(hazard):
    """Flashing over USB stood two sections before the warning of the two supplies."""
    found = 0
    for page in BUILD:
        text = (ROOT / 'docs' / page).read_text()
        count, unwarned = _steps_without_warning(text, *HAZARDS[hazard])
        assert not unwarned, page
        found += count
    assert found


# -- links ----------------------------------------------------------------------------------------

PAGES = [
    path
    for path in (ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'SECURITY.md')
    if path.exists()
] + sorted((ROOT / 'docs').glob('*.md'))


@pytest.mark.parametrize('page', PAGES, ids=lambda path: path.name)
def test_no_relative_link_is_dead(page):
    """The file of each link exists, and so does the heading or the id of its anchor."""
    dead = []
    for target in _links(page):
        if re.match(r'[a-z]+:', target):
            continue
        name, _, anchor = target.partition('#')
        file = page.parent / name if name else page
        found = file.exists() and (not anchor or anchor in _anchors(file))
        if not found:
            dead.append(target)
    assert not dead


@pytest.mark.parametrize('page', PAGES, ids=lambda path: path.name)
def test_every_table_has_rows(page):
    """A table that was to be filled from a record lost its twenty rows, and nobody saw it."""
    text = page.read_text(encoding='utf-8')
    assert not re.findall(r'^\|(?: *:?-+:? *\|)+$(?!\n\|)', text, flags=re.MULTILINE)


def _prose(page):
    """Return the text of a page without its code blocks."""
    return re.sub(r'^(```|~~~).*?^\1', '', page.read_text(), flags=re.DOTALL | re.MULTILINE)


def _links(page):
    """Return the targets of links and images: inline, by reference, and in HTML."""
    text = re.sub(r'`[^`\n]*`', '', _prose(page))
    inline = re.findall(r'\]\(\s*<?([^()\s<>]+)>?(?:\s+"[^"]*")?\s*\)', text)
    reference = re.findall(r'^\[[^\]]+\]:\s*<?([^\s<>]+)', text, re.MULTILINE)
    html = re.findall(r'(?:href|src)="([^"]+)"', text)
    return [*inline, *reference, *html]


def _anchors(page):
    """Return the anchors of a page: its headings in the form of GitHub, and its ids."""
    anchors, count = set(), {}
    for heading in re.findall(r'^#{1,6}\s+(.*?)\s*#*$', _prose(page), re.MULTILINE):
        plain = re.sub(r'\[([^\]]*)\]\([^)]*\)', r'\1', heading).lower()
        slug = re.sub(r'[^\w\- ]', '', plain).replace(' ', '-')
        number = count[slug] = count.get(slug, -1) + 1
        anchors.add(f'{slug}-{number}' if number else slug)
    return anchors | set(re.findall(r'(?:id|name)="([^"]+)"', page.read_text()))
