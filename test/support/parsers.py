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
"""Every command of ``t3mpc`` with its parser, found by walking from the program itself."""

import argparse
from functools import cache
from importlib import import_module
from unittest.mock import patch

from t3mpc_ros.cli.main import PROGRAMS, main


class _Asked(Exception):
    """Ends a program in place of parsing; its argument is the parser."""


def _ask(parser, *arguments):
    raise _Asked(parser)


def _parser_of(program):
    with patch.object(argparse.ArgumentParser, 'parse_args', _ask):
        try:
            program([])
        except _Asked as asked:
            return asked.args[0]
    raise AssertionError('the program must parse its command line')


@cache
def commands():
    """Return the parser of each command by its words, as in ``bag info``."""
    found = dict(_leaves(_parser_of(main), ()))
    for name in PROGRAMS:
        own = import_module(f't3mpc_ros.cli.{name}').main
        del found[name,]
        found |= _leaves(_parser_of(own), (name,))
    return {' '.join(words): parser for words, parser in found.items()}


def _leaves(parser, words):
    nested = [each for each in parser._actions if isinstance(each, argparse._SubParsersAction)]
    if not nested:
        yield words, parser
    for group in nested:
        for name, child in group.choices.items():
            yield from _leaves(child, (*words, name))


def options(parser):
    """Return what a command takes, but help and version, by the name in its namespace."""
    shown = (each for each in parser._actions if each.help != argparse.SUPPRESS)
    return {each.dest: each for each in shown if each.dest not in ('help', 'version')}
