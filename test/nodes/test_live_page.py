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
"""The live page of a running graph in a headless browser, as a person uses it."""

import numpy as np
import pytest
from support.browser import SIZES, Browser

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.cli.view import PAGE_AT
from t3mpc_ros.evaluation.bag_report.recorded_run import load_run
from t3mpc_ros.geometry.types import NANOSECONDS

pytestmark = [pytest.mark.ros, pytest.mark.slow]

ROBOT = {'world': 'room', 'noise.variance': 0.04}
SWITCHING = {'switching.times': [3.0, 6.0]}
"""Switches follow each other sooner than by default."""


class LivePage(Browser):
    """The live page in Chromium."""

    def wait_for_headline(self, *words):
        self.wait(
            lambda: self.text('headline').startswith(words),
            lambda: f'no headline {words}: {self.text("headline")}',
        )


@pytest.fixture(scope='module')
def browser():
    browser = LivePage()
    yield browser
    browser.driver.quit()


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('runs')


@pytest.fixture(scope='module')
def page(shared_processes, browser, folder):
    """Start graph and page, and open it; it records into the folder.

    The last test stops all of them.
    """
    processes = shared_processes
    processes.start('sim_robot', parameters=ROBOT)
    processes.start('reference_generator', parameters=SWITCHING)
    processes.start('controller')
    options = '--headless', '--port', '0', '--runs', str(folder)
    processes.start('view', 'view', *options, program='t3mpc')
    processes.wait_for('view', '(stop with', 120.0)
    processes.wait_for('controller', 'tracking', 600.0)
    text = processes.log('view').read_text()
    url = text[text.index(PAGE_AT) + len(PAGE_AT) :].split()[0]
    browser.driver.get(url)
    browser.wait_for_headline('Tracking', 'Driving')
    return url


def newest(browser, stream='odometry'):
    return browser.run(f'return streams.{stream}.time.at(-1)')


SWITCHES = "return events.filter(({kind}) => kind === 'switch').map(({time}) => time)"


def test_a_recording_agrees_with_the_page_and_ends_in_a_report(page, browser, folder):
    """Legends mixed instants, and switches were marked 0.4 s before the report marks them."""
    browser.show_as(1440, 1000)
    browser.find('record').click()
    browser.wait(lambda: browser.run('return facts.recorder.state') == 'recording', 'no recording')
    begun, known = newest(browser), len(browser.run(SWITCHES))
    browser.wait(lambda: len(browser.run(SWITCHES)) >= known + 2, 'no two switches')
    last = browser.run(SWITCHES)[-1]
    browser.wait(lambda: newest(browser) > last + 1.0, 'no new samples')
    browser.find('hold').click()
    ended = newest(browser)
    browser.find('record').click()
    browser.wait(lambda: browser.find('report').is_displayed(), 'no report')
    (bag,) = folder.glob('view_*/bag')
    assert str(bag) in browser.text('record-text')
    with open_bag(bag) as recording:
        run = load_run(recording)
        origin = recording.start_ns / NANOSECONDS - browser.run('return facts.origin')
    browser.run('selection = arguments', begun, ended)
    browser.run('changed = true')
    browser.wait(lambda: not browser.run('return changed'), 'nothing is drawn')
    # The recorder may discover the topics after the first of them: on a busy machine in 2 s.
    recorded = run.switches + origin
    assert recorded.size > 0
    marked = np.array(browser.run(SWITCHES))
    assert np.abs(recorded[:, np.newaxis] - marked).min(axis=1).max() < 0.02

    # The report opens beside the page, alone.
    browser.find('report').click()
    browser.wait(lambda: len(browser.driver.window_handles) == 2, 'no report')
    browser.driver.switch_to.window(browser.driver.window_handles[1])
    browser.wait(lambda: browser.run('return Boolean(span)'), 'the report is not drawn')
    assert browser.run('return origin') == 'null'
    assert browser.errors() == []
    browser.driver.close()
    browser.driver.switch_to.window(browser.driver.window_handles[0])
    browser.find('hold').click()


