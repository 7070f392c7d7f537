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
"""One run: own controllers, references, plants and noise do what their definitions say."""

import csv
import math
import pickle
import re
import sys

import numpy as np
import pytest

import t3mpc_ros as t3
from t3mpc_ros.evaluation.api.own_reference import sampled
from t3mpc_ros.evaluation.api.script_inputs import loaded

PERIOD = 0.01
SHORT = {'plant': 'servo', 'duration': 4.0}


def proportional(observation, gain=20.0):
    slope = (observation.next_reference - observation.reference) / PERIOD
    return slope - gain * (observation.speeds - observation.reference)


class Proportional:
    def __init__(self, model, gain=20.0):
        self.period, self.gain = model.period, gain

    def step(self, observation):
        slope = (observation.next_reference - observation.reference) / self.period
        return slope - self.gain * (observation.speeds - observation.reference)


class Integral:
    """Keeps a sum between its steps."""

    def __init__(self):
        self.sum = np.zeros(2)

    def step(self, observation):
        self.sum = self.sum + PERIOD * (observation.speeds - observation.reference)
        return proportional(observation) - 50.0 * self.sum


def test_function_class_and_object_are_the_same_controller():
    runs = [
        t3.simulate(controller, **SHORT)
        for controller in (proportional, Proportional, t3.Controller(Proportional, {'gain': 20.0}))
    ]
    assert all(np.array_equal(run['command_right'], runs[0]['command_right']) for run in runs)
    assert runs[-1].controller == 'Proportional, gain 20.0'
    kept = Integral()
    first, again = (t3.simulate(kept, **SHORT) for _ in range(2))
    assert np.array_equal(first['speed_left'], again['speed_left'])
    assert not kept.sum.any()  # each run has a copy
    assert first.rmse(1.0) < runs[0].rmse(1.0)  # friction is a constant load


def test_results_are_those_of_the_comparison():
    """The interface adds no second loop: it gives the numbers of the tables."""
    from t3mpc_ros.evaluation.loop import run
    from t3mpc_ros.evaluation.method_table import methods_for
    from t3mpc_ros.evaluation.run_record import measure
    from t3mpc_ros.evaluation.scenario import Scenario

    found = t3.simulate('ADRC', seed=203, **SHORT)
    scenario = Scenario('servo', 'nominal', 203, 4.0)
    expected = run(scenario, methods_for('servo')['ADRC'])
    assert np.array_equal(found.record.speeds, expected.speeds)
    assert found.metrics == measure(expected)
    assert found.rmse() == pytest.approx(expected.rmse())


# -- references ---------------------------------------------------------------------------------


def _wave(time):
    return 3.0 * math.sin(time), 2.0 * math.cos(time)


@pytest.mark.slow
def test_array_function_and_csv_are_the_same_reference(tmp_path):
    time = np.arange(500) * PERIOD
    table = np.array([_wave(t) for t in time])
    path = tmp_path / 'reference.csv'
    with path.open('w', newline='') as stream:
        csv.writer(stream).writerows([('time', 'right', 'left'), *np.column_stack([time, table])])
    geometry = t3.Robot().plant_parameters().geometry
    first, *others = (sampled(each, 4.0, geometry) for each in (table, _wave, path, str(path)))
    for other in others:
        np.testing.assert_allclose(other.speeds, first.speeds, atol=1e-12)
    run = t3.simulate('PI + feed-forward', reference=_wave, **SHORT)
    np.testing.assert_allclose(run['reference_right'], table[:400, 0], atol=1e-12)
    assert run.rmse(2.0) < 0.1


@pytest.mark.parametrize(
    ('first', 'last', 'words'),
    [
        (0.0, 3.9, 'must last as long as the run, 4 s: got 3.9 s; choose a shorter duration'),
        (100.0, 104.0, 'must begin at 0 s, where the run begins: got 100 s; subtract'),
        (1.7e9, 1.7e9 + 4.0, 'got 1700000000 s; subtract'),
    ],
)
def test_a_reference_of_other_times_is_refused(first, last, words, tmp_path):
    """The row at its end was held, and a standing robot was judged: errors of 0.0005 rad/s."""
    path = tmp_path / 'reference.csv'
    path.write_text(f'time,right,left\n{first!r},3,5\n{last!r},4,4\n')
    geometry = t3.Robot().plant_parameters().geometry
    with pytest.raises(t3.ScriptError, match=re.escape(words)):
        sampled(path, 4.0, geometry)
    if first == 0.0:
        with pytest.raises(t3.ScriptError, match=re.escape(words)):
            sampled(np.ones((391, 2)), 4.0, geometry)


def test_a_reference_of_the_body_is_converted(tmp_path):
    path = tmp_path / 'body.csv'
    path.write_text('time,linear,angular\n0,0.1,1.0\n9,0.1,1.0\n')
    run = t3.simulate('feed-forward', reference=path, plant='servo', duration=0.1)
    half = 0.5 * 0.147
    assert run['reference_right'][0] == pytest.approx((0.1 + half) / 0.035)
    assert run['reference_left'][0] == pytest.approx((0.1 - half) / 0.035)


