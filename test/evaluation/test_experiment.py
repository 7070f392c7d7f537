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
"""The one table of results, the runner that fills it, and the file of finished runs."""

from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from dataclasses import make_dataclass, replace
from importlib import import_module
import math

import numpy as np
import pytest

from t3mpc_ros.evaluation import run_cache_key
from t3mpc_ros.evaluation.experiment import JobError, ResultFile, ResultTable, Run, run_experiment
from t3mpc_ros.evaluation.result_output import progress_bar
from t3mpc_ros.evaluation.run_cache_key import content_of, digest, source_digest

ROWS = [
    {'controller': name, 'seed': seed, 'error': error}
    for name, errors in (('a', (1.0, 2.0, 4.0)), ('b', (1.5, 3.0, 6.5)))
    for seed, error in enumerate(errors)
]


def doubled(job):
    number, _ = job
    return {'double': 2.0 * number}


class Named:
    name = 'm'


def runs(*numbers):
    return [Run((n, Named()), {'number': n}, f'key {n}') for n in numbers]


def test_rows_are_found_by_any_columns():
    table = ResultTable(ROWS)
    assert table.values('error', controller='b') == [1.5, 3.0, 6.5]
    assert table.where(controller='a', seed=1) == [ROWS[1]]
    assert table.where(controller='c') == []
    assert table.values('unknown') == []
    assert table.unique('seed') == (0, 1, 2)


def test_a_difference_is_paired_by_seed_whatever_the_order():
    table = ResultTable([*ROWS[:3], *reversed(ROWS[3:])])
    found = table.difference('error', {'controller': 'b'}, {'controller': 'a'})
    assert found.mean == pytest.approx((0.5 + 1.0 + 2.5) / 3)
    assert table.difference('error', {'controller': 'b'}, {'controller': 'c'}) is None
    with pytest.raises(ValueError, match='error must be paired by seed'):
        ResultTable(ROWS[:5]).difference('error', {'controller': 'b'}, {'controller': 'a'})


@pytest.mark.parametrize('stored', [False, True])
def test_rows_are_those_of_the_runs_in_their_order(stored, tmp_path):
    store = tmp_path / 'runs.jsonl' if stored else None
    table = run_experiment(runs(3, 1, 2), doubled, store=store)
    assert list(table) == [{'number': n, 'double': 2.0 * n} for n in (3, 1, 2)]


class LosingWorkers(ThreadPoolExecutor):
    """Loses a process at some submissions."""

    def __init__(self, lost_at):
        super().__init__(1)
        self.left = lost_at

    def submit(self, *arguments):
        self.left -= 1
        if self.left % 3 == 0 and self.left >= 0:
            raise BrokenProcessPool('lost')
        return super().submit(*arguments)


@pytest.mark.parametrize('losses, finished', [(3, True), (4, False)])
def test_runs_of_lost_workers_are_begun_again_three_times(losses, finished, tmp_path):
    """A worker lost while runs were still being submitted ended the study."""
    told = []
    with LosingWorkers(3 * losses) as executor:
        outcome = nullcontext() if finished else pytest.raises(JobError, match='m on .* failed')
        with outcome:
            store = tmp_path / 'runs.jsonl'
            table = run_experiment(
                runs(1, 2, 3), doubled, executor, store=store, report=told.append
            )
            assert [row['double'] for row in table] == [2.0, 4.0, 6.0]
            assert {*table.keys} == {'key 1', 'key 2', 'key 3'}
    assert sum('begun again' in text for text in told) == 3


def test_content_tells_equal_numbers_of_other_kinds_apart():
    values = [1, 1.0, True, '1', [1], (1, 2), {'1': 1}, None, Named, doubled]
    values += [np.array([1.0, 2.0]), np.array([1.0, 2.5]), np.array([1, 2])]
    assert len({repr(content_of(value)) for value in values}) == len(values)
    assert content_of(values[-1].copy()) == content_of(values[-1])


def test_content_changes_with_every_field():
    values = {'one': [0, np.array([0.0])], 'two': [None, doubled], 'three': [{'a': 1}, 'b']}
    made = make_dataclass('Made', values)
    first = made(*(value for value, _ in values.values()))
    others = [replace(first, **{name: other}) for name, (_, other) in values.items()]
    assert len({repr(content_of(each)) for each in (first, *others)}) == 4


def test_an_object_is_known_by_the_source_of_its_class(tmp_path, monkeypatch):
    """A sweep kept the rows of a dataclass controller whose method had been edited."""
    monkeypatch.syspath_prepend(tmp_path)
    text = '@dataclass\nclass Law:\n    gain: float\n    def step(self, _):\n        return {}\n'
    found = []
    for name, code in (('law_a', 'self.gain'), ('law_b', '-self.gain'), ('law_c', 'self.gain')):
        source = 'from dataclasses import dataclass\n' + text.format(code)
        (tmp_path / f'{name}.py').write_text(source)
        found.append(content_of(import_module(name).Law(1.0)))
    assert found[0] == found[2]
    assert found[0] != found[1]


