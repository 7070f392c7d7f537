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
"""Sweep a gain of two methods over noise and seeds, into a Parquet file."""

from pathlib import Path

import t3mpc_ros as t3


def main(folder=Path('runs/examples'), duration=26.0, executor=None):
    """Print the table and draw the error over the gain; run it again: nothing is left to do."""
    folder.mkdir(parents=True, exist_ok=True)
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
