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
"""Odometry that is out of order, repeated, slow, without twist or yaw: never much worse for it.

Full and feed-forward drive the exact twin with one seed. A pair of messages in the wrong order
once stopped the robot for 0.4 s, and one pair every 0.2 s for ever.
"""

import math

import pytest
from support.long_tests import few_of

from t3mpc_ros.evaluation import loop
from t3mpc_ros.evaluation.loop import ReportLink
from t3mpc_ros.evaluation.methods import FEED_FORWARD, FULL, methods_for
from t3mpc_ros.evaluation.record import measure
from t3mpc_ros.evaluation.scenario import OwnParts, Scenario
from t3mpc_ros.geometry.types import STANDSTILL
from t3mpc_ros.simulation.fault_injection import FaultEvent

pytestmark = pytest.mark.compiled
MARGIN = 1.15
"""Largest ratio of the errors of full and feed-forward."""
DURATION = 30.0


def with_pose(state, **changes):
    odometry = state.odometry
    return state._replace(odometry=odometry._replace(pose=odometry.pose._replace(**changes)))


def swapped(every):
    """Return a fault: of each ``every`` messages, the last arrives after its successor."""

    def send(link, k, state):
        if k % every == 0:
            link.late = state
            return []
        late, link.late = link.late, None
        return [state] if late is None else [state, late]

    return send


def yaw_set(link, k, state):
    """The odometry is set at 15 s: a jump that nobody drove."""
    return [with_pose(state, yaw=state.odometry.pose.yaw + 0.5) if k >= 1500 else state]


def yaw_frozen(link, k, state):
    if k == 1500:
        link.late = state.odometry.pose.yaw
    return [with_pose(state, yaw=link.late) if k >= 1500 else state]


def without_twist(link, k, state):
    return [state._replace(odometry=state.odometry._replace(twist=STANDSTILL))]


REPORTS = {
    'a pair swapped every 0.2 s': swapped(20),
    'one pair swapped': swapped(1500),
    'every third swapped': swapped(3),
    'repeated': lambda link, k, state: [state, state],
    'half the rate': lambda link, k, state: [state] if k % 2 else [],
    'one in five lost in bursts': lambda link, k, state: [] if k % 50 < 10 else [state],
    'yaw set': yaw_set,
    'yaw frozen': yaw_frozen,
}
GYRO = {
    'bias jump': {'gyro_bias_jump': 0.05},
    'gyro dead': {'gyro_dead': True},
    'bias jump back': {'gyro_bias_jump': -0.01},
}


class FaultyLink(ReportLink):
    """Reports that a fault of :data:`REPORTS` changes."""

    fault = staticmethod(lambda link, k, state: [state])

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.k, self.late = 0, None

    def send(self, state):
        self.k += 1
        for each in self.fault(self, self.k, state):
            super().send(each)


def run(monkeypatch, name, fault=None, changes=None, events=()):
    class Link(FaultyLink):
        pass

    if fault:
        Link.fault = staticmethod(fault)
    monkeypatch.setattr(loop, 'ReportLink', Link)
    own = OwnParts(robot_parameters=changes or {}, events=tuple(events))
    scenario = Scenario('twin', 'nominal', 2001, DURATION, own=own)
    return measure(loop.run(scenario, methods_for('twin')[name]))


def assert_not_much_worse(full, forward):
    for metric in ('settled', 'overall', 'yaw_rate_settled', 'yaw_rate'):
        assert full[metric] < MARGIN * forward[metric], metric
    assert full['stopped'] == 0.0


@pytest.mark.parametrize('name', few_of(REPORTS))
def test_faults_of_messages_cost_no_more_than_without_feedback(monkeypatch, name):
    found = [run(monkeypatch, method, REPORTS[name]) for method in (FULL, FEED_FORWARD)]
    assert_not_much_worse(*found)


@pytest.mark.parametrize('name', few_of(GYRO))
def test_faults_of_the_gyro_cost_no_more_than_without_feedback(monkeypatch, name):
    ((fault, value),) = GYRO[name].items()
    events = [FaultEvent(12.0, fault, value, math.inf)]
    found = [run(monkeypatch, method, events=events) for method in (FULL, FEED_FORWARD)]
    assert_not_much_worse(*found)


def test_an_odometry_without_twist_is_differentiated(monkeypatch):
    """Its errors were five times those of an open loop, for ever."""
    exact = run(monkeypatch, FULL)
    found = run(monkeypatch, FULL, without_twist)
    assert found['overall'] < 1.1 * exact['overall']
    assert found['settled'] < 1.6 * exact['settled']
