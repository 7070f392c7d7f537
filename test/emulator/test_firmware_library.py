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
"""Compilation of the firmware's core at its first use."""

from concurrent.futures import ThreadPoolExecutor
import shutil

import pytest

from t3mpc_ros.cli import emulator as emulator_cli
from t3mpc_ros.emulator import firmware_library

SLOW_COMPILER = """#!/bin/sh
while [ "$1" != -o ]; do shift; done
printf begin > "$2"
sleep 0.2
printf begin,end > "$2"
"""


@pytest.fixture(autouse=True)
def no_library(monkeypatch, tmp_path):
    """Start without a compiled library; return the folder for it."""
    monkeypatch.setenv('T3MPC_CACHE_DIR', str(tmp_path / 'cache'))
    firmware_library.load_library.cache_clear()
    yield tmp_path / 'cache'
    firmware_library.load_library.cache_clear()


def use_compiler(monkeypatch, path, script):
    path.write_text(script)
    path.chmod(0o755)
    monkeypatch.setenv('CC', str(path))


def test_without_compiler_the_command_names_what_to_install(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv('PATH', '')
    monkeypatch.delenv('CC', raising=False)
    assert emulator_cli.main(['--link', str(tmp_path / 'dongle')]) == 2
    error = capsys.readouterr().err
    assert 'not found: cc, gcc, clang. Install one (sudo apt install gcc' in error
    monkeypatch.setenv('CC', 'no-such-compiler')
    with pytest.raises(firmware_library.CompilerMissingError, match='not found: no-such-compiler'):
        firmware_library.compile_library()


def test_a_failing_compiler_is_quoted_and_leaves_nothing(monkeypatch, tmp_path, no_library):
    use_compiler(monkeypatch, tmp_path / 'cc', '#!/bin/sh\necho stdint.h: not found >&2\nexit 1\n')
    with pytest.raises(
        firmware_library.FirmwareLibraryError, match=r'libc6-dev\): got\nstdint.h: not found'
    ):
        firmware_library.compile_library()
    assert [path for path in no_library.rglob('*') if path.is_file()] == []


def test_processes_that_start_together_never_load_half_a_library(
    monkeypatch, tmp_path, no_library
):
    use_compiler(monkeypatch, tmp_path / 'cc', SLOW_COMPILER)
    with ThreadPoolExecutor() as pool:
        first = pool.submit(firmware_library.compile_library)
        while not list(no_library.rglob('*.so')):
            assert not first.done()
        assert firmware_library.compile_library().read_text() == 'begin,end'
        assert first.result().read_text() == 'begin,end'


def test_a_changed_source_is_compiled_again(monkeypatch, tmp_path):
    use_compiler(monkeypatch, tmp_path / 'cc', SLOW_COMPILER)
    first = firmware_library.compile_library()
    copy = tmp_path / 'firmware'
    for part in ('core', 'host'):
        shutil.copytree(firmware_library.FIRMWARE / part, copy / part)
    monkeypatch.setattr(firmware_library, 'FIRMWARE', copy)
    assert firmware_library.compile_library() == first
    with (copy / 'core' / 't3_robot.h').open('a') as header:
        header.write('\n')
    assert firmware_library.compile_library() != first
