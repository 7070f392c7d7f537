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
"""Short default set of tests; fixtures: an isolated ROS graph for each test that needs one."""

import argparse
import functools
import gc
import itertools
import os
from pathlib import Path
import re
import signal

import pytest
from support import processor_wait
from support.missing_tools import list_missing, skip
from support.waiting import TIMEOUTS, Processes

from t3mpc_ros.cli.process_group import PrivateGraph

ROOT = Path(__file__).resolve().parent
DEFAULT = ('geometry', 'parameters', 'robot', 'fuzzy', 'test_launch_files.py')
"""What ``colcon test``, and pytest without arguments, runs; scripts/check runs all."""

FIRST = (
    'test_live_page.py',
    'test_node_processes.py',
    'test_live_stop.py',
    'test_install.py',
    'test_viewer.py',
    'test_reference_generator.py',
    'test_scripts.py',
    'test_launch_files.py',
    'test_readme.py',
)
"""Files that take long: at the end of a run, the other processors would wait for them.

The last of them follows those that compute much: it repeats a demo that was too slow.
"""
MAX_WAIT = 0.3
"""Largest share of the time with work to do that processes of a test may wait for a processor."""
WAIT = pytest.StashKey[processor_wait.ProcessorWait]()
PROCESSOR_WAIT = 'processor wait'
"""Property of the report of a test with nodes: this share."""
INCONCLUSIVE = 'inconclusive'
"""Outcome of a test, and title of the section of its report that holds the time-out."""
INCONCLUSIVE_CODE = 6
"""Exit code of a run in which nothing failed and something was inconclusive; pytest has 0 to 5."""
EMPTY_PART = pytest.StashKey[bool]()
"""Whether the part of the tests that is asked for has none, though there are tests."""
OUTCOMES = {'skipped': 'skipped', 'passed': 'passed', INCONCLUSIVE: INCONCLUSIVE} | dict.fromkeys(
    ('failed', 'error'), 'failed'
)
"""Outcomes of a test by those of its phases, the worst of which, the last here, counts."""


def pytest_addoption(parser):
    parser.addoption(
        '--part', type=_part, metavar='K/N', help='run part K of N of the selected tests'
    )
    parser.addoption(
        '--outcomes', type=Path, metavar='FILE', help='append OUTCOME NAME of each test to FILE'
    )


def pytest_configure(config):
    """End as with Ctrl-C at SIGTERM: fixtures then end the nodes that they have started."""
    # A run that a time limit had ended left graphs of nodes behind, which ran for ever.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # A shell lets what it starts in the background ignore Ctrl-C; the processes of the tests,
    # which inherit that, would be killed after a time-out instead of ending.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # With the limits of Python, garbage collection takes a seventh of the time of all tests.
    gc.set_threshold(50_000, 20, 100)


def _part(text):
    """Return number and count of ``K/N``."""
    number, _, count = text.partition('/')
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise argparse.ArgumentTypeError(f'must be K/N with 1 <= K <= N: got {text}')
    return int(number), int(count)


COUNTED_LATER = os.environ.get('T3MPC_COUNTED_LATER', '').split()
"""Folders whose tests .ci/coverage repeats without the compiler: traced once, in that run."""

MARKS = ('ros', 'timed', 'slow', 'long')
"""Marks by which a run selects."""


@functools.cache
def _marks_in(path):
    """Return the marks that all tests of a file have, and those that some of them may have."""
    text = path.read_text().replace('few_of(', 'mark.long(')
    of_all = ''.join(re.findall(r'^pytestmark = .*$', text, re.MULTILINE))
    named = ({*re.findall(r'\bmark\.(\w+)', words)} & {*MARKS} for words in (of_all, text))
    return tuple(named)


def _may_match(expression, path):
    """Return whether a test of a file may match a marker expression."""
    if {*re.findall(r'[\w.]+', expression)} - {*MARKS, 'and', 'or', 'not'}:
        return True
    certain, possible = _marks_in(path)
    return any(
        eval(expression, {}, {mark: mark in certain or mark in chosen for mark in MARKS})
        for count in range(len(MARKS) + 1)
        for chosen in itertools.combinations(possible, count)
    )


def _is_default(config):
    """Return whether nothing selects tests: neither paths, nor markers, nor names."""
    chosen = config.args_source is config.ArgsSource.ARGS or config.option.markexpr
    return not (chosen or config.option.keyword or hasattr(config, 'workerinput'))


