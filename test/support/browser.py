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
"""Headless Chromium, driven as a person does."""

import json

from support.missing_tools import find, needs
from support.waiting import wait_until

WIDTHS = 'return document.documentElement.scrollWidth'
SIZES = {360: 800, 768: 1024, 1440: 1000}

# WCAG 2: relative luminance of a colour, contrast ratio of text and background.
CONTRAST = """
const weights = [0.2126, 0.7152, 0.0722];
const linear = (c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
const light = (text) => text.match(/[\\d.]+/g).slice(0, 3)
  .reduce((sum, each, i) => sum + weights[i] * linear(each / 255), 0);
let box = arguments[0];
const ink = light(getComputedStyle(box).color);
const paper = () => getComputedStyle(box).backgroundColor;
while (paper() === 'rgba(0, 0, 0, 0)') box = box.parentElement;
const [a, b] = [ink, light(paper())].sort((x, y) => y - x);
return (a + 0.05) / (b + 0.05);
"""


class Browser:
    """Chromium with a page, and waits for what it shows."""

    def __init__(self):
        needs('chromium', 'chromedriver')
        from selenium import webdriver

        options = webdriver.ChromeOptions()
        options.binary_location = find('chromium')
        for word in ('headless=new', 'no-sandbox', 'disable-gpu', 'disable-dev-shm-usage'):
            options.add_argument(f'--{word}')
        options.set_capability('goog:loggingPrefs', {'browser': 'ALL', 'performance': 'ALL'})
        service = webdriver.ChromeService(find('chromedriver'))
        self.driver = webdriver.Chrome(options=options, service=service)

    def text(self, name):
        return self.find(name).text

    def find(self, name):
        return self.driver.find_element('id', name)

    def select(self, selector):
        return self.driver.find_element('css selector', selector)

    def run(self, script, *values):
        return self.driver.execute_script(script, *values)

    def wait(self, condition, what):
        from selenium.common.exceptions import StaleElementReferenceException

        def met():
            try:
                return condition()
            except StaleElementReferenceException:  # the page is being loaded anew
                return False

        wait_until(met, what)

    def show_as(self, width, height, scheme='light'):
        """Show the page in a window of that size, and wait until its parts fit into it.

        Charts take their new width in a later frame than the window.
        """
        metrics = {'width': width, 'height': height, 'deviceScaleFactor': 1, 'mobile': width < 500}
        self.driver.execute_cdp_cmd('Emulation.setDeviceMetricsOverride', metrics)
        feature = {'name': 'prefers-color-scheme', 'value': scheme}
        self.driver.execute_cdp_cmd('Emulation.setEmulatedMedia', {'features': [feature]})
        self.wait(
            lambda: self.run(
                'return innerWidth === arguments[0] &&'
                ' document.documentElement.scrollWidth <= innerWidth',
                width,
            ),
            lambda: f'the page is {self.run(WIDTHS)} px wide in a window of {width} px',
        )

    def contrast(self, element):
        """Return the contrast ratio of an element's text."""
        return self.run(CONTRAST, element)

    def errors(self):
        """Return the errors of the console so far."""
        log = self.driver.get_log('browser')
        return [entry['message'] for entry in log if entry['level'] == 'SEVERE']

    def requests(self):
        """Return the addresses of all requests so far."""
        messages = [
            json.loads(entry['message'])['message'] for entry in self.driver.get_log('performance')
        ]
        return [
            message['params']['request']['url']
            for message in messages
            if message['method'] == 'Network.requestWillBeSent'
        ]
