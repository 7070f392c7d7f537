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
"""The parameter file of a controller for a drive that was identified in a recorded run."""

from dataclasses import asdict

from t3mpc_ros.control.controller import ControllerParameters, StepperControllerParameters
from t3mpc_ros.evaluation.tuning.drive_identification import IdentifiedDrive
from t3mpc_ros.parameters.yaml_file import parameter_file


def fitting_parameters(
    drive: IdentifiedDrive, composition: str, slower: float = 0.0
) -> ControllerParameters:
    """Return the parameters for a drive with a lag ``slower`` by some s; the gain by the rule."""
    parameters = StepperControllerParameters().with_values(
        {
            'rate': drive.rate,
            'wheel_radius': drive.geometry.wheel_radius,
            'wheel_separation': drive.geometry.wheel_separation,
            'composition': composition,
            'mean_speeds': drive.mean_speeds,
            'speed_filter.lag': drive.lag.value + slower,
            'speed_filter.dead_time': drive.dead_time.value,
            'speed_filter.noise_variance': drive.noise_variance.value,
            'law.gain': 0.0,
        }
    )
    return parameters.resolved()


def drive_record(drive: IdentifiedDrive, composition: str) -> dict[str, object]:
    """Return the drive, with standard deviations, and the parameters that fit it as plain data."""
    return {'drive': asdict(drive), 'parameters': fitting_parameters(drive, composition).to_dict()}


def drive_file(drive: IdentifiedDrive, composition: str, source: str) -> str:
    """Return the parameter file (YAML) of the controller for a drive; ``source`` names the bag."""
    values = fitting_parameters(drive, composition).to_dict()
    slower = fitting_parameters(drive, composition, drive.lag.uncertainty).to_dict()

    def by_lag(name: str, unit: str) -> str:
        change = abs(float(str(slower[name])) - float(str(values[name])))
        return f'by the lag; standard deviation {change:.2g} {unit}'

    kind = 'means over the period before the stamp' if drive.mean_speeds else 'at the stamp'
    comments = {
        'rate': 'of the odometry',
        'wheel_radius': '',
        'wheel_separation': '',
        'composition': '',
        'mean_speeds': f'measured speeds are {kind}',
        'speed_filter.lag': f'standard deviation {drive.lag.uncertainty:.2g} s',
        'speed_filter.dead_time': f'standard deviation {drive.dead_time.uncertainty:.2g} s',
        'speed_filter.noise_variance': 'standard deviation '
        f'{drive.noise_variance.uncertainty:.2g} (rad/s)²',
        'law.gain': by_lag('law.gain', '1/s'),
        'law.smoothing': by_lag('law.smoothing', 'rad/s'),
    }
    rounded = {
        name: float(f'{value:.5g}') if isinstance(value := values[name], float) else value
        for name in comments
    }
    title = (
        f'Drive identified from {source}: {drive.duration:.1f} s, '
        f'{100 * drive.explained:.1f} % of the wheel speeds explained.'
    )
    title = '\n# '.join([title, *drive.oddities])
    return parameter_file(title, {'/**/controller': rounded}, comments)
