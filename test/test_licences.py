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
"""Licences of the libraries that an installation brings: all known, and none forbids the use."""

from importlib.metadata import PathDistribution
from pathlib import Path
import runpy
import sys

import pytest

SCRIPT = runpy.run_path(str(Path(__file__).resolve().parent.parent / 'scripts' / 'licences.py'))


def planted(folder, name, *lines):
    """Write the metadata of an installed library."""
    metadata = folder / f'{name}-1.0.dist-info' / 'METADATA'
    metadata.parent.mkdir(parents=True)
    metadata.write_text(
        '\n'.join(['Metadata-Version: 2.4', f'Name: {name}', 'Version: 1.0', *lines])
    )
    return PathDistribution(metadata.parent)


def test_every_library_has_a_known_licence(capsys):
    assert SCRIPT['main']({'ros', 'compare', 'cluster'}) == 0, capsys.readouterr().err
    listed = {line.split()[0] for line in capsys.readouterr().out.splitlines()}
    # Some of each kind: direct, of an extra, of another library, and with an extra of its own.
    assert {'t3mpc-ros', 'numba', 'casadi', 'tornado', 'llvmlite', 'ros-fastrtps'} <= listed


@pytest.mark.parametrize(
    'lines, licence, allowed',
    [
        (['License-Expression: MIT AND (GPL-3.0-only OR BSD-3-Clause)'], None, True),
        (['License-Expression: MIT AND GPL-3.0-only'], None, False),
        (['License-Expression: Apache-2.0 WITH LLVM-exception'], None, True),
        (['License: MIT', 'License-Expression: GPL-2.0-only'], 'GPL-2.0-only', False),
        (['Classifier: License :: OSI Approved :: MIT License'], 'MIT', True),
        (
            ['License: x', 'Classifier: License :: OSI Approved :: GNU Affero General Public'],
            'GNU Affero General Public',
            False,
        ),
        (['License: Apache License, Version 2.0'], 'Apache-2.0', True),
        (['License: free for research'], 'free for research', False),
        (['License: Copyright of somebody', '        all rights reserved'], '', False),
        ([], '', False),
    ],
)
def test_each_statement_of_a_licence_is_judged(lines, licence, allowed, tmp_path):
    found, _ = SCRIPT['licence_of'](planted(tmp_path, 'library', *lines))
    assert found == (licence if licence is not None else lines[0].partition(': ')[2])
    assert SCRIPT['is_allowed'](found) == allowed


@pytest.mark.parametrize(
    'lines, reason',
    [
        (['License: free for research'], 'middle (free for research)'),
        ([], 'middle (no licence in its metadata)'),
        (None, 'middle (not installed)'),
    ],
)
def test_an_unknown_licence_of_a_distant_library_fails(
    lines, reason, tmp_path, monkeypatch, capsys
):
    planted(tmp_path, 't3mpc_ros', 'License: Apache-2.0', 'Requires-Dist: top; extra == "more"')
    planted(tmp_path, 'top', 'License: MIT', 'Requires-Dist: middle[part]>=1')
    if lines is not None:
        planted(tmp_path, 'middle', *lines)
    monkeypatch.setattr(sys, 'path', [str(tmp_path)])
    assert SCRIPT['main'](set()) == 0  # without the extra nothing of it is needed
    assert SCRIPT['main']({'more'}) == 1
    assert f'error: not a known licence: {reason}\n' in capsys.readouterr().err


def test_what_is_stated_here_is_stated_nowhere_else():
    """A release whose metadata name the licence makes the entry superfluous."""
    libraries = SCRIPT['required']('t3mpc-ros', {'ros'})
    for name, row in SCRIPT['STATED'].items():
        assert SCRIPT['licence_of'](libraries[name]) == row, name
