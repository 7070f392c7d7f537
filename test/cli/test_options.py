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
"""Options of every command: what the help says is what the parser and the code behind it do."""

from dataclasses import asdict
from inspect import signature
import itertools
import json
import math
import re
import subprocess
import sys

import pytest
from support.checkout import ROOT
from support.long_tests import few_of
from support.parsers import commands, options
from support.waiting import run

from t3mpc_ros.cli import tune
from t3mpc_ros.cli.demo import DemoOptions
from t3mpc_ros.cli.main import main
from t3mpc_ros.evaluation import comparison
from t3mpc_ros.evaluation.api.comparison_runs import compare
from t3mpc_ros.evaluation.api.parameter_sweep import sweep
from t3mpc_ros.evaluation.bag_report.animation_file import AnimationOptions
from t3mpc_ros.evaluation.fuzzy_estimation_error import compare as compare_estimators
from t3mpc_ros.evaluation.paper.paper_study import chosen_extent
from t3mpc_ros.evaluation.patrol.patrol_comparison import PatrolPlan
from t3mpc_ros.evaluation.process_replay import replay_comparison
from t3mpc_ros.evaluation.process_replay.replay_comparison import Tolerances
from t3mpc_ros.evaluation.training.train_models import fit_bags
from t3mpc_ros.radio.tool.calibration_wizard import WizardOptions
from t3mpc_ros.robot.calibration import MARKS
from t3mpc_ros.version import VERSION

UNIT = re.compile(
    r'\b(s|seconds?|m|M|mm|rad/s|1/s²|Hz|V|degrees|minutes|frames per second|share|SI units)\b'
    r'|\(rad/s\)²|: 1/4 of it'
)
UNSTATED = ('workers', 'steps')
"""As many as there are: the help says so."""
ELSEWHERE = {
    ('bag compare', 'abs'): [Tolerances().absolute, replay_comparison.ELSEWHERE],
    ('bag compare', 'rel'): [Tolerances().relative],
    ('paper', 'seeds'): [len(chosen_extent(quick=each).seeds) for each in (False, True)],
    ('paper', 'estimation_seeds'): [20, 2],
    ('tune', 'evaluations'): [tune.EVALUATIONS, tune.TWIN_EVALUATIONS],
}
"""Defaults that are numbers of the code behind a command, not of its parser."""


def shown(value):
    """Return a default as a help text gives it."""
    if isinstance(value, float):
        return f'{value:g}'
    if isinstance(value, list | tuple) and all(isinstance(each, int) for each in value):
        assert list(value) == list(range(value[0], value[-1] + 1))
        return f'{value[0]}-{value[-1]}'
    if isinstance(value, list | tuple):
        return (' ' if isinstance(value, list) else ',').join(map(shown, value))
    return str(value)


@pytest.mark.parametrize('command', commands())
def test_the_help_gives_defaults_and_units(command):
    """A default of the parser is in the help, and a default in the help is that of the parser."""
    for name, option in options(commands()[command]).items():
        text, value = option.help or '', option.default
        if option.option_strings:
            assert text, f'{name} must have a help text'
        if isinstance(value, float) or 'float' in getattr(option.type, '__qualname__', ''):
            assert UNIT.search(f'{text} {name}'), f'{name} must have a unit: {text}'
        (given,) = re.findall(r'(?:(\w+): [^;]*)?\(default:?(?: ([^)]+))?', text) or [('', '')]
        if isinstance(value, bool) or value in (None, '', [], (), '{}', math.inf):
            numbers = [float(each) for each in re.findall(r'\b\d[\d.e-]*', given[1])]
            assert numbers == ELSEWHERE.get((command, name), []), f'{name}: {text}'
        elif name not in UNSTATED:
            stated = re.split(r'; |, ', given[1])[0] or given[0]
            assert stated == shown(value), f'{name} is {shown(value)} by default: {text}'


COMMANDS = ('', 'bag', 'robot', *commands())


HEAVY = ('numba', 'rosbags', 'matplotlib', 'rclpy', 'scipy', 'mcap')
"""Libraries that take a part of a second to import."""


