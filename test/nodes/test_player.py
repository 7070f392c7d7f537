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
"""The player as a node over DDS and as a process in a terminal."""

import errno
import fcntl
import os
import pty
import re
import select
import signal
import subprocess
import sys
import termios
import threading

from geometry_msgs.msg import Twist
from mcap.reader import make_reader
import pytest
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.ros_graph import LATCHED, diagnostic, diagnostic_level, odometry, reason, twist
from support.waiting import wait_until

from t3mpc_ros.bag.errors import BagError
from t3mpc_ros.bag.player import MergedReader
from t3mpc_ros.bag.qos import QosProfile
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.nodes import ros_messages
from t3mpc_ros.nodes.base_node import OK, WARN
from t3mpc_ros.nodes.player import PlayerNode
from t3mpc_ros.nodes.player_terminal import parse_keys
from t3mpc_ros.nodes.recorder import RecorderNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode
from t3mpc_ros.parameters.table import ParameterError

pytestmark = pytest.mark.ros

SECOND = 10**9
START = 1_700_000_000 * SECOND
ONE_LATCHED = QosProfile(depth=1, durability='transient_local')
WEAK = QosProfile(reliability='best_effort')


def write(folder, messages, profiles=None, **more):
    """Write a bag of (topic, seconds, message)."""
    with BagWriter(folder, metadata_records={}, **more) as bag:
        for topic, seconds, message in messages:
            offered = (profiles or {}).get(topic, QosProfile())
            bag.add_topic(topic, ros_messages.type_name(type(message)), [offered])
            stamp_ns = START + round(seconds * SECOND)
            bag.write(topic, stamp_ns, stamp_ns, serialize_message(message))
    return str(folder)


def texts(count=10, period=0.02, topic='/text', first=0):
    return [
        (topic, i * period, String(data=str(number)))
        for i, number in enumerate(range(first, first + count))
    ]


def payloads(folder):
    """Return the serialized messages of each topic, in order."""
    bag = open_bag(folder)
    tape, found = MergedReader([bag]), {}
    for message in tape.messages(0):
        found.setdefault(message.topic, []).append(message.data)
    tape.close()
    return found


def play(harness, bag, *arguments, **more):
    more = {'play__subscriber_timeout': 20.0} | more
    return harness.add(PlayerNode, arguments, storage__uris=[str(bag)], **more)


def call(harness, name):
    return harness.call(Trigger, f'player/{name}')


# -- messages and QoS -----------------------------------------------------------------------------


def test_a_played_and_recorded_bag_has_the_same_bytes(harness, tmp_path):
    messages = [('/map', 0.0, String(data='a map'))]
    for i in range(200):
        at = i * 0.005
        messages += [
            ('/odom', at, odometry(START + i, 0.01 * i, -0.02 * i)),
            ('/cmd_vel', at, twist(0.1 * i, 0.2 * i)),
            ('/text', at + 0.001, String(data='x' * i)),
        ]
    bag = write(tmp_path / 'first', messages, {'/map': ONE_LATCHED, '/text': WEAK})
    first = payloads(bag)
    first['/velocity'] = first.pop('/cmd_vel')
    recorder = harness.add(
        RecorderNode, storage__uri=str(tmp_path / 'second'), record__topics=list(first)
    )
    player = play(harness, bag, play__topic_remapping_options=['cmd_vel:=velocity'])
    count = len(messages)
    harness.spin_until(lambda: player.exit_requested, 'the bag ends')
    harness.spin_until(lambda: diagnostic(recorder, 'messages') >= count, 'all is recorded')
    assert player.exit_code == 0
    harness.remove(player)
    harness.remove(recorder)
    second = payloads(tmp_path / 'second')
    assert second == first
    tape = MergedReader([open_bag(tmp_path / 'second')])
    assert tape.topics['/map'].offered_qos_profiles[0].durability == 'transient_local'
    assert tape.topics['/text'].offered_qos_profiles[0].reliability == 'best_effort'
    assert tape.topics['/odom'].offered_qos_profiles[0].reliability == 'reliable'
    # The recorded interval of one second is published within one second.
    assert (tape.end_ns - tape.start_ns) / SECOND == pytest.approx(0.996, abs=0.2)
    tape.close()


