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
"""Manoeuvre: both wheels turn by given angles over the link, and the telemetry is recorded.

The robot moves only while the link runs, the robot follows, and the time allowed has not passed;
otherwise the manoeuvre fails and the link is shut down. If the host itself fails, the robot stops
within the time to live of a command.
"""

from collections.abc import Callable
from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np

from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.radio.link.actions_and_states import LinkState, PortAction, Wait
from t3mpc_ros.radio.link.link import Link
from t3mpc_ros.radio.link.link_parameters import LinkParameters
from t3mpc_ros.radio.link.telemetry import Telemetry
from t3mpc_ros.robot.calibration import Recording
from t3mpc_ros.robot.interface import ZERO_WHEEL_SPEEDS, WheelAngles

_CONNECT_TIMEOUT = 15.0  # timeout for the start of the dongle and the handshake, s
_PERIOD_NS = NANOSECONDS // 50
_COMMAND_NS = NANOSECONDS // 4  # time for which a command is followed
_REPORT_DELAY_NS = NANOSECONDS  # a reason that lasts this long is reported
_ACCELERATION = 8.0  # rad/s², both ways
_FINAL_SPEED = 0.2  # speed at the target, rad/s: 0.3 degrees per cycle
_APPROACH_GAIN = 3.0  # speed per remaining angle, 1/s
_NOT_FOLLOWING_TIMEOUT = 1.0  # time without following after which the manoeuvre fails, s
_TIME_MARGIN = 15.0  # additional time for acceleration and approach, s
SETTLING_TIME = 0.3  # standstill until the rotors have settled, s
_POWER_ON_TIME = 1.5  # time until the rotors have settled after the drivers were switched on, s
_TURNING_RATE, _RESTING_RATE = 0.1, 0.03
"""A turn by hand begins above the one and ends below the other, rad/s."""
_TURN_MARGIN = 0.3  # time before and after that belongs to the turn, s
NO_MOTION = WheelAngles(0.0, 0.0)
_IDLE_OFF = 0.1  # standstill after which the drivers are off for a turn by hand, s


