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
"""Benchmark of the nodes: processor time and latency beside a bare echo node of rclpy.

    PYTHONPATH=.:test .venv/bin/python bench/node_cost.py [--seconds 40] [--runs 3]

Generator, controller, simulated robot and recorder at 100 Hz, as the demo starts them, and in the
same graph a node that answers each odometry message with a Twist and does nothing else. The first
half of a run counts processor time. Then an observer takes the time from each odometry message to
the command of the controller while the echo is suspended, and to the answer of the echo while the
controller is: both wake at once, and the second of them would wait for the first.
"""

import argparse
import os
from pathlib import Path
import signal
import statistics
import subprocess
import sys
import tempfile
import time

from bench.recorder_load import processor_time
from t3mpc_ros.cli.process_group import PrivateGraph, ProcessGroup

NODES = ('sim_robot', 'reference_generator', 'controller', 'recorder')
ECHO = """
import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
rclpy.init()
node = rclpy.create_node('echo')
answers = node.create_publisher(Twist, 'answer', 1)
answer = Twist()
node.create_subscription(Odometry, 'odom', lambda message: answers.publish(answer), 1)
rclpy.spin(node)
"""
OBSERVER = """
import statistics, sys, time
import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
rclpy.init()
node = rclpy.create_node('observer')
begin, times = [], []
def start(message):
    begin[:] = [time.monotonic()]
def end(message):
    times.extend(time.monotonic() - each for each in begin)
    begin.clear()
node.create_subscription(Odometry, 'odom', start, 1, raw=True)
node.create_subscription(Twist, sys.argv[1], end, 1, raw=True)
last = time.monotonic() + float(sys.argv[2])
while time.monotonic() < last:
    rclpy.spin_once(node, timeout_sec=0.1)
print(1e3 * statistics.median(times))
"""


def run(folder: Path, seconds: float) -> dict[str, float]:
    """Return the shares of a core, and the median latencies in ms, of one run."""
    with PrivateGraph() as graph:
        environment = graph.environment()
        processes = ProcessGroup(folder / 'log', environment)
        program = [sys.executable, '-c']
        echo = subprocess.Popen([*program, ECHO], env=environment)
        try:
            for name in NODES:
                storage = {'storage.uri': str(folder / 'bag')} if name == 'recorder' else None
                processes.start(name, parameters=storage)
            for name in NODES:
                processes.wait_ready(name)
            time.sleep(5.0)  # discovery, first seconds of the run
            pids = {'echo': echo.pid} | {name: processes.pid(name) for name in NODES}
            begin, before = time.monotonic(), {n: processor_time(p) for n, p in pids.items()}
            time.sleep(seconds / 2)
            elapsed = time.monotonic() - begin
            found = {n: (processor_time(p) - before[n]) / elapsed for n, p in pids.items()}
            for name, topic, other in (
                ('command_ms', 'cmd_vel', 'echo'),
                ('answer_ms', 'answer', 'controller'),
            ):
                os.kill(pids[other], signal.SIGSTOP)
                arguments = [*program, OBSERVER, topic, str(seconds / 4)]
                found[name] = float(subprocess.check_output(arguments, env=environment))
                os.kill(pids[other], signal.SIGCONT)
            return found
        finally:
            processes.stop_all()
            echo.kill()
            echo.wait()


def main() -> None:
    """Print the medians of some runs."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--seconds', type=float, default=40.0)
    parser.add_argument('--runs', type=int, default=3)
    options = parser.parse_args()
    results = []
    for number in range(options.runs):
        with tempfile.TemporaryDirectory() as folder:
            results.append(run(Path(folder), options.seconds))
        print(number + 1, {key: round(value, 4) for key, value in results[-1].items()})
    found = {key: statistics.median(each[key] for each in results) for key in results[0]}
    print('', '| node | share of a core | of the echo |', '|---|---|---|', sep='\n')
    for name in ('echo', *NODES):
        print(f'| {name} | {100 * found[name]:.1f} % | {found[name] / found["echo"]:.1f} |')
    print('', f'odom to command: {found["command_ms"]:.2f} ms', sep='\n')
    print(f'odom to answer of the echo: {found["answer_ms"]:.2f} ms')


if __name__ == '__main__':
    main()
