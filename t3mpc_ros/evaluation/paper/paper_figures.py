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
"""Figures of the paper: the single runs that they show, the claims decided from them, drawings."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
import math
import re
from textwrap import wrap
from typing import Any

from matplotlib.ticker import MaxNLocator
import numpy as np
from numpy.typing import NDArray

from t3mpc_ros.chaos.reference import ReferenceParameters
from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.control.controller import WHEELS
from t3mpc_ros.evaluation import figure_style
from t3mpc_ros.evaluation.cases import NOMINAL
from t3mpc_ros.evaluation.confidence_intervals import rms
from t3mpc_ros.evaluation.experiment import Row, map_jobs, recorded_run
from t3mpc_ros.evaluation.fuzzy_estimation_error import (
    KINDS,
    NORMALISED_GAIN,
    SETTLE,
    estimate,
    estimator,
    simulate_open_loop,
    torque_robot,
)
from t3mpc_ros.evaluation.html_page import thinned
from t3mpc_ros.evaluation.method_table import FULL, methods
from t3mpc_ros.evaluation.paper.claims import REFERENCE_SPREAD, Claim
from t3mpc_ros.evaluation.paper.paper_study import (
    PAPER_NOISE,
    PARTS,
    SETTLING,
    STAGES,
    WITHOUT,
    Extent,
    Results,
    label,
    rank,
)
from t3mpc_ros.evaluation.run_record import START, Record, switch_times
from t3mpc_ros.evaluation.scenario import PLANT_OF, Scenario
from t3mpc_ros.evaluation.topic_roles import ODOMETRY, REFERENCE, TRUTH
from t3mpc_ros.geometry.kinematics import WheelGeometry, advance_pose, twist_from_wheels
from t3mpc_ros.geometry.types import ORIGIN, Array, WheelSpeeds

NO_PREVIEW = WITHOUT['preview']
PORTRAITS = 6
"""How many phase portraits are compared, the full controller's among them."""
FOLLOWS = 0.10
"""Settled RMSE over the reference's spread that counts as following under noise."""
LONG_ENOUGH = 59.0
"""Length of a run that the claims are about, s; a shorter one cannot refute them."""
EXPLAINS = 0.5
"""Share of the unknown acceleration's variance that an estimate must explain to follow it."""


@dataclass(frozen=True, slots=True)
class FigureRuns:
    """One run of each kind, all with the same seed and the paper's noise."""

    torque: Record
    """The full controller in the paper's parameter."""
    velocity: Record
    """The full controller as the nodes close the loop."""
    blind: Record
    """The same without preview."""
    portraits: Mapping[str, Record]
    """Of several methods in the paper's parameter, the full controller first."""
    pairs: tuple[tuple[int, int], ...]
    """Signals, from 1, that drive right and left wheel in each mode."""
    driven: Array
    """True speeds of a robot without a controller (86) after it has settled, rad/s, shape
    (n, 2)."""
    estimated: Mapping[str, Array]
    """Their estimates by each kind of fuzzy system."""

    def claims(self) -> list[Claim]:
        """Return the paper's claims on single runs, decided for these."""
        return [decide(self.torque) for decide in (switches_claim, follows_claim, estimate_claim)]


def simulate_figure_runs(extent: Extent, results: Results, workers: int | Executor) -> FigureRuns:
    """Return the runs that are drawn, with the first held-out seed."""
    seed = extent.seeds[0]
    shown = portrait_methods(results)
    wanted = [('torque', name) for name in shown]
    wanted += [('velocity', FULL), ('velocity', NO_PREVIEW)]
    jobs = []
    for drive, name in wanted:
        scenario = Scenario(PLANT_OF[drive], NOMINAL, seed, extent.duration, PAPER_NOISE)
        jobs.append((scenario, methods(drive)[name]))
    found = dict(zip(wanted, map_jobs(recorded_run, jobs, workers), strict=True))
    alone = simulate_open_loop(torque_robot(PAPER_NOISE, seed), SETTLE + extent.duration, seed)
    first = round(SETTLE / alone.period)
    return FigureRuns(
        torque=found['torque', FULL],
        velocity=found['velocity', FULL],
        blind=found['velocity', NO_PREVIEW],
        portraits={name: found['torque', name] for name in shown},
        pairs=ReferenceParameters().switching.pairs,
        driven=alone.speeds[first:],
        estimated={
            kind: estimate(alone, estimator(kind, PAPER_NOISE, NORMALISED_GAIN))[0][first:]
            for kind in KINDS
        },
    )