@pytest.mark.slow
@pytest.mark.parametrize('words', ['', 'robot calibrate', 'emulator'])
def test_the_help_imports_no_heavy_library(words):
    """That of robot and emulator took two seconds, most of it for the compiler."""
    code = (
        'import contextlib, sys; from t3mpc_ros.cli.main import main\n'
        f'with contextlib.suppress(SystemExit): main({[*words.split(), "--help"]})\n'
        f'print([name for name in {HEAVY} if name in sys.modules])'
    )
    done = run([sys.executable, '-c', code])
    assert done.stdout.splitlines()[-1] == '[]', done.stderr


BAG = str(ROOT / 'test' / 'golden' / 'stops.mcap')
JSON = {
    'exponents --duration 1': 'exponents',
    f'bag info {BAG}': 'topics',
    f'bag report {BAG} --output OUT': 'verdict',
    f'bag report {BAG} {BAG} --output OUT': 'verdicts',
    f'bag replay {BAG}': 'fields',
    f'bag compare {BAG}': 'same',
    f'bag recover {BAG} --output NEW': 'topics',
    'patrol --seeds 101-101 --minutes 0.2 --paths logistic --workers 1 --output OUT': 'paths',
}
"""Commands with ``--json``, and a name in what they write; ``robot``: test_cli_robot.py."""


@pytest.mark.slow
@pytest.mark.parametrize(
    'command', few_of(JSON, len(JSON) - 1), ids=lambda text: ' '.join(text.split()[:2])
)
def test_json_means_the_same_in_every_command(command, tmp_path, capsys):
    """It was a flag here and a file there; ``-`` is the standard output in place of the text."""
    file, count = tmp_path / 'new.json', itertools.count()

    def words():
        folders = {'OUT': tmp_path / 'out', 'NEW': tmp_path / f'new_{next(count)}'}
        return [str(folders.get(word, word)) for word in command.split()]

    assert main([*words(), '--json', '-']) == 0
    numbers = json.loads(capsys.readouterr().out)
    found = numbers[0] if isinstance(numbers, list) else numbers
    assert JSON[command] in found
    assert main([*words(), '--json', str(file)]) == 0
    assert capsys.readouterr().out.strip()
    written = json.loads(file.read_text())
    for each in (numbers, written):  # what differs from run to run
        if isinstance(each, dict):
            [each.pop(name, None) for name in ('reading', 'running', 'output')]
    assert written == numbers


def test_the_text_is_the_same_beside_a_file_of_json(tmp_path, capsys):
    for words in (['exponents', '--duration', '1'], ['bag', 'info', BAG]):
        assert main(words) == 0
        text = capsys.readouterr().out
        assert main([*words, '--json', str(tmp_path / 'new.json')]) == 0
        assert capsys.readouterr().out == text
    assert main(['bag', 'info', BAG, '--json']) == 0  # as before
    assert json.loads(capsys.readouterr().out) == json.loads((tmp_path / 'new.json').read_text())


@pytest.mark.parametrize('words', COMMANDS)
def test_every_subcommand_prints_the_version(words, capsys):
    """Only ``t3mpc --version`` did."""
    with pytest.raises(SystemExit) as end:
        main([*words.split(), '--version'])
    assert end.value.code == 0
    assert capsys.readouterr().out == f't3mpc_ros {VERSION}\n'


def default_of(function, name):
    return signature(function).parameters[name].default


SIMULATED = ('noise', 'duration', 'seeds', 'cases')
"""Options of a command that are arguments of its function in Python."""
IN_CODE = {
    'demo': {name: getattr(DemoOptions(), name) for name in ('duration', 'robot', 'loss', 'seed')},
    'estimation': {
        'seeds': default_of(compare_estimators, 'seeds'),
        'duration': default_of(compare_estimators, 'duration'),
        'gain': default_of(compare_estimators, 'normalised_gain'),
    },
    'sweep': {name: default_of(sweep, name) for name in SIMULATED} | {'robot': 'twin'},
    'compare': {name: default_of(compare, name) for name in SIMULATED[:2]} | {'robot': 'twin'},
    'patrol': {'robot': PatrolPlan().robot, 'arena': list(PatrolPlan().arena)},
    'bag train': {'folds': default_of(fit_bags, 'count')},
    'bag animate': AnimationOptions()._asdict(),
    'robot calibrate': {
        name: getattr(WizardOptions(), name)
        for name in ('distance', 'turns', 'speed', 'distances')
    }
    | asdict(WizardOptions().geometry)
    | {
        'mark_distance': 1e3 * MARKS.distance,
        'mark_angle': math.degrees(MARKS.angle),
        'mark_range': 1e3 * MARKS.range,
        'mark_voltage': MARKS.voltage,
    },
}
"""Defaults of what the options of a command are passed on to."""


