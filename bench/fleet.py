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
"""Benchmark of a fleet: robots of this machine in one graph, until its cores are full.

    PYTHONPATH=. .venv/bin/python bench/fleet.py [--seconds 20] [LAYOUT:ROBOTS ...]

Each robot is a simulated one with reference, controller and recorder at 100 Hz, in a namespace.
Layouts: ``processes`` (one for each node), ``composed`` (one for each robot), ``domains`` (as
processes, each robot in a ROS domain of its own), ``server`` (as processes, with a discovery
server of Fast DDS). Processor time is that of /proc, which other programs of a busy machine change
little; the times from odometry to command and the rate show whether the cores suffice. The traffic
is that of UDP on the loopback interface, divided by port into discovery and messages; it needs the
right to capture packets (root).
"""

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from typing import NamedTuple

from bench.recorder_load import processor_time
from t3mpc_ros.cli.process_group import PrivateGraph, ProcessGroup

NODES = ('sim_robot', 'reference_generator', 'controller', 'recorder')
LAYOUTS = ('processes', 'composed', 'domains', 'server')
RUNS = (
    *('processes:1', 'processes:2', 'processes:3', 'processes:4'),
    *('composed:1', 'composed:2', 'composed:4', 'composed:6', 'domains:4', 'server:4'),
)
SETTLING = 5.0  # time from the last node's start to the begin of the measurement, s
PORT_BASE, DOMAIN_PORTS = 7400, 250
"""UDP ports of a domain by the DDSI-RTPS specification (9.6.1.1); there the even ones discover."""
SERVER_PORT = 11811
OBSERVER = """
import statistics, sys, time
import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
rclpy.init()
node = rclpy.create_node('observer', namespace=sys.argv[1])
begin, times, count = [], [], [0]
def start(message):
    begin[:] = [time.monotonic()]
    count[0] += 1
def end(message):
    times.extend(time.monotonic() - each for each in begin)
    begin.clear()
node.create_subscription(Odometry, 'odom', start, 10, raw=True)
node.create_subscription(Twist, 'cmd_vel', end, 10, raw=True)
while not times:
    rclpy.spin_once(node, timeout_sec=0.1)
count[0], first = 0, time.monotonic()
times.clear()
while time.monotonic() < first + float(sys.argv[2]):
    rclpy.spin_once(node, timeout_sec=0.1)
times.sort()
late = times[int(0.99 * len(times))]
print(1e3 * statistics.median(times), 1e3 * late, count[0] / float(sys.argv[2]))
"""


class Result(NamedTuple):
    """Figures of one run."""

    layout: str
    robots: int
    processes: int
    cores: float  # processor time of all robots per time
    sim_robot: float
    """The same of one node, mean of the robots; of all nodes of a robot if it is composed."""
    reference_generator: float
    controller: float
    recorder: float
    memory: float  # proportional set size of a robot, MB
    latency: float  # median time from odometry to command, ms
    latency_99: float  # its 99th percentile, ms
    rate: float  # odometry messages a second, of 100
    start_discovery: float  # bytes of discovery until the begin of the measurement, MB
    discovery: float  # bytes of discovery afterwards, kB/s
    messages: float  # bytes of messages, kB/s
    bag: float  # volume of the bag of a robot, MB/h


class Traffic:
    """Counts the UDP bytes on the loopback interface by what they are for."""

    def __init__(self) -> None:
        self.discovery = self.messages = 0
        self._ended = False
        self._thread = threading.Thread(target=self._count, daemon=True)
        try:
            self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.ntohs(0x0800))
            self._socket.bind(('lo', 0))
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
            self._socket.settimeout(0.2)
        except PermissionError:
            return
        self._thread.start()

    def _count(self) -> None:
        packet = bytearray(64)
        while not self._ended:
            try:
                size, address = self._socket.recvfrom_into(packet, 64, socket.MSG_TRUNC)
            except TimeoutError:
                continue
            head = 4 * (packet[0] & 15)
            if packet[9] != socket.IPPROTO_UDP or address[2] == socket.PACKET_OUTGOING:
                continue  # each packet is seen twice
            if int.from_bytes(packet[6:8], 'big') & 0x1FFF:
                self.messages += size  # a later fragment has no port
                continue
            port = int.from_bytes(packet[head + 2 : head + 4], 'big')
            if port >= PORT_BASE:
                even = (port - PORT_BASE) % DOMAIN_PORTS % 2 == 0
                if even or port == SERVER_PORT:
                    self.discovery += size
                else:
                    self.messages += size

    def close(self) -> None:
        """End."""
        self._ended = True
        if self._thread.is_alive():
            self._thread.join()


def memory_of(pid: int) -> float:
    """Return the proportional set size of a process, MB."""
    for line in Path(f'/proc/{pid}/smaps_rollup').read_text().splitlines():
        if line.startswith('Pss:'):
            return int(line.split()[1]) / 1e3
    return float('nan')


def size_of(folder: Path) -> int:
    """Return the bytes of the files of bags."""
    return sum(file.stat().st_size for file in folder.rglob('*.mcap'))


