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
"""The e-stop of the live page: with many tabs, wherever the focus is, without its program."""

import os
import signal

import pytest
from support.robot_page import FOCUS, LATCHED, UNCONFIRMED, RobotPage

pytestmark = [pytest.mark.ros, pytest.mark.slow]


@pytest.fixture(scope='module')
def page(shared_processes):
    """Return the page of one robot; the last test kills its program."""
    page = RobotPage(shared_processes)
    yield page
    page.driver.quit()


def test_every_one_of_twelve_tabs_stops_the_robot(page):
    """A stream of each tab took one of the six connections of a browser; the click waited."""
    for count in (1, 7, 12):
        page.open_tabs(count)
        page.click()
        page.release()
    page.close_tabs()
    page.click()
    page.release()


def test_the_space_bar_stops_wherever_the_focus_is(page):
    """After a click on a button, space pressed that button again: Enable, say."""
    page.run('window.sent = []; const f = fetch; fetch = (url, options) => {'
                       ' if (options.body) sent.push(JSON.parse(options.body).command);'
                       ' return f(url, options); }')  # fmt: skip
    for kind, selector in FOCUS.items():
        part = page.select(selector)
        state = 'const [a] = arguments; return [a.value, a.checked, a.parentElement.open]'
        before = page.run(state, part)
        page.run('arguments[0].focus()', part)
        assert page.run('return document.activeElement === arguments[0]', part), kind
        page.press_space()
        page.wait_for_headline(LATCHED)
        assert page.run(state, part) == before, kind
        page.release()
    # Nothing but stops and releases was sent, whatever had the focus.
    assert set(page.run('return sent')) == {'e_stop'}
    # In a text field, space is a letter.
    sent = len(page.run('return sent'))
    page.run('arguments[0].focus()', page.find('search'))
    page.press_space()
    assert page.run('return place("search").value') == ' '
    assert len(page.run('return sent')) == sent


def test_a_stop_that_nobody_confirms_is_asked_for_again(page, shared_processes):
    processes = shared_processes
    # Suspended: the page says so, asks again, and the stop is executed when the program goes on.
    view = processes.pid('view')
    os.kill(view, signal.SIGSTOP)
    try:
        page.click()
        page.wait_for_headline(UNCONFIRMED)
    finally:
        os.kill(view, signal.SIGCONT)
    page.release()

    # A release that waits does not undo the stop that was asked for after it.
    page.click()
    page.wait_for_headline(LATCHED)
    page.wait(lambda: page.find('release').is_displayed(), 'no release')
    os.kill(view, signal.SIGSTOP)
    try:
        page.find('release').click()
        page.press_space()
        page.wait_for_headline(UNCONFIRMED)
    finally:
        os.kill(view, signal.SIGCONT)
    page.release()

    # Without a robot: the reason is shown, until there is one.
    processes.stop('sim_robot')
    page.press_space()
    page.wait_for_headline(UNCONFIRMED)
    page.wait(lambda: 'e_stop' in page.text('detail'), 'no reason')
    processes.start('sim_robot')
    page.wait_for_headline(LATCHED)
    page.release()

    # Killed: the same, and the page that loads itself anew asks again.
    processes.kill('view')
    page.wait_for_headline('This page has lost its program')
    page.click()
    page.wait_for_headline(UNCONFIRMED)
    page.start_view(page.port)
    page.release()
