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
"""Figures: what their lines, error bars, colours and labels show, read from the drawn artists.

Every quantity of the runs has a value of its own, so that any two that are exchanged are seen.
"""

from dataclasses import replace
from itertools import product
import math
import re
from types import SimpleNamespace

from matplotlib.colors import to_hex
from matplotlib.patches import Circle, Rectangle
import numpy as np
import pytest
from support.records import PAIRS, record_of

from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.evaluation import comparison, fault_outcomes, figure_style
from t3mpc_ros.evaluation.api.chaos_generator import ChaosSolution
from t3mpc_ros.evaluation.api.parameter_sweep import Sweep
from t3mpc_ros.evaluation.api.single_run import RunResult
from t3mpc_ros.evaluation.comparison import ComparisonPlan, first_verdicts
from t3mpc_ros.evaluation.confidence_intervals import interval
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.method_table import FULL, methods_for
from t3mpc_ros.evaluation.paper import paper_figures
from t3mpc_ros.evaluation.paper.paper_figures import FigureRuns
from t3mpc_ros.evaluation.paper.paper_study import STAGES, WITHOUT, Results
from t3mpc_ros.evaluation.patrol import path_tracker_comparison, patrol_comparison
from t3mpc_ros.evaluation.patrol.path_tracker_comparison import OURS as TRACKER
from t3mpc_ros.evaluation.patrol.path_tracker_comparison import (
    TRACKED_PATHS,
    TrackingPlan,
    TrackingStudy,
)
from t3mpc_ros.evaluation.patrol.patrol_comparison import OURS, PatrolPlan, PatrolStudy
from t3mpc_ros.evaluation.patrol.patrol_metrics import HORIZONS, CoverageGrid, visits
from t3mpc_ros.evaluation.process_replay import replay_comparison
from t3mpc_ros.evaluation.process_replay.replay_comparison import (
    Comparison,
    FieldComparison,
    Tolerances,
)
from t3mpc_ros.evaluation.run_record import METRICS
from t3mpc_ros.evaluation.scenario import Scenario
from t3mpc_ros.simulation.world import World

GREEN, RED, GREY, COMMAND = '#15803d', '#be123c', '#6b7280', '#0f766e'


def lines(axis):
    """Return the named lines of an axis, as columns."""
    return {
        line.get_label(): np.asarray(line.get_xydata()).T
        for line in axis.lines
        if not line.get_label().startswith('_')
    }


def bars(container):
    """Return the ends of each error bar of a container, in order."""
    (segments,) = (
        container.lines[2] if hasattr(container, 'lines') else container.errorbar.lines[2]
    )
    return np.array(segments.get_segments())


def halves(container, axis):
    """Return middles and half lengths of the error bars along an axis: 0 for x, 1 for y."""
    ends = bars(container)[:, :, axis]
    return ends.mean(axis=1), 0.5 * np.diff(ends, axis=1)[:, 0]


def title(axis):
    return axis.get_title(loc='left') or axis.get_title()


def texts(axis):
    return title(axis), axis.get_xlabel(), axis.get_ylabel()


# -- runs -----------------------------------------------------------------------------------------

TIME = 0.1 * np.arange(300)


def loop_record(shift=0.0):
    """Return a run whose columns all differ, with a switch at 15 s."""
    columns = {
        name: np.outer(np.sin(0.3 * TIME + k), (1.0, 1.0)) + (10.0 * k + shift, 10.0 * k + 5)
        for k, name in enumerate(PAIRS, 1)
    }
    modes = (TIME >= 15.0).astype(np.int64)
    columns['reference'] += 3.0 * modes[:, None]
    terms = np.stack([columns['speeds'] * (k + 2) for k in range(len(TERM_NAMES))], axis=1)
    return record_of(TIME, mode=modes, terms=terms, switches=[15.0], **columns)


RUN, SERVO, BLIND, OTHER = map(loop_record, (0.0, 100.0, 200.0, 300.0))
SHOWCASE = FigureRuns(
    RUN, SERVO, BLIND, {FULL: RUN, 'PI': OTHER}, ((1, 2), (3, 4)),
    RUN.speeds, {'type3': RUN.speeds + 0.5, 'type1': OTHER.speeds},
)  # fmt: skip
SIDES = ('right', 'left')


UNKNOWN = np.diff(RUN.speeds, axis=0) / 0.1 - RUN['acceleration'][:-1]


