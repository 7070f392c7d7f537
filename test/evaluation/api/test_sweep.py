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
"""Sweeps: complete rows, resumption, and the same numbers wherever they are computed."""

from dataclasses import replace
from functools import partial
import math
import os
import re
import signal
import time

import numpy as np
import pytest

import t3mpc_ros as t3
from t3mpc_ros.cli.main import main
from t3mpc_ros.evaluation import run_cache_key
from t3mpc_ros.evaluation.api import parameter_sweep
from t3mpc_ros.evaluation.api.parameter_sweep import make_runs
from t3mpc_ros.evaluation.cases import LinkFaults
from t3mpc_ros.simulation.fault_schedule import FaultEvent, FaultSchedule

SHORT = {'plant': 'servo', 'duration': 2.0}
GAINS = {'gain': [10.0, 20.0]}


class Proportional:
    def __init__(self, model, gain=20.0):
        self.period, self.gain = model.period, gain

    def step(self, observation):
        if self.gain > 1000.0:
            raise ArithmeticError('the gain is too large')
        slope = (observation.next_reference - observation.reference) / self.period
        return slope - self.gain * (observation.speeds - observation.reference)


def _numbers(found):
    names = ('controller', 'gain', 'seed', 'settled', 'overall', 'variation', 'run')
    return [tuple(row[name] for name in names) for row in found.rows]


@pytest.fixture
def counted(monkeypatch):
    """Return the list of the runs that are computed in this process."""
    runs = []
    measured = parameter_sweep.measured_run

    def count(job, numbers):
        runs.append(job)
        return measured(job, numbers)

    monkeypatch.setattr(parameter_sweep, 'measured_run', count)
    return runs


@pytest.mark.slow
def test_a_row_holds_all_that_was_run():
    found = t3.sweep(
        [Proportional, 'ADRC'],
        {'gain': np.array([10.0, 20.0]), 'robot.friction_factor': [1.0, 3.0], 'noise': [0.0]},
        seeds=[2],
        cases=['nominal', 'mass +30 %'],
        executor=1,
        **SHORT,
    )
    assert len(found.rows) == 2 * 2 * 2 * 2
    row = found.rows[0]
    assert row['version'] == t3.__version__
    assert {'commit', 'python', 'reference', 'case', 'duration', 'robot', 'run'} <= {*row}
    assert len({row['run'] for row in found.rows}) == len(found.rows)
    assert all(row['noise'] == 0.0 and row['error'] == '' for row in found.rows)
    one = t3.compare(t3.Controller('ADRC', {'gain': 20.0}), seeds=[2], noise=0.0, **SHORT)
    wanted = {'controller': 'ADRC', 'gain': 20.0, 'robot.friction_factor': 1.0, 'seed': 2}
    wanted |= {'case': 'nominal'}
    (same,) = [each for each in found.rows if wanted.items() <= each.items()]
    assert same['overall'] == one.rows()[0]['overall']
    assert found.table().count('\n') == 1 + 2 * 2 * 2 * 2
    assert found.plot('gain').axes
    with pytest.raises(t3.ScriptError, match='metric must be one of .*settled.*: got drift'):
        found.plot('gain', 'drift')  # it drew an empty figure


def test_a_run_that_fails_is_a_row_with_its_reason():
    """A sweep of a night must not end at its worst corner."""
    found = t3.sweep(Proportional, {'gain': [10.0, 2000.0]}, seeds=[1], executor=1, **SHORT)
    good, bad = found.rows
    assert good['error'] == ''
    assert 'raised ArithmeticError (the gain is too large)' in bad['error']
    assert 'overall' not in bad
    assert '| failed [1] |' in found.table()
    with pytest.raises(t3.ScriptError, match='every run failed: .*the gain is too large'):
        t3.sweep(Proportional, {'gain': [2000.0]}, seeds=[1], executor=1, **SHORT)


class Made:
    def step(self, observation):
        return np.zeros(2)


def still(observation):
    return np.zeros(2)


def drives(observation):
    return np.full(2, 20.0)


def raises(observation):
    raise RuntimeError('no sensor & no_file')


