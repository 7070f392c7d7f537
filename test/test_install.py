# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Installation: the package built with colcon, and the scripts with their environment."""

from fnmatch import fnmatch
import functools
import os
from pathlib import Path
import re
import runpy
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest
from support.launch_files import nodes_of
from support.long_tests import few_of
import yaml

from t3mpc_ros.cli.main import _parser as cli_parser
from t3mpc_ros.nodes.registry import NODES, parameter_class

# All tests share one build.
pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parent.parent
EXECUTABLES = set(re.findall(r"f'(\w+) = \{NAME\}", (ROOT / 'setup.py').read_text()))
# Variables of the user's ROS, workspace and pip, removed for the tests.
FOREIGN = ('PYTHONPATH', 'AMENT_PREFIX_PATH', 'COLCON_', 'PIP_', 'UV_', 'T3MPC_')


def clean_environment(**extra):
    """Return the environment of this process without the variables of the user's setup."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(FOREIGN)}
    return kept | {key: str(value) for key, value in extra.items()}


def copy_package(destination):
    """Copy the package without the files that version control ignores."""
    ignored = [line.rstrip('/') for line in (ROOT / '.gitignore').read_text().split()]
    shutil.copytree(ROOT, destination, ignore=shutil.ignore_patterns('.git', *ignored))
    return destination


# --- colcon -------------------------------------------------------------------------------------


class Tree:
    """A colcon workspace with the package built into it."""

    def __init__(self, folder, *options):
        self.source = copy_package(folder / 'src' / 't3mpc_ros')
        self.symlinked = '--symlink-install' in options
        self.prefix = folder / 'install' / 't3mpc_ros'
        self.share = self.prefix / 'share' / 't3mpc_ros'
        colcon = Path(sys.prefix) / 'bin' / 'colcon'
        assert colcon.exists(), 'colcon is missing: pip install -r requirements-colcon.txt'
        self.environment = clean_environment(
            AMENT_PREFIX_PATH=sys.prefix,
            COLCON_HOME=folder / 'colcon',
        )
        built = subprocess.run(
            [colcon, 'build', *options],
            cwd=folder,
            env=self.environment,
            capture_output=True,
            text=True,
        )
        assert built.returncode == 0, built.stdout + built.stderr
        self.environment = self._sourced(folder / 'install' / 'setup.bash')
        self.scratch = folder / 'scratch'
        self.scratch.mkdir()

    def _sourced(self, setup):
        """Return the environment of a shell that has sourced the workspace."""
        output = subprocess.run(
            ['bash', '-c', 'source "$1" && env -0', 'bash', setup],
            env=self.environment,
            capture_output=True,
            text=True,
            check=True,
        )
        return dict(line.split('=', 1) for line in output.stdout.split('\0') if line)

    def start(self, name, *arguments):
        """Start an executable like ``ros2 run``, in the graph of the current test."""
        graph = {k: v for k, v in os.environ.items() if k.startswith(('ROS_', 'FASTRTPS_'))}
        return Process(self, name, arguments, self.environment | graph)

    def run(self, name, *arguments):
        return subprocess.run(
            [self.prefix / 'lib' / 't3mpc_ros' / name, *arguments],
            cwd=self.scratch,
            env=self.environment,
            capture_output=True,
            text=True,
        )


class Process:
    """A running executable; as a context manager it is killed at the end."""

    def __init__(self, tree, name, arguments, environment):
        self._name = name
        self._log = tree.scratch / f'{name}-{time.monotonic_ns()}.log'
        with self._log.open('wb') as output:
            self._process = subprocess.Popen(
                [tree.prefix / 'lib' / 't3mpc_ros' / name, *arguments],
                cwd=tree.scratch,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()

    def output(self):
        return self._log.read_text(errors='replace')

    def wait_ready(self, seconds=180.0):
        deadline = time.monotonic() + seconds
        while f'{self._name} ready' not in self.output():
            assert self._process.poll() is None, f'{self._name} exited early:\n{self.output()}'
            assert time.monotonic() < deadline, f'{self._name} is not ready:\n{self.output()}'
            time.sleep(0.05)

    def interrupt(self):
        """Return the exit code after SIGINT."""
        self._process.send_signal(signal.SIGINT)
        return self._process.wait(15.0)


@pytest.fixture(scope='module')
def build(tmp_path_factory):
    """Return a function that builds the package, once for each set of options."""

    @functools.cache
    def built(*options):
        return Tree(tmp_path_factory.mktemp('workspace'), *options)

    return built


@pytest.fixture(scope='module', params=['copied', 'symlinked'])
def tree(request, build):
    """Return the package built by ``colcon build``, and again with ``--symlink-install``."""
    return build() if request.param == 'copied' else build('--symlink-install')


@pytest.fixture(scope='module')
def copied(build):
    """Return the package built by a plain ``colcon build``."""
    return build()


def test_a_workspace_contains_all_files_that_ros_needs(tree):
    assert (tree.prefix / 'share/ament_index/resource_index/packages/t3mpc_ros').is_file()
    executables = {path.name for path in (tree.prefix / 'lib' / 't3mpc_ros').iterdir()}
    assert executables == EXECUTABLES == {*NODES, 't3mpc'}
    assert all(os.access(tree.prefix / 'lib/t3mpc_ros' / name, os.X_OK) for name in executables)
    for pattern in ('package.xml', 'config/*', 'launch/*.launch.py'):
        wanted = {path.relative_to(tree.source) for path in tree.source.glob(pattern)}
        there = {path.relative_to(tree.share) for path in tree.share.glob(pattern)}
        assert wanted == there != set()
    for path in tree.share.glob('config/*'):
        # Symlinked: an edited YAML takes effect. Copied: independent of the source.
        assert path.is_relative_to(tree.prefix)
        assert path.resolve().is_relative_to(tree.source.resolve()) == tree.symlinked


def test_a_sourced_workspace_runs_its_own_complete_code(tree):
    """``packages=[name]`` in setup.py would omit the sub-packages, which .venv would hide."""
    code = 'import t3mpc_ros; print(t3mpc_ros.__path__[0])'
    output = subprocess.check_output(
        [sys.executable, '-c', code], cwd=tree.scratch, env=tree.environment, text=True
    )
    installed = Path(output.strip())
    assert installed.is_relative_to(tree.prefix.parent.parent)
    source = tree.source / 't3mpc_ros'
    assert {path.relative_to(installed) for path in installed.rglob('*.py')} == {
        path.relative_to(source) for path in source.rglob('*.py')
    }
    prefixes = tree.environment['AMENT_PREFIX_PATH'].split(os.pathsep)
    assert prefixes == [str(tree.prefix), sys.prefix]


@pytest.mark.slow
@pytest.mark.parametrize('tree', few_of(['copied', 'symlinked']), indirect=True)
def test_every_installed_node_starts_and_exits_with_0(tree, graph):
    for name in NODES:
        with tree.start(name) as node:
            node.wait_ready()
            assert node.interrupt() == 0, node.output()
            assert 'Traceback' not in node.output()


@pytest.mark.slow
@pytest.mark.parametrize('tree', few_of(['copied', 'symlinked']), indirect=True)
def test_the_installed_program_computes_lyapunov_exponents(tree):
    done = tree.run('t3mpc', 'exponents', '--duration', '20')
    assert done.returncode == 0, done.stderr
    # The sum is the trace of the Jacobian, whatever the duration.
    assert float(re.search(r'sum: (-?[\d.]+)', done.stdout).group(1)) == pytest.approx(
        -38, abs=0.1
    )


def test_colcon_test_runs_the_tests_and_reports_them(copied):
    """Without pytest as a test dependency it ran nothing and reported success."""
    colcon, workspace = Path(sys.prefix) / 'bin' / 'colcon', copied.source.parent.parent
    some = ['--pytest-args', 'test/geometry/test_timing.py']
    for words in (['test', *some], ['test-result', '--all']):
        done = subprocess.run(
            [colcon, *words],
            cwd=workspace,
            env=copied.environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout + done.stderr
    (count,) = re.findall(
        r'^Summary: (\d+) tests, 0 errors, 0 failures', done.stdout, re.MULTILINE
    )
    assert int(count) > 10


# --- configuration and launch -------------------------------------------------------------------

CHANGED = {
    'controller': ('terms_rate', 12.5),
    'recorder': ('storage.chunk_size', 4096),
    'player': ('play.rate', 2.5),
    'radio_bridge': ('port', '/dev/other'),
    'reference_generator': ('seed', 77),
    'sim_robot': ('noise.variance', 0.0625),
}
"""One parameter of each node with a value that is not its default."""


def _read_parameter(node, name, wanted):
    """Return a parameter of a running node, read through its service."""
    from rcl_interfaces.srv import GetParameters
    import rclpy
    from rclpy.parameter import parameter_value_to_python

    client = node.create_client(GetParameters, f'{name}/get_parameters')
    assert client.wait_for_service(30.0), f'{name} is not in the graph'
    future = client.call_async(GetParameters.Request(names=[wanted]))
    rclpy.spin_until_future_complete(node, future, timeout_sec=30.0)
    return parameter_value_to_python(future.result().values[0])


@pytest.mark.slow
@pytest.mark.parametrize('name', CHANGED)
def test_each_yaml_reaches_its_node_with_and_without_a_namespace(name, copied, ros, tmp_path):
    """The key matches ``/controller`` and ``/robot_1/controller``.

    The installed file is loaded, then a copy with one value that differs from the default: a key
    that matches no node fails.
    """
    import rclpy

    installed = copied.share / 'config' / f'{name}.yaml'
    parameter, value = CHANGED[name]
    assert parameter_class(name).from_dict({}).to_dict()[parameter] != value
    content = yaml.safe_load(installed.read_text())
    (entry,) = content.values()
    *parents, leaf = parameter.split('.')
    branch = entry['ros__parameters']
    for parent in parents:
        branch = branch.setdefault(parent, {})
    branch[leaf] = value
    changed = tmp_path / 'changed.yaml'
    changed.write_text(yaml.safe_dump(content))

    files = ['--params-file', str(installed), '--params-file', str(changed)]
    reader = rclpy.create_node('reader')
    try:
        other = ['-r', '__ns:=/robot_1']
        with (
            copied.start(name, '--ros-args', *files) as plain,
            copied.start(name, '--ros-args', *other, *files) as inside,
        ):
            for node, namespace in ((plain, ''), (inside, '/robot_1')):
                node.wait_ready()
                assert _read_parameter(reader, f'{namespace}/{name}', parameter) == value
                assert node.interrupt() == 0, node.output()
    finally:
        reader.destroy_node()


def test_every_yaml_is_tested():
    # The files of other robots: test_launch_files.py
    tested = set(CHANGED) | {'generic', 'paper_robot', 'turtlebot3'}
    assert {path.stem for path in (ROOT / 'config').glob('*.yaml')} == tested


def test_the_launch_file_names_only_what_is_installed(copied, monkeypatch):
    """The package ``launch`` is available from apt only: the file runs with substitutes."""
    monkeypatch.setenv('AMENT_PREFIX_PATH', copied.environment['AMENT_PREFIX_PATH'])
    for file in (copied.share / 'launch').iterdir():
        for node in nodes_of(file):
            assert node.executable in EXECUTABLES
            files = [Path(level) for level in node.parameters if isinstance(level, str)]
            assert all(path.is_relative_to(copied.share) for path in files)
            keys = [key for path in files for key in yaml.safe_load(path.read_text())]
            assert any(fnmatch(f'/{node.name}', key.replace('/**', '*')) for key in keys)


# --- scripts ------------------------------------------------------------------------------------

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
  exec "$REAL_PYTHON" -c 'import sys
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
-m\ ruff* | -m\ mypy* | -m\ pytest*) echo "$*" >>"$beside/checks" ;;
*main\ compile)
  note compile
  [ ! -e "$beside/slow_kernels" ] || exec sleep 60 ;;
*) echo "unexpected: $*" >&2; exit 99 ;;
esac
"""
UPDATE = ['uv', 'libraries', 'compile', 'package']
SET_UP = ['venv', *UPDATE]


