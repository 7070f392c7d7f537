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
"""Time from a click on E-STOP, or the space bar, until the live page says that the robot stands.

Usage: live_stop.py [--count N]; needs Chromium with its driver. Prints for each
condition the median and the worst time until the page says E-STOP, or STOP NOT CONFIRMED.
"""

import argparse
from collections.abc import Callable
import os
from pathlib import Path
import signal
import statistics
import sys
import tempfile
import time

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

from support.robot_page import FOCUS, LATCHED, RobotPage  # noqa: E402

from t3mpc_ros.cli.process_group import PrivateGraph, ProcessGroup  # noqa: E402

TABS = (1, 2, 6, 7, 12)
WATCH = """
const headline = document.getElementById('headline');
const stopped = () => /^(E-STOP|STOP NOT CONFIRMED)/.test(headline.textContent);
for (const kind of ['click', 'keydown']) {
  addEventListener(kind, (event) => {
    if (kind === 'keydown' ? event.code !== 'Space' : event.target.id !== 'e-stop') return;
    window.begun = performance.now();
    window.shown = null;
  }, { capture: true });
}
new MutationObserver(() => {
  if (!stopped() || window.shown) return;
  window.shown = [performance.now() - window.begun, headline.textContent];
}).observe(headline, { childList: true, characterData: true, subtree: true });
"""


class WatchedPage(RobotPage):
    """The live page, with the time until it shows a stop."""

    def open(self) -> None:
        """Show the page, and watch its headline."""
        super().open()
        self.run(WATCH)

    def shown(self) -> tuple[float, str]:
        """Return the time until the page showed the stop, ms, and how it was called."""
        self.wait(lambda: self.run('return window.shown'), 'no stop is shown')
        time_taken, words = self.run('return window.shown')
        return time_taken, words

    def stop(self, press: Callable[[], None]) -> tuple[float, str]:
        """Return what :meth:`shown` does of a stop that is released again."""
        press()
        found = self.shown()
        self.release()
        return found


def measure(page: WatchedPage, count: int) -> dict[str, list[tuple[float, str]]]:
    """Return the times and words of each condition."""
    from selenium.webdriver import ActionChains

    found: dict[str, list[tuple[float, str]]] = {}
    for tabs in TABS:
        page.open_tabs(tabs)
        found[f'{tabs} tabs'] = [page.stop(page.click) for _ in range(count)]
    for name, selector in FOCUS.items():
        part = page.select(selector)

        def press(part: object = part) -> None:
            page.run('arguments[0].focus()', part)
            page.press_space()

        found[f'space on {name}'] = [page.stop(press) for _ in range(count)]
    slider = page.select(FOCUS['a slider'])
    times = []
    for _ in range(count):
        ActionChains(page.driver).move_to_element(slider).click_and_hold().perform()
        page.press_space()
        times.append(page.shown())
        ActionChains(page.driver).release().perform()
        page.release()
    found['space while a slider is dragged'] = times
    suspended, resumed = [], []
    for _ in range(count):
        view = page.processes.pid('view')
        os.kill(view, signal.SIGSTOP)
        page.click()
        suspended.append(page.shown())
        time.sleep(5.0)
        os.kill(view, signal.SIGCONT)
        begun = time.monotonic()
        page.wait_for_headline(LATCHED)
        resumed.append((1e3 * (time.monotonic() - begun), LATCHED))
        page.release()
    found['program suspended for 5 s'] = suspended
    found['after it goes on'] = resumed
    killed = []
    for _ in range(count):
        page.processes.kill('view')
        page.click()
        killed.append(page.shown())
        page.start_view(page.port)
        page.release()  # the page has loaded itself anew
        page.run(WATCH)
    found['program killed'] = killed
    return found


def main() -> int:
    """Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--count', type=int, default=20, help='stops of each condition')
    options = parser.parse_args()
    with PrivateGraph() as graph, tempfile.TemporaryDirectory() as folder:
        processes = ProcessGroup(Path(folder), graph.environment())
        page = None
        try:
            page = WatchedPage(processes)
            found = measure(page, options.count)
        finally:
            if page is not None:
                page.driver.quit()
            processes.end_all()
    print('| condition | median | worst | page says |', '|---|---|---|---|', sep='\n')
    for name, rows in found.items():
        times = [each for each, _ in rows]
        words = ', '.join(sorted({text.split(':')[0] for _, text in rows}))
        median, worst = statistics.median(times), max(times)
        print(f'| {name} | {median:.0f} ms | {worst:.0f} ms | {words} |')
    return 0


if __name__ == '__main__':
    sys.exit(main())
