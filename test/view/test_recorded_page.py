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
"""The page of a recorded run in a headless browser: what it says is what the bag holds."""

from pathlib import Path
import time

import numpy as np
import pytest
from support.bag_messages import START, TYPES, odometry_message, twist_message
from support.browser import Browser
from support.page_data import check_legends, legends
from support.robot_bags import following_rows, write

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.cli.bag_on_live_page import recorded_run
from t3mpc_ros.evaluation.bag_report.recorded_run import load_run
from t3mpc_ros.view.live_data import LiveData, LiveRun
from t3mpc_ros.view.server import PageServer

pytestmark = pytest.mark.slow

GOLDEN = Path(__file__).parents[1] / 'golden' / 'switches.mcap'


@pytest.fixture(scope='module')
def browser():
    browser = Browser()
    yield browser
    browser.driver.quit()


@pytest.fixture
def show(browser):
    """Return a function that opens the page of some data, and one that closes all of them."""
    servers = []

    def opened(data, command=None):
        server = PageServer(data, command, 0, time.monotonic).__enter__()
        servers.append(server)
        browser.driver.get(server.url)
        browser.show_as(1440, 1000)
        browser.wait(lambda: browser.run('return connected && !changed'), 'nothing is drawn')
        return server

    yield opened
    for server in servers:
        server.__exit__()


def test_the_legend_says_what_was_sent_for_the_cursor(browser, show):
    """It showed the reference 0.4 s later than the measurement and the error beside it."""
    with open_bag(GOLDEN) as recording:
        run = load_run(recording)
    show(recorded_run(GOLDEN))
    # Without a cursor there is no instant, and no value.
    shown = 'return charts.charts.flatMap(({values}) => values.map((each) => each.textContent))'
    assert set(browser.run(shown)) == {'–'}
    check_legends(browser, run, seed=29)


@pytest.fixture(scope='module')
def switching(tmp_path_factory):
    """A bag whose reference, sent 0.4 s ahead, jumps at 5 and at 10 s."""
    kind = 'std_msgs/msg/Int32MultiArray'
    layout = TYPES['std_msgs/msg/MultiArrayLayout']([], 0)
    rows = []
    for k in range(800):
        at, mode = 0.02 * k, int(k >= 250) + int(k >= 500)
        stamp = START + round(1e9 * at)
        rows.append((at, '/odom', odometry_message(stamp, (0.1, 0.0), (0.1 * at, 0.0, 0.0))))
        rows.append((at, '/cmd_vel', twist_message((0.1, 0.0))))
        if k in (0, 250, 500):
            data = TYPES[kind](layout, np.array([mode, 1, 2], np.int32))
            rows.append((at - 0.4, '/reference/signals', data))
        rows.append((at - 0.4, '/reference', odometry_message(stamp, (0.1 + 0.02 * mode, 0.0))))
    rows = [(at + 0.5, *row) for at, *row in sorted(rows, key=lambda row: row[0])]
    return write(tmp_path_factory.mktemp('switching') / 'bag', rows)


def test_switches_are_marked_where_the_report_marks_them(browser, show, switching):
    with open_bag(switching) as recording:
        switches = load_run(recording).switches.tolist()
    assert len(switches) == 2
    show(recorded_run(switching))
    assert browser.run('return charts.marks.map(({time}) => time)') == switches
    assert browser.text('marks') == 'switch'


def test_the_reference_that_is_not_due_yet_is_its_preview(browser, show):
    """It was drawn as if the robot were late by the lead of the reference."""
    data = LiveRun()
    data.set('terms', [])
    for k in range(200):
        data.add('odometry', 0.02 * k, [1.0, 2.0, 0.0, 0.0, 0.0])
        data.add('reference', 0.02 * k + 0.4, [0.02 * k + 0.4, 2.0, 0.0, 0.0, 0.0])
    data.tick(0.0)
    show(data)
    found = browser.run("""
        const {reference, preview} = shownStreams([0, 10]);
        return [reference, preview].map(({time}) => [time[0], time.at(-1)]);
    """)
    assert found == [[0.4, 3.98], [3.98, 4.38]]
    _, shown = legends(browser, 2.0)
    assert shown['Right wheel']['reference'] == pytest.approx(2.0, abs=1e-3)
    assert shown['Right wheel']['preview'] is None
    assert shown['Error']['right'] == pytest.approx(-1.0, abs=1e-3)