# -- the file of finished runs -------------------------------------------------------------------

RUNS = [Run((k, 'method'), {'seed': k}, f'key {k}') for k in range(12)]


class Stopped(BaseException):
    """Raised in a run, as a signal would be."""


def table(path, *, stop_after=None, report=None):
    """Return the rows of the experiment, and the jobs that were run for them."""
    done = []

    def task(job):
        if len(done) == stop_after:
            raise Stopped
        done.append(job)
        return {'third': job[0] / 3.0, 'nan': math.nan}

    try:
        found = run_experiment(RUNS, task, store=path, report=report)
    except Stopped:
        return None, done
    return list(map(repr, found)), done


def test_a_stopped_experiment_goes_on_with_what_is_missing(tmp_path):
    whole, jobs = table(tmp_path / 'whole')
    lines = []
    _, first = table(tmp_path / 'r', stop_after=7, report=lines.append)
    assert lines[-1].startswith('7 of 12 runs are kept')
    found, rest = table(tmp_path / 'r', report=lines.append)
    assert '7 are there already' in lines[-1]
    assert (found, first + rest) == (whole, jobs)
    assert table(tmp_path / 'r') == (whole, [])  # bit for bit: a text has every digit


def test_a_torn_last_line_costs_that_line_only(tmp_path):
    path = tmp_path / 'r'
    whole, _ = table(path)
    *kept, last = path.read_bytes().splitlines(keepends=True)
    for cut in (1, 20, len(last) - 2, len(last) - 1):  # the last: only its end is gone
        path.write_bytes(b''.join(kept) + last[:cut])
        found, done = table(path)
        assert found == whole
        assert len(done) == (0 if cut == len(last) - 1 else 1), cut
        assert len(ResultFile(path).read()) == len(RUNS)
        assert table(path) == (whole, [])


def test_lines_that_are_no_runs_are_skipped_and_counted(tmp_path):
    path = tmp_path / 'r'
    whole, _ = table(path)
    path.write_bytes(b'\xff\xfe nonsense\n[1, 2]\n{"method": "full"}\n\n' + path.read_bytes())
    assert table(path) == (whole, [])
    file = ResultFile(path)
    file.read()
    assert file.unreadable == 3
    with ResultFile(path, fresh=True) as file:
        assert file.read() == {}


def test_only_the_runs_of_a_finished_study_are_removed(tmp_path):
    """A patrol and a sweep removed the runs of other settings, too."""
    path = tmp_path / 'r'
    whole, _ = table(path)
    file = ResultFile(path)
    file.remove({'key 2', 'key 5'})
    found, done = table(path)
    assert (found, done) == (whole, [(2, 'method'), (5, 'method')])
    file.remove([run.key for run in RUNS])
    assert not path.exists()


def test_a_file_has_one_writer_and_runs_with_different_keys(tmp_path):
    with ResultFile(tmp_path / 'r'), pytest.raises(RuntimeError, match='another process'):
        table(tmp_path / 'r')
    with pytest.raises(RuntimeError, match='must be a file for the runs: move that folder away'):
        table(tmp_path)
    for key in ('', 'key 1'):
        with pytest.raises(ValueError, match='different keys'):
            run_experiment([*RUNS, replace(RUNS[0], key=key)], store=tmp_path / 'r')


def test_progress_shows_pace_and_time_left(capsys):
    with progress_bar(2) as bar:
        bar.update()
        bar.refresh()
        assert '1/2 [' in capsys.readouterr().err
        bar.update()
    assert '2/2 [' in capsys.readouterr().err
    with progress_bar(2, show=False) as bar:
        bar.update()
    assert capsys.readouterr().err == ''


def test_the_digest_covers_sources_that_change_a_run(tmp_path, monkeypatch):
    relevant = (
        'control/law.py', 'evaluation/baselines/pi.py', 'worlds/room.yaml',
        'evaluation/tuning/tuned.json',
    )  # fmt: skip
    others = (
        'evaluation/paper/page.py', 'nodes/a.py', 'cli/main.py', 'control/__pycache__/law.pyc',
        'control/notes.md',
    )  # fmt: skip
    for name in relevant + others:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text('one')
    sources = source_digest.__wrapped__  # without its cache
    before = sources(tmp_path)
    for name in others:
        (tmp_path / name).write_text('two')
    assert sources(tmp_path) == before
    seen = {before}
    for name in relevant:
        (tmp_path / name).write_text('two')
        seen.add(sources(tmp_path))
    assert len(seen) == 1 + len(relevant)
    known = digest(1)
    monkeypatch.setattr(run_cache_key, 'source_digest', lambda: 'other')
    assert digest(1) != known
