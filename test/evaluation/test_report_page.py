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
"""The page of a report in a headless browser, as a person uses it."""

import csv
from functools import partial
import math
import re

import pytest
from support.browser import SIZES, Browser
from support.robot_bags import following_rows, write

from t3mpc_ros.evaluation.bag_report.report_page import write_report
from t3mpc_ros.evaluation.bag_report.run_comparison import write_comparison

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def browser():
    browser = Browser()
    yield browser
    browser.driver.quit()


def without(rows, low, high):
    return [row for row in rows if not (row[1] == '/odom' and low < row[0] < high)]


@pytest.fixture(scope='module')
def report(tmp_path_factory):
    """The report of a run with a gap from 6 to 9 s."""
    folder = tmp_path_factory.mktemp('report')
    return write_report(write(folder / 'bag', without(following_rows(), 6.0, 9.0)), folder).report


def opened(browser, path):
    browser.driver.get(path.as_uri())
    browser.wait(lambda: browser.run('return Boolean(span)'), lambda: f'{browser.errors()}')


def shown(browser):
    """Return the time that each chart shows, s."""
    return browser.run(
        'return charts.charts.map(({uplot}) => [uplot.scales.x.min, uplot.scales.x.max])'
    )


def test_a_person_looks_closely_at_a_run(report, browser, tmp_path):
    from selenium.webdriver import ActionChains, Keys

    opened(browser, report)
    browser.show_as(1440, 1000)
    assert browser.select('.headline').text.startswith('No odom for 3.0 s from 6.0 s on; settled')
    assert 'No message of /odom for 3.0 s from 6.0 s on.' in browser.select('.notes').text
    count = len(browser.driver.find_elements('css selector', '.u-over'))
    assert count == len(shown(browser)) > 8
    whole = shown(browser)[0]
    assert shown(browser) == [whole] * count
    # The gap is one: a value that is unknown, between two that are known.
    column = browser.run(
        'const [t, y] = charts.charts[0].data; return t.map((each, i) => [each, y[i]])'
    )
    unknown = [time for time, value in column if value is None and 6.0 < time < 9.0]
    assert len(unknown) >= 1

    # One cursor for all charts.
    plots = browser.driver.find_elements('css selector', '.u-over')
    ActionChains(browser.driver).scroll_to_element(plots[1]).move_to_element(plots[0]).perform()
    browser.wait(lambda: 'cursor at' in browser.text('range'), 'no cursor')
    assert browser.run('return charts.charts.every(({uplot}) => uplot.cursor.left > 0)')

    # A span selected with the mouse is enlarged everywhere, and a double click undoes it.
    drag = ActionChains(browser.driver).move_to_element(plots[1]).click_and_hold()
    drag.move_by_offset(90, 0).release().perform()
    browser.wait(lambda: shown(browser)[0] != whole, 'no zoom')
    (low, high), *others = shown(browser)
    assert 0.5 < high - low < 8.0
    assert others == [[low, high]] * (count - 1)

    # What is shown is downloaded.
    place = {'behavior': 'allow', 'downloadPath': str(tmp_path)}
    browser.driver.execute_cdp_cmd('Browser.setDownloadBehavior', place)
    browser.select('.chart h3 button').click()
    file = tmp_path / 'right_wheel.csv'
    browser.wait(file.exists, 'no file')
    with file.open(newline='') as lines:
        head, *rows = csv.reader(lines)
    assert head == ['time_s', 'robot (odometry) (rad/s)', 'reference (rad/s)']
    times = [float(row[0]) for row in rows]
    assert low <= min(times) <= low + 0.03
    assert high - 0.03 <= max(times) <= high
    for time, measured, reference in rows:
        # The bag begins at the receipt of the first reference, 1 ms before its stamp.
        at = float(time) + 0.019
        speed = 0.2 + 0.05 * math.sin(1.3 * at) + 0.5 * math.sin(0.7 * at) * 0.0735
        if reference:
            assert float(reference) == pytest.approx(speed / 0.035, abs=2e-3)
        if measured:
            assert float(measured) == pytest.approx((speed + 0.02) / 0.035, abs=2e-3)

    # With the keyboard: zoom, move the cursor, show everything.
    browser.find('all').click()
    assert shown(browser)[0] == whole
    browser.run('charts.charts[2].plot.focus()')
    keys = ActionChains(browser.driver)
    keys.send_keys('+', Keys.ARROW_RIGHT, Keys.ARROW_RIGHT).perform()
    assert shown(browser)[3][1] - shown(browser)[3][0] == pytest.approx(
        0.5 * (whole[1] - whole[0]), rel=1e-3
    )
    assert 'cursor at' in browser.text('range')
    ActionChains(browser.driver).send_keys('0').perform()
    assert shown(browser)[0] == whole

    # An event shows its part of the charts.
    event = browser.select('.timeline .gap button')
    event.click()
    assert shown(browser)[0] == pytest.approx([3.0, 9.0], abs=0.1)
    assert re.search(r'cursor at (5\.9|6\.0)', browser.text('range'))

    # The floor shows the path and the points of that part; all points stood where no path was.
    browser.run("""
        const draw = Floor.prototype.draw;
        Floor.prototype.draw = function (scene) { window.drawn = scene; draw.call(this, scene); };
        planes.at(-1).marks = [[4, 0, 0, 'stopped'], [9.5, 1, 1, 'stopped']];
    """)
    for button, points in ((browser.find('all'), 2), (event, 1)):
        button.click()
        browser.run('drawPlanes(null)')
        assert len(browser.run('return drawn.marks')) == points

    # Legible in every size and scheme, with something drawn.
    for scheme in ('light', 'dark'):
        for width, height in SIZES.items():
            browser.show_as(width, height, scheme)
            for part in ('.headline', '.notes li', '.tiles span', 'nav a', 'figcaption', '#all',
                         'th', '.chart h3 button', '.timeline .note', '.quiet'):  # fmt: skip
                for element in browser.driver.find_elements('css selector', part)[:1]:
                    assert browser.contrast(element) >= 4.5, (part, scheme)
    assert browser.errors() == []
    inside = (report.as_uri(), 'data:', 'blob:')
    assert [url for url in browser.requests() if not url.startswith(inside)] == []


