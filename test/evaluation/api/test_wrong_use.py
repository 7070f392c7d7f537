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
"""Wrong use is one sentence: it names the thing, the bound, the value, and what to do next."""

from functools import cache
from pathlib import Path
import subprocess
import sys
import tempfile
import traceback

import numpy as np
import pytest
from support.long_tests import few_of

import t3mpc_ros as t3

SHORT = {'plant': 'servo', 'duration': 1.0}
GROWING = t3.StateSpace(5.0 * np.eye(2), np.eye(2), np.eye(2))
LATE_FAULT = t3.FaultSchedule([t3.FaultEvent(100.0, 'command_loss', 1.0)])


def run(controller='feed-forward', **setting):
    return t3.simulate(controller, **{**SHORT, **setting})


def compare(controllers, **setting):
    return t3.compare(controllers, **{**SHORT, **setting})


def returns_list(observation):
    return [1.0, 2.0]


def returns_three(observation):
    return np.zeros(3)


def returns_nan(observation):
    return np.full(2, np.nan)


def raises(observation):
    return 1 / (observation.elapsed - 1)


def unstable(time, state, command):
    return 1e3 * state * abs(state) + command


def wrong_states(time, state, command):
    return np.zeros(3)


def changes_what_it_sees(observation):
    error = observation.speeds
    error -= observation.reference
    return error


@cache
def finished():
    return t3.simulate('feed-forward', plant='servo', duration=4.0)


@cache
def compared():
    return t3.compare('feed-forward', seeds=[1], plant='servo', duration=4.0, executor=1)


class NoStep:
    pass


class WrongArguments:
    def __init__(self, gain):
        self.gain = gain

    def step(self, observation):
        return np.zeros(2)


def write_bytes(content):
    """Return a CSV file that is none."""
    path = Path(tempfile.mkdtemp()) / 'bytes.csv'
    path.write_bytes(content)
    return path


