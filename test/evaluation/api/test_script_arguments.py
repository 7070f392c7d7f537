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
"""Every argument of the scripting interface changes what its function does.

A row holds a function, the arguments of a first call, and another value of each of its arguments.
"""

from concurrent.futures import Executor, Future
from functools import cache
from inspect import signature
from pathlib import Path

import matplotlib.figure
import numpy as np
import pytest
from support.equations import linear_decay_system
from support.long_tests import few_of

import t3mpc_ros as t3

pytestmark = pytest.mark.slow

SHORT = {'plant': 'servo', 'duration': 1.0}
PI = 'PI + feed-forward'
SUBMITTED = []


class Inline(Executor):
    """Computes here, and counts."""

    def submit(self, function, /, *arguments, **named):
        SUBMITTED.append(function)
        found = Future()
        found.set_result(function(*arguments, **named))
        return found


class Proportional:
    def __init__(self, model, gain=20.0):
        self.gain = gain

    def step(self, observation):
        return -self.gain * (observation.speeds - observation.reference)


def wave(time):
    return 3.0 * np.sin(time), 2.0 * np.cos(time)


def lag(time, state, command):
    return 40.0 / state.size * (np.resize(command, state.shape) - state)


def slow_lag(time, state, command):
    return 0.5 * lag(time, state, command)


def half(state):
    return 0.5 * state[:2]


def quiet(generator, time, speeds):
    return generator.normal(0.0, 0.1, 2)


def loud(generator, time, speeds):
    return generator.normal(0.0, 0.4, 2)


def run(**changes):
    return t3.simulate(**{'controller': PI, **SHORT, **changes})


def seen(value):
    """Return what a person gets: numbers, texts, and the lines of a picture."""
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, t3.RunResult):
        return value.controller, [seen(column) for column in value.columns.values()]
    if isinstance(value, t3.Comparison):
        return [seen(row) for row in value.results]
    if isinstance(value, t3.Sweep):
        return [
            {name: row[name] for name in ('settled', 'overall', 'variation')} for row in value.rows
        ]
    if isinstance(value, t3.ChaosSolution):
        return seen(value.t), seen(value.y)
    if isinstance(value, t3.FuzzySystem):
        points = np.linspace(-0.9, 0.9, 6).repeat(len(value.inputs)).reshape(6, -1)
        return value.inputs, seen(value.basis(points)), seen(value.coefficients)
    if isinstance(value, matplotlib.figure.Figure):
        lines = [seen(np.asarray(line.get_xydata())) for axis in value.axes for line in axis.lines]
        return lines, [axis.get_ylabel() for axis in value.axes]
    return value


LINKS = t3.LinkFaults(0.2, (0.01, 0.03), 0.2, (0.0, 0.02), 0.2, 0.7)
BLOCK = t3.FaultEvent(2.5, 'wheel_blocked', 'right', 0.5)
SIMULATED = {
    'reference': wave, 'plant': 'torque', 'noise': 0.0, 'faults': LINKS, 'duration': 3.0,
}  # fmt: skip
"""Arguments that simulate, compare and sweep have in common."""
ELSEWHERE = {'executor': Inline(), 'progress': True}


def fault(**changes):
    event = t3.FaultEvent(**changes)
    return t3.simulate(PI, faults=t3.FaultSchedule([event]), duration=4.0)


@cache
def compared():
    cases = ['nominal', 'friction x3']
    return t3.compare([PI, 'ADRC'], seeds=[1, 2], cases=cases, executor=1, **SHORT)


@cache
def swept():
    values = {'gain': [5.0, 40.0], 'noise': [0.0, 0.1]}
    return t3.sweep(PI, values, seeds=[1, 2], executor=1, **SHORT)


def fitted(ridge=1e-6, inputs=((0.1,), (0.4,)), outputs=(1.0, 2.0)):
    return t3.fuzzy('x', sets=3).fit(inputs, outputs, ridge=ridge)