class Checkout:
    """A new copy of the package, with a fake Python as the only one on PATH."""

    def __init__(self, folder):
        self.root = copy_package(folder / 'a checkout')
        self.notes = folder / 'notes'
        self.bin = folder / 'bin'
        self.python(self.bin, '3.12.3')
        tools = 'bash cat chmod cp dirname env flock grep mkdir mv readlink rm setsid sha256sum'
        tools += ' sleep tail uname'
        for tool in tools.split():
            (self.bin / tool).symlink_to(shutil.which(tool))

    def python(self, folder, version):
        """Create a fake ``python3`` of a version in a folder."""
        folder.mkdir(exist_ok=True)
        path = folder / 'python3'
        path.write_text(FAKE_PYTHON)
        path.chmod(0o755)
        (folder / 'version').write_text(version)
        return path

    def command(self, *arguments, **extra):
        environment = clean_environment(
            PATH=self.bin,
            FAKE_NOTES=self.notes,
            REAL_PYTHON=sys.executable,
            VENV=self.root / '.venv',
        )
        return {
            'args': [self.root / 'scripts' / 'run', *arguments],
            'env': environment | {key: str(value) for key, value in extra.items()},
            'stdout': subprocess.PIPE,
            'stderr': subprocess.PIPE,
            'text': True,
        }

    def run(self, *arguments, **extra):
        return subprocess.run(**self.command(*arguments, **extra))

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

    @property
    def stamped(self):
        return (self.root / '.venv' / 'stamp').exists()


