#!/usr/bin/env python3
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
"""Memory and processor time of the live page's program beside the nodes of a demo.

Usage: view_cost.py [--minutes 30] [--seconds 60]. Counts processor time without a page and with
five readers that ask ten times a second, as pages do, then the memory of each minute with one.
Time in which this process is suspended does not count.
"""

import argparse
from collections.abc import Iterator
from http.client import HTTPConnection
import json
from pathlib import Path
import sys
import tempfile
import time
from urllib.parse import quote

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from bench.recorder_load import processor_time  # noqa: E402
from t3mpc_ros.cli.process_group import PrivateGraph, ProcessGroup  # noqa: E402
from t3mpc_ros.cli.view import PAGE_AT  # noqa: E402

NODES = ('sim_robot', 'reference_generator', 'controller')
PERIOD = 0.1  # time between two requests of a page, s
MAX_STEP = 1.0  # longest time between two steps of this process that counts, s


class Reader:
    """Asks for what is new as a page does."""

    def __init__(self, address: str) -> None:
        self.connection = HTTPConnection(address, timeout=60.0)
        self.last = ''

    def read(self) -> None:
        """Ask until there is nothing more."""
        more = True
        while more:
            self.connection.request('GET', f'/events?last={quote(self.last)}')
            news = json.loads(self.connection.getresponse().read())
            self.last, more = news['id'], news.get('more', False)


def steps(seconds: float) -> Iterator[float]:
    """Yield the time that has counted, s, each :data:`PERIOD`, up to an end."""
    passed, before = 0.0, time.monotonic()
    while passed < seconds:
        time.sleep(PERIOD)
        now = time.monotonic()
        passed += min(now - before, MAX_STEP)
        before = now
        yield passed


def share(pid: int, readers: list[Reader], seconds: float) -> float:
    """Return the share of a core that a process takes while some readers ask."""
    before, passed = processor_time(pid), 0.0
    for now in steps(seconds):
        passed = now
        for each in readers:
            each.read()
    return (processor_time(pid) - before) / passed


def memory(pid: int) -> float:
    """Return the memory that a process has in use, MB."""
    lines = Path(f'/proc/{pid}/status').read_text(encoding='ascii').splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith('VmRSS:'))
    return int(kilobytes) / 1024.0


def measure(pid: int, address: str, seconds: float, minutes: float) -> None:
    """Print what the program costs."""
    if seconds:
        print(f'no page: {share(pid, [], seconds):.1%} of a core', flush=True)
        readers = [Reader(address) for _ in range(5)]
        for each in readers:
            each.read()
        print(f'5 readers: {share(pid, readers, seconds):.1%} of a core', flush=True)
        for each in readers:
            each.connection.close()
    reader, minute = Reader(address), 0
    for passed in steps(60.0 * minutes):
        reader.read()
        if passed >= 60.0 * minute:
            print(f'{minute} min: {memory(pid):.1f} MB', flush=True)
            minute += 1
    print(f'{minutes:g} min: {memory(pid):.1f} MB')


def main() -> int:
    """Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--minutes', type=float, default=30.0, help='of the memory')
    parser.add_argument('--seconds', type=float, default=60.0, help='of each share of a core')
    options = parser.parse_args()
    with PrivateGraph() as graph, tempfile.TemporaryDirectory() as folder:
        processes = ProcessGroup(Path(folder), graph.environment())
        try:
            for name in NODES:
                processes.start(name, parameters={'world': 'room'} if name == 'sim_robot' else {})
            processes.start('view', 'view', '--headless', '--port', '0', program='t3mpc')
            processes.wait_for('view', '(stop with', 120.0)
            processes.wait_for('controller', 'tracking', 600.0)
            text = processes.log('view').read_text(encoding='utf-8')
            address = text[text.index(PAGE_AT) + len(PAGE_AT) :].split()[0]
            time.sleep(10.0)  # discovery
            place = address.removeprefix('http://').rstrip('/')
            measure(processes.pid('view'), place, options.seconds, options.minutes)
        finally:
            processes.end_all()
    return 0


if __name__ == '__main__':
    sys.exit(main())
