# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The replayer as a node over real DDS, and as a process in a terminal."""

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
import time

from geometry_msgs.msg import Twist
from mcap.reader import make_reader
import pytest
from rcl_interfaces.msg import Log
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_nodes_behaviour import LATCHED, World, odometry, reason, twist

from t3mpc_ros.bag.merged_reader import MergedReader, open_serialized_bag
from t3mpc_ros.bag.qos import QosProfile
from t3mpc_ros.bag.schema import BagError
from t3mpc_ros.bag.writer import BagWriter
from t3mpc_ros.nodes.common import conversions, introspection
from t3mpc_ros.nodes.common.base_node import OK, WARN
from t3mpc_ros.nodes.player.node import PlayerNode
from t3mpc_ros.nodes.player.terminal import parse_keys
from t3mpc_ros.nodes.recorder.node import RecorderNode
from t3mpc_ros.nodes.sim_robot import SimRobotNode
from t3mpc_ros.parameters.table import ParameterError

pytestmark = pytest.mark.ros

SECOND = 10**9
START = 1_700_000_000 * SECOND
ONE_LATCHED = QosProfile(depth=1, durability='transient_local')
WEAK = QosProfile(reliability='best_effort')


@pytest.fixture
def world(ros):
    made = World()
    yield made
    made.close()


def write(folder, messages, profiles=None, **more):
    """Record (topic, seconds, message)."""
    with BagWriter(folder, metadata_records={}, **more) as bag:
        for topic, seconds, message in messages:
            offered = (profiles or {}).get(topic, QosProfile())
            bag.add_topic(topic, introspection.type_name(type(message)), [offered])
            stamp_ns = START + round(seconds * SECOND)
            bag.write(topic, stamp_ns, stamp_ns, serialize_message(message))
    return str(folder)


def texts(count=10, period=0.02, topic='/text', first=0):
    return [
        (topic, i * period, String(data=str(number)))
        for i, number in enumerate(range(first, first + count))
    ]


def payloads(folder):
    """Return the messages of each topic, as bytes and in order."""
    bag = open_serialized_bag(folder)
    tape, found = MergedReader([bag]), {}
    for message in tape.messages(0):
        found.setdefault(message.topic, []).append(message.data)
    tape.close()
    return found


def play(world, bag, *arguments, **more):
    more = {'wait_for_subscribers': 20.0} | more
    return world.add(PlayerNode, arguments, bags=[str(bag)], **more)


def call(world, name):
    return world.call(Trigger, f'replayer/{name}')


# -- what is published ----------------------------------------------------------------------------


@pytest.mark.parametrize('given', [{'allow_commands': True}, {'remap': ['cmd_vel:=velocity']}])
def test_record_replay_record_gives_the_same_bytes_in_the_same_order(given, world, tmp_path):
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
    if 'remap' in given:
        first['/velocity'] = first.pop('/cmd_vel')
    recorder = world.add(RecorderNode, folder=str(tmp_path / 'second'), topics=list(first))
    replayer = play(world, bag, **given)
    count = len(messages)
    world.until(lambda: replayer.done, 'the bag ends')
    world.until(lambda: recorder.produce_diagnostics()[2]['messages'] >= count, 'all is recorded')
    assert replayer.exit_code == 0
    world.remove(replayer)
    world.remove(recorder)
    second = payloads(tmp_path / 'second')
    assert second == first
    tape = MergedReader([open_serialized_bag(tmp_path / 'second')])
    assert tape.tracks['/map'].profiles[0].durability == 'transient_local'
    assert tape.tracks['/text'].profiles[0].reliability == 'best_effort'
    assert tape.tracks['/odom'].profiles[0].reliability == 'reliable'
    # What was played in a second took a second.
    assert (tape.end_ns - tape.start_ns) / SECOND == pytest.approx(0.996, abs=0.2)
    tape.close()