def runaway(time, state, command):
    return np.where(np.abs(state) > 1.0, 1e3 * state * np.abs(state), command - state)


def test_a_table_says_which_runs_failed_and_which_diverged():
    """Every failure, a misspelt parameter too, was *diverged* in a table for a paper."""
    plant = t3.OdePlant(runaway)
    found = t3.sweep(
        [still, drives, raises], {}, plant=plant, seeds=[1, 2], executor=1, duration=2.0
    )
    outcomes = [line.split('|')[4].strip() for line in found.table().splitlines() if '|' in line]
    assert outcomes[3:] == ['diverged [1]', 'failed [2]']
    for shown in (str(found), found._repr_html_(), found.to_latex()):
        assert re.search(r'\[1\] seed 1: diverged at \d.\d\d s: the wheel speeds before', shown)
        assert re.search(r'\[2\] seed 1: raises raised RuntimeError \(no sensor', shown)
    assert r'no sensor \& no\_file' in found.to_latex()
    assert [row['error'][:8] for row in found.rows[:3]] == ['', 'diverged', 'raises r']
    assert '–' in found.table('yaw rate'), 'a metric that this robot lacks'
    rows = [{**row, 'seed': k, 'controller': 'a'} for k, row in enumerate(found.rows)]
    mixed = parameter_sweep.Sweep(rows, ())
    assert '| 2 of 6 failed, 2 of 6 diverged [1] |' in mixed.table()


def test_a_run_that_failed_is_made_again_from_the_file(tmp_path, counted):
    """A continued file with such a row could not be printed, and kept it for ever."""
    pytest.importorskip('pyarrow')
    make = partial(
        t3.sweep,
        *([still, drives, raises], {}),
        plant=t3.OdePlant(runaway),
        seeds=[1],
        duration=2.0,
        executor=1,
        output=tmp_path / 'sweep.parquet',
    )
    first, again = make(), make()
    assert [job[1].name for job in counted] == ['still', 'drives', 'raises', 'raises']
    assert again.table() == first.table()
    assert '| failed [2] |' in again.table()
    assert [*tmp_path.iterdir()] == [tmp_path / 'sweep.parquet']


@pytest.mark.parametrize(
    ('arguments', 'text'),
    [
        ((['full', Proportional], {'gain': [20.0]}), 'full, gain 20.0: there is no .* law.gain.*'),
        (('full', {'law.gain': [90.0, 20.0]}), 'law.gain 20.0: law.gain must be from 77.* got 20'),
        ((Proportional, {'gian': [20.0]}), 'settings of Proportional must be gain: got gian'),
        ((still, {'gain': [20.0]}), 'settings of still must be none: got gain'),
        ((t3.Controller(Made()), {'gain': [1.0]}), 'must be given to its class'),
    ],
)
def test_what_simulate_refuses_is_refused_before_any_run(arguments, text, counted):
    with pytest.raises(t3.ScriptError, match=f'no run was begun: .*{text}') as caught:
        t3.sweep(*arguments, seeds=[1], executor=1)
    assert not counted
    several = 'sweep each with its own' in str(caught.value)
    assert several == isinstance(arguments[0], list)


def test_a_sweep_with_more_values_runs_only_these(tmp_path, counted):
    parquet = pytest.importorskip('pyarrow.parquet')
    path = tmp_path / 'sweep.parquet'
    t3.sweep(Proportional, GAINS, seeds=[1], executor=1, output=path, **SHORT)
    more = {'gain': [10.0, 20.0, 30.0]}
    found = t3.sweep(Proportional, more, seeds=[1], executor=1, output=path, **SHORT)
    assert len(counted) == 3
    assert [row['gain'] for row in found.rows] == [10.0, 20.0, 30.0]
    t3.sweep('ADRC', {}, seeds=np.arange(1, 2), executor=1, output=path, **SHORT)
    table = parquet.read_table(path)
    assert sorted(table['controller'].to_pylist()) == ['ADRC', *['Proportional'] * 3]
    assert table.schema.metadata[b'version'] == t3.__version__.encode()


