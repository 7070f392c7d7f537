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
"""Calibration wizard: what to do, what is measured, and how sure the result is, step by step.

The wizard asks and shows texts through two functions and measures through a
:class:`CalibrationRobot`. A measurement that is refused, or that the link interrupts, can be
repeated; a step that is left out keeps the values of the calibration at the start. Nothing moves
the robot without a yes to the question before it.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
import math
from typing import NamedTuple, TypeVar

import numpy as np

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.geometry.types import RANGE_SENSORS
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.tool import eeprom_records, procedure, robot_settings
from t3mpc_ros.radio.tool.manoeuvre import HandTurn, Manoeuvre, Rest
from t3mpc_ros.radio.tool.procedure import ROBOT_BOARD, ProcedureError, Script
from t3mpc_ros.robot import calibration
from t3mpc_ros.robot.interface import WheelAngles

Value = TypeVar('Value')

STEPS = {
    'rest': 'bias of the gyro, at rest',
    'radius': 'wheel radius, on a straight line',
    'track': 'track and scale of the gyro, turning on the spot',
    'hand': 'scale of the gyro, turning by hand',
    'ranges': 'distance sensors',
    'battery': 'divider of the battery',
}
"""Title of each step, which the method ``measure_`` and its name runs, in their order."""
USB_STEPS = 'ranges', 'battery'
"""Steps over the USB port of the robot board, at rest; the others need a robot without cables.

