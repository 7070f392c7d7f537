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
"""``t3mpc robot calibrate``: the wizard at a terminal, and its parameter file."""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
import datetime
import math
import os
from pathlib import Path
import sys
from typing import Any

from t3mpc_ros.atomic_file import write_atomically
from t3mpc_ros.cli.shared_options import ask_line, check_two_ports
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.parameters.command_line import bounded_float, bounded_int, check_writable
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.parameters.yaml_loader import file_errors, parameter_file, read_yaml
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.tool.calibration_wizard import (
    STEPS,
    USB_STEPS,
    CalibrationRobot,
    CalibrationWizard,
    Interrupted,
    WizardOptions,
    available_steps,
)
from t3mpc_ros.radio.tool.procedure import ProcedureError
from t3mpc_ros.radio.tool.robot_settings import RobotSettings
from t3mpc_ros.robot.calibration import (
    MARKS,
    Calibration,
    DividerCorrection,
    Estimate,
    MarkUncertainty,
    SharpCurve,
)

_EXIT_OK, _EXIT_INTERRUPTED = 0, 130


def _report(text: str) -> None:
    print(f't3mpc robot: {text}', file=sys.stderr)


# -- parameter file -------------------------------------------------------------------------------


_ESTIMATES = {
    'wheel_radius': ('wheel_radius', 'calibration.wheel_radius_uncertainty'),
    'track': ('wheel_separation', 'calibration.wheel_separation_uncertainty'),
    'gyro_scale': ('odometry.gyro_scale', 'odometry.gyro_scale_tolerance'),
    'gyro_bias': ('calibration.gyro_bias', 'calibration.gyro_bias_uncertainty'),
}
"""Parameters of value and uncertainty of each estimate of a calibration."""
_GEOMETRY = 'wheel_radius', 'wheel_separation'
"""Parameters that the controller and the generator have, too."""


def calibration_file(found: Calibration, date: str, link: Mapping[str, object]) -> str:
    """Return the ROS parameter file of a calibration.

    It holds the parameters of the link (by name, without ``link.``) as well: the launch file takes
    one file.
    """
    bridge: dict[str, object] = {f'link.{name}': value for name, value in link.items()}
    bridge['calibration.date'] = date
    for field, names in _ESTIMATES.items():
        if (estimate := getattr(found, field)) is not None:
            bridge |= zip(names, map(_rounded, estimate), strict=True)
    geometry = {name: bridge[name] for name in _GEOMETRY if name in bridge}
    if found.divider is not None:
        for name, value in found.divider._asdict().items():
            bridge[f'calibration.battery_{name}'] = _rounded(value)
    if any(found.curves):
        none = SharpCurve(0.0, 0.0, 0.0, 0.0)
        for name in SharpCurve._fields:
            values = [_rounded(getattr(curve or none, name)) for curve in found.curves]
            bridge[f'calibration.range_{name}'] = values
    nodes = {'radio_bridge': bridge}
    if geometry:
        nodes |= {'controller': dict(geometry), 'reference_generator': geometry}
    if (tolerance := bridge.get('odometry.gyro_scale_tolerance')) is not None:
        nodes.setdefault('controller', {})['body.gyro_scale_tolerance'] = tolerance
    title = 'Calibration of the robot, written by t3mpc robot calibrate.'
    return parameter_file(title, {f'/**/{node}': values for node, values in nodes.items()})


def _rounded(value: float) -> float:
    """Return a value with seven digits: a file that a person can read."""
    return float(f'{value:.7g}')


