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
"""The fuzzy system alone: rules by hand, and a fit to noisy samples with each kind of sets."""

import numpy as np

import t3mpc_ros as t3


def main(samples=200):
    """Print the output of three rules, and the error of each kind away from its samples."""
    heating = t3.fuzzy('temperature', sets=3, centres=(10.0, 30.0))
    for index, power in enumerate((100.0, 40.0, 0.0)):  # cold, mild, hot
        heating.add_rule([('temperature', index)], power)
    for temperature in (10.0, 17.0, 30.0):
        power = heating.evaluate({'temperature': temperature})
        print(f'{temperature:g} °C: {power:.1f} %')

    generator = np.random.default_rng(1)
    inputs = generator.uniform(-1.0, 1.0, (samples, 2))
    outputs = np.sin(3.0 * inputs[:, 0]) * inputs[:, 1]
    noisy = outputs + 0.1 * generator.standard_normal(samples)
    apart = generator.uniform(-0.9, 0.9, (samples, 2))
    errors = {}
    for kind in ('type1', 'interval_type2', 'type3'):
        system = t3.fuzzy('x', 'y', kind=kind, sets=5).fit(inputs, noisy, ridge=0.01)
        missed = system.evaluate(apart) - np.sin(3.0 * apart[:, 0]) * apart[:, 1]
        errors[kind] = float(np.sqrt(np.mean(missed**2)))
        print(f'{kind}: RMSE {errors[kind]:.4f}')
    return heating, errors


if __name__ == '__main__':
    main()
