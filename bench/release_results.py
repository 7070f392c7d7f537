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
"""The runs behind the published numbers, one row a run in one file of a release.

Usage: release_results.py FILE.csv [--quick] [--workers N]. A row has seed, settings, metrics,
version, commit and processor. Two hours on two cores; the parts that are done are kept beside the
file, so that it can be interrupted. --quick makes few seeds and short runs, which takes minutes.
"""

import argparse
import csv
import os
from pathlib import Path
import shutil
import sys

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from t3mpc_ros.cli.main import main as t3mpc  # noqa: E402

SEEDS = {'torque': '2001-2006', 'servo': '2001-2006', 'twin': '7001-7006'}
"""Seeds of the comparison on each robot, which are in no other table."""


def parts(folder: Path, *, quick: bool) -> dict[Path, list[str]]:
    """Return the command of each part by the file that it writes."""
    few = ['--seeds', '2001-2001', '--duration', '6', '--cases', 'nominal'] if quick else []
    paper = ['--quick', '--seeds', '101-101', '--estimation-seeds', '1-1'] if quick else []
    found = {folder / 'paper' / 'runs.csv': ['paper', '--output', str(folder / 'paper'), *paper]}
    for robot, seeds in SEEDS.items():
        file = folder / f'{robot}.csv'
        command = ['compare', '--robot', robot, '--seeds', seeds, '--csv', str(file)]
        found[file] = [*command, *few]
    return found


def main() -> int:
    """Make the parts that are missing and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('file', type=Path, metavar='FILE.csv')
    parser.add_argument('--quick', action='store_true', help='few seeds and short runs: a check')
    parser.add_argument('--workers', default=str(len(os.sched_getaffinity(0))), help='processes')
    options = parser.parse_args()
    folder = options.file.with_suffix('.parts')
    rows: list[dict[str, str]] = []
    for file, command in parts(folder, quick=options.quick).items():
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            if code := t3mpc([*command, '--workers', options.workers]):
                return code
        with file.open(encoding='utf-8', newline='') as stream:
            study = 'paper' if command[0] == 'paper' else 'compare'
            rows += [{'study': study, **row} for row in csv.DictReader(stream)]
    names = dict.fromkeys(name for row in rows for name in row)
    with options.file.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.DictWriter(stream, [*names], lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows)
    shutil.rmtree(folder)
    print(f'{len(rows)} runs: {options.file}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
