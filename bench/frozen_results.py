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
"""Published results, frozen: compute them anew, and compare them with those in ``bench/frozen``.

Usage: frozen_results.py [--update | --sample RUNS] [NAME ...]; by default all names, which takes
an hour or more. --sample makes only so many runs of the frozen comparisons, some minutes for 60.
A change that is to change no number runs this before it lands; the exit code is 1 if a number, a
text or a key differs. --update writes the file instead: then the commit says why, with the old and
the new values.
"""

import argparse
from collections.abc import Callable, Iterator
import dataclasses
import hashlib
import json
import math
from pathlib import Path
import random
import sys
import tempfile

BENCH = Path(__file__).resolve().parent
ROOT = BENCH.parent
FROZEN = BENCH / 'frozen'
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

from support import robot_bags  # noqa: E402

from t3mpc_ros.bag.reader import open_bag  # noqa: E402
from t3mpc_ros.cli.main import main as t3mpc  # noqa: E402
from t3mpc_ros.evaluation.bag_report.metrics import compute_metrics  # noqa: E402
from t3mpc_ros.evaluation.bag_report.recorded_run import load_run  # noqa: E402
from t3mpc_ros.evaluation.cases import ROBOTS  # noqa: E402
from t3mpc_ros.evaluation.experiment import measured_run  # noqa: E402
from t3mpc_ros.evaluation.method_table import methods_for  # noqa: E402
from t3mpc_ros.evaluation.process_replay.controller_inputs import load_inputs  # noqa: E402
from t3mpc_ros.evaluation.process_replay.controller_replay import replay_controller  # noqa: E402
from t3mpc_ros.evaluation.scenario import Scenario  # noqa: E402

IGNORED = ('version', 'sources', 'origin', 'step_time_us')
"""Keys that say which code it was, on which machine."""


def command(*words: str, written: str = '') -> object:
    """Return the JSON of a command of ``t3mpc``: of --json, or ``written`` to its folder."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, written or 'results.json')
        options = ['--output', folder] if written or words[0] == 'paper' else []
        options += [] if written else ['--json', str(file)]
        if t3mpc([*words, *options]):
            raise RuntimeError(f't3mpc {" ".join(words)} failed')
        return json.loads(file.read_text())


def golden_replays() -> object:
    """Return a digest of each recomputed field of each golden bag."""
    return {
        bag.stem: {
            name: hashlib.sha256(values.tobytes()).hexdigest()
            for name, values in replay_controller(load_inputs(bag)).fields.items()
        }
        for bag in sorted((ROOT / 'test' / 'golden').glob('*.mcap'))
    }


def reports() -> object:
    """Return the metrics of the reports of ten bags: golden, of other robots, of a demo."""
    golden = {bag.stem: bag for bag in sorted((ROOT / 'test' / 'golden').glob('*.mcap'))}
    rows = {
        'slow robot': robot_bags.following_rows(),
        'stands still': robot_bags.following_rows(offset=lambda t: -0.2 * (t > 8.0)),
        'drifts': robot_bags.following_rows(offset=lambda t: 0.002 * t),
        'at 10 Hz': robot_bags.following_rows(rate=10.0),
        'turned start': robot_bags.following_rows(pose=(1.0, -2.0, 2.5)),
        'without reference': [
            row for row in robot_bags.following_rows() if row[1] != '/reference'
        ],
    }
    with tempfile.TemporaryDirectory() as folder:
        written = {
            name: robot_bags.write(Path(folder, name.replace(' ', '_')), each)
            for name, each in rows.items()
        }
        bags = {**golden, **written, 'demo': FROZEN / 'demo.mcap'}
        return {name: metrics_of(bag) for name, bag in bags.items()}


def metrics_of(bag: Path) -> object:
    """Return the metrics of a report as plain data."""
    with open_bag(bag) as recording:
        run = load_run(recording)
        found = dict(vars(compute_metrics(run, Path('report.html'), 0)))
    del found['run']
    of_run = ('duration', 'measured', 'channels', 'absent')
    found |= {name: getattr(run, name) for name in of_run}
    return plain({**found, 'switches': run.switches.size})


def plain(value: object) -> object:
    """Return data that JSON can hold; numbers that are not finite by their names."""
    if dataclasses.is_dataclass(value):
        return {each.name: plain(getattr(value, each.name)) for each in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else repr(value)
    return value if isinstance(value, int | str | None) else str(value)


def vectors() -> object:
    """Return digests of the golden bags and of the vectors of the radio protocol."""
    files = sorted((ROOT / 'test' / 'golden').iterdir())
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


SEEDS = 4
"""Of the 20 held-out seeds of the paper's results; twelve are in docs/results_tables.md, to
the digits that are printed there."""
RESULTS: dict[str, Callable[[], object]] = {
    'vectors': vectors,
    'golden_replays': golden_replays,
    'reports': reports,
    'tracking': lambda: command(
        'patrol', '--tracking', '--seeds', '101-102', written='tracking.json'
    ),
    'patrol': lambda: command(
        'patrol', '--seeds', '101-102', '--minutes', '6', written='patrol.json'
    ),
    'patrol_twin': lambda: command(
        'patrol', '--robot', 'twin', '--seeds', '101-101', '--minutes', '3', written='patrol.json'
    ),
    'faults': lambda: command('faults'),
    'compare_twin': lambda: command('compare', '--seeds', '201-202'),
    'compare_servo': lambda: command('compare', '--robot', 'servo', '--seeds', '201-202'),
    'compare_torque': lambda: command('compare', '--robot', 'torque', '--seeds', '201-202'),
    'paper': lambda: command('paper', '--seeds', f'101-{100 + SEEDS}'),
}


def sample(count: int) -> Iterator[tuple[str, object, object]]:
    """Yield what differs in ``count`` runs of the frozen comparisons, spread over all of them."""
    runs = []
    for robot in ROBOTS:
        frozen = json.loads((FROZEN / f'compare_{robot}.json').read_text())
        first, last = frozen['seeds']
        runs += [
            (Scenario(robot, case, seed, frozen['duration']), name, each['runs'][seed - first])
            for case, cell in frozen['cases'].items()
            for name, each in cell['methods'].items()
            for seed in range(first, last + 1)
        ]
    for scenario, name, old in random.Random(count).sample(runs, count):
        numbers = measured_run((scenario, methods_for(scenario.robot)[name]))
        print(f'{scenario}, {name}', flush=True)
        del old['seed']
        new = {key: value for key, value in numbers.items() if key in old}
        yield from differences(old, new, f'/{scenario}/{name}')


def differences(old: object, new: object, where: str = '') -> Iterator[tuple[str, object, object]]:
    """Yield place, old and new value of whatever differs."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            if key not in IGNORED:
                yield from differences(old.get(key), new.get(key), f'{where}/{key}')
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, pair in enumerate(zip(old, new, strict=True)):
            yield from differences(*pair, f'{where}/{index}')
    elif old != new:
        yield where, old, new


