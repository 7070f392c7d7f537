#!/usr/bin/env python3
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
"""Pictures of the pages, light and dark, for three sizes of a window, as the docs show some.

Usage: page_images.py [--output FOLDER] [--all] [--runs FOLDER]; needs Chromium with its driver.
Makes the runs that the folder of --runs lacks, some minutes, and their reports; starts a robot in
the world ``room`` for the live page. --all writes every page in every state, else those of docs/.
"""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

from support.browser import SIZES, Browser  # noqa: E402
from support.recorded_stories import STORIES  # noqa: E402

from t3mpc_ros.cli.process_group import (  # noqa: E402
    PrivateGraph,
    ProcessGroup,
    executable,
)
from t3mpc_ros.cli.view import PAGE_AT  # noqa: E402
from t3mpc_ros.evaluation.bag_report.report_page import write_report  # noqa: E402

ROBOT = {'world': 'room', 'noise.variance': 0.04, 'seed': 3}
STOP_AT, SHOWN_AT = 20.0, 40.0
"""Times of the live run, s."""
PLAIN = (
    '--set', 'controller.adaptation.enabled=false', '--set', 'controller.predictive.enabled=false'
)  # fmt: skip
SERVO = 'demo', '--headless', '--robot', 'servo', '--duration', '30', '--seed', '11'
FAULTS = 'gyro_bias_jump', 'wheel_blocked', 'brown_out', 'slippery'
RUNS = {
    'demo/report.html': ('demo', '--headless', '--seed', '3', '--output', 'demo'),
    'patrol/report.html': (
        'demo', '--headless', '--patrol', '--duration', '75', '--seed', '7', '--output', 'patrol',
    ),
    'a/report.html': (
        *SERVO, '--output', 'a',
    ),
    'b/report.html': (
        *SERVO, *PLAIN, '--output', 'b',
    ),
    'ab/comparison.html': ('bag', 'report', 'a/bag', 'b/bag', '--output', 'ab'),
    'compare.html': (
        'compare', '--robot', 'servo', '--seeds', '31-33', '--duration', '12', '--workers', '1',
        '--cases', 'nominal', 'mass +30 %', '--html', 'compare.html',
    ),
    'faults.html': (
        'faults', *FAULTS, '--workers', '1', '--html', 'faults.html',
    ),
    'paper/paper.html': (
        'paper', '--quick', '--seeds', '1-1', '--workers', '1', '--output', 'paper',
    ),
}  # fmt: skip
"""Commands by the page that each writes."""
TOLD = ('e-stop', 'stalls', 'good')  # recorded stories with a report
IN_DOCS = {
    'report_1440_light': ('demo/report.html', 1440, 'light', ''),
    'report_1440_dark': ('demo/report.html', 1440, 'dark', 'switch'),
    'report_768_dark': ('demo/report.html', 768, 'dark', 'Tracking error'),
    'report_360_light': ('demo/report.html', 360, 'light', ''),
    'report_360_dark': ('demo/report.html', 360, 'dark', ''),
    'report_slow_machine': ('stalls/report.html', 1440, 'light', ''),
    'comparison_1440_light': ('ab/comparison.html', 1440, 'light', ''),
}
"""Pictures of reports in the docs: page, width, scheme, and what they show: its begin, a switch
enlarged, or the table below a heading."""


def make_runs(folder: Path) -> None:
    """Make each page that a folder lacks."""
    for page, words in RUNS.items():
        if not (folder / page).exists():
            # The exit code of a demo says whether it is a good run; the page is written anyhow.
            subprocess.run([str(executable('t3mpc')), *words], cwd=folder, check=False)
    for name in TOLD:
        if not (folder / name / 'report.html').exists():
            write_report(STORIES[name].write(folder / name / 'bag'), folder / name)


def drawn(browser: Browser) -> None:
    """Wait until a report has drawn its charts, if it has any."""
    browser.wait(
        lambda: browser.run('return !document.getElementById("data") || Boolean(span)'),
        lambda: f'not drawn: {browser.errors()}',
    )


def picture(browser: Browser, file: Path) -> None:
    """Write what the window shows."""
    time.sleep(0.5)  # a picture of the live page is drawn each 0.1 s
    browser.driver.save_screenshot(str(file))


def report_pictures(browser: Browser, runs: Path, output: Path) -> None:
    """Write the pictures of reports that the docs show."""
    for name, (page, width, scheme, part) in IN_DOCS.items():
        browser.driver.get((runs / page).resolve().as_uri())
        drawn(browser)
        browser.show_as(width, SIZES[width], scheme)
        if part == 'switch':
            browser.select('.timeline .switch button').click()
            browser.run('scrollTo(0, 0)')
        elif part:
            browser.run(
                'Array.from(document.querySelectorAll("h2")).find((each) =>'
                ' each.textContent === arguments[0]).scrollIntoView()',
                part,
            )
        picture(browser, output / f'{name}.png')


