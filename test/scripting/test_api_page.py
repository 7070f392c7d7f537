# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The page of the interface is generated from its docstrings, and complete."""

import inspect
from pathlib import Path
import re

import t3mpc_ros as t3
from t3mpc_ros.scripting.api_page import SECTIONS, with_api

PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'api.md'


def test_the_page_of_the_interface_is_up_to_date():
    page = PAGE.read_text()
    assert page == with_api(page), (
        'docs/api.md is out of date: run '
        '`.venv/bin/python -m t3mpc_ros.scripting.api_page docs/api.md`'
    )


def test_every_public_name_is_on_the_page_once():
    assert sorted(name for names in SECTIONS.values() for name in names) == sorted(t3.__all__)


def test_every_argument_is_described():
    """An argument without a line in its docstring is one that a reader has to guess."""
    for name in SECTIONS['Functions']:
        function = getattr(t3, name)
        section = PAGE.read_text().split(f'### `{name}`')[1].split('\n###')[0]
        described = ', '.join(re.findall(r'^- `([^`]+)`:', section, re.MULTILINE))
        arguments = [each for each in inspect.signature(function).parameters if each != 'path']
        assert {*arguments} <= {*re.split(r', \*?|^\*', described)}, name
