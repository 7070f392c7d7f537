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
"""The page of the interface is generated from its docstrings, and complete."""

import inspect
import re
import runpy

import pytest
from support.checkout import ROOT

import t3mpc_ros as t3
from t3mpc_ros.evaluation.api.script_inputs import check_method
from t3mpc_ros.evaluation.cases import NOMINAL
from t3mpc_ros.evaluation.scenario import Scenario

PAGE = ROOT / 'docs' / 'api.md'
GENERATOR = runpy.run_path(str(PAGE.with_name('api_page.py')))
SECTIONS = GENERATOR['SECTIONS']


def test_the_page_of_the_interface_is_up_to_date():
    page = PAGE.read_text()
    assert page == GENERATOR['with_api'](page), 'run .venv/bin/python docs/api_page.py'


def test_every_public_name_is_on_the_page_once():
    assert sorted(name for names in SECTIONS.values() for name in names) == sorted(t3.__all__)


def test_every_argument_is_described():
    """An argument without a line in its docstring is one that a reader has to guess."""
    for name in SECTIONS['Functions']:
        function = getattr(t3, name)
        section = PAGE.read_text().split(f'### `{name}`')[1].split('\n###')[0]
        items = re.findall(r'^- (.+?`): ', section, re.MULTILINE)
        described = re.findall(r'`\*?(\w+)', ', '.join(items))
        arguments = [each for each in inspect.signature(function).parameters if each != 'path']
        assert {*arguments} <= {*described}, name


CALLS = {
    call
    for page in PAGE.parent.glob('*.md')
    for call in re.findall(r"t3\.Controller\('[^)]*\)", page.read_text())
}


@pytest.mark.parametrize('call', sorted(CALLS))
def test_a_controller_on_a_page_exists(call):
    """The tutorial had one with a gain that the twin refuses."""
    method = eval(call, {'t3': t3}).method('twin')
    check_method(method, Scenario('twin', NOMINAL, 1), [NOMINAL])
