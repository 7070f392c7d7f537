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
"""``make release``: both programs, built twice in different places, are the same bytes."""

import hashlib
from pathlib import Path
import re
import shutil
import subprocess

import pytest
from support.missing_tools import AVR, needing

from t3mpc_ros.radio.protocol.frames import VERSION

FIRMWARE = Path(__file__).resolve().parents[2] / 'firmware'
pytestmark = [needing(*AVR), pytest.mark.slow]


def release(source, build):
    """Return the files of a release by name."""
    command = ['make', '-s', '-C', str(source), 'release', f'BUILD={build}']
    subprocess.run(command, check=True, capture_output=True)
    return {path.name: path.read_bytes() for path in (Path(build) / 'release').iterdir()}


@pytest.mark.long
def test_a_release_is_reproducible_and_has_its_hashes(tmp_path):
    """Another folder, other times of the files, another folder of the results."""
    copy = tmp_path / 'copy' / 'firmware'
    ignored = shutil.ignore_patterns('build', '__pycache__')
    shutil.copytree(FIRMWARE, copy, ignore=ignored, copy_function=shutil.copyfile)
    first, second = release(FIRMWARE, tmp_path / 'one'), release(copy, tmp_path / 'elsewhere')
    assert first == second
    text = (FIRMWARE / 'core' / 't3_protocol.h').read_text()
    major, minor = (
        int(re.search(rf'T3_FIRMWARE_{part} (\d+)u', text)[1]) for part in ('MAJOR', 'MINOR')
    )
    assert major == VERSION
    images = [f'{board}-{major}.{minor}.hex' for board in ('dongle', 'robot')]
    assert sorted(first) == sorted(['COMPILER', 'SHA256SUMS', *images])
    sums = dict(line.split()[::-1] for line in first['SHA256SUMS'].decode().splitlines())
    assert sums == {name: hashlib.sha256(first[name]).hexdigest() for name in images}
    check = ['sha256sum', '-c', 'SHA256SUMS']  # as on the page
    assert not subprocess.run(
        check, cwd=tmp_path / 'one' / 'release', capture_output=True
    ).returncode
    assert first['COMPILER'].startswith(b'avr-gcc')
    for name in images:
        assert first[name].startswith(b':')
        assert first[name].rstrip().endswith(b':00000001FF')
