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
"""The bridge over a real port, and what is done to both: killed, unplugged, opened twice.

Times are those of the emulator: it knows when the last command reached its robot, and when the
wheels stood, however busy this machine is.
"""

from contextlib import suppress
import os
import random
import re
import threading

from nav_msgs.msg import Odometry
import pytest
from support.missing_tools import needs
from support.ros_graph import CommandSource, diagnostic, diagnostic_level, reason, twist

from t3mpc_ros.emulator.emulator import Emulator, EmulatorParameters, StopTimeMonitor
from t3mpc_ros.emulator.pty_port import PtyPort, serve
from t3mpc_ros.nodes.base_node import ERROR
from t3mpc_ros.nodes.radio_bridge import RadioBridgeNode
from t3mpc_ros.radio.protocol.codec import encode
from t3mpc_ros.radio.protocol.frames import Command, Poll, Transmit
from t3mpc_ros.radio.protocol.framing import encode_frame

pytestmark = [pytest.mark.ros, pytest.mark.timed]

REST = 0.45
"""Maximum time to standstill after the last executed command, s."""
FULL = 0.35
"""Speed with both wheels at their maximum of 10 rad/s, m/s."""


class ServedEmulator:
    """An emulator behind a pseudo-terminal, in a thread on the wall clock."""

    def __init__(self, path, console=None, **flat):
        self.path = str(path)
        names = {name.replace('__', '.'): value for name, value in flat.items()}
        self.emulator = Emulator(EmulatorParameters.from_dict(names))
        self.emulator.plant.warm_up()
        self.port = PtyPort(path)
        self.console = None if console is None else PtyPort(console)
        self.watch = StopTimeMonitor(self.emulator)
        note = self.emulator.board.on_command
        self.followed = []

        def follow(now_us, command):
            note(now_us, command)
            self.followed.append((self.emulator.now_ns, command))

        self.emulator.board.on_command = follow
        self.news = []
        self.back_ns = None
        self._todo = []
        self._ended = False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self):
        serve(
            self.emulator,
            self.port,
            1.0,
            self._stopped,
            console_port=self.console,
            on_update=self._on_update,
        )

    def _stopped(self):
        while self._todo:
            self.emulator.inject(*self._todo.pop(0))
        return self._ended

    def _on_update(self):
        if status := self.watch.poll():
            self.news.append(status)
        if not self.emulator.port_open:
            self.back_ns = self.emulator.now_ns

    def inject(self, *fault):
        self._todo.append(fault)

    def close(self):
        self._ended = True
        self._thread.join()
        self.port.close()
        if self.console is not None:
            self.console.close()


@pytest.fixture
def served(tmp_path):
    made = []

    def serve_one(**flat):
        made.append(ServedEmulator(tmp_path / 'dongle', **flat))
        return made[-1]

    yield serve_one
    for one in made:
        one.close()


def follows_commands(node):
    """Return whether the robot follows commands; a busy machine may add a warning."""
    return node._robot.reason(node.steady_ns()) == ''


@pytest.mark.slow
def test_a_killed_bridge_leaves_the_wheels_at_rest(harness, processes, tmp_path):
    """SIGKILL at full speed; the emulator measures the time to standstill."""
    needs('C compiler')
    path = tmp_path / 'dongle'
    processes.start('emulator', 'emulator', '--link', str(path), program='t3mpc')
    processes.wait_for('emulator', 'stop with Ctrl-C', 120.0)
    odom = harness.subscribe(Odometry, 'odom')
    source = CommandSource(harness)
    for _ in range(2):
        processes.start('radio_bridge', parameters={'port': str(path)})
        source.message = twist(FULL)
        odom.clear()
        harness.spin_until(
            lambda: odom and odom[-1].twist.twist.linear.x > 0.98 * FULL, 'full speed'
        )
        processes.kill('radio_bridge')
        before = processes.log('emulator').read_text().count('at rest')
        harness.spin_until(
            lambda before=before: processes.log('emulator').read_text().count('at rest') > before,
            'rest',
        )
    found = re.findall(r'at rest ([0-9.]+) s', processes.log('emulator').read_text())
    print(f'\nat rest {", ".join(found)} s after the last command')
    assert len(found) >= 2
    assert max(map(float, found)) <= REST