def test_a_gap_is_one_in_lines_and_legend(browser, show):
    data = LiveRun()
    data.set('terms', [])
    for k in (*range(100), *range(300, 400)):
        data.add('odometry', 0.02 * k, [1.0, 2.0, 0.0, 0.0, 0.0])
        data.add('reference', 0.02 * k, [1.0, 2.0, 0.0, 0.0, 0.0])
    data.tick(0.0)
    show(data)
    holes = browser.run("""
        const [time, reference] = charts.charts[0].data;
        return time.filter((at, i) => reference[i] === null);
    """)
    assert len(holes) == 1
    assert 1.98 < holes[0] < 6.0
    for at in (2.5, 3.0, 5.0):
        instant, shown = legends(browser, at)
        # A measurement, not the null after it that interrupts the lines.
        assert instant in (1.98, 6.0)
        assert shown['Right wheel']['odometry'] == 1.0


def test_a_bag_of_any_robot_with_odometry_is_shown(browser, show, tmp_path):
    """Without the parameters of this package it was refused, with options that do not exist."""
    rows = [row for row in following_rows() if row[1] in ('/odom', '/cmd_vel')]
    bag = write(tmp_path / 'bag', rows)
    data = recorded_run(bag)
    show(data)
    titles = browser.run('return charts.charts.map(({title, unit}) => `${title}, ${unit}`)')
    assert titles == ['Forward speed, m/s', 'Turn rate, rad/s']
    labels = browser.run('return charts.charts[0].series.map(({label}) => label)')
    assert labels == ['odometry', 'command']
    assert 'm/s and' in browser.text('pose')
    assert browser.errors() == []


def test_the_error_is_scaled_to_what_was_driven(browser, show):
    """The half second after a stop made a line of the whole run."""
    data = LiveRun()
    data.set('terms', [])
    generator = np.random.default_rng(5)
    data.report(0.0, 'resume', 'Tracking the reference')
    data.report(16.0, 'stop', 'E-STOP')
    for k in range(1000):
        # From 18 s on the controller commands rest; from 16 s the robot does not obey.
        at, drives, commanded = 0.02 * k, k < 800, k < 900
        error = 0.03 * generator.uniform(-1.0, 1.0) if drives else 5.0
        data.add('reference', at, [4.0, 4.0, 0.0, 0.0, 0.0])
        data.add('odometry', at, [4.0 + error, 4.0 + error, 0.0, 0.0, 0.0])
        data.add('command', at, [4.0 * commanded, 4.0 * commanded])
    data.tick(0.0)
    show(data)
    scale = 'const {min, max} = charts.charts[arguments[0]].uplot.scales.y; return [min, max]'
    low, high = browser.run(scale, 2)
    assert -0.06 < low < -0.02 < 0.02 < high < 0.06
    assert browser.run(scale, 0)[1] > 8.9, 'the speeds are shown whole'


def test_a_recording_is_played_and_events_lead_to_their_time(browser, show, switching):
    show(recorded_run(switching))
    begin, end = browser.run('return [begin(), newest()]')
    browser.run("place('rate').value = '4'")
    browser.find('play').click()
    browser.wait(lambda: (browser.run('return playTime') or 0.0) > begin + 1.0, 'it does not play')
    browser.find('play').click()
    at = browser.run('return playTime')
    pose = browser.text('pose')
    assert begin < at < end
    # The floor and the cursor are those of the instant; it stays.
    browser.wait(lambda: browser.run('return charts.charts[0].uplot.cursor.left') > 0, 'no cursor')
    assert browser.run('return playTime') == at
    browser.run("place('seek').value = 1; place('seek').oninput()")
    browser.wait(lambda: browser.text('pose') != pose, 'the robot has not moved')
    assert browser.run('return playTime') == end
    event = browser.select('#events .switch button')
    event.click()
    when = browser.run('return events.find(({kind}) => kind === "switch").time')
    times = browser.run('return events.filter(({kind}) => kind === "switch").map((e) => e.time)')
    browser.wait(lambda: browser.run('return playTime') in times, f'not at {when}')
    span = 'return charts.range[1] - charts.range[0]'
    browser.wait(lambda: browser.run(span) == pytest.approx(10.0), 'its time is not shown')


