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
"""Published tables: each cell is the number that its head names, in its unit."""

from dataclasses import replace
import math

import numpy as np
import pytest
from support.records import record_of

from t3mpc_ros.evaluation.cases import LinkFaults
from t3mpc_ros.evaluation.confidence_intervals import interval
from t3mpc_ros.evaluation.experiment import ResultTable
from t3mpc_ros.evaluation.paper.paper_study import Results, estimation
from t3mpc_ros.evaluation.patrol.patrol_comparison import (
    OURS,
    PatrolPlan,
    PatrolStudy,
    coverage_table,
    surprise_table,
)
from t3mpc_ros.evaluation.patrol.patrol_metrics import HORIZONS, SHARES
from t3mpc_ros.evaluation.process_replay.replay_comparison import (
    Comparison,
    FieldComparison,
    Tolerances,
)
from t3mpc_ros.evaluation.run_record import METRICS, START, measure
from t3mpc_ros.evaluation.scenario import KINDS, OwnParts, Scenario
from t3mpc_ros.geometry.kinematics import WheelGeometry, body_speeds


def columns(table):
    """Return the cells of a table by their heads, a dictionary for each row."""
    return [dict(zip(table.head, row, strict=True)) for row in table.rows]


def test_rows_of_the_paper():
    situation = {
        'controller': 'PI', 'baseline': True, 'preview': False, 'drive': 'torque', 'noise': 0.04,
        'case': 'nominal', 'duration': 59.5,
    }  # fmt: skip
    names = 'rmse', 'settled', 'chatter', 'largest_error'
    numbers = [(0.1 * k, 0.03 * k * k, 50.0 + k, 2.0 + k) for k in (1, 2, 4)]
    runs = [
        {**situation, **dict(zip(names, each, strict=True)), 'finite': True, 'seed': seed}
        for seed, each in enumerate(numbers)
    ]
    (row,) = Results(ResultTable(runs)).means
    rmse, settled = [run['rmse'] for run in runs], [run['settled'] for run in runs]
    assert row == pytest.approx(situation | {
        'rmse_mean': np.mean(rmse), 'rmse_ci95': interval(rmse),
        'settled_mean': np.mean(settled), 'settled_ci95': interval(settled),
        'chatter_mean': np.mean([51.0, 52.0, 54.0]), 'largest_error': 6.0, 'finite': True,
        'seeds': 3,
    })  # fmt: skip


def test_numbers_of_a_run_on_the_twin():
    """Of a drive with a constant error of the wheels, and a body that turns too fast."""
    time = 0.01 * np.arange(2001)
    reference = np.tile([4.0, 2.0], (time.size, 1))
    error = np.where(time < 10.0, 0.1, 0.3)[:, None]
    ramp = np.cumsum(np.full((time.size, 2), 0.02), axis=0)
    requested = np.where((np.arange(time.size) % 2)[:, None], 0.01, 0.0) + ramp
    stopped = (time >= 12.0) & (time < 14.0)
    geometry, kind = WheelGeometry(), KINDS['twin']
    lengths = geometry.wheel_radius, geometry.half_separation
    twist = np.column_stack(body_speeds(*(reference + (0.2, 0.1)).T, *lengths))
    record = record_of(
        time, drive='velocity', start=kind.start, switches=[7.0], reference=reference,
        speeds=reference + error, sent=requested, twist=twist,
    )  # fmt: skip
    record = replace(record, robot_reasons=['stop' if each else '' for each in stopped])
    links = LinkFaults(begin=0.45, lasting=3.0)
    scenario = Scenario('twin', 'nominal', 1, 20.0, own=OwnParts(links=links))
    found = measure(replace(record, settling=kind.settling, fault_span=scenario.fault_span))
    rate = 0.1 * geometry.wheel_radius / geometry.wheel_separation
    assert found['yaw_rate'] == found['yaw_rate_settled'] == pytest.approx(rate)
    counted = time >= kind.start + START
    before, after = kind.settling
    settled = counted & ((time < 7.0 - before) | (time >= 7.0 + after))
    for name, rows in (('overall', counted), ('settled', settled)):
        assert found[name] == pytest.approx(np.sqrt(np.mean(error[rows] ** 2)), rel=1e-3)
    assert found['drift'] == pytest.approx(rate * 0.01 * np.count_nonzero(counted), rel=2e-3)
    assert found['stopped'] == pytest.approx(2.0, abs=0.01)
    # The acceleration alternates between 3 and 1 rad/s²: it varies by 2 in 0.01 s.
    assert found['variation'] == pytest.approx(200.0, rel=1e-2)
    during = math.sqrt((0.1**2 + 2 * 0.3**2) / 3)
    assert found['before'] == pytest.approx(0.1)
    assert found['during'] == pytest.approx(during, rel=5e-3)
    assert found['after'] == pytest.approx(0.3)
    assert {*found} == {metric.name for metric in METRICS}


