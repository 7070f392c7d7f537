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
"""Conversions between ROS messages and the types of the package."""

import math
import struct

from geometry_msgs.msg import PoseStamped, Quaternion, Twist, TwistStamped
from nav_msgs.msg import Odometry, Path
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Range
from std_msgs.msg import Float64

from t3mpc_ros.geometry.kinematics import WheelGeometry, twist_from_wheels
from t3mpc_ros.geometry.types import NANOSECONDS, BodyTwist, Pose, State, WheelSpeeds, wrap_angle
from t3mpc_ros.nodes import robot_messages, ros_messages
from t3mpc_ros.nodes.robot_messages import state_values, state_warnings
from t3mpc_ros.robot.command_limiter import SLIP_STOP_REASON
from t3mpc_ros.robot.interface import (
    ZERO_WHEEL_SPEEDS,
    BatteryReading,
    ImuSample,
    RobotState,
    RobotStatus,
    WheelAngles,
)
from t3mpc_ros.robot.sensor_parameters import (
    BatteryParameters,
    ImuParameters,
    RangeSensorParameters,
)
from t3mpc_ros.simulation.digital_twin import TwinDiagnostics
from t3mpc_ros.simulation.sensors.imu import SimulatedImu, SimulatedImuParameters

YAWS = [*np.linspace(-30.0, 30.0, 61), 1e-9, -1e-9, math.pi, math.pi - 1e-9, 1e-9 - math.pi]
STAMPS = [0, 1, NANOSECONDS - 1, NANOSECONDS, 1_795_240_567_146_950_308, (2**31 - 1) * NANOSECONDS]


def motions(count=20):
    generator = np.random.default_rng(5)
    for stamp_ns in generator.integers(0, 2 * 10**18, count):
        x, y, v, w = generator.uniform(-1e3, 1e3, 4)
        yaw = generator.uniform(-math.pi, math.pi)
        yield State(int(stamp_ns), Pose(x, y, yaw), BodyTwist(v, w))


def message_of(state, frame='', child=''):
    """Return an odometry message, field by field."""
    message = Odometry(child_frame_id=child)
    message.header.frame_id = frame
    message.header.stamp = ros_messages.time_from_ns(state.stamp_ns)
    message.pose.pose.position.x, message.pose.pose.position.y = state.pose[:2]
    message.pose.pose.orientation = ros_messages.quaternion_from_yaw(state.pose.yaw)
    message.twist.twist = ros_messages.twist_from_body(state.twist)
    return message


def from_odometry(message):
    return ros_messages.state_from_odometry(serialize_message(message))


def yaw_of(rotation):
    return ros_messages.yaw_from_quaternion(rotation.x, rotation.y, rotation.z, rotation.w)


@pytest.mark.parametrize('stamp_ns', STAMPS)
def test_a_stamp_survives_to_the_nanosecond(stamp_ns):
    stamp = ros_messages.time_from_ns(stamp_ns)
    assert 0 <= stamp.nanosec < NANOSECONDS
    assert ros_messages.ns_from_time(stamp) == stamp_ns


@pytest.mark.parametrize('frame', range(9))
@pytest.mark.parametrize('child', range(9))
def test_odometry_is_written_and_read_whatever_its_frames(frame, child):
    """Texts of any length precede the numbers, which lie at multiples of eight."""
    serialized = ros_messages.SerializedOdometry('a' * frame, 'b' * child)
    for motion in motions(3):
        message = message_of(motion, serialized.frame, serialized.child)
        message.pose.covariance[:] = np.arange(36.0) * motion.pose.x
        message.twist.covariance[:] = -np.arange(36.0) * motion.pose.x
        serialized.set_pose_covariance(message.pose.covariance)
        serialized.set_twist_covariance(message.twist.covariance)
        assert deserialize_message(serialized.with_state(motion), Odometry) == message
        message.pose.covariance[:] = message.twist.covariance[:] = math.nan
        message.pose.pose.position.z = math.nan
        back = from_odometry(message)
        assert back._replace(pose=motion.pose) == motion
        assert back.pose == pytest.approx(motion.pose, abs=1e-14)
    with pytest.raises(struct.error):
        ros_messages.state_from_odometry(serialize_message(message)[:-350])