def portrait_methods(results: Results) -> list[str]:
    """Return the methods of the phase portraits: proposed, other fuzzy kinds, best baselines."""
    rows = results.methods('torque')
    kinds = re.compile(r'fuzzy|type.?[12]\b|\bi?t[12]\b', re.IGNORECASE)
    fuzzy = [row['controller'] for row in rows if kinds.search(row['controller'])]
    best = sorted((row for row in rows if row['baseline']), key=lambda row: rank(row['rmse_mean']))
    return list(dict.fromkeys([FULL, *fuzzy, *(row['controller'] for row in best)]))[:PORTRAITS]


def estimated_unknown(run: Record) -> Array:
    """Return g of (31) as the law used it, rad/s², shape (n, 2): its term in (66) is -g."""
    return -run['terms'][:, TERM_NAMES.index('fuzzy')]


def true_unknown(run: Record) -> Array:
    """Return chi' - u of (30), from the true speeds over each period, rad/s², shape (n - 1, 2)."""
    period = (run.time[-1] - run.time[0]) / (run.time.size - 1)
    found: Array = np.diff(run.speeds, axis=0) / period - run['acceleration'][:-1]
    return found


def explained(run: Record) -> tuple[float, float]:
    """Return the share of the unknown acceleration that g explains, of right and left wheel.

    1 - mean((unknown - g)²)/var(unknown) after the start: 1 is perfect, 0 no better than the
    mean, negative worse than that.
    """
    counted = run.time[:-1] >= START
    target = true_unknown(run)[counted]
    miss = target - estimated_unknown(run)[:-1][counted]
    shares = 1.0 - np.mean(miss**2, axis=0) / np.var(target, axis=0)
    return float(shares[0]), float(shares[1])


def switches_claim(run: Record) -> Claim:
    """Decide whether the reference changes its signals as often as in the paper's run."""
    count = switch_times(run.time, run['mode']).size
    verdict = 'held' if count == 4 else 'not held'
    return Claim(
        'four switches',
        'paper',
        'The reference changes its signals four times in a run, suddenly (60 s here)',
        f'{count} switches in {run.time[-1]:.0f} s',
        verdict if run.time[-1] > LONG_ENOUGH else 'not measured',
        {'switches': count},
    )


def follows_claim(run: Record) -> Claim:
    """Decide whether the outputs follow between switches, in the run that is drawn."""
    settled = run.rmse(START, margins=SETTLING)
    return _of_run(
        run,
        'outputs follow',
        'The outputs track the switching references very well (here: settled RMSE at most '
        f'{100 * FOLLOWS:.0f} % of the reference, torque drive, noise {PAPER_NOISE:g}, run shown)',
        f'settled RMSE {settled:.3f} rad/s, {100 * settled / REFERENCE_SPREAD:.1f} %',
        settled <= FOLLOWS * REFERENCE_SPREAD,
        {'settled': settled},
    )


def estimate_claim(run: Record) -> Claim:
    """Decide whether the fuzzy systems' estimates follow the true unknown acceleration."""
    right, left = explained(run)
    return _of_run(
        run,
        'estimates follow',
        'The estimated signals follow their targets (here: they explain at least '
        f'{100 * EXPLAINS:.0f} % of the variance on both wheels, run shown)',
        f'{100 * right:.0f} % of the variance explained on the right, {100 * left:.0f} % left',
        min(right, left) >= EXPLAINS,
        {'right': right, 'left': left},
    )


def _of_run(
    run: Record, name: str, text: str, found: str, held: bool, numbers: dict[str, object]
) -> Claim:
    """Return the claim with its verdict; a short run refutes nothing."""
    refuted = 'not held' if run.time[-1] > LONG_ENOUGH else 'inconclusive'
    return Claim(name, 'paper', text, found, 'held' if held else refuted, numbers)


def largest_switch(run: Record) -> int | None:
    """Return the row of the switch with the largest jump, None when there is none.

    Switches so near the end that nothing of what follows could be shown do not count, unless
    there are no others.
    """
    rows = np.flatnonzero(np.diff(run['mode']) != 0) + 1
    early = rows[run.time[rows] < run.time[-1] - 3.0]
    rows = early if early.size else rows
    if not rows.size:
        return None
    jumps = np.abs(run.reference[rows] - run.reference[rows - 1]).sum(axis=1)
    return int(rows[int(np.argmax(jumps))])