def assert_over_time(axis, i, shown, begin=0.0):
    """Lines of an axis are those of a wheel by their labels, at the times where they are drawn."""
    found = lines(axis)
    for label, values in shown.items():
        time, drawn = found[label]
        assert drawn == pytest.approx(values[np.searchsorted(TIME, time + begin - 1e-6), i]), label


@pytest.mark.parametrize(
    ('draw', 'unit', 'shown', 'zoomed'),
    [
        (
            paper_figures.outputs,
            'speed / rad/s',
            {'reference': RUN.reference, 'robot': RUN.speeds},
            {'measured': RUN['measured']},
        ),
        (
            paper_figures.estimates,
            'rad/s²',
            {'estimate g': -RUN['terms'][:, 0], 'unknown, $\\dot\\chi - u$': UNKNOWN},
            {},
        ),
        (paper_figures.control, 'u / rad/s²', {}, {}),
    ],
)
def test_a_run_and_its_switch(draw, unit, shown, zoomed):
    axes = np.array(draw(SHOWCASE).axes).reshape(2, 2)
    for i, (whole, about) in enumerate(axes):
        assert whole.get_ylabel() == unit
        assert title(whole).startswith(f'{SIDES[i]} wheel')
        assert_over_time(whole, i, shown)
        assert_over_time(about, i, shown | zoomed)
    assert {axis.get_xlabel() for axis in axes[-1]} == {'time / s'}
    # The largest switch is in the middle of the second column.
    low, high = axes[0, 1].get_xlim()
    assert low < 15.0 < high < 20.0
    assert {*axes[0, 1].lines[0].get_xdata()} == {15.0}


def test_numbers_of_a_wheel_are_in_its_title():
    steep = np.cumsum(np.ones((TIME.size, 2)) * (1.0, 3.0), axis=0)
    run = replace(RUN, columns={**RUN.columns, 'acceleration': steep})
    controls = paper_figures.control(replace(SHOWCASE, torque=run)).axes[::2]
    counted = TIME[:-1] >= 3.0
    miss = np.mean((UNKNOWN + RUN['terms'][:-1, 0])[counted] ** 2, axis=0)
    shares = 1.0 - miss / np.var(UNKNOWN[counted], axis=0)
    estimates = paper_figures.estimates(SHOWCASE).axes[::2]
    for i, (control, estimate) in enumerate(zip(controls, estimates, strict=True)):
        assert f'varies by {(10, 30)[i]} rad/s² a second' in title(control)
        assert control.lines[-1].get_ydata() == pytest.approx(steep[:, i])
        assert f'{100 * shares[i]:.0f} % of the variance' in title(estimate)


def test_portraits_have_the_left_wheel_to_the_right():
    figure = paper_figures.portrait(RUN)
    drawn = {'reference': RUN.reference, 'robot': RUN.speeds}
    for axis, (name, values) in zip(figure.axes, drawn.items(), strict=True):
        assert (*axis.lines[0].get_xydata()[0],) == (*values[0, ::-1],)
        assert axis.get_xlabel() == 'left wheel / rad/s'
        assert title(axis) == name
    assert figure.axes[0].get_ylabel() == 'right wheel / rad/s'


def test_portraits_of_methods_name_the_run_and_its_rmse():
    results = results_of()
    for axis, (name, run) in zip(
        paper_figures.portraits(SHOWCASE, results).axes, SHOWCASE.portraits.items(), strict=False
    ):
        reference, driven = (each.get_xydata() for each in axis.lines)
        assert (*reference[0],) == (run.reference[0, 1], run.reference[0, 0])
        assert (*driven[0],) == (run.speeds[30, 1], run.speeds[30, 0])
        error = (run.speeds - run.reference)[30:]
        rmse = np.sqrt(np.mean(error**2))
        assert title(axis).startswith(f'{name}\nRMSE {rmse:.3f}, settled ')
    first, second = paper_figures.estimation_portraits(SHOWCASE).axes
    assert title(first) == 'type 3\nRMSE 0.500 rad/s'
    shown = lines(first)
    assert shown['estimated'][:, 0] == pytest.approx(RUN.speeds[0, ::-1] + 0.5)
    assert shown['true'][:, 0] == pytest.approx(RUN.speeds[0, ::-1])


def test_preview_is_compared_about_the_switch():
    shown = {'with preview': SERVO.speeds, 'without preview': BLIND.speeds}
    for i, axis in enumerate(paper_figures.preview(SHOWCASE).axes):
        assert_over_time(axis, i, {'reference': SERVO.reference, **shown}, begin=15.0)
        assert title(axis) == f'{SIDES[i]} wheel'


