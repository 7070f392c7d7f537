# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A picture of a radio link over time."""

from typing import Any

import numpy as np

from t3mpc_ros.lab.report.canvas import COLOURS, add_legend, name_time, new_panels
from t3mpc_ros.lab.report.recorded import Run

COUNTED = {
    'robot_resets': "resets of the robot's board",
    'dongle_resets': 'resets of the dongle',
    'port_failures': 'failures of the port',
    'crc_errors': 'wrong checksums',
    'frame_errors': 'broken frames',
}
_DASHES: tuple[Any, ...] = ('-', '--', ':', '-.', (0, (1, 3)))


def link(run: Run) -> Any:
    """Return answered cycles, round trips and counters of faults; None without a link."""
    if not run.links or run.links[0].time.size < 2:
        return None
    shown = run.links[0]
    values, answered = shown.values, shown.answered()
    told = bool(np.isfinite(answered).any())
    trips = [key for key in ('round_trip_median_ms', 'round_trip_p99_ms') if key in values]
    counted = [key for key in COUNTED if np.isfinite(values.get(key, np.nan)).any()]
    if not (told or trips or counted):
        return None
    figure, axes = new_panels(told + bool(trips) + bool(counted), 1.5)
    free = iter(axes)
    if told:
        axis = next(free)
        style = {'color': COLOURS['answered'], 'linewidth': 1.1, 'drawstyle': 'steps-pre'}
        axis.plot(shown.time, 100.0 * answered, **style)
        axis.set_title(f'{shown.name}: cycles answered since the report before')
        axis.set_ylabel('%')
        axis.set_ylim(min(90.0, 100.0 * float(np.nanmin(answered)) - 2.0), 101.0)
    if trips:
        axis = next(free)
        for key, strength in zip(trips, (1.0, 0.5), strict=False):
            label = 'median' if 'median' in key else '99 % below'
            style = {'color': COLOURS['round trip'], 'alpha': strength, 'linewidth': 1.1}
            axis.plot(shown.time, values[key], label=label, **style)
        axis.set_title('round trip')
        axis.set_ylabel('ms')
        axis.set_ylim(bottom=0.0)
        add_legend(axis)
    if counted:
        axis = next(free)
        for key, dash in zip(counted, _DASHES, strict=False):
            since = values[key] - values[key][np.isfinite(values[key])][0]
            style = {'color': COLOURS['resets'], 'linewidth': 1.1, 'linestyle': dash}
            axis.step(shown.time, since, where='post', label=COUNTED[key], **style)
        axis.set_title('faults since the first report')
        axis.set_ylabel('number')
        axis.set_ylim(-0.05, max(1.0, 1.6 * axis.get_ylim()[1]))
        axis.legend(loc='upper left', ncols=3)
    name_time(axes)
    return figure