def broken_at_switches(run: Record, values: Sequence[Array] | Array) -> Array:
    """Return ``values`` (n, 2) with a gap before each switch: a jump is no line in a portrait."""
    rows = np.flatnonzero(np.diff(run['mode']) != 0) + 1
    return np.insert(np.asarray(values, dtype=np.float64), rows, np.nan, axis=0)


# -- figures --------------------------------------------------------------------------------------

REFERENCE_COLOUR, DRIVEN = figure_style.COLOURS[REFERENCE], figure_style.COLOURS[TRUTH]
COMMAND, MEASURED = figure_style.COLOURS['applied'], figure_style.COLOURS[ODOMETRY]


def path(showcase: FigureRuns) -> Any:
    """Return the path on the floor of the simulated robot, the paper's Fig. 8."""
    run = showcase.velocity
    figure, axis = figure_style.new_figure(5.0)
    reference, driven = floor_path(run.reference, run.time), floor_path(run.speeds, run.time)
    axis.plot(*reference.T, color=REFERENCE_COLOUR, linewidth=1.0, label='reference')
    axis.plot(*driven.T, color=DRIVEN, linewidth=1.6, label='driven')
    axis.plot(*driven[0], 'o', color=REFERENCE_COLOUR, markersize=6, label='start')
    at = driven[1:][np.diff(run['mode']) != 0]
    axis.plot(*at.T, 'D', color=figure_style.COLOURS['switch'], markersize=5, label='switch')
    axis.set_aspect('equal', adjustable='datalim')
    axis.set(xlabel='x / m', ylabel='y / m')
    figure_style.legend_above(figure, axis)
    return figure


def floor_path(speeds: Array, time: Array) -> Array:
    """Return places (m) on the way of a robot whose wheels turn so, shape (n, 2), from (0, 0).

    The body motion (1)-(3) is integrated in exact arcs, a wheel's speed (rad/s, right first) held
    at the mean of both ends of a period.
    """
    geometry = WheelGeometry()
    places = np.zeros((time.size, 2))
    pose = ORIGIN
    middles = 0.5 * (speeds[1:] + speeds[:-1])
    for k, (dt, wheels) in enumerate(zip(np.diff(time), middles, strict=True), 1):
        twist = twist_from_wheels(WheelSpeeds(float(wheels[0]), float(wheels[1])), geometry)
        pose = advance_pose(pose, twist, float(dt))
        places[k] = pose.x, pose.y
    return places


def path_in_words(showcase: FigureRuns) -> str:
    """Return how long the way was and where it ended."""
    run = showcase.velocity
    reference, driven = floor_path(run.reference, run.time), floor_path(run.speeds, run.time)
    way = float(np.hypot(*np.diff(driven, axis=0).T).sum())
    apart = float(np.hypot(*(driven[-1] - reference[-1])))
    return (
        f'A simulated robot: after {way:.1f} m in {run.time[-1]:.0f} s it is {apart:.2f} m from '
        'where the reference alone would have led, with nothing that corrects its place.'
    )


def portrait_in_words(showcase: FigureRuns) -> str:
    """Return how closely the simulated robot's wheels followed."""
    run = showcase.velocity
    settled = run.rmse(margins=SETTLING)
    return f'A simulated robot: RMSE {run.rmse():.3f} rad/s, settled {settled:.3f} rad/s.'


def portrait(run: Record) -> Any:
    """Return the phase portrait of the wheels and of their reference, Fig. 9 and 14."""
    figure, ((left, right),) = figure_style.new_figure(3.4, (1, 2), sharex=True, sharey=True)
    # The robot's way through a switch is part of its portrait, the reference's jump is not.
    reference = broken_at_switches(run, run.reference)
    for axis, values, colour, title in (
        (left, reference, REFERENCE_COLOUR, 'reference'),
        (right, run.speeds, DRIVEN, 'robot'),
    ):
        axis.plot(values[:, 1], values[:, 0], color=colour, linewidth=0.8)
        axis.set(title=title, xlabel='left wheel / rad/s')
    left.set_ylabel('right wheel / rad/s')
    return figure