def test_who_comes_late_gets_the_latched_message(world, tmp_path):
    messages = [('/map', 0.0, String(data='old')), *texts(), ('/map', 0.3, String(data='new'))]
    bag = write(tmp_path / 'bag', messages, {'/map': ONE_LATCHED})
    replayer = play(world, bag, wait_for_subscribers=0.0, exit_at_end=False)
    world.until(lambda: reason(replayer) == 'finished')
    late = world.hear(String, 'map', LATCHED)
    world.until(lambda: late)
    assert [message.data for message in late] == ['new']


def test_a_later_start_brings_the_map_from_before_it(world, tmp_path):
    messages = [('/map', 0.0, String(data='a map')), *texts(20)]
    bag = write(tmp_path / 'bag', messages, {'/map': ONE_LATCHED})
    heard = world.hear(String, 'map', LATCHED), world.hear(String, 'text')
    play(world, bag, start_offset=0.1, until=0.2)
    world.until(lambda: len(heard[1]) == 6)
    assert [message.data for message in heard[0]] == ['a map']
    assert [int(message.data) for message in heard[1]] == [5, 6, 7, 8, 9, 10]


def test_overrides_win_over_what_was_recorded(world, tmp_path):
    bag = write(tmp_path / 'bag', [*texts(), ('/other', 0.5, String())], {'/other': WEAK})
    overrides = tmp_path / 'overrides.yaml'
    overrides.write_text('/text: {reliability: best_effort, durability: transient_local}')
    play(world, bag, quality_overrides=str(overrides))

    def offered(topic):
        infos = world.probe.get_publishers_info_by_topic(topic)
        return [(i.qos_profile.reliability, i.qos_profile.durability) for i in infos]

    weak = ReliabilityPolicy.BEST_EFFORT
    world.until(lambda: offered('/other') == [(weak, DurabilityPolicy.VOLATILE)])
    world.until(lambda: offered('/text') == [(weak, DurabilityPolicy.TRANSIENT_LOCAL)])


def test_the_clock_of_the_bag_is_told(world, tmp_path):
    bag = write(tmp_path / 'bag', [*texts(50), ('/clock', 0.1, Clock())])
    log = world.hear(Log, '/rosout', LATCHED)
    clock = world.hear(Clock, '/clock', QoSProfile(depth=100))
    text = world.hear(String, 'text')
    replayer = play(world, bag, clock_rate=100.0, rate=2.0)
    assert world.probe.get_publishers_info_by_topic('/clock')
    world.until(lambda: replayer.done)
    world.until(lambda: len(text) == 50)
    stamps = [conversions.ns_from_time(message.clock) for message in clock]
    assert stamps == sorted(stamps)
    assert stamps[0] >= START
    assert stamps[-1] <= START + 0.98 * SECOND
    assert len(stamps) > 20
    assert any('/clock is not played: the replayer tells' in entry.msg for entry in log)


def test_a_type_that_is_not_installed_is_left_out_with_an_error(world, tmp_path, monkeypatch):
    log = world.hear(Log, '/rosout', LATCHED)
    bag = write(tmp_path / 'bag', [*texts(), ('/odom', 0.1, odometry(0))])
    monkeypatch.setitem(sys.modules, 'nav_msgs.msg', None)
    heard = world.hear(String, 'text')
    replayer = play(world, bag)
    world.until(lambda: len(heard) == 10)
    world.until(lambda: [e.level for e in log if '/odom is not played' in e.msg] == [40])
    assert replayer.produce_diagnostics()[2]['left_out'] == '/odom'


