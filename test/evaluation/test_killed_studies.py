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
"""What a study has finished is on the disk at once: one that is killed goes on from there."""

from functools import cache
import math
from pathlib import Path
import re
import shutil

import pytest

import t3mpc_ros as t3
from t3mpc_ros.evaluation.api import parameter_sweep
from t3mpc_ros.evaluation.method_table import FULL, method_definitions, methods
from t3mpc_ros.evaluation.paper import paper_study, reproduce
from t3mpc_ros.evaluation.paper.paper_study import Extent
from t3mpc_ros.evaluation.paper.reproduce import run_study
from t3mpc_ros.evaluation.patrol import patrol_comparison
from t3mpc_ros.evaluation.patrol.patrol_comparison import PatrolPlan, compare_patrols
from t3mpc_ros.evaluation.tuning.tune_methods import history_path, tune_methods
from t3mpc_ros.evaluation.tuning.tuned_parameters import TunedParameters, TuningBudget

measured_patrol = cache(patrol_comparison.measured_patrol)


def sweep(folder, begun, monkeypatch):
    pytest.importorskip('pyarrow')

    def measured(job, numbers):
        begun()
        scenario, method = job
        return {'overall': scenario.seed / method.parameters.gain, 'error': ''}

    monkeypatch.setattr(parameter_sweep, 'measured_run', measured)
    path, values = folder / 'sweep.parquet', {'gain': [10.0, 20.0]}
    found = t3.sweep('ADRC', values, seeds=[1, 2], plant='servo', output=path, executor=1)
    assert [*folder.iterdir()] == [path]
    return found.rows


def paper(folder, begun, monkeypatch):
    def measured(job, numbers):
        begun()
        scenario, method = job
        return {'rmse': scenario.seed / 3.0, 'settled': math.nan, 'chatter': len(method.name)}

    monkeypatch.setattr(reproduce, 'measured_run', measured)
    monkeypatch.setattr(paper_study, 'methods', lambda drive: {FULL: methods(drive)[FULL]})
    extent = Extent((101, 102), 6.0, ('nominal',), (0.04,))
    return list(map(str, run_study(extent, folder)))


def patrols(folder, begun, monkeypatch):
    def measured(job):
        begun()
        return measured_patrol(job)

    monkeypatch.setattr(patrol_comparison, 'measured_patrol', measured)
    plan = PatrolPlan(('boustrophedon', 'random walk'), (101, 102), 5.0)
    table = compare_patrols(plan, folder / 'runs.jsonl').table
    # The tracks of the first seed alone are drawn.
    assert [row['seed'] for row in table if 'track' in row] == [101, 101]
    return list(map(str, table))


def tuning(folder, begun, monkeypatch):
    def evaluate(method, drive, candidates):
        begun()
        return [each.gain for each in candidates]

    chosen = [each for each in method_definitions() if each.name in ('ADRC', 'PI + feed-forward')]
    path = folder / 'tuned.json'
    store = tune_methods(
        chosen, ['velocity'], TuningBudget(30), 1, path, evaluate=evaluate, resume=True
    )
    assert all(history_path(path, each, 'velocity').is_file() for each in chosen)
    assert TunedParameters.load(path) == store
    return store.table()


@pytest.mark.slow
@pytest.mark.parametrize('study', [sweep, paper, patrols, tuning])
def test_a_killed_study_goes_on_with_what_is_missing(study, tmp_path, monkeypatch):
    """Finished runs were in the memory of the process alone, and lost with it."""
    whole, begun = tmp_path / 'whole', []
    whole.mkdir()

    def kept():  # what would be left on the disk if the process were killed in this run
        shutil.copytree(whole, tmp_path / f'{len(begun)}')
        begun.append(1)

    with monkeypatch.context() as patch:
        expected = study(whole, kept, patch)
    runs = len(begun)
    assert runs >= 4
    for done in (1, runs - 1):
        begun.clear()
        with monkeypatch.context() as patch:
            found = study(tmp_path / f'{done}', lambda: begun.append(1), patch)
        assert (len(begun), found) == (runs - done, expected)


def test_every_study_with_a_file_of_its_runs_is_tried():
    package = Path(t3.__file__).parent
    users = {
        path.stem
        for path in package.rglob('*.py')
        if re.search(r'import .*\bResultFile\b', path.read_text())
    }
    users -= {'patrol', 'parameter_sweep'}  # these remove finished runs only
    assert users == {'cma_search'}  # beside the experiment, which defines it
