# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The scripting interface: its names and signatures, what an import costs, which types it has."""

import inspect
import json
import subprocess
import sys

import t3mpc_ros as t3

SIGNATURES = {
    'chaos': '(alpha=0.98, *, tspan=(0.0, 60.0), dt=0.001, y0=None, every=10, system=None)',
    'compare': "(controllers, *, seeds=(201, 202, 203, 204, 205, 206), cases=('nominal',), "
    "reference=None, plant='twin', noise=0.04, faults=None, duration=60.0, executor=None, "
    'progress=False)',
    'fuzzy': "(*inputs, kind='type3', sets=7, centres=(-1.0, 1.0), spread=0.6, slices=4, "
    'input_fuzziness=0.0)',
    'read_bag': '(path)',
    'sweep': "(controllers, parameters, *, seeds=(1, 2, 3, 4, 5), cases=('nominal',), "
    "reference=None, plant='twin', noise=0.04, faults=None, duration=60.0, output=None, "
    'executor=None, progress=False)',
    'simulate': "(controller='full', *, reference=None, plant='twin', noise=0.04, faults=None, "
    "case='nominal', seed=1, duration=60.0)",
    'Controller': "(source, settings=<factory>, name='')",
    'FaultEvent': '(at, fault, value, duration=inf)',
    'FaultSchedule': "(events=(), name='')",
    'LinkFaults': '(command_loss=0.0, command_delay=(0.0, 0.0), odometry_loss=0.0, '
    'odometry_delay=(0.0, 0.0), begin=0.0, lasting=inf)',
    'NoiseLaw': '(draw, variance)',
    'OdePlant': "(right_hand_side, states=2, output=None, drive='velocity', initial=None, "
    'robot=<factory>)',
    'Robot': '(wheel_radius=0.035, wheel_separation=0.147, lag=0.02, dead_time=0.01, '
    'linear_velocity=None, angular_velocity=None, wheel_velocity=None, '
    'linear_acceleration=None, angular_acceleration=None, wheel_acceleration=None, '
    'parameters=<factory>)',
    'StateSpace': "(A, B, C, drive='velocity', initial=None, robot=<factory>)",
    'Waypoints': '(points, speed=0.2, acceleration=0.3)',
}
RESULTS = {
    'BagColumns': {'path', 'types', 'duration'},
    'ChaosSolution': {'t', 'y', 'system', 'plot', 'to_csv'},
    'Comparison': {'plan', 'results', 'table', 'values', 'difference', 'rows', 'to_csv'}
    | {'to_parquet', 'to_html'},
    'FuzzySystem': {'add_rule', 'basis', 'evaluate', 'fit', 'rules'},
    'NominalModel': {'drive', 'period', 'lag', 'acceleration', 'robot'},
    'Observation': {'speeds', 'unexplained', 'reference', 'next_reference', 'command', 'future'}
    | {'elapsed'},
    'Sweep': {'rows', 'parameters', 'columns', 'table', 'plot', 'to_csv', 'to_parquet'},
    'RunResult': {'columns', 'metrics', 'error', 'rmse', 'table', 'plot', 'to_csv', 'to_parquet'},
}
HEAVY = ('numba', 'numpy', 'matplotlib', 'rclpy', 'mcap', 'rosbags', 'pyarrow', 'distributed')


def _untyped(function):
    """Return a signature without its types, which mypy checks."""
    found = inspect.signature(function)
    empty = inspect.Parameter.empty
    plain = [each.replace(annotation=empty) for each in found.parameters.values()]
    return str(found.replace(parameters=plain, return_annotation=inspect.Signature.empty))


def test_public_names_and_signatures_are_pinned():
    """A script written today runs after an update: a change here is a change for its users."""
    assert set(t3.__all__) == {*SIGNATURES, *RESULTS, 'ScriptError'}
    assert {name: _untyped(getattr(t3, name)) for name in SIGNATURES} == SIGNATURES
    for name, members in RESULTS.items():
        kind = getattr(t3, name)
        slots = {*getattr(kind, '__dataclass_fields__', {}), *dir(kind)}
        assert members <= slots | {'path', 'types', 'duration'}, name
    assert set(t3.__all__) <= {*dir(t3)}


def test_the_import_loads_no_library():
    """``import t3mpc_ros`` took a second when it imported what a script may never use."""
    code = (
        f'import json, sys, t3mpc_ros; print(json.dumps([m for m in {HEAVY} if m in sys.modules]))'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []


def test_generator_and_fuzzy_system_are_functions_in_any_order():
    """Both are packages, too: importing a module of one must not replace the function."""
    import t3mpc_ros.chaos.system
    import t3mpc_ros.fuzzy.inference

    assert t3mpc_ros.chaos is t3.chaos is sys.modules['t3mpc_ros.chaos']
    assert t3.chaos(tspan=(0.0, 0.1)).y.shape == (11, 4)
    assert t3.fuzzy('x', sets=3).rules == t3mpc_ros.fuzzy('x', sets=3).rules == 3


def test_an_unknown_name_is_an_attribute_error():
    assert not hasattr(t3, 'no_such_name')