def test_a_late_subscriber_gets_the_latched_message(harness, tmp_path):
    """Also one from before the start offset."""
    maps = [('/map', at, String(data=data)) for at, data in ((0.0, 'old'), (0.18, 'new'))]
    bag = write(tmp_path / 'bag', [*maps, *texts(20)], {'/map': ONE_LATCHED})
    received = harness.subscribe(String, 'map', LATCHED), harness.subscribe(String, 'text')
    given = {'play__start_offset': 0.1, 'play__playback_until': 0.2}
    player = play(harness, bag, play__exit_at_end=False, **given)
    harness.spin_until(lambda: len(received[1]) == 6 and reason(player) == 'finished')
    late = harness.subscribe(String, 'map', LATCHED)
    harness.spin_until(lambda: late)
    assert [message.data for message in received[0]] == ['old', 'new']
    assert [int(message.data) for message in received[1]] == [5, 6, 7, 8, 9, 10]
    assert [message.data for message in late] == ['new']


def test_qos_overrides_replace_the_recorded_qos(harness, tmp_path):
    bag = write(tmp_path / 'bag', [*texts(), ('/other', 0.5, String())], {'/other': WEAK})
    overrides = tmp_path / 'overrides.yaml'
    overrides.write_text('/text: {reliability: best_effort, durability: transient_local}')
    play(harness, bag, play__qos_profile_overrides_path=str(overrides))

    def offered(topic):
        infos = harness.probe.get_publishers_info_by_topic(topic)
        return [(i.qos_profile.reliability, i.qos_profile.durability) for i in infos]

    weak = ReliabilityPolicy.BEST_EFFORT
    harness.spin_until(lambda: offered('/other') and offered('/text'))
    assert offered('/other') == [(weak, DurabilityPolicy.VOLATILE)]
    assert offered('/text') == [(weak, DurabilityPolicy.TRANSIENT_LOCAL)]


def test_the_time_of_the_bag_is_published_as_clock(harness, logged, tmp_path):
    bag = write(tmp_path / 'bag', [*texts(50), ('/clock', 0.1, Clock())])
    clock = harness.subscribe(Clock, '/clock', QoSProfile(depth=100))
    text = harness.subscribe(String, 'text')
    player = play(harness, bag, play__clock_publish_frequency=100.0, play__rate=2.0)
    assert harness.probe.get_publishers_info_by_topic('/clock')
    harness.spin_until(lambda: player.exit_requested)
    harness.spin_until(lambda: len(text) == 50)
    stamps = [ros_messages.ns_from_time(message.clock) for message in clock]
    assert stamps == sorted(stamps)
    assert stamps[0] >= START
    assert stamps[-1] <= START + 0.98 * SECOND
    assert len(stamps) > 20
    assert logged('/clock is not played: the player publishes its own clock')


def test_a_type_that_is_not_installed_is_not_played(harness, logged, tmp_path, monkeypatch):
    bag = write(tmp_path / 'bag', [*texts(), ('/odom', 0.1, odometry(0))])
    monkeypatch.setitem(sys.modules, 'nav_msgs.msg', None)
    received = harness.subscribe(String, 'text')
    player = play(harness, bag)
    harness.spin_until(lambda: len(received) == 10)
    (line,) = logged('/odom is not played')
    assert line.startswith('[ERROR]')
    assert diagnostic(player, 'excluded') == '/odom'


# -- safety ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'arguments, topic',
    [
        ((), '/robot_1/cmd_vel'),
        # A launch file may remap the robot's topic to any name.
        ((), '/steer'),
        # The rule applies to the name after remapping.
        (('-r', '/velocity:=/cmd_vel'), '/velocity'),
    ],
)
def test_a_velocity_is_played_with_allow_commands_only(
    arguments, topic, harness, logged, tmp_path
):
    messages = [*texts(), *[(topic, 0.02 * i + 0.01, twist(0.3)) for i in range(10)]]
    bag = write(tmp_path / 'bag', messages)
    name = arguments[1].split(':=')[1] if arguments else topic
    moved, received = harness.subscribe(Twist, name), harness.subscribe(String, 'text')
    given = {'play__topic_remapping_options': ['cmd_vel:=velocity']} if arguments else {}
    player = play(harness, bag, *arguments, **given)
    harness.spin_until(lambda: len(received) == 10 and player.exit_requested)
    assert not moved
    assert diagnostic(player, 'excluded') == topic
    (line,) = logged(f'{topic} is not played')
    assert line.startswith('[WARN]')
    assert 'play.allow_commands' in line
    assert 'play.topic_remapping_options' in line
    harness.remove(player)
    again = play(harness, bag, *arguments, play__allow_commands=True, **given)
    harness.spin_until(lambda: len(moved) == 10 and again.exit_requested)


