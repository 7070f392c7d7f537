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
"""Fault injection: faults of the simulated robot as dynamic parameters."""

from collections.abc import Mapping
from dataclasses import dataclass

from t3mpc_ros.parameters.table import (
    Parameters,
    ParameterSpec,
    parameter,
)


@dataclass(frozen=True)
class FaultParameters(Parameters):
    """Faults that are active now; a parameter at its default is no fault."""

    command_delay: float = parameter(
        0.0, 'additional delay of every command', 's', (0.0, 2.0), dynamic=True
    )
    command_jitter: float = parameter(
        0.0,
        'random additional delay of each command, uniform up to this value; commands may overtake',
        's',
        (0.0, 2.0),
        dynamic=True,
    )
    command_loss: float = parameter(
        0.0, 'fraction of the commands that is lost', bounds=(0.0, 1.0), dynamic=True
    )
    gyro_bias_jump: float = parameter(
        0.0,
        'offset added to the gyro; an MPU6050 may have 0.35 rad/s (20 deg/s)',
        'rad/s',
        (-10.0, 10.0),
        dynamic=True,
    )
    gyro_dead: bool = parameter(False, 'the IMU does not respond', dynamic=True)
    ranges_dead: bool = parameter(False, 'no range sensor is measured', dynamic=True)
    wheel_blocked: str = parameter(
        'none', 'blocked wheel', choices=('none', 'right', 'left', 'both'), dynamic=True
    )
    load_change: float = parameter(
        0.0,
        'mass added to the body, unknown to the controller; negative: removed',
        'kg',
        (-1.0, 5.0),
        dynamic=True,
    )
    slippery: float = parameter(
        1.0, 'factor on the grip of the tyres, everywhere', bounds=(0.0, 1.0), dynamic=True
    )
    supply_sag: float = parameter(
        0.0, 'voltage drop of the battery cells', 'V', (0.0, 20.0), dynamic=True
    )
    brown_out: bool = parameter(False, 'the board restarts when this becomes true', dynamic=True)
    schedule: str = parameter(
        '',
        'schedule of faults: name of a bundled one, or path of a file that ends in .yaml; '
        'empty = none',
    )


FAULTS: Mapping[str, ParameterSpec] = {
    spec.name: spec for spec in FaultParameters.specs() if spec.dynamic
}
"""All faults: the dynamic parameters of :class:`FaultParameters`, in their order."""


def active_faults(parameters: FaultParameters) -> tuple[str, ...]:
    """Return the active faults as text, for example ``command_delay 0.1 s``."""
    texts = []
    for name, spec in FAULTS.items():
        value = getattr(parameters, name)
        if value == spec.default:
            continue
        if isinstance(value, bool):
            texts.append(name)
        else:
            number = f'{value:g}' if isinstance(value, float) else str(value)
            texts.append(f'{name} {number} {spec.unit}'.rstrip())
    return tuple(texts)