# -- safety ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    'arguments, topic',
    [
        ((), '/cmd_vel'),
        ((), '/robot_1/cmd_vel'),
        # A launch file may have given the robot's topic any name.
        ((), '/steer'),
        # The name that counts is the one under which it would really come.
        (('-r', '/velocity:=/cmd_vel'), '/velocity'),
    ],
)
def test_a_velocity_is_not_played_unless_that_is_asked_for(arguments, topic, world, tmp_path):
    log = world.hear(Log, '/rosout', LATCHED)
    messages = [*texts(), *[(topic, 0.02 * i + 0.01, twist(0.3)) for i in range(10)]]
    bag = write(tmp_path / 'bag', messages)
    name = arguments[1].split(':=')[1] if arguments else topic
    moved, heard = world.hear(Twist, name), world.hear(String, 'text')
    given = {'remap': ['cmd_vel:=velocity']} if arguments else {}
    replayer = play(world, bag, *arguments, **given)
    world.until(lambda: len(heard) == 10 and replayer.done)
    assert not moved
    assert replayer.produce_diagnostics()[2]['left_out'] == topic
    (entry,) = [entry for entry in log if f'{topic} is not played' in entry.msg]
    assert entry.level == 30
    assert 'allow_commands' in entry.msg
    assert 'remap' in entry.msg
    world.remove(replayer)
    again = play(world, bag, *arguments, allow_commands=True, **given)
    world.until(lambda: len(moved) == 10 and again.done)


def test_a_renamed_velocity_does_not_reach_a_robot_by_a_detour(world, tmp_path):
    robot = world.add(SimRobotNode, ['-r', 'cmd_vel:=/steer'])
    log = world.hear(Log, '/rosout', LATCHED)
    bag = write(tmp_path / 'bag', [(t, 0.02 * i, twist(0.3)) for i in range(20) for t in ['/v']])
    replayer = play(world, bag, remap=['v:=steer'])
    world.until(lambda: replayer.done)
    assert any('/steer is played no longer: it would drive /sim_robot' in e.msg for e in log)
    assert robot.produce_diagnostics()[2]['commands'] == 0


def test_another_publisher_of_the_same_topic_is_named(world, tmp_path):
    world.add(SimRobotNode)
    bag = write(tmp_path / 'bag', [('/odom', 0.02 * i, odometry(i)) for i in range(500)])
    log = world.hear(Log, '/rosout', LATCHED)
    world.hear(type(odometry(0)), 'odom')
    replayer = play(world, bag)
    world.until(lambda: any('/odom is published by /sim_robot, too' in e.msg for e in log))
    world.until(
        lambda: replayer.produce_diagnostics()[:2] == (WARN, 'also published by others: /odom')
    )


# -- control --------------------------------------------------------------------------------------


def test_services_pause_step_seek_and_set_the_rate(world, tmp_path):
    bag = write(tmp_path / 'bag', texts(2000, 0.01))
    heard = world.hear(String, 'text', 2000)
    replayer = play(world, bag, start_paused=True, step_count=3)
    assert call(world, 'step').success
    world.until(lambda: len(heard) == 3)
    replayer.set_parameters([Parameter('seek_time', value=15.0), Parameter('step_count', value=1)])
    assert 'paused at 15.000 s' in call(world, 'seek').message
    assert call(world, 'step').success
    world.until(lambda: len(heard) == 4)
    assert [message.data for message in heard] == ['0', '1', '2', '1500']
    replayer.set_parameters([Parameter('seek_time', value=20.0)])
    answer = call(world, 'seek')
    assert not answer.success
    assert answer.message == 'the place must be from 0.000 to 19.990 s: got 20.000 s'
    assert 'playing' in call(world, 'resume').message
    world.until(lambda: len(heard) > 20)
    answer = call(world, 'step')
    assert not answer.success
    assert 'must be paused' in answer.message
    assert 'paused' in call(world, 'pause').message
    assert 'playing' in call(world, 'toggle_paused').message
    replayer.set_parameters([Parameter('rate', value=50.0)])
    assert 'rate 50' in call(world, 'set_rate').message
    world.until(lambda: replayer.done, 'the end comes soon at that rate')
    world.until(lambda: len(heard) == 503)
    numbers = [int(message.data) for message in heard]
    assert numbers == [0, 1, 2, *range(1500, 2000)]


def test_without_a_bag_it_waits_and_says_so(world):
    replayer = world.add(PlayerNode)
    said = world.diagnosis('replayer')
    assert (said.level, said.message) == (WARN, 'no bag is open: set bags')
    answer = call(world, 'resume')
    assert (answer.success, answer.message) == (False, 'no bag is open: set bags')
    assert not replayer.done


