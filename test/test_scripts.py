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
"""The scripts and the local environment that they create."""

import os
from pathlib import Path
import re
import runpy
import shutil
import signal
import socket
import subprocess
import sys

import pytest
from support.checkout import EXECUTABLES, ROOT, clean_environment, copy_package
from support.long_tests import few_of
from support.signals import attend
from support.waiting import communicate, run, wait_until

from t3mpc_ros.cli.main import _parser as cli_parser
from t3mpc_ros.version import VERSION

pytestmark = pytest.mark.slow

# Fake Python and, in its place, uv: report a version, log their calls and what they install. While
# a file no_index exists beside the log they install nothing; no_uv: uv is not in the index.
FAKE_PYTHON = r"""#!/usr/bin/env bash
notes="$FAKE_NOTES"
beside="$(dirname "$notes")"
here="$(cat "$(dirname "$0")/version" 2>/dev/null)"
note() { echo "$1" >>"$notes"; }
case "$*" in
--version) echo "Python $here" ;;
-c*)
  exec "$REAL_PYTHON" -IS -c 'import sys
sys.version_info = tuple(map(int, sys.argv[1].split(".")))
exec(sys.argv[2])' "$here" "$2" ;;
'-m venv'*)
  note venv
  target="${!#}"
  [[ "$*" != *--clear* ]] || rm -rf "$target"
  mkdir -p "$target/bin"
  cp "$0" "$target/bin/python"
  echo "$here" >"$target/bin/version" ;;
'-m pip --version') [ -e "$(dirname "$0")/pip" ] ;;
'-m ensurepip')
  note ensurepip
  >"$(dirname "$0")/pip" ;;
'cache dir') echo "$beside/cache" ;;
'-m pip config list') [ ! -e "$beside/pip_settings" ] || cat "$beside/pip_settings" ;;
*'pip install'*'--target '*' uv')
  note uv
  [ ! -e "$beside/no_uv" ] || exit 1
  mkdir -p "$VENV/uv/bin"
  cp "$0" "$VENV/uv/bin/uv" ;;
*'pip install'*' -r '*)
  note libraries
  echo "$0 $*" >>"$beside/installed"
  env | grep '^UV_' >"$beside/uv_settings"
  if [ -e "$beside/slow" ]; then
    echo "$BASHPID" >"$beside/slow"
    sleep 60
  fi
  if [ -e "$beside/no_index" ]; then
    echo 'ERROR: Could not find a version that satisfies the requirement numpy'
    exit 1
  fi ;;
*'pip install'*' -e '*)
  note package
  printf '#!/bin/sh\necho "t3mpc got $*"\n' >"$VENV/bin/t3mpc"
  chmod +x "$VENV/bin/t3mpc" ;;
*finish_install.py)
  mkdir -p "$VENV/lib/t3mpc_ros"
  mv "$VENV/bin/t3mpc" "$VENV/lib/t3mpc_ros/t3mpc" ;;
*missing_tools.py*) cat "$2" >&2 ;;
-m\ ruff* | -m\ mypy* | -m\ pytest*)
  echo "$*" >>"$beside/checks"
  case "$*" in *pytest*) echo "not installed, $*" >>"$T3MPC_MISSING_TOOLS" ;; esac
  [ ! -e "$beside/failing" ] || exit 1 ;;
*main\ compile)
  note compile
  [ ! -e "$beside/slow_kernels" ] || exec sleep 60 ;;
*) echo "unexpected: $*" >&2; exit 99 ;;
esac
"""
UNUSED = (
    'firmware', 'examples', 'bag', 'chaos', 'cli', 'control', 'emulator', 'evaluation', 'fuzzy',
    'geometry', 'localization', 'mpc', 'nodes', 'page', 'parameters', 'radio', 'robot',
    'simulation', 'view',
)  # fmt: skip
"""Folders that the set-up does not look into."""
UPDATE = ['uv', 'libraries', 'compile', 'package']
SET_UP = ['venv', *UPDATE]


