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
"""Playback of bags in virtual time: every message once, in order, at its time."""

from contextlib import closing
from functools import partial
from itertools import pairwise
import random
import threading

import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.metadata import parse_qos
from support.bag_messages import STORE, TYPES, serialised

from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.mcap_file import SerializedMessage
from t3mpc_ros.bag.player import (
    MIN_LOOP_NS,
    MergedReader,
    PlaybackParameters,
    PlaybackTimeline,
    ReadAheadQueue,
    ScheduledMessage,
    velocity_command_risk,
)
from t3mpc_ros.bag.qos import (
    PUBLISHER_DEPTH,
    UNLIMITED,
    QosError,
    QosProfile,
    adapt_offer_to_recorded_offers,
    profiles_to_yaml,
    read_qos_overrides,
)
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.topic_filter import PlayTopicFilter, parse_remappings
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.parameters.table import ParameterError

TEXT, NUMBER = 'std_msgs/msg/String', 'std_msgs/msg/Float64'
SECOND = 10**9
START = 1_700_000_000 * SECOND
LATCHED = QosProfile(depth=1, durability='transient_local')


def text(words):
    return serialised(TYPES[TEXT](data=words))


def write_mcap(folder, messages, chunk_bytes=2000, latched=('/map',)):
    """Write ``(topic, received_ns)``; the data contain the number of the message."""
    topics = {topic for topic, _ in messages}
    with BagWriter(folder, metadata_records={}, chunk_bytes=chunk_bytes) as bag:
        for topic in sorted(topics):
            bag.add_topic(topic, TEXT, [LATCHED if topic in latched else QosProfile()])
        for number, (topic, stamp_ns) in enumerate(messages):
            bag.write(topic, stamp_ns, stamp_ns, text(f'{topic} {number}'))
    return folder


def write_sqlite(folder, messages, latched=('/map',), **compression):
    bag = Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
    if compression:
        bag.set_compression(**compression)
    with bag:
        connections = {}
        for topic in sorted({topic for topic, _ in messages}):
            (offered,) = parse_qos(
                profiles_to_yaml([LATCHED if topic in latched else QosProfile()])
            )
            connections[topic] = bag.add_connection(
                topic, TEXT, typestore=STORE, offered_qos_profiles=[offered]
            )
        for number, (topic, stamp_ns) in enumerate(messages):
            bag.write(connections[topic], stamp_ns, text(f'{topic} {number}'))
    return folder