Without a dongle, the step ``rest`` is one of them.
"""
_REST_TIME = 10.0
_RESTS = (4.0, 4.0)  # before and after a turn, s
_HAND_TIMEOUT = 120.0
_SAMPLES = 20
"""Of the converter for each reading: one second, in which a distance sensor measures 26 times."""
_SKIP, _YES = 'skip', ('y', 'yes')
_SIDES = (('front', 0), ('left', 2), ('rear', 4), ('right', 6))
"""Side, and the number of the first of its two sensors."""


def available_steps(port: str, robot_port: str) -> tuple[str, ...]:
    """Return the steps that can be run at the ports of dongle and robot, in their order."""
    if not robot_port:
        return tuple(step for step in STEPS if step not in USB_STEPS)
    return USB_STEPS if port else ('rest', *USB_STEPS)


class Interrupted(Exception):
    """The user ends the wizard: Ctrl-C, or the end of the input."""


@dataclass
class CalibrationRobot:
    """The robot behind a dongle and, for raw counts, behind its own USB port.

    Either port may be empty: without a dongle, a rest is recorded over the USB port of the robot.
    A measurement raises ProcedureError with a reason and a remedy, or :class:`Interrupted`:
    ``interrupted``, whether the user has ended the wizard, is polled. ``report`` receives the
    reasons for waiting.
    """

    port: str
    robot_port: str
    parameters: LinkParameters
    key: bytes
    entropy: Callable[[int], bytes]
    interrupted: Callable[[], bool]
    report: Callable[[str], None]

    def __post_init__(self) -> None:
        self._link = self.parameters, self.key, self.entropy, self.report

    def rest(self, seconds: float) -> calibration.Recording:
        """Return a recording of the robot at rest."""
        return self._record(Rest(*self._link, (seconds, 0.0)))

    def drive(
        self, angles: WheelAngles, speed: float, rests: tuple[float, float]
    ) -> calibration.Recording:
        """Turn the wheels by angles (rad); return the recording with the rests around it."""
        return self._record(Manoeuvre(*self._link, rests, angles, speed))

    def turn_by_hand(self, timeout: float, rests: tuple[float, float]) -> calibration.Recording:
        """Return the recording of a turn by hand between two rests."""
        return self._record(HandTurn(*self._link, rests, timeout))

    def counts(self, samples: int) -> Sequence[tuple[int, ...]]:
        """Return raw counts: of the eight distance sensors and, last, of the battery."""
        return self._at_board(eeprom_records.read_counts(samples))

    def settings(self) -> robot_settings.RobotSettings:
        """Return the settings of the robot."""
        stored = self._at_board(robot_settings.read_settings())
        if not stored.valid:
            raise ProcedureError('the robot has no valid settings: t3mpc robot setup')
        return stored.content

    def store(self, found: calibration.Calibration) -> None:
        """Store a calibration in the robot, in place of the one that it has."""
        try:
            self._at_board(eeprom_records.write_calibration(found))
        except ValueError as error:
            raise ProcedureError(f'the robot cannot hold this calibration: {error}') from error

    def stored(self) -> calibration.Calibration:
        """Return the calibration in the robot."""
        return self._at_board(eeprom_records.read_calibration())

    def _at_board(self, script: Script[Value]) -> Value:
        try:
            return procedure.run_script(script, self.robot_port, self.interrupted, ROBOT_BOARD)
        except ProcedureError as error:
            if self.interrupted():
                raise Interrupted from error
            raise

    def _record(self, task: Manoeuvre) -> calibration.Recording:
        procedure.run_at_port(task, self.port or self.robot_port, self.interrupted)
        if self.interrupted():
            raise Interrupted
        if task.error:
            raise ProcedureError(task.error)
        return task.recording


class WizardOptions(NamedTuple):
    """What is measured, and how sure a person is of it."""

    marks: calibration.MarkUncertainty = calibration.MARKS
    geometry: WheelGeometry = WheelGeometry()
    """Nominal wheels, which decide how far the robot drives."""
    steps: tuple[str, ...] = tuple(STEPS)
    distance: float = 2.0  # length of a straight run, m
    turns: int = 10  # whole turns on the spot, and by hand
    speed: float = 4.0  # of the wheels, rad/s
    distances: tuple[float, ...] = (0.1, 0.15, 0.2, 0.3, 0.5, 0.8)
    """From the distance sensors to the board, m."""


class Skipped(Exception):
    """A step is left out."""


class CalibrationWizard:
    """Runs the steps and collects their results.

    ``ask`` shows a question and returns the answer, ``show`` shows a line. Where a step is left
    out, the values of the calibration ``start`` are kept.
    """

    def __init__(
        self,
        robot: CalibrationRobot,
        ask: Callable[[str], str],
        show: Callable[[str], None],
        options: WizardOptions,
        start: calibration.Calibration,
    ) -> None:
        self._robot = robot
        self._ask = ask
        self._show = show
        self._options = options
        self._turns: list[tuple[float, calibration.GyroTurn]] = []
        self.calibration = start

    def run(self) -> calibration.Calibration:
        """Run the steps; return the calibration."""
        steps = available_steps(self._robot.port, self._robot.robot_port)
        steps = tuple(step for step in steps if step in self._options.steps)
        for number, step in enumerate(steps):
            self._show(f'Step {number + 1} of {len(steps)}: {STEPS[step]}')
            self._repeat(getattr(self, f'measure_{step}'))
            self._show('')
        for line in summary(self.calibration):
            self._show(line)
        if self._robot.robot_port:
            self._repeat(self._store)
        return self.calibration

    def _store(self) -> None:
        if self._answer('Store these values in the robot? [yes/no] ') not in _YES:
            self._show('The robot keeps the values that it had.')
            return
        self._robot.store(self.calibration)
        self._show('Stored in both copies, and read back.')

    def _repeat(self, action: Callable[[], None]) -> None:
        """Run an action until it succeeds or is left out."""
        while True:
            try:
                action()
            except (calibration.CalibrationError, ProcedureError) as error:
                self._show(f'  Refused: {error}')
                if self._answer(f'  Enter to repeat, or {_SKIP}: ') in ('', *_YES):
                    continue
            except Skipped:
                pass
            else:
                return
            self._show('  Left out: the value stays as it was.')
            return

    # -- steps ------------------------------------------------------------------------------------

    def measure_rest(self) -> None:
        """Measure the bias of the gyro."""
        self._do(f'Put the robot down level, and do not touch it for {_REST_TIME:g} s.')
        self._wait_for_enter()
        recording = self._robot.rest(_REST_TIME)
        rates = recording.rates
        self._see(
            f'{len(rates)} samples in {recording.times[-1]:.1f} s, scatter '
            f'{np.std(rates):.4f} rad/s'
        )
        bias = calibration.estimate_gyro_bias(recording)
        calibration.check_within(
            'the bias of the gyro',
            math.degrees(bias.value),
            (-calibration.MAX_GYRO_BIAS, calibration.MAX_GYRO_BIAS),
            ' deg/s',
            'the robot must stand still; otherwise a bad sensor',
        )
        self._keep(gyro_bias=bias)
        self._result(f'bias of the gyro {_degrees(bias)} deg/s')

    def measure_radius(self) -> None:
        """Measure the wheel radius."""
        options, radius = self._options, self._options.geometry.wheel_radius
        angle = options.distance / radius
        self._do(
            f'Put the robot on the floor with {options.distance + 0.5:g} m free in front of it.'
        )
        runs: list[calibration.StraightRun] = []
        for way, sign in (('forward', 1.0), ('back', -1.0)):
            self._confirm(
                f'Mark where a wheel touches the floor. The robot drives {options.distance:g} m '
                f'{way} at {options.speed * radius:.2f} m/s; Ctrl-C stops it.'
            )
            angles = WheelAngles(sign * angle, sign * angle)
            recording = self._robot.drive(angles, options.speed, (0.0, 1.0))
            right, left = (
                float(angle[-1] - angle[0]) for angle in (recording.right, recording.left)
            )
            self._see(
                f'the wheels turned {math.degrees(right):.1f} (right) and '
                f'{math.degrees(left):.1f} (left) degrees'
            )
            driven = 0.5 * abs(right + left) * radius
            check = partial(
                calibration.check_within,
                'distance between the marks',
                bounds=calibration.plausible(driven),
                unit=' m',
                remedy=f'the wheels drove {driven:.2f} m by their nominal radius: measure in m, '
                'or give --wheel-radius of other wheels',
            )
            distance = self._number(
                'Mark where it touches the floor now. Between both marks, in m: ', check
            )
            runs.append(calibration.StraightRun(distance, right, left))
            # Refused now, not after the way back.
            calibration.check_straight_run(runs[-1])
        found = calibration.estimate_wheel_radius(runs, options.marks)
        self._keep(wheel_radius=found)
        self._result(f'wheel radius {_millimetres(found)} mm, nominal {1e3 * radius:.2f}')

    def measure_track(self) -> None:
        """Measure the track and the scale of the gyro."""
        options, geometry = self._options, self._options.geometry
        radius = self.calibration.wheel_radius
        if radius is None:
            raise calibration.CalibrationError(
                'the track needs a wheel radius: got none; run the step radius before'
            )
        self._do(
            'Put the robot in the middle of a free circle of 1 m. Its direction is marked by two '
            'points on the floor, as far apart as possible.'
        )
        measured = []
        for way, sign in (('left', 1.0), ('right', -1.0)):
            rate = options.speed * radius.value / geometry.half_separation
            self._confirm(
                f'Mark its direction anew. The robot turns {options.turns} times to the {way} at '
                f'{math.degrees(rate):.0f} deg/s; Ctrl-C stops it.'
            )
            angle = sign * options.turns * math.tau * geometry.half_separation / radius.value
            recording = self._robot.drive(WheelAngles(angle, -angle), options.speed, _RESTS)
            measured.append(self._read_turn(recording))
        track = calibration.estimate_track(measured, radius, options.marks)
        calibration.check_within(
            'the track',
            track.value,
            calibration.plausible(geometry.wheel_separation),
            ' m',
            'count the turns, repeat the step radius, or give --wheel-separation of other wheels',
        )
        self._turns += measured
        scale = calibration.estimate_gyro_scale(self._turns, options.marks)
        self._keep(track=track, gyro_scale=scale)
        self._result(
            f'track {_millimetres(track)} mm, nominal {1e3 * geometry.wheel_separation:.2f}'
        )
        self._result(f'scale of the gyro {_value(scale, 1.0, 5)}')

    def measure_hand(self) -> None:
        """Measure the scale of the gyro again."""
        options = self._options
        self._do(
            'The motors are off in this step. Mark the direction of the robot on the floor. After '
            f'Enter, let it rest for {_RESTS[0]:g} s, turn it {options.turns} times to the left '
            f'by hand, back to the mark, slower than {0.9 * _FULL_SCALE:.0f} deg/s, and let it '
            f'rest again; {_HAND_TIMEOUT:g} s in all.'
        )
        self._wait_for_enter()
        recording = self._robot.turn_by_hand(_HAND_TIMEOUT, _RESTS)
        turn = self._read_turn(recording)
        scale = calibration.estimate_gyro_scale([*self._turns, turn], options.marks)
        self._turns.append(turn)
        self._keep(gyro_scale=scale)
        self._result(f'scale of the gyro {_value(scale, 1.0, 5)}, of {len(self._turns)} turns')

    def measure_ranges(self) -> None:
        """Measure the curves of the distance sensors."""
        self._do(
            'Use a white board, wider than the robot, parallel to one side after the other. '
            'Distances are from the faces of the sensors.'
        )
        for side, first in _SIDES:
            self._repeat(partial(self._measure_side, side, first))

    def _measure_side(self, side: str, first: int) -> None:
        readings: tuple[list[calibration.RangeReading], list[calibration.RangeReading]] = ([], [])
        names = RANGE_SENSORS[first : first + 2]

        def measure(nominal: float, distance: float) -> None:
            bounds, remedy = (0.5 * nominal, 2.0 * nominal), 'measure in m, from the sensors'
            calibration.check_within('distance of the board', distance, bounds, ' m', remedy)
            counts = self._robot.counts(_SAMPLES)
            new = [
                calibration.RangeReading(distance, tuple(each[first + number] for each in counts))
                for number in (0, 1)
            ]
            pairs = zip(names, new, strict=True)
            seen = ', '.join(f'{name} {np.mean(each.counts):.1f}' for name, each in pairs)
            self._see(f'mean counts: {seen}')
            for number, name in enumerate(names):
                with _naming(name):
                    calibration.check_range_reading(new[number])
            for number in (0, 1):
                readings[number].append(new[number])

        for nominal in self._options.distances:
            self._number(
                f'{side}: put the board at {nominal:g} m. Enter, or its distance in m: ',
                partial(measure, nominal),
                nominal,
            )
        curves = list(self.calibration.curves)
        for number, name in enumerate(names):
            with _naming(name):
                curve = calibration.estimate_sharp_curve(readings[number], self._options.marks)
            curves[first + number] = curve
            self._result(f'{name} {_curve(curve)}')
        self._keep(curves=tuple(curves))

    def measure_battery(self) -> None:
        """Measure the divider of the battery."""
        marks, divider = self._options.marks, self._robot.settings().divider
        self._do(
            'Connect a meter to the battery, or a bench supply in its place. Measure a full and '
            'an empty battery, at least 1 V apart.'
        )
        readings: list[calibration.VoltageReading] = []

        def measure(meter: float) -> None:
            counts = float(np.mean([each[-1] for each in self._robot.counts(_SAMPLES)]))
            nominal = calibration.nominal_battery_voltage(counts, divider)
            self._see(f'mean count {counts:.1f}: {nominal:.3f} V without correction')
            new = calibration.VoltageReading(meter, nominal)
            calibration.check_voltages([*readings, new])
            readings.append(new)

        for which in ('first', 'second'):
            self._number(f'Voltage of the meter, {which}, in V: ', measure)
        found = calibration.estimate_divider(readings, divider, marks)
        self._keep(divider=found)
        self._result(
            f'battery voltage times {1.0 + found.gain:.4f}, plus {found.offset:+.3f} V, '
            f'± {calibration.COVERAGE * found.uncertainty:.3f} V'
        )

    # -- questions --------------------------------------------------------------------------------

    def _read_turn(self, recording: calibration.Recording) -> tuple[float, calibration.GyroTurn]:
        """Return the yaw (rad) of a turn, by its mark, and what the gyro measured."""
        turn = calibration.measure_turn(recording)
        fastest = math.degrees(float(np.max(np.abs(recording.rates))))
        self._see(
            f'the gyro counted {turn.rotation / math.tau:+.3f} turns, at up to {fastest:.0f} deg/s'
        )
        check = partial(
            calibration.check_within,
            'angle',
            bounds=(-180.0, 180.0),
            unit=' degrees',
            remedy='measure the shorter way',
        )
        beyond = math.radians(
            self._number('Degrees from the mark to the robot, left positive: ', check, 0.0)
        )
        return calibration.whole_turns(turn, beyond) * math.tau + beyond, turn

    def _number(
        self, question: str, use: Callable[[float], None], default: float | None = None
    ) -> float:
        """Return a number that ``use`` accepts (else CalibrationError), or raise Skipped."""
        while True:
            text = self._answer(f'  {question}').replace(',', '.')
            if text == _SKIP:
                raise Skipped
            try:
                value = default if not text and default is not None else float(text)
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                self._show(f'  Refused: the answer must be a number, or {_SKIP}: got {text!r}')
                continue
            try:
                use(value)
            except calibration.CalibrationError as error:
                self._show(f'  Refused: {error}')
            else:
                return value

    def _confirm(self, motion: str) -> None:
        """Return after a yes; anything else leaves the step out."""
        if self._answer(f'  {motion} Move now? [yes/{_SKIP}] ') not in _YES:
            raise Skipped

    def _wait_for_enter(self) -> None:
        if self._answer(f'  Enter to begin, or {_SKIP}: ') == _SKIP:
            raise Skipped

    def _answer(self, question: str) -> str:
        return self._ask(question).strip().lower()

    def _do(self, text: str) -> None:
        self._show(f'  Do: {text}')

    def _see(self, text: str) -> None:
        self._show(f'  Measured: {text}')

    def _result(self, text: str) -> None:
        self._show(f'  Result: {text}')

    def _keep(self, **values: object) -> None:
        self.calibration = self.calibration._replace(**values)  # type: ignore[arg-type]


@contextmanager
def _naming(sensor: str) -> Iterator[None]:
    """Raise the errors of a calibration with the name of the sensor in front."""
    try:
        yield
    except calibration.CalibrationError as error:
        raise calibration.CalibrationError(f'{sensor}: {error}') from error


_FULL_SCALE = math.degrees(calibration.GYRO_FULL_SCALE)


def summary(found: calibration.Calibration) -> list[str]:
    """Return the lines of a calibration: value and interval of 95 %."""
    lines = ['Calibration, with intervals of 95 %:']
    for name, text in (
        ('wheel radius', found.wheel_radius and f'{_millimetres(found.wheel_radius)} mm'),
        ('track', found.track and f'{_millimetres(found.track)} mm'),
        ('scale of the gyro', found.gyro_scale and _value(found.gyro_scale, 1.0, 5)),
        ('bias of the gyro', found.gyro_bias and f'{_degrees(found.gyro_bias)} deg/s'),
        (
            'battery voltage',
            found.divider and f'± {calibration.COVERAGE * found.divider.uncertainty:.3f} V',
        ),
    ):
        lines.append(f'  {name:<18}  {text or "not calibrated"}')
    for name, curve in zip(RANGE_SENSORS, found.curves, strict=True):
        lines.append(f'  {name:<18}  {_curve(curve) if curve else "not calibrated"}')
    return lines


def _value(estimate: calibration.Estimate, factor: float, digits: int) -> str:
    half = factor * calibration.COVERAGE * estimate.uncertainty
    return f'{factor * estimate.value:.{digits}f} ± {half:.{digits}f}'


def _millimetres(estimate: calibration.Estimate) -> str:
    return _value(estimate, 1e3, 3)


def _degrees(estimate: calibration.Estimate) -> str:
    return _value(estimate, math.degrees(1.0), 3)


def _curve(curve: calibration.SharpCurve) -> str:
    return (
        f'{curve.scale:.4f} V m / (d + {curve.shift:.4f} m) + {curve.offset:.4f} V, '
        f'± {1e3 * calibration.COVERAGE * curve.uncertainty:.0f} mm or better'
    )
