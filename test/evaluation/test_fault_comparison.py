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

import dataclasses
from functools import cache

import pytest
from support.long_tests import few_of

from bench import fault_comparison
from bench.fault_comparison import (
    FAULTS,
    Fault,
    Job,
    delayed,
    first_said,
    held,
    late_pose,
    run_job,
)
from t3mpc_ros.evaluation.loop import NodeMethod
from t3mpc_ros.evaluation.method_table import FEED_FORWARD, FULL
from t3mpc_ros.evaluation.scenario import OwnParts, Scenario
from t3mpc_ros.simulation.fault_schedule import FaultEvent

pytestmark = pytest.mark.compiled


def test_each_fault_fits_the_robot_and_the_controller():
    assert len(FAULTS) > 40
    for fault in FAULTS.values():
        for name, value in fault.events.items():
            FaultEvent(fault.begin, name, value, fault.lasting)
        own = OwnParts(robot_parameters=fault.changes, assumed=fault.assumed)
        NodeMethod(FULL, {}).parameters_for(Scenario('twin', 'nominal', 1, own=own))


def test_what_is_assumed_wrongly_is_assumed_by_every_method(monkeypatch):
    """Simple methods once knew the dead time that the controller was told wrongly."""
    monkeypatch.setattr(fault_comparison, 'DURATION', 12.0)
    wrong, right = (
        run_job(Job(name, FEED_FORWARD, 2001))['overall']
        for name in ('dead time 10 ms, 60 ms assumed', 'none')
    )
    assert wrong > 4.0 * right


@pytest.mark.parametrize(
    'name, words, seed',
    [
        ('no twist in the odometry', 'odom has no twist', 2001),
        ('twist reversed', 'the twist in odom is wrong', 2001),
        ('stamps of the odometry off by up to 3 ms', 'the stamps of odom jitter', 2001),
        ('twist of the odometry + 10 %', 'times the change of its pose', 2001),
        ('twist of the odometry in mm/s', 'cannot be in m/s and rad/s', 2001),
        ('twist of the odometry in degrees/s', 'cannot be in m/s and rad/s', 2005),
        ('rate set to 50, odometry has 100 Hz', 'odom has 100 Hz, but rate is 50 Hz', 2001),
        ('shaper for another robot', 'the robot oscillates in yaw with', 2005),
        ('lag 20 ms assumed, none', 'too early for a speed_filter.lag of 0.02 s', 2003),
        ('disturbance x10', 'the yaw rate of odom is rough by', 2006),
    ],
)
def test_a_fault_reaches_the_controller_and_is_named(name, words, seed, monkeypatch):
    monkeypatch.setattr(fault_comparison, 'DURATION', 8.0)
    found = run_job(Job(name, FULL, seed))
    assert words in first_said(FAULTS[name], found['said'])
    assert found['stopped'] == 0.0


def test_commands_that_are_lost_are_named(monkeypatch):
    monkeypatch.setattr(fault_comparison, 'DURATION', 21.0)
    name = '30 % of the commands lost'
    said = run_job(Job(name, FULL, 2001))['said']
    assert 'commands are lost' in first_said(FAULTS[name], said)
    monkeypatch.setattr(fault_comparison, 'DURATION', 8.0)
    assert run_job(Job('none', FULL, 2001))['said'] == []


@cache
def settled(name, duration):
    """Return the settled error of a run, made once: several are compared with that of no fault.

    Without the deadband: what it is worth in a run so short depends on where the microsteps are.
    """
    fault = FAULTS[name]
    plain = {**fault.assumed, 'wheel.deadband_velocity': 0.0}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fault_comparison, 'DURATION', duration)
        patch.setitem(FAULTS, name, dataclasses.replace(fault, assumed=plain))
        return run_job(Job(name, FULL, 2003))['settled']


LATE = ('lag 20 ms assumed, none',)
"""Found too late on the gentle reference of this seed: 1.41 times the error."""


