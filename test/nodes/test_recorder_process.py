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
"""The recorder as a process: load, SIGKILL at random times, signals, and a file size limit."""

from concurrent.futures import ThreadPoolExecutor
import os
import random
import resource
import signal
from threading import Event, Thread
import time

import pytest
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from std_msgs.msg import Float64MultiArray
from support.bag_files import kept_messages
from support.long_tests import few_of
from support.waiting import Processes, wait_for_acknowledgement, wait_until

from bench.recorder_load import run
from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recovery import recover_bag
from t3mpc_ros.cli.process_group import ProcessError
from t3mpc_ros.geometry.types import NANOSECONDS

pytestmark = pytest.mark.ros

SLOTS = 3
"""Recorders at a time."""


@pytest.mark.timed
@pytest.mark.long
def test_two_thousand_messages_a_second_are_all_recorded(processes, tmp_path):
    """``bench/recorder_load.py`` runs this for a minute and prints the processor load."""
    found = run(tmp_path / 'bag', processes, seconds=2.0)
    assert found.sent == 4000
    assert found.recorded == found.sent
    assert found.in_order
    with open_bag(tmp_path / 'bag') as recording:
        assert set(recording.metadata_records['losses'].values()) == {'0'}


class NumberPublisher:
    """Publishes numbers from this process to recorders in other ones."""

    def __init__(self):
        self._node = Node('publisher')
        self._publisher = self._node.create_publisher(
            Float64MultiArray, 'number', QoSProfile(depth=5000)
        )
        self._random = random.Random(1)
        self._end = Event()
        self._thread = Thread(target=self._publish_until_the_end)
        self.ballast = 0
        """Incompressible random numbers appended to each message."""
        self.sent = []
        """Time of publication of each number, ns since 1970, and its serialized message."""

    def wait_for_recorder(self, namespace='/'):
        def subscribes():
            found = self._node.get_subscriptions_info_by_topic('/number')
            return namespace in {info.node_namespace for info in found}

        wait_until(subscribes, 'no recorder')
        wait_until(self._publisher.get_subscription_count, 'no match')

    def publish(self, count, period=0.01):
        start = time.monotonic()
        for number in range(count):
            numbers = [self._random.random() for _ in range(self.ballast)]
            message = Float64MultiArray(data=[float(len(self.sent)), *numbers])
            data = serialize_message(message)
            self.sent.append((time.time_ns(), data))
            self._publisher.publish(data)
            time.sleep(max(0.0, start + (number + 1) * period - time.monotonic()))

    def start(self):
        """Publish from a thread of its own from now on."""
        self._thread.start()

    def _publish_until_the_end(self):
        while not self._end.is_set():
            self.publish(10)

    def wait_for_acknowledgement(self):
        wait_for_acknowledgement(self._publisher)

    def close(self):
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()
        self._node.destroy_node()


@pytest.fixture
def publisher(ros):
    made = NumberPublisher()
    yield made
    made.close()


def start(processes, folder, *arguments, **more):
    parameters = {'storage.uri': str(folder), 'record.topics': ['/number'], **more}
    processes.start('recorder', *arguments, parameters=parameters)
    processes.wait_ready('recorder')


def numbers(path):
    with open_bag(path) as recording:
        return recording.series('/number', {'n': 'data[0]'})['n'].astype(int).tolist()


def kill_in_sequence(folder, slot, publisher, turns):
    """Start recorders one after the other and kill each after a random time.

    Return the bag of each, and the times of its subscription and its end, ns.
    """
    rng = random.Random(100 + slot)
    result = []
    for turn in range(turns):
        name = f'slot_{slot}_{turn}'
        processes = Processes(folder / f'log_{name}', os.environ)
        try:
            start(processes, folder / name, '--ros-args', '-r', f'__ns:=/{name}')
            publisher.wait_for_recorder(f'/{name}')
            subscribed_ns = time.time_ns()
            time.sleep(rng.uniform(2.0, 5.0))
            killed_ns = time.time_ns()
        finally:
            processes.kill('recorder')
        result.append((folder / name, subscribed_ns, killed_ns))
    return result


@pytest.mark.timed
@pytest.mark.slow
@pytest.mark.parametrize('turns', few_of([1, 4]))
def test_a_kill_loses_at_most_one_second(turns, publisher, tmp_path):
    publisher.start()
    with ThreadPoolExecutor(SLOTS) as pool:
        slots = [
            pool.submit(kill_in_sequence, tmp_path, slot, publisher, turns)
            for slot in range(SLOTS)
        ]
        kills = [one for slot in slots for one in slot.result()]
    assert len(kills) == SLOTS * turns
    times, payloads = zip(*publisher.sent, strict=True)
    losses = []
    for bag, subscribed_ns, killed_ns in kills:
        output = bag.with_suffix('.new')
        result = recover_bag(bag, output)
        assert not result.clean  # the file of a killed recorder has no footer
        with open_bag(output) as recording:
            assert recording.message_count == result.kept > 0
            kept = [bytes(message.data) for message in recording.serialized_messages(['/number'])]
        first = payloads.index(kept[0])
        last = first + len(kept)
        # In order, without a gap, and byte for byte equal.
        assert kept == list(payloads[first:last])
        assert times[first] < subscribed_ns + NANOSECONDS
        lost_ns = killed_ns - times[last] if last < len(times) else 0
        losses.append(max(0, lost_ns) / NANOSECONDS)
    print('seconds lost:', ', '.join(f'{loss:.2f}' for loss in sorted(losses)))
    assert max(losses) <= 1.0


@pytest.mark.timed
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


def test_a_second_recorder_of_a_bag_ends_with_the_reason(processes, tmp_path):
    start(processes, tmp_path / 'bag')
    second = Processes(tmp_path / 'second', os.environ)
    with pytest.raises(ProcessError, match='ended with code 1'):
        start(second, tmp_path / 'bag')
    (line,) = second.log('recorder').read_text().splitlines()
    assert line.startswith('recorder: cannot record into')
    assert line.endswith('another recorder writes this bag: set storage.uri')
    processes.kill('recorder')
    third = Processes(tmp_path / 'third', os.environ)
    start(third, tmp_path / 'bag')
    assert third.stop('recorder') == 0


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
