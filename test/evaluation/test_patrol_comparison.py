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
"""``t3mpc patrol``: runs, claims, tables, page."""

from dataclasses import fields, replace
import json
import math

import numpy as np
import pytest
from support.unrendered import unrendered  # noqa: F401 - a fixture

from t3mpc_ros.cli.main import main
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.patrol import patrol_comparison
from t3mpc_ros.evaluation.patrol.patrol_metrics import CoverageGrid
from t3mpc_ros.geometry.path_timing import MotionLimits
from t3mpc_ros.simulation.world import clearance, load_world


@pytest.mark.parametrize('name', patrol_comparison.PATHS)
@pytest.mark.slow
def test_every_path_is_driven_within_arena_and_limits(name):
    plan = patrol_comparison.PatrolPlan(duration=40.0)
    track = patrol_comparison.patrol_track(plan, name, 101)
    left, bottom, right, top = plan.arena
    assert (track.position >= np.array([left, bottom]) - 1e-6).all()
    assert (track.position <= np.array([right, top]) + 1e-6).all()
    speed = np.hypot(*np.diff(track.position, axis=0).T) / np.diff(track.time)
    assert speed.max() <= MotionLimits().linear
    assert np.array_equal(track.position[0], [0.0, 0.0])
    assert track.time[-1] == pytest.approx(plan.duration)


def test_cells_near_walls_and_boxes_do_not_count():
    world = load_world('room')
    grid = patrol_comparison.free_cells(
        patrol_comparison.PatrolPlan(arena=(-2.0, -1.5, 2.0, 1.5)), world
    )
    centres = grid.centres()[grid.free]
    assert 0 < centres.shape[0] < 400
    assert all(world.is_free(x, y, patrol_comparison.CLEARANCE) for x, y in centres)
    assert patrol_comparison.free_cells(patrol_comparison.PatrolPlan(), None).free.all()


def judged(duration=1300.0, **rows):
    """Return the claims on patrols of three seeds with the given columns of each path."""
    names = {'own': patrol_comparison.OURS, 'walk': 'random walk', 'lanes': 'boustrophedon'}
    table = ResultTable(
        [
            {'controller': names[short], 'seed': seed, **dict(zip(columns, values, strict=True))}
            for short, (columns, *seeds) in rows.items()
            for seed, values in enumerate(zip(*seeds, strict=True), 1)
        ]
    )
    return patrol_comparison.claims(
        patrol_comparison.PatrolStudy(
            patrol_comparison.PatrolPlan(seeds=(1, 2, 3), duration=duration), table
        )
    )


@pytest.mark.parametrize(
    'own, verdict',
    [
        ([700.0, 720.0, 710.0], 'holds'),
        ([990.0, 1010.0, 1000.0], 'does not hold'),
        ([600.0, 1200.0, 800.0], 'inconclusive'),
        ([700.0, 720.0, math.inf], 'inconclusive'),  # how long it takes is not known
    ],
)
def test_verdict_on_coverage_needs_its_interval(own, verdict):
    column = ('time_to_90',)
    (claim,) = judged(own=(column, own), lanes=(column, (300.0, 301.0, 299.0)))
    assert claim.verdict == verdict


@pytest.mark.parametrize(
    'skills, spread, verdicts',
    [
        ([0.51, 0.50, 0.52], 1.0, ('holds', 'holds')),
        ([0.60, 0.61, 0.59], 1.0, ('does not hold', 'does not hold')),
        ([0.40, 0.60, 0.55], 1.0, ('inconclusive', 'inconclusive')),
        # A path that surprised by as many metres was refused for covering more of the room.
        ([0.66, 0.67, 0.68], 1.5, ('holds', 'does not hold')),
    ],
)
def test_verdicts_on_the_observer_refer_to_the_random_walk(skills, spread, verdicts):
    def observed(values, spread):
        errors = [math.sqrt((1.0 - value) * spread) for value in values]
        return ('skill_5', 'prediction_error_5'), values, errors

    found = judged(own=observed(skills, spread), walk=observed([0.50, 0.51, 0.52], 1.0))
    assert tuple(claim.verdict for claim in found) == verdicts


@pytest.mark.usefixtures('unrendered')
@pytest.mark.slow
def test_the_command_writes_page_pictures_and_numbers(tmp_path, capsys):
    words = ['--seeds', '101', '--minutes', '2.2', '--workers', '1']
    words += ['--paths', 'boustrophedon', 'random-walk', '--output', str(tmp_path)]
    assert main(['patrol', *words]) == 0
    printed = capsys.readouterr().out
    assert '| random walk |' in printed
    page = (tmp_path / 'patrol.html').read_text()
    assert 'Predictability' in page
    numbers = json.loads((tmp_path / 'patrol.json').read_text())
    assert set(numbers['paths']) == {'random walk', 'boustrophedon'}
    run = numbers['paths']['boustrophedon']['runs'][0]
    assert run['skill_5'] > 0.9
    assert run['time_to_90'] is None  # not within two minutes
    drawn = {path.stem for path in (tmp_path / 'figures').iterdir()}
    assert drawn == {'coverage', 'heat_maps', 'paths', 'predictability'}


def test_the_key_of_a_patrol_changes_with_its_plan(monkeypatch):
    found = []

    def keep(runs, *_, **__):
        found.extend(run.key for run in runs)

    monkeypatch.setattr(patrol_comparison, 'run_experiment', keep)
    base = patrol_comparison.PatrolPlan(('boustrophedon',), (1,))
    changes = {
        'paths': ('random walk',), 'seeds': (2,), 'duration': 60.0,
        'arena': (-1.0, -1.0, 1.0, 1.0), 'robot': 'twin',
    }  # fmt: skip
    assert {*changes, 'planned'} == {each.name for each in fields(patrol_comparison.PatrolPlan)}
    for plan in (base, *(replace(base, **{name: value}) for name, value in changes.items())):
        patrol_comparison.compare_patrols(plan)
    patrol_comparison.compare_patrols(replace(base, robot='twin', planned=True))
    patrol_comparison.compare_patrols(
        patrol_comparison.PatrolPlan(('boustrophedon',), (3, 1))
    )  # only the first has a track
    assert len(found) == len({*found}) == 9


def test_a_wrong_plan_is_refused(capsys, tmp_path):
    assert main(['patrol', '--paths', 'Lorentz', '--output', str(tmp_path)]) == 1
    assert 'did you mean Lorenz?' in capsys.readouterr().err
    with pytest.raises(ValueError, match=r'arena must contain the start'):
        patrol_comparison.PatrolPlan(arena=(0.5, -1.0, 2.0, 1.0))
    with pytest.raises(ValueError, match='planned needs the robot twin'):
        patrol_comparison.PatrolPlan(planned=True)
    with pytest.raises(ValueError, match='blocked must leave at least one cell free'):
        CoverageGrid((0.0, 0.0), (1.0, 1.0), 1, 1, np.ones((1, 1), dtype=bool))


@pytest.mark.slow
def test_the_twin_drives_among_unknown_boxes_and_sees_them():
    plan = patrol_comparison.PatrolPlan(duration=8.0, robot='twin')
    track = patrol_comparison.patrol_track(plan, 'random waypoints', 101)
    assert track.contacts == 0
    assert track.grid.free.sum() < 400
    # Rays end at walls or boxes, within the errors of the sensors.
    assert len(track.hits)
    distance = [clearance(x, y, track.world.segments, track.world.circles) for x, y in track.hits]
    assert np.median(distance) < 0.03