class Checkout:
    """A new copy of the package, with a fake Python as the only one on PATH."""

    def __init__(self, folder):
        self.root = copy_package(folder / 'a checkout', 'docs', 'test', 'bench', *UNUSED)
        self.notes = folder / 'notes'
        self.bin = folder / 'bin'
        self.python(self.bin, '3.12.3')
        tools = 'bash cat chmod cp dirname env flock grep locale mkdir mktemp mv'
        tools += ' nice nproc readlink rm sed setsid sha256sum sleep sort tail uname'
        for tool in tools.split():
            (self.bin / tool).symlink_to(shutil.which(tool))
        # The sleep between two looks at a command is shortened.
        sleep, bash = self.bin / 'sleep', shutil.which('bash')
        real = sleep.readlink()
        sleep.unlink()
        text = f'[ "$1" = 0.2 ] && exec {real} 0.005\nexec {real} "$1"\n'
        sleep.write_text(f'#!{bash}\n{text}')
        sleep.chmod(0o755)

    def python(self, folder, version):
        """Create a fake ``python3`` of a version in a folder."""
        folder.mkdir(exist_ok=True)
        path = folder / 'python3'
        path.write_text(FAKE_PYTHON)
        path.chmod(0o755)
        (folder / 'version').write_text(version)
        return path

    def command(self, *arguments, script=None, **extra):
        environment = clean_environment(
            PATH=self.bin,
            FAKE_NOTES=self.notes,
            REAL_PYTHON=sys.executable,
            VENV=self.root / '.venv',
        )
        return {
            'args': [script or self.root / 'scripts' / 'run', *arguments],
            'env': environment | {key: str(value) for key, value in extra.items()},
            'stdout': subprocess.PIPE,
            'stderr': subprocess.PIPE,
            'text': True,
            'preexec_fn': attend,
        }

    def run(self, *arguments, **extra):
        options = self.command(*arguments, **extra)
        return run(options.pop('args'), **options)

    def done(self):
        """Return the logged calls since the last call; kernels and package go side by side."""
        steps = self.notes.read_text().split() if self.notes.exists() else []
        self.notes.unlink(missing_ok=True)
        if steps[-2:] == ['package', 'compile']:
            steps[-2:] = ['compile', 'package']
        return steps

    def beside(self, name):
        """Return a file that steers or reports on the fake Python."""
        return self.notes.parent / name

    def report(self, name):
        """Return the lines of a report of the fake Python since the last call."""
        lines = self.beside(name).read_text().splitlines()
        self.beside(name).unlink()
        return lines

    @property
    def stamped(self):
        return (self.root / '.venv' / 'stamp').exists()


@pytest.fixture
def checkout(tmp_path):
    """Return a new copy of the package with a fake Python."""
    return Checkout(tmp_path)


@pytest.fixture(scope='module')
def ready(tmp_path_factory):
    """Return a checkout that is set up, for tests that change no more than its program.

    Regression: a folder launch/__pycache__ ended every script without a message.
    """
    made = Checkout(tmp_path_factory.mktemp('ready'))
    (made.root / 'launch' / '__pycache__').mkdir()
    assert made.run('t3mpc').returncode == 0
    return made


def test_run_sets_up_once_and_passes_arguments_on(checkout, tmp_path):
    first = checkout.run('t3mpc', 'two words', '-x')
    assert (first.returncode, first.stdout) == (0, 't3mpc got two words -x\n'), first.stderr
    assert checkout.done() == SET_UP
    again = checkout.run('t3mpc')
    assert (again.returncode, again.stdout, again.stderr) == (0, 't3mpc got \n', '')
    link = tmp_path / 'a link'
    link.symlink_to(checkout.root / 'scripts' / 'run')
    linked = checkout.run('t3mpc', 'x', script=link)
    assert (linked.returncode, linked.stdout) == (0, 't3mpc got x\n'), linked.stderr
    assert checkout.done() == []
    for arguments in ((), ('t3mpcs',), ('.',), ('../t3mpc',)):
        done = checkout.run(*arguments)
        assert done.returncode == 2
        assert 'NAME one of: t3mpc\n' in done.stderr
        assert all(f'no executable {name}\n' in done.stderr for name in arguments)


SOURCES = 'requirements.txt', 'setup.py', 'config/fastdds_loopback.xml', 'scripts/environment.sh'


@pytest.mark.parametrize(('names',), few_of([(SOURCES[:2],), (SOURCES[2:],)]))
def test_a_stale_environment_is_updated(names, checkout):
    checkout.run('t3mpc')
    checkout.done()
    for name in names:
        with (checkout.root / name).open('a') as text:
            text.write('# changed\n')
        assert checkout.run('t3mpc').returncode == 0
        assert checkout.done() == UPDATE, name
    checkout.run('t3mpc')
    assert checkout.done() == []


