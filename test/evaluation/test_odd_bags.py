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
"""Reports of odd bags: each oddity is named before the first number, and no number is wrong.

All bags are of a robot that is 0.02 m/s faster than its reference: a report says that, or that it
cannot be measured.
"""

import json
import resource
import sys

import numpy as np
import pytest
from rosbags.convert import convert
from rosbags.typesys import Stores, get_typestore
from support.bag_messages import START, STORE, TYPES, diagnostics, odometry_message, twist_message
from support.report_run import text_of
from support.robot_bags import following_rows, write, write_with_records

from t3mpc_ros.cli.main import main as t3mpc
from t3mpc_ros.evaluation.bag_report.report_page import write_report

OFFSET = 0.02 / 0.035
"""Error of both wheels, rad/s, by the wheel radius that is assumed."""
MONTH = 30 * 86_400.0
ROWS = following_rows()
OVERLOADED = [(5.0, '/diagnostics', diagnostics(START, 'sim_robot', 1, 'processor overloaded'))]
TEXT = TYPES['std_msgs/msg/String']('hello')


def copied(message):
    kind = message.__msgtype__
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)


def changed(topic, change, rows=None):
    """Return the rows with ``change(number, seconds, message)`` applied to a topic's messages."""
    made, count = [], 0
    for received, name, message in ROWS if rows is None else rows:
        if name == topic:
            message = copied(message)
            change(count, received, message)
            count += 1
        made.append((received, name, message))
    return made


def only(*topics):
    return [row for row in ROWS if row[1] in topics]


def by_time(*rows):
    return sorted((row for part in rows for row in part), key=lambda row: row[0])


def restamped(message, seconds):
    stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec + round(seconds * 1e9)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)


def month_later():
    later = []
    for received, topic, message in ROWS:
        if received > 8.0:
            message = copied(message)
            if topic != '/cmd_vel':
                restamped(message, MONTH)
            received += MONTH
        later.append((received, topic, message))
    return later


def moved_away(i, t, message):
    message.pose.pose.position.x += 1e6 * (t > 8.0)


def set_speed(value):
    def change(i, t, message):
        if 100 <= i < 107:
            message.twist.twist.linear.x = value

    return change


def stand(i, t, message):
    message.pose = only('/odom')[0][2].pose
    message.twist.twist.linear.x = message.twist.twist.angular.z = 0.0


def stand_outside(i, t, message):
    """Stand before 3 s and after 13 s, while the reference goes on."""
    if not 3.0 < t < 13.0:
        twist = message.twist.twist if hasattr(message, 'twist') else message
        twist.linear.x = twist.angular.z = 0.0
        if hasattr(message, 'pose'):
            places = [(abs(r - min(max(t, 3.0), 13.0)), m.pose) for r, n, m in only('/odom')]
            message.pose = min(places, key=lambda each: each[0])[1]


def second_robot(pose=(0.0, 0.0, 0.0)):
    """Return odometry of another robot that publishes to the same topic, more slowly."""
    rows = []
    for t in np.arange(100, 750) / 50.0:
        x, y, yaw = pose
        place = (x, y - 0.1 * (t - 2.0), yaw)
        stamp = START + round(t * 1e9) + 7_000_000
        rows.append((t + 0.008, '/odom', odometry_message(stamp, (0.1, 0.0), place)))
    return rows[::2]


def in_namespace(space, rows):
    return [(received, space + topic, message) for received, topic, message in rows]


def thinned_after(second, every):
    """Return the rows with every n-th odometry after a time."""
    odometry = [row for row in ROWS if row[1] == '/odom']
    late = [row for row in odometry if row[0] > second]
    return by_time(only('/cmd_vel', '/reference'), odometry[: -len(late)], late[::every])


def odd_bag(make, headline, *words, measured=True):
    """Return what makes rows, begin of the first sentence, other words, and what is measured.

    The error is measured, or not (False), or as another one (None).
    """
    return make, headline, words, measured


