# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recovery of the bags of recorders killed with SIGKILL at random times."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
import os
from pathlib import Path
import random
import threading
import time

from nav_msgs.msg import Odometry
import pytest
import rclpy
from rclpy.serialization import serialize_message
from support.long_tests import few_of
from support.waiting import Processes, wait_until

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recovery import recover_bag
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes import qos

pytestmark = [pytest.mark.ros, pytest.mark.timed, pytest.mark.slow]

RATE = 100.0
SLOTS = 5
"""Recorders at a time."""
ALLOWED = 1.0
"""Time before the kill that may be lost, s."""


class Source:
    """Publishes numbered odometry at 100 Hz from a thread, and stores the sent messages."""

    def __init__(self):
        self._node = rclpy.create_node('source')
        self._publisher = self._node.create_publisher(Odometry, 'odom', qos.STREAM)
        self._stop = threading.Event()
        self.sent = []
        """(time of publication in ns, serialized message)"""
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def has_subscriber_in(self, namespace):
        """Return whether a node of this namespace subscribes."""
        found = self._node.get_subscriptions_info_by_topic('/odom')
        return any(info.node_namespace == namespace for info in found)

    def close(self):
        self._stop.set()
        self._thread.join()
        self._node.destroy_node()

    def _run(self):
        message = Odometry()
        start = time.monotonic()
        number = 0
        while not self._stop.wait(max(0.0, start + number / RATE - time.monotonic())):
            message.header.stamp.sec = number
            message.pose.pose.position.x = number / 7.0
            data = serialize_message(message)
            self.sent.append((time.time_ns(), data))
            self._publisher.publish(data)
            number += 1


@pytest.fixture
def source(ros):
    publishing = Source()
    yield publishing
    publishing.close()


@dataclass
class KilledRecorder:
    """A killed recorder: its bag, and the times of subscription and kill, ns."""

    bag: Path
    subscribed_ns: int
    killed_ns: int


def kill_in_sequence(root, slot, source, turns):
    """Start recorders one after the other, kill each after a random time; return them."""
    rng = random.Random(100 + slot)
    result = []
    for turn in range(turns):
        name = f'slot_{slot}_{turn}'
        processes = Processes(root / f'log_{name}', os.environ)
        bag = root / name
        try:
            processes.start(
                'recorder',
                *('--ros-args', '-r', f'__ns:=/{name}'),
                parameters={'storage.uri': str(bag), 'record.topics': ['/odom']},
            )
            processes.wait_ready('recorder')
            wait_until(lambda name=name: source.has_subscriber_in(f'/{name}'))
            subscribed_ns = time.time_ns()
            time.sleep(rng.uniform(2.0, 5.0))
            killed_ns = time.time_ns()
        finally:
            processes.kill('recorder')
        result.append(KilledRecorder(bag, subscribed_ns, killed_ns))
    return result


def kept_after_kill(folder: Path, output: Path):
    """Return the serialized odometry messages that recovery finds in a bag."""
    result = recover_bag(folder, output)
    assert not result.clean  # the file of a killed recorder has no footer
    with open_bag(output) as recording:
        assert recording.message_count == result.kept
        return [bytes(message.data) for message in recording.serialized_messages(['/odom'])]


@pytest.mark.parametrize('turns', few_of([1, 4]))
def test_a_kill_loses_at_most_one_second(turns, source, tmp_path):
    with ThreadPoolExecutor(SLOTS) as pool:
        slots = [pool.submit(kill_in_sequence, tmp_path, i, source, turns) for i in range(SLOTS)]
        kills = [one for slot in slots for one in slot.result()]
    sent = list(source.sent)
    losses = []
    for one in kills:
        kept = kept_after_kill(one.bag, one.bag.with_suffix('.new'))
        assert kept, one.bag
        first = next(n for n, (_, data) in enumerate(sent) if data == kept[0])
        last = first + len(kept)
        # In order, without a gap, and byte for byte equal.
        assert kept == [data for _, data in sent[first:last]]
        assert sent[first][0] < one.subscribed_ns + NANOSECONDS
        lost_ns = one.killed_ns - sent[last][0] if last < len(sent) else 0
        losses.append(max(0, lost_ns) / NANOSECONDS)
    losses.sort()
    print('seconds lost:', ', '.join(f'{loss:.2f}' for loss in losses))
    assert len(losses) == SLOTS * turns
    assert losses[-1] <= ALLOWED