@pytest.mark.long
def test_a_moved_checkout_or_new_python_gets_a_new_environment(checkout, tmp_path):
    checkout.run('t3mpc')
    checkout.root = checkout.root.rename(tmp_path / 'moved')
    checkout.done()
    assert checkout.run('t3mpc').returncode == 0
    assert checkout.done() == SET_UP
    newer = checkout.python(tmp_path / 'newer', '3.13.1')
    assert checkout.run('t3mpc', T3MPC_PYTHON=newer).returncode == 0
    assert checkout.done() == SET_UP
    # It remains in use without T3MPC_PYTHON.
    assert checkout.run('t3mpc').returncode == 0
    assert checkout.done() == []


def test_two_scripts_at_once_set_up_once(checkout):
    both = [subprocess.Popen(**checkout.command('t3mpc')) for _ in range(2)]
    for process in both:
        output, errors = communicate(process)
        assert (process.returncode, output) == (0, 't3mpc got \n'), errors
    assert checkout.done() == SET_UP


def test_a_python_that_is_too_old_is_an_error_with_a_remedy(checkout):
    checkout.python(checkout.bin, '3.9.2')
    done = checkout.run('t3mpc')
    assert done.returncode == 1
    assert re.search(r'^error: .*3\.11.*Python 3\.9\.2', done.stderr, re.MULTILINE)
    assert re.search(r'^remedy: .*T3MPC_PYTHON=', done.stderr, re.MULTILINE)
    assert not (checkout.root / '.venv').exists()


@pytest.mark.parametrize('version, named', [('3.9.2', 'Python 3.9.2'), (None, 'not found')])
def test_an_unusable_requested_python_is_an_error(version, named, checkout, tmp_path):
    requested = tmp_path / 'requested' / 'python3'
    if version:
        checkout.python(requested.parent, version)
    done = checkout.run('t3mpc', T3MPC_PYTHON=requested)
    assert done.returncode == 1
    assert f'error: T3MPC_PYTHON={requested}' in done.stderr
    assert named in done.stderr
    assert 'remedy: ' in done.stderr
    assert checkout.done() == []


def test_an_interrupted_setup_is_repaired_by_the_next_run(checkout):
    checkout.beside('no_index').touch()
    done = checkout.run('t3mpc')
    assert done.returncode == 1
    assert 'ERROR: Could not find a version' in done.stderr
    assert 'error: the libraries could not be installed' in done.stderr
    assert 'remedy: check the network' in done.stderr
    assert checkout.done() == ['venv', 'uv', 'libraries', 'ensurepip', 'libraries']
    assert not checkout.stamped
    checkout.beside('no_index').unlink()
    assert checkout.run('t3mpc').returncode == 0
    assert checkout.done() == UPDATE
    # Nor does a failed update count as an environment.
    with (checkout.root / 'requirements.txt').open('a') as text:
        text.write('# changed\n')
    checkout.beside('no_index').touch()
    for _ in range(2):
        assert checkout.run('t3mpc').returncode == 1
        assert not checkout.stamped


@pytest.mark.parametrize('number', few_of([signal.SIGTERM, signal.SIGINT, signal.SIGHUP]))
def test_a_signal_ends_the_set_up_and_its_commands(number, checkout):
    """A signal to the script once left pip running, with the lock of the set-up."""
    slow = checkout.beside('slow')
    slow.touch()
    script = subprocess.Popen(**checkout.command('t3mpc'))
    wait_until(lambda: slow.read_text().strip())
    pid = slow.read_text().strip()
    script.send_signal(number)
    _, errors = communicate(script)  # the pipe ends with the last process of the set-up
    assert script.returncode == 128 + number
    assert 'stopped' in errors
    assert not Path('/proc', pid).exists()
    assert not checkout.stamped


def test_a_long_step_of_the_set_up_shows_the_time(checkout):
    """Compilation alone takes a minute, in which the script would print nothing."""
    checkout.beside('slow').touch()
    with subprocess.Popen(**checkout.command('t3mpc')) as script:
        shown = []
        for line in script.stderr:
            shown.append(line.strip())
            if line.strip() == '30 s':
                break
        script.send_signal(signal.SIGTERM)
    step = shown.index('installing ROS 2 Jazzy and the libraries from the package index')
    assert re.fullmatch(r'done in \d+ s', shown[step - 1])
    assert shown[step + 1 :] == ['10 s', '20 s', '30 s']


