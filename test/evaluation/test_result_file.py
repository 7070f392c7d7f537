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
"""Experiments with a file of finished runs: what it keeps, and what makes a run another one."""

from dataclasses import replace
import math

import pytest

from t3mpc_ros.evaluation import run_digest
from t3mpc_ros.evaluation.experiment import Run, run_experiment
from t3mpc_ros.evaluation.reporting import progress_bar
from t3mpc_ros.evaluation.result_file import ResultFile
from t3mpc_ros.evaluation.run_digest import digest, source_digest

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


def test_a_fresh_file_forgets_its_runs(tmp_path):
    table(tmp_path / 'r')
    with ResultFile(tmp_path / 'r', fresh=True) as file:
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


def test_two_experiments_do_not_share_a_file(tmp_path):
    with ResultFile(tmp_path / 'r'), pytest.raises(RuntimeError, match='another process'):
        table(tmp_path / 'r')


def test_a_folder_in_place_of_the_file_is_an_error_with_a_remedy(tmp_path):
    with pytest.raises(RuntimeError, match='must be a file for the runs: move that folder away'):
        table(tmp_path)


def test_runs_without_different_keys_are_refused(tmp_path):
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
    monkeypatch.setattr(run_digest, 'source_digest', lambda: 'other')
    assert digest(1) != known
