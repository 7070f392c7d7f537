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
"""A run, ready for a report, of which no two quantities are equal."""

from html import unescape
import re

import numpy as np

from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.evaluation.bag_report.diagnostic_history import LinkHistory
from t3mpc_ros.evaluation.bag_report.recorded_run import (
    BY_WHEEL,
    SIGNAL_NAMES,
    Run,
    Series,
    Timing,
)
from t3mpc_ros.evaluation.bag_report.report_charts import SECTIONS
from t3mpc_ros.evaluation.topic_roles import COMMAND, ODOMETRY, REFERENCE, TRUTH
from t3mpc_ros.geometry.kinematics import WheelGeometry

WHEELS = 'right', 'left'
TIME = 0.01 * np.arange(2000)
MOTIONS = 'linear', 'angular', 'right', 'left', 'x', 'y', 'yaw'
NAMES = (
    *(f'controller/terms/{name}/{wheel}' for name in (*TERM_NAMES, 'applied') for wheel in WHEELS),
    *(f'controller/{name}/{wheel}' for name in ('estimate', 'skill') for wheel in WHEELS),
    'controller/lyapunov/value',
    'controller/lyapunov/margin',
    *SIGNAL_NAMES,
)


def wave(k):
    """Return a quantity with a mean and a phase of its own."""
    return k + 0.3 * np.sin(0.9 * TIME + k)


NUMBERS = {name: Series(TIME, {'value': wave(40 + k)}) for k, name in enumerate(NAMES)}
NUMBERS['controller/lyapunov/margin'] = Series(TIME, {'value': np.where(TIME < 5.0, -1.0, 2.0)})
COMMANDED = {name: wave(30 + k) for k, name in enumerate(MOTIONS)}
REPORTS = 10.0 * np.arange(2.0)
LINK = {
    'cycles': np.array([100.0, 300.0]),
    'cycles_lost': np.array([0.0, 10.0]),
    'round_trip_median_ms': np.array([6.0, 7.0]),
    'round_trip_p99_ms': np.array([9.0, 11.0]),
    'robot_resets': np.array([1.0, 3.0]),
    'dongle_resets': np.array([1.0, 4.0]),
    'port_failures': np.array([1.0, 5.0]),
    'crc_errors': np.array([1.0, 6.0]),
    'frame_errors': np.array([1.0, 8.0]),
}
RUN = Run(
    duration=20.0, topics={}, absent=(), namespaces=('',), ours=True, geometry=WheelGeometry(),
    channels=BY_WHEEL,
    motions={
        topic: Series(TIME, {name: wave(10 * j + k) for k, name in enumerate(MOTIONS)})
        for j, topic in enumerate((REFERENCE, ODOMETRY, TRUTH))
    } | {COMMAND: Series(TIME, COMMANDED)},
    numbers=NUMBERS,
    receipts={ODOMETRY: TIME, COMMAND: TIME[:-1] + 0.002 + 0.004 * (np.arange(1999) % 20 == 0)},
    timing={ODOMETRY: Timing(2000, 0.01, 0.002, 0.05)},
    switches=np.array([8.0]), lead=0.205, complaints=(), changes=(),
    links=(LinkHistory('radio', REPORTS, LINK),), oddities=(), remarks=(),
)  # fmt: skip


def text_of(page):
    """Return the text of a page without its tags."""
    return ' '.join(unescape(re.sub(r'<[^>]*>', ' ', page)).split())


def sections_of(page):
    """Return the names of the sections with charts of the page of a report."""
    found = re.findall(r'<h2[^>]*>([^<]*)</h2>\n<div class="charts">', page)
    return [section.draw.__name__ for section in SECTIONS if section.title in found]