def modes(showcase: FigureRuns) -> Any:
    """Return which chaotic signal drives which output, the paper's Fig. 10."""
    run = showcase.torque
    figure, axes = figure_style.new_panels(2, 1.25)
    index = run['mode'].astype(int) % len(showcase.pairs)
    signals = np.array(showcase.pairs)[index]
    end = run.time[-1] + run.time[1] - run.time[0]
    for axis, wheel, column in zip(axes, WHEELS, signals.T, strict=True):
        starts = np.concatenate(([0], np.flatnonzero(np.diff(column)) + 1))
        edges = np.append(run.time[starts], end)
        for left, right, k in zip(edges[:-1], edges[1:], starts, strict=True):
            axis.plot((left, right), (column[k],) * 2, color=COMMAND, linewidth=4.0)
        axis.step(run.time, column, where='post', color=COMMAND, linewidth=0.8)
        axis.set_title(f'signal that drives the {wheel} wheel')
        axis.set_yticks((1, 2, 3, 4), [f'$y_{k}$' for k in (1, 2, 3, 4)])
        axis.set_ylim(0.5, 4.5)
    _name_time(axes[-1])
    return figure


def outputs(showcase: FigureRuns) -> Any:
    """Return both outputs with their references, whole run and one switch, the paper's Fig. 11."""
    run = showcase.torque
    dots = {'color': MEASURED, 'marker': '.', 'linestyle': '', 'ms': 2.5, 'label': 'measured'}
    reference = {'color': REFERENCE_COLOUR, 'lw': 1.0, 'label': 'reference'}
    driven = {'color': DRIVEN, 'lw': 1.2, 'label': 'robot'}
    columns = ((run.reference, reference), (run.speeds, driven))
    samples = run['measured'], dots
    figure, axes = run_and_zoom(run, 'speed / rad/s', 0.4, 1.6, columns, samples)
    figure_style.legend_above(figure, axes[0][-1])
    return figure


def control(showcase: FigureRuns) -> Any:
    """Return the control signals with their total variation, the paper's Fig. 12."""
    run = showcase.torque
    effort = run['acceleration']
    columns = ((effort, {'color': COMMAND, 'lw': 1.0}),)
    figure, axes = run_and_zoom(run, 'u / rad/s²', 0.4, 1.6, columns)
    varied = np.abs(np.diff(effort, axis=0)).sum(axis=0) / (run.time[-1] - run.time[0])
    for axis, wheel, rate in zip(axes[:, 0], WHEELS, varied, strict=True):
        axis.set_title(f'{wheel} wheel, varies by {rate:.0f} rad/s² a second')
    return figure


def estimates(showcase: FigureRuns) -> Any:
    """Return the estimates g with their targets, the paper's Fig. 13."""
    run = showcase.torque
    target = {
        'color': figure_style.COLOURS['target'],
        'lw': 0.9,
        'label': 'unknown, $\\dot\\chi - u$',
    }
    found = {'color': figure_style.COLOURS['estimate'], 'lw': 1.3, 'label': 'estimate g'}
    columns = ((true_unknown(run), target), (estimated_unknown(run)[:-1], found))
    figure, axes = run_and_zoom(run, 'rad/s²', 2.0, 4.0, columns)
    for axis, wheel, share in zip(axes[:, 0], WHEELS, explained(run), strict=True):
        axis.set_title(f'{wheel} wheel, {100 * share:.0f} % of the variance explained')
    figure_style.legend_above(figure, axes[0][-1])
    return figure


def preview(showcase: FigureRuns) -> Any:
    """Return both wheels about a switch, with preview and without."""
    run, blind = showcase.velocity, showcase.blind
    middle = largest_switch(run)
    if middle is None:
        return None
    before, after = 0.3, 0.8
    rows = rows_between(run, run.time[middle] - before, run.time[middle] + after)
    time = run.time[rows] - run.time[middle]
    figure, axes = figure_style.new_panels(2, 2.1)
    for axis, i in zip(axes, range(2), strict=True):
        axis.axvline(
            0.0, color=figure_style.COLOURS['switch'], linewidth=0.8, linestyle=(0, (4, 3))
        )
        reference = {'color': REFERENCE_COLOUR, 'lw': 1.0, 'label': 'reference'}
        axis.step(time, run.reference[rows, i], where='post', **reference)
        axis.plot(time, run.speeds[rows, i], color=DRIVEN, lw=1.6, label='with preview')
        axis.plot(time, blind.speeds[rows, i], color='#ea580c', lw=1.6, label='without preview')
        axis.set(title=f'{WHEELS[i]} wheel', ylabel='speed / rad/s')
        axis.margins(x=0.0)
    axes[-1].set_xlabel(f'time from the switch at {run.time[middle]:.0f} s / s')
    figure_style.legend_above(figure, axes[0])
    return figure