def test_without_scripts_verdict_and_tables_remain(report, browser):
    browser.driver.execute_cdp_cmd('Emulation.setScriptExecutionDisabled', {'value': True})
    try:
        browser.driver.get(report.as_uri())
        assert browser.select('.headline').text.startswith('No odom for 3.0 s from 6.0 s on')
        text = browser.select('main').text
        assert 'This browser runs no scripts' in text
        assert 'follows it with a settled RMSE of 0.571 rad/s' in text
        assert browser.select('table').is_displayed()
    finally:
        browser.driver.execute_cdp_cmd('Emulation.setScriptExecutionDisabled', {'value': False})


def test_a_comparison_is_drawn(browser, tmp_path):
    folders = [
        write(tmp_path / name, following_rows(offset=offset))
        for name, offset in (('one', 0.02), ('two', 0.03))
    ]
    path, *_ = write_comparison(folders, tmp_path)
    opened(browser, path)
    assert browser.select('.headline').text == 'Larger settled error'
    assert {len(found) for found in browser.run('return charts.charts.map((c) => c.series)')} == {
        2,
        3,
    }
    browser.show_as(360, 800)
    assert browser.errors() == []


@pytest.mark.long
def test_a_report_is_printed_on_a4(report, browser):
    """Charts were cut off at the edge, and those of a dark screen pale."""
    opened(browser, report)
    browser.show_as(1440, 1000, 'dark')
    ink = "return [colour('ink'), charts.charts[0].uplot.axes[0].stroke()]"
    browser.wait(lambda: len(set(browser.run(ink))) == 1, 'not drawn in the dark')
    dark = browser.run(ink)
    browser.run("dispatchEvent(new Event('beforeprint'))")
    light = browser.run(ink)
    assert light[0] == light[1] != dark[0]
    browser.run('charts.resize = () => {}')  # paper is no window that has changed its size
    features = [{'name': 'prefers-color-scheme', 'value': 'dark'}]
    set_media = partial(browser.driver.execute_cdp_cmd, 'Emulation.setEmulatedMedia')
    try:
        set_media({'media': 'print', 'features': features})
        within = round((210 - 2 * 14) / 25.4 * 96)
        metrics = {'width': within, 'height': 1000, 'deviceScaleFactor': 1, 'mobile': False}
        browser.driver.execute_cdp_cmd('Emulation.setDeviceMetricsOverride', metrics)
        wide = browser.run(
            'return Array.from(document.querySelectorAll("main *")).filter((each) =>'
            ' each.getBoundingClientRect().right > innerWidth + 1).map((each) => each.tagName)'
        )
        assert wide == []
        assert browser.run('return document.documentElement.scrollWidth') <= within
    finally:
        set_media({'media': '', 'features': features})
    browser.run("dispatchEvent(new Event('afterprint'))")
    assert browser.run(ink) == dark
