# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Telemetry of the robot: STATE frames converted to SI units and host time."""

import math
from typing import NamedTuple

from t3mpc_ros.geometry.types import WheelSpeeds
from t3mpc_ros.radio.protocol.clock_sync import ClockModel, CounterUnwrapper, wrapped_difference
from t3mpc_ros.radio.protocol.frames import AGE_NONE, State, StatusFlag
from t3mpc_ros.robot.interface import ImuSample, RobotStatus, WheelAngles
from t3mpc_ros.robot.sensor_conversions import ImuParameters, decode_range

_MICROSECOND = 1000
"""ns"""
_MAX_CLOCK_ERROR = 1.0
"""Maximum constant difference of the time that elapsed for host and robot, s."""
_MAX_CLOCK_ERROR_RATIO = 0.02
"""Maximum additional difference relative to the elapsed time."""
_MAX_STATE_AGE_US = 200_000
"""Maximum age of a STATE: without packets, the robot loads one twice as often."""
_MAX_SPEED_INTERVAL = 0.5
"""Maximum interval for a mean wheel speed, s."""
STEPS_PER_REV, MICROSTEPS, GYRO_RANGE = 200, 16, 500


class Telemetry(NamedTuple):
    """One measurement of the robot, the source of a RobotState."""

    stamp_ns: int
    """Host time of the sample."""
    angles: WheelAngles
    """Continuous over wraps of the counters and restarts of the robot."""
    wheels: WheelSpeeds
    """Mean since the previous measurement."""
    imu: ImuSample | None
    """None when the sensor does not answer."""
    ranges: tuple[float, ...]
    """m, in the order of RANGE_SENSORS: -inf too near, inf beyond, NaN not measured or faulty."""
    status: RobotStatus
    raw: State
    """The decoded frame."""


class CommandTiming(NamedTuple):
    """Transmission time of the CMD that a STATE answers, if it had no retransmission."""

    sent_ns: int
    delay_ns: int
    """Minimum delay to the robot: ``clock_sync.forward_delay_ns``."""


class TelemetryDecoder:
    """Converts successive STATE frames into measurements; detects restarts of the robot."""

    def __init__(self) -> None:
        self._clock = ClockModel()
        self._time = CounterUnwrapper()
        self._left = CounterUnwrapper()
        self._right = CounterUnwrapper()
        self._base = WheelAngles(0.0, 0.0)
        self._wheels = WheelSpeeds(0.0, 0.0)
        self._last: State | None = None
        self._last_ns = 0
        self.rebooted = False
        """Whether the robot restarted before the last measurement."""
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
        """Set the microsteps per revolution and the full scale of the gyro (deg/s).

        ValueError: a count below 1, or a range that the MPU6050 lacks.
        """
        if steps < 1:
            raise ValueError(f'steps per revolution must be at least 1: got {steps}')
        imu = ImuParameters(gyro_range=str(gyro_range))
        self._rate_step, self._acceleration_step = imu.rate_step, imu.acceleration_step
        step = math.tau / steps
        if step != self._step:
            self._base, self._step = self.angles, step
            self._left, self._right = CounterUnwrapper(), CounterUnwrapper()

    def decode(
        self, state: State, now_ns: int, timing: CommandTiming | None = None
    ) -> Telemetry | None:
        """Return the measurement of a STATE; None if it is not newer than the last one."""
        self.rebooted = self._has_restarted(state, now_ns)
        if self.rebooted:
            for counter in (self._time, self._left, self._right):
                counter.rebase()
            self._clock.reset()
        elif self._last is not None and wrapped_difference(self._last.time_us, state.time_us) <= 0:
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

    def _has_restarted(self, state: State, now_ns: int) -> bool:
        """Return whether the robot clock jumped against the host clock.

        A lost session alone is no evidence: the robot ends it after a long silence and keeps its
        counters.
        """
        last = self._last
        if last is None:
            return False
        back_us = wrapped_difference(state.time_us, last.time_us)
        if state.status & StatusFlag.NO_SESSION and back_us > _MAX_STATE_AGE_US:
            return True
        elapsed_us = (now_ns - self._last_ns) // _MICROSECOND
        error = wrapped_difference((last.time_us + elapsed_us) % (1 << 32), state.time_us) / 1e6
        return abs(error) > _MAX_CLOCK_ERROR + _MAX_CLOCK_ERROR_RATIO * elapsed_us / 1e6

    def _update_speed(self, elapsed_us: int, right: int, left: int) -> None:
        if self.rebooted:
            self._wheels = WheelSpeeds(0.0, 0.0)
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