Column = tuple[Array, Mapping[str, Any]]
"""Values of both wheels, shape (n, 2), and the style of their line."""


def run_and_zoom(
    run: Record,
    unit: str,
    before: float,
    after: float,
    columns: Sequence[Column],
    samples: Column | None = None,
) -> tuple[Any, Any]:
    """Return a figure with a row per wheel: the whole run, and about its largest switch.

    ``before`` and ``after`` are times about the switch, s; samples are drawn there alone.
    """
    stretches = [np.arange(run.time.size)]
    middle = largest_switch(run)
    if middle is not None:
        switch = run.time[middle]
        stretches.append(rows_between(run, switch - before, switch + after))
    ratios = {'width_ratios': (1.7, 1.0)[: len(stretches)]}
    shape = 2, len(stretches)
    figure, axes = figure_style.new_figure(4.6, shape, sharex='col', gridspec_kw=ratios)
    for i, wheel in enumerate(WHEELS):
        axes[i, 0].set(title=f'{wheel} wheel', ylabel=unit)
        for k, (axis, rows) in enumerate(zip(axes[i], stretches, strict=True)):
            figure_style.mark_switches(axis, switch_times(run.time, run['mode']))
            for values, style in (samples, *columns) if samples and k else columns:
                shown = rows[rows < len(values)]
                axis.plot(*thinned(run.time[shown], values[shown, i]), **style)
    for axis, rows in zip(axes[-1], stretches, strict=True):
        axis.set_xlim(run.time[rows[0]], run.time[rows[-1]])
        axis.xaxis.set_major_locator(MaxNLocator(nbins=6, steps=(1, 2, 5, 10)))
        _name_time(axis)
    for axis in axes[0, 1:]:
        axis.set_title('about a switch')
    return figure, axes


def rows_between(run: Record, begin: float, end: float) -> NDArray[np.intp]:
    """Return the rows with a time (s) in a stretch."""
    return np.flatnonzero((run.time >= begin - 1e-9) & (run.time <= end + 1e-9))


def _name_time(axis: Any) -> None:
    axis.margins(x=0.01)
    axis.set_xlabel('time / s')


OURS = '#be123c'
"""The full controller, in every figure."""
_BASELINE_COLOURS = (
    '#0284c7', '#ea580c', '#15803d', '#7c3aed', '#a16207', '#0891b2',
    '#4338ca', '#db2777', '#65a30d', '#6b7280', '#92400e', '#0f766e', '#38bdf8', '#a78bfa',
    '#1f2937', '#f59e0b',
)  # fmt: skip
_MARKS = 'sD^vPX<>*hd'
_STAGE_COLOURS = ('#cbd5e1', '#94a3b8', '#fbbf24', '#f97316', OURS)
_PART_COLOURS = dict(zip(PARTS, ('#7c3aed', '#a16207', '#db2777', '#0284c7'), strict=True))
KIND_NAMES = {'type3': 'type 3', 'interval_type2': 'interval type 2', 'type1': 'type 1'}


def colours_of(results: Results) -> dict[str, str]:
    """Return one colour per method, the same in every figure."""
    found = dict.fromkeys(results.means.unique('controller'), '#9ca3af')
    for i, name in enumerate(results.means.unique('controller', baseline=True)):
        found[name] = _BASELINE_COLOURS[i % len(_BASELINE_COLOURS)]
    return found | {FULL: OURS}