def test_what_is_shown_is_saved_as_a_page_that_opens_alone(browser, show, tmp_path):
    server = show(recorded_run(GOLDEN), lambda *_: 'done')
    place = {'behavior': 'allow', 'downloadPath': str(tmp_path)}
    browser.driver.execute_cdp_cmd('Browser.setDownloadBehavior', place)
    browser.run('selection = [begin() + 2, begin() + 6]; changed = true')
    low, high = browser.run('return selection')
    browser.find('share').click()
    browser.wait(lambda: [*tmp_path.glob('*.html')], 'no file')
    (file,) = tmp_path.glob('*.html')
    assert server.token not in file.read_text(), 'who has the file could command the robot'
    expected = [legends(browser, at) for at in (low + 1.0, low + 2.5)]
    server.__exit__()
    browser.driver.get('about:blank')
    browser.driver.get_log('browser')  # the page has lost its program
    browser.driver.get_log('performance')
    browser.driver.get(file.as_uri())
    browser.wait(lambda: browser.run('return newest() !== undefined && !changed'), 'nothing')
    begin, end = browser.run('return [begin(), newest()]')
    assert (begin, end) == (pytest.approx(low, abs=0.03), pytest.approx(high, abs=0.03))
    assert [legends(browser, at) for at in (low + 1.0, low + 2.5)] == expected
    assert browser.errors() == []
    assert [
        url for url in browser.requests() if not url.startswith(('file:', 'data:', 'blob:'))
    ] == []


def test_a_line_on_the_floor_is_a_path_and_a_touch_a_goal(browser, show):
    from selenium.webdriver import ActionChains

    data, sent = LiveRun(), []
    source = {'name': 'source', 'value': 'signals', 'dynamic': False}
    data.set('terms', [])
    data.set('parameters/reference_generator', [source])
    for k in range(100):
        # The odometry began elsewhere than the map, and turned by a quarter.
        data.add('odometry', 0.02 * k, [0.0, 0.0, 0.0, 0.0, 0.0])
        data.add('truth', 0.02 * k, [0.0, 0.0, 1.0, 2.0, 0.5 * np.pi])
    data.tick(0.0)

    def command(name, arguments, asked):
        sent.append((name, arguments))
        return 'sent'

    show(data, command)
    assert not browser.find('draw').is_displayed(), 'the reference follows no path'
    data.set('parameters/reference_generator', [{**source, 'value': 'topic'}])
    browser.wait(lambda: browser.find('draw').is_displayed(), 'no button')
    floor = browser.find('floor')
    browser.find('draw').click()
    browser.wait(lambda: not browser.run('return changed || moved'), 'not drawn')
    *centre, half = browser.run('return floor.view')
    per_metre = browser.run('return floor.canvas.clientWidth') / (2.0 * half)
    step = round(0.2 * per_metre)
    line = ActionChains(browser.driver).move_to_element(floor).click_and_hold()
    line.move_by_offset(step, 0).move_by_offset(0, -step).release().perform()
    browser.wait(lambda: sent, 'no path')
    name, arguments = sent.pop()
    points = np.array(arguments['points'])
    assert name == 'path'
    assert len(points) > 2
    # To the right on the map is to the right of a robot that faces up, which is −y; up is ahead.
    moved = points[-1] - points[0]
    np.testing.assert_allclose(moved, [step / per_metre, -step / per_metre], atol=0.02)
    start = np.array([centre[1] - 2.0, 1.0 - centre[0]])
    np.testing.assert_allclose(points[0], start, atol=0.02)

    assert not browser.run('return isDrawing()'), 'a line is still drawn'
    browser.find('draw').click()
    browser.wait(lambda: not browser.run('return changed || moved'), 'not drawn')
    *centre, half = browser.run('return floor.view')
    right = step * 2.0 * half / browser.run('return floor.canvas.clientWidth')
    goal = [centre[1] - 2.0, 1.0 - centre[0] - right]
    ActionChains(browser.driver).move_to_element_with_offset(floor, step, 0).click().perform()
    browser.wait(lambda: sent, 'no goal')
    (name, arguments) = sent.pop()
    assert name == 'path'
    np.testing.assert_allclose(arguments['points'], [goal], atol=0.02)
    # Without drawing, the floor takes no goals.
    ActionChains(browser.driver).move_to_element(floor).click().perform()
    assert browser.run('return [drawingLine, isDrawing()]') == [False, False]
    assert sent == []


