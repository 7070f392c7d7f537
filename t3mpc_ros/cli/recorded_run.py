# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A recorded run as the page of ``t3mpc view`` shows it."""

from collections.abc import Sequence
import math
from pathlib import Path

import numpy as np

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.evaluation.bag_report.metrics import compute_metrics
from t3mpc_ros.evaluation.bag_report.run_data import load_run
from t3mpc_ros.evaluation.topic_roles import bag_display_name
from t3mpc_ros.geometry.types import Array
from t3mpc_ros.simulation.world import world_outline
from t3mpc_ros.view.live_data import STEP, LiveData


def recorded_run(bag: Path) -> LiveData:
    """Return a recorded run as the page shows it."""
    data = LiveData(math.inf, STEP)
    with open_bag(bag) as recording:
        run = load_run(recording)
        verdict = compute_metrics(run, Path(), recording.message_count).verdict
    if run.geometry is None:
        raise ValueError(
            f'{bag} has no parameters of a robot: its wheel radius and separation are not known '
            '(t3mpc bag report takes them as options)'
        )
    motion = ('right', 'left', 'x', 'y', 'yaw')
    for stream, topic, names in (
        ('odometry', 'odom', motion),
        ('truth', 'ground_truth/odom', motion),
        ('reference', 'reference', motion),
        ('command', 'cmd_vel', motion[:2]),
    ):
        if topic in run.motions:
            series = run.motions[topic]
            _add_columns(data, stream, series.time, [series[name] for name in names])
    terms = [
        run.numbers.get(f'controller/terms/{term}/{wheel}')
        for term in TERM_NAMES
        for wheel in ('right', 'left')
    ]
    if first := terms[0]:
        columns = [
            np.interp(first.time, each.time, each['value'])
            if each
            else np.full(len(first), np.nan)
            for each in terms
        ]
        _add_columns(data, 'terms', first.time, columns)
    for time_of_switch in run.switches.tolist():
        data.report(time_of_switch, 'switch', 'switch of the reference')
    for when, _, node, text in run.complaints:
        data.report(when, 'note', f'{node}: {text}')
    data.set('terms', list(TERM_NAMES))
    data.set(
        'robot',
        {
            'wheel_radius': run.geometry.wheel_radius,
            'wheel_separation': 2.0 * run.geometry.half_separation,
        },
    )
    data.set('world', world_outline(run.world))
    data.set(
        'banner',
        {
            'kind': 'good' if verdict.sound else 'warning',
            'headline': f'Recording {bag_display_name(bag)}, {run.duration:.1f} s',
            'detail': verdict.text(),
        },
    )
    data.set('recording', {'duration': run.duration})
    return data


def _add_columns(data: LiveData, stream: str, time: Array, columns: Sequence[Array]) -> None:
    for row, at in enumerate(time.tolist()):
        data.add(stream, at, [column[row] for column in columns])