def test_modes_show_which_signal_drives_which_wheel():
    for i, axis in enumerate(paper_figures.modes(SHOWCASE).axes):
        time, signal = axis.lines[-1].get_xydata().T
        assert {*signal[time < 14.9]} == {SHOWCASE.pairs[0][i]}
        assert {*signal[time > 15.1]} == {SHOWCASE.pairs[1][i]}
        assert title(axis) == f'signal that drives the {SIDES[i]} wheel'


def test_the_path_on_the_floor_is_that_of_its_label():
    (axis,) = paper_figures.path(SHOWCASE).axes
    shown = lines(axis)
    for label, speeds in (('reference', SERVO.reference), ('driven', SERVO.speeds)):
        assert pytest.approx(paper_figures.floor_path(speeds, TIME)) == shown[label].T
    assert shown['start'][:, 0] == pytest.approx([0.0, 0.0])
    assert texts(axis)[1:] == ('x / m', 'y / m')


def test_a_quantity_has_its_colour_in_every_figure():
    colours = {
        'reference': '#1f2937', 'robot': '#0284c7', 'driven': '#0284c7', 'with preview': '#0284c7',
        'measured': '#7dd3fc', 'estimate g': '#7c3aed', 'switch': '#d97706', 'true': '#1f2937',
    }  # fmt: skip
    seen = set()
    for draw in (paper_figures.outputs, paper_figures.estimates, paper_figures.preview,
                 paper_figures.path, paper_figures.estimation_portraits):  # fmt: skip
        for axis in draw(SHOWCASE).axes:
            for line in axis.lines:
                if (name := line.get_label()) in colours:
                    seen.add(name)
                    assert to_hex(line.get_color()) == colours[name], name
    assert seen == colours.keys()


def test_a_run_of_a_script():
    columns = {'time': TIME}
    for k, name in enumerate(('reference', 'speed')):
        columns |= {f'{name}_{s}': np.sin(TIME) + 10 * k + 3 * i for i, s in enumerate(SIDES)}
    result = RunResult('mine', None, None, columns, {'settled': 0.25, 'overall': 0.5})
    *wheels, error = result.plot().axes
    for axis, side in zip(wheels, SIDES, strict=True):
        shown = lines(axis)
        assert shown['mine'][1] == pytest.approx(columns[f'speed_{side}'])
        assert shown['reference'][1] == pytest.approx(columns[f'reference_{side}'])
        assert lines(error)[f'{side} wheel'][1] == pytest.approx(10.0)
        assert texts(axis)[::2] == (f'{side} wheel', 'rad/s')
    assert texts(error) == ('error', 'time / s', 'rad/s')
    table = result.table()
    assert '| settled | 0.2500 | rad/s |' in table
    assert '| with switches | 0.5000 | rad/s |' in table


# -- error bars -----------------------------------------------------------------------------------

VALUES = {1.0: [0.1, 0.2, 0.4], 2.0: [0.7, 0.8, 1.0, 1.5], 3.0: [0.3]}


def test_a_sweep_shows_means_and_their_intervals():
    metric = METRICS[0]
    fields = {'case': 'nominal', 'error': ''}
    rows = [
        {'controller': name, 'gain': gain, **fields, metric.name: factor * value}
        for factor, name in ((1.0, 'a'), (10.0, 'b'))
        for gain, values in VALUES.items()
        for value in values
    ]
    sweep = Sweep(rows, ('gain',))
    (axis,) = sweep.plot('gain', metric.name).axes
    for factor, container in zip((1.0, 10.0), axis.containers, strict=True):
        middles, half = halves(container, 1)
        assert middles == pytest.approx([factor * np.mean(v) for v in VALUES.values()])
        assert half[:2] == pytest.approx([factor * interval(VALUES[k]) for k in (1.0, 2.0)])
        assert half[2] == 0.0  # a single run has none
    assert [each.get_label() for each in axis.containers] == ['a', 'b']
    assert texts(axis)[1:] == ('gain', f'{metric.heading} / ({metric.unit})')
    d = metric.digits
    cell = f'{np.mean(VALUES[1.0]):.{d}f} ± {interval(VALUES[1.0]):.{d}f}'
    assert f'| a | 1.0 | nominal | 3 | {cell} |' in sweep.table(metric.name)


