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
"""Sections of a report on a patrol: where the robot was, and what contradicts its map."""

from collections.abc import Iterator
import math

import numpy as np

from t3mpc_ros.evaluation.bag_report.diagnostic_history import RecordedChange
from t3mpc_ros.evaluation.bag_report.motion_continuity import gaps
from t3mpc_ros.evaluation.bag_report.recorded_run import Run, Series
from t3mpc_ros.evaluation.bag_report.tracking_errors import on_reference_frame
from t3mpc_ros.evaluation.html_page import Block, Chart, Heading, Line, Paragraph
from t3mpc_ros.evaluation.patrol.patrol_metrics import (
    HORIZONS,
    SHARES,
    SHORTEST,
    CoverageGrid,
    coverage_at,
    patrol_metrics,
    visits,
)
from t3mpc_ros.evaluation.result_output import Table
from t3mpc_ros.evaluation.topic_roles import REFERENCE, TRUTH
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.simulation.world import recorded_world

LEAST_DISTANCE, LEAST_SIZE = 2.0, 0.5
"""Length of the path, and of a side of its bounding box, from which on there is a section, m."""
BODY = 0.11
"""Radius of the robot, m: cells whose centre it cannot reach do not count."""
_SAMPLE = 0.05
"""Least time between two positions that are evaluated, s."""


def followed_reference(run: Run) -> Series | None:
    """Return the reference if the controller follows its positions; None if its speeds alone."""
    reference, motion = run.motions.get(REFERENCE), run.motion
    if motion is None or reference is None or not run.follows_path:
        return None
    return reference if 'x' in reference.values and len(reference) > 1 else None


def patrol_blocks(run: Run) -> Iterator[Block]:
    """Yield the section on coverage; nothing for a robot that hardly left its place."""
    motion = run.motion
    if motion is None or len(motion) < 2:
        return
    rarely = np.concatenate([[True], np.diff(np.floor(motion.time / _SAMPLE)) > 0.0])
    time, x, y = motion.time[rarely], motion['x'][rarely], motion['y'][rarely]
    distance = float(np.hypot(np.diff(x), np.diff(y)).sum())
    if time.size < 2 or distance < LEAST_DISTANCE or max(np.ptp(x), np.ptp(y)) < LEAST_SIZE:
        return
    grid, where = _grid(run, x, y)
    reference = followed_reference(run)
    wanted = None
    if reference is not None:
        inside = (time >= reference.time[0]) & (time <= reference.time[-1])
        wanted = np.column_stack(
            [np.interp(time, reference.time, reference[axis]) for axis in 'xy']
        )
        wanted[~inside] = math.nan
        laid = on_reference_frame(run)
        if laid is not None:  # as far from the robot as it is in its own frame
            wanted += np.column_stack([x - laid['x'][rarely], y - laid['y'][rarely]])
    torn = bool(gaps(motion.time))
    found = patrol_metrics(time, x, y, grid, wanted, whole=not torn)
    entered = f'{100.0 * found["coverage"]:.1f} %'
    rows = [['cells entered', entered]]
    for share in SHARES:
        needed = found[f'time_to_{100.0 * share:g}']
        text = f'after {needed:.1f} s' if math.isfinite(needed) else 'not reached'
        rows.append([f'{100.0 * share:g} % of the cells', text])
    rows.append(['evenness of the time in the cells', f'{found["evenness"]:.3f}'])
    if math.isfinite(found['path_error']):
        rows.append(['path error, root mean square', f'{1e3 * found["path_error"]:.1f} mm'])
    observed = f'skill_{HORIZONS[0]:g}' in found
    for horizon in HORIZONS if observed else ():
        skill, predictor = found[f'skill_{horizon:g}'], found[f'predictor_{horizon:g}']
        rows.append([f'skill of an observer, {horizon:g} s ahead', f'{skill:.3f} ({predictor})'])
        median, known = found[f'prediction_median_{horizon:g}'], found[f'known_{horizon:g}']
        rows.append(
            [
                'median error of it, and share of the moments known to 25 cm',
                f'{median:.2f} m, {100.0 * known:.0f} %',
            ]
        )
    for name, column, unit in (
        ('permutation entropy', 'permutation_entropy', ''),
        ('spectral entropy', 'spectral_entropy', ''),
        ('largest Lyapunov exponent of the path', 'exponent', ' 1/s'),
    ):
        if math.isfinite(found[column]):
            rows.append([name, f'{found[column]:.3f}{unit}'])
    yield Heading('Coverage and predictability')
    yield Table('', ['quantity', 'value'], rows)
    curve = 100.0 * coverage_at(visits(time, x, y, grid), grid, time - time[0])
    seen = f'{entered} of the cells were entered.'
    yield Chart('Coverage', '%', [Line('cells entered', 'c1', time, curve)], seen)
    short = (
        f' Predictability, entropies and exponent need {SHORTEST:g} s without a gap.'
        if not observed
        else ' Skill: an observer learns from the first half of the path and predicts the '
        'second; 1 exact, 0 no better than the mean position.'
    )
    yield Paragraph(
        f'A grid of 20 × 20 cells over {where}; evenness 1: the same time in each.{short}', 'quiet'
    )


def _grid(run: Run, x: Array, y: Array) -> tuple[CoverageGrid, str]:
    """Return the grid over the known room, else over what the robot drove, and which it is."""
    world = recorded_world(run.world) if run.measured == TRUTH else None
    if world is not None and len(world.segments):
        grid = CoverageGrid(*world.bounds())
        centres = grid.centres().tolist()
        blocked = np.array([[not world.is_free(a, b, BODY) for a, b in row] for row in centres])
        if not blocked.all():
            cells = CoverageGrid(grid.low, grid.high, blocked=blocked)
            return cells, f'the room {world.name}, without those that the robot cannot reach'
    low = float(x.min()) - 1e-6, float(y.min()) - 1e-6
    high = float(x.max()) + 1e-6, float(y.max()) + 1e-6
    return CoverageGrid(low, high), 'the bounding box of the path'


def map_change_blocks(changes: tuple[RecordedChange, ...]) -> Iterator[Block]:
    """Yield the section on what contradicts the map; nothing without changes."""
    if not changes:
        return
    yield Heading('What contradicts the map')
    head = ['found / s', 'kind', 'place', 'size', 'confidence', 'seen before', 'seen for', 'state']
    rows = [
        [
            f'{each.found:.1f}', each.kind, f'x {each.x:.2f} m, y {each.y:.2f} m',
            f'{each.size:.2f} m', f'{each.confidence:.2f}', f'{each.seen_before:.1f} s',
            f'{each.seen_for:.1f} s', each.state,
        ]
        for each in changes
    ]  # fmt: skip
    yield Table('', head, rows, text=4)
    yield Paragraph(
        'New: a thing that the map lacks; missing: one that is not where the map has it; moving: '
        'it was seen, and then that it was gone. The place is the middle of what was seen of it. '
        'Withdrawn: the robot was lost, and had not been where it took itself to be.',
        'quiet',
    )
