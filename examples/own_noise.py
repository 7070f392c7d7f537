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
"""Noise by a law of one's own, lost messages, and a blocked wheel."""

import numpy as np

import t3mpc_ros as t3


class Outliers:
    """White noise, and now and then a reading that is far off."""

    def __call__(self, generator, time, speeds):
        """Return what is added to the true wheel speeds, rad/s, shape (2,)."""
        noise = 0.1 * generator.standard_normal(2)
        return noise + 3.0 * (generator.random(2) < 0.01) * generator.standard_normal(2)


def main(duration=20.0):
    """Print the RMSE of the full controller with each of them."""
    law = t3.NoiseLaw(Outliers(), variance=0.1)
    lost = t3.LinkFaults(command_loss=0.2, odometry_loss=0.2)
    blocked = t3.FaultSchedule([t3.FaultEvent(0.5 * duration, 'wheel_blocked', 'left', 1.0)])
    runs = {
        'white noise': t3.simulate('full', plant='servo', duration=duration),
        'outliers': t3.simulate('full', plant='servo', noise=law, duration=duration),
        'lost messages': t3.simulate('full', plant='servo', faults=lost, duration=duration),
        'blocked wheel': t3.simulate('full', plant='twin', faults=blocked, duration=duration),
    }
    for name, run in runs.items():
        print(f'{name}: RMSE {run.rmse():.4f} rad/s, largest {np.abs(run.error).max():.3f} rad/s')
    return runs


if __name__ == '__main__':
    main()