def path_message(places, frame, frames):
    """Return a path whose poses have the frames in turn."""
    message = Path()
    message.header.frame_id = frame
    for k, (x, y) in enumerate(places):
        pose = PoseStamped()
        pose.header.frame_id = frames[k % len(frames)]
        pose.pose.position.x, pose.pose.position.y = x, y
        message.poses.append(pose)
    return message


@pytest.mark.parametrize('length', range(9))
@pytest.mark.parametrize('frames', [('',), ('odom',), ('odom', 'map'), ('a', '', 'base_link')])
def test_points_of_a_path_are_read_whatever_its_frames(length, frames):
    for count in (0, 1, 2, 7):
        places = [(0.1 * k, -0.3 * k) for k in range(count)]
        data = serialize_message(path_message(places, 'f' * length, frames))
        assert ros_messages.points_from_path(data).tolist() == [list(each) for each in places]
        with pytest.raises(struct.error):
            ros_messages.points_from_path(data[: 60 * count + 10])


def test_a_long_path_is_read_at_once_and_not_pose_by_pose(monkeypatch):
    """200 000 points took 8 s, in which no reference was published."""
    one, two = (
        serialize_message(path_message([(1.0, 2.0)] * count, 'odom', ('odom',)))
        for count in (1, 2)
    )
    count = 200_000
    data = bytearray(one + count * two[len(one) :])
    data[len(one) - 84 : len(one) - 80] = struct.pack('<I', count)
    read, reads = struct.unpack_from, []
    monkeypatch.setattr(
        ros_messages.struct, 'unpack_from', lambda *given: reads.append(given[0]) or read(*given)
    )
    points = ros_messages.points_from_path(bytes(data))
    assert len(reads) < 10
    assert points.shape == (count, 2)
    assert (points == (1.0, 2.0)).all()


def test_big_endian_odometry_is_read():
    header = bytes(4) + struct.pack('>iI', 7, 8) + 2 * struct.pack('>I4s', 4, b'abc')
    numbers = struct.pack(
        '>7d36d6d36d', 1, 2, 3, 0, 0, 0, 1, *36 * [9], 4, 0, 0, 0, 0, 5, *36 * [9]
    )
    state = ros_messages.state_from_odometry(header + numbers)
    assert state == State(7 * NANOSECONDS + 8, Pose(1.0, 2.0, 0.0), BodyTwist(4.0, 5.0))


@pytest.mark.parametrize('frame', range(9))
def test_ranges_are_read_whatever_their_frame(frame):
    """A text of any length precedes the numbers, which lie at multiples of four."""
    message = Range(radiation_type=1, field_of_view=0.1, min_range=0.2, max_range=1.5)
    message.header.frame_id = 'a' * frame
    for distance in (0.25, math.inf, -math.inf):
        message.range = distance
        data = serialize_message(message)
        assert ros_messages.range_from_serialized(data) == (distance, 1.5)
        with pytest.raises(struct.error):
            ros_messages.range_from_serialized(data[:-9])


def test_numbers_are_read():
    data = serialize_message(Float64(data=-0.1))
    assert ros_messages.float_from_serialized(data) == -0.1
    swapped = bytes(4) + data[:3:-1]
    assert ros_messages.float_from_serialized(swapped) == -0.1
    with pytest.raises(struct.error):
        ros_messages.float_from_serialized(data[:-1])


def test_yaw_survives_the_conversion_to_a_quaternion():
    for yaw in YAWS:
        rotation = ros_messages.quaternion_from_yaw(yaw)
        assert (rotation.x, rotation.y) == (0.0, 0.0)
        assert math.hypot(rotation.z, rotation.w) == pytest.approx(1.0, abs=1e-15)
        # q and -q are the same rotation.
        for same in (rotation, Quaternion(z=-rotation.z, w=-rotation.w)):
            assert abs(wrap_angle(yaw_of(same) - yaw)) < (1e-13 if abs(yaw) > 4.0 else 4e-15)


