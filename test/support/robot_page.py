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
"""The live page of one simulated robot in a browser, in any number of tabs."""

from support.browser import Browser
from t3mpc_ros.cli.view import PAGE_AT

LATCHED, UNCONFIRMED = 'E-STOP', 'STOP NOT CONFIRMED'

FOCUS = {
    'a button': '#buttons button',
    'a summary': '#parameters summary',
    'a slider': '#parameters input[type="range"]',
    'a number': '#parameters input[type="number"]',
    'a checkbox': '#parameters input[type="checkbox"]',
    'a list': '#span',
    'the events': '#events',
}
"""Kinds of elements that can have the focus, and where one is."""


class RobotPage(Browser):
    """A robot, its live page, and a browser that shows it."""

    def __init__(self, processes):
        super().__init__()
        self.processes = processes
        try:
            self._start()
        except BaseException:
            self.driver.quit()
            raise

    def _start(self):
        self.processes.start('sim_robot')
        self.start_view('0')
        text = self.processes.log('view').read_text()
        self.url = text[text.index(PAGE_AT) + len(PAGE_AT) :].split()[0]
        self.port = self.url.rstrip('/').rpartition(':')[2]
        self.open()

    def start_view(self, port):
        self.processes.start('view', 'view', '--headless', '--port', port, program='t3mpc')
        self.processes.wait_for('view', '(stop with', 120.0)

    def open(self):
        """Show the page, with all its parameters, in the present tab."""
        self.driver.get(self.url)
        ready = 'return Boolean(place("sim_robot/faults.command_loss"))'
        self.wait(lambda: self.run(ready), 'no parameters')
        self.run('document.querySelectorAll("#parameters details").forEach((e) => e.open = true)')

    def open_tabs(self, count):
        while len(self.driver.window_handles) < count:
            self.driver.switch_to.new_window('tab')
            self.open()

    def close_tabs(self):
        """Close all tabs but the first."""
        first, *others = self.driver.window_handles
        for each in others:
            self.driver.switch_to.window(each)
            self.driver.close()
        self.driver.switch_to.window(first)

    def wait_for_headline(self, words):
        self.wait(
            lambda: self.text('headline').startswith(words),
            lambda: f'no headline {words}: {self.text("headline")}',
        )

    def click(self):
        self.find('e-stop').click()

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