class Manoeuvre:
    """Turns both wheels over the link: handshake, rest, motion, rest, drives disabled.

    The wheels turn by ``angles`` (rad), the faster one with at most ``speed`` (rad/s), and both
    speeds have the relation of the angles. ``rests`` are those before and after the motion, s;
    ``report`` receives the reason for waiting when it changes. The acceleration of the link is
    replaced by 8 rad/s²; an empty key is an open link.
    """

    def __init__(
        self,
        parameters: LinkParameters,
        key: bytes,
        entropy: Callable[[int], bytes],
        report: Callable[[str], None],
        rests: tuple[float, float] = (0.0, SETTLING_TIME),
        angles: WheelAngles = NO_MOTION,
        speed: float = 1.0,
    ) -> None:
        robot = replace(parameters.robot, acceleration=_ACCELERATION, deceleration=_ACCELERATION)
        self.link = Link(replace(parameters, robot=robot), key, entropy)
        self._angles = angles
        self._largest = max(map(abs, angles))
        self._speed = speed
        self._report = report
        self._rests = rests
        self._reported = self._reason = ''
        self._reason_ns = 0
        self._start: WheelAngles | None = None
        self._start_ns = self._begin_ns = 0
        self._next_ns = self._following_ns = 0
        self._standstill_ns: int | None = None
        self._timeout = self._largest / speed + sum(rests) + _TIME_MARGIN
        self._finished = False
        self._newest: Telemetry | None = None
        self._samples: list[tuple[int, float, float, float]] = []
        self._motion = [0, 0]  # numbers of the first sample in motion, and of the first after it
        self.seconds = 0.0  # time since the start of the motion, s
        self.error = ''  # reason of a failure; empty on success

    @property
    def done(self) -> bool:
        """Whether the drives are disabled and the port is closed."""
        return self.link.state is LinkState.DONE

    @property
    def travelled(self) -> WheelAngles | None:
        """Angles by which the wheels have turned, rad; None before the start."""
        if self._start is None or self.link.telemetry is None:
            return None
        now = self.link.telemetry.angles
        return WheelAngles(now.right - self._start.right, now.left - self._start.left)

    @property
    def recording(self) -> Recording:
        """Samples from the first rest to the end."""
        columns = np.array(self._samples, dtype=float).reshape(-1, 4)
        times = (columns[:, 0] - columns[:1, 0]) / NANOSECONDS
        begin, end = self._motion
        return Recording(times, columns[:, 1], columns[:, 2], columns[:, 3], begin, end)

    def port_opened(self, now_ns: int) -> None:
        """Report that the port is open."""
        self.link.port_opened(now_ns, cable=self._over_cable)

    def port_failed(self, text: str, absent: bool, now_ns: int) -> None:
        """Fail with ``text``; the robot stops by itself within the TTL."""
        self._fail(text)
        self.link.port_failed(text, absent, now_ns)

    def interrupt(self, now_ns: int) -> None:
        """Stop the wheels, disable the drives, and end."""
        self._fail('interrupted')

    def step(self, now_ns: int, received: bytes = b'') -> list[PortAction]:
        """Return the actions to execute now; the last one is the time of the next call."""
        if not self._begin_ns:
            self._begin_ns = now_ns
        actions = self.link.step(now_ns, received)
        if not self.error and not self._finished:
            self._advance(now_ns)
        last = actions[-1]
        if isinstance(last, Wait):
            actions[-1] = Wait(min(last.until_ns, now_ns + _PERIOD_NS))
        return actions

    def _advance(self, now_ns: int) -> None:
        link, telemetry = self.link, self.link.telemetry
        reason = link.reason(now_ns)
        if link.state is not LinkState.RUN or telemetry is None:
            self._report_reason(reason, now_ns)
            if self._start is not None:
                self._fail(reason or 'the link was lost')
            elif now_ns - self._begin_ns > _CONNECT_TIMEOUT * NANOSECONDS:
                self._fail(reason)
            return
        if self._start is None:
            if telemetry.status.moving:
                return
            self._start, self._start_ns = telemetry.angles, now_ns
            self._following_ns = now_ns
        elapsed = (now_ns - self._start_ns) / NANOSECONDS
        if self._rests[0] > 0.0:
            elapsed -= _POWER_ON_TIME
        if elapsed >= 0.0:
            self._record(telemetry)
        if elapsed < self._rests[0]:
            self._motion = [len(self._samples), len(self._samples)]
            self._following_ns = now_ns
            return
        self.seconds = elapsed - self._rests[0]
        if elapsed > self._timeout:
            self._fail(self._late_reason)
        elif self._ends_when_silent and link.is_silent(now_ns):
            # It has stopped by itself; it must not start again when it is back.
            self._fail(reason)
        else:
            self._move(telemetry, now_ns)

    _over_cable = False
    """Whether it may run over the USB of the robot: at rest, or with the wheels in the air."""
    _ends_when_silent = True
    """Whether a robot that does not answer for the time to live ends the manoeuvre."""
    _late_reason = 'the wheels do not reach their target: does the board count its steps?'

    def _move(self, telemetry: Telemetry, now_ns: int) -> None:
        remaining, status = self._remaining(), telemetry.status
        if remaining <= _FINAL_SPEED / 100.0:
            self._finish(status.moving, now_ns)
            return
        if status.enabled and not status.estop:
            self._following_ns = now_ns
        if now_ns - self._following_ns > _NOT_FOLLOWING_TIMEOUT * NANOSECONDS:
            self._fail(self.link.reason(now_ns) or 'the robot does not follow')
        elif now_ns >= self._next_ns:
            self._next_ns = now_ns + _PERIOD_NS
            size = min(self._speed, max(_FINAL_SPEED, _APPROACH_GAIN * abs(remaining)))
            right, left = (size * angle / self._largest for angle in self._angles)
            self.link.command(WheelSpeeds(right, left), now_ns + _COMMAND_NS)

    def _remaining(self) -> float:
        """Return the angle that the faster wheel still has to turn, rad."""
        travelled = self.travelled
        if travelled is None:
            return self._largest
        target, way = max(zip(self._angles, travelled, strict=True), key=lambda pair: abs(pair[0]))
        return self._largest - math.copysign(1.0, target) * way

    def _finish(self, moving: bool, now_ns: int) -> None:
        """Wait for standstill and the rest after it, then shut the link down."""
        # The first one does not wait for the period.
        if self._standstill_ns is None or now_ns >= self._next_ns:
            self._next_ns = now_ns + _PERIOD_NS
            self.link.command(ZERO_WHEEL_SPEEDS, now_ns + _COMMAND_NS)
        if moving or self._standstill_ns is None:
            self._standstill_ns = now_ns
        resting = (now_ns - self._standstill_ns) / NANOSECONDS
        if resting <= SETTLING_TIME:
            self._motion[1] = len(self._samples)
        if resting > max(self._rests[1], SETTLING_TIME):
            self._end()

    def _end(self) -> None:
        self._finished = True
        self.link.shut_down()

    def _record(self, telemetry: Telemetry) -> None:
        """Keep a measurement that is new and later than the last one."""
        last_ns = self._samples[-1][0] if self._samples else -1
        if telemetry is self._newest or telemetry.stamp_ns <= last_ns:
            return
        self._newest = telemetry
        rate = math.nan if telemetry.imu is None else telemetry.imu.angular
        self._samples.append((telemetry.stamp_ns, *telemetry.angles, rate))

    def _report_reason(self, reason: str, now_ns: int) -> None:
        """Report the reason for waiting once it has lasted a second."""
        if reason != self._reason:
            self._reason, self._reason_ns = reason, now_ns
        elif reason and reason != self._reported and now_ns - self._reason_ns >= _REPORT_DELAY_NS:
            self._reported = reason
            self._report(reason)

    def _fail(self, reason: str) -> None:
        self.error = self.error or reason
        self.link.shut_down()


