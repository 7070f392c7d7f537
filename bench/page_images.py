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
"""Pictures of the live page of a simulated robot, light and dark, as docs/view.md shows them.

Usage: page_images.py [--output FOLDER]; needs Chromium with its driver. Starts a demo in the world
``room`` and photographs it after 40 s, with a stop by hand at 20 s.
"""

import argparse
from pathlib import Path
import sys
import tempfile
import time

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

from support.browser import SIZES, Browser  # noqa: E402

from t3mpc_ros.cli.private_graph import PrivateGraph  # noqa: E402
from t3mpc_ros.cli.process_group import ProcessGroup  # noqa: E402
from t3mpc_ros.cli.view import PAGE_AT  # noqa: E402

ROBOT = {'world': 'room', 'noise.variance': 0.04, 'seed': 3}
STOP_AT, SHOWN_AT = 20.0, 40.0
"""Times of the run, s."""


def photograph(browser: Browser, output: Path) -> None:
    """Write a picture of the whole page for each size and scheme."""
    for scheme in ('light', 'dark'):
        for width, height in SIZES.items():
            browser.show_as(width, height, scheme)
            full = browser.run('return document.documentElement.scrollHeight')
            browser.show_as(width, full, scheme)
            browser.run('changed = true')
            time.sleep(0.5)  # a picture is drawn each 0.1 s
            browser.driver.save_screenshot(str(output / f'view_{width}_{scheme}.png'))


def main() -> int:
    """Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--output', type=Path, default=ROOT / 'docs' / 'images')
    options = parser.parse_args()
    with PrivateGraph() as graph, tempfile.TemporaryDirectory() as folder:
        processes = ProcessGroup(Path(folder), graph.environment())
        browser = None
        try:
            processes.start('sim_robot', parameters=ROBOT)
            processes.start('reference_generator', parameters={'seed': 3})
            processes.start('controller')
            words = '--headless', '--port', '0', '--runs', folder
            processes.start('view', 'view', *words, program='t3mpc')
            processes.wait_for('view', '(stop with', 120.0)
            processes.wait_for('controller', 'tracking', 600.0)
            text = processes.log('view').read_text()
            browser = Browser()
            browser.driver.get(text[text.index(PAGE_AT) + len(PAGE_AT) :].split()[0])
            run_time = 'return (newest() ?? 0) - (begin() ?? 0)'
            browser.wait(lambda: browser.run(run_time) > STOP_AT, 'no samples')
            browser.find('e-stop').click()
            browser.wait(lambda: browser.find('release').is_displayed(), 'no stop')
            time.sleep(1.0)
            browser.find('release').click()
            browser.wait(lambda: browser.run(run_time) > SHOWN_AT, 'no samples')
            photograph(browser, options.output)
        finally:
            if browser is not None:
                browser.driver.quit()
            processes.end_all()
    return 0


if __name__ == '__main__':
    sys.exit(main())
