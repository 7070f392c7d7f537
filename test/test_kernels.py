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
"""Kernel decorator: floating-point behaviour, and a cache that is writable and up to date."""

from copy import deepcopy
import os
from pathlib import Path
import pickle
import shutil
import subprocess
import sys

import numba
import numpy as np
import pytest

from t3mpc_ros.control.input_shaper import row_at
from t3mpc_ros.kernels import (
    TypedKernel,
    cache_directory,
    kernel,
    remove_compiled,
    source_fingerprint,
)


def test_division_by_zero_gives_infinity_not_an_exception():
    @kernel
    def ratio(values, out):
        out[0] = values[0] / values[1]

    out = np.zeros(1)
    ratio(np.array([1.0, 0.0]), out)
    assert np.isposinf(out[0])


@kernel
def square(x):
    return x * x


@kernel
def sum_of_squares(values):
    return square(values[0]) + square(values[1])


def test_a_kernel_that_others_call_is_compiled_with_them():
    assert sum_of_squares(np.array([3.0, 4.0])) == 25.0
    assert not square.compiled.signatures
    assert square(3) == 9
    assert len(square.compiled.signatures) == 1


def test_a_typed_kernel_takes_a_fraction_after_an_integer():
    """The types are those of its first arguments: 0.5 s after 1 s would have been 0 s."""

    @kernel
    def half(duration: float) -> float:
        return 0.5 * duration

    typed = TypedKernel(half)
    assert [typed(1), typed(0.5)] == [0.5, 0.25]


def test_a_typed_kernel_is_copied_and_pickled_after_a_call():
    """Studies copy controllers, and send them to other processes; compiled code cannot be sent."""
    typed = TypedKernel(row_at)
    rows = np.array([[1.0, 0.0, 0.0], [3.0, 0.0, 1.0]])
    assert typed(rows, 0, 0.5) == 2.0
    for other in (deepcopy(typed), pickle.loads(pickle.dumps(typed))):
        assert other(rows, 0, 0.25) == 1.5
    assert pickle.loads(pickle.dumps(row_at)) is row_at


def test_a_kernel_that_allocates_an_array_is_rejected():
    @kernel
    def total(values):
        copy = np.zeros(values.size)
        return copy[0]

    with pytest.raises(numba.TypingError, match='zeros'):
        total(np.ones(2))


def test_fingerprint_depends_on_kernels_and_compiler_only(tmp_path, monkeypatch):
    (tmp_path / 'a').mkdir()
    file, other = tmp_path / 'a' / 'x.py', tmp_path / 'a' / 'y.py'
    file.write_text('@kernel\ndef f(): return 1\n')
    before = source_fingerprint(tmp_path)
    other.write_text('nothing = "compiled"\n')
    assert source_fingerprint(tmp_path) == before
    file.write_text('@kernel\ndef f(): return 2\n')
    seen = {before, source_fingerprint(tmp_path)}
    file.rename(tmp_path / 'x.py')
    seen.add(source_fingerprint(tmp_path))
    monkeypatch.setattr(numba, '__version__', '0.0.1')
    seen.add(source_fingerprint(tmp_path))
    (tmp_path / 'kernels.py').write_text('OPT = 1\n')
    seen.add(source_fingerprint(tmp_path))
    assert len(seen) == 5


def test_an_unwritable_folder_is_skipped(tmp_path):
    blocked = tmp_path / 'file'
    blocked.write_text('a file, so no folder can be created below it')
    chosen = cache_directory(
        {'T3MPC_CACHE_DIR': str(blocked / 'x'), 'XDG_CACHE_HOME': str(tmp_path / 'ok')}
    )
    assert chosen.parent == tmp_path / 'ok' / 't3mpc_ros'
    assert chosen.is_dir()


def test_error_without_a_writable_folder_names_all_candidates(tmp_path, monkeypatch):
    blocked = tmp_path / 'file'
    blocked.write_text('')
    monkeypatch.setattr('tempfile.gettempdir', lambda: str(blocked / 'tmp'))
    with pytest.raises(OSError, match='T3MPC_CACHE_DIR') as caught:
        cache_directory({'HOME': str(blocked)})
    assert str(blocked) in str(caught.value)


def test_what_was_compiled_is_removed_and_nothing_else(tmp_path, monkeypatch):
    """An uninstallation left the folders of every version."""
    monkeypatch.setattr('tempfile.gettempdir', lambda: str(tmp_path / 'tmp'))
    home, own = tmp_path / 'home' / '.cache' / 't3mpc_ros', tmp_path / 'own'
    made = [home / ('0' * 16), home / f'firmware-{"f" * 16}', own / ('a' * 16)]
    others = [own / 'mine', own / ('b' * 15)]
    for folder in [*made, *others]:
        folder.mkdir(parents=True)
        (folder / 'file').write_text('')
    environment = {'HOME': str(tmp_path / 'home')}
    # The cache of the user, which other installations share, is not that of the variable.
    assert remove_compiled(environment | {'T3MPC_CACHE_DIR': str(own)}) == made[2:]
    assert made[0].exists()
    assert sorted(remove_compiled(environment)) == sorted(made[:2])
    assert not [folder for folder in [*made, home] if folder.exists()]
    assert all((folder / 'file').exists() for folder in others)
    assert remove_compiled(environment) == []


@pytest.mark.slow
def test_equal_sources_share_compiled_code_wherever_they_are(tmp_path):
    """The compiler's cache is by path: each clone and each workspace compiled everything again.

    It is beside the source by default, which fails for a read-only package: nothing is there.
    """
    package = Path(__file__).resolve().parent.parent / 't3mpc_ros'
    code = (
        'import numpy as np\n'
        'from t3mpc_ros.control.control_law import law_terms\n'
        'z = np.zeros(2); law_terms(z, z, z, z, z, 1.0, 1.0, 1.0, np.zeros((5, 2)), np.zeros(2))\n'
        'print(law_terms.compiled.stats.cache_path)\n'
    )
    cache, copies, found = tmp_path / 'cache', [tmp_path / 'one', tmp_path / 'two'], []
    for copy in copies:
        shutil.copytree(package, copy / 't3mpc_ros', ignore=shutil.ignore_patterns('__pycache__'))
        if copy != copies[0]:
            with (copy / 't3mpc_ros' / '__init__.py').open('a') as text:
                text.write('# no kernel\n')
        output = subprocess.check_output(
            [sys.executable, '-c', code],
            cwd=copy,
            env=dict(os.environ, T3MPC_CACHE_DIR=str(cache), PYTHONPATH=str(copy)),
            text=True,
        )
        compiled = {path: path.stat().st_mtime_ns for path in cache.rglob('*.nbc')}
        found.append((Path(output.strip()), compiled))
    assert found[0] == found[1]
    assert found[0][0].is_relative_to(cache)
    assert found[0][1]
    assert not [path for copy in copies for path in copy.rglob('*.nbc')]