METHODS = {FULL: (False, True), **dict.fromkeys(STAGES, (False, False))}
METHODS |= dict.fromkeys(WITHOUT.values(), (False, True))
METHODS = {'PI': (True, False), 'MPC': (True, True)} | METHODS


def results_of():
    """Return results in which each method, drive, noise and case has numbers of its own."""
    generator = np.random.default_rng(1)
    names = 'drive', 'noise', 'case'
    situations = product(('torque', 'velocity'), (0.0, 0.04), ('nominal', 'mass +30 %'))
    rows = [
        {
            'controller': name, 'baseline': baseline, 'preview': preview, 'rmse': rmse,
            'settled': 0.5 * rmse, 'chatter': 9.0, 'largest_error': 2.0, 'finite': True,
            'seed': seed, 'duration': 59.5, **dict(zip(names, situation, strict=True)),
        }
        for situation in situations
        for name, (baseline, preview) in METHODS.items()
        for seed, rmse in enumerate(0.5 + generator.random(4))
    ]  # fmt: skip
    return Results(ResultTable(rows))


def rmse_of(results, name, drive, noise=0.04, case='nominal'):
    found = results.runs.values('rmse', controller=name, drive=drive, noise=noise, case=case)
    return np.array(found)


def assert_bars(middles, half, runs):
    assert middles == pytest.approx([np.mean(each) for each in runs])
    assert half == pytest.approx([interval(each) for each in runs])


def test_bars_of_the_methods_have_means_intervals_and_names():
    results = results_of()
    for axis, drive in zip(paper_figures.rmse_bars(results).axes, results.drives, strict=True):
        names = [tick.get_text().removesuffix(' (preview)') for tick in axis.get_yticklabels()]
        assert {*names} == {'PI', 'MPC', FULL}
        bar = next(each for each in axis.containers if hasattr(each, 'errorbar'))
        middles, half = halves(bar, 0)
        assert_bars(middles, half, [rmse_of(results, name, drive) for name in names])
        for patch, name, middle in zip(bar.patches, names, middles, strict=True):
            assert patch.get_width() == pytest.approx(middle)
            assert (to_hex(patch.get_facecolor()) == paper_figures.OURS) == (name == FULL)
        assert drive in title(axis)
    assert axis.get_xlabel() == 'RMSE / rad/s'


def test_growth_with_noise_has_intervals_and_begins_at_zero():
    results = results_of()
    top, bottom = np.array(paper_figures.noise_growth(results).axes).reshape(2, 2)
    for axis, growth, drive in zip(top, bottom, results.drives, strict=True):
        for container, line in zip(axis.containers, growth.lines, strict=True):
            name = container.get_label().removesuffix(' (preview)')
            middles, half = halves(container, 1)
            assert_bars(middles, half, [rmse_of(results, name, drive, n) for n in (0.0, 0.04)])
            assert line.get_ydata() == pytest.approx(middles - middles[0])
    assert top[0].get_ylabel() == 'RMSE / rad/s'
    assert {axis.get_xlabel() for axis in bottom} == {'noise variance / (rad/s)²'}


def test_stages_are_bars_by_case():
    results = results_of()
    for axis, drive in zip(paper_figures.ablation_bars(results).axes, results.drives, strict=True):
        found = [each for each in axis.containers if hasattr(each, 'errorbar')]
        assert [each.get_label().removesuffix(' (+preview)') for each in found] == [*STAGES]
        for stage, bar in zip(STAGES, found, strict=True):
            heights = [patch.get_height() for patch in bar.patches]
            runs = [rmse_of(results, stage, drive, case=case) for case in results.cases(drive)]
            assert_bars(heights, halves(bar, 1)[1], runs)
        assert axis.get_ylabel() == 'RMSE / rad/s'


def test_parts_are_paired_differences_left_of_zero_if_better():
    results = results_of()
    figure = paper_figures.parts(results)
    axes = np.array(figure.axes).reshape(len(results.drives), -1)
    assert 'left of zero: better with it' in figure._supxlabel.get_text()
    for row, drive in zip(axes, results.drives, strict=True):
        for axis in row:
            part = title(axis)
            added = [*STAGES][paper_figures.PARTS.index(part) :][:2]
            pairs = added, (WITHOUT[part], FULL)
            for container, (less, more) in zip(axis.containers, pairs, strict=True):
                apart = [
                    rmse_of(results, more, drive, case=case)
                    - rmse_of(results, less, drive, case=case)
                    for case in results.cases(drive)
                ]
                assert_bars(*halves(container, 0), apart)