def test_no_slope_of_a_reference_looks_ahead():
    """A method without preview extrapolates: the slope of row k must not know row k + 1."""
    early, late = np.zeros((600, 2)), np.zeros((600, 2))
    late[300:] = np.arange(300)[:, None] * 0.01 + 0.01
    geometry = t3.Robot().plant_parameters().geometry
    slopes = [sampled(each, 4.0, geometry).rate for each in (early, late)]
    assert np.array_equal(slopes[0][:300], slopes[1][:300])
    assert slopes[1][300, 0] == pytest.approx(1.0)
    step = np.where(np.arange(600)[:, None] < 200, 0.0, 2.0) * np.ones(2)
    found = sampled(step, 4.0, geometry)
    assert found.switched.nonzero()[0].tolist() == [200]
    assert not found.rate.any()


@pytest.mark.slow
def test_the_wheels_of_waypoints_drive_through_the_points():
    points = np.array([[0.0, 0.0], [0.6, 0.0], [1.0, 0.5], [0.6, 1.0]])
    path = t3.Waypoints(points, speed=0.2, acceleration=0.4)
    time = np.arange(0.0, 20.0, 0.001)
    linear, angular = path.twists(time).T
    yaw = np.cumsum(angular) * 0.001
    best = math.inf
    for start in np.linspace(-0.6, 0.6, 121):  # the spline is not straight at its start
        x = np.cumsum(linear * np.cos(start + yaw)) * 0.001
        y = np.cumsum(linear * np.sin(start + yaw)) * 0.001
        gaps = [np.hypot(x - px, y - py).min() for px, py in points]
        best = min(best, max(gaps))
    assert best < 0.01
    assert linear.max() == pytest.approx(0.2)
    assert linear[-1] == 0.0
    assert np.abs(np.diff(linear)).max() <= 0.4 * 0.001 + 1e-9


# -- plants and noise ---------------------------------------------------------------------------


def servo(time, state, command):
    return (command - state) / 0.05


def test_state_space_and_ode_are_the_same_plant():
    lag = 0.05
    linear = t3.StateSpace(-np.eye(2) / lag, np.eye(2) / lag, np.eye(2))
    runs = [
        t3.simulate(proportional, plant=plant, duration=3.0, noise=0.0)
        for plant in (linear, t3.OdePlant(servo))
    ]
    np.testing.assert_allclose(runs[0]['speed_right'], runs[1]['speed_right'], atol=1e-7)


def test_a_plant_answers_after_its_dead_time():
    plant = t3.OdePlant(servo, robot=t3.Robot(dead_time=0.05))
    found = t3.simulate(lambda o: np.array([5.0, 5.0]), plant=plant, duration=1.0, noise=0.0)
    moved = np.flatnonzero(found['speed_right'] > 0.0)
    # Sent in row 0, at the wheels 50 ms later, seen at the end of that period.
    assert moved[0] == 6


def test_a_robot_has_its_own_geometry_and_limits():
    robot = t3.Robot(wheel_radius=0.033, wheel_separation=0.16, lag=0.1, linear_velocity=0.05)
    run = t3.simulate('PI + feed-forward', plant=robot, duration=4.0)
    mean = 0.5 * (run['command_right'] + run['command_left'])
    assert np.abs(mean).max() == pytest.approx(0.05 / 0.033)


@pytest.mark.parametrize('plant, rest', [('servo', 1e-12), ('twin', 0.15)])
def test_a_noise_law_replaces_the_white_noise(plant, rest):
    """What is left on the twin is the resolution of the step counter."""

    def bursts(generator, time, speeds):
        noise = generator.standard_normal(2)
        return noise if time % 1.0 >= 0.5 else np.zeros(2)

    run = t3.simulate('feed-forward', plant=plant, noise=t3.NoiseLaw(bursts, 0.04), duration=8.0)
    noise = run['measured_left'] - run['speed_left']
    driven, second = run['time'] > 1.0, run['time'] % 1.0
    assert np.std(noise[driven & (second < 0.485)]) < rest
    assert np.std(noise[driven & (second > 0.505)]) == pytest.approx(1.0, rel=0.15)


# -- files --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_files_hold_every_digit(tmp_path):
    run = t3.simulate(proportional, **SHORT)
    head, *rows = csv.reader(run.to_csv(tmp_path / 'run.csv').read_text().splitlines())
    assert head == [*run.columns]
    assert np.array_equal(np.array(rows, float)[:, 3], run[head[3]])
    pyarrow = pytest.importorskip('pyarrow.parquet')
    table = pyarrow.read_table(run.to_parquet(tmp_path / 'run.parquet'))
    assert np.array_equal(table[head[5]].to_numpy(), run[head[5]])
    assert table.schema.metadata[b'controller'] == b'proportional'
    assert table.schema.metadata[b'version'] == t3.__version__.encode()
    assert run.plot(tmp_path / 'run.png').axes
    assert (tmp_path / 'run.png').read_bytes().startswith(b'\x89PNG')
    assert '| variation |' in run.table()


PLANT_FILE = """import t3mpc_ros as t3


def lag(time, state, command):
    return 20.0 * (command - state)


named = t3.OdePlant(lag)
"""


def test_a_plant_of_a_file_goes_to_another_process_with_its_file(tmp_path):
    """``t3mpc compare --robot FILE.py:NAME`` ended with the advice to guard the script."""
    path = tmp_path / 'own.py'
    path.write_text(PLANT_FILE)
    found = loaded(f'{path}:named')
    here = t3.simulate('PI + feed-forward', plant=found, duration=4.0)
    sent = pickle.dumps(found)
    path.unlink()
    for name in [name for name in sys.modules if name.startswith('own_')]:
        del sys.modules[name]
    there = t3.simulate('PI + feed-forward', plant=pickle.loads(sent), duration=4.0)
    assert np.array_equal(there['speed_right'], here['speed_right'])
    assert found.name == 'lag'