class Rest(Manoeuvre):
    """Records a robot that its motors hold at rest, for the first one of ``rests``."""

    _over_cable = True  # it does not move

    def _move(self, telemetry: Telemetry, now_ns: int) -> None:
        self._end()


class HandTurn(Manoeuvre):
    """Records a turn by hand between two rests, with the drivers off.

    The turn begins when the gyro reports it, and ends with a rest, at most ``timeout`` s after the
    first rest.
    """

    _late_reason = 'no turn between two rests was seen within the time'

    def __init__(
        self,
        parameters: LinkParameters,
        key: bytes,
        entropy: Callable[[int], bytes],
        report: Callable[[str], None],
        rests: tuple[float, float],
        timeout: float,
    ) -> None:
        robot = replace(parameters.robot, idle_off=_IDLE_OFF)
        super().__init__(replace(parameters, robot=robot), key, entropy, report, rests)
        self._timeout = rests[0] + timeout
        self._turning = False
        self._resting_ns: int | None = None

    def _move(self, telemetry: Telemetry, now_ns: int) -> None:
        if telemetry.imu is None or not self._samples:
            self._fail('the inertial sensor does not answer')
            return
        rate = abs(telemetry.imu.angular - self._bias())
        if not self._turning:
            self._turning = rate > _TURNING_RATE
            if not self._turning:
                self._motion[0] = len(self._samples)
                return
            # The turn began a little before it was noticed.
            begin_ns = telemetry.stamp_ns - round(_TURN_MARGIN * NANOSECONDS)
            while self._motion[0] > 1 and self._samples[self._motion[0] - 1][0] > begin_ns:
                self._motion[0] -= 1
            rate = abs(telemetry.imu.angular - self._bias())
        if rate > _RESTING_RATE or self._resting_ns is None:
            self._resting_ns = now_ns
        resting = (now_ns - self._resting_ns) / NANOSECONDS
        if resting <= _TURN_MARGIN:
            self._motion[1] = len(self._samples)
        elif resting > self._rests[1] + _TURN_MARGIN:
            self._end()

    def _bias(self) -> float:
        """Return the mean rate of the rest before the turn, rad/s."""
        return float(np.mean([rate for *_, rate in self._samples[: self._motion[0] or 1]]))


LEFT, RIGHT = 'left', 'right'


class JogResult(NamedTuple):
    """Microsteps counted by the board, forward positive."""

    target: int
    counted: int
    other: int  # of the other wheel, expected to be 0
    seconds: float


class Jog(Manoeuvre):
    """Turns one wheel, LEFT or RIGHT, over the link; negative revolutions are backward."""

    _ends_when_silent = False
    _over_cable = True
    _late_reason = 'the wheel does not reach its target: does the board count its steps?'

    def __init__(
        self,
        parameters: LinkParameters,
        key: bytes,
        entropy: Callable[[int], bytes],
        wheel: str,
        revolutions: float,
        speed: float,
        report: Callable[[str], None],
    ) -> None:
        if wheel not in (LEFT, RIGHT):
            raise ValueError(f'wheel must be {LEFT} or {RIGHT}: got {wheel}')
        self._right = wheel == RIGHT
        self._angle = math.tau * revolutions
        angles = WheelAngles(self._angle, 0.0) if self._right else WheelAngles(0.0, self._angle)
        super().__init__(parameters, key, entropy, report, angles=angles, speed=speed)

    @property
    def result(self) -> JogResult | None:
        """Counts of the board so far."""
        info, travelled = self.link.info, self.travelled
        if info is None or travelled is None:
            return None
        steps = info.steps_per_rev * info.microsteps
        way, other = travelled if self._right else reversed(travelled)
        target, counted, idle = (
            round(angle * steps / math.tau) for angle in (self._angle, way, other)
        )
        return JogResult(target, counted, idle, self.seconds)


def format_result(result: JogResult, wheel: str, revolutions: float) -> str:
    """Return the result as text, with the expected motion and remedies."""
    way, top = ('forward', 'front') if revolutions > 0 else ('backward', 'back')
    other = RIGHT if wheel == LEFT else LEFT
    return '\n'.join(
        (
            f'{wheel}: {result.counted} microsteps counted, target {result.target}; '
            f'{other}: {result.other}; {result.seconds:.1f} s',
            f'Expected: {abs(revolutions):g} turns {way} of the {wheel} wheel (its top moves to '
            f'the {top}), standstill of the {other} wheel. Otherwise:',
            '  the other wheel turned: swap the cables of the two drivers',
            f'  reverse direction: t3mpc robot setup --invert {wheel} (or both), over the USB of '
            'the robot board, or swap the wires of one motor coil',
            '  more or fewer turns: t3mpc robot setup --microsteps as the jumpers of the drivers',
            '  humming or lost steps: more motor current, or a lower --speed',
        )
    )