# -- pages ----------------------------------------------------------------------------------------


@pytest.fixture
def caught(monkeypatch):
    """Return the figures of a page, which are not rendered."""
    figures = []

    def instead(draw, subject):
        if (figure := draw(subject)) is not None:
            figures.append(figure)

    monkeypatch.setattr(figure_style, 'drawing', instead)
    return figures


def test_differences_of_methods_are_coloured_by_their_verdict(caught):
    """Green is better, which is a smaller error; an interval about zero is grey."""
    apart = {'DMC': -0.3, 'ADRC': 0.3, FULL: 0.0}
    noise = np.array([-0.01, 0.0, 0.02])
    methods = {name: methods_for('servo')[name] for name in ('feed-forward', *apart)}
    plan = ComparisonPlan(Scenario('servo', 'nominal', 1), ('nominal',), methods, (1, 2, 3))
    fields = {'case': 'nominal', 'overall': 2.0, 'variation': 9.0}
    rows = [
        {'controller': name, 'seed': seed, 'settled': 1.0 + n, **fields}
        for name, shift in {'feed-forward': None, **apart}.items()
        for seed, n in enumerate(0.0 * noise if shift is None else shift + noise)
    ]
    results = ResultTable(rows)
    found = first_verdicts(plan, results)  # of the first metric: the other one never differs
    assert [found[name, 'nominal'] for name in apart] == ['better', 'worse', 'inconclusive']
    page = comparison.page(plan, results)
    (axis,) = caught[0].axes
    assert [tick.get_text() for tick in axis.get_yticklabels()] == [*apart]
    for container, (name, shift), colour, verdict in zip(
        axis.containers, apart.items(), (GREEN, RED, GREY),
        ('better', 'worse', 'inconclusive'), strict=True,
    ):  # fmt: skip
        middles, half = halves(container, 0)
        assert middles == pytest.approx(np.mean(noise) + shift)
        assert half == pytest.approx(interval(noise))
        assert to_hex(container.lines[0].get_color()) == colour
        value = f'{1.0 + shift + np.mean(noise):.4f}'
        assert re.search(rf'{value} ±[^"]*{verdict}', page)
        stored = comparison.record(plan, results)['cases']['nominal']['methods'][name]
        assert stored['difference_from_feed_forward']['settled']['verdict'] == verdict
    assert axis.get_xlabel() == 'settled / (rad/s)'


OUTCOME = {
    'name': 'gyro_dead', 'course': 'chaotic', 'verdict': 'bounded', 'before': 0.1, 'during': 0.7,
    'after': 0.2, 'recovery_time': 1.0, 'odometry_before': [0.0, 0.0], 'detected': ['imu'],
    'odometry_after': [0.0, 0.0], 'ranges': '', 'undetected': [], 'reason': 'a command of 2 m/s',
}  # fmt: skip


def test_errors_of_faults_are_named_and_judged_by_the_worst(caught):
    other = OUTCOME | {'name': 'brown_out', 'before': 0.3, 'during': 0.9, 'after': None}
    page = fault_outcomes.page([OUTCOME, other])
    (axis,) = caught[0].axes
    shown = lines(axis)
    errors = {'before': [0.1, 0.3], 'during': [0.7, 0.9], 'after': [0.2]}
    assert {name: [*x] for name, (x, _) in shown.items()} == errors
    names = [tick.get_text() for tick in axis.get_yticklabels()]
    assert dict(zip(axis.get_yticks(), names, strict=True))[shown['after'][1][0]] == 'gyro_dead'
    assert [to_hex(each.get_color()) for each in axis.lines] == [GREY, RED, COMMAND]
    assert 'Every fault stays bounded' in page
    assert '2 stay within the limits and recover.' in page
    lost = {'undetected': ['odometry is wrong'], 'odometry_after': [1.03, 0.5]}
    astray = fault_outcomes.page([OUTCOME, other | lost])
    assert (
        '<div class="verdict open"><p class="headline">Every fault stays within the limits, but '
        'the odometry is wrong at the end of 1 of 2 runs, by up to 1.03 m, 28.6° (brown_out, '
        in astray
    ), 'it was green: every fault stays bounded'
    worse = fault_outcomes.page(
        [OUTCOME, other | {'verdict': 'unbounded', 'undetected': ['tilt']}]
    )
    assert 'Not every fault stays bounded' in worse
    assert '1 exceed a limit.' in worse


