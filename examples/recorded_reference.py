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
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / 'recorded_reference.csv'
    header = 'time,linear,angular'
    np.savetxt(file, np.column_stack(columns), delimiter=',', header=header, comments='')
    duration = duration or float(time[-1])
    table = t3.compare(['full', 'DMC'], reference=file, duration=duration, executor=executor)
    print(table)
    return table


if __name__ == '__main__':
    try:
        main(*sys.argv[1:3])
    except t3.ScriptError as error:
        sys.exit(f'error: {error}')
