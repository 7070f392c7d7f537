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
"""Samples, facts and events for readers of their own pace; the banner."""

import json
import math

import numpy as np
import pytest
from support.page_data import read_all

from t3mpc_ros.view.live_data import (
    LOST,
    LOST_REMEDY,
    MAX_AGE,
    MAX_CHANGES,
    MAX_EVENTS,
    SPAN,
    Cursor,
    LiveData,
    LiveRun,
    NodeReport,
    banner,
)


def test_readers_of_any_pace_get_every_sample_once_and_in_order():
    data = LiveData()
    generator = np.random.default_rng(1)
    cursors, found = [Cursor()] * 3, [[], [], []]
    for k in range(600):
        data.add('a' if k % 3 else 'b', 0.01 * k, [k, -k])
        for reader in np.flatnonzero(generator.random(3) < (1.0, 0.1, 0.01)):
            changes, cursors[reader] = data.read(cursors[reader])
            for stream in changes.get('streams', {}).values():
                found[reader] += stream['values'][0]
    for reader in range(3):
        for stream in data.read(cursors[reader])[0].get('streams', {}).values():
            found[reader] += stream['values'][0]
        assert sorted(found[reader]) == list(range(600))
    assert data.read(Cursor(600)) == ({}, Cursor(600))


def test_no_answer_is_long_and_together_they_are_complete():
    """A page that opens gets ten minutes: in one answer, the loop would wait for it."""
    data = LiveData()
    generator = np.random.default_rng(2)
    kinds = generator.choice(
        ['a', 'b', 'event', 'fact'], 3 * MAX_CHANGES, p=[0.5, 0.4, 0.08, 0.02]
    )
    for k, kind in enumerate(kinds):
        if kind == 'event':
            data.report(0.001 * k, 'note', str(k))
        elif kind == 'fact':
            data.set('newest', k)
        else:
            data.add(kind, 0.001 * k, [k])
    cursor, sizes = Cursor(), []
    while (answer := data.read(cursor))[1] != cursor:
        news, cursor = answer
        rows = [len(each['time']) for each in news.get('streams', {}).values()]
        sizes.append(sum(rows) + len(news.get('events', ())))
        assert news.get('more', False) == (cursor.change < np.count_nonzero(kinds != 'fact'))
    assert max(sizes) <= MAX_CHANGES
    assert len(sizes) == 3
    found, _ = read_all(data)
    for stream in 'ab':
        assert found['streams'][stream]['values'][0] == np.flatnonzero(kinds == stream).tolist()
    texts = [event['text'] for event in found['events']]
    assert texts == [str(k) for k in np.flatnonzero(kinds == 'event')[-MAX_EVENTS:]]
    assert found['facts'] == {'newest': np.flatnonzero(kinds == 'fact')[-1]}


def test_what_is_kept_is_bounded():
    data = LiveData()
    for k in range(3 * round(SPAN)):
        data.add('a', float(k), [0.0])
        data.report(float(k), 'note', str(k))
    for k in range(2 * MAX_EVENTS):
        data.report(0.0, 'note', str(k))
    changes, _ = read_all(data)
    times = changes['streams']['a']['time']
    assert (times[0], times[-1]) == (times[-1] - SPAN, 3 * round(SPAN) - 1)
    assert len(changes['events']) == MAX_EVENTS


def test_samples_between_two_steps_are_left_out():
    data = LiveData(step=0.019)
    for k in range(101):
        data.add('a', 0.01 * k, [k])
    assert read_all(data)[0]['streams']['a']['values'] == [list(range(0, 101, 2))]


def test_time_that_goes_back_starts_the_stream_anew():
    """A robot that restarts, or a bag that is played again."""
    data = LiveData()
    for time in (5.0, 6.0, 0.0, 1.0):
        data.add('a', time, [time])
    assert read_all(data)[0]['streams']['a']['time'] == [0.0, 1.0]


def test_a_sample_that_is_late_does_not_discard_the_others():
    data = LiveData()
    for time in (5.0, 6.0, 5.99, 5.6, 6.1):
        data.add('a', time, [time])
    assert read_all(data)[0]['streams']['a']['time'] == [5.0, 6.0, 6.1]


def test_numbers_that_are_not_finite_become_null():
    data = LiveData()
    data.add('a', 0.0, [math.nan, math.inf, -math.inf, 1.0])
    text = json.dumps(read_all(data)[0], allow_nan=False)
    assert json.loads(text)['streams']['a']['values'] == [[None], [None], [None], [1.0]]


def test_a_fact_is_read_again_only_when_it_has_changed():
    data = LiveData()
    data.set('world', {'walls': [1]})
    changes, cursor = data.read(Cursor())
    assert changes == {'facts': {'world': {'walls': [1]}}}
    data.set('world', {'walls': [1]})
    assert data.read(cursor)[0] == {}
    data.set('world', None)
    assert data.read(cursor)[0] == {'facts': {'world': None}}


TRACKING = {'controller': NodeReport('tracking'), 'sim_robot': NodeReport('following commands')}
ESTOP = NodeReport('emergency stop: requested by service e_stop', 'stopped')


def test_a_page_without_a_robot_names_others():
    words = 'robots of other namespaces: /east, /west (t3mpc view --namespace)'
    assert banner({}, None, ['/east', '/west']).detail == f'no odometry on the graph yet; {words}'
    assert words not in banner({}, 0.1, ['/east', '/west']).detail


