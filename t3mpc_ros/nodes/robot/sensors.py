# Copyright 2026 The t3mpc_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Messages of the robot's sensors: what never changes is written once, the reading each time."""

import math

from sensor_msgs.msg import BatteryState, Imu, Range

from t3mpc_ros.motion import Geometry
from t3mpc_ros.nodes.plumbing import convert
from t3mpc_ros.robot.backend import BatteryReading, ImuSample
from t3mpc_ros.robot.sensors.battery import BatterySettings
from t3mpc_ros.robot.sensors.mpu6050 import GRAVITY, ImuSettings
from t3mpc_ros.robot.sensors.sharp import SharpSettings

UNKNOWN = 1e6
"""Variance of what is not measured, in whatever unit."""


def imu_message(settings: ImuSettings, frame: str) -> Imu:
    """Return a message that says how well an inertial sensor measures, and holds no sample yet.

    Orientation is not measured (its covariance begins with -1, REP 145), nor is anything out of
    the plane. Variances are those of noise and counts; bias and scale error are no noise.
    """
    message = Imu()
    message.header.frame_id = frame
    message.orientation_covariance[0] = -1.0
    turn = _with_counts(math.radians(settings.gyro_noise), settings.rate_step, settings)
    push = _with_counts(
        1e-6 * GRAVITY * settings.accel_noise, settings.acceleration_step, settings
    )
    message.angular_velocity_covariance = _diagonal(UNKNOWN, UNKNOWN, turn)
    message.linear_acceleration_covariance = _diagonal(push, push, UNKNOWN)
    return message


def fill_imu(message: Imu, sample: ImuSample, stamp_ns: int) -> Imu:
    """Write a sample into ``message``, which is used again and again."""
    message.header.stamp = convert.time_from_ns(stamp_ns)
    message.angular_velocity.z = sample.angular
    message.linear_acceleration.x = sample.forward
    message.linear_acceleration.y = sample.sideways
    return message


def range_message(settings: SharpSettings, frame: str) -> Range:
    """Return a message that says what a distance sensor can see, and holds no distance yet."""
    message = Range(
        radiation_type=Range.INFRARED,
        field_of_view=settings.field_of_view,
        min_range=settings.minimum,
        max_range=settings.maximum,
        range=math.nan,
    )
    message.header.frame_id = frame
    return message


def fill_range(message: Range, distance: float, stamp_ns: int, *, infinity: bool) -> Range:
    """Write a distance (m) into ``message``, which is used again and again.

    REP 117: -inf is nearer than the sensor can tell, inf beyond its range. Without ``infinity``
    the latter becomes ``max_range``, for those who take that for a free view.
    """
    message.header.stamp = convert.time_from_ns(stamp_ns)
    message.range = message.max_range if distance == math.inf and not infinity else distance
    return message


def battery_message(settings: BatterySettings) -> BatteryState:
    """Return a message that says what battery it is, and holds no reading yet."""
    return BatteryState(
        temperature=math.nan,
        capacity=math.nan,
        design_capacity=settings.capacity,
        power_supply_status=BatteryState.POWER_SUPPLY_STATUS_DISCHARGING,
        power_supply_technology=BatteryState.POWER_SUPPLY_TECHNOLOGY_LION,
        present=True,
        cell_voltage=[math.nan] * settings.cells,
        cell_temperature=[math.nan] * settings.cells,
    )


def fill_battery(message: BatteryState, reading: BatteryReading, stamp_ns: int) -> BatteryState:
    """Write a reading into ``message``; what flows out of a battery is negative there."""
    message.header.stamp = convert.time_from_ns(stamp_ns)
    message.voltage = reading.voltage
    message.current = -reading.current
    message.percentage = reading.charge
    message.charge = reading.charge * message.design_capacity
    return message


def twist_covariance(geometry: Geometry, variance: float) -> list[float]:
    """Return the 36 numbers for the twist of two wheels measured with ``variance`` ((rad/s)²).

    By (1), v and omega are their mean and difference. How fast the robot slides sideways is not
    measured, and nothing is if the variance is infinite: the wheels are known to mislead.
    """
    forward = 0.5 * variance * geometry.wheel_radius**2
    turn = forward / geometry.half_separation**2
    return convert.planar_covariance(
        (
            (min(forward, UNKNOWN), 0.0, 0.0),
            (0.0, UNKNOWN, 0.0),
            (0.0, 0.0, min(turn, UNKNOWN)),
        )
    )


def count_variance(step: float, period: float) -> float:
    """Return the variance ((rad/s)²) of a speed read from a counter once per ``period`` seconds.

    Each of the two readings is off by up to one ``step`` (rad), evenly spread.
    """
    return (step / period) ** 2 / 6.0


def _with_counts(density: float, step: float, settings: ImuSettings) -> float:
    """Return the variance of a noise density behind the low-pass, rounded to whole counts."""
    return density**2 * settings.noise_bandwidth + step**2 / 12.0


def _diagonal(x: float, y: float, z: float) -> list[float]:
    return [x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z]