ODD_BAGS = {
    'gap of a month': odd_bag(
        month_later,
        'No odom for 30.0 days from 8.0 s on, the longest of 3 gaps; settled RMSE 0.571',
        'No message of /odom for 2592000.',
    ),
    'jump of the pose': odd_bag(
        lambda: changed('/odom', moved_away),
        'The position of odom jumps by 1e+06 m at 8.0 s; settled RMSE 0.571 / 0.571 rad/s.',
        'The position of /odom jumps by 1e+06 m at 8.0',
    ),
    'two robots from one place': odd_bag(
        lambda: by_time(ROWS, second_robot()),
        'The position of /odom jumps between its messages: several robots publish it, or',
        'or its pose disagrees with its twist; nothing measured from it is valid',
        measured=False,
    ),
    'two namespaces': odd_bag(
        lambda: by_time(in_namespace('/one', ROWS), in_namespace('/two', only('/odom'))),
        'Good run',
        'also holds topics of /two: another robot',
    ),
    'odometry in another namespace': odd_bag(
        lambda: by_time(only('/cmd_vel', '/reference'), in_namespace('/base', only('/odom'))),
        'Good run',
        'Odometry is taken from /base/odom',
        'also holds topics of /base',
    ),
    'odometry of two robots': odd_bag(
        lambda: by_time(
            in_namespace('/one', only('/cmd_vel', '/reference')),
            [(t, '/one/wheels', message) for t, _, message in only('/odom')],
            [(t + k, '/two/wheels', message) for t, _, message in only('/odom') for k in (0, 1)],
        ),
        'Good run',
        'Odometry is taken from /one/wheels; there is also /two/wheels',
    ),
    'foreign types': odd_bag(
        lambda: by_time(
            only('/odom', '/reference'), [(1.0 + i, '/cmd_vel', TEXT) for i in range(9)]
        ),
        'The robot drove 3.56 m in 16.0 s; the bag holds no cmd_vel, so',
        '/cmd_vel is std_msgs/msg/String, not geometry_msgs/msg/Twist',
    ),
    'not a number': odd_bag(
        lambda: changed('/odom', set_speed(np.nan)),
        'Good run',
        '7 messages of /odom hold a number that is not finite',
    ),
    'only commands': odd_bag(
        lambda: only('/cmd_vel'),
        'The bag holds no reference and no odom, so tracking cannot be judged.',
        'without a message: reference, odom',
        measured=False,
    ),
    'robot clock set back': odd_bag(
        lambda: changed('/odom', lambda i, t, m: restamped(m, -100.0 * (t > 8.0))),
        'Good run',
        'The stamps of /odom leap by -100.0 s at 8.0',
    ),
    'robot clock set back and forward again': odd_bag(
        lambda: changed('/odom', lambda i, t, m: restamped(m, -100.0 * (8.0 < t < 9.0))),
        'Good run',
        'The stamps of /odom leap by -100.0 s at 8.0 s, the first of 2 leaps: a clock was set',
    ),
    'no stamps': odd_bag(
        lambda: changed('/odom', lambda i, t, m: restamped(m, -t - START / 1e9)),
        'Good run',
        'The stamps of /odom are constant; its messages were placed by receive time',
    ),
    'simulated time': odd_bag(
        lambda: changed(
            '/reference',
            lambda i, t, m: restamped(m, 1.0 - START / 1e9),
            changed('/odom', lambda i, t, m: restamped(m, 1.0 - START / 1e9)),
        ),
        'Good run',
        'The stamps are of another clock than the receive times',
    ),
    'stands before and after': odd_bag(
        lambda: changed('/cmd_vel', stand_outside, changed('/odom', stand_outside)), 'Good run'
    ),
    'driven for less than a second': odd_bag(
        lambda: [
            (t, topic, twist_message((0.0, 0.0)) if topic == '/cmd_vel' and t > 0.9 else m)
            for t, topic, m in ROWS
        ],
        'Only 0.4 of 0.4 s count: settled RMSE 0.571 / 0.571 rad/s.',
    ),
    'receipt out of order': odd_bag(
        lambda: [(t - 3.0 * (i % 60 == 7), *row) for i, (t, *row) in enumerate(ROWS)],
        'Good run',
        'messages of /odom were out of order; they were sorted',
    ),
    'messages twice': odd_bag(
        lambda: by_time(ROWS, [(t + 0.0001, *row) for t, *row in only('/odom')]), 'Good run'
    ),
    'robot at rest': odd_bag(
        lambda: changed('/odom', stand),
        'The robot never moved, although it was to for 15.',
        'Every speed of /odom is zero in all 799 messages',
        measured=None,
    ),
    'one message': odd_bag(
        lambda: only('/odom')[:1],
        'The bag holds no reference and no cmd_vel, so tracking cannot be judged.',
        '/odom has a single message: nothing follows from it',
        measured=False,
    ),
    'two rates': odd_bag(
        lambda: thinned_after(8.0, 10),
        '44.4 % of odom is missing; settled RMSE 0.571',
        'of odom is missing',
    ),
    'reference at once': odd_bag(
        lambda: [
            (t if topic != '/reference' or t > 1.0 else 0.0, topic, m) for t, topic, m in ROWS
        ],
        'Good run',
    ),
    'slow machine': odd_bag(
        lambda: by_time(
            [row for row in ROWS if row[1] != '/odom' or row[0] % 1 > 0.3], OVERLOADED
        ),
        'The machine was overloaded from 5.0 s on (sim_robot: processor overloaded): errors',
        "errors since then may not be the controller's",
        'of odom is missing',
    ),
}


