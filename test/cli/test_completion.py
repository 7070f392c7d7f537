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
"""What a shell completes is what the program takes."""

import subprocess

import pytest

from t3mpc_ros.cli.main import main


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
