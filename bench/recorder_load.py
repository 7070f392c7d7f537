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
"""Benchmark of the recorder: lost messages and processor time at a high message rate.

    PYTHONPATH=. .venv/bin/python bench/recorder_load.py [--seconds 60] [--topics 20]
        [--rate 100]

A publisher and the recorder run as separate processes over DDS on loopback. Half of the topics
are Odometry (about 0.7 kB), half Float64; each message contains its number. The output is the
number of messages sent, recorded and lost, and the processor time of the recorder (user and
system, all threads) as a fraction of one core, from the first to the last message.
``test/nodes/test_recorder_process.py`` runs a short benchmark and asserts that nothing is lost.
"""

import argparse
from dataclasses import dataclass
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.cli.process_group import PrivateGraph, ProcessGroup

FIELDS = {
    'nav_msgs/msg/Odometry': 'pose.pose.position.x',
    'std_msgs/msg/Float64': 'data',
}
DEPTH = 1000  # history depth of the publishers, which covers delays of the recorder


@dataclass(frozen=True)
class BenchmarkResult:
    """Result of one run."""

    sent: int
    recorded: int
    in_order: bool
    """Whether every message of each topic was recorded once, in the order of publication."""
    share: float  # processor time of the recorder per elapsed time, 1 = one core
    seconds: float
    size: int  # bytes of the bag


def processor_time(pid: int) -> float:
    """Return the processor time of a process, user and system, s."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def run(
    folder: Path, processes: ProcessGroup, seconds: float, topics: int = 20, rate: float = 100.0
):
    """Return the :class:`BenchmarkResult` of one recording in ``folder``."""
    from support.waiting import communicate  # the publisher, a script, has no such package

    processes.start(
        'recorder', parameters={'storage.uri': str(folder), 'record.topics': ['bench/*']}
    )
    processes.wait_ready('recorder')
    pid = processes.pid('recorder')
    command = [sys.executable, __file__, '--publish', '--seconds', str(seconds)]
    command += ['--topics', str(topics), '--rate', str(rate)]
    publisher = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=processes._environment
    )
    try:
        assert publisher.stdout.readline() == 'begin\n'
        begin, used = time.monotonic(), processor_time(pid)
        assert publisher.stdout.readline() == 'end\n'
        elapsed, used = time.monotonic() - begin, processor_time(pid) - used
        sent = int(communicate(publisher)[0])
    finally:
        publisher.kill()
        publisher.wait()
    code = processes.stop('recorder')
    assert code == 0, f'the recorder ended with code {code}'
    recorded, in_order = 0, True
    with open_bag(folder) as reader:
        for name, topic in reader.topics.items():
            recorded += topic.message_count
            numbers = reader.series(name, {'n': FIELDS[topic.type_name]})['n']
            in_order &= numbers.tolist() == list(range(sent // topics))
    size = sum(path.stat().st_size for path in folder.glob('*.mcap'))
    return BenchmarkResult(sent, recorded, in_order, used / elapsed, elapsed, size)


def publish(seconds: float, topics: int, rate: float) -> None:
    """Publish on all topics, evenly over each period, after all of them have a subscriber."""
    from nav_msgs.msg import Odometry
    import rclpy
    from rclpy.duration import Duration
    from rclpy.node import Node
    from std_msgs.msg import Float64

    rclpy.init(args=[])
    node = Node('bench')
    kinds = [Odometry if i % 2 else Float64 for i in range(topics)]
    publishers = [node.create_publisher(k, f'bench/n{i}', DEPTH) for i, k in enumerate(kinds)]
    while not all(publisher.get_subscription_count() for publisher in publishers):
        time.sleep(0.1)
    time.sleep(1.0)  # discovery is complete on both sides
    messages = [kind() for kind in kinds]
    print('begin', flush=True)
    count = round(seconds * rate)
    begin = time.monotonic()
    for number in range(count):
        for i, publisher in enumerate(publishers):
            if kinds[i] is Float64:
                messages[i].data = float(number)
            else:
                messages[i].pose.pose.position.x = float(number)
            publisher.publish(messages[i])
            if i % 5 == 4:  # in bursts of five, as from an executor
                due = begin + (number + (i + 1) / topics) / rate
                time.sleep(max(0.0, due - time.monotonic()))
    print('end', flush=True)
    for publisher in publishers:
        publisher.wait_for_all_acked(Duration(nanoseconds=10**10))
    print(count * topics, flush=True)
    rclpy.try_shutdown()


def main() -> int:
    """Run one benchmark and print its result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--topics', type=int, default=20)
    parser.add_argument('--rate', type=float, default=100.0)
    parser.add_argument('--publish', action='store_true', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.publish:
        publish(options.seconds, options.topics, options.rate)
        return 0
    with tempfile.TemporaryDirectory() as folder, PrivateGraph() as graph:
        processes = ProcessGroup(Path(folder) / 'log', graph.environment())
        found = run(Path(folder) / 'bag', processes, options.seconds, options.topics, options.rate)
    print(f'sent      {found.sent} in {found.seconds:.1f} s, {found.sent / found.seconds:.0f}/s')
    print(f'recorded  {found.recorded}, in order and complete: {found.in_order}')
    print(f'lost      {found.sent - found.recorded}')
    print(f'processor {100 * found.share:.1f} % of one core')
    print(f'bag       {found.size / 1e6:.1f} MB')
    return 0


if __name__ == '__main__':
    sys.exit(main())