NAMED = ODD_BAGS.keys() - {
    'reference at once', 'only commands', 'slow machine', 'two rates', 'messages twice',
    'stands before and after', 'driven for less than a second', 'odometry of two robots',
}  # fmt: skip
"""Bags with an oddity beside the verdict."""


def first_screen(figures):
    """Return the text of the page before its contents."""
    page = figures.report.read_text(encoding='utf-8').partition('<main>')[2].partition('<nav')[0]
    return text_of(page)


def remarks(figures):
    """Return the text of the page on where its data come from."""
    page = figures.report.read_text(encoding='utf-8')
    return text_of(page.partition('<div class="side">')[2].partition('</div>')[0])


@pytest.mark.parametrize('name', ODD_BAGS)
@pytest.mark.slow
def test_an_odd_bag_is_named_first(name, tmp_path):
    make, headline, words, measured = ODD_BAGS[name]
    figures = write_report(write(tmp_path / 'bag', make()))
    screen = first_screen(figures)
    assert figures.verdict.sentence.startswith(headline), figures.verdict
    assert figures.verdict.sentence in screen
    for each in words:
        assert each in screen or each in remarks(figures)
    assert ('Unusual in this bag' in screen) == (name in NAMED), screen
    errors = [figures.wheels[each.name].settled for each in figures.run.channels]
    if measured:
        assert [each.rmse for each in errors] == pytest.approx([OFFSET] * 2, rel=1e-3)
    elif measured is False:
        assert [each.count for each in errors] == [0, 0]
        assert 'RMSE' not in figures.summary()


def test_a_gap_of_a_month_is_no_response_and_no_loss(tmp_path):
    """It was "213/435 ms, 100 % missing"."""
    figures = write_report(write(tmp_path / 'bag', month_later()))
    assert figures.missing['odom'] == pytest.approx(0.0, abs=0.01)
    for channel, numbers in figures.wheels.items():
        assert not figures.delay(channel) > 0.03
        assert numbers.demand == pytest.approx(numbers.chatter, rel=0.05)
        assert numbers.demand > 0.5  # as without the gap, not a millionth of it


def scaled(linear, angular):
    def change(i, t, message):
        message.twist.twist.linear.x *= linear
        message.twist.twist.angular.z *= angular

    return change


def turned(**values):
    def change(i, t, message):
        for name, value in values.items():
            setattr(message.pose.pose.orientation, name, value)

    return change


def in_millimetres(i, t, message):
    message.pose.pose.position.x *= 1e3
    message.pose.pose.position.y *= 1e3


UNITS = 'The twist of /odom cannot be in m/s and rad/s'
JUMPS = 'The position of /odom jumps between its messages: several robots publish it, or its pose'
IMPOSSIBLE = {
    # change of the odometry, words of the verdict, whether anything measured is valid
    'stamps': (lambda i, t, m: restamped(m, -t - START / 1e9), 'of /odom are constant', True),
    'zeros': (turned(z=0.0, w=0.0), '799 of 799 quaternions of /odom are zero', True),
    'nan': (turned(x=np.nan), '799 messages of /odom hold a number that is not finite', True),
    'degrees': (scaled(1.0, 180.0 / np.pi), UNITS, False),
    'millimetres': (scaled(1e3, 1.0), UNITS, False),
    'pose in millimetres': (in_millimetres, JUMPS, False),
}


@pytest.mark.parametrize('name', IMPOSSIBLE)
def test_the_verdict_names_an_impossible_odometry(name, tmp_path, capsys):
    """It was a good run, or one of *several robots*, not valid, which *drove 1.07 m*."""
    change, words, valid = IMPOSSIBLE[name]
    rows = [row for row in changed('/odom', change) if row[1] != '/reference' or valid]
    bag = write(tmp_path / 'bag', rows)
    assert t3mpc(['bag', 'report', str(bag), '--json', '-']) == 0
    found = json.loads(capsys.readouterr().out)
    verdict, numbers = found['verdict'], found['numbers']
    assert words in verdict['text']
    page = text_of((tmp_path / 'report.html').read_text(encoding='utf-8'))
    assert words in page
    if not valid:
        assert verdict['kind'] == 'bad'
        assert 'drove' not in verdict['text']
        # Tables had its errors, its path and its delay as if they were those of a robot.
        assert {name.split(' (')[0] for name, number in numbers.items() if number is not None} == {
            'duration', 'messages', *(f'variation of the command per second, {each}'
                                                 for each in ('linear', 'angular')),
        }  # fmt: skip
        assert 'Path and stops' not in page
        assert '/odom, not valid' in page


