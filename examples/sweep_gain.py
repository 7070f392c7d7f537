# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Sweep a gain of two methods over noise and seeds, into a Parquet file."""

from pathlib import Path

import t3mpc_ros as t3


def main(folder=Path('runs/examples'), duration=26.0, executor=None):
    """Print the table and draw the error over the gain; run it again: nothing is left to do."""
    found = t3.sweep(
        ['PI + feed-forward', 'ADRC'],
        {'gain': [5.0, 10.0, 20.0, 40.0], 'noise': [0.0, 0.04]},
        plant='servo',
        seeds=range(1, 4),
        duration=duration,
        output=folder / 'sweep_gain.parquet',
        executor=executor,
        progress=True,
    )
    print(found)
    found.plot('gain', 'settled', folder / 'sweep_gain.png')
    return found


if __name__ == '__main__':
    main()
