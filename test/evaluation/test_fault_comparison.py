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
"""The table of faults and wrong assumptions: each can be run, and what is said names it."""

import pytest

from bench import fault_comparison
from bench.fault_comparison import FAULTS, Fault, Job, first_said, run_job
from t3mpc_ros.evaluation.drivers import NodeMethod
from t3mpc_ros.evaluation.methods import FULL
from t3mpc_ros.evaluation.scenario import OwnParts, Scenario
from t3mpc_ros.simulation.fault_injection import FaultEvent

pytestmark = pytest.mark.compiled


def test_each_fault_fits_the_robot_and_the_controller():
    assert len(FAULTS) > 40
    for fault in FAULTS.values():
        for name, value in fault.events.items():
            FaultEvent(fault.begin, name, value, fault.lasting)
        scenario = Scenario('twin', 'nominal', 1, own=OwnParts(robot_parameters=fault.changes))
        NodeMethod(FULL, fault.assumed).parameters_for(scenario)


@pytest.mark.parametrize(
    'name, words',
    [
        ('no twist in the odometry', 'odom has no twist'),
        ('twist reversed', 'opposite sign'),
        ('rate set to 50, odometry has 100 Hz', 'odom has 100 Hz, but rate is 50 Hz'),
    ],
)
def test_a_fault_reaches_the_controller_and_is_named(name, words, monkeypatch):
    monkeypatch.setattr(fault_comparison, 'DURATION', 8.0)
    job = Job(name, FULL, 2001)
    numbers, said = run_job((job, job))
    assert words in first_said(FAULTS[name], said)
    assert (numbers['stopped'] > 0.0) == (name == 'twist reversed')


def test_what_was_said_before_a_fault_does_not_name_it():
    said = [(3.0, 'late by 0.1 s'), (11.0, 'late by 0.2 s'), (12.0, 'dead'), (17.0, 'slow')]
    assert first_said(Fault(begin=10.0), said) == 'dead (2 s)'
    assert first_said(Fault(begin=2.0), said) == 'late by 0.1 s (1 s)'
