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
"""Print the branch coverage of each package of t3mpc_ros; exit with 1 if one is below its bound.

Usage: coverage_report.py DATA [DATA ...], files of coverage.py whose results are joined. Compiled
kernels are invisible: they are counted in a run with NUMBA_DISABLE_JIT=1. The data of a check is
measured by ``T3MPC_COVERAGE=DATA scripts/check``.
"""

from collections import defaultdict
import json
from pathlib import Path
import sys
import tempfile

from coverage import Coverage

BOUNDS = dict.fromkeys(
    (
        'bag', 'chaos', 'control', 'evaluation', 'fuzzy', 'geometry', 'mpc', 'parameters', 'radio',
        'robot',
    ), 90.0
)  # fmt: skip
OTHERS = 80.0
"""Least coverage of every other package, %."""


def main(arguments: list[str]) -> int:
    """Print the table; return the exit code."""
    with tempfile.TemporaryDirectory() as folder:
        joined = Coverage(data_file=f'{folder}/joined')
        joined.combine(arguments, keep=True)
        joined.json_report(outfile=f'{folder}/report.json')
        files = json.loads(Path(f'{folder}/report.json').read_text())['files']
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    for name, entry in files.items():
        parts = name.partition('t3mpc_ros/')[2].split('/')
        found, package = entry['summary'], parts[0] if len(parts) > 1 else '(root)'
        for key in (package, 'all'):
            counts[key][0] += found['num_statements'] + found['num_branches']
            counts[key][1] += found['covered_lines'] + found['covered_branches']
            counts[key][2] += found['num_statements']
    low = []
    print('package       lines  covered %  bound %')
    for package, (possible, covered, lines) in sorted(counts.items()):
        share = 100.0 * covered / max(possible, 1)
        bound = 0.0 if package == 'all' else BOUNDS.get(package, OTHERS)
        print(f'{package:12} {lines:6} {share:9.1f} {bound or "":>8}')
        if share < bound:
            low.append(f'{package} {share:.1f} % < {bound:.0f} %')
    if low:
        print(f'coverage is too low: {", ".join(low)}', file=sys.stderr)
    return 1 if low else 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
