# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""``t3mpc robot calibrate``: the wizard at a terminal, and its parameter file."""

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
import datetime
import math
import os
from pathlib import Path
import sys
from typing import Any, TypeVar

from t3mpc_ros.cli.command import ask_line, check_writable
from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.parameters.command_line import bounded_float, bounded_int
from t3mpc_ros.parameters.table import ParameterError
from t3mpc_ros.parameters.yaml_files import YamlError, parameter_file, read_yaml
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.radio_robot import RadioRobotParameters
from t3mpc_ros.radio.tool import procedure, robot_records, robot_settings
from t3mpc_ros.radio.tool.calibration_wizard import (
    STEPS,
    CalibrationRobot,
    CalibrationWizard,
    WizardOptions,
)
from t3mpc_ros.radio.tool.manoeuvre import HandTurn, Manoeuvre, Rest
from t3mpc_ros.radio.tool.procedure import ROBOT_BOARD, ProcedureError, Script
from t3mpc_ros.robot.calibration import (
    MARKS,
    Calibration,
    DividerCorrection,
    Estimate,
    MarkUncertainty,
    Recording,
    SharpCurve,
)
from t3mpc_ros.robot.interface import WheelAngles

Value = TypeVar('Value')
_EXIT_OK, _EXIT_INTERRUPTED = 0, 130


class Interrupted(Exception):
    """The user ends the wizard: Ctrl-C, or the end of the input."""


class LinkedRobot(CalibrationRobot):
    """The robot behind a dongle and, for raw counts, behind its own USB port.

    Parameters
    ----------
    port, robot_port
        Of the dongle, and of the robot board; the second may be empty.
    parameters, key
        Of the link.
    interrupted
        Whether the user has ended the wizard; polled during every measurement.
    """

    def __init__(
        self,
        port: str,
        robot_port: str,
        parameters: LinkParameters,
        key: bytes,
        interrupted: Callable[[], bool],
    ) -> None:
        self.has_usb = bool(robot_port)
        self._port = port
        self._robot_port = robot_port
        self._parameters = parameters
        self._key = key
        self._interrupted = interrupted

    def rest(self, seconds: float) -> Recording:
        """Return a recording of the robot at rest."""
        return self._record(Rest(self._parameters, self._key, os.urandom, seconds, _report))

    def drive(self, angles: WheelAngles, speed: float, rests: tuple[float, float]) -> Recording:
        """Turn the wheels by angles (rad); return the recording with the rests around it."""
        return self._record(
            Manoeuvre(self._parameters, self._key, os.urandom, angles, speed, _report, rests)
        )

    def turn_by_hand(self, timeout: float, rests: tuple[float, float]) -> Recording:
        """Return the recording of a turn by hand between two rests."""
        return self._record(
            HandTurn(self._parameters, self._key, os.urandom, timeout, _report, rests)
        )

    def counts(self, samples: int) -> Sequence[tuple[int, ...]]:
        """Return raw counts: of the eight distance sensors and, last, of the battery."""
        return self._at_board(robot_records.read_counts(samples))

    def divider(self) -> float:
        """Return the nominal divider of the battery, as in the settings of the robot."""
        stored = self._at_board(robot_settings.read_settings())
        if not stored.valid:
            raise ProcedureError('the robot has no valid settings: t3mpc robot setup')
        return stored.settings.divider

    def store(self, found: Calibration) -> None:
        """Store a calibration in the robot, in place of the one that it has."""
        try:
            self._at_board(robot_records.write_calibration(found))
        except ValueError as error:
            raise ProcedureError(f'the robot cannot hold this calibration: {error}') from error

    def stored(self) -> Calibration:
        """Return the calibration in the robot."""
        return self._at_board(robot_records.read_calibration())

    def _at_board(self, script: Script[Value]) -> Value:
        try:
            return procedure.run_script(script, self._robot_port, self._interrupted, ROBOT_BOARD)
        except ProcedureError as error:
            if self._interrupted():
                raise Interrupted from error
            raise

    def _record(self, task: Manoeuvre) -> Recording:
        procedure.run_at_port(task, self._port, self._interrupted)
        if self._interrupted():
            raise Interrupted
        if task.error:
            raise ProcedureError(task.error)
        return task.recording


def _report(text: str) -> None:
    print(f't3mpc robot: {text}', file=sys.stderr)


# -- parameter file -------------------------------------------------------------------------------


def calibration_file(found: Calibration, date: str, link: Mapping[str, object]) -> str:
    """Return the ROS parameter file of a calibration.

    It holds the parameters of the link (by name, without ``link.``) as well: the launch file takes
    one file.
    """
    geometry: dict[str, object] = {}
    bridge: dict[str, object] = {f'link.{name}': value for name, value in link.items()}
    bridge['calibration.date'] = date
    for name, estimate in (
        ('wheel_radius', found.wheel_radius),
        ('wheel_separation', found.track),
    ):
        if estimate is not None:
            geometry[name] = _rounded(estimate.value)
            bridge[f'calibration.{name}_uncertainty'] = _rounded(estimate.uncertainty)
    if found.gyro_scale is not None:
        bridge['odometry.gyro_scale'] = _rounded(found.gyro_scale.value)
        bridge['odometry.gyro_scale_tolerance'] = _rounded(found.gyro_scale.uncertainty)
    if found.gyro_bias is not None:
        bridge['calibration.gyro_bias'] = _rounded(found.gyro_bias.value)
        bridge['calibration.gyro_bias_uncertainty'] = _rounded(found.gyro_bias.uncertainty)
    if found.divider is not None:
        for name, value in found.divider._asdict().items():
            bridge[f'calibration.battery_{name}'] = _rounded(value)
    if any(found.curves):
        none = SharpCurve(0.0, 0.0, 0.0, 0.0)
        for name in SharpCurve._fields:
            values = [_rounded(getattr(curve or none, name)) for curve in found.curves]
            bridge[f'calibration.range_{name}'] = values
    nodes = {'radio_bridge': geometry | bridge}
    if geometry:
        nodes |= {'controller': geometry, 'reference_generator': geometry}
    title = 'Calibration of the robot, written by t3mpc robot calibrate.'
    return parameter_file(title, {f'/**/{node}': values for node, values in nodes.items()})