def test_each_part_of_the_environment_is_installed_when_needed(checkout):
    """Tests, types and the nonlinear MPC are no part of what a demo needs: 1.2 GB were."""
    checkout.run('t3mpc')
    [libraries] = checkout.report('installed')
    assert re.findall(r'/(requirements[\w.-]*)', libraries) == ['requirements.txt']
    checkout.done()
    check = checkout.root / 'scripts' / 'check'
    with (checkout.root / 'requirements-colcon.txt').open('a') as text:
        text.write('# changed\n')
    assert checkout.run('t3mpc').returncode == 0
    assert checkout.done() == []
    assert checkout.run('--version', script=check).returncode == 0
    assert checkout.done() == UPDATE
    [installed] = checkout.report('installed')
    assert re.findall(r'/(requirements[\w.-]*)', installed) == [
        'requirements.txt',
        'requirements-dev.txt',
    ]
    checkout.run('t3mpc')
    checkout.run('--version', script=check)
    assert checkout.done() == []


def test_check_runs_what_is_asked_for(checkout, tmp_path):
    check = checkout.root / 'scripts' / 'check'
    (notes := tmp_path / 'temporary').mkdir()
    long = ['long and not ros', 'long and ros']
    computing = 'not (ros or long)'
    usual = [*2 * [computing], 'ros and not (timed or long)', 'ros and timed and not long']
    for arguments, linted, selected in (
        ((), True, usual),
        (('--quick',), True, ['not (ros or slow or long)']),
        (('--long',), False, long),
        (('--long', '3/7'), False, [f'{marks} --part 3/7' for marks in long]),
    ):
        done = checkout.run(*arguments, script=check, TMPDIR=notes)
        assert done.returncode == 0
        lines = checkout.report('checks')
        begin = re.compile(r'-m pytest --outcomes=\S+ ')
        tests = [begin.sub('', line) for line in lines if begin.match(line)]
        # What all of them have skipped for want of a tool stands at the end, once.
        listed = [line for line in done.stderr.splitlines() if 'not installed' in line]
        listed = [begin.sub('', line.partition(', ')[2]) for line in listed]
        assert sorted(listed) == sorted(tests)  # two stages run at once
        assert [*notes.iterdir()] == []
        assert len(lines) - len(tests) == (3 if linted else 0)
        found = [re.fullmatch(r'-m (.*?)(?: --ignore-glob .*| -n .*)?', test) for test in tests]
        assert sorted(match.group(1) for match in found) == sorted(selected)
    assert checkout.run('-k', 'name', script=check).returncode == 0
    assert [line for line in checkout.report('checks') if line.endswith('/outcomes -k name')]
    checkout.beside('failing').touch()
    done = checkout.run('--long', script=check)
    assert done.returncode == 1
    assert re.search('^not installed, .* -m long and ros$', done.stderr, re.MULTILINE)


def test_the_installer_is_uv_and_without_it_pip(checkout):
    uv = checkout.bin / 'uv'
    uv.write_text(FAKE_PYTHON)
    uv.chmod(0o755)
    checkout.beside('pip_settings').write_text(
        "global.extra-index-url='https://a.example/simple\\nhttps://b.example/simple'\n"
        f"global.find-links='{checkout.root}'\nglobal.timeout='60'\n"
        "global.index-url='https://mirror.example/simple?a=b'\n"
    )
    checkout.run('t3mpc')
    assert checkout.done() == ['venv', 'libraries', 'compile', 'package']
    assert set(checkout.beside('uv_settings').read_text().splitlines()) == {
        'UV_DEFAULT_INDEX=https://mirror.example/simple?a=b',
        'UV_INDEX=https://a.example/simple https://b.example/simple',
        'UV_INDEX_STRATEGY=unsafe-best-match',
        f'UV_FIND_LINKS={checkout.root}',
    }
    # A home folder that cannot be written: uv would fail at its cache.
    checkout.beside('cache').rmdir()
    checkout.beside('cache').touch()
    (checkout.root / '.venv' / 'stamp').unlink()
    checkout.run('t3mpc')
    assert f'UV_CACHE_DIR={checkout.root}/.venv/uv/cache' in checkout.report('uv_settings')
    checkout.done()
    uv.unlink()
    checkout.beside('no_uv').touch()
    (checkout.root / '.venv' / 'stamp').unlink()
    done = checkout.run('t3mpc')
    assert (done.returncode, done.stdout) == (0, 't3mpc got \n'), done.stderr
    assert checkout.done() == ['uv', 'ensurepip', 'libraries', 'compile', 'package']
    assert f'{checkout.root}/.venv/bin/python -m pip' in checkout.beside('installed').read_text()
    assert not (checkout.root / '.venv' / 'uv').exists()