# -- patrols and the twin -------------------------------------------------------------------------


SKILLS = {(OURS, 1): (0.9, 0.4), (OURS, 2): (0.7, 0.1), ('random walk', 1): (0.8, 0.3),
          ('random walk', 2): (0.2, 0.2)}  # fmt: skip
PATROLS = PatrolStudy(
    PatrolPlan((OURS, 'random walk'), (1, 2), duration=600.0),
    ResultTable(
        [
            {'controller': name, 'seed': seed, 'curve': np.linspace(0.0, first, 11)}
            | {f'skill_{h:g}': first if h < 5.0 else later for h in HORIZONS}
            for (name, seed), (first, later) in SKILLS.items()
        ]
    ),
)


def test_coverage_is_the_mean_in_per_cent_over_minutes():
    (axis,) = patrol_comparison.draw_coverage(PATROLS).axes
    shown = lines(axis)
    for name, last in ((OURS, 80.0), ('random walk', 50.0)):
        time, share = shown[name]
        assert (time[0], time[-1]) == (0.0, pytest.approx(10.0))
        assert share == pytest.approx(np.linspace(0.0, last, 11))
    assert texts(axis)[1:] == ('time / min', 'cells entered / %')


def test_skills_have_their_intervals():
    (axis,) = patrol_comparison.draw_predictability(PATROLS).axes
    for name, container in zip(PATROLS.plan.paths, axis.containers, strict=True):
        assert container.get_label() == name
        values = [PATROLS.table.values(f'skill_{h:g}', controller=name) for h in HORIZONS]
        middles, half = halves(container, 1)
        assert middles == pytest.approx([np.mean(row) for row in values])
        assert half == pytest.approx([interval(row) for row in values])
    assert texts(axis)[1:] == ('horizon / s', 'skill of the observer')


WORLD = World(
    'odd',
    np.array([[0.0, 0.0, 4.0, 0.5], [4.0, 0.5, 3.0, 2.0]]),
    np.array([[1.0, 1.5, 0.2]]),
    np.array([[3.0, 0.5, 0.4, 0.1]]),
    np.array([[2.0, 1.0, 0.8, 0.2, math.pi / 6]]),
)


def value_at(axis, x, y):
    """Return the number that the picture of an axis shows at a place of its coordinates."""
    (image,) = axis.images
    across, up = axis.transData.transform((x, y))
    return image.get_cursor_data(SimpleNamespace(x=across, y=up))


def walls_of(axis):
    """Return the walls that are drawn, shape (n, 4), and the places (m) of discs and boxes."""
    (walls,) = axis.collections
    discs = [(*each.center, each.radius) for each in axis.patches if isinstance(each, Circle)]
    corners = [
        each.get_patch_transform().transform(each.get_path().vertices[:4])
        for each in axis.patches
        if isinstance(each, Rectangle)
    ]
    return np.reshape(walls.get_segments(), (-1, 4)), discs, corners


GRID = CoverageGrid((0.0, 0.0), (4.0, 2.0), 8, 4)


def patrol_row(name, place, hits):
    """Return a patrol that stays at a place for 3 s and at another one for 1 s."""
    track = np.array([place, place, place, place, (3.5, 1.75)])
    dwell = visits(np.arange(0.0, 5.0), *track.T, GRID).dwell
    dwell[3, 1] = math.nan  # x 0.5 to 1, y 1.5 to 2 does not count
    return {'controller': name, 'seed': 1, 'track': track.tolist(), 'dwell': dwell.tolist(),
            'hits': hits}  # fmt: skip


DRAWN = PatrolStudy(
    SimpleNamespace(arena=(0.0, 0.0, 4.0, 2.0)),
    ResultTable(
        [
            patrol_row(OURS, (0.25, 0.25), [(4.0, 0.5), (3.2, 1.7)]),
            patrol_row('random walk', (2.75, 0.75), [(1.0, 1.3)]),
        ]
    ),
    WORLD,
)


