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
"""Tools that the README does not ask for: the way to skip without one, and the list of them.

A run of pytest ends with what was missing and the command that installs it. Runs with the same
``T3MPC_MISSING_TOOLS``, a file, leave the list to ``python missing_tools.py FILE``.
"""

from collections import Counter
import os
from pathlib import Path
import shutil
import sys

import pytest

REASON = 'not installed: '
"""Begin of the reason: of a worker process, the one that writes the list sees nothing else."""
INSTALL = {
    'make': 'apt-get install make',
    'gcc': 'apt-get install gcc libc6-dev',
    'C compiler': 'apt-get install gcc libc6-dev',
    'avr-gcc': 'apt-get install gcc-avr avr-libc binutils-avr',
    'simavr': 'apt-get install simavr',
    'libsimavr-dev': 'apt-get install libsimavr-dev',
    'libelf-dev': 'apt-get install libelf-dev',
    'chromium': 'apt-get install chromium',
    'chromedriver': 'apt-get install chromium-driver',
    'node': 'apt-get install nodejs',
    'npm': 'apt-get install npm',
    'packages of npm': 'a connection to the registry of npm',
}
"""What makes the skipped tests run."""
HEADERS = {
    'libsimavr-dev': Path('/usr/include/simavr/sim_avr.h'),
    'libelf-dev': Path('/usr/include/libelf.h'),
}
AVR = ('make', 'gcc', 'avr-gcc', 'libsimavr-dev', 'libelf-dev')
"""What builds the firmware and the simulator of its boards."""


def find(name):
    """Return the path of a tool; None if it is not installed."""
    if name in HEADERS:
        return HEADERS[name] if HEADERS[name].exists() else None
    names = [name]
    if name == 'C compiler':
        names = [os.environ['CC']] if os.environ.get('CC') else ['cc', 'gcc', 'clang']
    elif name == 'go':  # where its own archive installs it
        names.append('/usr/local/go/bin/go')
    return next(filter(None, map(shutil.which, names)), None)


def skip(*names):
    """Skip the running test: these are not there."""
    assert {*names} <= {*INSTALL}
    pytest.skip(REASON + ', '.join(names))


def needs(*names):
    """Skip the running test unless all tools are there."""
    if missing := [name for name in names if not find(name)]:
        skip(*missing)


def needing(*names):
    """Return the mark of tests that need all of the tools."""
    assert {*names} <= {*INSTALL}
    missing = [name for name in names if not find(name)]
    return pytest.mark.skipif(bool(missing), reason=REASON + ', '.join(missing))


def list_missing(terminal):
    """List what was missing, at the end of a run; or note it for a list at the end of several."""
    if hasattr(terminal.config, 'workerinput'):
        return  # the main process has the reports of all workers
    skipped = Counter()
    for report in terminal.stats.get('skipped', []):
        _, found, names = report.longrepr[2].partition(REASON)
        skipped.update(names.split(', ') if found else [])
    if notes := os.environ.get('T3MPC_MISSING_TOOLS'):
        with Path(notes).open('a', encoding='utf-8') as file:
            file.writelines(f'{name}\n' for name in skipped.elements())
    elif skipped:
        terminal.section('skipped, as not installed')
        terminal.write_line('\n'.join(lines_of(skipped)))


def lines_of(skipped):
    """Return a line for each tool: how many tests were skipped, and what installs it."""
    return [
        f'not installed: {name}, {count} test{"s" * (count > 1)} skipped; remedy: {INSTALL[name]}'
        for name, count in sorted(skipped.items())
    ]


if __name__ == '__main__':
    for line in lines_of(Counter(Path(sys.argv[1]).read_text(encoding='utf-8').splitlines())):
        print(line, file=sys.stderr)