def ticks(count=200, step=SECOND // 100):
    """Return two topics with equal times each period, and a latched one every 50 periods."""
    messages = []
    for i in range(count):
        now = START + i * step
        messages += [('/a', now), ('/b', now)]
        if i % 50 == 0:
            messages.append(('/map', now + 1))
    return messages


def expected(messages):
    return [
        SerializedMessage(topic, at, at, text(f'{topic} {n}'))
        for n, (topic, at) in enumerate(messages)
    ]


FORMATS = {
    'mcap': write_mcap,
    'sqlite3': write_sqlite,
    'sqlite3, files compressed': partial(
        write_sqlite, mode=CompressionMode.FILE, fmt=CompressionFormat.ZSTD
    ),
    'sqlite3, messages compressed': partial(
        write_sqlite, mode=CompressionMode.MESSAGE, fmt=CompressionFormat.ZSTD
    ),
}


@pytest.fixture(params=FORMATS)
def write(request):
    return FORMATS[request.param]


@pytest.fixture
def tape(tmp_path):
    """Return a function that opens bags as one reader."""
    opened = []

    def make(*folders, offsets_ns=(), **choice):
        opened.append(
            MergedReader([open_bag(f) for f in folders], offsets_ns, PlayTopicFilter(**choice))
        )
        return opened[-1]

    yield make
    for each in opened:
        each.close()


# -- sources --------------------------------------------------------------------------------------


def test_every_format_returns_every_byte_in_file_order(write, tape, tmp_path):
    written = expected(ticks())
    made = tape(write(tmp_path / 'bag', ticks()))
    assert list(made.messages(START)) == written
    assert (made.start_ns, made.end_ns) == (START, written[-1].received_ns)
    assert {name: topic.message_count for name, topic in made.topics.items()} == {
        '/a': 200,
        '/b': 200,
        '/map': 4,
    }
    assert made.topics['/map'].transient_local_count == 1
    assert made.topics['/a'].offered_qos_profiles[0].durability == 'volatile'
    assert made.topics['/a'].type_name == TEXT


def test_reading_from_any_time_on_gives_the_same_messages(write, tape, tmp_path):
    written = expected(ticks())
    made = tape(write(tmp_path / 'bag', ticks()))
    rng = random.Random(1)
    for start in [START - 5, START, made.end_ns, made.end_ns + 1] + [
        START + rng.randrange(2 * SECOND) for _ in range(10)
    ]:
        assert list(made.messages(start)) == [m for m in written if m.received_ns >= start]


def test_a_single_file_is_a_bag_too(tape, tmp_path):
    for folder, pattern in (
        (write_mcap(tmp_path / 'm', ticks(5)), '*.mcap'),
        (write_sqlite(tmp_path / 's', ticks(5)), '*.db3'),
    ):
        (file,) = folder.glob(pattern)
        assert list(tape(file).messages(0)) == expected(ticks(5))
        (folder / 'metadata.yaml').unlink()
        assert list(tape(folder).messages(0)) == expected(ticks(5))


def test_a_continued_bag_is_one_sequence(tape, tmp_path):
    """The time ranges of consecutive files may overlap."""
    one, two = ticks(60), [(topic, at + 55 * SECOND // 100) for topic, at in ticks(60)]
    write_mcap(tmp_path / 'bag', one)
    write_mcap(tmp_path / 'bag', two)
    both = [*expected(one), *expected(two)]
    assert list(tape(tmp_path / 'bag').messages(0)) == sorted(both, key=lambda m: m.received_ns)


def test_path_without_a_bag_is_rejected(tmp_path):
    (tmp_path / 'notes.txt').write_text('hello')
    (tmp_path / 'none.mcap').touch()
    (tmp_path / 'begun.mcap').write_bytes(b'\x89MCAP0\r\n')
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'above' / 'run2').mkdir(parents=True)
    (tmp_path / 'above' / 'run2' / 'metadata.yaml').touch()
    (tmp_path / 'broken.db3').write_bytes(b'no database' * 100)
    for path, words in (
        ('none.mcap', 'is empty: it has no byte'),
        ('begun.mcap', 't3mpc bag recover .*begun.mcap'),
        ('nowhere', 'there is no bag'),
        ('notes.txt', 'is no MCAP file and no sqlite3 bag'),
        ('empty', 'empty, which holds no .mcap and no .db3 file$'),
        ('above', 'file; a bag is .*above/run2$'),
        ('broken.db3', 'cannot be read'),
    ):
        with pytest.raises(BagError, match=words):
            open_bag(tmp_path / path)


def test_the_folder_of_a_run_is_its_bag(tmp_path):
    """``t3mpc bag report runs/latest`` said that there was no complete bag file."""
    write_mcap(tmp_path / 'run' / 'bag', ticks())
    (tmp_path / 'run' / 'log').mkdir()
    with open_bag(tmp_path / 'run') as bag:
        assert bag.folder == tmp_path / 'run' / 'bag'


def test_a_damaged_chunk_is_skipped_and_counted(tape, tmp_path):
    folder = write_mcap(tmp_path / 'bag', ticks())
    (file,) = folder.glob('*.mcap')
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 40] = bytes(40)
    file.write_bytes(content)
    reader = tape(folder)
    played = list(reader.messages(0))
    assert 0 < len(played) < len(ticks())
    assert len(played) + reader.damaged_count == len(ticks())
    stamps = [message.received_ns for message in played]
    assert stamps == sorted(stamps)
    # A second loop does not count them again.
    assert len(list(reader.messages(0))) == len(played)
    assert len(played) + reader.damaged_count == len(ticks())


# -- several bags ---------------------------------------------------------------------------------


def test_bags_are_merged_by_time_of_receipt(tape, tmp_path):
    one = write_mcap(tmp_path / 'one', [('/a', START + i * 1000) for i in range(0, 50, 2)])
    two = write_sqlite(tmp_path / 'two', [('/b', START + i * 1000) for i in range(0, 50, 5)])
    merged = list(tape(one, two).messages(0))
    assert len(merged) == 25 + 10
    # Equal times: in the order of the bags.
    assert merged == sorted(merged, key=lambda m: (m.received_ns, m.topic))
    turned = list(tape(two, one).messages(0))
    assert [m.topic for m in turned[:2]] == ['/b', '/a']


def test_a_bag_can_be_shifted_in_time(tmp_path):
    one = write_mcap(tmp_path / 'one', [('/a', START + i * SECOND) for i in range(3)])
    two = write_mcap(tmp_path / 'two', [('/b', 5 * START + i * SECOND) for i in range(3)])
    parameters = PlaybackParameters(
        uris=(str(one), str(two)), align_bags=True, bag_offsets=(0.0, 1e-9)
    )
    made, _ = parameters.open_reader()
    with closing(made):
        assert [(m.received_ns - START, m.topic) for m in made.messages(0)] == [
            (i * SECOND + shift, topic)
            for i in range(3)
            for shift, topic in ((0, '/a'), (1, '/b'))
        ]
    assert (made.start_ns, made.end_ns) == (START, START + 2 * SECOND + 1)


def test_one_name_with_two_types_is_refused(tmp_path):
    folders = []
    for kind in (TEXT, NUMBER):
        folders.append(tmp_path / kind.rsplit('/', 1)[-1])
        with BagWriter(folders[-1], metadata_records={}) as bag:
            bag.add_topic('/x', kind)
            bag.write('/x', START, START, b'\0\1\0\0')
    bags = [open_bag(folder) for folder in folders]
    with pytest.raises(BagError, match='/x is std_msgs/msg/String and std_msgs/msg/Float64'):
        MergedReader(bags)
    MergedReader(bags, topic_filter=PlayTopicFilter(exclude_topics=('x',))).close()


# -- filter and remapping -------------------------------------------------------------------------


@pytest.mark.parametrize(
    'choice, played',
    [
        ({}, ['/cmd_vel', '/odom', '/range/left', '/range/right', '/tf']),
        ({'topics': ('range/*', 'tf')}, ['/range/left', '/range/right', '/tf']),
        ({'topics': ('*',), 'exclude_topics': ('/range/*',)}, ['/cmd_vel', '/odom', '/tf']),
        ({'regex': '/(odom|range/l.*)'}, ['/odom', '/range/left']),
        ({'regex': '/odo'}, []),
        ({'regex': '/tf', 'topics': ('odom',)}, ['/odom', '/tf']),
        ({'exclude_regex': '.*range.*|/tf', 'exclude_topics': ('cmd_vel',)}, ['/odom']),
    ],
)
def test_topics_are_chosen_by_name_pattern_and_expression(choice, played):
    names = ['/cmd_vel', '/odom', '/range/left', '/range/right', '/tf']
    assert list(filter(PlayTopicFilter(**choice).matches, names)) == played


def test_remapped_topics_have_new_names_and_may_merge(tape, tmp_path):
    folder = write_mcap(tmp_path / 'bag', ticks(3))
    made = tape(folder, remappings=parse_remappings(['a:=/x/y', '/b := x/y']))
    assert [m.topic for m in made.messages(0)] == ['/x/y'] * 2 + ['/map'] + ['/x/y'] * 4
    assert [m.data for m in made.messages(0)] == [m.data for m in expected(ticks(3))]
    assert made.recorded_names['/x/y'] == {'/a', '/b'}
    assert made.topics['/x/y'].message_count == 6
    made.exclude_topic('/x/y')
    assert [m.topic for m in made.messages(0)] == ['/map']


@pytest.mark.parametrize(
    'given, words',
    [
        ({'play.playback_until': 0.1, 'play.start_offset': 0.1}, 'play.playback_until must be'),
        ({'play.bag_offsets': [1.0, 2.0]}, 'one number for each of the 1 bags: got 2'),
        ({'play.regex_to_filter': '['}, 'play.regex_to_filter must be a regular expression'),
        ({'play.exclude_regex': '('}, 'play.exclude_regex must be a regular expression'),
        *(
            ({'play.topic_remapping_options': items}, 'play.topic_remapping_options must')
            for items in (['a'], ['a:='], [':=b'], ['a:=b', '/a:=c'], ['a=b'])
        ),
    ],
)
def test_parameters_that_cannot_be_played_are_rejected(given, words):
    with pytest.raises(ParameterError, match=words):
        PlaybackParameters.from_dict({'storage.uris': ['bag'], **given})


@pytest.mark.parametrize(('name', 'value'), [('start_offset', 1e300), ('bag_offsets', [1e300])])
def test_a_time_beyond_any_bag_is_refused(name, value):
    """1e300 s ended with the traceback of an OverflowError."""
    words = rf'play\.{name} must be from (0|-1e\+10) to 1e\+10 s: got 1e\+300'
    with pytest.raises(ParameterError, match=words):
        PlaybackParameters.from_dict({'storage.uris': ['bag'], f'play.{name}': value})


def test_one_bag_twice_is_refused(tmp_path):
    """Each message was played twice."""
    folder = write_mcap(tmp_path / 'bag', ticks())
    (file,) = folder.glob('*.mcap')
    with pytest.raises(ParameterError, match=f'must name each bag once: got {file} twice'):
        PlaybackParameters(uris=(str(folder), str(file))).open_reader()


@pytest.mark.parametrize(
    'recorded, name, kind, risky',
    [
        ('/cmd_vel', '/cmd_vel', 'geometry_msgs/msg/Twist', True),
        ('/robot_1/cmd_vel', '/robot_1/cmd_vel', 'geometry_msgs/msg/TwistStamped', True),
        ('/x', '/cmd_vel', 'geometry_msgs/msg/Twist', True),
        ('/cmd_vel', '/other/cmd_vel', 'geometry_msgs/msg/Twist', True),
        ('/cmd_vel', '/cmd_vel', 'my_msgs/msg/Drive', True),
        ('/steer', '/steer', 'geometry_msgs/msg/Twist', True),
        ('/cmd_vel', '/recorded/velocity', 'geometry_msgs/msg/Twist', False),
        ('/odom', '/odom', 'nav_msgs/msg/Odometry', False),
    ],
)
def test_topics_that_may_drive_a_robot_are_detected(recorded, name, kind, risky):
    assert bool(velocity_command_risk(recorded, name, kind)) == risky


# -- quality of service ---------------------------------------------------------------------------

WEAK = QosProfile(reliability='best_effort')


@pytest.mark.parametrize(
    'recorded, reliability, durability, depth',
    [
        ([], 'reliable', 'volatile', PUBLISHER_DEPTH),
        ([WEAK], 'best_effort', 'volatile', PUBLISHER_DEPTH),
        ([WEAK, QosProfile()], 'reliable', 'volatile', PUBLISHER_DEPTH),
        ([LATCHED], 'reliable', 'transient_local', 1),
        ([LATCHED, WEAK, LATCHED], 'reliable', 'transient_local', 2),
        # As reported by Fast DDS for a latched publisher of another process.
        ([QosProfile('unknown', 0, 'reliable', LATCHED.durability)], 'reliable',
         'transient_local', 1),
        ([QosProfile(reliability='unknown')], 'reliable', 'volatile', PUBLISHER_DEPTH),
    ],
)  # fmt: skip
def test_offer_is_compatible_with_recorded_subscriptions(recorded, reliability, durability, depth):
    offer = adapt_offer_to_recorded_offers(recorded)
    assert (offer.reliability, offer.durability, offer.depth) == (reliability, durability, depth)
    assert offer.history == 'keep_last'


def test_of_different_deadlines_the_strictest_is_offered():
    offer = adapt_offer_to_recorded_offers(
        [
            QosProfile(deadline_ns=5, liveliness='automatic', liveliness_lease_ns=9),
            QosProfile(deadline_ns=3, liveliness='manual_by_topic', lifespan_ns=7),
            QosProfile(deadline_ns=0, liveliness='unknown'),
        ]
    )
    assert (offer.deadline_ns, offer.liveliness, offer.liveliness_lease_ns) == (
        3,
        'manual_by_topic',
        9,
    )
    assert offer.lifespan_ns == UNLIMITED


def test_overrides_are_read_as_ros2_bag_reads_them(tmp_path):
    path = tmp_path / 'overrides.yaml'
    path.write_text(
        '/talker:\n  reliability: best_effort\n  history: keep_all\n'
        '/map:\n  durability: transient_local\n  depth: 3\n  deadline: {sec: 1, nsec: 5}\n'
    )
    overrides = read_qos_overrides(path)
    assert overrides == {
        '/talker': QosProfile(reliability='best_effort', history='keep_all'),
        '/map': QosProfile(durability=LATCHED.durability, depth=3, deadline_ns=SECOND + 5),
    }


@pytest.mark.parametrize(
    'content, words',
    [
        ('[1, 2]', 'must contain profiles by topic: got list'),
        ('/a: {reliabilty: reliable}', "/a: 'reliabilty' is none of history"),
        ('/a: {reliability: strong}', '/a: reliability must be one of'),
        ('/a: {deadline: 5}', '/a: deadline must have sec and nsec'),
        ('/a: reliable', '/a must have policies'),
        ('{', 'is not YAML'),
    ],
)
def test_overrides_that_ros2_bag_would_refuse_are_refused(content, words, tmp_path):
    path = tmp_path / 'overrides.yaml'
    path.write_text(content)
    with pytest.raises(QosError, match=words):
        read_qos_overrides(path)


# -- latched topics -------------------------------------------------------------------------------


def test_latched_messages_precede_any_later_start(write, tape, tmp_path):
    """Also one from hours before: /old was published once, at the beginning."""
    messages = [('/old', START - 5000 * SECOND), *ticks()]
    made = tape(write(tmp_path / 'bag', messages, latched=('/map', '/old')))
    old, *written = (m for m in expected(messages) if m.topic in ('/map', '/old'))
    for start in (START, START + 1, START + 2, START + SECOND // 2 + 1, made.end_ns, 2 * START):
        earlier = [m for m in written if m.received_ns < start]
        assert made.latched_messages_before(start) == [old, *earlier[-1:]]


def test_two_latched_publishers_keep_a_message_each(tape, tmp_path):
    """One restored message of /tf_static would leave half of the robot without frames."""
    with BagWriter(tmp_path / 'bag', metadata_records={}) as bag:
        bag.add_topic('/tf_static', TEXT, [LATCHED, LATCHED])
        for i in range(3):
            bag.write('/tf_static', START + i, START, text(str(i)))
    kept = tape(tmp_path / 'bag').latched_messages_before(START + 10)
    assert [m.data for m in kept] == [text('1'), text('2')]


def test_a_shifted_bag_restores_its_own_map(tape, tmp_path):
    """Two runs of different days are played together from their middle.

    Of the second one the map is due as well: its stamps are moved to the first run, and so must be
    the time before which it is searched.
    """
    day = 86_400 * SECOND
    one = write_mcap(tmp_path / 'one', [('/a', START + i * SECOND) for i in range(5)])
    two = [('/map', START + SECOND), ('/b', START + 2 * SECOND), ('/map', START + 3 * SECOND)]
    for shift in (day, -day):
        late = [(topic, stamp_ns - shift) for topic, stamp_ns in two]
        other = write_mcap(tmp_path / f'two{shift}', late)
        made = tape(one, other, offsets_ns=[0, shift])
        (kept,) = made.latched_messages_before(START + 2 * SECOND)
        assert (kept.topic, kept.received_ns) == ('/map', START + SECOND)


# -- playing --------------------------------------------------------------------------------------


class Player:
    """Timeline with a virtual clock and the list of due messages."""

    def __init__(self, tape, begin_ns=None, end_ns=None, loop=False, **more):
        begin_ns = tape.start_ns if begin_ns is None else begin_ns
        end_ns = tape.end_ns if end_ns is None else end_ns
        self.made = PlaybackTimeline(
            lambda at: tape.schedule(at, begin_ns, end_ns, loop),
            begin_ns,
            end_ns,
            loop=loop,
            **more,
        )
        self.now = 7 * SECOND
        self.wake = self.now
        self.out = []

    @property
    def messages(self):
        return [e.message for _, e in self.out if e.message is not None]

    @property
    def errors(self):
        return [now - e.due_ns for now, e in self.out if e.message is not None]

    def ask(self, most=20):
        emissions, self.wake = self.made.due_messages(self.now, most)
        assert len([e for e in emissions if e.message]) <= most
        self.out += [(self.now, e) for e in emissions]

    def run(self, until_ns=None):
        """Call at the returned times, until nothing is due any more."""
        while self.wake is not None and (until_ns is None or self.wake <= until_ns):
            self.now = max(self.now, self.wake)
            self.ask()
        if until_ns is not None:
            self.now = max(self.now, until_ns)
        return self


@pytest.fixture
def bag(tape, tmp_path):
    return tape(write_mcap(tmp_path / 'bag', ticks()))


def test_each_message_is_due_at_its_time(bag):
    player = Player(bag).run()
    assert player.messages == expected(ticks())
    assert player.made.finished
    assert set(player.errors) == {0}
    first = player.out[0][0]
    assert all(now - first == e.message.received_ns - START for now, e in player.out)


def test_start_offset_and_end_select_a_range_after_the_map(bag):
    begin, end = START + SECOND // 2 + 2, START + SECOND
    player = Player(bag, begin, end).run()
    inside = [m for m in expected(ticks()) if begin <= m.received_ns <= end]
    (kept,) = bag.latched_messages_before(begin)
    assert player.messages == [kept, *inside]
    assert inside[-1].received_ns == end
    assert player.out[0][1].stamp_ns == begin, 'the clock does not start earlier'


def test_loops_are_consecutive_without_gap_or_drift(bag):
    begin, end = START + SECOND // 2 + 2, START + SECOND + 5_000_000
    player = Player(bag, begin, end, loop=True, rate=0.7)
    player.run(player.now + int(100.5 * (end - begin) / 0.7))
    loop_messages = [e.message for e in (e for _, e in Player(bag, begin, end).run().out)]
    assert player.messages[: 100 * len(loop_messages)] == loop_messages * 100
    whole = (end - begin) / 0.7
    # Each loop begins with the latched message from before it.
    for first in range(2):
        times = [now for now, _ in player.out[first :: len(loop_messages)]]
        assert len(times) == 101
        for number, now in enumerate(times):
            assert now - times[0] == pytest.approx(number * whole, abs=2)
    assert player.made.loops(player.now) == 100


def test_loop_of_a_single_message_has_a_minimum_duration(tape, tmp_path):
    made = tape(write_mcap(tmp_path / 'bag', [('/a', START)]))
    player = Player(made, loop=True)
    player.run(player.now + 10 * MIN_LOOP_NS)
    assert len(player.messages) == 11
    nothing = tape(tmp_path / 'bag', topics=('/none',))
    player = Player(nothing, loop=True).run()
    assert player.made.finished
    assert player.messages == []


def test_stepping_into_the_next_loop_does_not_play_the_map_early(bag):
    begin = START + 2
    player = Player(bag, begin, START + SECOND // 100 + 1000, loop=True, paused=True).run()
    played = ['/map']
    assert [m.topic for m in player.messages] == played
    for more in (['/a'], ['/b'], ['/map', '/a']):
        player.made.play_next(player.now)
        player.wake = player.now
        player.run()
        played += more
        assert [m.topic for m in player.messages] == played


def test_clock_has_its_rate_and_is_monotonic(bag):
    player = Player(bag, clock_rate=40.0, rate=0.5).run()
    clock = [(now, e.stamp_ns) for now, e in player.out if e.message is None]
    assert {b - a for (a, _), (b, _) in pairwise(clock)} == {SECOND // 40}
    stamps = [e.stamp_ns for _, e in player.out]
    assert stamps == sorted(stamps)
    first = clock[0][0]
    assert all(stamp == START + (now - first) // 2 for now, stamp in clock)


def test_clock_is_published_while_paused(bag):
    player = Player(bag, clock_rate=10.0, paused=True)
    player.run(player.now + SECOND)
    assert [e.stamp_ns for _, e in player.out] == [START] * 11


# -- reading ahead --------------------------------------------------------------------------------


def test_reading_ahead_changes_nothing_and_ends_when_closed(bag):
    before = threading.active_count()
    player = Player(bag)
    made = PlaybackTimeline(
        lambda at: ReadAheadQueue(bag.schedule(at, bag.start_ns, bag.end_ns, True), 100),
        bag.start_ns,
        bag.end_ns,
        loop=True,
    )
    player.made = made
    player.run(player.now + 3 * SECOND)
    for target in range(0, SECOND, SECOND // 20):
        made.seek(player.now, START + target)
    player.wake = player.now
    count = len(player.messages)
    player.run(player.now + SECOND)
    loops = expected(ticks()) * 3
    assert player.messages[:count] == loops[:count]
    assert player.messages[count + 1].received_ns == START + SECOND // 20 * 19
    made.close()
    assert threading.active_count() == before


def test_read_ahead_is_bounded_and_raises_errors_in_place():
    taken = []

    def source():
        for number in range(1000):
            taken.append(number)
            if number == 600:
                raise BagError('torn here')
            yield number

    stream = ReadAheadQueue(source(), 200)
    assert next(stream) == 0
    assert len(taken) <= 200
    assert [next(stream) for _ in range(599)] == list(range(1, 600)), 'all before the error'
    with pytest.raises(BagError, match='torn here'):
        next(stream)
    stream.close()


def test_schedule_keeps_positions_when_a_seek_starts_a_loop(bag):
    begin, end = bag.start_ns, bag.end_ns
    stream = bag.schedule(START + SECOND, begin, end, loop=True)
    planned = [next(stream) for _ in range(700)]
    assert planned[0] == ScheduledMessage(
        SECOND, START + SECOND, bag.latched_messages_before(START + SECOND)[0], restored=True
    )
    assert [p.at_ns for p in planned] == sorted(p.at_ns for p in planned)
    loop_ns = end - begin
    assert (
        next(p for p in planned if p.at_ns == loop_ns and p.stamp_ns == begin).message.topic
        == '/a'
    )