def test_another_controller_of_the_same_name_is_run_anew(tmp_path, counted):
    pytest.importorskip('pyarrow')
    path, script = tmp_path / 'sweep.parquet', tmp_path / 'mine.py'
    text = 'import numpy as np\ndef step(observation):\n    return np.full(2, GAIN)\n'
    for gain in ('1.0', '2.0', '1.0'):
        script.write_text(text.replace('GAIN', gain))
        t3.sweep(f'{script}:step', {}, seeds=[1], executor=1, output=path, **SHORT)
    assert len(counted) == 2


def right_hand_side(time, state, command):
    return np.resize(command, state.shape) - state


def other_side(time, state, command):
    return np.resize(command, state.shape) - 2.0 * state


def first_noise(generator, time, speeds):
    return generator.normal(0.0, 0.1, 2)


def other_noise(generator, time, speeds):
    return generator.normal(0.0, 0.2, 2)


def first(state):
    return state[:2]


SERVO, TWIN = SHORT, {'plant': 'twin', 'duration': 2.0}
LINKS = LinkFaults(0.1, (0.01, 0.02), 0.2, (0.0, 0.01), 0.5, 1.0)
EVENT = FaultEvent(0.5, 'gyro_dead', True, 1.0)
ODE, SPACE = t3.OdePlant(right_hand_side), t3.StateSpace(-np.eye(2), np.eye(2), np.eye(2))
VALUES = {
    'reference': [np.ones((300, 2)), np.zeros((300, 2))],
    'noise': [0.1, t3.NoiseLaw(first_noise, 0.1), t3.NoiseLaw(other_noise, 0.1)],
    'faults': [LINKS, replace(LINKS, lasting=2.0)],
    'duration': [3.0],
    'plant': [
        'torque',
        *(t3.Robot(), t3.Robot(lag=0.05), t3.Robot(linear_velocity=0.3)),
        *(ODE, replace(ODE, right_hand_side=other_side), replace(ODE, initial=(1.0, 1.0))),
        *(replace(ODE, robot=t3.Robot(lag=0.05)), replace(ODE, output=first)),
        *(SPACE, replace(SPACE, A=-2.0 * np.eye(2)), replace(SPACE, drive='torque')),
    ],
}
"""Values of the arguments of a sweep, each another run; content_of has every field of them."""
SETTINGS = [
    *(SERVO, TWIN),
    *({**SERVO, name: value} for name, values in VALUES.items() for value in values),
    *({**TWIN, 'faults': FaultSchedule([replace(EVENT, at=at)])} for at in (0.5, 0.6)),
]
CONTROLLERS = [
    'ADRC',
    *(t3.Controller(Proportional, {'gain': gain}, 'a') for gain in (10.0, 11.0)),
    t3.Controller(Proportional, {'gain': 10.0}, 'b'),
    t3.Controller('PI + feed-forward', name='a'),
]


def keys(setting=SERVO, controllers='ADRC', parameters=None, seeds=(1,), cases=('nominal',)):
    return [run.key for run in make_runs(controllers, parameters or {}, seeds, cases, setting)]


def test_the_key_of_a_run_changes_with_all_that_determines_it():
    """A sweep once took stale runs from its file after another input had changed."""
    found = [keys(setting)[0] for setting in SETTINGS]
    found += [keys(controllers=each)[0] for each in CONTROLLERS[1:]]
    found += keys(parameters={'robot.friction_factor': [2.0]})
    assert len({*found}) == len(SETTINGS) + len(CONTROLLERS)
    assert [keys(setting)[0] for setting in SETTINGS] == found[: len(SETTINGS)]


def test_the_key_of_a_run_changes_with_its_place_in_the_sweep(monkeypatch):
    found = keys(parameters={'gain': [10.0, 20.0]}, seeds=(1, 2), cases=('nominal', 'disturbance'))
    assert len({*found}) == 8
    again = keys(parameters={'gain': [20.0]}, seeds=(2,), cases=('disturbance',))
    assert {*again} < {*found}
    # What the package is made of, and the Python that runs it.
    for module, name, other in (
        (run_cache_key, 'source_digest', 'x'),
        (run_cache_key, 'VERSION', '0'),
        (parameter_sweep, 'provenance', {'python': '4'}),
    ):
        new = other if name == 'VERSION' else lambda value=other: value
        monkeypatch.setattr(module, name, new)
        changed = keys(parameters={'gain': [20.0]}, seeds=(2,), cases=('disturbance',))
        assert not {*changed} & {*found, *again}
        again += changed


