# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Imu, Range and BatteryState messages with covariances from the sensor parameters."""

import math

from sensor_msgs.msg import BatteryState, Imu, Range

from t3mpc_ros.geometry.kinematics import WheelGeometry
from t3mpc_ros.nodes.common import conversions
from t3mpc_ros.nodes.common.conversions import UNKNOWN_VARIANCE
from t3mpc_ros.robot.interface import BatteryReading, ImuSample
from t3mpc_ros.robot.sensor_conversions import (
    GRAVITY,
    BatteryParameters,
    ImuParameters,
    RangeSensorParameters,
)


def imu_message(parameters: ImuParameters, frame: str) -> Imu:
    """Return an Imu message with frame and covariances, without a sample.

    Orientation is not measured (its covariance begins with -1, REP 145), nor are quantities out
    of the plane. The acceleration contains gravity (REP 145): its z is that of a level robot, with
    the variance of an unknown. The other variances are those of noise and quantisation, without
    bias and scale error.
    """
    message = Imu()
    message.header.frame_id = frame
    message.orientation_covariance[0] = -1.0
    message.linear_acceleration.z = GRAVITY
    rate = _noise_variance(math.radians(parameters.gyro_noise), parameters.rate_step, parameters)
    acceleration = _noise_variance(
        1e-6 * GRAVITY * parameters.accel_noise, parameters.acceleration_step, parameters
    )
    message.angular_velocity_covariance = _diagonal(UNKNOWN_VARIANCE, UNKNOWN_VARIANCE, rate)
    message.linear_acceleration_covariance = _diagonal(
        acceleration, acceleration, UNKNOWN_VARIANCE
    )
    return message


def fill_imu(message: Imu, sample: ImuSample, stamp_ns: int) -> Imu:
    """Write a sample into ``message``."""
    message.header.stamp = conversions.time_from_ns(stamp_ns)
    message.angular_velocity.z = sample.angular
    message.linear_acceleration.x = sample.forward
    message.linear_acceleration.y = sample.sideways
    return message


def range_message(parameters: RangeSensorParameters, frame: str) -> Range:
    """Return a Range message with the limits of the sensor, without a distance."""
    message = Range(
        radiation_type=Range.INFRARED,
        field_of_view=parameters.field_of_view,
        min_range=parameters.minimum,
        max_range=parameters.maximum,
        range=math.nan,
    )
    message.header.frame_id = frame
    return message


def fill_range(message: Range, distance: float, stamp_ns: int, *, infinity: bool) -> Range:
    """Write a distance (m) into ``message``.

    REP 117: -inf is closer than the minimum range, inf beyond the maximum range. Without
    ``infinity`` the latter becomes ``max_range``, which some consumers take for free space.
    """
    message.header.stamp = conversions.time_from_ns(stamp_ns)
    message.range = message.max_range if distance == math.inf and not infinity else distance
    return message


def battery_message(parameters: BatteryParameters) -> BatteryState:
    """Return a BatteryState message with the type of the battery, without a reading."""
    return BatteryState(
        temperature=math.nan,
        capacity=math.nan,
        design_capacity=parameters.capacity,
        power_supply_status=BatteryState.POWER_SUPPLY_STATUS_DISCHARGING,
        power_supply_technology=BatteryState.POWER_SUPPLY_TECHNOLOGY_LION,
        present=True,
        cell_voltage=[math.nan] * parameters.cells,
        cell_temperature=[math.nan] * parameters.cells,
    )


def fill_battery(message: BatteryState, reading: BatteryReading, stamp_ns: int) -> BatteryState:
    """Write a reading into ``message``; the current of a discharging battery is negative there."""
    message.header.stamp = conversions.time_from_ns(stamp_ns)
    message.voltage = reading.voltage
    message.current = -reading.current
    message.percentage = reading.charge
    message.charge = reading.charge * message.design_capacity
    return message


def twist_covariance(geometry: WheelGeometry, variance: float) -> list[float]:
    """Return the 36 numbers for a twist from wheel speeds of variance ``variance`` ((rad/s)²).

    By (1), v and omega are the mean and the difference of the wheel speeds. Lateral speed is not
    measured. With infinite variance (slipping wheels) all variances are that of an unknown.
    """
    linear = 0.5 * variance * geometry.wheel_radius**2
    angular = linear / geometry.half_separation**2
    return conversions.planar_covariance(
        (
            (min(linear, UNKNOWN_VARIANCE), 0.0, 0.0),
            (0.0, UNKNOWN_VARIANCE, 0.0),
            (0.0, 0.0, min(angular, UNKNOWN_VARIANCE)),
        )
    )


def count_variance(step: float, period: float) -> float:
    """Return the variance ((rad/s)²) of a speed from a counter read every ``period`` seconds.

    The quantisation error of both readings is uniform over one ``step`` (rad).
    """
    return (step / period) ** 2 / 6.0


def _noise_variance(density: float, step: float, parameters: ImuParameters) -> float:
    """Return the variance of a noise density behind the low-pass filter, with quantisation."""
    return density**2 * parameters.noise_bandwidth + step**2 / 12.0


def _diagonal(x: float, y: float, z: float) -> list[float]:
    return [x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z]
