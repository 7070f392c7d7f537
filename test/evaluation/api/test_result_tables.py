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
"""How results are shown in a terminal, a notebook and a paper."""

from functools import cache, partial
from html.parser import HTMLParser
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest

import t3mpc_ros as t3
from t3mpc_ros.evaluation.comparison import markdown
from t3mpc_ros.evaluation.html_page import html_page

SHORT = {'plant': 'servo', 'duration': 4.0}
MAKERS = {
    'run': partial(t3.simulate, 'feed-forward'),
    'comparison': partial(
        t3.compare,
        ['feed-forward', 'PI + feed-forward'],
        seeds=[1, 2],
        cases=['nominal', 'friction x3'],
        executor=1,
    ),
    'sweep': partial(
        t3.sweep, 'PI + feed-forward', {'gain': [10.0, 20.0]}, seeds=[1, 2], executor=1
    ),
}


@cache
def made(name):
    """Return a result, made for the first test that needs it."""
    return MAKERS[name](**SHORT)


@pytest.fixture(params=MAKERS)
def result(request):
    return made(request.param)


class Cells(HTMLParser):
    """The cells of tables, row by row; every element must be closed."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.open = [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)
        if tag == 'tr':
            self.rows.append([])
        elif tag in ('td', 'th'):
            self.rows[-1].append('')

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if {'td', 'th'} & {*self.open}:
            self.rows[-1][-1] += data


def cells_of(markdown):
    lines = [line for line in markdown.splitlines() if line.startswith('|') and '|---' not in line]
    return [[cell.strip(' *') for cell in line.strip('|').split('|')] for line in lines]


def test_a_result_in_a_notebook_is_small_and_its_tables(result):
    """The repr of a run had 256 110 characters."""
    assert len(repr(result)) < 200
    assert '\n' not in repr(result)
    shown = result._repr_html_()
    assert len(shown.encode()) < 5000
    assert Cells(shown).rows == cells_of(str(result))


def test_the_latex_of_a_result_has_its_cells(result):
    text = result.to_latex(columns=cells_of(str(result))[0])
    rows = [line for line in text.splitlines() if line.endswith(r'\\')]
    table = cells_of(str(result))
    assert len(rows) == len(table)
    for row, cells in zip(rows, table, strict=True):
        assert len(re.split(r'(?<!\\)&', row)) == len(cells)
    for begin, end in (('{', '}'), (r'\begin', r'\end')):
        assert text.count(begin) == text.count(end)
    # Nothing that LaTeX reads otherwise, and no sign that its fonts may lack.
    assert not re.search(r'(?<!\\)[%#_~^]', re.sub(r'\$[^$]*\$', '', text))
    assert text.isascii() or not {*'±−×²³·≤'} & {*text}
    for rule in ('toprule', 'midrule', 'bottomrule'):
        assert text.count(rule) == text.count('begin{tabular}')


def test_the_latex_of_a_comparison_is_a_table_for_a_paper():
    """It had twelve columns, one of them with 130 characters, and no label."""
    comparison = made('comparison')
    text = comparison.to_latex('nominal', label='tab:mine', caption='Mine & others')
    assert r'method & settled, rad/s & settled $-$ feed-forward & verdict \\' in text
    assert text.splitlines()[2:4] == [r'  \caption{Mine \& others}', r'  \label{tab:mine}']
    chosen = comparison.to_latex('nominal', columns=['verdict', 'variation', 'verdict'])
    assert r'method & verdict & variation, rad/s$^3$ & verdict \\' in chosen
    for wrong, reason in (
        (
            {'columns': ['setled']},
            'column must be one of method, settled, .* did you mean settled',
        ),
        ({'label': 'tab:mine'}, 'label and caption are of one table: choose one of 2 cases'),
    ):
        with pytest.raises(t3.ScriptError, match=reason):
            comparison.to_latex(**wrong)


def test_a_table_with_verdicts_says_how_they_are_made():
    """``+0.0570 ± 0.0333 inconclusive`` reads as a contradiction."""
    comparison = made('comparison')
    note = 'for the 2 comparisons of the table. An interval is that of its mean alone'
    page = html_page('', comparison._tables('nominal'))
    for text in (str(comparison), comparison._repr_html_(), comparison.to_latex()):
        assert text.count(note) == 2
    assert page.count(note) == 1
    summary = markdown(comparison.plan, comparison.results)
    assert summary.count("by Student's test of the differences") == 3, 'one below each table'


def test_the_metric_of_a_result_is_by_default_the_settled_one():
    comparison, swept = made('comparison'), made('sweep')
    for shown in (swept.table(), swept.to_latex()):
        assert 'settled, rad/s' in shown
    assert comparison.values('feed-forward') == comparison.values('feed-forward', 'settled')
    heading = comparison.values('feed-forward', 'with switches')
    assert heading == comparison.values(t3.Controller('feed-forward'), 'overall')
    assert comparison.difference('PI + feed-forward').mean == pytest.approx(
        np.subtract(
            comparison.values('PI + feed-forward'), comparison.values('feed-forward')
        ).mean()
    )
    (axis,) = comparison.plot(case='friction x3').axes
    assert axis.get_xlabel() == 'settled / (rad/s)'
    assert [each.get_text() for each in axis.get_yticklabels()] == [
        'feed-forward',
        'PI + feed-forward',
    ]


def test_one_case_or_metric_is_chosen_by_its_name():
    comparison, swept = made('comparison'), made('sweep')
    assert made('run').to_latex('variation').count('rad/s') == 1
    assert comparison.to_latex().count('tabular}') == 4
    assert comparison.to_latex('friction x3').count('tabular}') == 2
    assert swept.to_latex('variation') != swept.to_latex()
    with pytest.raises(t3.ScriptError, match='nominal'):
        comparison.to_latex('no such case')


@pytest.mark.long
def test_a_figure_shows_itself_and_is_written_in_three_forms(tmp_path):
    figure = made('run').plot()
    assert figure._repr_png_().startswith(b'\x89PNG')
    for suffix, begin in (('.png', b'\x89PNG'), ('.pdf', b'%PDF'), ('.svg', b'<?xml')):
        path = tmp_path / f'run{suffix}'
        written = []
        for _ in range(2):
            made('run').plot(path)
            written.append(path.read_bytes())
        assert written[0].startswith(begin)
        assert written[0] == written[1], 'an equal figure is an equal file'


def test_a_result_as_a_data_frame(monkeypatch):
    frames = []
    monkeypatch.setitem(sys.modules, 'pandas', SimpleNamespace(DataFrame=frames.append))
    for name in MAKERS:
        made(name).to_frame()
    run, comparison, swept = frames
    assert set(run) == set(made('run').columns)
    assert len(comparison['seed']) == 8
    assert swept['gain'] == [10.0, 20.0, 10.0, 20.0]
    monkeypatch.setitem(sys.modules, 'pandas', None)
    with pytest.raises(t3.ScriptError, match='needs pandas: .* -m pip install pandas'):
        made('run').to_frame()


@pytest.mark.parametrize('alpha', [1.0, 0.98, 0.9])
def test_the_step_of_the_generator_follows_from_the_tolerance(alpha):
    """With its step of 1 ms the solution was 2.6 % off at 1 s, and nothing said so."""
    exact = t3.chaos(alpha, tspan=(0.0, 1.0), dt=2.0**-5 * 1e-3, every=320).y
    errors = []
    for rtol in (1e-2, 1e-3, 1e-4):
        found = t3.chaos(alpha, tspan=(0.0, 1.0), rtol=rtol)
        assert np.allclose(np.diff(found.t), 0.01)
        errors.append(np.max(np.abs(found.y - exact)) / np.max(np.abs(exact)))
        # Half of the step changes it by rtol at most; of a solver of second order, that is
        # three quarters of the error.
        assert errors[-1] <= 1.5 * rtol
    assert errors[0] > errors[2]
    assert t3.chaos(alpha, tspan=(0.0, 1.0), dt=0.001).dt == 0.001