def test_a_remapped_velocity_does_not_reach_a_robot(harness, logged, tmp_path):
    robot = harness.add(SimRobotNode, ['-r', 'cmd_vel:=/steer'])
    bag = write(tmp_path / 'bag', [(t, 0.02 * i, twist(0.3)) for i in range(20) for t in ['/v']])
    player = play(harness, bag, play__topic_remapping_options=['v:=steer'])
    harness.spin_until(lambda: player.exit_requested)
    assert logged('/steer is disabled: it would move /sim_robot')
    assert diagnostic(robot, 'commands') == 0


def test_another_publisher_of_a_topic_is_a_warning(harness, logged, tmp_path):
    harness.add(SimRobotNode)
    bag = write(tmp_path / 'bag', [('/odom', 0.02 * i, odometry(i)) for i in range(500)])
    harness.subscribe(type(odometry(0)), 'odom')
    player = play(harness, bag)
    harness.spin_until(lambda: logged('/odom is published by /sim_robot, too'))
    harness.spin_until(
        lambda: (
            diagnostic_level(player) == WARN
            and reason(player) == 'also published by other nodes: /odom'
        )
    )


# -- control --------------------------------------------------------------------------------------


def test_services_pause_play_next_seek_and_set_the_rate(harness, tmp_path):
    bag = write(tmp_path / 'bag', texts(2000, 0.01))
    received = harness.subscribe(String, 'text', 2000)
    player = play(harness, bag, play__start_paused=True, play__play_next_count=3)
    assert call(harness, 'play_next').success
    harness.spin_until(lambda: len(received) == 3)
    player.set_parameters(
        [Parameter('play.seek_time', value=15.0), Parameter('play.play_next_count', value=1)]
    )
    assert 'paused at 15.000 s' in call(harness, 'seek').message
    assert call(harness, 'play_next').success
    harness.spin_until(lambda: len(received) == 4)
    assert [message.data for message in received] == ['0', '1', '2', '1500']
    player.set_parameters([Parameter('play.seek_time', value=20.0)])
    response = call(harness, 'seek')
    assert not response.success
    assert response.message == 'the seek target must be from 0.000 to 19.990 s: got 20.000 s'
    assert 'playing' in call(harness, 'resume').message
    harness.spin_until(lambda: len(received) > 20)
    assert (diagnostic_level(player), reason(player)) == (OK, 'playing')
    assert 15.0 < diagnostic(player, 'position_s') < 19.99 == diagnostic(player, 'length_s')
    assert diagnostic(player, 'latency_max_ms') > 0.0
    response = call(harness, 'play_next')
    assert not response.success
    assert 'must be paused' in response.message
    assert 'paused' in call(harness, 'pause').message
    assert 'playing' in call(harness, 'toggle_paused').message
    player.set_parameters([Parameter('play.rate', value=50.0)])
    assert 'rate 50' in call(harness, 'set_rate').message
    harness.spin_until(lambda: player.exit_requested, 'the end of the bag at that rate')
    harness.spin_until(lambda: len(received) == 503)
    numbers = [int(message.data) for message in received]
    assert numbers == [0, 1, 2, *range(1500, 2000)]


def test_without_a_bag_the_player_warns(harness):
    player = harness.add(PlayerNode)
    found = diagnostic_level(player), reason(player)
    assert found == (WARN, 'no bag is open: set storage.uris')
    response = call(harness, 'resume')
    assert (response.success, response.message) == (False, found[1])
    assert not player.exit_requested