BANNERS = (
    (
        'Stopped',
        'sim_robot: a wheel slips for longer than a second; controller: no reference ' * 3,
    ),
    ('STOP NOT CONFIRMED: use the switch on the robot', 'no answer; asking again'),
    ('E-STOP', 'sim_robot: emergency stop: requested by service e_stop, latched'),
)


def test_the_banner_of_a_phone_leaves_room_for_the_rest(browser, show):
    """With a reason of several lines it took 368 px."""
    data = LiveData()
    data.set('banner', {'kind': 'good', 'headline': 'Tracking the reference', 'detail': ''})
    data.set('namespace', 'east')
    show(data, lambda *_: 'done')
    browser.show_as(360, 800)
    assert browser.text('namespace') == 'east'  # which robot it stops
    assert 'east' in browser.driver.title
    for headline, detail in BANNERS:
        words = {'kind': 'stopped', 'headline': headline, 'detail': detail}
        data.set('banner', words)
        browser.wait(lambda words=words: browser.text('headline') == words['headline'], 'no news')
        height = browser.run('return place("banner").getBoundingClientRect().height')
        assert height <= 96, headline
        shown = 'const e = place(arguments[0]); return e.scrollHeight - e.clientHeight'
        assert browser.run(shown, 'headline') <= 1, 'the headline is cut off'
        for button in ('e-stop', *(['release'] if headline == 'E-STOP' else [])):
            box = browser.find(button).rect
            assert box['y'] >= 0
            assert box['y'] + box['height'] <= height
            assert box['height'] >= 32
    # The whole reason is a touch away.
    data.set('banner', {'kind': 'stopped', 'headline': BANNERS[0][0], 'detail': BANNERS[0][1]})
    browser.wait(lambda: browser.text('headline') == 'Stopped', 'no news')
    cut = browser.run(shown, 'detail')
    assert cut > 10
    assert browser.text('more') == 'more'
    browser.find('state').click()
    assert browser.run(shown, 'detail') <= 1
    browser.find('more').click()
    assert browser.run(shown, 'detail') == cut
    # So is a long verdict of a recording; what is whole offers no more.
    long = (
        'The robot stood for 17.7 s from 48.0 s on; while it drove settled RMSE 0.012 rad/s. ' * 3
    )
    for headline, offered in ((long, True), ('E-STOP', False)):
        data.set('banner', {'kind': 'warning', 'headline': headline, 'detail': 'once'})
        browser.wait(lambda words=headline: browser.text('headline')[:9] == words[:9], 'no news')
        assert browser.find('more').is_displayed() == offered
        assert browser.run('return place("banner").getBoundingClientRect().height') <= 96
        if offered:
            browser.find('more').click()
            assert browser.run(shown, 'headline') <= 1
            browser.find('more').click()


def test_events_are_marked_where_the_robot_was(browser, show):
    """The floor did not show where a wheel had slipped."""
    data = LiveRun()
    data.set('terms', [])
    for k in range(300):
        data.add('odometry', 0.02 * k, [1.0, 1.0, 0.01 * k, 0.02 * k, 0.0])
    data.set('world', {'segments': [], 'circles': [], 'patches': [[0.0, 0.0, 0.3, 0.5]]})
    for time_of_event, kind in ((1.0, 'slip'), (2.0, 'parameter'), (4.0, 'stop')):
        data.report(time_of_event, kind, kind)
    show(data)
    browser.run('floor.draw = (scene) => { window.scene = scene; }; moved = true')
    browser.wait(lambda: browser.run('return Boolean(window.scene)'), 'not drawn')
    marks = browser.run('return scene.marks')
    assert [name for *_, name in marks] == ['slip', 'stopped']
    assert [at for *at, _ in marks] == [pytest.approx([0.5, 1.0]), pytest.approx([2.0, 4.0])]
    legend = browser.text('floor-legend').split('\n')
    assert legend[1:] == ['stop', 'slip', 'slippery floor']


