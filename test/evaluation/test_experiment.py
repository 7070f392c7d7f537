# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The one table of results and the runner that fills it."""

from importlib import import_module

import pytest

from t3mpc_ros.evaluation.experiment import ResultTable, Run, content_of, run_experiment

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


def test_content_tells_equal_numbers_of_other_kinds_apart():
    values = [1, 1.0, True, '1', [1], (1, 2), {'1': 1}, None, Named, doubled]
    assert len({repr(content_of(value)) for value in values}) == len(values)


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
