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
"""Records what a command of the checkout prints, with which docs/numbers.yaml compares a page.

    .venv/bin/python bench/record.py docs/measured/speed.txt bench/simulation_speed.py
    .venv/bin/python bench/record.py docs/measured/tracking.txt t3mpc patrol --tracking

The record begins with command, version, commit, date, machine, duration, and the load average of
the machine before and after.
"""

from datetime import UTC, datetime
import os
from pathlib import Path
import subprocess
import sys
import time

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from t3mpc_ros.parameters.version_and_commit import machine, provenance  # noqa: E402


def main() -> int:
    """Run the command, write the record if it succeeds, and return its exit code."""
    if len(sys.argv) < 3:
        print(__doc__, file=sys.stderr)
        return 2
    file, *command = sys.argv[1:]
    before, begin, lines = os.getloadavg()[0], time.monotonic(), []
    origin = provenance() | machine()
    python = Path(sys.executable)
    started = (
        [python.with_name('t3mpc'), *command[1:]] if command[0] == 't3mpc' else [python, *command]
    )
    paths = os.pathsep.join([str(ROOT), str(ROOT / 'test')])
    with subprocess.Popen(
        started,
        stdout=subprocess.PIPE,
        text=True,
        encoding='utf-8',
        env=os.environ | {'PYTHONPATH': paths, 'PYTHONUNBUFFERED': '1'},
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end='', flush=True)
            lines.append(line.rstrip())
    if process.returncode:
        return process.returncode
    if '--output' in command:
        at = command.index('--output')
        del command[at : at + 2]  # where files go does not change what is measured
    head = {
        'command': ' '.join(f'"{word}"' if ' ' in word else word for word in command),
        **origin,
        'date': datetime.now(UTC).date().isoformat(),
        'duration': f'{time.monotonic() - begin:.0f} s',
        'load': f'{before:.1f} before, {os.getloadavg()[0]:.1f} after',
    }
    text = [*(f'{name}: {value}' for name, value in head.items()), '', *lines, '']
    Path(file).write_text('\n'.join(text), encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