def compare(name: str, new: object) -> bool:
    """Print how a result differs from the frozen one; return whether it does."""
    frozen = json.loads((FROZEN / f'{name}.json').read_text())
    return print_differences(name, [*differences(frozen, new)])


def print_differences(name: str, found: list[tuple[str, object, object]]) -> bool:
    """Print what differs; return whether anything does."""
    numbers = [
        (abs(b - a), abs(b - a) / max(abs(a), 1e-300), place)
        for place, a, b in found
        if isinstance(a, int | float) and isinstance(b, int | float)
    ]
    if not found:
        print(f'{name}: equal to the last bit')
        return False
    for place, a, b in found[:10]:
        print(f'  {place}: {a} -> {b}')
    print(f'{name}: {len(found)} differ, {len(numbers)} of them numbers')
    if numbers:
        absolute, relative = max(numbers), max(numbers, key=lambda each: each[1])
        print(f'  largest difference {absolute[0]:.3g} in {absolute[2]}')
        print(f'  largest relative difference {relative[1]:.3g} in {relative[2]}')
    return True


def main() -> int:
    """Return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('names', nargs='*', metavar='NAME', help=', '.join(RESULTS))
    parser.add_argument('--update', action='store_true')
    parser.add_argument('--sample', type=int, metavar='RUNS')
    options = parser.parse_args()
    if options.sample:
        return int(print_differences('sample', [*sample(options.sample)]))
    if unknown := {*options.names} - {*RESULTS}:
        parser.error(f'unknown: {", ".join(sorted(unknown))}; there are {", ".join(RESULTS)}')
    differs = False
    for name in options.names or RESULTS:
        result = json.loads(json.dumps(RESULTS[name]()))
        if options.update:
            FROZEN.mkdir(exist_ok=True)
            text = json.dumps(result, indent=0, ensure_ascii=False)
            (FROZEN / f'{name}.json').write_text(text + '\n', encoding='utf-8')
            print(f'{name}: written, {len(text)} characters')
        else:
            differs |= compare(name, result)
    return int(differs)


if __name__ == '__main__':
    sys.exit(main())
