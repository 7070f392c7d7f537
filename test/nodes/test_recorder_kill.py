# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recorders killed with -9 at random moments of a 100 Hz run: what recovery brings back."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
import random
import threading
import time

from nav_msgs.msg import Odometry
import pytest
import rclpy
from rclpy.serialization import serialize_message

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.bag.recovery.recover_bag import recover_bag
from t3mpc_ros.cli.process_group import ProcessGroup, private_graph
from t3mpc_ros.geometry.types import NANOSECONDS
from t3mpc_ros.nodes.common import qos

pytestmark = [pytest.mark.ros, pytest.mark.slow]

RATE = 100.0
SLOTS, TURNS = 5, 4
ALLOWED = 1.0
"""Seconds before the kill that may be lost."""


class Source:
    """Publishes numbered odometry at 100 Hz from a thread of its own, and keeps what it sent."""

    def __init__(self):
        self._node = rclpy.create_node('source')
        self._publisher = self._node.create_publisher(Odometry, 'odom', qos.STREAM)
        self._stop = threading.Event()
        self.sent = []
        """(time of sending in ns, serialised message)"""
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def is_heard_in(self, namespace):
        """Return whether a node of this namespace listens."""
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


def wait_until(met, seconds=30.0):
    deadline = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < deadline, 'it did not come about in time'
        time.sleep(0.02)


@dataclass
class Killed:
    """A recorder that was killed: its bag, and when it was listening and when it died, in ns."""

    bag: Path
    heard_ns: int
    killed_ns: int


def kill_one_after_the_other(root, slot, source):
    """Return what came of some recorders, each started, let run for a random time, and killed."""
    rng = random.Random(100 + slot)
    result = []
    for turn in range(TURNS):
        name = f'slot_{slot}_{turn}'
        fleet = ProcessGroup(root / f'log_{name}', private_graph())
        bag = root / name
        try:
            fleet.start(
                'recorder',
                *('--ros-args', '-r', f'__ns:=/{name}'),
                parameters={'folder': str(bag), 'topics': ['/odom']},
            )
            fleet.wait_ready('recorder')
            wait_until(lambda name=name: source.is_heard_in(f'/{name}'))
            heard_ns = time.time_ns()
            time.sleep(rng.uniform(2.0, 5.0))
            killed_ns = time.time_ns()
        finally:
            fleet.kill('recorder')
        result.append(Killed(bag, heard_ns, killed_ns))
    return result


def kept_after_kill(folder: Path, output: Path):
    """Return the odometry messages that recovery finds in a bag, as they were serialised."""
    result = recover_bag(folder, output)
    assert not result.clean  # a killed recorder's file has no end
    with open_bag(output) as recording:
        assert recording.message_count == result.kept
        (odom,) = (item for item in recording._reader.connections if item.topic == '/odom')
        return [bytes(data) for _, _, data in recording._reader.messages([odom])]


def test_20_kills_lose_at_most_one_second_each(source, tmp_path):
    with ThreadPoolExecutor(SLOTS) as pool:
        slots = [pool.submit(kill_one_after_the_other, tmp_path, i, source) for i in range(SLOTS)]
        kills = [one for slot in slots for one in slot.result()]
    sent = list(source.sent)
    losses = []
    for one in kills:
        kept = kept_after_kill(one.bag, one.bag.with_suffix('.new'))
        assert kept, one.bag
        first = next(n for n, (_, data) in enumerate(sent) if data == kept[0])
        last = first + len(kept)
        # In order, without a hole, byte for byte, and nothing that was not sent.
        assert kept == [data for _, data in sent[first:last]]
        assert sent[first][0] < one.heard_ns + NANOSECONDS
        lost_ns = one.killed_ns - sent[last][0] if last < len(sent) else 0
        losses.append(max(0, lost_ns) / NANOSECONDS)
    losses.sort()
    print('seconds lost:', ', '.join(f'{loss:.2f}' for loss in losses))
    assert len(losses) == 20
    assert losses[-1] <= ALLOWED