@pytest.mark.parametrize(
    'name',
    few_of(
        [
            'twist of the odometry of the world',  # shaken when it was replaced: 2.2 times
            'right wheel of the twist + 5 %',  # taken for another dead time: twice
            'no twist in the odometry',  # its errors were five times those of an open loop
            'noise 0.04 (rad/s)², none assumed',
            'twist of the odometry + 10 %',
            'shaper for another robot',
            'rate set to 200, odometry has 100 Hz',
            *LATE,
        ],
        2,
    ),
)
def test_contradicted_assumptions_cost_little(name, request):
    """They cost up to four times the settled error without them."""
    if name in LATE:
        request.applymarker(pytest.mark.xfail(strict=True))
    assert settled(name, 16.0) < 1.25 * settled('none', 16.0)


def test_a_twist_that_stops_at_times_is_no_dead_time(monkeypatch):
    """It was taken for one of up to 0.06 s, and the error was four to six times as large."""
    monkeypatch.setattr(fault_comparison, 'DURATION', 16.0)
    name = 'twist of the odometry repeated for 0.1 s each second'
    found = run_job(Job(name, FULL, 2001))
    assert found['settled'] == pytest.approx(run_job(Job('none', FULL, 2001))['settled'], rel=0.05)


@pytest.mark.parametrize('send', [held('pose', 10), delayed(3, late_pose)], ids=['held', 'late'])
def test_a_pose_that_is_late_contradicts_no_dead_time(send, monkeypatch):
    """Before it was known to be late it contradicted the right dead time, and did so for good."""
    monkeypatch.setattr(fault_comparison, 'DURATION', 16.0)
    wrong = {'speed_filter.dead_time': 0.04}
    for name, fault in (('late', Fault(send=send, assumed=wrong)), ('not', Fault(assumed=wrong))):
        monkeypatch.setitem(FAULTS, name, fault)
    late, prompt = (run_job(Job(name, FULL, 2001))['settled'] for name in ('late', 'not'))
    assert late < 1.25 * prompt


@pytest.mark.parametrize('rate', [85.0, 118.0, 62.0, 150.0])
def test_a_rate_that_is_not_that_of_the_odometry_costs_little(rate, monkeypatch):
    """Steps counted as whole periods: four times the settled error, unnamed below 20 %."""
    name = f'rate {rate}'
    monkeypatch.setitem(FAULTS, name, Fault(assumed={'rate': rate}))
    assert settled(name, 10.0) < 1.2 * settled('none', 10.0)


@pytest.mark.long
def test_more_noise_than_assumed_costs_little():
    """An estimate from the few blocks that fitted cost up to six times the settled error."""
    name = 'noise 0.04 (rad/s)², none assumed'
    for seed in (2001, 2004):
        wrong, exact = (run_job(Job(each, FULL, seed))['settled'] for each in (name, 'none'))
        assert wrong < 1.15 * exact


@pytest.mark.parametrize(
    'name',
    few_of(
        [
            'a pair swapped every 0.2 s',
            'gyro bias + 0.05 rad/s',
            'one pair swapped',
            'every third swapped',
            'each message twice',
            'half the rate',
            'one in five lost in bursts',
            'yaw set by 0.5 rad',
            'yaw frozen',
            'gyro bias - 0.01 rad/s',
            'gyro dead',
        ],
        2,
    ),
)
def test_faults_of_odometry_cost_no_more_than_without_feedback(name):
    """A pair of messages in the wrong order once stopped the robot for 0.4 s, each time."""
    full, forward = (run_job(Job(name, method, 2001)) for method in (FULL, FEED_FORWARD))
    for metric in (*fault_comparison.WHEELS, *fault_comparison.BODY):
        assert full[metric] < fault_comparison.MARGIN * forward[metric], metric
    assert full['stopped'] == 0.0


def test_what_was_said_before_a_fault_does_not_name_it():
    said = [(3.0, 'late by 0.1 s'), (11.0, 'late by 0.2 s'), (12.0, 'dead'), (17.0, 'slow')]
    assert first_said(Fault(begin=10.0), said) == 'dead (2 s)'
    assert first_said(Fault(begin=2.0), said) == 'late by 0.1 s (1 s)'
