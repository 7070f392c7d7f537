# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels: one decorator, a cache that is writable and never stale."""

import os
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest

from t3mpc_ros.kernels import cache_directory, kernel, source_fingerprint


def test_division_by_zero_gives_infinity_not_an_exception():
    @kernel
    def ratio(values, out):
        out[0] = values[0] / values[1]

    out = np.zeros(1)
    ratio(np.array([1.0, 0.0]), out)
    assert np.isposinf(out[0])


def test_the_fingerprint_changes_with_any_file_that_holds_a_kernel_and_with_no_other(tmp_path):
    (tmp_path / 'a').mkdir()
    file, other = tmp_path / 'a' / 'x.py', tmp_path / 'a' / 'y.py'
    file.write_text('@kernel\ndef f(): return 1\n')
    before = source_fingerprint(tmp_path)
    other.write_text('nothing = "compiled"\n')
    assert source_fingerprint(tmp_path) == before
    file.write_text('@kernel\ndef f(): return 2\n')
    assert source_fingerprint(tmp_path) != before


def test_an_unwritable_place_is_passed_over(tmp_path):
    blocked = tmp_path / 'file'
    blocked.write_text('a file, so nothing can be made below it')
    chosen = cache_directory(
        {'T3MPC_CACHE_DIR': str(blocked / 'x'), 'XDG_CACHE_HOME': str(tmp_path / 'ok')}
    )
    assert chosen.parent == tmp_path / 'ok' / 't3mpc_ros'
    assert chosen.is_dir()


def test_without_any_writable_place_the_error_names_them_and_the_remedy(tmp_path, monkeypatch):
    blocked = tmp_path / 'file'
    blocked.write_text('')
    monkeypatch.setattr('tempfile.gettempdir', lambda: str(blocked / 'tmp'))
    with pytest.raises(OSError, match='T3MPC_CACHE_DIR') as caught:
        cache_directory({'HOME': str(blocked)})
    assert str(blocked) in str(caught.value)


def test_a_package_installed_read_only_still_compiles_and_caches(tmp_path):
    """Numba's default puts the cache beside the source, and fails where it may not write.

    The test runs as root on some machines, where no folder is read-only: so it shows instead
    that nothing at all is written beside the sources, and that the chosen folder is used.
    """
    package = Path(__file__).resolve().parent.parent / 't3mpc_ros'
    environment = dict(os.environ, T3MPC_CACHE_DIR=str(tmp_path))
    code = (
        'import numpy as np\n'
        'from t3mpc_ros.control.control_law import law_terms\n'
        'z = np.zeros(2); law_terms(z, z, z, z, z, 1.0, 1.0, 1.0, np.zeros((5, 2)), np.zeros(2))\n'
    )
    subprocess.run([sys.executable, '-c', code], env=environment, check=True, cwd=package.parent)
    assert list(tmp_path.rglob('*.nbc'))
    assert not [path for path in package.rglob('*.nbc') if '__pycache__' in path.parts]