def pytest_ignore_collect(collection_path, config):
    """Import only files whose tests may be selected: the import of all takes many seconds."""
    if collection_path.suffix != '.py' or not collection_path.is_relative_to(ROOT):
        return None
    if _is_default(config):
        return not {*collection_path.relative_to(ROOT).parts} & {*DEFAULT} or None
    if not (expression := config.option.markexpr):
        return None
    return not _may_match(expression, collection_path) or None


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Keep a part of the tests; of the default set, those that take neither long nor slow.

    What comes first is not left to the order of the arguments: pytest removes a path that is
    within another one.
    """
    for item in items:
        certain, possible = _marks_in(item.path)
        marks = {mark.name for mark in item.iter_markers()} & {*MARKS}
        if not certain <= marks <= possible:
            raise pytest.UsageError(f'{item.nodeid}: its file must name its marks, mark.NAME')
        repeated = item.path.parent.name in COUNTED_LATER and 'ros' not in marks
        if repeated and not item.get_closest_marker('compiled'):
            item.add_marker('no_cover')
    ranks = {name: rank for rank, name in enumerate(FIRST)}
    items.sort(key=lambda item: ranks.get(item.path.name, len(FIRST)))
    if config.option.part:
        number, count = config.option.part
        kept = items[number - 1 :: count]
        config.stash[EMPTY_PART] = bool(items and not kept)
        _keep(config, items, kept)
    elif _is_default(config):
        times = {'slow', 'long'}
        _keep(config, items, [i for i in items if not times & {m.name for m in i.iter_markers()}])


@pytest.hookimpl(trylast=True)
def pytest_collection_finish():
    """Let no later garbage collection examine the modules and thousands of tests: 0.3 s each."""
    gc.freeze()


def _keep(config, items, kept):
    config.hook.pytest_deselected(items=[*{*items} - {*kept}])
    items[:] = kept


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item):
    item.stash[WAIT] = processor_wait.begin()
    return (yield from _skip_without_compiler())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    return (yield from _skip_without_compiler())


def _skip_without_compiler():
    """Skip what needs emulated boards, whose rules are in C; scripted ones need no compiler."""
    try:
        return (yield)
    except Exception as error:
        if type(error).__name__ == 'CompilerMissingError':
            skip('C compiler')
        raise


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """A wait that timed out is inconclusive where processes had no processor; nothing else is."""
    report = yield
    wait = item.stash[WAIT]
    if report.when == 'call' and item.get_closest_marker('ros'):
        # Worker processes send reports, and nothing else, to the process that writes the summary.
        report.user_properties.append((PROCESSOR_WAIT, wait.share()))
    error = call.excinfo and call.excinfo.value
    if report.failed and isinstance(error, TIMEOUTS) and _share_at(error, wait) > MAX_WAIT:
        share = f'{_share_at(error, wait):.0%}'
        text = f'its processes waited for a processor for {share} of their time'
        failure = f'{item.nodeid}: {text}\n{report.longreprtext}'
        report.sections.append((INCONCLUSIVE, failure))
        report.outcome, report.longrepr = 'skipped', (str(item.path), 0, f'inconclusive: {text}')
    return report


def _share_at(error, wait):
    """Return the share when an error was raised: that of a shared fixture is raised again."""
    if not hasattr(error, 'processor_wait'):
        error.processor_wait = wait.share()
    return error.processor_wait


@pytest.hookimpl(tryfirst=True)
def pytest_report_teststatus(report):
    if [*getattr(report, 'get_sections', lambda title: ())(INCONCLUSIVE)]:
        return INCONCLUSIVE, 'I', INCONCLUSIVE.upper()
    return None


def pytest_sessionfinish(session):
    """Write the outcomes; end with a code of its own if something is inconclusive."""
    config = session.config
    if config.stash.get(EMPTY_PART, False):  # with fewer tests than parts, no mistake
        session.exitstatus = pytest.ExitCode.OK
    if hasattr(config, 'workerinput'):
        return
    reports = config.pluginmanager.get_plugin('terminalreporter').stats
    if path := config.option.outcomes:
        outcomes = {
            report.nodeid: outcome
            for phase, outcome in OUTCOMES.items()
            for report in reports.get(phase, ())
        }
        with path.open('a') as target:
            target.writelines(f'{outcome} {name}\n' for name, outcome in outcomes.items())
    if session.exitstatus == pytest.ExitCode.OK and reports.get(INCONCLUSIVE):
        session.exitstatus = INCONCLUSIVE_CODE


def pytest_terminal_summary(terminalreporter):
    """List what was not installed, what was inconclusive, and the tests that waited longest."""
    list_missing(terminalreporter)
    reports = terminalreporter.stats
    if inconclusive := reports.get(INCONCLUSIVE):
        terminalreporter.section('inconclusive: the machine is too busy; repeat when it is not')
        texts = [text for report in inconclusive for _, text in report.get_sections(INCONCLUSIVE)]
        terminalreporter.write_line('\n\n'.join(texts))
    shares = sorted(
        (value, report.nodeid)
        for phase in OUTCOMES
        for report in reports.get(phase, ())
        for name, value in getattr(report, 'user_properties', ())
        if name == PROCESSOR_WAIT
    )
    if shares:
        terminalreporter.write_line(
            f'processor wait of {len(shares)} tests with nodes: '
            f'median {shares[len(shares) // 2][0]:.0%}, above the limit of {MAX_WAIT:.0%}: '
            f'{sum(share > MAX_WAIT for share, _ in shares)}; largest: '
            + ', '.join(f'{share:.0%} {name}' for share, name in shares[:-4:-1])
        )


@pytest.fixture
def graph(monkeypatch):
    """Return the ``ROS_DOMAIN_ID`` of a private graph of this process and its children."""
    with PrivateGraph() as private:
        environment = private.environment()
        for name in set(os.environ) - set(environment):
            monkeypatch.delenv(name)
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        yield private.domain


@pytest.fixture
def ros(graph):
    """Initialise rclpy in the process of the test, for the duration of a test."""
    import rclpy

    rclpy.init(args=[])
    yield graph
    rclpy.try_shutdown()


@pytest.fixture
def processes(graph, tmp_path):
    """Return a process group; processes that still run at the end are killed."""
    started = Processes(tmp_path / 'log', os.environ)
    yield started
    for name in list(started.running()):
        started.kill(name)
