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
"""Where the settled error of the wheels on the twin comes from: zero crossings and microsteps.

``python bench/zero_crossings.py``: a table in Markdown. For the controller of the node, nominal
case, the settled error with shares of its power: of a wheel that is slower than ``SLOW`` or was so
within ``RINGS``, of a wheel of which the other one was, and of all other samples. Then the same
with coarser microsteps, and with deadbands of the commands (``wheel.deadband_velocity``).
"""

import argparse
from dataclasses import replace

import numpy as np

from t3mpc_ros.evaluation.experiment import map_jobs
from t3mpc_ros.evaluation.loop import run
from t3mpc_ros.evaluation.method_table import FULL, methods_for
from t3mpc_ros.evaluation.result_output import Table
from t3mpc_ros.evaluation.run_record import RATE, START, measure
from t3mpc_ros.evaluation.scenario import OwnParts, Scenario

SLOW = 0.05  # rad/s
RINGS = 0.4
"""Time for which the rotor of a wheel rings after a zero crossing, s: three of its periods."""
LEFT_OUT = 0.02, 0.055, 0.08  # deadbands of the commands, rad/s
MICROSTEPS = 16, 8
"""Per full step; the robot has 16."""


def measured(job: tuple[int, int, float]) -> tuple[float, float, list[float]]:
    """Return settled error, variation, and the shares of the power of a seed."""
    seed, microsteps, left_out = job
    own = OwnParts(robot_parameters={'motor.microsteps': microsteps})
    scenario = Scenario('twin', 'nominal', seed, own=own)
    method = methods_for('twin')[FULL]
    changes = {**method.changes, 'wheel.deadband_velocity': left_out}
    record = run(scenario, replace(method, changes=changes))
    counted = record.counted(START, record.settling)[:, None]
    slow = np.abs(record.reference) < SLOW
    window = np.ones(round(RINGS * RATE) + 1, dtype=np.bool_)
    near = np.column_stack([np.convolve(each, window)[: len(slow)] > 0 for each in slow.T])
    power = counted * record.error**2
    parts = near, near[:, ::-1] & ~near, ~near & ~near[:, ::-1]
    shares = [float(power[part].sum() / power.sum()) for part in parts]
    numbers = measure(record)
    return numbers['settled'], numbers['variation'], shares


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--seeds', type=int, default=12, help='number, from 4001 on (default 12)')
    parser.add_argument('--workers', type=int, default=1, help='processes (default 1)')
    options = parser.parse_args()
    cases = [(f'{steps} microsteps', steps, 0.0) for steps in MICROSTEPS]
    cases += [(f'deadband {speed:g} rad/s', MICROSTEPS[0], speed) for speed in LEFT_OUT]
    seeds = range(4001, 4001 + options.seeds)
    jobs = [(seed, steps, speed) for _, steps, speed in cases for seed in seeds]
    found = map_jobs(measured, jobs, options.workers)
    rows = []
    for number, (name, *_) in enumerate(cases):
        runs = found[number * len(seeds) : (number + 1) * len(seeds)]
        settled, variation, shares = (np.mean(each, axis=0) for each in zip(*runs, strict=True))
        cells = (f'{100.0 * share:.0f}' for share in shares)
        rows.append([name, f'{settled:.4f}', f'{variation:.1f}', *cells])
    head = 'commands and board', 'settled, rad/s', 'variation, rad/s³'
    parts = 'own crossing, %', 'crossing of the other wheel, %', 'rest, %'
    print(Table(f'{len(seeds)} seeds from 4001', [*head, *parts], rows).markdown())


if __name__ == '__main__':
    main()