def read_parameter_file(path: Path) -> tuple[Calibration, dict[str, object]]:
    """Return the calibration and the link parameters of a file of :func:`calibration_file`."""
    from t3mpc_ros.radio.radio_robot import RadioRobotParameters  # with the compiler

    with file_errors(path, ParameterError):
        content: Any = read_yaml(path)
    try:
        values = content['/**/radio_bridge']['ros__parameters']
        parameters = RadioRobotParameters.from_dict(values)
    except (KeyError, TypeError) as error:
        raise ParameterError(
            f'{path} must be a parameter file of t3mpc robot calibrate, with calibration below '
            '/**/radio_bridge'
        ) from error
    except ParameterError as error:
        raise ParameterError(f'{path}: {error}') from error
    known: dict[str, Any] = parameters.to_dict()
    estimates = {
        field: Estimate(known[value], known[uncertainty])
        for field, (value, uncertainty) in _ESTIMATES.items()
        if value in values and known[uncertainty] > 0.0
    }
    battery = [known[f'calibration.battery_{name}'] for name in DividerCorrection._fields]
    ranges = [known[f'calibration.range_{name}'] for name in SharpCurve._fields]
    found = Calibration(
        **estimates,
        divider=DividerCorrection(*battery) if battery[-1] > 0.0 else None,
        curves=tuple(
            SharpCurve(*each) if each[-1] > 0.0 else None for each in zip(*ranges, strict=True)
        ),
    )
    link = parameters.link
    return found, {'address': link.address} | _changed(link)


def _changed(link: LinkParameters) -> dict[str, object]:
    """Return the parameters of a link that differ from their defaults, by name."""
    defaults = LinkParameters().to_dict()
    return {name: value for name, value in link.to_dict().items() if value != defaults[name]}


# -- command --------------------------------------------------------------------------------------


def calibrate(
    options: argparse.Namespace, parameters: LinkParameters, key: bytes, stop: Callable[[], bool]
) -> int:
    """Run the wizard; save what it found, also if the user ends it; return the exit code."""
    if not (options.port or options.robot_port):
        raise ProcedureError('give --port of the dongle, --robot-port of the robot board, or both')
    check_two_ports(options.port, options.robot_port)
    _check_steps(options.steps or (), available_steps(options.port, options.robot_port))
    check_writable(options.save)
    if not sys.stdin.isatty():
        raise ProcedureError('calibrating a robot needs a person: run it at a terminal')
    path: Path = options.save
    robot = CalibrationRobot(
        options.port, options.robot_port, parameters, key, os.urandom, stop, _report
    )
    start, link = Calibration(), _changed(parameters)
    try:
        own = _link_of(robot.settings()) if options.robot_port else parameters
        _check_address('the link parameters are', link, own)
        saved: dict[str, object] = {}
        if path.exists():
            start, saved = read_parameter_file(path)
            _check_address(f'{path} is', saved, own)
        elif options.robot_port:
            start = robot.stored()
    except Interrupted as interruption:
        raise ProcedureError('interrupted') from interruption
    link = {'address': own.address} | saved | _changed(own) | link
    wizard = CalibrationWizard(robot, _asker(stop), _show, _wizard_options(options), start)
    code = _EXIT_OK
    try:
        wizard.run()
    except Interrupted:
        _show('')
        _report('interrupted')
        code = _EXIT_INTERRUPTED
    if wizard.calibration != start:
        today = datetime.date.today().isoformat()
        write_atomically(path, calibration_file(wizard.calibration, today, link))
        _show(f'{path}: saved; ros2 launch t3mpc_ros robot.launch.py params_file:={path}')
    return code


def _link_of(settings: RobotSettings) -> LinkParameters:
    """Return the link parameters of the host that fit the settings of a robot."""
    return LinkParameters(
        address=settings.address.hex(), channel=settings.channel, rate=settings.rate
    )


def _check_address(subject: str, link: Mapping[str, object], robot: LinkParameters) -> None:
    """Raise ProcedureError if link parameters name the address of another robot."""
    address = str(link.get('address', robot.address))
    if address.lower() != robot.address.lower():
        raise ProcedureError(
            f'{subject} of the robot at address {address}, and this robot has {robot.address}: '
            'give --params-file and --save of this robot (where only link.address is wrong or '
            'missing, correct it), or connect the other one'
        )