def test_a_quaternion_of_zeros_is_no_yaw():
    """A driver that left it so was taken to look along x for ever."""
    message = message_of(State(0, Pose(1.0, 2.0, 0.5), BodyTwist(0.1, 0.0)))
    message.pose.pose.orientation = Quaternion(x=0.0, y=0.0, z=0.0, w=0.0)
    assert math.isnan(from_odometry(message).pose.yaw)
    assert not from_odometry(message).is_finite()


def test_roll_and_pitch_do_not_change_the_yaw():
    generator = np.random.default_rng(6)
    for _ in range(100):
        yaw = generator.uniform(-math.pi, math.pi)
        pitch, roll = generator.uniform(-1.4, 1.4), generator.uniform(-math.pi, math.pi)
        x, y, z, w = Rotation.from_euler('ZYX', [yaw, pitch, roll]).as_quat()
        assert ros_messages.yaw_from_quaternion(x, y, z, w) == pytest.approx(yaw, abs=1e-12)


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 1e200])
@pytest.mark.parametrize('axis', ['x', 'y', 'z', 'w'])
def test_an_invalid_rotation_has_no_yaw(axis, value):
    """atan2 of infinite components is finite, and powers of 1e200 raise OverflowError."""
    rotation = Quaternion(x=0.5, y=0.5, z=0.5, w=0.5)
    setattr(rotation, axis, value)
    yaw = yaw_of(rotation)
    assert math.isnan(yaw) or (value == 1e200 and axis in 'xw')


@pytest.mark.parametrize('value', [math.nan, math.inf])
@pytest.mark.parametrize(
    'place',
    [
        'pose.pose.position.x',
        'pose.pose.position.y',
        'pose.pose.orientation.z',
        'twist.twist.linear.x',
        'twist.twist.angular.z',
    ],
)
def test_non_finite_odometry_stays_non_finite(place, value):
    message = message_of(State(0, Pose(1, 2, 3), BodyTwist(4, 5)))
    assert from_odometry(message).is_finite()
    *parents, name = place.split('.')
    owner = message
    for parent in parents:
        owner = getattr(owner, parent)
    setattr(owner, name, value)
    assert not from_odometry(message).is_finite()


def test_poses_in_all_their_messages_agree():
    for motion in motions():
        odometry = message_of(motion)
        posed = ros_messages.pose_stamped(motion, 'odom')
        moved = ros_messages.transform(motion.stamp_ns, motion.pose, 'odom', 'base_link', 0.25)
        assert posed.pose == odometry.pose.pose
        assert posed.header.stamp == moved.header.stamp == odometry.header.stamp
        assert (posed.header.frame_id, moved.header.frame_id) == ('odom', 'odom')
        assert moved.child_frame_id == 'base_link'
        assert moved.transform.rotation == odometry.pose.pose.orientation
        offset = moved.transform.translation
        assert (offset.x, offset.y, offset.z) == (*motion.pose[:2], 0.25)


def test_a_planar_covariance_fills_x_y_and_yaw():
    """ROS orders the rows x, y, z, roll, pitch, yaw (REP 103, geometry_msgs)."""
    generator = np.random.default_rng(7)
    root = generator.normal(size=(3, 3))
    planar = root @ root.T
    known = [0, 1, 5]
    for least, wanted in (
        (0.0, planar),
        (1e9, planar - np.diag(np.diag(planar)) + 1e9 * np.eye(3)),
    ):
        full = np.array(ros_messages.planar_covariance(planar, least)).reshape(6, 6)
        np.testing.assert_array_equal(full[np.ix_(known, known)], wanted)
        np.testing.assert_array_equal(full, full.T)
        assert np.linalg.eigvalsh(full).min() > 0.0
        for unknown in (2, 3, 4):
            assert full[unknown, unknown] == 1e6
            assert np.count_nonzero(full[unknown]) == 1