def test_the_key_of_a_run_changes_with_the_content_of_its_files(tmp_path):
    """A schedule was known by its path alone: after a change of it the old runs came back."""
    faults = tmp_path / 'faults.yaml'
    found = set()
    for at in (0.5, 0.7, 0.5):
        faults.write_text(f'- {{at: {at}, fault: gyro_dead, value: true}}\n')
        found |= {*keys({**TWIN, 'faults': str(faults)}, 'full')}
        found |= {*keys({**TWIN, 'faults': faults}, 'full')}
    assert len(found) == 2
    world = tmp_path / 'world.yaml'
    for name in ('one', 'two', 'one'):
        world.write_text(f'name: {name}\n')
        found |= {*keys(TWIN, parameters={'robot.world': [str(world)]})}
    assert len(found) == 4


def test_the_key_of_a_run_ignores_files_named_like_a_case(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = keys(TWIN, 'full')
    for name in ('full', 'twin', 'nominal'):
        (tmp_path / name).write_text('not meant')
    assert keys(TWIN, 'full') == before


@pytest.mark.parametrize(
    'arguments, text',
    [
        ((Proportional, [1.0]), 'parameters must map names to lists of values'),
        ((Proportional, {'gain': 3.0}), 'gain must be a list of values: got 3.0'),
        ((Proportional, {'gain': []}), 'each parameter must have one or more values'),
        ((Proportional, {'gain': [20, 20.0]}), 'values must differ: got .20, 20.0. of gain'),
        ((Proportional, {'gain': [[1.0, 2.0]]}), 'gain must be numbers, truth values or texts'),
        ((Proportional, {'gain': [20.0, math.inf]}), 'values of gain must be finite: got inf'),
        ((Proportional, {'seed': [1, 2]}), 'seed is a column of every sweep'),
        ((Proportional, {1: [1.0]}), 'parameters must map names to lists of values: got 1'),
        (
            ([t3.Controller(Proportional, name='a'), t3.Controller(Made, name='a')], {}),
            'must have different names',
        ),
        (('full', {'law.gian': [1.0]}), 'did you mean law.gain'),
        ((Proportional, {'robot.frction_factor': [1.0]}), 'did you mean friction_factor'),
    ],
)
def test_wrong_use_of_a_sweep_is_a_sentence(arguments, text):
    """Runs of two such cells were one cell, with twice the seeds and too narrow an interval."""
    with pytest.raises(t3.ScriptError, match=text):
        t3.sweep(*arguments, executor=1, seeds=[1], **SHORT)


def test_a_file_of_another_kind_is_left_alone(tmp_path, monkeypatch):
    pytest.importorskip('pyarrow')
    monkeypatch.chdir(tmp_path)
    path = tmp_path / 'sweep.parquet'
    (tmp_path / 'folder.parquet').mkdir()
    for name, text in (
        ('x.csv', 'must end in .parquet: got x.csv'),
        ('folder.parquet', 'cannot be written'),
        (3, 'path must be a text or a Path: got 3'),
    ):
        with pytest.raises(t3.ScriptError, match=text):
            t3.sweep(Proportional, GAINS, executor=1, output=name, **SHORT)
    t3.simulate(Proportional, **SHORT).to_parquet(path)
    content = path.read_bytes()
    with pytest.raises(t3.ScriptError, match='is no file of a sweep'):
        t3.sweep(Proportional, GAINS, executor=1, output=path, **SHORT)
    assert path.read_bytes() == content


def test_values_that_no_file_holds_are_refused_before_the_runs(tmp_path, counted):
    """``--set gain=5,,6`` made every run, and then wrote no file."""
    pytest.importorskip('pyarrow')
    with pytest.raises(t3.ScriptError, match='values of gain must be of one kind'):
        t3.sweep(
            Proportional,
            {'gain': [5.0, '']},
            executor=1,
            output=tmp_path / 'a.parquet',
            seeds=[1],
            **SHORT,
        )
    assert not counted


def test_a_parameter_that_is_set_twice_is_refused(capsys):
    """Of ``--set gain=20 --set gain=10`` only the last one was swept, without a word."""
    assert main(['sweep', '--set', 'law.gain=20', '--set', 'law.gain=10']) == 1
    assert '--set must name each parameter once' in capsys.readouterr().err


def test_a_value_that_is_not_finite_is_refused(tmp_path, capsys):
    """A controller got the text ``nan``, and each run failed by it."""
    script = tmp_path / 'mine.py'
    script.write_text('def step(observation, gain):\n    return -gain * observation.speeds\n')
    words = ['--set', 'gain=nan,2', '--robot', 'servo', '--output', f'{tmp_path / "a.parquet"}']
    assert main(['sweep', f'{script}:step', *words]) == 1
    assert 'values of gain must be finite: got nan' in capsys.readouterr().err


def assert_the_command_has_the_same_rows(path, capsys, *options):
    words = ['--set', 'gain=10.0,20.0', '--robot', 'servo', '--duration', '2', '--seeds', '1-2']
    assert main(['sweep', 'ADRC', *words, '--output', str(path), *options]) == 0
    found = t3.sweep('ADRC', GAINS, seeds=[1, 2], executor=1, **SHORT)
    assert found.table() in capsys.readouterr().out
    rows = pytest.importorskip('pyarrow.parquet').read_table(path)
    assert rows['overall'].to_pylist() == found.columns['overall']


@pytest.mark.slow
def test_the_command_writes_the_same_rows(tmp_path, capsys):
    path = tmp_path / 'runs' / 'sweep.parquet'  # no folder yet, as of the default output
    assert_the_command_has_the_same_rows(path, capsys, '--workers', '1')


# -- clusters -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_cluster_gives_the_same_numbers(tmp_path, capsys):
    """Its workers are threads here, which need no import of their own."""
    distributed = pytest.importorskip('distributed')
    pytest.importorskip('pyarrow')
    alone = t3.sweep(Proportional, GAINS, seeds=(1, 2), executor=1, **SHORT)
    options = {'n_workers': 2, 'threads_per_worker': 1, 'dashboard_address': None}
    with (
        distributed.LocalCluster(
            **options, processes=False, protocol='tcp', host='127.0.0.1'
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        together = t3.sweep(Proportional, GAINS, seeds=(1, 2), executor=client, **SHORT)
        assert _numbers(together) == _numbers(alone)
        assert_the_command_has_the_same_rows(
            tmp_path / 'shell.parquet', capsys, '--scheduler', cluster.scheduler_address
        )


@pytest.mark.long
def test_a_lost_worker_gives_the_same_numbers(tmp_path):
    """A worker that is killed in mid-run loses nothing: its runs are begun again elsewhere."""
    distributed = pytest.importorskip('distributed')
    pytest.importorskip('pyarrow')
    alone = t3.sweep(Proportional, GAINS, seeds=(1, 2), executor=1, **SHORT)
    options = {'n_workers': 2, 'threads_per_worker': 1, 'dashboard_address': None}
    with (
        distributed.LocalCluster(**options, host='127.0.0.1') as cluster,
        distributed.Client(cluster) as client,
    ):
        first = next(iter(client.run(os.getpid)))
        client.submit(_kill_later, workers=[first], allow_other_workers=False, pure=False)
        lost = t3.sweep(
            *(Proportional, GAINS),
            seeds=range(1, 9),
            executor=client.get_executor(pure=False),
            output=tmp_path / 'lost.parquet',
            **SHORT,
        )
        assert len(lost.rows) == 16
        assert _numbers(lost)[:4] == _numbers(alone)
        assert not any(math.isnan(row['overall']) for row in lost.rows)


def _kill_later():
    """End the process of the worker, as the kernel does when there is no memory left."""
    time.sleep(0.1)
    os.kill(os.getpid(), signal.SIGKILL)