@pytest.fixture
def checkout(tmp_path):
    """Return a new copy of the package with a fake Python."""
    return Checkout(tmp_path)


def test_run_sets_up_once_and_passes_arguments_on(checkout):
    first = checkout.run('t3mpc', 'two words', '-x')
    assert (first.returncode, first.stdout) == (0, 't3mpc got two words -x\n'), first.stderr
    assert checkout.done() == SET_UP
    again = checkout.run('t3mpc')
    assert (again.returncode, again.stdout, again.stderr) == (0, 't3mpc got \n', '')
    assert checkout.done() == []


@pytest.mark.parametrize('arguments', [(), ('t3mpcs',), ('.',), ('../t3mpc',)])
def test_run_with_an_unknown_name_lists_the_names(arguments, checkout):
    checkout.run('t3mpc')
    done = checkout.run(*arguments)
    assert done.returncode == 2
    assert 'NAME one of: t3mpc\n' in done.stderr
    assert all(f'no executable {name}\n' in done.stderr for name in arguments)


@pytest.mark.parametrize(
    'file',
    ['requirements.txt', 'setup.py', 'config/fastdds_loopback.xml', 'scripts/environment.sh'],
)
def test_a_stale_environment_is_updated(file, checkout):
    checkout.run('t3mpc')
    checkout.done()
    with (checkout.root / file).open('a') as text:
        text.write('# changed\n')
    assert checkout.run('t3mpc').returncode == 0
    assert checkout.done() == UPDATE
    checkout.run('t3mpc')
    assert checkout.done() == []