def patrol(name, k):
    return {
        'controller': name, 'seed': 1, 'coverage': 0.2 * k, 'evenness': 0.3 * k,
        'exponent': 0.01 * k, 'permutation_entropy': 0.4 * k, 'spectral_entropy': 0.15 * k,
        'path_error': 0.002 * k, 'contacts': k - 1, 'avoiding': 0.05 * k, 'on_path': 0.4 * k,
        **{f'time_to_{100.0 * share:g}': 100.0 * k + j for j, share in enumerate(SHARES)},
        **{f'skill_{h:g}': 0.1 * k + 0.01 * j for j, h in enumerate(HORIZONS)},
        **{f'prediction_error_{h:g}': 3.0 * k + j for j, h in enumerate(HORIZONS)},
        **{f'predictor_{h:g}': 'linear' if h == 5.0 else 'kernel' for h in HORIZONS},
    }  # fmt: skip


def test_tables_of_patrols():
    names = (OURS, 'random walk')
    table = ResultTable([patrol(name, k) for k, name in enumerate(names, 1)])
    study = PatrolStudy(PatrolPlan(names, (1,), robot='twin'), table)
    heads = 'coverage, %', 'evenness', 'path error, mm', 'avoiding, %', 'on the path, %'
    heads += ('patrols with contacts',)
    rows = columns(coverage_table(study))
    for k, row in enumerate(rows, 1):
        cells = [float(row[head]) for head in heads]
        assert cells == pytest.approx([20.0 * k, 0.3 * k, 2.0 * k, 5.0 * k, 40.0 * k, k - 1])
        times = [float(row[f'{100.0 * share:g} %, s']) for share in SHARES]
        assert times == pytest.approx([100.0 * k + j for j in range(len(SHARES))])
    for k, row in enumerate(columns(surprise_table(study)), 1):
        skills = [float(row[f'skill at {horizon:g} s']) for horizon in HORIZONS]
        assert skills == pytest.approx([0.1 * k + 0.01 * j for j in range(len(HORIZONS))])
        judged = [*HORIZONS].index(5.0)
        assert float(row['error at 5 s, m']) == pytest.approx(3.0 * k + judged)
        heads = ('permutation entropy', 'spectral entropy', 'exponent, 1/s')
        assert [float(row[head]) for head in heads] == pytest.approx([0.4 * k, 0.15 * k, 0.01 * k])
        assert row['best predictor at 5 s'] == 'linear'


def test_the_table_of_a_replay_in_full():
    rows = (
        FieldComparison('linear', 90, 0.5, 0.25, 4, 2.5, 25),
        FieldComparison('angular', 80, 1e-12, 1e-10, 0, math.nan, -1),
    )
    outcome = Comparison(
        rows, Tolerances(0.01, 0.1), np.arange(3.0), {}, {}, np.array([True, True, False]),
        ('a remark',), ('law.gain is 2, recorded 1',),
    )  # fmt: skip
    assert outcome.table() == (
        'note: a remark\n'
        'setting: law.gain is 2, recorded 1\n'
        '2 of 3 events compared\n'
        'field          n    max abs    max rel   differ    first at\n'
        'linear        90   5.00e-01   2.50e-01        4      2.500 s\n'
        'angular       80   1.00e-12   1.00e-10        0           -\n'
        'differs: linear first, at 2.500 s (event 25)'
    )


def test_tables_of_the_estimators():
    results = [
        {'kind': kind, 'noise_variance': noise, 'seed': seed}
        | {'speed': s + 0.1 * seed, 'unknown': 10 * s + 2 * seed}
        for kind, s in (('type3', 0.2), ('type1', 0.5))
        for noise, s in ((0.01, s), (0.04, 2 * s))
        for seed in range(2)
    ]
    half, wide = interval([0.0, 0.1]), interval([0.0, 2.0])
    text = '\n'.join(table.markdown() for table in estimation(ResultTable(results)))
    assert f'| **type3** | 0.2500 ± {half:.4f} | 0.4500 ± {half:.4f} | +0.200 (+80 %) |' in text
    assert f'| type1 | 0.5500 ± {half:.4f} | 1.0500 ± {half:.4f} | +0.500 (+91 %) |' in text
    assert '| type1 | +0.3000 ± 0.0000 * | +0.6000 ± 0.0000 * |' in text
    assert f'| **type3** | 3.0000 ± {wide:.4f} | 5.0000 ± {wide:.4f} | +2.000 (+67 %) |' in text
    assert '(rad/s²)' in text
