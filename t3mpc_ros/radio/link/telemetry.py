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
"""Telemetry of the robot: STATE frames converted to SI units and host time."""

import math
from typing import NamedTuple

from t3mpc_ros.geometry.types import NANOSECONDS, WheelSpeeds
from t3mpc_ros.radio.protocol.clock_sync import ClockModel, CounterUnwrapper, wrapped_difference
from t3mpc_ros.radio.protocol.frames import AGE_NONE, State, StatusFlag
from t3mpc_ros.robot.interface import ImuSample, RobotStatus, WheelAngles
from t3mpc_ros.robot.sensor_parameters import ImuParameters, decode_range

_MAX_COUNTED_RESTARTS = 1000
"""Difference of two counts of starts above which one of them was lost: one restart is certain."""
_CLOCK_WINDOW_NS = 10 * NANOSECONDS
"""Silence between two sessions after which the samples of the clock are too old."""
_MAX_STATE_AGE_US = 200_000
"""Maximum age of a STATE: without packets, the robot loads one twice as often."""
_MAX_SPEED_INTERVAL = 0.5  # maximum interval for a mean wheel speed, s
STEPS_PER_REV, MICROSTEPS, GYRO_RANGE = 200, 16, 500


class Telemetry(NamedTuple):
    """One measurement of the robot, the source of a RobotState."""

    stamp_ns: int  # host time of the sample
    angles: WheelAngles  # continuous over wraps of the counters and restarts of the robot
    wheels: WheelSpeeds  # mean since the previous measurement
    imu: ImuSample | None  # none when the sensor does not answer
    ranges: tuple[float, ...]
    """m, in the order of RANGE_SENSORS: -inf too near, inf beyond, NaN not measured or faulty."""
    status: RobotStatus
    raw: State  # the decoded frame


class CommandTiming(NamedTuple):
    """Transmission time of the CMD that a STATE answers, if it had no retransmission."""

    sent_ns: int
    delay_ns: int  # minimum delay to the robot: ``clock_sync.forward_delay_ns``


class TelemetryDecoder:
    """Converts the STATE frames of successive sessions into measurements.

    A session ends with a restart of the robot, so within a session time and counters of the robot
    are continuous, however late a STATE is read. Between two sessions the robot has restarted if
    its count of starts differs.
    """

    def __init__(self) -> None:
        self._clock = ClockModel()
        self._time = CounterUnwrapper()
        self._left = CounterUnwrapper()
        self._right = CounterUnwrapper()
        self._base = WheelAngles(0.0, 0.0)
        self._wheels = WheelSpeeds(0.0, 0.0)
        self._last: State | None = None
        self._last_ns = 0
        self._session = 0
        self._boots: int | None = None
        self._former_boots: set[int | None] = set()
        self.two_robots = False
        """Whether the last STATE, or the start of the session, was of another robot.

        A clock that goes back within a session, or a former count of starts, is not that of one
        robot: two with one address answer in turn.
        """
        self._unmeasured = True
        """Whether the next measurement is the first one, or the first since a restart."""
        self._step = math.tau / (STEPS_PER_REV * MICROSTEPS)
        self.configure(STEPS_PER_REV * MICROSTEPS, GYRO_RANGE)

    @property
    def angles(self) -> WheelAngles:
        """Wheel angles since the first measurement."""
        return WheelAngles(
            self._base.right + self._right.total * self._step,
            self._base.left + self._left.total * self._step,
        )

    def configure(self, steps: int, gyro_range: int) -> None:
        """Set microsteps per turn and gyro range (deg/s); ValueError: impossible ones."""
        if steps < 1:
            raise ValueError(f'steps per revolution must be at least 1: got {steps}')
        imu = ImuParameters(gyro_range=str(gyro_range))
        self._rate_step, self._acceleration_step = imu.rate_step, imu.acceleration_step
        step = math.tau / steps
        if step != self._step:
            self._base, self._step = self.angles, step
            self._left, self._right = CounterUnwrapper(), CounterUnwrapper()

    def start_session(self, number: int, boots: int | None, now_ns: int) -> int:
        """Decode this session from now on; return the restarts before it, by ``boots``."""
        before, self._boots = self._boots, boots
        self.two_robots = boots != before and boots in self._former_boots
        if before is not None:
            self._former_boots.add(before)
        first, self._session = not self._session, number
        restarts = 0 if first or self.two_robots else _restarts(before, boots)
        if restarts or self.two_robots:
            self._unmeasured = True
            for counter in (self._left, self._right):
                counter.rebase()
                if restarts:
                    counter.add(0)  # where it starts
        if self._unmeasured or now_ns - self._last_ns > _CLOCK_WINDOW_NS:
            self._last = None
            self._time.rebase()
            self._clock.reset()
        return restarts

    def decode(
        self, state: State, now_ns: int, timing: CommandTiming | None = None
    ) -> Telemetry | None:
        """Return the measurement of a STATE; None: not of this session, or not newer."""
        if state.session != self._session:
            return None
        ahead_us = (
            1 if self._last is None else wrapped_difference(self._last.time_us, state.time_us)
        )
        self.two_robots = ahead_us < -_MAX_STATE_AGE_US
        if ahead_us <= 0:
            return None
        before_us, right, left = self._time.total, self._right.total, self._left.total
        time_us = self._time.add(state.time_us)
        right = self._right.add(state.right) - right
        left = self._left.add(state.left) - left
        self._last, self._last_ns = state, now_ns
        if timing is not None and state.age != AGE_NONE:
            self._clock.add(time_us - 10 * state.age, timing.sent_ns, now_ns, timing.delay_ns)
        self._update_speed(time_us - before_us, right, left)
        return Telemetry(
            min(self._clock.to_host_ns(time_us), now_ns) if self._clock.is_set else now_ns,
            self.angles,
            self._wheels,
            self._decode_imu(state),
            tuple(map(decode_range, state.ranges)),
            _decode_status(state.status),
            state,
        )

    def _update_speed(self, elapsed_us: int, right: int, left: int) -> None:
        if self._unmeasured:
            self._wheels, self._unmeasured = WheelSpeeds(0.0, 0.0), False
        elapsed = elapsed_us / 1e6 * (1.0 + self._clock.skew)
        if 0.0 < elapsed <= _MAX_SPEED_INTERVAL:
            self._wheels = WheelSpeeds(right * self._step / elapsed, left * self._step / elapsed)

    def _decode_imu(self, state: State) -> ImuSample | None:
        if state.status & StatusFlag.IMU_FAULT:
            return None
        step = self._acceleration_step
        return ImuSample(
            state.gyro_z * self._rate_step, state.accel_x * step, state.accel_y * step
        )


def _restarts(before: int | None, after: int | None) -> int:
    """Return the number of restarts between two counts of starts, modulo 2**31."""
    if before is None or after is None:
        return 1  # a robot that does not count may have restarted
    restarts = (after - before) % (1 << 31)
    return restarts if restarts <= _MAX_COUNTED_RESTARTS else 1


def _decode_status(bits: int) -> RobotStatus:
    return RobotStatus(
        enabled=bool(bits & StatusFlag.ENABLED),
        moving=bool(bits & StatusFlag.MOVING),
        estop=bool(bits & StatusFlag.ESTOP),
        timed_out=bool(bits & StatusFlag.TTL_EXPIRED),
        limited=bool(bits & StatusFlag.LIMITED),
        imu_fault=bool(bits & StatusFlag.IMU_FAULT),
        low_battery=bool(bits & StatusFlag.LOW_BATTERY),
    )
