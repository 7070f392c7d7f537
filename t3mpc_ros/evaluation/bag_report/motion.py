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
"""Motion of a robot in a report: path length, speeds, stops."""

import numpy as np

from t3mpc_ros.evaluation.bag_report.incidents import (
    DEMANDED,
    PAUSE,
    STILL,
    smooth,
    still_rows,
)
from t3mpc_ros.evaluation.bag_report.run_data import Run
from t3mpc_ros.evaluation.record import spans_of
from t3mpc_ros.evaluation.reporting import format_number
from t3mpc_ros.evaluation.topic_roles import COMMAND


def motion_rows(run: Run) -> list[list[str]]:
    """Return path length, turning, speeds and stops as rows; none when there are few samples."""
    motion, command = run.motions.get(run.measured), run.motions.get(COMMAND)
    if motion is None:
        return []
    time, linear = smooth(motion, 'linear')
    _, angular = smooth(motion, 'angular')
    known = np.isfinite(linear)
    if not known.any():
        return []
    step = float(time[1] - time[0]) if time.size > 1 else 0.0
    still = still_rows(linear, angular)
    spans = [each for each in spans_of(still) if (each.stop - each.start) * step >= PAUSE]
    stops = [(float(time[each][0]), float(time[each][-1])) for each in spans]
    lengths = [end - start for start, end in stops]
    distance = float(np.abs(linear[known]).sum() * step)
    moving = float(np.count_nonzero(known & ~still) * step)
    mean, fastest = distance / moving if moving > 0.0 else 0.0, np.abs(linear[known]).max()
    turned = float(np.abs(angular[known]).sum() * step)
    rows = [
        ['path length, forwards and backwards', f'{format_number(distance)} m'],
        ['turning, both ways', f'{format_number(turned)} rad'],
        ['speed while moving, mean and largest', f'{mean:.3f} and {fastest:.3f} m/s'],
        ['time moving', f'{moving:.1f} s'],
        [
            'standstills',
            f'{len(stops)}, {sum(lengths):.1f} s in all, the longest '
            f'{max(lengths, default=0.0):.1f} s',
        ],
    ]
    if stops:
        where = ', '.join(f'{start:.1f} to {end:.1f}' for start, end in stops[:5])
        more = f', and {len(stops) - 5} more' if len(stops) > 5 else ''
        rows.append(['standstill at', f'{where}{more} s'])
    if command is not None:
        commanded = np.zeros(time.size, dtype=np.bool_)
        for name, least in STILL.items():
            commanded |= np.abs(command.held(name, time)) > DEMANDED * least
        commanded &= time >= command.time[0]
        disobeyed = step * sum(int(np.count_nonzero(commanded[each])) for each in spans)
        rows.append(['of that, motion was commanded', f'{disobeyed:.1f} s'])
    return rows