def test_diagnostics_tell_place_and_punctuality(world, tmp_path):
    bag = write(tmp_path / 'bag', texts(500))
    world.hear(String, 'text')
    replayer = play(world, bag)
    world.until(lambda: replayer.produce_diagnostics()[2]['messages'] > 10)
    said = world.diagnosis('replayer')
    values = {entry.key: entry.value for entry in said.values}
    assert (said.level, said.message) == (OK, 'playing')
    assert 0.0 < float(values['position_s']) < 9.98 == float(values['length_s'])
    assert float(values['lateness_p99_ms']) >= float(values['lateness_p50_ms']) > 0.0


@pytest.mark.parametrize('allowed', [True, False])
def test_a_priority_is_asked_for_and_playing_goes_on_without_it(
    allowed, world, tmp_path, monkeypatch
):
    asked = []

    def scheduler(number, policy, parameters):
        asked.append((threading.current_thread().name, policy, parameters.sched_priority))
        if not allowed:
            raise PermissionError(errno.EPERM, 'Operation not permitted')

    monkeypatch.setattr(os, 'sched_setscheduler', scheduler)
    log = world.hear(Log, '/rosout', LATCHED)
    heard = world.hear(String, 'text')
    replayer = play(world, write(tmp_path / 'bag', texts(30)), realtime_priority=5)
    world.until(lambda: replayer.done and len(heard) == 30)
    assert asked == [('sender', os.SCHED_FIFO, 5)]
    words = 'realtime_priority 5 cannot be had: Operation not permitted; it plays without'
    if not allowed:
        world.until(lambda: any(entry.msg == words for entry in log))
    assert allowed or sum(entry.msg == words for entry in log) == 1


def test_a_bag_that_is_damaged_inside_ends_it_with_an_error(world, tmp_path):
    bag = write(tmp_path / 'bag', texts(200), chunk_bytes=1024)
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    with file.open('r+b') as content:
        chunks = make_reader(content).get_summary().chunk_indexes
        assert len(chunks) > 5
        content.seek(chunks[3].chunk_start_offset + chunks[3].chunk_length - 60)
        content.write(bytes(60))
    log = world.hear(Log, '/rosout', LATCHED)
    replayer = play(world, bag, wait_for_subscribers=0.0)
    world.until(lambda: replayer.exit_code == 1)
    assert replayer.produce_diagnostics()[2]['messages'] > 30, 'what comes before is played'
    words = r'playing has ended early: .*bag_0.mcap cannot be read'
    world.until(lambda: [e.level for e in log if re.match(words, e.msg)] == [40])


@pytest.mark.parametrize(
    'given, error, words',
    [
        ({'bags': ['/nowhere/at/all']}, BagError, 'there is no bag /nowhere/at/all'),
        (
            {'start_offset': 9.0},
            ParameterError,
            'start_offset must be at most .* 0.180 s: got 9 s',
        ),
        ({'start_offset': 0.1, 'until': 0.1}, ParameterError, 'until must be later than'),
        ({'remap': ['a=b']}, ParameterError, "remap must be a list of old:=new: got 'a=b'"),
        ({'regex': '['}, ParameterError, 'regex must be a regular expression'),
        ({'bag_offsets': [1.0, 2.0]}, ParameterError, 'one number for each of the 1 bags: got 2'),
        ({'quality_overrides': '/none.yaml'}, BagError, '/none.yaml cannot be read'),
    ],
)
def test_what_cannot_be_used_is_refused_at_start(given, error, words, world, tmp_path):
    bag = write(tmp_path / 'bag', texts())
    with pytest.raises(error, match=words):
        world.add(PlayerNode, **({'bags': [bag]} | given))


# -- in a terminal --------------------------------------------------------------------------------

PROGRAM = 'import sys; from t3mpc_ros.nodes.common.entry_point import player; sys.exit(player())'


