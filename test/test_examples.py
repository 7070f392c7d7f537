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
"""Every program of ``examples/`` runs, and shows what its docstring says."""

import math
import subprocess
import sys

import numpy as np
import pytest
from support.checkout import ROOT, load_example
from support.long_tests import few_of

import t3mpc_ros as t3
from t3mpc_ros.geometry.kinematics import WheelGeometry

pytestmark = pytest.mark.slow

EXAMPLES = sorted((ROOT / 'examples').glob('*.py'))
NAMES = sorted((path.stem for path in EXAMPLES), key=lambda name: name != 'own_controller')
"""That of the tutorial first."""
BAG = ROOT / 'test' / 'golden' / 'stops.mcap'


def _own_controller(module, folder):
    table = module.main(folder, 3.0, executor=1)
    assert tuple(table.plan.methods) == ('full', 'Pi', 'Pi, gain 40.0, integral 400.0')
    assert 'own_controller' in {path.stem for path in folder.iterdir()}


def _own_reference(module, folder):
    runs = module.main(folder, 6.0)
    assert max(run.rmse(1.0) for run in runs.values()) < 0.1


def _own_robot(module, folder):
    assert len(module.main(folder, 4.0, executor=1).rows()) == 15


def _own_plant(module, folder):
    """Flexible shafts ring after switches; in 6 s without one, noise alone decided."""
    runs = module.main(folder, 20.0)
    rigid, flexible = (runs[name, 'full'].metrics['settled'] for name in ('rigid', 'flexible'))
    assert rigid < 0.5 * flexible


def _own_noise(module, folder):
    runs = module.main(6.0)
    assert runs['outliers'].rmse(1.0) > 0.0
    assert np.abs(runs['blocked wheel'].error).max() > 1.0


def _policy(module, folder):
    """The policy of the environment is the controller of the comparison."""
    pytest.importorskip('gymnasium')
    table = module.main(3.0, generations=1, episodes=2.0, executor=1)
    assert tuple(table.plan.methods) == ('PI + feed-forward', 'policy', 'feed-forward')
    assert max(table.values('policy')) < 1.0


def _read_bag(module, folder):
    assert module.main(BAG, f'{folder}')['/odom']['stamp'].size > 100  # as on a command line


def _recorded_reference(module, folder):
    """From the first message on, the simulated reference is the recorded one."""
    table = module.main(BAG, folder, 2.0, executor=1)
    assert tuple(table.plan.methods) == ('full', 'DMC')
    recorded = t3.read_bag(BAG)['/reference']['twist.twist.linear.x'][:200]
    right, left = table.plan.scenario.own.reference.speeds[:200].T
    np.testing.assert_allclose(0.5 * WheelGeometry().wheel_radius * (right + left), recorded)


def _sweep_gain(module, folder):
    pytest.importorskip('pyarrow')
    found = module.main(folder, 2.0, executor=1)
    assert len(found.rows) == 2 * 4 * 2 * 3


def _generator(module, folder):
    solution, distance = module.main(folder, 5.0)
    assert solution.y.shape == (2501, 4)
    assert distance[-1] > 1e3 * distance[0]  # chaos: neighbours separate


def _fuzzy_system(module, folder):
    heating, errors = module.main()
    assert heating.evaluate({'temperature': 5.0}) > 60.0 > heating.evaluate({'temperature': 35.0})
    assert max(errors.values()) < 0.1


def _digital_twin(module, folder):
    lost, (truth, odometry, steps) = module.main(folder, side=1.0)
    assert lost >= 4
    assert math.dist(steps[-1, :2], (0.0, 0.0)) < 5e-3  # the counters see a square
    assert math.dist(truth[-1], steps[-1]) > 5.0 * math.dist(truth[-1], odometry[-1])


CHECKS = {
    name.removeprefix('_'): check
    for name, check in globals().copy().items()
    if name.removeprefix('_') in {path.stem for path in EXAMPLES}
}


@pytest.mark.parametrize('name', few_of(NAMES, 2))
def test_an_example_runs_and_shows_what_it_says(name, tmp_path):
    """Also where its folder is not there yet: those that a reader starts ended with an error."""
    CHECKS[name](load_example(name), tmp_path / 'made')


@pytest.mark.parametrize('name', ['read_bag', 'recorded_reference'])
def test_an_example_says_in_one_sentence_that_there_is_no_bag(name, tmp_path):
    """It was a traceback."""
    program = [sys.executable, ROOT / 'examples' / f'{name}.py', tmp_path / 'none', tmp_path]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == f'error: there is no bag {tmp_path / "none"}\n'


def test_the_tutorial_shows_the_controller_of_the_example():
    """One text in two places: the page shows what this test runs."""
    block = (ROOT / 'docs/tutorial.md').read_text().split('```python\n')[1].split('```')[0]
    example = (ROOT / 'examples/own_controller.py').read_text()

    def body(text):
        lines = text[text.index('class Pi:') :].splitlines()
        code = lines[: next(i for i, line in enumerate(lines[1:], 1) if line[:1].strip())]
        return [line for line in code if line.strip() and 'Return the acc' not in line]

    assert body(block) == body(example)
