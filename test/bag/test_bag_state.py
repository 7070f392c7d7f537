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
"""Bags over generated histories: as new after a change; player, queue and cache by a model."""

from collections import deque
import random

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from mcap.records import Attachment
import pytest
from support.object_state import differences
from support.properties import PROPERTY, STATEFUL

from t3mpc_ros.bag.mcap_file import SerializedMessage
from t3mpc_ros.bag.message_definitions import MessageDefinitions
from t3mpc_ros.bag.player import PlaybackParameters, PlaybackTimeline, ScheduledMessage
from t3mpc_ros.bag.snapshot_ring_buffer import CircularMessageCache
from t3mpc_ros.bag.writer import BagWriter

SECOND, MS = 10**9, 10**6
START = 1_700_000_000 * SECOND
NUMBER = 'std_msgs/msg/Float64'
DEFINITIONS = MessageDefinitions()


def message(topic, at_ns, size=12):
    return SerializedMessage(topic, START + at_ns, START + at_ns, b'\0\1\0\0' + bytes(size - 4))


# -- as new ---------------------------------------------------------------------------------------


def a_writer(source, folder):
    """The next file of a split is that of a new writer with the same records and topics."""
    options = {
        'chunk_bytes': 100,
        'chunk_ns': source.choice([SECOND // 10, SECOND]),
        'max_file_bytes': source.choice([0, 10**6]),
        'max_file_ns': source.choice([0, 100 * SECOND]),
        'definitions': DEFINITIONS,
    }
    records, attachments = {'a': {'b': 'c'}}, {}
    used = BagWriter(folder / 'used' / 'bag', metadata_records=records, **options)
    for _ in range(source.randrange(30)):
        _do_something(used, source, records, attachments)
    used.split()
    (folder / 'new' / 'bag').mkdir(parents=True)
    for path in used.folder.glob('*_0.mcap'):
        (folder / 'new' / 'bag' / path.name).write_bytes(path.read_bytes())
    fresh = BagWriter(folder / 'new' / 'bag', metadata_records=records, **options)
    for attachment in attachments.values():
        fresh.add_attachment(attachment)
    for topic in used._topics.values():
        fresh.add_topic(topic.name, topic.type_name, topic.offered_qos_profiles, topic.type_hash)
    # The disk is synchronized once a second, whatever the file.
    yield used, fresh, ('_synced_ns', '_output._synced')
    seed = source.random()
    for each in (used, fresh):
        each._synced_ns = 0
        later = random.Random(seed)
        for _ in range(10):
            _do_something(each, later, {}, {})
        each.close()
    yield used.path.read_bytes(), fresh.path.read_bytes(), ()


def _do_something(writer, source, records, attachments):
    action, at_ns = source.randrange(5), source.randrange(50 * SECOND)
    topic = source.choice(['/a', '/b'])
    if action == 0:
        records[topic] = {'value': str(at_ns)}
        writer.add_metadata_record(topic, records[topic])
    elif action == 1:
        attachments[topic] = Attachment(0, at_ns, topic, 'text/plain', source.randbytes(3))
        writer.add_attachment(attachments[topic])
    elif action == 2:
        writer.tick(at_ns)
    else:
        writer.add_topic(topic, NUMBER)
        writer.write(*message(topic, at_ns))


def a_timeline(source, folder):
    """``seek`` keeps rate, pause and the next tick of the clock."""
    schedule = _schedule(source.random() < 0.5)
    used, fresh = (PlaybackTimeline(schedule, START, END, clock_rate=10.0) for _ in range(2))
    now_ns = 7 * SECOND
    for _ in range(source.randrange(10)):
        now_ns += source.randrange(400) * MS
        action = source.randrange(6)
        if action == 0:
            used.pause(now_ns)
        elif action == 1:
            used.resume(now_ns)
        elif action == 2:
            used.set_rate(now_ns, source.choice([0.5, 2.0]))
        elif action == 3:
            used.play_next(now_ns, 3)
        else:
            used.due_messages(now_ns)
    for each in (used, fresh):
        each.set_rate(now_ns, 0.5)
        each.pause(now_ns)
        assert each.seek(now_ns, START + 300 * MS) == ''
    yield used, fresh, ('_next_tick_ns',)


@pytest.mark.parametrize('change', [a_writer, a_timeline], ids=lambda each: each.__name__)
@given(seed=st.integers(0, 2**32 - 1))
@settings(PROPERTY, max_examples=15)
def test_after_a_change_an_object_is_as_new(change, tmp_path_factory, seed):
    """Each yields pairs that must be equal, but for what its docstring says is kept."""
    folder = tmp_path_factory.mktemp('state')
    for used, fresh, kept in change(random.Random(seed), folder):
        assert differences(used, fresh, (*kept, 'folder', 'path')) == {}


# -- player ---------------------------------------------------------------------------------------

END = START + 1000 * MS
STAMPS = [0, 0, 10, 20, 200, 210, 500, 500, 990, 1000]
"""Times of the messages of a bag, ms; a latched one is at 20."""


def _messages_from(from_ns):
    """Return what is played from a time on: the latched message before it, then the others."""
    named = [message(f'/{number}', at * MS) for number, at in enumerate(STAMPS)]
    latched = [named[3]] if named[3].received_ns < from_ns else []
    return latched, [each for each in named if each.received_ns >= from_ns]


def _schedule(loop):
    def schedule(from_ns):
        begin_ns, loops = START, 0
        while True:
            before, rest = _messages_from(from_ns)
            shift = loops * (END - begin_ns) - begin_ns
            for each in before:
                yield ScheduledMessage(from_ns + shift, from_ns, each, restored=True)
            for each in rest:
                yield ScheduledMessage(each.received_ns + shift, each.received_ns, each)
            if not loop:
                return
            from_ns, loops = begin_ns, loops + 1

    return schedule


class Player(RuleBasedStateMachine):
    """A timeline against its definition: position = rate x time while it plays."""

    @initialize(loop=st.booleans(), paused=st.booleans(), rate=st.sampled_from([0.5, 1.0, 4.0]))
    def start(self, loop, paused, rate):
        self.loop, self.paused, self.rate = loop, paused, rate
        self.now_ns, self.position = 7 * SECOND, 0
        self.made = PlaybackTimeline(
            _schedule(loop), START, END, rate=rate, loop=loop, paused=paused
        )
        self.restart(START)

    def restart(self, stamp_ns):
        self.entries, self.steps, self.finished = _schedule(self.loop)(stamp_ns), 0, False
        self.position = stamp_ns - START
        self.head = next(self.entries)
        assert self.made.due_messages(self.now_ns) == ([], self.now_ns)
        self.ask(0, 1)

    @rule(elapsed=st.integers(0, 600), most=st.integers(1, 9))
    def ask(self, elapsed, most):
        self.now_ns += elapsed * MS
        if not (self.paused or self.finished):
            self.position += round(elapsed * MS * self.rate)
        due, _ = self.made.due_messages(self.now_ns, most)
        assert [each.message for each in due] == self.expected(most)
        assert all(each.due_ns <= self.now_ns for each in due)

    def expected(self, most):
        found = []
        while len(found) < most and self.head is not None:
            at_once = self.head.restored and self.head.at_ns <= self.position
            if self.paused and not at_once and not self.steps:
                break
            if not self.paused and self.head.at_ns > self.position:
                break
            if self.paused and not self.head.restored:
                self.steps -= 1
                self.position = max(self.position, self.head.at_ns)
            found.append(self.head.message)
            self.head = next(self.entries, None)
        self.finished = self.head is None
        return found

    @rule()
    def pause(self):
        self.made.pause(self.now_ns)
        self.paused = True

    @rule()
    def resume(self):
        self.made.resume(self.now_ns)
        self.paused, self.steps = False, 0

    @rule(rate=st.sampled_from([0.5, 1.0, 4.0]))
    def set_rate(self, rate):
        self.made.set_rate(self.now_ns, rate)
        self.rate = rate

    @rule(count=st.integers(1, 4))
    def step(self, count):
        problem = self.made.play_next(self.now_ns, count)
        assert bool(problem) == (not self.paused or self.finished)
        self.steps += 0 if problem else count

    @rule(late=st.booleans(), count=st.integers(1, 4), most=st.integers(1, 2))
    def step_and_go_on(self, late, count, most):
        """Steps from messages that are late, and steps that are pending when it resumes."""
        self.resume()
        self.ask(600 if late else 0, 1)
        self.pause()
        self.step(count)
        self.ask(0, most)
        self.resume()
        self.pause()
        self.ask(0, 9)

    @rule(at=st.integers(-10, 1010))
    def seek(self, at):
        problem = self.made.seek(self.now_ns, START + at * MS)
        assert bool(problem) == (not 0 <= at <= 1000)
        if not problem:
            self.restart(START + at * MS)

    @invariant()
    def position_and_state(self):
        if not hasattr(self, 'made'):
            return
        made, now_ns, length = self.made, self.now_ns, END - START
        where = self.position % length if self.loop else min(self.position, length)
        assert made.bag_time_ns(now_ns) == START + where
        assert made.remaining_ns(now_ns) == int((length - where) / self.rate)
        assert made.loops(now_ns) == (self.position // length if self.loop else 0)
        state = made.paused, made.finished, made.rate
        assert state == (self.paused, self.finished, self.rate)


TestPlayer = Player.TestCase
TestPlayer.settings = settings(STATEFUL, max_examples=60)


@given(
    start=st.integers(0, 1200), duration=st.integers(0, 1500), until=st.integers(0, 1500)
)  # fmt: skip
@PROPERTY
def test_the_range_to_play_is_counted_from_the_first_message(start, duration, until):
    class Reader:
        start_ns, end_ns = START, END

    if 0 < until <= start:
        return  # refused by the parameters
    made = PlaybackParameters(
        start_offset=start / 1e3, playback_duration=duration / 1e3, playback_until=until / 1e3
    )
    if start > 1000:
        with pytest.raises(ValueError, match='at most the length of the bag, 1.000 s'):
            made.time_range_ns(Reader)
        return
    ends = [1000, start + duration if duration else 1000, until or 1000]
    assert made.time_range_ns(Reader) == (START + start * MS, START + min(ends) * MS)


# -- recorder -------------------------------------------------------------------------------------


class Cache(RuleBasedStateMachine):
    """The last seconds within the memory, and the last latched messages before them."""

    SPAN, LIMIT = 2 * SECOND, 4000

    def __init__(self):
        super().__init__()
        self.cache = CircularMessageCache(self.SPAN, self.LIMIT)
        self.cached, self.expired, self.latched = deque(), [], {}
        self.newest_ns, self.number = 0, 0

    @rule(count=st.integers(1, 3))
    def keep_last(self, count):
        self.cache.keep_last('/map', count)
        if '/map' in self.latched:
            self.expired = self.expired[-count:]
        self.latched['/map'] = count

    @rule(steps=st.lists(st.integers(-300, 900), min_size=1, max_size=6))
    def add(self, steps):
        messages = []
        for step in steps:
            self.number += 1
            now_ns = max(self.newest_ns - START, 0) + step * MS  # a clock may be set back
            topic = '/map' if self.number % 3 == 0 else '/a'
            messages.append(message(topic, max(now_ns, 0), 8 + self.number))
            self.newest_ns = max(self.newest_ns, messages[-1].received_ns)
        self.cache.add(messages)
        self.cached += messages
        self.expire(self.newest_ns)

    def expire(self, now_ns):
        oldest_ns = now_ns - self.SPAN
        while self.cached and (self.bytes > self.LIMIT or self.cached[0].received_ns < oldest_ns):
            gone = self.cached.popleft()
            if gone.topic in self.latched:
                self.expired = [*self.expired, gone][-self.latched['/map'] :]

    @rule(off=st.sampled_from([-1, 0, 1]))
    def add_when_the_newest_expires(self, off):
        self.add([self.SPAN // MS + off])

    @property
    def bytes(self):
        return sum(each.memory_size for each in self.cached)

    @precondition(lambda self: self.newest_ns)
    @rule(late=st.integers(0, 3000))
    def read(self, late):
        now_ns = self.newest_ns + late * MS
        self.expire(now_ns)
        begin_ns = min((each.received_ns for each in self.cached), default=now_ns - self.SPAN)
        first = [each._replace(received_ns=begin_ns) for each in self.expired]
        assert self.cache.messages(now_ns) == [*first, *self.cached]

    @invariant()
    def memory(self):
        assert self.cache.bytes == self.bytes <= self.LIMIT


TestCache = Cache.TestCase
TestCache.settings = STATEFUL
