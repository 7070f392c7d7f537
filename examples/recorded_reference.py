# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Compare methods in closed loop on the reference of a bag."""

from pathlib import Path
import sys

import numpy as np

import t3mpc_ros as t3


def main(path='runs/latest/bag', folder=Path('runs/examples'), duration=None, executor=None):
    """Track the recorded reference with two methods on the digital twin."""
    reference = t3.read_bag(path)['/reference']
    time = reference['stamp'] - reference['stamp'][0]
    columns = [time, reference['twist.twist.linear.x'], reference['twist.twist.angular.z']]
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / 'recorded_reference.csv'
    header = 'time,linear,angular'
    np.savetxt(file, np.column_stack(columns), delimiter=',', header=header, comments='')
    duration = duration or float(time[-1])
    table = t3.compare(['full', 'DMC'], reference=file, duration=duration, executor=executor)
    print(table)
    return table


if __name__ == '__main__':
    main(*sys.argv[1:])