def rules(antecedent, consequent):
    system = t3.fuzzy('x', sets=3)
    system.add_rule(antecedent, consequent)
    return system


def on_robot(**changes):
    path = t3.Waypoints([(0.0, 0.0), (0.2, 0.0), (0.3, 0.2)], speed=0.3, acceleration=2.0)
    return run(plant=t3.Robot(**changes), reference=path)


TABLE = {
    'simulate': (t3.simulate, {'controller': PI, **SHORT}, {
        'controller': 'ADRC', **SIMULATED, 'case': 'friction x3', 'seed': 2,
    }),
    'simulate on the twin': (t3.simulate, {'controller': PI, 'duration': 3.0}, {
        'faults': t3.FaultSchedule([BLOCK]), 'reference': wave, 'noise': 0.1, 'seed': 2,
    }),
    'compare': (t3.compare, {'controllers': PI, 'seeds': [1], 'executor': 1, **SHORT}, {
        'controllers': 'ADRC', **SIMULATED, **ELSEWHERE, 'seeds': [2], 'cases': ['friction x3'],
    }),
    'sweep': (t3.sweep, {
        'controllers': PI, 'parameters': {}, 'seeds': [1], 'executor': 1, **SHORT,
    }, {
        'controllers': 'ADRC', **SIMULATED, **ELSEWHERE, 'seeds': [2], 'cases': ['friction x3'],
        'parameters': {'gain': [7.0]}, 'output': 'new.parquet',
    }),
    'chaos': (t3.chaos, {'tspan': (0.0, 0.2)}, {
        'alpha': 0.95, 'tspan': (0.1, 0.3), 'dt': 0.002, 'y0': np.full(4, 0.5), 'every': 5,
        'system': linear_decay_system(0.9), 'rtol': 1e-6,
    }),
    'fuzzy': (t3.fuzzy, {'sets': 3, 'input_fuzziness': 0.1}, {
        'inputs': ('x', 'y'), 'kind': 'type1', 'sets': 4, 'centres': (-2.0, 1.0), 'spread': 0.5,
        'slices': 3, 'input_fuzziness': 0.2,
    }),
    'Controller': (
        lambda **given: run(controller=t3.Controller(**given)), {'source': Proportional}, {
            'source': 'ADRC', 'settings': {'gain': 5.0}, 'name': 'mine',
        },
    ),
    'FaultEvent': (fault, {'at': 2.5, 'fault': 'command_delay', 'value': 0.1}, {
        'at': 3.0, 'fault': 'command_jitter', 'value': 0.2, 'duration': 0.3,
    }),
    'FaultSchedule': (
        lambda events=(), name='': t3.simulate(
            PI, faults=t3.FaultSchedule(events, name), duration=4.0
        ), {}, {'events': [BLOCK]},
    ),
    'LinkFaults': (lambda **given: run(faults=t3.LinkFaults(**given)), {
        'command_loss': 0.3, 'command_delay': (0.0, 0.02), 'odometry_loss': 0.2,
        'odometry_delay': (0.0, 0.02), 'odometry_swapped': 3, 'odometry_repeated': 2,
        'odometry_kept': 2,
    }, {
        'command_loss': 0.6, 'command_delay': (0.05, 0.08), 'odometry_loss': 0.5,
        'odometry_delay': (0.05, 0.08), 'begin': 0.5, 'lasting': 0.5,
        'odometry_swapped': 5, 'odometry_repeated': 3, 'odometry_kept': 3,
    }),
    'NoiseLaw': (
        lambda **given: run(noise=t3.NoiseLaw(**given)), {'draw': quiet, 'variance': 0.01},
        {'draw': loud, 'variance': 0.1},
    ),
    'OdePlant': (lambda **given: run(plant=t3.OdePlant(**given)), {'right_hand_side': lag}, {
        'right_hand_side': slow_lag, 'output': half, 'drive': 'torque', 'initial': (1.0, 1.0),
        'robot': t3.Robot(dead_time=0.05), 'states': 4,
    }),
    'Robot': (on_robot, {}, {
        'wheel_radius': 0.04, 'wheel_separation': 0.2, 'lag': 0.1, 'dead_time': 0.05,
        'linear_velocity': 0.05, 'angular_velocity': 0.2, 'wheel_velocity': 1.0,
        'linear_acceleration': 0.05, 'angular_acceleration': 0.2, 'wheel_acceleration': 1.0,
        'parameters': {'friction_factor': 3.0},
    }),
    'StateSpace': (
        lambda **given: run(plant=t3.StateSpace(**given)),
        {'A': -20.0 * np.eye(2), 'B': 20.0 * np.eye(2), 'C': np.eye(2)}, {
            'A': -10.0 * np.eye(2), 'B': 10.0 * np.eye(2), 'C': 0.5 * np.eye(2),
            'drive': 'torque', 'initial': (1.0, 1.0), 'robot': t3.Robot(dead_time=0.05),
        },
    ),
    'Waypoints': (
        lambda **given: run(reference=t3.Waypoints(**given)), {'points': [(0, 0), (0.1, 0), (1, 1)]
        }, {'points': [(0, 0), (1, 0)], 'speed': 0.1, 'acceleration': 0.1},
    ),
}  # fmt: skip
METHODS = {
    'rmse': (
        lambda **given: run().rmse(**given), t3.RunResult.rmse, {'after': 0.25}, {'after': 0.5},
    ),
    'plot of a run': (
        lambda **given: run().plot(**given), t3.RunResult.plot, {}, {'path': 'new.png'},
    ),
    'table of a comparison': (
        lambda **given: compared().table(**given), t3.Comparison.table, {},
        {'case': 'friction x3'},
    ),
    'plot of a comparison': (
        lambda **given: compared().plot(**given), t3.Comparison.plot, {},
        {'path': 'new.png', 'case': 'friction x3'},
    ),
    'to_latex': (
        lambda **given: compared().to_latex(**given), t3.Comparison.to_latex,
        {'chosen': 'nominal'},
        {'chosen': 'friction x3', 'columns': ['variation'], 'label': 'a', 'caption': 'b'},
    ),
    'values': (
        lambda **given: compared().values(**given), t3.Comparison.values, {'controller': PI},
        {'controller': 'ADRC', 'metric': 'variation', 'case': 'friction x3'},
    ),
    'difference': (
        lambda **given: compared().difference(**given), t3.Comparison.difference,
        {'controller': 'ADRC'},
        {'controller': PI, 'metric': 'variation', 'case': 'friction x3'},
    ),
    'table of a sweep': (
        lambda **given: swept().table(**given), t3.Sweep.table, {}, {'metric': 'variation'},
    ),
    'plot of a sweep': (
        lambda **given: swept().plot(**given), t3.Sweep.plot, {'parameter': 'gain'},
        {'parameter': 'noise', 'metric': 'variation', 'path': 'new.png'},
    ),
    'plot of chaos': (
        lambda **given: t3.chaos(tspan=(0.0, 0.2)).plot(**given), t3.ChaosSolution.plot, {},
        {'path': 'new.png', 'plane': True},
    ),
    'fit': (fitted, t3.FuzzySystem.fit, {}, {
        'inputs': [(0.2,), (0.5,)], 'outputs': [3.0, 1.0], 'ridge': 0.5,
    }),
    'add_rule': (rules, t3.FuzzySystem.add_rule, {'antecedent': [('x', 0)], 'consequent': 1.0}, {
        'antecedent': [('x', 1)], 'consequent': 2.0,
    }),
}  # fmt: skip
NAMED_ONLY = {'FaultSchedule': {'name'}}
"""Arguments that are no part of a run."""
GIVEN = {
    'BagColumns', 'ChaosSolution', 'Comparison', 'FuzzySystem', 'NominalModel', 'Observation',
    'RunResult', 'ScriptError', 'Sweep', 'read_bag',
}  # fmt: skip
"""What a script gets and does not make, and what has one argument."""


