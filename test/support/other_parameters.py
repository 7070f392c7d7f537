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
"""Other valid values of parameters."""

from contextlib import suppress

from t3mpc_ros.parameters.table import ParameterError


def with_other_value(parameters, spec):
    """Return valid parameters that differ in one parameter, which is not its default either."""
    for value in _others(spec, parameters.to_dict()[spec.name]):
        with suppress(ParameterError):
            changed = parameters.with_values({spec.name: value})
            if changed.to_dict()[spec.name] != spec.default:
                return changed
    raise AssertionError(f'no other value of {spec.name} is known')


def _others(spec, value):
    if spec.kind is bool:
        return [not value]
    if spec.kind is str:
        return [choice for choice in spec.choices if choice != value]
    if spec.many:
        return [(spec.kind(1),), ('wheel',)]
    numbers = [value * factor for factor in (0.5, 0.9, 0.99, 1.1, 2.0)]
    numbers += [value + step for step in (0.25, -0.25, 0.01, 90.0)]
    return [spec.kind(number) for number in numbers if spec.kind(number) != value]
