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
"""The radio bridge node with a pseudo-terminal as its port and a scripted dongle."""

from contextlib import closing
import errno
import os
import select
import threading
import time
import tty

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
import pytest
from sensor_msgs.msg import BatteryState, Imu, JointState, Range
from std_srvs.srv import SetBool
from support.radio_bench import FakeDongle, FakeRobot
from support.ros_graph import CommandSource, diagnostic, reason, twist

from t3mpc_ros.geometry.types import RANGE_SENSORS
from t3mpc_ros.nodes.radio_bridge import RadioBridgeNode
from t3mpc_ros.radio.protocol.authentication import KeyFileError
from t3mpc_ros.robot.command_limiter import CLOCK_JUMPED_BACK
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, RobotCommand

pytestmark = pytest.mark.ros


class Plug:
    """A dongle behind a pseudo-terminal."""

    def __init__(self, path, key=b''):
        self.path = str(path)
        self.robot = FakeRobot(key)
        self.dongle = FakeDongle(self.robot)
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.symlink(os.ttyname(slave), self.path)
        os.close(slave)
        self.dongle.restart(time.monotonic_ns())
        self._in_port = True
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()

    def close(self):
        self._in_port = False
        self._thread.join()
        os.close(self._master)

    def _answer(self):
        replies = []
        while self._in_port:
            now_ns = time.monotonic_ns()
            while replies and replies[0][0] <= now_ns:
                os.write(self._master, replies.pop(0)[1])
            wait = min(0.02, max(0.0, (replies[0][0] - now_ns) / 1e9)) if replies else 0.02
            if not select.select([self._master], [], [], wait)[0]:
                continue
            try:
                data = os.read(self._master, 4096)
            except OSError as error:
                if error.errno != errno.EIO:  # the other end is closed
                    raise
                time.sleep(0.005)
                continue
            replies += self.dongle.receive(data, time.monotonic_ns())
            replies.sort()


@pytest.fixture
def plug(tmp_path):
    with closing(Plug(tmp_path / 'dongle')) as made:
        yield made


def driving(harness, plug, linear=0.1):
    """Return the node, the command source and the received odometry, once the robot drives."""
    node = harness.add(RadioBridgeNode, port=plug.path)
    odom = harness.subscribe(Odometry, 'odom')
    source = CommandSource(harness, twist(linear))
    harness.spin_until(
        lambda: odom and odom[-1].twist.twist.linear.x > 0.9 * linear, 'the robot drives'
    )
    return node, source, odom


def test_topics_are_those_of_sim_robot_without_truth(harness, plug):
    received = {
        name: harness.subscribe(kind, name)
        for kind, name in (
            (Imu, 'imu/data_raw'),
            (JointState, 'joint_states'),
            (BatteryState, 'battery_state'),
            (Range, 'range/left_back'),
        )
    }
    node, _, odom = driving(harness, plug)
    harness.spin_until(lambda: all(received.values()), 'every topic')
    level, text, values = node.produce_diagnostics()
    if 'round trips up to' not in text:  # on a busy machine
        assert (level, text) == (DiagnosticStatus.OK, 'following commands, unauthenticated')
    assert values['link'] == 'running'
    assert values['authenticated'] is False
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in odom]
    assert stamps == sorted(set(stamps))
    assert abs(stamps[-1] - node.now_ns()) < 2e9  # the clock of the node, not that of the link
    assert odom[-1].pose.pose.position.x > odom[0].pose.pose.position.x
    topics = {name for name, _ in node.get_publisher_names_and_types_by_node('radio_bridge', '/')}
    assert {f'/range/{name}' for name in RANGE_SENSORS} <= topics
    assert '/ground_truth/odom' not in topics


def test_timeout_and_e_stop_stop_the_robot(harness, plug):
    node, source, _ = driving(harness, plug)
    source.message = None
    harness.spin_until(
        lambda: reason(node).startswith('no command for 0.25 s'), 'the reason in the diagnostics'
    )
    harness.spin_until(lambda: plug.robot.speeds == (0.0, 0.0), 'standstill')
    harness.done(SetBool, 'e_stop', data=True)
    source.message = twist(0.1)
    harness.spin_until(lambda: plug.robot.estop, 'the stop')
    assert 'emergency stop: requested by service e_stop' in reason(node)
    assert plug.robot.speeds == (0.0, 0.0)
    harness.done(SetBool, 'e_stop', data=False)
    harness.spin_until(lambda: max(plug.robot.speeds) > 2.0, 'the robot drives again')


def test_shutdown_stops_the_robot_and_disables_its_drives(harness, plug):
    node, source, _ = driving(harness, plug)
    source.message = None
    harness.remove(node)
    assert plug.robot.speeds == (0.0, 0.0)
    assert not plug.robot.enabled
    assert not node._port_thread.is_alive()


def test_a_key_file_readable_by_others_is_rejected(harness, plug, tmp_path):
    key = tmp_path / 'key'
    key.write_text('00' * 16)
    key.chmod(0o644)
    with pytest.raises(KeyFileError, match='chmod 600'):
        harness.add(RadioBridgeNode, port=plug.path, key_file=str(key))


def test_commands_are_signed_with_the_key(harness, tmp_path):
    key = bytes(range(16))
    path = tmp_path / 'key'
    path.write_text(key.hex())
    path.chmod(0o600)
    with closing(Plug(tmp_path / 'dongle', key)) as plug:
        node = harness.add(RadioBridgeNode, port=plug.path, key_file=str(path))
        CommandSource(harness, twist(0.1))
        harness.spin_until(lambda: max(plug.robot.speeds) > 2.0, 'the robot drives')
        harness.spin_until(lambda: reason(node) == 'following commands', 'status OK')
        assert diagnostic(node, 'authenticated') is True


def test_command_between_two_steps_is_no_clock_that_jumps_back(harness, plug, monkeypatch):
    """A step had the time before its lock: a command that came first stopped the robot."""
    node, _, _ = driving(harness, plug)
    reasons = []
    monkeypatch.setattr(node, '_log_reason', reasons.append)

    class Contested:
        """A lock for which each holder has waited for a command of another thread."""

        lock = node._lock

        def __enter__(self):
            self.lock.acquire()
            standstill = RobotCommand(ZERO_WHEEL_SPEEDS, node.steady_ns())
            node._robot.apply(standstill, standstill.stamp_ns)

        def __exit__(self, *error):
            self.lock.release()

    monkeypatch.setattr(node, '_lock', Contested())
    reasons += [node.produce_diagnostics()[1] for _ in range(3)]
    harness.spin_until(lambda: len(reasons) > 10, 'steps of the radio')
    assert not any(CLOCK_JUMPED_BACK in each for each in reasons)