def observed(function, given, capsys):
    """Return what a call gives, says, writes and computes elsewhere."""
    given = dict(given)
    places = given.pop('inputs', ()) if function is t3.fuzzy else ()
    SUBMITTED.clear()
    capsys.readouterr()
    found = seen(function(*places, **given))
    files = sorted(path.name for path in Path().iterdir())
    for name in files:
        Path(name).unlink()
    return found, files, bool(capsys.readouterr().err), len(SUBMITTED)


ROWS = {name: (row[0], row[-2], row[-1]) for name, row in (TABLE | METHODS).items()}


@pytest.mark.parametrize('name', ROWS)
def test_every_argument_changes_what_is_done(name, tmp_path, monkeypatch, capsys):
    """``sweep(..., progress=True)`` without a file showed no progress."""
    monkeypatch.chdir(tmp_path)
    function, base, changes = ROWS[name]
    if 'output' in changes:
        pytest.importorskip('pyarrow')
    first = observed(function, base, capsys)
    if name in METHODS:  # one_run_is_the_same_in_every_function repeats runs
        assert observed(function, base, capsys) == first
    for argument, value in changes.items():
        assert observed(function, {**base, argument: value}, capsys) != first, argument


def test_every_argument_has_a_row():
    assert {*t3.__all__} - {*TABLE} == GIVEN
    for name in {*t3.__all__} - GIVEN:
        own = {*signature(getattr(t3, name)).parameters} - NAMED_ONLY.get(name, set())
        assert own == {*TABLE[name][2]}, name
    for name, (_, method, _, changes) in METHODS.items():
        assert {*signature(method).parameters} - {'self'} == {*changes}, name