def _rounded(value: float) -> float:
    """Return a value with seven digits: a file that a person can read."""
    return float(f'{value:.7g}')


def read_parameter_file(path: Path) -> tuple[Calibration, dict[str, object]]:
    """Return the calibration and the parameters of the link in a file of :func:`calibration_file`.

    Raises
    ------
    ParameterError
        The file cannot be read, or is another one.
    """
    try:
        content: Any = read_yaml(path)
        values = content['/**/radio_bridge']['ros__parameters']
        parameters = RadioRobotParameters.from_dict(values)
    except YamlError as error:
        raise ParameterError(f'{path} {error}') from error
    except (KeyError, TypeError) as error:
        raise ParameterError(
            f'{path} must be a parameter file of t3mpc robot calibrate, with calibration below '
            '/**/radio_bridge'
        ) from error
    known, odometry = parameters.calibration, parameters.odometry
    curves = zip(
        known.range_scale,
        known.range_shift,
        known.range_offset,
        known.range_uncertainty,
        strict=True,
    )
    geometry = parameters.geometry
    has_scale = 'odometry.gyro_scale' in values
    has_divider = known.battery_uncertainty > 0.0
    found = Calibration(
        _estimate(geometry.wheel_radius, known.wheel_radius_uncertainty),
        _estimate(geometry.wheel_separation, known.wheel_separation_uncertainty),
        Estimate(odometry.gyro_scale, odometry.gyro_scale_tolerance) if has_scale else None,
        _estimate(known.gyro_bias, known.gyro_bias_uncertainty),
        DividerCorrection(known.battery_gain, known.battery_offset, known.battery_uncertainty)
        if has_divider
        else None,
        tuple(SharpCurve(*each) if each[3] > 0.0 else None for each in curves),
    )
    return found, _changed(parameters.link)


def _changed(link: LinkParameters) -> dict[str, object]:
    """Return the parameters of a link that differ from their defaults, by name."""
    defaults = LinkParameters().to_dict()
    return {name: value for name, value in link.to_dict().items() if value != defaults[name]}


def _estimate(value: float, uncertainty: float) -> Estimate | None:
    return Estimate(value, uncertainty) if uncertainty > 0.0 else None


# -- command --------------------------------------------------------------------------------------


def calibrate(
    options: argparse.Namespace,
    parameters: LinkParameters,
    key: bytes,
    stop: Callable[[], bool],
) -> int:
    """Run the wizard; save what it found, also if the user ends it; return the exit code."""
    check_writable(options.save)
    if not sys.stdin.isatty():
        raise ProcedureError('calibrating a robot needs a person: run it at a terminal')
    path: Path = options.save
    robot = LinkedRobot(options.port, options.robot_port, parameters, key, stop)
    start, link = Calibration(), _changed(parameters)
    if path.exists():
        start, known = read_parameter_file(path)
        link = known | link
    elif robot.has_usb:
        try:
            start = robot.stored()
        except Interrupted as interruption:
            raise ProcedureError('interrupted') from interruption
    wizard = CalibrationWizard(robot, _asker(stop), _show, _wizard_options(options), start)
    code = _EXIT_OK
    try:
        wizard.run()
    except Interrupted:
        _show('')
        _report('interrupted')
        code = _EXIT_INTERRUPTED
    if wizard.calibration != start:
        path.write_text(calibration_file(wizard.calibration, _today(), link))
        _show(f'{path}: saved; ros2 launch t3mpc_ros robot.launch.py params_file:={path}')
    return code


def _show(text: str) -> None:
    print(text, flush=True)


def _today() -> str:
    return datetime.date.today().isoformat()


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
        tuple(options.steps),
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
    add('--robot-port', default='', help='USB port of the robot board, for ranges and battery')
    add(
        '--save',
        type=Path,
        default=Path('calibration.yaml'),
        metavar='FILE',
        help='parameter file of the result (default calibration.yaml); its values are kept where '
        'a step is left out',
    )
    add(
        '--steps',
        type=_steps,
        default=STEPS,
        metavar='STEP,…',
        help=f'some of {", ".join(STEPS)}; default: all',
    )
    for flag, kind, default, text in (
        ('--wheel-radius', bounded_float(0.005, 1.0), geometry.wheel_radius, 'nominal, m'),
        ('--wheel-separation', bounded_float(0.01, 5.0), geometry.wheel_separation, 'nominal, m'),
        ('--distance', bounded_float(0.5, 20.0), usual.distance, 'straight run, m'),
        ('--turns', bounded_int(2, 15), usual.turns, 'turns on the spot'),
        ('--speed', bounded_float(0.2, 8.0), usual.speed, 'wheel speed, rad/s'),
    ):
        add(flag, type=kind, default=default, help=f'{text} (default {default:g})')
    add(
        '--distances',
        type=_distances,
        default=usual.distances,
        metavar='M,…',
        help='from the distance sensors to the board, m (default '
        f'{",".join(map(str, usual.distances))})',
    )
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
