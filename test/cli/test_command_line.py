# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc`` and its subcommands: version and unknown arguments."""

import pytest
from support.parsers import commands

import t3mpc_ros
from t3mpc_ros.cli.main import main

COMMANDS = ('', 'bag', 'robot', *commands())


@pytest.mark.parametrize('words', COMMANDS)
def test_every_subcommand_prints_the_version(words, capsys):
    """Only ``t3mpc --version`` did."""
    with pytest.raises(SystemExit) as end:
        main([*words.split(), '--version'])
    assert end.value.code == 0
    assert capsys.readouterr().out == f't3mpc_ros {t3mpc_ros.__version__}\n'


@pytest.mark.parametrize('words', COMMANDS)
def test_unknown_options_of_subcommands_give_code_2(words):
    with pytest.raises(SystemExit) as end:
        main([*words.split(), '--no-such-option'])
    assert end.value.code == 2