def rmse_bars(results: Results) -> Any:
    """Return the RMSE with intervals of all methods at the paper's noise."""
    shown = {}
    for drive in results.drives:
        rows = [row for row in results.compared(drive) if math.isfinite(row['rmse_mean'])]
        shown[drive] = sorted(rows, key=lambda row: float(row['rmse_mean']))
    colours = colours_of(results)
    longest = max(map(len, shown.values()))
    height = 0.9 + len(shown) * (0.5 + 0.23 * longest)
    figure, axes = figure_style.new_figure(height, (len(shown), 1))
    for axis, (drive, rows) in zip(axes[:, 0], shown.items(), strict=True):
        places = np.arange(len(rows))
        means, bounds = _bars(rows)
        bar_colours = [colours[row['controller']] for row in rows]
        axis.barh(places, means, xerr=bounds, color=bar_colours, height=0.7, ecolor='#1f2937')
        for place, mean, bound in zip(places, means, bounds, strict=True):
            axis.text(mean + bound, place, f'  {mean:.3f}', va='center', fontsize=8)
        axis.set_yticks(places, [label(row) for row in rows])
        axis.invert_yaxis()
        axis.grid(axis='y', visible=False)
        axis.margins(x=0.12)
        axis.set_xlim(left=0.0)
        axis.set_axisbelow(True)
        axis.set_title(f'{drive} drive, noise {PAPER_NOISE:g}')
    axes[-1, 0].set_xlabel('RMSE / rad/s')
    return figure


def noise_growth(results: Results) -> Any:
    """Return RMSE against noise of every baseline and the proposed controller, and its growth."""
    noises = results.noises
    if len(noises) < 2:
        return None
    colours = colours_of(results)
    baselines = results.means.unique('controller', baseline=True)
    drives, height = results.drives, 5.6 + 0.16 * len(baselines) / 3
    figure, axes = figure_style.new_figure(height, (2, len(drives)), sharex=True, sharey='row')
    for column, drive in zip(axes.T, drives, strict=True):
        for i, name in enumerate([*baselines, FULL]):
            rows = [row for noise in noises if (row := results.row(name, drive, noise))]
            if not rows:
                continue
            x = np.array([row['noise'] for row in rows])
            y, bound = map(np.array, _bars(rows))
            # Beside each other, or the intervals of equal methods hide one another.
            beside = x + 0.006 * noises[-1] * (i - 0.5 * len(baselines))
            own = name == FULL
            style = {
                'color': colours[name],
                'linewidth': 2.2 if own else 1.0,
                'marker': 'o' if own else _MARKS[i % len(_MARKS)],
                'markersize': 6 if own else 4.5,
                'zorder': 5 if own else 2,
            }
            column[0].errorbar(beside, y, bound, label=label(rows[0]), elinewidth=0.8, **style)
            if x[0] == noises[0]:
                column[1].plot(beside, y - y[0], **style)
        column[0].set_title(f'{drive} drive')
        column[1].set_xlabel('noise variance / (rad/s)²')
    axes[0, 0].set_ylim(bottom=0.0)  # not before every line is there: it fixes the top, too
    axes[0, 0].set_ylabel('RMSE / rad/s')
    axes[1, 0].set_ylabel('RMSE less that without noise / rad/s')
    figure_style.legend_above(figure, *axes[0], columns=3)
    return figure


def ablation_bars(results: Results) -> Any:
    """Return the RMSE of the controller's stages in every case at the paper's noise."""
    drives = results.drives
    figure, panels = figure_style.new_figure(0.6 + 2.3 * len(drives), (len(drives), 1))
    width = 0.85 / len(STAGES)
    for axis, drive in zip(panels[:, 0], drives, strict=True):
        cases = results.cases(drive)
        for i, (stage, colour) in enumerate(zip(STAGES, _STAGE_COLOURS, strict=True)):
            rows = [row for case in cases if (row := results.row(stage, drive, PAPER_NOISE, case))]
            places = [cases.index(row['case']) + (i - 2) * width for row in rows]
            means, bounds = _bars(rows)
            axis.bar(
                places, means, width, yerr=bounds, color=colour, ecolor='#1f2937',
                error_kw={'elinewidth': 0.8}, label=f'{stage} (+preview)' if i == 4 else stage,
            )  # fmt: skip
        axis.set_xticks(range(len(cases)), [case.replace(' ', '\n', 1) for case in cases])
        axis.grid(axis='x', visible=False)
        axis.set_axisbelow(True)
        axis.set_ylim(bottom=0.0)
        axis.set(title=f'{drive} drive, noise {PAPER_NOISE:g}', ylabel='RMSE / rad/s')
    figure_style.legend_above(figure, panels[0, 0])
    return figure