def truncated(folder):
    """Cut the second half of the second file of a bag."""
    half = len(ROWS) // 2
    write(folder, ROWS[:half])
    (rest,) = write(folder.parent / 'rest', ROWS[half:]).glob('*.mcap')
    data = rest.read_bytes()
    (folder / 'bag_1.mcap').write_bytes(data[: len(data) // 2])


def broken_metadata(folder):
    write(folder, ROWS)
    (folder / 'metadata.yaml').write_text('rosbag2_bagfile_information: [\x00')


def ros1(folder):
    source = write(folder.parent / 'ros2', ROWS)
    folder.mkdir()
    all_of_it = {'exclude_topics': (), 'include_topics': (), 'exclude_msgtypes': (),
                 'include_msgtypes': ()}  # fmt: skip
    convert(
        [source], folder / 'run.bag', dst_storage='', dst_version=0, compress=None,
        compress_mode='', default_typestore=STORE, typestore=get_typestore(Stores.ROS1_NOETIC),
        **all_of_it,
    )  # fmt: skip


DAMAGED_BAGS = {
    'truncated file': (truncated, '', 'Truncated or unfinished files, not read: bag_1.mcap'),
    'broken metadata': (broken_metadata, '', 'Good run'),
    'ROS 1': (ros1, 'run.bag', 'This is a bag of ROS 1'),
}


@pytest.mark.parametrize('name', DAMAGED_BAGS)
def test_a_damaged_bag_has_a_report_that_says_so(name, tmp_path):
    make, file, words = DAMAGED_BAGS[name]
    make(tmp_path / 'bag')
    figures = write_report(tmp_path / 'bag' / file if file else tmp_path / 'bag', tmp_path)
    assert words in first_screen(figures)
    assert figures.verdict.sound == (name != 'truncated file')
    errors = [figures.wheels[each.name].settled.rmse for each in figures.run.channels]
    assert errors == pytest.approx([OFFSET] * 2, rel=1e-3)


def test_a_damaged_chunk_names_the_command_that_recovers(tmp_path, capsys):
    """*A chunk cannot be decompressed* had no remedy, where a truncated file has one."""
    (file,) = write_with_records(tmp_path / 'bag', only('/odom'), {}).glob('*.mcap')
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(content)
    assert t3mpc(['bag', 'report', str(file)]) == 1
    assert f'`t3mpc bag recover {file}` writes what it still' in capsys.readouterr().err


def test_a_full_disk_names_the_file_and_the_remedy(tmp_path, capsys):
    """It was *[Errno 28] No space left on device*: neither which file nor what to do."""
    bag = write(tmp_path / 'bag', only('/odom')[:50])
    assert t3mpc(['bag', 'info', str(bag), '--json', '/dev/full']) == 1
    words = 'error: /dev/full cannot be written: No space left on device; free space there'
    assert words in capsys.readouterr().err


def test_a_report_that_cannot_be_written_keeps_the_last_one(tmp_path, capsys, monkeypatch):
    """A limit of the size of files left a part of the new report in place of the good one."""
    bag = write(tmp_path / 'bag', only('/odom')[:50])
    good = write_report(bag).report.read_text(encoding='utf-8')
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    monkeypatch.setattr(sys, 'dont_write_bytecode', True)  # nothing else is cut off
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, before[1]))
    try:
        assert t3mpc(['bag', 'report', str(bag)]) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert f'{tmp_path}/report.html cannot be written: File too large' in capsys.readouterr().err
    assert (tmp_path / 'report.html').read_text(encoding='utf-8') == good
    assert {each.name for each in tmp_path.iterdir()} == {'bag', 'report.html'}


def test_a_link_to_a_file_of_numbers_remains_a_link(tmp_path, capsys):
    """A file that replaces another one would have replaced the link to it."""
    bag = write(tmp_path / 'bag', only('/odom')[:50])
    (tmp_path / 'numbers.json').write_text('')
    (tmp_path / 'link').symlink_to('numbers.json')
    assert t3mpc(['bag', 'info', str(bag), '--json', str(tmp_path / 'link')]) == 0
    assert (tmp_path / 'link').is_symlink()
    assert 'message_count' in (tmp_path / 'numbers.json').read_text()