@pytest.mark.parametrize(
    ('reports', 'age', 'expected'),
    [
        ({}, None, ('lost', 'Waiting for a robot', 'no odometry on the graph yet')),
        ({}, 0.1, ('good', 'Receiving odometry', '')),
        (TRACKING, 0.1, ('good', 'Tracking the reference', '')),
        (
            {
                'reference_generator': NodeReport('paused'),
                'controller': NodeReport('no reference', 'stopped'),
            },
            0.1,
            ('warning', 'Reference paused', 'controller: no reference'),
        ),
        (
            {'reference_generator': NodeReport('paused'), 'sim_robot': ESTOP},
            0.1,
            ('stopped', 'E-STOP', f'sim_robot: {ESTOP.text}'),
        ),
        (TRACKING, LOST + 1.6, ('lost', 'Connection lost', f'no odometry for 3 s: {LOST_REMEDY}')),
        (
            {**TRACKING, 'sim_robot': NodeReport('the battery is low', 'warning')},
            0.1,
            ('warning', 'Driving, with a warning', 'sim_robot: the battery is low'),
        ),
        (
            {**TRACKING, 'controller': NodeReport('no odometry', 'stopped')},
            0.1,
            ('stopped', 'Stopped', 'controller: no odometry'),
        ),
        # A robot that stands for its own reason is stopped, whatever its level; that comes first.
        (
            {
                'controller': NodeReport('no odometry', 'stopped'),
                'sim_robot': NodeReport('a wheel slips', 'stopped'),
            },
            0.1,
            ('stopped', 'Stopped', 'sim_robot: a wheel slips; controller: no odometry'),
        ),
        # What follows from the stop is not its reason.
        (
            {'controller': NodeReport('does not follow', 'warning'), 'sim_robot': ESTOP},
            0.1,
            ('stopped', 'E-STOP', f'sim_robot: {ESTOP.text}'),
        ),
    ],
)
def test_the_banner_says_what_matters_most(reports, age, expected):
    assert banner(reports, age) == expected


def test_stops_and_their_ends_are_events():
    run = LiveRun()
    run.tick(0.0)
    for name, report in TRACKING.items():
        run.node_report(name, *report)
    for k in range(30):
        run.add('odometry', 0.1 * k, [0.0])
        if k == 10:
            run.node_report('sim_robot', *ESTOP)
        if k == 15:  # what follows from the stop is no other stop
            run.node_report('controller', 'commands pause', 'stopped')
        if k == 19:
            run.node_report('controller', 'tracking', 'normal')
        if k == 20:
            run.node_report('sim_robot', 'following commands', 'normal')
        run.tick(0.1 * k)
    run.tick(2.9 + LOST + 0.1)
    events = read_all(run)[0]['events']
    assert [(event['kind'], event['text'].split(':')[0]) for event in events] == [
        ('resume', 'Tracking the reference'),
        ('stop', 'E-STOP'),
        ('resume', 'Tracking the reference'),
        ('stop', 'Connection lost'),
    ]
    assert events[1]['time'] == pytest.approx(1.0)
    assert read_all(run)[0]['facts']['banner']['kind'] == 'lost'


def test_the_report_of_a_node_that_has_left_is_discarded():
    run = LiveRun()
    run.add('odometry', 0.0, [0.0])
    run.node_report('sim_robot', *ESTOP)
    run.node_gone('sim_robot')
    run.tick(0.0)
    assert read_all(run)[0]['facts']['banner']['kind'] == 'good'


@pytest.mark.parametrize(
    ('commands', 'executed'),
    [
        # name, on, time of the click, time of its arrival
        ([('e_stop', False, 10.0, 10.1)], [True]),
        ([('e_stop', False, 10.0, 10.1 + MAX_AGE)], [False]),
        ([('reset', None, -math.inf, 10.0)], [False]),
        ([('reset', None, math.nan, 10.0)], [False]),
        ([('reset', None, 11.0 + MAX_AGE, 10.0)], [False]),
        ([('e_stop', True, -math.inf, 10.0)], [True]),
        ([('e_stop', True, 10.0, 99.0), ('enable', False, 0.0, 99.0)], [True, True]),
        # A release and a stop wait together; whichever arrives last, the stop stays.
        ([('e_stop', False, 10.0, 12.0), ('e_stop', True, 11.0, 12.0)], [True, True]),
        ([('e_stop', True, 11.0, 12.0), ('e_stop', False, 10.0, 12.0)], [True, False]),
        ([('enable', False, 11.0, 12.0), ('enable', True, 10.5, 12.0)], [True, False]),
        ([('pause', True, 11.0, 12.0), ('pause', False, 11.0, 12.0)], [True, False]),
        ([('e_stop', True, 11.0, 12.0), ('e_stop', False, 11.5, 12.0)], [True, True]),
        # The clock of the page may be fast: what is asked for after the stop arrived counts.
        ([('e_stop', True, 13.0, 12.0), ('e_stop', False, 12.5, 12.6)], [True, True]),
        # An old stop that arrives once more undoes nothing that was asked for before it.
        (
            [
                ('e_stop', True, 11.0, 11.1),
                ('e_stop', False, 12.0, 12.1),
                ('e_stop', True, 11.0, 12.2),
                ('e_stop', False, 12.3, 12.4),
            ],
            [True, True, True, True],
        ),
    ],
)
def test_a_late_command_is_executed_if_it_stops(commands, executed):
    run = LiveRun()
    found = [run.refusal(*each) for each in commands]
    assert [text == '' for text in found] == executed
    assert all(text == '' or 'ask again' in text for text in found)
