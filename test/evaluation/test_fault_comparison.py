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
    'name, words, seed',
    [
        ('no twist in the odometry', 'odom has no twist', 2001),
        ('twist reversed', 'opposite sign', 2001),
        ('twist of the odometry + 10 %', 'times the change of its pose', 2001),
        ('twist of the odometry in mm/s', 'cannot be in m/s and rad/s', 2001),
        ('rate set to 50, odometry has 100 Hz', 'odom has 100 Hz, but rate is 50 Hz', 2001),
        ('shaper for another robot', 'the robot oscillates in yaw with', 2005),
        ('lag 20 ms assumed, none', 'too early for a speed_filter.lag of 0.02 s', 2003),
        ('disturbance x10', 'the yaw rate of odom is rough by', 2001),
    ],
)
def test_a_fault_reaches_the_controller_and_is_named(name, words, seed, monkeypatch):
    monkeypatch.setattr(fault_comparison, 'DURATION', 8.0)
    job = Job(name, FULL, seed)
    numbers, said = run_job((job, job))
    assert words in first_said(FAULTS[name], said)
    assert (numbers['stopped'] > 0.0) == (name == 'twist reversed')


def test_commands_that_are_lost_are_named(monkeypatch):
    monkeypatch.setattr(fault_comparison, 'DURATION', 21.0)
    job = Job('30 % of the commands lost', FULL, 2001)
    _, said = run_job((job, job))
    assert 'commands are lost' in first_said(FAULTS[job.fault], said)
    exact = Job('none', FULL, 2001)
    assert run_job((exact, exact))[1] == []


@pytest.mark.long
def test_contradicted_assumptions_cost_little(monkeypatch):
    """They cost up to four times the settled error without them."""
    monkeypatch.setattr(fault_comparison, 'DURATION', 16.0)
    names = (
        'none',
        'no twist in the odometry',
        'twist of the odometry + 10 %',
        'rate set to 200, odometry has 100 Hz',
        'shaper for another robot',
        'lag 20 ms assumed, none',
        'noise 0.04 (rad/s)², none assumed',
    )
    jobs = [Job(name, FULL, 2003) for name in names]
    exact, *wrong = [run_job((job, job))[0]['settled'] for job in jobs]
    assert max(wrong) < 1.25 * exact


def test_what_was_said_before_a_fault_does_not_name_it():
    said = [(3.0, 'late by 0.1 s'), (11.0, 'late by 0.2 s'), (12.0, 'dead'), (17.0, 'slow')]
    assert first_said(Fault(begin=10.0), said) == 'dead (2 s)'
    assert first_said(Fault(begin=2.0), said) == 'late by 0.1 s (1 s)'