@contextmanager
def discovery_server(environment: dict[str, str]) -> Iterator[None]:
    """Run a discovery server, and make the environment one of its clients."""
    program = shutil.which('fast-discovery-server', path=str(Path(sys.executable).parent))
    assert program, 'fast-discovery-server is not installed'
    environment.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
    command = [program, '-i', '0', '-l', '127.0.0.1', '-p', str(SERVER_PORT)]
    with subprocess.Popen(command, env=dict(environment), stdout=subprocess.DEVNULL) as server:
        environment['ROS_DISCOVERY_SERVER'] = f'127.0.0.1:{SERVER_PORT}'
        environment['FASTDDS_BUILTIN_TRANSPORTS'] = 'UDPv4'
        try:
            yield
        finally:
            server.kill()


def start_robot(processes: ProcessGroup, layout: str, robot: str, bags: Path) -> dict[str, int]:
    """Start the nodes of a robot; return their process ids."""
    ids, seed = {}, 1 + int(robot.rpartition('_')[2])
    programs = ('composed',) if layout == 'composed' else NODES
    for program in programs:
        given: dict[str, object] = {}
        if program in ('recorder', 'composed'):
            given['storage.uri'] = str(bags / robot)
        if program in ('sim_robot', 'reference_generator', 'composed'):
            given['seed'] = seed
        name = f'{robot}_{program}'
        processes.start(
            name, '--ros-args', '-r', f'__ns:=/{robot}', parameters=given, program=program
        )
        ids[program] = processes.pid(name)
    return ids


def run(layout: str, robots: int, seconds: float) -> Result:
    """Return the figures of one run."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        traffic = Traffic()
        stack.callback(traffic.close)
        domains = robots if layout == 'domains' else 1
        environments = [stack.enter_context(PrivateGraph()).environment() for _ in range(domains)]
        if layout == 'server':
            stack.enter_context(discovery_server(environments[0]))
        groups = [
            ProcessGroup(folder / f'log_{number}', environment)
            for number, environment in enumerate(environments)
        ]
        for group in groups:
            stack.callback(group.end_all)
        ids = {}
        for number in range(robots):
            robot, group = f'robot_{number}', groups[number % domains]
            ids[robot] = start_robot(group, layout, robot, folder / 'bags')
            for program in ids[robot]:
                group.wait_for(f'{robot}_{program}', f'{program} ready', 120.0)
        time.sleep(SETTLING)
        command = [sys.executable, '-c', OBSERVER, '/robot_0', str(seconds)]
        observer = subprocess.Popen(
            command, env=environments[0], stdout=subprocess.PIPE, text=True
        )
        stack.callback(observer.kill)
        time.sleep(2.0)
        pids = [(program, pid) for some in ids.values() for program, pid in some.items()]
        start = traffic.discovery
        before = [time.monotonic(), traffic.discovery, traffic.messages, size_of(folder)]
        used = [processor_time(pid) for _, pid in pids]
        time.sleep(seconds)
        after = [time.monotonic(), traffic.discovery, traffic.messages, size_of(folder)]
        used = [processor_time(pid) - one for (_, pid), one in zip(pids, used, strict=True)]
        elapsed, discovery, messages, volume = (b - a for a, b in zip(before, after, strict=True))
        shares = dict.fromkeys(NODES, 0.0)
        for (program, _), one in zip(pids, used, strict=True):
            with suppress(KeyError):
                shares[program] += one / elapsed / robots
        if layout == 'composed':
            shares['sim_robot'] = sum(used) / elapsed / robots
        memory = sum(memory_of(pid) for _, pid in pids) / robots
        latency, latest, rate = map(float, observer.communicate(timeout=120)[0].split())
        return Result(
            layout,
            robots,
            len(pids),
            sum(used) / elapsed,
            *(shares[name] for name in NODES),
            memory,
            latency,
            latest,
            rate,
            start / 1e6,
            discovery / elapsed / 1e3,
            messages / elapsed / 1e3,
            volume / elapsed * 3600.0 / 1e6 / robots,
        )


COLUMNS = (
    *('layout, robots', 'processes', 'cores', 'of it a robot', 'memory of a robot, MB'),
    *('odom to command, ms: median, 99 %', 'Hz', 'discovery until all run, MB'),
    *('discovery then, kB/s', 'messages, kB/s', 'bag of a robot, MB/h'),
)


def format_row(found: Result) -> str:
    """Return a row of the table."""
    cells = (
        f'{found.layout}, {found.robots}',
        f'{found.processes}',
        f'{found.cores:.2f}',
        f'{found.cores / found.robots:.2f}',
        f'{found.memory:.0f}',
        f'{found.latency:.1f}, {found.latency_99:.0f}',
        f'{found.rate:.0f}',
        f'{found.start_discovery:.1f}',
        f'{found.discovery:.0f}',
        f'{found.messages:.0f}',
        f'{found.bag:.0f}',
    )
    return f'| {" | ".join(cells)} |'


def main() -> None:
    """Print the figures of some runs."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--seconds', type=float, default=20.0)
    parser.add_argument('runs', nargs='*', default=RUNS, metavar='LAYOUT:ROBOTS')
    options = parser.parse_args()
    print(f'| {" | ".join(COLUMNS)} |', '|---' * len(COLUMNS) + '|', sep='\n')
    for each in options.runs:
        layout, _, robots = each.partition(':')
        if layout not in LAYOUTS:
            parser.error(f'a layout is one of {", ".join(LAYOUTS)}: got {layout}')
        result = run(layout, int(robots), options.seconds)
        print(format_row(result), flush=True)


if __name__ == '__main__':
    main()