@pytest.mark.parametrize('argument', [*SIMULATED, 'seed', 'case', 'controller'])
def test_one_run_is_the_same_in_every_function(argument):
    """``compare(..., faults=...)`` without its faults would be another run than simulate's."""
    value = TABLE['simulate'][2][argument]
    given = {'controller': PI, 'seed': 1, 'case': 'nominal', **SHORT, argument: value}
    alone = t3.simulate(**given).metrics
    controller, seeds, cases = given.pop('controller'), [given.pop('seed')], [given.pop('case')]
    among = t3.compare(controller, seeds=seeds, cases=cases, executor=1, **given).rows()
    many = t3.sweep(controller, {}, seeds=seeds, cases=cases, executor=1, **given).rows
    for (row,) in (among, many):
        assert {name: row[name] for name in alone} == alone


WRITERS = {
    'run': (run, ('to_csv', 'to_parquet', 'plot')),
    'comparison': (compared, ('to_csv', 'to_parquet', 'to_html')),
    'sweep': (swept, ('to_csv', 'to_parquet')),
    'chaos': (lambda: t3.chaos(tspan=(0.0, 0.2)), ('to_csv', 'plot')),
}
ENDS = {'to_csv': '.csv', 'to_parquet': '.parquet', 'to_html': '.html', 'plot': '.png'}


@pytest.mark.parametrize('name', few_of(WRITERS, step=3))
def test_a_file_that_exists_is_replaced(name, tmp_path):
    make, writers = WRITERS[name]
    result = make()
    assert {each for each in dir(result) if each in ENDS} <= {*writers, 'plot'}
    for writer in writers:
        if writer == 'to_parquet':
            pytest.importorskip('pyarrow')
        path = tmp_path / f'file{ENDS[writer]}'
        getattr(result, writer)(path)
        first = path.read_bytes()
        path.write_bytes(b'of an earlier run\n' + 2 * first)
        getattr(result, writer)(f'{path}')
        assert path.read_bytes() == first, writer
        assert [*path.parent.iterdir()] == [path]
        path.unlink()