def parts(results: Results) -> Any:
    """Return the effect of adding and of leaving out each part, with 95 % intervals."""
    drives = results.drives
    most = max(len(results.cases(drive)) for drive in drives)
    shape, height = (len(drives), len(PARTS)), 1.0 + len(drives) * (0.5 + 0.3 * most)
    figure, axes = figure_style.new_figure(height, shape, sharey='row')
    for row, drive in zip(axes, drives, strict=True):
        cases = results.cases(drive)
        for axis, part, stage in zip(row, PARTS, STAGES[1:], strict=True):
            colour = _PART_COLOURS[part]
            here = {'drive': drive, 'noise': PAPER_NOISE}
            added = results.added.where(first=stage, **here)
            kept = results.lost.where(first=WITHOUT[part], **here)
            axis.axvline(0.0, color='#6b7280', linewidth=0.8)
            for pairs, sign, beside, face, words in (
                (added, 1.0, -0.13, colour, 'added to the stage before'),
                (kept, -1.0, 0.13, 'white', 'kept, against left out'),
            ):
                if pairs:
                    axis.errorbar(
                        [sign * pair['difference'] for pair in pairs],
                        [cases.index(pair['case']) + beside for pair in pairs],
                        xerr=[figure_style.whisker(pair['ci95']) for pair in pairs],
                        fmt='o', markersize=4, elinewidth=1.4, label=words, color=colour,
                        markerfacecolor=face,
                    )  # fmt: skip
            axis.xaxis.set_major_locator(MaxNLocator(nbins=2))
            axis.grid(axis='y', visible=False)
            axis.set_title(part)
        row[0].set_yticks(range(len(cases)), cases)
        row[0].set_ylim(len(cases) - 0.5, -0.5)
        row[0].set_ylabel(f'{drive} drive')
    figure.supxlabel('paired difference of RMSE / rad/s; left of zero: better with it', fontsize=9)
    figure_style.legend_above(figure, axes[0, 0])
    return figure


def portraits(showcase: FigureRuns, results: Results) -> Any:
    """Return phase portraits of several methods in closed loop (Fig. 15)."""
    colours = colours_of(results)
    shown = showcase.portraits
    columns = min(3, len(shown))
    rows = math.ceil(len(shown) / columns)
    shape, height = (rows, columns), 0.6 + 2.2 * rows
    figure, axes = figure_style.new_figure(height, shape, sharex=True, sharey=True)
    for axis in axes.flat[len(shown) :]:
        axis.set_visible(False)
    for axis, (name, run) in zip(axes.flat, shown.items(), strict=False):
        counted = run.time >= START
        reference = broken_at_switches(run, run.reference)
        axis.plot(reference[:, 1], reference[:, 0], color=REFERENCE_COLOUR, linewidth=0.7)
        speeds = run.speeds[counted]
        axis.plot(speeds[:, 1], speeds[:, 0], color=colours[name], linewidth=0.8, alpha=0.9)
        title = '\n'.join(wrap(name, 24)[:2])
        axis.set_title(f'{title}\nRMSE {run.rmse():.3f}, settled {run.rmse(margins=SETTLING):.3f}')
    _name_wheels(axes)
    return figure


def estimation_portraits(showcase: FigureRuns) -> Any:
    """Return phase portraits of (86) by kind of fuzzy system, the paper's Fig. 15."""
    shown = showcase.estimated
    figure, axes = figure_style.new_figure(2.7, (1, len(shown)), sharex=True, sharey=True)
    true = showcase.driven
    palette = (OURS, figure_style.COLOURS['estimate'], figure_style.COLOURS['feedforward'])
    for axis, (kind, found), colour in zip(axes.flat, shown.items(), palette, strict=False):
        miss = rms(found - true)
        axis.plot(found[:, 1], found[:, 0], color=colour, linewidth=0.7, label='estimated')
        axis.plot(true[:, 1], true[:, 0], color=REFERENCE_COLOUR, linewidth=0.8, label='true')
        axis.set_title(f'{KIND_NAMES.get(kind, kind)}\nRMSE {miss:.3f} rad/s')
    _name_wheels(axes)
    return figure


def _name_wheels(axes: Any) -> None:
    for axis in axes[-1]:
        axis.set_xlabel('left wheel / rad/s')
    for axis in axes[:, 0]:
        axis.set_ylabel('right wheel / rad/s')


def _bars(rows: Sequence[Row]) -> tuple[list[float], list[float]]:
    """Return the RMSE of rows and the lengths of their whiskers."""
    return [row['rmse_mean'] for row in rows], [
        figure_style.whisker(row['rmse_ci95']) for row in rows
    ]