def _check_steps(steps: Sequence[str], available: Sequence[str]) -> None:
    """Raise ProcedureError for a step that needs the other pass: a cable, or none."""
    for step in steps:
        if step in available:
            continue
        if step in USB_STEPS:
            raise ProcedureError(f'the step {step} needs --robot-port, at rest')
        raise ProcedureError(
            f'the step {step} needs a robot without cables: unplug its USB, and give --port of '
            'the dongle alone'
        )


def _show(text: str) -> None:
    print(text, flush=True)


def _asker(stop: Callable[[], bool]) -> Callable[[str], str]:
    def ask(question: str) -> str:
        answer = ask_line(question, stop)
        if not answer:
            raise Interrupted
        return answer

    return ask


def _wizard_options(options: argparse.Namespace) -> WizardOptions:
    marks = MarkUncertainty(
        1e-3 * options.mark_distance,
        math.radians(options.mark_angle),
        1e-3 * options.mark_range,
        options.mark_voltage,
    )
    return WizardOptions(
        marks,
        WheelGeometry(options.wheel_radius, options.wheel_separation),
        tuple(options.steps or STEPS),
        options.distance,
        options.turns,
        options.speed,
        tuple(options.distances),
    )


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Add the arguments of the command, besides those of the link."""
    add = command.add_argument
    usual = WizardOptions()
    geometry = usual.geometry
    add(
        '--robot-port',
        default='',
        help='USB port of the robot board: the second pass, at rest; without --port, the steps '
        'that need no radio',
    )
    text = (
        'parameter file of the result (default calibration.yaml); its values are kept where '
        'a step is left out'
    )
    add('--save', type=Path, default=Path('calibration.yaml'), metavar='FILE', help=text)
    text = (
        f'some of {", ".join(STEPS)}; default: with --robot-port {" and ".join(USB_STEPS)}, '
        'without it the others, without --port rest as well'
    )
    add('--steps', type=_steps, metavar='STEP,…', help=text)
    for flag, kind, default, text in (
        ('--wheel-radius', bounded_float(0.005, 1.0), geometry.wheel_radius, 'nominal, m'),
        ('--wheel-separation', bounded_float(0.01, 5.0), geometry.wheel_separation, 'nominal, m'),
        ('--distance', bounded_float(0.5, 20.0), usual.distance, 'straight run, m'),
        ('--turns', bounded_int(2, 15), usual.turns, 'turns on the spot'),
        ('--speed', bounded_float(0.2, 8.0), usual.speed, 'wheel speed, rad/s'),
    ):
        add(flag, type=kind, default=default, help=f'{text} (default {default:g})')
    text = (
        'from the distance sensors to the board, m (default '
        f'{",".join(map(str, usual.distances))})'
    )
    add('--distances', type=_distances, default=usual.distances, metavar='M,…', help=text)
    for name, value, unit, text in (
        ('distance', 1e3 * MARKS.distance, 'mm', 'of a mark on the floor'),
        ('angle', math.degrees(MARKS.angle), 'degrees', 'of a direction read from a mark'),
        ('range', 1e3 * MARKS.range, 'mm', 'of the distance of the board'),
        ('voltage', MARKS.voltage, 'V', 'of the meter'),
    ):
        add(
            f'--mark-{name}',
            type=bounded_float(1e-3, 100.0),
            default=value,
            help=f'standard uncertainty {text}, {unit} (default {value:g})',
        )


def _steps(text: str) -> Sequence[str]:
    steps = text.split(',')
    for step in steps:
        if step not in STEPS:
            raise argparse.ArgumentTypeError(f'must be of {", ".join(STEPS)}: got {step}')
    return steps


def _distances(text: str) -> Iterable[float]:
    values = sorted(float(each) for each in text.split(','))
    if len(values) < 4 or not values[0] >= 0.05 or not values[-1] <= 1.0:
        raise argparse.ArgumentTypeError(f'must be at least 4, from 0.05 to 1 m: got {text}')
    return values