def test_executables_are_written_and_files_linked(tmp_path):
    finish = runpy.run_path(str(ROOT / 'scripts' / 'finish_install.py'))
    target = tmp_path / 'lib' / 't3mpc_ros'
    target.mkdir(parents=True)
    (target / 'of_an_earlier_version').touch()
    finish['write_executables'](tmp_path, ROOT)
    assert {path.name for path in target.iterdir()} == EXECUTABLES
    assert all(os.access(path, os.X_OK) for path in target.iterdir())

    finish['link_data_files'](tmp_path, ROOT)
    share = tmp_path / 'share'
    assert (share / 'ament_index/resource_index/packages/t3mpc_ros').exists()
    for name in ('launch', 'config'):
        names = {path.name for path in (ROOT / name).iterdir() if path.is_file()}
        assert {path.name for path in (share / 't3mpc_ros' / name).iterdir()} == names

    # The path of an editable installation, in any locale and from any folder.
    packages = tmp_path / 'lib' / 'python3.11' / 'site-packages'
    packages.mkdir(parents=True)
    path = packages / f'__editable__.t3mpc_ros-{VERSION}.pth'
    finish['shorten_path'](tmp_path, source := tmp_path / 'Übung')
    assert not path.exists()
    path.write_text(f'{source}\n')
    finish['shorten_path'](tmp_path, tmp_path)
    assert path.read_bytes() == b'../../..\n'

    size = finish['LARGE']
    contents = {'a.so': b'1' * size, 'a.so.2': b'1' * size, 'b.so': b'2' * size, 'c.so': b'1'}
    contents['d.so.1'] = b'1'
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    finish['link_copies'](tmp_path)
    assert {name: (tmp_path / name).read_bytes() for name in contents} == contents
    assert (tmp_path / 'a.so').samefile(tmp_path / 'a.so.2')
    assert not (tmp_path / 'c.so').samefile(tmp_path / 'd.so.1')  # not worth it
    assert not list(tmp_path.glob('*.link'))


def test_a_failed_installation_ends_the_compilation(checkout):
    """It goes on beside the installation, and would keep a processor busy after the error."""
    checkout.beside('slow_kernels').touch()
    text = (checkout.bin / 'python3').read_text().replace('note package', 'exit 1')
    (checkout.bin / 'python3').write_text(text)
    # The pipe ends with the last process.
    done = checkout.run('t3mpc')
    assert done.returncode == 1
    assert 'error: the package could not be installed' in done.stderr


def test_the_help_of_the_demo_needs_no_environment(checkout):
    for word in ('--help', '-h'):
        done = checkout.run('--headless', word, script=checkout.root / 'scripts' / 'demo')
        assert (done.returncode, done.stderr) == (0, '')
        options = vars(cli_parser().parse_args(['demo'])).keys() - {'command', 'run'}
        assert all(f'--{name}' in done.stdout for name in options)
    assert checkout.done() == []
    assert not (checkout.root / '.venv').exists()


UNREACHABLE = [
    {'PIP_INDEX_URL': 'http://127.0.0.1:PORT/simple', 'no_proxy': '127.0.0.1'},
    {'PIP_NO_INDEX': 1},
]