class Terminal:
    """The replayer in a pseudo terminal, started like a shell would."""

    def __init__(self, *parameters, program=PROGRAM):
        self.master, self.slave = pty.openpty()
        self.before = termios.tcgetattr(self.slave)
        self.text = ''
        words = ['--ros-args', *(word for item in parameters for word in ('-p', item))]
        self.process = subprocess.Popen(
            [sys.executable, '-c', program, *words],
            stdin=self.slave,
            stdout=self.slave,
            stderr=self.slave,
            preexec_fn=self._take_terminal,
            start_new_session=True,
        )

    def _take_terminal(self):
        fcntl.ioctl(self.slave, termios.TIOCSCTTY, 0)

    def until(self, pattern):
        """Read until the terminal shows something; return it and forget what came before."""
        deadline = time.monotonic() + 15.0
        while not (match := re.search(pattern, self.text)):
            assert time.monotonic() < deadline, f'no {pattern} in {self.text!r}'
            if select.select([self.master], [], [], 0.1)[0]:
                self.text += os.read(self.master, 4096).decode()
        self.text = self.text[match.end() :]
        return match

    def press(self, keys):
        os.write(self.master, keys)

    def settings(self):
        return termios.tcgetattr(self.slave)

    def wait(self):
        deadline = time.monotonic() + 20.0
        while self.process.poll() is None:
            assert time.monotonic() < deadline, f'it does not end: {self.text!r}'
            if select.select([self.master], [], [], 0.05)[0]:
                self.text += os.read(self.master, 4096).decode()
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


def test_keys_pause_step_and_change_the_rate(terminal, tmp_path):
    bag = write(tmp_path / 'bag', texts(100, 1.0))
    shell = terminal(f'bags:=["{bag}"]')
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
    shell.press(b'\x03')  # Ctrl-C still is Ctrl-C
    assert shell.wait() == 0
    assert 'messages, timing error 50/99 %' in shell.text
    assert shell.settings() == shell.before


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_the_terminal_is_given_back_after_a_signal(number, terminal, tmp_path):
    bag = write(tmp_path / 'bag', texts(100, 0.1))
    shell = terminal(f'bags:=["{bag}"]', 'start_paused:=true')
    shell.until('paused')
    assert shell.settings() != shell.before
    shell.process.send_signal(number)
    assert shell.wait() == 0
    assert shell.settings() == shell.before
    assert 'Traceback' not in shell.text


def test_the_terminal_is_given_back_at_the_end_of_the_bag(terminal, tmp_path):
    bag = write(tmp_path / 'bag', texts(5))
    shell = terminal(f'bags:=["{bag}"]')
    shell.until('5 messages, timing error 50/99 %')
    assert shell.wait() == 0
    assert shell.settings() == shell.before


def test_the_terminal_is_given_back_after_an_error(terminal, tmp_path):
    bag = write(tmp_path / 'bag', texts(5))
    fault = (
        'from t3mpc_ros.nodes.player.node import PlayerNode as node; '
        'node._watch = lambda self: 1 / (self._keyboard is None); '
    )
    shell = terminal(f'bags:=["{bag}"]', program=fault + PROGRAM)
    assert shell.wait() == 1
    assert 'ZeroDivisionError' in shell.text
    assert shell.settings() == shell.before


def test_without_a_terminal_it_plays_to_the_end_and_exits(graph, tmp_path):
    bag = write(tmp_path / 'bag', texts(5))
    command = [sys.executable, '-c', PROGRAM, '--ros-args', '-p']
    done = subprocess.run(
        [*command, f'bags:=["{bag}"]'], stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert '5 messages, timing error 50/99 %' in done.stderr
    assert done.stdout == '', 'no line of progress in a log file'
    refused = subprocess.run(
        [*command, 'bags:=["/nowhere"]'], stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    assert refused.returncode == 2
    assert refused.stderr == 'replayer: there is no bag /nowhere\n'


def test_keys_are_known_in_whatever_pieces_they_come():
    assert parse_keys(b' \x1b[A\x1bOB\x1b[C\x1b[D+-x\x1b[') == [
        'space',
        'up',
        'down',
        'right',
        'left',
        'up',
        'down',
    ]