def test_a_command_survives_a_twist():
    for motion in motions():
        assert ros_messages.body_twist(ros_messages.twist_from_body(motion.twist)) == motion.twist
        stamped = ros_messages.stamped_twist(motion.twist, motion.stamp_ns, 'base_link')
        assert stamped.header.frame_id == 'base_link'
        assert ros_messages.twist_and_stamp(stamped, 5) == (motion.twist, motion.stamp_ns)
    # A command without a stamp has the present time.
    for message in (Twist(), TwistStamped()):
        assert ros_messages.twist_and_stamp(message, 5) == (BodyTwist(0.0, 0.0), 5)


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize('part', ['linear', 'angular'])
@pytest.mark.parametrize('axis', ['x', 'y', 'z'])
def test_one_non_finite_number_invalidates_a_command(part, axis, value):
    message = ros_messages.twist_from_body(BodyTwist(0.5, 1.0))
    setattr(getattr(message, part), axis, value)
    for each in (message, TwistStamped(twist=message)):
        twist, _ = ros_messages.twist_and_stamp(each, 5)
        assert not all(map(math.isfinite, twist))


def test_wheel_joints_keep_their_order():
    message = ros_messages.joint_state(('right', 'left'), (1.0, 2.0), np.array((3.0, 4.0)), 7)
    assert message.name == ['right', 'left']
    assert (list(message.position), list(message.velocity)) == ([1.0, 2.0], [3.0, 4.0])
    assert ros_messages.ns_from_time(message.header.stamp) == 7


# -- sensors --------------------------------------------------------------------------------------


def test_imu_covariance_is_the_variance_of_its_samples():
    """At rest, without drift of the bias."""
    parameters = SimulatedImuParameters(gyro_drift=0.0)
    sensor = SimulatedImu(parameters, np.random.default_rng(3))
    still = np.zeros((3, 2))
    samples = np.array([sensor.measure(still, 0.01) for _ in range(20_000)])
    message = robot_messages.imu_message(parameters, 'a/imu')
    turn, push = message.angular_velocity_covariance, message.linear_acceleration_covariance
    claimed = (turn[8], push[0], push[4])
    np.testing.assert_allclose(samples.var(axis=0), claimed, rtol=0.1)
    assert message.orientation_covariance[0] == -1.0
    for covariance, unknown in ((turn, (0, 4)), (push, (8,))):
        matrix = np.array(covariance).reshape(3, 3)
        np.testing.assert_array_equal(matrix, np.diag(np.diag(matrix)))
        assert all(covariance[place] == 1e6 for place in unknown)
    noisier = robot_messages.imu_message(ImuParameters(gyro_noise=0.05), 'imu_link')
    assert noisier.angular_velocity_covariance[8] > 50.0 * turn[8]
    robot_messages.fill_imu(message, ImuSample(0.5, 1.0, -2.0), 7)
    assert ros_messages.ns_from_time(message.header.stamp) == 7
    assert message.header.frame_id == 'a/imu'
    turn, push = message.angular_velocity, message.linear_acceleration
    assert (turn.x, turn.y, turn.z) == (0.0, 0.0, 0.5)
    assert (push.x, push.y, push.z) == (1.0, -2.0, 9.80665)


FLOATS = np.float32


@pytest.mark.parametrize(
    'distance, infinity, expected',
    [
        (0.345, True, FLOATS(0.345)),
        (0.10, True, FLOATS(0.10)),
        (-math.inf, True, -math.inf),
        (math.inf, True, math.inf),
        (0.345, False, FLOATS(0.345)),
        (-math.inf, False, -math.inf),
        (math.inf, False, FLOATS(0.80)),
    ],
)
def test_a_distance_follows_rep_117_after_serialization(distance, infinity, expected):
    """Ranges are serialized in single precision; a value at a limit must stay within it."""
    message = robot_messages.range_message(RangeSensorParameters(), 'left_front_range_link')
    robot_messages.fill_range(message, distance, 7, infinity=infinity)
    received = deserialize_message(serialize_message(message), Range)
    assert received.range == expected
    assert received.radiation_type == Range.INFRARED
    assert received.field_of_view == FLOATS(0.1)
    if math.isfinite(expected):
        assert received.min_range <= received.range <= received.max_range
        assert (received.range == received.max_range) == (expected == FLOATS(0.8))


