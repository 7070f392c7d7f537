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
"""A recorded run as the page of ``t3mpc view`` shows it."""

from collections.abc import Sequence
import math
from pathlib import Path

import numpy as np

from t3mpc_ros.bag.reader import open_bag
from t3mpc_ros.control.control_law import TERM_NAMES
from t3mpc_ros.evaluation.bag_report.incidents import UNDER_WAY, Incidents, exceeds
from t3mpc_ros.evaluation.bag_report.metrics import compute_metrics
from t3mpc_ros.evaluation.bag_report.recorded_run import Run, load_run
from t3mpc_ros.evaluation.topic_roles import ReportOptions, bag_display_name
from t3mpc_ros.geometry.types import NANOSECONDS, Array
from t3mpc_ros.simulation.world import world_outline
from t3mpc_ros.view.live_data import STEP, LiveData


def recorded_run(bag: Path, namespace: str | None = None) -> LiveData:
    """Return the recorded run of a robot as the page shows it: of any robot with odometry.

    ValueError without odometry.
    """
    data = LiveData(math.inf, STEP)
    with open_bag(bag) as recording:
        run = load_run(recording, ReportOptions(namespace))
        metrics = compute_metrics(run, Path(), recording.message_count)
        verdict, incidents = metrics.verdict, metrics.incidents
        data.set('origin', recording.start_ns / NANOSECONDS)
    if 'odom' not in run.motions:
        raise ValueError(f'{bag} has no odometry to show; t3mpc bag info lists its topics')
    absent = ['preview', *_add_motions(data, run), *_add_terms(data, run)]
    for event in sorted(_events(run, incidents)):
        data.report(*event)
    data.set('absent', absent)
    data.set('channels', [[each.title.capitalize(), each.unit] for each in run.channels])
    data.set('follows_path', run.follows_path)
    data.set('terms', list(TERM_NAMES))
    if run.geometry is not None:
        size = {
            'wheel_radius': run.geometry.wheel_radius,
            'wheel_separation': 2.0 * run.geometry.half_separation,
        }
        data.set('robot', size)
    data.set('world', world_outline(run.world))
    data.set(
        'banner',
        {
            'kind': 'good' if verdict.kind == 'good' else 'warning',
            'headline': verdict.sentence,
            'detail': ' '.join(
                [f'Recording {bag_display_name(bag)}, {run.duration:.1f} s.', *verdict.reasons()]
            ),
        },
    )
    data.set('recording', {'duration': run.duration})
    return data


def _add_motions(data: LiveData, run: Run) -> list[str]:
    """Add the samples of each recorded motion; return the streams that are absent."""
    channels = tuple(each.name for each in run.channels)
    motion = (*channels, 'x', 'y', 'yaw')
    shown = {
        'odometry': ('odom', motion),
        'truth': ('ground_truth/odom', motion),
        'reference': ('reference', motion),
        'command': ('cmd_vel', channels),
    }
    for stream, (topic, names) in shown.items():
        if topic in run.motions:
            series = run.motions[topic]
            unknown = np.full(len(series), math.nan)  # a reference may have speeds only
            columns = [series.values.get(name, unknown) for name in names]
            _add_columns(data, stream, series.time, columns)
    return [stream for stream, (topic, _) in shown.items() if topic not in run.motions]


def _add_terms(data: LiveData, run: Run) -> list[str]:
    """Add the terms of the control law at the times of the first; return the stream if absent."""
    terms = [
        run.numbers.get(f'controller/terms/{term}/{wheel}')
        for term in TERM_NAMES
        for wheel in ('right', 'left')
    ]
    first = terms[0]
    if not first:
        return ['terms']
    columns = [
        np.interp(first.time, each.time, each['value']) if each else np.full(len(first), np.nan)
        for each in terms
    ]
    _add_columns(data, 'terms', first.time, columns)
    return []


def _events(run: Run, incidents: Incidents) -> list[tuple[float, str, str]]:
    """Return what happened, as of :meth:`LiveData.report`."""
    events = [(time, 'switch', 'switch of the reference') for time in run.switches.tolist()]
    events += [(when, 'note', f'{node}: {text}') for when, _, node, text in run.complaints]
    for stop in incidents.stops:
        later = run.motions[run.measured].between(stop.end, math.inf)
        if exceeds(later, UNDER_WAY).any():
            events.append((stop.end, 'resume', 'the robot moves again'))
    return events + incidents.events()


def _add_columns(data: LiveData, stream: str, time: Array, columns: Sequence[Array]) -> None:
    for row, at in enumerate(time.tolist()):
        data.add(stream, at, [column[row] for column in columns])
