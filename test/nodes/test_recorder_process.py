# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The recorder as a process: load, SIGKILL, signals, and a file size limit."""

import random
import resource
import signal
import time

import pytest
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64MultiArray
from support.bag_files import kept_messages
from support.long_tests import few_of
from support.waiting import wait_for_acknowledgement, wait_until

from bench.recorder_load import run
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recovery import recover_bag
from t3mpc_ros.cli.process_group import ProcessError

pytestmark = [pytest.mark.ros, pytest.mark.timed]

DEEP = QoSProfile(depth=5000)


def test_two_thousand_messages_a_second_are_all_recorded(processes, tmp_path):
    """``bench/recorder_load.py`` runs this for a minute and prints the processor load."""
    found = run(tmp_path / 'bag', processes, seconds=4.0)
    assert found.sent == 8000
    assert found.recorded == found.sent
    assert found.in_order
    with open_bag(tmp_path / 'bag') as recording:
        assert set(recording.metadata_records['losses'].values()) == {'0'}


class NumberPublisher:
    """Publishes numbers from this process to a recorder in another one."""

    def __init__(self, topic='number'):
        self._node = Node('publisher')
        self._publisher = self._node.create_publisher(Float64MultiArray, topic, DEEP)
        self._random = random.Random(1)
        self.ballast = 0
        """Incompressible random numbers appended to each message."""
        self.sent = []
        """Time of publication of each number, ns since 1970."""

    def wait_for_recorder(self):
        wait_until(self._publisher.get_subscription_count, 'no recorder')

    def publish(self, count, period=0.01):
        for _ in range(count):
            self.sent.append(time.time_ns())
            number = float(len(self.sent) - 1)
            self._publisher.publish(Float64MultiArray(data=[number, *self._ballast()]))
            time.sleep(period)

    def _ballast(self):
        return [self._random.random() for _ in range(self.ballast)]

    def wait_for_acknowledgement(self):
        wait_for_acknowledgement(self._publisher)

    def close(self):
        self._node.destroy_node()


@pytest.fixture
def publisher(ros):
    made = NumberPublisher()
    yield made
    made.close()


def start(processes, folder, **more):
    processes.start(
        'recorder', parameters={'storage.uri': str(folder), 'record.topics': ['number'], **more}
    )
    processes.wait_ready('recorder')


def numbers(path):
    with open_bag(path) as recording:
        return recording.series('/number', {'n': 'data[0]'})['n'].astype(int).tolist()


def test_a_recorder_killed_after_a_pause_has_lost_nothing(processes, publisher, tmp_path):
    start(processes, tmp_path / 'bag')
    publisher.wait_for_recorder()
    publisher.publish(20)
    time.sleep(1.0)
    processes.kill('recorder')
    (path,) = (tmp_path / 'bag').glob('*.mcap')
    assert len(kept_messages(path)) == 20


@pytest.mark.parametrize('number', few_of([signal.SIGINT, signal.SIGTERM]))
def test_messages_before_a_signal_are_in_the_bag(number, processes, publisher, tmp_path):
    start(processes, tmp_path / 'bag')
    publisher.wait_for_recorder()
    publisher.publish(900, period=0.0)
    publisher.wait_for_acknowledgement()
    assert processes.stop('recorder', number) == 0
    assert numbers(tmp_path / 'bag') == list(range(900))


def test_a_write_error_stops_recording_and_keeps_chunks(processes, publisher, tmp_path):
    start(processes, tmp_path / 'bag', **{'storage.chunk_duration': 0.05})
    publisher.wait_for_recorder()
    publisher.ballast = 500
    resource.prlimit(processes.pid('recorder'), resource.RLIMIT_FSIZE, (400_000, 400_000))

    def publish_until_the_end():
        while len(publisher.sent) < 3000:
            publisher.publish(1)
            processes.check()

    with pytest.raises(ProcessError, match='ended with code 1'):
        publish_until_the_end()
    status = processes.log('recorder').read_text()
    assert status.count('recording has stopped') == 1
    for words in ('File too large', 't3mpc bag recover', 'restart the recorder'):
        assert words in status
    assert 'Traceback' not in status
    recover_bag(tmp_path / 'bag', tmp_path / 'whole')
    kept = numbers(tmp_path / 'whole')
    assert len(kept) > 50
    assert kept == list(range(len(kept)))