def test_a_changed_parameter_is_compared_before_and_after(browser, show):
    data = LiveRun()
    data.set('terms', [])
    for k in range(1100):
        at = 0.02 * k
        error = 0.2 if at < 10.5 else 0.05
        data.add('reference', at, [4.0, 4.0, 0.0, 0.0, 0.0])
        data.add('odometry', at, [4.0 + error, 4.0 - 2 * error, 0.0, 0.0, 0.0])
        data.add('command', at, [4.0, 4.0])
        if k == 525:
            data.report(at, 'parameter', 'controller: law.gain = 8.0')
        if k == 600:
            data.tick(0.0)
            show(data)
            assert 'measures 10 s' in browser.text('changes')
    browser.wait(lambda: 'RMSE' in browser.text('changes'), 'no comparison')
    text = browser.text('changes')
    assert 'law.gain = 8.0' in text
    assert 'right: 0.2000 before, 0.05' in text
    assert 'left: 0.4000 before, 0.10' in text


IN_CHART = """
const {chart, lines} = shownCharts.find(({chart}) => chart.title === arguments[0]);
return lines.map(({label}) => label);
"""
CENTRE = """
const {left, top, width, height} = arguments[0].getBoundingClientRect();
return [left + width / 2, top + height / 2];
"""


def signal_button(browser, name):
    (found,) = (
        each
        for each in browser.driver.find_elements('css selector', '#signals button')
        if each.text == name
    )
    return found


def test_a_signal_is_put_into_a_chart(browser, show):
    from selenium.webdriver import ActionChains, Keys

    show(recorded_run(GOLDEN))
    browser.select('#signals-box summary').click()
    plots = browser.driver.find_elements('css selector', '.u-over')

    # By mouse: a line of the same unit, with its values beside those that are there.
    before = browser.run(IN_CHART, 'Right wheel')
    drag = ActionChains(browser.driver)
    drag.move_to_element(signal_button(browser, 'Left wheel, odometry'))
    drag.click_and_hold().move_to_element(plots[0]).release().perform()
    assert browser.run(IN_CHART, 'Right wheel') == [*before, 'Left wheel, odometry']
    assert browser.run('return chosen') is None, 'a drag is no choice'
    browser.wait(lambda: not browser.run('return changed'), 'not drawn')
    _, shown = legends(browser, 4.0)
    values = shown['Right wheel']['Left wheel, odometry'], shown['Left wheel']['odometry']
    assert values[0] == values[1] is not None

    # By touch: another unit, which has an axis of its own; the page does not scroll meanwhile.
    plots = browser.driver.find_elements('css selector', '.u-over')
    places = [
        dict(zip('xy', browser.run(CENTRE, each), strict=True))
        for each in (signal_button(browser, 'x, odometry'), plots[0])
    ]
    for kind, points in (
        ('touchStart', places[:1]), ('touchMove', places[1:]), ('touchEnd', []),
    ):  # fmt: skip
        browser.driver.execute_cdp_cmd(
            'Input.dispatchTouchEvent', {'type': kind, 'touchPoints': points}
        )
    assert browser.run(IN_CHART, 'Right wheel')[-1] == 'x, odometry'
    scale = 'const s = charts.charts[0].uplot.series.at(-1); return [s.scale, s.label]'
    assert browser.run(scale) == ['other', 'x, odometry']
    ActionChains(browser.driver).send_keys(Keys.ESCAPE).perform()

    # By keys: chosen, then the chart; a third unit is refused, and says why.
    for name, words in (('yaw, odometry', 'two units already'), ('y, odometry', 'is in Right')):
        signal_button(browser, name).send_keys(Keys.ENTER)
        browser.select('.here').send_keys(Keys.ENTER)
        browser.wait(lambda words=words: words in browser.text('signal-text'), words)
    assert browser.run(IN_CHART, 'Right wheel')[-2:] == ['x, odometry', 'y, odometry']
    assert browser.driver.find_elements('css selector', '.here') == []

    # Out again, with the axis; the others stay.
    for _ in range(2):
        browser.driver.find_elements('css selector', '.remove')[-1].click()
    assert browser.run(IN_CHART, 'Right wheel') == [*before, 'Left wheel, odometry']
    assert browser.run('return charts.charts[0].uplot.axes.length') == 2
    assert browser.run('return added') == [['Right wheel', 'Left wheel, odometry']]
    # Where the finger leaves the charts, nothing is added.
    drag = ActionChains(browser.driver).move_to_element(signal_button(browser, 'yaw, odometry'))
    drag.click_and_hold().move_to_element(browser.find('floor')).release().perform()
    assert browser.run('return [added.length, drag]') == [1, None]
    assert browser.errors() == []