WRONG = [
    (
        lambda: compare('feed-forward', seeds=5),
        r'seeds must be a list of them, such as \[1\] or range\(1, 6\): got 5',
    ),
    (lambda: run('mine.py'), 'mine.py must be followed by what to take of it: mine.py:NAME'),
    (lambda: t3.chaos(system=3), 'system must be a QuadraticSystem: got 3'),
    (
        lambda: t3.fuzzy('x').fit([[0.0]], [1.0], ridge=float('nan')),
        'ridge must be at least 0: got nan',
    ),
    (
        lambda: finished().to_csv('/nowhere/at/all.csv'),
        'all.csv cannot be written: give a file in a folder that exists',
    ),
    (lambda: finished().plot('run.gif'), 'path must end in .png, .pdf, .svg: got run.gif'),
    (
        lambda: run(reference=lambda time: (0.0, -1e9)),
        r'reference must be from -200 to 200 rad/s, .* got 1e\+09 rad/s',
    ),
    (
        lambda: run(reference=np.ones((9, 2), complex)),
        'reference must be real numbers: got complex ones',
    ),
    (
        lambda: run(reference=write_bytes(b'\xff\x00\x80')),
        'bytes.csv must be a CSV file: got one that is no text in UTF-8',
    ),
    (lambda: t3.fuzzy(['x']), r"inputs must be names, each once: got \['x'\]"),
    (lambda: t3.chaos(rtol=0.0), 'rtol must be from 1e-06 to 1'),
    (
        lambda: run(returns_list),
        r'returns_list must return a numpy array of shape \(2,\), .* got \[1.0, 2.0\] at 0.00 s',
    ),
    (
        lambda: run(returns_three),
        r'must return a numpy array of shape \(2,\), .* got shape \(3,\)',
    ),
    (
        lambda: run(returns_nan),
        r'returns_nan must return finite accelerations: got \[nan, nan\] at 0.00 s',
    ),
    (
        lambda: run(raises),
        r'raises raised ZeroDivisionError \(.*zero\) in raises\(\), test_wrong_use.py line \d+',
    ),
    (
        lambda: run(reference=lambda time: 1.0 / 0.0),
        r'reference raised ZeroDivisionError \(.*zero\) in .*, test_wrong_use.py line \d+',
    ),
    (
        lambda: run(changes_what_it_sees),
        r'read-only\) in .*, at 0.00 s; change a copy, such as observation.speeds.copy\(\)',
    ),
    (
        lambda: run(lambda seen: seen.future[0]),
        'observation.future is None without preview = True in the class',
    ),
    (
        lambda: run(lambda seen: np.array([1j, 2j])),
        r'array of shape \(2,\), .* got shape \(2,\) of complex128 at 0.00 s',
    ),
    (
        lambda: finished()['sped_right'],
        "column must be one of time, .* got 'sped_right'; did you mean speed_right",
    ),
    (lambda: finished().to_csv('a.xlsx'), 'must end in .csv: got a.xlsx'),
    (lambda: finished().to_parquet('a.csv'), 'path must end in .parquet: got a.csv'),
    (lambda: compared().to_html('a.pdf'), 'path must end in .html: got a.pdf'),
    (lambda: t3.chaos(tspan=(0.0, 0.1)).to_csv('a.txt'), 'path must end in .csv: got a.txt'),
    (lambda: finished().rmse(after=-1.0), 'after must be from 0 to 3.99 s: got -1'),
    (lambda: compared().values(NoStep), 'controller must be one of feed-forward: got NoStep'),
    (
        lambda: run(
            'PI + feed-forward', plant=t3.OdePlant(unstable, initial=[1.0, 1.0]), duration=1.0
        ),
        r'run of PI \+ feed-forward diverged at 0.0\d s: the wheel speeds before were',
    ),
    (  # an error of 3e14 rad/s was a number like others, and the method *better*
        lambda: run('PI + feed-forward', plant=GROWING, duration=8.0),
        r'run of PI \+ feed-forward diverged at \d.\d\d s: the wheel speeds before were',
    ),
    (
        lambda: run('full', plant='twin', faults=LATE_FAULT, duration=8.0),
        'faults must begin within the run, which lasts 8 s: got 100 s as the first begin',
    ),
    (
        lambda: run('full', plant='twin', faults=5, duration=8.0),
        'faults must be LinkFaults, a FaultSchedule, or the name or file of one: got int 5',
    ),
    (
        lambda: run(reference=lambda time: (1.0, 1.0), duration=-1.0),
        'duration must be from .* s: got -1.0',
    ),
    (lambda: t3.chaos(dt=True), 'dt must be above 0 s and at most the span: got True'),
    (
        lambda: t3.OdePlant(wrong_states),
        r'wrong_states must return 2 numbers, one for each state: got the shape \(3,\)',
    ),
    (
        lambda: t3.OdePlant(unstable, initial=[1.0, 1.0, 1.0]),
        r'initial must have the shape \(2,\): got \(3,\)',
    ),
    (
        lambda: run(plant=t3.OdePlant(unstable), case='friction x3'),
        'case must be one of nominal: got friction x3',
    ),
    (lambda: run('ful'), 'did you mean full'),
    (lambda: run(plant='twn'), 'plant must be .* did you mean twin'),
    (lambda: run(case='nominl'), 'did you mean nominal'),
    (lambda: run(t3.Controller('full', {'law.gian': 2.0})), 'did you mean law.gain'),
    (lambda: run(NoStep), 'class NoStep must have a method step'),
    (lambda: run(3), 'controller must be a name, .* got int 3'),
    (
        lambda: run(WrongArguments),
        "WrongArguments cannot be made: TypeError .*missing 1 required .*'gain'",
    ),
    (
        lambda: run(reference=np.zeros((2, 50))),
        r'reference must have the shape \(n, 2\), .* got \(2, 50\)',
    ),
    (
        lambda: run(reference=[[1.0, 2.0], [3.0]]),
        r'reference must be numbers of the shape \(n, 2\): got list',
    ),
    (
        lambda: run(reference=np.full((50, 2), np.nan)),
        r'reference must be finite: got nan at \[0, 0\]',
    ),
    (lambda: run(reference='no.csv'), 'no.csv cannot be read: No such file'),
    (lambda: run(noise='0.1'), 'noise must be a variance .* got str'),
    (lambda: run(seed=1.5), 'seed must be a whole number .* got 1.5'),
    (lambda: run(duration='1'), "duration must be a number .* got '1'"),
    (
        lambda: compare(lambda o: np.zeros(2), seeds=[1, 2], executor=2),
        'top level of a file to be sent to other processes; use executor=1',
    ),
    (lambda: compare('full', seeds=[1], executor='x'), 'executor must be None'),
    (lambda: t3.read_bag('no_bag'), 'there is no bag no_bag'),
    (lambda: t3.chaos(1.2), 'alpha must be above 0 and at most 1'),
    (lambda: t3.chaos(y0=[1, 2]), r'y0 must have the shape \(4,\)'),
    (lambda: t3.fuzzy('x').evaluate({'y': 1.0}), 'inputs must be x: got y'),
]


