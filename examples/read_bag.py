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
"""Read a bag without ROS, and plot commanded and measured speeds."""

from pathlib import Path
import sys

import t3mpc_ros as t3


def main(path='runs/latest/bag', folder=Path('runs/examples')):
    """Print what the bag holds, and draw its odometry against the commands."""
    import matplotlib.figure

    bag = t3.read_bag(path)
    for topic, kind in bag.types.items():
        print(f'{topic} ({kind}): {len(bag[topic].get("received", ()))} messages')
    odometry, command = bag['/odom'], bag['/cmd_vel']
    figure = matplotlib.figure.Figure(figsize=(6.2, 3.0), layout='constrained')
    axis = figure.subplots()
    axis.plot(odometry['stamp'], odometry['twist.twist.linear.x'], label='odom')
    axis.plot(command['received'], command['linear.x'], label='cmd_vel')
    axis.set_xlabel('time / s')
    axis.set_ylabel('m/s')
    axis.legend()
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / 'read_bag.png', dpi=150)
    return bag


if __name__ == '__main__':
    try:
        main(*sys.argv[1:3])
    except t3.ScriptError as error:
        sys.exit(f'error: {error}')