def test_heat_maps_are_where_the_robot_was():
    """Between the walls and axes of the room: the picture of an array begins at the top."""
    *axes, bar = patrol_comparison.draw_heat_maps(DRAWN).axes
    for axis, row, place in zip(axes, DRAWN.table, ((0.25, 0.25), (2.75, 0.75)), strict=True):
        assert title(axis) == row['controller']
        even = 4.0 / 31  # s in each of the cells that count
        assert 3.0 / even <= value_at(axis, *place) < 4.0 / even
        entered = {(x, y) for x, y in GRID.centres().reshape(-1, 2).tolist()
                   if value_at(axis, x, y) > 0.0}  # fmt: skip
        steps = np.linspace(place, (3.5 - 1e-9, 1.75 - 1e-9), 1000)
        assert entered == {(*cell,) for cell in (0.5 * np.floor(2.0 * steps) + 0.25).tolist()}
        assert np.ma.is_masked(value_at(axis, 0.75, 1.75))
        assert axis.images[0].get_clim() == (0.0, 3.0)
        assert walls_of(axis)[0] == pytest.approx(WORLD.segments)
        assert (axis.get_xlim(), axis.get_ylim()) == (
            pytest.approx((-0.1, 4.1)),
            pytest.approx((-0.1, 2.1)),
        )
        dark, pale = (axis.images[0].cmap(each)[0] for each in (1.0, 0.0))
        assert dark < pale
    assert bar.get_ylabel() == 'time in the cell / even share'