@pytest.mark.parametrize('call, text', WRONG, ids=[text for _, text in WRONG])
def test_wrong_use_is_one_sentence(call, text):
    with pytest.raises(t3.ScriptError, match=text) as caught:
        call()
    assert '\n' not in str(caught.value)
    # Nothing from inside: the last call shown is the one of the interface.
    assert caught.value.__cause__ is None
    assert caught.value.__context__ is None
    inside = [
        frame for frame in traceback.extract_tb(caught.tb) if '/t3mpc_ros/' in frame.filename
    ]
    assert len(inside) <= 2


@pytest.mark.parametrize(
    'kind, given, text',
    [
        ('LinkFaults', {'command_loss': 2.0}, 'command_loss must be a number from 0 to 1: got 2'),
        ('LinkFaults', {'odometry_loss': True}, 'odometry_loss must be a number from 0 to 1'),
        ('LinkFaults', {'begin': -0.1}, 'begin must be a number from 0 to 1: got -0.1'),
        ('LinkFaults', {'begin': 1.0}, 'or there are no faults: got begin 1 and lasting inf s'),
        ('LinkFaults', {'lasting': 0.0}, 'or there are no faults: got begin 0 and lasting 0 s'),
        ('LinkFaults', {'lasting': float('nan')}, 'lasting must be a number from 0 to inf s'),
        ('LinkFaults', {'odometry_delay': (0.2, 0.1)}, 'from 0.2 to 10 s: got 0.1'),
        ('LinkFaults', {'command_delay': 0.1}, 'command_delay must be a list: got 0.1'),
        ('LinkFaults', {'odometry_kept': 0}, 'odometry_kept must be a whole number of at least 1'),
        ('FaultEvent', {'at': -1.0, 'fault': 'slippery', 'value': True}, 'at must be a number'),
        ('FaultEvent', {'at': 1.0, 'fault': 'slipery', 'value': True}, 'did you mean slippery'),
    ],
)
def test_faults_of_ones_own_are_checked_when_they_are_made(kind, given, text):
    """A loss of 200 % was a loss of everything; an event raised an error of another class."""
    with pytest.raises(t3.ScriptError, match=text):
        getattr(t3, kind)(**given)


@pytest.mark.slow
@pytest.mark.parametrize('line', few_of(['', 'name = __name__\n']))
def test_a_script_without_a_guard_gets_a_sentence(tmp_path, line):
    """Worker processes run the script again: without its guard they would start workers.

    What comes before, a training of minutes, ran in each of them first; it is refused before.
    """
    script = tmp_path / 'script.py'
    script.write_text(
        f'{line}import t3mpc_ros as t3\n'
        "print('begun', flush=True)\n"
        "print(t3.compare('ADRC', seeds=[1, 2], plant='servo', duration=4.0, executor=2))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode == 1
    assert "begin its work with: if __name__ == '__main__':" in done.stderr.splitlines()[-1]
    assert line or done.stdout.split() == ['begun']


class Shared:
    """Forgets that its class keeps the list."""

    errors = []
    gain = 20.0

    def step(self, observation):
        self.errors.append(observation.reference[0])
        return self.gain * (observation.reference - observation.speeds)


def test_what_one_run_leaves_in_a_class_is_named():
    """The second run began with what the first had left: equal arguments, other results."""
    t3.simulate(Shared, plant='servo', duration=0.05)
    Shared.errors, Shared.gain = [], 30.0  # what the script itself sets is its own matter
    t3.simulate(Shared, plant='servo', duration=0.05)
    with pytest.raises(t3.ScriptError, match=r'Shared.errors was changed by a run before'):
        t3.simulate(Shared, plant='servo', duration=0.05)