def test_a_person_watches_and_commands_a_robot(page, browser, shared_processes):
    from selenium.webdriver import ActionChains, Keys

    processes = shared_processes

    # A moving value.
    before = newest(browser)
    browser.wait(lambda: newest(browser) > before + 1.0, 'no new samples')
    browser.wait(lambda: 'wheels' in browser.text('pose'), 'no pose')

    # The cursor of one chart moves in all of them, and shows its time.
    charts = browser.driver.find_elements('css selector', '.u-over')
    assert len(charts) == 5
    ActionChains(browser.driver).move_to_element(charts[0]).perform()
    browser.wait(lambda: 'cursor at' in browser.text('cursor-time'), 'no cursor')
    assert browser.run('return charts.charts.every((each) => each.uplot.cursor.left > 0)')

    # A selected span is held; a double click follows the run again.
    drag = ActionChains(browser.driver).move_to_element(charts[1]).click_and_hold()
    drag.move_by_offset(80, 0).release().perform()
    browser.wait(lambda: browser.text('hold') == 'Follow', 'no zoom')
    shown = 'const {min, max} = charts.charts[0].uplot.scales.x; return max - min'
    browser.wait(lambda: 0.0 < browser.run(shown) < 25.0, 'the span is not shown')
    ActionChains(browser.driver).double_click(charts[1]).perform()
    browser.wait(lambda: browser.text('hold') == 'Hold', 'zoom not undone')

    # A parameter: found by a search, set, and refused beyond its bound.
    name = 'sim_robot/faults.command_loss'
    browser.wait(lambda: browser.run('return Boolean(place(arguments[0]))', name), 'no parameter')
    browser.find('search').send_keys('command_loss')
    entry = browser.find(name).find_element('css selector', 'input')
    # Over what is selected: a clear() takes the focus, and the page shows the value anew.
    entry.send_keys(Keys.CONTROL, 'a', Keys.NULL, '0.2', Keys.ENTER)
    browser.wait(lambda: 'is set' in browser.text('answer'), 'not set')
    entry.send_keys(Keys.CONTROL, 'a', Keys.NULL, '7', Keys.ENTER)
    browser.wait(lambda: 'not done' in browser.text('answer'), 'not refused')
    assert 'Max: 1.0' in browser.text('answer')
    browser.wait(lambda: entry.get_attribute('value') == '0.2', 'a refused value is shown')

    # E-stop by the keyboard: the robot rests, and the banner says why.
    browser.run('document.activeElement.blur()')
    ActionChains(browser.driver).send_keys(' ').perform()
    browser.wait_for_headline('E-STOP')
    assert 'emergency stop' in browser.text('detail')
    speeds = 'return streams.truth.values.slice(0, 2).map((each) => Math.abs(each.at(-1)))'
    browser.wait(lambda: max(browser.run(speeds)) < 0.01, 'the robot moves')
    browser.find('release').click()
    browser.wait_for_headline('Tracking', 'Driving')

    # Every control is reached with the keyboard.
    browser.run(
        'window.reached = []; addEventListener("focusin", ({target}) => '
        '{ reached.push(target.id || target.innerText); })'
    )
    browser.find('e-stop').send_keys(Keys.TAB)
    wanted = {'span', 'hold', 'play', 'seek', 'record', 'search', 'events', 'Enable', 'Reseed'}
    for _ in range(10):
        ActionChains(browser.driver).send_keys(20 * Keys.TAB).perform()
        if wanted <= {*browser.run('return reached')}:
            break
    assert wanted <= {*browser.run('return reached')}

    # Legible in every size and scheme.
    for scheme in ('light', 'dark'):
        for width, height in SIZES.items():
            browser.show_as(width, height, scheme)
        for part in ('headline', 'e-stop', 'floor-title', 'pose', 'answer', 'hold'):
            assert browser.contrast(browser.find(part)) >= 4.5, (part, scheme)

    # The graph stops and starts again.
    for node in ('controller', 'reference_generator', 'sim_robot'):
        processes.stop(node)
    browser.wait_for_headline('Connection lost')
    processes.start('sim_robot', parameters=ROBOT)
    processes.start('reference_generator')
    processes.start('controller')
    browser.wait_for_headline('Tracking', 'Driving')

    # The browser logs the answer to the value that was refused.
    assert [text for text in browser.errors() if '409 (Conflict)' not in text] == []
    assert {url for url in browser.requests() if not url.startswith((page, 'data:'))} == set()
