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
"""Wheel and source distribution: complete, and they run from any folder."""

import os
from pathlib import Path
import shutil
import sys
from sysconfig import get_platform
import tarfile
import zipfile

import pytest
from support.checkout import EXECUTABLES, ROOT, clean_environment, copy_package
from support.waiting import run

from t3mpc_ros.missing_library import EXTRAS
from t3mpc_ros.nodes.registry import NODES
from t3mpc_ros.version import VERSION

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def source(tmp_path_factory):
    return copy_package(tmp_path_factory.mktemp('source') / 't3mpc_ros')


def _run(*words, cwd, **extra):
    done = run([str(word) for word in words], 300.0, cwd=cwd, env=clean_environment(**extra))
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope='module')
def archive(source):
    """Return the source distribution."""
    _run(sys.executable, 'setup.py', '-q', 'sdist', '-d', source.parent, cwd=source)
    (found,) = source.parent.glob('*.tar.gz')
    return found


@pytest.fixture(scope='module')
def wheel(archive, tmp_path_factory):
    """Return the wheel that is built from the source distribution, as an index would."""
    folder = tmp_path_factory.mktemp('wheel')
    words = ['-q', '--no-deps', '--no-build-isolation', '--no-index', '-w', folder, archive]
    _run(sys.executable, '-m', 'pip', 'wheel', *words, cwd=folder)
    (found,) = folder.glob('*.whl')
    return found


@pytest.fixture(scope='module')
def installed(wheel, tmp_path_factory):
    """Return an environment with the wheel and the libraries of this one."""
    folder = tmp_path_factory.mktemp('environment')
    _run(sys.executable, '-m', 'venv', '--without-pip', folder / 'env', cwd=folder)
    packages = folder / 'env' / f'lib/python{sys.version_info[0]}.{sys.version_info[1]}'
    target = packages / 'site-packages'
    # A path, whose .pth files are not read: one of them is this checkout.
    libraries = next(Path(path) for path in sys.path if path.endswith('site-packages'))
    (target / 'libraries.pth').write_text(f'{libraries}\n')
    words = ['--python', folder / 'env', 'install', '-q', '--no-deps', '--no-index', wheel]
    _run(sys.executable, '-m', 'pip', *words, cwd=folder)
    return folder / 'env'


@pytest.mark.long
def test_a_build_that_was_interrupted_can_be_repeated(source, tmp_path):
    """Ctrl-C in a set-up left a folder behind, at which every later set-up ended."""
    left = f'build/bdist.{get_platform()}/wheel/t3mpc_ros-{VERSION}.data/data/lib/t3mpc_ros'
    (source / left).mkdir(parents=True)
    _run(sys.executable, 'setup.py', '-q', 'bdist_wheel', '-d', tmp_path, cwd=source)
    assert [*tmp_path.glob('*.whl')]


@pytest.mark.long
def test_the_distributions_hold_every_file_of_the_package(source, archive, wheel):
    wanted = {
        str(path.relative_to(source))
        for path in (source / 't3mpc_ros').rglob('*')
        if path.is_file()
        and '__pycache__' not in path.parts
        # Of the firmware the emulator needs the portable core and its host.
        and ('firmware' not in path.parts or path.parent.name in ('core', 'host'))
    }
    with zipfile.ZipFile(wheel) as files:
        names = {*files.namelist()}
    assert wanted - names == set()
    assert 't3mpc_ros/py.typed' in names
    shared = {name.partition('/data/')[2] for name in names if '/data/' in name}
    assert {
        f'share/t3mpc_ros/config/{path.name}' for path in (ROOT / 'config').iterdir()
    } <= shared
    with tarfile.open(archive) as files:
        names = {name.partition('/')[2] for name in files.getnames()}
    assert wanted - names == set()
    assert {'requirements.txt', 'package.xml', 'LICENSE', 'launch/sim.launch.py'} <= names
    assert not [name for name in names if name.startswith(('test/', 'docs/'))], 'some of them'


@pytest.mark.parametrize('kind', ['sdist', 'wheel'])
@pytest.mark.long
def test_equal_sources_give_equal_distributions(kind, source, request, tmp_path):
    """At another time and place, with another umask, for another time zone and owner of files."""
    (tmp_path / 'Übung mit Blank').mkdir()
    other = Path(shutil.copytree(source, tmp_path / 'Übung mit Blank' / 'copy', symlinks=True))
    for number, path in enumerate(sorted(other.rglob('*'))):
        path.chmod(0o770 if path.is_dir() else 0o660)
        os.utime(path, (number * 86400, number * 86400))
    before = os.umask(0o077)
    try:
        zone = {'TZ': 'Pacific/Auckland', 'PYTHONHASHSEED': '7'}
        if kind == 'sdist':
            words = ['setup.py', '-q', 'sdist', '-d', tmp_path]
        else:
            options = ['-q', '--no-deps', '--no-build-isolation', '--no-index']
            words = ['-m', 'pip', 'wheel', *options, '-w', tmp_path, other]
        _run(sys.executable, *words, cwd=other, **zone)
    finally:
        os.umask(before)
    made = request.getfixturevalue('archive' if kind == 'sdist' else 'wheel')
    assert (tmp_path / made.name).read_bytes() == made.read_bytes()


def test_the_extras_are_declared(wheel):
    with zipfile.ZipFile(wheel) as files:
        (name,) = [each for each in files.namelist() if each.endswith('/METADATA')]
        text = files.read(name).decode()
    needed = [line for line in text.splitlines() if line.startswith('Requires-Dist:')]
    plain = [line for line in needed if 'extra ==' not in line]
    assert any('numba>=' in line or 'numba<' in line for line in plain)
    assert not any('setuptools' in line for line in plain)
    assert 'Description-Content-Type: text/markdown' in text
    assert '](docs/' not in text.partition('\n\n')[2], 'a relative link leads nowhere'
    # The environment of the demo stays small, and apt ROS 2 stays the ROS of its users.
    for extra, libraries in EXTRAS.items():
        for library in libraries:
            name = {'PIL': 'pillow', 'serial': 'pyserial'}.get(library, library)
            found = [line for line in needed if line.startswith(f'Requires-Dist: {name}')]
            assert any(f"extra == '{extra}'" in line.replace('"', "'") for line in found), library
            assert not any('extra ==' not in line for line in found), library
    assert not any('ros-jazzy' in line for line in plain)
    for extra in ('bags', 'ros', 'compare', 'cluster', 'dev'):
        assert f'Provides-Extra: {extra}\n' in text


# .ci/run installs the wheel every day as well.
@pytest.mark.long
def test_an_installation_by_pip_runs_in_any_folder(installed, tmp_path):
    on_path = {path.name for path in (installed / 'bin').iterdir()}
    assert on_path & EXECUTABLES == {'t3mpc'}, 'generic names collide there'
    nodes = installed / 'lib' / 't3mpc_ros'
    assert {path.name for path in nodes.iterdir()} == EXECUTABLES == {*NODES, 't3mpc'}
    code = 'import t3mpc_ros as t3; print(t3.__file__); print(t3.simulate("ADRC", duration=3.0))'
    shown = _run(installed / 'bin' / 'python', '-c', code, cwd=tmp_path)
    assert shown.startswith(str(installed))
    for name in sorted(EXECUTABLES):
        assert 't3mpc_ros' in _run(nodes / name, '--version', cwd=tmp_path)