def test_a_replugged_dongle_drives_within_a_second(harness, served):
    board = served(dongle_boot_time=0.0)
    node = harness.add(RadioBridgeNode, port=board.path)
    CommandSource(harness, twist(0.1))
    harness.spin_until(
        lambda: board.followed and board.followed[-1][1].left > 2000, 'the robot drives'
    )
    board.inject('close_port', 0.7)
    harness.spin_until(
        lambda: 'is the dongle plugged in?' in reason(node), 'the reason in the diagnostics'
    )
    assert diagnostic_level(node) == ERROR
    harness.spin_until(
        lambda: board.back_ns and board.followed[-1][0] > board.back_ns,
        'commands after the reconnection',
    )
    first = next(now_ns for now_ns, _ in board.followed if now_ns > board.back_ns)
    took = (first - board.back_ns) / 1e9
    print(f'\nfollows commands {took:.2f} s after the port is back')
    assert took <= 2.0  # 0.2 s in virtual time: see firmware/test_avr_faults.py
    assert diagnostic(node, 'port_failures') == 1
    harness.spin_until(lambda: follows_commands(node), 'status OK')


def test_of_several_ports_the_dongle_is_used(harness, served, tmp_path):
    """The udev rule names every chip of a kind: the robot board may have the same one.

    Alone it drives the robot over the cable; beside a dongle it does not, whatever the order.
    """
    robot_usb = tmp_path / 'a_robot'  # before the dongle in order
    served(console=robot_usb, dongle_boot_time=0.0)
    node = harness.add(RadioBridgeNode, port=str(robot_usb))
    harness.spin_until(lambda: diagnostic(node, 'link') == 'running', 'the link over the cable')
    assert diagnostic(node, 'port') == str(robot_usb)
    harness.remove(node)
    node = harness.add(RadioBridgeNode, port=str(tmp_path / '*'))
    harness.spin_until(lambda: diagnostic(node, 'link') == 'running', 'the link')
    assert diagnostic(node, 'port') == str(tmp_path / 'dongle')


def test_a_second_reader_of_the_port_causes_no_wrong_command(harness, served):
    """The other process ignores the lock, reads responses, writes noise and frames of its own."""
    board = served()
    node = harness.add(RadioBridgeNode, port=board.path)
    CommandSource(harness, twist(0.1))
    harness.spin_until(lambda: len(board.followed) > 20, 'the robot drives')
    foreign_node = os.open(board.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    dice = random.Random(4)
    count = len(board.followed)
    for _ in range(30):
        foreign = Command(
            1 + dice.randrange(255), dice.randrange(256), 1, 20, -9000, 9000, dice.randrange(2**32)
        )
        if foreign.session == board.emulator.board.session:
            continue  # one in 255 is the session of the bridge, which only a key protects
        poll = encode(Poll(foreign.session, 0, 0))
        frame = encode_frame(encode(Transmit(dice.randrange(256), 6, encode(foreign), poll)))
        os.write(foreign_node, dice.choice((frame, dice.randbytes(20), frame[:9])))
        with suppress(BlockingIOError):
            os.read(foreign_node, 64)
        end = node.steady_ns() + 30_000_000
        harness.spin_until(lambda end=end: node.steady_ns() > end, 'the waiting time')
    print(f'\nwhile it wrote: {reason(node)}, {len(board.followed) - count} commands followed')
    os.close(foreign_node)
    harness.spin_until(lambda: follows_commands(node), 'status OK afterwards')
    count = len(board.followed)
    harness.spin_until(lambda: len(board.followed) > count + 20, 'commands')
    for _, command in board.followed:
        assert 0 <= command.left == command.right <= 3000