@pytest.mark.parametrize('allowed', [True, False])
def test_playback_works_without_the_realtime_priority(
    allowed, harness, logged, tmp_path, monkeypatch
):
    asked = []

    def scheduler(number, policy, parameters):
        asked.append((threading.current_thread().name, policy, parameters.sched_priority))
        if not allowed:
            raise PermissionError(errno.EPERM, 'Operation not permitted')

    monkeypatch.setattr(os, 'sched_setscheduler', scheduler)
    received = harness.subscribe(String, 'text')
    player = play(harness, write(tmp_path / 'bag', texts(30)), play__realtime_priority=5)
    harness.spin_until(lambda: player.exit_requested and len(received) == 30)
    assert asked == [('player', os.SCHED_FIFO, 5)]
    words = (
        'play.realtime_priority 5 is not available: Operation not permitted; playing without it'
    )
    assert len(logged(words)) == (not allowed)


def damaged_bag(folder, chosen):
    """Write a bag of 200 texts with damage in some of its chunks."""
    bag = write(folder, texts(200), chunk_bytes=1024)
    (file,) = folder.glob('*.mcap')
    with file.open('r+b') as content:
        chunks = make_reader(content).get_summary().chunk_indexes
        assert len(chunks) > 5
        for chunk in chunks[chosen]:
            content.seek(chunk.chunk_start_offset + chunk.chunk_length - 60)
            content.write(bytes(60))
    return bag


def test_a_damaged_bag_is_played_with_a_warning_and_a_count(harness, logged, tmp_path):
    """Playback once ended at the damage, and half of the bag was not played."""
    bag = damaged_bag(tmp_path / 'bag', slice(3, 4))
    player = play(harness, bag, play__subscriber_timeout=0.0, play__rate=10.0)
    harness.spin_until(lambda: player.exit_requested)
    assert player.exit_code == 0
    damaged = diagnostic(player, 'damaged')
    assert damaged > 0
    assert diagnostic(player, 'messages') + damaged == 200
    assert diagnostic_level(player) == WARN
    words = f'the bag is damaged: {damaged} messages so far are not played'
    assert [line.split()[0] for line in logged(words)] == ['[WARN]']


@pytest.mark.parametrize(
    'damaged, given, words',
    [
        (slice(99), {}, 'nothing was played: all 200 messages are in damaged chunks'),
        (slice(0), {'play__topics_to_filter': ['none']}, 'no message in the topics and the time'),
        (slice(0), {'play__topic_remapping_options': ['text:=cmd_vel']}, 'may drive a robot'),
    ],
)
def test_a_bag_that_plays_nothing_is_an_error(damaged, given, words, harness, logged, tmp_path):
    """0 of 1 200 messages ended with code 0."""
    bag = damaged_bag(tmp_path / 'bag', damaged)
    player = play(harness, bag, play__subscriber_timeout=0.0, play__rate=10.0, **given)
    harness.spin_until(lambda: player.exit_requested)
    assert player.exit_code == 1
    assert [words in line for line in logged('nothing was played')] == [True]


def test_an_empty_bag_is_named_as_such(harness, logged, tmp_path):
    """It said that /cmd_vel may drive a robot, which was not why nothing was played."""
    with BagWriter(tmp_path / 'bag', metadata_records={}) as bag:
        bag.add_topic('/cmd_vel', 'geometry_msgs/msg/Twist')
    player = play(harness, tmp_path / 'bag', play__subscriber_timeout=0.0)
    harness.spin_until(lambda: player.exit_requested)
    assert len(logged('nothing was played: the bags hold no message')) == 1


@pytest.mark.parametrize(
    'given, error, words',
    [
        ({'play__start_offset': 9.0}, ParameterError, 'at most .* 0.180 s: got 9 s'),
        ({'play__qos_profile_overrides_path': '/none.yaml'}, BagError, 'cannot be read'),
    ],
)
def test_a_bag_that_cannot_be_played_so_is_refused(given, error, words, harness, tmp_path):
    bag = write(tmp_path / 'bag', texts())
    with pytest.raises(error, match=words):
        play(harness, bag, **given)


# -- in a terminal --------------------------------------------------------------------------------

PROGRAM = 'import sys; from t3mpc_ros.nodes.entry_points import player; sys.exit(player())'