def test_a_discharging_battery_has_a_negative_current():
    parameters = BatteryParameters(cells=4, capacity=2.0)
    message = robot_messages.battery_message(parameters)
    robot_messages.fill_battery(message, BatteryReading(15.0, 0.5, 0.75), 7)
    assert (message.voltage, message.current, message.percentage) == (15.0, -0.5, 0.75)
    assert (message.charge, message.design_capacity) == (1.5, 2.0)
    assert message.power_supply_status == message.POWER_SUPPLY_STATUS_DISCHARGING
    assert len(message.cell_voltage) == 4
    assert np.isnan([*message.cell_voltage, message.temperature, message.capacity]).all()
    robot_messages.fill_battery(message, BatteryReading(15.0, math.nan, math.nan), 8)
    assert np.isnan([message.current, message.charge, message.percentage]).all()


@pytest.mark.slow
def test_the_covariance_of_a_twist_is_that_of_its_wheels():
    geometry, variance = WheelGeometry(), 0.04
    rng = np.random.default_rng(9)
    wheels = rng.normal(scale=math.sqrt(variance), size=(20_000, 2))
    twists = np.array([twist_from_wheels(WheelSpeeds(*pair), geometry) for pair in wheels])
    covariance = np.array(robot_messages.twist_covariance(geometry, variance)).reshape(6, 6)
    np.testing.assert_allclose([covariance[0, 0], covariance[5, 5]], twists.var(axis=0), rtol=0.05)
    assert covariance[1, 1] == 1e6
    misled = np.array(robot_messages.twist_covariance(geometry, math.inf)).reshape(6, 6)
    np.testing.assert_array_equal(misled, 1e6 * np.eye(6))


def test_count_variance_is_that_of_quantisation():
    step, period = 0.002, 0.01
    rng = np.random.default_rng(10)
    angles = np.cumsum(rng.uniform(0.01, 0.05, 20_000))
    counted = np.diff(np.floor(angles / step) * step) / period
    error = counted - np.diff(angles) / period
    assert robot_messages.count_variance(step, period) == pytest.approx(error.var(), rel=0.05)


# -- diagnostics ----------------------------------------------------------------------------------


def _state(reason='', lost=(0, 0), **status):
    flags = {'enabled': True, 'moving': False, 'estop': False, 'timed_out': False} | status
    return RobotState(
        stamp_ns=0,
        wheels=ZERO_WHEEL_SPEEDS,
        angles=WheelAngles(0.0, 0.0),
        odometry=State(0, Pose(0, 0, 0), BodyTwist(0, 0)),
        covariance=np.zeros((3, 3)),
        commanded=ZERO_WHEEL_SPEEDS,
        status=RobotStatus(limited=False, **flags),
        reason=reason,
        battery=BatteryReading(9.87, 0.5, 0.1),
        lost_steps=lost,
    )


@pytest.mark.parametrize(
    'state, faults, words',
    [
        (_state(), (), []),
        (_state(), None, []),
        (_state('no command yet'), (), ['no command yet']),
        (_state(slipping=True), (), ['a wheel slips']),
        (_state(SLIP_STOP_REASON, slipping=True), (), ['gyro and steps disagree']),
        (_state(imu_fault=True), (), ['inertial sensor does not answer']),
        (_state(low_battery=True), (), ['battery is low: 9.9 V']),
        (_state(lost=(4, -8)), (), ['steps lost: 4 right, -8 left']),
        (_state('why', imu_fault=True), (), ['why', 'inertial sensor']),
        (_state(), ('gyro_dead', 'delay 0.1 s'), ['faults: gyro_dead, delay 0.1 s']),
    ],
)
def test_warnings_name_each_problem_once(state, faults, words):
    inside = None
    if faults is not None:
        inside = TwinDiagnostics(faults, (0.1, 0.2), (0.0, 0.0), 0.05, 0.04, 0.0)
    found = state_warnings(state, inside)
    assert len(found) == len(words)
    for text, word in zip(found, words, strict=True):
        assert word in text
    values = state_values(state, inside)
    assert values['battery_v'] == 9.87
    if inside is not None:
        assert values['faults'] == (', '.join(faults) or 'none')
        assert (values['gyro_bias_rad_s'], values['gyro_bias_estimate_rad_s']) == (0.05, 0.04)
        assert (values['slid_right_m'], values['slid_left_m']) == (0.1, 0.2)