def test_compiled_files_beside_the_launch_file_are_ignored(checkout):
    """Regression: a folder launch/__pycache__ ended every script without a message."""
    (checkout.root / 'launch' / '__pycache__').mkdir()
    assert checkout.run('t3mpc').returncode == 0


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
        output, errors = process.communicate(timeout=30)
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


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_set_up_and_its_commands(number, checkout):
    """A signal to the script once left pip running, with the lock of the set-up."""
    slow = checkout.beside('slow')
    slow.touch()
    script = subprocess.Popen(**checkout.command('t3mpc'))
    deadline = time.monotonic() + 30.0
    while not (pid := slow.read_text().strip()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    script.send_signal(number)
    _, errors = script.communicate(timeout=30)  # the pipe ends with the last process of the set-up
    assert script.returncode == 128 + number
    assert 'stopped' in errors
    assert not Path('/proc', pid).exists()
    assert not checkout.stamped


def test_a_long_step_of_the_set_up_shows_the_time(checkout):
    """Compilation alone takes a minute, in which the script would print nothing."""
    sleep = checkout.bin / 'sleep'
    sleep.unlink()
    # Of the two sleeps, that between two looks at the command is shortened.
    real = shutil.which('sleep')
    text = f'[ "$1" = 0.2 ] && exec {real} 0.005\nexec {real} "$1"\n'
    sleep.write_text(f'#!{shutil.which("bash")}\n{text}')
    sleep.chmod(0o755)
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
    [libraries] = checkout.beside('installed').read_text().splitlines()
    assert re.findall(r'/(requirements[\w.-]*)', libraries) == ['requirements.txt']
    checkout.done()
    check = checkout.command('--version')
    check['args'][0] = checkout.root / 'scripts' / 'check'
    with (checkout.root / 'requirements-colcon.txt').open('a') as text:
        text.write('# changed\n')
    assert checkout.run('t3mpc').returncode == 0
    assert checkout.done() == []
    assert subprocess.run(**check).returncode == 0
    assert checkout.done() == UPDATE
    installed = checkout.beside('installed').read_text().splitlines()[-1]
    assert re.findall(r'/(requirements[\w.-]*)', installed) == [
        'requirements.txt',
        'requirements-dev.txt',
    ]
    checkout.run('t3mpc')
    subprocess.run(**check)
    assert checkout.done() == []


@pytest.mark.parametrize(
    'arguments, linted, selected',
    [
        (
            (),
            True,
            ['not (ros or long)', 'ros and not (alone or long)', 'ros and alone and not long'],
        ),
        (('--quick',), True, ['not (ros or slow or long)']),
        (('--long',), False, ['long']),
        (('--long', '3/7'), False, ['long --part 3/7']),
        (('-k', 'name'), True, None),
    ],
)
def test_check_runs_what_is_asked_for(arguments, linted, selected, checkout):
    command = checkout.command(*arguments)
    command['args'][0] = checkout.root / 'scripts' / 'check'
    done = subprocess.run(**command)
    assert done.returncode == 0, done.stderr
    lines = checkout.beside('checks').read_text().splitlines()
    tests = [line.removeprefix('-m pytest ') for line in lines if 'pytest' in line]
    assert len(lines) - len(tests) == (3 if linted else 0)
    if selected is None:
        assert tests == ['-k name']
    else:
        found = [re.fullmatch(r'-m (.*?)(?: --ignore-glob .*| -n .*)?', test) for test in tests]
        assert [match.group(1) for match in found] == selected


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
    uv.unlink()
    checkout.beside('no_uv').touch()
    (checkout.root / '.venv' / 'stamp').unlink()
    done = checkout.run('t3mpc')
    assert (done.returncode, done.stdout) == (0, 't3mpc got \n'), done.stderr
    assert checkout.done() == ['uv', 'ensurepip', 'libraries', 'compile', 'package']
    assert f'{checkout.root}/.venv/bin/python -m pip' in checkout.beside('installed').read_text()
    assert not (checkout.root / '.venv' / 'uv').exists()


def test_executables_are_moved_and_files_linked(tmp_path, monkeypatch):
    finish = runpy.run_path(str(ROOT / 'scripts' / 'finish_install.py'))
    bin_folder, target = tmp_path / 'bin', tmp_path / 'lib' / 't3mpc_ros'
    for folder in (bin_folder, target):
        folder.mkdir(parents=True)
    (target / 'of_an_earlier_version').touch()
    for name in (*EXECUTABLES, 'python'):
        (bin_folder / name).touch()
    finish['move_executables'](tmp_path)
    assert {path.name for path in target.iterdir()} == EXECUTABLES
    assert [path.name for path in bin_folder.iterdir()] == ['python']

    finish['link_data_files'](tmp_path, ROOT)
    share = tmp_path / 'share'
    assert (share / 'ament_index/resource_index/packages/t3mpc_ros').exists()
    for name in ('launch', 'config'):
        names = {path.name for path in (ROOT / name).iterdir() if path.is_file()}
        assert {path.name for path in (share / 't3mpc_ros' / name).iterdir()} == names

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
    done = subprocess.run(**checkout.command('t3mpc'), timeout=50)
    assert done.returncode == 1
    assert 'error: the package could not be installed' in done.stderr


def test_the_help_of_the_demo_needs_no_environment(checkout):
    for word in ('--help', '-h'):
        command = checkout.command()
        command['args'] = [checkout.root / 'scripts' / 'demo', '--headless', word]
        done = subprocess.run(**command)
        assert (done.returncode, done.stderr) == (0, '')
        options = vars(cli_parser().parse_args(['demo'])).keys() - {'command', 'run'}
        assert all(f'--{name}' in done.stdout for name in options)
    assert checkout.done() == []
    assert not (checkout.root / '.venv').exists()


def test_a_symlink_to_a_script_works(checkout, tmp_path):
    link = tmp_path / 'run'
    link.symlink_to(checkout.root / 'scripts' / 'run')
    command = checkout.command('t3mpc', 'x')
    command['args'][0] = link
    done = subprocess.run(**command)
    assert (done.returncode, done.stdout) == (0, 't3mpc got x\n'), done.stderr
    assert checkout.stamped


def test_a_failed_update_does_not_count_as_an_environment(checkout):
    checkout.run('t3mpc')
    with (checkout.root / 'requirements.txt').open('a') as text:
        text.write('# changed\n')
    checkout.beside('no_index').touch()
    assert checkout.run('t3mpc').returncode == 1
    assert not checkout.stamped
    assert checkout.run('t3mpc').returncode == 1


@pytest.mark.slow
def test_an_unreachable_index_is_an_error_with_a_remedy(tmp_path):
    """With the real Python and pip, and an index that does not respond."""
    root = copy_package(tmp_path / 'checkout')
    with socket.socket() as listener:
        listener.bind(('127.0.0.1', 0))
        port = listener.getsockname()[1]
    offline = {
        'T3MPC_PYTHON': getattr(sys, '_base_executable', sys.executable),
        'PIP_CONFIG_FILE': os.devnull,
        'PIP_NO_CACHE_DIR': 1,
        'PIP_RETRIES': 0,
    }
    for index in (
        {'PIP_INDEX_URL': f'http://127.0.0.1:{port}/simple', 'no_proxy': '127.0.0.1'},
        {'PIP_NO_INDEX': 1},
    ):
        done = subprocess.run(
            [root / 'scripts' / 'run', 't3mpc', 'exponents'],
            env=clean_environment(**offline, **index),
            capture_output=True,
            text=True,
        )
        assert done.returncode == 1
        assert 'error: the libraries could not be installed' in done.stderr
        assert 'remedy: check the network and the package index' in done.stderr
        assert not (root / '.venv' / 'stamp').exists()


def test_a_sourced_ros_does_not_enter_the_local_environment(checkout, tmp_path):
    """Regression: modules and libraries of a system ROS took precedence."""
    libraries = tmp_path / 'ros' / 'lib'
    libraries.mkdir(parents=True)
    (libraries / 'librcl.so').touch()
    checkout.run('t3mpc')
    program = checkout.root / '.venv' / 'lib' / 't3mpc_ros' / 't3mpc'
    program.write_text('#!/bin/sh\nenv\n')
    output = checkout.run(
        't3mpc',
        PYTHONPATH=tmp_path / 'ros',
        AMENT_PREFIX_PATH=tmp_path / 'ros',
        LD_LIBRARY_PATH=f'{libraries}:{tmp_path / "own"}',
        RMW_IMPLEMENTATION='rmw_cyclonedds_cpp',
        ROS_DOMAIN_ID='7',
        PYTHONDONTWRITEBYTECODE='1',
    ).stdout
    environment = dict(line.split('=', 1) for line in output.splitlines() if '=' in line)
    assert environment['AMENT_PREFIX_PATH'] == str(checkout.root / '.venv')
    assert environment['LD_LIBRARY_PATH'] == str(tmp_path / 'own')
    assert environment['ROS_DOMAIN_ID'] == '7'
    assert not {'PYTHONPATH', 'RMW_IMPLEMENTATION', 'PYTHONDONTWRITEBYTECODE'} & set(environment)


@pytest.mark.slow
@pytest.mark.skipif(
    Path(sys.prefix) != ROOT / '.venv', reason='not run through scripts/check: no .venv in use'
)
def test_run_starts_the_real_program():
    run = [ROOT / 'scripts' / 'run']
    done = subprocess.run(
        [*run, 't3mpc', 'exponents', '--duration', '5'], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert 'trace of the Jacobian: -38' in done.stdout
    subprocess.run([*run, 't3mpc', 'compile'], check=True)
    done = subprocess.run(run, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.endswith(f'NAME one of: {" ".join(sorted(EXECUTABLES))}\n')