class Terminal:
    """The player in a pseudo-terminal, started as by a shell."""

    def __init__(self, *parameters, program=PROGRAM):
        self.master, self.slave = pty.openpty()
        self.before = termios.tcgetattr(self.slave)
        self.text = ''
        arguments = ['--ros-args', *(word for item in parameters for word in ('-p', item))]
        self.process = subprocess.Popen(
            [sys.executable, '-c', program, *arguments],
            stdin=self.slave,
            stdout=self.slave,
            stderr=self.slave,
            preexec_fn=self._take_terminal,
            start_new_session=True,
        )

    def _take_terminal(self):
        fcntl.ioctl(self.slave, termios.TIOCSCTTY, 0)

    def until(self, pattern):
        """Read until the terminal shows ``pattern``; return the match, discard the text."""
        self._wait_until(lambda: re.search(pattern, self.text))
        match = re.search(pattern, self.text)
        self.text = self.text[match.end() :]
        return match

    def _wait_until(self, condition):
        wait_until(condition, lambda: f'it shows {self.text!r}', step=self._read)

    def _read(self):
        ready = select.select([self.master], [], [], 0.05)[0]
        if ready:
            self.text += os.read(self.master, 4096).decode()
        return bool(ready)

    def press(self, keys):
        os.write(self.master, keys)

    def settings(self):
        return termios.tcgetattr(self.slave)

    def wait(self):
        self._wait_until(lambda: self.process.poll() is not None)
        while self._read():  # what it wrote between the last look and its end
            pass
        return self.process.returncode

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def terminal(graph):
    made = []

    def start(*parameters, **more):
        made.append(Terminal(*parameters, **more))
        return made[-1]

    yield start
    for each in made:
        each.close()


def test_keys_pause_play_next_and_change_the_rate(terminal, tmp_path):
    bag = write(tmp_path / 'bag', texts(100, 1.0))
    shell = terminal(f'storage.uris:=["{bag}"]')
    shell.until(r'playing .* x1 ')
    assert not shell.settings()[3] & (termios.ICANON | termios.ECHO)
    shell.press(b' ')
    shell.until(r'paused .* left')
    shell.press(b'\x1b[C')
    place = int(shell.until(r'paused .* (\d+)\.00 / 99.00 s')[1])
    shell.press(b'\x1b[C\x1b[C')
    shell.until(rf'paused .* {place + 2}\.00 / 99.00 s')
    shell.press(b'\x1b[A+')
    shell.until(r' x1.21 ')
    shell.press(b'-q\x1b[D')
    shell.until(rf' {max(0, place - 3)}\.00 / 99.00 s  x1.1 ')
    shell.press(b' ')
    shell.until(r'playing')
    shell.press(b'\x03')  # Ctrl-C keeps its meaning
    assert shell.wait() == 0
    assert 'messages, timing error at most' in shell.text
    assert shell.settings() == shell.before


FAULT = (
    'from t3mpc_ros.nodes.player import PlayerNode as node; '
    'node._monitor = lambda self: 1 / (self._keyboard is None); '
)


@pytest.mark.parametrize(
    'count, program, sent, code, words',
    [
        (100, PROGRAM, signal.SIGTERM, 0, 'messages, timing error at most'),
        (5, PROGRAM, None, 0, '5 messages, timing error at most'),
        (5, FAULT + PROGRAM, None, 1, 'ZeroDivisionError'),
    ],
    ids=['signal', 'end', 'error'],
)
def test_the_terminal_is_restored(count, program, sent, code, words, terminal, tmp_path):
    bag = write(tmp_path / 'bag', texts(count, 0.1))
    shell = terminal(f'storage.uris:=["{bag}"]', program=program)
    if sent is not None:
        shell.until('playing')
        assert shell.settings() != shell.before
        shell.process.send_signal(sent)
    assert shell.wait() == code
    assert words in shell.text
    assert code or 'Traceback' not in shell.text
    assert shell.settings() == shell.before


def test_without_a_terminal_the_player_plays_to_the_end(graph, tmp_path):
    bag = write(tmp_path / 'bag', texts(5))
    command = [sys.executable, '-c', PROGRAM, '--ros-args', '-p']
    done = subprocess.run(
        [*command, f'storage.uris:=["{bag}"]'],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert '5 messages, timing error at most' in done.stderr
    assert done.stdout == '', 'no progress line without a terminal'


def test_keys_are_parsed_from_any_input():
    keys = 'space up down right left up down'
    assert parse_keys(b' \x1b[A\x1bOB\x1b[C\x1b[D+-x\x1b[') == keys.split()
