# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The e-stop of the live page: with many tabs, wherever the focus is, without its program."""

import os
import signal

import pytest
from support.browser import Browser

from t3mpc_ros.cli.view import PAGE_AT

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timed]

LATCHED, UNCONFIRMED = 'E-STOP', 'STOP NOT CONFIRMED'


class StopPage(Browser):
    """The live page of one robot, in any number of tabs."""

    def wait_for_headline(self, *words):
        self.wait(
            lambda: self.text('headline').startswith(words),
            lambda: f'no headline {words}: {self.text("headline")}',
        )

    def open_tabs(self, url, count):
        while len(self.driver.window_handles) < count:
            self.driver.switch_to.new_window('tab')
            self.driver.get(url)
            self.wait_for_headline('Following', 'Receiving', 'Stopped', 'Driving')

    def press_space(self):
        """Press the space bar; what has the focus gets it."""
        for kind in ('rawKeyDown', 'char', 'keyUp'):
            key = {'type': kind, 'key': ' ', 'code': 'Space', 'windowsVirtualKeyCode': 32}
            self.driver.execute_cdp_cmd(
                'Input.dispatchKeyEvent', key | ({'text': ' '} if kind == 'char' else {})
            )

    def release(self):
        self.wait_for_headline(LATCHED)
        self.wait(lambda: self.find('release').is_displayed(), 'no release')
        self.find('release').click()
        self.wait(lambda: not self.text('headline').startswith(LATCHED), 'not released')


@pytest.fixture
def page(processes):
    browser = StopPage()
    try:
        processes.start('sim_robot')
        processes.start('view', 'view', '--headless', '--port', '0', program='t3mpc')
        processes.wait_for('view', '(stop with', 120.0)
        text = processes.log('view').read_text()
        browser.url = text[text.index(PAGE_AT) + len(PAGE_AT) :].split()[0]
        browser.driver.get(browser.url)
        shown = 'return Boolean(place("sim_robot/faults.command_loss"))'
        browser.wait(lambda: browser.run(shown), 'no parameters')
        yield browser
    finally:
        browser.driver.quit()


def test_every_one_of_twelve_tabs_stops_the_robot(page):
    """A stream of each tab took one of the six connections of a browser; the click waited."""
    for count in (1, 6, 7, 12):
        page.open_tabs(page.url, count)
        page.find('e-stop').click()
        page.release()
    page.driver.switch_to.window(page.driver.window_handles[0])
    page.find('e-stop').click()
    page.release()


def test_the_space_bar_stops_wherever_the_focus_is(page):
    """After a click on a button, space pressed that button again: Enable, say."""
    for box in page.driver.find_elements('css selector', '#parameters details'):
        page.run('arguments[0].open = true', box)
    kinds = {
        'button': '#buttons button',
        'summary': '#parameters summary',
        'slider': '#parameters input[type="range"]',
        'number': '#parameters input[type="number"]',
        'checkbox': '#parameters input[type="checkbox"]',
        'list': '#span',
        'events': '#events',
    }
    answers = page.run('window.sent = []; const f = fetch; fetch = (url, options) => {'
                       ' if (options.body) sent.push(JSON.parse(options.body).command);'
                       ' return f(url, options); }')  # fmt: skip
    assert answers is None
    for kind, selector in kinds.items():
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


def test_a_stop_that_nobody_confirms_is_asked_for_again(page, processes):
    # Suspended: the page says so, asks again, and the stop is executed when the program goes on.
    view = processes.pid('view')
    os.kill(view, signal.SIGSTOP)
    try:
        page.find('e-stop').click()
        page.wait_for_headline(UNCONFIRMED)
    finally:
        os.kill(view, signal.SIGCONT)
    page.release()

    # A release that waits does not undo the stop that was asked for after it.
    page.find('e-stop').click()
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
    port = page.url.rstrip('/').rpartition(':')[2]
    processes.kill('view')
    page.find('e-stop').click()
    page.wait_for_headline(UNCONFIRMED)
    processes.start('view', 'view', '--headless', '--port', port, program='t3mpc')
    page.release()