@pytest.mark.parametrize('command', IN_CODE)
def test_the_defaults_are_those_of_the_code(command):
    for name, value in IN_CODE[command].items():
        assert commands()[command].get_default(name) == value, name


def test_the_help_without_environment_is_that_of_the_parser():
    """``scripts/demo --help`` is a text of its own."""
    text = subprocess.run(
        [ROOT / 'scripts' / 'demo', '--help'], capture_output=True, text=True, check=True
    ).stdout
    rows = re.findall(r'^  (--\w+)(?: [A-Z.=]+)?\s+(.*(?:\n {18}.*)*)', text, re.MULTILINE)
    assert {name: ' '.join(line.split()) for name, line in rows} == {
        option.option_strings[0]: option.help.replace(
            '<time>)', '<time>; runs/latest links to it)'
        )
        for option in options(commands()['demo']).values()
    }
    assert {*re.findall(r'--\w+', text.partition('Runs all')[0])} == {name for name, _ in rows}


@pytest.mark.parametrize('option', ['--json', '--html', '--csv'])
def test_a_folder_as_a_file_is_refused_before_the_runs(option, tmp_path, capsys, monkeypatch):
    """An hour of runs ended with *Is a directory*."""
    monkeypatch.setattr(comparison, 'run_plan', lambda *_: pytest.fail('runs were begun'))
    words = ['compare', '--robot', 'servo', '--seeds', '201-202', '--methods', 'full']
    assert main([*words, option, str(tmp_path)]) == 1
    assert f'{tmp_path} cannot be written' in capsys.readouterr().err


@pytest.mark.parametrize(
    'command',
    ['bag report x', 'bag info x', 'bag replay x', 'bag compare x y', 'estimation', 'paper'],
)
def test_a_result_that_cannot_be_written_is_refused_first(command, tmp_path, capsys):
    """The report of a bag was read and drawn first."""
    assert main([*command.split(), '--json', str(tmp_path)]) == 1
    assert f'{tmp_path} cannot be written' in capsys.readouterr().err


# -- completion -----------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def completed(tmp_path_factory):
    """Return what bash completes after some words."""
    script = tmp_path_factory.mktemp('completion') / 'bash'
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('builtins.print', lambda text: script.write_text(text))
        assert main(['completion', 'bash']) == 0

    def ask(*words):
        typed = ' '.join(f"'{word}'" for word in words)
        call = (
            f'source {script}; COMP_WORDS=({typed}); COMP_CWORD={len(words) - 1}; '
            'of=$(complete -p t3mpc); of=${of##*-F }; ${of% t3mpc}; echo "${COMPREPLY[@]}"'
        )
        done = subprocess.run(['bash', '-c', call], capture_output=True, text=True, check=True)
        return set(done.stdout.split())

    return ask


@pytest.mark.parametrize(
    'words, found',
    [
        (('t3mpc', 'com'), 'compare completion compile'),
        (('t3mpc', 'param', ''), 'list describe get set'),
        (('t3mpc', 'bag', 're'), 'recover report replay'),
        (('t3mpc', 'robot', 'do'), 'doctor'),
        (('t3mpc', 'compare', '--see'), '--seeds'),
        (('t3mpc', 'demo', '--robot', ''), 'twin servo emulator'),
    ],
    ids=str,
)
def test_bash_completes_commands_options_and_choices(completed, words, found):
    assert {*found.split()} <= completed(*words)
    assert all(each.startswith(words[-1]) for each in completed(*words))


def test_the_script_for_zsh_is_one(capsys):
    assert main(['completion', 'zsh']) == 0
    script = capsys.readouterr().out
    assert script.startswith('#compdef t3mpc')
    assert '\n    completion:' in script