@pytest.mark.parametrize('index', few_of(UNREACHABLE, 0))
def test_an_unreachable_index_is_an_error_with_a_remedy(index, tmp_path):
    """With the real Python and pip, and an index that does not respond."""
    root = copy_package(tmp_path / 'checkout')
    with socket.socket() as listener:
        listener.bind(('127.0.0.1', 0))
        port = listener.getsockname()[1]
    settings = {
        'T3MPC_PYTHON': getattr(sys, '_base_executable', sys.executable),
        'PIP_CONFIG_FILE': os.devnull,
        'PIP_NO_CACHE_DIR': 1,
        'PIP_RETRIES': 0,
    }
    settings |= {name: str(value).replace('PORT', str(port)) for name, value in index.items()}
    done = subprocess.run(
        [root / 'scripts' / 'run', 't3mpc', 'exponents'],
        env=clean_environment(**settings),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert 'error: the libraries could not be installed' in done.stderr
    assert 'remedy: check the network and the package index' in done.stderr
    assert not (root / '.venv' / 'stamp').exists()


@pytest.fixture
def environment_of(ready):
    """Return a function that runs a program and returns its environment."""
    program = ready.root / '.venv' / 'lib' / 't3mpc_ros' / 't3mpc'
    program.write_text('#!/bin/sh\nenv\n')

    def environment(**given):
        lines = ready.run('t3mpc', **given).stdout.splitlines()
        return dict(line.split('=', 1) for line in lines if '=' in line)

    return environment


def test_a_sourced_ros_does_not_enter_the_local_environment(environment_of, ready, tmp_path):
    """Regression: modules and libraries of a system ROS took precedence."""
    libraries = tmp_path / 'ros' / 'lib'
    libraries.mkdir(parents=True)
    (libraries / 'librcl.so').touch()
    found = environment_of(
        PYTHONPATH=tmp_path / 'ros',
        AMENT_PREFIX_PATH=tmp_path / 'ros',
        LD_LIBRARY_PATH=f'{libraries}:{tmp_path / "own"}',
        RMW_IMPLEMENTATION='rmw_cyclonedds_cpp',
        ROS_DOMAIN_ID='7',
        PYTHONDONTWRITEBYTECODE='1',
    )
    assert found['AMENT_PREFIX_PATH'] == str(ready.root / '.venv')
    assert found['LD_LIBRARY_PATH'] == str(tmp_path / 'own')
    assert found['ROS_DOMAIN_ID'] == '7'
    assert not {'PYTHONPATH', 'RMW_IMPLEMENTATION', 'PYTHONDONTWRITEBYTECODE'} & set(found)


NO_LOCALE = {'LC_ALL': '', 'LC_CTYPE': '', 'LANG': ''}


@pytest.mark.parametrize(
    'given, name, seen',
    [
        # In another locale, Python failed on its own path file if the checkout had an umlaut.
        ({'LC_ALL': 'C'}, 'LC_ALL', 'C.UTF-8'),
        ({'LC_ALL': 'xx_XX.UTF-8'}, 'LC_ALL', 'C.UTF-8'),  # of a terminal elsewhere
        (NO_LOCALE, 'LC_ALL', 'C.UTF-8'),
        (NO_LOCALE | {'LANG': 'C.UTF-8'}, 'LC_ALL', ''),
        # Without a home, each command of matplotlib began with a warning, and listed all fonts.
        ({'HOME': '/tmp', 'MPLCONFIGDIR': ''}, 'MPLCONFIGDIR', ''),
        ({'HOME': '/dev/null', 'MPLCONFIGDIR': ''}, 'MPLCONFIGDIR', '.venv/matplotlib'),
        ({'HOME': '/dev/null', 'MPLCONFIGDIR': '/chosen'}, 'MPLCONFIGDIR', '/chosen'),
    ],
)
def test_programs_run_in_a_locale_of_utf8_and_with_a_home(given, name, seen, environment_of):
    found = environment_of(**given).get(name, '')
    assert found.endswith(seen) if seen else not found


real_environment = pytest.mark.skipif(
    Path(sys.prefix) != ROOT / '.venv', reason='not run through scripts/check: no .venv in use'
)


@real_environment
def test_run_starts_the_real_program():
    run = [ROOT / 'scripts' / 'run']
    done = subprocess.run([*run, 't3mpc', '--version'], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, '')
    done = subprocess.run(run, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.endswith(f'NAME one of: {" ".join(sorted(EXECUTABLES))}\n')


@real_environment
def test_the_environment_starts_without_a_locale():
    """A path file with the umlaut of a checkout ended every program in a UnicodeDecodeError."""
    for path in Path(sys.prefix).glob('lib/python*/site-packages/*.pth'):
        assert path.read_bytes().isascii(), path
    program = [sys.executable, '-c', 'import t3mpc_ros; print(ascii(t3mpc_ros.__path__[0]))']
    done = subprocess.run(
        program, env={'LC_ALL': 'C'}, cwd='/', capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == ascii(str(ROOT / 't3mpc_ros'))


@pytest.mark.long
@real_environment
def test_every_kernel_compiles():
    subprocess.run([ROOT / 'scripts' / 'run', 't3mpc', 'compile'], check=True)
