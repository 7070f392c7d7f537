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
"""A PI controller of one's own in a table against the full controller."""

from pathlib import Path

import numpy as np

import t3mpc_ros as t3


class Pi:
    """Feed-forward of the reference, and a PI controller on the error."""

    def __init__(self, model, gain=20.0, integral=100.0):
        self.period = model.period  # s
        self.gain, self.integral = gain, integral
        self.sum = np.zeros(2)

    def step(self, observation):
        """Return the accelerations of the right and the left wheel, rad/s²."""
        slope = (observation.next_reference - observation.reference) / self.period
        error = observation.speeds - observation.reference
        self.sum = self.sum + self.period * error
        return slope - self.gain * error - self.integral * self.sum


def main(folder=Path('runs/examples'), duration=30.0, executor=None):
    """Print the table, and write it with a figure as a page."""
    folder.mkdir(parents=True, exist_ok=True)
    controllers = ['full', Pi, t3.Controller(Pi, {'gain': 40.0, 'integral': 400.0})]
    table = t3.compare(controllers, seeds=range(1, 4), duration=duration, executor=executor)
    print(table)
    print(table.to_html(folder / 'own_controller.html'))
    run = t3.simulate(Pi, plant='servo', duration=duration)
    run.plot(folder / 'own_controller.png')
    return table


if __name__ == '__main__':  # the runs are spread over processes, which import this file
    main()
