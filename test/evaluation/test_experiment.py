# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The one table of results and the runner that fills it."""

import json

import pytest

from t3mpc_ros.evaluation.experiment import ResultTable, Run, content_of, run_experiment
from t3mpc_ros.evaluation.result_file import ResultFile

ROWS = [
    {'controller': name, 'seed': seed, 'error': error}
    for name, errors in (('a', (1.0, 2.0, 4.0)), ('b', (1.5, 3.0, 6.5)))
    for seed, error in enumerate(errors)
]


def doubled(job):
    number, _ = job
    if number < 0:
        raise ArithmeticError('negative')
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


def test_what_a_file_holds_is_not_made_again(tmp_path):
    """Also after a run that failed, and although a line was torn and another is no run."""
    store, made = tmp_path / 'runs.jsonl', []

    def counted(job):
        made.append(job[0])
        return doubled(job)

    with pytest.raises(RuntimeError, match='negative'):
        run_experiment(runs(1, 2, -3, 4), counted, store=store)
    lines = store.read_text().splitlines()
    assert [json.loads(line)['double'] for line in lines] == [2.0, 4.0]
    store.write_text(f'{lines[0]}\n[1, 2]\n{lines[1][:9]}')
    said = []
    table = run_experiment(runs(2, 1), counted, store=store, report=said.append)
    assert made == [1, 2, -3, 2]
    assert table.values('double') == [4.0, 2.0]
    assert said == ['2 runs; 1 are there already, 1 to do; 2 torn lines are skipped']
    run_experiment(runs(1), counted, store=store, fresh=True)
    assert made[4:] == [1]
    assert list(ResultFile(store).read()) == ['key 1']


def test_runs_that_are_to_be_kept_have_keys_of_their_own(tmp_path):
    for wrong in (runs(1, 1), [Run((1, Named()), {})]):
        with pytest.raises(ValueError, match='different keys'):
            run_experiment(wrong, doubled, store=tmp_path / 'runs.jsonl')
    assert not list(tmp_path.iterdir())


def test_numbers_that_are_not_finite_come_back_from_a_file(tmp_path):
    rows = {'x': float('nan'), 'y': float('inf'), 'z': [1.0, float('-inf')]}
    store = tmp_path / 'runs.jsonl'
    for _ in range(2):
        table = run_experiment(runs(1), lambda job: rows, store=store)
        assert repr(table[0]) == repr({'number': 1, **rows})


def test_content_tells_equal_numbers_of_other_kinds_apart():
    values = [1, 1.0, True, '1', [1], (1, 2), {'1': 1}, None, Named, doubled]
    assert len({repr(content_of(value)) for value in values}) == len(values)