def all_sizes(browser: Browser, output: Path, name: str, *, whole: bool = False) -> None:
    """Write the first screen of the present page in each size and scheme, or the whole page."""
    for scheme in ('light', 'dark'):
        for width, height in SIZES.items():
            browser.show_as(width, height, scheme)
            if whole:
                full = browser.run('return document.documentElement.scrollHeight')
                browser.show_as(width, full, scheme)
            browser.run('if (typeof changed !== "undefined") changed = true')
            picture(browser, output / f'{name}_{width}_{scheme}.png')


@contextmanager
def live_robot(browser: Browser) -> Iterator[ProcessGroup]:
    """Yield the processes of a robot whose live page the browser shows, after a stop."""
    with PrivateGraph() as graph, tempfile.TemporaryDirectory() as folder:
        processes = ProcessGroup(Path(folder), graph.environment())
        try:
            processes.start('sim_robot', parameters=ROBOT)
            processes.start('reference_generator', parameters={'seed': 3})
            processes.start('controller')
            words = '--headless', '--port', '0', '--runs', folder
            processes.start('view', 'view', *words, program='t3mpc')
            processes.wait_for('view', '(stop with', 120.0)
            processes.wait_for('controller', 'tracking', 600.0)
            text = processes.log('view').read_text()
            browser.driver.get(text[text.index(PAGE_AT) + len(PAGE_AT) :].split()[0])
            run_time = 'return (newest() ?? 0) - (begin() ?? 0)'
            browser.wait(lambda: browser.run(run_time) > STOP_AT, 'no samples')
            browser.find('e-stop').click()
            browser.wait(lambda: browser.find('release').is_displayed(), 'no stop')
            time.sleep(1.0)
            browser.find('release').click()
            browser.wait(lambda: browser.run(run_time) > SHOWN_AT, 'no samples')
            yield processes
        finally:
            processes.end_all()


def states(browser: Browser, processes: ProcessGroup, output: Path) -> None:
    """Write the live page in each of its states."""
    all_sizes(browser, output, 'live_driving')
    browser.select('#signals-box summary').click()
    browser.select('#signals button:last-child').click()
    all_sizes(browser, output, 'live_signals')
    browser.select('#signals-box summary').click()
    browser.find('e-stop').click()
    browser.wait(lambda: browser.find('release').is_displayed(), 'no stop')
    time.sleep(1.0)
    all_sizes(browser, output, 'live_latched')
    view = processes.pid('view')
    os.kill(view, signal.SIGSTOP)
    try:
        browser.find('e-stop').click()
        browser.wait(lambda: browser.text('headline').startswith('STOP NOT'), 'no warning')
        all_sizes(browser, output, 'live_not_confirmed')
    finally:
        os.kill(view, signal.SIGCONT)
    browser.wait(lambda: browser.text('headline') == 'E-STOP', 'no stop')
    processes.stop('controller')
    browser.find('release').click()
    browser.wait(lambda: browser.text('headline').startswith('Stopped'), 'it drives')
    all_sizes(browser, output, 'live_stopped')
    processes.stop('sim_robot')
    browser.wait(lambda: browser.text('headline').startswith('Connection lost'), 'it is there')
    all_sizes(browser, output, 'live_lost')


def replay_pictures(browser: Browser, runs: Path, output: Path) -> None:
    """Write the pages of bags."""
    for name in ('demo', 'patrol', 'e-stop'):
        words = [str(executable('t3mpc')), 'view', '--headless', '--port', '0', '--bag']
        with subprocess.Popen([*words, str(runs / name / 'bag')], stdout=subprocess.PIPE) as view:
            try:
                line = view.stdout.readline().decode() if view.stdout else ''
                browser.driver.get(line.removeprefix(PAGE_AT).split()[0])
                browser.wait(lambda: browser.run('return connected && !changed'), 'nothing drawn')
                all_sizes(browser, output, f'bag_{name}')
            finally:
                view.send_signal(signal.SIGINT)


def main() -> int:
    """Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--output', type=Path, default=ROOT / 'docs' / 'images')
    parser.add_argument('--all', action='store_true', help='every page in every size')
    parser.add_argument('--runs', type=Path, help='runs that are there are not made again')
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as made:
        runs = options.runs or Path(made)
        runs.mkdir(parents=True, exist_ok=True)
        make_runs(runs)
        browser = Browser()
        try:
            if options.all:
                for page in (*RUNS, *(f'{name}/report.html' for name in TOLD)):
                    browser.driver.get((runs / page).resolve().as_uri())
                    drawn(browser)
                    all_sizes(
                        browser, options.output, page.removesuffix('.html').replace('/', '_')
                    )
                replay_pictures(browser, runs, options.output)
            else:
                report_pictures(browser, runs, options.output)
            with live_robot(browser) as processes:
                if options.all:
                    states(browser, processes, options.output)
                else:
                    all_sizes(browser, options.output, 'view', whole=True)
        finally:
            browser.driver.quit()
    return 0


if __name__ == '__main__':
    sys.exit(main())