def test_patrols_are_drawn_with_their_hits_and_the_room():
    for axis, row in zip(patrol_comparison.draw_paths(DRAWN).axes, DRAWN.table, strict=True):
        assert title(axis) == row['controller']
        hits, path = axis.lines
        assert hits.get_xydata() == pytest.approx(np.array(row['hits']))
        assert to_hex(hits.get_color()) == '#f59e0b'  # orange, as the title says
        assert (hits.get_marker(), hits.get_linestyle()) == ('.', 'None')
        assert path.get_xydata() == pytest.approx(np.array(row['track']))
        assert axis.get_aspect() == 1.0
        segments, discs, (corners,) = walls_of(axis)
        assert segments == pytest.approx(WORLD.segments)
        assert discs == [(3.0, 0.5, 0.4), (1.0, 1.5, 0.2)]
        along, across = (
            size / 2 * np.array((math.cos(yaw), math.sin(yaw)))
            for size, yaw in ((0.8, math.pi / 6), (0.2, 2 * math.pi / 3))
        )
        middle = np.array((2.0, 1.0))
        assert corners == pytest.approx(
            np.array([middle + a * along + b * across for a, b in
                      ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        )  # fmt: skip


def test_tracked_paths_have_the_drives_of_their_methods():
    paths = [*TRACKED_PATHS][:2]
    colours = {'path': '#9ca3af', TRACKER: '#be123c', 'pure pursuit': '#0284c7'}
    methods = ('pure pursuit', TRACKER, 'with the default gains')
    tracks = {
        (path, method): np.array([[k, 2.0 * n], [k + 1.0, 3.0 * n]])
        for k, path in enumerate(paths)
        for n, method in enumerate(methods, 1)
    }
    table = ResultTable(
        [{'path': path, 'controller': method, 'seed': 1, 'track': track}
         for (path, method), track in tracks.items()]
    )  # fmt: skip
    study = TrackingStudy(TrackingPlan(paths, (1,), methods), table)
    first, second, *empty = path_tracker_comparison.draw_tracks(study).axes
    for axis, path in zip((first, second), paths, strict=True):
        shown = lines(axis)
        assert shown.keys() == colours.keys()
        assert pytest.approx(TRACKED_PATHS[path]()) == shown.pop('path').T
        for name, drawn in shown.items():
            assert pytest.approx(tracks[path, name]) == drawn.T
        assert {each.get_label(): to_hex(each.get_color()) for each in axis.lines} == colours
        assert texts(axis) == (path, 'x / m', 'y / m')
    assert not any(axis.get_visible() for axis in empty)


def test_the_first_divergence_and_all_of_them_are_shown(caught, tmp_path):
    """Both runs and the tolerance; below, pale where all agree, dark beyond the tolerance."""
    time = 5.0 + 0.1 * np.arange(100)
    was = {name: np.full(100, 2.0) for name in ('command', 'speed', 'estimate')}
    was['estimate'][:50] = np.nan  # not recorded before 10 s
    now = {name: values.copy() for name, values in was.items()}
    now['speed'][20:25] += 0.5
    now['estimate'][80:] += 1.0
    rows = tuple(
        FieldComparison(name, 100, 1.0, 1.0, beyond, when, first)
        for name, beyond, when, first in (
            ('command', 0, math.nan, -1), ('speed', 5, 7.0, 20), ('estimate', 20, 13.0, 80)
        )
    )  # fmt: skip
    tolerances, compared = Tolerances(0.01, 0.1), np.ones(100, dtype=bool)
    outcome = Comparison(rows, tolerances, time, was, now, compared, (), ())
    replay_comparison.write_divergence_figure(outcome, tmp_path / 'x.png')
    close, apart, axis = caught[0].axes
    assert title(close) == 'speed'
    shown = {name: y for name, (_, y) in (lines(close) | lines(apart)).items()}
    near = (time >= 6.5) & (time <= 8.5)
    assert shown['recorded'] == pytest.approx(was['speed'][near])
    assert shown['recomputed'] == pytest.approx(now['speed'][near])
    assert shown['tolerance'] == pytest.approx(0.01 + 0.1 * 2.0)
    assert max(shown['difference']) == pytest.approx(0.5)
    names = [each.get_text() for each in axis.get_yticklabels()]
    places = dict(zip(names, axis.get_yticks(), strict=True))
    assert places.keys() == was.keys()
    for name, same, dark in (
        ('command', (5.5, 7.1, 13.5), ()),
        ('speed', (5.5, 9.0, 13.5), (7.1,)),
        ('estimate', (11.0,), (13.2, 14.5)),
    ):
        assert [value_at(axis, when, places[name]) for when in same] == [0.0] * len(same), name
        assert [value_at(axis, when, places[name]) for when in dark] == [1.0] * len(dark), name
    assert np.ma.is_masked(value_at(axis, 7.1, places['estimate']))
    assert places['command'] < places['speed'] < places['estimate']
    assert axis.yaxis_inverted()  # the first at the top
    colours = [to_hex(axis.images[0].cmap(level)) for level in (0.0, 1.0)]
    assert colours == ['#d1fae5', RED]
    assert axis.get_xlabel() == 'time / s'


def test_solutions_of_the_chaotic_system_are_drawn_by_state():
    time = np.linspace(0.0, 1.0, 50)
    states = np.column_stack([np.sin(time), 2.0 + time, time**2])
    solution = ChaosSolution(time, states, SimpleNamespace(size=3), 0.001)
    axes = solution.plot().axes
    for k, axis in enumerate(axes):
        assert title(axis) == f'y{k + 1}'
        assert axis.lines[0].get_xydata() == pytest.approx(np.column_stack([time, states[:, k]]))
    assert axes[-1].get_xlabel() == 'time / s'
    (axis,) = solution.plot(plane=True).axes
    assert axis.lines[0].get_xydata() == pytest.approx(states[:, :2])
    assert texts(axis)[1:] == ('y1', 'y2')


def test_a_figure_of_a_page_is_made_of_lines_and_repeatable():
    def draw(values):
        figure, axis = figure_style.new_figure(2.0)
        axis.plot(values)
        return figure

    files = {
        kind: [
            figure_style.file_of(figure_style.drawing(draw, [1.0, 3.0, 2.0]), kind)
            for _ in range(2)
        ]
        for kind in figure_style.DATES
    }
    assert all(first == again for first, again in files.values())
    assert files['png'][0].startswith(b'\x89PNG')
    assert files['pdf'][0].startswith(b'%PDF')
    assert b'<path' in files['svg'][0]
    assert b'<image' not in files['svg'][0]


@pytest.mark.parametrize(
    ('values', 'near', 'scale'),
    [
        ([0.0090, 0.0095], 0.0, 'linear'),
        ([0.0, 0.0], 0.0, 'linear'),
        ([0.003, 2.2], 0.0, 'log'),
        ([-0.005, 0.0057], 0.01, 'linear'),
        ([-0.3, 0.02], 0.01, 'symlog'),
    ],
)
def test_the_ticks_of_an_axis_are_plain_numbers(values, near, scale):
    """Differences within 0.01 rad/s had ticks like -5.07817 x 10^-3."""
    figure, panel = figure_style.new_figure(2.0)
    panel.plot(values, values, 'o')
    figure_style.scale_by_size(panel, 'x', values, near)
    assert panel.get_xscale() == scale
    figure.canvas.draw()
    shown = [text.get_text() for text in panel.get_xticklabels() if text.get_text()]
    assert len(shown) >= 2
    for text in shown:
        assert re.fullmatch(r'[-\u2212]?[0-9.e-]{1,7}', text), text
