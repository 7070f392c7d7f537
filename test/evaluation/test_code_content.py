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
"""What a run depends on of a user's code: its source, and all of it that it uses."""

import importlib
import sys

import numpy as np
import pytest

from t3mpc_ros.evaluation.run_cache_key import code_content, content_of

HELPER = 'GAIN = {gain}\n\n\ndef gain():\n    return {value}\n'
LAW = """
import numpy as np
import used_helper
from used_helper import gain

OFFSET = {offset}
TABLE = np.array([{table}])
UNUSED = {unused}
FACTOR = {factor}
SHARE = {share}


class Base:
    def slope(self):
        return {slope}


class Law(Base):
    share = SHARE

    def step(self, o, *, factor=FACTOR):
        def inner():
            return gain() + used_helper.GAIN
        return inner() + OFFSET + TABLE[0] + self.slope() * factor * self.share
"""
VALUES = {
    'gain': '1.0', 'value': '2.0', 'offset': '3.0', 'table': '4.0', 'slope': '5.0',
    'factor': '6.0', 'unused': '7.0', 'share': '8.0',
}  # fmt: skip


@pytest.fixture
def content(tmp_path, monkeypatch):
    """Return a function that returns the content of a class of files with some values."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, 'dont_write_bytecode', True)
    count = iter(range(100))

    def found(**changes):
        values = VALUES | changes
        (tmp_path / 'used_helper.py').write_text(HELPER.format(**values))
        name = f'used_law_{next(count)}'
        (tmp_path / f'{name}.py').write_text(LAW.format(**values))
        sys.modules.pop('used_helper', None)
        importlib.invalidate_caches()
        return repr(code_content(importlib.import_module(name).Law))

    yield found
    for name in [each for each in sys.modules if each.startswith('used_')]:
        del sys.modules[name]


@pytest.mark.parametrize('changed', [name for name in VALUES if name != 'unused'])
def test_what_a_class_uses_is_part_of_it(changed, content):
    """A file kept the rows of a controller whose constant or helper had been edited."""
    assert content() != content(**{changed: '9.0'})


def test_what_a_class_does_not_use_is_no_part_of_it(content):
    """Another value in the sweep of the same script leaves the rows that are there."""
    assert content() == content(unused='9.0')


def _cell(text):
    """Run the text of a cell of a notebook, which has no file; return what it defines."""
    module = {'__name__': '__main__'}
    exec(compile(text, '<cell>', 'exec'), module)
    return module


@pytest.mark.parametrize(
    'edited',
    [
        'K = 2.0\nclass Law:\n    def step(self, o):\n        return -K * o\n',
        'K = 3.0\nclass Law:\n    def step(self, o):\n        return K * o\n',
        'K = 2.0\nclass Law:\n    def step(self, o):\n        return K * o * 2.0\n',
        'K = 2.0\nclass Law:\n    def step(self, o):\n        return K * (lambda: o + 1.0)()\n',
    ],
)
def test_a_class_of_a_notebook_is_more_than_its_name(edited):
    """After an edit of its cell a sweep with a file returned the rows of the former class."""
    before = 'K = 2.0\nclass Law:\n    def step(self, o):\n        return K * o\n'
    first, again, other = (_cell(text)['Law'] for text in (before, before, edited))
    assert content_of(first) == content_of(again)
    assert content_of(first) != content_of(other)
    assert content_of(first()) != content_of(other())


def test_a_closure_is_known_by_its_values():
    def law(gain):
        return lambda o: gain * o

    assert content_of(law(1.0)) != content_of(law(2.0))
    assert content_of(law(np.ones(2))) != content_of(law(np.zeros(2)))
    assert content_of(law(1.0)) == content_of(law(1.0))


def test_functions_that_call_each_other_end():
    module = _cell('def a(o):\n    return b(o)\ndef b(o):\n    return a(o)\n')
    assert len(code_content(module['a'])) == 2