def test_a_patrol_is_shown_by_its_distance_from_the_path(browser, show):
    """Beside a path, the errors of the speeds were drawn, which are none."""
    data = LiveRun()
    data.set('terms', [])
    for k in range(200):
        at = 0.02 * k
        data.add('odometry', at, [1.0, 2.0, 0.1 * at, 0.03, 0.0])
        data.add('reference', at + 0.4, [3.0, 1.0, 0.1 * (at + 0.4), 0.0, 0.0])
    data.tick(0.0)
    show(data)
    titles = 'return shownCharts.filter((e) => !figureOf(e).hidden).map(({chart}) => chart.title)'
    assert browser.run(titles) == ['Right wheel', 'Left wheel', 'Error']
    follows = {'name': 'pose.enabled', 'value': True, 'dynamic': False}
    data.set('parameters/controller', [follows])
    browser.wait(lambda: 'Distance from the path' in browser.run(titles), 'no distance')
    assert 'Error' not in browser.run(titles)
    browser.wait(lambda: not browser.run('return changed'), 'not drawn')
    _, shown = legends(browser, 2.0)
    assert shown['Distance from the path']['distance'] == pytest.approx(30.0, abs=0.01)


def test_a_stop_is_confirmed_however_slow_the_program_is(browser, show):
    """Each attempt was given up after a second: one that takes longer was never confirmed."""
    data = LiveData()
    data.set('banner', {'kind': 'good', 'headline': 'Tracking the reference', 'detail': ''})

    def command(name, arguments, asked):
        time.sleep(1.6)
        return 'latched'

    show(data, command)
    # A browser that keeps nothing is not in the way: the stop was not sent, and no later one was.
    browser.run("Storage.prototype.setItem = () => { throw new Error('refused'); }")
    browser.find('e-stop').click()
    browser.wait(lambda: browser.text('headline').startswith('STOP NOT CONFIRMED'), 'no warning')
    browser.wait(lambda: browser.text('headline').startswith('Tracking'), 'not confirmed')
    assert browser.text('answer') == 'latched'


def test_a_robot_that_says_that_it_stands_is_believed(browser, show):
    data, replies = LiveData(), []
    data.set('banner', {'kind': 'good', 'headline': 'Tracking the reference', 'detail': ''})

    def command(name, arguments, asked):
        while not replies:
            time.sleep(0.02)
        return replies[0]

    show(data, command)
    browser.find('e-stop').click()
    browser.wait(lambda: browser.text('headline').startswith('STOP NOT CONFIRMED'), 'no warning')
    data.set('banner', {'kind': 'stopped', 'headline': 'E-STOP', 'detail': 'sim_robot: latched'})
    browser.wait(lambda: browser.text('headline') == 'E-STOP', 'not believed')
    replies.append('latched')
    browser.wait(lambda: browser.text('answer') == 'latched', 'no answer')
    assert browser.run('return pressed') is None
    # What it said before the press is no confirmation: someone else may have released it since.
    replies.clear()
    browser.run("const f = fetch; fetch = (url, options) => (url.startsWith('events')"
                ' ? new Promise(() => {}) : f(url, options))')  # fmt: skip
    browser.find('e-stop').click()
    browser.wait(lambda: browser.text('headline').startswith('STOP NOT CONFIRMED'), 'believed')
    replies.append('latched')
